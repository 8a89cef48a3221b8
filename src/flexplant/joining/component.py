"""A component at its place in the machine, with the matrices that joining needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray, instance, real_array
from ..errors import LabelError, ModelError, require_known
from ..labels import DIRECTIONS, DofSet, Interpolation, component_columns
from ..reduction import ReducedModel
from ..store import Value
from ..structure import FEModel
from ..tolerances import ROUNDING, SAME

#: types of models that can be joined
Model = FEModel | ReducedModel


class Component(NamedTuple):
    """A component of a machine."""

    name: str
    model: Any
    static_rows: FloatArray

    @property
    def dofs(self) -> DofSet:
        """All its DOFs."""
        found: DofSet = self.model.full_dofs
        return found

    @property
    def n(self) -> int:
        """Number of its coordinates."""
        return int(self.model.n_dof)

    @property
    def is_reduced(self) -> bool:
        """Whether it is a reduced model."""
        return isinstance(self.model, ReducedModel)

    @property
    def is_damped(self) -> bool:
        """Whether it has a damping matrix."""
        D: Any = self.model.D
        return D is not None and bool(abs(D).max() > 0)

    @property
    def T(self) -> Any:
        """Matrix (n_full, n) that gives all its DOFs from its coordinates."""
        return self.model.T if self.is_reduced else sp.eye_array(self.n, format="csc")

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of its coordinates, those of the machine's DOFs first."""
        names = self.model.coordinates if self.is_reduced else self.model.dofs.labels
        return tuple(f"{self.name}/{name}" for name in names)


def components_of(models: Any, placed: Any) -> list[Component]:
    """Return the components at their places in the machine."""
    instance(models, Mapping, "components", "Pass {'stage': model, 'frame': model}.")
    if not models:
        raise ModelError("components is empty. Pass {'stage': model, 'frame': model}.")
    names = list(models)
    component_columns(names, np.zeros(0, np.int64), 0)
    poses = {} if placed is None else dict(instance(placed, Mapping, "placed", "Pass {name: Pose}"))
    require_known("component", poses, names)
    found = []
    hint = "Join models and reduced models; Modes by reduce(modes, ModalTruncation(k))."
    for name, model in models.items():
        pose = instance(poses.get(name, Pose()), Pose, f"placed[{name!r}]", "Pass Pose(shift=...).")
        instance(model, Model, f"component {name!r}", hint)
        found.append(Component(name, placed_model(model, pose), _static_rows(model, pose)))
    return found


def _static_rows(model: Model, pose: Pose) -> FloatArray:
    """Return the loads (s, n_full) whose static shapes a reduced model has, in its orientation."""
    rows = []
    for name in model.static_at if isinstance(model, ReducedModel) else ():
        at: Any = name
        if name.startswith("("):
            at = [float(x) for x in name.strip("()").split(",")]
        if " " not in name or name.startswith("("):
            rows.append(model.full_dofs.row(at))
    C: Any = turned_dofs(model.full_dofs, pose)[1]
    return np.asarray((C @ np.array(rows).reshape(-1, C.shape[1]).T).T)


def placed_model(model: Model, pose: Pose) -> Model:
    """Return a model at its place, with its DOFs in the directions of the machine."""
    # coordinates of a reduced model that become oblique are kept as generalised coordinates
    if np.array_equal(pose.rotation, np.eye(3)) and not np.any(pose.shift):
        return model
    full = model.full_dofs
    dofs, C = turned_dofs(full, pose)
    if full.interpolation is not None:
        dofs = dofs.replace(interpolation=PlacedShape(full.interpolation, pose, C))
    if isinstance(model, ReducedModel):
        return _placed_reduced(model, dofs, C, pose)

    def turned(matrix: Any) -> Any:
        moved: Any = C @ matrix @ C.T
        return 0.5 * (moved + moved.T)

    load, motions = model.held_inertia, model.joint_motions
    return model._with(
        M=turned(model.M),
        K=turned(model.K),
        D=None if model.D is None else turned(model.D),
        dofs=dofs,
        held_inertia=None if load is None else C @ load @ pose.own_ground(),
        joint_motions=None if motions is None else C @ motions,
    )


