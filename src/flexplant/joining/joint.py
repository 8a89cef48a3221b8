"""Joints between components and their ends: motions of places, with lever arms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from ..arrays import (
    FloatArray,
    IntArray,
    instance,
    name_list,
    node_numbers,
    positive_array,
    real_array,
)
from ..errors import LabelError, ModelError, require_known, short
from ..labels import DIRECTIONS, DofSet
from ..store import Value
from ..structure.rigid import rigid_motions
from ..tolerances import FOUR_DIGITS, ROOT, SAME

#: an end: "stage/41:z", "stage/41" (a node), ("stage", (x, y, z)) or a Patch
End: TypeAlias = "str | tuple[str, Sequence[float]] | Patch"


@dataclass(frozen=True, eq=False, repr=False)
class Joint(Value):
    """A joint between two places of components, or between one and the ground.

    A joint without `stiffness` and `rate` is rigid: both ends have the same motion along each axis.
    Otherwise a spring and a damper connect the two ends along each axis.

    Parameters
    ----------
    first, second : str, (str, (3,) array [m]) or Patch
        Ends of the joint. An end is a DOF such as ``"stage/41:z"``, a node such as ``"stage/41"``,
        a point ``("stage", (x, y, z))`` in the coordinates of the machine, or a patch of nodes.
        Without `second`, a spring or damper acts against the ground.
    axes : sequence of str, optional
        Axes along which the ends are joined, among x, y, z, rx, ry, rz, in the directions of the
        machine. None: the axis of the DOF if an end is a DOF, otherwise the axes of both ends,
        which must be the same.
    stiffness : float or one for each axis [N/m, N m/rad], optional
        Stiffness of the spring. It is negative where the ends attract each other, as magnets do.
    rate : float or one for each axis [N s/m, N m s/rad], optional
        Damping of the damper (force per velocity).
    point : (3,) array [m], optional
        Point where the joint acts. A rigid lever arm connects each end to this point, so that a
        rotation of the end adds to the displacement of the point. None: the point is the first end.
        An end that is given as a DOF has no lever arm. At a node without rotations, the rotation
        follows from the displacements of neighbouring nodes. This is allowed for lever arms of up
        to 1e-4 of the machine's size. Such short arms occur when the coordinates are rounded, so
        that two ends at one place do not coincide exactly.

    Examples
    --------
    A rigid joint between two components, and a spring with a damper to the ground:

    >>> Joint("stage/41:z", "frame/7:z")
    <Joint stage/41:z - frame/7:z, rigid>
    >>> Joint("stage/41:z", stiffness=1e5, rate=20.0)
    <Joint stage/41:z - ground, 100000 N/m, 20 N s/m>
    """

    first: End
    second: End | None = None
    axes: Iterable[str] | None = field(default=None, kw_only=True)
    stiffness: float | Sequence[float] | FloatArray | None = field(default=None, kw_only=True)
    rate: float | Sequence[float] | FloatArray | None = field(default=None, kw_only=True)
    point: Sequence[float] | FloatArray | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        axes = None if self.axes is None else name_list(self.axes, "axes of a joint")
        require_known("axis", axes or (), DIRECTIONS)
        if axes is not None and (not axes or len(set(axes)) < len(axes)):
            raise LabelError(
                f"axes of a joint must be different, got {axes!r}: name each axis once."
            )
        self._set(
            first=_checked_end(self.first),
            second=None if self.second is None else _checked_end(self.second),
            axes=axes,
            stiffness=_axis_numbers(self.stiffness, "stiffness of a joint"),
            rate=_axis_numbers(self.rate, "rate of a joint"),
            point=None if self.point is None else real_array(self.point, "point", (3,)),
        )
        if self.is_rigid and self.second is None:
            raise ModelError(
                f"a rigid joint of {_end_text(self.first)} needs a second end. Hold DOFs to the "
                "ground by model.fixed([...]) before they are joined, or give stiffness=."
            )
        if self.rate is not None and np.any(np.asarray(self.rate) < 0):
            raise ModelError(f"the rate of a damper must not be negative, got {self.rate}.")

    def __repr__(self) -> str:
        second = "ground" if self.second is None else _end_text(self.second)
        ends = f"{_end_text(self.first)} - {second}"
        along = "" if self.axes is None else f" along {', '.join(self.axes)}"
        if self.is_rigid:
            return f"<Joint {ends}{along}, rigid>"
        kinds = ((self.stiffness, "N/m"), (self.rate, "N s/m"))
        listed = [
            f"{' '.join(f'{float(x):g}' for x in np.atleast_1d(np.asarray(value)))} {unit}"
            for value, unit in kinds
            if value is not None
        ]
        return f"<Joint {ends}{along}, {', '.join(listed)}>"

    @property
    def is_rigid(self) -> bool:
        """Whether both ends have the same motion along the axes of the joint."""
        return self.stiffness is None and self.rate is None

    def values(self, axes: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return the stiffness (k,) and the rate (k,) of the joint along k given axes."""
        axes = name_list(axes, "axes")
        found = []
        for value, name in ((self.stiffness, "stiffness"), (self.rate, "rate")):
            array = np.zeros(len(axes)) if value is None else np.asarray(value, dtype=np.float64)
            if array.ndim == 0 and len({axis.startswith("r") for axis in axes}) > 1 and array:
                raise ModelError(
                    f"one {name} of {self!r} cannot serve displacements and rotations "
                    f"({', '.join(axes)}): their units differ. Give one number for each axis."
                )
            if array.ndim and array.size != len(axes):
                raise ModelError(
                    f"{array.size} numbers as {name} of {self!r}, which joins "
                    f"{', '.join(axes)}. Give one for each axis."
                )
            found.append(np.broadcast_to(array, (len(axes),)).copy())
        return found[0], found[1]


