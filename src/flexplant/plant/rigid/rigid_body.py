"""The rigid body inside a structure: its six motions, mass and centre of gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import ModelError
from ...labels import DIRECTIONS
from ...structure import FEModel
from ...structure.rigid import turned_about
from ...values import FloatArray, Value
from ..realisation import ModalRealisation, Structure

#: relative: a rigid-body motion that the shapes make up to this is one of theirs
_SPANNED = 1e-7


@dataclass(frozen=True, eq=False)
class RigidBody(Value):
    """The rigid-body motions that a structure can make, about its centre of gravity.

    Parameters
    ----------
    axes : sequence of str
        Those of x, y, z, rx, ry, rz that exist.
    motions : (n, r) array
        Of the model's DOFs, per metre and radian, rotations about the centre of gravity.
    mass : (r, r) array [kg, kg m, kg m^2]
        ``motions' M motions``.
    centre : (3,) array [m]
        The centre of gravity; what the motions do not determine of it is 0.
    """

    axes: tuple[str, ...]
    motions: FloatArray
    mass: FloatArray
    centre: FloatArray

    def __post_init__(self) -> None:
        self._set(motions=self.motions, mass=self.mass, centre=self.centre)


def inertia_load(realisation: ModalRealisation, direction: str, about: FloatArray) -> FloatArray:
    """Return the load (n,) ``-M r`` of a unit base acceleration.

    Raises
    ------
    ModelError
        When the model does not determine its inertia against this motion.
    """
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
    if missed > _SPANNED:
        raise ModelError(
            f"the shapes of this {type(model).__name__} do not make the rigid-body motion "
            f"{direction!r} (they miss {missed:.2g} of it), so that its inertia against a base "
            "acceleration is not known: it is held, or has springs that were there before its "
            "modes were solved. Pass the FEModel, or solve it free and suspend(model, springs)."
        )
    return np.asarray(-model.inertia(motion)[:, 0])


def rigid_body_of(realisation: ModalRealisation) -> RigidBody:
    """Return the rigid body of a free or suspended structure.

    Raises
    ------
    ModelError
        When the structure cannot make any rigid-body motion.
    """
    model = realisation.model
    everywhere, missed = model.rigid_motions(), model.missed_motions()
    exists = [
        i
        for i, axis in enumerate(DIRECTIONS)
        if np.any(everywhere[:, i])
        and (axis in model.full_dofs.directions or axis.startswith("r"))
        and missed[i] < _SPANNED
    ]
    exists = _independent(everywhere, exists)
    if not exists:
        raise ModelError("this structure is held: it cannot move as a rigid body.")
    axes = tuple(DIRECTIONS[i] for i in exists)
    centre = _centre(_mass(model, everywhere[:, exists]), axes)
    motions = model.rigid_motions(centre)[:, exists]
    return RigidBody(axes, motions, _mass(model, motions), centre)


def _independent(motions: FloatArray, exists: list[int]) -> list[int]:
    """Drop axes that are combinations of earlier ones (few DOFs)."""
    kept: list[int] = []
    for i in exists:
        trial = motions[:, [*kept, i]]
        if np.linalg.matrix_rank(trial / np.linalg.norm(trial, axis=0), tol=1e-9) > len(kept):
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
