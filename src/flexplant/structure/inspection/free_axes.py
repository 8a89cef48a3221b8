"""The axes of rigid-body motions that supports leave free."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ...labels import DIRECTIONS, DofSet
from ...values import FloatArray
from ..rigid import rigid_motions
from ..zero_energy import ZeroEnergy

#: relative: a rotation smaller than this is a translation, a coordinate smaller than it 0
_SMALL = 1e-6


def free_axes(motions: ZeroEnergy, dofs: DofSet) -> list[str]:
    """Return in words the free motions that are combinations of x to rz, one by one.

    A motion ``t + w x (r - r_0)`` turns about the axis along w through ``r_0 + w x t / |w|^2``, and
    moves along it by ``t . w / |w|`` per radian.
    """
    center = dofs.xyz.mean(axis=0)
    every = rigid_motions(dofs.replace(xyz=dofs.xyz - center, interpolation=None))
    size = float(np.abs(dofs.xyz - center).max()) or 1.0
    unit = np.array([1.0, 1.0, 1.0, 1 / size, 1 / size, 1 / size])
    made = la.lstsq(every * unit, motions.rigid)[0]
    made[[name in motions.free for name in DIRECTIONS]] = 0.0
    basis, sizes, _ = la.svd(made, full_matrices=False)
    basis = basis[:, sizes > _SMALL * sizes.max(initial=0.0)]
    # echelon form: each motion has one coordinate that the others do not have
    _, _, pivots = la.qr(basis.T, pivoting=True)
    basis = basis @ la.inv(basis[pivots[: basis.shape[1]]])
    return [_axis(column * unit, center, size) for column in basis.T]


def _axis(motion: FloatArray, center: FloatArray, size: float) -> str:
    move, turn = motion[:3], motion[3:]
    angle, length = float(np.linalg.norm(turn)), float(np.linalg.norm(move))
    if angle * size <= _SMALL * length:
        return f"to move along {_vector(move / length)}"
    along = turn / angle
    if along[np.argmax(np.abs(along))] < 0:
        along = -along
    point = center + np.cross(turn, move) / angle**2
    point = np.where(np.abs(point) > _SMALL * size, point, 0.0)
    pitch = float(move @ turn) / angle**2
    screw = f", moving {pitch:.3g} m per radian" if abs(pitch) > _SMALL * size else ""
    return f"to turn about the axis through {_vector(point)} m along {_vector(along)}{screw}"


def _vector(values: FloatArray) -> str:
    shown = np.where(np.abs(values) > _SMALL, values, 0.0)
    return f"({', '.join(f'{value:.4g}' for value in shown)})"
