"""Minimising functions that are not smooth where it matters: BFGS, then gradient sampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..values import FloatArray

#: value (infinite where not defined) and gradient
Function: TypeAlias = Callable[[FloatArray], tuple[float, FloatArray]]

#: weak Wolfe conditions, and steps of their bisection
_ARMIJO, _WOLFE, _BISECTIONS = 1e-4, 0.9, 30
#: so many steps that gain less than this part together end BFGS (parameters that run to infinity
#: gain little for ever)
_PATIENCE, _GAIN = 5, 1e-5
#: radii of the gradient sampling, beside the size of the parameters; samples per parameter
_RADII, _SAMPLES = (1e-2, 1e-3, 1e-4, 1e-5), 2.0
#: most samples, most steps at one radius, and what one has to gain
_MOST, _STEPS, _STEP_GAIN = 60, 12, 1e-6


@dataclass(frozen=True)
class Minimum:
    """Where a minimisation ended.

    Parameters
    ----------
    x : (n,) array
        The parameters.
    value : float
        The function there.
    slope : float
        Norm of the smallest convex combination of the gradients sampled around x.
    radius : float
        Within this distance; infinite when nothing was sampled.
    evaluations : int
        Calls of the function.
    """

    x: FloatArray
    value: float
    slope: float
    radius: float
    evaluations: int

    @property
    def decrease(self) -> float:
        """What a step within the radius would lower the value by to first order, relative to it."""
        return float(self.slope * self.radius / abs(self.value)) if self.value else 0.0


def bfgs(
    function: Function, x: FloatArray, *, enough: float, steps: int, out_of_time: Callable[[], bool]
) -> tuple[FloatArray, float]:
    """Return where BFGS with a weak Wolfe line search ends, and the value there.

    Parameters
    ----------
    function : function
        Value and gradient.
    x : (n,) array
        The start, with a finite value.
    enough : float
        It stops below this value.
    steps : int
        At most.
    out_of_time : function
        It stops when this is true.

    References
    ----------
    [LewisOverton2013]_.
    """
    value, gradient = function(x)
    H, values = np.eye(x.size), [value]
    for _ in range(steps):
        if value < enough or out_of_time() or not np.any(gradient):
            break
        direction = -H @ gradient
        slope = float(gradient @ direction)
        if not slope < 0.0:
            H, direction = np.eye(x.size), -gradient
            slope = -float(gradient @ gradient)
        found = _line_search(function, x, value, direction, slope, out_of_time)
        if found is None:
            break
        step, new, at = found
        s, change = step * direction, at - gradient
        x, value, gradient = x + s, new, at
        curvature = float(s @ change)
        if curvature > 1e-14 * float(np.linalg.norm(s) * np.linalg.norm(change)):
            if np.array_equal(H, np.eye(x.size)):
                H = H * (curvature / float(change @ change))
            rho = 1.0 / curvature
            left = np.eye(x.size) - rho * np.outer(s, change)
            H = left @ H @ left.T + rho * np.outer(s, s)
        values.append(value)
        if len(values) > _PATIENCE and values[-_PATIENCE - 1] - value <= _GAIN * abs(value):
            break
    return x, value


def _line_search(
    function: Function,
    x: FloatArray,
    value: float,
    direction: FloatArray,
    slope: float,
    out_of_time: Callable[[], bool],
) -> tuple[float, float, FloatArray] | None:
    """Return a step of the weak Wolfe conditions, or the best that decreases; None without."""
    low, high, step = 0.0, np.inf, 1.0
    best: tuple[float, float, FloatArray] | None = None
    for _ in range(_BISECTIONS):
        new, gradient = function(x + step * direction)
        if not new <= value + _ARMIJO * step * slope:
            high = step
        else:
            if best is None or new < best[1]:
                best = step, new, gradient
            if float(gradient @ direction) >= _WOLFE * slope or out_of_time():
                return step, new, gradient
            low = step
        step = 0.5 * (low + high) if np.isfinite(high) else 2.0 * low
    return best


def sampled_minimum(
    function: Function,
    x: FloatArray,
    value: float,
    *,
    rng: np.random.Generator,
    out_of_time: Callable[[], bool],
) -> Minimum:
    """Return the minimum near x by gradient sampling, with the report on its optimality.

    At a kink no gradient is small; the smallest convex combination of gradients around it is.

    Parameters
    ----------
    function : function
        Value and gradient.
    x, value : (n,) array, float
        Where BFGS ended.
    rng : Generator
        Draws the samples.
    out_of_time : function
        It stops when this is true.

    References
    ----------
    [Burke2005]_.
    """
    count = int(min(_MOST, _SAMPLES * x.size + 1))
    evaluations, slope, reached = 0, np.inf, np.inf
    for part in _RADII:
        radius = part * max(1.0, float(np.linalg.norm(x)))
        for _ in range(_STEPS):
            if out_of_time():
                return Minimum(x, value, slope, reached, evaluations)
            steps = rng.standard_normal((count, x.size))
            steps *= (rng.random(count) ** (1.0 / x.size) / np.linalg.norm(steps, axis=1))[:, None]
            steps[0] = 0.0
            near = [function(x + radius * one) for one in steps]
            evaluations += count
            gradients = np.array([g for v, g in near if np.isfinite(v)])
            downhill = smallest_combination(gradients)
            slope, reached = float(np.linalg.norm(downhill)), radius
            if slope * radius <= _STEP_GAIN * abs(value):
                break
            step, found = radius, False
            for _ in range(_BISECTIONS // 2):
                new, _ = function(x - step * downhill / slope)
                evaluations += 1
                if new < value - 1e-6 * step * slope:
                    x, value, found = x - step * downhill / slope, new, True
                    break
                step *= 0.5
            if not found:
                break
    return Minimum(x, value, slope, reached, evaluations)


def smallest_combination(gradients: FloatArray) -> FloatArray:
    """Return the convex combination of gradients (rows) that has the smallest norm.

    With weights t mu, sum(mu) = 1, the least of ``|G' t mu|^2 + (t - 1)^2`` grows with ``|G' mu|``:
    a problem of least squares with non-negative unknowns.
    """
    from scipy.optimize import nnls

    size = float(np.linalg.norm(gradients, axis=1).max())
    if not size:
        return np.zeros(gradients.shape[1])
    count = gradients.shape[0]
    left = np.vstack([gradients.T / size, np.ones((1, count))])
    weights, _ = nnls(left, np.append(np.zeros(gradients.shape[1]), 1.0))
    return np.asarray(gradients.T @ (weights / weights.sum()))
