"""A loop on other machines: with truncated modes, and intervals over drawn machines."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, one_of
from ..certificates import Certificate, Verified, one_line, stability_check, stability_name
from ..errors import SHOWN, ModelError, named_modes
from ..lti.statespace import StateSpace
from ..plant.machine_plants import FigureInterval, PlantMachines, interval, interval_text
from ..store import Value
from ..tolerances import INTERVAL, TINY
from .broken import axis_bandwidths, axis_sensitivities, moved_poles

#: participation relative to the largest below which a mode is not named
_TAKES_PART = 0.3
#: |S| at u with truncated modes above which a warning is given (8 dB), and ratio to |S| without
#: them
_HIGH, _LARGER = 2.5, 1.1


@dataclass(frozen=True, eq=False, repr=False)
class SpillOver(Value):
    """The check of a loop on the plant with truncated modes. Sampling and delay stay the same.

    Parameters
    ----------
    stability : float
        Spectral radius of a sampled closed loop on that plant, below 1 when stable. For a
        continuous loop it is the largest real part of the poles [rad/s], below 0 when stable.
    sampled : bool
        Whether the loop is sampled.
    modulus_margin : float
        Modulus margin on that plant, with the loop opened at u; 0 when unstable.
    without : float
        Modulus margin on the plant without the truncated modes; 0 when unstable.
    peak_freq : float [Hz]
        Frequency at which |S| at u is largest with the truncated modes; NaN when unstable.
    states : int
        Number of states of the plant with the truncated modes.
    modes : sequence of int
        Numbers of the modes that take the largest part in the instability, or in the peak of |S|
        at u if `is_high` is true; otherwise empty. Counting starts at 1 and includes rigid-body
        modes.
    freq : sequence of float [Hz]
        Frequency of the instability or of the peak, one value for each of these modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.loop.SpillOver(1.02, True, 0.0, 0.6, float("nan"), 8, (7,), (211.0,))
    >>> found.named_modes
    'mode 7 (at 211 Hz)'
    """

    stability: float
    sampled: bool
    modulus_margin: float
    without: float
    peak_freq: float
    states: int
    modes: tuple[int, ...] = ()
    freq: tuple[float, ...] = ()

    @property
    def is_stable(self) -> bool:
        """Whether the loop is stable with the truncated modes."""
        return self.stability < (1.0 if self.sampled else 0.0)

    @property
    def is_high(self) -> bool:
        """Whether the loop is stable, but truncated modes raise |S| at u above 8 dB."""
        return self.is_stable and high(self.modulus_margin, self.without)

    @property
    def is_fine(self) -> bool:
        """Whether the loop is stable with the truncated modes and `is_high` is false."""
        return self.is_stable and not self.is_high

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of the eigenvalues of the sampled loop with the truncated modes.

        A continuous loop raises ModelError; its `stability` is the largest real part.
        """
        if not self.sampled:
            raise ModelError("the spectral radius belongs to sampled loops: use stability.")
        return self.stability

    @property
    def certificate(self) -> Certificate:
        """Checks on the plant with the truncated modes."""
        beyond = " with truncated modes"
        margin = Verified(f"modulus margin{beyond}", self.modulus_margin, "a sweep of |1 + L|")
        return Certificate((stability_check(self.stability, self.sampled, of=beyond), margin))

    @property
    def _measure(self) -> str:
        return stability_name(self.sampled)

    @property
    def named_modes(self) -> str:
        """Text of the modes that cause the instability or the peak."""
        return modes_in_words(self.modes, self.freq)

    def __repr__(self) -> str:
        return f"<SpillOver: {self.summary}>"

    @property
    def summary(self) -> str:
        """Text of the result in one line."""
        found = one_line({self._measure: self.stability})
        if not self.is_stable:
            return f"unstable ({self.states} states), {found}: {self.named_modes}"
        there = f"stable ({self.states} states), {found}, |S| at u up to {_db(self.modulus_margin)}"
        if not self.is_high:
            return there
        return (
            f"{there} at {self.peak_freq:.4g} Hz where it is at most {_db(self.without)} without "
            f"them: {self.named_modes}"
        )


def _db(margin: float) -> str:
    return f"{-20.0 * np.log10(margin):.3g} dB"


def modes_in_words(modes: Sequence[int], freq: Sequence[float]) -> str:
    """Return a text of modes, the first few of many; a pole of several modes is given once."""
    pairs = list(zip(modes, freq, strict=True))
    listed = []
    for pole, sharing in groupby(pairs[:SHOWN], key=itemgetter(1)):
        listed.append(f"{named_modes(number for number, _ in sharing)} (at {pole:.4g} Hz)")
    more = len(pairs) - SHOWN
    return (", ".join(listed) or "no mode named") + (f" and {more} more" if more > 0 else "")


def high(margin: float, without: float) -> bool:
    """Return whether modes make |S| at u larger than 8 dB: margins with and without them."""
    return margin < min(1.0 / _HIGH, without / _LARGER)


