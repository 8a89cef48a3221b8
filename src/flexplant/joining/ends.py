"""The ends of joints: motions of places of components, with lever arms."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from ..checks import FloatArray
from ..errors import LabelError, require_known
from ..labels import DIRECTIONS, DofSet
from .joint import Joint, Patch, mean_motions

#: lever arms below this part of the machine's size are none
_NO_ARM = 1e-9
#: up to this part, a node without rotations turns as the nodes next to it do
_SHORT_ARM, _NEIGHBOURS = 1e-4, 12


class Jointed(Protocol):
    """What has ends of joints: a component, or channels that were measured on it."""

    @property
    def name(self) -> str:
        """What labels begin with."""
        ...

    @property
    def dofs(self) -> DofSet:
        """All that moves."""
        ...


class JointEnd:
    """One end of a joint."""

    def __init__(
        self, parts: Sequence[Jointed], end: Any, size: float, motions: Sequence[FloatArray]
    ) -> None:
        self.text = repr(end) if isinstance(end, Patch) else str(end)
        names = [part.name for part in parts]
        text = f"{end.component}/" if isinstance(end, Patch) else end
        name, rest = split_end(text, names) if isinstance(text, str) else (end[0], "")
        require_known("component", [name], names)
        self.index, self._size = names.index(name), size
        self._dofs, self._motions = parts[self.index].dofs, motions[self.index]
        self.label = ":" in rest
        self.axes: tuple[str, ...]
        if self.label:
            try:
                self._rows = {rest.rpartition(":")[2]: self._dofs.row(rest)}
            except LabelError as error:
                raise LabelError(f"component {name!r}: {error}") from None
            self.point = np.asarray(self._dofs.location(rest))
        elif isinstance(end, Patch):
            self._at_patch(end)
        elif rest:
            self._at_node(rest)
        else:
            self._at_point(end[1])
        self.axes = tuple(axis for axis in DIRECTIONS if axis in self._rows)

    def _at_node(self, node: str) -> None:
        dofs, self._rows = self._dofs, {}
        if dofs.component_of is None and node.lstrip("-").isdigit():
            for row in np.flatnonzero(dofs.nodes == int(node)):
                self._rows[dofs.directions[row]] = _unit(len(dofs), row)
                self.point = np.asarray(dofs.xyz[row])
        else:  # of a machine: "frame/41", of which DOFs may follow others
            for axis in DIRECTIONS:
                with suppress(LabelError):
                    self._rows[axis] = dofs.row(f"{node}:{axis}")
                    self.point = np.asarray(dofs.location(f"{node}:{axis}"))
        if not self._rows:
            raise LabelError(
                f"no node {node!r} for the joint at {self.text!r}: {dofs!r}. "
                "dofs.nearest((x, y, z)) finds one by its place."
            )

    def _at_patch(self, patch: Patch) -> None:
        self.point = patch.point(self._dofs)
        mean, _, made = patch.mean(self._dofs, self.point)
        rows, self._rows = patch.rows(self._dofs), {}
        for axis in made:
            self._rows[axis] = np.zeros(len(self._dofs))
            self._rows[axis][rows] = mean[DIRECTIONS.index(axis)]

    def _at_point(self, point: Any) -> None:
        self.point, self._rows = np.asarray(point, dtype=np.float64), {}
        failed = ""
        for axis in sorted(DIRECTIONS, key=lambda axis: axis not in self._dofs.directions):
            try:
                self._rows[axis] = self._dofs.row(self.point, axis)
            except LabelError as error:
                failed = failed or str(error)
        if not self._rows:
            raise LabelError(f"the joint at {self.text} is nowhere: {failed}")

    def is_near(self, point: FloatArray) -> bool:
        """Return whether a point is so near that coordinates with few digits explain its gap."""
        return bool(np.linalg.norm(point - self.point) <= _SHORT_ARM * self._size)

    def row(self, axis: str, point: FloatArray) -> FloatArray:
        """Return the motion (n,) along an axis at a point that moves with this end.

        A displacement there is ``u + theta x (point - own point)``.
        """
        if axis not in self._rows:
            raise LabelError(
                f"the joint at {self.text} has no axis {axis!r}: it moves along "
                f"{', '.join(self.axes)}. Join along these, or join a Patch of nodes, which has "
                "mean rotations."
            )
        found = self._rows[axis]
        arm = point - self.point
        if DIRECTIONS.index(axis) >= 3 or self.label or np.abs(arm).max() <= _NO_ARM * self._size:
            return found
        along = np.eye(3)[DIRECTIONS.index(axis)]
        for k, turn in enumerate(("rx", "ry", "rz")):
            share = float(np.cross(np.eye(3)[k], arm) @ along)
            if abs(share) <= _NO_ARM * self._size:
                continue
            turned = self._rows.get(turn)
            if turned is None and self.is_near(point):
                turned = self._turn_of_neighbours(turn)
            if turned is None:
                raise LabelError(
                    f"the lever arm ({', '.join(f'{x:g}' for x in arm)}) m of the joint at "
                    f"{self.text} needs its rotation {turn}, which it has not. Give point=, where "
                    "the joint acts, on its side, or join a Patch of nodes, which has mean "
                    "rotations."
                )
            found = found + share * turned
        return found

    def _turn_of_neighbours(self, turn: str) -> FloatArray | None:
        """Return the mean rotation (n,) of the nodes next to this end, None where there is none.

        Coordinates with few digits leave gaps between nodes that are meant to be one.
        """
        dofs = self._dofs
        first = np.unique(dofs.node_index, return_index=True)[1]
        distance = np.linalg.norm(dofs.xyz[first] - self.point, axis=1)
        near = first[np.argsort(distance, kind="stable")[:_NEIGHBOURS]]
        rows = np.flatnonzero(np.isin(dofs.node_index, dofs.node_index[near]) & (dofs.kinds < 3))
        mean, _, made = mean_motions(dofs._taken(rows), self.point, np.ones(rows.size))
        if turn not in made:
            return None
        found = np.zeros(len(dofs))
        found[rows] = mean[DIRECTIONS.index(turn)]
        return found

    def carried(self, row: FloatArray) -> FloatArray:
        """Return what a row (n,) gives for the six rigid-body motions of the machine (6,)."""
        some = np.flatnonzero(row)
        return np.asarray(row[some] @ self._motions[some])


def joint_axes(joint: Joint, first: JointEnd, second: JointEnd | None) -> tuple[str, ...]:
    """Return the axes that a joint joins: those given, that of a DOF, or those of both ends."""
    if joint.axes is not None:
        return tuple(joint.axes)
    for place in (first, second):
        if place is not None and place.label:
            return place.axes
    if second is not None and first.axes != second.axes:
        raise LabelError(
            f"the ends of {joint!r} move along {', '.join(first.axes)} and along "
            f"{', '.join(second.axes)}: it is not clear what is joined. Name axes=[...]."
        )
    return first.axes


def split_end(text: str, names: Sequence[str]) -> tuple[str, str]:
    """Return which component a text such as "stage/41:z" begins with, and the rest of it."""
    for name in sorted(names, key=len, reverse=True):
        if text.startswith(f"{name}/"):
            return name, text[len(name) + 1 :]
    return text.partition("/")[0], text.partition("/")[2]


def _unit(n: int, row: Any) -> FloatArray:
    found = np.zeros(n)
    found[row] = 1.0
    return found
