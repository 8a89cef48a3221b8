"""Rayleigh-Ritz in the span of some shapes, accurate for soft modes beside stiff ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..values import FloatArray
from .factor import by_rows

#: eigenvalues closer together than this are found to 1e-9 of themselves in one go
SPREAD = 1e-6
#: a group of soft modes ends below this part of the largest eigenvalue, at the widest gap
_END = 1e-3
#: rows that are mixed at a time
_ROWS = 65536
_EPS = float(np.finfo(np.float64).eps)


def rayleigh_ritz(K: Any, M: Any, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 (k,), ascending, and M-orthonormal shapes (n, k) in the span of X.

    LAPACK's error is a rounding of the largest eigenvalue. The soft modes, separated from the
    stiff ones to first order, are therefore solved for again by themselves, group by group, as
    often as the spread of the eigenvalues needs it. X is overwritten.
    """
    K, M = by_rows(K), by_rows(M)
    squares, mix = _eigh(K, M, X)
    X = mixed(X, mix)
    end = squares.size
    while end > 1 and squares[0] < SPREAD * squares[end - 1]:
        end = soft_group(squares[:end])
        part = np.ascontiguousarray(X[:, :end])
        squares[:end], mix = _eigh(K, M, part)
        X[:, :end] = mixed(part, mix)
    return squares, X


def soft_group(squares: FloatArray) -> int:
    """Return how many of some ascending eigenvalues form a soft group, up to the widest gap."""
    top = float(squares[-1])
    # those below are wrong by a rounding of the largest one: gaps among them say nothing
    sure = np.maximum(squares, 0.1 * SPREAD * top)
    ratio = np.where(sure[:-1] <= _END * top, sure[1:] / sure[:-1], 0.0)
    return int(np.argmax(ratio)) + 1


def rounding_of(K: Any, phi: FloatArray) -> FloatArray:
    """Return ``eps |phi|^T |K| |phi|`` of each M-orthonormal shape [1/s^2].

    By so much the eigenvalue of a shape may change when the entries of K are rounded to double
    precision: no method finds it closer to that of the structure.
    """
    size = np.abs(phi)
    return np.asarray(_EPS * np.einsum("ij,ij->j", size, np.asarray(absolute(by_rows(K)) @ size)))


def absolute(K: Any) -> Any:
    """Return ``|K|``, entry by entry."""
    given: Any = K
    if not sp.issparse(K):
        return np.abs(given)
    return sp.csr_array((np.abs(given.data), given.indices, given.indptr), shape=given.shape)


def mixed(X: FloatArray, mix: FloatArray) -> FloatArray:
    """Return ``X mix`` in the place of X: a second array of this size is memory at its peak."""
    for begin in range(0, X.shape[0], _ROWS):
        rows = slice(begin, begin + _ROWS)
        X[rows, : mix.shape[1]] = X[rows] @ mix
    return X[:, : mix.shape[1]]


def _eigh(K: Any, M: Any, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    stiffness, mass = X.T @ (K @ X), X.T @ (M @ X)
    squares, mix = la.eigh(0.5 * (stiffness + stiffness.T), 0.5 * (mass + mass.T))
    return np.asarray(squares), np.asarray(mix)
