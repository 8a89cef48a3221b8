"""Rigid-body motions from the geometry of the degrees of freedom."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..labels import DofSet
from ..values import FloatArray, Matrix

#: ||K r|| below this part of || |K| |r| || is rounding: the motion r costs no energy
_ENERGY_TOLERANCE = 1e-10


def rigid_motions(dofs: DofSet) -> FloatArray:
    """Return the six rigid-body motions (n, 6) of the DOFs: x, y, z, rx, ry, rz.

    Rotations are small ones about the origin: rx moves a point by ``y rx`` in z and ``-z rx`` in y,
    hence a plate's rx = dz/dy and ry = -dz/dx.
    """
    n = len(dofs)
    kind = dofs.kinds
    motions = np.zeros((n, 6))
    motions[np.arange(n), kind] = 1.0
    for axis in range(3):
        # a turn about axis moves the next one by minus the coordinate after it, and so on round
        after, before = (axis + 1) % 3, (axis + 2) % 3
        for moved, along, sign in ((after, before, -1.0), (before, after, 1.0)):
            rows = kind == moved
            motions[rows, 3 + axis] = sign * dofs.xyz[rows, along]
    return motions


def rigid_body_basis(M: Matrix, K: Matrix, dofs: DofSet) -> FloatArray:
    """Return the M-orthonormal rigid-body vectors (n, r) of a structure, ``K R = 0``.

    They come from the coordinates, not from an eigenvalue solver, so that they are exact.
    Translations come first, then rotations about the centre of gravity. Partly held structures
    (a hinge, say) keep the combinations of the six motions that cost no energy.
    """
    # independent ones only: some are absent, and with few DOFs some of the six coincide
    motions = orthonormalised(M, rigid_motions(dofs), dependent="drop")
    # K and |K| |r|, row by row: forces of rounding size say that no energy is stored
    size_of_K: Any = abs(K)
    scale = np.linalg.norm(size_of_K @ np.abs(motions), axis=0)
    force = np.asarray(K @ motions) / np.where(scale > 0, scale, 1.0)
    free = np.linalg.norm(force, axis=0) < _ENERGY_TOLERANCE
    if np.all(free):
        return motions
    # of the small triangle: the left factor of all DOFs would be a full square matrix
    _, found, right = la.svd(la.qr(force, mode="economic")[1])
    values = np.zeros(scale.size)
    values[: found.size] = found
    null = right[values < _ENERGY_TOLERANCE].T
    if null.shape[1] > np.count_nonzero(free):
        return orthonormalised(M, motions @ (null / np.where(scale > 0, scale, 1.0)[:, None]))
    return motions[:, free]


def orthonormalised(M: Matrix, basis: FloatArray, *, dependent: str = "raise") -> FloatArray:
    """Return the M-orthonormal vectors of a basis, in order, by Gram-Schmidt done twice.

    Raises
    ------
    ModelError
        When a vector depends on those before it, unless `dependent` is "drop"; when M is not
        positive definite.
    """
    done = np.zeros((basis.shape[0], 0))
    loaded = np.zeros((basis.shape[0], 0))  # M done: each vector meets M as few times as possible
    for i in range(basis.shape[1]):
        vector = basis[:, i]
        length = _length(M, vector) if vector.any() else 0.0
        if length:
            for _ in range(2):
                vector = vector - done @ (loaded.T @ vector)
        left = _length(M, vector) if length else 0.0
        if left <= 1e-9 * length:
            if dependent == "drop":
                continue
            raise ModelError(
                f"vector {i + 1} of the rigid-body basis depends on those before it "
                f"(M-norm {left:.3g} of {length:.3g} is left): give independent vectors."
            )
        vector = vector / left
        # once more, now that rounding of the normalisation shows
        vector = vector - done @ (loaded.T @ vector)
        forces = np.asarray(M @ vector)
        size = np.sqrt(vector @ forces)
        done = np.column_stack([done, vector / size])
        loaded = np.column_stack([loaded, forces / size])
    return done


def _length(M: Matrix, vector: FloatArray) -> float:
    square = float(vector @ np.asarray(M @ vector))
    if square < 0:
        raise ModelError(
            f"M is not positive definite: a rigid-body motion has the inertia {square:.3g}. Look "
            "for a sign, or for a negative added mass that is larger than what it is added to."
        )
    return float(np.sqrt(square))
