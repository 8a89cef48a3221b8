"""The matrix D of a damping law."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..errors import ModelError
from ..labels import DofSet
from ..sparse.factor import dense
from ..values import FloatArray, Matrix
from .damping import Damping, ModalDamping, Rayleigh
from .eigen import elastic_modes

#: modal damping over all modes fills D; beyond this it would not fit the memory comfortably
_LIMIT = 5000


def damping_matrix(
    stiffness: Matrix,
    mass: Matrix,
    rigid: FloatArray,
    damping: Damping,
    motions: Callable[[], FloatArray],
    dofs: DofSet,
) -> FloatArray:
    """Return the full D of a damping law, ``M Phi 2 Z Omega Phi^T M`` over all modes.

    Parameters
    ----------
    stiffness, mass : (n, n) matrix
        K and M.
    rigid : (n, r) array
        M-orthonormal rigid-body motions.
    damping : Damping
        The law.
    motions : function
        Gives the rigid-body motions of every piece, whether held or not.
    dofs : DofSet
        The n rows.

    Raises
    ------
    ModelError
        When n is above 5000: D would not fit the memory comfortably.
    """
    n = rigid.shape[0]
    if n > _LIMIT:
        raise ModelError(
            f"this damping gives a full D, too large for {n} DOFs (limit "
            f"{_LIMIT}). Pass it to solve_modes(model, damping=...) instead."
        )
    M, K = dense(mass), dense(stiffness)
    loaded = M @ rigid
    if isinstance(damping, Rayleigh):
        D = damping.alpha * (M - loaded @ loaded.T) + damping.beta * K
        return np.asarray(0.5 * (D + D.T), dtype=np.float64)
    elastic, phi = elastic_modes(M, K, rigid, motions=motions)
    r = rigid.shape[1]
    every = np.hstack([rigid, phi])
    zeta = damping.ratios(np.concatenate([np.zeros(r), elastic]), every, K, dofs)[r:]
    forces = M @ phi
    D = (forces * (2 * zeta * np.abs(elastic))) @ forces.T
    if isinstance(damping, ModalDamping) and damping.rigid:
        D = D + damping.rigid * (loaded @ loaded.T)
    return np.asarray(0.5 * (D + D.T), dtype=np.float64)
