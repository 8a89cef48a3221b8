"""Motions without inertia, of single DOFs or of several together, refused or condensed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..arrays import COLUMNS, FloatArray, IntArray
from ..errors import ModelError, SolverError, counted
from ..sparse.factor import LARGEST_FULL, is_positive_definite, symmetric_lu
from ..sparse.symmetric import dense, diagonal, projected, unit_diagonal
from ..tolerances import NULL, ROUNDING


def null_motions(M: Any, digits: int | None) -> FloatArray:
    """Return the motions (n, q) without inertia, block by block of M; (n, 0) when M is definite."""
    # M is scaled to a unit diagonal first; eigenvalues below 1e-11, or below what the digits of a
    # text leave, count as zero
    n = M.shape[0]
    tolerance = NULL if digits is None else max(NULL, 10.0 ** (1 - digits))
    if is_positive_definite(M, -tolerance):
        return np.zeros((n, 0))
    scaled: Any
    scaled, scale = unit_diagonal(M)
    scaled = sp.csc_array(scaled)
    count, label = csgraph.connected_components(scaled, directed=False)
    order = np.argsort(label, kind="stable")
    columns: list[FloatArray] = []
    for block in np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1]):
        if block.size > LARGEST_FULL:
            raise ModelError(
                f"M is singular or indefinite, and {block.size} of its DOFs are coupled: too "
                f"many to search (limit {LARGEST_FULL}). Export a lumped M, or one with rotary "
                "inertia."
            )
        values, vectors = la.eigh(dense(scaled[block][:, block]))
        if values[0] < -tolerance:
            raise ModelError(
                f"M is indefinite: scaled to a unit diagonal, an eigenvalue is {values[0]:.3g}. "
                "Some motion would have a negative inertia. Look for a sign, or a cut triangle."
            )
        for vector in vectors[:, values < tolerance].T:
            column = np.zeros(n)
            column[block] = scale[block] * vector
            columns.append(column)
    return np.column_stack(columns) if columns else np.zeros((n, 0))


def massless_dofs(motions: FloatArray, M: Any) -> IntArray:
    """Return the DOFs (q,), ascending, that the motions (n, q) without inertia move most."""
    size = np.sqrt(diagonal(M))[:, None] * motions
    pivots = la.qr(size.T, mode="r", pivoting=True)[1]
    return np.sort(np.asarray(pivots[: motions.shape[1]], dtype=np.int64))


def condense_massless(
    K: Any, M: Any, D: Any, motions: FloatArray, names: Callable[[IntArray], tuple[str, ...]]
) -> tuple[FloatArray, FloatArray, FloatArray | None, IntArray]:
    """Return K, M, D on the motions with inertia, in n - q of the DOFs, and these DOFs."""
    # for motions N without inertia, `N^T K q = 0` at every frequency. It determines q of the DOFs,
    # s, from the others: `q_s = -(N^T K)_s^-1 (N^T K)_m q_m`. This is exact, all finite eigenvalues
    # stay, and the kept DOFs keep their meaning
    n, q = motions.shape
    if n > LARGEST_FULL:
        raise ModelError(
            f"condensing {q} motions without inertia gives full matrices of {n - q} DOFs (limit "
            f"{LARGEST_FULL}). Give the offset masses a rotary inertia."
        )
    if D is not None and np.abs(D @ motions).max() > 0:
        raise ModelError(
            "damping acts on motions without inertia: they do not follow statically. Give them "
            "inertia, or leave D out and give damping by mode."
        )
    s = massless_dofs(motions, M)
    m = np.setdiff1d(np.arange(n), s)
    forces = np.asarray(K @ motions).T
    weight = np.sqrt(np.abs(diagonal(K)))[s]
    weight[weight == 0] = 1.0
    pivot = forces[:, s] / weight
    pivot_rows = np.linalg.norm(pivot, axis=1)
    if not pivot_rows.all() or np.linalg.cond(pivot / pivot_rows[:, None]) > 1.0 / ROUNDING:
        raise ModelError(
            f"a motion without inertia has no stiffness either, at {', '.join(names(s[:6]))} among "
            "others: it does not follow from the others. Hold it: without([...])."
        )
    T = np.zeros((n, m.size))
    T[m, np.arange(m.size)] = 1.0
    T[s] = -np.linalg.solve(pivot, forces[:, m]) / weight[:, None]

    return projected(K, T), projected(M, T), None if D is None else projected(D, T), m


class Inertial(NamedTuple):
    """Matrices on the motions with inertia, the rows (k,) that are left, and what was done."""

    K: Any
    M: Any
    D: Any
    rows: IntArray
    notes: tuple[str, ...]


def inertial(
    K: Any,
    M: Any,
    D: Any,
    names: Callable[[IntArray], tuple[str, ...]],
    *,
    digits: int | None,
    massless: str,
) -> Inertial:
    """Return matrices whose M is definite: motions without inertia follow the others statically."""
    notes: tuple[str, ...] = ()
    rows: IntArray = np.arange(M.shape[0])
    without = empty_rows(M)
    if without.any():
        if massless == "refuse":
            some = names(np.flatnonzero(without))
            listed = ", ".join(repr(name) for name in some[:6])
            more = f" ({len(some)} in all)" if len(some) > 6 else ""
            raise ModelError(
                f"DOFs without mass: {listed}{more}. They follow the other DOFs statically. "
                "Condense them, which is exact: model(massless='condense'); or give them their "
                "mass."
            )
        K, M, D = condensed(K, M, D, without, names)
        rows = np.flatnonzero(~without)
        notes = (f"{counted(int(without.sum()), 'massless DOF')} condensed",)
    motions = null_motions(M, digits)
    count = motions.shape[1]
    if count:
        if massless == "refuse":
            at = ", ".join(names(rows[massless_dofs(motions, M)[:6]]))
            raise ModelError(
                f"{counted(count, 'motion')} without inertia, turning {at} among others: offset "
                "masses without rotary inertia, or rods that do not resist turning? Condense them, "
                "which is exact: model(massless='condense'); or give them their inertia."
            )
        left = rows
        K, M, D, kept = condense_massless(K, M, D, motions, lambda some: names(left[some]))
        rows = rows[kept]
        notes = (*notes, f"{counted(count, 'motion')} without inertia condensed")
    return Inertial(K, M, D, rows, notes)


def empty_rows(matrix: Any) -> Any:
    """Return which rows (n,) are zero: those of M belong to DOFs without any mass."""
    return _row_sums(matrix) == 0


def held_rows(K: Any, M: Any, D: Any) -> Any:
    """Return which rows (n,) a solver left for held DOFs: at most a diagonal of K, or empty."""
    size = _row_sums(K)
    held = size == 0 if M is None else size <= np.abs(K.diagonal())
    for matrix in (M, D):
        if matrix is not None:
            held &= empty_rows(matrix)
    return held


def _row_sums(matrix: Any) -> Any:
    sizes: Any = abs(matrix)
    return np.asarray(sizes.sum(axis=1)).ravel()


def condensed(
    K: Any, M: Any, D: Any, without: Any, names: Callable[[IntArray], tuple[str, ...]]
) -> tuple[Any, Any, Any]:
    """Return K, M, D without the massless DOFs s: ``K_mm - K_ms K_ss^-1 K_sm``, M_mm, D_mm."""
    # exact: `K_sm q_m + K_ss q_s = 0` holds at every frequency. All finite eigenvalues stay
    s, m = np.flatnonzero(without), np.flatnonzero(~without)
    if not m.size:
        raise ModelError("no DOF has mass: M is zero. Was another matrix read as M?")
    if D is not None:
        damped = s[~empty_rows(D)[s]]
        if damped.size:
            raise ModelError(
                f"damping acts on the massless DOFs {list(names(damped[:6]))}: they would not "
                "follow statically, and condensing them would not be exact. Give them mass, or "
                "leave D out and give damping by mode."
            )
    K_ss, K_sm, K_mm = K[s][:, s], sp.csc_array(K[s][:, m]), K[m][:, m]
    scaled: Any
    scaled, scale = unit_diagonal(K_ss)
    try:
        lu = symmetric_lu(scaled)
    except SolverError:
        lu = None
    pivots = scaled.diagonal() if lu is None else np.abs(lu.U.diagonal())[lu.perm_c]
    if lu is None or pivots.min() < ROUNDING:
        loose = names(s[pivots < ROUNDING][:6]) or names(s[:6])
        raise ModelError(
            f"massless DOFs have a motion without stiffness, {', '.join(loose)} among them: where "
            "they are does not follow from the others. Hold them: without([...])."
        )
    touched = np.flatnonzero(np.diff(K_sm.indptr))
    if touched.size > LARGEST_FULL:
        raise ModelError(
            f"condensing {counted(s.size, 'massless DOF')} would fill a block of {touched.size} "
            f"DOFs (limit {LARGEST_FULL}). Export a consistent mass matrix, or one with rotary "
            "inertia."
        )
    sides: Any = sp.diags_array(scale) @ K_sm[:, touched]
    block = np.zeros((touched.size, touched.size))
    for first in range(0, touched.size, COLUMNS):
        part = slice(first, first + COLUMNS)
        block[:, part] = sides.T @ lu.solve(sides[:, part].toarray())
    block = 0.5 * (block + block.T)
    spread: Any = sp.coo_array(block)
    index = (touched[spread.row], touched[spread.col])
    filled: Any = sp.csc_array((spread.data, index), shape=K_mm.shape)
    return K_mm - filled, M[m][:, m], None if D is None else D[m][:, m]
