"""How well an update explains the measurement, and how well its parameters are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ...checks import FloatArray
from ...tolerances import TINY, divisor
from ..point_model import Point
from ..search import Objective

#: a chi-square that noise exceeds more rarely than this is no noise
CHANCE = 1e-4
#: residuals that are named
NAMED = 3


def chi_square(objective: Objective, point: Point, free: FloatArray) -> tuple[float | None, int]:
    """Return chi-square (None where the noise is not known) and its degrees of freedom.

    ``min_d |N^-1/2 (r + J d)|^2`` to first order, which for residuals weighted by their own
    covariance is ``|r|^2``: distributed as chi-square with (residuals and priors) - (parameters
    that are free) degrees of freedom, whatever the weights of the fit.
    """
    r = objective.values(point)
    dof = r.size - int(np.sum(free))
    if not objective.noise_known:
        return None, max(dof, 0)
    weighted = [one for one in objective.rows(point) if one[0].noise is not None]
    J = objective.slopes(point)[:, free] if weighted else np.zeros((r.size, 0))
    for bound, rows in weighted:
        r[rows] = _whitened(bound.noise, r[rows])
        J[rows] = _whitened(bound.noise, J[rows])
    total = float(r @ r)
    if J.shape[1]:
        length = np.linalg.norm(J, axis=0)
        Q = la.qr(J / divisor(length), mode="economic")[0]
        total -= float(np.sum((Q.T @ r) ** 2))
    return max(total, 0.0), max(dof, 0)


def _whitened(noise: Any, rows: FloatArray) -> FloatArray:
    """Return ``L^-1 rows`` with ``noise = L L^T``, which is banded where it is sparse."""
    if not sp.issparse(noise):
        return np.asarray(la.solve_triangular(la.cholesky(noise, lower=True), rows, lower=True))
    sparse: Any = noise
    coo = sparse.tocoo()
    apart = coo.row - coo.col
    width = int(apart.max())
    band = np.zeros((width + 1, coo.shape[0]))
    below = apart >= 0
    band[apart[below], coo.col[below]] = coo.data[below]
    return np.asarray(la.solve_banded((width, 0), la.cholesky_banded(band, lower=True), rows))


def chance(chi2: float | None, dof: int) -> float | None:
    """Return the probability that noise leaves a larger chi-square, None when not known."""
    if chi2 is None or dof < 1:
        return None
    from scipy.special import chdtrc

    return float(chdtrc(dof, chi2))


def is_bad(probability: float | None) -> bool:
    """Return whether noise alone hardly explains what is left."""
    return probability is not None and probability < CHANCE


def worst(objective: Objective, point: Point) -> str:
    """Return the residuals that fit worst, in words."""
    r = objective.values(point)
    found: dict[str, float] = {}
    for bound, rows in objective.rows(point):
        part, noise = r[rows], bound.noise
        size = np.abs(part) if noise is None else np.abs(part) / np.sqrt(noise.diagonal())
        for row in np.argsort(-size, kind="stable")[: 2 * NAMED].tolist():
            name = bound.row_name(row)
            found[name] = max(found.get(name, 0.0), float(size[row]))
    order = sorted(found, key=lambda name: -found[name])[:NAMED]
    return ", ".join(f"{name} ({found[name]:.3g} standard deviations)" for name in order)


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
    safe = divisor(length)
    U, s, Vt = np.linalg.svd(J / safe, full_matrices=False)
    inverse = np.where(s > SINGULAR * s[0], 1 / np.maximum(s, TINY), 0.0)
    half = (Vt.T * inverse) / safe[:, None]
    unit = half @ half.T
    spare = r.size - q
    found: FloatArray | None = None
    if objective.noise_known:
        found = unit = half @ _noise_in(objective, point, U) @ half.T
    elif spare > 0:
        found = unit * float(r @ r) / spare
    std = np.sqrt(np.diag(unit))
    size = divisor(std)
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
