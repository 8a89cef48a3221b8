"""What measured mode shapes say of the scatter that mixes the modes of a machine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, divisor
from ..tolerances import ROUNDING, SAME, TINY

#: trial variances of the noise, over the decades of rounding: 15 % apart
_VARIANCES = 200


class MeasuredShapes:
    """Mode shapes measured at n places, which condition draws of the scatter E of stiffness.

    A machine of stiffness ``Omega exp(E) Omega`` has, to first order, the mode shapes
    ``phi_i + sum_j g_ij E_ij phi_j`` with ``g_ij = w_i w_j / (w_i^2 - w_j^2)``; a rigid-body motion
    j has ``g_ij = -1``, because its E is mass. The difference r (k,) of the measured shapes and the
    model's is therefore ``r = G E + noise``, with the scale of each shape removed. Close pairs,
    whose shapes mix by more than a small angle, say nothing of the scatter within the pair.
    The noise contains errors of the model's shapes. Its variance v is drawn from its posterior, by
    ``r ~ N(0, G C G' + v I)`` with the covariance C of E.

    Parameters
    ----------
    seen : (n, b) array
        Rows of the places over the modes.
    shapes : (n, m) array
        Measured shapes, each of any scale.
    omega : (b,) array [rad/s]
        Frequencies, rigid-body motions first.
    measured : (m,) array of int
        Places of the measured modes among the modes.
    pairs : sequence of pairs of int
        Places of close pairs among the measured modes.
    covariance : (b, b) array
        Variances of the elements of E for a relative deviation of the frequencies of 1.
    deviation : float
        Relative deviation of the frequencies.
    """

    def __init__(
        self,
        seen: FloatArray,
        shapes: ComplexArray,
        omega: FloatArray,
        measured: IntArray,
        pairs: Sequence[tuple[int, int]],
        covariance: FloatArray,
        deviation: float,
    ) -> None:
        self.measured, self.covariance, self.omega = measured, covariance, omega
        own = omega[measured, None]
        gap = own**2 - omega**2
        gains = np.divide(
            own * omega, gap, out=np.zeros_like(gap), where=np.abs(gap) > SAME * own**2
        )
        gains[:, omega == 0.0] = -1.0
        self._near = np.zeros(gains.shape, dtype=bool)
        n, m = len(seen), len(measured)
        self.rows, self.effects = np.zeros((2, m, n, omega.size))
        self.off, count = np.zeros((m, n)), 0
        for k, i in enumerate(measured.tolist()):
            near = [k, *(sum(pair) - k for pair in pairs if k in pair)]
            self._near[k, measured[near]] = True
            gains[k, self._near[k]] = 0.0
            plane = la.orth(seen[:, measured[near]])
            apart = (np.eye(n) - plane @ plane.T) / divisor(la.norm(seen[:, i]))
            self.rows[k] = apart @ seen
            self.effects[k] = self.rows[k] * gains[k]
            scale = np.vdot(shapes[:, k], seen[:, i]) / divisor(la.norm(shapes[:, k]) ** 2)
            self.off[k] = apart @ (scale * shapes[:, k]).real
            count += n - plane.shape[1]
        values, self._vectors = la.eigh(self._prior())
        self._values = np.where(values > ROUNDING * values[-1], values, 0.0)
        self.variances, self.chances = self._noise(count, deviation)

    def _prior(self) -> FloatArray:
        """Return G C G' (m n, m n): two measured modes share one element of E."""
        m, n, _ = self.effects.shape
        of = self.covariance[self.measured]
        A = np.zeros((m, n, m, n))
        each = np.arange(m)
        A[each, :, each, :] = np.einsum("knb,kb,kpb->knp", self.effects, of, self.effects)
        both = self.effects[:, :, self.measured]
        A += np.einsum("knl,kl,lpk->knlp", both, of[:, self.measured], both)
        return A.reshape(m * n, m * n)

    def _noise(self, count: int, deviation: float) -> tuple[FloatArray, FloatArray]:
        """Return trial variances of the noise and their posterior probabilities.

        Its standard deviation has a flat prior between rounding and all of the misfit.
        """
        misfit = (self._vectors.T @ self.off.ravel()) ** 2
        most = max(float(misfit.sum()) / max(count, 1), TINY)
        v = most * np.geomspace(ROUNDING, 1.0, _VARIANCES)
        of = deviation**2 * self._values[:, None] + v
        # directions along the shapes have no misfit, because their scale was removed
        log = (misfit.size - count + 1) * np.log(v) - np.sum(
            np.log(of) + misfit[:, None] / of, axis=0
        )
        chance = np.exp(0.5 * (log - log.max()))
        return v, chance / chance.sum()

    def given(
        self, M: FloatArray, K: FloatArray, deviation: float, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Return mass and stiffness (b, b) of a draw, conditioned on the shapes by Matheron's rule.

        What its shapes miss is taken to first order, with all that moves them.
        """
        own, size = self.measured, np.diag(K) / np.diag(M)
        gap = size[own, None] - size
        mixed = (K[own] - size[own, None] * M[own]) / np.where(gap == 0.0, np.inf, gap)
        mixed[self._near] = 0.0
        v = rng.choice(self.variances, p=self.chances)
        noise = np.sqrt(v) * rng.standard_normal(self.off.shape)
        missed = self.off - np.einsum("knb,kb->kn", self.rows, mixed) - noise
        left = self._vectors.T @ missed.ravel()
        left /= deviation**2 * self._values + v
        left[self._values == 0.0] = 0.0
        weights = (self._vectors @ left).reshape(self.off.shape)
        moved = np.zeros_like(K)
        moved[own] = np.einsum("knb,kn->kb", self.effects, weights)
        E = deviation**2 * self.covariance * (moved + moved.T)
        rigid = (self.omega == 0.0) | (self.omega[:, None] == 0.0)
        return M + np.where(rigid, E, 0.0), K + self.omega[:, None] * E * self.omega
