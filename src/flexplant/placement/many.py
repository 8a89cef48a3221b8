"""Scores of the same choice on several machines or at several positions: the worst or the mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..checks import FloatArray
from ..errors import AssumptionError
from .convex import Below, Convex, Tangent, least_sum
from .criterion import Scorer
from .layouts import RigidPart
from .rows import Branch

MEASURES = ("worst", "mean")
#: rounds in which the shares of parts move to the worst one, how fast, and the gap that ends them
_ROUNDS, _PULL, _GAP = 8, 4.0, 1e-3


def over(measure: str, values: Any) -> Any:
    """Return the largest or the mean along the first axis."""
    return np.max(values, axis=0) if measure == "worst" else np.mean(values, axis=0)


def many_scores(
    parts: Sequence[Scorer], measure: str, rigid: Sequence[RigidPart] = ()
) -> ManyScores:
    """Return the scores of several parts together, with bounds of their relaxation where all have.

    With what each part sees of the rigid-body modes, a choice that misses one has no score.
    """
    kind = ConvexScores if all(isinstance(part, Convex) for part in parts) else ManyScores
    return kind(tuple(parts), measure, tuple(rigid))


@dataclass(frozen=True, eq=False)
class ManyScores(Scorer):
    """The worst or the mean of several scores of the same choice."""

    parts: tuple[Any, ...]
    measure: str
    rigid: tuple[RigidPart, ...] = ()

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice."""
        missed = [i for i, part in enumerate(self.rigid) if part.missing(chosen)]
        if missed:
            raise AssumptionError(
                f"It misses a rigid-body mode at {len(missed)} of {len(self.rigid)} positions."
            )
        return float(over(self.measure, [part.value(chosen) for part in self.parts]))

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return it for several choices."""
        values, missed = np.full(len(sets), np.inf), np.zeros(len(sets), dtype=bool)
        for part in self.rigid:
            missed = missed | (np.asarray(part.all_missing(sets)) > 0)
        kept = np.flatnonzero(~missed).tolist()
        if kept:
            found = np.array([part.score([sets[i] for i in kept]) for part in self.parts])
            values[kept] = over(self.measure, found)
        return values

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the worst or the mean of the bounds."""
        bounds = [part.bound(count, required) for part in self.parts]
        return float(over(self.measure, bounds))


@dataclass(frozen=True, eq=False)
class ConvexScores(ManyScores, Convex):
    """The worst or the mean of convex costs: it is one itself."""

    def cost(self, weights: FloatArray) -> float:
        """Return it at weights (N,)."""
        return float(over(self.measure, [part.cost(weights) for part in self.parts]))

    def tangent(self, weights: FloatArray) -> Below:
        """Return the worst or the mean of the tangents."""
        return BelowAll(tuple(part.tangent(weights) for part in self.parts), self.measure)

    def everything(self) -> float:
        """Return a number below the cost of all candidates together."""
        return float(over(self.measure, [part.everything() for part in self.parts]))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the bound of the relaxation."""
        return Convex.bound(self, count, required)

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.parts[0].total)


@dataclass(frozen=True, eq=False)
class BelowAll(Below):
    """The worst or the mean of functions below costs: it lies below the worst or the mean."""

    parts: tuple[Below, ...]
    measure: str

    @cached_property
    def rows(self) -> FloatArray:  # type: ignore[override]
        """Effects of each candidate on all parts."""
        return np.hstack([part.rows for part in self.parts])

    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return numbers (m,) below the cost of each choice."""
        return np.asarray(over(self.measure, [part.values(sets) for part in self.parts]))

    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least.

        For any shares that add up to one ``min_w sum_p share_p f_p(w) <= min_w max_p f_p(w)``;
        they are moved to the worst parts as far as that lifts the bound.
        """
        tangents = [part for part in self.parts if isinstance(part, Tangent)]
        if len(tangents) < len(self.parts):
            found = [part.least(branch, start) for part in self.parts]
            bound = float(over(self.measure, [one for one, _ in found]))
            return bound, np.mean([weights for _, weights in found], axis=0)
        shares = np.full(len(tangents), 1.0 / len(tangents))
        best, kept = least_sum(tangents, shares, branch, start)
        if self.measure == "mean":
            return best, kept
        weights = kept
        for _ in range(_ROUNDS):
            falls = [one.fall(weights) for one in tangents]
            if any(fall is None for fall in falls):
                break
            costs = np.array(
                [f[0] + t.constant for f, t in zip(falls, tangents, strict=True) if f is not None]
            )
            size = float(np.abs(costs).max())
            if float(costs.max()) - best <= _GAP * size:
                break
            shares = shares * np.exp(_PULL * (costs - costs.max()) / size)
            shares = shares / shares.sum()
            bound, weights = least_sum(tangents, shares, branch, weights)
            if bound > best:
                best, kept = bound, weights
        return best, kept
