"""`reduce`, the method of the paper, and the choice of the DOFs that it keeps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, instance, name_list, positive, whole
from ..errors import LabelError, ModelError, ShapeError, attempted, counted, some_names
from ..labels import DofSet, Place
from ..modes.modes import Modes, require_real
from ..modes.solve import places, solve_modes
from ..parallel import Progress
from ..store import Value, checked
from ..structure import Damping, FEModel
from ..structure.definite import refuse_unstable
from ..tolerances import NEGLIGIBLE, TYPED
from .reduced import ReducedModel

#: shapes at DOFs, real or complex
Rows: TypeAlias = FloatArray | ComplexArray


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


def labels_given(dofs: Iterable[str], name: str) -> tuple[str, ...]:
    """Return labels as a tuple, none of them twice."""
    labels = name_list(dofs, name)
    if not labels:
        raise LabelError(f"{name} is empty: name at least one DOF, such as '41:z'.")
    if len(set(labels)) < len(labels):
        doubled = sorted({label for label in labels if labels.count(label) > 1})
        raise LabelError(f"{name} {doubled} appear twice: the matrix to invert would be singular.")
    return labels


_LAW = "Give ModalDamping or Rayleigh: ModalDamping(0.01) is 1 % in all modes."


@dataclass(frozen=True, eq=False, repr=False)
class ReductionMethod(Value):
    """The base class of reduction methods, which make a reduced model of a structure.

    Your own method is a class with the function `ReductionMethod.reduced`.

    Parameters
    ----------
    damping : ModalDamping or Rayleigh, optional
        Damping that replaces D when an FEModel is reduced.

    Examples
    --------
    The library's methods are instances of this class:

    >>> import flexplant as fx
    >>> isinstance(fx.reduction.Guyan(["1:x"]), fx.reduction.ReductionMethod)
    True
    """

    damping: Damping | None = field(
        default=None, kw_only=True, metadata=checked(instance, kind=Damping, hint=_LAW)
    )

    @abstractmethod
    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the reduced model of a structure; `reduce` calls this method."""


