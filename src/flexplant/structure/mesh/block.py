"""A solid block of bricks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...checks import FloatArray, real_array
from ..model import FEModel
from .element_matrices import brick_mass, brick_stiffness
from .grid_fields import Field, counts_of, dofs_of, field_of, lengths_of, poisson_of, present_of
from .grid_matrices import Grid
from .shapes import BlockShape


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
    """Return a free rectangular block of eight-node bricks, corner at the origin.

    Trilinear displacements with incompatible modes inside each element (Wilson and Taylor), so that
    bending is not locked; consistent mass. Nodes are numbered from 1, x fastest, then y, z; each
    has the DOFs x, y, z [m]. Beside holes, nodes keep the numbers of the full block.

    Parameters
    ----------
    size : (3,) array [m]
        Lengths in x, y and z.
    elements : (3,) array of int
        Number of elements nx, ny, nz.
    density : float, (nx, ny, nz) array or function of an element's centre [kg/m^3]
        Mass density.
    youngs_modulus : float, (nx, ny, nz) array or function of an element's centre [Pa]
        Young's modulus.
    poisson_ratio : float [-]
        Above -1 and below 0.5, the same everywhere.
    holes : (nx, ny, nz) array of bool or function of an element's centre, optional
        Which elements are missing (True).
    name : str, optional
        For display.

    Returns
    -------
    FEModel
        Sparse, without D, its DofSet interpolating with the trilinear shape functions.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, there is not one for each element, or the block falls apart.

    Examples
    --------
    >>> solid_block(size=(0.4, 0.3, 0.1), elements=(4, 3, 1), density=2700, youngs_modulus=70e9,
    ...             poisson_ratio=0.33)
    <FEModel 'block': 120 DOFs, sparse, 6 rigid-body motions, D not given>
    """
    lengths, counts = lengths_of(size, 3), counts_of(elements, 3)
    present = present_of(holes, lengths, counts, corners=False)
    rho = field_of(density, "density", lengths, counts, present)
    E = field_of(youngs_modulus, "youngs_modulus", lengths, counts, present)
    nu = poisson_of(real_array(poisson_ratio, "poisson_ratio", ()).item(), lengths, counts, present)
    there = np.ones(counts[::-1], dtype=bool) if present is None else present
    grid = Grid(counts, 3, there)
    a, b, c = (n / k for n, k in zip(lengths, counts, strict=True))
    shape = BlockShape(
        (lengths[0], lengths[1], lengths[2]), (counts[0], counts[1], counts[2]), present
    )
    return FEModel._proven(
        M=grid.matrix([(brick_mass(a, b, c), rho)]),
        K=grid.matrix([(brick_stiffness(a, b, c, nu), E)]),
        D=None,
        dofs=dofs_of(grid, lengths, ("x", "y", "z"), shape),
        name="block" if name is None else name,
    )
