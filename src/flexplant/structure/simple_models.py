"""Machines of simple form: chains, straight beams, blocks of bricks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray, one_of, positive, positive_array, real_array, several
from ..errors import LabelError, ModelError, ShapeError, short
from ..labels import DIRECTIONS, DofSet
from ..store import frozen
from .element_matrices import (
    beam_mass,
    beam_parts,
    beam_stiffness,
    beam_terms,
    brick_bending,
    brick_mass,
    brick_shape,
    brick_slopes,
    brick_stiffness,
)
from .grids import Field, Grid, GridShape, grid_of
from .model import FEModel
from .plates import edge_share


def chain(
    *,
    masses: Sequence[float] | FloatArray,
    stiffnesses: Sequence[float] | FloatArray,
    dampings: Sequence[float] | FloatArray | None = None,
    ground: float | Sequence[float] | FloatArray = 0.0,
    spacing: float = 1.0,
    name: str | None = None,
) -> FEModel:
    """Return a chain of masses along x, with springs and dampers between neighbours.

    Mass i has the equation of motion
    ``m_i x_i'' = k_{i-1} (x_{i-1} - x_i) + k_i (x_{i+1} - x_i) - g_i x_i``. Here k_i is the
    stiffness between the masses i and i + 1, and g_i is the stiffness to the ground. Dampers
    between neighbours add their forces in the same way.

    Parameters
    ----------
    masses : (n,) array [kg]
        Masses. Their DOFs are "1:x", "2:x", ...
    stiffnesses : (n - 1,) array [N/m]
        Stiffnesses of the springs between neighbours.
    dampings : (n - 1,) array [N s/m], optional
        Damping between neighbours. None: the model has no D.
    ground : float or (n,) array [N/m]
        Stiffnesses from each mass to the ground.
    spacing : float [m]
        Distance between neighbours. Only the coordinates depend on it.
    name : str, optional
        Name of the model, as it is printed.

    Returns
    -------
    FEModel
        Model with n DOFs and sparse matrices.

    Raises
    ------
    ModelError, ShapeError
        When a number is negative, or the lengths of the arrays do not match.

    Examples
    --------
    Three masses and two springs, free along x:

    >>> chain(masses=[1, 2, 3], stiffnesses=[5, 7])
    <FEModel 'chain': 3 DOFs, sparse, 1 rigid-body motion, D not given>
    """
    m = positive_array(masses, "masses", (None,), hint="Leave massless ones out.")
    n = m.size
    if not n:
        raise ModelError(
            "masses is empty: a chain needs at least one mass. Pass for example [1.0]."
        )
    held = real_array(ground, "ground")
    held = np.zeros(n) + positive_array(held, "ground", (n,) if held.ndim else (), zero=True)
    k = _between_masses(stiffnesses, "stiffnesses", n)
    xyz = np.zeros((n, 3))
    xyz[:, 0] = positive(spacing, "spacing") * np.arange(n)
    return FEModel._proven(
        M=frozen(sp.diags_array(m, format="csc")),
        K=frozen(_laplacian(k, held)),
        D=None
        if dampings is None
        else frozen(_laplacian(_between_masses(dampings, "dampings", n), np.zeros(n))),
        dofs=DofSet(np.arange(1, n + 1), ("x",) * n, xyz),
        name="chain" if name is None else name,
    )


def _between_masses(given: Any, name: str, n: int) -> FloatArray:
    values = positive_array(given, name, (None,), zero=True)
    if values.size != n - 1:
        raise ShapeError(
            f"{n} masses have {n - 1} {name} between them, got {values.size}. Springs to the "
            "ground are given by ground=, dampers by model.with_parts([Damper(...)])."
        )
    return values


def _laplacian(between: FloatArray, ground: FloatArray) -> sp.csc_array:
    main = ground + np.append(between, 0.0) + np.append(0.0, between)
    return sp.csc_array(sp.diags_array([-between, main, -between], offsets=[-1, 0, 1]))


@dataclass(frozen=True, eq=False, repr=False)
class BeamShape(GridShape):
    """The shape functions of a beam along x, which are cubic between its nodes.

    Parameters
    ----------
    length : float [m]
        Length of the beam.
    elements : int
        Number of elements.
    softness : float or (elements,) array, optional [m^2]
        Ratio of bending stiffness to shear stiffness. None: the beam has no shear deformation.

    Examples
    --------
    A beam of 2 m with four elements:

    >>> import flexplant as fx
    >>> fx.structure.BeamShape(2.0, 4)
    BeamShape(length=2, elements=4)
    """

    length: float
    elements: int
    softness: float | FloatArray | None = None

    motions = ("z", "ry")
    body = "a beam in bending"

    @cached_property
    def _grid(self) -> Grid:
        return Grid((self.length,), (self.elements,), 2, np.ones(self.elements, dtype=bool))

    def _beside(self, points: FloatArray, element: IntArray) -> FloatArray:
        return np.asarray(np.abs(points[:, 1:]).max(axis=1))

    def _weights(self, direction: str, element: IntArray, place: FloatArray) -> FloatArray:
        (h,) = self._grid.steps
        given = 0.0 if self.softness is None else self.softness
        f = edge_share(np.broadcast_to(given, (self.elements,))[element], h)
        z, slope = (one[0] + f * one[1] for one in beam_parts(place[:, 0], h))
        return np.asarray((z if direction == "z" else -slope) * [1, -1, 1, -1])

    def _off(self, point: FloatArray, element: IntArray, outside: bool) -> LabelError:
        return LabelError(
            f"the point {tuple(point.tolist())} is off the beam, whose axis reaches from "
            f"(0, 0, 0) to ({self.length:g}, 0, 0) m: its motion is not known. Coordinates are in "
            "metres."
        )


#: motions that an end holds
_ENDS = {"free": (), "pinned": ("z",), "clamped": ("z", "ry"), "guided": ("ry",)}


def beam(
    *,
    length: float,
    elements: int,
    density: Field,
    youngs_modulus: Field,
    area: Field,
    inertia: Field,
    poisson_ratio: Field | None = None,
    shear_factor: float = 5 / 6,
    ends: tuple[str, str] = ("free", "free"),
    name: str | None = None,
) -> FEModel:
    """Return a straight beam in bending along x from the origin, by Euler-Bernoulli or Timoshenko.

    Without `poisson_ratio` this is the beam of Euler and Bernoulli. Its equation is
    ``rho A z'' + (E I z_xx)_xx = f``, where the index x means a derivative with respect to x. Its
    elements have two nodes, cubic shape functions and consistent mass. Nodes are numbered from 1.
    Each node has the DOFs z [m] and ry = -dz/dx [rad], except those that are held at an end. The
    model is accurate for wave lengths well above ten times the height.

    With `poisson_ratio` the beam has shear deformation and rotary inertia (Timoshenko). Its
    equations are ``rho A z'' = (k G A (z_x - t))_x`` and
    ``rho I t'' = (E I t_x)_x + k G A (z_x - t)``, where t is the slope of the section. Its elements
    are exact in statics [FriedmanKosmatka1993]_, and ry is the rotation -t of the section.

    Parameters
    ----------
    length : float [m]
        Length of the beam.
    elements : int
        Number of elements.
    density, youngs_modulus : float, (elements,) array or function of x [kg/m^3], [Pa]
        Density and Young's modulus of the material.
    area, inertia : float, (elements,) array or function of x [m^2], [m^4]
        Area of the cross section, and its second moment of area.
    poisson_ratio : float, (elements,) array or function of x, optional [-]
        Poisson's ratio nu, for the shear modulus G = E / (2 (1 + nu)). None: Euler-Bernoulli.
    shear_factor : float
        Factor k of the shear stiffness k G A. It is 5/6 for a rectangular section.
    ends : (str, str)
        Support of each end: "free", "pinned" (z is held), "clamped" (z and ry are held) or "guided"
        (ry is held).
    name : str, optional
        Name of the model, as it is printed.

    Returns
    -------
    FEModel
        Model with sparse matrices and without D. Its DofSet interpolates between nodes with the
        cubic shape functions.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, an end is unknown, or no DOF is free.

    Examples
    --------
    A steel cantilever of ten elements, clamped at its left end:

    >>> steel = {"density": 7850, "youngs_modulus": 210e9}
    >>> beam(length=1.0, elements=10, area=1e-4, inertia=8.3e-10, **steel, ends=("clamped", "free"))
    <FEModel 'beam': 20 DOFs, sparse, no rigid-body motions, D not given>
    """
    grid = grid_of((positive(length, "length"),), elements, 1, 2)
    held = _end_supports(ends)
    rho, E = grid.field(density, "density"), grid.field(youngs_modulus, "youngs_modulus")
    A, inertia_of = grid.field(area, "area"), grid.field(inertia, "inertia")
    (h,) = grid.steps
    turns = E * inertia_of  # bending stiffness
    softness: Any = None
    if poisson_ratio is None:
        M, K = [(beam_mass(h), rho * A)], [(beam_stiffness(h), turns)]
    else:
        nu = grid.poisson(poisson_ratio)
        sheared = positive(shear_factor, "shear_factor") * A
        softness = 2.0 * (1.0 + nu) * inertia_of / sheared
        f = edge_share(softness, h)
        masses, rotary, sections = beam_terms(h)
        M = [(one, rho * A * f**k) for k, one in enumerate(masses)]
        M += [(one, rho * inertia_of * f**k) for k, one in enumerate(rotary)]
        K = [(beam_stiffness(h), turns * f), (sections, turns * (1.0 - f))]
    sign = np.outer([1, -1, 1, -1], [1, -1, 1, -1])  # ry = -dz/dx
    shape = BeamShape(grid.lengths[0], grid.counts[0], softness)
    free = FEModel._proven(
        M=grid.matrix([(sign * matrix, weight) for matrix, weight in M]),
        K=grid.matrix([(sign * matrix, weight) for matrix, weight in K]),
        D=None,
        dofs=grid.dofs(("z", "ry"), shape),
        name="beam" if name is None else name,
    )
    nodes = (1, grid.counts[0] + 1)
    labels = [f"{node}:{d}" for node, kind in zip(nodes, held, strict=True) for d in kind]
    return free.fixed(labels) if labels else free


def _end_supports(ends: Any) -> list[tuple[str, ...]]:
    if not several(ends) or len(list(ends)) != 2:
        raise ModelError(
            f"ends must be two words, for the ends at 0 and at the length, got {short(ends)}. "
            '("clamped", "free"), say.'
        )
    for end in ends:
        one_of(end, "an end of a beam", _ENDS)
    return [_ENDS[end] for end in ends]


@dataclass(frozen=True, eq=False, repr=False)
class BlockShape(GridShape):
    """The trilinear shape functions of a box of eight-node bricks.

    Parameters
    ----------
    size : (float, float, float) [m]
        Lengths in x, y and z.
    elements : (int, int, int)
        Number of elements in x, y and z.
    present : (nz, ny, nx) array of bool, optional
        True for each element that exists. None: all elements exist.
    poisson_ratio : float
        Poisson's ratio. The transverse curvature of a bent element is proportional to it.

    Examples
    --------
    The weights add up to one, so that a translation along x is exact:

    >>> import flexplant as fx
    >>> shape = fx.structure.BlockShape((1.0, 1.0, 1.0), (2, 2, 2))
    >>> round(float(shape.row((0.3, 0.2, 0.1), "x").sum()), 9)
    1.0
    """

    size: tuple[float, float, float]
    elements: tuple[int, int, int]
    present: Any = None
    poisson_ratio: float = 0.0

    motions = DIRECTIONS
    body = "a solid"

    @cached_property
    def _grid(self) -> Grid:
        there = np.ones(self.elements[::-1], dtype=bool) if self.present is None else self.present
        return Grid(self.size, self.elements, 3, np.asarray(there))

    def _beside(self, points: FloatArray, element: IntArray) -> FloatArray:
        return np.zeros(len(points))

    def _weights(self, direction: str, element: IntArray, place: FloatArray) -> FloatArray:
        kind, weights = DIRECTIONS.index(direction), np.zeros((len(place), 11, 3))
        if kind < 3:
            weights[:, :, kind] = brick_shape(place)
        else:
            slopes = brick_slopes(place) / self._grid.steps
            after, before = (kind - 2) % 3, (kind - 1) % 3
            weights[:, :, before] = 0.5 * slopes[:, :, after]
            weights[:, :, after] = -0.5 * slopes[:, :, before]
        corners, bends = weights[:, :8].reshape(-1, 24), weights[:, 8:].reshape(-1, 9)
        return np.asarray(corners + bends @ self._bending)

    @cached_property
    def _bending(self) -> FloatArray:
        """Bending modes (9, 24) inside an element that follow its corners."""
        a, b, c = self._grid.steps
        return brick_bending(a, b, c, self.poisson_ratio)

    def _off(self, point: FloatArray, element: IntArray, outside: bool) -> LabelError:
        where = "outside" if outside else "in a hole of"
        return LabelError(
            f"the point {tuple(point.tolist())} is {where} the block, which reaches from "
            f"(0, 0, 0) to {self.size} m: its motion is not known. Coordinates are in metres."
        )


def solid_block(
    *,
    size: Sequence[float],
    elements: Sequence[int],
    density: Field,
    youngs_modulus: Field,
    poisson_ratio: float,
    holes: FloatArray | Callable[[float, float, float], bool] | None = None,
    name: str | None = None,
) -> FEModel:
    """Return a free rectangular block of eight-node bricks, with one corner at the origin.

    Displacements are trilinear. The incompatible modes of Wilson and Taylor are added inside each
    element, so that the elements are not too stiff in bending (locking). The mass matrix is
    consistent. Nodes are numbered from 1, first along x, then y, then z. Each has the DOFs x, y and
    z [m]. With holes, nodes keep the numbers of the full block.

    Parameters
    ----------
    size : (3,) array [m]
        Lengths in x, y and z.
    elements : (3,) array of int
        Number of elements nx, ny, nz.
    density : float, (nx, ny, nz) array or function of an element's centre [kg/m^3]
        Density of the material.
    youngs_modulus : float, (nx, ny, nz) array or function of an element's centre [Pa]
        Young's modulus of the material.
    poisson_ratio : float [-]
        Poisson's ratio, above -1 and below 0.5, the same everywhere.
    holes : (nx, ny, nz) array of bool or function of an element's centre, optional
        True for each element that is missing.
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
        When a number is not physical, the size of an array differs from the number of elements, or
        the holes divide the block into separate pieces.

    Examples
    --------
    An aluminium block of 4 x 3 x 1 elements:

    >>> solid_block(size=(0.4, 0.3, 0.1), elements=(4, 3, 1), density=2700, youngs_modulus=70e9,
    ...             poisson_ratio=0.33)
    <FEModel 'block': 120 DOFs, sparse, 6 rigid-body motions, D not given>
    """
    grid = grid_of(size, elements, 3, 3, holes)
    rho, E = grid.field(density, "density"), grid.field(youngs_modulus, "youngs_modulus")
    nu = grid.poisson(real_array(poisson_ratio, "poisson_ratio", ()).item())
    a, b, c = grid.steps
    (sx, sy, sz), (nx, ny, nz) = grid.lengths, grid.counts
    present = None if grid.present.all() else grid.present
    shape = BlockShape((sx, sy, sz), (nx, ny, nz), present, nu)
    return FEModel._proven(
        M=grid.matrix([(brick_mass(a, b, c), rho)]),
        K=grid.matrix([(brick_stiffness(a, b, c, nu), E)]),
        D=None,
        dofs=grid.dofs(("x", "y", "z"), shape),
        name="block" if name is None else name,
    )
