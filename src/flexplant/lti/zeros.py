"""Invariant zeros of a system, all finite ones and those on the imaginary axis."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor
from ..tolerances import NULL, SAME, SPLIT
from .equations import mean_speed, reciprocal, state_scale


def invariant_zeros(g: Any) -> ComplexArray:
    """Return the finite invariant zeros, where ``[A - s I, B; C, D]`` loses its normal rank."""
    # the system is compressed until D has full row and column rank: outputs without feedthrough are
    # states, which act as inputs of the rest. A regular pencil remains, whose eigenvalues are the
    # finite zeros; zeros at infinity were removed with the compressed states.
    # [EmamiNaeiniVanDooren1982]_
    A, B, C, D = _scaled_matrices(g)
    d = state_scale(A, B, C) if A.size else np.ones(0)
    A, B, C = A * d / d[:, None], B / d[:, None], C * d
    A, B, C, D = _full_rank_part(A, B, C, D)
    A, C, B, D = (part.T for part in _full_rank_part(A.T, C.T, B.T, D.T))
    n, m = B.shape
    if not n:
        return np.zeros(0, dtype=np.complex128)
    if not m:
        return np.asarray(la.eigvals(A) * _pole_size(g), dtype=np.complex128)
    # columns that [C D] does not see: the pencil [A - s I, B] on them is square
    unseen = la.qr(np.hstack([C, D]).T)[0][:, -n:]
    alpha, beta = la.eigvals(np.hstack([A, B]) @ unseen, unseen[:n], homogeneous_eigvals=True)
    finite = np.abs(beta) > NULL * np.abs(alpha)
    return np.asarray(alpha[finite] / beta[finite] * _pole_size(g), dtype=np.complex128)


def _full_rank_part(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a system of the same finite zeros whose D has full row rank."""
    limit = NULL * float(np.linalg.norm(np.block([[A, B], [C, D]])))
    while True:
        turn, rank = _row_space(D, limit)
        C, D = turn.T @ C, turn.T @ D
        C_direct, C_late, D = C[:rank], C[rank:], D[:rank]
        turn, fixed = _row_space(C_late.T, limit)  # states that C_late sees come first
        if not fixed:
            return A, B, C_direct, D
        # outputs without feedthrough that are zero hold these states at zero: their rates are
        # the next outputs
        A, B, C_direct = turn.T @ A @ turn, turn.T @ B, C_direct @ turn
        C = np.vstack([C_direct[:, fixed:], A[:fixed, fixed:]])
        D = np.vstack([D, B[:fixed]])
        A, B = A[fixed:, fixed:], B[fixed:]


def _row_space(matrix: FloatArray, limit: float) -> tuple[FloatArray, int]:
    """Return an orthogonal Q and r: the first r columns of Q span the columns of the matrix."""
    if not matrix.size:
        return np.eye(matrix.shape[0]), 0
    left, values, _ = np.linalg.svd(matrix)
    return left, int(np.sum(values > limit))


def axis_zeros(g: Any) -> ComplexArray:
    """Return the invariant zeros on the imaginary axis (unit circle), upper half plane."""
    # where `[A - s I, B; C, D]` loses column rank. With more outputs than inputs they are among the
    # generalised eigenvalues of the pencil with its outputs mixed down to as many as inputs;
    # candidates near the limit are moved onto it. The rank of the whole matrix, states, inputs and
    # outputs scaled to unit size, decides. [EmamiNaeiniVanDooren1982]_; the random mixing replaces
    # their compression
    n, m = g.n_states, len(g.inputs)
    A, B, C, D = _scaled_matrices(g)
    mixing = np.linalg.qr(np.random.default_rng(0).standard_normal((C.shape[0], m)))[0].T
    pencil = np.block([[A, B], [mixing @ C, mixing @ D]])
    E = np.zeros((n + m, n + m))
    E[:n, :n] = np.eye(n)
    alpha, beta = la.eig(pencil, E, right=False, homogeneous_eigvals=True)
    # larger values are rounding of a zero at infinity, which is computed as about 1 / (2e-16)
    finite = np.abs(beta) > 1e-14 * np.abs(alpha)
    speed = _pole_size(g)
    zeros = alpha[finite] / beta[finite]
    size = np.maximum(np.abs(zeros), 0.1)  # double zeros at 0 have the size of the root of rounding
    off = np.abs(np.abs(zeros) - 1) if g.dt else np.abs(zeros.real) / size
    near = zeros[(off < SPLIT) & (zeros.imag >= 0)]
    on = near / np.abs(near) if g.dt else 1j * near.imag
    # several zeros at zero frequency have errors of a root of rounding, so that zero is always
    # tested
    on = np.append(on, 1.0 if g.dt else 0.0)
    found: list[complex] = []
    for zero in np.sort_complex(on):
        # in units of the scaled system
        if any(abs(zero - other) < SPLIT * max(abs(zero), 1e-3) for other in found):
            continue
        whole = np.block([[A - zero * np.eye(n), B], [C, D]])
        columns = np.linalg.norm(whole, axis=0)
        if np.linalg.svd(whole / divisor(columns), compute_uv=False)[-1] < SAME:
            found.append(complex(zero))
    return np.array(found, dtype=np.complex128) * speed


def _pole_size(g: Any) -> float:
    """Return a frequency [rad/s] that makes A of order one; 1 when sampled."""
    return 1.0 if g.dt else mean_speed(g.poles())


def _scaled_matrices(g: Any) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the matrices with time in units of the poles, inputs and outputs of unit size."""
    A, B = g.A / _pole_size(g), g.B / _pole_size(g)
    into = reciprocal(np.linalg.norm(B, axis=0) + 0.0)
    B, D = B * into, g.D * into
    out = reciprocal(np.linalg.norm(np.hstack([g.C, D]), axis=1))
    return A, B, g.C * out[:, None], D * out[:, None]
