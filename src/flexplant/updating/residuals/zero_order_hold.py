"""The model behind a zero-order hold, sampled exactly, and its derivatives."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la

from ...errors import ModelError
from ...values import ComplexArray, FloatArray
from ..point_model import Point


class Held:
    """``x[k+1] = A x[k] + Gamma_1 u[k-n] + Gamma_0 u[k-n-1]`` of ``M q'' + D q' + K q = B u``.

    All from one exponential of ``S = [0 s 0; -M^-1 K/s  -M^-1 D  M^-1 B; 0 0 0]``, with the states
    (s q, q', u) of one size, and its Frechet derivatives: exact with rigid-body modes, real poles
    and repeated ones, where sums over modes are not.
    """

    def __init__(
        self, point: Point, B: FloatArray, C: FloatArray, *, rate: float, delay: float, order: int
    ) -> None:
        self.point, self.T = point, 1 / rate
        if point.family.condensed:
            raise ModelError(
                "a zero-order hold needs a mass in every coordinate, and this model has some "
                "without. Reduce it with DesiredDofs or CraigBampton, or divide the hold out of "
                "the measurement and leave hold= out."
            )
        M, D, K = point.matrices
        k, i = B.shape
        self.k, self.i = k, i
        self.whole, self.part = divmod(delay, 1.0)
        self.size = np.maximum(np.sqrt(np.abs(np.diag(K) / np.diag(M))), rate)
        self.factor = la.cho_factor(M, check_finite=False)
        moved = la.cho_solve(self.factor, np.hstack([K, D, B]), check_finite=False)
        self.MK, self.MD, self.MB = moved[:, :k], moved[:, k : 2 * k], moved[:, 2 * k :]
        # inputs in units that make their column as large as the others
        self.unit = max(float(np.abs(self.MB).max(initial=0.0)) * self.T, 1e-300)
        S = np.zeros((2 * k + i, 2 * k + i))
        S[np.arange(k), k + np.arange(k)] = self.size
        S[k : 2 * k] = np.hstack([-self.MK / self.size, -self.MD, self.MB / self.unit])
        self.S = S * self.T
        self.C = np.zeros((C.shape[0], 2 * k))
        if order:
            self.C[:, k:] = C
        else:
            self.C[:, :k] = C / self.size

    def responses(self, omega: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return H (l, o, i), and what its slopes take: z and the states X (l, 2k, i)."""
        z = np.exp(1j * omega * self.T)
        late = z ** (-self.whole) * self.unit
        A = self.stepped[: 2 * self.k, : 2 * self.k]
        X = np.linalg.solve(z[:, None, None] * np.eye(2 * self.k) - A, self._inputs(z, self._gains))
        X = X * late[:, None, None]
        return np.matmul(self.C, X), z, X

    def slopes(self, z: ComplexArray, X: ComplexArray) -> ComplexArray:
        """Return dH / dp (q, l, o, i) = Y^T (dA X + dGamma)."""
        n = 2 * self.k
        late = z ** (-self.whole) * self.unit
        A = self.stepped[:n, :n]
        turned = z[:, None, None] * np.eye(n) - A.T
        Y = np.linalg.solve(turned, np.broadcast_to(self.C.T + 0j, (z.size, *self.C.T.shape)))
        found = np.zeros((self.point.p.size, z.size, self.C.shape[0], self.i), complex)
        for b, direction in enumerate(self._directions()):
            moved = _moved(self.S, direction)
            part = moved[:n, n:]
            if self.part:
                share = 1 - self.part
                part = _moved(share * self.S, share * direction)[:n, n:]
            gains = part, moved[:n, n:] - part
            pushed = np.matmul(moved[:n, :n], X) + late[:, None, None] * self._inputs(z, gains)
            found[b] = np.matmul(Y.transpose(0, 2, 1), pushed)
        return found

    def zeros(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the zeros (m,) of one input to one output as s = ln(z)/T, and ds/dp (m, q).

        Those of the upper half plane, below half the rate. ``[A - z, Gamma; C, 0] [x; u] = 0`` with
        ``y`` from the left: ``dz = y^T (dA x + dGamma u) / y^T x``.
        """
        n = 2 * self.k
        row = self.C / np.abs(self.C).max()
        gain = self.stepped[:n, n:]
        size = max(float(np.abs(gain).max()), 1e-300)
        system = np.block([[self.stepped[:n, :n], gain / size], [row, np.zeros((1, 1))]])
        unit = np.diag(np.append(np.ones(n), 0.0))
        solve: Any = la.eig
        (alpha, beta), left, right = solve(system, unit, left=True, homogeneous_eigvals=True)
        # what is infinite has beta of rounding
        kept = np.flatnonzero(np.abs(beta) > 1e-10 * np.abs(alpha))
        z = alpha[kept] / beta[kept]
        s = np.log(np.where(z == 0, 1e-300, z)) / self.T
        upper = (s.imag > 1e-9 / self.T) & (s.imag < (np.pi - 1e-9) / self.T)
        kept, z, s = kept[upper], z[upper], s[upper]
        x, u = right[:n, kept], right[n:, kept] / size
        y = left[:n, kept].conj()
        scale = np.sum(y * x, axis=0) * z * self.T
        slopes = np.zeros((z.size, self.point.p.size), dtype=np.complex128)
        for b, direction in enumerate(self._directions()):
            moved = _moved(self.S, direction)
            slopes[:, b] = np.sum(y * (moved[:n, :n] @ x + moved[:n, n:] @ u), axis=0) / scale
        return np.asarray(s, dtype=np.complex128), slopes

    @cached_property
    def stepped(self) -> FloatArray:
        """The exponential over one sample."""
        return np.asarray(la.expm(self.S), dtype=np.float64)

    @cached_property
    def _gains(self) -> tuple[FloatArray, FloatArray]:
        """Gamma of the newer input and of the older one, which acts for the delay's fraction."""
        n = 2 * self.k
        all_ = self.stepped[:n, n:]
        newer = la.expm((1 - self.part) * self.S)[:n, n:] if self.part else all_
        return newer, all_ - newer

    def _inputs(self, z: ComplexArray, gains: tuple[FloatArray, FloatArray]) -> ComplexArray:
        newer, older = gains
        return newer[None] + older[None] / z[:, None, None]

    def _directions(self) -> list[FloatArray]:
        """Return dS of every parameter."""
        family, k = self.point.family, self.k
        found = []
        for dM, dD, dK in zip(family.dM, family.dD, family.dK, strict=True):
            right = np.hstack(
                [
                    -(dK - dM @ self.MK) / self.size,
                    -(dD - dM @ self.MD),
                    -(dM @ self.MB) / self.unit,
                ]
            )
            dS = np.zeros_like(self.S)
            dS[k : 2 * k] = self.T * la.cho_solve(self.factor, right, check_finite=False)
            found.append(dS)
        return found


def _moved(S: FloatArray, dS: FloatArray) -> FloatArray:
    """Return the derivative of e^S in the direction dS."""
    moved: Any = la.expm_frechet(S, dS, compute_expm=False, check_finite=False)
    return np.asarray(moved, dtype=np.float64)
