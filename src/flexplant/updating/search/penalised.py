"""Penalties on the change: its square, weighted by the L-curve, or sparse, subsets by BIC."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...arrays import FloatArray, positive
from ...errors import ModelError, SolverError
from ...store import checked
from ...tolerances import ROUNDING, TINY
from .least_squares import TrustRegion
from .objective import Objective, PriorRows, SearchEnd, Trail, UpdateMethod, unit_changes

#: weights tried for an L-curve, or on a path of sparse changes
PATH = 13
#: convex problems for each weight of the path
PATH_STEPS = 5
#: a change of less than so many units is the solver's rounding
NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class PenalisedMethod(UpdateMethod):
    """A method with a penalty of some weight; None: the weight is chosen from the data."""

    weight: float | None = field(default=None, kw_only=True, metadata=checked(positive))

    @property
    def penalised(self) -> bool:
        """Whether the answer is drawn towards the start."""
        return True


@dataclass(frozen=True, eq=False)
class Tikhonov(PenalisedMethod):
    """Trust region with a penalty ``weight^2 |(p - start) / unit|^2``.

    The unit of each parameter is its prior standard deviation, half the width of finite bounds, or
    the change that moves the residuals by one.

    Parameters
    ----------
    weight : float, optional
        None: the corner of the L-curve, where the curve of penalty over misfit (both
        logarithmic) turns most.

    References
    ----------
    [Hansen1992]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[615.0j], modes=[2]))
    >>> ends = [fx.AddedMass("1:x"), fx.AddedMass("3:x")]  # alike: the smallest change has both
    >>> fx.update(drawing, ends, [poles], method=fx.updating.Tikhonov(weight=1e-3)).values.round(3)
    array([0.058, 0.058])
    """

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where the search from `start` ends; see `UpdateMethod.search`."""
        J = objective.slopes(objective.begin(start), prior=False)
        unit = unit_changes(objective, J)

        def solved(size: float, begin: FloatArray) -> SearchEnd:
            objective.drawn.append(PriorRows(start, np.diag(size / unit)))
            try:
                return TrustRegion().search(objective, begin, most=most, tolerance=tolerance)
            finally:
                objective.drawn.pop()

        if self.weight is not None:
            return solved(self.weight, start)
        largest = float(np.linalg.norm(J * unit, 2))
        curve, found, begin = [], [], start
        # from all to next to nothing of the prior
        for size in np.geomspace(largest, 1e-6 * largest, PATH).tolist():
            one = solved(size, begin)
            begin = one.p
            change = float(np.linalg.norm((one.p - start) / unit))
            curve.append((np.log(max(one.trail.error[-1], TINY)) / 2, np.log(max(change, TINY))))
            found.append(one)
        return found[_sharpest_bend(np.array(curve))]


def _sharpest_bend(curve: FloatArray) -> int:
    """Return the point of an L-curve (m, 2) with the largest curvature, of three points each."""
    before, after = np.diff(curve, axis=0)[:-1], np.diff(curve, axis=0)[1:]
    area = before[:, 1] * after[:, 0] - before[:, 0] * after[:, 1]
    sides = np.prod(
        [np.linalg.norm(one, axis=1) for one in (before, after, before + after)], axis=0
    )
    turn = np.where(sides > 0, 2 * area / np.where(sides > 0, sides, 1.0), -np.inf)
    return int(np.argmax(turn)) + 1 if np.any(sides > 0) else len(curve) // 2


