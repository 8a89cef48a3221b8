"""Plates and blocks in polynomials of high order: what virtual machines are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
from numpy.polynomial import legendre

from ..arrays import FloatArray
from ..dof_columns import Interpolation
from ..errors import LabelError, require_known
from ..labels import DIRECTIONS, DofSet, node_dofs
from ..sparse.symmetric import dense
from ..structure import FEModel
from ..tolerances import SAME

#: order in each direction: of the paper's plate the first twenty frequencies to 2e-6 and forty, to
#: 7 kHz, to 1e-3; one of 15 takes twice as long in every loop
ORDER = 13
#: derivatives in (x, y) of the deflection and their sign: rx = dz/dy, ry = -dz/dx
_MOTIONS = {"z": (0, 0, 1.0), "rx": (0, 1, 1.0), "ry": (1, 0, -1.0)}


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialShape(Interpolation):
    """Lagrange's polynomials through a grid of nodes (n, n) in [-1, 1], x fastest."""

    size: tuple[float, float]
    nodes: FloatArray

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n^2,) with which the deflections give a motion at a point."""
        return np.asarray(self.rows(np.asarray(xyz)[None], direction)[0])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n^2) at many points (p, 3)."""
        require_known("motion", [direction], _MOTIONS, "a plate in bending")
        places = np.asarray(points)[:, :2] / self.size
        off = np.any((places < -SAME) | (places > 1.0 + SAME), axis=1)
        if np.any(off):
            raise LabelError(
                f"the point {tuple(np.asarray(points)[off][0].tolist())} is off the plate of "
                f"{self.size} m. Choose one on it."
            )
        *orders, sign = _MOTIONS[direction]
        x, y = (
            lagrange(self.nodes, 2.0 * p - 1.0, int(k)) * (2.0 / length) ** int(k)
            for p, k, length in zip(places.T, orders, self.size, strict=True)
        )
        return np.asarray(sign * np.einsum("pi,pj->pij", y, x).reshape(len(places), -1))


def lobatto(order: int) -> FloatArray:
    """Return Lobatto's points in [-1, 1], through which Lagrange's polynomials stay small."""
    inner = legendre.legroots(legendre.legder(np.eye(order + 1)[order]))
    return np.concatenate([[-1.0], np.sort(inner.real), [1.0]])


def lagrange(nodes: FloatArray, points: FloatArray, order: int = 0) -> FloatArray:
    """Return derivatives of Lagrange's polynomials through nodes, at points (p, n)."""
    size = nodes.size - 1  # by Legendre's polynomials, which stay well conditioned
    given = legendre.legvander(nodes, size)
    seen = legendre.legval(points, legendre.legder(np.eye(size + 1), order)).T
    return np.asarray(np.linalg.solve(given.T, seen.T).T)


def ritz_plate(
    *,
    size: Sequence[float],
    thickness: float,
    density: float,
    youngs_modulus: float,
    poisson_ratio: float,
    order: int = ORDER,
    stiffer: Any = None,
) -> FEModel:
    """Return a free rectangular plate with rotary inertia by the method of Ritz, dense."""
    # the energies of bending, `D/2 (w_xx^2 + w_yy^2 + 2 nu w_xx w_yy + 2 (1 - nu) w_xy^2)` with `D
    # = E h^3 / (12 (1 - nu^2))`, and of `rho h w_t^2 / 2 + rho h^3 (w_xt^2 + w_yt^2) / 24`, in
    # polynomials that meet each boundary condition in the limit; integrals exact. `stiffer` is a
    # function of (x, y): a factor of E there
    nodes = lobatto(order)
    points, weights = legendre.leggauss(order + 3)
    a, b = (0.5 * float(length) for length in size)
    N = [lagrange(nodes, points, k) for k in range(3)]

    def derived(x_order: int, y_order: int) -> FloatArray:
        both = np.einsum("pj,qi->pqji", N[y_order], N[x_order]).reshape(points.size**2, -1)
        return np.asarray(both / (a**x_order * b**y_order))

    area = a * b * np.outer(weights, weights).reshape(-1)
    x, y = np.meshgrid(a * (1.0 + points), b * (1.0 + points))
    share = np.ones(area.size) if stiffer is None else np.asarray(stiffer(x, y)).reshape(-1)
    nu = poisson_ratio
    bending = (area * share * youngs_modulus * thickness**3 / (12.0 * (1.0 - nu**2)))[:, None]
    xx, yy, xy = derived(2, 0), derived(0, 2), derived(1, 1)
    K = xx.T @ (bending * (xx + nu * yy)) + yy.T @ (bending * (yy + nu * xx))
    K += 2.0 * (1.0 - nu) * xy.T @ (bending * xy)
    mass = (density * area)[:, None]
    M, turning = np.zeros_like(K), thickness**3 / 12.0
    for inertia, motion in ((thickness, (0, 0)), (turning, (1, 0)), (turning, (0, 1))):
        part = derived(*motion)
        M += part.T @ (inertia * mass * part)
    at_x, at_y = np.meshgrid(a * (1.0 + nodes), b * (1.0 + nodes))
    xyz = np.column_stack([at_x.reshape(-1), at_y.reshape(-1), np.zeros(at_x.size)])
    shape = PolynomialShape((float(size[0]), float(size[1])), nodes)
    dofs = DofSet(np.arange(1, at_x.size + 1), ("z",) * at_x.size, xyz, shape)
    return FEModel(0.5 * (M + M.T), 0.5 * (K + K.T), dofs=dofs, name="plate by Ritz")


