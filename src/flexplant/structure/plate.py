"""A rectangular Kirchhoff plate of four-node elements with twelve degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import cast

import numpy as np
import scipy.sparse as sp

from ..errors import LabelError, ModelError, ShapeError
from ..labels import DofSet, Interpolation
from ..values import FloatArray, IntArray, positive, real_array, rebuild
from .model import FEModel

# the twelve-term polynomial: x^p y^q in coordinates from 0 to 1 over the element
_P = np.array([0, 1, 0, 2, 1, 0, 3, 2, 1, 0, 3, 1])
_Q = np.array([0, 0, 1, 0, 1, 2, 0, 1, 2, 3, 1, 3])
_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
_DIRECTIONS = ("z", "rx", "ry")


def kirchhoff_plate(
    *,
    size: Sequence[float],
    thickness: float,
    elements: Sequence[int],
    density: float,
    youngs_modulus: float,
    poisson_ratio: float,
    name: str | None = None,
) -> FEModel:
    """Return a free rectangular plate in bending.

    Four-node non-conforming elements with the complete cubic and x^3 y, x y^3 (Adini, Clough and
    Melosh), stiffness and consistent mass integrated exactly. The plate lies in the x-y plane with
    one corner at the origin and its middle plane at z = 0. Nodes are numbered from 1, x fastest;
    each has the DOFs z [m], rx = dz/dy and ry = -dz/dx [rad].

    Parameters
    ----------
    size : (2,) array [m]
        Lengths in x and y.
    thickness : float [m]
        Thickness.
    elements : (2,) array of int
        Number of elements in x and y.
    density : float [kg/m^3]
        Mass density.
    youngs_modulus : float [Pa]
        Young's modulus.
    poisson_ratio : float [-]
        Above -1 and below 0.5.
    name : str, optional
        For display.

    Returns
    -------
    FEModel
        Sparse, without D, its DofSet interpolating with the element's own shape functions.

    Raises
    ------
    ModelError
        When a number is not physical.

    Examples
    --------
    >>> kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702,
    ...                 youngs_modulus=70e9, poisson_ratio=0.35)
    <FEModel 'plate': 243 DOFs, sparse, 3 rigid-body motions, D not given>
    """
    lengths = real_array(size, "size", (2,))
    width, height = positive(lengths[0], "size in x"), positive(lengths[1], "size in y")
    depth = positive(thickness, "thickness")
    nx, ny = _element_counts(elements)
    nu = float(real_array(poisson_ratio, "poisson_ratio", ()))
    if not -1 < nu < 0.5:
        raise ModelError(f"poisson_ratio must be above -1 and below 0.5, got {nu:g}.")
    a, b = width / nx, height / ny
    area_mass = positive(density, "density") * depth
    bending = positive(youngs_modulus, "youngs_modulus") * depth**3 / (12 * (1 - nu**2))
    # x fastest
    x, y = np.tile(np.arange(nx + 1) * a, ny + 1), np.repeat(np.arange(ny + 1) * b, nx + 1)
    x[nx :: nx + 1], y[-nx - 1 :] = width, height
    n_nodes = (nx + 1) * (ny + 1)
    dofs = DofSet(
        np.repeat(np.arange(1, n_nodes + 1), 3),
        _DIRECTIONS * n_nodes,
        np.repeat(np.column_stack([x, y, np.zeros(n_nodes)]), 3, axis=0),
        PlateShape((width, height), depth, (nx, ny)),
    )
    fields = {
        "M": _assembled(_mass(a, b) * area_mass, nx, ny),
        "K": _assembled(_stiffness(a, b, nu) * bending, nx, ny),
        "D": None,
        "dofs": dofs,
        "name": "plate" if name is None else name,
    }
    # not through the checks of the door: sums of definite elements are definite, and at 1e5
    # elements the factorisation that proves it again takes longer than everything here
    return cast(FEModel, rebuild(FEModel, fields))


@dataclass(frozen=True, eq=False, repr=False)
class PlateShape(Interpolation):
    """The shape functions of a rectangular grid of plate elements.

    Parameters
    ----------
    size : (float, float) [m]
        Lengths in x and y.
    thickness : float [m]
        Points between the two surfaces belong to the plate.
    elements : (int, int)
        Number of elements in x and y.
    """

    size: tuple[float, float]
    thickness: float
    elements: tuple[int, int]

    def __repr__(self) -> str:
        (lx, ly), (nx, ny) = self.size, self.elements
        return f"<PlateShape {lx:g} x {ly:g} m, {nx} x {ny} elements>"

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of all DOFs in the motion z, rx or ry at a point.

        Between elements z is continuous; the slope across an edge is not (the element is
        non-conforming), and the element on the side of larger coordinates is taken.

        Raises
        ------
        LabelError
            When the point is off the plate, or the direction is not z, rx or ry.
        """
        if direction not in _DIRECTIONS:
            raise LabelError(
                f"a plate in bending has no motion {direction!r}: use one of z, rx, ry."
            )
        point = real_array(xyz, "xyz", (3,))
        slack = 1e-9 * max(self.size)
        inside = (
            -slack <= point[0] <= self.size[0] + slack
            and -slack <= point[1] <= self.size[1] + slack
            and abs(point[2]) <= 0.5 * self.thickness + slack
        )
        if not inside:
            raise LabelError(
                f"the point {tuple(point.tolist())} is off the plate, which reaches from "
                f"(0, 0) to ({self.size[0]:g}, {self.size[1]:g}) m at |z| <= "
                f"{0.5 * self.thickness:g} m: its motion is not known. Coordinates are in metres."
            )
        (nx, ny), (i, s, a), (j, t, b) = (
            self.elements,
            _located(point[0], self.size[0], self.elements[0]),
            _located(point[1], self.size[1], self.elements[1]),
        )
        powers = {
            "z": _monomials(s, t, 0, 0),
            "rx": _monomials(s, t, 0, 1) / b,
            "ry": -_monomials(s, t, 1, 0) / a,
        }
        row = np.zeros(3 * (nx + 1) * (ny + 1))
        node = i + _CORNERS[:, 0] + (nx + 1) * (j + _CORNERS[:, 1])
        row[(3 * node[:, None] + np.arange(3)).ravel()] = powers[direction] @ _coefficients(a, b)
        return row


