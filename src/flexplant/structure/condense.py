"""Degrees of freedom without mass follow the others statically: nothing is lost without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import ModelError, SolverError, counted
from ..sparse.factor import symmetric_lu, unit_diagonal
from ..values import IntArray

#: so many columns of K_ss^-1 K_sm at once: more of them no longer fit the cache
_COLUMNS = 256
#: that many DOFs next to massless ones fill a block that no longer fits the memory comfortably
_TOO_MANY = 10_000
#: a pivot below this part of its diagonal is a zero that rounding hides
_SINGULAR = 1e-12


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
    """Return K, M, D without the massless DOFs s: ``K_mm - K_ms K_ss^-1 K_sm``, M_mm, D_mm.

    Exact: ``K_sm q_m + K_ss q_s = 0`` holds at every frequency. All finite eigenvalues stay.
    """
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
    if lu is None or pivots.min() < _SINGULAR:
        loose = names(s[pivots < _SINGULAR][:6]) or names(s[:6])
        raise ModelError(
            f"massless DOFs have a motion without stiffness, {', '.join(loose)} among them: where "
            "they are does not follow from the others. Hold them: without([...])."
        )
    touched = np.flatnonzero(np.diff(K_sm.indptr))
    if touched.size > _TOO_MANY:
        raise ModelError(
            f"condensing {counted(s.size, 'massless DOF')} would fill a block of {touched.size} "
            f"DOFs (limit {_TOO_MANY}). Export a consistent mass matrix, or one with rotary "
            "inertia."
        )
    sides: Any = sp.diags_array(scale) @ K_sm[:, touched]
    block = np.zeros((touched.size, touched.size))
    for first in range(0, touched.size, _COLUMNS):
        part = slice(first, first + _COLUMNS)
        block[:, part] = sides.T @ lu.solve(sides[:, part].toarray())
    block = 0.5 * (block + block.T)
    spread: Any = sp.coo_array(block)
    index = (touched[spread.row], touched[spread.col])
    filled: Any = sp.csc_array((spread.data, index), shape=K_mm.shape)
    return K_mm - filled, M[m][:, m], None if D is None else D[m][:, m]
