"""Rigid-body motions from the geometry of the degrees of freedom."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..errors import ModelError, SolverError
from ..labels import DofSet
from ..values import FloatArray, Matrix
from .lowest import ROUNDING, definite_solver

#: ||K r|| below this part of || |K| |r| || is rounding: the motion r costs no energy
_ENERGY_TOLERANCE = 1e-10
#: of a K that was never written as text
_ROUNDED = 1e-14
#: part of all DOFs: forces at fewer are of springs, not of rounding
_FEW = 0.02
#: the same for motions that coordinates of few digits keep from being free: worth a closer look
_NEARLY = 1e-2
#: largest force of such a motion at any DOF, of the largest that its parts make anywhere
_EVERYWHERE = 3e-4
#: force of a motion at 0, of the largest eigenvalue of the model, that its modes are checked for
_RESIDUAL = 1e-12
#: steps of inverse iteration from the geometry's motions to the null vectors of K
_STEPS = 4
#: part of a motion that may be lost on this way
_ASIDE = 1e-3


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
    (a hinge, say) keep the combinations of the six motions that cost no energy. Where coordinates
    have few digits, rotations are the null vectors of K next to theirs.
    """
    # independent ones only: some are absent, and with few DOFs some of the six coincide
    motions = orthonormalised(M, rigid_motions(dofs), dependent="drop")
    # K and |K| |r|, row by row: forces of rounding size say that no energy is stored
    size_of_K: Any = abs(K)
    sizes = np.asarray(size_of_K @ np.abs(motions))
    scale = np.linalg.norm(sizes, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    force = np.asarray(K @ motions) / scale
    tolerance = _tolerance(K, force)
    free = np.linalg.norm(force, axis=0) < tolerance
    if np.all(free):
        return motions
    # of the small triangle: the left factor of all DOFs would be a full square matrix
    _, found, right = la.svd(la.qr(force, mode="economic")[1])
    values = np.zeros(scale.size)
    values[: found.size] = found
    null = right[values < tolerance].T
    basis = motions[:, free]
    if null.shape[1] > basis.shape[1]:
        basis = orthonormalised(M, motions @ (null / scale[:, None]))
    near = right[(values >= tolerance) & (values < _NEARLY)].T
    if not near.shape[1]:
        return basis
    nearly = _everywhere_small(K, size_of_K, motions @ (near / scale[:, None]))
    return _null_vectors(M, K, size_of_K, motions, basis, nearly) if nearly.shape[1] else basis


def _tolerance(K: Matrix, force: FloatArray) -> float:
    """Return the size of relative forces (n, r) that pass for rounding.

    Rounding of K leaves forces everywhere; those of soft springs are at a few DOFs only, and are
    looked at closer however small they are.
    """
    size = np.linalg.norm(force, axis=0)
    small = (size > _ROUNDED) & (size < _ENERGY_TOLERANCE)
    if not small.any():
        return _ENERGY_TOLERANCE
    entries: Any = K.diagonal()
    weight = np.where(entries > 0, entries, np.inf)
    squares = force[:, small] ** 2 / weight[:, None]
    # the number of rows that share a force: of m equal ones it is m
    rows = squares.sum(axis=0) ** 2 / np.maximum((squares**2).sum(axis=0), np.finfo(float).tiny)
    return _ROUNDED if rows.min() < _FEW * force.shape[0] else _ENERGY_TOLERANCE


def force_free(M: Matrix, K: Matrix, motions: FloatArray) -> bool:
    """Return whether M-orthonormal motions pass for modes at 0 of (K, M), to rounding."""
    root = np.sqrt(M.diagonal())[:, None]
    force = np.linalg.norm(np.asarray(K @ motions) / root, axis=0)
    return bool(np.all(force <= _RESIDUAL * float(np.max(K.diagonal() / M.diagonal()))))


def _everywhere_small(K: Matrix, size_of_K: Any, motions: FloatArray) -> FloatArray:
    """Return those of some motions that meet no large force at any DOF: nothing grounds them."""
    entries: Any = K.diagonal()
    weight = 1 / np.sqrt(np.where(entries > 0, entries, 1.0))[:, None]
    force = np.abs(weight * np.asarray(K @ motions)).max(axis=0)
    most = (weight * np.asarray(size_of_K @ np.abs(motions))).max(axis=0)
    return motions[:, force < _EVERYWHERE * most]


def _null_vectors(
    M: Matrix,
    K: Matrix,
    size_of_K: Any,
    motions: FloatArray,
    basis: FloatArray,
    nearly: FloatArray,
) -> FloatArray:
    """Return a basis and the null vectors of K next to nearly free motions, if there are such.

    By inverse iteration, ``(K + s M) x' = s M x``: what the last digits of coordinates add are
    elastic modes, which shrink by s / (lambda + s) each time, and motions without energy stay. A
    motion that something holds, however softly, keeps its energy and is none.
    """
    start = orthonormalised(M, np.hstack([basis, nearly]), dependent="drop")
    spread = float(np.einsum("ij,ij->j", np.abs(start), size_of_K @ np.abs(start)).max())
    shift = 30 * ROUNDING * spread
    try:
        solve = definite_solver(K, M, shift)
        found = start
        for _ in range(_STEPS):
            found = orthonormalised(M, np.asarray(solve(np.asarray(M @ found))))
    except SolverError:
        return basis  # K is indefinite: the solver of the modes says so
    energy = np.asarray(found.T @ np.asarray(K @ found))
    values, mix = la.eigh(0.5 * (energy + energy.T))
    null = found @ mix[:, np.abs(values) < ROUNDING * spread]
    # the geometry's own motions, seen in the null space: what turns stays a turn about its axis
    for candidates in (motions, nearly):
        seen = null.T @ np.asarray(M @ candidates)
        size = np.sqrt(np.einsum("ij,ij->j", candidates, np.asarray(M @ candidates)))
        kept = np.linalg.norm(seen, axis=0) > (1 - _ASIDE) * size
        several = np.hstack([*([basis] if candidates is nearly else []), null @ seen[:, kept]])
        whole = orthonormalised(M, several, dependent="drop")
        if whole.shape[1] >= null.shape[1]:
            break
    return whole


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
