"""Leakage: what windowed segments make of narrow resonances, fitted where it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import SolverError, warn
from ..lti.frequency import Frf
from ..values import ComplexArray
from .identified import IdentifiedModes
from .refine import Fit, Lines, refined

#: width 2 zeta f of a resonance in lines below which leakage is more than a few per cent of it
FEWEST = 4.0
#: leakage widens what is seen of such a resonance: by this much at most where it has that width
WIDENED = 1.2
#: the same in lines where the window is fitted through: then little but its main lobe is seen
FEWEST_THROUGH = 0.5


def hann_segment(frf: Frf) -> float | None:
    """Return the length [s] of the Hann-windowed segments of a measurement, None of others."""
    known = frf.window == "hann" and frf.resolution is not None
    return 1.0 / float(frf.resolution or 1.0) if known else None


def seen_better(
    lines: Lines, fit: Fit, poles: ComplexArray, participation: ComplexArray, *, steps: int
) -> tuple[Lines, Fit]:
    """Return the fit through the window, or without it where that leaves less.

    H1 of an input that is white over a few lines is what the window makes of the response; H2, Hv
    and bursts that end within a segment are not.
    """
    if lines.segment is None:
        return lines, fit
    plain = replace(lines, segment=None)
    other = refined(plain, poles, participation, steps=steps, strict=False)
    return (plain, other) if other.cost < fit.cost else (lines, fit)


def leakage_warned(frf: Frf, found: IdentifiedModes) -> None:
    r"""Warn of resonances narrower than about four lines of windowed segments.

    Random excitation through a window smears the response over the main lobe of ``|W|^2``. Its
    second moment is 4/3 of a squared line for a Hann window, so that damping is overestimated by
    1 % at 10 lines, by some 10 % at 4, and one resonance becomes two poles below
    ([BendatPiersol2010]_, section 11.6). Where the window is fitted through: half a line.
    """
    if frf.window is None or frf.resolution is None:
        return
    poles = found.poles
    width = -2.0 * poles.real / (2 * np.pi)
    fewest, widened = (FEWEST, WIDENED) if found.segment is None else (FEWEST_THROUGH, 1.0)
    lines = width / (frf.resolution * widened)
    narrow = np.flatnonzero(lines < fewest)
    if not narrow.size:
        return
    worst = int(narrow[np.argmin(lines[narrow])])
    freq = np.abs(poles) / (2 * np.pi)
    listed = ", ".join(f"{freq[k]:.4g} Hz (2 zeta f = {width[k]:.2g} Hz)" for k in narrow[:4])
    more = f" and {narrow.size - 4} more" if narrow.size > 4 else ""
    warn(
        f"segments of {1 / frf.resolution:.3g} s are too short for the damping near "
        f"{listed}{more}: below about {fewest:g}/segment = {fewest * frf.resolution:.2g} Hz "
        "leakage widens a resonance and splits it into several poles, so that damping and the "
        "number of modes are wrong by more than their stated deviation. Take segment= of at least "
        f"{fewest * widened / width[worst]:.2g} s (the true damping is less than what is seen), "
        "or excite with whole periods, Periodic(...)."
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
