"""Numbers behind the report on a model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray, divisor
from ..errors import ModelError, SolverError
from ..labels import DIRECTIONS
from ..sparse.factor import is_positive_definite
from ..sparse.lowest import MOST_ZEROS, Lowest, lowest_modes
from ..sparse.symmetric import EXTRA_VALUES, ZERO, by_rows, diagonal, orthonormalised, unit_diagonal
from ..tolerances import NEGLIGIBLE, PRECISION, RESIDUAL, SAME
from .definite import are_rigid, are_swapped, unstable_stiffness
from .matrices import FEMatrices
from .model import FEModel
from .rigid import RigidMass, farness, pieces, rigid_mass, rigid_motions, unheld
from .singular_mass import empty_rows, massless_dofs, null_motions
from .zero_energy_motions import ZeroEnergy, loss, nonrigid, own_motions, shown_digits, zero_energy


@dataclass(frozen=True)
class Facts:
    """All numbers that `check` reports."""

    given: FEMatrices
    skew: dict[str, tuple[float, int, int]]
    massless: IntArray
    stiffless: IntArray
    empty: IntArray
    n_unstable: int
    mass_definite: bool | None
    negative_mass: IntArray
    without_inertia: IntArray
    lowest: Lowest | None
    scaled_by_mass: bool
    failure: str
    motions: ZeroEnergy | None
    mechanisms: FloatArray
    body: RigidMass
    piece: IntArray
    loss: float | None
    digits: int | None
    swapped: bool
    damping: dict[str, Any]
    #: frequency [Hz] by Rayleigh's quotient of each joint motion that the structure resists
    resisted: dict[int, float]
    #: number of joint motions that the model states
    n_joint_motions: int

    def names(self, rows: IntArray) -> tuple[str, ...]:
        """Return the labels of some rows (from 0)."""
        return self.given.names(rows)

    @property
    def n_zero(self) -> int:
        """Motions without energy in K, those of DOFs in no matrix not counted."""
        return 0 if self.lowest is None else self.lowest.n_zero

    @property
    def n_negative(self) -> int:
        """Negative eigenvalues of K among the lowest ones."""
        if self.lowest is None:
            return 0
        first = self.lowest.n_zero
        if self.lowest.below is not None:
            return max(self.lowest.below - first, 0)
        return int(np.count_nonzero(self.lowest.values[first:] < 0))

    @property
    def first_freq(self) -> float:
        """Frequency of the first elastic mode [Hz], NaN when it is not known."""
        if self.lowest is None or not self.scaled_by_mass:
            return float("nan")
        elastic = self.lowest.values[self.lowest.n_zero :]
        elastic = elastic[elastic > 0]
        return float(np.sqrt(elastic[0]) / (2 * np.pi)) if elastic.size else float("nan")


def facts(given: FEMatrices, model: FEModel | None = None) -> Facts:
    """Return all known facts on some matrices."""
    proven, joints = model is not None, None if model is None else model.joint_motions
    skew = {
        name: (0.0, 0, 0) if proven else _skew(matrix)
        for name, matrix in (("K", given.K), ("M", given.M), ("D", given.D))
        if matrix is not None
    }
    K, M, D = (
        sp.csc_array(matrix) if proven and matrix is not None else _symmetric_part(matrix)
        for matrix in (given.K, given.M, given.D)
    )
    n = given.n_dof
    no_stiffness = empty_rows(K)
    no_mass = np.zeros(n, dtype=bool) if M is None else empty_rows(M)
    absent = no_stiffness & (no_mass if M is not None else True)
    there = np.flatnonzero(~absent)
    none = np.zeros(0, dtype=np.int64)
    mass_definite, negative, weak = (True, none, none) if proven else _mass_state(given, M, no_mass)
    digits = given.digits
    if digits is None and given.dofs is not None:
        digits = shown_digits(K, given.dofs)
    swapped = not proven and are_swapped(given.K, given.M, given.dofs)
    loose = np.flatnonzero(no_stiffness & ~absent)
    lowest, scaled, failure = None, False, "K and M are swapped"
    motions, mechanisms, unstable = None, np.zeros((n, 0)), 0
    if not swapped:
        if given.dofs is not None:
            motions = zero_energy(
                K,
                given.dofs,
                located=given.located,
                rounding=max(ZERO, _rounding(K, M, given, digits)),
                M=M,
                joint_motions=joints,
            )
        written = 0.0 if digits is None else 10.0**-digits
        lowest, scaled, failure = _try_lowest_modes(
            given, K, M, there, loose, bool(mass_definite), written, motions
        )
    if lowest is not None and motions is not None:
        if scaled:
            lowest, unstable = _of_springs(K, M, lowest, motions)
        zero = lowest.shapes[:, : lowest.n_zero]
        mechanisms = nonrigid(zero, motions.rigid)
    nothing = RigidMass(np.full(3, np.nan), np.full(3, np.nan), np.full((3, 3), np.nan))
    body = nothing if M is None or given.dofs is None else rigid_mass(M, given.dofs)
    if not given.located:
        body = RigidMass(body.mass, nothing.center, nothing.inertia)
    return Facts(
        given=given,
        skew=skew,
        massless=np.flatnonzero(no_mass & ~absent),
        stiffless=loose,
        n_unstable=unstable,
        empty=np.flatnonzero(absent),
        mass_definite=mass_definite,
        negative_mass=negative,
        without_inertia=weak,
        lowest=lowest,
        scaled_by_mass=scaled,
        failure=failure,
        motions=motions,
        mechanisms=mechanisms,
        body=body,
        piece=pieces(K, M, given.dofs),
        loss=None if lowest is None or digits is None else loss(lowest, digits),
        digits=digits,
        swapped=swapped,
        damping={} if D is None else _damping_facts(D, motions, proven),
        resisted={} if model is None else _resisted(model),
        n_joint_motions=0 if joints is None else joints.shape[1],
    )


def _resisted(model: FEModel) -> dict[int, float]:
    """Return the frequency [Hz] of each joint motion (from 1) that is not a free motion."""
    if model.joint_motions is None:
        return {}
    given, free = model.joint_motions, model.rigid_body
    left = given - free @ (free.T @ model.inertia(given))
    size = np.einsum("ij,ij->j", given, model.inertia(given))
    beyond = np.einsum("ij,ij->j", left, model.inertia(left)) > NEGLIGIBLE**2 * size
    energy = np.einsum("ij,ij->j", given, np.asarray(model.K @ given))
    hertz = np.sqrt(np.maximum(energy, 0.0) / divisor(size)) / (2.0 * np.pi)
    return {i + 1: float(hertz[i]) for i in np.flatnonzero(beyond).tolist()}


def _skew(matrix: Any) -> tuple[float, int, int]:
    scaled: Any
    scaled, _ = unit_diagonal(matrix)
    difference: Any = abs(scaled - scaled.T)
    if not difference.nnz:
        return 0.0, 0, 0
    i, j = (int(k) for k in np.unravel_index(difference.argmax(), difference.shape))
    return float(difference[i, j]), min(i, j), max(i, j)


def _symmetric_part(matrix: Any) -> Any:
    return None if matrix is None else sp.csc_array(0.5 * (matrix + matrix.T))


def _mass_state(given: FEMatrices, M: Any, no_mass: Any) -> tuple[bool | None, IntArray, IntArray]:
    """Return whether M is semi-definite, DOFs of negative mass, and DOFs of singular motions."""
    none = np.zeros(0, dtype=np.int64)
    if M is None:
        return None, none, none
    kept = np.flatnonzero(~no_mass)
    negative = kept[diagonal(M)[kept] <= 0]
    if negative.size or not kept.size:
        return False, negative, none
    part = M[kept][:, kept]
    try:
        motions = null_motions(part, given.digits)
    except ModelError:
        return False, negative, none
    return True, negative, kept[massless_dofs(motions, part)] if motions.size else none


def _rounding(K: Any, M: Any, given: FEMatrices, digits: int | None) -> float:
    """Return the relative error of K's entries, from its digits or its free rigid motions."""
    written = 0.0 if digits is None else 10.0**-digits
    if given.dofs is None:
        return written
    motions = own_motions(M, rigid_motions(given.dofs)[:, : 6 if given.located else 3])
    size: Any = abs(K)
    sizes = np.asarray(size @ np.abs(motions))
    force = np.asarray(K @ motions)
    scale = np.linalg.norm(sizes, axis=0)
    relative = np.linalg.norm(force, axis=0) / divisor(scale)
    motions = motions[:, (scale > 0) & (relative < RESIDUAL)]
    motions = motions @ unheld(
        by_rows(K), motions, max(PRECISION, written), farness(given.dofs.xyz)
    )
    moved = np.abs(motions)
    work = np.einsum("ij,ij->j", moved, np.abs(np.asarray(K @ motions)))
    most = np.einsum("ij,ij->j", moved, np.asarray(size @ moved))
    return max(written, 10 * float(np.max(work / most, initial=0.0)))


