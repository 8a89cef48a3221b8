"""A stationary quadratic cost as a function of which candidates are used: one Riccati each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from ..errors import SolverError
from ..lti.lyapunov import doubled
from ..lti.riccati import control_dare
from ..values import FloatArray, IntArray, Value
from .criterion import Scorer

#: a doubling has converged when every diagonal entry grows by less than this: the next one would
#: add the square of it
CONVERGED = 1e-8
DOUBLINGS = 50
#: largest residual of the Riccati equation, relative, that is taken without another solver
RESIDUAL = 1e-10
#: steps of the relaxation, and the relative gap at which it stops
STEPS, GAP = 60, 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class Quadratic(Value, Scorer):
    """``J(w) = tr(S X+ S') + constant`` with weights w of the candidates.

    ::

        X = A' X+ A + H,    X+ = (X^-1 + G)^-1,    G = sum_i w_i g_i g_i'

    For a filter X is the covariance of the state before and X+ after the measurement (A is the
    transpose of the plant's), g_i = c_i / (standard deviation of sensor i). For a controller X is
    the cost to go and g_i = b_i / (weight of effort i). More candidates never cost more.

    Parameters
    ----------
    A, H : (n, n) arrays
        In states in which X has a diagonal near one (see `quadratic`).
    S : (k, n) array
        What the cost looks at.
    items : (N, n) array
        g_i, one row per candidate.
    owned : (N, m) array of int
        States that are there only with their candidate (the last of a delay line).
    constant : float
        What no candidate can change.
    """

    A: FloatArray
    H: FloatArray
    S: FloatArray
    items: FloatArray
    owned: IntArray
    constant: float

    def __post_init__(self) -> None:
        self._set(A=self.A, H=self.H, S=self.S, items=self.items, owned=self.owned)

    def value(self, chosen: Sequence[int]) -> float:
        """Return J with some candidates.

        Raises
        ------
        SolverError
            When no stationary solution exists.
        """
        rows = np.sort(np.asarray(chosen, dtype=np.int64))
        keep = np.ones(self.A.shape[0], dtype=bool)
        if self.owned.size:
            keep[self.owned.ravel()] = False
            keep[self.owned[rows].ravel()] = True
        inner = np.ix_(keep, keep)
        g = self.items[rows][:, keep]
        S, A, H = self.S[:, keep], self.A[inner], self.H[inner]
        return _cost(S, solved(A, H, g), g) + self.constant

    def relaxed(self, weights: FloatArray) -> tuple[float, FloatArray]:
        """Return J and its gradient (N,) at weights of the candidates.

        ``dX+ = M dX+ M' - X+ dG X+`` with ``M = (I - K g) A'``, so with the adjoint Stein
        equation ``Y = M' Y M + S' S`` the gradient is ``-g_i' X+ Y X+ g_i``.
        """
        g = np.sqrt(weights)[:, None] * self.items
        used = weights > 0
        X = solved(self.A, self.H, g[used])
        gain = _gain(X, g[used])
        left = np.eye(X.shape[0]) - gain @ g[used]
        after = left @ X @ left.T + gain @ gain.T
        adjoint = doubled(self.A @ left.T, self.S.T @ self.S)
        seen = self.items @ after
        gradient = -np.einsum("ij,jk,ik->i", seen, adjoint, seen)
        return _cost(self.S, X, g[used]) + self.constant, gradient

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return a lower bound of J over all choices of `count` candidates.

        J is convex in the weights: the information ``(X+)^-1`` is the limit of iterates that are
        concave in w (a parallel sum is), and the trace of an inverse is convex and decreasing. So
        J at any weights plus its slope towards the best choice bounds J at every choice
        (Frank-Wolfe, whose steps only sharpen the bound).
        """
        free = np.setdiff1d(np.arange(self.items.shape[0]), required)
        chosen = count - len(required)
        everything = self.value(range(self.items.shape[0]))
        weights = np.ones(self.items.shape[0])
        if free.size:
            weights[free] = chosen / free.size
        best = everything
        for step in range(STEPS):
            try:
                value, gradient = self.relaxed(weights)
            except SolverError:
                break
            vertex = np.ones_like(weights)
            vertex[free] = 0.0
            vertex[free[np.argsort(gradient[free], kind="stable")[:chosen]]] = 1.0
            best = max(best, value + float(gradient @ (vertex - weights)))
            if value - best <= GAP * abs(value):
                break
            weights = weights + 2.0 / (step + 4.0) * (vertex - weights)
        # rounding must not turn the bound into a claim
        return best - 1e-9 * abs(best)


def quadratic(
    A: FloatArray,
    H: FloatArray,
    S: FloatArray,
    items: FloatArray,
    *,
    constant: float = 0.0,
    owned: IntArray | None = None,
) -> Quadratic:
    """Return the problem in states in which X, with all candidates, has a unit diagonal.

    Raises
    ------
    SolverError
        When even all candidates together have no stationary solution.
    """
    X = control_dare(A, items.T, Q=H, R=np.eye(items.shape[0])).P
    variance = np.maximum(X.diagonal(), 0.0)
    s = np.sqrt(np.where(variance > 1e-200, variance, 1.0))
    return Quadratic(
        A * s[:, None] / s,
        H / s / s[:, None],
        S * s,
        items * s,
        np.zeros((items.shape[0], 0), dtype=np.int64) if owned is None else owned,
        constant,
    )


def solved(A: FloatArray, H: FloatArray, g: FloatArray) -> FloatArray:
    """Return X of ``X = A' (X^-1 + g' g)^-1 A + H``: doubling, its residual checked.

    Raises
    ------
    SolverError
        When there is none; the message is that of `solve_dare`.
    """
    X = _doubled(A, g.T @ g, H)
    if X is not None:
        gain = _gain(X, g)
        left = np.eye(X.shape[0]) - gain @ g
        residual = A.T @ (left @ X @ left.T + gain @ gain.T) @ A + H - X
        # closed loops that are barely stable look converged: `control_dare` distinguishes them
        if np.linalg.norm(residual) <= RESIDUAL * np.linalg.norm(X):
            return X
    return control_dare(A, g.T, Q=H, R=np.eye(g.shape[0])).P


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _doubled(A: FloatArray, G: FloatArray, H: FloatArray) -> FloatArray | None:
    """Return X by doubling (see `lti.doubling`), or None when it does not converge."""
    n = A.shape[0]
    for _ in range(DOUBLINGS):
        W = G @ H
        W.flat[:: n + 1] += 1.0
        _, _, solution, info = lapack.dgesv(W, np.concatenate([A, G], axis=1), 1, 1)
        if info:
            return None
        left, right = solution[:, :n], solution[:, n:]
        step = A.T @ (H @ left)
        G = G + A @ right @ A.T
        H = H + step
        A = A @ left
        H, G = 0.5 * (H + H.T), 0.5 * (G + G.T)
        growth = float(np.max(step.diagonal() / np.maximum(H.diagonal(), 1e-300)))
        if not np.isfinite(growth):
            return None
        if growth < CONVERGED:
            return H
    return None


def _gain(X: FloatArray, g: FloatArray) -> FloatArray:
    """Return K with ``X+ = (I - K g) X``."""
    seen = X @ g.T
    inner = g @ seen
    inner.flat[:: inner.shape[0] + 1] += 1.0
    size = np.sqrt(inner.diagonal())
    unit = inner / size / size[:, None]
    return np.asarray(np.linalg.solve(unit, (seen / size).T).T / size)


def _cost(S: FloatArray, X: FloatArray, g: FloatArray) -> float:
    """Return ``tr(S X+ S')`` as a sum of squares: nothing cancels when sensors are good."""
    gain = S @ _gain(X, g)
    left = S - gain @ g
    return float(np.einsum("ij,jk,ik->", left, X, left) + np.sum(gain**2))
