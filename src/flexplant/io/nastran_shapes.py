"""Eigenvectors of Nastran, node by node, brought to places and global directions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..dof_columns import at_nodes
from ..errors import LabelError, counted
from ..labels import DIRECTIONS, DofSet
from ..values import FloatArray
from .file_shapes import FileShapes
from .nastran import Nodes, read_nodes
from .tables import read_nodes_table

_BULK = (".bdf", ".dat", ".nas", ".blk")


def shapes_at(
    table: tuple[Any, Any, Any],
    omega: FloatArray,
    *,
    nodes: Nodes | Path | None,
    turned: bool,
    masses: FloatArray | None,
    path: str,
) -> FileShapes:
    """Return the FileShapes of eigenvectors."""
    ids, kinds, values = table
    grid = kinds == 1
    notes: tuple[str, ...] = ()
    if not grid.all():
        scalar = counted(int(np.count_nonzero(~grid)), "scalar point")
        notes = (f"without a place, left out: {scalar}",)
    ids, values = ids[grid], np.array(values[grid])
    xyz, axes = _places(ids, nodes, path)
    local_rows = [] if turned else [i for i, node in enumerate(ids.tolist()) if node in axes]
    for row in local_rows:
        local = axes[int(ids[row])]
        for first in (0, 3):
            values[row, first : first + 3] = local @ values[row, first : first + 3]
    if local_rows:
        moved = counted(len(local_rows), "node")
        notes = (*notes, f"{moved} moved in local directions: turned into the basic ones")
    dofs = DofSet(np.repeat(ids, 6), DIRECTIONS * ids.size, np.repeat(xyz, 6, axis=0))
    phi = values.reshape(6 * ids.size, omega.size)
    return FileShapes(omega, phi, dofs, masses=masses, notes=notes)


def _places(ids: Any, nodes: Nodes | Path | None, path: str) -> tuple[FloatArray, Any]:
    if isinstance(nodes, Path):
        if not nodes.name.lower().endswith(_BULK):
            known, xyz = read_nodes_table(nodes)
            return at_nodes(ids, known, xyz, str(nodes)), {}
        nodes = read_nodes(nodes)
    missing = [node for node in ids.tolist() if nodes is None or node not in nodes.xyz]
    if nodes is None or missing:
        raise LabelError(
            f"{path!r} does not say where {len(missing)} of its nodes are, the first "
            f"{missing[:6]}, nor in which directions they move. Give the bulk data: nodes=."
        )
    return np.array([nodes.xyz[node] for node in ids.tolist()]).reshape(-1, 3), nodes.axes
