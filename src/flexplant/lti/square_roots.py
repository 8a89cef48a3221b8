"""Stein and Riccati equations of a filter in square roots ``P = L L'``: twice the digits of P.

Little noise beside much motion leaves P with directions that are 1e-16 of others, below the
rounding of P itself, and yet the gain hangs on them. QR factors of its root keep them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray
from ..errors import ModelError, SolverError
from ..tolerances import divisor
from .equations import DOUBLINGS, scale_of, symmetrised
from .riccati import RiccatiSolution, solve_dare

#: relative, of a standard deviation: the terms that follow add the square of this to a variance,
#: Newton's next step would square it; and where the gain's own rounding lets no step go below,
#: the most that is accepted: of
#: 12 such filters at 3e-4, of states that the POIs hardly show, 8 were within 1e-6 of the optimum
_LAST, _SETTLED, _STALLED = 1e-9, 1e-9, 3e-4
#: steps in a row that do not halve the least change: some come before the quadratic ones
_STALLS = 6
#: Newton's steps: from a start with 1e8 times the noise it took 20, the last four of them
#: quadratic
STEPS = 60
#: powers of ten by which sensors have more noise, beside their motion in a sample and own noise:
#: from rounding to a million times as much
DECADES = (-16, 7)


class RiccatiRoot(NamedTuple):
    """The stationary filter of ``x+ = A x + G e, y = C x + H e``, e of unit variance.

    The predictor gain is K, ``L L'`` the covariance of x before its measurement and ``X X'`` that
    of the innovation, X lower triangular; `change` is that of a standard deviation in the last
    step.
    """

    L: FloatArray
    K: FloatArray
    X: FloatArray
    change: float
    steps: int

    def weighed(self, part: FloatArray) -> FloatArray:
        """Return ``part (X X')^-1``."""
        return np.asarray(la.cho_solve((self.X, True), part.T).T)


def square_root(X: FloatArray) -> FloatArray:
    """Return L with ``L L' = X``, which is positive semidefinite apart from rounding.

    By its eigenvectors, each row scaled to unit size before.
    """
    size = divisor(np.sqrt(np.maximum(X.diagonal(), 0.0)))
    values, vectors = np.linalg.eigh(symmetrised(X) / size / size[:, None])
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def compressed(M: FloatArray) -> FloatArray:
    """Return a lower triangular T with ``T T' = M M'``: exact for each row, whatever its size."""
    return np.asarray(la.qr(M.T, mode="r")[0][: M.shape[0]].T)


@np.errstate(over="ignore", invalid="ignore")
def stein_root(F: FloatArray, G: FloatArray) -> FloatArray:
    """Return L with ``L L'`` the sum of ``F^k G G' F'^k``, k = 0, 1, ..., by doubling."""
    L = G
    for _ in range(DOUBLINGS):
        more = F @ L
        L = compressed(np.hstack([L, more]))
        if not np.isfinite(L).all():
            break
        if np.all(np.linalg.norm(more, axis=1) <= _LAST * np.linalg.norm(L, axis=1)):
            return L
        F = F @ F
    raise SolverError("the sum of squares does not end: the filter is not strictly stable.")


def dual_variances(F: FloatArray, G: FloatArray, rows: FloatArray, size: FloatArray) -> FloatArray:
    """Return the variances of ``c x`` for rows c, ``x+ = F x + G e``, as sums of ``(c F^k G)^2``.

    `size` (n,) are standard deviations of the states: their units.
    """
    size = divisor(size)
    F, G = F * size / size[:, None], G / size[:, None]
    return np.array([float(np.sum((stein_root(F.T, c[:, None]).T @ G) ** 2)) for c in rows * size])


def difference_of(claim: FloatArray, truth: FloatArray) -> float:
    """Return the largest relative difference of variances; without end where one is negative."""
    if not np.all(claim >= 0) or not np.all(truth >= 0):
        return np.inf
    return float(np.max(np.abs(claim - truth) / divisor(truth), initial=0.0))


def _measured(
    A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray, L: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gain K of a covariance L L', and X with ``X X' = C L L' C' + H H'``."""
    p = C.shape[0]
    T = compressed(np.vstack([np.hstack([H, C @ L]), np.hstack([G, A @ L])]))
    X, Y = T[:p, :p], T[p:, :p]
    return np.asarray(la.solve_triangular(X, Y.T, lower=True, trans="T").T), X


def riccati_root(A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray) -> RiccatiRoot:
    """Return the stationary filter, by Newton's steps from that of noisier sensors."""
    start = _noisier(A, C, G, H)
    d = scale_of(np.abs(start.P.diagonal()))
    found = _newton(A * d / d[:, None], C * d, G / d[:, None], H, start.gain / d[:, None])
    return found._replace(L=found.L * d[:, None], K=found.K * d[:, None])


def _noisier(A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray) -> RiccatiSolution:
    """Return the filter for the least noise that sensors have besides, in decades, with one."""
    why: Exception | None = None
    R, moved = H @ H.T, C @ G
    reach = np.diag(R) + np.sum(moved**2, axis=1)
    for factor in 10.0 ** (2 * np.arange(*DECADES)):
        try:
            return solve_dare(A, C, Q=G @ G.T, R=R + factor * np.diag(reach), S=G @ H.T)
        except (SolverError, ModelError, np.linalg.LinAlgError) as error:  # R may be singular
            why = error
    raise SolverError(f"with much noisier sensors no filter was found either: {why}")


def _newton(
    A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray, K: FloatArray
) -> RiccatiRoot:
    """Improve a stable gain: the error that it has, then the gain best for it [Hewer1971]_."""
    last, least, stalls = np.zeros(A.shape[0]), np.inf, 0
    for taken in range(1, STEPS + 1):
        closed = A - K @ C
        if np.max(np.abs(la.eigvals(closed)), initial=0.0) >= 1.0:
            raise SolverError("no strictly stable filter was found in square roots either.")
        L = stein_root(closed, G - K @ H)
        size = np.linalg.norm(L, axis=1)
        change = float(np.max(np.abs(size - last) / np.where(size > 0, size, 1.0), initial=0.0))
        K, X = _measured(A, C, G, H, L)
        stalls = stalls + 1 if change >= 0.5 * least else 0
        if change <= (_STALLED if stalls >= _STALLS else _SETTLED):
            return RiccatiRoot(L, K, X, change, taken)
        last, least = size, min(least, change)
    raise SolverError(
        f"the filter is not settled in {STEPS} steps of Newton in square roots: a standard "
        f"deviation still changes by {change:.1e} of it."
    )
