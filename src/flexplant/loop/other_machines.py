"""A loop on other machines: modal errors, truncated modes, intervals over drawn machines."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, IntArray, positive, real_array
from ..certificates import Certificate, Verified, one_line, stability_check, stability_name
from ..errors import AssumptionError, ModelError, aligned, counted, named_modes, warn
from ..lti.statespace import StateSpace
from ..plant import AnyPlant, standard_plant
from ..plant.machine_plants import FigureInterval, PlantMachines, interval, interval_text
from ..plant.realisation import natural
from ..plant.uncertainty.uncertain_plants import UncertainPlant
from ..store import Value
from ..tolerances import CLOSE, DEVIATIONS, INTERVAL, TINY
from ..words import SHOWN, one_of
from .broken import BrokenLoop, axis_bandwidths, axis_sensitivities, moved_poles
from .mode_crossings import LIMIT, ModeLoops, axis_crossings, size_reached

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


#: number of grid points per half-width around a mode, and largest number on either side
_TO_A_WIDTH, _ASIDE = 2, 400
#: searched range of relative changes of damping: without damping, a mode that the loop does not
#: affect is marginal
_DAMPINGS = (-0.999, 2.0)
#: modulus margin for which tolerances are stated: |S| at u of 2.9, 9 dB
MARGIN = 0.35
#: ratio of the search range, or that of a grid, to the requested change, so that a crossing and the
#: flanks of a resonance lie inside
BEYOND = 1.25


@dataclass(frozen=True, eq=False, repr=False)
class ModeTolerances(Value):
    """The smallest change of each mode, with the others unchanged, at which a loop fails.

    Each array with two columns holds the change downwards (negative) and the change upwards. A
    change is infinite if the loop does not fail up to `limit`. In the printed table, ">5" means
    that it does not fail up to 5 %. A frequency is changed through the stiffness of the mode, so
    that its damping force stays the same.

    Parameters
    ----------
    modes : (m,) array
        Numbers of the modes. Counting starts at 1 and includes rigid-body modes.
    freq : (m,) array [Hz]
        Frequencies of the modes in the plant.
    stable : (m, 2) array
        Relative changes of frequency at which the loop becomes unstable.
    within : (m, 2) array
        Relative changes of frequency at which the modulus margin of the loop falls to `margin`.
    damping : (m, 2) array
        Relative changes of damping at which the loop becomes unstable. Changes from -1 to 2 are
        examined.
    margin : float
        Modulus margin that defines `within`, with the loop opened at u.
    limit : (m,) array
        Largest relative change of frequency examined.
    known : (m,) array, optional
        Relative uncertainty of each frequency.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.close_loop(plant, observer, servo).mode_tolerances()
    <ModeTolerances of 2 modes: stays stable if one modal frequency (not its shape) shifts by 5 %
      mode      Hz  |S| at u of 2.86   unstable
      2     100.66         ->5 +>5 %  ->5 +>5 %
      3     174.35         ->5 +>5 %  ->5 +>5 %>
    """

    modes: IntArray
    freq: FloatArray
    stable: FloatArray
    within: FloatArray
    damping: FloatArray
    margin: float
    limit: FloatArray
    known: FloatArray | None = None

    @property
    def least(self) -> FloatArray:
        """Smallest change (m,) of each frequency at which the loop fails or reaches `margin`.

        If the loop does not have this margin without a change, only failure counts.
        """
        ends = [self.stable] if self._is_below else [self.within, self.stable]
        return np.asarray(np.abs(np.hstack(ends)).min(axis=1))

    @property
    def _is_below(self) -> bool:
        """Whether the loop is below `margin` without a change."""
        return not np.any(self.within)

    @property
    def critical(self) -> tuple[int, ...]:
        """Modes with a tolerance below twice their uncertainty; empty if that is not known."""
        if self.known is None:
            return ()
        return tuple(self.modes[self.least < DEVIATIONS * self.known].tolist())

    @property
    def summary(self) -> str:
        """Text of the mode with the smallest tolerance."""
        if not self.modes.size:
            return "no elastic mode"
        worst = int(np.argmin(self.least))
        below = f"the modulus margin is below {self.margin:.3g}, " if self._is_below else ""
        if not np.isfinite(self.least[worst]):
            off = f"{100 * self.limit.min():.2g} %"
            return f"{below}stays stable if one modal frequency (not its shape) shifts by {off}"
        to = f"a modulus margin of {self.margin:.3g}"
        side = int(np.argmin(np.abs(self.within[worst])))
        change = self.within[worst, side]
        if self._is_below or not np.isfinite(change):
            change = self.stable[worst, int(np.argmin(np.abs(self.stable[worst])))]
            to = "instability"
        return (
            f"{below}mode {self.modes[worst]} ({self.freq[worst]:.4g} Hz) shifted by "
            f"{100 * change:+.2g} % "
            f"leads to {to}"
            + ("" if self.known is None else f" (known to {100 * self.known[worst]:.2g} %)")
        )

    @property
    def certificate(self) -> Certificate:
        """Checks of the mode whose tolerance is smallest relative to its uncertainty."""
        checks: list[Verified] = []
        if self.modes.size:
            known = np.ones_like(self.least) if self.known is None else self.known
            with np.errstate(divide="ignore"):
                worst = int(np.argmin(self.least / known))
            name = f"mode {self.modes[worst]}"
            if np.isfinite(self.least[worst]):  # else no change of a single mode matters
                route = "the loop closed around changed machines"
                checks.append(Verified(f"{name} holds to", float(self.least[worst]), route))
                if self.known is not None:
                    route = "what is known of the machine"
                    checks.append(Verified(f"{name} known to", float(self.known[worst]), route))
        return Certificate(tuple(checks))

    def warn_of_critical(self) -> None:
        """Warn of modes with a tolerance below twice their uncertainty."""
        if self.known is None or not self.critical:
            return
        said = [
            f"mode {mode} ({freq:.4g} Hz) tolerates {100 * least:.2g} %, is known to "
            f"{100 * known:.2g} %"
            for mode, freq, least, known in zip(
                self.modes, self.freq, self.least, self.known, strict=True
            )
            if mode in self.critical
        ]
        more = f" and {len(said) - SHOWN} more" if len(said) > SHOWN else ""
        warn(
            "the loop depends on frequencies that are not known accurately enough: "
            f"{'; '.join(said[:SHOWN])}{more}. Measure these modes, or design for their "
            "uncertainty: design_stage(plant.uncertain(...))."
        )

    def __repr__(self) -> str:
        lines = [f"<ModeTolerances of {counted(self.modes.size, 'mode')}: {self.summary}"]
        head = ("mode", "Hz", f"|S| at u of {1 / self.margin:.3g}", "unstable", "known to", "")
        rows = []
        for i in np.argsort(self.least, kind="stable")[:SHOWN]:
            row = [_percent(ends, self.limit[i]) for ends in (self.within[i], self.stable[i])]
            own = "" if self.known is None else f"{100 * self.known[i]:.2g} %"
            mark = "!" if self.modes[i] in self.critical else ""
            rows.append((str(self.modes[i]), f"{self.freq[i]:.5g}", *row, own, mark))
        lines += [f"  {line}" for line in aligned(head, rows)]
        if self.modes.size > SHOWN:
            lines.append(f"  ... and {self.modes.size - SHOWN} more")
        return "\n".join(lines) + ">"


def _percent(ends: FloatArray, limit: float) -> str:
    """Return two ends of a range in percent."""
    low, high = (
        f"{100 * end:+.2g}" if np.isfinite(end) else f"{sign}>{100 * limit:.2g}"
        for end, sign in zip(ends, "-+", strict=True)
    )
    return f"{low} {high} %"


def mode_tolerances(
    plant: AnyPlant,
    broken: BrokenLoop,
    *,
    margin: float,
    known: Any = None,
    limit: float | Mapping[int, float] = LIMIT,
) -> ModeTolerances:
    """Return the smallest changes of each mode that make a stable loop fail, up to `limit`."""
    # a mapping names the examined modes, each with its own limit. At each point of the stability
    # boundary, a complex change of one mode can place a pole there (`mode_crossings`). Where the
    # imaginary part of this change has a zero along the boundary, a real change makes a pole cross
    # it. The sampled plant's matrices are exact
    _ = standard_plant(plant).assembled.realisation.uncoupled
    margin = positive(margin, "margin")
    if margin >= 1.0:
        raise ModelError(f"margin must be below 1, the largest that a loop can keep, got {margin}.")
    modes, freq, zeta = _swinging_modes(plant)
    if broken.is_unstable:
        raise AssumptionError(
            "the loop is unstable, so that modes have no tolerance. Stabilise it first."
        )
    if isinstance(limit, Mapping):
        some = np.isin(modes, list(limit))
        modes, freq, zeta = modes[some], freq[some], zeta[some]
        most = np.minimum([limit[int(mode)] for mode in modes], LIMIT)
    else:
        most = np.full(modes.size, limit)
    limits = np.minimum(most, _ASIDE / _TO_A_WIDTH * zeta)
    own = _uncertainties(known, modes)
    if not modes.size:
        none = np.zeros((0, 2))
        return ModeTolerances(modes, freq, none, none, none, margin, limits, own)
    loops = ModeLoops.of(plant, broken, modes)
    grids = [
        _around(f, z, end, broken.grid, plant.dt)
        for f, z, end in zip(freq, zeta, limits, strict=True)
    ]
    every, at = np.unique(np.concatenate([*grids, np.zeros(0)]), return_inverse=True)
    mode = np.repeat(np.arange(modes.size), [grid.size for grid in grids])
    swept = loops.swept(every)
    each = swept.swept_modes(at, mode)
    ends = np.outer(limits, [-1.0, 1.0])
    stable = axis_crossings(swept, each, every[at], "freq", ends)
    damping = axis_crossings(swept, each, every[at], "damping", np.tile(_DAMPINGS, (modes.size, 1)))
    passed = np.abs(every[at] / freq[mode] - 1.0) <= BEYOND * limits[mode]
    within = size_reached(swept, each, every[at], passed, stable, limits, 1.0 / margin)
    return ModeTolerances(modes, freq, stable, within, damping, margin, limits, own)


def reported_tolerances(loop: Any) -> ModeTolerances | None:
    """Return the tolerances of the modes of a closed loop, with the uncertainty of its plant."""
    # with the truncated modes, if these are known and frequencies are uncertain; without them for a
    # certain plant, since evaluation models are large and change the result little
    uncertain = loop.plant.uncertainty
    if uncertain is None:
        sure = loop.plant.has_own_modes and loop.is_stable and _swinging_modes(loop.plant)[0].size
        return _tolerances(loop, {}) if sure else None
    whole_loop = loop.completed or loop
    if not uncertain.frequencies or not whole_loop.is_stable:
        return None
    return _tolerances(whole_loop, uncertain.frequencies)


def warn_of_critical(loop: Any) -> None:
    """Warn of modes whose stated uncertainty is too large for a loop."""
    if loop.plant.uncertainty is not None and loop.tolerances is not None:
        loop.tolerances.warn_of_critical()


def _tolerances(loop: Any, known: Mapping[int, float]) -> ModeTolerances | None:
    """Return the tolerances of a stable loop to the changes that a report follows."""
    limit = min(max(CLOSE, BEYOND * DEVIATIONS * max(known.values(), default=0.0)), LIMIT)
    try:
        return mode_tolerances(
            loop.plant, loop.broken, margin=MARGIN, known=known or None, limit=limit
        )
    except ModelError as error:
        if known:
            warn(f"the tolerances of modes are not computed: {error}")
        return None


def _swinging_modes(plant: AnyPlant) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return numbers, frequencies [Hz] and damping ratios of oscillating modes below Nyquist."""
    realisation = plant.assembled.realisation
    omega, zeta = natural(realisation.pairs)
    top = np.pi / plant.dt if plant.dt else np.inf
    swings = (np.arange(omega.size) >= realisation.n_rigid) & (zeta < 1.0) & (omega < top)
    keep = np.flatnonzero(swings & (omega > 0))
    return keep + 1, omega[keep] / (2.0 * np.pi), zeta[keep]


