"""Nastran bulk data: where the nodes are, and in which directions they move."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import FloatArray
from ..dof_columns import at_nodes
from ..errors import FlexplantError, LabelError, ModelError, counted, require_known
from ..labels import DIRECTIONS, DofSet
from ..tolerances import ROUNDING
from .file_shapes import FileShapes
from .numbers import decimal
from .paths import USUAL, defined_twice, file_path
from .tables import read_nodes_table

_KINDS = ("GRID", "GRDSET", "CORD2R", "CORD2C", "CORD2S")
_INCLUDE = re.compile(r"\s*INCLUDE\s+(?:'([^']*)'|\"([^\"]*)\"|([^\s$]+))", re.IGNORECASE)
_END = re.compile(r"\s*ENDDATA\b", re.IGNORECASE)
#: files within files, at most
_DEEP = 20
#: what to do with two cards of one number
_DEFINED_ONCE = "Remove the card that is not of this run."


@dataclass(frozen=True)
class Nodes:
    """Positions (n, 3) in the basic system, and the axes (3, 3) of each node's displacements."""

    xyz: dict[int, FloatArray]
    axes: dict[int, FloatArray]  # columns are the local axes; absent: the basic ones


def read_nodes(path: str | Path) -> Nodes:
    """Return the nodes of a Nastran bulk data file.

    GRID, GRDSET and CORD2R, CORD2C, CORD2S in free, small or large fields, also in files that it
    INCLUDEs, up to ENDDATA; all other cards are passed over.
    """
    lines = _bulk_lines(file_path(path, "bdf"))
    grids: dict[int, list[str]] = {}
    systems: dict[int, tuple[str, list[str]]] = {}
    default = ["", ""]
    defined: dict[str, str] = {}
    for number, kind, fields in cards((line for _, _, line in lines), _KINDS):
        fields = fields + [""] * 12
        file, line, _ = lines[number - 1]
        try:
            key = 0 if kind == "GRDSET" else int(fields[0])
        except ValueError as error:
            raise FlexplantError(f"{file!r}, line {line}: {kind} {fields[:8]}: {error}.") from None
        what = {"GRID": f"GRID {key}", "GRDSET": kind}.get(kind, f"coordinate system {key}")
        if what in defined:
            raise defined_twice(what, defined[what], f"line {line} of {file!r}", _DEFINED_ONCE)
        defined[what] = f"line {line} of {file!r}"
        if kind == "GRID":
            grids[key] = fields
        elif kind == "GRDSET":
            default = [fields[1], fields[5]]
        else:
            systems[key] = (kind, fields)
    parsed: dict[int, list[Any]] = {}
    for node, fields in grids.items():
        try:
            place = [nastran_float(item) for item in fields[2:5]]
            into, moves = int(fields[1] or default[0] or 0), int(fields[5] or default[1] or 0)
        except ValueError as error:
            raise FlexplantError(f"{str(path)!r}, GRID {node}: {error}.") from None
        parsed[node] = [into, place, moves]
    return basic_nodes(parsed, systems, str(path))


def basic_nodes(
    grids: Mapping[int, Sequence[Any]], systems: dict[int, tuple[str, list[str]]], path: str
) -> Nodes:
    """Return nodes of (system of the place, place, system of the displacements) by number."""
    known = _Systems(systems, path)
    xyz, axes = {}, {}
    for node, (into, place, moves) in grids.items():
        point = np.array(place, dtype=np.float64)
        xyz[node] = known.position(into, point) if into else point
        if moves > 0:
            axes[node] = known.axes(moves, xyz[node])
    return Nodes(xyz, axes)


def _bulk_lines(path: Path, above: tuple[Path, ...] = ()) -> list[tuple[str, int, str]]:
    """Return (file, line number, text) of all lines, those of INCLUDEd files in their place.

    ENDDATA, in whatever file, ends all of them.
    """
    found = []
    continued = ""
    for number, line in enumerate(path.read_text(encoding="latin-1").splitlines(), 1):
        joined = continued + (line.lstrip() if continued else line)
        # the name may go on in the next line, until its quote is closed
        continued = joined.rstrip() if _goes_on(joined) else ""
        match = None if continued else _INCLUDE.match(joined)
        if match is None:
            if not continued:
                found.append((str(path), number, joined))
            if _END.match(joined):
                break
            continue
        name = (match[1] or match[2] or match[3] or "").strip()
        # in the folder of the file that names it, or of the first one
        places = [file.parent / name for file in (path, *above[:1])]
        file = next((place for place in places if name and place.is_file()), None)
        if file is None or len(above) == _DEEP:
            why = "includes itself" if file else "is not there"
            raise FlexplantError(
                f"{str(path)!r}, line {number}: the INCLUDEd file {name!r} {why}: its nodes would "
                "be missing. Put it beside, or give the file that holds the GRID cards."
            )
        found += _bulk_lines(file, (*above, path))
        if found and _END.match(found[-1][2]):
            break
    return found


def _goes_on(line: str) -> bool:
    quotes = line.count("'") + line.count('"')
    return line.lstrip()[:8].upper() == "INCLUDE " and quotes == 1 and len(line) < 1000


def nastran_float(text: str) -> float:
    """Return a number as Nastran writes it: 1.5, 1.5E3, 1.5D3, 1.5+3; blank is 0."""
    return decimal(text) if text.strip() else 0.0


