"""A branch of a search: counts in disjoint groups of candidates, and the best weights there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, product
from math import comb, prod
from typing import TypeAlias

import numpy as np

from ..values import FloatArray, IntArray

#: disjoint groups of candidates, and how many of each are chosen
Groups: TypeAlias = tuple[tuple[IntArray, int], ...]


@dataclass(frozen=True, eq=False)
class Branch:
    """All choices with given counts in disjoint groups of candidates, and none elsewhere."""

    groups: Groups

    @property
    def members(self) -> IntArray:
        """Every candidate that appears in a choice."""
        return np.sort(np.concatenate([group for group, _ in self.groups]))

    @property
    def size(self) -> int:
        """How many choices there are."""
        return prod(comb(group.size, count) for group, count in self.groups)

    def choices(self) -> list[tuple[int, ...]]:
        """Return all choices, indices ascending."""
        parts = [combinations(group.tolist(), count) for group, count in self.groups]
        return [tuple(sorted(sum(parts, ()))) for parts in product(*parts)]

    def nearest(self, weights: FloatArray) -> FloatArray:
        """Return the nearest weights (N,) in [0, 1] whose sums over the groups are the counts."""
        found = np.zeros_like(weights)
        for group, count in self.groups:
            found[group] = _capped(weights[group], count)
        return found

    def centre(self, total: int) -> FloatArray:
        """Return equal weights (total,) within each group."""
        found = np.zeros(total)
        for group, count in self.groups:
            found[group] = count / group.size
        return found

    def least(self, slope: FloatArray) -> float:
        """Return the smallest sum of `slope` (N,) over any choice."""
        return float(sum(np.sort(slope[group])[:count].sum() for group, count in self.groups))

    def halves(self, rows: FloatArray, weights: FloatArray) -> Iterator[Branch]:
        """Return the parts that arise when the most diverse group is cut in two."""
        open_groups = [i for i, (group, count) in enumerate(self.groups) if count < group.size]
        spread = [_spread(rows[g], weights[g]) for g, _ in (self.groups[i] for i in open_groups)]
        most = open_groups[int(np.argmax([size for size, _ in spread]))]
        group, count = self.groups[most]
        along = spread[open_groups.index(most)][1]
        order = np.argsort(along, kind="stable")
        heaped = np.cumsum(weights[group][order])
        middle = int(np.searchsorted(heaped, 0.5 * heaped[-1])) + 1
        middle = min(max(middle, 1), group.size - 1)
        low, high = np.sort(group[order[:middle]]), np.sort(group[order[middle:]])
        rest = self.groups[:most] + self.groups[most + 1 :]
        for part in range(max(0, count - high.size), min(count, low.size) + 1):
            counts = ((low, part), (high, count - part))
            yield Branch(rest + tuple((g, c) for g, c in counts if c))


def _spread(rows: FloatArray, weights: FloatArray) -> tuple[float, FloatArray]:
    """Return the weighted variance of rows, and each row's place along its main direction."""
    weights = weights + 1e-3 * np.max(weights) + 1e-12
    away = rows - weights @ rows / np.sum(weights)
    _, sizes, directions = np.linalg.svd(np.sqrt(weights)[:, None] * away, full_matrices=False)
    return float(np.sum(sizes**2)), np.asarray(away @ directions[0])


def _capped(values: FloatArray, count: int) -> FloatArray:
    """Return the nearest entries in [0, 1] that sum to count: all shifted alike, then cut off."""
    if count >= values.size:
        return np.ones_like(values)
    kinks = np.sort(np.concatenate([values, values - 1.0]))
    sums = np.clip(values - kinks[:, None], 0.0, 1.0).sum(axis=1)  # falls from the size to 0
    return np.asarray(np.clip(values - np.interp(-count, -sums, kinks), 0.0, 1.0))


def ascended(
    function: Callable[[FloatArray], tuple[float, FloatArray] | None],
    branch: Branch,
    start: FloatArray,
    *,
    steps: int,
    close: Callable[[float, float], bool],
) -> tuple[float, FloatArray]:
    """Return a number above the function at every choice of a branch, and weights near the largest.

    Projected gradient steps of Barzilai and Borwein [BarzilaiBorwein1988]_. Whatever w is,
    ``h(w) + h'(w) (x - w)`` is above h at every choice x: that is the bound.
    """
    weights, step = branch.nearest(start), 0.0
    most, kept, highest = np.inf, weights, -np.inf
    before: tuple[FloatArray, FloatArray] | None = None
    for _ in range(steps):
        found = function(weights)
        if found is None:
            break
        value, rise = found
        most = min(most, value - branch.least(-rise) - float(rise @ weights))
        if value > highest:
            kept, highest = weights, value
        if close(value, most):
            break
        if before is None:
            step = 0.3 / max(float(np.max(np.abs(rise))), 1e-300)
        else:
            moved, turned = weights - before[0], before[1] - rise
            bend = float(moved @ turned)
            step = float(moved @ moved) / bend if bend > 0 else 2.0 * step
        before = weights, rise
        weights = branch.nearest(weights + step * rise)
        if np.max(np.abs(weights - before[0])) < 1e-9:
            break
    return most, kept
