"""Criteria for the choice of degrees of freedom that distinguish modes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor, positive, whole
from ..errors import LabelError, ModelError, ShapeError, counted
from ..modes.modes import Modes
from ..store import Value
from ..tolerances import ROUNDING, TINY, TYPED
from ..words import instance, name_list

#: shapes at DOFs, real or complex
Rows: TypeAlias = FloatArray | ComplexArray

#: number of downdates after which the information matrix is computed again and dropped rows are
#: removed
_REFRESH = 64


class SelectionCriterion(Value):
    """The base class of criteria by which `select_dofs` chooses DOFs.

    Modes and attachment vectors are the k columns of a matrix, which has a row for each DOF. A
    criterion chooses rows of this matrix.

    Examples
    --------
    The library's criteria are instances of this class:

    >>> import flexplant as fx
    >>> isinstance(fx.reduction.Greedy(), fx.reduction.SelectionCriterion)
    True
    """

    @abstractmethod
    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return the positions of the `count` rows of the array `pool` (p, k) that are chosen.

        The rows of `required` (q, k) are chosen already and are not counted.
        """

    @abstractmethod
    def values(self, rows: Rows) -> FloatArray:
        """Return the value of the criterion for each of the chosen rows (n, k), in their order."""


@dataclass(frozen=True, eq=False, repr=False)
class PivotedQr(SelectionCriterion):
    """QR with column pivoting: each DOF is the one that the previous DOFs explain least.

    The row of a DOF holds its motion in each mode. The value of a DOF is the length of the part of
    its row that is orthogonal to all previous rows.

    References
    ----------
    [Manohar2018]_.

    Examples
    --------
    The two ends of a chain distinguish its first two modes best:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2, criterion=fx.reduction.PivotedQr()).labels
    ('1:x', '3:x')
    """

    def chosen(self, required: Rows, pool: Rows, count: int) -> list[int]:
        """Return the positions of the chosen rows; see `SelectionCriterion.chosen`."""
        if not count:
            return []
        if required.shape[0]:
            span = la.qr(required.T, mode="economic")[0]
            for _ in range(2):
                pool = pool - (pool @ span.conj()) @ span.T
        return [int(i) for i in la.qr(pool.T, mode="r", pivoting=True)[1][:count]]

    def values(self, rows: Rows) -> FloatArray:
        """Return the length of the part of each row that is orthogonal to all rows before it."""
        return np.abs(np.diag(la.qr(rows.T, mode="r")[0]))


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


@dataclass(frozen=True, eq=False, repr=False)
class DofSelection(Value):
    """DOFs that `select_dofs` chose, for use by `DesiredDofs`, `Guyan` or as a boundary.

    Parameters
    ----------
    labels : tuple of str
        The DOFs, required ones first.
    condition : float
        Condition number of the matrix phi_kk, which holds the rows of the mode shapes at these
        DOFs, and those of the attachment vectors if there are any. A low number is good.
    values : (count,) array, optional
        Value of the criterion for each DOF, in the order of the labels.
    criterion : SelectionCriterion
        Criterion by which they were chosen.

    Examples
    --------
    Two DOFs are chosen for two modes:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2).labels
    ('1:x', '3:x')
    """

    labels: tuple[str, ...]
    condition: float
    values: FloatArray = field(default_factory=lambda: np.zeros(0))
    criterion: SelectionCriterion = field(default_factory=PivotedQr)

    def __repr__(self) -> str:
        more = f", ... {self.labels[-1]}" if len(self.labels) > 3 else ""
        listed = f"{counted(len(self.labels), 'DOF')} ({', '.join(self.labels[:3])}{more})"
        return f"<DofSelection: {listed}, condition {self.condition:.3g}>"

    def __iter__(self) -> Iterator[str]:
        return iter(self.labels)

    def __len__(self) -> int:
        return len(self.labels)


def _candidates(modes: Modes) -> list[str]:
    """Return the displacements, or all labels where displacements do not distinguish the modes."""
    straight = [label for label in modes.dofs.labels if ":r" not in label]
    if len(straight) == len(modes.dofs):
        return straight
    rows = modes.basis[modes.dofs.indices(straight)]
    sizes = la.eigvalsh(rows.conj().T @ rows)
    return straight if sizes[0] > TYPED**2 * sizes[-1] else list(modes.dofs.labels)