def _element_counts(elements: Sequence[int]) -> tuple[int, int]:
    counts = real_array(elements, "elements")
    if counts.shape != (2,):
        raise ShapeError(f"elements must be two numbers (in x and y), got shape {counts.shape}.")
    if np.any(counts < 1) or np.any(counts != np.round(counts)):
        raise ModelError(f"elements must be positive whole numbers, got {counts.tolist()}.")
    return int(counts[0]), int(counts[1])


def _located(value: float, length: float, count: int) -> tuple[int, float, float]:
    """Return the element, the coordinate from 0 to 1 in it, and its length."""
    place = min(max(value / length, 0.0), 1.0) * count
    nearest = round(place)
    if abs(place - nearest) < 1e-9 * count:  # rounding must not decide on which side a node is
        place = float(nearest)
    index = min(int(place), count - 1)
    return index, place - index, length / count


def _monomials(s: float, t: float, dp: int, dq: int) -> FloatArray:
    """Return the d^dp/ds^dp d^dq/dt^dq derivatives (12,) of the terms s^p t^q."""
    return _derived(_P, s, dp) * _derived(_Q, t, dq)


def _derived(power: IntArray, x: float, order: int) -> FloatArray:
    factor = np.ones(power.size)
    for k in range(order):
        factor *= power - k
    return np.asarray(factor * np.power(float(x), np.maximum(power - order, 0)), dtype=np.float64)


@cache
def _unit_coefficients() -> FloatArray:
    """Return the polynomial coefficients (12, 12) of unit DOFs z, dz/dt, -dz/ds at the corners."""
    rows = []
    for s, t in _CORNERS.astype(float):
        rows += [_monomials(s, t, 0, 0), _monomials(s, t, 0, 1), -_monomials(s, t, 1, 0)]
    return np.round(np.linalg.inv(np.array(rows)), 6)  # small whole numbers


