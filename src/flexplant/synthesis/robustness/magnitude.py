"""A filter of few states with a given magnitude, stable with a stable inverse."""

from __future__ import annotations

import numpy as np

from ...lti.statespace import StateSpace
from ...values import FloatArray

#: mean error of the logarithm with which a fit of fewer states is taken
_CLOSE = 0.05


def fitted_magnitude(omega: FloatArray, size: FloatArray, order: int) -> StateSpace:
    """Return ``k prod (s + a_i) / (s + b_i)`` near a magnitude, of at most some order.

    Least squares of the logarithm; the fewest factors that come close.
    """
    from scipy.optimize import least_squares  # not loaded with the package

    goal = np.log(np.maximum(size, 1e-12 * size.max()))
    at = np.log(omega)
    found = StateSpace([], [], [], [[float(np.exp(goal.mean()))]])
    if np.std(goal) < _CLOSE:
        return found
    for count in range(1, order + 1):
        corners = np.interp(np.linspace(0, 1, 2 * count + 2)[1:-1], np.linspace(0, 1, at.size), at)

        def error(q: FloatArray, n: int = count) -> FloatArray:
            a, b = np.exp(2 * q[1 : n + 1]), np.exp(2 * q[n + 1 :])
            square = omega[:, None] ** 2
            ratio = 0.5 * (np.log(square + a) - np.log(square + b)).sum(axis=1)
            return np.asarray(q[0] + ratio - goal)

        start = np.concatenate([[goal.mean()], corners[::2], corners[1::2]])
        best = least_squares(error, start, max_nfev=200)
        a, b = np.exp(best.x[1 : count + 1]), np.exp(best.x[count + 1 :])
        found = _product(float(np.exp(best.x[0])), a, b)
        if np.std(best.fun) < _CLOSE:
            break
    return found


def inverse(g: StateSpace) -> StateSpace:
    """Return the inverse of a filter of one input and output with feedthrough."""
    d = 1.0 / g.D[0, 0]
    return g.replace(A=g.A - d * g.B @ g.C, B=d * g.B, C=-d * g.C, D=[[d]])


def _product(k: float, a: FloatArray, b: FloatArray) -> StateSpace:
    """Return the factors in series, the gain in the last."""
    g = StateSpace([], [], [], [[k]])
    for zero, pole in zip(a, b, strict=True):
        root = np.sqrt(abs(zero - pole)) or 1.0
        one = StateSpace([[-pole]], [[root]], [[(zero - pole) / root]], [[1.0]])
        g = one * g
    return g
