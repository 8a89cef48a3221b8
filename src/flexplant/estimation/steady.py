"""The gains of a filter: of one covariance, and the stationary ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..lti.lyapunov import solve_stein
from ..values import FloatArray
from .filter_model import FilterModel
from .sight import Sight


class FilterGains(NamedTuple):
    """L, K and the whitening W of the innovations, zeros at sensors that are missing."""

    L: FloatArray
    K: FloatArray
    W: FloatArray


def gains(model: FilterModel, P: FloatArray, seen: FloatArray) -> FilterGains:
    """Return the gains of a covariance P before the measurement, for the sensors that are there."""
    M = P @ model.C2.T
    S = model.C2 @ M + model.R
    W = np.zeros_like(S)
    there = np.flatnonzero(seen)
    if there.size:
        at = np.ix_(there, there)
        W[at] = np.linalg.inv(np.linalg.cholesky(0.5 * (S + S.T)[at]))
    weight = W.T @ W
    L = M @ weight
    return FilterGains(L, model.A @ L + model.S @ weight, W)


class Steady:
    """The stationary filter of a model in states and sensors of unit variance."""

    def __init__(self, model: FilterModel, P: FloatArray) -> None:
        self.model, self.P = model, P
        self.gains = gains(model, P, np.ones(model.C2.shape[0], dtype=bool))
        self.F = model.A - self.gains.K @ model.C2

    def variances(
        self, sight: Sight, P: FloatArray, g: FilterGains, *, predict: bool
    ) -> FloatArray:
        """Return the variances (1 or k, nz) of the estimates of a covariance P and its gains.

        ``(C1 - L_z C2) P (C1 - L_z C2)' + V - L_z N' - N L_z' + L_z R L_z'``: Joseph's form.
        """
        m, n = self.model, P.shape[0]
        C1, N = sight.c[:, :, :n], sight.c[:, :, n:]
        L_z = sight.c @ self.entering(g, predict=predict)
        left = C1 - L_z @ m.C2
        own = np.sum((left @ P) * left, axis=2)
        return np.asarray(own + sight.V + np.sum((L_z @ m.R - 2.0 * N) * L_z, axis=2))

    def entering(self, g: FilterGains, *, predict: bool) -> FloatArray:
        """Return how an innovation enters [x; b] (n + ny, ny)."""
        both = np.vstack([g.L, g.W.T @ g.W])
        return np.zeros_like(both) if predict else both

    def onward(self, P: FloatArray, g: FilterGains) -> FloatArray:
        """Return the rows (n + ny, n) by which a later adjoint enters [x; b]."""
        closed = self.model.A - g.K @ self.model.C2
        return np.vstack([P @ closed.T, -g.K.T])

    def weight(self, sight: Sight) -> FloatArray:
        """Return Y: ``trace(Y dP)`` is what dP adds to all later variances, relative to them."""
        n = self.model.A.shape[0]
        some = np.unique(np.linspace(0, sight.c.shape[0] - 1, 50).astype(np.int64))
        chosen = Sight(*(part[some] for part in sight))
        size = np.sqrt(self.variances(chosen, self.P, self.gains, predict=False))
        rows = (chosen.c[:, :, :n] / size[:, :, None] / np.sqrt(some.size)).reshape(-1, n)
        H = np.vstack([self.gains.W @ self.model.C2, rows])
        return solve_stein(self.F.T, H.T @ H)
