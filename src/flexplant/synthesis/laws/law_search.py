"""The law of one axis with the highest bandwidth: steps of linear programs from many starts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product as every
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...checks import ComplexArray, FloatArray, IntArray
from ...errors import SolverError
from ...tolerances import TINY
from .axis_law import AxisLaw
from .law import Law, product, tustin_s

#: depth and width of a notch from which a better one is sought, gain in bandwidth that it has to
#: bring; closest points, highest modes and multiples of the bandwidth where it is tried
_SLIGHT, _WORTH, _TRIED, _ABOVE = (0.7, 0.3), 1.02, 2, (1.3, 1.8, 2.7)
#: linear steps, of trials and of what is kept; how many are kept
_FEW, _MANY, _KEPT = 10, 60, 3
#: radii [e-folds], penalty on what is violated, step of differences
_RADIUS, _SMALLEST, _PENALTY, _DIFFERENCE = 0.25, 5e-4, 20.0, 1e-6
#: minima of the distance that count in a step, at most and as far above the least
_POINTS, _REACH = 40, 0.4
#: distance to the critical point that steps keep beyond what is needed, to end with no less
_SPARE = 5e-4
#: error of a line that is named when nothing is found
_POOR = 0.2


class FoundLaw(NamedTuple):
    """A law and the logarithms of its numbers."""

    law: Law
    numbers: FloatArray

    @property
    def bandwidth(self) -> float:
        """Where the loop of the rigid body alone crosses 1 [Hz]."""
        return float(np.exp(self.numbers[0]))

    @property
    def notches(self) -> int:
        """The number of its notches."""
        return (self.numbers.size - 4) // 3


@dataclass(frozen=True)
class LawSearch:
    """The search for the law of one axis with the highest bandwidth that holds |S|."""

    of: AxisLaw
    notches: int

    def best(self) -> FoundLaw:
        """Return the law of the highest bandwidth."""
        given = starts(self.of, self.notches)
        rough = [one for start in given if (one := self.raised(start, _FEW)) is not None]
        if not rough:
            raise SolverError(self.failure())
        rough.sort(key=lambda one: -one.bandwidth)
        best = max((self._finished(one) for one in rough[:_KEPT]), key=lambda one: one.bandwidth)
        while best.notches < self.notches and (more := self._with_notch(best)) is not None:
            best = more
        return self._without_idle(best)

    def _finished(self, found: FoundLaw) -> FoundLaw:
        return self.raised(found.numbers) or found

    def raised(self, numbers: FloatArray, steps: int = _MANY) -> FoundLaw | None:
        """Return what steps from some numbers lead to; None when that does not hold the peak."""
        # linear programs within a radius, with an exact penalty [Fletcher1987]_, chapter 14
        x, radius, best = numbers, _RADIUS, None
        if not self.of.axis.is_stable(self.of.law(x)):
            return None
        room = self._spare(x)
        for _ in range(steps):
            step, expected = self._step(x, room, radius)
            if radius < _SMALLEST or expected < _SMALLEST:
                break
            trial = self._spare(x + step)
            gained = step[0] + _PENALTY * (min(trial.min(), 0.0) - min(room.min(), 0.0))
            if gained > 0.1 * expected and self.of.axis.is_stable(self.of.law(x + step)):
                x, room = x + step, trial
                radius *= 2.0 if gained > 0.7 * expected and radius < _RADIUS else 1.0
                if room.min() >= -_SPARE and (best is None or x[0] > best[0]):
                    best = x
            else:
                radius *= 0.4
        if best is None or best[0] <= np.log(self.of.lowest):
            return None
        law = self.of.law(best)
        return FoundLaw(law, best) if self.of.room(law).min() >= 0.0 else None

    def _spare(self, numbers: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Return the room beyond a little that steps may violate."""
        return self.of.room_of(self.of.gain(numbers, rows), rows) - _SPARE

    def _step(self, x: FloatArray, room: FloatArray, radius: float) -> tuple[FloatArray, float]:
        """Return the step of the linear program, and the gain that it predicts."""
        from scipy.optimize import linprog

        rows = _critical_points(room)
        low, high, limits, most = self.of.limits(x)
        none = np.zeros((most.size, 1))
        answer = linprog(
            np.concatenate([[-1.0], np.zeros(x.size - 1), [_PENALTY]]),
            A_ub=np.block([
                [-self._slopes(x, room, rows), -np.ones((rows.size, 1))],
                [limits, none],
            ]),
            b_ub=np.concatenate([room[rows], np.maximum(most - limits @ x, 0.0)]),
            bounds=np.vstack(
[np.clip([low - x, high - x], -radius, radius).T, [0.0, np.inf]]
).tolist(),
        )  # fmt: skip
        if answer.x is None or answer.fun is None:
            return np.zeros(x.size), 0.0
        return answer.x[:-1], float(-answer.fun) - _PENALTY * float(min(room.min(), 0.0))

    def _slopes(self, x: FloatArray, room: FloatArray, rows: IntArray) -> FloatArray:
        """Return the derivatives of some of the room by the numbers, by differences."""
        found = np.zeros((rows.size, x.size))
        for k in range(x.size):
            step = np.zeros(x.size)
            step[k] = _DIFFERENCE
            found[:, k] = (self._spare(x + step, rows) - room[rows]) / _DIFFERENCE
        return found

    def _with_notch(self, found: FoundLaw) -> FoundLaw | None:
        """Return the law with the notch that raises the bandwidth most; None when none is worth it.

        At the points closest to the critical point, at modes and above the bandwidth.
        """
        close = self.of.axis.points[0][lowest_of(self.of.room(found.law))[:_TRIED]]
        above = found.bandwidth * np.array(_ABOVE)
        trials = []
        for f in [*close.tolist(), *self.of.axis.resonances[:_TRIED].tolist(), *above.tolist()]:
            if self.of.axis.freq[0] < f < self.of.axis.ceiling:
                slight = np.log([f, *_SLIGHT])
                trials.append(self.raised(np.append(found.numbers, slight), _FEW))
        best = max((one for one in trials if one), key=lambda one: one.bandwidth, default=None)
        return self._finished(best) if best and best.bandwidth > _WORTH * found.bandwidth else None

    def _without_idle(self, found: FoundLaw) -> FoundLaw:
        """Return the law without notches that bring little."""
        for i in reversed(range(4, found.numbers.size, 3)):
            less = self.raised(np.delete(found.numbers, slice(i, i + 3)), _FEW)
            if less and less.bandwidth * _WORTH > found.bandwidth:
                found = less
        return found

    def failure(self) -> str:
        """Return why no law was found, in words."""
        axis = self.of.axis
        if axis.free:
            need = (
                "a rigid body, its motion per force, at the lowest lines. Give rigid=0 when it is"
            )
            need += " on springs"
        else:
            need = f"a mass above its springs' mode, taken to be at {axis.suspension:.4g} Hz. Give"
            need += " rigid= when the body is free"
        low, top = self.of.lowest, self.of.highest
        reach = f"from {low:.3g} to {top:.3g} Hz" if top > low else f"above {low:.3g} Hz"
        worst = int(np.argmax(axis.deviation / np.maximum(np.abs(axis.G), TINY)))
        share = axis.deviation[worst] / max(abs(axis.G[worst]), TINY)
        poor = (
            f" The line at {axis.freq[worst]:.4g} Hz has an error of {100 * share:.0f} %: measure "
            "longer, or leave out the lines that say little."
            if share > _POOR
            else ""
        )
        decibel = 20.0 * np.log10(self.of.peak)
        return (
            f"axis {axis.name!r}: no bandwidth {reach} is stable with |S| below {decibel:.2g} dB. "
            f"The axis has to be {need}; raise the rate, lower "
            f"the delay, or measure at lower frequencies.{poor}"
        )


