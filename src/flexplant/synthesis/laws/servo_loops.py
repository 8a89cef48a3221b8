"""A servo at all frequencies: the law of each axis, and the loop with estimate, modes and delay."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ...loop import ClosedLoop
from ...loop.blocks import path_of
from ...loop.broken import (
    inverted,
    lowest_crossing,
    mixed_units,
    peaking_size,
    reference_pairs,
    sensitivity,
    sensitivity_size,
)
from ...lti.blocks_of_states import Matrices, cascaded
from ...lti.frequency_sweep import local_maxima, resonance_grid
from ...lti.interconnection import loop_poles
from ...lti.response_solvers import responses
from ...lti.statespace import StateSpace
from ...plant import StandardPlant
from ...plant.axes import DrivenAxes, Reading, force_units, gains_at, oscillations
from ...tolerances import KEPT_PLANTS
from .law import Integrator, Law, LowPass, Notch, Pid, decoupled, product, tustin_s

#: the lead of a mass line: its zero lies this factor below the bandwidth, its pole above. With 4
#: |S| of a free mass peaks near 4 dB with the roll-off and integrator of `design_servo`. Where a
#: mode lies just above the bandwidth its notch takes phase, which wider leads give back
LEADS = (4.0, 16.0, 64.0)
#: highest corner of a law, as a fraction of the rate
HIGHEST = 0.4
#: lines on which an axis may lie, by the power of 1 / s of its response: a mass that is free (or
#: above its springs), a damper, a spring (or a mass below its springs' frequency)
POWERS = {"mass": 2.0, "damper": 1.0, "spring": 0.0}
#: a line is tried when slope and phase of the response are at most this much further from it than
#: from the nearest line; both distances are counted in powers of s
_ASIDE = 0.8
#: step of frequency for the slope, and how far below the bandwidth a response that vanishes at
#: rest is sought, with how small it is there
_STEP, _BELOW, _VANISHED = 1.05, 1e-3, 1e-2
#: |S| at u that a notch is to bring the loop below: 6 dB
TARGET = 2.0
#: modes that may be notched, of those that resonate most: all sets of notches are judged, three
#: times as many with one mode more
_NOTCHES = 5
#: damping ratios of a notch's poles, and its least depths, that are tried. Its zeros have the
#: damping of the mode, or more where the depth is the least: then it takes less phase
_KINDS = ((0.3, Notch(1.0).depth), (0.45, 0.0))
#: fraction of TARGET that notches are to reach: the grid may miss the top of a resonance by 1 %
WITHIN = 0.99
#: these change only how long a search takes. A law gives five cuts, at the highest peaks of |S|.
#: The last 30 are kept, and six rule out most sets. A law is first judged at each fourth point
_TOPS, _CUTS, _FIRST, _PART = 5, 30, 6, 4
#: a pole moves nearly in proportion to the gain for changes up to a half, of which 1 % shows how.
#: It still grows if a third of its growth is left, by which the estimate may be wrong
_SIMILAR, _SMALL, _STILL = 0.5, 0.01, 0.3
#: laws and notches whose numbers are kept: those of one bandwidth
_KEPT = 64
#: loop gain at a resonance below which a notch there serves nothing
_QUIET = 0.3


@dataclass(frozen=True, eq=False)
class Axis:
    """The law of an axis, sampled by Tustin's rule, of gain 1 at the bandwidth.

    On a mass line ``(1 + w_i / s) (1 + r s / w_b) / (1 + s / (r w_b)) F(s)`` with the lead r, on
    that of a damper ``(1 + w_i / s) F(s)``, of a spring ``F(s) / s``, of a response that vanishes
    at rest ``F(s)``; F is a second-order low-pass and the notches.
    """

    line: str
    bandwidth: float
    rolloff: float
    rate: float
    lead: float
    integrator: float

    def law(self, notches: Sequence[Notch]) -> Law:
        """Return the law with notches, from error to command."""
        factors = (*self.action, LowPass(self.rolloff), *notches)
        there = product(
            (one.section.at(self.rate) for one in factors), tustin_s(self.bandwidth, self.rate)
        )
        return Law(factors, float(1.0 / abs(there)), self.rate)

    @cached_property
    def shape(self) -> Law:
        """The law without notches."""
        return self.law(())

    @cached_property
    def turn(self) -> complex:
        """The response of the shape at the bandwidth, of size 1."""
        return complex(self.shape.at(np.array(self.bandwidth)))

    @property
    def action(self) -> tuple[Pid | Integrator, ...]:
        """Integral action and lead."""
        if self.line == "mass":
            zero = self.bandwidth / self.lead
            pole = min(self.bandwidth * self.lead, HIGHEST * self.rate)
            return (Pid.corners(1.0, integrator=self.integrator, zero=zero, pole=pole),)
        if self.line == "damper":
            return (Integrator(self.integrator),)
        return (Pid(0.0, i=1.0),) if self.line == "spring" else ()


#: equal laws are one, so that what is known of it is found at once
known_axis = lru_cache(maxsize=_KEPT)(Axis)


@lru_cache(maxsize=_KEPT)
def _series(shape: Law, notches: tuple[Notch, ...]) -> Matrices:
    """Return A, B, C and D of a law and notches, sampled."""
    if not notches:
        return shape.matrices
    return cascaded(_series(shape, notches[:-1]), _sampled(notches[-1], shape.rate))


@lru_cache(maxsize=_KEPT)
def _notch(freq: float, depth: float, width: float) -> Notch:
    return Notch(freq, depth, width)


@lru_cache(maxsize=_KEPT)
def _sampled(notch: Notch, rate: float) -> Matrices:
    return notch.sampled(rate).matrices


def lines_of(plant: StandardPlant, axes: DrivenAxes) -> list[tuple[str, ...]]:
    """Return the lines on which each axis may lie, the most likely first."""
    phases = np.angle(gains_at(plant, axes)) + np.pi * axes.freq * plant.dt * (1 + 2 * plant.delay)
    steps = np.array([_BELOW, 1.0 / _STEP, 1.0, _STEP])[:, None]
    real = [gains_at(plant, axes, np.asarray(one)) for one in -1j * steps * axes.freq]
    rest, below, there, above = np.abs(np.real(real))
    slopes = -np.log(above / below) / (2.0 * np.log(_STEP))
    return [
        ("speed",) if rest[i] < _VANISHED * there[i] else _likely(float(slopes[i]), float(phase))
        for i, phase in enumerate(phases)
    ]


def _likely(slope: float, phase: float) -> tuple[str, ...]:
    """Return the lines near a slope of the real axis and a phase [rad] of the imaginary one."""
    # phases in (-3/2 pi, pi/2], so that that of a mass is -pi
    turned = float(np.mod(phase - 0.5 * np.pi, 2.0 * np.pi) - 1.5 * np.pi)
    off = {
        line: abs(slope - power) + abs(turned / (0.5 * np.pi) + power)
        for line, power in POWERS.items()
    }
    nearest = min(off.values())
    order = sorted(off, key=off.__getitem__)
    return tuple(line for line in order if off[line] <= nearest + _ASIDE)


def combinations(lines: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return lines of all axes to try: each axis on its first line, its second, and on a mass.

    Next to its springs' frequency an axis resonates beyond the bandwidth, and crosses 1 once more
    as a mass: the lead of that law holds it there.
    """
    most = max(len(one) for one in lines)
    tried = [tuple(one[min(k, len(one) - 1)] for one in lines) for k in range(most)]
    tried.append(tuple("speed" if one == ("speed",) else "mass" for one in lines))
    return list(dict.fromkeys(tried))


