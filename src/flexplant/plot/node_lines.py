"""Nodes that translate, and lines between nodes: those that elements join, or that are near."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..labels import DofSet
from ..structure.model import FEModel

#: neighbours of a node among which its lines are searched
_NEIGHBOURS = 27


def translations(dofs: DofSet) -> tuple[IntArray, FloatArray, IntArray]:
    """Return the nodes, their places (n, 3), and the DOFs (n, 3) along x, y and z, -1 for none."""
    nodes, first, node = np.unique(dofs.nodes, return_index=True, return_inverse=True)
    rows = np.full((nodes.size, 3), -1, dtype=np.int64)
    moves = dofs.kinds < 3
    rows[node[moves], dofs.kinds[moves]] = np.flatnonzero(moves)
    return nodes, np.asarray(dofs.xyz[first]), rows


def joined_lines(joined: Any, nodes: IntArray) -> IntArray:
    """Return the rows (m, 2) of sorted `nodes` that a model or pairs of node numbers join."""
    if isinstance(joined, FEModel):
        found = sp.coo_array(joined.K)
        kept = found.data != 0
        numbers = np.asarray(joined.dofs.nodes)
        pairs = np.column_stack([numbers[found.row[kept]], numbers[found.col[kept]]])
        pairs = pairs[np.isin(pairs, nodes).all(axis=1)]
    else:
        pairs = np.asarray(joined)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.isin(pairs, nodes).all():
            raise ModelError(
                "joined is the FEModel, or an array (m, 2) of the node numbers at both ends of "
                f"each line, got {type(joined).__name__} of shape {pairs.shape}. Pass numbers of "
                "nodes of these modes."
            )
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    lines = np.searchsorted(nodes, np.unique(pairs, axis=0))
    return np.asarray(lines, dtype=np.int64).reshape(-1, 2)


def neighbours(xyz: FloatArray) -> IntArray:
    """Return the pairs (m, 2) of nodes between which no other lies (a Gabriel graph)."""
    # a pair is joined when the sphere with it as diameter holds no third node: the lines of a
    # regular mesh without its diagonals, whatever its ratio of sides
    from scipy.spatial import cKDTree

    count = min(len(xyz), _NEIGHBOURS)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    tree: Any = cKDTree(xyz)
    distance, near = tree.query(xyz, k=count)
    i = np.repeat(np.arange(len(xyz)), count)
    pairs = np.column_stack([i, near.ravel()])[distance.ravel() > 0]
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    a, b = xyz[pairs[:, 0]], xyz[pairs[:, 1]]
    radius = 0.5 * np.linalg.norm(b - a, axis=1)
    closest, _ = tree.query((a + b) / 2, k=min(3, len(xyz)))
    # the pair itself is at the radius; a third node inside or on the sphere is nearer or as near
    # nodes of a regular mesh lie on the sphere: rounding must not decide
    inside = np.atleast_2d(closest)[:, : min(3, len(xyz))] < radius[:, None] * (1.0 - 1e-6)
    on = np.sum(closest <= radius[:, None] * (1.0 + 1e-6), axis=1) > 2
    return np.asarray(pairs[~inside.any(axis=1) & ~on], dtype=np.int64)
