"""Resonances narrower than the lines of windowed segments: leakage widens and splits them."""

from __future__ import annotations

import warnings

import numpy as np

from ..errors import FlexplantWarning, SolverError
from ..lti.frequency import Frf
from ..values import ComplexArray

#: width 2 zeta f of a resonance in lines below which leakage is more than a few per cent of it
FEWEST = 4.0
#: leakage widens what is seen of such a resonance: by this much at most where it has that width
WIDENED = 1.2


def leakage_warned(frf: Frf, poles: ComplexArray) -> None:
    r"""Warn of poles whose resonance is narrower than about four lines of windowed segments.

    Random excitation through a window smears the response over the main lobe of ``|W|^2``. Its
    second moment is 4/3 of a squared line for a Hann window, so that damping is overestimated by
    1 % at 10 lines, by some 10 % at 4, and one resonance becomes two poles below (Bendat and
    Piersol, Random Data, 2010, sec. 11.6).
    """
    if frf.window is None or frf.resolution is None:
        return
    width = -2.0 * poles.real / (2 * np.pi)
    lines = width / (frf.resolution * WIDENED)
    narrow = np.flatnonzero(lines < FEWEST)
    if not narrow.size:
        return
    worst = int(narrow[np.argmin(lines[narrow])])
    freq = np.abs(poles) / (2 * np.pi)
    listed = ", ".join(f"{freq[k]:.4g} Hz (2 zeta f = {width[k]:.2g} Hz)" for k in narrow[:4])
    more = f" and {narrow.size - 4} more" if narrow.size > 4 else ""
    warnings.warn(
        f"segments of {1 / frf.resolution:.3g} s are too short for the damping near "
        f"{listed}{more}: below about 4/segment = {FEWEST * frf.resolution:.2g} Hz leakage "
        "widens a resonance and splits it into several poles, so that damping and the number of "
        f"modes are wrong by more than their stated deviation. Take segment= of at least "
        f"{FEWEST * WIDENED / width[worst]:.2g} s (the true damping is less than what is seen), "
        "or excite with whole periods, Periodic(...).",
        FlexplantWarning,
        4,
    )


def no_pole(frf: Frf, error: SolverError) -> SolverError:
    """Return the error of a search that found no pole, with leakage as a possible cause."""
    if frf.window is None or frf.resolution is None:
        return error
    return SolverError(
        f"{error} The responses come from windowed segments of {1 / frf.resolution:.3g} s: where "
        f"resonances are narrower than about four lines ({FEWEST * frf.resolution:.2g} Hz), "
        "leakage makes poles unstable. Take longer segments, segment=, or excite with whole "
        "periods, Periodic(...)."
    )
