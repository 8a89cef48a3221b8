"""Motions without energy: rigid-body motions by the geometry, mechanisms, and what is grounded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray, IntArray
from ..errors import ModelError
from ..labels import DIRECTIONS, DofSet
from ..sparse.factor import by_rows, dense
from ..sparse.lowest import PRECISION, ROUNDING
from ..tolerances import divisor
from .rigid import bodies, farness, orthonormalised, rigid_motions, unheld

#: times the energy that rounding of the entries allows: free
_MARGIN = 3.0
#: a motion is in the space of others when less than this part of it is left over
_LEFT = 1e-6
#: a singular value below this part of the largest is none
_RANK = 1e-8
#: DOFs of a mechanism that move at least this part of the most moving one
_MOVES = 0.05
#: full matrices beyond this do not fit the memory comfortably
_LARGEST = 6000


@dataclass(frozen=True)
class ZeroEnergy:
    """How the motions of zero energy compare with those the geometry allows."""

    free: tuple[str, ...]
    grounded: tuple[str, ...]
    absent: tuple[str, ...]
    n_rigid: int
    n_bodies: int
    rigid: FloatArray
    every: FloatArray
    length_factor: float | None


def zero_energy(
    K: Any,
    dofs: DofSet,
    *,
    located: bool,
    rounding: float,
    M: Any = None,
    joint_motions: FloatArray | None = None,
) -> ZeroEnergy:
    """Return the rigid-body motions that the geometry allows, and which of them cost no energy.

    Free are those whose energy is below three times the relative `rounding` of the entries of K,
    unless soft springs hold them: judged by `unheld`, as the rigid-body motions of a model are.
    Rotations are left out where coordinates are not known. Pieces that neither K nor M joins have
    their own motions each, and a joined machine those that its joints allow.
    """
    center = dofs.xyz.mean(axis=0) if len(dofs) else np.zeros(3)
    motions = rigid_motions(dofs, center)
    if not located:
        motions = motions[:, :3]
    names = DIRECTIONS[: motions.shape[1]]
    present = np.any(motions != 0, axis=0)
    several = bodies(K, M, dofs)
    possible = motions if joint_motions is None else np.hstack([motions, joint_motions])
    every, basis = _of_bodies(K, M, possible, several, rounding, dofs.xyz)
    left = motions - basis @ (basis.T @ motions)
    free = present & (np.linalg.norm(left, axis=0) < _RANK * np.linalg.norm(motions, axis=0))
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
        every=every,
        length_factor=_length_factor(K, dofs, motions, free),
    )


def _of_bodies(
    K: Any,
    M: Any,
    motions: FloatArray,
    several: list[IntArray],
    rounding: float,
    xyz: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return orthonormal motions of all bodies: all of them, and those that nothing holds."""
    every: list[FloatArray] = []
    free: list[FloatArray] = []
    for rows in several:
        whole = rows.size == motions.shape[0]
        stiffness, mass = (A if whole or A is None else A[rows][:, rows] for A in (K, M))
        own = own_motions(mass, motions[rows])
        found = _energy_free(stiffness, abs(stiffness), own, _MARGIN * rounding)
        written, far = rounding * PRECISION / ROUNDING, farness(xyz[rows])
        mix = unheld(by_rows(stiffness), found, written, far)
        for part, kept in ((every, _independent(own)), (free, _independent(found @ mix))):
            part.append(np.zeros((motions.shape[0], kept.shape[1])))
            part[-1][rows] = kept
    return np.hstack(every), np.hstack(free)


def own_motions(M: Any, motions: FloatArray) -> FloatArray:
    """Return independent motions (n, r) of a body: those of its model where M makes one."""
    independent = _independent(motions[:, np.any(motions != 0, axis=0)])
    if M is not None:
        try:
            found = orthonormalised(M, motions, dependent="drop")
        except ModelError:
            return independent
        if found.shape == independent.shape:
            return found
    return independent


def _energy_free(K: Any, size: Any, motions: FloatArray, allowed: float) -> FloatArray:
    """Return those of some independent motions, or combinations, without energy (n, r)."""
    most = np.einsum("ij,ij->j", np.abs(motions), np.asarray(size @ np.abs(motions)))
    energy = np.abs(np.einsum("ij,ij->j", motions, np.asarray(K @ motions)))
    free = energy < allowed * most
    if free.all():
        return motions
    combined = _free_combinations(K, size, _independent(motions), allowed)
    return combined if combined.shape[1] > np.count_nonzero(free) else motions[:, free]


def _free_combinations(K: Any, size: Any, motions: FloatArray, allowed: float) -> FloatArray:
    """Return an orthonormal basis (n, r) of the combinations of orthonormal motions without energy.

    A hinge leaves one rotation about itself, which is none of those about the middle.
    """
    most = np.einsum("ij,ij->j", np.abs(motions), np.asarray(size @ np.abs(motions)))
    scaled = motions / np.sqrt(divisor(most))
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
    return zero_energy(K, dofs, located=True, rounding=rounding, M=M).rigid


def freed(K: Any, M: Any, dofs: DofSet, digits: int | None) -> FloatArray:
    """Return ``P^T K P``, ``P = I - R R^T M``, which the nearly free motions R cost nothing."""
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


def nonrigid(zero_modes: FloatArray, rigid: FloatArray, extra: int | None = None) -> FloatArray:
    """Return the part of a space that is not rigid-body motion, as `extra` orthonormal columns."""
    extra = zero_modes.shape[1] - rigid.shape[1] if extra is None else extra
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
        # rounding of forces that cancel between stiff elements
        if rest < 1e-6 * np.linalg.norm(by_turning) and factor > 0:
            factors.append(factor)
    if not factors or np.ptp(factors) > 1e-3 * factors[0] or abs(factors[0] - 1) < 1e-3:
        return None
    return float(np.mean(factors))
