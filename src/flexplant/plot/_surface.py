"""The surface of a structure from its nodes alone: models hold matrices, no elements."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..errors import ModelError
from ..labels import DofSet
from ..values import FloatArray, IntArray

#: (n_dof,) or (n, 3), real or complex
Shape: TypeAlias = Any

#: nodes of a structure whose picture is drawn within seconds
MOST = 30_000
#: edges longer than this many times the distance between nodes join what is not connected
_REACH = 2.5
#: relative: nodes are on a line, or in a plane, up to this
_FLAT = 1e-6
#: share of the hull that a surface has at least: with less, the nodes are too irregular to judge
_WHOLE = 0.6
#: cosine of the angle between faces, below which their edge is one of the body
_EDGE = 0.8


class Surface(NamedTuple):
    """The surface of a structure."""

    xyz: FloatArray
    rows: IntArray
    triangles: IntArray
    edges: IntArray

    @property
    def is_solid(self) -> bool:
        """Whether the nodes fill a volume."""
        return bool(len(self.triangles)) and _rank(self.xyz) == 3

    @property
    def extent(self) -> float:
        """The largest dimension [m]."""
        return float(np.max(np.ptp(self.xyz, axis=0)))

    def motion(self, shape: Shape) -> Shape:
        """Return the displacements (n, 3) of the nodes by a real or complex shape (n_dof,)."""
        moved: Shape = np.where(self.rows >= 0, shape[self.rows], 0.0)
        return moved


def surface_of(dofs: DofSet) -> Surface:
    """Return the surface of a structure, by Delaunay's triangulation of its nodes.

    Edges much longer than the distance between nodes are left out: holes and notches stay open
    where they are wider than two elements, half an element of their corners is filled.
    """
    numbers, first, node = np.unique(dofs.nodes, return_index=True, return_inverse=True)
    if numbers.size > MOST:
        raise ModelError(
            f"{numbers.size} nodes are more than a picture shows ({MOST}): reduce the model, or "
            "choose DOFs of its surface (dofs.where)."
        )
    rows = np.full((numbers.size, 3), -1, dtype=np.int64)
    moves = dofs.kinds < 3
    rows[node[moves], dofs.kinds[moves]] = np.flatnonzero(moves)
    xyz = np.asarray(dofs.xyz[first])
    rank = _rank(xyz)
    if rank < 2 or numbers.size < rank + 1:
        order = np.argsort(xyz @ np.array([1.0, 1e-3, 1e-6]))
        chain = np.column_stack([order[:-1], order[1:]])
        return Surface(xyz, rows, np.zeros((0, 3), dtype=np.int64), chain)
    flat = _plane(xyz) if rank == 2 else xyz
    triangles = _triangulated(flat)
    return Surface(xyz, rows, triangles, _edges(xyz, triangles))


def _rank(xyz: FloatArray) -> int:
    """Return 0 to 3: whether nodes are in one place, on a line, in a plane, or fill a volume."""
    if len(xyz) < 2:
        return 0
    sizes = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    return int(np.count_nonzero(sizes > _FLAT * sizes[0]))


def _plane(xyz: FloatArray) -> FloatArray:
    """Return two of the coordinates (n, 2) of nodes in a plane, without the one closest across."""
    normal = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)[2][2]
    return np.delete(xyz, int(np.argmax(np.abs(normal))), axis=1)


def _triangulated(points: FloatArray) -> IntArray:
    """Return triangles of points (n, 2), or the outer faces of the tetrahedra between (n, 3)."""
    from scipy.spatial import Delaunay, cKDTree

    scaled = points / _spacings(points)
    simplices = np.asarray(Delaunay(scaled).simplices, dtype=np.int64)
    corners = scaled[simplices]
    sides = corners[:, :, None, :] - corners[:, None, :, :]
    longest = np.sqrt(np.max(np.sum(sides**2, axis=-1), axis=(1, 2)))
    near = np.asarray(cKDTree(scaled).query(scaled, k=2)[0])[:, 1]
    kept = simplices[longest <= _REACH * near[simplices].max(axis=1)]
    if np.unique(kept).size > _WHOLE * len(points):
        simplices = kept
    if points.shape[1] == 2:
        return simplices
    faces = np.vstack([np.delete(simplices, k, axis=1) for k in range(4)])
    _, index, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return np.asarray(faces[index[count == 1]])


def _spacings(points: FloatArray) -> FloatArray:
    """Return the distance between nodes along each axis: of a grid its steps, else one for all."""
    extent = np.ptp(points, axis=0)
    steps = []
    for k, size in enumerate(extent):
        levels = np.unique(np.round(points[:, k] / size, 6)) * size
        steps.append(float(np.median(np.diff(levels))) if 2 * levels.size <= len(points) else 0.0)
    return np.array(steps) if all(steps) else np.full(extent.size, float(extent.max()))


def _edges(xyz: FloatArray, triangles: IntArray) -> IntArray:
    """Return the sides that belong to one triangle only, or to two at an angle."""
    a, b, c = (xyz[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    known = np.flatnonzero(area[:, 0] > _FLAT * area.max())
    normal = normal / np.where(area > 0, area, 1.0)
    sides = np.sort(np.vstack([triangles[known][:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    order = np.lexsort(sides.T)
    sides, owner = sides[order], np.tile(known, 3)[order]
    same = np.all(sides[1:] == sides[:-1], axis=1)
    # of neighbours in a plane |cos| is 1, whichever way their corners are listed
    flat = np.abs(np.sum(normal[owner[1:]] * normal[owner[:-1]], axis=1)) > _EDGE
    inside = np.zeros(len(sides), dtype=bool)
    inside[1:] |= same & flat
    inside[:-1] |= same & flat
    return np.asarray(np.unique(sides[~inside], axis=0))
