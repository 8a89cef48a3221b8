"""Criteria that choose degrees of freedom one by one, or drop them one by one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, divisor
from ..tolerances import ROUNDING, TINY
from .methods import PivotedQr, Rows, SelectionCriterion

#: number of downdates after which the information matrix is computed again and dropped rows are
#: removed
_REFRESH = 64


@dataclass(frozen=True, eq=False, repr=False)
class EffectiveIndependence(SelectionCriterion):
    """Effective independence: drop the DOF that adds least to the information on the modes.

    The matrix phi has a row for each candidate DOF, with its motion in each mode. The search starts
    with all candidates. Their information on the modes is ``Q = phi^H phi``. Row i of phi has the
    share ``E_i = phi_i Q^-1 phi_i^H`` in it, a number from 0 to 1. If the share is 1, the modes
    cannot be distinguished without this row. The row with the lowest share is dropped, Q^-1 is
    updated, and this is repeated. If fewer DOFs than modes are wanted, the search stops when as
    many rows as modes are left. `PivotedQr` then chooses among these rows.

    References
    ----------
    [Kammer1991]_.

    Examples
    --------
    The two ends of a chain distinguish its first two modes best:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2, criterion=fx.reduction.EffectiveIndependence()).labels
    ('1:x', '3:x')
    """

    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return the positions of the chosen rows; see `SelectionCriterion.chosen`."""
        if not count:
            return []
        fixed, p = required.shape[0], pool.shape[0]
        # orthonormal columns, so that the units of modes do not matter
        both: FloatArray = np.vstack([required, pool])
        length = np.linalg.norm(both, axis=0)
        both = both / divisor(length)
        vectors, size, _ = la.svd(both, full_matrices=False)
        rows = np.array(vectors[:, size > ROUNDING * size[0]])
        wanted = max(count, min(rows.shape[1] - fixed, p))
        remaining = np.arange(fixed + p)
        while remaining.size > fixed + wanted:
            drops = min(_REFRESH, remaining.size - fixed - wanted)
            remaining = np.delete(remaining, _dropped_rows(rows[remaining], fixed, drops))
        left = remaining[fixed:] - fixed
        if wanted > count:
            left = left[PivotedQr().chosen(required, pool[left], count)]
        return [int(i) for i in left]

    def values(self, rows: Rows) -> FloatArray:
        """Return the share E_i of each row in the information of all chosen rows."""
        vectors, size, _ = la.svd(rows, full_matrices=False)
        return np.asarray(np.sum(np.abs(vectors[:, size > ROUNDING * size[0]]) ** 2, axis=1))


def _dropped_rows(rows: Rows, fixed: int, drops: int) -> list[int]:
    """Return the rows that effective independence drops, one after the other."""
    inverse = la.inv(rows.conj().T @ rows)
    share = np.einsum("ij,ij->i", rows @ inverse, rows.conj()).real
    share[:fixed] = np.inf
    dropped: list[int] = []
    for _ in range(drops):
        worst = int(np.argmin(share))
        dropped.append(worst)
        image = inverse @ rows[worst].conj()
        left = max(1.0 - float(np.real(rows[worst] @ image)), ROUNDING)
        inverse += np.outer(image, image.conj() / left)
        share += np.abs(rows @ (image / np.sqrt(left))) ** 2
        share[worst] = np.inf
    return dropped


@dataclass(frozen=True, eq=False, repr=False)
class Greedy(SelectionCriterion):
    """Choice of one DOF after the other, each for the largest value of the criterion.

    The criterion is the smallest singular value of phi_kk, which holds the rows of the modes at the
    chosen DOFs. The value of a DOF is the criterion directly after this DOF was chosen.

    Examples
    --------
    The two ends of a chain distinguish its first two modes best:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2, criterion=fx.reduction.Greedy()).labels
    ('1:x', '3:x')
    """

    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return the positions of the chosen rows; see `SelectionCriterion.chosen`."""
        taken: Any = np.array(required)
        free = np.ones(pool.shape[0], dtype=bool)
        found: list[int] = []
        for _ in range(min(count, pool.shape[0])):
            lowest = np.where(free, _smallest_with(taken, pool), -np.inf)
            best = int(np.argmax(lowest))
            free[best] = False
            found.append(best)
            taken = np.vstack([taken, pool[best]])
        return found

    def values(self, rows: Rows) -> FloatArray:
        """Return, for each row, the smallest singular value of the matrix of all rows up to it."""
        return np.array([la.svdvals(rows[: i + 1])[-1] for i in range(rows.shape[0])])


def _smallest_with(taken: Rows, pool: Rows) -> FloatArray:
    """Return the smallest eigenvalue of the Gram matrix of the taken rows plus one of the pool."""
    # this is the root of the secular equation below all eigenvalues of the Gram matrix of the taken
    # rows: `v'v - mu - sum_i w_i^2 / (lambda_i - mu) = 0`, w the products of v with their
    # eigenvectors, bisected for all of the pool at once
    size = np.einsum("ij,ij->i", pool, pool.conj()).real
    if not taken.shape[0]:
        return np.asarray(size)
    values, vectors = la.eigh(taken @ taken.conj().T)
    share = np.abs((pool @ taken.conj().T) @ vectors) ** 2
    low, high = np.zeros(pool.shape[0]), np.minimum(size, max(values[0], 0.0))
    for _ in range(60):
        middle = 0.5 * (low + high)
        gap = np.maximum(values[None, :] - middle[:, None], TINY)
        above = size - middle - np.sum(share / gap, axis=1) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.asarray(0.5 * (low + high))
