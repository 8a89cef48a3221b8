"""Antiresonances: where a response dips."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..values import ComplexArray, FloatArray

#: how deep a dip is at least, as a share of the lower one of the two maxima that it lies between
_DEPTH = 0.5
#: how many are refined, the deepest on the grid first
_MOST = 40


def dips(
    find: Callable[[FloatArray], ComplexArray],
    grid: FloatArray,
) -> FloatArray:
    """Return the antiresonances [Hz] of responses: deep local minima of the size of a channel."""
    size = np.abs(find(grid)).reshape(grid.size, -1)
    place, channel = np.nonzero((size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:]))
    lowest = size[place + 1, channel]
    ends = zip(place.tolist(), channel, strict=True)
    sides = np.array([_lower_side(size[:, own], at + 1) for at, own in ends])
    first = np.argsort(lowest / np.maximum(sides, 1e-300), kind="stable")[:_MOST]
    place, channel, lowest, sides = place[first], channel[first], lowest[first], sides[first]
    left, centre, right = grid[place], grid[place + 1], grid[place + 2]
    part = np.linspace(0.0, 1.0, 9)[1:-1]
    for _ in range(15 if place.size else 0):
        inside = left[:, None] + (right - left)[:, None] * part
        found = np.abs(find(inside.ravel())).reshape(*inside.shape, -1)
        found = np.take_along_axis(found, channel[:, None, None], axis=2)[:, :, 0]
        best = np.argmin(found, axis=1)
        rows = np.arange(place.size)
        centre, lowest = inside[rows, best], found[rows, best]
        edges = np.column_stack([left, inside, right])
        left, right = edges[rows, best], edges[rows, best + 2]
    share = lowest / np.maximum(sides, 1e-300)
    order = np.argsort(share, kind="stable")
    return np.asarray(centre[order][share[order] < _DEPTH])


def _lower_side(size: FloatArray, at: int) -> float:
    """Return the lower one of the maxima left and right of a minimum, up to where it is as low."""
    sides = (size[:at][::-1], size[at + 1 :])
    ends = [np.flatnonzero(side < size[at]) for side in sides]
    return min(
        float(side[: end[0] if end.size else None].max(initial=0.0))
        for side, end in zip(sides, ends, strict=True)
    )