class ServoLaw(NamedTuple):
    """Laws of axes, and how their commands reach the actuators."""

    driven: DrivenAxes
    axes: tuple[Axis, ...]
    #: gains (r,) of the plant at the bandwidths, decoupled: exact
    level: tuple[float, ...]
    #: which all axes have in common
    notches: tuple[Notch, ...] = ()

    def of(self, axes: Iterable[Axis]) -> ServoLaw:
        """Return the same with other axes."""
        return self._replace(axes=tuple(axes))

    def faster(self, part: float) -> ServoLaw:
        """Return the same with integral action up to a part of the bandwidth, or faster."""
        corners = (max(one.integrator, part * one.bandwidth) for one in self.axes)
        each = zip(self.axes, corners, strict=True)
        return self.of(known_axis(*astuple(one)[:-1], corner) for one, corner in each)

    def there(self, notch: Notch) -> ComplexArray:
        """Return the responses (r,) of a notch at the bandwidths, whose gains the laws make up."""
        rate = self.axes[0].rate
        s = tustin_s(np.array([axis.bandwidth for axis in self.axes]), rate)
        return notch.section.at(rate).gain(s)

    def at(self, freq: FloatArray | ComplexArray) -> ComplexArray:
        """Return the responses (n_freq, r) of the laws."""
        found, rate = {one: one.shape.at(freq) for one in set(self.axes)}, self.axes[0].rate
        at = np.stack([found[one] for one in self.axes], axis=-1) / self.level
        for notch in self.notches:
            gain = notch.section.at(rate).gain(tustin_s(freq, rate))
            at *= gain[:, None] / np.abs(self.there(notch))
        return at

    @property
    def matrices(self) -> Matrices:
        """A, B, C and D from what the servo reads to the actuators."""
        notched = np.abs(np.prod([self.there(notch) for notch in self.notches], axis=0))
        parts = []
        for axis, gain in zip(self.axes, notched * np.array(self.level), strict=True):
            A, B, C, D = _series(axis.shape, self.notches)
            parts.append((A, B, C / gain, D / gain))
        return decoupled(parts, self.driven.T, np.eye(len(self.axes)))


