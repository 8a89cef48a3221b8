"""A primal-dual interior-point method for semidefinite programs that form their own Schur matrix.

``min cost' y`` with blocks ``Z = const + linear(y) >= 0``; multipliers X >= 0 with
``adjoint(X) = cost``. The direction of Helmberg, Kojima and Monteiro with Mehrotra's predictor and
corrector, from a start that need not be feasible [Helmberg1996]_.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray
from .lmi_solution import half

#: the most steps
STEPS = 100
#: least and greatest part of the way to the boundary
_NEAR, _NEARER = 0.9, 0.08
#: corrections of the solution of the Schur system
_CORRECTIONS = 2


class Program(Protocol):
    """A semidefinite program, as `ProjectedLmis` is one."""

    const: list[FloatArray]
    cost: FloatArray

    def linear(self, y: FloatArray) -> list[FloatArray]:
        """Return the part of each block that is linear in y."""

    def adjoint(self, W: Sequence[FloatArray]) -> FloatArray:
        """Return the products of W with the basis of y."""

    def schur(
        self,
        X_roots: Sequence[FloatArray],
        Z_roots: Sequence[FloatArray],
        X: FloatArray,
        Z_inverse: FloatArray,
    ) -> FloatArray:
        """Return the Schur matrix."""


class Iterate(NamedTuple):
    """A point of the method."""

    y: FloatArray
    X: list[FloatArray]
    Z: list[FloatArray]
    #: cost' y - (lower bound by the multipliers), were both feasible
    gap: float
    #: by how much ``Z = const + linear(y)``, and ``adjoint(X) = cost``, are missed
    primal_residual: float
    dual_residual: float


def iterates(program: Program, y: FloatArray, size: float) -> Iterator[Iterate]:
    """Yield the points of the method, until rounding stops it."""
    X = [np.eye(const.shape[0]) for const in program.const]
    Z = [size * np.eye(const.shape[0]) for const in program.const]
    order = sum(const.shape[0] for const in program.const)
    for _ in range(STEPS):
        missed = [
            c + moved - z for c, moved, z in zip(program.const, program.linear(y), Z, strict=True)
        ]
        unbalanced = program.adjoint(X) - program.cost
        gap = _inner(X, Z)
        yield Iterate(y, X, Z, gap, _largest(missed), float(np.max(np.abs(unbalanced))))
        try:
            step = _Step(program, X, Z, missed, unbalanced)
        except la.LinAlgError:  # rounding: a block is no longer positive definite
            return
        mu = gap / order
        predicted = step.direction([-x for x in X])
        x_way, z_way = step.lengths(predicted)
        aimed = _inner(_moved(X, predicted.X, x_way), _moved(Z, predicted.Z, z_way)) / order
        centring = (aimed / mu) ** 2 if min(x_way, z_way) > 0.1 else 0.5
        target = min(1.0, max(centring, 1e-3)) * mu
        found = step.direction(
            [
                target * inverse - x - half(dx @ dz @ inverse)
                for x, inverse, dx, dz in zip(
                    X, step.Z_inverse, predicted.X, predicted.Z, strict=True
                )
            ]
        )
        near = _NEAR + _NEARER * min(x_way, z_way)
        x_way, z_way = step.lengths(found, near)
        X, Z, y = _moved(X, found.X, x_way), _moved(Z, found.Z, z_way), y + z_way * found.y


def smallest(
    program: Program,
    y: FloatArray,
    size: float,
    tolerance: float,
    count: Callable[[], None] = lambda: None,
) -> list[Iterate]:
    """Return the points up to a relative gap of tolerance."""
    found: list[Iterate] = []
    for one in iterates(program, y, size):
        found.append(one)
        count()
        value = abs(float(program.cost @ one.y))
        residual = max(one.primal_residual, one.dual_residual)
        if one.gap <= tolerance * value and residual <= 0.1 * tolerance:
            break
    return found


class _Direction(NamedTuple):
    y: FloatArray
    X: list[FloatArray]
    Z: list[FloatArray]


class _Step:
    """The linear system of one step, factored once for predictor and corrector."""

    def __init__(
        self,
        program: Program,
        X: list[FloatArray],
        Z: list[FloatArray],
        missed: list[FloatArray],
        unbalanced: FloatArray,
    ) -> None:
        self._program, self._X, self._missed, self._unbalanced = program, X, missed, unbalanced
        self._X_roots = [la.cholesky(x, lower=True) for x in X]
        self._Z_roots = [la.cholesky(z, lower=True) for z in Z]
        inverses = [
            la.solve_triangular(root, np.eye(root.shape[0]), lower=True) for root in self._Z_roots
        ]
        self.Z_inverse = [inverse.T @ inverse for inverse in inverses]
        self._M = program.schur(
            self._X_roots[:2],
            [inverse.T for inverse in inverses[:2]],
            X[-1],
            self.Z_inverse[-1],
        )
        self._d = 1.0 / np.sqrt(self._M.diagonal())
        self._factor = la.cho_factor(self._M * self._d * self._d[:, None], overwrite_a=True)

    def direction(self, target: list[FloatArray]) -> _Direction:
        """Return the direction for ``dX + sym(X dZ Z^-1) = target``, residuals made zero."""
        program = self._program
        kept = [
            t - half(x @ r @ inverse)
            for t, x, r, inverse in zip(target, self._X, self._missed, self.Z_inverse, strict=True)
        ]
        dy = self._solved(self._unbalanced + program.adjoint(kept))
        dZ = [r + moved for r, moved in zip(self._missed, program.linear(dy), strict=True)]
        dX = [
            t - half(x @ dz @ inverse)
            for t, x, dz, inverse in zip(target, self._X, dZ, self.Z_inverse, strict=True)
        ]
        return _Direction(dy, dX, dZ)

    def lengths(self, to: _Direction, near: float = 1.0) -> tuple[float, float]:
        """Return how far X and Z can go, at most 1 and the part `near` of the way out."""
        ways = []
        for roots, moves in ((self._X_roots, to.X), (self._Z_roots, to.Z)):
            way = min(_way_out(root, move) for root, move in zip(roots, moves, strict=True))
            ways.append(min(1.0, near * way))
        return ways[0], ways[1]

    def _solved(self, right: FloatArray) -> FloatArray:
        found = np.zeros_like(right)
        for _ in range(1 + _CORRECTIONS):
            rest = right - self._M @ found
            found = found + self._d * la.cho_solve(self._factor, self._d * rest)
        return found


def _way_out(root: FloatArray, move: FloatArray) -> float:
    """Return the largest a with ``L L' + a move >= 0``."""
    half_way = la.solve_triangular(root, move, lower=True)
    inner = half(la.solve_triangular(root, half_way.T, lower=True))
    least = float(la.eigvalsh(inner, subset_by_index=[0, 0])[0])
    return -1.0 / least if least < 0.0 else np.inf


def _moved(M: list[FloatArray], move: list[FloatArray], way: float) -> list[FloatArray]:
    return [half(m + way * d) for m, d in zip(M, move, strict=True)]


def _inner(X: list[FloatArray], Z: list[FloatArray]) -> float:
    return float(sum(np.sum(x * z) for x, z in zip(X, Z, strict=True)))


def _largest(blocks: list[FloatArray]) -> float:
    return max(float(np.max(np.abs(block), initial=0.0)) for block in blocks)
