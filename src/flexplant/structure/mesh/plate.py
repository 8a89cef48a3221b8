"""A rectangular Kirchhoff plate of four-node elements with twelve degrees of freedom."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from typing import Any

import numpy as np

from ...checks import FloatArray, members
from ..model import FEModel
from .element_matrices import plate_mass, plate_stiffness
from .grid_fields import (
    Field,
    Hole,
    counts_of,
    dofs_of,
    field_of,
    lengths_of,
    poisson_of,
    present_of,
    share_of,
)
from .grid_matrices import Grid
from .ribs import Rib, Skin, rib_matrices
from .shapes import PlateShape as PlateShape


def kirchhoff_plate(
    *,
    size: Sequence[float],
    thickness: Field,
    elements: Sequence[int],
    density: Field,
    youngs_modulus: Field,
    poisson_ratio: Field,
    holes: Iterable[Hole] | Hole | FloatArray | Callable[[float, float], bool] | None = None,
    ribs: Iterable[Rib] | Rib = (),
    name: str | None = None,
) -> FEModel:
    """Return a free rectangular plate in bending.

    Four-node non-conforming elements with the complete cubic and x^3 y, x y^3 (Adini, Clough and
    Melosh), stiffness and consistent mass integrated exactly. The plate lies in the x-y plane with
    one corner at the origin and its middle plane at z = 0. Nodes are numbered from 1, x fastest;
    each has the DOFs z [m], rx = dz/dy and ry = -dz/dx [rad]. Beside holes, nodes keep the numbers
    of the full plate.

    Thickness and material are one number, an array (nx, ny) with one for each element, or a
    function of the centre (x, y) of an element.

    Parameters
    ----------
    size : (2,) array [m]
        Lengths in x and y.
    thickness : float, (nx, ny) array or function [m]
        Thickness, symmetric about the middle plane.
    elements : (2,) array of int
        Number of elements nx, ny.
    density : float, (nx, ny) array or function [kg/m^3]
        Mass density.
    youngs_modulus : float, (nx, ny) array or function [Pa]
        Young's modulus.
    poisson_ratio : float, (nx, ny) array or function [-]
        Above -1 and below 0.5.
    holes : Rectangle, Disc, list of them, (nx, ny) array of bool or function of (x, y), optional
        Which elements are missing (True). Elements that the edge of a Rectangle or Disc cuts have
        their stiffness and mass times the part of their area that is left: frequencies of a plate
        with a disc of a third of its length are within 0.4 % at 24 x 16 elements, 0.2 % at 48 x 32.
    ribs : Rib or list of them
        Beams along edges of elements.
    name : str, optional
        For display.

    Returns
    -------
    FEModel
        Sparse, without D, its DofSet interpolating with the element's own shape functions.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, there is not one for each element, the plate falls apart, or
        a rib is not along edges.

    Examples
    --------
    >>> kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702,
    ...                 youngs_modulus=70e9, poisson_ratio=0.35)
    <FEModel 'plate': 243 DOFs, sparse, 3 rigid-body motions, D not given>
    """
    lengths, counts = lengths_of(size, 2), counts_of(elements, 2)
    if isinstance(holes, Iterator | Set):
        holes = list(holes)
    present = present_of(holes, lengths, counts, corners=True)
    skin = Skin(
        field_of(thickness, "thickness", lengths, counts, present),
        field_of(density, "density", lengths, counts, present),
        field_of(youngs_modulus, "youngs_modulus", lengths, counts, present),
        poisson_of(poisson_ratio, lengths, counts, present),
    )
    there = np.ones(counts[::-1], dtype=bool) if present is None else present
    grid = Grid(counts, 3, there)
    a, b = lengths[0] / counts[0], lengths[1] / counts[1]
    share = share_of(holes, lengths, counts)
    M = grid.matrix([(plate_mass(a, b), share * skin.density * skin.thickness)])
    bending = share * skin.youngs_modulus * skin.thickness**3 / (12 * (1 - skin.poisson_ratio**2))
    K = grid.matrix(_weighted(plate_stiffness(a, b), bending, skin.poisson_ratio))
    listed = _ribs(ribs)
    if listed:
        M, K = rib_matrices(grid, lengths, skin, listed, M, K)
    shape = PlateShape((lengths[0], lengths[1]), skin.thickness, (counts[0], counts[1]), present)
    # sums of definite elements are definite: nothing to check again
    return FEModel._proven(
        M=M,
        K=K,
        D=None,
        dofs=dofs_of(grid, lengths, ("z", "rx", "ry"), shape),
        name="plate" if name is None else name,
    )


def _weighted(parts: tuple[FloatArray, FloatArray], bending: Any, nu: Any) -> Any:
    plain, cross = parts
    if np.ndim(nu) == 0:
        return [(plain + nu * cross, bending)]
    return [(plain, bending), (cross, bending * nu)]


def _ribs(ribs: Any) -> list[Rib]:
    listed = [ribs] if isinstance(ribs, Rib) else ribs
    hint = "Rib((0, 0.3), (0.6, 0.3), width=0.01, height=0.02), say."
    return list(members(listed, Rib, "ribs", hint, least=0))