class Cut(NamedTuple):
    """A point of the grid and a row (nu,) that show high |S|."""

    point: int
    row: ComplexArray


class Notched(NamedTuple):
    """A law with several sets of notches: at each of some modes none or one."""

    law: ServoLaw
    #: None and the notches, and their gains (1 + n_notches, r) at the bandwidths
    notches: tuple[Notch | None, ...]
    gains: FloatArray
    #: of each set and mode the number of a notch
    chosen: IntArray

    @classmethod
    def all(cls, law: ServoLaw, options: Sequence[Sequence[Notch]]) -> Notched:
        """Return all sets of the notches of each mode, the fewest notches first."""
        notches = [one for each in options for one in each]
        gains = np.array([np.ones(len(law.axes)), *(np.abs(law.there(one)) for one in notches)])
        return cls(law, (None, *notches), gains, _choices(tuple(map(len, options))))

    def some(self, which: BoolArray | slice) -> Notched:
        """Return some of the sets."""
        return self._replace(chosen=self.chosen[which])

    @property
    def first(self) -> ServoLaw:
        """The law with the first set."""
        further = [self.notches[i] for i in self.chosen[0]]
        return self.law._replace(notches=(*self.law.notches, *filter(None, further)))

    def over(self, loop: ServoLoop, points: Sequence[int]) -> ComplexArray:
        """Return the responses (n_sets, n_points, r) of the laws at points of a grid."""
        known = [loop.stop(one)[points] for one in self.notches if one]
        return self._products(loop.at(self.law)[points], known)

    def at(self, freq: ComplexArray) -> ComplexArray:
        """Return the responses (n_sets, n_freq, r) of the laws at complex s / (2 pi j)."""
        rate = self.law.axes[0].rate
        s = tustin_s(freq, rate)
        known = [one.section.at(rate).gain(s) for one in self.notches if one]
        return self._products(self.law.at(freq), known)

    def _products(self, alone: ComplexArray, notches: list[ComplexArray]) -> ComplexArray:
        each = np.array([np.ones(len(alone)), *notches])[..., None] / self.gains[:, None]
        found = np.broadcast_to(alone, (self.chosen.shape[0], *alone.shape))
        for chosen in self.chosen.T:
            found = found * each[chosen]
        return found


