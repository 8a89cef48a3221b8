"""Search for the subset of many parameters that explains a measurement."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from math import comb, expm1, log
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, divisor
from ...errors import ModelError, SolverError
from ...modes.matching import ALIKE, mac_matrix
from ...sparse.symmetric import factors
from ...tolerances import CLOSE, FOUR_DIGITS, MOST_STEPS, NEGLIGIBLE, NULL, SETTLED, TINY, TYPED
from ..family import Eigen, Family, Point
from ..search import Objective, TrustRegion
from ..search.least_squares import SearchEnd
from ..search.objective import chance, independent_share, is_bad, noise_misfit, worst

#: number of best subsets of each size that are extended
BEAM = 3
#: number of candidates that extend a subset, and number of pairs that are tried together
JOIN = 6
#: number of parts of the way to a guess at which modes are followed, if their shapes change much
WAY = np.arange(4) / 4
#: ratio of the effect of a candidate to its first-order effect, where noise may explain the
#: residual
REACH = 4.0

Subset = tuple[int, ...]


def bic(error: float, rows: int, count: int, noisy: bool) -> float:
    """Return ``chi^2 + k ln n``, or ``n ln(e/n) + k ln n`` where the noise is not known."""
    misfit = error if noisy else rows * float(np.log(max(error, TINY) / rows))
    return misfit + count * float(np.log(rows))


class SubsetFit(NamedTuple):
    """The fit of a subset: its values (those of nuisance parameters last) and its residual."""

    p: FloatArray
    #: sum of squares of the residuals
    error: float
    #: the same in units of the noise and its correlation, None if not known
    chi2: float | None
    #: the extended BIC, ``chi^2 + k ln n + 2 ln C(c, k)``
    score: float


class Subsets:
    """Fits of subsets of the candidates together with the nuisance parameters, each done once.

    Fits of modes with changes of low rank use few `coordinates`, where these are accurate enough,
    until `polish`.
    """

    def __init__(self, whole: Objective, residuals: Any, count: int) -> None:
        self.whole, self.residuals, self.count = whole, residuals, count
        self.nuisance = list(range(count, len(whole.parameters)))
        self.start = whole.default_start
        self.done: dict[Subset, SubsetFit | None] = {}
        #: value of each candidate alone, to first order
        self.linear: FloatArray | None = None
        #: values near those of a set's fit, where they are known from elsewhere
        self.guesses: dict[Subset, FloatArray] = {}
        #: the model where each fit ended
        self.ends: dict[Subset, Point] = {}
        point = whole.begin(np.where(np.arange(self.start.size) < count, 0.0, self.start))
        self.rows = whole.values(point).size
        self.share = independent_share(whole, point)
        modal = not any(residual.loaded for residual in residuals)
        self.confines = modal and bool(whole.numbers) and not whole.family.condensed
        highest = np.abs(whole.poles(point)).max(initial=0.0) if self.confines else 0.0
        self.top = max([float(highest), *(residual.top for residual in residuals)])
        self.loads: dict[int, FloatArray | None] = {}
        #: the least criterion of all fits
        self.least = np.inf
        self.error_without = float(np.sum(whole.values(point) ** 2))
        if self.nuisance:
            self.done[()] = self._fitted(())
            self.start = self.start.copy()
            self.start[self.nuisance] = self.ends[()].p
        else:
            self.done[()], self.ends[()] = self._left(whole, self.start[:0], point, ()), point

    def fit(self, subset: Subset) -> SubsetFit | None:
        """Return the fit of a subset, None when it cannot be fitted."""
        if subset not in self.done:
            try:
                self.done[subset] = found = self._fitted(subset)
                self.least = min(self.least, found.score)
            except (ModelError, SolverError):
                self.done[subset] = None
        return self.done[subset]

    def polish(self, subset: Subset) -> None:
        """Fit a subset to full accuracy, from the end of its previous fit."""
        if self.fit(subset) is None or not (subset or self.nuisance):
            return
        objective = self._objective([*subset, *self.nuisance])
        near = self._end_of(objective, range(len(objective.parameters)), subset)
        # shapes of few coordinates are not exact
        objective.origin = objective.place(near.continued(near.p))
        found = TrustRegion().search(objective, near.p, most=50, tolerance=SETTLED)
        point = objective.at(found.p)
        self.done[subset] = self._left(objective, found.p, point, subset)
        self.ends[subset] = point

    def worst(self, subset: Subset) -> str:
        """Return the residuals that the fit of a subset explains least, in words."""
        picked = [*subset, *self.nuisance]
        objective = self._objective(picked)
        return worst(objective, self._end_of(objective, range(len(picked)), subset))

    def score(self, subset: Subset) -> float:
        """Return the extended BIC of a subset, infinite without a fit."""
        found = self.fit(subset)
        return np.inf if found is None else found.score

    def _left(
        self, objective: Objective, values: FloatArray, point: Point, subset: Subset
    ) -> SubsetFit:
        """Return the residual of the model at a point; `values`: those of fitted parameters."""
        r, k = objective.values(point), len(subset)
        error = float(r @ r)
        # residuals without a scale have the same weight as the others
        free = np.full(point.p.size, bool(values.size))
        chi2 = noise_misfit(objective, point, free) if objective.noise_known else None
        misfit = error if chi2 is None else chi2
        rows = self.rows if chi2 is None else max(round(self.share * self.rows), 1)
        score = bic(misfit, rows, k + len(self.nuisance), chi2 is not None)
        return SubsetFit(values, error, chi2, score + 2 * log(comb(self.count, k)))

    def chi2(self, subset: Subset) -> tuple[float | None, int]:
        """Return the chi-square of a subset (None if the noise is not known) and its freedom."""
        found = self.fit(subset)
        lost = sum(bound.lost for bound in self.whole.bounds)
        dof = round(self.share * (self.rows - lost - len(subset) - len(self.nuisance)))
        return (None if found is None else found.chi2), dof

    def runner_up(self, best: Subset) -> tuple[Subset, float]:
        """Return the best fitted set that names another place, and its criterion."""
        # a set that only adds candidates to the best set names no other place
        other = [
            (found.score, one)
            for one, found in self.done.items()
            if found is not None and not set(best) <= set(one)
        ]
        score, found_best = min(other, default=(np.inf, ()))
        return found_best, score

    def best(self, singles: Iterable[int], most: int) -> Subset:
        """Return the subset of up to `most` candidates with the least extended BIC."""
        best: Subset = ()
        layer: list[Subset] = [(i,) for i in singles]
        for size in range(1, min(most, self.rows - 1 - len(self.nuisance)) + 1):
            ranked = sorted(layer, key=self.score)[:BEAM]
            if not ranked or not np.isfinite(self.score(ranked[0])):
                break
            ranked[0] = self._exchanged(ranked[0])
            better = self.score(ranked[0]) < self.score(best)
            best = ranked[0] if better else best
            # larger sets are tried while they improve the fit, or the residual exceeds noise
            enough = self._is_enough(best)
            if not better and enough:
                break
            grown: set[Subset] = {
                tuple(sorted((*subset, i))) for subset in ranked for i in self._joining(subset)
            }
            layer = sorted(grown.union(self._pairs() if size == 1 and not enough else []))
        return best

    def _is_enough(self, subset: Subset) -> bool:
        """Return whether noise could explain the residual of a subset, if the noise is known."""
        return self.whole.noise_known and not is_bad(chance(*self.chi2(subset)))

    def explained(self, subset: Subset) -> FloatArray:
        """Return the first-order effect of each candidate on the residual of a subset."""
        # the projection on the subset and the nuisance parameters is removed from the slopes:
        # `(J_c^T r)^2 / (J_c^T J_c)` with r and J_c free of them
        if self.fit(subset) is None:
            return np.zeros(self.count)
        fixed = [*subset, *self.nuisance]
        try:
            point = self._end_of(self.whole, fixed, subset)
            r = self.whole.values(point)
            if not point.turned:
                J = self.whole.slopes(point)
                if not subset:
                    self.linear = _alone(J[:, : self.count], J[:, fixed], r)
                return _explained(J[:, : self.count], J[:, fixed], r)
            # slopes of repeated modes depend on the candidate, so that each is treated separately
            return np.array([self._alone(b, subset, r) for b in range(self.count)])
        except ModelError:
            return np.zeros(self.count)

    def _alone(self, candidate: int, subset: Subset, r: FloatArray) -> float:
        if candidate in subset:
            return 0.0
        fixed = [*subset, *self.nuisance]
        alone = self._objective([candidate, *fixed])
        J = alone.slopes(self._end_of(alone, range(1, len(fixed) + 1), subset))
        return float(_explained(J[:, :1], J[:, 1:], r)[0])

    def _end_of(self, objective: Objective, rows: Sequence[int], subset: Subset) -> Point:
        """Return the end of the fit of a subset as a point of `objective`."""
        # the fitted parameters are the `rows` of those of the objective, the others are zero
        end, p = self.ends[subset], np.zeros(len(objective.parameters))
        p[list(rows)] = end.p[: len(rows)]
        return objective.place(Point(objective.family, p, end.eigen, end.labels))

    def _joining(self, subset: Subset) -> list[int]:
        """Return the candidates that explain most in addition to a subset, if this may pay off."""
        explained = self.explained(subset)
        explained[list(subset)] = -1.0
        order = np.argsort(-explained, kind="stable")[:JOIN]
        return [int(i) for i in order if explained[i] > self._least(subset) / REACH]

    def _least(self, subset: Subset) -> float:
        """Return the effect that lowers the BIC of a subset with a candidate, 0 if unknown."""
        c, k = self.count, len(subset)
        price = log(self.rows) + 2 * log(comb(c, min(k + 1, c)) / comb(c, k))
        if not self.whole.noise_known:
            return self._error(subset) * -expm1(-price / self.rows)
        return price if self.whole.noisy and self._is_enough(subset) else 0.0

    def _exchanged(self, subset: Subset) -> Subset:
        """Return the best subset that differs from this one in one member at a time."""
        if len(subset) < 2:
            return subset
        for _ in range(MOST_STEPS):
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
        point = self._end_of(self.whole, self.nuisance, ())
        if point.turned:
            return []
        J, r = self.whole.slopes(point), self.whole.values(point)
        J, r = _without(J[:, : self.count], J[:, self.nuisance], r)
        length = np.linalg.norm(J, axis=0)
        J = J / np.where(length > NULL * length.max(initial=0.0), length, np.inf)
        a, overlap = J.T @ r, J.T @ J
        room = 1 - overlap**2
        both = a[:, None] ** 2 + a[None] ** 2 - 2 * overlap * np.outer(a, a)
        # parallel columns count as one parameter: the second adds nothing
        gain = np.where(room > 1e-6, both / np.maximum(room, 1e-6), 0.0)
        i, j = np.triu_indices(self.count, 1)
        order = np.argsort(-gain[i, j], kind="stable")[: 2 * JOIN]
        return [(int(i[n]), int(j[n])) for n in order]

    def few(self, picked: list[int]) -> Objective:
        """Return the objective of some parameters, in few coordinates where these suffice."""
        return self._objective(picked, self._coordinates(picked))

    def _objective(self, picked: list[int], B: FloatArray | None = None) -> Objective:
        """Return the objective of some parameters, in the coordinates B where they are given."""
        family = self.whole.family.of(picked)
        family = family if B is None else family.confined(B)
        parameters = [self.whole.parameters[i] for i in picked]
        return Objective(family.model, parameters, self.residuals, prior=False, family=family)

    def _coordinates(self, picked: list[int]) -> FloatArray | None:
        """Return few coordinates in which some parameters are fitted, None for all of them."""
        if not self.confines:
            return None
        found = []
        for i in picked:
            if i not in self.loads:
                self.loads[i] = load_vectors(self.whole.family, i)
            loads = self.loads[i]
            if loads is None:
                return None
            found.append(loads)
        return coordinates(self.whole.family, np.hstack(found), self.top)

    def _fitted(self, subset: Subset) -> SubsetFit:
        picked = [*subset, *self.nuisance]
        exact = self._objective(picked)
        B = self._coordinates(picked)
        if B is not None:
            few = self._objective(picked, B)
            found = self._searched(few, subset)
            made = few.at(found.p)
            point = lifted_point(exact.family, B, made, exact.numbers)
            r = exact.values(point)
            off = float(np.sum((r - few.values(made)) ** 2))
            close = off <= max(CLOSE**2 * float(r @ r), TYPED**2 * self.error_without)
            left = self._left(exact, found.p, point, subset)
            # an impossible model fits better than a possible one: of interest only if it is the
            # best
            if close and (left.score > self.least or is_physical(exact.family, found.p)):
                self.ends[subset] = point
                return left
        found = self._searched(exact, subset)
        self.ends[subset] = point = exact.at(found.p)
        return self._left(exact, found.p, point, subset)

    def _searched(self, objective: Objective, subset: Subset) -> SearchEnd:
        """Return the end of the search for a subset's values."""
        picked = [*subset, *self.nuisance]
        first, guess = self.start[picked], self._guess(subset)
        method = TrustRegion()
        if guess is not None:
            try:
                # modes keep the numbers of the start, and are followed on the way
                objective.origin = self._followed(objective, first, guess)
                found = method.search(objective, guess, most=50, tolerance=FOUR_DIGITS)
            except (ModelError, SolverError, np.linalg.LinAlgError):
                found = None
            if found is not None and found.trail.error[-1] < self._error(()):
                return found
            objective.origin = None
        return method.search(objective, first, most=50, tolerance=FOUR_DIGITS)

    def _followed(self, objective: Objective, first: FloatArray, guess: FloatArray) -> Point:
        """Return the point from which modes are followed to a guess: the start, or one near it."""
        with suppress(ModelError):
            begin = objective.begin(first)
            X, Y = (
                objective.family.weighted(point.eigen.X)[:, point.columns(objective.numbers)]
                for point in (begin, objective.at(guess))
            )
            if np.all(np.diag(mac_matrix(X, Y)) >= ALIKE):
                return begin
        return objective.follow([first + part * (guess - first) for part in WAY])

    def _guess(self, subset: Subset) -> FloatArray | None:
        """Return values near the fit of a subset: of the best part of it, or to first order."""
        if subset in self.guesses:
            return self.guesses[subset]
        # from zero a trust region would grow by a factor of two per step to the start of one of
        # these
        parts = [tuple(k for k in subset if k != out) for out in subset]
        parts = [part for part in parts if part and self.done.get(part) is not None]
        if parts:
            best = min(parts, key=self._error)
            fit = self.done[best]
            assert fit is not None  # noqa: S101 - just selected
            own = dict(zip([*best, *self.nuisance], fit.p.tolist(), strict=True))
            return np.array([own.get(k, 0.0) for k in [*subset, *self.nuisance]])
        if len(subset) != 1 or self.linear is None:
            return None
        return np.array([self.linear[subset[0]], *self.start[self.nuisance]])

    def _error(self, subset: Subset) -> float:
        found = self.done.get(subset)
        return np.inf if found is None else found.error


