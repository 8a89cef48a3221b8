"""The laws of all axes together: steps of linear programs that keep |S| on all plants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import ComplexArray, FloatArray, IntArray
from ...loop.measured_loop import nyquist_count
from ...lti.frequency import Frf
from ...lti.frequency_sweep import SOUGHT, highest, resonance_grid
from ...lti.interconnection import loop_poles
from ...lti.joining import block_matrix
from ...lti.measured_lines import hidden_modes
from ...lti.responses import responder
from ...lti.statespace import StateSpace
from .axis_law import AxisLaw, near_lowest
from .law import Law, tustin_s

#: logarithmic part of a grid through the resonances, and times that it is refined
_POINTS, _REFINEMENTS = 250, 6


class Worst(NamedTuple):
    """The largest |S|, its frequency [Hz], and where it is."""

    size: float
    freq: float
    place: str


@dataclass(frozen=True)
class JointPlant:
    """A plant in its own channels, and the static maps to them and from them."""

    plant: StateSpace | Frf
    before: FloatArray
    after: FloatArray
    axes: tuple[str, ...]
    rigid: int
    kind: str = ""

    @property
    def places(self) -> tuple[str, ...]:
        """Where |S| counts: at u and at y where these have one unit, and in each axis."""
        sides = {"u": self.plant.inputs, "y": self.plant.outputs}
        units = self.plant.channel_units if isinstance(self.plant, Frf) else self.plant.units
        alike = [f"at {s}" for s, names in sides.items() if len({units.get(n) for n in names}) < 2]
        return (*alike, *(f"of {name}" for name in self.axes))

    @cached_property
    def grid(self) -> FloatArray:
        """The lines of an Frf, or frequencies through the resonances of a model."""
        if isinstance(self.plant, Frf):
            return self.plant.freq
        return self._through(self.plant.poles())

    @cached_property
    def respond(self) -> Callable[[FloatArray], ComplexArray]:
        """The response (n_freq, ny, nu)."""
        if isinstance(self.plant, Frf):
            lines, data = self.plant.freq, np.moveaxis(self.plant.data, -1, 0)
            return lambda freq: data[np.searchsorted(lines, freq)]
        find = responder(self.plant)
        return lambda freq: np.moveaxis(find(freq), -1, 0)

    def coupling(self, freq: FloatArray) -> Coupling:
        """Return what couples the axes at some frequencies [Hz]."""
        G = self.respond(freq)
        seen, felt = G @ self.before, self.after @ G
        return Coupling(freq, seen, felt, self.after @ seen, self)

    def is_stable(self, laws: Sequence[Law]) -> bool:
        """Return whether the loop is stable, by its poles or the Nyquist count of an Frf."""
        if not isinstance(self.plant, Frf):
            poles = self._poles(laws)
            edge = np.abs(poles) - 1.0 if self.plant.dt else poles.real
            return bool(edge.max(initial=-1.0) < 0.0)
        P = np.moveaxis(self.coupling(self.grid).inner, 0, -1)

        def respond(freq: FloatArray) -> ComplexArray:
            each = np.array([-law.response(freq) for law in laws])
            return np.asarray(np.eye(len(laws))[:, :, None] * each)

        lines = self.grid
        count = nyquist_count(
            lines,
            P,
            respond,
            hidden_modes(lines, P, respond(lines)),
            slope=2 if self.rigid else 0,
            at_zero=2 * self.rigid + len(laws),  # each law integrates once
            unstable=0,
        )
        return count.unstable == 0

    def worst(self, laws: Sequence[Law]) -> Worst:
        """Return the largest |S| of a stable loop, the grid refined at its peaks."""

        def sizes(freq: FloatArray) -> FloatArray:
            return 1.0 / self.coupling(freq).distances(_law_gains(laws, freq))

        rounds = 0 if isinstance(self.plant, Frf) else _REFINEMENTS
        size, freq = highest(lambda f: sizes(f).max(axis=0), self._closed_grid(laws), rounds)
        place = self.places[int(np.argmax(sizes(np.array([freq]))[:, 0]))]
        return Worst(size, freq, f"{place}{self.kind}")

    def high(self, laws: Sequence[Law], size: float) -> FloatArray:
        """Return frequencies through the resonances of the closed loop where |S| is above a size.

        A mode is as narrow as its damping, and the loop moves it off the grid of the plant.
        """
        grid = self._closed_grid(laws)
        least = self.coupling(grid).distances(_law_gains(laws, grid)).min(axis=0)
        return np.asarray(grid[least * size < 1.0])

    def _closed_grid(self, laws: Sequence[Law]) -> FloatArray:
        return self.grid if isinstance(self.plant, Frf) else self._through(self._poles(laws))

    def _through(self, poles: ComplexArray) -> FloatArray:
        dt = float(self.plant.dt)  # type: ignore[union-attr]
        grid = resonance_grid(poles, dt, points=_POINTS, around=SOUGHT)
        return grid[(grid > 0.0) & (grid < 0.4999 / dt)] if dt else grid[grid > 0.0]

    def _poles(self, laws: Sequence[Law]) -> ComplexArray:
        assert isinstance(self.plant, StateSpace)  # noqa: S101 - an Frf has no poles
        parts = [law.system for law in laws]
        A, B, C, D = (block_matrix([getattr(one, part) for one in parts]) for part in "ABCD")
        K = StateSpace(
            A, -B @ self.after, self.before @ C, -self.before @ D @ self.after, self.plant.dt
        )
        return loop_poles(self.plant, K)


def _law_gains(laws: Sequence[Law], freq: FloatArray) -> ComplexArray:
    return np.stack([law.at(freq) for law in laws], axis=-1)


class Coupling(NamedTuple):
    """``seen = G before``, ``felt = after G``, ``inner = after G before``, frequency first."""

    freq: FloatArray
    seen: ComplexArray
    felt: ComplexArray
    inner: ComplexArray
    of: JointPlant

    def turns(self, C: ComplexArray) -> ComplexArray:
        """Return ``det(I + after G before C)`` of laws C (n, k)."""
        return np.asarray(np.linalg.det(np.eye(C.shape[1]) + self.inner * C[:, None, :]))

    def distances(self, C: ComplexArray) -> FloatArray:
        """Return ``1 / |S|`` (places, n): the least singular value, or ``1 / |S_ii|``."""
        S = self._inverse(C)
        sides = [
            1.0 / np.sqrt(np.linalg.eigvalsh(one.conj().swapaxes(1, 2) @ one)[:, -1])
            for one in self._sides(S, C)
        ]
        axes = 1.0 / np.abs(np.einsum("fii->if", S))
        return np.concatenate([np.reshape(sides, (len(sides), len(C))), axes])

    def slopes(self, C: ComplexArray, place: int) -> ComplexArray:
        """Return g (n, k) of one place: the distance changes by ``Re(g . dC)``."""
        # v, w: singular vectors of S, and 1 / S = I + M: d sigma = Re(v' dM w)
        S = self._inverse(C)
        sides, of = self._sides(S, C), self.of
        if place >= len(sides):
            i = place - len(sides)
            m = 1.0 / S[:, i, i]
            turn = m * np.abs(m)  # conj(m) / |m| m^2
            return np.asarray(turn[:, None] * (S @ self.inner)[:, i, :] * S[:, :, i])
        left, _, right = np.linalg.svd(sides[place])
        # S = left sigma right: I + M has the singular vectors the other way round
        v, w = right[:, 0, :], left[:, :, 0]
        if of.places[place] == "at u":
            return np.asarray((v @ of.before) * np.einsum("fku,fu->fk", self.felt, w))
        return np.asarray(np.einsum("fy,fyk->fk", v, self.seen) * (w @ of.after.T))

    def rows(self, rows: IntArray) -> Coupling:
        """Return what couples the axes at some of the frequencies."""
        parts = (self.seen[rows], self.felt[rows], self.inner[rows])
        return Coupling(self.freq[rows], *parts, self.of)

    def _inverse(self, C: ComplexArray) -> ComplexArray:
        return np.asarray(np.linalg.inv(np.eye(C.shape[1]) + self.inner * C[:, None, :]))

    def _sides(self, S: ComplexArray, C: ComplexArray) -> list[ComplexArray]:
        """Return S at u and y, ``I - before C S after G`` and ``I - G before C S after``."""
        CS, of = C[:, :, None] * S, self.of
        found = []
        if "at u" in of.places:
            found.append(np.eye(of.before.shape[0]) - of.before @ CS @ self.felt)
        if "at y" in of.places:
            found.append(np.eye(of.after.shape[1]) - self.seen @ CS @ of.after)
        return found


#: slower starts, as a factor, until the loops are stable with |S| below so much
_SLOWER, _STARTS, _WILD = 0.8, 30, 10.0
#: steps between two checks, and checks at which frequencies are added
_STEPS, _ROUNDS = 50, 6
#: radii [e-folds], penalty on what is violated, step of differences
_RADIUS, _SMALLEST, _PENALTY, _DIFFERENCE = 0.25, 1e-3, 4.0, 1e-6
#: points of one place that count in a step, at most and as far above the bound
_LOWEST, _REACH = 12, 0.3
#: distance kept beyond what is needed, to end with no less
_SPARE = 2e-3
#: steps down, and their factor, where the grid missed the very top of a peak; |S| beside the bound
#: from which on that is no cure
_DOWN, _LITTLE, _FAR = 5, 0.99, 1.05
#: part of the bound on |S| from which on a frequency of the closed loop is added
_NEAR = 0.9


class JointLaws(NamedTuple):
    """Numbers of all axes, and the largest |S| that they reach."""

    numbers: list[FloatArray]
    worst: Worst

    def laws(self, of: Sequence[AxisLaw]) -> list[Law]:
        """Return the laws."""
        return [law.law(x) for law, x in zip(of, self.numbers, strict=True)]


@dataclass(frozen=True)
class JointSearch:
    """The search for laws of the highest mean bandwidth that hold |S| on some plants."""

    of: Sequence[AxisLaw]
    plants: Sequence[JointPlant]
    peak: float
    given: Sequence[FloatArray]

    def checked(self, numbers: list[FloatArray]) -> JointLaws | None:
        """Return laws with their largest |S| on all plants; None when unstable on one."""
        laws = [law.law(x) for law, x in zip(self.of, numbers, strict=True)]
        if not all(plant.is_stable(laws) for plant in self.plants):
            return None
        return JointLaws(numbers, max(plant.worst(laws) for plant in self.plants))

    def best(self) -> JointLaws | None:
        """Return laws that hold the peak, or come closest to it; None where none are stable."""
        held = self._held(self.given)
        if held is not None:
            return held
        found = self._start()
        if found is None:
            return None
        known, added, spare = found, [np.empty(0) for _ in self.plants], _SPARE
        for _ in range(_ROUNDS):
            laws = [law.law(x) for law, x in zip(self.of, found.numbers, strict=True)]
            high = [plant.high(laws, _NEAR * self.peak) for plant in self.plants]
            added = [np.union1d(*both) for both in zip(added, high, strict=True)]
            again = self.checked(self._raised(found.numbers, added, 1.0 / self.peak + spare))
            if again is None:
                break
            found = again
            if found.worst.size <= self.peak:
                return found
            known = min(known, found, key=lambda one: one.worst.size)
            spare += 1.0 / self.peak - 1.0 / found.worst.size  # what lies between the points
        return self._held(known.numbers) or known

    def _held(self, numbers: Sequence[FloatArray]) -> JointLaws | None:
        """Return the laws, or ones a little slower, that hold the peak; None where it is far."""
        for step in range(_DOWN):
            found = self.checked(self._slowed(numbers, _LITTLE**step))
            if found is None or found.worst.size > _FAR * self.peak:
                return None
            if found.worst.size <= self.peak:
                return found
        return None

    def _slowed(self, numbers: Sequence[FloatArray], factor: float) -> list[FloatArray]:
        """Return the numbers with bandwidths times a factor, none below the lowest."""
        least = [np.log(law.lowest) for law in self.of]
        return [
            np.append(max(x[0] + np.log(factor), min(x[0], low)), x[1:])
            for x, low in zip(numbers, least, strict=True)
        ]

    def _start(self) -> JointLaws | None:
        """Return the fastest of ever slower laws that are stable, |S| not wild if possible."""
        wild = None
        for step in range(_STARTS):
            found = self.checked(self._slowed(self.given, _SLOWER**step))
            if found is not None and found.worst.size < _WILD:
                return found
            wild = wild or found
        return wild

    def _raised(
        self, numbers: list[FloatArray], added: Sequence[FloatArray], least: float
    ) -> list[FloatArray]:
        """Return what steps from stable laws lead to."""
        # an exact penalty on what is violated [Fletcher1987]_; det(I + P C) turns as often as
        # before
        grids = [np.union1d(one.grid, more) for one, more in zip(self.plants, added, strict=True)]
        couplings = [one.coupling(grid) for one, grid in zip(self.plants, grids, strict=True)]
        x, radius = np.concatenate(numbers), _RADIUS
        gains = self._gains(x, couplings)
        rooms = self._rooms(gains, couplings, least)
        lowest = min(float(room.min()) for room in rooms)
        for _ in range(_STEPS):
            program = self._program(x, gains, rooms, couplings)
            step, expected = program.step(program.room, radius)
            if radius < _SMALLEST or expected < _SMALLEST:
                break
            for last in (False, True):
                there = self._gains(x + step, couplings)
                found = self._rooms(there, couplings, least)
                low = min(float(room.min()) for room in found)
                gained = program.mean(step) + _PENALTY * (min(low, 0.0) - min(lowest, 0.0))
                if gained > 0.1 * expected or last:
                    break
                # second-order correction: the bounds are curved, and steps along them short
                bent = program.at(found) - program.slopes @ step
                step = program.step(bent, radius)[0]
            if gained > 0.1 * expected and all(map(_same_winding, couplings, gains, there)):
                x, gains, rooms, lowest = x + step, there, found, low
                radius *= 2.0 if gained > 0.7 * expected and radius < _RADIUS else 1.0
            else:
                radius *= 0.4
        return self._split(x)

    def _gains(self, x: FloatArray, couplings: Sequence[Coupling]) -> list[ComplexArray]:
        """Return the laws C (n_freq, axes) on each plant."""
        numbers = self._split(x)
        found = []
        for one in couplings:
            s = tustin_s(one.freq, self.of[0].axis.rate)
            each = [law.response(own, s) for law, own in zip(self.of, numbers, strict=True)]
            found.append(np.stack(each, axis=-1))
        return found

    def _rooms(
        self, gains: Sequence[ComplexArray], couplings: Sequence[Coupling], least: float
    ) -> list[FloatArray]:
        """Return what the distances have beyond the least allowed (places, n_freq)."""
        return [one.distances(C) - least for one, C in zip(couplings, gains, strict=True)]

    def _program(
        self,
        x: FloatArray,
        gains: Sequence[ComplexArray],
        rooms: Sequence[FloatArray],
        couplings: Sequence[Coupling],
    ) -> _Program:
        """Return the problem linearised at some numbers."""
        slopes, places = [np.empty((0, x.size))], []
        for number, (one, C, room) in enumerate(zip(couplings, gains, rooms, strict=True)):
            for place, own in enumerate(room):
                rows = np.unique(near_lowest(own, _LOWEST, _REACH))
                if rows.size:
                    some = one.rows(rows)
                    slopes.append(self._by_numbers(x, some, some.slopes(C[rows], place)))
                    places.append((number, place, rows))
        limits = [law.limits(own) for law, own in zip(self.of, self._split(x), strict=True)]
        low, high = (np.concatenate([one[i] for one in limits]) - x for i in (0, 1))
        bound = la.block_diag(*(one[2] for one in limits))
        slack = np.maximum(np.concatenate([one[3] for one in limits]) - bound @ x, 0.0)
        program = _Program(
            np.vstack(slopes), places, np.empty(0), low, high, bound, slack, self._places
        )
        return program._replace(room=program.at(rooms))

    def _by_numbers(self, x: FloatArray, some: Coupling, slopes: ComplexArray) -> FloatArray:
        """Return the derivatives by the numbers from those by the laws, by differences."""
        s = tustin_s(some.freq, self.of[0].axis.rate)
        found = []
        for i, (law, own) in enumerate(zip(self.of, self._split(x), strict=True)):
            here = law.response(own, s)
            for k in range(own.size):
                moved = own.copy()
                moved[k] += _DIFFERENCE
                change = (law.response(moved, s) - here) / _DIFFERENCE
                found.append((slopes[:, i] * change).real)
        return np.array(found).T

    @property
    def _places(self) -> IntArray:
        """Where the bandwidths are among the numbers of all axes."""
        return np.cumsum([0, *(one.size for one in self.given[:-1])])

    def _split(self, x: FloatArray) -> list[FloatArray]:
        return np.split(x, self._places[1:])


class _Program(NamedTuple):
    """The linearised problem: ``room + slopes step >= 0`` at some points of some places."""

    slopes: FloatArray
    places: list[tuple[int, int, IntArray]]
    room: FloatArray
    low: FloatArray
    high: FloatArray
    bound: FloatArray
    slack: FloatArray
    bandwidths: IntArray

    def at(self, rooms: Sequence[FloatArray]) -> FloatArray:
        """Return the room at the points of the program."""
        return np.concatenate([[], *(rooms[i][k, rows] for i, k, rows in self.places)])

    def mean(self, step: FloatArray) -> float:
        """Return the mean growth of the bandwidths."""
        return float(np.mean(step[self.bandwidths]))

    def step(self, room: FloatArray, radius: float) -> tuple[FloatArray, float]:
        """Return the best step within a radius for some room, and the gain that it predicts."""
        from scipy.optimize import linprog

        aim = np.zeros(self.low.size + 1)
        aim[self.bandwidths], aim[-1] = -1.0 / self.bandwidths.size, _PENALTY
        answer = linprog(
            aim,
            A_ub=np.block([
                [-self.slopes, -np.ones((room.size, 1))],
                [self.bound, np.zeros((self.slack.size, 1))],
            ]),
            b_ub=np.concatenate([room, self.slack]),
            bounds=np.vstack(
                [np.clip([self.low, self.high], -radius, radius).T, [0.0, np.inf]]
            ).tolist(),
        )  # fmt: skip
        if answer.x is None or answer.fun is None:
            return np.zeros(self.low.size), 0.0
        now = float(min(self.room.min(initial=np.inf), 0.0))
        return answer.x[:-1], float(-answer.fun) - _PENALTY * now


def _same_winding(one: Coupling, before: ComplexArray, after: ComplexArray) -> bool:
    """Return whether ``det(I + P C)`` of two laws with the same unstable poles turns as often."""
    ratio = one.turns(after) / one.turns(before)
    return bool(abs(np.sum(np.angle(ratio[1:] / ratio[:-1]))) < 0.5 * np.pi)
