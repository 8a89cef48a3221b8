"""Nodes of universal files: positions and local directions of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray
from ..labels import DIRECTIONS
from ..tolerances import FOUR_DIGITS, SAME
from .coordinate_systems import BASIC, CARTESIAN, CYLINDRICAL, SPHERICAL, System, axes_along
from .files import damaged, defined_twice, parsing, refused, unread
from .uff_records import datasets

#: codes of coordinate systems in dataset 2420; of those of dataset 18 only 0 is documented
_TYPES = {0: CARTESIAN, 1: CYLINDRICAL, 2: SPHERICAL}
_EXPORT = "Export nodes and results in global coordinates and directions."


@dataclass(frozen=True)
class UffNodes:
    """Nodes of datasets 15 and 2411, and the coordinate systems of datasets 18 and 2420."""

    path: str
    ids: IntArray
    kinds: IntArray  # 15 or 2411
    given_in: IntArray
    moves_in: IntArray
    places: FloatArray
    systems: dict[int, System | str]  # a text gives the reason why a system is not read

    def xyz(self) -> FloatArray:
        """Return the places (n, 3) of the nodes in the global system, in units of the file."""
        if not self.ids.size:
            raise refused(self.path, "holds no nodes (datasets 15, 2411)", "Export them.")
        xyz = self.places.copy()
        for row, number in enumerate(self.given_in.tolist()):
            node, what = int(self.ids[row]), "gives"
            system = self._system(number, node, what)
            if _is_global(system):
                continue
            where = f"gives node {node} in coordinate system {number}"
            if self.kinds[row] == 2411:
                why = "whether its coordinates are turned differs between programs"
                raise unread(self.path, f"{where} in dataset 2411, where {why}", _EXPORT)
            if system.kind != CARTESIAN:
                raise unread(self.path, f"{where}, which is {system.kind}", _EXPORT)
            xyz[row] = system.position(xyz[row])
        return xyz

    def axes(self, nodes: IntArray | None = None) -> dict[int, FloatArray]:
        """Return the axes (columns) of those of some nodes that move in local directions."""
        found: dict[int, FloatArray] = {}
        asked = np.ones(self.ids.size, np.bool_) if nodes is None else np.isin(self.ids, nodes)
        pairs = np.unique(np.stack([self.ids[asked], self.moves_in[asked]]), axis=1)[0]
        if (twice := pairs[:-1][np.diff(pairs) == 0]).size:
            what = f"moves node {twice[0]} in one coordinate system and again in another"
            raise refused(self.path, what, _EXPORT)
        for number in np.unique(self.moves_in[asked]).tolist():
            own = np.flatnonzero(asked & (self.moves_in == number))
            listed = self.ids[own].tolist()
            system = self._system(number, listed[0], "moves")
            if system.kind == SPHERICAL:
                what = f"moves node {listed[0]} in coordinate system {number}, which is spherical"
                raise unread(self.path, what, _EXPORT)
            if system.kind == CYLINDRICAL:
                places = self.xyz()
                found |= {int(self.ids[row]): system.axes_at(places[row]) for row in own}
            elif np.abs(system.axes - np.eye(3)).max() > FOUR_DIGITS:
                found |= dict.fromkeys(listed, system.axes)
        return found

    def _system(self, number: int, node: int, what: str) -> System:
        # 0 is global; 1 is what the file defines, and global where it defines no system 1
        system = self.systems.get(number, BASIC if number in (0, 1) else "the file does not define")
        if isinstance(system, str):
            where = f"{what} node {node} in coordinate system {number}, which {system}"
            raise unread(self.path, where, _EXPORT)
        return system


def _is_global(system: System) -> bool:
    off = max(np.abs(system.axes - np.eye(3)).max(), np.abs(system.origin).max())
    return system.kind == CARTESIAN and bool(off <= SAME)


def uff_nodes(path: str | Path) -> UffNodes:
    """Return the nodes of a universal file, which may have no nodes."""
    sets = datasets(path, (15, 2411, 18, 2420))
    systems = _systems(sets, str(path))
    if 0 in systems and not (isinstance(systems[0], System) and _is_global(systems[0])):
        what = "defines coordinate system 0, the global one, as turned, moved or curved"
        raise unread(path, what, _EXPORT)
    none = np.zeros(0, dtype=np.int64)
    parts = [(none, none, none, none, np.zeros((0, 3)))]
    for part in (part for part in sets if part["type"] in (15, 2411)):
        ids = np.atleast_1d(part["node_nums"]).astype(np.int64)
        given, moves = (np.atleast_1d(part.get(name, 0)) for name in ("def_cs", "disp_cs"))
        given, moves = (np.resize(one.astype(np.int64), ids.shape) for one in (given, moves))
        xyz = [np.atleast_1d(part[axis]) for axis in "xyz"]
        if any(axis.shape != ids.shape for axis in xyz):
            raise damaged(path, f"a dataset of {ids.size} nodes lacks some of their numbers")
        kinds = np.full(ids.size, part["type"])
        parts.append((ids, kinds, given, moves, np.stack(xyz, axis=1)))
    ids, kinds, given, moves, places = (np.concatenate(one) for one in zip(*parts, strict=True))
    return UffNodes(str(path), ids, kinds, given, moves, places, systems)


def _systems(sets: list[dict[str, Any]], path: str) -> dict[int, System | str]:
    """Return the coordinate systems of datasets 2420 and 18 by number."""
    found: dict[int, System | str] = {}
    for part in sets:
        if part["type"] == 18:
            with parsing(path, "Export it again."):
                own = _of_18(part, path)
        elif part["type"] == 2420:
            with parsing(path, "Export it again."):
                own = _of_2420(part)
        else:
            continue
        for number, system in own.items():
            first = found.setdefault(number, system)
            if not _alike(first, system):
                what = f"{path!r}: coordinate system {number}"
                raise defined_twice(what, "one dataset", "another, differently,", _EXPORT)
    return found


def _alike(first: System | str, second: System | str) -> bool:
    if isinstance(first, str) or isinstance(second, str):
        return first == second
    same = np.abs(first.axes - second.axes).max() <= FOUR_DIGITS
    size = max(1.0, np.abs(first.origin).max())
    near = np.abs(first.origin - second.origin).max() <= FOUR_DIGITS * size
    return first.kind == second.kind and bool(same and near)


def _of_2420(part: dict[str, Any]) -> dict[int, System | str]:
    found: dict[int, System | str] = {}
    listed = zip(part["CS_sys_labels"], part["CS_types"], part["CS_matrices"], strict=True)
    for number, kind, matrix in listed:
        # rows 1 to 3 are the axes, row 4 is the origin
        axes, origin = np.asarray(matrix, dtype=np.float64)[:3].T, np.asarray(matrix)[3]
        straight = np.abs(axes.T @ axes - np.eye(3)).max() < FOUR_DIGITS
        if not straight or np.linalg.det(axes) < 0:
            found[int(number)] = "has axes that are not orthogonal, of unit length and right-handed"
        elif int(kind) not in _TYPES:
            found[int(number)] = f"is of the unknown type {int(kind)}"
        else:
            found[int(number)] = System(_TYPES[int(kind)], origin, axes)
    return found


def _of_18(part: dict[str, Any], path: str) -> dict[int, System | str]:
    numbers = np.atleast_1d(part["cs_num"]).astype(np.int64).tolist()
    columns = [np.atleast_1d(part[name]) for name in ("cs_type", "ref_cs_num")]
    points = [np.asarray(part[name]) for name in ("ref_o", "x_point", "xz_point")]
    if any(len(column) != len(numbers) for column in (*columns, *points)):
        raise damaged(path, "a dataset 18 lacks some of its numbers", "Export it again.")
    given = {number: row for row, number in enumerate(numbers)}
    kinds, bases = (column.astype(np.int64).tolist() for column in columns)
    found: dict[int, System | str] = {}

    def system(number: int, above: tuple[int, ...]) -> System | str:
        if number in found or number not in given:
            return found.get(number, BASIC if number in (0, 1) else f"refers to system {number}")
        row = given[number]
        if number in above:
            return "refers to itself"
        # a system that is its own reference is given in the global one
        base = BASIC if bases[row] == number else system(bases[row], (*above, number))
        if isinstance(base, str):
            return f"is defined in another system, which {base}"
        if base.kind != CARTESIAN or kinds[row] != 0:
            return f"is of type {kinds[row]} of dataset 18, which is not read but for 0"
        origin, on_x, in_xz = (base.position(group[row]) for group in points)
        axes = axes_along(on_x - origin, in_xz - origin)  # x, z, -y
        if axes is None:
            return "has three points on a line"
        return System(CARTESIAN, origin, axes[:, [0, 2, 1]] * [1, -1, 1])

    for number in numbers:
        found[number] = system(number, ())
    return found


def turning(
    labels: Sequence[str], axes: dict[int, FloatArray], path: str
) -> tuple[list[str], FloatArray]:
    """Return labels in global directions, and the matrix (n, n) that turns motions into them.

    Forces rotate like motions. A node with local directions must have all local directions that a
    global one combines.
    """
    names, matrix = list(labels), np.eye(len(labels))
    groups: dict[tuple[int, int], list[int]] = {}
    for row, label in enumerate(labels):
        place, _, direction = label.partition(":")
        if direction in DIRECTIONS and place.isdigit() and int(place) in axes:
            groups.setdefault((int(place), DIRECTIONS.index(direction) // 3), []).append(row)
    for (node, kind), rows in groups.items():
        local = np.array([DIRECTIONS.index(labels[row].partition(":")[2]) % 3 for row in rows])
        missing = np.setdiff1d(np.arange(3), local)
        known = np.flatnonzero(
            np.abs(axes[node][:, missing]).max(axis=1, initial=0.0) < FOUR_DIGITS
        )
        if known.size != local.size:
            seen = ", ".join(
                np.array2string(column, precision=4) for column in axes[node][:, local].T
            )
            what = (
                f"has node {node} move along {seen}, local directions which give no global one "
                "without the others of the node"
            )
            raise unread(path, what, f"Measure all three. {_EXPORT}")
        matrix[np.ix_(rows, rows)] = axes[node][np.ix_(known, local)]
        for row, axis in zip(rows, known.tolist(), strict=True):
            names[row] = f"{node}:{DIRECTIONS[3 * kind + axis]}"
    return names, matrix


def is_permutation(turn: FloatArray) -> bool:
    """Return whether a turn leaves every direction along one axis."""
    return bool(np.all(np.abs(turn).max(axis=1, initial=0.0) > 1 - FOUR_DIGITS))