def _without(J: FloatArray, nuisance: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return J and r without their projection on the columns `nuisance`."""
    Q = np.linalg.qr(nuisance)[0]
    return J - Q @ (Q.T @ J), r - Q @ (Q.T @ r)


def _alone(J: FloatArray, nuisance: FloatArray, r: FloatArray) -> FloatArray:
    """Return the first-order value of each single parameter in addition to others."""
    J, r = _without(J, nuisance, r)
    length = np.sum(J**2, axis=0)
    return np.asarray(-(J.T @ r) / np.where(length > 0, length, np.inf))


def _explained(J: FloatArray, nuisance: FloatArray, r: FloatArray) -> FloatArray:
    whole = np.sum(J**2, axis=0)
    J, r = _without(J, nuisance, r)
    length = np.sum(J**2, axis=0)
    # a candidate that depends on nuisance parameters explains nothing
    own = length > NULL * whole
    return np.asarray((J.T @ r) ** 2 / np.where(own, length, np.inf))


#: relative distance above the highest compared frequency up to which modes are coordinates
BEYOND = 1.5
#: number of frequencies at which the other modes follow a load, and fraction of coordinates that
#: saves time
SHIFTS, WORTHWHILE = 3, 0.7


def load_vectors(family: Family, parameter: int) -> FloatArray | None:
    """Return the forces (k, r) by which a parameter couples the modes; None if they are many."""
    # `dM = sum_i s_i b_i b_i^T`, and so dD and dK. A diagonal matrix couples none
    found: list[FloatArray] = []
    for stack in family.terms:
        for j in np.flatnonzero(np.array(family.owner) == parameter).tolist():
            across = np.abs(stack[j] - np.diag(np.diag(stack[j]))).max(initial=0.0)
            if across > NULL * np.abs(stack[j]).max(initial=0.0):
                own = factors(stack[j])
                if own is None:
                    return None
                found += [b for _, b in own]
    return np.array(found).reshape(-1, family.V.shape[1]).T


def coordinates(family: Family, loads: FloatArray, top: float) -> FloatArray | None:
    """Return B (k, k') of few coordinates for modes up to `top` [rad/s], None if many."""
    # the modes up to 1.5 `top`; and the response of the others to a load b at three frequencies,
    # `b_i/(\omega_i^2 - \sigma)`: eigenvalues have the error of this rational interpolation
    # squared. Columns are orthonormal, and diagonal in K
    squares = np.diag(family.K)
    low = squares <= (BEYOND * top) ** 2
    high = np.flatnonzero(~low)
    coupled, sizes, _ = la.svd(family.D[np.ix_(high, low)], full_matrices=False)
    coupled = coupled[:, sizes > NULL * np.abs(family.D).max(initial=TINY)]
    forces = np.hstack([loads[high], coupled])
    kept = int(low.sum())
    if kept + SHIFTS * forces.shape[1] > WORTHWHILE * squares.size:
        return None
    # Chebyshev points in omega^2
    angle = np.pi * (np.arange(SHIFTS) + 0.5) / SHIFTS
    shifts = top**2 * (1 - np.cos(angle)) / 2
    moved = np.hstack([forces / (squares[high] - shift)[:, None] for shift in shifts])
    size = np.linalg.norm(moved, axis=0)
    # the shifts give vectors that are nearly equal: smaller differences are rounding
    Z = la.orth(moved / divisor(size), rcond=1e-10)
    turn = la.eigh((Z.T * squares[high]) @ Z)[1]
    B = np.zeros((squares.size, kept + Z.shape[1]))
    B[np.flatnonzero(low), np.arange(kept)] = 1.0
    B[high, kept:] = Z @ turn
    return B


def is_physical(family: Family, p: FloatArray) -> bool:
    """Return whether M is positive definite and K positive semi-definite, in all coordinates."""
    # a negative mass that few coordinates allow may exceed the mass at its place
    M, _, K = family.matrices(p)
    elastic = np.sort(np.diag(family.K))[family.n_rigid]
    try:
        la.cholesky(M)
    except la.LinAlgError:
        return False
    softest = 0.0 if K is family.K else float(la.eigvalsh(K, subset_by_index=(0, 0))[0])
    return softest > -NEGLIGIBLE * float(elastic)


def lifted_point(family: Family, B: FloatArray, point: Point, numbers: Sequence[int]) -> Point:
    """Return a point of few coordinates in all coordinates of `family`, to second order."""
    # the missing part, `\rho = P(\lambda) B x`, moves the shape by `-P_0(\lambda)^{-1} \rho` and
    # the eigenvalue by `\rho^T P_0^{-1} \rho/(x^T (2 \lambda M + D) x)`, P_0 the pencil's diagonal
    M, D, K = family.matrices(point.p)
    X, poles = B @ point.eigen.X, point.eigen.poles.copy()
    followed = np.array(point.columns(numbers))
    own, lam = X[:, followed], poles[followed]
    left = (M @ own) * lam**2 + (D @ own) * lam + K @ own
    # kept coordinates have only rounding errors
    beyond = np.flatnonzero(~np.any(B == 1.0, axis=1))
    inside = B[beyond]
    left = left[beyond] - inside @ (inside.T @ left[beyond])
    m, d, k = (np.diag(part)[beyond, None] for part in (M, D, K))
    answer = left / (m * lam**2 + d * lam + k)
    answer = answer - inside @ (inside.T @ answer)
    scale = np.sum(own * (2 * lam * (M @ own) + D @ own), axis=0)
    poles[followed] = lam + np.sum(left * answer, axis=0) / scale
    X[np.ix_(beyond, followed)] -= answer
    eigen = Eigen(poles, X, X.conj(), M, D, point.eigen.n_rigid, K)
    return Point(family, point.p, eigen, point.labels)
