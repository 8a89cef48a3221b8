"""Invariant zeros on the stability limit, for plants with more outputs than inputs too."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..values import ComplexArray, FloatArray
from .scaling import mean_speed
from .statespace import StateSpace

#: a zero closer to the limit than this, relative to its size, is tested as if it were on it
_NEAR = 1e-6
#: smallest singular value of the scaled system matrix, at which its rank is lost
_LOST = 1e-9


def axis_zeros(g: StateSpace) -> ComplexArray:
    """Return the invariant zeros on the imaginary axis (unit circle), upper half plane.

    Where ``[A - s I, B; C, D]`` loses column rank. With more outputs than inputs they are among
    the generalised eigenvalues of the pencil with its outputs mixed down to as many as inputs;
    candidates near the limit are moved onto it. The rank of the whole matrix, states, inputs and
    outputs scaled to unit size, decides.

    Parameters
    ----------
    g : StateSpace
        (p, m) with p >= m, continuous or sampled.

    Returns
    -------
    (k,) complex array [rad/s, or z]

    References
    ----------
    Emami-Naeini, Van Dooren, Computation of zeros of linear multivariable systems, Automatica 18,
    1982; the random mixing replaces their compression.
    """
    n, m = g.n_states, len(g.inputs)
    A, B, C, D = _scaled(g)
    mixing = np.linalg.qr(np.random.default_rng(0).standard_normal((C.shape[0], m)))[0].T
    pencil = np.block([[A, B], [mixing @ C, mixing @ D]])
    E = np.zeros((n + m, n + m))
    E[:n, :n] = np.eye(n)
    alpha, beta = la.eig(pencil, E, right=False, homogeneous_eigvals=True)
    finite = np.abs(beta) > 1e-14 * np.abs(alpha)
    speed = _speed(g)
    zeros = alpha[finite] / beta[finite]
    size = np.maximum(np.abs(zeros), 0.1)  # double zeros at 0 come out at the root of rounding
    off = np.abs(np.abs(zeros) - 1) if g.dt else np.abs(zeros.real) / size
    near = zeros[(off < _NEAR) & (zeros.imag >= 0)]
    on = near / np.abs(near) if g.dt else 1j * near.imag
    found: list[complex] = []
    for zero in np.sort_complex(on):
        if any(abs(zero - other) < 1e-6 * max(abs(zero), 1e-3) for other in found):
            continue
        whole = np.block([[A - zero * np.eye(n), B], [C, D]])
        columns = np.linalg.norm(whole, axis=0)
        if np.linalg.svd(whole / np.where(columns > 0, columns, 1.0), compute_uv=False)[-1] < _LOST:
            found.append(complex(zero))
    return np.array(found, dtype=np.complex128) * speed


def _speed(g: StateSpace) -> float:
    """Return a frequency [rad/s] that makes A of order one; 1 when sampled."""
    return 1.0 if g.dt else mean_speed(g.poles())


def _scaled(g: StateSpace) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the matrices with time in units of the poles, inputs and outputs of unit size."""
    A, B = g.A / _speed(g), g.B / _speed(g)
    into = _inverse(np.linalg.norm(B, axis=0) + 0.0)
    B, D = B * into, g.D * into
    out = _inverse(np.linalg.norm(np.hstack([g.C, D]), axis=1))
    return A, B, g.C * out[:, None], D * out[:, None]


def _inverse(sizes: FloatArray) -> FloatArray:
    return np.asarray(1.0 / np.where(sizes > 0, sizes, 1.0))
