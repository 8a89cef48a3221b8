"""Directions and places of DOFs, tables of them, and texts on DOFs that are not there."""

from __future__ import annotations

import csv
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from .arrays import FloatArray, IntArray, as_list, node_numbers, real_array
from .errors import LabelError, ShapeError, unknown_label
from .store import Value
from .tolerances import SAME

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
#: a place: a DOF label, a point (x, y, z) [m], or a mapping {label or point: weight}
Place: TypeAlias = "str | Sequence[float] | FloatArray | Mapping[Any, float]"


class Interpolation(Value):
    """Interpolation of displacements between nodes by element shape functions."""

    @abstractmethod
    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion `direction` at `xyz` [m]."""

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        places = real_array(points, "points", (None, 3))
        return np.array([self.row(point, direction) for point in places])

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the row (n,) and the coordinates (3,) of a DOF that follows others, or None.

        A joint makes DOFs follow others. Such a DOF is not a row of the matrices, but its label can
        still be used: its displacement is the product of the row and the other DOFs. The result is
        None for each label that is not such a DOF.
        """
        return None


_COLUMNS = ("node", "direction", "x", "y", "z")


def columns_of(
    table: str | Path | Iterable[Mapping[str, Any]],
) -> tuple[IntArray, tuple[str, ...], FloatArray]:
    """Return nodes (n,), directions and coordinates (n, 3) [m] of a table or a CSV file."""
    if isinstance(table, str | Path):
        try:
            with open(table, newline="", encoding="utf-8") as file:
                rows: list[Mapping[str, Any]] = list(csv.DictReader(file))
        except (UnicodeDecodeError, csv.Error) as error:
            raise LabelError(
                f"{str(table)!r:.80} is not a CSV file: {error}. Write it as text in UTF-8."
            ) from None
    else:
        rows = as_list(table, "a DOF table", "a CSV file or a list of mappings")
    if not rows or not all(isinstance(row, Mapping) for row in rows):
        raise LabelError(
            "a DOF table needs rows with columns node, direction, x, y, z, got "
            f"{f'a {type(rows[0]).__name__} as its first row' if rows else 'no row'}. "
            "The first line of a CSV file names its columns."
        )
    missing = [c for c in _COLUMNS if any(row.get(c) is None for row in rows)]
    if missing:
        raise LabelError(
            f"a DOF table needs rows with columns {', '.join(_COLUMNS)}; missing: {missing}. "
            "Name the columns so; where a line is cut short, complete it."
        )
    return (
        node_numbers([_cell_number(row, "node", i) for i, row in enumerate(rows)]),
        tuple(str(row["direction"]).strip() for row in rows),
        np.array([[_cell_number(row, c, i) for c in "xyz"] for i, row in enumerate(rows)]),
    )


def _cell_number(row: Mapping[str, Any], column: str, line: int) -> float:
    try:
        return float(row[column])
    except (TypeError, ValueError):
        raise LabelError(
            f"column {column!r} of the DOF table holds {row[column]!r:.60} in row {line} (from 0), "
            "which is not a number. Write it with a decimal point and no unit; coordinates are [m]."
        ) from None


def at_nodes(wanted: IntArray, known: IntArray, xyz: FloatArray, source: str) -> FloatArray:
    """Return the coordinates (n, 3) of some nodes out of a table of all."""
    numbers, count = np.unique(known, return_counts=True)
    if numbers.size < known.size:
        first, again = np.flatnonzero(known == numbers[np.argmax(count > 1)])[:2] + 1
        raise LabelError(
            f"{source!r} defines node {int(known[again - 1])} twice, as its nodes {first} and "
            f"{again}: which place holds is not known. Remove the one of another model."
        )
    missing = np.setdiff1d(wanted, known)
    if missing.size:
        raise LabelError(
            f"{source!r} has no coordinates for nodes {missing[:6].tolist()} ({missing.size} in "
            "all). Is it the table of the same model?"
        )
    order = np.argsort(known, kind="stable")
    return np.asarray(xyz[order[np.searchsorted(known[order], wanted)]], dtype=np.float64)


#: up to this number of labels the closest are found by comparing each with the one that is unknown
_COMPARABLE = 2000
_ROTATIONS = frozenset(DIRECTIONS[3:])


def unknown_dof(label: object, nodes: IntArray, label_of: Callable[[int], str]) -> LabelError:
    """Return the error for an unknown label, without comparing it with all labels."""
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
    """Return a hint where rotations come from if nodes only have displacements (solids)."""
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
    except (TypeError, ValueError, OverflowError):
        corners = np.full((1,), np.nan)
    if corners.shape != (2, 3) or not np.all(corners[0] <= corners[1]):
        raise ShapeError(
            f"box must be its lowest and its highest corner, [(x, y, z), (x, y, z)] in metres, "
            f"got {box!r:.120}. Use -inf and inf for open sides."
        )
    slack = SAME * float(np.ptp(xyz, axis=0).max(initial=0.0))
    return np.all((xyz >= corners[0] - slack) & (xyz <= corners[1] + slack), axis=1)
