"""Poles and zeros: transfer functions as chains of real sections, invariant zeros of a system."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..checks import ComplexArray, FloatArray, complex_array, positive, real_array
from ..errors import ModelError
from ..tolerances import ROUNDING, SPLIT, divisor
from .equations import mean_speed, reciprocal, state_scale
from .joining import block_matrix, cascaded


def zpk_fields(
    zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float, dt: float = 0.0
) -> dict[str, Any]:
    """Return A, B, C, D and blocks of ``gain prod(s - zeros) / prod(s - poles)``.

    Each pair of poles is a block of two states with the zeros nearest to it, the least damped
    first, so that A keeps its poles to rounding: a companion form of many poles does not.
    """
    z, p, dt = _as_roots(zeros, "zeros"), _as_roots(poles, "poles"), positive(dt, "dt", zero=True)
    if z.size > p.size:
        raise ModelError(
            f"the transfer function has {z.size} zeros and {p.size} poles: it differentiates its "
            "input, which no state space does. Add poles beyond the band, such as a low-pass."
        )
    left = root_pairs(z)
    chain = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    blocks: list[int] = []
    factor = float(real_array(gain, "gain", ()))
    for pair in sorted(root_pairs(p), key=lambda pole: _decay(pole[0], dt)):
        nearest = _near_zeros(pair, left)
        left = [part for part in left if part is not nearest]
        a, b, c, d = _section(pair, nearest)
        # sections of moderate gain: what they lack of the poles' size goes to the factor
        size = float(np.abs(pair).max()) or 1.0
        lacking = size ** (pair.size - nearest.size)
        c, d, factor = c * lacking, d * lacking, factor / lacking
        chain = cascaded(chain, (a, b, c, d))
        blocks = [pair.size, *blocks]
    A, B, C, D = chain
    return {"A": A, "B": B, "C": factor * C, "D": factor * D, "blocks": blocks}


def tf_fields(
    numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt: float = 0.0
) -> dict[str, Any]:
    """Return A, B, C, D and blocks of a ratio of polynomials, highest power first."""
    num, den = (
        np.trim_zeros(np.ravel(real_array(part, name)), "f")
        for part, name in ((numerator, "the numerator"), (denominator, "the denominator"))
    )
    if not den.size:
        raise ModelError("the denominator is zero: a transfer function needs one that is not.")
    if not num.size:
        return zpk_fields([], [], 0.0)
    return zpk_fields(np.roots(num), np.roots(den), num[0] / den[0], dt)


def matrix_fields(channels: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the fields of a matrix of transfer functions, each with states of its own."""
    every = [part for row in channels for part in row]
    inputs = [np.eye(len(row))[j : j + 1] for row in channels for j in range(len(row))]
    outputs = [np.eye(len(channels))[:, i : i + 1] for i, row in enumerate(channels) for _ in row]
    return {
        "A": block_matrix([part["A"] for part in every]),
        "B": np.vstack([part["B"] @ side for part, side in zip(every, inputs, strict=True)]),
        "C": np.hstack([side @ part["C"] for part, side in zip(every, outputs, strict=True)]),
        "D": np.array([[part["D"][0, 0] for part in row] for row in channels]),
        "blocks": [size for part in every for size in part["blocks"]],
    }


def _as_roots(values: npt.ArrayLike, name: str) -> ComplexArray:
    roots = complex_array(values, name).ravel()
    lonely = [root for root in roots if not np.isclose(roots, root.conj(), rtol=SPLIT).any()]
    if lonely:
        raise ModelError(
            f"{name} need the conjugate of {lonely[0]:.6g}: complex ones of a real system come in "
            "pairs."
        )
    return roots


def _decay(pole: complex, dt: float) -> float:
    return 1.0 - abs(pole) if dt else abs(pole.real) / (abs(pole) or 1.0)


def root_pairs(values: ComplexArray) -> list[ComplexArray]:
    """Return conjugate pairs, pairs of neighbouring real values, and one that is left over."""
    upper = values.imag > ROUNDING * np.abs(values)
    pairs = [np.array([v, np.conj(v)]) for v in values[upper]]
    real = np.sort(values[np.abs(values.imag) <= ROUNDING * np.abs(values)].real).astype(complex)
    return pairs + [real[i : i + 2] for i in range(0, real.size, 2)]


def _near_zeros(pair: ComplexArray, left: list[ComplexArray]) -> ComplexArray:
    """Return the zeros nearest to a pair of poles, none where it cannot hold them."""
    fitting = [z for z in left if z.size == pair.size] or [z for z in left if z.size < pair.size]
    if not fitting:
        return np.zeros(0, dtype=np.complex128)
    return min(fitting, key=lambda z: float(np.abs(z[0] - pair[0])))


