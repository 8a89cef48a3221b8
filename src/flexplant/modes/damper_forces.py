"""The forces of dampers at some places of a structure, apart from the damping of its material."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..sparse.factor import diagonal
from ..structure import FEModel
from ..values import FloatArray

#: DOFs at which dampers act, at most, and their forces, at most: more of them are a material's
_TOUCHED, _FORCES = 600, 200
#: relative: a damper below this is none
_NONE = 1e-12


def damper_forces(model: FEModel) -> FloatArray:
    """Return orthonormal forces (n, m) that span those of dampers.

    None, (n, 0), where D is a multiple of K and M, or at so many DOFs that it is a material's.
    """
    none = np.zeros((model.n_dof, 0))
    if model.D is None or is_rayleigh(model):
        return none
    rows = sp.csr_array(model.D)
    touched = np.flatnonzero(np.diff(rows.indptr))
    if touched.size > _TOUCHED:
        return none
    values, vectors = la.eigh(rows[touched][:, touched].toarray())
    kept = np.flatnonzero(values > _NONE * values.max(initial=0.0))
    if kept.size > _FORCES:
        return none
    forces = np.zeros((model.n_dof, kept.size))
    forces[touched] = vectors[:, kept]
    return forces


def is_rayleigh(model: FEModel) -> bool:
    """Return whether ``D = alpha M + beta K``, seen on one vector."""
    x = np.random.default_rng(0).standard_normal(model.n_dof) / np.sqrt(diagonal(model.K) + 1e-300)
    sides: Any = [np.asarray(part @ x) for part in (model.M, model.K)]
    basis = np.column_stack([side / np.linalg.norm(side) for side in sides])
    damped = np.asarray(model.D @ x)  # type: ignore[operator]
    left = damped - basis @ np.linalg.lstsq(basis, damped)[0]
    return bool(np.linalg.norm(left) <= 1e-12 * np.linalg.norm(damped))
