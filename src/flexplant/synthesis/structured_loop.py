"""The closed loop of a controller with parameters: its norm, its stability, and their gradients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..lti.norms import peak_gain
from ..lti.preparation import Prepared
from ..lti.statespace import StateSpace
from ..values import ComplexArray, FloatArray

#: a loop counts as stable with this decay, in the scaled unit of time
DECAY = 1e-7


class Matrices(NamedTuple):
    """A controller in continuous time (a sampled one by Tustin's rule), or a gradient by each."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


class ScaledLoop:
    """A prepared plant that a controller of k states is closed on.

    With ``K = [AK, BK; CK, DK]`` the loop is static feedback of the plant with k integrators, its
    matrices ``Acl = A + B Q C`` and so on, ``Q = (I - K D22)^-1 K``, and every change is
    ``dQ = (I - K D22)^-1 dK (I - D22 K)^-1``.
    """

    def __init__(self, p: Prepared, order: int) -> None:
        n, k = p.A.shape[0], order
        self.p, self.k = p, k
        nu, ny = len(p.u), len(p.y)
        self.A = la.block_diag(p.A, np.zeros((k, k)))
        self.B1 = np.vstack([p.B1, np.zeros((k, p.B1.shape[1]))])
        self.C1 = np.hstack([p.C1, np.zeros((p.C1.shape[0], k))])
        self.B = np.block([[np.zeros((n, k)), p.B2], [np.eye(k), np.zeros((k, nu))]])
        self.C = np.block([[np.zeros((k, n)), np.eye(k)], [p.C2, np.zeros((ny, k))]])
        self.D12 = np.hstack([np.zeros((p.D12.shape[0], k)), p.D12])
        self.D21 = np.vstack([np.zeros((k, p.D21.shape[1])), p.D21])
        self.D22 = la.block_diag(np.zeros((k, k)), p.D22)
        self._in = np.linalg.inv(p.y_scale)
        self._out = np.linalg.inv(p.u_scale)

    def stability(self, K: Matrices) -> tuple[float, Matrices, complex]:
        """Return the spectral abscissa [1], its gradient by K, and the pole that it is of."""
        Q, left, right = self._feedback(K)
        values, lefts, rights = la.eig(self.A + self.B @ Q @ self.C, left=True)
        worst = int(np.argmax(values.real))
        y, x = lefts[:, worst], rights[:, worst]
        overlap = np.vdot(y, x)
        overlap = overlap if abs(overlap) > 1e-12 else 1e-12  # a defective pole: any direction
        slope = np.real(np.outer((y.conj() @ self.B) / overlap, self.C @ x))
        return (
            float(values[worst].real),
            self._back(left.T @ slope @ right.T),
            complex(values[worst]),
        )

    def norm(self, K: Matrices) -> tuple[float, Matrices | None, float]:
        """Return the H-infinity norm, its gradient by K, and the frequency [1] of the peak.

        Infinite, without a gradient, when the loop is not stable. At the peak with singular vectors
        u and v the gain changes by ``Re u* dT v``.
        """
        Q, left, right = self._feedback(K)
        A = self.A + self.B @ Q @ self.C
        if not np.all(np.isfinite(A)):
            return np.inf, None, 0.0
        B, C = self.B1 + self.B @ Q @ self.D21, self.C1 + self.D12 @ Q @ self.C
        D = self.p.D11 + self.D12 @ Q @ self.D21
        loop = StateSpace(A, B, C, D)
        if float(loop.poles().real.max(initial=-1.0)) >= -DECAY:
            return np.inf, None, 0.0
        gain, freq = peak_gain(loop)
        if not np.isfinite(gain):
            return np.inf, None, freq
        into: ComplexArray = np.asarray(self.D21, dtype=np.complex128)
        out: ComplexArray = np.asarray(self.D12, dtype=np.complex128)
        T: ComplexArray = np.asarray(D, dtype=np.complex128)
        if np.isfinite(freq) and A.size:
            solved = np.linalg.solve(
                2j * np.pi * freq * np.eye(A.shape[0]) - A, np.hstack([B, self.B])
            )
            driven, pushed = solved[:, : B.shape[1]], solved[:, B.shape[1] :]
            into, out, T = into + self.C @ driven, out + C @ pushed, T + C @ driven
        U, _, Vh = np.linalg.svd(T)
        slope = np.real(np.outer(U[:, 0].conj() @ out, into @ Vh[0].conj()))
        return gain, self._back(left.T @ slope @ right.T), freq

    def _feedback(self, K: Matrices) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Q, (I - K D22)^-1 and (I - D22 K)^-1 of a controller in the user's units."""
        p, root = self.p, np.sqrt(self.p.speed)
        all_ = np.block(
            [
                [K.A / p.speed, K.B @ self._in / root],
                [self._out @ K.C / root, self._out @ K.D @ self._in],
            ]
        )
        left = np.linalg.inv(np.eye(all_.shape[0]) - all_ @ self.D22)
        right = np.linalg.inv(np.eye(all_.shape[1]) - self.D22 @ all_)
        return np.asarray(left @ all_), np.asarray(left), np.asarray(right)

    def _back(self, slope: FloatArray) -> Matrices:
        """Return the gradient by the matrices in the user's units."""
        k, p, root = self.k, self.p, np.sqrt(self.p.speed)
        return Matrices(
            slope[:k, :k] / p.speed,
            slope[:k, k:] @ self._in.T / root,
            self._out.T @ slope[k:, :k] / root,
            self._out.T @ slope[k:, k:] @ self._in.T,
        )
