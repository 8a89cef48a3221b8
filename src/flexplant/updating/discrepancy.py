"""What a model cannot explain: one variance for each kind of residual, by restricted likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray, Value
from .point_model import Point
from .residuals.residual import Bound, Kind
from .search import Objective, SearchEnd, UpdateMethod

#: degrees of freedom that the usual discrepancy of a kind counts: two measured modes outweigh it,
#: and none measured leaves it
USUAL_DOF = 2.0
#: rounds of weights and parameters, and relative change of the deviations at which they end
_ROUNDS, _SETTLED = 20, 0.01
#: rows that are weighed against each other: matrices of the rows' number are factored
_MOST_ROWS = 1000
#: range of the deviations searched, in units of the usual ones
_LEAST, _MOST = 1e-3, 1e4


@dataclass(frozen=True, eq=False)
class Discrepancy(Value):
    """What a model is off by in one kind of measured values, beside the noise.

    Parameters
    ----------
    kind : str
        ``"frequency"``, ``"damping"``, ``"mode shape"``, ...
    deviation : float
        Standard deviation, as a share of the measured value.
    dof : float
        Degrees of freedom of its estimate: of Student's distribution of a further value.

    Examples
    --------
    >>> Discrepancy("frequency", 0.004, 5.2).deviation
    0.004
    """

    kind: str
    deviation: float
    dof: float


def restricted(
    r: FloatArray, J: FloatArray, noise: FloatArray, kinds: Sequence[Kind]
) -> tuple[list[Discrepancy], FloatArray]:
    """Return the discrepancy of each kind, and the covariance V (m, m) of the residuals with them.

    ``V = N + sum_k s_k^2 F_k F_k^T`` maximises the likelihood of what the parameters leave,
    ``-(ln|V| + ln|J^T V^-1 J| + r^T P r)/2`` with ``P = V^-1 - V^-1 J (J^T V^-1 J)^-1 J^T V^-1``,
    times a scaled inverse chi-square density of each s_k^2 about what is usual.
    [PattersonThompson1971]_; [KennedyOHagan2001]_ (the discrepancy).
    """
    from scipy.optimize import minimize

    names = list(dict.fromkeys(kind.name for kind in kinds))
    usual = np.array([next(k.usual for k in kinds if k.name == name) for name in names])
    parts = [sum(k.F @ k.F.T for k in kinds if k.name == name) for name in names]
    length = np.linalg.norm(J, axis=0)
    Q = la.qr(J[:, length > 0] / length[length > 0], mode="economic")[0]

    def covariance(log: FloatArray) -> FloatArray:
        size = (usual * np.exp(log)) ** 2
        total: FloatArray = noise + sum(s * part for s, part in zip(size, parts, strict=True))
        return total

    def projected(V: FloatArray) -> tuple[FloatArray, float]:
        factor = la.cho_factor(V, lower=True)
        inverse = la.cho_solve(factor, np.eye(len(V)))
        weighed = inverse @ Q
        inner = la.cho_factor(Q.T @ weighed, lower=True)
        both = 2 * sum(np.log(np.diag(f[0])).sum() for f in (factor, inner))
        return inverse - weighed @ la.cho_solve(inner, weighed.T), float(both)

    def cost(log: FloatArray) -> tuple[float, FloatArray]:
        P, both = projected(covariance(log))
        known = USUAL_DOF * (log + 0.5 * np.exp(-2 * log))
        moved = P @ r
        slope = USUAL_DOF * (1 - np.exp(-2 * log))
        for k, (size, part) in enumerate(zip((usual * np.exp(log)) ** 2, parts, strict=True)):
            slope[k] += size * (np.sum(P * part) - moved @ part @ moved)
        return 0.5 * (both + r @ moved) + known.sum(), slope

    limits = [(np.log(_LEAST), np.log(_MOST))] * len(names)
    log = minimize(cost, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=limits).x
    V = covariance(log)
    P = projected(V)[0]
    size = usual * np.exp(log)
    dof = [s**2 * float(np.sum(P * part)) for s, part in zip(size, parts, strict=True)]
    found = [
        Discrepancy(name, float(s), USUAL_DOF + d)
        for name, s, d in zip(names, size, dof, strict=True)
    ]
    return found, V


class _Weighed(Bound):
    """Residuals of another model's accuracy: whitened by noise and discrepancy together."""

    noisy = True

    def __init__(self, bound: Bound, V: FloatArray) -> None:
        self.own, self.numbers, self.name = bound, bound.numbers, bound.name
        self.factor = la.cholesky(V, lower=True)
        self.size = np.abs(self.white(np.eye(len(V)))) @ np.broadcast_to(bound.size, len(V))

    def white(self, rows: FloatArray) -> FloatArray:
        """Return ``L^-1 rows`` with ``V = L L^T``."""
        return np.asarray(la.solve_triangular(self.factor, rows, lower=True))

    def values(self, point: Point) -> FloatArray:
        """Return them whitened."""
        return self.white(self.own.values(point))

    def slopes(self, point: Point) -> FloatArray:
        """Return their derivatives."""
        return self.white(self.own.slopes(point))

    def row_name(self, row: int) -> str:
        """Return what is measured in a row."""
        return self.own.row_name(row)

    def assigned(self, point: Point) -> Point:
        """Return the point as the residual itself numbers it."""
        return self.own.assigned(point)


