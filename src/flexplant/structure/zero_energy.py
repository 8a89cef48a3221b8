"""Motions without energy: rigid-body motions by the geometry, mechanisms, and what is grounded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..labels import DIRECTIONS, DofSet
from ..sparse.factor import dense
from ..sparse.lowest import ROUNDING
from ..values import FloatArray, IntArray
from .components import bodies
from .rigid import orthonormalised, rigid_motions

#: times the energy that rounding of the entries allows: free
_MARGIN = 3.0
#: a singular value below this part of the largest is none
_RANK = 1e-8
#: DOFs of a mechanism that move at least this part of the most moving one
_MOVES = 0.05
#: full matrices beyond this do not fit the memory comfortably
_LARGEST = 6000


@dataclass(frozen=True)
class ZeroEnergy:
    """How the motions of zero energy compare with those the geometry allows.

    Attributes
    ----------
    free : tuple of str
        Which of x, y, z, rx, ry, rz (about the centre) cost no energy.
    grounded : tuple of str
        Which do.
    absent : tuple of str
        Which the DOFs cannot make.
    n_rigid : int
        Independent rigid-body motions without energy, combinations and those of all bodies
        included.
    n_bodies : int
        Pieces that nothing joins, each with motions of its own.
    rigid : (n, n_rigid) array
        A basis of them.
    mechanisms : (n, m) array
        Zero-energy motions beyond these.
    length_factor : float or None
        By which the coordinates would have to be multiplied to fit K, when another unit explains
        why rotations cost energy.
    """

    free: tuple[str, ...]
    grounded: tuple[str, ...]
    absent: tuple[str, ...]
    n_rigid: int
    n_bodies: int
    rigid: FloatArray
    mechanisms: FloatArray
    length_factor: float | None


def zero_energy(
    K: Any,
    dofs: DofSet,
    zero_modes: FloatArray,
    *,
    located: bool,
    rounding: float,
    M: Any = None,
) -> ZeroEnergy:
    """Return the rigid-body motions of the geometry and the mechanisms among `zero_modes` (n, q).

    Free are those whose energy is below three times the relative `rounding` of the entries of K.
    Rotations are left out where coordinates are not known. Pieces that neither K nor M joins have
    their own motions each.
    """
    center = dofs.xyz.mean(axis=0) if len(dofs) else np.zeros(3)
    motions = rigid_motions(dofs.replace(xyz=dofs.xyz - center, interpolation=None))
    if not located:
        motions = motions[:, :3]
    names = DIRECTIONS[: motions.shape[1]]
    present = np.any(motions != 0, axis=0)
    size: Any = abs(K)
    # by energy, not by force: the last digits of coordinates change it in second order only
    most = np.einsum("ij,ij->j", np.abs(motions), np.asarray(size @ np.abs(motions)))
    energy = np.abs(np.einsum("ij,ij->j", motions, np.asarray(K @ motions)))
    free = (energy < _MARGIN * rounding * most) & present
    several = bodies(K, M, dofs)
    if len(several) == 1:
        basis = _free_motions(K, size, motions, _MARGIN * rounding)
    else:
        parts = []
        for rows in several:
            stiffness, sizes = (A[rows][:, rows] for A in (K, size))
            found = _free_motions(stiffness, sizes, motions[rows], _MARGIN * rounding)
            parts.append(np.zeros((len(dofs), found.shape[1])))
            parts[-1][rows] = found
        basis = np.hstack(parts)
    return ZeroEnergy(
        free=tuple(name for name, is_free in zip(names, free, strict=True) if is_free),
        grounded=tuple(
            name
            for name, is_free, there in zip(names, free, present, strict=True)
            if there and not is_free
        ),
        absent=tuple(name for name, there in zip(names, present, strict=True) if not there),
        n_rigid=basis.shape[1],
        n_bodies=len(several),
        rigid=basis,
        mechanisms=beyond(zero_modes, basis),
        length_factor=_length_factor(K, dofs, motions, free),
    )


def _free_motions(K: Any, size: Any, motions: FloatArray, allowed: float) -> FloatArray:
    """Return an orthonormal basis (n, r) of the motions, or combinations, without energy."""
    motions = motions[:, np.any(motions != 0, axis=0)]
    most = np.einsum("ij,ij->j", np.abs(motions), np.asarray(size @ np.abs(motions)))
    energy = np.abs(np.einsum("ij,ij->j", motions, np.asarray(K @ motions)))
    free = energy < allowed * most
    basis = _independent(motions[:, free])
    if free.all():
        return basis
    combined = _free_combinations(K, size, _independent(motions), allowed)
    return combined if combined.shape[1] > basis.shape[1] else basis


def _free_combinations(K: Any, size: Any, motions: FloatArray, allowed: float) -> FloatArray:
    """Return an orthonormal basis (n, r) of the combinations of orthonormal motions without energy.

    A hinge leaves one rotation about itself, which is none of those about the middle.
    """
    most = np.einsum("ij,ij->j", np.abs(motions), np.asarray(size @ np.abs(motions)))
    scaled = motions / np.sqrt(np.where(most > 0, most, 1.0))
    values, vectors = la.eigh(scaled.T @ np.asarray(K @ scaled))
    return _independent(scaled @ vectors[:, np.abs(values) < allowed])


def _independent(motions: FloatArray) -> FloatArray:
    """Return an orthonormal basis (n, r) of some motions."""
    if not motions.shape[1]:
        return motions
    lengths = np.linalg.norm(motions, axis=0)
    spread, sizes, _ = la.svd(motions / lengths, full_matrices=False)
    return np.asarray(spread[:, sizes > _RANK * sizes[0]], dtype=np.float64)


def nearly_free(K: Any, M: Any, dofs: DofSet, digits: int | None) -> FloatArray:
    """Return the rigid-body motions of the geometry that cost no more energy than rounding."""
    rounding = ROUNDING if digits is None else max(ROUNDING, 10.0**-digits)
    none = np.zeros((len(dofs), 0))
    return zero_energy(K, dofs, none, located=True, rounding=rounding, M=M).rigid


def freed(K: Any, M: Any, dofs: DofSet, digits: int | None) -> FloatArray:
    """Return ``P^T K P``, ``P = I - R R^T M``, which the nearly free motions R cost nothing.

    Raises
    ------
    ModelError
        When no motion is nearly free, or the full matrix would be too large.
    """
    if len(dofs) > _LARGEST:
        raise ModelError(
            f"freeing fills K: too large for {len(dofs)} DOFs (limit {_LARGEST}). Export in binary."
        )
    motions = nearly_free(K, M, dofs, digits)
    if not motions.shape[1]:
        raise ModelError(
            "no rigid-body motion of the geometry is free but for rounding: the structure is held, "
            "or the coordinates are wrong. check(...) shows which."
        )
    R = orthonormalised(M, motions)
    loaded = np.asarray(M @ R)
    part = np.asarray(K @ R)
    full = dense(K) - part @ loaded.T
    full = full - loaded @ (R.T @ full)
    # once more, so that what is left of K R is rounding of the result, not of the first pass
    full = full - (full @ R) @ loaded.T
    return np.asarray(0.5 * (full + full.T), dtype=np.float64)


def most_moved(motion: FloatArray) -> IntArray:
    """Return the DOFs (from 0, at most 24) that move most in a motion (n,), the first first."""
    size = np.abs(motion)
    order = np.argsort(-size, kind="stable")[:24]
    return np.asarray(order[size[order] >= _MOVES * size[order[0]]], dtype=np.int64)


def beyond(zero_modes: FloatArray, rigid: FloatArray) -> FloatArray:
    """Return the part of a space that is not rigid-body motion, as orthonormal columns."""
    extra = zero_modes.shape[1] - rigid.shape[1]
    if extra <= 0:
        return np.zeros((zero_modes.shape[0], 0))
    space = la.qr(zero_modes, mode="economic")[0]
    left = la.svd(space - rigid @ (rigid.T @ space), full_matrices=False)[0]
    return np.asarray(left[:, :extra], dtype=np.float64)


def _length_factor(K: Any, dofs: DofSet, motions: FloatArray, free: Any) -> float | None:
    """Return the factor on the coordinates with which rotations would cost no energy, if any."""
    turning = dofs.kinds >= 3
    if motions.shape[1] < 6 or not turning.any() or turning.all():
        return None
    factors = []
    for k in np.flatnonzero(~free[3:] & np.any(motions[:, 3:] != 0, axis=0)) + 3:
        moved = np.where(turning, 0.0, motions[:, k])
        turned = np.where(turning, motions[:, k], 0.0)
        by_moving, by_turning = np.asarray(K @ moved), np.asarray(K @ turned)
        square = float(by_moving @ by_moving)
        if not square:
            continue
        factor = -float(by_moving @ by_turning) / square
        rest = np.linalg.norm(factor * by_moving + by_turning)
        if rest < 1e-6 * np.linalg.norm(by_turning) and factor > 0:
            factors.append(factor)
    if not factors or np.ptp(factors) > 1e-3 * factors[0] or abs(factors[0] - 1) < 1e-3:
        return None
    return float(np.mean(factors))
