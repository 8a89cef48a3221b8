"""Minimising the largest of many smooth functions: models of all that are near it, at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray
from ...tolerances import FOUR_DIGITS, MOST_STEPS, NEGLIGIBLE, SAME, TINY, TYPED

#: value (infinite where not defined) and gradient
Function: TypeAlias = Callable[[FloatArray], tuple[float, FloatArray]]

#: weak Wolfe conditions, and steps of their bisection
_ARMIJO, _WOLFE, _BISECTIONS = 1e-4, 0.9, 30
#: number of steps whose total gain below this limit ends a search (the gain becomes ever smaller
#: where parameters grow without bound)
_STALLED, _GAIN = 8, FOUR_DIGITS
#: the first step, relative to the size of the parameters
_FIRST = 0.3
#: fraction of the decrease of the model that a step has to reach; below and above which the model
#: is trusted less and more
_ENOUGH, _POOR, _GOOD = 0.05, 0.3, 0.7
#: factor of the damping after a step that is poor or refused, its reciprocal after a good one
_MORE = 3.0


class Pieces(NamedTuple):
    """Smooth functions of x near the largest: values (k,), gradients (k, n), Hessian of one."""

    value: FloatArray
    gradient: FloatArray
    hessian: Callable[[int], FloatArray]

    def and_those(self, other: Pieces) -> Pieces:
        """Return these pieces and others."""
        count = self.value.size
        return Pieces(
            np.concatenate([self.value, other.value]),
            np.concatenate([self.gradient, other.gradient]),
            lambda i: self.hessian(i) if i < count else other.hessian(i - count),
        )


class Maximum(Protocol):
    """The largest of many smooth functions of x, each of a place, such as a frequency."""

    def value(self, theta: FloatArray, /) -> tuple[float, Any]:
        """Return the largest value, infinite where it is not defined, and its place."""

    def pieces(self, theta: FloatArray, /) -> Pieces:
        """Return all functions near the largest, itself among them."""

    def piece(self, theta: FloatArray, place: Any, /) -> Pieces:
        """Return the functions of one place."""


class Minimum(NamedTuple):
    """Where a minimisation ended."""

    x: FloatArray
    value: float
    settled: bool


def bfgs(
    function: Function,
    x: FloatArray,
    *,
    enough: float,
    steps: int,
    spent: Callable[[], bool] = lambda: False,
) -> tuple[FloatArray, float]:
    """Return where BFGS with a weak Wolfe line search ends, and the value there."""
    # stops below the value `enough`, after a number of steps, and when `spent` is true
    # [LewisOverton2013]_
    value, gradient = function(x)
    H, values = np.eye(x.size), [value]
    for _ in range(steps):
        if value < enough or spent() or not np.any(gradient):
            break
        direction = -H @ gradient
        slope = float(gradient @ direction)
        if not slope < 0.0:
            H, direction = np.eye(x.size), -gradient
            slope = -float(gradient @ gradient)
        found = _line_search(function, x, value, direction, slope)
        if found is None:
            break
        step, new, at = found
        s, change = step * direction, at - gradient
        x, value, gradient = x + s, new, at
        curvature = float(s @ change)
        # no update from rounding: H stays positive definite
        if curvature > 1e-14 * float(np.linalg.norm(s) * np.linalg.norm(change)):
            if np.array_equal(H, np.eye(x.size)):
                H = H * (curvature / float(change @ change))
            rho = 1.0 / curvature
            left = np.eye(x.size) - rho * np.outer(s, change)
            H = left @ H @ left.T + rho * np.outer(s, s)
        values.append(value)
        if len(values) > _STALLED and values[-_STALLED - 1] - value <= 0.1 * _GAIN * abs(value):
            break
    return x, value


def _line_search(
    function: Function, x: FloatArray, value: float, direction: FloatArray, slope: float
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
            if float(gradient @ direction) >= _WOLFE * slope:
                return step, new, gradient
            low = step
        step = 0.5 * (low + high) if np.isfinite(high) else 2.0 * low
    return best


def minimax(
    function: Maximum, x: FloatArray, *, steps: int, spent: Callable[[], bool] = lambda: False
) -> Minimum:
    """Return a local minimum of the largest function near x."""
    # each step minimises `max_i (f_i + g_i' d) + d' (|H| + mu I) d / 2`, H the Hessian of the
    # functions weighted as the step weights their gradients, |H| with its negative eigenvalues
    # turned round. A step that another peak refuses is tried again with the model of that peak, at
    # x, and a larger mu. It stops after a number of steps, or when `spent` is true.
    # [ApkarianNoll2006]_
    value, _ = function.value(x)
    pieces, weights, mu = function.pieces(x), None, None
    values, refused = [value], 0
    while len(values) <= steps and refused < MOST_STEPS and not spent():
        if mu is None:
            slope = float(np.linalg.norm(pieces.gradient[np.argmax(pieces.value)]))
            if not slope:  # the number does not depend on the parameters here
                break
            mu = slope / (_FIRST * max(1.0, float(np.linalg.norm(x))))
        model = _Model(pieces, value, weights)
        step, weights, decrease = model.step(mu)
        if decrease <= TYPED:
            far = float(np.linalg.norm(step)) >= max(1.0, float(np.linalg.norm(x)))
            if refused or far or mu <= 1e-3 * model.size:  # hardly damped
                break
            mu *= 1e-2
            continue
        new, place = function.value(x + step)
        part = (value - new) / decrease
        if part >= _ENOUGH:
            x, value, refused, weights = x + step, new, 0, None
            pieces = function.pieces(x)
            values.append(value)
            mu *= 1.0 / _MORE if part > _GOOD else _MORE if part < _POOR else 1.0
            if len(values) > _STALLED and values[-_STALLED - 1] - value <= _GAIN:
                break
        else:
            refused += 1
            if np.isfinite(new):
                pieces = pieces.and_those(function.piece(x, place))
                weights = np.append(weights, np.zeros(pieces.value.size - weights.size))
            mu *= _MORE
    return Minimum(x, value, len(values) <= steps and refused < MOST_STEPS and not spent())


class _Model:
    """Gradients of pieces in the directions of |H|, H of the weights that the step finds."""

    def __init__(self, pieces: Pieces, value: float, weights: FloatArray | None) -> None:
        self.pieces, self.below = pieces, pieces.value - value
        if weights is None:  # of the largest alone
            weights = (np.arange(self.below.size) == np.argmax(self.below)).astype(float)
        self.weights = weights

    def step(self, mu: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the step, the weights of the pieces, and by how much the largest decreases."""
        weights = self.weights
        for _ in range(2):  # the weights of the first give the Hessian of the second
            active = np.flatnonzero(weights > SAME).tolist()
            values, vectors = la.eigh(sum(weights[i] * self.pieces.hessian(i) for i in active))
            self.size = float(np.abs(values).max())
            root = np.sqrt(np.abs(values) + mu)
            weights, y = downhill(self.pieces.gradient @ vectors / root, self.below)
            step = vectors @ (y / root)
        return step, weights, -float(np.max(self.below + self.pieces.gradient @ step))


