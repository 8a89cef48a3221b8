"""A family of models in few coordinates: modes that are compared, and what changes them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la

from ..values import FloatArray
from .family import Eigen, Family
from .low_rank import ROUNDING, factors
from .point_model import Point

#: modes up to this part above the highest frequency that is compared are coordinates themselves
BEYOND = 1.5
#: frequencies at which the others follow a load, and part of all coordinates that pay
SHIFTS, WORTHWHILE = 3, 0.7
#: part of the softest mode's stiffness by which rounding may leave K negative
NEARLY = 1e-3


def load_vectors(family: Family, parameter: int) -> FloatArray | None:
    """Return the forces (k, r) by which a parameter couples the modes; None if it does by many.

    ``dM = sum_i s_i b_i b_i^T``, and so dD and dK. A diagonal matrix couples none.
    """
    found: list[FloatArray] = []
    for stack in family.terms:
        for j in np.flatnonzero(np.array(family.owner) == parameter).tolist():
            across = np.abs(stack[j] - np.diag(np.diag(stack[j]))).max(initial=0.0)
            if across > ROUNDING * np.abs(stack[j]).max(initial=0.0):
                own = factors(stack[j])
                if own is None:
                    return None
                found += [b for _, b in own]
    return np.array(found).reshape(-1, family.V.shape[1]).T


def coordinates(family: Family, loads: FloatArray, top: float) -> FloatArray | None:
    r"""Return B (k, k') of few coordinates for modes up to `top` [rad/s], None if not worth it.

    The modes up to 1.5 `top`; and of those beyond, what a load b moves of them at three
    frequencies, :math:`b_i/(\omega_i^2 - \sigma)`. That is rational interpolation over the band
    of how they follow it; eigenvalues have its error squared. Columns are orthonormal, and
    diagonal in K.
    """
    squares = np.diag(family.K)
    low = squares <= (BEYOND * top) ** 2
    high = np.flatnonzero(~low)
    coupled, sizes, _ = la.svd(family.D[np.ix_(high, low)], full_matrices=False)
    coupled = coupled[:, sizes > ROUNDING * np.abs(family.D).max(initial=1e-300)]
    forces = np.hstack([loads[high], coupled])
    kept = int(low.sum())
    if kept + SHIFTS * forces.shape[1] > WORTHWHILE * squares.size:
        return None
    # Chebyshev points in omega^2
    angle = np.pi * (np.arange(SHIFTS) + 0.5) / SHIFTS
    shifts = top**2 * (1 - np.cos(angle)) / 2
    moved = np.hstack([forces / (squares[high] - shift)[:, None] for shift in shifts])
    size = np.linalg.norm(moved, axis=0)
    Z = la.orth(moved / np.where(size > 0, size, 1.0), rcond=1e-10)
    turn = la.eigh((Z.T * squares[high]) @ Z)[1]
    B = np.zeros((squares.size, kept + Z.shape[1]))
    B[np.flatnonzero(low), np.arange(kept)] = 1.0
    B[high, kept:] = Z @ turn
    return B


def is_physical(family: Family, p: FloatArray) -> bool:
    """Return whether M is positive definite and K indefinite nowhere, in all coordinates.

    A negative mass that few coordinates allow may be more than there is at its place.
    """
    M, _, K = family.matrices(p)
    elastic = np.sort(np.diag(family.K))[family.n_rigid]
    try:
        la.cholesky(M)
    except la.LinAlgError:
        return False
    softest = 0.0 if K is family.K else float(la.eigvalsh(K, subset_by_index=(0, 0))[0])
    return softest > -NEARLY * float(elastic)


def lifted(family: Family, B: FloatArray, point: Point, numbers: Sequence[int]) -> Point:
    r"""Return a point of few coordinates in all those of `family`, corrected to second order.

    What the coordinates miss, :math:`\rho = P(\lambda) B x`, moves the shape by
    :math:`-P_0(\lambda)^{-1} \rho` and the eigenvalue by
    :math:`\rho^T P_0^{-1} \rho/(x^T (2 \lambda M + D) x)`, P_0 the pencil's diagonal.
    """
    M, D, K = family.matrices(point.p)
    X, poles = B @ point.eigen.X, point.eigen.poles.copy()
    followed = np.array(point.columns(numbers))
    own, lam = X[:, followed], poles[followed]
    left = (M @ own) * lam**2 + (D @ own) * lam + K @ own
    # coordinates that are kept miss nothing but rounding
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
