"""Which subset of many parameters explains a measurement: grown, screened again and exchanged."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import comb, log
from typing import Any, NamedTuple

import numpy as np

from ...errors import ModelError, SolverError
from ...values import FloatArray
from ..search import Objective, TrustRegion
from ..search.lasso import bic
from .goodness import chance, chi_square, is_bad, worst

#: best subsets of each size that grow
BEAM = 3
#: candidates that join a subset, pairs that are tried at once
JOIN = 6
#: rounds of exchanging members
ROUNDS = 4
#: relative tolerance of the fits that are compared, and of the one that is chosen
COMPARED, CHOSEN = 1e-4, 1e-9
#: parts of the way to a guess at which modes are followed, where their shapes change much on it
WAY = (0.0, 0.25, 0.5, 0.75)
#: least MAC of every mode with itself at which it is the same mode without a step between
SAME = 0.8

Subset = tuple[int, ...]


class SubsetFit(NamedTuple):
    """The exact fit of a subset: its values (those of the nuisance last) and what it leaves."""

    p: FloatArray
    #: sum of squares of the residuals
    error: float
    #: the same in units of the noise and its correlation, None where that is not known
    chi2: float | None
    #: the residuals that fit worst, in words
    worst: str


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
        self.done: dict[Subset, SubsetFit | None] = {}
        #: what each candidate would be alone, to first order
        self.linear: FloatArray | None = None
        #: the points each fit went through
        self.ways: dict[Subset, list[FloatArray]] = {(): [self.start[self.beside]]}
        if self.beside:
            self.done[()] = self._fitted(())
            self.start = self.start.copy()
            self.start[self.beside] = self.ways[()][-1]
        point = whole.begin(self.start)
        self.rows = whole.values(point).size
        if not self.beside:
            self.done[()] = _left(whole, self.start[:0], whole.default_start)

    def fit(self, subset: Subset) -> SubsetFit | None:
        """Return the fit of a subset, None when it cannot be fitted."""
        if subset not in self.done:
            try:
                self.done[subset] = self._fitted(subset)
            except (ModelError, SolverError):
                self.done[subset] = None
        return self.done[subset]

    def polish(self, subset: Subset) -> None:
        """Fit a subset to all digits, from where its fit ended."""
        if self.fit(subset) is None or not (subset or self.beside):
            return
        objective = self._objective([*subset, *self.beside])
        objective.path = self.ways[subset][:-1]
        end = self.ways[subset][-1]
        found = TrustRegion().search(objective, end, most=50, tolerance=CHOSEN)
        self.ways[subset] = [*self.ways[subset], *found.trail.p[1:]]
        self.done[subset] = _left(objective, found.p, found.p)

    def score(self, subset: Subset) -> float:
        """Return the extended BIC, ``chi^2 + k ln n + 2 ln C(c, k)``; infinite without a fit."""
        found, k, c = self.fit(subset), len(subset), self.count
        if found is None:
            return np.inf
        known = found.chi2 is not None
        misfit = found.error if found.chi2 is None else found.chi2
        return bic(misfit, self.rows, k + len(self.beside), known) + 2 * log(comb(c, k))

    def chi2(self, subset: Subset) -> tuple[float | None, int]:
        """Return what a subset leaves (None where the noise is not known) and its freedom."""
        found = self.fit(subset)
        dof = self.rows - len(subset) - len(self.beside)
        return (None if found is None else found.chi2), dof

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
            if not better and self.whole.noise_known and not is_bad(chance(*self.chi2(best))):
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
                if not subset:
                    self.linear = _alone(J[:, : self.count], J[:, fixed], r)
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

    def _fitted(self, subset: Subset) -> SubsetFit:
        picked = [*subset, *self.beside]
        objective = self._objective(picked)
        first, guess = self.start[picked], self._guess(subset)
        method = TrustRegion()
        if guess is not None:
            # modes keep the numbers of the start, and are followed on the way
            objective.path = self._way(objective, first, guess)
            try:
                found = method.search(objective, guess, most=50, tolerance=COMPARED)
            except (ModelError, SolverError, np.linalg.LinAlgError):
                found = None
            if found is not None and found.trail.error[-1] < self._error(()):
                self.ways[subset] = [*objective.path, *found.trail.p]
                return _left(objective, found.p, found.p)
            objective = self._objective(picked)
        found = method.search(objective, first, most=50, tolerance=COMPARED)
        self.ways[subset] = found.trail.p
        return _left(objective, found.p, found.p)

    def _way(self, objective: Objective, first: FloatArray, guess: FloatArray) -> list[FloatArray]:
        """Return the points through which modes are followed from the start to a guess."""
        try:
            begin = objective.begin(first)
            end = objective.at(guess)
        except ModelError:
            return [first + part * (guess - first) for part in WAY]
        columns = [point.columns(objective.numbers) for point in (begin, end)]
        X, Y = (
            objective.family.weighted(point.eigen.X)[:, own]
            for point, own in zip((begin, end), columns, strict=True)
        )
        cosine = np.abs(np.sum(X.conj() * Y, axis=0))
        if np.all(
            cosine**2 >= SAME * np.sum(np.abs(X) ** 2, axis=0) * np.sum(np.abs(Y) ** 2, axis=0)
        ):
            return [first]
        return [first + part * (guess - first) for part in WAY]

    def _guess(self, subset: Subset) -> FloatArray | None:
        """Return values near the fit of a subset: of the best part of it, or to first order.

        From zero a trust region grows by a factor of two a step to where one of these begins.
        """
        parts = [tuple(k for k in subset if k != out) for out in subset]
        parts = [part for part in parts if part and self.done.get(part) is not None]
        if parts:
            best = min(parts, key=self._error)
            fit = self.done[best]
            assert fit is not None  # noqa: S101 - just selected
            own = dict(zip([*best, *self.beside], fit.p.tolist(), strict=True))
            return np.array([own.get(k, 0.0) for k in [*subset, *self.beside]])
        if len(subset) != 1 or self.linear is None:
            return None
        return np.array([self.linear[subset[0]], *self.start[self.beside]])

    def _error(self, subset: Subset) -> float:
        found = self.done.get(subset)
        return np.inf if found is None else found.error


def _left(objective: Objective, values: FloatArray, p: FloatArray) -> SubsetFit:
    """Return what the model at `p` leaves; `values` are those parameters that were fitted."""
    point = objective.at(p)
    r = objective.values(point)
    fitted = np.full(p.size, bool(values.size))
    chi2, _ = chi_square(objective, point, fitted)
    return SubsetFit(values, float(r @ r), chi2, worst(objective, point))


def _alone(J: FloatArray, beside: FloatArray, r: FloatArray) -> FloatArray:
    """Return what each parameter alone would be to first order, beside others."""
    Q = np.linalg.qr(beside)[0]
    J, r = J - Q @ (Q.T @ J), r - Q @ (Q.T @ r)
    length = np.sum(J**2, axis=0)
    return np.asarray(-(J.T @ r) / np.where(length > 0, length, np.inf))


def _share(J: FloatArray, beside: FloatArray, r: FloatArray) -> FloatArray:
    Q = np.linalg.qr(beside)[0]
    whole = np.sum(J**2, axis=0)
    J, r = J - Q @ (Q.T @ J), r - Q @ (Q.T @ r)
    length = np.sum(J**2, axis=0)
    # a candidate that is all nuisance explains nothing of its own
    own = length > 1e-12 * whole
    return np.asarray((J.T @ r) ** 2 / np.where(own, length, np.inf))
