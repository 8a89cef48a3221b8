"""Linear rows that a choice must satisfy, and choices that satisfy them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from math import comb, prod
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from ..checks import FloatArray, IntArray
from ..tolerances import SETTLED, TINY

#: what rounding may have added to a sum
_SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class LinearRows:
    """``lower <= A x <= upper``, x 1 for chosen candidates and 0 for others."""

    A: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def closed(cls, which: npt.NDArray[np.bool_]) -> LinearRows:
        """Return rows that exclude some candidates (N,)."""
        rows = np.eye(which.size)[which]
        return cls(rows, np.zeros(len(rows)), np.zeros(len(rows)))

    @classmethod
    def counted(cls, row: FloatArray, at_least: int | None, at_most: int | None) -> LinearRows:
        """Return one row (N,) between two limits, of which either may be absent."""
        high = np.inf if at_most is None else float(at_most)
        return cls(row[None], np.array([float(at_least or 0)]), np.array([high]))

    @classmethod
    def equal(cls, pairs: Sequence[tuple[int, int]], total: int) -> LinearRows:
        """Return rows by which both or none of each pair are chosen."""
        rows = np.zeros((len(pairs), total))
        for row, (i, j) in zip(rows, pairs, strict=True):
            row[i] += 1.0
            row[j] -= 1.0
        return cls(rows, np.zeros(len(rows)), np.zeros(len(rows)))

    @classmethod
    def stacked(cls, parts: Sequence[LinearRows], total: int) -> LinearRows:
        """Return the rows of all parts."""
        found = cls(np.zeros((0, total)), np.zeros(0), np.zeros(0))
        for part in parts:
            found = found.and_(part)
        return found

    def and_(self, other: LinearRows) -> LinearRows:
        """Return the rows of both."""
        return LinearRows(
            np.vstack([self.A, other.A]),
            np.concatenate([self.lower, other.lower]),
            np.concatenate([self.upper, other.upper]),
        )

    def hold(self, sets: Sequence[Sequence[int]]) -> npt.NDArray[np.bool_]:
        """Return which of some choices (m,) satisfy every row."""
        x = np.zeros((len(sets), self.A.shape[1]))
        for row, chosen in zip(x, sets, strict=True):
            row[list(chosen)] = 1.0
        sums = x @ self.A.T
        within = (sums >= self.lower - self._slack) & (sums <= self.upper + self._slack)
        return np.asarray(np.all(within, axis=1))

    def added(self, base: Sequence[int]) -> npt.NDArray[np.bool_]:
        """Return which candidates (N,) exceed no upper limit beside `base` that it does not."""
        used = self.A[:, list(base)].sum(axis=1)
        over = (used[:, None] + self.A > (self.upper + self._slack)[:, None]) & (self.A > 0)
        return np.asarray(~np.any(over & (used <= self.upper + self._slack)[:, None], axis=0))

    def shut(self, required: Sequence[int]) -> npt.NDArray[np.bool_]:
        """Return which candidates (N,) no choice with `required` can hold, by one row alone."""
        used = np.zeros(self.A.shape[1])
        used[list(required)] = 1.0
        least = np.minimum(self.A, 0.0) @ (1.0 - used) + self.A @ used
        with_it = least[:, None] + np.maximum(self.A, 0.0)
        found = np.any(with_it > (self.upper + self._slack)[:, None], axis=0)
        found[list(required)] = False
        return np.asarray(found)

    def possible(self, branch: Branch) -> bool:
        """Return whether each row alone leaves a choice of a branch."""
        low, high = np.zeros(len(self.A)), np.zeros(len(self.A))
        for group, count in branch.groups:
            part = np.sort(self.A[:, group], axis=1)
            low += part[:, :count].sum(axis=1)
            high += part[:, part.shape[1] - count :].sum(axis=1)
        return bool(
            np.all(low <= self.upper + self._slack) and np.all(high >= self.lower - self._slack)
        )

    def units(self) -> list[tuple[int, ...]]:
        """Return the sets of candidates that are chosen together, single ones included."""
        from scipy.sparse.csgraph import connected_components

        zero = (self.lower == 0) & (self.upper == 0)
        pair = zero & (np.count_nonzero(self.A, axis=1) == 2) & (self.A.sum(axis=1) == 0)
        total = self.A.shape[1]
        ends = np.nonzero(self.A[pair])[1].reshape(-1, 2)
        graph = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(total, total))
        count, label = connected_components(graph, directed=False)
        return [tuple(np.flatnonzero(label == i).tolist()) for i in range(count)]

    def with_partners(self, chosen: Sequence[int]) -> tuple[int, ...]:
        """Return a choice with all that its members are chosen together with."""
        return tuple(sorted(i for unit in self.units() if set(unit) & set(chosen) for i in unit))

    def best(
        self, worth: FloatArray, count: int, required: Sequence[int]
    ) -> tuple[int, ...] | None:
        """Return the choice of `count` with the largest sum of worth (N,); None if there is none.

        A mixed-integer linear program (HiGHS).
        """
        from scipy.optimize import Bounds, LinearConstraint, milp

        total, slack = self.A.shape[1], self._slack
        low = np.zeros(total)
        low[list(required)] = 1.0
        found = milp(
            -np.asarray(worth) / max(float(np.max(np.abs(worth))), TINY),
            constraints=[
                LinearConstraint(csr_array(self.A), self.lower - slack, self.upper + slack),
                LinearConstraint(np.ones((1, total)), count, count),
            ],
            integrality=np.ones(total, dtype=np.int64),
            bounds=Bounds(low, 1.0),
        )
        if found.x is None:
            return None
        return tuple(np.flatnonzero(found.x > 0.5).tolist())

    @property
    def _slack(self) -> FloatArray:
        return np.asarray(_SLACK * np.abs(self.A).max(axis=1, initial=0.0))


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
        spread = [
            _main_variance(rows[g], weights[g]) for g, _ in (self.groups[i] for i in open_groups)
        ]
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


def _main_variance(rows: FloatArray, weights: FloatArray) -> tuple[float, FloatArray]:
    """Return the weighted variance of rows, and each row's place along its main direction."""
    # those of weight zero are to be cut as well
    weights = weights + 1e-3 * np.max(weights) + TINY
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
            # weights move by 0.3 of their range at first
            step = 0.3 / max(float(np.max(np.abs(rise))), TINY)
        else:
            moved, turned = weights - before[0], before[1] - rise
            bend = float(moved @ turned)
            step = float(moved @ moved) / bend if bend > 0 else 2.0 * step
        before = weights, rise
        weights = branch.nearest(weights + step * rise)
        if np.max(np.abs(weights - before[0])) < SETTLED:
            break
    return most, kept