@lru_cache(maxsize=KEPT_PLANTS)
def _choices(counts: tuple[int, ...]) -> IntArray:
    """Return all choices of none (0) or one number from each of some groups, the shortest first."""
    ends = np.cumsum([1, *counts]).tolist()
    numbers = [(0, *range(i, j)) for i, j in itertools.pairwise(ends)]
    chosen = np.array(list(itertools.product(*numbers)), dtype=np.intp)
    return np.asarray(chosen[np.argsort(np.count_nonzero(chosen, axis=1), kind="stable")])


@dataclass(frozen=True)
class ServoLoop:
    """The loop of a servo over frequency, broken where `ClosedLoop.broken` breaks it.

    ``u = -T C (E_y y + E_u u)``: C of the axes, E of the observer, which may read u too; T
    decouples. The plant moves y, so that only the path through y is broken, the other stays closed.
    """

    freq: FloatArray
    plant: StandardPlant
    observer: StateSpace | None
    reading: Reading
    #: from u to what the servo reads, of the plant that the design knows
    path: StateSpace
    #: of the modes of that plant: frequencies [Hz] and damping ratios
    modes: FloatArray
    damping: FloatArray

    @cached_property
    def motion(self) -> ComplexArray:
        """From u to the axes with a reference (n_freq, k, nu): their true motion."""
        return _stack(self.plant.system, self.reading.references, self.plant.u, self.freq)

    @cached_property
    def _paths(self) -> tuple[ComplexArray, ComplexArray | None]:
        """E_y G + E_u and E_u (n_freq, r, nu)."""
        plant, observer, reading, grid = self.plant, self.observer, self.reading, self.freq
        direct = [one for one in reading.channels if observer is None or reading.reads[one] == one]
        rows = {name: i for i, name in enumerate(reading.channels)}
        through = np.zeros((grid.size, len(rows), len(plant.u)), dtype=np.complex128)
        if direct:
            known = _stack(plant.system, direct, plant.u, grid)
            through[:, [rows[name] for name in direct]] = known
        guessed = [name for name in reading.channels if name not in direct]
        if not guessed or observer is None:
            return through, None
        read, given = (
            [name for name in observer.inputs if name in side] for side in (plant.y, plant.u)
        )
        at, hats = [rows[name] for name in guessed], [reading.reads[name] for name in guessed]
        E = _stack(observer, hats, [*read, *given], grid)
        through[:, at] = E[..., : len(read)] @ _stack(plant.system, read, plant.u, grid)
        if not given:
            return through, None
        own = np.zeros_like(through)
        columns = [plant.u.index(name) for name in given]
        own[np.ix_(range(grid.size), at, columns)] = E[..., len(read) :]
        return through + own, own

    @cached_property
    def mixed(self) -> bool:
        """Whether the actuators have several units, as for `BrokenLoop.mixed`."""
        plant = self.plant
        return bool(mixed_units(plant.u, plant.units, lambda: force_units(plant)))

    def broken(
        self, law: ServoLaw, some: IntArray | slice = slice(None)
    ) -> tuple[ComplexArray, ComplexArray | None]:
        """Return L (k, nu, nu) with all paths, and the inner loop of the observer's u."""
        act, (through, own) = -law.driven.T * self.at(law)[some, None, :], self._paths
        return act @ through[some], None if own is None else act @ own[some]

    def _sizes(self, law: ServoLaw, some: IntArray | slice = slice(None)) -> FloatArray:
        loop = self.broken(law, some)
        return peaking_size(sensitivity(*loop)) if self.mixed else sensitivity_size(*loop, 1.0)

    @cached_property
    def at(self) -> Callable[[ServoLaw], ComplexArray]:
        """The function of a law that gives its responses over the grid."""

        @lru_cache
        def found(law: ServoLaw) -> ComplexArray:
            if not law.notches:
                return law.at(self.freq)
            *first, last = law.notches
            before = found(law._replace(notches=tuple(first)))
            return np.asarray(before * (self.stop(last)[:, None] / np.abs(law.there(last))))

        return found

    @cached_property
    def size(self) -> Callable[[ServoLaw], FloatArray]:
        """The function of a law that gives sigma_max(S_u) over the grid.

        It is a lower bound where it is not the largest. It says nothing of stability: check that.
        """
        return lru_cache(self._sizes)

    def peak(self, law: ServoLaw) -> tuple[float, float]:
        """Return max_f sigma_max(S_u) over the grid and its frequency [Hz]."""
        size = self.size(law)
        top = int(np.argmax(size))
        return float(size[top]), float(self.freq[top])

    def suppressed_up_to(self, law: ServoLaw) -> float:
        """Return the least frequency [Hz] at which |S| of a reference first crosses 1."""
        T, L = law.driven.T, self.broken(law)[0]
        moved = np.linalg.solve(np.eye(len(T)) - L, T * self.at(law)[:, None, :])
        referred = [self.reading.channels.index(name) for name in self.reading.references]
        error = 1.0 - np.einsum("fij,fji->if", self.motion, moved[:, :, referred])
        return lowest_crossing(self.freq, np.abs(error))

    @cached_property
    def _near(self) -> tuple[IntArray, IntArray]:
        """The points of the grid near each mode, and where those of each mode start."""
        ends = np.searchsorted(self.freq, [0.98 * self.modes, 1.02 * self.modes])
        each = [np.arange(*pair) for pair in ends.T.tolist()]
        points = np.concatenate([np.zeros(0, dtype=np.intp), *each])
        return points, np.cumsum([0, *map(len, each)])[:-1]

    @cached_property
    def _reach(self) -> Callable[[DrivenAxes], FloatArray]:
        """The function of axes that gives the size of T times what u moves, near the modes."""
        near = self._paths[0][self._near[0]]
        return lru_cache(lambda axes: np.linalg.norm(axes.T @ near, axis=(1, 2)))

    def resonant(self, law: ServoLaw) -> list[int]:
        """Return the modes above the bandwidth with loop gain and no notch, the largest first."""
        points, starts = self._near
        size = np.abs(self.at(law)[points]).max(axis=1) * self._reach(law.driven)
        peaks = np.maximum.reduceat(size, starts) if starts.size else np.zeros(0)
        # below the bandwidths a notch would take the gain that suppresses the error
        peaks[self.modes < law.driven.freq.min()] = 0.0
        done = np.isin(self.places, [notch.freq for notch in law.notches])
        peaks[done | (self.damping > _KINDS[0][0])] = 0.0
        order = np.argsort(-peaks, kind="stable")
        return [int(i) for i in order[peaks[order] > _QUIET]]

    @cached_property
    def places(self) -> FloatArray:
        """Frequencies [Hz] of notches: next to slow modes, up to a third below fast ones."""
        # the bilinear transform would move them there. At the resonance such a notch leads the
        # phase, so that the loop tolerates a machine whose mode is elsewhere: of 40 machines of the
        # wafer stage with 0.1 % damping 20 were unstable with notches at the modes, and none so
        rate = 1.0 / self.plant.dt
        return np.asarray(rate / np.pi * np.arctan(np.pi * self.modes / rate))

    def _options(self, law: ServoLaw) -> list[list[Notch]]:
        """Return the notches that are tried at each of the modes that resonate most."""
        modes = self.resonant(law)[:_NOTCHES]
        places, dampings = self.places[modes].tolist(), self.damping[modes].tolist()
        tried = [
            [_notch(place, max(damping / width, least), width) for width, least in _KINDS]
            for place, damping in zip(places, dampings, strict=True)
        ]
        return [list(dict.fromkeys(each)) for each in tried]

    @cached_property
    def poles(self) -> Callable[[ServoLaw], ComplexArray]:
        """The function of a law that gives the poles of its loop, without truncated modes."""
        return lru_cache(lambda law: loop_poles(self.path, law.matrices))

    def radius(self, law: ServoLaw) -> float:
        """Return the spectral radius of the loop of a law."""
        return float(np.abs(self.poles(law)).max())

    def is_hopeless(self, law: ServoLaw) -> bool:
        """Return whether a loop has more unstable poles than notches, a pair each, bring back."""
        return int(np.sum(np.abs(self.poles(law)) >= 1.0)) > 2 * _NOTCHES

    def notched(self, law: ServoLaw, given: bool, most: float) -> ServoLaw | None:
        """Return a law with the fewest notches that bring |S| at u below 6 dB, and the lowest peak.

        If no set of notches does so, the law with the lowest peak is returned, or None if no peak
        is below `most`. All sets of notches are judged, or only those that are `given`. What is
        known of others rules most of them out: points where |S| is high, see `_exceed`, and poles
        that still grow, see `_grow`.
        """
        left, best = Notched.all(law, [] if given else self._options(law)), None
        for cuts in (self._cuts[:_FIRST], self._cuts[_FIRST:]):
            left = left.some(~self._exceed(left, cuts, most))
        while left.chosen.shape[0]:
            one, left = left.first, left.some(slice(1, None))
            points, peak = self._tops(one, most)
            if peak > most:
                self._cuts[:0] = cuts = self._cut(one, points)
                del self._cuts[_CUTS:]
                left = left.some(~self._exceed(left, cuts, most))
            elif self.radius(one) >= 1.0:
                left = left.some(~self._grow(left, one))
            else:
                best, most = one, peak
                if peak <= WITHIN * TARGET:
                    left = left.some(np.count_nonzero(left.chosen, axis=1) <= len(one.notches))
                left = left.some(~self._exceed(left, self._cuts[:], most))
        return best

    def _tops(self, law: ServoLaw, most: float) -> tuple[IntArray, float]:
        """Return where |S| of a law peaks, and how high; of a part of the grid if above `most`."""
        size = self._sizes(law, slice(None, None, _PART))
        step = _PART if size.max() > most else 1
        size = size if step > 1 else self.size(law)
        tops = local_maxima(size)[:_TOPS]
        return step * tops, float(size[tops[0]])

    @cached_property
    def _cuts(self) -> list[Cut]:
        """Cuts that ruled out laws, the last first: they change only how long a search takes."""
        return []

    def _cut(self, law: ServoLaw, points: IntArray) -> list[Cut]:
        """Return the cuts that show |S| of a law at some points."""
        L, inner = self.broken(law, points)
        left = np.linalg.svd(sensitivity(L, inner))[0][:, None, :, 0].conj()
        rows = (left @ inverted(L))[:, 0]
        return [Cut(*one) for one in zip(points.tolist(), rows, strict=True)]

    def _exceed(self, laws: Notched, cuts: Sequence[Cut], most: float) -> BoolArray:
        """Return whether cuts show that |S| of laws exceeds some size.

        ``sigma_max(S) >= |q (I - inner)| / |q (I - L)|`` for every row q. With scaled axes |S| is
        at least the largest entry of its diagonal.
        """
        if not cuts or not laws.chosen.shape[0]:
            return np.zeros(laws.chosen.shape[0], dtype=bool)
        points, rows = [one.point for one in cuts], np.array([one.row for one in cuts])
        c, T = laws.over(self, points), laws.law.driven.T
        through, own = self._paths[0][points], self._paths[1]
        own = None if own is None else own[points]
        if self.mixed:
            act = -T * c[..., None, :]
            S = sensitivity(act @ through, None if own is None else act @ own)
            return np.asarray((np.abs(np.einsum("...ii->...i", S)) > most).any(axis=(1, 2)))
        c, rows = (c * (rows @ T)).swapaxes(0, 1), rows[:, None]
        passed, back = (rows if one is None else rows + c @ one for one in (own, through))
        high = np.linalg.norm(passed, axis=-1) > most * np.linalg.norm(back, axis=-1)
        return np.asarray(high.any(axis=0))

    def _grow(self, laws: Notched, like: ServoLaw) -> BoolArray:
        """Return whether the pole that grows most with a like law still grows with some laws.

        An estimate: a pole s moves by ``ds/dg (g - 1)`` where they multiply the gain by g at s. In
        10 000 searches that were compared with judging every set it lost none.
        """
        rate, poles = 1.0 / self.plant.dt, self.poles(like)
        worst = poles[np.argmax(np.abs(poles))]
        moved = self.poles(like._replace(level=tuple(k / (1.0 + _SMALL) for k in like.level)))
        nearest = moved[np.argmin(np.abs(moved - worst))]
        s, slope = rate * np.log(worst), rate * np.log(nearest / worst) / _SMALL
        at = np.array([s / (2j * np.pi)])
        change = laws.at(at)[:, 0] / like.at(at)[0] - 1.0
        largest = np.argmax(np.abs(change), axis=1)
        change = change[range(largest.size), largest]
        still = (s + slope * change).real > _STILL * s.real
        return np.asarray(still & (np.abs(change) < _SIMILAR))

    @cached_property
    def stop(self) -> Callable[[Notch], ComplexArray]:
        """The function of a notch that gives its response over the grid."""
        rate = 1.0 / self.plant.dt
        s = tustin_s(self.freq, rate)
        return lru_cache(maxsize=_KEPT)(lambda notch: notch.section.at(rate).gain(s))


