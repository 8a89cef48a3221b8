"""Motions without energy: rigid-body motions, mechanisms, grounded motions, effects of rounding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray, divisor
from ..errors import ModelError, SolverError, attempted
from ..labels import DIRECTIONS, DofSet
from ..sparse.factor import LARGEST_FULL
from ..sparse.lowest import Lowest, lowest_modes
from ..sparse.symmetric import ZERO, dense, diagonal, orthonormalised
from ..tolerances import FOUR_DIGITS, NEGLIGIBLE, NULL, PRECISION, SAME
from .rigid import bodies, farness, force_free, free_motions, rigid_motions

#: motion of a DOF of a mechanism, relative to the largest one, above which it is listed
_MOVES = 0.05


@dataclass(frozen=True)
class ZeroEnergy:
    """Comparison of zero-energy motions with those that the geometry allows."""

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
    """Return the rigid-body motions that the geometry allows, and which of them cost no energy."""
    # judged as the rigid-body motions of a model are, with the relative `rounding` of K's entries.
    # Rotations are left out where coordinates are not known. Pieces that neither K nor M joins have
    # their own motions each, and a joined machine those that its joints allow
    center = dofs.xyz.mean(axis=0) if len(dofs) else np.zeros(3)
    motions = rigid_motions(dofs, center)
    if not located:
        motions = motions[:, :3]
    names = DIRECTIONS[: motions.shape[1]]
    present = np.any(motions != 0, axis=0)
    several = bodies(K, M, dofs)
    # joint motions first: what is made orthogonal to them does not mix with their rounding
    possible = motions if joint_motions is None else np.hstack([joint_motions, motions])
    every, basis = _of_bodies(K, M, possible, several, rounding, dofs.xyz)
    left = motions - basis @ (basis.T @ motions)
    free = present & (np.linalg.norm(left, axis=0) < NEGLIGIBLE * np.linalg.norm(motions, axis=0))
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
    K: Any, M: Any, motions: FloatArray, several: list[IntArray], rounding: float, xyz: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return orthonormal motions of all bodies: all of them, and those that nothing holds."""
    every: list[FloatArray] = []
    free: list[FloatArray] = []
    for rows in several:
        whole = rows.size == motions.shape[0]
        stiffness, mass = (A if whole or A is None else A[rows][:, rows] for A in (K, M))
        own = own_motions(mass, motions[rows])
        written, far = rounding * PRECISION / ZERO, farness(xyz[rows])
        found = free_motions(_metric(stiffness), stiffness, own, far, written)
        for part, kept in ((every, _independent(own)), (free, _independent(found))):
            part.append(np.zeros((motions.shape[0], kept.shape[1])))
            part[-1][rows] = kept
    return np.hstack(every), np.hstack(free)


def _metric(K: Any) -> Any:
    """Return a mass (n, n) that normalises motions of which only the span matters: M or None."""
    return sp.diags_array(divisor(np.abs(diagonal(K))), format="csc")


def own_motions(M: Any, motions: FloatArray) -> FloatArray:
    """Return independent motions (n, r) of a body, from its model where M allows one."""
    independent = _independent(motions[:, np.any(motions != 0, axis=0)])
    if M is not None:
        try:
            found = orthonormalised(M, motions, dependent="drop")
        except ModelError:
            return independent
        if found.shape == independent.shape:
            return found
    return independent


def _independent(motions: FloatArray) -> FloatArray:
    """Return an orthonormal basis (n, r) of some motions."""
    if not motions.shape[1]:
        return motions
    lengths = np.linalg.norm(motions, axis=0)
    spread, sizes, _ = la.svd(motions / lengths, full_matrices=False)
    return np.asarray(spread[:, sizes > SAME * sizes[0]], dtype=np.float64)


def nearly_free(K: Any, M: Any, dofs: DofSet, digits: int | None) -> FloatArray:
    """Return the rigid-body motions of the geometry whose energy is rounding."""
    rounding = ZERO if digits is None else max(ZERO, 10.0**-digits)
    return zero_energy(K, dofs, located=True, rounding=rounding, M=M).rigid