def downhill(gradients: FloatArray, below: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights and the minimum y of ``max_i (c_i + g_i' y) + |y|^2 / 2``."""
    # y = -G' w with w >= 0, sum(w) = 1: the point of a polyhedron next to the origin
    # [LawsonHanson1995]_
    from scipy.optimize import nnls

    size = max(float(np.linalg.norm(gradients, axis=1).max()), np.sqrt(TINY))
    # small against the rest of the quadratic program, large against the rounding of its squares
    lift = NEGLIGIBLE
    G, c = gradients / size, np.maximum(below / size**2, -1.0 / lift)
    lifted = np.vstack([-lift * G.T, np.ones((1, c.size)), lift * c[None] + 1.0 / lift])
    right = np.zeros(lifted.shape[0])
    right[-1] = 1.0
    weights, _ = nnls(lifted, right, maxiter=100 * c.size)
    weights = weights / weights.sum()
    return weights, -size * (G.T @ weights)


def decrease_left(pieces: Pieces, radius: float) -> tuple[float, float]:
    """Return the least slope of convex combinations of the gradients, and the decrease left."""
    # -min_(|d| <= r) max_i (c_i + g_i' d), by bisection over the weight of |d|^2
    below = pieces.value - pieces.value.max()
    top = pieces.gradient[np.argmax(below)]
    low, high = 0.0, np.log(1e3 * (1.0 + float(np.linalg.norm(top)) / radius))
    low, slope, gained = -high, 0.0, 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        root = np.exp(0.5 * middle)
        weights, y = downhill(pieces.gradient / root, below)
        step = y / root
        if float(np.linalg.norm(step)) > radius:
            low = middle
        else:
            high = middle
            slope = float(np.linalg.norm(weights @ pieces.gradient))
            gained = max(gained, -float(np.max(below + pieces.gradient @ step)))
    return slope, gained
