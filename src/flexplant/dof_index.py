"""Rows of DOFs by label, found by number: a million labels need no dictionary."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from .dof_columns import LARGEST_NODE
from .errors import LabelError, ShapeError, unknown_label
from .places import DIRECTIONS
from .values import FloatArray, IntArray

#: of so many labels the closest are found by comparing each with the one that is unknown
_COMPARABLE = 2000
_ROTATIONS = frozenset(DIRECTIONS[3:])


class DofIndex:
    """The rows of DOFs, given their node numbers (n,) and kinds (n,), 0 to 5 for x to rz."""

    def __init__(
        self,
        nodes: IntArray,
        kinds: IntArray,
        components: tuple[str, ...] = (),
        component_of: IntArray | None = None,
    ) -> None:
        keys = nodes * len(DIRECTIONS) + kinds
        self._order = np.arange(keys.size)
        self._ends = {"": (0, keys.size)}
        if component_of is not None:
            self._order = np.lexsort((keys, component_of))
            ends = np.searchsorted(component_of[self._order], np.arange(len(components) + 1))
            pairs = zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
            self._ends = dict(zip(components, pairs, strict=True))
        elif np.any(keys[1:] < keys[:-1]):
            self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    @property
    def doubled(self) -> tuple[int, int] | None:
        """Two rows with the same DOF, or None."""
        for start, end in self._ends.values():
            same = np.flatnonzero(np.diff(self._keys[start:end]) == 0)
            if same.size:
                first = start + int(same[0])  # the stable sort keeps equal keys in their order
                return int(self._order[first]), int(self._order[first + 1])
        return None

    def found(self, label: object) -> int:
        """Return the row of a label, or -1: by its number, so that a million need no dictionary."""
        if not isinstance(label, str):
            return -1
        component, _, rest = label.rpartition("/")
        node, _, direction = rest.partition(":")
        if direction not in DIRECTIONS or component not in self._ends:
            return -1
        try:
            number = int(node)
        except ValueError:
            return -1
        if str(number) != node or abs(number) > LARGEST_NODE:  # "07:z" and "1_0:z" are no labels
            return -1
        start, end = self._ends[component]
        key = number * len(DIRECTIONS) + DIRECTIONS.index(direction)
        place = start + int(np.searchsorted(self._keys[start:end], key))
        return int(self._order[place]) if place < end and self._keys[place] == key else -1


def unknown_dof(label: object, nodes: IntArray, label_of: Callable[[int], str]) -> LabelError:
    """Return the error for a label that is not there, without comparing it with a million."""
    number = re.match(r"-?\d{1,15}", str(label).rpartition("/")[2])
    if number is not None:
        own = [label_of(row) for row in np.flatnonzero(nodes == int(number.group())).tolist()]
        wanted = str(label).rpartition(":")[2]
        if hint := rotation_hint([wanted], [name.rpartition(":")[2] for name in own]):
            return LabelError(f"no DOF {label!r}, at its node there are {', '.join(own)}. {hint}")
    if nodes.size <= _COMPARABLE:
        return unknown_label("DOF", label, [label_of(row) for row in range(nodes.size)])
    near = int(number.group()) if number else int(nodes[0])
    rows = np.argsort(np.abs(nodes - near), kind="stable")[:6].tolist()
    listed = ", ".join(repr(label_of(row)) for row in rows)
    return LabelError(
        f"no DOF {label!r} ({nodes.size} known). At the nodes next to it there are: {listed}."
    )


def rotation_hint(wanted: Iterable[str], there: Iterable[str]) -> str:
    """Return where rotations are had of nodes that only have displacements, as of solids."""
    present = set(there)
    if not present or present & _ROTATIONS or not set(wanted) & _ROTATIONS:
        return ""
    turn = min(set(wanted) & _ROTATIONS)
    return (
        "Its nodes only have displacements, as those of solids do: the rotation of a point, "
        f"at=(x, y, z) along {turn!r}, is that of flexplant.interpolated(model)."
    )


def in_box(xyz: FloatArray, box: Any) -> Any:
    """Return which points (n, 3) are between the lowest and the highest corner of a box (n,)."""
    try:
        corners = np.array(box, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.full((1,), np.nan)
    if corners.shape != (2, 3) or not np.all(corners[0] <= corners[1]):
        raise ShapeError(
            f"box must be its lowest and its highest corner, [(x, y, z), (x, y, z)] in metres, "
            f"got {box!r:.120}. Use -inf and inf for open sides."
        )
    slack = 1e-9 * float(np.ptp(xyz, axis=0).max(initial=0.0))
    return np.all((xyz >= corners[0] - slack) & (xyz <= corners[1] + slack), axis=1)