def freed(K: Any, M: Any, dofs: DofSet, digits: int | None) -> FloatArray:
    """Return ``P^T K P``, ``P = I - R R^T M``, which the nearly free motions R cost nothing."""
    if len(dofs) > LARGEST_FULL:
        raise ModelError(
            f"freeing fills K: too large for {len(dofs)} DOFs (limit {LARGEST_FULL}). "
            "Export in binary."
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
    # again, so that the remaining K R is rounding of the result, not of the first pass
    full = full - (full @ R) @ loaded.T
    return np.asarray(0.5 * (full + full.T), dtype=np.float64)


def most_moved(motion: FloatArray) -> IntArray:
    """Return the DOFs (from 0, at most 24) that move most in a motion (n,), the first first."""
    size = np.abs(motion)
    order = np.argsort(-size, kind="stable")[:24]
    return np.asarray(order[size[order] >= _MOVES * size[order[0]]], dtype=np.int64)


def nonrigid(zero_modes: FloatArray, rigid: FloatArray) -> FloatArray:
    """Return the part of a space that is not rigid-body motion, as orthonormal columns."""
    extra = zero_modes.shape[1] - rigid.shape[1]
    if extra <= 0:
        return np.zeros((zero_modes.shape[0], 0))
    space = la.qr(zero_modes, mode="economic")[0]
    left = la.svd(space - rigid @ (rigid.T @ space), full_matrices=False)[0]
    return np.asarray(left[:, :extra], dtype=np.float64)


def _length_factor(K: Any, dofs: DofSet, motions: FloatArray, free: Any) -> float | None:
    """Return the factor on the coordinates that would make rotations free of energy, if any."""
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
    # a single factor that is not 1
    if not factors or np.ptp(factors) > 1e-3 * factors[0] or abs(factors[0] - 1) < 1e-3:
        return None
    return float(np.mean(factors))


#: least number of loaded rows for a median of their forces
_ROWS = 12


def shown_digits(K: Any, dofs: DofSet) -> int | None:
    """Return the number of correct digits of the entries of K, None where it is above 11."""
    # rigid translations t cost no energy, so that `K t` is rounding: in every row, of either sign.
    # Springs to ground act in few rows, or with the motion. Errors uniform up to a relative d leave
    # `|K t|_i = 0.39 d (sum_j K_ij^2 t_j^2)^(1/2)` in the median
    stiffness: Any = sp.csr_array(K)
    size = stiffness.multiply(stiffness)
    worst = 0.0
    for direction in range(3):
        motion = (dofs.kinds == direction).astype(np.float64)
        force = stiffness @ motion
        scale = np.sqrt(size @ motion)
        rows = np.flatnonzero(scale > 0)
        if rows.size < _ROWS:
            continue
        error = float(np.median(np.abs(force[rows]) / scale[rows])) / 0.39
        work = np.abs(motion * force)
        aligned = abs(float(motion @ force)) > 0.5 * float(work.sum())
        if error < FOUR_DIGITS and not aligned:
            worst = max(worst, error)
    return round(-float(np.log10(worst))) if worst > NULL else None


def loss(found: Lowest, digits: int) -> float | None:
    """Return the relative error of the first elastic eigenvalue that `digits` digits allow."""
    # `10^-digits |phi|^T |K| |phi| / lambda`: effect of rounding each entry of K
    if found.n_zero >= found.values.size:
        return None
    first = found.n_zero
    return float(10.0**-digits * found.spread[first] / abs(found.values[first]))


def endangered(K: Any, M: Any, digits: int) -> str | None:
    """Return a text when the digits of K are too few for the first elastic eigenvalue."""
    if digits > np.finfo(np.float64).precision:  # double precision
        return None
    with attempted("the check of the digits of K by its lowest modes", SolverError):
        found = lowest_modes(K, M, 8, rounding=10.0**-digits)
        return verdict(loss(found, digits), digits)
    return None


def verdict(error: float | None, digits: int) -> str | None:
    """Return a text on an error of the first elastic eigenvalue, None when it is harmless."""
    if error is None or error <= FOUR_DIGITS:
        return None
    percent = f"up to {100 * error:.2g} %" if error < 1 else "wholly"
    return (
        f"K was written with {digits} digits, which may change the first elastic eigenvalue "
        f"{percent}: their rounding times the norm of K exceeds its softness. Export in double "
        "precision: in binary (OP4, HDF5, npz), or with 16 digits."
    )


def held_by_rounding(
    K: Any, M: Any, dofs: DofSet, digits: int, found: FloatArray | None = None
) -> str | None:
    """Return a text when only rounding of the entries of K holds rigid-body motions."""
    nearly = nearly_free(K, M, dofs, digits).shape[1]
    metric = _metric(K)
    if found is not None and force_free(metric, K, orthonormalised(metric, found)):
        nearly -= found.shape[1]
    if nearly <= 0:
        return None
    return (
        f"{nearly} of its rigid-body motions are held by nothing but the rounding of K's entries "
        f"to {digits} digits, and modes at or below 0 would follow. Export in double precision, or "
        "free them: FEMatrices(K, M, dofs=dofs).model(free=True), read_model(..., free=True)."
    )
