"""The rigid body inside a structure: its six motions, mass and centre of gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import ModelError
from ...labels import DIRECTIONS
from ...modes import Modes
from ...reduction import ReducedModel
from ...structure import FEModel
from ...structure.rigid import rigid_motions
from ...values import FloatArray, Value
from ..realisation import ModalRealisation, Structure

#: relative: a rigid-body motion that the shapes make up to this is one of theirs
_SPANNED = 1e-7
#: relative: what complex shapes span less than this is rounding
_TRUNCATED = 1e-9


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
        The centre of gravity; what the motions do not tell of it is 0.
    """

    axes: tuple[str, ...]
    motions: FloatArray
    mass: FloatArray
    centre: FloatArray

    def __post_init__(self) -> None:
        self._set(motions=self.motions, mass=self.mass, centre=self.centre)


def inertia_load(
    realisation: ModalRealisation, direction: str, about: Sequence[float]
) -> FloatArray:
    """Return the load (n,) ``-M r`` of a unit base acceleration.

    Raises
    ------
    ModelError
        When the model does not tell its inertia against this motion.
    """
    model = realisation.model
    motion = _motions(model, np.asarray(about))[:, DIRECTIONS.index(direction)]
    if not np.any(motion):
        raise ModelError(
            f"a base acceleration along {direction!r} does not move this model: its DOFs are "
            f"{', '.join(sorted(set(getattr(model, 'full_dofs', model.dofs).directions)))}."
        )
    if isinstance(model, FEModel):
        return -np.asarray(model.M @ motion)
    missed = _missed(model, motion[:, None], np.asarray(about), direction)
    if missed > _SPANNED:
        raise ModelError(
            f"the shapes of this {type(model).__name__} do not make the rigid-body motion "
            f"{direction!r} (they miss {missed:.2g} of it), so that its inertia against a base "
            "acceleration is not known: it is held, or has springs that were there before its "
            "modes were solved. Pass the FEModel, or solve it free and suspend(model, springs)."
        )
    return -inertia(model, motion[:, None])[:, 0]


def inertia(model: Structure, motions: FloatArray) -> FloatArray:
    """Return loads (n, r) with the modal forces of ``M motions``, motions that the shapes make."""
    if isinstance(model, Modes):
        # any load with these modal forces will do: basis' f = c, where r = basis c
        basis = _real_basis(model)
        return np.asarray(np.linalg.lstsq(basis.T, _share(basis, motions), rcond=None)[0])
    return np.asarray(model.M @ motions)


def rigid_body_of(realisation: ModalRealisation) -> RigidBody:
    """Return the rigid body of a free or suspended structure.

    Raises
    ------
    ModelError
        When the structure cannot make any rigid-body motion.
    """
    model = realisation.model
    origin = np.zeros(3)
    everywhere = _motions(model, origin)
    directions = (model.full_dofs if isinstance(model, ReducedModel) else model.dofs).directions
    exists = [
        i
        for i, axis in enumerate(DIRECTIONS)
        if np.any(everywhere[:, i])
        and (axis in directions or axis.startswith("r"))
        and _missed(model, everywhere[:, i : i + 1], origin, axis) < _SPANNED
    ]
    exists = _independent(everywhere, exists)
    if not exists:
        raise ModelError("this structure is held: it cannot move as a rigid body.")
    mass = _mass(model, everywhere[:, exists])
    axes = tuple(DIRECTIONS[i] for i in exists)
    centre = _centre(mass, axes)
    motions = _motions(model, centre)[:, exists]
    return RigidBody(axes, motions, _mass(model, motions), centre)


def _motions(model: Structure, about: FloatArray) -> FloatArray:
    if isinstance(model, ReducedModel):
        return model.rigid_motions(about)
    dofs = model.dofs
    return rigid_motions(dofs.replace(xyz=dofs.xyz - about, interpolation=None))


def _independent(motions: FloatArray, exists: list[int]) -> list[int]:
    """Drop axes that are combinations of earlier ones (few DOFs)."""
    kept: list[int] = []
    for i in exists:
        trial = motions[:, [*kept, i]]
        if np.linalg.matrix_rank(trial / np.linalg.norm(trial, axis=0), tol=1e-9) > len(kept):
            kept.append(i)
    return kept


def _missed(model: Structure, motion: FloatArray, about: FloatArray, axis: str) -> float:
    """Return the relative part of a rigid-body motion that the model's shapes do not make."""
    if isinstance(model, FEModel):
        return 0.0  # all DOFs are there: any motion is possible, at some cost
    if isinstance(model, ReducedModel):
        full = model.full_dofs
        whole = rigid_motions(full.replace(xyz=full.xyz - about, interpolation=None))
        wanted = whole[:, DIRECTIONS.index(axis)]
        return float(np.linalg.norm(model.T @ motion[:, 0] - wanted) / np.linalg.norm(wanted))
    basis = _real_basis(model)
    left = motion - basis @ _share(basis, motion)
    return float(np.linalg.norm(left) / np.linalg.norm(motion))


def _real_basis(model: Modes) -> FloatArray:
    """Return M-orthonormal real shapes B that span those of the modes.

    Complex modes tell M on their span by how they answer at once: ``B B' = sum Re(phi phi' lambda
    / (i Im lambda))``, with ``phi_r phi_r'`` for rigid-body modes.
    """
    if not np.iscomplexobj(model.phi):
        return np.real(model.basis)
    phi, r = np.asarray(model.phi), model.n_rigid
    rigid, elastic, poles = phi[:, :r].real, phi[:, r:], model.poles[r:]
    Q = np.linalg.qr(np.hstack([rigid, elastic.real, elastic.imag]))[0]
    inner = Q.T @ elastic
    core = np.real((inner * (poles / (1j * poles.imag))) @ inner.T)
    core = core + (Q.T @ rigid) @ (Q.T @ rigid).T
    values, vectors = np.linalg.eigh(0.5 * (core + core.T))
    kept = values > _TRUNCATED * values[-1]
    return np.asarray((Q @ vectors[:, kept]) * np.sqrt(values[kept]))


def _share(basis: FloatArray, motions: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(basis, motions, rcond=None)[0])


def _mass(model: Structure, motions: FloatArray) -> FloatArray:
    if isinstance(model, Modes):
        share = _share(_real_basis(model), motions)
        return np.asarray(share.T @ share)
    return np.asarray(motions.T @ np.asarray(model.M @ motions))


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
