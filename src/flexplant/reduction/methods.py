"""`reduce`, the common part of reductions by projection, and the method of the paper."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, Matrix
from ..errors import LabelError, ModelError, ShapeError, SolverError, attempted, counted, some_names
from ..labels import DofSet, Place
from ..modes.modes import Modes, require_real
from ..modes.solve import solve_modes
from ..modes.statics import places
from ..parallel import Progress
from ..sparse.factor import DENSE_LIMIT, MultifrontalFactor
from ..sparse.symmetric import dense, projected, unit_diagonal
from ..store import Value, checked
from ..structure import Damping, FEModel
from ..structure.definite import elastic_modes, refuse_unstable
from ..tolerances import MISSED, NEGLIGIBLE, RANK, TINY, TYPED
from ..words import instance, name_list
from .criteria import PivotedQr
from .ranking import ErrorBound
from .reduced import ReducedModel


class Solver:
    """A factorised positive definite matrix, dense or sparse."""

    def __init__(self, matrix: Matrix, singular: str) -> None:
        self._matrix: Any = matrix
        self._singular = singular
        self._once: Callable[[FloatArray], Any]
        try:
            if sp.issparse(matrix) and matrix.shape[0] > DENSE_LIMIT:
                factor = MultifrontalFactor(matrix)
                self._once = lambda loads: factor.solve(np.ascontiguousarray(loads))
                return
            scaled, size = unit_diagonal(dense(matrix))
            lower = la.cholesky(dense(scaled), lower=True)
        except (SolverError, la.LinAlgError) as error:
            raise ModelError(singular) from error
        # a square root: pivots below 1e-14 of a unit diagonal count as zero
        if np.diag(lower).min(initial=1.0) < 1e-7:
            raise ModelError(singular)
        scale = size[:, None]
        self._once = lambda loads: la.cho_solve((lower, True), loads * scale) * scale

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return the (n, m) solution, refined once."""
        if not loads.size:
            return np.zeros_like(loads)
        found: FloatArray = self._once(loads)
        found = found + self._once(loads - np.asarray(self._matrix @ found))
        left = np.linalg.norm(loads - np.asarray(self._matrix @ found))
        # a mechanism that the factorisation did not detect, because of rounding, carries no load
        if not left <= MISSED * np.linalg.norm(loads):
            raise ModelError(self._singular)
        return found


def labels_given(dofs: Iterable[str], name: str) -> tuple[str, ...]:
    """Return labels as a tuple, none of them twice."""
    labels = name_list(dofs, name)
    if not labels:
        raise LabelError(f"{name} is empty: name at least one DOF, such as '41:z'.")
    if len(set(labels)) < len(labels):
        doubled = sorted({label for label in labels if labels.count(label) > 1})
        raise LabelError(f"{name} {doubled} appear twice: the matrix to invert would be singular.")
    return labels


def fe_model(structure: FEModel | Modes, method: object) -> FEModel:
    """Return the structure if it has the matrices that a method needs."""
    if isinstance(structure, FEModel):
        return structure
    raise ModelError(
        f"{type(method).__name__} works on the matrices M and K, which {type(structure).__name__} "
        f"do not hold: reduce(model, {type(method).__name__}(...)) with the FEModel."
    )


def block(matrix: Matrix, rows: Any, columns: Any) -> Any:
    """Return a block of a dense or sparse matrix."""
    if sp.issparse(matrix):
        sparse: Any = matrix
        return sparse[rows][:, columns]
    return np.asarray(matrix)[np.ix_(rows, columns)]


def projected_model(
    model: FEModel,
    T: FloatArray,
    *,
    dofs: DofSet,
    method: str,
    coordinates: Sequence[str] = (),
    damping: Damping | None = None,
    condition: float | None = None,
    condition_of: str = "M*",
    bound: ErrorBound | None = None,
    singular: str = "",
    static_at: Sequence[str] = (),
) -> ReducedModel:
    """Return the reduced model with the matrices ``T^T M T``, ``T^T K T`` and ``T^T D T``.

    Use this function in your own reduction method, after it has computed T (`ReductionMethod`).

    Parameters
    ----------
    model : FEModel
        Full structure.
    T : (n, k) array
        Columns that span the kept motions, including the rigid-body motions.
    dofs : DofSet
        DOFs of the k coordinates. Empty: the coordinates are not DOFs.
    method : str
        Name of the method, which messages and the printed model show.
    coordinates : sequence of str
        Names of the coordinates. They are needed if not all coordinates are DOFs.
    damping : Damping, optional
        Damping of the reduced model in place of the model's D.
    condition, condition_of : float, str
        Condition number of the matrix that your method inverts, and the name of this matrix.
    bound : ErrorBound, optional
        Bound of the error between channels, where your method has one.
    singular : str
        Advice that the error message gives when the columns of T depend on each other.
    static_at : sequence of str
        Labels whose static response is exact in the span of T.

    Returns
    -------
    ReducedModel
        Model whose motions are combinations of the columns of T.

    Raises
    ------
    ModelError
        When the columns of T depend on each other, or do not contain the rigid-body motions.

    Examples
    --------
    With T = I, the reduced model is the full model:

    >>> import numpy as np
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduction.projected_model(model, np.eye(3), dofs=model.dofs, method="none").M.diagonal()
    array([1., 1., 1.])
    """
    M, K = projected(model.M, T), projected(model.K, T)
    scaled, scale = unit_diagonal(M)
    values = la.eigvalsh(dense(scaled))
    if not values[0] > RANK * values[-1]:
        raise ModelError(
            f"the {T.shape[1]} coordinates of {method} depend on each other (condition of M* "
            f"{values[-1] / max(float(values[0]), TINY):.3g}): M* would be singular. "
            + (singular or "Take fewer.")
        )
    full = model.rigid_body
    load = scale[:, None] * (T.T @ np.asarray(model.M @ full))
    rigid = scale[:, None] * la.solve(dense(scaled), load, assume_a="pos")
    missed = float(np.abs(T @ rigid - full).max(initial=0.0))
    if not missed <= MISSED * np.abs(full).max(initial=0.0):
        raise ModelError(
            f"{method} does not hold the rigid-body motions of the structure (misses "
            f"{missed / np.abs(full).max():.2g} of them): its poles at 0 would be lost. "
            + (singular or "Add coordinates that do.")
        )
    if damping is not None:  # modes with the damping ratios of the law
        omega, phi = elastic_modes(M, K, rigid)
        omega, phi = np.concatenate([np.zeros(rigid.shape[1]), omega]), np.hstack([rigid, phi])
        zeta = damping.zeta(omega)
        D = projected(np.diag(2 * zeta * omega), (M @ phi).T)
    else:
        D = np.zeros_like(M) if model.D is None else projected(model.D, T)
    return ReducedModel(
        M=M,
        D=D,
        K=K,
        T=T,
        dofs=dofs,
        full_dofs=model.dofs,
        rigid_body=rigid,
        method=method,
        condition=float(values[-1] / values[0]) if condition is None else condition,
        condition_of=condition_of,
        coordinates=coordinates,
        bound=bound,
        static_at=static_at,
    )


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