def plate_modes(plate: FEModel) -> tuple[FloatArray, FloatArray]:
    """Return omega (k,) [rad/s] and mass-normalised shapes (n, k) of all modes but three."""
    values, phi = la.eigh(dense(plate.K), dense(plate.M))
    return np.sqrt(values[3:]), phi[:, 3:]


#: orders along x, y and z of a block that is thin in z: a wave of bending has few half waves in a
#: thickness, and twelve elastic frequencies change by less than 1e-4 with one order more of each
ORDERS = (9, 8, 3)
_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False, repr=False)
class SolidShape(Interpolation):
    """Lagrange's polynomials through a grid of nodes, x fastest, three displacements in each."""

    size: tuple[float, ...]
    orders: tuple[int, ...]

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of all displacements in a motion; rotations are half the curl."""
        require_known("motion", [direction], DIRECTIONS, "a solid")
        place = np.asarray(xyz) / self.size
        if np.any(place < -SAME) or np.any(place > 1.0 + SAME):
            raise LabelError(
                f"the point {tuple(np.asarray(xyz).tolist())} is outside the block of {self.size} "
                "m. Choose one in it."
            )
        points = [np.array([2.0 * value - 1.0]) for value in place]
        weights = np.zeros((int(np.prod(np.array(self.orders) + 1)), 3))
        axis = _AXES.index(direction[-1])
        if len(direction) == 1:
            weights[:, axis] = self.seen(points)[0]
            return weights.reshape(-1)
        after, before = (axis + 1) % 3, (axis + 2) % 3
        weights[:, before] = 0.5 * self.seen(points, after)[0]
        weights[:, after] = -0.5 * self.seen(points, before)[0]
        return weights.reshape(-1)

    def seen(self, points: Sequence[FloatArray], slope: int | None = None) -> FloatArray:
        """Return all polynomials (p, n), or their slopes along an axis, at the points of a grid."""
        each = [
            lagrange(lobatto(order), at, int(slope == i)) * (2.0 / length) ** int(slope == i)
            for i, (order, at, length) in enumerate(
                zip(self.orders, points, self.size, strict=True)
            )
        ]
        every = np.einsum("rk,qj,pi->rqpkji", *reversed(each))
        return np.asarray(every.reshape(np.prod(every.shape[:3]), -1))


def ritz_block(
    *,
    size: Sequence[float],
    density: float,
    youngs_modulus: float,
    poisson_ratio: float,
    orders: tuple[int, int, int] = ORDERS,
    stiffer: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
) -> FEModel:
    """Return a free block of linear elasticity by the method of Ritz, dense."""
    # of the energies `rho u_t . u_t / 2` and `lambda (tr e)^2 / 2 + mu e : e` of the strains
    # `e = (grad u + grad u') / 2` integrals are exact; free faces meet their conditions in the
    # limit. `stiffer` is a function of (x, y): a factor of E there
    lengths = tuple(float(length) for length in size)
    shape = SolidShape(lengths, tuple(orders))
    gauss = [legendre.leggauss(order + 2) for order in orders]
    weight = np.einsum("r,q,p->rqp", *(w for _, w in reversed(gauss))).reshape(-1)
    weight = weight * np.prod(lengths) / 8.0
    grid = [0.5 * length * (1.0 + at) for (at, _), length in zip(gauss, lengths, strict=True)]
    z, y, x = (one.reshape(-1) for one in np.meshgrid(*reversed(grid), indexing="ij"))
    share = np.ones(z.size) if stiffer is None else np.asarray(stiffer(x, y))
    N = shape.seen([at for at, _ in gauss])
    slopes = [shape.seen([at for at, _ in gauss], axis) for axis in range(3)]
    first = youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    shear = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    each = [[one.T @ ((weight * share)[:, None] * other) for other in slopes] for one in slopes]
    n = N.shape[1]
    K, M = np.zeros((n, 3, n, 3)), np.zeros((n, 3, n, 3))
    mass = N.T @ ((density * weight)[:, None] * N)
    for i in range(3):
        M[:, i, :, i] = mass
        K[:, i, :, i] += shear * sum(each[k][k] for k in range(3))
        for j in range(3):
            K[:, i, :, j] += first * each[i][j] + shear * each[j][i]
    places = [0.5 * a * (1.0 + lobatto(order)) for order, a in zip(orders, lengths, strict=True)]
    z, y, x = (one.reshape(-1) for one in np.meshgrid(*reversed(places), indexing="ij"))
    dofs = node_dofs(np.arange(1, n + 1), _AXES, np.column_stack([x, y, z]), shape)
    M, K = (0.5 * (one + one.T) for one in (M.reshape(3 * n, -1), K.reshape(3 * n, -1)))
    return FEModel(M, K, dofs=dofs, name="block by Ritz")
