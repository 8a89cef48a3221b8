"""Reduction by projection on a basis: the matrices, their factors and the reduced model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, Matrix
from ..errors import ModelError, SolverError
from ..labels import DofSet
from ..modes.modes import Modes
from ..sparse.factor import DENSE_LIMIT, MultifrontalFactor
from ..sparse.symmetric import dense, projected, unit_diagonal
from ..structure import Damping, FEModel
from ..structure.definite import elastic_modes
from ..tolerances import MISSED, RANK, TINY
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