def _around(freq: float, zeta: float, limit: float, grid: FloatArray, dt: float) -> FloatArray:
    """Return frequencies [Hz] over the possible range of a mode, and around it."""
    count = int(np.ceil(limit * _TO_A_WIDTH / max(zeta, TINY)))
    count = min(max(count, 2 * _TO_A_WIDTH), _ASIDE)
    fine = freq * (1.0 + BEYOND * limit * np.linspace(-1.0, 1.0, 2 * count + 1))
    near = np.union1d(fine, grid[(grid > 0.5 * freq) & (grid < 2.0 * freq)])
    return np.asarray(near[near < 0.5 / dt] if dt else near)


def _uncertainties(given: Any, modes: IntArray) -> FloatArray | None:
    """Return the relative uncertainty of each frequency, zero where it is not stated."""
    if given is None:
        return None
    if isinstance(given, UncertainPlant):
        given = given.frequencies
    if isinstance(given, Mapping):
        given = [given.get(int(mode), 0.0) for mode in modes]
    values = real_array(given, "known")
    if values.ndim and values.shape != modes.shape:
        raise ModelError(
            f"known has the shape {values.shape}, the plant {counted(modes.size, 'elastic mode')}: "
            "pass a number, one for each, {mode: number} or an UncertainPlant."
        )
    return np.broadcast_to(values, modes.shape).copy()


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