def _placed_reduced(model: ReducedModel, full: DofSet, C: Any, pose: Pose) -> ReducedModel:
    T, k = np.asarray(C @ model.T), model.n_dof
    changes: dict[str, Any] = {"T": T, "full_dofs": full, "truncated": None}
    try:
        own, turn = turned_dofs(model.dofs, pose)
    except ModelError:  # oblique: the motions are kept, but get new names
        names = [f"own {name}" for name in model.coordinates]
        return model.replace(dofs=full.select(()), coordinates=names, **changes)
    wide = np.eye(k)
    wide[: len(own), : len(own)] = turn.toarray()
    names = [*own.labels, *tuple(model.coordinates)[len(own) :]]
    motions = model.joint_motions
    return model.replace(
        M=wide @ model.M @ wide.T,
        D=wide @ model.D @ wide.T,
        K=wide @ model.K @ wide.T,
        rigid_body=wide @ model.rigid_body,
        joint_motions=None if motions is None else wide @ motions,
        dofs=own,
        coordinates=names,
        **(changes | {"T": T @ wide.T}),
    )


@dataclass(frozen=True, eq=False, repr=False)
class PlacedShape(Interpolation):
    """The shape functions of a component that was rotated and shifted.

    Parameters
    ----------
    own, pose : Interpolation, Pose
        Interpolation of the component in its own coordinates, and its pose.
    C : (n, n) sparse array
        Matrix of ``q = C q_own``. It changes the DOFs q_own in the component's own directions into
        the DOFs q in the directions of the machine.

    Examples
    --------
    The second beam is shifted to the end of the first one. Its own shape functions stay the same:

    >>> import flexplant as fx
    >>> bar = {"length": 0.2, "elements": 2, "area": 1e-4, "inertia": 1e-9}
    >>> beam = fx.beam(**bar, density=7800.0, youngs_modulus=2.1e11)
    >>> joint = fx.joining.Joint("left/3:z", "right/1:z")
    >>> shift = fx.joining.Pose(shift=(0.2, 0.0, 0.0))
    >>> machine = fx.joined({"left": beam, "right": beam}, joint, placed={"right": shift})
    >>> machine.dofs.interpolation.parts[1].interpolation.own
    BeamShape(length=0.2, elements=2)
    """

    own: Interpolation
    pose: Pose
    C: sp.csc_array

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) with which the DOFs give the motion `direction` at `xyz` [m]."""
        return np.asarray(self.rows(np.asarray(xyz, dtype=np.float64)[None], direction)[0])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        places = self.pose.own_points(points)
        found = sum(share * self.own.rows(places, own) for own, share in self._shares(direction))
        return np.asarray((self.C @ np.asarray(found).T).T)

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the weights (n,) and the coordinates (3,) [m] of a DOF that joints removed.

        A component has such DOFs if it is itself a joined machine. The weights give the
        displacement of the DOF from those of the n DOFs that remain. The result is None if the
        label is not that of a removed DOF. After a rotation of the component, the DOF combines
        several directions of its node. If the component lacks one of these directions, the result
        is None.
        """
        node, _, direction = label.rpartition(":")
        if direction not in DIRECTIONS:
            return None
        row, place = np.zeros(self.C.shape[1]), np.zeros(3)
        for own, share in self._shares(direction):
            found = self.own.dependent(f"{node}:{own}")
            if found is None:
                return None
            row, place = row + share * found[0], found[1]
        return np.asarray(self.C @ row), self.pose.points(place[None])[0]

    def _shares(self, direction: str) -> list[tuple[str, float]]:
        """Return the own directions that a direction of the machine combines, and their weights."""
        first, axis = divmod(DIRECTIONS.index(direction), 3)
        shares = np.asarray(self.pose.rotation)[axis].tolist()
        own = DIRECTIONS[3 * first : 3 * first + 3]
        return [(name, share) for name, share in zip(own, shares, strict=True) if share]


