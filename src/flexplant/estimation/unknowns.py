"""Unknown parameters of a first state, found by least squares while a record goes on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..values import FloatArray

#: a direction counts as found from this part of the best known one's information (root)
_FOUND = 1e-10


class KnownParameters(NamedTuple):
    """What is known of the parameters delta: their value, ``X X'`` their covariance.

    The columns of `open` are directions that no measurement has shown yet.
    """

    value: FloatArray
    X: FloatArray
    open: FloatArray

    def added(self, rows: FloatArray) -> FloatArray:
        """Return the variance (p,) that delta adds where it enters by rows (p, r)."""
        variance = np.sum((rows @ self.X) ** 2, axis=1)
        missed = np.linalg.norm(rows @ self.open, axis=1)
        return np.where(missed > 1e-8 * np.linalg.norm(rows, axis=1), np.inf, variance)


class Unknowns:
    """The least-squares problem of delta, in triangular form (square root of its information)."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.root = np.zeros((0, count + 1))

    def add(self, rows: FloatArray, values: FloatArray) -> None:
        """Add measurements ``values = rows delta + noise`` of unit variance."""
        both = np.vstack([self.root, np.column_stack([rows, values])])
        self.root = np.asarray(np.linalg.qr(both, mode="r"))

    def found(self) -> KnownParameters:
        """Return what is known by now."""
        R = self.root[: self.count, : self.count]
        U, sizes, V = np.linalg.svd(R, full_matrices=True)
        rank = int(np.count_nonzero(sizes > _FOUND * np.max(sizes, initial=0.0)))
        X = V[:rank].T / sizes[:rank]
        value = X @ (U[:, :rank].T @ self.root[: self.count, self.count])
        return KnownParameters(value, X, V[rank:].T)
