"""Ways to choose degrees of freedom that distinguish modes; each is a small value."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ..values import ComplexArray, FloatArray, Value

#: shapes at DOFs, real or complex
Rows: TypeAlias = FloatArray | ComplexArray

#: downdates after which the information matrix is made anew, and dropped rows leave the arrays
_REFRESH = 64
#: part of the largest information below which a combination of modes is not seen at all
_UNSEEN = 1e-12


class SelectionCriterion(Value):
    """The base class of criteria for the choice of rows of a basis.

    Examples
    --------
    >>> import flexplant as fx
    >>> isinstance(fx.reduction.Greedy(), fx.reduction.SelectionCriterion)
    True
    """

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    @abstractmethod
    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return which rows of the pool (p, k) to take beside the required ones (q, k)."""

    @abstractmethod
    def values(self, rows: Rows) -> FloatArray:
        """Return the value of the criterion at each of the chosen rows, in their order."""


@dataclass(frozen=True, eq=False, repr=False)
class PivotedQr(SelectionCriterion):
    """QR with column pivoting: each next DOF is the one least explained by those before.

    Its value for a DOF is the length of what those before it do not explain.

    References
    ----------
    [Manohar2018]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2, criterion=fx.reduction.PivotedQr()).labels
    ('1:x', '3:x')
    """

    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return which rows of the pool to take."""
        if not count:
            return []
        if required.shape[0]:
            span = la.qr(required.T, mode="economic")[0]
            for _ in range(2):
                pool = pool - (pool @ span.conj()) @ span.T
        pivots = la.qr(pool.T, mode="r", pivoting=True)[1]
        return [int(i) for i in pivots[:count]]

    def values(self, rows: Rows) -> FloatArray:
        """Return the length of each row beyond the span of those before it."""
        return np.abs(np.diag(la.qr(rows.T, mode="r")[0]))


@dataclass(frozen=True, eq=False, repr=False)
class EffectiveIndependence(SelectionCriterion):
    """Effective independence: drop the DOF that adds least to the information on the modes.

    Starts from all candidates. Their information is ``Q = phi^H phi``, of which row i holds the
    share ``E_i = phi_i Q^-1 phi_i^H``, from 0 to 1 (without it, a mode is lost). One by one the
    lowest goes, and Q^-1 follows by a rank-one downdate. Fewer DOFs than modes are chosen by
    `PivotedQr` from the last k.

    References
    ----------
    [Kammer1991]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2, criterion=fx.reduction.EffectiveIndependence()).labels
    ('1:x', '3:x')
    """

    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return which rows of the pool to take."""
        if not count:
            return []
        fixed, p = required.shape[0], pool.shape[0]
        # orthonormal columns, so that no unit of a mode matters
        both = np.vstack([required, pool])
        length = np.linalg.norm(both, axis=0)
        both = both / np.where(length > 0, length, 1.0)
        vectors, size, _ = la.svd(both, full_matrices=False)
        rows = np.array(vectors[:, size > _UNSEEN * size[0]])
        wanted = max(count, min(rows.shape[1] - fixed, p))
        alive = np.arange(fixed + p)
        while alive.size > fixed + wanted:
            drops = min(_REFRESH, alive.size - fixed - wanted)
            dropped = _lowest(rows[alive], fixed, drops)
            alive = np.delete(alive, dropped)
        left = alive[fixed:] - fixed
        if wanted > count:
            return [int(left[i]) for i in PivotedQr().chosen(required, pool[left], count)]
        return [int(i) for i in left]

    def values(self, rows: Rows) -> FloatArray:
        """Return the share E_i of each row in the information of all."""
        vectors, size, _ = la.svd(rows, full_matrices=False)
        return np.asarray(np.sum(np.abs(vectors[:, size > _UNSEEN * size[0]]) ** 2, axis=1))


def _lowest(rows: Rows, fixed: int, drops: int) -> list[int]:
    """Return the rows that effective independence drops, one after the other."""
    inverse = la.inv(rows.conj().T @ rows)
    share = np.einsum("ij,ij->i", rows @ inverse, rows.conj()).real
    share[:fixed] = np.inf
    dropped: list[int] = []
    for _ in range(drops):
        worst = int(np.argmin(share))
        dropped.append(worst)
        image = inverse @ rows[worst].conj()
        left = max(1.0 - float(np.real(rows[worst] @ image)), _UNSEEN)
        inverse += np.outer(image, image.conj() / left)
        share += np.abs(rows @ (image / np.sqrt(left))) ** 2
        share[worst] = np.inf
    return dropped


@dataclass(frozen=True, eq=False, repr=False)
class Greedy(SelectionCriterion):
    """Each next DOF is the one that leaves the largest smallest singular value of phi_kk.

    Its value for a DOF is that singular value when it was taken.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2, criterion=fx.reduction.Greedy()).labels
    ('1:x', '3:x')
    """

    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return which rows of the pool to take."""
        taken: Any = np.array(required)
        free = np.ones(pool.shape[0], dtype=bool)
        found: list[int] = []
        for _ in range(count):
            lowest = np.where(free, _smallest_with(taken, pool), -np.inf)
            best = int(np.argmax(lowest))
            free[best] = False
            found.append(best)
            taken = np.vstack([taken, pool[best]])
        return found

    def values(self, rows: Rows) -> FloatArray:
        """Return the smallest singular value of each row with those before it."""
        return np.array([la.svdvals(rows[: i + 1])[-1] for i in range(rows.shape[0])])


def _smallest_with(taken: Rows, pool: Rows) -> FloatArray:
    """Return the smallest eigenvalue of the Gram matrix of the taken rows plus one of the pool.

    The root below all eigenvalues of the Gram matrix of the taken rows of the secular equation
    ``v'v - mu - sum_i w_i^2 / (lambda_i - mu) = 0``, w the products of v with their eigenvectors,
    bisected for all of the pool at once.
    """
    size = np.einsum("ij,ij->i", pool, pool.conj()).real
    if not taken.shape[0]:
        return np.asarray(size)
    values, vectors = la.eigh(taken @ taken.conj().T)
    share = np.abs((pool @ taken.conj().T) @ vectors) ** 2
    low, high = np.zeros(pool.shape[0]), np.minimum(size, max(values[0], 0.0))
    for _ in range(60):
        middle = 0.5 * (low + high)
        gap = np.maximum(values[None, :] - middle[:, None], 1e-300)
        above = size - middle - np.sum(share / gap, axis=1) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.asarray(0.5 * (low + high))