def weigh_discrepancy(
    objective: Objective,
    method: UpdateMethod,
    end: SearchEnd,
    *,
    most: int | None,
    tolerance: float,
) -> tuple[SearchEnd, tuple[Discrepancy, ...]]:
    """Return the end of a search with the discrepancy as part of the noise, and the discrepancy.

    In turn: the variances at the estimate, the estimate with these variances. The objective then
    weighs by them. None where the kind of a residual has no discrepancy (responses: an error of a
    model is no noise from line to line).
    """
    rows = objective.rows(objective.at(end.p))
    kinds = [bound.kinds() for bound, _ in rows]
    count = rows[-1][1].stop
    if not objective.noise_known or not all(kinds) or count > _MOST_ROWS:
        return end, ()
    own, defect = list(objective.bounds), objective.defect
    noise, spread = np.eye(count), []
    for (bound, at), each in zip(rows, kinds, strict=True):
        if bound.noise is not None:
            dense: Any = bound.noise
            noise[at, at] = dense.toarray() if hasattr(dense, "toarray") else dense
        for kind in each:
            F = np.zeros((count, kind.F.shape[1]))
            F[at] = kind.F
            spread.append(kind._replace(F=F))
    before: FloatArray = np.zeros(0)
    places = [at for _, at in rows]
    found: list[Discrepancy] = []
    for _ in range(_ROUNDS):
        objective.bounds, objective.defect = own, defect
        point = objective.at(end.p)
        r, J = objective.values(point), objective.slopes(point)
        # priors are measured values without a discrepancy
        extra = r.size - count
        widened = [k._replace(F=np.pad(k.F, ((0, extra), (0, 0)))) for k in spread]
        found, V = restricted(r, J, la.block_diag(noise, np.eye(extra)), widened)
        new = [_Weighed(bound, V[at, at]) for bound, at in zip(own, places, strict=True)]
        objective.bounds = list(new)
        objective.noisy = True
        if defect is not None:
            parts = list(zip(new, places, strict=True))
            objective.defect = defect._replace(
                values=np.concatenate([b.white(defect.values[at]) for b, at in parts]),
                slopes=np.vstack([b.white(defect.slopes[at]) for b, at in parts]),
            )
        objective.path = end.trail.p[:-1]
        way = end.trail
        end = method.search(objective, end.p, most=most, tolerance=tolerance)
        end.trail = way.joined(end.trail)
        size = np.array([one.deviation for one in found])
        if before.size and np.all(np.abs(size - before) <= _SETTLED * size):
            break
        before = size
    return end, tuple(found)
