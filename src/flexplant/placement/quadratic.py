"""Stationary quadratic costs as functions of which candidates are used: one Riccati each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray, IntArray, Value
from ..errors import SolverError
from ..lti.equations import doubled, doubled_riccati, relative
from ..lti.riccati import control_dare
from ..lti.square_roots import riccati_root, square_root
from ..tolerances import divisor
from .convex import Convex, Tangent
from .criterion import Scorer

#: largest residual of the Riccati equation, relative, that is taken without another solver
RESIDUAL = 1e-10
#: variance beside the largest that counts as none, and the part of a gradient that must agree
_NOTHING, _CONFIRMED = 1e-13, 1e-10


@dataclass(frozen=True, eq=False, repr=False)
class Quadratic(Value, Convex):
    """``J(w) = tr(S X+ S') + constant`` with weights w of the candidates.

    ::

        X = A' X+ A + H,    X+ = (X^-1 + G)^-1,    G = sum_i w_i g_i g_i'

    For a filter X is the covariance of the state before and X+ after the measurement (A is the
    transpose of the plant's), g_i = c_i / (standard deviation of sensor i). For a controller X is
    the cost to go and g_i = b_i / (weight of effort i). More candidates never cost more.
    """

    A: FloatArray
    H: FloatArray
    S: FloatArray
    items: FloatArray
    owned: IntArray
    constant: float

    def value(self, chosen: Sequence[int]) -> float:
        """Return J with some candidates."""
        return float(np.sum(self.terms(chosen))) + self.constant

    def terms(self, chosen: Sequence[int]) -> FloatArray:
        """Return the parts (k,) of J that the rows of S see, without the constant."""
        g, X, S = self.solution(chosen)
        return _quotients(S, X, g)

    def solution(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return g, X and S of some candidates, in the states that are there with them."""
        rows = np.sort(np.asarray(chosen, dtype=np.int64))
        keep = np.ones(self.A.shape[0], dtype=bool)
        if self.owned.size:
            keep[self.owned.ravel()] = False
            keep[self.owned[rows].ravel()] = True
        inner = np.ix_(keep, keep)
        g = _square_root(self.items[rows][:, keep])
        return g, solved(self.A[inner], self.H[inner], g), self.S[:, keep]

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.items.shape[0])

    def relaxed(self, weights: FloatArray) -> tuple[float, FloatArray]:
        """Return J and its gradient (N,) at weights of the candidates.

        ``dX+ = M dX+ M' - X+ dG X+`` with ``M = (I - K g) A'``, so with the adjoint Stein
        equation ``Y = M' Y M + S' S`` the gradient is ``-g_i' X+ Y X+ g_i``.
        """
        cost, _, _, adjoint, seen = self._stationary(weights)
        return cost, -np.sum((seen @ adjoint) * seen, axis=1)

    def cost(self, weights: FloatArray) -> float:
        """Return J at weights (N,); infinite where it has none."""
        g = self._weighted(weights)
        try:
            return float(np.sum(_quotients(self.S, solved(self.A, self.H, g), g))) + self.constant
        except SolverError:
            return np.inf

    def tangent(self, weights: FloatArray) -> Tangent:
        """Return the tangent of the information ``(X+)^-1`` at weights (N,).

        The information is the limit of iterates that are concave in w (a parallel sum is). Its
        derivative by w_i is ``(X+)^-1 D_i (X+)^-1`` with the Stein equation ``D_i = M D_i M' + X+
        g_i g_i' X+``, solved for all i by the eigenvectors of M, or one by one where it lacks some;
        the adjoint equation confirms the slopes. Directions of no variance are left out: a
        compression of an inverse has an inverse that is concave as well.
        """
        cost, after, closed, adjoint, seen = self._stationary(weights)
        sizes, axes = np.linalg.eigh(0.5 * (after + after.T))
        kept = sizes > _NOTHING * sizes[-1]
        lost = (self.S @ axes[:, ~kept]) ** 2 @ np.abs(sizes[~kept])
        root = axes[:, kept] * np.sqrt(sizes[kept])
        face, into = root.T @ self.S.T, (root / sizes[kept]).T
        gradient = np.sum((seen @ adjoint) * seen, axis=1)
        most = float(np.max(gradient))
        for slopes in _increments(closed, seen, into):
            found = np.einsum("ik,nij,jk->n", face, slopes, face, optimize=True)
            if np.max(np.abs(found - gradient)) <= _CONFIRMED * most:
                break
        else:
            raise SolverError("the derivatives of the Riccati equation are not certain.")
        if float(np.sum(lost)) > _CONFIRMED * (cost - self.constant):
            raise SolverError("directions of no variance have a part in the cost.")
        value, vectors = np.linalg.eigh(adjoint)
        rows = seen @ (vectors * np.sqrt(np.maximum(value, 0.0)))
        return Tangent(face, slopes, np.array(weights), self.constant, rows)

    def _stationary(
        self, weights: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return J, X+, M, the adjoint Y and the rows ``g_i' X+`` at weights."""
        g = self._weighted(weights)
        X = solved(self.A, self.H, g)
        left, after = measured(X, g)
        closed = left @ self.A.T
        adjoint = doubled(closed.T, self.S.T @ self.S)
        cost = float(np.sum(_quotients(self.S, X, g))) + self.constant
        return cost, after, closed, adjoint, self.items @ after

    def _weighted(self, weights: FloatArray) -> FloatArray:
        """Return g of the candidates with weights above zero, each times the root of its own."""
        used = weights > 0
        return _square_root(np.sqrt(weights[used])[:, None] * self.items[used])


def quadratic(
    A: FloatArray,
    H: FloatArray,
    S: FloatArray,
    items: FloatArray,
    *,
    constant: float = 0.0,
    owned: IntArray | None = None,
) -> Quadratic:
    """Return the problem in states in which X, with all candidates, has a unit diagonal."""
    X = _certain(A, H, items)
    variance = np.maximum(X.diagonal(), 0.0)
    s = np.sqrt(divisor(variance))
    return Quadratic(
        A * s[:, None] / s,
        H / s / s[:, None],
        S * s,
        items * s,
        np.zeros((items.shape[0], 0), dtype=np.int64) if owned is None else owned,
        constant,
    )


def solved(A: FloatArray, H: FloatArray, g: FloatArray) -> FloatArray:
    """Return X of ``X = A' (X^-1 + g' g)^-1 A + H``: doubling, its residual checked."""
    with suppress(SolverError):
        X = doubled_riccati(A, g.T @ g, H, quick=True)[0]
        residual = A.T @ measured(X, g)[1] @ A + H - X
        # closed loops that are barely stable look converged: `control_dare` distinguishes them
        if relative(residual, float(np.linalg.norm(X))) <= RESIDUAL:
            return X
    return _certain(A, H, g)


def _certain(A: FloatArray, H: FloatArray, g: FloatArray) -> FloatArray:
    """Return X by Newton's steps; in square roots where it has too few digits for these."""
    one = np.eye(g.shape[0])
    try:
        return control_dare(A, g.T, Q=H, R=one).P
    except SolverError as error:
        noise = la.block_diag(square_root(H), one)
        try:
            L = riccati_root(A.T, g, noise[: len(A)], noise[len(A) :]).L
        except SolverError:
            raise error from None
        return np.asarray(L @ L.T)


def _square_root(g: FloatArray) -> FloatArray:
    """Return as few rows as there are states with the same ``g' g``."""
    return g if g.shape[0] <= g.shape[1] else np.asarray(np.linalg.qr(g, mode="r"))


def _increments(closed: FloatArray, seen: FloatArray, into: FloatArray) -> Iterator[FloatArray]:
    """Yield ``into D_i into'`` (N, m, m) for all i with ``D_i = M D_i M' + s_i s_i'``, two ways."""
    poles, modes = np.linalg.eig(closed)
    try:
        part = np.linalg.solve(modes, seen.T.astype(complex)).T
    except np.linalg.LinAlgError:  # delay lines of a lag lack eigenvectors
        part = np.zeros((0, len(poles)), dtype=complex)
    if len(part):
        sums = part[:, :, None] * (part[:, None, :].conj() / (1.0 - poles[:, None] * poles.conj()))
        turned = into @ modes
        yield (turned @ sums @ turned.conj().T).real
    yield np.array([into @ doubled(closed, np.outer(row, row)) @ into.T for row in seen])


def measured(X: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return I - K g, and X+ as a sum of squares: ``(I - K g) X (I - K g)' + K K'``."""
    gain = _update_gain(X, g)
    left = np.eye(X.shape[0]) - gain @ g
    return left, left @ X @ left.T + gain @ gain.T


def _update_gain(X: FloatArray, g: FloatArray) -> FloatArray:
    """Return K with ``X+ = (I - K g) X``."""
    seen = X @ g.T
    inner = g @ seen
    inner.flat[:: inner.shape[0] + 1] += 1.0
    size = np.sqrt(inner.diagonal())
    unit = inner / size / size[:, None]
    return np.asarray(np.linalg.solve(unit, (seen / size).T).T / size)


def _quotients(S: FloatArray, X: FloatArray, g: FloatArray) -> FloatArray:
    """Return the diagonal of ``S X+ S'`` as sums of squares: nothing cancels with good sensors."""
    gain = S @ _update_gain(X, g)
    left = S - gain @ g
    return np.asarray(np.einsum("ij,jk,ik->i", left, X, left) + np.sum(gain**2, axis=1))


@dataclass(frozen=True, eq=False)
class WorstRow(Scorer):
    """``max_a (s_a X+ s_a' + constant_a)`` over the rows of a quadratic cost."""

    costs: Quadratic
    constants: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return the largest term with some candidates."""
        return float(np.max(self.costs.terms(chosen) + self.constants))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the largest bound of any one term, or of their mean: the maximum is above both."""
        k = len(self.constants)
        parts = [
            self.costs.replace(S=self.costs.S[[i]], constant=float(self.constants[i]))
            for i in range(k)
        ]
        mean = float(np.mean(self.constants))
        parts.append(self.costs.replace(S=self.costs.S / np.sqrt(k), constant=mean))
        return max(part.bound(count, required) for part in parts)