def _of_springs(K: Any, M: Any, lowest: Lowest, motions: ZeroEnergy) -> tuple[Lowest, int]:
    """Return the lowest modes, with those on springs not at zero, and the number of unstable ones.

    As the modes of a structure are judged: a rigid-body motion that is not free has springs, which
    rounding does not hide; negative ones, of magnets, may only move the structure as a rigid body.
    """
    every = orthonormalised(M, motions.every, dependent="drop")
    n_zero, values = lowest.n_zero, lowest.values
    held = np.zeros(values.size, dtype=bool)
    at = slice(motions.n_rigid, n_zero)
    held[at] = are_rigid(M, every, lowest.shapes[:, at]) & (values[at] > 0)
    order = np.argsort(np.where(np.arange(values.size) < n_zero, held, 1), kind="stable")
    count = int(np.count_nonzero(held))
    springs = replace(
        lowest,
        values=values[order],
        shapes=lowest.shapes[:, order],
        spread=lowest.spread[order],
        n_zero=n_zero - count,
        below=None if lowest.below is None else lowest.below - count,
    )
    if springs.negative is None:
        return springs, 0
    pulled = unstable_stiffness(K, every).size
    return springs, pulled if np.all(are_rigid(M, every, springs.negative[1])) else 0


def _try_lowest_modes(
    given: FEMatrices,
    K: Any,
    M: Any,
    there: IntArray,
    loose: IntArray,
    mass_definite: bool,
    rounding: float,
    motions: ZeroEnergy | None,
) -> tuple[Lowest | None, bool, str]:
    """Return the lowest modes, whether M was used, and the reason if none was found."""
    # each DOF without stiffness (`loose`) is a motion without energy. The others are judged without
    # these, since shapes that M couples to them have no energy except rounding
    if not there.size or not K.nnz:
        return None, False, "K is zero"
    there = np.setdiff1d(there, loose)
    stiff = np.abs(diagonal(K))
    # without a mass matrix, displacements and rotations are scaled by their own stiffness
    weight = sp.diags_array(np.where(stiff > 0, stiff, float(stiff.max()) or 1.0))
    scaled = M is not None and mass_definite
    inner: Any = M if scaled else weight
    whole = there.size == K.shape[0]
    kept_K, kept_M = K, sp.csc_array(inner)
    if not whole:
        kept_K, kept_M = (A[there][:, there] for A in (kept_K, kept_M))
    try:
        known, rigid = None, len(DIRECTIONS)
        if motions is not None:
            known = orthonormalised(kept_M, motions.rigid[there], dependent="drop")
            rigid = max(rigid - known.shape[1], 0)
        found = lowest_modes(
            kept_K,
            kept_M,
            min(rigid + EXTRA_VALUES, there.size),
            known=known,
            rounding=rounding,
            nodes=None if given.dofs is None else given.dofs.nodes[there],
            xyz=given.dofs.xyz[there] if given.dofs is not None and given.located else None,
        )
    except (SolverError, ModelError) as error:
        return None, scaled, str(error)
    few = loose[:MOST_ZEROS]
    shapes = np.zeros((K.shape[0], few.size + found.shapes.shape[1]))
    shapes[few, np.arange(few.size)] = 1.0
    shapes[there, few.size :] = found.shapes
    negative = None
    if found.negative is not None:
        moved = np.zeros((K.shape[0], found.negative[0].size))
        moved[there] = found.negative[1]
        negative = found.negative[0], moved
    none = np.zeros(few.size)
    every = Lowest(
        np.concatenate([none, found.values]),
        shapes,
        np.concatenate([none, found.spread]),
        found.n_zero + few.size,
        None if found.below is None else found.below + few.size,
        negative,
    )
    return every, scaled, ""


def _damping_facts(D: Any, motions: ZeroEnergy | None, proven: bool) -> dict[str, Any]:
    kept = np.flatnonzero(~empty_rows(D))
    definite = proven or not kept.size or is_positive_definite(D[kept][:, kept], SAME)
    drag = 0.0
    if motions is not None and motions.n_rigid and kept.size:
        size: Any = abs(D)
        scale = np.linalg.norm(np.asarray(size @ np.abs(motions.rigid)), axis=0)
        force = np.linalg.norm(np.asarray(D @ motions.rigid), axis=0)
        drag = float(np.max(force / divisor(scale), initial=0.0))
    return {"definite": definite, "drag": drag}