@dataclass(frozen=True, eq=False, repr=False)
class JoinedShape(Interpolation):
    """The shape functions of all components of a joined machine.

    Parameters
    ----------
    names : sequence of str
        Names of the components.
    parts : sequence of DofSet
        DOFs of the placed components with their shapes.
    expansion : (n_all, n) sparse array, optional
        Matrix that computes the DOFs of all components from the n DOFs of the machine. None: the
        joints removed no DOF.
    motions : (n_all, k) array, optional
        All motions that a reduced machine can make, one in each column. They show whether two
        components that share a point move together there.

    Examples
    --------
    The free end of the second beam is found by its coordinates in the machine:

    >>> import flexplant as fx
    >>> bar = {"length": 0.2, "elements": 2, "area": 1e-4, "inertia": 1e-9}
    >>> beam = fx.beam(**bar, density=7800.0, youngs_modulus=2.1e11)
    >>> joint = fx.joining.Joint("left/3:z", "right/1:z")
    >>> shift = fx.joining.Pose(shift=(0.2, 0.0, 0.0))
    >>> machine = fx.joined({"left": beam, "right": beam}, joint, placed={"right": shift})
    >>> machine.dofs.interpolation.names, machine.dofs.nearest((0.4, 0.0, 0.0), "z")
    (('left', 'right'), 'right/3:z')
    """

    names: tuple[str, ...]
    parts: tuple[DofSet, ...]
    expansion: sp.csc_array | None = None
    motions: FloatArray | None = None

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) with which the DOFs give the motion `direction` at `xyz` [m].

        The point must lie on a component that can move in the given direction. If it also lies on
        another component, both must move together there. Otherwise a LabelError is raised.
        """
        found: dict[str, FloatArray] = {}
        failed: list[str] = []
        for index, (name, part) in enumerate(zip(self.names, self.parts, strict=True)):
            try:
                found[name] = self._expanded(index, part.row(xyz, direction))
            except LabelError as error:
                failed.append(f"{name}: {error}")
        if not found:
            raise LabelError(
                f"the point {tuple(np.asarray(xyz).tolist())} is on no component with the motion "
                f"{direction!r}. {' '.join(failed)}"
            )
        rows = list(found.values())
        seen = rows if self.motions is None else [row @ self.motions for row in rows]
        if any(np.abs(one - seen[0]).max() > SAME * np.abs(seen[0]).max() for one in seen[1:]):
            one, other = list(found)[:2]
            raise LabelError(
                f"the point {tuple(np.asarray(xyz).tolist())} is on {one!r} and on {other!r}, "
                "which move differently there. Name a DOF: "
                f"dofs.nearest(point, {direction!r}, component={one!r})."
            )
        return rows[0]

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the weights (n,) and the coordinates (3,) [m] of a DOF that joints removed.

        The weights give its displacement from those of the n DOFs of the machine. The result is
        None if no component has a DOF with this label.
        """
        for index, (name, part) in enumerate(zip(self.names, self.parts, strict=True)):
            rest = label.removeprefix(f"{name}/")
            if rest == label:
                continue
            if rest in part:
                return self._expanded(index, part.row(rest)), part.xyz[part.index(rest)]
            own = part.interpolation
            inner = None if own is None else own.dependent(rest)
            if inner is not None:
                return self._expanded(index, inner[0]), inner[1]
        return None

    def _expanded(self, index: int, row: FloatArray) -> FloatArray:
        start, rows = sum(len(part) for part in self.parts[:index]), np.flatnonzero(row)
        return np.asarray(row[rows] @ self._by_rows[start + rows])

    @cached_property
    def _by_rows(self) -> Any:
        every = sp.eye_array(sum(len(part) for part in self.parts))
        return sp.csr_array(every if self.expansion is None else self.expansion)