def _checked_end(end: Any) -> Any:
    if isinstance(end, Patch):
        return end
    if isinstance(end, str) and all(end.partition("/")):
        return end
    if isinstance(end, tuple | list) and len(end) == 2 and isinstance(end[0], str):
        return end[0], tuple(real_array(end[1], "the point of a joint", (3,)).tolist())
    raise LabelError(
        f"the end of a joint must be a DOF 'stage/41:z', a node 'stage/41', a point "
        f"('stage', (x, y, z)) or a Patch, got {end!r:.80}. Begin with the component's name."
    )


def _axis_numbers(value: Any, name: str) -> Any:
    if value is None:
        return None
    array = real_array(value, name)
    return float(array) if array.ndim == 0 else real_array(array, name, (None,))


def _end_text(end: Any) -> str:
    if isinstance(end, tuple):
        return f"{end[0]}/({', '.join(f'{x:g}' for x in end[1])})"
    return repr(end) if isinstance(end, Patch) else str(end)


@dataclass(frozen=True, eq=False, repr=False)
class Patch(Value):
    """Nodes of a component that are joined by their mean motion, as by NASTRAN's RBE3.

    The mean motion v is the rigid-body motion of the patch that is closest to the displacements u
    of its nodes: ``v = (A^T W A)^-1 A^T W u``. The columns of A are the rigid-body motions about
    the point of the patch, and W is the diagonal matrix of the weights. A force on the patch is
    distributed over its nodes with the same weights. The patch may bend, which makes it too soft. A
    rigid patch (RBE2) is too stiff. The stiffness of a real bonded patch lies between the two.
    `JoiningReport` states how far the two differ.

    Parameters
    ----------
    component : str
        Name of the component that has the nodes. If this component belongs to a machine that was
        itself joined, both names are given, such as "machine/stage".
    nodes : sequence of int, optional
        Node numbers. Either `nodes` or `box` must be given.
    box : (2, 3) array [m], optional
        Lowest and highest corner of a box, in the coordinates of the machine. The patch has all
        nodes of the component in this box.
    at : (3,) array [m], optional
        Point about which the patch rotates, in the coordinates of the machine. None: the mean of
        the positions of the nodes.
    weights : (m,) array, optional
        Weights of the nodes in the order of `nodes`, for example their areas. None: equal weights,
        as always with a box.

    Examples
    --------
    A spring connects the mean motion of the lower plate with a node of the upper one:

    >>> import flexplant as fx
    >>> size, mesh = {"size": (0.2, 0.2), "thickness": 0.01}, {"elements": (2, 2)}
    >>> steel = {"density": 7800.0, "youngs_modulus": 2.1e11, "poisson_ratio": 0.3}
    >>> plate = fx.kirchhoff_plate(**size, **mesh, **steel)
    >>> foot = fx.joining.Patch("lower", box=[(0.0, 0.0, 0.0), (0.2, 0.2, 0.0)])
    >>> joint = fx.joining.Joint(foot, "upper/5:z", stiffness=1e6)
    >>> foot, fx.joined({"lower": plate, "upper": plate}, joint)
    (<Patch of lower, in a box>, <FEModel: 54 DOFs, sparse, 5 rigid-body motions, D not given>)
    """

    component: str
    nodes: Iterable[int] | None = None
    box: Sequence[Sequence[float]] | FloatArray | None = field(default=None, kw_only=True)
    at: Sequence[float] | FloatArray | None = field(default=None, kw_only=True)
    weights: Sequence[float] | FloatArray | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        instance(self.component, str, "component of a patch", "Name it.", LabelError)
        if (self.nodes is None) == (self.box is None):
            raise LabelError(
                "a patch needs either nodes=[...] or box=[(x, y, z), (x, y, z)]. Give one of them."
            )
        nodes = None if self.nodes is None else tuple(node_numbers(self.nodes).tolist())
        if nodes and len(set(nodes)) < len(nodes):
            raise LabelError(
                f"nodes of a patch must be different, got {short(nodes)}: name each once, with "
                "the sum of its weights."
            )
        weights = self.weights
        if weights is not None:
            weights = positive_array(weights, "weights of a patch", (len(nodes or ()),))
        self._set(
            nodes=nodes,
            box=None if self.box is None else real_array(self.box, "box", (2, 3)),
            at=None if self.at is None else real_array(self.at, "at", (3,)),
            weights=weights,
        )

    def __repr__(self) -> str:
        where = "in a box" if self.nodes is None else f"{len(tuple(self.nodes))} nodes"
        return f"<Patch of {self.component}, {where}>"

    def rows(self, dofs: DofSet) -> IntArray:
        """Return the indices (m,) of the displacements of the patch in the list `dofs`.

        `dofs` are the DOFs of the component.
        """
        inner = [name for name in dofs.components if self.component.endswith(f"/{name}")]
        if self.nodes is not None and dofs.components and not inner:
            raise LabelError(
                f"{self!r} names nodes by numbers, which {', '.join(dofs.components)} may share. "
                f"Name the component: fx.joining.Patch('{self.component}/{dofs.components[0]}', "
                "nodes), "
                "or give box=."
            )
        own = max(inner, key=len, default=None)
        chosen = dofs.where(nodes=self.nodes, box=self.box, component=own)
        rows = dofs.indices(chosen.labels)
        return np.asarray(rows[dofs.kinds[rows] < 3])

    def point(self, dofs: DofSet) -> FloatArray:
        """Return the point (3,) [m] about which the patch rotates.

        `dofs` are the DOFs of the component.
        """
        if self.at is not None:
            return np.asarray(self.at, dtype=np.float64)
        rows = self.rows(dofs)
        first = np.unique(dofs.node_index[rows], return_index=True)[1]
        return np.asarray(dofs.xyz[rows[first]].mean(axis=0))

    def mean(self, dofs: DofSet, point: FloatArray) -> tuple[FloatArray, FloatArray, list[str]]:
        """Return the matrices of the mean motions of the patch at a point.

        `dofs` are the DOFs of the component. The method returns three things. The first is the
        matrix (6, m) that computes the six mean motions from the displacements of the nodes. Its
        rows are zero for motions that the nodes do not determine. The second is the matrix A (m, 6)
        of the displacements in the six rigid-body motions. The third is the list of the motions
        that are determined.
        """
        rows = self.rows(dofs)
        return mean_motions(dofs._taken(rows), point, self._weight_of(dofs, rows))

    def _weight_of(self, dofs: DofSet, rows: IntArray) -> FloatArray:
        if self.weights is None:
            return np.ones(rows.size)
        known = dict(zip(tuple(self.nodes or ()), np.asarray(self.weights).tolist(), strict=True))
        return np.array([known[node] for node in dofs.nodes[rows].tolist()])


