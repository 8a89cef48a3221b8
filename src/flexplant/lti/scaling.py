"""Units of the states in which rounding does little harm."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..checks import ComplexArray, FloatArray
from ..tolerances import SPLIT, divisor

#: size of B and C beside A: enough to hold the states of a chain together
BORDER = 1.0


def state_scale(A: FloatArray, B: FloatArray, C: FloatArray) -> FloatArray:
    """Return d (n,), powers of two, for states ``x = d x_scaled``: ``A d / d[:, None]`` is even.

    A is bordered by the sizes of B's rows and C's columns and balanced with them: balancing A
    alone shrinks whatever lies above its diagonal blocks without end (a Schur form of 84 states
    got units of 1e26 beside 1e-34), which costs B and C all their digits.
    """
    drive, sight = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    # borders whose size beside the balanced A is moderate, whatever the units of A, inputs, outputs
    size = BORDER * (float(np.linalg.norm(balanced_matrix(A))) or 1.0)
    return bordered_scale(
        A,
        drive * (size / (float(np.linalg.norm(drive)) or 1.0)),
        sight * (size / (float(np.linalg.norm(sight)) or 1.0)),
    )


def scaled_schur(
    A: FloatArray, B: FloatArray, C: FloatArray
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return units d of the states, and T, U of the Schur form ``A d / d[:, None] = U T U*``."""
    # units first: the transformation mixes rounding with the norm of all of A
    d = state_scale(A, B, C)
    T, U = la.schur(A * d / d[:, None], output="complex")
    return d, T, U


def bordered_scale(A: FloatArray, drive: FloatArray, sight: FloatArray) -> FloatArray:
    """Return d (n,), powers of two, that balance A bordered by a column and a row (Osborne)."""
    n = A.shape[0]
    bordered = np.zeros((n + 1, n + 1))
    bordered[:n, :n], bordered[:n, n], bordered[n, :n] = A, drive, sight
    found = even_scale(bordered)
    return np.asarray(found[:n] / found[n])


def even_scale(A: FloatArray) -> FloatArray:
    """Return d (n,), powers of two, for which ``A d / d[:, None]`` has even rows and columns."""
    # gebal itself: scipy's matrix_balance reads scales above 2^63 as permutations, with a warning
    return np.asarray(la.lapack.dgebal(A, scale=1, permute=0)[3])


def balanced_matrix(A: FloatArray) -> FloatArray:
    """Return A with even rows and columns (LAPACK's gebal): the same eigenvalues."""
    return np.asarray(la.lapack.dgebal(A, scale=1, permute=0)[0])


def mean_speed(poles: ComplexArray) -> float:
    """Return the geometric mean [rad/s] of the sizes of poles, those near zero left out; 1 if none.

    Free masses come out at rounding, which says nothing about the others.
    """
    sizes = np.abs(poles)
    moving = sizes[sizes > SPLIT * sizes.max(initial=0.0)]
    return float(np.exp(np.mean(np.log(moving)))) if moving.size else 1.0


def reciprocal(size: FloatArray) -> FloatArray:
    """Return ``1 / size``, and 1 for what is of no size."""
    return np.asarray(1.0 / divisor(size))
