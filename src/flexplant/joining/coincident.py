"""Joints of all nodes of two components that are at the same places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from ..dof_index import in_box
from ..errors import ModelError
from ..labels import DIRECTIONS, DofSet
from ..values import FloatArray, positive
from .component import Component, Model, components_of
from .joint import Joint
from .links import machine_size
from .pose import Pose


def coincident_joints(
    components: Mapping[str, Model],
    *,
    placed: Mapping[str, Pose] | None = None,
    box: Sequence[Sequence[float]] | FloatArray | None = None,
    tolerance: float | None = None,
) -> list[Joint]:
    """Return rigid joints of all nodes of different components that are at one place.

    For meshes that match. Each joins the directions that both nodes have.

    Parameters
    ----------
    components : mapping {str: FEModel or ReducedModel}
        As `joined` takes them; of a reduced model all nodes count.
    placed : mapping {str: Pose}, optional
        As `joined` takes it.
    box : (2, 3) array [m], optional
        Only nodes in this box of the machine.
    tolerance : float [m], optional
        How far apart nodes may be; None: 1e-6 of the machine's size.

    Returns
    -------
    list of Joint

    Raises
    ------
    ModelError
        When no two nodes are at one place, or some are near several.

    Examples
    --------
    >>> from flexplant.structure import chain
    >>> stage, frame = chain(masses=[1, 2], stiffnesses=[5]), chain(masses=[3, 4], stiffnesses=[6])
    >>> coincident_joints({"stage": stage, "frame": frame}, box=[(0, 0, 0), (0, 0, 0)])
    [<Joint stage/1 - frame/1 along x, rigid>]
    """
    parts = components_of(components, placed)
    reach = 1e-6 * machine_size(parts) if tolerance is None else positive(tolerance, "tolerance")
    found: list[Joint] = []
    for one, other in combinations(parts, 2):
        found += _joints(one, other, box, reach)
    if not found:
        raise ModelError(
            f"no nodes of {', '.join(part.name for part in parts)} are within {reach:.2g} m of "
            "each other. Are they placed as they are meant to be? Give tolerance=, or join a Patch."
        )
    return found


def _joints(one: Component, other: Component, box: Any, reach: float) -> list[Joint]:
    from scipy.spatial import KDTree

    first, second = _nodes(one.dofs, box), _nodes(other.dofs, None)
    if not first.size or not second.size:
        return []
    found_at: Any = KDTree(other.dofs.xyz[second]).query(one.dofs.xyz[first])
    distance, nearest = found_at
    pairs = [(first[i], second[nearest[i]]) for i in np.flatnonzero(distance <= reach)]
    if len({int(row) for _, row in pairs}) < len(pairs):
        raise ModelError(
            f"nodes of {one.name!r} and {other.name!r} are near several of each other within "
            f"{reach:.2g} m: lower tolerance=."
        )
    found = []
    for i, j in pairs:
        both = _axes(one.dofs, i) & _axes(other.dofs, j)
        if both:
            ends = (f"{one.name}/{_name(one.dofs, i)}", f"{other.name}/{_name(other.dofs, j)}")
            found.append(Joint(*ends, axes=[axis for axis in DIRECTIONS if axis in both]))
    return found


def _nodes(dofs: DofSet, box: Any) -> Any:
    """Return one row for each node in a box."""
    inside = np.ones(len(dofs), dtype=bool) if box is None else in_box(dofs.xyz, box)
    first = np.unique(dofs.node_index, return_index=True)[1]
    return first[inside[first]]


def _axes(dofs: DofSet, row: int) -> set[str]:
    return {dofs.directions[i] for i in np.flatnonzero(dofs.node_index == dofs.node_index[row])}


def _name(dofs: DofSet, row: int) -> str:
    return dofs._label(row).partition(":")[0]