def mean_motions(
    some: DofSet, point: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Return the mean motions of some displacements (m,) at a point; see `Patch.mean`."""
    A = rigid_motions(some, point)
    radius = float(np.abs(A[:, 3:]).max(initial=0.0)) or 1.0
    scale = np.array([1.0] * 3 + [radius] * 3)
    root = np.sqrt(weights)[:, None]
    spread = root * A / scale
    inverse = np.linalg.pinv(spread, rcond=ROOT)
    made = np.linalg.norm(inverse @ spread - np.eye(6), axis=0) < ROOT
    by_node = (inverse * root.T) / scale[:, None]
    by_node[~made] = 0.0
    return by_node, A, [name for name, there in zip(DIRECTIONS, made, strict=True) if there]


#: largest lever arm, relative to the size, at which a node without rotations uses that of its
#: neighbours
_SHORT_ARM, _NEIGHBOURS = FOUR_DIGITS, 12


class JointEnd:
    """One end of a joint, on components with all their DOFs or with measured ones."""

    def __init__(
        self, parts: Mapping[str, DofSet], end: Any, size: float, motions: Sequence[FloatArray]
    ) -> None:
        self.text = repr(end) if isinstance(end, Patch) else str(end)
        text = f"{end.component}/" if isinstance(end, Patch) else end
        name, rest = split_end(text, list(parts)) if isinstance(text, str) else (end[0], "")
        require_known("component", [name], parts)
        self.index, self._size = list(parts).index(name), size
        self._dofs, self._motions = parts[name], motions[self.index]
        self.label = ":" in rest
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
            for row in np.flatnonzero(dofs.nodes == int(node)).tolist():
                self._rows[dofs.directions[row]] = np.eye(1, len(dofs), row)[0]
                self.point = np.asarray(dofs.xyz[row])
        else:  # in a machine: "frame/41", whose DOFs may follow others
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
            raise LabelError(f"the place of the joint at {self.text} is unknown: {failed}")

    def is_near(self, point: FloatArray) -> bool:
        """Return whether coordinates with few digits explain the distance of a point."""
        return bool(np.linalg.norm(point - self.point) <= _SHORT_ARM * self._size)

    def row(self, axis: str, point: FloatArray) -> FloatArray:
        """Return the motion (n,) along an axis at a point that moves with this end."""
        # a displacement there is `u + theta x (point - own point)`
        if axis not in self._rows:
            raise LabelError(
                f"the joint at {self.text} has no axis {axis!r}: it moves along "
                f"{', '.join(self.axes)}. Join along these, or join a Patch of nodes, which has "
                "mean rotations."
            )
        found = self._rows[axis]
        arm = point - self.point
        if DIRECTIONS.index(axis) >= 3 or self.label or np.abs(arm).max() <= SAME * self._size:
            return found
        along = np.eye(3)[DIRECTIONS.index(axis)]
        for k, turn in enumerate(("rx", "ry", "rz")):
            share = float(np.cross(np.eye(3)[k], arm) @ along)
            if abs(share) <= SAME * self._size:
                continue
            turned = self._rows.get(turn)
            if turned is None and self.is_near(point):
                turned = self._turn_of_neighbours(turn)
            if turned is None:
                raise LabelError(
                    f"the lever arm ({', '.join(f'{x:g}' for x in arm)}) m of the joint at "
                    f"{self.text} needs its rotation {turn}, which is missing. Give point=, "
                    "where the joint acts, on its side, or join a Patch of nodes, which has "
                    "mean "
                    "rotations."
                )
            found = found + share * turned
        return found

    def _turn_of_neighbours(self, turn: str) -> FloatArray | None:
        """Return the mean rotation (n,) of the nodes next to this end, None without such nodes."""
        # coordinates with few digits leave gaps between nodes that should coincide
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
        """Return the value (6,) of a row (n,) for the six rigid-body motions of the machine."""
        some = np.flatnonzero(row)
        return np.asarray(row[some] @ self._motions[some])


def joint_axes(joint: Joint, first: JointEnd, second: JointEnd | None) -> tuple[str, ...]:
    """Return the joined axes: the given ones, that of a DOF, or those of both ends."""
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


def joint_list(joints: Any) -> list[Joint]:
    """Return a joint, or several, as a list."""
    listed = [joints] if isinstance(joints, Joint) else joints
    hint = "Pass Joint('stage/41:z', 'frame/7:z')."
    listed = instance(listed, Iterable, "joints", "Pass Joint(...) in [...].")
    return [instance(joint, Joint, "a joint", hint) for joint in listed]


def split_end(text: str, names: Sequence[str]) -> tuple[str, str]:
    """Return the component and the rest of a text such as "stage/41:z"."""
    own = (name for name in sorted(names, key=len, reverse=True) if text.startswith(f"{name}/"))
    name = next(own, text.partition("/")[0])
    return name, text[len(name) + 1 :]