@dataclass(frozen=True, eq=False)
class Lasso(PenalisedMethod):
    """Sparse change: penalty ``weight |(p - start) / unit|_1`` on a sequence of linear problems.

    Most parameters end at exactly their start: those are the ones without a change. The convex
    problems go to Clarabel through cvxpy.

    Parameters
    ----------
    weight : float, optional
        None: of a path of weights the one with the least BIC (Bayesian information criterion), its
        parameters fitted once more without the penalty.

    References
    ----------
    [Tibshirani1996]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.5], stiffnesses=[4e5, 4e5])
    >>> heavier = fx.chain(masses=[1.0, 1.0, 1.7], stiffnesses=[4e5, 4e5])
    >>> measured = fx.MeasuredModes(poles=fx.solve_modes(heavier, count=3).poles[1:], modes=[2, 3])
    >>> masses = [fx.AddedMass(f"{i}:x") for i in (1, 2, 3)]
    >>> method = fx.updating.Lasso(weight=1e-4)
    >>> fx.update(drawing, masses, [fx.Eigenvalues(measured)], method=method).values.round(2)
    array([0. , 0. , 0.2])
    """

    @property
    def least_squares(self) -> bool:
        """Whether the answer is fitted once more without the penalty."""
        return self.weight is None

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where the search from `start` ends; see `UpdateMethod.search`."""
        steps = most or self.steps
        J = objective.slopes(objective.begin(start), prior=False)
        r = objective.values(objective.at(start), prior=False)
        unit = unit_changes(objective, J)
        if self.weight is not None:
            return _sparse(objective, start, unit, self.weight, steps, tolerance)
        best: tuple[float, tuple[int, ...], SearchEnd] | None = None
        tried: set[tuple[int, ...]] = set()

        def judged(key: tuple[int, ...], begin: FloatArray) -> None:
            nonlocal best
            if key in tried or not key or len(key) >= r.size:
                return
            tried.add(key)
            found = _refitted(objective, start, begin, key, steps, tolerance)
            score = bic(found.trail.error[-1], r.size, len(key), objective.noisy)
            if best is None or score < best[0]:
                best = (score, key, found)

        largest = float(np.abs((J * unit).T @ r).max())
        # from one change to all
        for size in np.geomspace(0.9 * largest, 1e-3 * largest, PATH).tolist():
            # the path only has to say which parameters change; these are fitted anew
            found = _sparse(objective, start, unit, size, PATH_STEPS, 1e-4)
            change = np.abs((found.p - start) / unit)
            # zeros of the l1 problem, as accurate as its solver is
            judged(tuple(np.flatnonzero(change > 1e-6 * change.max()).tolist()), found.p)
        if best is None:
            raise SolverError(
                "no weight of the l1 penalty leaves a sparse change: nothing differs."
            )
        # a path that entered by a wrong parameter keeps it: drop what the criterion can spare
        before: tuple[int, ...] = ()
        while best[1] != before and len(best[1]) > 1:
            before = best[1]
            for out in before:
                judged(tuple(i for i in before if i != out), best[2].p)
        return best[2]


def bic(error: float, rows: int, count: int, noisy: bool) -> float:
    """Return ``chi^2 + k ln n``, or ``n ln(e/n) + k ln n`` where the noise is not known."""
    misfit = error if noisy else rows * float(np.log(max(error, TINY) / rows))
    return misfit + count * float(np.log(rows))


def _refitted(
    objective: Objective,
    start: FloatArray,
    begin: FloatArray,
    places: tuple[int, ...],
    most: int,
    tolerance: float,
) -> SearchEnd:
    """Minimise over some parameters, the others held at the start."""
    lower, upper = objective.lower, objective.upper
    active = np.isin(np.arange(start.size), places)
    # bounds must differ: nine digits are held
    held = 1e-9 * np.maximum(np.abs(start), 1e-9)
    try:
        objective.lower = np.where(active, lower, start - held)
        objective.upper = np.where(active, upper, start + held)
        p = np.where(active, begin, start)
        found = TrustRegion().search(objective, p, most=most, tolerance=tolerance)
    finally:
        objective.lower, objective.upper = lower, upper
    found.p = np.where(active, found.p, start)
    objective.at(found.p, refer=True)
    return found


def _sparse(
    objective: Objective,
    start: FloatArray,
    unit: FloatArray,
    weight: float,
    most: int,
    tolerance: float,
) -> SearchEnd:
    """Solve a sequence of convex problems, each linear in the residuals, steps halved."""
    import cvxpy

    cp: Any = cvxpy

    def total(r: FloatArray, p: FloatArray) -> float:
        return float(r @ r) / 2 + weight * float(np.abs((p - start) / unit).sum())

    trail = Trail()
    p, point = start, objective.begin(start)
    trail.add(objective, start, 0.0)
    r = objective.values(point)
    for _ in range(most):
        J = objective.slopes(point) * unit
        x = cp.Variable(p.size)
        now = (p - start) / unit
        limits = [
            sign * x[finite] <= sign * (edge - start)[finite] / unit[finite]
            for sign, edge in ((1.0, objective.upper), (-1.0, objective.lower))
            if (finite := np.flatnonzero(np.isfinite(edge))).size
        ]
        loss = cp.sum_squares(r + J @ (x - now)) / 2 + weight * cp.norm1(x)
        problem = cp.Problem(cp.Minimize(loss), limits)
        problem.solve(solver=cp.CLARABEL)
        if x.value is None:
            raise SolverError(f"the l1 problem was not solved: {problem.status}.")
        # zeros of the l1 problem, as accurate as its solver is
        aim = np.where(np.abs(x.value) > max(1e-7 * np.abs(x.value).max(), NOTHING), x.value, 0.0)
        step, fraction = (aim - now) * unit, 1.0
        for _ in range(20):
            try:
                trial = objective.at(p + fraction * step)
                if total(objective.values(trial), trial.p) <= total(r, p) * (1 + ROUNDING):
                    break
            except ModelError:
                pass
            fraction /= 2
        else:
            return SearchEnd(p, total(r, p), trail, True, "no part of a step helps")
        p = start + aim * unit if fraction == 1.0 else p + fraction * step
        point = objective.at(p, refer=True)
        r = objective.values(point)
        trail.add(objective, p, fraction)
        # the accuracy of its convex solver
        if np.abs(step / unit).max() < max(tolerance, 1e-6) * max(1.0, float(np.abs(aim).max())):
            return SearchEnd(p, total(r, p), trail, True, "step below the tolerance")
    return SearchEnd(p, total(r, p), trail, False, "max_iterations reached")
