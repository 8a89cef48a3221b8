"""The model at one set of parameters: its modes and their derivatives, each computed once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..values import ComplexArray, FloatArray, IntArray
from .family import Eigen, Family
from .pairing import pair


class Point:
    """The model at the parameters `p`, its modes labelled by their numbers in the start model.

    Parameters
    ----------
    family : Family
        The pencils.
    p : (q,) array
        Values of the parameters.
    eigen : Eigen
        Modes there.
    labels : (m,) int array
        The mode number each column continues, 0 for none.
    """

    def __init__(self, family: Family, p: FloatArray, eigen: Eigen, labels: IntArray) -> None:
        #: with the derivatives at p
        self.family = family.tangent(p)
        self.p = p
        self.eigen = eigen
        self.labels = labels
        self._known: dict[tuple[int, ...], tuple[ComplexArray, ComplexArray]] = {}
        #: derivatives of eigenvalues of repeated modes, by mode number
        self.turned: dict[int, ComplexArray] = {}

    @cached_property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M, D and K in the coordinates of the family."""
        return self.family.matrices(self.p)

    @cached_property
    def _where(self) -> dict[int, int]:
        return {int(n): c for c, n in enumerate(self.labels.tolist()) if n}

    def columns(self, numbers: Sequence[int]) -> list[int]:
        """Return the columns of modes by number.

        Raises
        ------
        ModelError
            When one of them no longer oscillates.
        """
        where = self._where
        lost = [n for n in numbers if n not in where]
        if lost:
            raise ModelError(f"modes {lost} cease to oscillate.")
        return [where[n] for n in numbers]

    def sensitivity(self, numbers: Sequence[int]) -> ComplexArray:
        """Return d lambda / d p (m, q), the paper's (11)."""
        S = self.family.sensitivity(self.eigen, self.columns(numbers))
        for i, number in enumerate(numbers):
            S[i] = self.turned.get(number, S[i])
        return S

    def subspace(self, numbers: Sequence[int]) -> tuple[ComplexArray, ComplexArray]:
        """Return dX (q, k, s) and dL (q, s, s) of the invariant pair (X, L) of some modes.

        The bordered system, one factor per mode for all parameters::

            [P(lambda_j)  B_j] [dX_j]     [-(lambda_j^2 dM + lambda_j dD + dK) x_j]
            [B_j^T          0] [dL_j]  =  [                  0                    ]

        with ``B_j = [M x_i (lambda_i + lambda_j) + D x_i]_i``: regular for any distance of the
        modes in the group, as long as no other mode comes near. One mode alone gives d lambda and
        the derivative of its vector at fixed ``x^T (2 lambda M + D) dx = 0``.
        """
        key = tuple(numbers)
        if key not in self._known:
            self._known[key] = _bordered(self, self.columns(key))
        return self._known[key]

    def continued(self, p: FloatArray) -> Point:
        """Return the model at other parameters, its modes paired by shape with those here."""
        eigen = self.family.at(p)
        old, new = self.family.weighted(self.eigen.X), self.family.weighted(eigen.X)
        found = pair(self.eigen.poles, old, new)
        labels = np.zeros(eigen.poles.size, dtype=np.int64)
        labels[found[found >= 0]] = self.labels[found >= 0]
        return Point(self.family, p, eigen, labels)


def first_point(family: Family, p: FloatArray) -> Point:
    """Return the model at the start: modes numbered from 1 by rising frequency."""
    eigen = family.at(p)
    labels = np.arange(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1, dtype=np.int64)
    return Point(family, p, eigen, labels)


def _bordered(point: Point, columns: list[int]) -> tuple[ComplexArray, ComplexArray]:
    M, D, K = point.matrices
    family, X, poles = point.family, point.eigen.X[:, columns], point.eigen.poles[columns]
    k, s = X.shape
    q = point.p.size
    dX, dL = np.zeros((q, k, s), complex), np.zeros((q, s, s), complex)
    MX, DX = M @ X, D @ X
    real = not np.any(DX) and not np.any(X.imag) and not np.any(poles.real)
    changes = family.moved(X, (poles**2, poles, np.ones_like(poles)))
    for j, lam in enumerate(poles):
        moved = changes[:, :, j]
        border = MX * (poles + lam) + DX
        size = np.sqrt(np.linalg.norm(K, 1) / np.abs(border).max())
        # undamped: all is real but the border, imaginary, and its unknown
        whole = real and not np.any(moved.imag)
        turn = -1j if whole else 1.0
        kind = np.float64 if whole else np.complex128
        system = np.zeros((k + s, k + s), kind)
        system[:k, :k] = (lam**2).real * M + K if whole else lam**2 * M + lam * D + K
        edge = border * size * turn
        system[:k, k:] = edge.real if whole else edge
        system[k:, :k] = system[:k, k:].T
        right = np.zeros((k + s, q), kind)
        right[:k] = -moved.T.real if whole else -moved.T
        solved = la.lu_solve(la.lu_factor(system, check_finite=False), right, check_finite=False)
        dX[:, :, j] = solved[:k].T
        dL[:, :, j] = solved[k:].T * size * turn
    return dX, dL