def _coefficients(a: float, b: float) -> FloatArray:
    """Return the coefficients (12, 12) of unit DOFs z, rx, ry of an element a x b."""
    return np.asarray(_unit_coefficients() * np.tile([1.0, b, a], 4), dtype=np.float64)


def _product(first: tuple[int, int], second: tuple[int, int]) -> FloatArray:
    """Return the exact integrals (12, 12) of products of derivatives over the unit square."""

    def factor(power: IntArray, order: int) -> IntArray:
        return power * (power - 1) if order == 2 else power if order == 1 else np.ones_like(power)

    p = np.add.outer(_P - first[0], _P - second[0])
    q = np.add.outer(_Q - first[1], _Q - second[1])
    scale = np.outer(
        factor(_P, first[0]) * factor(_Q, first[1]), factor(_P, second[0]) * factor(_Q, second[1])
    )
    # where a derivative vanishes its power may be negative
    return np.asarray(scale / (np.maximum(p, 0) + 1) / (np.maximum(q, 0) + 1), dtype=np.float64)


def _mass(a: float, b: float) -> FloatArray:
    """Return the element's consistent mass (12, 12) for unit mass per area."""
    shape = _coefficients(a, b)
    return _symmetrised(a * b * shape.T @ _product((0, 0), (0, 0)) @ shape)


def _stiffness(a: float, b: float, nu: float) -> FloatArray:
    """Return the element's stiffness (12, 12) for unit bending stiffness E t^3 / 12 (1 - nu^2)."""
    xx, yy, xy = (2, 0), (0, 2), (1, 1)
    cross = _product(xx, yy) / (a * b) ** 2
    energy = (
        _product(xx, xx) / a**4
        + _product(yy, yy) / b**4
        + nu * (cross + cross.T)
        + 2 * (1 - nu) * _product(xy, xy) / (a * b) ** 2
    )
    shape = _coefficients(a, b)
    return _symmetrised(a * b * shape.T @ energy @ shape)


def _symmetrised(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)


def _assembled(element: FloatArray, nx: int, ny: int) -> sp.csc_array:
    """Return the matrix of nx x ny equal elements, row by row of nodes (no triplets to sort).

    A node sees up to nine nodes through up to four elements; which of these exist decides what
    its three rows hold.
    """
    columns = np.arange(nx + 1)
    i, j = np.tile(columns, ny + 1), np.repeat(np.arange(ny + 1), nx + 1)
    n_nodes = i.size
    # the element in which the node is local corner c; and where the element's corners then are
    table = np.zeros((4, 9, 3, 3))
    exists = np.zeros((n_nodes, 4))
    for c, (ci, cj) in enumerate(_CORNERS):
        exists[:, c] = (i >= ci) & (i - ci < nx) & (j >= cj) & (j - cj < ny)
        for d, (di, dj) in enumerate(_CORNERS):
            offset = 3 * (dj - cj + 1) + (di - ci + 1)
            table[c, offset] = element[3 * c : 3 * c + 3, 3 * d : 3 * d + 3]
    data = (exists @ table.reshape(4, 81)).reshape(n_nodes, 9, 3, 3).transpose(0, 2, 1, 3)
    step_i, step_j = np.tile([-1, 0, 1], 3), np.repeat([-1, 0, 1], 3)
    there = (
        ((i[:, None] + step_i) >= 0)
        & ((i[:, None] + step_i) <= nx)
        & ((j[:, None] + step_j) >= 0)
        & ((j[:, None] + step_j) <= ny)
    )
    neighbour = (np.arange(n_nodes)[:, None] + step_i + (nx + 1) * step_j).astype(np.int32)
    index = np.broadcast_to(
        (3 * neighbour[:, None, :, None] + np.arange(3, dtype=np.int32)), data.shape
    )
    keep = np.broadcast_to(there[:, None, :, None], data.shape)
    per_row = np.repeat(3 * there.sum(axis=1), 3)
    pointer = np.concatenate([[0], np.cumsum(per_row)]).astype(np.int32)
    # symmetric, so rows serve as columns
    shape = (3 * n_nodes, 3 * n_nodes)
    return sp.csc_array((data[keep], index[keep], pointer), shape=shape)