#: entries of a rotation below this count as zero: cos(pi/2) is 6e-17
_ZERO = ROUNDING
#: largest departure of a rotation matrix from orthogonality
_ORTHOGONAL = SAME


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Value):
    """Position and orientation of a component in a machine.

    The point p of the component is at ``R p + shift`` in the machine.

    Parameters
    ----------
    shift : (3,) array [m]
        Position of the component's origin in the machine.
    rotation : (3,) array [rad] or (3, 3) array
        Either the rotation vector or the rotation matrix R. The rotation vector gives a rotation
        about the origin of the component: its direction is the axis of the rotation, and its length
        is the angle.

    Raises
    ------
    ShapeError, ModelError
        When R is not orthogonal or contains a mirror image, or the angle is above 2 pi.

    Examples
    --------
    A component is rotated by 90 degrees about z and shifted along x:

    >>> pose = Pose(shift=(1.0, 0.0, 0.0), rotation=(0.0, 0.0, np.pi / 2))
    >>> pose.points([[0.5, 0.0, 0.0]])
    array([[1. , 0.5, 0. ]])
    """

    shift: Sequence[float] | FloatArray = (0.0, 0.0, 0.0)
    rotation: Any = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        turn = real_array(self.rotation, "rotation")
        if turn.ndim == 1:
            x, y, z = real_array(turn, "rotation", (3,))
            if la.norm(turn) > 2 * np.pi:
                raise ModelError(
                    f"rotation {turn.tolist()} is more than a full turn: angles are in radians. "
                    "For degrees, pass numpy.radians([0, 0, 90])."
                )
            turn = la.expm(np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))
            turn[np.abs(turn) < _ZERO] = 0.0
        turn = real_array(turn, "rotation", (3, 3))
        if np.abs(turn @ turn.T - np.eye(3)).max() > _ORTHOGONAL or la.det(turn) < 0:
            raise ModelError(
                f"rotation must be a rotation vector [rad] or an orthogonal matrix without a "
                f"mirror image, got {turn.tolist()}: lengths would change. A quarter turn about z "
                "is (0, 0, pi / 2)."
            )
        self._set(shift=real_array(self.shift, "shift", (3,)), rotation=turn)

    def __repr__(self) -> str:
        angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(self.rotation) - 1), -1.0, 1.0)))
        place = ", ".join(f"{float(x):g}" for x in self.shift)
        return f"<Pose at ({place}) m, turned by {angle:.4g} degrees>"

    def points(self, xyz: Any) -> FloatArray:
        """Return machine coordinates of points (n, 3) [m] that are given in the component's."""
        return np.asarray(real_array(xyz, "xyz", (None, 3)) @ self.rotation.T + self.shift)

    def own_points(self, xyz: FloatArray) -> FloatArray:
        """Return component coordinates of points (n, 3) [m] that are given in the machine's."""
        return np.asarray((xyz - self.shift) @ self.rotation)

    def own_ground(self) -> FloatArray:
        """Return the (6, 6) matrix that maps a ground motion from the machine to the component.

        In the coordinates of the machine, the ground motion is a translation v and a rotation w
        about the machine's origin. In the coordinates of the component, it is the translation
        ``R^T (v + w x shift)`` and the rotation ``R^T w`` about the component's origin.
        """
        x, y, z = self.shift
        back = self.rotation.T
        cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # w x shift = cross w
        return np.block([[back, back @ cross], [np.zeros((3, 3)), back]])


def turned_dofs(dofs: DofSet, pose: Pose) -> tuple[DofSet, sp.csc_array]:
    """Return DOFs in the directions and places of the machine, and C with ``q = C q_own``."""
    # without the interpolation. C is orthogonal: it rotates the displacements and the rotations of
    # each node
    kinds, n = np.array(dofs.kinds), len(dofs)
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for first in (0, 3):
        there = np.flatnonzero((dofs.kinds >= first) & (dofs.kinds < first + 3))
        # by node, then by direction
        there = there[np.lexsort((dofs.kinds[there], dofs.node_index[there]))]
        for own, group in _direction_groups(dofs, there, first):
            R = pose.rotation[:, own]
            made = np.flatnonzero(np.any(np.abs(R) > _ORTHOGONAL, axis=1))
            if made.size != own.size:
                has = ", ".join(DIRECTIONS[k] for k in own + first)
                raise ModelError(
                    f"node {dofs.nodes[group[0][0]]} has only the directions {has}, which this "
                    "rotation turns away from x, y and z: its motion would be oblique. Rotate by "
                    "quarter turns, or about the axis that keeps them, or use a component with "
                    "all directions (place the components of a machine before they are joined)."
                )
            kinds[group] = first + made
            rows.append(np.repeat(group, own.size, axis=1).ravel())
            columns.append(np.tile(group, (1, own.size)).ravel())
            values.append(np.tile(R[made].ravel(), group.shape[0]))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    names = np.array(DIRECTIONS, dtype=object)
    placed = dofs.replace(
        directions=tuple(names[kinds]), xyz=pose.points(dofs.xyz), interpolation=None
    )
    return placed, sp.csc_array(entries, shape=(n, n))


def _direction_groups(dofs: DofSet, rows: IntArray, first: int) -> list[tuple[IntArray, IntArray]]:
    """Return, for nodes with the same directions, these (k,) and their rows (m, k)."""
    if not rows.size:
        return []
    node = dofs.node_index[rows]
    starts = np.flatnonzero(np.diff(node, prepend=-1))
    bits = np.add.reduceat(1 << (dofs.kinds[rows] - first), starts)
    found = []
    for mask in np.unique(bits):
        own = np.flatnonzero([mask >> k & 1 for k in range(3)])
        begin = starts[bits == mask]
        found.append((own, rows[begin[:, None] + np.arange(own.size)]))
    return found
