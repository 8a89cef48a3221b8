"""The rigid body inside a structure: its six motions, mass and centre of gravity."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..arrays import FloatArray
from ..errors import AssumptionError, ModelError
from ..labels import DIRECTIONS
from ..store import Value
from ..structure import FEModel
from ..structure.rigid import turned_about
from ..tolerances import NEGLIGIBLE, SAME
from .realisation import ModalRealisation, Structure


@dataclass(frozen=True, eq=False)
class RigidBody(Value):
    """The rigid-body motions that a structure can make, about its centre of gravity."""

    axes: tuple[str, ...]
    motions: FloatArray
    mass: FloatArray
    centre: FloatArray
    lost: Mapping[str, float] = field(default_factory=dict)


def inertia_load(realisation: ModalRealisation, direction: str, about: FloatArray) -> FloatArray:
    """Return the load (n,) ``-M r`` of a unit base acceleration."""
    key = ("inertia", direction, *np.asarray(about).tolist())
    return realisation.once(
        key, lambda: realisation.load(_inertia_load(realisation, direction, about))
    )


def _inertia_load(realisation: ModalRealisation, direction: str, about: FloatArray) -> FloatArray:
    model, axis = realisation.model, DIRECTIONS.index(direction)
    motion = model.rigid_motions(about)[:, axis : axis + 1]
    if not np.any(motion):
        raise ModelError(
            f"a base acceleration along {direction!r} does not move this model: its DOFs are "
            f"{', '.join(sorted(set(model.full_dofs.directions)))}."
        )
    if isinstance(model, FEModel):
        return -model.ground_inertia(turned_about(direction, about))
    missed = model.missed_motions(about)[axis]
    if missed > NEGLIGIBLE:
        raise ModelError(
            f"the shapes of this {type(model).__name__} do not make the rigid-body motion "
            f"{direction!r} (they miss {missed:.2g} of it), so that its inertia against a base "
            "acceleration is not known: it is held, or has springs that were there before its "
            "modes were solved and that bend them. Pass the FEModel, more modes, or solve it free "
            "and fx.plant.suspend(modes, springs)."
        )
    return np.asarray(-model.inertia(motion)[:, 0])


def rigid_body_of(realisation: ModalRealisation) -> RigidBody:
    """Return the rigid body of a free or suspended structure."""
    body, why = realisation.once("rigid body", lambda: _rigid_body(realisation.model))
    if body is None:
        raise ModelError(
            f"this structure is held: it cannot move as a rigid body, {why}. Take the structure "
            "without its supports."
        )
    return body


def _rigid_body(model: Structure) -> tuple[RigidBody | None, str]:
    """Return the rigid body; None and why, of a structure that is held."""
    everywhere, missed = model.rigid_motions(), model.missed_motions()
    moving = [
        i
        for i, axis in enumerate(DIRECTIONS)
        if np.any(everywhere[:, i]) and (axis in model.full_dofs.directions or axis.startswith("r"))
    ]
    exists = _drop_dependent(everywhere, [i for i in moving if missed[i] < NEGLIGIBLE])
    lost = {DIRECTIONS[i]: float(missed[i]) for i in moving if missed[i] >= NEGLIGIBLE}
    if not exists:
        why = (
            f"DOFs are held against {', '.join(lost)}"
            if isinstance(model, FEModel)
            else f"its shapes miss {_lost_shares(lost)} of these motions"
        )
        return None, why
    axes = tuple(DIRECTIONS[i] for i in exists)
    centre = _centre(_mass(model, everywhere[:, exists]), axes)
    motions = model.rigid_motions(centre)[:, exists]
    return RigidBody(axes, motions, _mass(model, motions), centre, lost), ""


def refuse_lost(
    body: RigidBody, realisation: ModalRealisation, rows: Iterable[FloatArray], do: str
) -> None:
    """Raise AssumptionError when channels have part in a rigid-body axis that a model has lost."""
    lost = body.lost
    if not lost:
        return
    motions = realisation.model.rigid_motions(body.centre)
    motions = motions[:, [DIRECTIONS.index(axis) for axis in lost]]
    stacked = np.array(list(rows)).reshape(-1, motions.shape[0])
    most = np.abs(stacked) @ np.abs(motions)
    seen = np.any(np.abs(stacked @ motions) > SAME * most.max(axis=0, initial=0.0), axis=0)
    if np.any(seen):
        named = {axis: part for (axis, part), one in zip(lost.items(), seen, strict=True) if one}
        others = f"the other axes ({', '.join(body.axes)}) would be mixed with these"
        if isinstance(realisation.model, FEModel):
            raise AssumptionError(
                f"the channels have part in {', '.join(named)}, against which DOFs of this model "
                f"are held, and {others}{do}."
            )
        raise AssumptionError(
            f"the channels have part in rigid-body axes that this model has no shapes for: they "
            f"miss {_lost_shares(named)}, and {others}. Stiff springs that were there before the "
            "modes were solved bend them: keep more modes, or solve the free structure and "
            f"fx.plant.suspend(modes, springs){do}."
        )


def _lost_shares(lost: Mapping[str, float]) -> str:
    return ", ".join(f"{100 * part:.2g} % of {axis}" for axis, part in lost.items())


def _drop_dependent(motions: FloatArray, exists: list[int]) -> list[int]:
    """Drop axes that are combinations of earlier ones (few DOFs)."""
    kept: list[int] = []
    for i in exists:
        trial = motions[:, [*kept, i]]
        if np.linalg.matrix_rank(trial / np.linalg.norm(trial, axis=0), tol=SAME) > len(kept):
            kept.append(i)
    return kept


def _mass(model: Structure, motions: FloatArray) -> FloatArray:
    return np.asarray(motions.T @ model.inertia(motions))


def _centre(mass: FloatArray, axes: tuple[str, ...]) -> FloatArray:
    """Return c from ``mass[i, r] = m (e_r x c)_i``, translations i and rotations r about 0."""
    rows, values = [], []
    for i, moved in enumerate(axes):
        for j, turned in enumerate(axes):
            if not moved.startswith("r") and turned.startswith("r"):
                about = np.eye(3)["xyz".index(turned[1])]
                along = np.eye(3)["xyz".index(moved)]
                # (e_r x c) . e_i = c . (e_i x e_r)
                rows.append(np.cross(along, about))
                values.append(mass[i, j] / mass[i, i])
    if not rows:
        return np.zeros(3)
    return np.asarray(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0])


def rigid_parts(rows: Sequence[FloatArray], motions: FloatArray) -> FloatArray:
    """Return the parts (p, r) of rows over the DOFs, which may be none, in motions (n, r)."""
    return np.array(rows).reshape(len(rows), motions.shape[0]) @ motions
