"""A model where it stands in the machine, with the matrices that joining needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ..dof_columns import component_columns
from ..errors import ModelError, require_known
from ..labels import DofSet
from ..reduction import ReducedModel
from ..structure import FEModel
from ..values import FloatArray, instance
from .joined_shapes import PlacedShape
from .pose import Pose, turned

#: either kind of model that can be joined
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
        """Whether it has damping of its own."""
        D: Any = self.model.D
        return D is not None and bool(abs(D).max() > 0)

    @property
    def T(self) -> Any:
        """All its DOFs by its coordinates (n_full, n)."""
        return self.model.T if self.is_reduced else sp.eye_array(self.n, format="csc")

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of its coordinates, those of the machine's DOFs first."""
        names = self.model.coordinates if self.is_reduced else self.model.dofs.labels
        return tuple(f"{self.name}/{name}" for name in names)


def components_of(models: Any, placed: Any) -> list[Component]:
    """Return the components of a machine where they stand."""
    instance(models, Mapping, "components", "Pass {'stage': model, 'frame': model}.")
    if not models:
        raise ModelError("there is no component to join. Pass {'stage': model, 'frame': model}.")
    names = list(models)
    component_columns(names, np.zeros(0, np.int64), 0)
    poses = {} if placed is None else dict(instance(placed, Mapping, "placed", "Pass {name: Pose}"))
    require_known("component", poses, names)
    found = []
    for name, model in models.items():
        pose = instance(poses.get(name, Pose()), Pose, f"placed[{name!r}]", "Pass Pose(shift=...).")
        hint = "Join models and reduced models; Modes by reduce(modes, ModalTruncation(k))."
        instance(model, Model, f"component {name!r}", hint)
        found.append(Component(name, placed_model(model, pose), _static_rows(model, pose)))
    return found


def _static_rows(model: Model, pose: Pose) -> FloatArray:
    """Return the loads (s, n_full) whose static shapes a reduced model has, turned as it is."""
    rows = []
    for name in model.static_at if isinstance(model, ReducedModel) else ():
        at: Any = name
        if name.startswith("("):
            at = [float(x) for x in name.strip("()").split(",")]
        if " " not in name or name.startswith("("):
            rows.append(model.full_dofs.row(at))
    if not rows:
        return np.zeros((0, len(model.full_dofs)))
    C: Any = turned(model.full_dofs, pose)[1]
    return np.asarray((C @ np.array(rows).T).T)


def placed_model(model: Model, pose: Pose) -> Model:
    """Return a model where it stands, its DOFs in the directions of the machine.

    Coordinates of a reduced model that the rotation makes oblique stay, as generalised ones.
    """
    if np.array_equal(pose.rotation, np.eye(3)) and not np.any(pose.shift):
        return model
    full = model.full_dofs
    dofs, C = turned(full, pose)
    if full.interpolation is not None:
        dofs = dofs.replace(interpolation=PlacedShape(full.interpolation, pose, C))
    if isinstance(model, ReducedModel):
        return _placed_reduced(model, dofs, C, pose)
    load = model.held_inertia
    matrices = {
        name: None if matrix is None else _turned_matrix(matrix, C)
        for name, matrix in (("M", model.M), ("K", model.K), ("D", model.D))
    }
    motions = model.joint_motions
    return model._with(
        **matrices,
        dofs=dofs,
        held_inertia=None if load is None else C @ load @ pose.own_ground(),
        joint_motions=None if motions is None else C @ motions,
    )


def _turned_matrix(matrix: Any, C: Any) -> Any:
    moved: Any = C @ matrix @ C.T
    return 0.5 * (moved + moved.T)


def _placed_reduced(model: ReducedModel, full: DofSet, C: Any, pose: Pose) -> ReducedModel:
    T, k = np.asarray(C @ model.T), model.n_dof
    changes: dict[str, Any] = {"T": T, "full_dofs": full, "truncated": None}
    try:
        own, turn = turned(model.dofs, pose)
    except ModelError:  # oblique: what they are stays, their names do not
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