@dataclass(frozen=True, eq=False, repr=False)
class DesiredDofs(ReductionMethod):
    """Modal reduction in desired physical DOFs (equations (6) to (8) of [paper]_).

    The coordinates of the reduced model are DOFs that you choose, and the kept modes are exact. The
    matrix that expands the coordinates to all DOFs is ``T = phi phi_kk^-1``. Here phi holds the
    modes and attachment vectors, and phi_kk their rows at the chosen DOFs.

    Parameters
    ----------
    dofs : sequence of str, DofSet or DofSelection
        Labels of the kept DOFs. There must be one for each mode and each attachment vector (the
        static displacement under a unit force at a place of `static_at`). Without attachment
        vectors there may be fewer. The same number of lowest modes is then kept, and the model
        stores the other modes as `truncated`. For an FEModel, the method solves for as many modes
        as there are labels, minus the number of places in `static_at`.
    static_at : place or sequence of places
        Places where attachment vectors keep the static compliance of truncated modes. Only for an
        FEModel, since `Modes` already contain their attachment vectors.
    damping : ModalDamping or Rayleigh, optional
        Damping of modes and vectors in place of the model's D. Only for an FEModel.

    References
    ----------
    [paper]_, equations (6)-(8).

    Examples
    --------
    Two modes are kept in a model of two DOFs:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.reduce(modes, fx.DesiredDofs(["1:x", "3:x"])).dofs.labels
    ('1:x', '3:x')
    """

    dofs: Iterable[str] = field(metadata=checked(labels_given, name="desired DOFs"))
    static_at: Place | Iterable[Place] = field(default=(), kw_only=True, metadata=checked(places))

    def __repr__(self) -> str:
        labels = tuple(self.dofs)
        return f"<DesiredDofs: {len(labels)} ({some_names(labels, 3)})>"

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the model in these DOFs. Call `reduce` instead of this method."""
        modes = self._modes(structure)
        labels = tuple(self.dofs)
        modes.dofs.indices(labels)
        truncated = None
        if not modes.n_vectors and modes.n_rigid <= len(labels) < modes.n_modes:
            truncated = modes.select(range(len(labels), modes.n_modes))
            modes = modes.select(range(len(labels)))
        k = modes.n_modes + modes.n_vectors
        require_real(
            modes, "(5) is not diagonal: add dampers later, or reduce(model, reduction.Serep(dofs))"
        )
        if len(labels) != k:
            advice = f"Name {counted(k - len(labels), 'more DOF')} or keep fewer modes"
            if len(labels) > k:
                advice = f"Leave out {counted(len(labels) - k, 'DOF')} or keep more modes"
            raise ShapeError(
                f"{counted(len(labels), 'desired DOF')} for {counted(modes.n_modes, 'mode')} plus "
                f"{modes.n_vectors} attachment vectors = {k}: phi_kk in equation (7) must be "
                f"square. {advice}; select_dofs(modes, {k}) finds a good set."
            )
        basis = np.asarray(modes.basis, dtype=np.float64)
        condition = refused_partition(modes.dofs, basis, labels, f"{k} modes and vectors")
        partition = basis[modes.dofs.indices(labels)]
        inverse = la.inv(partition)
        return ReducedModel(
            M=inverse.T @ inverse,
            D=(inverse.T * modes.basis_rates) @ inverse,
            K=(inverse.T * modes.basis_squares) @ inverse,
            T=la.solve(partition.T, basis.T).T,
            dofs=modes.dofs.select(labels),
            full_dofs=modes.dofs,
            rigid_body=partition[:, : modes.n_rigid],
            method=counted(modes.n_modes, "mode")
            + (f" and {counted(modes.n_vectors, 'attachment vector')}" if modes.n_vectors else ""),
            condition=condition,
            truncated=truncated,
            n_vectors=modes.n_vectors,
            static_at=modes.vector_dofs,
        )

    def _modes(self, structure: FEModel | Modes) -> Modes:
        static: Any = self.static_at
        if isinstance(structure, Modes):
            if self.damping is not None or static:
                raise ModelError(
                    "damping= and static_at= of DesiredDofs need an FEModel, but Modes were "
                    "given: pass damping= and compliance_at= to solve_modes."
                )
            return structure
        count = len(tuple(self.dofs)) - len(static)
        return solve_modes(structure, count=count, damping=self.damping, compliance_at=static)


def refused_partition(dofs: DofSet, basis: FloatArray, labels: tuple[str, ...], what: str) -> float:
    """Return the condition of phi_kk."""
    singular = la.svdvals(basis[dofs.indices(labels)])
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf
    if condition < 1.0 / TYPED:
        return condition
    raise ModelError(
        f"phi_kk is near singular: condition {condition:.3g} (limit {1.0 / TYPED:.0e}). The "
        f"DOFs do not distinguish the {what}, and M*, K* would be rounding. "
        + _proposal(dofs, basis, labels)
    )


def _proposal(dofs: DofSet, basis: FloatArray, labels: tuple[str, ...]) -> str:
    """Return a text with better DOFs in place of some of the given ones."""
    k = basis.shape[1]
    _, upper, order = la.qr(basis[dofs.indices(labels)].T, mode="economic", pivoting=True)
    size = np.abs(np.diag(upper))
    kept = [labels[i] for i in order[: int(np.count_nonzero(size > NEGLIGIBLE * size[0]))]]
    pool = [label for label in dofs.labels if label not in set(labels)]
    straight = [label for label in pool if ":r" not in label]
    for candidates in (straight, pool):
        taken = None
        with attempted(f"a choice of {k - len(kept)} of {len(candidates)} DOFs"):
            held, free = basis[dofs.indices(kept)], basis[dofs.indices(candidates)]
            taken = PivotedQr().chosen(held, free, k - len(kept))
        if taken is None or len(taken) < k - len(kept):
            continue
        fresh = [candidates[i] for i in taken]
        values = la.svdvals(basis[dofs.indices([*kept, *fresh])])
        if values[-1] > TYPED * values[0]:
            left = [label for label in labels if label not in set(kept)]
            return (
                f"Take {', '.join(fresh)} in place of {', '.join(left)}: condition "
                f"{values[0] / values[-1]:.3g}. Or select_dofs(modes, {k}, required=[those that "
                "must stay])."
            )
    return f"Choose others: select_dofs(modes, {k}, required=[those that must stay])."


def reduce(model: FEModel | Modes, method: ReductionMethod) -> ReducedModel:
    """Return a reduced model of a structure.

    Parameters
    ----------
    model : FEModel or Modes
        Structure to reduce. Every method accepts an `FEModel`. `DesiredDofs`, `ModalTruncation` and
        `ModalBalanced` need no matrices, and also accept the `Modes` of `solve_modes`.
    method : ReductionMethod
        Reduction method: `DesiredDofs` (the paper), `ModalTruncation`, `ModalBalanced`, `Guyan`,
        `Irs`, `Serep`, `CraigBampton`, `Rubin`, `MacNeal` or `Krylov`.

    Returns
    -------
    ReducedModel
        Reduced model. Its rigid-body motions are exact with every method. `ReducedModel.quality`
        gives its errors.

    Raises
    ------
    ShapeError
        When the numbers of DOFs and modes do not match.
    ModelError
        When the method needs another kind of structure or meets a singular matrix, or the modes are
        complex.

    References
    ----------
    [paper]_, equations (6)-(8).

    Examples
    --------
    A plate is reduced to five of its DOFs by static condensation:

    >>> from flexplant.structure import kirchhoff_plate
    >>> from flexplant.reduction import Guyan
    >>> plate = kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(4, 4), density=2702,
    ...                         youngs_modulus=70e9, poisson_ratio=0.35)
    >>> reduce(plate, Guyan(["1:z", "5:z", "13:z", "21:z", "25:z"]))
    <ReducedModel: 5 of 75 DOFs by static condensation (Guyan), 3 rigid-body motions, cond(M*) 5.59>
    """
    if not isinstance(model, FEModel | Modes) or not isinstance(method, ReductionMethod):
        raise ModelError(
            f"reduce needs an FEModel or Modes and a method, got {type(model).__name__} and "
            f"{type(method).__name__}: call reduce(model, DesiredDofs([...])) or "
            "reduce(model, fx.reduction.Guyan([...]))."
        )
    if not isinstance(method, DesiredDofs):
        refuse_unstable(model, f"reduction by {type(method).__name__}")
    with Progress(0, "reduction"):
        return method.reduced(model)
