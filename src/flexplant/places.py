"""Directions and places on a structure, and how motion between nodes follows from the nodes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from .values import FloatArray, Value

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
#: a place: a DOF label, a point (x, y, z) [m], or a mapping {label or point: weight}
Place: TypeAlias = "str | Sequence[float] | FloatArray | Mapping[Any, float]"


class Interpolation(Value):
    """How displacements between nodes follow from those at the nodes (element shape functions)."""

    @abstractmethod
    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) with which all n DOFs give the motion `direction` at `xyz`.

        Raises
        ------
        LabelError
            When the point is off the structure or the direction is unknown to it.
        """

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3); the same as `row` one by one.

        Raises
        ------
        LabelError
            When one of them is off the structure.
        """
        return np.array([self.row(point, direction) for point in points])

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the row (n,) and the coordinates (3,) of a DOF that follows others, or None.

        A joint makes DOFs follow: they are no rows of the matrices, but their labels stay known.
        """
        return None
