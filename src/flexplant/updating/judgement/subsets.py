"""Which subset of many parameters explains a measurement: grown, screened again and exchanged."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import comb, log
from typing import Any

import numpy as np

from ...errors import ModelError, SolverError
from ...values import FloatArray
from ..search import Objective, SearchEnd, TrustRegion
from ..search.lasso import bic
from .goodness import chance, is_bad

#: best subsets of each size that grow
BEAM = 3
#: candidates that join a subset, pairs that are tried at once
JOIN = 6
#: rounds of exchanging members
ROUNDS = 4

Subset = tuple[int, ...]


class Subsets:
    """Exact fits of subsets of the candidates, the nuisance beside them, each done once.

    Parameters
    ----------
    whole : Objective
        Of all candidates, then the nuisance.
    residuals : sequence of Residual
        The measurement.
    count : int
        Number of candidates.
    """

    def __init__(self, whole: Objective, residuals: Any, count: int) -> None:
        self.whole, self.residuals, self.count = whole, residuals, count
        self.beside = list(range(count, len(whole.parameters)))
        self.start = whole.default_start
        self.done: dict[Subset, tuple[FloatArray, float] | None] = {}
        #: the points each fit went through
        self.ways: dict[Subset, list[FloatArray]] = {(): [self.start[self.beside]]}
        if self.beside:
            self.ways[()] = self._search([]).trail.p
            self.start = self.start.copy()
            self.start[self.beside] = self.ways[()][-1]
        point = whole.begin(self.start)
        r = whole.values(point)
        self.done[()] = self.start[self.beside], float(r @ r)
        self.rows = r.size

    def fit(self, subset: Subset) -> tuple[FloatArray, float] | None:
        """Return values (those of the nuisance last) and error, None when it cannot be fitted."""
        if subset not in self.done:
            try:
                found = self._search([*subset])
                self.done[subset] = found.p, 2 * found.cost
                self.ways[subset] = found.trail.p
            except (ModelError, SolverError):
                self.done[subset] = None
        return self.done[subset]

    def score(self, subset: Subset) -> float:
        """Return the extended BIC, ``chi^2 + k ln n + 2 ln C(c, k)``; infinite without a fit."""
        found, k, c = self.fit(subset), len(subset), self.count
        if found is None:
            return np.inf
        choices = log(comb(c, k))
        return bic(found[1], self.rows, k + len(self.beside), self.whole.noisy) + 2 * choices

    def chi2(self, subset: Subset) -> tuple[float | None, int]:
        """Return what a subset leaves (None where the noise is not known) and its freedom."""
        found = self.fit(subset)
        dof = self.rows - len(subset) - len(self.beside)
        return (found[1] if found is not None and self.whole.noisy else None), dof

    def best(self, singles: Iterable[int], most: int) -> Subset:
        """Return the subset of up to `most` candidates with the least extended BIC.

        Parameters
        ----------
        singles : sequence of int
            Candidates to begin with.
        most : int
            Largest subset.
        """
        best: Subset = ()
        layer: list[Subset] = [(i,) for i in singles]
        for size in range(1, min(most, self.rows - 1 - len(self.beside)) + 1):
            ranked = sorted(layer, key=self.score)[:BEAM]
            if not ranked or not np.isfinite(self.score(ranked[0])):
                break
            ranked[0] = self._exchanged(ranked[0])
            better = self.score(ranked[0]) < self.score(best)
            best = ranked[0] if better else best
            # more are worth a try while something is gained, or missing
            if not better and not is_bad(chance(*self.chi2(best))) and self.whole.noisy:
                break
            grown: set[Subset] = {
                tuple(sorted((*subset, i))) for subset in ranked for i in self._joining(subset)
            }
            layer = sorted(grown.union(self._pairs() if size == 1 else []))
        return best

    def explained(self, subset: Subset) -> FloatArray:
        """Return what each candidate explains to first order of what a subset leaves.

        What the subset and the nuisance explain is taken out of its slopes:
        ``(J_c^T r)^2 / (J_c^T J_c)`` with r and J_c free of them.
        """
        if self.fit(subset) is None:
            return np.zeros(self.count)
        fixed = [*subset, *self.beside]
        try:
            point = self._followed(self.whole, fixed, subset)
            r = self.whole.values(point)
            if not point.turned:
                J = self.whole.slopes(point)
                return _share(J[:, : self.count], J[:, fixed], r)
            # slopes of repeated modes depend on the candidate: each by itself
            return np.array([self._alone(b, subset, r) for b in range(self.count)])
        except ModelError:
            return np.zeros(self.count)

    def _alone(self, candidate: int, subset: Subset, r: FloatArray) -> float:
        if candidate in subset:
            return 0.0
        fixed = [*subset, *self.beside]
        alone = self._objective([candidate, *fixed])
        J = alone.slopes(self._followed(alone, range(1, len(fixed) + 1), subset))
        return float(_share(J[:, :1], J[:, 1:], r)[0])

    def _followed(self, objective: Objective, rows: Sequence[int], subset: Subset) -> Any:
        """Return the end of the fit of a subset, its modes followed as they were by the fit.

        The fitted parameters are the `rows` of those of the objective, the others are zero.
        """
        for i, values in enumerate(self.ways[subset]):
            p = np.zeros(len(objective.parameters))
            p[list(rows)] = values
            point = objective.begin(p) if i == 0 else objective.at(p, refer=True)
        return point

    def _joining(self, subset: Subset) -> list[int]:
        explained = self.explained(subset)
        explained[list(subset)] = -1.0
        order = np.argsort(-explained, kind="stable")[:JOIN]
        return [int(i) for i in order if explained[i] > 0]

    def _exchanged(self, subset: Subset) -> Subset:
        """Return the best subset that differs from this one in one member at a time."""
        if len(subset) < 2:
            return subset
        for _ in range(ROUNDS):
            others = {
                tuple(sorted((*rest, i)))
                for out in subset
                for rest in [tuple(k for k in subset if k != out)]
                for i in self._joining(rest)
            }
            best = min(sorted(others | {subset}), key=self.score)
            if best == subset:
                break
            subset = best
        return subset

    def _pairs(self) -> list[Subset]:
        """Return the pairs that explain most together, to first order."""
        point = self._followed(self.whole, self.beside, ())
        if point.turned:
            return []
        J, r = self.whole.slopes(point), self.whole.values(point)
        Q = np.linalg.qr(J[:, self.beside])[0]
        J, r = J[:, : self.count], r - Q @ (Q.T @ r)
        J = J - Q @ (Q.T @ J)
        length = np.linalg.norm(J, axis=0)
        J = J / np.where(length > 1e-12 * length.max(initial=0.0), length, np.inf)
        a, overlap = J.T @ r, J.T @ J
        room = 1 - overlap**2
        both = a[:, None] ** 2 + a[None] ** 2 - 2 * overlap * np.outer(a, a)
        gain = np.where(room > 1e-6, both / np.maximum(room, 1e-6), 0.0)
        i, j = np.triu_indices(self.count, 1)
        order = np.argsort(-gain[i, j], kind="stable")[: 2 * JOIN]
        return [(int(i[n]), int(j[n])) for n in order]

    def _objective(self, picked: list[int]) -> Objective:
        family = self.whole.family.of(picked)
        parameters = [self.whole.parameters[i] for i in picked]
        return Objective(family.model, parameters, self.residuals, prior=False, family=family)

    def _search(self, subset: list[int]) -> SearchEnd:
        picked = [*subset, *self.beside]
        return TrustRegion().search(
            self._objective(picked), self.start[picked], most=50, tolerance=1e-8
        )


def _share(J: FloatArray, beside: FloatArray, r: FloatArray) -> FloatArray:
    Q = np.linalg.qr(beside)[0]
    whole = np.sum(J**2, axis=0)
    J, r = J - Q @ (Q.T @ J), r - Q @ (Q.T @ r)
    length = np.sum(J**2, axis=0)
    # a candidate that is all nuisance explains nothing of its own
    own = length > 1e-12 * whole
    return np.asarray((J.T @ r) ** 2 / np.where(own, length, np.inf))