def growing_modes(
    loop: StateSpace, states: Sequence[str], near: float | None = None
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return the numbers of the modes that cause the instability, and its frequencies [Hz]."""
    # by participation factors |left_k right_k| [PerezArriaga1982]_, independent of the units of
    # states
    numbers = np.zeros(loop.n_states, dtype=np.int64)  # 0 for states outside of modes
    for i, name in enumerate(states):
        if owner := re.fullmatch(r"mode(\d+):[qv]", name):
            numbers[i] = int(owner[1])
    if not np.any(numbers):
        return (), ()
    eigen: Any = la.eig(loop.A, left=True, right=True)
    values, left, right = eigen
    edge = np.abs(values) - 1.0 if loop.dt else values.real
    if near is None:
        looked_at = np.flatnonzero((edge >= 0) & (values.imag >= 0))
        looked_at = looked_at[np.argsort(-edge[looked_at], kind="stable")]
    else:
        turn = 2j * np.pi * near
        turned = np.exp(turn * loop.dt) if loop.dt else turn
        looked_at = np.argsort(np.abs(values - turned), kind="stable")[:1]
    found: dict[int, float] = {}
    for k in looked_at:
        share = np.bincount(numbers, weights=np.abs(left[:, k] * right[:, k]))
        share[0] = 0.0
        pole = np.log(values[k]) / loop.dt if loop.dt else values[k]
        for number in np.flatnonzero(share >= max(_TAKES_PART * share.max(), TINY)).tolist():
            found.setdefault(number, float(abs(pole.imag) / (2.0 * np.pi)))
    return tuple(found), tuple(found.values())


def warn_of_critical(loop: Any) -> None:
    """Warn of modes whose stated uncertainty is too large for a loop."""
    if loop.plant.uncertainty is not None and loop.tolerances is not None:
        loop.tolerances.warn_of_critical()


#: figures that have an interval in the repr of a loop
MODULUS_MARGIN, BANDWIDTH, RADIUS = FIGURES = ("modulus margin", "bandwidth", "spectral radius")


class MachineLoops:
    """One controller around each of the machines ``plant.machines``; figures are cached."""

    def __init__(self, loop: Any, machines: PlantMachines) -> None:
        self.machines = machines
        near = loop.completed or loop
        self.loops = [loop_beside(near, loop.plant.around(plant)) for plant in machines.plants]
        self._found: dict[Any, FloatArray] = {}

    @property
    def unstable(self) -> int:
        """Number of machines on which the loop is not stable."""
        return sum(not loop.is_stable for loop in self.loops)

    def values(self, figure: str | Callable[[Any], float]) -> FloatArray:
        """Return a figure, the rms of a channel, or a function of the loop on each machine."""
        if figure not in self._found:
            self._found[figure] = np.array([_figure(loop, figure) for loop in self.loops])
        return self._found[figure]


def loop_beside(known: Any, plant: Any) -> Any:
    """Return the loop of a controller around a machine, its poles from a like one's if proven."""
    loop = known.around(plant)
    poles = moved_poles(known, loop)
    if poles is not None:
        loop.__dict__["_poles"] = poles
    return loop


def _figure(loop: Any, figure: str | Callable[[Any], float]) -> float:
    if not isinstance(figure, str):
        return float(figure(loop))
    if figure == BANDWIDTH:
        return min(axis_bandwidths(loop).values())
    if figure == RADIUS:  # the distance to the circle is log-normal, not the radius
        return 1.0 - float(loop.spectral_radius)
    return float(loop.modulus_margin if figure == MODULUS_MARGIN else loop.drawn_rms(figure))


def loop_interval(
    loop: Any, figure: str | Callable[[Any], float], level: float, unit: str = ""
) -> FigureInterval:
    """Return the interval of a figure or a channel's rms; see `ClosedLoop.interval`."""
    known = loop.plant.machine.machines
    if isinstance(figure, str):
        figure = one_of(figure, "figure", (*FIGURES, *loop.monitored.outputs))
    if known is None or known.missing:
        return interval(known, lambda: np.zeros(0), level, "")
    loops = loop.on_machines
    if loops.unstable:
        return FigureInterval(
            None, None, f"unstable on {loops.unstable} of {len(loops.loops)} such machines"
        )
    if figure == BANDWIDTH and not axis_sensitivities(loop):
        return FigureInterval(None, None, "no interval: the loop has no reference")
    if isinstance(figure, str):
        unit = "Hz" if figure == BANDWIDTH else loop.units.get(figure, "")
    given = "" if callable(figure) or figure in FIGURES else known.densities
    own = None
    if isinstance(figure, str) and loop.is_stable:  # a figure of the loop is verified
        own = _figure(loop, figure) if figure in FIGURES else loop.rms(figure)
    found = interval(known, partial(loops.values, figure), level, unit, given, own)
    if figure != RADIUS or found.low is None or found.high is None:
        return found
    low, high = 1.0 - found.high, 1.0 - found.low
    return FigureInterval(
        low, high, f"{low:.6f} to {high:.6f} on {100 * level:.3g} % of such machines"
    )


def interval_line(loop: Any) -> str:
    """Return the line of a loop's repr: intervals of all figures, or the reason without them."""
    known = loop.plant.machine.machines
    if known is None:
        return ""
    found = {figure: loop_interval(loop, figure, INTERVAL) for figure in FIGURES}
    if found[MODULUS_MARGIN].low is None:
        return found[MODULUS_MARGIN].sentence
    parts = []
    for figure, one in found.items():
        if one.low is not None and one.high is not None:
            ends = (
                f"{one.low:.6f} to {one.high:.6f}"
                if figure == RADIUS
                else interval_text(one.low, one.high, "Hz" if figure == BANDWIDTH else "")
            )
            parts.append(f"{figure} {ends}")
    return f"on {100 * INTERVAL:.3g} % of such machines:\n    " + ", ".join(parts)
