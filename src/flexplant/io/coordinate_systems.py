"""Coordinate systems of files: positions of points, and directions of motion of nodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..tolerances import ROUNDING

CARTESIAN, CYLINDRICAL, SPHERICAL = "cartesian", "cylindrical", "spherical"


class System(NamedTuple):
    """A coordinate system: its kind, its origin and its axes (columns) in the basic system."""

    kind: str
    origin: FloatArray
    axes: FloatArray

    def position(self, place: FloatArray) -> FloatArray:
        """Return the basic coordinates of a point (angles in degrees)."""
        first, second, third = place
        turn = np.deg2rad(second)
        if self.kind == CYLINDRICAL:
            place = np.array([first * np.cos(turn), first * np.sin(turn), third])
        elif self.kind == SPHERICAL:
            around = np.deg2rad(third)
            ring = first * np.sin(turn)
            place = np.array([ring * np.cos(around), ring * np.sin(around), first * np.cos(turn)])
        return np.asarray(self.origin + self.axes @ place)

    def axes_at(self, xyz: FloatArray) -> FloatArray:
        """Return the axes (columns) of displacements at a place, which turn in a polar system."""
        if self.kind == CARTESIAN:
            return self.axes
        x, y, z = self.axes.T @ (xyz - self.origin)
        around = np.arctan2(y, x)
        radial = np.array([np.cos(around), np.sin(around), 0.0])
        tangent = np.array([-np.sin(around), np.cos(around), 0.0])
        if self.kind == CYLINDRICAL:
            return np.asarray(self.axes @ np.column_stack([radial, tangent, [0, 0, 1]]))
        down = np.arctan2(np.hypot(x, y), z)
        outward = np.sin(down) * radial + np.cos(down) * np.array([0, 0, 1.0])
        south = np.cos(down) * radial - np.sin(down) * np.array([0, 0, 1.0])
        return np.asarray(self.axes @ np.column_stack([outward, south, tangent]))


#: the basic system, in which all others are defined in the end
BASIC = System(CARTESIAN, np.zeros(3), np.eye(3))


def axes_along(first: FloatArray, in_plane: FloatArray) -> FloatArray | None:
    """Return the unit vector along the first of two, and one in their plane; None on a line."""
    normal = np.cross(first, in_plane)
    if not np.linalg.norm(first) or np.linalg.norm(normal) < ROUNDING * np.linalg.norm(first):
        return None
    first, normal = first / np.linalg.norm(first), normal / np.linalg.norm(normal)
    return np.column_stack([first, np.cross(normal, first), normal])


def turned_motions(motions: Any, nodes: Iterable[int], axes: Mapping[int, FloatArray]) -> Any:
    """Return motions (n, 6, ...) of nodes in global directions, turned from local ones."""
    turned = np.array(motions)
    for row, node in enumerate(nodes):
        if node in axes:
            for first in (0, 3):
                part = slice(first, first + 3)
                turned[row, part] = np.tensordot(axes[node], turned[row, part], axes=1)
    return turned
