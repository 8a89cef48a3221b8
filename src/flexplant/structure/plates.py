"""Rectangular plates: thin ones, and those that shear and whose sections have rotary inertia."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import FloatArray, IntArray, positive
from ..errors import LabelError
from .element_matrices import POINTS, plate_mass, plate_stiffness, thin_coefficients, thin_terms
from .grids import Field, Grid, GridShape, corners, grid_of
from .model import FEModel

# The shear of an edge is constant and the slope of the section along it quadratic: between ends
# that turn by t1, t2 and move by z1, z2 over a length L,
#     shear = (1 - f) d,  slope = linear + 6 s (1 - s) f d,  d = (z2 - z1) / L - (t1 + t2) / 2,
# with f = 1 / (1 + 12 B / (G L^2)), B the bending and G the shear stiffness, which makes an edge an
# exact Timoshenko beam ([FriedmanKosmatka1993]_). In a plate both carry over linearly to the
# opposite edge: the element of [Katili1993]_ on a rectangle. f = 1 is an edge that does not shear.


def edge_share(softness: Any, length: float) -> Any:
    """Return f of an edge whose bending stiffness is `softness` [m^2] of its shear stiffness."""
    return 1.0 / (1.0 + 12.0 * np.asarray(softness) / length**2)


class PlateParts(NamedTuple):
    """Fields of an element at p points, in terms of its DOFs z, rx, ry at four corners.

    The first axis of (3, p, 12) holds the parts that 1, f along x and f along y weigh.
    """

    z: FloatArray
    #: slopes dz/dx and dz/dy of the section
    slopes: tuple[FloatArray, FloatArray]
    #: their derivatives along the same axis, and the twist, the sum of the other two
    curvatures: tuple[FloatArray, FloatArray, FloatArray]
    #: (p, 12): the shear along x and y, over 1 - f of that direction
    shears: tuple[FloatArray, FloatArray]


def plate_parts(s: Any, t: Any, a: float, b: float) -> PlateParts:
    """Return the fields of an element a x b at points s, t (p,) between 0 and 1."""
    place = [np.reshape(np.asarray(one, dtype=np.float64), (-1, 1)) for one in (s, t)]
    # the weights (p, 2) of an edge along x are those of its two places in y
    at_y, at_x = across = [np.hstack([1.0 - one, one]) for one in place[::-1]]
    lengths, count = (a, b), len(place[0])
    low_high = np.array([-1.0, 1.0])
    corner = at_x[:, [0, 1, 0, 1]] * at_y[:, [0, 0, 1, 1]]
    along = (
        at_y[:, [0, 0, 1, 1]] * low_high[[0, 1, 0, 1]] / a,
        at_x[:, [0, 1, 0, 1]] * low_high[[0, 0, 1, 1]] / b,
    )

    def spread(values: FloatArray, column: int, sign: float = 1.0) -> FloatArray:
        found = np.zeros((count, 4, 3))
        found[:, :, column] = sign * values
        return found.reshape(count, 12)

    z, twist = (np.zeros((3, count, 12)) for _ in range(2))
    z[0] = spread(corner, 0)
    slopes, bends, shears = [], [], []
    for axis in range(2):
        # the two edges along an axis, by their corners; the DOF of their slope and its sign
        edges = [(i, i + 1 + axis) for i in np.flatnonzero(corners(2)[:, axis] == 0).tolist()]
        column, sign = 2 - axis, 2.0 * axis - 1.0
        x, length, other, blend = place[axis], lengths[axis], 1 - axis, across[axis]
        excess, turn = _edge_rows(edges, column, sign, length)
        bubble = 6.0 * x * (1.0 - x)
        z[0] -= length / 12.0 * bubble * (blend @ turn)
        z[1 + axis] = length / 6.0 * bubble * (2.0 * x - 1.0) * (blend @ excess)
        slope, bend = (np.zeros((3, count, 12)) for _ in range(2))
        slope[0], slope[1 + axis] = spread(corner, column, sign), bubble * (blend @ excess)
        bend[0] = spread(along[axis], column, sign)
        bend[1 + axis] = 6.0 * (1.0 - 2.0 * x) / length * (blend @ excess)
        twist[0] += spread(along[other], column, sign)
        twist[1 + axis] = bubble * (low_high @ excess) / lengths[other]
        slopes.append(slope)
        bends.append(bend)
        shears.append(blend @ excess)
    return PlateParts(
        z, (slopes[0], slopes[1]), (bends[0], bends[1], twist), (shears[0], shears[1])
    )


def _edge_rows(
    edges: Sequence[tuple[int, int]], column: int, sign: float, length: float
) -> tuple[FloatArray, FloatArray]:
    """Return (2, 12) each: chord less mean slope of two edges, and how far their ends turn."""
    excess, turn = np.zeros((2, 4, 3)), np.zeros((2, 4, 3))
    for k, (start, end) in enumerate(edges):
        excess[k, [start, end], 0] = np.array([-1.0, 1.0]) / length
        excess[k, [start, end], column] = -0.5 * sign
        turn[k, [start, end], column] = np.array([-sign, sign])
    return excess.reshape(2, 12), turn.reshape(2, 12)


#: element matrices and their weights: numbers or fields (ny, nx)
Terms: TypeAlias = list[tuple[FloatArray, Any]]


def plate_terms(
    a: float, b: float, softness: Any, *, mass: Any, rotary: Any, bending: Any, nu: Any
) -> tuple[Terms, Terms]:
    """Return the terms of M and K of plate elements a x b.

    `softness` is the bending stiffness over the shear stiffness, `mass` that per area, `rotary` the
    inertia ``rho h^3 / 12`` and `bending` the stiffness ``E h^3 / 12 (1 - nu^2)``.
    """
    line, weights = np.polynomial.legendre.leggauss(POINTS)
    s, t = (one.ravel() for one in np.meshgrid(0.5 * (line + 1.0), 0.5 * (line + 1.0)))
    area = 0.25 * a * b * np.outer(weights, weights).reshape(-1, 1)
    parts = plate_parts(s, t, a, b)
    xx, yy, xy = parts.curvatures
    f = (1.0, edge_share(softness, a), edge_share(softness, b))
    M: Terms = []
    K: Terms = []
    for i, j in combinations_with_replacement(range(3), 2):

        def of(one: FloatArray, other: FloatArray, i: int = i, j: int = j) -> FloatArray:
            both = one[i].T @ (area * other[j]) + (one[j].T @ (area * other[i]) if i != j else 0.0)
            return np.asarray(0.5 * (both + both.T))

        weight = f[i] * f[j]
        M.append((of(parts.z, parts.z), weight * mass))
        along_x, along_y = parts.slopes
        M.append((of(along_x, along_x) + of(along_y, along_y), weight * rotary))
        K.append((of(xx, xx) + of(yy, yy) + 0.5 * of(xy, xy), weight * bending))
        K.append((2.0 * of(xx, yy) - 0.5 * of(xy, xy), weight * bending * nu))
    for one, share, length in zip(parts.shears, f[1:], (a, b), strict=True):
        # the shear stiffness times (1 - f)^2, also where it is infinite
        scaled = 12.0 / length**2 * share
        own = one.T @ (area * one)
        K.append((0.5 * (own + own.T), bending * softness * scaled**2))
    return M, K


def _collected(terms: Terms) -> Terms:
    """Return the sum of the terms where all weights are numbers."""
    if any(np.ndim(weight) for _, weight in terms):
        return terms
    return [(np.asarray(sum(weight * matrix for matrix, weight in terms)), 1.0)]


@dataclass(frozen=True, eq=False, repr=False)
class PlateShape(GridShape):
    """The shape functions of a rectangular grid of plate elements.

    Parameters
    ----------
    size : (float, float) [m]
        Lengths in x and y.
    thickness : float or (ny, nx) array [m]
        Thickness of the plate. Points between the two surfaces belong to the plate.
    elements : (int, int)
        Number of elements in x and y.

    Examples
    --------
    The weights of the deflections add up to one, so that a translation in z is exact:

    >>> import flexplant as fx
    >>> shape = fx.structure.PlateShape((1.0, 1.0), 0.01, (2, 2))
    >>> round(float(shape.row((0.3, 0.2, 0.0), "z")[::3].sum()), 9)
    1.0
    """

    size: tuple[float, float]
    thickness: float | FloatArray
    elements: tuple[int, int]

    motions = ("z", "rx", "ry")
    body = "a plate in bending"

    @cached_property
    def _grid(self) -> Grid:
        return Grid(self.size, self.elements, 3, np.ones(self.elements[::-1], dtype=bool))

    def _beside(self, points: FloatArray, element: IntArray) -> FloatArray:
        return np.asarray(np.abs(points[:, 2]) - 0.5 * self._depth(element))

    def _depth(self, element: IntArray) -> Any:
        return np.broadcast_to(self.thickness, self.elements[::-1])[tuple(element.T[::-1])]

    def _weights(self, direction: str, element: IntArray, place: FloatArray) -> FloatArray:
        (a, b), (s, t) = self._grid.steps, place.T
        if direction == "z":
            terms = thin_terms(s, t, 0, 0)
        elif direction == "rx":
            terms = thin_terms(s, t, 0, 1) / b
        else:
            terms = -thin_terms(s, t, 1, 0) / a
        return np.asarray(terms @ thin_coefficients(a, b))

    def _off(self, point: FloatArray, element: IntArray, outside: bool) -> LabelError:
        return LabelError(
            f"the point {tuple(point.tolist())} is off the plate, which reaches from "
            f"(0, 0) to ({self.size[0]:g}, {self.size[1]:g}) m at |z| <= "
            f"{0.5 * self._depth(element):g} m: its motion is not known. Coordinates are in metres."
        )


@dataclass(frozen=True, eq=False, repr=False)
class ThickPlateShape(PlateShape):
    """The shape functions of a rectangular grid of plate elements with shear deformation.

    Parameters
    ----------
    size, thickness, elements
        Size, thickness and number of elements, as for `PlateShape`.
    softness : float or (ny, nx) array [m^2]
        Ratio of bending stiffness to shear stiffness of the elements. 0: the plate has no shear
        deformation.

    Examples
    --------
    The weights of the deflections add up to one, so that a translation in z is exact:

    >>> import flexplant as fx
    >>> shape = fx.structure.ThickPlateShape((1.0, 1.0), 0.1, (2, 2), softness=3e-3)
    >>> round(float(shape.row((0.3, 0.2, 0.0), "z")[::3].sum()), 9)
    1.0
    """

    softness: float | FloatArray = 0.0

    def _weights(self, direction: str, element: IntArray, place: FloatArray) -> FloatArray:
        (a, b), (s, t) = self._grid.steps, place.T
        fields = plate_parts(s, t, a, b)
        along_x, along_y = fields.slopes
        parts = {"z": fields.z, "rx": along_y, "ry": -along_x}[direction]
        soft = np.broadcast_to(self.softness, self.elements[::-1])[tuple(element.T[::-1])]
        along = [edge_share(soft, length)[:, None] for length in (a, b)]
        return np.asarray(parts[0] + along[0] * parts[1] + along[1] * parts[2])


def plate(
    *,
    size: Sequence[float],
    thickness: Field,
    elements: Sequence[int],
    density: Field,
    youngs_modulus: Field,
    poisson_ratio: Field,
    shear_factor: float | None = 5 / 6,
    name: str | None = None,
) -> FEModel:
    """Return a free rectangular plate in bending, with shear and rotary inertia (Mindlin).

    The equations are ``rho h z'' = div(k G h (grad z - t))`` and
    ``rho h^3 / 12 t'' = div m(t) + k G h (grad z - t)``. Here z is the deflection, t are the slopes
    of the section, m(t) the bending moments, h the thickness, rho the density, G the shear modulus
    and k the shear factor [Mindlin1951]_. The elements have four nodes, quadratic slopes and
    constant shear along each edge [Katili1993]_. They do not become too stiff for thin plates (no
    locking), since they then turn into discrete Kirchhoff elements. Stiffness and consistent mass
    are integrated exactly. Errors are proportional to the square of the element size.

    The plate lies in the x-y plane with one corner at the origin and its middle plane at z = 0.
    Nodes are numbered from 1 along x, row by row. Each has the DOFs z [m] and the rotations rx, ry
    [rad] of the section. Without shear deformation, these are dz/dy and -dz/dx.

    Thickness, density and the constants of the material may each be one number, an array (nx, ny)
    with a number for each element, or a function of the centre (x, y) of an element.

    Parameters
    ----------
    size : (2,) array [m]
        Lengths in x and y.
    thickness : float, (nx, ny) array or function [m]
        Thickness, symmetric about the middle plane.
    elements : (2,) array of int
        Number of elements nx, ny. Near a free edge the twist changes within about one thickness.
        Larger elements cannot follow this change. The lowest frequency of a plate of 0.6 x 0.6 x
        0.027 m is then up to 1 % too high.
    density : float, (nx, ny) array or function [kg/m^3]
        Density of the material.
    youngs_modulus : float, (nx, ny) array or function [Pa]
        Young's modulus of the material.
    poisson_ratio : float, (nx, ny) array or function [-]
        Poisson's ratio, above -1 and below 0.5.
    shear_factor : float, optional
        Factor k of the shear stiffness k G h. It is 5/6 if the shear stress is a parabola over the
        thickness. None: the plate has no shear deformation, but its sections have inertia.
    name : str, optional
        Name of the model, as it is printed.

    Returns
    -------
    FEModel
        Model with sparse matrices and without D. Its DofSet interpolates between nodes with the
        shape functions of the elements.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, or the size of an array differs from the number of elements.

    See Also
    --------
    kirchhoff_plate : the thin plate, with frequencies that are 3 to 5 % too high at a wave length
    of fifteen times the thickness.

    Examples
    --------
    A square aluminium plate of 8 x 8 elements:

    >>> import flexplant as fx
    >>> fx.plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702,
    ...          youngs_modulus=70e9, poisson_ratio=0.35)
    <FEModel 'plate': 243 DOFs, sparse, 3 rigid-body motions, D not given>
    """
    grid = grid_of(size, elements, 2, 3)
    h = grid.field(thickness, "thickness")
    rho = grid.field(density, "density")
    E = grid.field(youngs_modulus, "youngs_modulus")
    nu = grid.poisson(poisson_ratio)
    soft = 0.0
    if shear_factor is not None:  # E h^3 / 12 (1 - nu^2) over k E h / 2 (1 + nu)
        soft = h**2 / (6.0 * positive(shear_factor, "shear_factor") * (1.0 - nu))
    (x, y), (nx, ny), (a, b) = grid.lengths, grid.counts, grid.steps
    M, K = plate_terms(
        a, b, soft, mass=rho * h, rotary=rho * h**3 / 12.0, nu=nu,
        bending=E * h**3 / (12.0 * (1.0 - nu**2)),
    )  # fmt: skip
    shape = ThickPlateShape((x, y), h, (nx, ny), softness=soft)
    return _plate_model(grid, M, K, shape, name)


def _plate_model(grid: Grid, M: Terms, K: Terms, shape: PlateShape, name: str | None) -> FEModel:
    # sums of definite elements are definite, so that no new check is needed
    return FEModel._proven(
        M=grid.matrix(_collected(M)),
        K=grid.matrix(_collected(K)),
        D=None,
        dofs=grid.dofs(("z", "rx", "ry"), shape),
        name="plate" if name is None else name,
    )


def kirchhoff_plate(
    *,
    size: Sequence[float],
    thickness: Field,
    elements: Sequence[int],
    density: Field,
    youngs_modulus: Field,
    poisson_ratio: Field,
    name: str | None = None,
) -> FEModel:
    """Return a free thin rectangular plate in bending, without shear and rotary inertia.

    The elements are those of Adini, Clough and Melosh. They have four nodes and are non-conforming.
    The deflection is a complete cubic polynomial with the additional terms x^3 y and x y^3.
    Stiffness and consistent mass are integrated exactly. The plate lies in the x-y plane with one
    corner at the origin and its middle plane at z = 0. Nodes are numbered from 1 along x, row by
    row. Each has the DOFs z [m], rx = dz/dy and ry = -dz/dx [rad].

    Thickness, density and the constants of the material may each be one number, an array (nx, ny)
    with a number for each element, or a function of the centre (x, y) of an element.

    Parameters
    ----------
    size : (2,) array [m]
        Lengths in x and y.
    thickness : float, (nx, ny) array or function [m]
        Thickness, symmetric about the middle plane.
    elements : (2,) array of int
        Number of elements nx, ny.
    density : float, (nx, ny) array or function [kg/m^3]
        Density of the material.
    youngs_modulus : float, (nx, ny) array or function [Pa]
        Young's modulus of the material.
    poisson_ratio : float, (nx, ny) array or function [-]
        Poisson's ratio, above -1 and below 0.5.
    name : str, optional
        Name of the model, as it is printed.

    Returns
    -------
    FEModel
        Model with sparse matrices and without D. Its DofSet interpolates between nodes with the
        shape functions of the elements.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, or the size of an array differs from the number of elements.

    Examples
    --------
    A square aluminium plate of 8 x 8 elements:

    >>> kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702,
    ...                 youngs_modulus=70e9, poisson_ratio=0.35)
    <FEModel 'plate': 243 DOFs, sparse, 3 rigid-body motions, D not given>
    """
    grid = grid_of(size, elements, 2, 3)
    h = grid.field(thickness, "thickness")
    rho = grid.field(density, "density")
    E = grid.field(youngs_modulus, "youngs_modulus")
    nu = grid.poisson(poisson_ratio)
    (x, y), (nx, ny), (a, b) = grid.lengths, grid.counts, grid.steps
    bending = E * h**3 / (12 * (1 - nu**2))
    plain, cross = plate_stiffness(a, b)
    shape = PlateShape((x, y), h, (nx, ny))
    M, K = [(plate_mass(a, b), rho * h)], [(plain, bending), (cross, bending * nu)]
    return _plate_model(grid, M, K, shape, name)
