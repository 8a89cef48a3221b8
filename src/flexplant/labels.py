"""Degrees of freedom (DOFs) and signals by name: `"41:z"` is the z-displacement of node 41."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from .errors import LabelError, ShapeError, unknown_label
from .values import FloatArray, IntArray, Value, real_array

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
#: a place: a DOF label, a point (x, y, z) [m], or a mapping {label or point: weight}
Place: TypeAlias = "str | Sequence[float] | FloatArray | Mapping[Any, float]"

_COLUMNS = ("node", "direction", "x", "y", "z")
#: of so many labels the closest are found by comparing each with the one asked for
_COMPARABLE = 2000
#: node numbers stay exact as floats, and their keys in 64 bits
_LARGEST_NODE = 2**53


class Interpolation(Value):
    """How displacements between nodes follow from those at the nodes (element shape functions)."""

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) with which all n DOFs give the motion `direction` at `xyz`.

        Raises
        ------
        LabelError
            When the point is off the structure or the direction is unknown to it.
        """
        raise NotImplementedError

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3); the same as `row` one by one.

        Raises
        ------
        LabelError
            When one of them is off the structure.
        """
        return np.array([self.row(point, direction) for point in points])


@dataclass(frozen=True, eq=False, repr=False)
class DofSet(Value):
    """The degrees of freedom of a model, in the order of its matrices.

    Parameters
    ----------
    nodes : (n,) array of int
        Node number of each DOF.
    directions : sequence of n str
        Each one of x, y, z [m], rx, ry, rz [rad]; rx = dz/dy and ry = -dz/dx on a plate.
    xyz : (n, 3) array [m]
        Coordinates of each DOF's node.
    interpolation : Interpolation, optional
        Element shape functions, or those of `interpolated`; without them only points at nodes are
        known.

    Raises
    ------
    ShapeError
        When the lengths differ.
    LabelError
        When a direction is unknown or a DOF appears twice.

    Examples
    --------
    >>> dofs = DofSet([1, 1, 2], ["z", "rx", "z"], [[0, 0, 0], [0, 0, 0], [1, 0, 0]])
    >>> dofs.index("2:z"), dofs.nearest((0.9, 0, 0), "z")
    (2, '2:z')
    """

    nodes: IntArray
    directions: tuple[str, ...]
    xyz: FloatArray
    interpolation: Interpolation | None = None

    def __post_init__(self) -> None:
        nodes = _node_numbers(self.nodes)
        directions = _directions(self.directions)
        if nodes.ndim != 1 or len(directions) != nodes.size:
            raise ShapeError(
                f"a DofSet needs one node and one direction per DOF, got nodes of shape "
                f"{nodes.shape} and {len(directions)} directions. Repeat a node's number once for "
                "each of its directions."
            )
        unknown = sorted(set(directions) - set(DIRECTIONS))
        if unknown:
            raise LabelError(
                f"unknown directions {unknown[:6]}: a DOF moves along {', '.join(DIRECTIONS)}. "
                "Translate the names of the foreign program first."
            )
        self._set(
            nodes=nodes, directions=directions, xyz=real_array(self.xyz, "xyz", (nodes.size, 3))
        )
        if not isinstance(self.interpolation, Interpolation | None):
            raise LabelError(
                f"interpolation must be an Interpolation, got {type(self.interpolation).__name__}: "
                "flexplant.interpolated(dofs) makes one, or leave it out."
            )
        keys, order = self._sorted_keys
        doubled = np.flatnonzero(np.diff(keys) == 0)
        if doubled.size:
            # the stable sort keeps equal keys in the order of the rows
            first, second = order[doubled[0]], order[doubled[0] + 1]
            raise LabelError(
                f"DOF '{nodes[first]}:{directions[first]}' appears twice, in rows {first} and "
                f"{second} (from 0): rows of the matrices would be ambiguous. Drop one of them, or "
                "renumber the node."
            )

    @cached_property
    def kinds(self) -> IntArray:
        """What each DOF is (n,): 0 to 5 for x, y, z, rx, ry, rz."""
        listed = np.array(self.directions, dtype="U2")
        kinds = np.zeros(listed.size, dtype=np.int64)
        for kind, direction in enumerate(DIRECTIONS):
            kinds[listed == direction] = kind
        kinds.flags.writeable = False
        return kinds

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The labels `"node:direction"`, in order."""
        return tuple(f"{n}:{d}" for n, d in zip(self.nodes.tolist(), self.directions, strict=True))

    @cached_property
    def _sorted_keys(self) -> tuple[IntArray, IntArray]:
        """One whole number for each DOF, ascending, and the rows in this order."""
        keys = self.nodes * len(DIRECTIONS) + self.kinds
        order = np.arange(keys.size)
        if np.any(keys[1:] < keys[:-1]):
            order = np.argsort(keys, kind="stable")
        return keys[order], order

    def _found(self, label: object) -> int:
        """Return the row of a label, or -1: by its number, so that a million need no dictionary."""
        if not isinstance(label, str):
            return -1
        node, _, direction = label.partition(":")
        if direction not in DIRECTIONS:
            return -1
        try:
            number = int(node)
        except ValueError:
            return -1
        if str(number) != node or abs(number) > _LARGEST_NODE:  # "07:z" and "1_0:z" are no labels
            return -1
        keys, order = self._sorted_keys
        key = number * len(DIRECTIONS) + DIRECTIONS.index(direction)
        place = int(np.searchsorted(keys, key))
        return int(order[place]) if place < keys.size and keys[place] == key else -1

    def __len__(self) -> int:
        return int(self.nodes.size)

    def __iter__(self) -> Iterator[str]:
        return iter(self.labels)

    def __contains__(self, label: object) -> bool:
        return self._found(label) >= 0

    def __repr__(self) -> str:
        counts = np.bincount(self.kinds, minlength=len(DIRECTIONS)).tolist()
        kinds = ", ".join(f"{n} {d}" for n, d in zip(counts, DIRECTIONS, strict=True) if n)
        return f"<DofSet {len(self)} DOFs at {np.unique(self.nodes).size} nodes: {kinds}>"

    def index(self, label: str) -> int:
        """Return the row of a DOF in the matrices (from 0).

        Parameters
        ----------
        label : str
            Such as `"41:z"`.

        Raises
        ------
        LabelError
            When there is no such DOF, with close matches.
        """
        row = self._found(label)
        if row < 0:
            raise self._unknown(label)
        return row

    def _unknown(self, label: object) -> LabelError:
        """Return the error for a label that is not there, without comparing it with a million."""
        if len(self) <= _COMPARABLE:
            return unknown_label("DOF", label, self.labels)
        number = re.match(r"-?\d{1,15}", str(label))
        near = int(number.group()) if number else int(self.nodes[0])
        rows = np.argsort(np.abs(self.nodes - near), kind="stable")[:6]
        listed = ", ".join(f"'{self.nodes[i]}:{self.directions[i]}'" for i in rows)
        return LabelError(
            f"no DOF {label!r} ({len(self)} known). At the nodes next to it there are: {listed}."
        )

    def indices(self, labels: Iterable[str]) -> IntArray:
        """Return the rows of several DOFs, in the order given."""
        if isinstance(labels, str):
            labels = [labels]
        labels = _listed(labels, "labels", "a list of DOF labels such as '41:z'")
        return np.array([self.index(label) for label in labels], dtype=np.int64)

    def select(self, labels: Iterable[str]) -> DofSet:
        """Return the DofSet of some of the DOFs, in the order given (no interpolation)."""
        return self._taken(self.indices(labels))

    def _taken(self, rows: IntArray) -> DofSet:
        """Return the DofSet of some rows (n,), in the order given (no interpolation)."""
        names = np.array(DIRECTIONS, dtype=object)
        return DofSet(self.nodes[rows], tuple(names[self.kinds[rows]]), self.xyz[rows])

    def where(
        self,
        nodes: Iterable[int] | int | None = None,
        directions: Iterable[str] | str | None = None,
        *,
        box: Sequence[Sequence[float]] | FloatArray | None = None,
    ) -> DofSet:
        """Return the DOFs at the given nodes, in the given directions, in a box (None: all).

        Parameters
        ----------
        nodes : int or sequence of int, optional
            Node numbers.
        directions : str or sequence of str, optional
            Such as `"z"`.
        box : (2, 3) array [m], optional
            Its lowest and highest corner, both belonging to it: ``[(0, 0, 0), (0, 0.6, 0)]`` is an
            edge. Infinite entries are allowed.

        Raises
        ------
        LabelError
            When a node or direction is not there, or no DOF is in the box.
        """
        keep = np.ones(len(self), dtype=bool)
        if nodes is not None:
            wanted = _node_numbers(nodes if isinstance(nodes, Iterable) else [nodes])
            missing = np.setdiff1d(wanted, self.nodes)
            if missing.size:
                raise LabelError(
                    f"no DOF at nodes {missing[:6].tolist()}: {self!r}. dofs.nodes lists them, "
                    "dofs.nearest((x, y, z)) finds one by its place."
                )
            keep &= np.isin(self.nodes, wanted)
        if directions is not None:
            given = [directions] if isinstance(directions, str) else directions
            named = set(_listed(given, "directions", "one or more of x, y, z, rx, ry, rz"))
            absent = sorted(str(d) for d in named - set(self.directions))
            if absent:
                raise LabelError(
                    f"no DOF in directions {absent}: {self!r}. Use those that are there."
                )
            keep &= np.isin(self.kinds, [DIRECTIONS.index(direction) for direction in named])
        if box is not None:
            keep &= self._inside(box)
            if not keep.any():
                low, high = self.xyz.min(axis=0).tolist(), self.xyz.max(axis=0).tolist()
                raise LabelError(
                    f"no such DOF in the box {np.asarray(box).tolist()!r:.120}: the nodes reach "
                    f"from {low} to {high} m. Coordinates are in metres; make the box larger."
                )
        return self._taken(np.flatnonzero(keep))

    def _inside(self, box: Any) -> Any:
        try:
            corners = np.array(box, dtype=np.float64)
        except (TypeError, ValueError):
            corners = np.full((1,), np.nan)
        if corners.shape != (2, 3) or not np.all(corners[0] <= corners[1]):
            raise ShapeError(
                f"box must be its lowest and its highest corner, [(x, y, z), (x, y, z)] in metres, "
                f"got {box!r:.120}. Open sides are -inf and inf."
            )
        slack = 1e-9 * float(np.ptp(self.xyz, axis=0).max(initial=0.0))
        return np.all((self.xyz >= corners[0] - slack) & (self.xyz <= corners[1] + slack), axis=1)

    def nearest(self, xyz: Sequence[float] | FloatArray, direction: str = "z") -> str:
        """Return the label of the DOF in `direction` whose node is nearest to a point.

        Parameters
        ----------
        xyz : (3,) array [m]
            The point.
        direction : str
            One of the directions present.

        Raises
        ------
        LabelError
            When no DOF has this direction.
        """
        kind = DIRECTIONS.index(direction) if direction in DIRECTIONS else -1
        rows = np.flatnonzero(self.kinds == kind)
        if not rows.size:
            raise LabelError(
                f"no DOF in direction {direction!r}: {self!r}. Ask for one that is there."
            )
        point = real_array(xyz, "xyz", (3,))
        distance = np.linalg.norm(self.xyz[rows] - point, axis=1)
        row = int(rows[np.argmin(distance)])
        return f"{self.nodes[row]}:{direction}"

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (n,) that picks the motion at a place from the vector of all DOFs.

        Its transpose is the load vector of a unit force (moment) there.

        Parameters
        ----------
        at : str, (3,) array [m] or mapping
            A DOF label, a point (interpolated between nodes), or a weighted sum of such,
            {label or (x, y, z): weight}.
        direction : str
            The motion at points; a label carries its own.

        Raises
        ------
        LabelError
            When the DOF is unknown or the point is off the structure.
        """
        row = np.zeros(len(self))
        if isinstance(at, str):
            row[self.index(at)] = 1.0
            return row
        if isinstance(at, Mapping):
            for place, weight in at.items():
                part = float(real_array(weight, f"weight of {place!r}", ()))
                row += part * self.row(place, direction)
            return row
        point = real_array(at, "at", (3,))
        if direction not in DIRECTIONS:
            raise unknown_label("direction", direction, DIRECTIONS)
        if self.interpolation is not None:
            return self.interpolation.row(point, direction)
        label = self.nearest(point, direction)
        row[self.index(label)] = 1.0
        offset = float(np.linalg.norm(self.xyz[self.index(label)] - point))
        if offset > 1e-9 * max(1.0, float(np.ptp(self.xyz, axis=0).max())):
            raise LabelError(
                f"the point {tuple(point.tolist())} is {offset:.3g} m from the nearest node with "
                f"direction {direction!r} ({label!r}), and this model has no shape functions to "
                f"interpolate with. Use at={label!r}, a mapping {{label: weight}}, or interpolate "
                "the shapes between nodes: flexplant.interpolated(model)."
            )
        return row

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, n) of the motion at many points (p, 3) [m]; see `row`.

        Raises
        ------
        LabelError
            When a point is off the structure.
        """
        places = real_array(points, "points", (None, 3))
        if self.interpolation is not None and direction in DIRECTIONS:
            return self.interpolation.rows(places, direction)
        return np.array([self.row(place, direction) for place in places]).reshape(-1, len(self))

    @classmethod
    def from_table(cls, table: str | Path | Iterable[Mapping[str, Any]]) -> DofSet:
        """Return the DofSet of a table with columns node, direction, x, y, z [m].

        Parameters
        ----------
        table : path of a CSV file, or an iterable of mappings
            One row per DOF, in the order of the matrices.

        Raises
        ------
        LabelError
            When a column is missing.
        """
        if isinstance(table, str | Path):
            with open(table, newline="", encoding="utf-8") as file:
                rows: list[Mapping[str, Any]] = list(csv.DictReader(file))
        else:
            rows = _listed(table, "a DOF table", "a CSV file or a list of mappings")
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
        return cls(
            _node_numbers([_number(row, "node", i) for i, row in enumerate(rows)]),
            tuple(str(row["direction"]).strip() for row in rows),
            np.array([[_number(row, c, i) for c in "xyz"] for i, row in enumerate(rows)]),
        )


