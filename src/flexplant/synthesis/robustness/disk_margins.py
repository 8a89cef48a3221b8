"""Disk margins: gain and phase that may change together, one loop at a time or all at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...arrays import ComplexArray, FloatArray
from ...errors import ModelError, aligned
from ...loop.broken import BrokenLoop, inverted, scaled_size
from ...loop.report import LoopMargins, report_loops
from ...loop.sensitivity_functions import Loop, taken_apart
from ...lti.frequency_sweep import ROUNDS, highest
from ...plant.uncertainty.delta_blocks import FullBlock
from ...store import Value
from .mu_bounds import mu

#: the three disks in use, by their skew sigma [Seiler2020]_: symmetric in gain, S and T
SKEWS = {"S-T": 0.0, "S": 1.0, "T": -1.0}
#: heads of the two parts of the table
_CLASSICAL = ("loop", "crosses 1 at [Hz]", "phase [deg]", "delay [ms]", "gain at [Hz]", "factor")
_DISK = ("loop", "disk", "alpha", "at [Hz]", "gain [dB]", "phase [deg]", "reached by")


@dataclass(frozen=True, eq=False, repr=False)
class DiskMargin(Value):
    """The disk of complex gain changes within which a closed loop is sure to stay stable.

    The loop gain is multiplied by the complex factor ``f = (2 + (1 - sigma) d) / (2 - (1 + sigma)
    d)``. The number d is the change, and sigma is the skew. The closed loop stays stable for all
    complex d with ``|d| < alpha``. For one loop, ``alpha = 1 / max |S + (sigma - 1) / 2|``, where S
    is the sensitivity.

    Parameters
    ----------
    kind : {"S-T", "S", "T"}
        Kind of change. "S-T" has a skew sigma of 0: the gain may rise and fall by the same factor.
        "S" has a skew of 1, a relative change of 1 / L, where L is the loop gain; its alpha is the
        modulus margin. "T" has a skew of -1, a relative change of L.
    alpha : float
        Size of d up to which stability is guaranteed.
    reached : float
        Size of a change d that makes the loop unstable. For one loop it equals alpha. For several
        loops together it follows from the lower bound of the structured singular value mu, and may
        be larger than alpha.
    freq : float [Hz]
        Frequency at which the loop is closest to the critical point.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.margins(fx.lti.tf([25.0], [1.0, 10.0, 10.0, 10.0])).disks[0][0]
    <DiskMargin S-T: alpha 0.458 at 0.3112 Hz, gain 0.627 to 1.59, phase 26 deg>
    """

    kind: str
    alpha: float
    reached: float
    freq: float

    @property
    def gains(self) -> tuple[float, float]:
        """The smallest and the largest real factor on the gain that the disk allows."""
        sigma, a = SKEWS[self.kind], self.alpha
        low = (2.0 - a * (1.0 - sigma)) / (2.0 + a * (1.0 + sigma))
        rest = 2.0 - a * (1.0 + sigma)
        high = (2.0 + a * (1.0 - sigma)) / rest if rest > 0.0 else float("inf")
        return max(low, 0.0), high

    @property
    def phase(self) -> float:
        """The largest change of phase [deg], lead or lag, that the disk allows."""
        # where the disk of the factors f, symmetric to the real axis, meets the unit circle
        sigma, square = SKEWS[self.kind], self.alpha**2
        cosine = (4.0 - square * (1.0 + sigma**2)) / (4.0 + square * (1.0 - sigma**2))
        return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def __repr__(self) -> str:
        low, high = self.gains
        return (
            f"<DiskMargin {self.kind}: alpha {self.alpha:.3f} at {self.freq:.4g} Hz, gain "
            f"{low:.3g} to {high:.3g}, phase {self.phase:.0f} deg>"
        )


@dataclass(frozen=True, eq=False, repr=False)
class MarginTable(Value):
    """All usual margins of a loop. It prints as a table with units.

    Parameters
    ----------
    loops : tuple of LoopMargins
        Classical margins of one loop at a time: all crossovers, gain, phase and delay.
    disks : tuple of tuples of DiskMargin
        Disk margins of each loop, for the kinds S-T, S and T.
    together : tuple of DiskMargin
        Disk margins of the same three kinds if all loops change at the same time, each by a
        separate complex factor. They are computed from bounds of the structured singular value mu.
        For a single loop they equal those of `disks`.
    """

    loops: tuple[LoopMargins, ...]
    disks: tuple[tuple[DiskMargin, ...], ...]
    together: tuple[DiskMargin, ...]

    def __repr__(self) -> str:
        rows = [row for loop in self.loops for row in _classical_rows(loop)]
        disks = [
            _disk_row(loop.name, disk)
            for loop, own in zip(self.loops, self.disks, strict=True)
            for disk in own
        ]
        if len(self.loops) > 1:
            disks += [_disk_row("all at once", disk) for disk in self.together]
        return "\n".join([*aligned(_CLASSICAL, rows), "", *aligned(_DISK, disks)])


def margins(loop: Loop, *, at: Literal["u", "y"] = "u") -> MarginTable:
    """Return classical margins and disk margins of each loop, and of all loops together.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller), or a loop gain L of negative feedback
        Loop, as for `flexplant.loop.loop_gain`. The plant may be a measured Frf.
    at : {"u", "y"}
        Where the loops are broken.

    Returns
    -------
    MarginTable
        Table of the margins. The classical margins are gain, phase and delay at each crossover. A
        disk margin is the size `alpha` of complex changes of the loop gain up to which the loop
        stays stable. `DiskMargin` defines its kinds S-T, S and T.

    Raises
    ------
    ModelError
        When the closed loop is not stable. It then has no margins.
    LabelError
        When channels of plant and controller do not match.

    References
    ----------
    [Seiler2020]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> print(fx.synthesis.margins(fx.lti.tf([25.0], [1.0, 10.0, 10.0, 10.0])))
    loop  crosses 1 at [Hz]  phase [deg]  delay [ms]  gain at [Hz]  factor
    in                0.284        +29.1         285        0.5033     3.6
    <BLANKLINE>
    loop  disk  alpha  at [Hz]     gain [dB]  phase [deg]  reached by
    in     S-T  0.458   0.3112  -4.1 to +4.1         25.8       0.458
    in       S  0.402   0.3201  -2.9 to +4.5         23.2       0.402
    in       T  0.486   0.2985  -5.8 to +3.4         28.1       0.486
    """
    parts = taken_apart(loop)
    found = report_loops(loop, at=at)
    if found.is_stable is False:
        raise ModelError(
            f"the closed loop is not stable ({found.poles}): it has no margins. "
            "fx.loop.report_loops gives its distances to the critical point."
        )
    count = len(found)
    disks = tuple(
        tuple(_disk(parts, at, kind, slice(i, i + 1)) for kind in SKEWS) for i in range(count)
    )
    together = tuple(_disk(parts, at, kind, slice(None)) for kind in SKEWS)
    return MarginTable(found.loops, disks, together)


def _disk(parts: BrokenLoop, at: Literal["u", "y"], kind: str, some: slice) -> DiskMargin:
    """Return the disk margin of some of the loops, the others closed."""
    shift = 0.5 * (SKEWS[kind] - 1.0)

    def changed(freq: FloatArray) -> ComplexArray:
        S = inverted(parts.gain(freq, at))[:, some, some]
        return np.asarray(S + shift * np.eye(S.shape[-1]))

    rounds = 0 if parts.measured is not None else ROUNDS
    size, freq = highest(lambda f: scaled_size(changed(f)), parts.followed, rounds)
    worst = changed(np.array([freq]))[0]
    lower = mu(worst, [FullBlock()] * len(worst)).lower
    return DiskMargin(kind, 1.0 / size, 1.0 / lower if lower else float("inf"), freq)


def _classical_rows(loop: LoopMargins) -> list[tuple[str, ...]]:
    """Return the rows of one loop: its crossovers and its factors, side by side."""
    delays = [
        phase % 360.0 / (0.36 * freq)
        for phase, freq in zip(loop.phases, loop.crossovers, strict=True)
    ]
    left = [
        (f"{freq:.4g}", f"{phase:+.1f}", f"{delay:.3g}")
        for freq, phase, delay in zip(loop.crossovers, loop.phases, delays, strict=True)
    ]
    left = left or [("never", "", "")]
    right = [(f"{freq:.4g}", f"{factor:.3g}") for freq, factor in loop.gains]
    count = max(len(left), len(right), 1)
    left += [("", "", "")] * (count - len(left))
    right += [("", "")] * (count - len(right))
    names = [loop.name, *[""] * (count - 1)]
    return [(name, *a, *b) for name, a, b in zip(names, left, right, strict=True)]


def _disk_row(name: str, disk: DiskMargin) -> tuple[str, ...]:
    with np.errstate(divide="ignore"):
        low, high = (20.0 * np.log10(gain) for gain in disk.gains)
    return (
        name, disk.kind, f"{disk.alpha:.3f}", f"{disk.freq:.4g}", f"{low:+.1f} to {high:+.1f}",
        f"{disk.phase:.1f}", f"{disk.reached:.3f}",
    )  # fmt: skip