def cards(lines: Iterable[str], kinds: tuple[str, ...]) -> Iterator[tuple[int, str, list[str]]]:
    """Yield (line number, name, fields after the name) of the cards of some kinds."""
    number, kind, fields = 0, "", list[str]()
    for at, raw in enumerate(lines, 1):
        line = raw.split("$", 1)[0].rstrip().expandtabs(8)
        if not line:
            continue
        if line[0] in "+* ,":
            if kind:
                fields += _card_fields(line)[1]
            continue
        if kind:
            yield number, kind, fields
        name, found = _card_fields(line)
        number, kind, fields = at, name if name in kinds else "", found
    if kind:
        yield number, kind, fields


def _card_fields(line: str) -> tuple[str, list[str]]:
    if "," in line:
        words = [word.strip() for word in line.split(",")]
        wide = words[0].endswith("*") or words[0].startswith("*")
        count = 4 if wide else 8
        return words[0].rstrip("*").upper(), (words[1 : 1 + count] + [""] * count)[:count]
    head = line[:8].strip().upper()
    width = 16 if "*" in head else 8
    body = line[8:72].ljust(64)
    return head.rstrip("*"), [body[i : i + width].strip() for i in range(0, 64, width)]


class _Systems:
    """Coordinate systems, each defined in another one down to the basic one, 0."""

    def __init__(self, given: dict[int, tuple[str, list[str]]], path: str) -> None:
        self.given, self.path = given, path
        self.known: dict[int, tuple[str, FloatArray, FloatArray]] = {
            0: ("CORD2R", np.zeros(3), np.eye(3))
        }

    def system(self, name: int, above: tuple[int, ...] = ()) -> tuple[str, FloatArray, FloatArray]:
        """Return the kind, the origin and the axes (columns) of a system."""
        if name in self.known:
            return self.known[name]
        if name not in self.given:
            raise LabelError(
                f"{self.path!r} has no coordinate system {name} as CORD2R, CORD2C or CORD2S: nodes "
                "refer to it. Add its card (CORD1R and the like: written out as CORD2R)."
            )
        if name in above:
            raise ModelError(f"{self.path!r}: coordinate system {name} is defined by itself.")
        kind, fields = self.given[name]
        try:
            numbers = [nastran_float(item) for item in fields[2:11]]
            base = int(fields[1] or 0)
        except ValueError as error:
            raise FlexplantError(f"{self.path!r}, {kind} {name}: {error}.") from None
        self.system(base, (*above, name))
        origin, on_z, in_xz = (self.position(base, np.array(numbers[i : i + 3])) for i in (0, 3, 6))
        z = on_z - origin
        y = np.cross(z, in_xz - origin)
        if not np.linalg.norm(z) or np.linalg.norm(y) < ROUNDING * np.linalg.norm(z):
            raise ModelError(
                f"{self.path!r}: the three points of {kind} {name} lie on a line, which gives no "
                "axes. Correct the card."
            )
        z, y = z / np.linalg.norm(z), y / np.linalg.norm(y)
        self.known[name] = (kind, origin, np.column_stack([np.cross(y, z), y, z]))
        return self.known[name]

    def position(self, name: int, place: FloatArray) -> FloatArray:
        """Return the basic coordinates of a point of a system (angles in degrees)."""
        kind, origin, axes = self.system(name)
        first, second, third = place
        turn = np.deg2rad(second)
        if kind == "CORD2C":
            place = np.array([first * np.cos(turn), first * np.sin(turn), third])
        elif kind == "CORD2S":
            around = np.deg2rad(third)
            ring = first * np.sin(turn)
            place = np.array([ring * np.cos(around), ring * np.sin(around), first * np.cos(turn)])
        return np.asarray(origin + axes @ place)

    def axes(self, name: int, xyz: FloatArray) -> FloatArray:
        """Return the axes (columns) of displacements at a place, which turn with a polar system."""
        kind, origin, axes = self.system(name)
        if kind == "CORD2R":
            return axes
        x, y, z = axes.T @ (xyz - origin)
        around = np.arctan2(y, x)
        radial = np.array([np.cos(around), np.sin(around), 0.0])
        tangent = np.array([-np.sin(around), np.cos(around), 0.0])
        if kind == "CORD2C":
            return np.asarray(axes @ np.column_stack([radial, tangent, [0, 0, 1]]))
        down = np.arctan2(np.hypot(x, y), z)
        outward = np.sin(down) * radial + np.cos(down) * np.array([0, 0, 1.0])
        south = np.cos(down) * radial - np.sin(down) * np.array([0, 0, 1.0])
        return np.asarray(axes @ np.column_stack([outward, south, tangent]))


_LETTERS = {"stiffness": "K", "mass": "M", "damping": "B"}


def named_matrices(
    found: Mapping[str, Any], given: Mapping[str, str | None], endings: Sequence[str], path: str
) -> list[str | None]:
    """Return the names of stiffness, mass and damping; of the latter two None where not there."""
    names: list[str | None] = []
    for what, said in given.items():
        if what == "damping" and said is None:
            names.append(None)
            continue
        name = None if said == USUAL else said
        require_known("matrix", () if name is None else (name,), found, repr(path))
        usual = [_LETTERS[what] + ending for ending in endings]
        there = [one for one in usual if one in found] if name is None else [name]
        if len(there) > 1:
            raise ModelError(
                f"{path!r} holds {there}, any of which may be the {what}. Say which: "
                f"{what}={there[0]!r}."
            )
        if not there and what == "stiffness":
            raise ModelError(
                f"{path!r} holds {sorted(found)}, none of which has a usual name of a stiffness "
                f"matrix ({', '.join(usual)}). Say which it is: stiffness='...'."
            )
        names.append(there[0] if there else None)
    return names


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
    xyz, axes = _node_places(ids, nodes, path)
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


def _node_places(ids: Any, nodes: Nodes | Path | None, path: str) -> tuple[FloatArray, Any]:
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
