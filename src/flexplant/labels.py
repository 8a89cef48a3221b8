"""Degrees of freedom (DOFs) and signals by name: `"41:z"` is the z-displacement of node 41."""

from __future__ import annotations

import csv
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
        nodes = np.asarray(self.nodes, dtype=np.int64)
        directions = tuple(str(direction) for direction in self.directions)
        if nodes.ndim != 1 or len(directions) != nodes.size:
            raise ShapeError(
                f"a DofSet needs one node and one direction per DOF, got nodes of shape "
                f"{nodes.shape} and {len(directions)} directions."
            )
        unknown = sorted(set(directions) - set(DIRECTIONS))
        if unknown:
            raise LabelError(f"unknown directions {unknown}: use {', '.join(DIRECTIONS)}.")
        self._set(
            nodes=nodes, directions=directions, xyz=real_array(self.xyz, "xyz", (nodes.size, 3))
        )
        if len(self._position) != nodes.size:
            seen: set[str] = set()
            twice = next(label for label in self.labels if label in seen or seen.add(label))  # type: ignore[func-returns-value]
            raise LabelError(
                f"DOF {twice!r} appears twice: rows of the matrices would be ambiguous."
            )

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The labels `"node:direction"`, in order."""
        return tuple(f"{n}:{d}" for n, d in zip(self.nodes.tolist(), self.directions, strict=True))

    @cached_property
    def _position(self) -> dict[str, int]:
        return {label: i for i, label in enumerate(self.labels)}

    def __len__(self) -> int:
        return int(self.nodes.size)

    def __iter__(self) -> Iterator[str]:
        return iter(self.labels)

    def __contains__(self, label: object) -> bool:
        return label in self._position

    def __repr__(self) -> str:
        kinds = ", ".join(
            f"{self.directions.count(d)} {d}" for d in DIRECTIONS if d in self.directions
        )
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
        try:
            return self._position[label]
        except (KeyError, TypeError):
            raise unknown_label("DOF", label, self.labels) from None

    def indices(self, labels: Iterable[str]) -> IntArray:
        """Return the rows of several DOFs, in the order given."""
        if isinstance(labels, str):
            labels = [labels]
        return np.array([self.index(label) for label in labels], dtype=np.int64)

    def select(self, labels: Iterable[str]) -> DofSet:
        """Return the DofSet of some of the DOFs, in the order given (no interpolation)."""
        rows = self.indices(labels)
        return DofSet(self.nodes[rows], tuple(self.directions[i] for i in rows), self.xyz[rows])

    def where(
        self,
        nodes: Iterable[int] | int | None = None,
        directions: Iterable[str] | str | None = None,
    ) -> DofSet:
        """Return the DOFs at the given nodes and in the given directions (None: all).

        Raises
        ------
        LabelError
            When a node or direction is not there.
        """
        keep = np.ones(len(self), dtype=bool)
        if nodes is not None:
            wanted = np.atleast_1d(np.asarray(nodes if isinstance(nodes, int) else list(nodes)))
            missing = np.setdiff1d(wanted, self.nodes)
            if missing.size:
                raise LabelError(f"no DOF at nodes {missing[:6].tolist()}: {self!r}.")
            keep &= np.isin(self.nodes, wanted)
        if directions is not None:
            named = {directions} if isinstance(directions, str) else set(directions)
            if named - set(self.directions):
                raise LabelError(
                    f"no DOF in directions {sorted(named - set(self.directions))}: {self!r}."
                )
            keep &= np.array([d in named for d in self.directions], dtype=bool)
        return self.select(np.array(self.labels, dtype=object)[keep].tolist())

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
        rows = np.array(
            [i for i, d in enumerate(self.directions) if d == direction], dtype=np.int64
        )
        if not rows.size:
            raise LabelError(f"no DOF in direction {direction!r}: {self!r}.")
        point = real_array(xyz, "xyz", (3,))
        distance = np.linalg.norm(self.xyz[rows] - point, axis=1)
        return self.labels[int(rows[np.argmin(distance)])]

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
            rows = list(table)
        missing = [
            c for c in ("node", "direction", "x", "y", "z") if any(c not in row for row in rows)
        ]
        if missing or not rows:
            raise LabelError(
                f"a DOF table needs rows with columns node, direction, x, y, z; missing: {missing}."
            )
        return cls(
            np.array([int(row["node"]) for row in rows], dtype=np.int64),
            tuple(str(row["direction"]).strip() for row in rows),
            np.array([[float(row[c]) for c in "xyz"] for row in rows]),
        )