@lru_cache(maxsize=KEPT_PLANTS)
def servo_loop(
    plant: StandardPlant, observer: StateSpace | None, reading: Reading, known: StandardPlant
) -> ServoLoop:
    """Return the loop of a plant with an observer, or with the axes themselves as estimates."""
    # with notches by what is known to the design: a plant of fewer modes
    systems = (plant.system,) if observer is None else (plant.system, observer)
    poles = np.concatenate([one.poles() for one in systems])
    grid = resonance_grid(poles, plant.dt, points=300)
    # half the rate itself, where a hold has no answer, is left out
    modes, damping = oscillations(known)
    grid = np.union1d(grid[grid < 0.5 / plant.dt * (1.0 - 1e-6)], modes)
    path = path_of(known, observer, reading)
    return ServoLoop(grid, plant, observer, reading, path, modes, damping)


def _stack(
    system: StateSpace, outputs: Iterable[str], inputs: Iterable[str], grid: FloatArray
) -> ComplexArray:
    found = responses(_part(system, tuple(outputs), tuple(inputs)), grid)
    return np.ascontiguousarray(np.moveaxis(found, -1, 0))


@lru_cache(maxsize=2 * KEPT_PLANTS)
def _part(system: StateSpace, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> StateSpace:
    return system.select(outputs, inputs)


def highest_bandwidth(freq: Sequence[float], holds: Callable[[float], bool]) -> float | None:
    """Return the largest frequency that holds: of a descending grid, then by bisection above."""
    i = next((i for i, one in enumerate(freq) if holds(one)), None)
    if not i:  # none, or the first
        return None if i is None else freq[0]
    low, high = freq[i], freq[i - 1]
    for _ in range(6):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def verified_suppression(closed: ClosedLoop) -> float:
    """Return the frequency [Hz] of `ServoLoop.suppressed_up_to`, from the closed loop instead."""
    plant = closed.plant
    response = closed.frequency_response(closed.broken.grid)
    sizes = (
        np.abs(response.data[plant.z.index(error), plant.w.index(reference)])
        for reference, error in reference_pairs(plant).items()
    )
    return lowest_crossing(response.freq, sizes)
