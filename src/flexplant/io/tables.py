"""Tables of degrees of freedom and of node coordinates, as text."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import LARGEST_NODE, FloatArray, IntArray
from ..dof_columns import at_nodes
from ..errors import FlexplantError, LabelError
from ..labels import DIRECTIONS, DofSet, node_dofs
from ..structure.unit_systems import units
from .files import decimal, file_path, refused, text_of

#: names of the six directions in other programs
_DIRECTION = {
    name: direction
    for direction, names in {
        "x": "x ux u1 t1 tx 1",
        "y": "y uy u2 t2 ty 2",
        "z": "z uz u3 t3 tz 3",
        "rx": "rx rotx ur1 r1 4",
        "ry": "ry roty ur2 r2 5",
        "rz": "rz rotz ur3 r3 6",
    }.items()
    for name in names.split()
}
_COLUMN = {
    "node": "node nodes nid id grid node_id nodeid gid",
    "direction": "direction dir dof component comp dofs",
    "x": "x xcoord coordx x1 x_coord",
    "y": "y ycoord coordy x2 y_coord",
    "z": "z zcoord coordz x3 z_coord",
    "row": "row rows equation eq index",
}
_NAMES = {name: column for column, names in _COLUMN.items() for name in names.split()}


def read_dofs(
    path: str | Path,
    *,
    nodes: str | Path | None = None,
    directions: Sequence[str] | None = None,
    length: str | float = "m",
) -> DofSet:
    """Return the DofSet of a text table: the DOFs of the rows of the matrices.

    The table has one of three forms. Either each line is a DOF with the columns
    `node, direction, x, y, z`. Or each line is a DOF with the columns `node, direction`, and a
    second table of `nodes` gives the coordinates. Or each line is a node (`node, x, y, z`), and all
    nodes have the same `directions`. A column `row` (from 1) gives the order of the DOFs; otherwise
    the order of the lines is used.

    Parameters
    ----------
    path : str or Path
        Path of the table. Columns are separated by commas, semicolons, tabs or spaces, and the
        first line gives their names. Directions may be x to rz, UX to ROTZ, T1 to R3 or 1 to 6.
    nodes : str or Path, optional
        A table `node, x, y, z`, with or without a first line of names.
    directions : sequence of str, optional
        Directions of every node, in the order of the rows: ("x", "y", "z").
    length : str or float
        Unit of the coordinates, for example "mm", or the length of this unit in metres.

    Raises
    ------
    FlexplantError
        When a line has another number of columns, or a number is missing.
    LabelError
        When a column is missing, a direction is unknown, or a node has no coordinates.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "dofs.csv")
    ...     with open(path, "w") as file:
    ...         for line in ("node,direction,x,y,z", "1,x,0,0,0", "2,x,10,0,0"):
    ...             print(line, file=file)
    ...     dofs = fx.io.read_dofs(path, length="mm")
    >>> dofs.labels, dofs.xyz[1].tolist()
    (('1:x', '2:x'), [0.01, 0.0, 0.0])
    """
    table = _read_table(path)
    columns = table.columns
    scale = units(length).length
    if directions is not None:
        numbers, xyz = _node_table(table)
        return node_dofs(numbers, [_direction(name, path) for name in directions], scale * xyz)
    needed = ("node", "direction") if nodes is not None else ("node", "direction", "x", "y", "z")
    missing = [name for name in needed if name not in columns]
    if missing:
        do = "One line a DOF: node, direction, x, y, z; or give nodes=table for the coordinates."
        if "node" in columns and "direction" not in columns:
            do = (
                "Of nodes with the same DOFs each give "
                f"dofs=fx.io.read_dofs({Path(path).name!r}, directions=('x', 'y', 'z')), or all "
                "six to 'rz'; else a table with one line a DOF: node, direction, x, y, z."
            )
        raise table.lacks(missing, do)
    numbers = table.whole("node")
    kinds = [_direction(name, path) for name in columns["direction"]]
    if nodes is None:
        xyz = np.column_stack([table.numbers(c) for c in "xyz"])
    else:
        known, places = read_nodes_table(nodes)
        xyz = at_nodes(numbers, known, places, str(nodes))
    order = np.arange(numbers.size)
    if "row" in columns:
        rows = table.whole("row")
        if not np.array_equal(np.sort(rows), np.arange(1, rows.size + 1)):
            raise LabelError(
                f"column 'row' of {str(path)!r} must count {rows.size} rows from 1, each once, got "
                f"{rows.min()} to {rows.max()}. Add 1 if it counts from 0."
            )
        order = np.argsort(rows)
    return DofSet(numbers[order], tuple(kinds[i] for i in order), scale * xyz[order])


def read_nodes_table(path: str | Path) -> tuple[IntArray, FloatArray]:
    """Return the node numbers (m,) and coordinates (m, 3) of a text table `node, x, y, z`."""
    return _node_table(_read_table(path, plain=("node", "x", "y", "z")))


def _node_table(table: _Table) -> tuple[IntArray, FloatArray]:
    missing = [name for name in ("node", "x", "y", "z") if name not in table.columns]
    if missing:
        raise table.lacks(missing, "A table of nodes has node, x, y, z: add them.")
    return table.whole("node"), np.column_stack([table.numbers(c) for c in "xyz"])


@dataclass(frozen=True)
class _Table:
    """The cells of a text table by the names of its columns, and the line of the file of each."""

    path: str
    columns: dict[str, list[str]]
    lines: list[int]

    def lacks(self, missing: list[str], do: str) -> LabelError:
        """Return the error of columns that are missing."""
        return LabelError(f"{self.path!r} has no column {missing}, got {list(self.columns)}. {do}")

    def numbers(self, column: str) -> FloatArray:
        """Return a column of numbers (n,)."""
        found = []
        for line, cell in zip(self.lines, self.columns[column], strict=True):
            try:
                found.append(decimal(cell))
            except ValueError as error:
                what = f"has no number in line {line}, column {column!r} ({error})"
                do = "Write it with a decimal point and no unit."
                raise refused(self.path, what, do) from None
        return np.array(found)

    def whole(self, column: str) -> IntArray:
        """Return a column of whole numbers (n,)."""
        numbers = self.numbers(column)
        if np.any((numbers != np.round(numbers)) | (np.abs(numbers) > LARGEST_NODE)):
            raise FlexplantError(
                f"{self.path!r}: column {column!r} must hold whole numbers to 2^53."
            )
        return numbers.astype(np.int64)


def _read_table(path: str | Path, plain: Sequence[str] = ()) -> _Table:
    text = text_of(file_path(path))
    numbered = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and line.lstrip()[0] not in "#%!$"
    ]
    if not numbered:
        raise FlexplantError(f"{str(path)!r} is empty: a table was expected.")
    mark = next((m for m in ";\t," if m in numbered[0][1]), None)
    rows = [
        [cell.strip() for cell in cells]
        for cells in (
            csv.reader((line for _, line in numbered), delimiter=mark)
            if mark
            else (re.split(r"\s+", line.strip()) for _, line in numbered)
        )
    ]
    first = [_NAMES.get(cell.lower().split("[")[0].strip(), cell) for cell in rows[0]]
    if "node" in first:
        names, rows, numbered = first, rows[1:], numbered[1:]
    elif plain and len(rows[0]) == len(plain):
        names = list(plain)
    else:
        raise LabelError(
            f"{str(path)!r} does not begin with the names of its columns, got {rows[0][:6]}. Write "
            "node, direction, x, y, z in its first line."
        )
    if doubled := [name for name in names if names.count(name) > 1]:
        raise refused(path, f"has {len(doubled)} columns {doubled[0]!r}", "Leave one of them.")
    lines = [number for number, _ in numbered]
    if len(lines) != len(rows):
        raise FlexplantError(f"{str(path)!r} has a cell of several lines. Close its quotes.")
    for line, row in zip(lines, rows, strict=True):
        if len(row) != len(names):
            what = f"has {len(row)} columns in line {line}, and {len(names)} names"
            raise refused(path, what, "Complete it.")
    columns = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    return _Table(str(path), columns, lines)


def _direction(name: str, path: str | Path) -> str:
    direction = _DIRECTION.get(str(name).strip().lower())
    if direction is None:
        raise LabelError(
            f"{str(path)!r}: {name!r} is not a direction of motion. Use {', '.join(DIRECTIONS)}, "
            "UX "
            "to ROTZ, T1 to R3 or 1 to 6, and leave temperature, pressure and the like out."
        )
    return direction
