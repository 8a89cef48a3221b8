"""Total mass, centre of gravity and inertia, from a mass matrix and the coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..labels import DofSet
from ..values import FloatArray
from .rigid import rigid_motions


@dataclass(frozen=True)
class RigidMass:
    """What M says of the body as a whole; NaN where the DOFs do not determine it.

    Attributes
    ----------
    mass : (3,) array [kg]
        Inertia against translation in x, y, z.
    center : (3,) array [m]
        Centre of gravity.
    inertia : (3, 3) array [kg m^2]
        About the centre of gravity.
    """

    mass: FloatArray
    center: FloatArray
    inertia: FloatArray


def rigid_mass(M: Any, dofs: DofSet) -> RigidMass:
    """Return mass, centre of gravity and inertia: ``R^T M R`` of the six rigid-body motions R.

    With all six directions it is ``[[m I, -m [c]x], [m [c]x, J]]``; a flat model that moves in z
    only determines m, two coordinates of c, and the inertia about two axes.
    """
    motions = rigid_motions(dofs)
    whole = motions.T @ np.asarray(M @ motions)
    there = np.array([np.any(dofs.kinds == kind) for kind in range(3)])
    mass = np.where(there, np.diag(whole)[:3], np.nan)
    center = np.full(3, np.nan)
    # e_d . (e_k x c) m_d is the coupling of translation d with rotation k: linear in c
    rows, sides = [], []
    for d in np.flatnonzero(there):
        for k in range(3):
            rows.append(mass[d] * np.cross(np.eye(3)[d], np.eye(3)[k]))
            sides.append(whole[d, 3 + k])
    inertia = np.full((3, 3), np.nan)
    if rows:
        system = np.array(rows)
        known = np.abs(system).max(axis=0) > 0
        found = np.linalg.lstsq(system[:, known], np.array(sides), rcond=None)[0]
        center[known] = found
        about = np.where(known, center, 0.0)
        # shifted to the centre of gravity, motion by motion: exact for any mass matrix
        shift = np.eye(6)
        for k in range(3):
            shift[:3, 3 + k] = -np.cross(np.eye(3)[k], about)
        turned = motions @ shift
        inertia = (turned.T @ np.asarray(M @ turned))[3:, 3:]
        moves = np.array([np.any(turned[:, 3 + k] != 0) for k in range(3)])
        inertia[~moves] = np.nan
        inertia[:, ~moves] = np.nan
    return RigidMass(mass, center, inertia)
