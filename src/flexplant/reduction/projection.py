"""What all reductions by projection share: their matrices, damping and rigid-body motions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..checks import FloatArray, Matrix, name_list
from ..errors import LabelError, ModelError, SolverError
from ..labels import DofSet
from ..modes.modes import Modes
from ..sparse.factor import DENSE_LIMIT, dense, unit_diagonal
from ..sparse.multifrontal import MultifrontalCholesky
from ..structure import Damping, FEModel
from ..structure.eigen import elastic_modes
from ..tolerances import RANK, TINY
from .bounds import ErrorBound
from .reduced import ReducedModel

#: part of a rigid-body motion that a basis may miss
_RIGID_TOLERANCE = 1e-7
#: part of the loads that a solution may leave
_LEFT = 1e-7


class Solver:
    """A factorised positive definite matrix, dense or sparse."""

    def __init__(self, matrix: Matrix, singular: str) -> None:
        self._matrix: Any = matrix
        self._sparse = bool(sp.issparse(matrix) and matrix.shape[0] > DENSE_LIMIT)
        self._singular = singular
        if self._sparse:
            try:
                self._factor: Any = MultifrontalCholesky(matrix)
            except SolverError as error:
                raise ModelError(singular) from error
            return
        scaled, self._scale = unit_diagonal(dense(matrix))
        try:
            self._factor = la.cho_factor(dense(scaled), lower=True)
        except la.LinAlgError as error:
            raise ModelError(singular) from error
        # a root: pivots below 1e-14 of a unit diagonal are rounding
        if matrix.shape[0] and np.diag(self._factor[0]).min() < 1e-7:
            raise ModelError(singular)

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return the (n, m) solution, refined once."""
        if not loads.size:
            return np.zeros_like(loads)
        found = self._once(loads)
        found = found + self._once(loads - np.asarray(self._matrix @ found))
        left = np.linalg.norm(loads - np.asarray(self._matrix @ found))
        # a mechanism that rounding let through the factorisation takes no load
        if not left <= _LEFT * np.linalg.norm(loads):
            raise ModelError(self._singular)
        return found

    def _once(self, loads: FloatArray) -> FloatArray:
        if self._sparse:
            return np.asarray(self._factor.solve(np.ascontiguousarray(loads)))
        scale = self._scale[:, None]
        return np.asarray(la.cho_solve(self._factor, loads * scale) * scale)


def labels_given(dofs: Iterable[str], name: str) -> tuple[str, ...]:
    """Return labels as a tuple, none of them twice."""
    labels = name_list(dofs, name)
    if not labels:
        raise LabelError(f"no {name} are given: name at least one DOF, such as '41:z'.")
    seen = set(labels)
    if len(seen) < len(labels):
        doubled = sorted(label for label in seen if labels.count(label) > 1)
        raise LabelError(f"{name} {doubled} appear twice: what must be inverted would be singular.")
    return labels


def shown(labels: Sequence[str]) -> str:
    """Return a short text for labels."""
    return ", ".join(labels[:3]) + (f", ... {labels[-1]}" if len(labels) > 3 else "")


def fe_model(structure: FEModel | Modes, method: object) -> FEModel:
    """Return the structure when it has the matrices that a method needs."""
    if isinstance(structure, FEModel):
        return structure
    raise ModelError(
        f"{type(method).__name__} works on the matrices M and K, which "
        f"{type(structure).__name__} do not hold: reduce(model, {type(method).__name__}(...)) "
        "with the FEModel."
    )


def block(matrix: Matrix, rows: Any, columns: Any) -> Any:
    """Return a block of a dense or sparse matrix."""
    if sp.issparse(matrix):
        sparse: Any = matrix
        return sparse[rows][:, columns]
    return np.asarray(matrix)[np.ix_(rows, columns)]


def inner(matrix: Matrix, T: FloatArray) -> FloatArray:
    """Return ``T^T A T``, exactly symmetric."""
    product = T.T @ np.asarray(matrix @ T)
    return np.asarray(0.5 * (product + product.T), dtype=np.float64)


def modal_damping(
    M: FloatArray,
    K: FloatArray,
    rigid: FloatArray,
    damping: Damping,
    model: FEModel,
    T: FloatArray,
) -> FloatArray:
    """Return the D that gives the modes of a reduced model the ratios of a damping law."""
    omega, phi = elastic_modes(M, K, rigid)
    r = rigid.shape[1]
    omega_all = np.concatenate([np.zeros(r), omega])
    zeta = damping.ratios(omega_all, T @ np.hstack([rigid, phi]), model.K, model.dofs)[r:]
    force = M @ phi
    D = (force * (2 * zeta * omega)) @ force.T
    return np.asarray(0.5 * (D + D.T), dtype=np.float64)


def projected(
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
    """Return the model in the span of T: ``T^T M T``, ``T^T K T``, ``T^T D T``."""
    M, K = inner(model.M, T), inner(model.K, T)
    scaled, scale = unit_diagonal(M)
    values = la.eigvalsh(dense(scaled))
    if not values[0] > RANK * values[-1]:
        raise ModelError(
            f"the {T.shape[1]} coordinates of {method} depend on each other (condition of M* "
            f"{values[-1] / max(float(values[0]), TINY):.3g}): M* would be singular. "
            + (singular or "Take fewer.")
        )
    rigid = np.zeros((T.shape[1], 0))
    full = model.rigid_body
    if full.shape[1]:
        load = scale[:, None] * (T.T @ np.asarray(model.M @ full))
        rigid = scale[:, None] * la.solve(dense(scaled), load, assume_a="pos")
        missed = float(np.abs(T @ rigid - full).max() / np.abs(full).max())
        if not missed < _RIGID_TOLERANCE:
            raise ModelError(
                f"{method} does not hold the rigid-body motions of the structure (misses "
                f"{missed:.2g} of them): its poles at 0 would be lost. "
                + (singular or "Add coordinates that do.")
            )
    if damping is not None:
        D = modal_damping(M, K, rigid, damping, model, T)
    else:
        D = np.zeros_like(M) if model.D is None else inner(model.D, T)
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
