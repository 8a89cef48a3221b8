"""A solid block in polynomials of high order: what virtual machines in six axes are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from ..checks import FloatArray
from ..dof_columns import Interpolation
from ..errors import LabelError
from ..labels import DofSet
from ..structure import FEModel
from .ritz_plate import EDGE, lagrange, lobatto

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
        if direction.removeprefix("r") not in _AXES:
            raise LabelError(
                f"a solid has no motion {direction!r}: use one of x, y, z, rx, ry, rz."
            )
        place = np.asarray(xyz) / self.size
        if np.any(place < -EDGE) or np.any(place > 1.0 + EDGE):
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
    """Return a free block of linear elasticity by the method of Ritz, dense.

    Of the energies ``rho u_t . u_t / 2`` and ``lambda (tr e)^2 / 2 + mu e : e`` of the strains
    ``e = (grad u + grad u') / 2`` integrals are exact; free faces meet their conditions in the
    limit. `stiffer` is a function of
    (x, y): a factor of E there.
    """
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
    xyz = np.repeat(np.column_stack([x, y, z]), 3, axis=0)
    dofs = DofSet(np.repeat(np.arange(1, n + 1), 3), _AXES * n, xyz, shape)
    M, K = (0.5 * (one + one.T) for one in (M.reshape(3 * n, -1), K.reshape(3 * n, -1)))
    return FEModel(M, K, dofs=dofs, name="block by Ritz")
