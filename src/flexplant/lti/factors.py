"""Gramians as factors: P = L L' with L to full precision, where P itself loses half the digits."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..values import ComplexArray, FloatArray
from .scaling import state_scale
from .statespace import StateSpace


def controllability_factor(g: StateSpace) -> FloatArray:
    """Return L (n, n) with ``P = L L'``, the controllability Gramian of a stable system."""
    d = state_scale(g.A, g.B, g.C)
    return d[:, None] * _factor(*_continuous(g.A * d / d[:, None], g.B / d[:, None], g.dt))


def observability_factor(g: StateSpace) -> FloatArray:
    """Return L (n, n) with ``Q = L L'``, the observability Gramian of a stable system."""
    d = state_scale(g.A, g.B, g.C)
    scaled = (g.A * d / d[:, None]).T
    return _factor(*_continuous(scaled, (g.C * d).T, g.dt)) / d[:, None]


def compressed(L: FloatArray) -> FloatArray:
    """Return a factor with the same ``L L'`` and no more columns than rows."""
    if L.shape[1] <= L.shape[0]:
        return L
    return np.asarray(la.qr(L.T, mode="r")[0][: L.shape[0]].T)


def _continuous(A: FloatArray, B: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Map ``P = A P A' + B B'`` to a Lyapunov equation with the same P (bilinear map)."""
    if not dt:
        return A, B
    inverse = np.linalg.inv(A + np.eye(A.shape[0]))
    return inverse @ (A - np.eye(A.shape[0])), np.sqrt(2.0) * inverse @ B


def _factor(A: FloatArray, B: FloatArray) -> FloatArray:
    """Solve ``A L L' + L L' A' + B B' = 0`` for L column by column of the Schur form.

    Hammarling's method: P is never formed, so that its small eigenvalues keep their digits.
    With S upper triangular, last row b of B, ``t = |b| / a, a^2 = -2 Re s_nn, v = b* / |b|``:
    column ``u = -(S_1 + conj(s_nn) I)^-1 (s t + a B_1 v)``, then ``B_1 <- B_1 - a u v*``.

    References
    ----------
    [Hammarling1982]_.
    """
    n = A.shape[0]
    if not n:
        return np.zeros((0, 0))
    S, Z = la.schur(A, output="complex")
    if (largest := float(np.max(S.diagonal().real))) >= 0:
        raise SolverError(
            f"the system is not strictly stable (largest real part {largest:.2e}), so its Gramian "
            "is infinite. Take rigid-body and unstable modes out first: split_stable."
        )
    R = np.asarray(Z.conj().T @ B, dtype=np.complex128)
    U: ComplexArray = np.zeros((n, n), dtype=np.complex128)
    diagonal = S.diagonal().copy()
    shifted = S.copy()
    at = np.arange(n)
    for k in range(n - 1, -1, -1):
        size = float(np.linalg.norm(R[k]))
        if not size:
            continue
        a = np.sqrt(-2.0 * diagonal[k].real)
        v = R[k].conj() / size
        U[k, k] = size / a
        if not k:
            break
        shifted[at[:k], at[:k]] = diagonal[:k] + diagonal[k].conj()
        right = -(S[:k, k] * U[k, k] + a * (R[:k] @ v))
        u, _ = la.lapack.ztrtrs(shifted[:k, :k], right)
        U[:k, k] = u
        R[:k] -= a * np.outer(u, v.conj())
    L = Z @ U
    return compressed(np.hstack([L.real, L.imag]))