def _section(
    poles: ComplexArray, zeros: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return ``prod (s - zero) / prod (s - pole)`` of order one or two, with no more zeros."""
    through = np.array([[float(zeros.size == poles.size)]])
    if poles.size == 1:
        p = float(poles[0].real)
        gain = p - float(zeros[0].real) if zeros.size else 1.0
        return np.array([[p]]), np.array([[1.0]]), np.array([[gain]]), through
    # through + (n1 s + n0) / den, zeros and poles compared before they are multiplied out
    if zeros.size == 2:
        n1 = float((poles.sum() - zeros.sum()).real)
        n0 = float((np.prod(zeros) - np.prod(poles)).real)
    else:
        n1, n0 = (1.0, -float(zeros[0].real)) if zeros.size else (0.0, 1.0)
    B = np.array([[0.0], [1.0]])
    real = float(poles[0].real)
    if poles[0].imag:
        imag = abs(float(poles[0].imag))
        A = np.array([[real, imag], [-imag, real]])
        return A, B, np.array([[(n0 + n1 * real) / imag, n1]]), through
    size = float(np.abs(poles).max()) or 1.0
    A = np.array([[real, size], [0.0, float(poles[1].real)]])
    return A, B, np.array([[(n0 + n1 * real) / size, n1]]), through


#: a zero closer to the limit than this, relative to its size, is tested as if it were on it
_NEAR = 1e-6
#: smallest singular value of the scaled system matrix, at which its rank is lost
_LOST = 1e-9
#: singular values below this, relative to the scaled system matrix, are rounding
_ROUNDING = 1e-11


def invariant_zeros(g: Any) -> ComplexArray:
    """Return the finite invariant zeros, where ``[A - s I, B; C, D]`` loses its normal rank.

    The system is compressed until D has full row and column rank: outputs that do not feel an input
    directly are states, and states of the rest. What is left is a regular pencil, whose eigenvalues
    are the zeros; those at infinity have left with the compressed states.
    [EmamiNaeiniVanDooren1982]_.
    """
    A, B, C, D = _even(*_scaled_matrices(g))
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
    finite = np.abs(beta) > _ROUNDING * np.abs(alpha)
    return np.asarray(alpha[finite] / beta[finite] * _pole_size(g), dtype=np.complex128)


def _full_rank_part(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a system of the same finite zeros whose D has full row rank."""
    limit = _ROUNDING * float(np.linalg.norm(np.block([[A, B], [C, D]])))
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


def _even(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    d = state_scale(A, B, C) if A.size else np.ones(0)
    return A * d / d[:, None], B / d[:, None], C * d, D


def axis_zeros(g: Any) -> ComplexArray:
    """Return the invariant zeros on the imaginary axis (unit circle), upper half plane.

    Where ``[A - s I, B; C, D]`` loses column rank. With more outputs than inputs they are among the
    generalised eigenvalues of the pencil with its outputs mixed down to as many as inputs;
    candidates near the limit are moved onto it. The rank of the whole matrix, states, inputs and
    outputs scaled to unit size, decides. [EmamiNaeiniVanDooren1982]_; the random mixing replaces
    their compression.
    """
    n, m = g.n_states, len(g.inputs)
    A, B, C, D = _scaled_matrices(g)
    mixing = np.linalg.qr(np.random.default_rng(0).standard_normal((C.shape[0], m)))[0].T
    pencil = np.block([[A, B], [mixing @ C, mixing @ D]])
    E = np.zeros((n + m, n + m))
    E[:n, :n] = np.eye(n)
    alpha, beta = la.eig(pencil, E, right=False, homogeneous_eigvals=True)
    # beyond: rounding of a zero at infinity, which comes out at some 1 / (2e-16)
    finite = np.abs(beta) > 1e-14 * np.abs(alpha)
    speed = _pole_size(g)
    zeros = alpha[finite] / beta[finite]
    size = np.maximum(np.abs(zeros), 0.1)  # double zeros at 0 come out at the root of rounding
    off = np.abs(np.abs(zeros) - 1) if g.dt else np.abs(zeros.real) / size
    near = zeros[(off < _NEAR) & (zeros.imag >= 0)]
    on = near / np.abs(near) if g.dt else 1j * near.imag
    # several at zero frequency come out at a root of rounding, which may be far off: always tested
    on = np.append(on, 1.0 if g.dt else 0.0)
    found: list[complex] = []
    for zero in np.sort_complex(on):
        if any(abs(zero - other) < SPLIT * max(abs(zero), 1e-3) for other in found):
            continue
        whole = np.block([[A - zero * np.eye(n), B], [C, D]])
        columns = np.linalg.norm(whole, axis=0)
        if np.linalg.svd(whole / divisor(columns), compute_uv=False)[-1] < _LOST:
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
