"""LoopLimits: what a loop shall keep, as the page draws and judges it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..checks import Value, checked, positive
from .evaluation import AxisLoop


class Judged(NamedTuple):
    """One limit: what is required, what was reached, whether it is met (None: not known)."""

    name: str
    required: str
    reached: str
    met: bool | None


@dataclass(frozen=True, eq=False, repr=False)
class LoopLimits(Value):
    """Limits on each loop: None leaves one out.

    Parameters
    ----------
    peak : float
        Largest |S|; 2 is a modulus margin of 0.5, 6 dB.
    gain_margin : float, optional
        Least factor on the gain.
    phase_margin : float, optional [deg]
        The least.
    bandwidth : float, optional [Hz]
        The least at which |S| crosses 0 dB.
    suppressed, below : float, optional
        |S| shall stay under `suppressed` up to the frequency `below` [Hz].
    rms : float, optional
        Largest predicted rms of the error, in its unit.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.workbench.LoopLimits(peak=2.0, phase_margin=30.0)
    LoopLimits(peak=2, phase_margin=30 deg)
    """

    peak: float = field(default=2.0, metadata=checked(positive))
    gain_margin: float | None = field(default=None, metadata=checked(positive))
    phase_margin: float | None = field(default=None, metadata=checked(positive, unit="deg"))
    bandwidth: float | None = field(default=None, metadata=checked(positive, unit="Hz"))
    suppressed: float | None = field(default=None, metadata=checked(positive))
    below: float | None = field(default=None, metadata=checked(positive, unit="Hz"))
    rms: float | None = field(default=None, metadata=checked(positive))

    def judged(self, loop: AxisLoop, rms: float | None = None) -> Iterator[Judged]:
        """Yield each limit with what a loop reaches.

        Parameters
        ----------
        loop : AxisLoop
            The loop.
        rms : float, optional
            The predicted rms, where it is known.
        """
        stable, margins = loop.is_stable, loop.margins

        def at_least(name: str, wanted: float | None, value: float, unit: str) -> Iterator[Judged]:
            if wanted is not None:
                met = None if stable is None else bool(stable and value >= wanted)
                yield Judged(name, f"at least {wanted:.4g}{unit}", f"{value:.4g}{unit}", met)

        peak = 1.0 / margins.modulus_margin if margins.modulus_margin else np.inf
        met = None if stable is None else bool(stable and peak <= self.peak)
        decibel = 20.0 * np.log10([self.peak, peak])
        yield Judged("peak of |S|", f"at most {decibel[0]:.3g} dB", f"{decibel[1]:.3g} dB", met)
        gain = min(margins.gain_margin, 1.0 / (margins.gain_reduction or 1e-300))
        yield from at_least("gain margin", self.gain_margin, gain, "")
        yield from at_least("phase margin", self.phase_margin, margins.phase_margin, " deg")
        yield from at_least("bandwidth", self.bandwidth, loop.bandwidth, " Hz")
        low = loop.freq <= (self.below or 0.0)
        if self.suppressed is not None and not np.any(low):
            reached = "no frequency given" if self.below is None else "no line there"
            yield Judged("|S| at low frequencies", f"at most {self.suppressed:.3g}", reached, None)
        elif self.suppressed is not None and self.below is not None:
            worst = float(np.abs(loop.S[low]).max(initial=0.0))
            met = None if stable is None else bool(stable and worst <= self.suppressed)
            level = 20.0 * np.log10([self.suppressed, max(worst, 1e-300)])
            yield Judged(
                f"|S| to {self.below:.4g} Hz",
                f"at most {level[0]:.3g} dB",
                f"{level[1]:.3g} dB",
                met,
            )
        if self.rms is not None:
            known = rms is not None and np.isfinite(rms)
            met = bool(rms <= self.rms) if rms is not None and known else None
            reached = f"{rms:.3g}" if known else "not known"
            yield Judged("rms of the error", f"at most {self.rms:.3g}", reached, met)
