"""Rectangular plates that shear and whose sections have rotary inertia."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import FloatArray, positive
from .element_matrices import Grid
from .grid_fields import Field, counts_of, dofs_of, field_of, lengths_of, poisson_of
from .model import FEModel
from .shapes import PlateShape
from .thick_elements import edge_share, plate_parts, plate_terms


@dataclass(frozen=True, eq=False, repr=False)
class ThickPlateShape(PlateShape):
    """The fields of a rectangular grid of plate elements that shear.

    Parameters
    ----------
    size, thickness, elements
        As for `PlateShape`.
    softness : float or (ny, nx) array [m^2]
        Bending stiffness over shear stiffness of the elements; 0: nothing shears.

    Examples
    --------
    >>> import flexplant as fx
    >>> shape = fx.structure.ThickPlateShape((1.0, 1.0), 0.1, (2, 2), softness=3e-3)
    >>> round(float(shape.row((0.3, 0.2, 0.0), "z")[::3].sum()), 9)
    1.0
    """

    softness: float | FloatArray = 0.0

    def _weights(self, direction: str, element: Any, s: Any, t: Any) -> FloatArray:
        a, b = (n / k for n, k in zip(self.size, self.elements, strict=True))
        fields = plate_parts(s, t, a, b)
        along_x, along_y = fields.slopes
        parts = {"z": fields.z, "rx": along_y, "ry": -along_x}[direction]
        x, y = element
        soft = np.broadcast_to(np.asarray(self.softness), self.elements[::-1])[y, x]
        shares = [edge_share(soft, length)[..., None] for length in (a, b)]
        found = parts[0] + shares[0] * parts[1] + shares[1] * parts[2]
        return np.asarray(found.reshape(*np.shape(s), 12))


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

    ``rho h z'' = div(k G h (grad z - t))``, ``rho h^3 / 12 t'' = div m(t) + k G h (grad z - t)``
    with the slopes t of the section and the moments m of their gradient [Mindlin1951]_. Four-node
    elements with quadratic slopes and constant shear along each edge [Katili1993]_: they do not
    lock, and become those of a discrete Kirchhoff plate where it is thin; stiffness and consistent
    mass are integrated exactly. Errors fall with the square of the element size.

    The plate lies in the x-y plane with one corner at the origin and its middle plane at z = 0.
    Nodes are numbered from 1, x fastest; each has the DOFs z [m] and the rotations rx, ry [rad] of
    the section, which are dz/dy and -dz/dx where nothing shears.

    Thickness and material are one number, an array (nx, ny) with one for each element, or a
    function of the centre (x, y) of an element.

    Parameters
    ----------
    size : (2,) array [m]
        Lengths in x and y.
    thickness : float, (nx, ny) array or function [m]
        Thickness, symmetric about the middle plane.
    elements : (2,) array of int
        Number of elements nx, ny. Elements smaller than the thickness show how a free edge twists:
        larger ones make the lowest frequency of a plate of 0.6 x 0.6 x 0.027 m up to 1 % too high.
    density : float, (nx, ny) array or function [kg/m^3]
    youngs_modulus : float, (nx, ny) array or function [Pa]
    poisson_ratio : float, (nx, ny) array or function [-]
        Above -1 and below 0.5.
    shear_factor : float, optional
        k of the shear stiffness k G h; 5/6 for a plate whose shear stress is a parabola over the
        thickness. None: the plate does not shear, but its sections have inertia.
    name : str, optional

    Returns
    -------
    FEModel
        Sparse, without D, its DofSet interpolating with the element's own fields.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, or there is not one for each element.

    See Also
    --------
    kirchhoff_plate : the thin plate; its frequencies are 3 to 5 % too high at a wave length of
    fifteen times the thickness.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702,
    ...          youngs_modulus=70e9, poisson_ratio=0.35)
    <FEModel 'plate': 243 DOFs, sparse, 3 rigid-body motions, D not given>
    """
    lengths, counts = lengths_of(size, 2), counts_of(elements, 2)
    h, rho, E = (
        field_of(value, text, lengths, counts)
        for value, text in (
            (thickness, "thickness"),
            (density, "density"),
            (youngs_modulus, "youngs_modulus"),
        )
    )
    nu = poisson_of(poisson_ratio, lengths, counts)
    soft = 0.0
    if shear_factor is not None:  # E h^3 / 12 (1 - nu^2) over k E h / 2 (1 + nu)
        soft = h**2 / (6.0 * positive(shear_factor, "shear_factor") * (1.0 - nu))
    a, b = (n / k for n, k in zip(lengths, counts, strict=True))
    M, K = plate_terms(
        a, b, soft, mass=rho * h, rotary=rho * h**3 / 12.0, nu=nu,
        bending=E * h**3 / (12.0 * (1.0 - nu**2)),
    )  # fmt: skip
    grid = Grid(counts, 3, np.ones(counts[::-1], dtype=bool))
    shape = ThickPlateShape((lengths[0], lengths[1]), h, (counts[0], counts[1]), softness=soft)
    # sums of definite elements are definite, so that no new check is needed
    return FEModel._proven(
        M=grid.matrix(M),
        K=grid.matrix(K),
        D=None,
        dofs=dofs_of(grid, lengths, ("z", "rx", "ry"), shape),
        name="plate" if name is None else name,
    )
