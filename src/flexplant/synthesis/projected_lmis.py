"""The projected LMIs of H-infinity synthesis as one semidefinite program that keeps its structure.

Over symmetric R, S (n, n) and gamma, with N_R = null [B2' D12'], N_S = null [C2 D21]
([GahinetApkarian1994]_, theorem 4.3)::

    min gamma,   -N_R' [A R + R A'  R C1'      B1      ] N_R >= 0,   [R I] >= 0,
                       [C1 R        -gamma I   D11     ]             [I S]
                       [B1'         D11'       -gamma I]

and the same with A', C1', B1', D11', S for N_S. Each side is ``const + U R V' + V R U' + gamma J``
with n columns in U and V, which is what makes the Schur complement of an interior-point step cheap.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la

from ..values import FloatArray
from .lmi_plant import Plant, half, null_space

#: rows of the transformed basis matrices that are held at once
_ROWS = 512


class _Side:
    """One projected LMI, ``const + U X V' + V X U' + gamma J >= 0`` in its symmetric X."""

    def __init__(
        self,
        A: FloatArray,
        B1: FloatArray,
        C1: FloatArray,
        D11: FloatArray,
        free: FloatArray,
    ) -> None:
        n, nw, nz = A.shape[0], B1.shape[1], C1.shape[0]
        self.onto = la.block_diag(null_space(free), np.eye(nw))
        self.U = -self.onto.T @ np.vstack([A, C1, np.zeros((nw, n))])
        self.V = self.onto[:n].T.copy()
        fixed = np.zeros((n + nz + nw, n + nz + nw))
        fixed[: n + nz, n + nz :] = np.vstack([B1, D11])
        self.const = half(-2.0 * self.onto.T @ fixed @ self.onto)
        self.J = half(self.onto[n:].T @ self.onto[n:])

    def value(self, X: FloatArray, gamma: float) -> FloatArray:
        moved = self.U @ X @ self.V.T
        return np.asarray(moved + moved.T + gamma * self.J)

    def adjoint(self, W: FloatArray) -> tuple[FloatArray, float]:
        moved = self.V.T @ W @ self.U
        return moved + moved.T, float(np.sum(W * self.J))


class ProjectedLmis:
    """The program ``min gamma`` over y = (R, S, gamma): blocks ``const + linear(y) >= 0``.

    R and S enter by their upper triangles. The multipliers X of the blocks satisfy
    ``adjoint(X) = cost`` at the optimum.
    """

    def __init__(self, plant: Plant) -> None:
        p, n = plant, plant.A.shape[0]
        self.n = n
        self.sides = (
            _Side(p.A, p.B1, p.C1, p.D11, np.hstack([p.B2.T, p.D12.T])),
            _Side(p.A.T, p.C1.T, p.B1.T, p.D11.T, np.hstack([p.C2, p.D21])),
        )
        self._I, self._J = np.triu_indices(n)
        #: a diagonal entry is counted once where an entry beside the diagonal stands twice
        self._once = np.where(self._I == self._J, 0.5, 1.0)
        coupling = np.kron(np.array([[0.0, 1.0], [1.0, 0.0]]), np.eye(n))
        self.const = [self.sides[0].const, self.sides[1].const, coupling]
        self.count = 2 * self._I.size + 1
        self.cost = np.zeros(self.count)
        self.cost[-1] = 1.0

    def start(self, size: float) -> FloatArray:
        """Return y of R = S = size I, gamma = size."""
        y = np.zeros(self.count)
        y[:-1] = size * np.tile(self._I == self._J, 2)
        y[-1] = size
        return y

    def matrices(self, y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return R, S and gamma of y."""
        R, S = np.zeros((2, self.n, self.n))
        for X, part in ((R, y[: self._I.size]), (S, y[self._I.size : -1])):
            X[self._I, self._J] = X[self._J, self._I] = part
        return R, S, float(y[-1])

    def linear(self, y: FloatArray) -> list[FloatArray]:
        """Return the part of each block that is linear in y."""
        R, S, gamma = self.matrices(y)
        first, second = self.sides
        return [first.value(R, gamma), second.value(S, gamma), la.block_diag(R, S)]

    def adjoint(self, W: Sequence[FloatArray]) -> FloatArray:
        """Return the products of symmetric W, one for each block, with the basis of y."""
        n = self.n
        (of_R, gamma_R), (of_S, gamma_S) = (
            side.adjoint(part) for side, part in zip(self.sides, W, strict=False)
        )
        parts = (of_R + W[2][:n, :n], of_S + W[2][n:, n:])
        folded = [(G[self._I, self._J] + G[self._J, self._I]) * self._once for G in parts]
        return np.concatenate([*folded, [gamma_R + gamma_S]])

    def schur(
        self,
        X_roots: Sequence[FloatArray],
        Z_roots: Sequence[FloatArray],
        X: FloatArray,
        Z_inverse: FloatArray,
    ) -> FloatArray:
        """Return ``M_ij = tr(A_i X A_j Z^-1)`` over the basis of y, summed over the blocks."""
        n, N = self.n, self._I.size
        M = np.zeros((self.count, self.count))
        for i, side in enumerate(self.sides):
            own = slice(i * N, (i + 1) * N)
            gamma = (Z_roots[i].T @ side.J @ X_roots[i]).ravel()
            rows = self._transformed(side, X_roots[i], Z_roots[i])
            M[own, own] = rows @ rows.T
            M[own, -1] = M[-1, own] = rows @ gamma
            M[-1, -1] += gamma @ gamma
        x, z = X, Z_inverse
        M[:N, :N] += self._pairs(x[:n, :n], z[:n, :n])
        M[N:-1, N:-1] += self._pairs(x[n:, n:], z[n:, n:])
        M[:N, N:-1] = self._pairs(x[:n, n:], z[n:, :n])
        M[N:-1, :N] = M[:N, N:-1].T
        return M

    def _transformed(self, side: _Side, X_root: FloatArray, Z_root: FloatArray) -> FloatArray:
        """Return ``L_z' (U E V' + V E U') L_x`` for each basis matrix E, one row each.

        The product of two rows is ``tr(A_i X A_j Z^-1)``.
        """
        left = (Z_root.T @ side.U).T, (Z_root.T @ side.V).T
        right = side.V.T @ X_root, side.U.T @ X_root
        size = X_root.shape[0]
        rows = np.empty((self._I.size, size * size))
        for begin in range(0, self._I.size, _ROWS):
            own = slice(begin, begin + _ROWS)
            I, J = self._I[own], self._J[own]  # noqa: E741 - indices of rows and columns
            part = np.zeros((I.size, size, size))
            for a, b in zip(left, right, strict=True):
                part += a[I][:, :, None] * b[J][:, None, :]
                part += a[J][:, :, None] * b[I][:, None, :]
            part *= self._once[own, None, None]
            rows[own] = part.reshape(I.size, -1)
        return rows

    def _pairs(self, P: FloatArray, Q: FloatArray) -> FloatArray:
        """Return ``tr(E_i P E_j Q)`` over the basis of one symmetric matrix (and of another)."""
        I, J = self._I, self._J  # noqa: E741 - indices of rows and columns
        found = np.zeros((I.size, I.size))
        for a, b in ((I, J), (J, I)):
            P_rows, Q_rows = P[b], Q.T[a]
            found += P_rows[:, I] * Q_rows[:, J]
            found += P_rows[:, J] * Q_rows[:, I]
        return found * self._once[:, None] * self._once
