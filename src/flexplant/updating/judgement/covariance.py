"""The covariance of the parameters of an update."""

from __future__ import annotations

import numpy as np

from ...values import FloatArray
from ..point_model import Point
from ..search import Objective

#: singular values of the scaled sensitivities below this part of the largest count as zero
SINGULAR = 1e-9


def covariance(objective: Objective, point: Point) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation of the estimate, to first order.

    ``G N G^T`` with ``G = (J^T J)^-1 J^T`` and N the covariance of the weighted residuals where it
    is known, else ``s^2 (J^T J)^-1`` with the variance s^2 of the residuals.
    """
    J, r = objective.slopes(point), objective.values(point)
    q = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    safe = np.where(length > 0, length, 1.0)
    U, s, Vt = np.linalg.svd(J / safe, full_matrices=False)
    inverse = np.where(s > SINGULAR * s[0], 1 / np.maximum(s, 1e-300), 0.0)
    half = (Vt.T * inverse) / safe[:, None]
    unit = half @ half.T
    spare = r.size - q
    found: FloatArray | None = None
    if objective.noise_known:
        found = unit = half @ _noise_in(objective, point, U) @ half.T
    elif spare > 0:
        found = unit * float(r @ r) / spare
    std = np.sqrt(np.diag(unit))
    size = np.where(std > 0, std, 1.0)
    correlation = unit / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    regular = s.size == q and bool(s[-1] > SINGULAR * s[0])
    return (found if regular else None), correlation


def _noise_in(objective: Objective, point: Point, U: FloatArray) -> FloatArray:
    """Return ``U^T N U``, N the covariance of the rows (those of priors have unit variance)."""
    total = U.T @ U
    for bound, rows in objective.rows(point):
        if bound.noise is not None:
            total += U[rows].T @ (bound.noise @ U[rows] - U[rows])
    return np.asarray(total, dtype=np.float64)
