"""Elastic modes of a dense undamped structure, its rigid-body motions taken out first."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..values import FloatArray
from .factor import dense, unit_diagonal

#: eigenvalues below this part of the largest one are rounding
_ROUNDING = 1e-13


def elastic_modes(
    M: FloatArray, K: FloatArray, rigid: FloatArray, count: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the elastic frequencies (k,) [rad/s] and M-orthonormal shapes (n, k), ascending.

    ``K phi = omega^2 M phi`` is solved in the M-orthogonal complement of the M-orthonormal
    rigid-body motions (n, r), so that these mix with no elastic mode.

    Raises
    ------
    ModelError
        When M is not positive definite or an elastic mode has no stiffness.
    """
    n, r = rigid.shape
    kept = n - r if count is None else min(count, n - r)
    scaled, scale = unit_diagonal(M)
    try:
        lower = la.cholesky(dense(scaled), lower=True)
    except la.LinAlgError as error:
        raise ModelError(
            "M is not positive definite: some motion would have no inertia, or a negative one."
        ) from error
    if kept <= 0:
        return np.zeros(0), np.zeros((n, 0))
    # q = reach^T y turns M into the identity
    reach = la.solve_triangular(lower, np.diag(scale), lower=True)
    stiffness = reach @ K @ reach.T
    largest = float(np.abs(stiffness).max())
    elastic: FloatArray = np.eye(n)
    if r:
        elastic = np.asarray(la.qr(lower.T @ (rigid / scale[:, None]))[0][:, r:], dtype=np.float64)
        stiffness = elastic.T @ stiffness @ elastic
    # the lowest few alone are faster; divide and conquer gives all of them
    few = kept <= (n - r) // 4
    squares, vectors = la.eigh(
        0.5 * (stiffness + stiffness.T),
        subset_by_index=(0, kept - 1) if few else None,
        driver="evr" if few else "evd",
    )
    squares, vectors = squares[:kept], vectors[:, :kept]
    check_stiffness(squares, _ROUNDING * largest, r)
    return np.sqrt(squares), signed(reach.T @ (elastic @ vectors))


def check_stiffness(squares: FloatArray, rounding: float, n_rigid: int) -> None:
    """Raise ModelError when the lowest elastic omega^2 is not above rounding."""
    if squares[0] <= rounding:
        raise ModelError(
            f"an elastic mode has no stiffness (omega^2 = {squares[0]:.3g} 1/s^2, rounding is "
            f"about {rounding:.1g}): K is indefinite, or has a zero-energy motion beyond the "
            f"{n_rigid} rigid-body motions of the geometry, or springs too soft for the digits of "
            "K. Look for a sign, a mechanism or wrong coordinates (check(model) tells); suspend "
            "the modes rather than the model on soft springs."
        )


def signed(phi: FloatArray) -> FloatArray:
    """Return shapes with the first of their largest entries positive: repeatable signs."""
    size = np.abs(phi)
    first = np.argmax(size >= (1 - 1e-6) * size.max(axis=0), axis=0)
    return np.asarray(phi * np.where(phi[first, np.arange(phi.shape[1])] < 0, -1.0, 1.0))
