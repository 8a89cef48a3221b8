"""Gramians of systems, in full and in factored form, and what they need of Stein equations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor
from ..errors import SolverError
from ..parallel import one_thread
from ..tolerances import MOST_STEPS, SETTLED
from .blocks_of_states import (
    ModalMap,
    bilinear_matrices,
    diagonal_blocks,
    is_block_diagonal,
    turning_parts,
)
from .equations import compressed, solve_lyapunov, solve_stein, state_scale, symmetrised, triangular
from .statespace import StateSpace, System, as_statespace


def controllability_gramian(sys: System) -> FloatArray:
    """Return P (n, n): ``A P + P A' + B B' = 0``, or ``P = A P A' + B B'`` when sampled.

    A closed form gives each block of P if A is block diagonal with 1 x 1 and 2 x 2 blocks.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Strictly stable system.

    Returns
    -------
    (n, n) array
        Gramian P, a symmetric matrix.

    Raises
    ------
    SolverError
        When the system is not strictly stable.

    References
    ----------
    [ZhouDoyleGlover1996]_, section 3.8.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.controllability_gramian(fx.lti.tf([1.0], [1.0, 1.0])).round(9)
    array([[0.5]])
    """
    g = as_statespace(sys)
    return _gramian(g, g.A, g.B)


def observability_gramian(sys: System) -> FloatArray:
    """Return Q (n, n): ``A' Q + Q A + C' C = 0``, or ``Q = A' Q A + C' C`` when sampled.

    It is the dual of `controllability_gramian`.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Strictly stable system.

    Raises
    ------
    SolverError
        When the system is not strictly stable.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.observability_gramian(fx.lti.tf([1.0], [1.0, 1.0])).round(9)
    array([[0.5]])
    """
    g = as_statespace(sys)
    return _gramian(g, g.A.T, g.C.T)


@one_thread()
def _gramian(g: StateSpace, A: FloatArray, B: FloatArray) -> FloatArray:
    if g.n_states and not g.is_stable:
        raise SolverError(
            f"{g!r} is not strictly stable, so that its Gramian is infinite. Take rigid-body and "
            "unstable modes out, or close a loop first."
        )
    if is_block_diagonal(g):
        return _modal_gramian(A, B, g.blocks or (), bool(g.dt))
    return solve_stein(A, B @ B.T) if g.dt else solve_lyapunov(A, B @ B.T)


#: least square of a pair's frequency, relative to that of its decay: a damping ratio of 0.95
_SWINGING = 0.1


def _modal_gramian(
    A: FloatArray, B: FloatArray, blocks: Sequence[int], discrete: bool
) -> FloatArray:
    """Solve block by block: ``A_i X_ij + X_ij A_j' + B_i B_j' = 0``, all pairs (i, j) at once."""
    pairs, slots = diagonal_blocks(A, blocks)
    real, b = slots >= 0, len(slots)
    drive = (B[slots] * real[:, :, None]).reshape(2 * b, -1)
    _, N, q = turning_parts(pairs)
    # nearly double poles have ill-conditioned eigenvectors, and real poles of different size would
    # lose digits
    if np.all(q < -_SWINGING * N[:, 0, 0] ** 2):
        own = ModalMap.of_pairs(pairs)
        modal = own.gramian(own.driven(drive), sampled=discrete)
        padded = own.back(own.back(modal).conj().T).real
    else:
        eye, W = np.eye(2), drive @ drive.T
        right = W.reshape(b, 2, b, 2).transpose(0, 2, 1, 3).reshape(b, b, 4, 1)
        if discrete:
            kron = np.eye(4) - np.einsum("iab,jcd->ijacbd", pairs, pairs).reshape(b, b, 4, 4)
        else:
            left = np.einsum("iab,cd->iacbd", pairs, eye).reshape(b, 1, 4, 4)
            kron = -(left + np.einsum("ab,jcd->jacbd", eye, pairs).reshape(1, b, 4, 4))
        X = np.linalg.solve(kron, right).reshape(b, b, 2, 2)
        padded = X.transpose(0, 2, 1, 3).reshape(2 * b, 2 * b)
    keep = np.flatnonzero(real.reshape(-1))
    return symmetrised(padded[np.ix_(keep, keep)])


def controllability_factor(g: StateSpace) -> FloatArray:
    """Return L (n, n) with ``P = L L'``, the controllability Gramian of a stable system."""
    return _factor(g.A, g.B, g.C, g.dt)


def observability_factor(g: StateSpace) -> FloatArray:
    """Return L (n, n) with ``Q = L L'``, the observability Gramian of a stable system."""
    return _factor(g.A.T, g.C.T, g.B.T, g.dt)


def _factor(A: FloatArray, B: FloatArray, C: FloatArray, dt: float) -> FloatArray:
    d = state_scale(A, B, C)
    A, B = A * d / d[:, None], B / d[:, None]
    if dt:  # ``P = A P A' + B B'`` is that of the bilinear image
        A, B, *_ = bilinear_matrices((A, B, A[:0], B[:0]), 1.0)
    return d[:, None] * _hammarling(A, B)


def _hammarling(A: FloatArray, B: FloatArray) -> FloatArray:
    """Solve ``A L L' + L L' A' + B B' = 0`` for L column by column of the Schur form."""
    # Hammarling's method: P is never formed, so that its small eigenvalues keep their digits. With
    # S upper triangular, last row b of B, `t = |b| / a, a^2 = -2 Re s_nn, v = b* / |b|`: column
    # `u = -(S_1 + conj(s_nn) I)^-1 (s t + a B_1 v)`, then `B_1 <- B_1 - a u v*`. [Hammarling1982]_
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


@np.errstate(over="ignore", invalid="ignore")
def stein_root(F: FloatArray, G: FloatArray) -> FloatArray:
    """Return L with ``L L'`` the sum of ``F^k G G' F'^k``, k = 0, 1, ..., by doubling."""
    L = G
    for _ in range(MOST_STEPS):
        more = F @ L
        L = triangular(np.hstack([L, more]))
        if not np.isfinite(L).all():
            break
        if np.all(np.linalg.norm(more, axis=1) <= SETTLED * np.linalg.norm(L, axis=1)):
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
