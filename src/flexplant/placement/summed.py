"""Scores of sums over the chosen: of numbers, and of matrices (Gramians, information)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray
from ..tolerances import TINY
from .criterion import Scorer
from .rows import Branch, ascended
from .tangent import Below, Convex

MEASURES = ("trace", "log det", "least")
#: what rounding leaves of an eigenvalue of zero, beside the largest
_NOTHING = 1e-13
#: steps to the largest log det, and the gap at which they stop [nats]
_STEPS, _CLOSE = 300, 1e-3
#: what rounding may have added to a log det [nats]
_ROUNDING = 1e-8
#: sums of so many numbers are made at once: they stay in the cache
_AT_ONCE = 200_000


@dataclass(frozen=True, eq=False)
class SummedWorth(Scorer):
    """Minus the sum of a worth (N,) of each candidate; its bound is exact."""

    worth: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return minus the sum."""
        return -float(self.worth[list(chosen)].sum())

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, those of one size at once."""
        return by_size(sets, lambda rows: -self.worth[rows].sum(axis=1))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the score of the best choice, and what rounding may have added to it."""
        kept = list(required)
        free = np.sort(np.delete(self.worth, kept))[::-1]
        used = np.concatenate([self.worth[kept], free[: count - len(kept)]])
        return -float(used.sum() + 1e-14 * np.abs(used).sum())


@dataclass(frozen=True, eq=False)
class SummedMatrices(Convex):
    """Minus a measure of ``sum_i W_i`` over the chosen: W_i (N, n, n), positive semidefinite.

    Minus the logarithm of the determinant is convex in weights of the candidates, so that it has a
    relaxation [JoshiBoyd2009]_. The other measures grow with
    each candidate: the bound is that of all of them.
    """

    matrices: FloatArray
    measure: str

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.matrices.shape[0])

    def value(self, chosen: Sequence[int]) -> float:
        """Return minus the measure: infinite where log det has none."""
        return float(self.score([tuple(chosen)])[0])

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, those of one size at once."""
        n = self.matrices.shape[1]
        few = max(1, _AT_ONCE // (n * n))

        def of(rows: FloatArray) -> FloatArray:
            parts = [self._measured(rows[i : i + few]) for i in range(0, len(rows), few)]
            return np.concatenate(parts)

        return by_size(sets, of)

    def tangent(self, weights: FloatArray) -> Below:
        """Return the relaxed cost itself, which is cheap to compute."""
        return _LogDet(self)

    def relaxation(self, branch: Branch) -> tuple[float, FloatArray]:
        """Return a lower bound over a branch, and weights near the least relaxed cost."""
        weights = branch.centre(self.total)
        if self.measure != "log det":
            return self.everything(), weights
        found, weights = self.tangent(weights).least(branch, weights)
        return max(found, self.everything()), weights

    def climbed(self, weights: FloatArray) -> tuple[float, FloatArray] | None:
        """Return log det at weights and its gradient ``tr(F^-1 W_i)``."""
        n = self.matrices.shape[1]
        F = (weights @ self.matrices.reshape(self.total, -1)).reshape(n, n)
        size = np.sqrt(np.maximum(F.diagonal(), TINY))
        sign, logs = np.linalg.slogdet(F / size / size[:, None])
        if sign <= 0:
            return None
        inverse = np.linalg.inv(F / size / size[:, None]) / size / size[:, None]
        rise = self.matrices.reshape(self.total, -1) @ inverse.ravel()
        return float(logs + 2.0 * np.sum(np.log(size))), rise

    def _measured(self, rows: FloatArray) -> FloatArray:
        """Return minus the measure of sums over rows (m, k) of indices."""
        total = self.matrices[rows[:, 0]]
        for j in range(1, rows.shape[1]):
            total += self.matrices[rows[:, j]]
        if self.measure == "least":
            return np.asarray(-np.linalg.eigvalsh(total)[:, 0])
        size = np.sqrt(np.maximum(np.einsum("mii->mi", total), TINY))
        try:
            root = np.linalg.cholesky(total / size[:, :, None] / size[:, None, :])
            part = np.einsum("mii->mi", root)
            if np.all(part.min(axis=1) > 1e-4):  # far from singular: nothing to decide
                return np.asarray(-2.0 * np.sum(np.log(part) + np.log(size), axis=1))
        except np.linalg.LinAlgError:
            pass
        values = np.linalg.eigvalsh(total)
        singular = values[:, 0] <= _NOTHING * values[:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = -np.sum(np.log(np.maximum(values, 0.0)), axis=1)
        return np.asarray(np.where(singular, np.inf, found))


class _LogDet(Below):
    """Minus log det as a function of weights: convex, and equal to the cost at choices."""

    def __init__(self, costs: SummedMatrices) -> None:
        self.costs = costs
        self.rows = costs.matrices.reshape(costs.total, -1)

    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the costs (m,) of each choice."""
        return self.costs.score(sets)

    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least.

        A weight of zero may make the sum singular, so that the start is moved inwards.
        """
        inner = 0.9 * branch.nearest(start) + 0.1 * branch.centre(start.size)
        most, weights = ascended(
            self.costs.climbed,
            branch,
            inner,
            steps=_STEPS,
            close=lambda value, most: most - value <= _CLOSE,
        )
        return -most - _ROUNDING, weights


def by_size(sets: Sequence[Sequence[int]], function: Any) -> FloatArray:
    """Return numbers of choices: the function gets rows (m, k) of those with k candidates."""
    if isinstance(sets, np.ndarray):
        return np.asarray(function(sets))
    found = np.empty(len(sets))
    sizes = np.fromiter(map(len, sets), dtype=np.int64, count=len(sets))
    for size in np.unique(sizes).tolist():
        which = np.flatnonzero(sizes == size)
        found[which] = function(np.array([sets[i] for i in which.tolist()], dtype=np.int64))
    return found


def summed(matrices: FloatArray, measure: str) -> Scorer:
    """Return the scorer of a measure of ``sum_i W_i``; the trace needs no matrices."""
    if measure == "trace":
        return SummedWorth(np.trace(matrices, axis1=1, axis2=2))
    return SummedMatrices(matrices, measure)
