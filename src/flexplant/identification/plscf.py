"""Poly-reference least-squares complex frequency (pLSCF): poles of matrix fractions.

[Peeters2004]_; [Cauberghe2004]_ (constraint).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..values import ComplexArray, FloatArray

#: part of the unit circle that the band is laid around; the rest separates its two ends
ARC = 0.9


@dataclass(frozen=True, eq=False)
class OrderPoles:
    """Poles of one model order: lambda (n,), shapes (n_out, n), participation (n_in, n)."""

    order: int
    poles: ComplexArray
    shapes: ComplexArray
    participation: ComplexArray


class Moments:
    r"""The normal equations of all model orders of a right matrix fraction.

    ``H(s_f) = B(z_f) A(z_f)^{-1}`` with polynomials ``A = sum_r A_r z^r`` (n_in, n_in) and
    ``B_o`` (1, n_in) is made linear by multiplication with A; the error of output o is

    .. math:: e_o(f) = w_o(f)\,\bigl(B_o(z_f) - H_o(z_f) A(z_f)\bigr).

    The band is laid around the unit circle, ``z = exp((s - s_0) \Delta t)``, where powers of z
    are nearly orthogonal: no other basis is needed for high orders, and coefficients are complex
    so that no order is spent on the conjugate poles outside the band. Every block of the
    normal equations is Toeplitz, and all orders share its moments.
    """

    def __init__(
        self, freq: FloatArray, data: ComplexArray, weight: FloatArray, order: int
    ) -> None:
        self.centre = np.pi * (freq[0] + freq[-1])
        self.step = 2 * np.pi * ARC / (2 * np.pi * (freq[-1] - freq[0]))
        z = np.exp(1j * (2 * np.pi * freq - self.centre) * self.step)
        lags = np.arange(-order, order + 1)
        powers = z[:, None] ** lags[None, :]
        squares = weight**2
        self.n_out, self.n_in = data.shape[:2]
        self.R = squares @ powers
        self.S = np.einsum("of,oif,fk->oik", squares, -data, powers, optimize=True)
        self.T = np.einsum("of,oif,ojf,fk->ijk", squares, data.conj(), data, powers, optimize=True)
        self.order = order

    def solve(self, order: int) -> OrderPoles:
        """Return the poles of one order."""
        A, B = self.fraction(order)
        return self._poles(order, A, B)

    def response(self, order: int, freq: FloatArray) -> ComplexArray:
        """Return the response (n_out, n_in, n_freq) of the matrix fraction of one order."""
        A, B = self.fraction(order)
        z = np.exp(1j * (2 * np.pi * freq - self.centre) * self.step)
        powers = z[None, :] ** np.arange(order + 1)[:, None]
        below = np.einsum("rij,rf->fji", A, powers)
        above = np.einsum("orj,rf->fjo", B, powers)
        return np.asarray(np.linalg.solve(below, above).transpose(2, 1, 0))

    def fraction(self, order: int) -> tuple[ComplexArray, ComplexArray]:
        """Return A (order + 1, n_in, n_in) with A_0 = I and B (n_out, order + 1, n_in).

        This constraint makes the mathematical poles unstable and leaves the physical ones
        stable, which is what makes the stabilisation diagram clear [Cauberghe2004]_.
        """
        n, m = order + 1, self.n_in
        toeplitz = np.arange(n)[None, :] - np.arange(n)[:, None] + self.order
        big = self.T[:, :, toeplitz].transpose(2, 0, 3, 1).reshape(n * m, n * m)
        numerators = []
        for o in range(self.n_out):
            R = self.R[o][toeplitz]
            # columns: coefficient r of A, channel i
            S = self.S[o][:, toeplitz].transpose(1, 2, 0).reshape(n, n * m)
            solved = _solved(R, S)
            big = big - S.conj().T @ solved
            numerators.append(-solved)
        free: Any = -_solved(big[m:, m:], big[m:, :m])
        A = np.concatenate([np.eye(m, dtype=np.complex128), free])
        B = np.array([part @ A for part in numerators])
        return A.reshape(n, m, m), B

    def _poles(self, order: int, A: ComplexArray, B: ComplexArray) -> OrderPoles:
        # in v = 1/z the polynomial is monic: its companion matrix needs no inverse
        m = self.n_in
        companion = np.eye(order * m, k=-m, dtype=np.complex128)
        companion[:m] = -A[1:].transpose(1, 0, 2).reshape(m, order * m)
        solved: Any = la.eig(companion, left=True, right=True)
        v, left, right = solved
        keep = np.abs(v) > 1e-8
        v, left, right = v[keep], left[:m, keep].conj(), right[-m:, keep]
        z = 1.0 / v
        powers = z[None, :] ** np.arange(order + 1)[:, None]
        values = np.einsum("orm,rk,mk->ok", B, powers, right)
        poles = np.log(z) / self.step + 1j * self.centre
        size = np.linalg.norm(values, axis=0)
        seen = size > 0
        return OrderPoles(
            order,
            poles[seen],
            values[:, seen] / size[seen],
            left[:, seen] / np.linalg.norm(left[:, seen], axis=0),
        )


def _solved(matrix: ComplexArray, right: ComplexArray) -> ComplexArray:
    # data without noise leave orders above the true one undetermined: the smallest solution then
    return np.asarray(la.lstsq(matrix, right, cond=1e-13, lapack_driver="gelsd")[0])