def select_dofs(
    modes: Modes,
    count: int,
    *,
    candidates: Iterable[str] | None = None,
    required: Iterable[str] = (),
    criterion: SelectionCriterion | None = None,
    limit: float = 1e12,
) -> DofSelection:
    """Return DOFs whose motions distinguish modes and attachment vectors well.

    phi_kk holds the rows of modes and attachment vectors at the chosen DOFs. A low condition number
    of this matrix is good, since `DesiredDofs` inverts it.

    Parameters
    ----------
    modes : Modes
        Modes, real or complex, with their attachment vectors.
    count : int
        Number of DOFs, at most the number of modes plus the number of attachment vectors. With
        exactly this sum, `DesiredDofs` keeps all modes. With fewer DOFs, it keeps fewer modes.
    candidates : iterable of str, optional
        Labels to choose from. None: all displacements, and the rotations too where displacements
        do not distinguish the modes, as of bodies that turn.
    required : iterable of str
        DOFs that are kept in any case.
    criterion : PivotedQr, EffectiveIndependence or Greedy, optional
        Criterion of the choice. None: `PivotedQr`.
    limit : float
        Largest accepted condition number of phi_kk.

    Raises
    ------
    ModelError
        When `count` is not a whole number, or no choice of candidates distinguishes the modes.

    Examples
    --------
    Two corners are required, and the third DOF is chosen among three candidates:

    >>> from flexplant.structure import kirchhoff_plate
    >>> from flexplant.modes import solve_modes
    >>> plate = kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(4, 4), density=2702,
    ...                         youngs_modulus=70e9, poisson_ratio=0.35)
    >>> near = ["7:z", "12:z", "23:z"]
    >>> select_dofs(solve_modes(plate, count=3), 3, required=["1:z", "5:z"], candidates=near)
    <DofSelection: 3 DOFs (1:z, 5:z, 23:z), condition 1.93>
    """
    instance(modes, Modes, "modes", "Pass solve_modes(model, count=24).")
    rule = PivotedQr() if criterion is None else criterion
    hint = "Pass reduction.PivotedQr() or reduction.Greedy()."
    instance(rule, SelectionCriterion, "criterion", hint)
    basis = modes.basis
    kept = list(name_list(required, "required DOFs"))
    if len(set(kept)) != len(kept):
        raise LabelError(f"required DOFs appear twice: {kept}.")
    pool = _candidates(modes) if candidates is None else name_list(candidates, "candidates")
    pool = [label for label in dict.fromkeys(pool) if label not in set(kept)]
    rows, open_rows = modes.dofs.indices(kept), modes.dofs.indices(pool)
    k = basis.shape[1]
    number = whole(count, "count", minimum=-(10**9))
    if not max(1, len(kept)) <= number <= k:
        raise ShapeError(
            f"count must be from {max(1, len(kept))} (the required DOFs) to {k} ({modes.n_modes} "
            f"modes plus {counted(modes.n_vectors, 'attachment vector')}), got {count!r}."
        )
    missing = number - len(kept)
    if missing > len(pool):
        raise ShapeError(
            f"{missing} DOFs are wanted, but there are {len(pool)} candidates: name more, "
            "candidates=modes.dofs.labels for all."
        )
    taken = rule.chosen(basis[rows], basis[open_rows], missing) if missing else []
    chosen = kept + [pool[i] for i in taken]
    picked = basis[modes.dofs.indices(chosen)]
    singular = la.svdvals(picked)
    top = positive(limit, "limit")
    if not singular[-1] * top > singular[0]:
        raise ModelError(
            f"no {number} of these DOFs distinguish the modes (condition above {top:.3g}): the "
            "required ones depend on each other, or all candidates lie on node lines. Name other "
            "candidates, such as modes.dofs.labels."
        )
    condition = float(singular[0] / singular[-1])
    return DofSelection(tuple(chosen), condition, rule.values(picked), rule)
