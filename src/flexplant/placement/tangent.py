"""Lower bounds of a convex cost of weighted candidates: its information, linear in the weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..checks import FloatArray
from ..errors import SolverError
from .criterion import Scorer
from .rows import Branch, ascended

#: steps in the weights on one tangent, and the relative gap at which they stop
_STEPS, _GAP = 40, 1e-3
#: tangents of a bound at the root, and the parts of a step between them
_TANGENTS, _HALVES = 20, (1.0, 0.5, 0.25, 0.125, 0.0625)
#: what rounding may have added to a bound, relative
_ROUNDING = 1e-9


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
        """Return a number below the cost of all choices of a branch, and weights near the least.

        ``h = 1 / (cost - constant)`` is concave in w: a harmonic sum of concave information.
        """
        size = abs(self.constant)
        most, weights = ascended(
            self._inverse,
            branch,
            start,
            steps=_STEPS,
            close=lambda h, most: 1.0 / h - 1.0 / most <= _GAP * (1.0 / h + size),
        )
        if not np.isfinite(most):
            return -np.inf, weights
        return float(_safe(np.array(1.0 / most + self.constant))), weights

    def _inverse(self, weights: FloatArray) -> tuple[float, FloatArray] | None:
        """Return one over the cost, without the constant, and its gradient."""
        try:
            solved = np.linalg.solve(self._information(weights[None])[0], self.face)
        except np.linalg.LinAlgError:
            return None
        cost = float(np.sum(self.face * solved))
        if not cost > 0.0:
            return None
        rise = np.einsum("ik,nij,jk->n", solved, self.slopes, solved, optimize=True) / cost**2
        return 1.0 / cost, rise

    def _information(self, weights: FloatArray) -> FloatArray:
        """Return ``I + sum_i (w_i - v_i) Z_i`` for rows of weights (m, N)."""
        total, n = self.slopes.shape[:2]
        added = (weights - self.at) @ self.slopes.reshape(total, n * n)
        return np.asarray(added.reshape(-1, n, n) + np.eye(n))


class Convex(Scorer):
    """Scores that are a convex cost of weights of the candidates, in [0, 1]: they have bounds."""

    def tangent(self, weights: FloatArray) -> Below:
        """Return the tangent of the cost's information at weights (N,)."""
        raise NotImplementedError

    def cost(self, weights: FloatArray) -> float:
        """Return the cost at weights (N,); infinite where it has none."""
        raise NotImplementedError

    def inner_tangent(self, branch: Branch, weights: FloatArray) -> Below | None:
        """Return the tangent at weights of a branch moved slightly inwards; None if there is none.

        A weight of zero has no part in the cost: a rigid-body mode might be missed.
        """
        try:
            return self.tangent(0.98 * weights + 0.02 * branch.centre(weights.size))
        except SolverError:
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
    def total(self) -> int:
        """How many candidates there are."""
        raise NotImplementedError


def _safe(bound: FloatArray) -> FloatArray:
    return np.asarray(bound - _ROUNDING * np.abs(bound))