def lowest_of(room: FloatArray) -> IntArray:
    """Return the local minima, the lowest first."""
    wide = np.concatenate([[np.inf], room, [np.inf]])
    places = np.flatnonzero((room <= wide[:-2]) & (room <= wide[2:]))
    return np.asarray(places[np.argsort(room[places], kind="stable")])


def near_lowest(room: FloatArray, most: int, level: float) -> IntArray:
    """Return so many of the lowest local minima, those below a level, and the points about them."""
    least = lowest_of(room)[:most]
    near = (least[room[least] < level, None] + np.array([-1, 0, 1])).ravel()
    return np.asarray(near[(near >= 0) & (near < room.size)])


def _critical_points(room: FloatArray) -> IntArray:
    """Return the points that count in a step: local minima, and the valleys about the lowest."""
    near = near_lowest(room, _POINTS, room.min() + _REACH)
    valley = np.flatnonzero(room < room.min() + 0.5 * _REACH)
    even = valley[:: max(1, valley.size // (2 * _POINTS))]
    return np.unique(np.concatenate([near, even, [room.size - 1]]))


#: shapes: zero below and pole above the bandwidth, low-pass above it
_LEADS = tuple((a, b) for a in (2.0, 3.0, 4.2, 6.0, 10.0) for b in (4.0, 8.0, 20.0))
_TAILS = (3.0, 7.0, 20.0)
#: notches at the highest modes: how far above the mode as a factor, depth and width
_NOTCHES = ((1.0, 0.05, 0.3), (1.1, 0.4, 0.4))
_MODES = 3
#: bandwidths; points on which they are tried, and to either side of each mode
_TRIALS, _GRID_POINTS, _AROUND = 50, 300, 10
#: starts that are kept in all, and with the same notches, so far apart
_STARTS, _EACH, _APART = 12, 3, 0.25
#: what a start may lack of the distance, and what that costs in its score
_LACK, _LATER = 0.25, 4.0


def starts(of: AxisLaw, notches: int) -> list[FloatArray]:
    """Return numbers near the highest bandwidths, with and without notches at the modes."""
    if not of.lowest < of.highest:
        return []
    rows = _axis_points(of)
    sets = _sets(of, notches)
    found: list[list[_Start]] = [[] for _ in sets]
    for w in np.geomspace(of.highest, of.lowest, _TRIALS).tolist():
        for own, start in zip(found, _best_starts(of, w, sets, rows), strict=True):
            # far enough from the last of the same notches to end elsewhere
            apart = not own or start.score < own[-1].score - _APART
            if np.isfinite(start.score) and len(own) < _EACH and apart:
                own += [start] if of.axis.is_stable(of.law(start.numbers)) else []
    best = sorted((one for own in found for one in own), key=lambda one: -one.score)
    return [one.numbers for one in best[:_STARTS]]


class _Start(NamedTuple):
    """The logarithm of a bandwidth, less where the peak is not held yet, and all numbers."""

    score: float
    numbers: FloatArray


def _sets(of: AxisLaw, notches: int) -> list[FloatArray]:
    """Return the logarithms of the numbers of the notches that are tried together."""
    modes = of.axis.resonances[: min(_MODES, notches)].tolist()
    each = [
        [(), *((f * up, d, z) for up, d, z in _NOTCHES if f * up < of.axis.ceiling)] for f in modes
    ]
    return [np.log([one for one in chosen if one]).reshape(-1) for chosen in every(*each)]


def _best_starts(of: AxisLaw, w: float, sets: list[FloatArray], rows: IntArray) -> list[_Start]:
    """Return for each set of notches the best start at one bandwidth [Hz]."""
    top, s = of.axis.ceiling, np.append(of.s[rows], tustin_s(np.array([w]), of.axis.rate))
    shapes = sorted({(a, min(b, top / w), min(c, top / w)) for a, b in _LEADS for c in _TAILS})
    numbers = [np.log([w, *shape]) for shape in shapes]
    bodies = np.array([product(of.sections(one), s) for one in numbers])
    stops = np.array([product(of.sections(np.append(numbers[0], one))[2:], s) for one in sets])
    gain = stops[:, None] * bodies
    gain = gain[..., :-1] * of.axis.inertia * (2.0 * np.pi * w) ** 2 / np.abs(gain[..., -1:])
    room = np.min(of.room_of(gain, rows), axis=-1)
    room[room < -_LACK] = -np.inf
    room[~_turns_stably(gain * of.axis.points[1][rows], 3 if of.axis.free else 1)] = -np.inf
    best, each = np.argmax(room, axis=1), np.arange(len(sets))
    scores = np.log(w) + _LATER * np.minimum(room[each, best], 0.0)
    return [
        _Start(float(score), np.append(numbers[i], one))
        for score, i, one in zip(scores, best, sets, strict=True)
    ]


def _turns_stably(L: ComplexArray, at_zero: int) -> npt.NDArray[np.bool_]:
    """Return whether loops (..., n) turn as stable ones do, on few points: see `nyquist_count`."""
    F = 1.0 + L
    turned = np.sum(np.angle(F[..., 1:] / F[..., :-1]), axis=-1)
    start = np.angle(F[..., 0]) + 0.5 * np.pi * at_zero
    low, last = start - np.pi * np.round(start / np.pi), np.angle(F[..., -1])
    return np.asarray(np.abs(low + turned - last - 0.5 * np.pi * at_zero) < 0.5 * np.pi)


def _axis_points(of: AxisLaw) -> IntArray:
    """Return points that show the axis: even ones, and those around its modes."""
    freq = of.axis.points[0]
    even = np.searchsorted(freq, np.geomspace(freq[0], freq[-1], _GRID_POINTS))
    near = np.searchsorted(freq, of.axis.resonances)[:, None] + np.arange(-_AROUND, _AROUND + 1)
    return np.unique(np.clip(np.concatenate([even, near.ravel()]), 0, freq.size - 1))
