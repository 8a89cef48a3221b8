"""Symmetric matrices of low rank: masses, springs and dampers at places."""

from __future__ import annotations

import numpy as np

from ..values import FloatArray

#: largest rank that is looked for, and relative size below which an entry is rounding
FEW, ROUNDING = 4, 1e-11
#: relative size of what one outer product may leave of a matrix that is replaced by it
EXACT = 1e-14


def factors(
    matrix: FloatArray, *, most: int = FEW, rounding: float = ROUNDING
) -> list[tuple[float, FloatArray]] | None:
    """Return s_i = +-1 and b_i of ``A = sum_i s_i b_i b_i^T``, by pivots; None when there are more.

    None too where no diagonal entry is left to begin with, [[0, 1], [1, 0]].
    """
    size = float(np.abs(matrix).max(initial=0.0))
    found: list[tuple[float, FloatArray]] = []
    left = matrix
    for _ in range(most):
        i = int(np.argmax(np.abs(np.diag(left))))
        pivot = float(left[i, i])
        if abs(pivot) <= rounding * size:
            return None
        b, sign = left[:, i] / np.sqrt(abs(pivot)), float(np.sign(pivot))
        left = left - sign * np.outer(b, b)
        found.append((sign, b))
        if np.abs(left).max() <= rounding * size:
            return found
    return None


def turned(stack: FloatArray, V: FloatArray) -> FloatArray:
    """Return ``V^T A V`` of all A (q, k, k): of one factor by its own, ``s (V^T b)(V^T b)^T``."""
    found = np.zeros((stack.shape[0], V.shape[1], V.shape[1]))
    for A, own in zip(stack, found, strict=True):
        if not A.any():
            continue
        one = factors(A, most=1, rounding=EXACT)
        if one is None:
            own[:] = V.T @ A @ V
        else:
            c = one[0][1] @ V
            own[:] = one[0][0] * np.outer(c, c)
    return found
