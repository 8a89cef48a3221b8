"""Where the search for a law begins: a grid of bandwidths, shapes and notches, all at once."""

from __future__ import annotations

from itertools import product as every
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..values import ComplexArray, FloatArray, IntArray
from .axis_law import AxisLaw
from .law import product, tustin_s

#: shapes: zero below and pole above the bandwidth, low-pass above it
_LEADS = tuple((a, b) for a in (2.0, 3.0, 4.2, 6.0, 10.0) for b in (4.0, 8.0, 20.0))
_TAILS = (3.0, 7.0, 20.0)
#: notches at the highest modes: how far above the mode as a factor, depth and width
_NOTCHES = ((1.0, 0.05, 0.3), (1.1, 0.4, 0.4))
_MODES = 3
#: bandwidths; points on which they are tried, and to either side of each mode
_TRIALS, _POINTS, _AROUND = 50, 300, 10
#: starts that are kept in all, and with the same notches, so far apart
_STARTS, _EACH, _APART = 12, 3, 0.25
#: what a start may lack of the distance, and what that costs in its score
_LACK, _LATER = 0.25, 4.0


def starts(of: AxisLaw, notches: int) -> list[FloatArray]:
    """Return numbers near the highest bandwidths, with and without notches at the modes."""
    if not of.lowest < of.highest:
        return []
    rows = _rows(of)
    sets = _sets(of, notches)
    found: list[list[_Start]] = [[] for _ in sets]
    for w in np.geomspace(of.highest, of.lowest, _TRIALS).tolist():
        for own, start in zip(found, _at(of, w, sets, rows), strict=True):
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


def _at(of: AxisLaw, w: float, sets: list[FloatArray], rows: IntArray) -> list[_Start]:
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


def _rows(of: AxisLaw) -> IntArray:
    """Return points that show the axis: even ones, and those around its modes."""
    freq = of.axis.points[0]
    even = np.searchsorted(freq, np.geomspace(freq[0], freq[-1], _POINTS))
    near = np.searchsorted(freq, of.axis.resonances)[:, None] + np.arange(-_AROUND, _AROUND + 1)
    return np.unique(np.clip(np.concatenate([even, near.ravel()]), 0, freq.size - 1))
