"""Lower bounds of convex costs of weighted candidates, among them sums over the chosen."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray
from ..errors import SolverError, attempted
from ..tolerances import TINY
from .criterion import Scorer
from .rows import Branch, ascended

#: steps in the weights on one tangent, and the relative gap at which they stop
_CUTS, _GAP = 40, 1e-3
#: tangents of a bound at the root, and the parts of a step between them
_TANGENTS, _HALVES = 20, (1.0, 0.5, 0.25, 0.125, 0.0625)
#: what rounding may have added to a bound, relative
_RELATIVE = 1e-9


class Below(ABC):
    """A function of weights that is nowhere above a cost of choices."""

    #: effect of each candidate (N, r) on the cost; of like candidates alike
    rows: FloatArray

    @abstractmethod
    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return numbers (m,) below the cost of each choice."""

    @abstractmethod
    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least."""


@dataclass(frozen=True, eq=False)
class Tangent(Below):
    """``tr(F' (I + sum_i (w_i - v_i) Z_i)^-1 F) + constant``: below a cost, equal to it at v.

    The cost is ``tr(S Y(w)^-1 S') + constant``. Its information Y is concave in w, as a matrix, so
    Y is below its tangent at v, and the cost is above the cost of this tangent.
    """

    face: FloatArray
    slopes: FloatArray
    at: FloatArray
    constant: float
    rows: FloatArray

    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return numbers (m,) below the cost of each choice."""
        weights = np.zeros((len(sets), self.at.size))
        for row, chosen in zip(weights, sets, strict=True):
            row[list(chosen)] = 1.0
        try:
            solved = np.linalg.solve(self._information(weights), self.face)
        except np.linalg.LinAlgError:
            return np.full(len(sets), -np.inf)
        return _safe(np.einsum("ij,mij->m", self.face, solved) + self.constant)

    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least."""
        return least_sum([self], np.ones(1), branch, start)

    def fall(self, weights: FloatArray) -> tuple[float, FloatArray] | None:
        """Return the cost without the constant, and how fast it falls with each weight."""
        try:
            solved = np.linalg.solve(self._information(weights[None])[0], self.face)
        except np.linalg.LinAlgError:
            return None
        cost = float(np.sum(self.face * solved))
        if not cost > 0.0:
            return None
        return cost, np.einsum("ik,nij,jk->n", solved, self.slopes, solved, optimize=True)

    def _information(self, weights: FloatArray) -> FloatArray:
        """Return ``I + sum_i (w_i - v_i) Z_i`` for rows of weights (m, N)."""
        total, n = self.slopes.shape[:2]
        added = (weights - self.at) @ self.slopes.reshape(total, n * n)
        return np.asarray(added.reshape(-1, n, n) + np.eye(n))


def least_sum(
    parts: Sequence[Tangent], shares: FloatArray, branch: Branch, start: FloatArray
) -> tuple[float, FloatArray]:
    """Return a number below ``sum_p share_p cost_p`` in a branch, and weights near the least.

    ``h = 1 / sum_p share_p (cost_p - constant_p)`` is concave in w: a harmonic sum of information
    that is concave, block by block.
    """
    constant = float(shares @ [part.constant for part in parts])

    def inverse(weights: FloatArray) -> tuple[float, FloatArray] | None:
        found = [part.fall(weights) for part in parts]
        if any(one is None for one in found):
            return None
        costs, falls = zip(*(one for one in found if one is not None), strict=True)
        cost = float(shares @ costs)
        return 1.0 / cost, shares @ np.array(falls) / cost**2

    size = abs(constant)
    most, weights = ascended(
        inverse,
        branch,
        start,
        steps=_CUTS,
        close=lambda h, most: 1.0 / h - 1.0 / most <= _GAP * (1.0 / h + size),
    )
    if not np.isfinite(most):
        return -np.inf, weights
    return float(_safe(np.array(1.0 / most + constant))), weights


class Convex(Scorer, ABC):
    """Scores that are a convex cost of weights of the candidates, in [0, 1]: they have bounds."""

    @abstractmethod
    def tangent(self, weights: FloatArray) -> Below:
        """Return the tangent of the cost's information at weights (N,)."""

    @abstractmethod
    def cost(self, weights: FloatArray) -> float:
        """Return the cost at weights (N,); infinite where it has none."""

    def inner_tangent(self, branch: Branch, weights: FloatArray) -> Below | None:
        """Return the tangent at weights of a branch moved slightly inwards; None if there is none.

        A weight of zero has no part in the cost: a rigid-body mode might be missed.
        """
        with attempted("a tangent within the branch", SolverError):
            return self.tangent(0.98 * weights + 0.02 * branch.centre(weights.size))
        return None

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return a lower bound over all choices of `count` candidates: tangent after tangent."""
        free = np.setdiff1d(np.arange(self.total), required)
        kept = np.array(sorted(required), dtype=np.int64)
        groups = ((kept, kept.size), (free, count - kept.size))
        return self.relaxation(Branch(tuple((g, n) for g, n in groups if n)))[0]

    def relaxation(self, branch: Branch) -> tuple[float, FloatArray]:
        """Return a lower bound over a branch, and weights near the least relaxed cost.

        The least weights of a tangent are in a direction in which the cost falls: it is convex,
        above the tangent and equal to it where they touch. The step is halved until it does fall,
        for whole steps may jump to and fro.
        """
        centre = branch.centre(self.total)
        weights, best, cost = centre, self.everything(), np.inf
        for _ in range(_TANGENTS):
            tangent = self.inner_tangent(branch, weights)
            if tangent is None:
                break
            found, least = tangent.least(branch, weights)
            best = max(best, found)
            for step in _HALVES:
                moved = weights + step * (least - weights)
                lower = self.cost(0.999 * moved + 0.001 * centre)
                if lower < cost:
                    break
            if not lower < cost - _GAP * abs(cost) and np.isfinite(cost):
                break
            weights, cost = moved, lower
            if cost - best <= _GAP * abs(cost):
                break
        return best, weights

    def everything(self) -> float:
        """Return a number below the cost of all candidates together."""
        return float(_safe(np.array(self.value(range(self.total)))))

    @property
    @abstractmethod
    def total(self) -> int:
        """How many candidates there are."""


def _safe(bound: FloatArray) -> FloatArray:
    return np.asarray(bound - _RELATIVE * np.abs(bound))


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
class SummedMatrices(Scorer):
    """Minus a measure of ``sum_i W_i`` over the chosen: W_i (N, n, n), positive semidefinite.

    It grows with each candidate: the bound is that of all of them.
    """

    matrices: FloatArray

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.matrices.shape[0])

    def value(self, chosen: Sequence[int]) -> float:
        """Return minus the measure."""
        return float(self.score([tuple(chosen)])[0])

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, those of one size at once."""
        n = self.matrices.shape[1]
        few = max(1, _AT_ONCE // (n * n))

        def of(rows: FloatArray) -> FloatArray:
            parts = [self._measured(rows[i : i + few]) for i in range(0, len(rows), few)]
            return np.concatenate(parts)

        return by_size(sets, of)

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return a number below the score of every choice."""
        return float(_safe(np.array(self.value(range(self.total)))))

    def _measured(self, rows: FloatArray) -> FloatArray:
        """Return minus the measure of sums over rows (m, k) of indices."""
        return np.asarray(-np.linalg.eigvalsh(self._sums(rows))[:, 0])

    def _sums(self, rows: FloatArray) -> FloatArray:
        total = self.matrices[rows[:, 0]]
        for j in range(1, rows.shape[1]):
            total += self.matrices[rows[:, j]]
        return np.asarray(total)


@dataclass(frozen=True, eq=False)
class LogDetOfSum(SummedMatrices, Convex):
    """Minus log det: convex in weights of the candidates, so that it has a relaxation.

    [JoshiBoyd2009]_.
    """

    bound = Convex.bound
    total = SummedMatrices.total

    def cost(self, weights: FloatArray) -> float:
        """Return it at weights (N,): infinite where log det has none."""
        found = self.climbed(weights)
        return np.inf if found is None else -found[0]

    def tangent(self, weights: FloatArray) -> Below:
        """Return the relaxed cost itself, which is cheap to compute."""
        return _LogDet(self)

    def relaxation(self, branch: Branch) -> tuple[float, FloatArray]:
        """Return a lower bound over a branch, and weights near the least relaxed cost."""
        weights = branch.centre(self.total)
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
        """Return minus log det of sums over rows (m, k) of indices, infinite where it has none."""
        total = self._sums(rows)
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

    def __init__(self, costs: LogDetOfSum) -> None:
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


def sum_scorer(matrices: FloatArray, measure: str) -> Scorer:
    """Return the scorer of a measure of ``sum_i W_i``; the trace needs no matrices."""
    if measure == "trace":
        return SummedWorth(np.trace(matrices, axis1=1, axis2=2))
    return LogDetOfSum(matrices) if measure == "log det" else SummedMatrices(matrices)