def _number(row: Mapping[str, Any], column: str, line: int) -> float:
    try:
        return float(row[column])
    except (TypeError, ValueError):
        raise LabelError(
            f"column {column!r} of the DOF table holds {row[column]!r:.60} in row {line} (from 0), "
            "which is no number. Write it with a decimal point and no unit; coordinates are [m]."
        ) from None


def _listed(items: Any, name: str, form: str) -> list[Any]:
    if not isinstance(items, Iterable):
        raise LabelError(f"{name} must be {form}, got {items!r:.60}. Pass it in [...].")
    return list(items)


def _node_numbers(nodes: Any) -> IntArray:
    try:
        numbers = np.asarray(nodes if isinstance(nodes, np.ndarray) else list(nodes))
        with np.errstate(invalid="ignore"):  # NaN is told below
            whole = numbers.astype(np.int64)
    except (TypeError, ValueError, OverflowError):
        numbers, whole = np.zeros(1), np.ones(1, dtype=np.int64)
    if numbers.dtype == bool or np.any(whole != numbers) or np.any(abs(whole) > _LARGEST_NODE):
        raise LabelError(
            f"node numbers must be whole numbers, got {nodes!r:.80}. Number the nodes, from 1 say, "
            "and keep the foreign program's names elsewhere."
        )
    return np.asarray(whole, dtype=np.int64)


def _directions(directions: Any) -> tuple[str, ...]:
    if isinstance(directions, str):
        raise LabelError(
            f"directions must be one for each DOF, got the single {directions!r}: write "
            f"[{directions!r}] * n."
        )
    # the million of a large model are strings already, and few different ones
    given = tuple(_listed(directions, "directions", "a list with one for each DOF"))
    try:
        if all(type(d) is str for d in set(given)):
            return given
    except TypeError:
        pass
    return tuple(str(direction) for direction in given)
