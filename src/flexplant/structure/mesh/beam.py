"""A straight beam in bending."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...checks import one_of, positive, short
from ...errors import ModelError
from ..model import FEModel
from .element_matrices import beam_mass, beam_stiffness
from .grid_fields import Field, counts_of, dofs_of, field_of
from .grid_matrices import Grid
from .shapes import BeamShape

#: which motions an end does not have
_ENDS = {"free": (), "pinned": ("z",), "clamped": ("z", "ry"), "guided": ("ry",)}


def beam(
    *,
    length: float,
    elements: int,
    density: Field,
    youngs_modulus: Field,
    area: Field,
    inertia: Field,
    ends: tuple[str, str] = ("free", "free"),
    name: str | None = None,
) -> FEModel:
    """Return a straight beam in bending (Euler-Bernoulli), along x from the origin.

    ``rho A z'' + (E I z_xx)_xx = f``: two-node elements with cubic shape functions and consistent
    mass. Nodes are numbered from 1; each has the DOFs z [m] and ry = -dz/dx [rad], less those that
    its end holds. Shear and the inertia of turning sections are left out: good for wave lengths
    well above ten times the height.

    Parameters
    ----------
    length : float [m]
        Of the beam.
    elements : int
        Their number.
    density, youngs_modulus : float, (elements,) array or function of x [kg/m^3], [Pa]
        Of the material.
    area, inertia : float, (elements,) array or function of x [m^2], [m^4]
        Of the cross section, and its second moment of area.
    ends : (str, str)
        How each end is held: "free", "pinned" (z), "clamped" (z and ry) or "guided" (ry).
    name : str, optional
        For display.

    Returns
    -------
    FEModel
        Sparse, without D, interpolating with the cubic shape functions.

    Raises
    ------
    ModelError, ShapeError
        When a number is not physical, an end is unknown, or nothing is left to move.

    Examples
    --------
    >>> steel = {"density": 7850, "youngs_modulus": 210e9}
    >>> beam(length=1.0, elements=10, area=1e-4, inertia=8.3e-10, **steel, ends=("clamped", "free"))
    <FEModel 'beam': 20 DOFs, sparse, no rigid-body motions, D not given>
    """
    lengths, counts = (positive(length, "length"),), counts_of(elements, 1)
    held = _ends(ends)
    rho, E, A, inertia_of = (
        field_of(value, text, lengths, counts)
        for value, text in (
            (density, "density"),
            (youngs_modulus, "youngs_modulus"),
            (area, "area"),
            (inertia, "inertia"),
        )
    )
    grid, h = Grid(counts, 2, np.ones(counts, dtype=bool)), lengths[0] / counts[0]
    sign = np.outer([1, -1, 1, -1], [1, -1, 1, -1])  # ry = -dz/dx
    free = FEModel._proven(
        M=grid.matrix([(sign * beam_mass(h), rho * A)]),
        K=grid.matrix([(sign * beam_stiffness(h), E * inertia_of)]),
        D=None,
        dofs=dofs_of(grid, lengths, ("z", "ry"), BeamShape(lengths[0], counts[0])),
        name="beam" if name is None else name,
    )
    labels = [
        f"{node}:{d}" for node, kind in zip((1, counts[0] + 1), held, strict=True) for d in kind
    ]
    return free.fixed(labels) if labels else free


def _ends(ends: Any) -> list[tuple[str, ...]]:
    if isinstance(ends, str) or not isinstance(ends, Iterable) or len(list(ends)) != 2:
        raise ModelError(
            f"ends must be two words, for the ends at 0 and at the length, got {short(ends)}. "
            '("clamped", "free"), say.'
        )
    for end in ends:
        one_of(end, "an end of a beam", _ENDS)
    return [_ENDS[end] for end in ends]
