"""A model with changed parameters, and the full structure in a basis for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, Matrix
from ..errors import ModelError, ShapeError, attempted, warn
from ..modes import solve_modes
from ..modes.dynamic_basis import static_shapes
from ..reduction import ReducedModel
from ..sparse.symmetric import beyond, matrix_sum, orthonormalised
from ..structure.definite import why_indefinite
from ..structure.model import FEModel
from ..tolerances import FOUR_DIGITS
from .family import Family, Point, pair
from .parameters import Parameter, PointParameter
from .residuals.residual import Residual
from .search import Objective
from .search.objective import compared_modes


def changed_model(
    model: Any,
    parameters: Sequence[Parameter],
    p: FloatArray,
    family: Family | None = None,
    std: FloatArray | None = None,
) -> Any:
    """Return the model with the parameters at `p` and its remaining rigid-body motions."""
    # `family` has the same parameters; `std` are their standard deviations, for an error message
    if isinstance(model, FEModel):
        total = _changes(model, parameters, p)
        try:
            return _replaced(model, total, parameters, p, std)
        except ModelError:
            found = _with_drag(model, total)
            if found is None:
                raise
            return found
    family = Family(model, parameters) if family is None else family
    changes: dict[str, Any] = {
        name: matrix_sum(getattr(model, name), change if np.any(change) else None)
        for name, change in zip("MDK", family.changes(p), strict=True)
    }
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    return _replaced(model, changes, parameters, p, std)


def applied(model: Any, parameters: Sequence[Parameter], p: FloatArray) -> Any:
    """Return another model of the same structure with the parameters at `p`."""
    damped = isinstance(model, FEModel) and model.D is None
    if damped and any(
        q.matrices(model)[1] is not None and v for q, v in zip(parameters, p, strict=True)
    ):
        warn(
            "the model has no D: the D of the updated model would contain only the parameters of "
            "the update, and solve_modes(..., damping=) would replace it. Apply the update to a "
            "model with damping, for example model.with_damping(ModalDamping(0.01))."
        )
    return changed_model(model, parameters, p)


def _changes(
    model: FEModel, parameters: Sequence[Parameter], p: FloatArray
) -> dict[str, Matrix | None]:
    """Return M, D and K with the parameters at `p`."""
    # add the small changes first, since the matrices of the model are large
    total: dict[str, Matrix | None] = dict.fromkeys("MDK")
    for parameter, value in zip(parameters, p.tolist(), strict=True):
        for name, part in zip("MDK", parameter.change(model, value), strict=True):
            total[name] = matrix_sum(total[name], part)
    return {name: matrix_sum(getattr(model, name), part) for name, part in total.items()}


def _with_drag(model: FEModel, changes: dict[str, Any]) -> FEModel | None:
    """Return the model if its D fails only by a slight negative damping of rigid motion."""
    # its sign does not matter below 1e-4 of the first elastic frequency (`normal_form`)
    D = changes["D"]
    if D is None or not model.rigid_body.shape[1]:
        return None
    held = None
    with attempted("the updated model without its damping", ModelError):
        held = model.replace(M=changes["M"], K=changes["K"], D=None)
    if held is None:
        return None
    rigid = held.rigid_body
    drag = float(np.abs(np.linalg.eigvalsh(rigid.T @ np.asarray(D @ rigid))).max())
    first = solve_modes(held, count=rigid.shape[1] + 1).omega[-1]
    if drag > FOUR_DIGITS * float(first):
        return None
    # the rigid-body part of D + d M is 0 in theory, so that twice d is above rounding
    shifted = matrix_sum(D, 2.0 * drag * held.M)
    try:
        model.replace(D=shifted)
    except ModelError:
        return None
    return held.with_unchecked_damping(D)


def _replaced(
    model: Any,
    changes: dict[str, Any],
    parameters: Sequence[Parameter],
    p: FloatArray,
    std: FloatArray | None,
) -> Any:
    try:
        # the joints of a machine were checked with the previous matrices
        gone = {"joining": None} if getattr(model, "joining", None) is not None else {}
        return model.replace(**changes, **gone)
    except ModelError as error:
        deviations = [None] * p.size if std is None else std.tolist()
        found = zip(parameters, p.tolist(), deviations, strict=True)
        text = ", ".join(q.text(v, deviation) for q, v, deviation in found)
        why = _impossible(model, changes, parameters, p) or error
        raise ModelError(
            f"the update ended at {text}, which the {type(model).__name__} refuses: {why}"
        ) from None


def _impossible(
    model: Any, changes: dict[str, Any], parameters: Sequence[Parameter], p: FloatArray
) -> str:
    """Return a text on an indefinite D or K and the parameters that cause it, else empty."""
    for name in "DK":
        said = "" if changes[name] is None else why_indefinite(changes[name], name)
        if not said:
            continue
        at = "MDK".index(name)
        negative = [
            q.name
            for q, v in zip(parameters, p.tolist(), strict=True)
            if v < 0 and q.change(model, v)[at] is not None
        ]
        keep = ", ".join(negative) or "the parameters"
        return (
            f"{said} The measurement alone does not keep {keep} physical: give bounds=, (0.0, "
            "None) for quantities that can only be added, or measure more."
        )
    return ""


#: number of modes of the basis for each coordinate of the reduced model
WIDER = 4
#: number of DOFs above which an FEModel is updated in such a basis, and above which it is too large
LARGE, TOO_LARGE = 300, 20_000


def is_large(model: Any) -> bool:
    """Return whether a model is an FEModel that is updated in a basis."""
    if not isinstance(model, FEModel) or model.n_dof <= LARGE:
        return False
    if model.n_dof > TOO_LARGE:
        raise ModelError(
            f"updating an FEModel of {model.n_dof} DOFs (limit {TOO_LARGE}) solves it again for "
            "each estimate. Reduce it, rom = reduce(...), and pass update(rom, ..., "
            "full=model), which needs a few solutions."
        )
    return True


class FullBasis:
    """The full model ``M + p dM`` and so on, at any `p`, as a large reduced model made at this p.

    Its basis holds the lowest modes of the full structure at `p`, the static response ``u = G f``
    to unit forces f at all places of measurement and parameters, and ``G M u``: responses have an
    error of order ``(f / f_cut)^8`` of what the truncated modes give.
    """

    def __init__(
        self,
        full: Any,
        parameters: Sequence[Parameter],
        residuals: Sequence[Residual],
        reduced: Any = None,
    ) -> None:
        if not isinstance(full, FEModel) or not isinstance(reduced, ReducedModel | None):
            raise ModelError(
                f"full= needs a reduced model and the FEModel it was made from, got "
                f"{type(reduced).__name__} and {type(full).__name__}. Pass update(reduced, ..., "
                "full=model)."
            )
        if reduced is not None and full.dofs.labels != reduced.full_dofs.labels:
            raise ModelError(
                f"full has {len(full.dofs)} DOFs that are not the {len(reduced.full_dofs)} of the "
                "reduced model's structure, in this order: they belong to different structures. "
                "Pass the FEModel that was reduced."
            )
        self.full, self.reduced = full, reduced
        self.parameters, self.residuals = tuple(parameters), tuple(residuals)
        loaded = [pair for residual in residuals for pair in residual.loaded]
        loads = [full.dofs.row(place, direction) for place, direction in loaded]
        for q in parameters:
            if isinstance(q, PointParameter):
                loads += q.rows(full)  # the force of p r r^T acts along r
        try:
            for q in parameters:
                q.matrices(full)
        except ShapeError as error:
            raise ShapeError(
                f"{error} The full model needs the matrices of all its DOFs: give these; they "
                "are projected on the reduced model."
            ) from None
        self.loads = np.array(loads).reshape(-1, full.n_dof).T

    def at(self, p: FloatArray) -> ReducedModel:
        """Return the full model with zero parameters, in the basis that is accurate at `p`."""
        full, V = self.full, self._basis(p)
        M, K = (np.asarray(V.T @ (part @ V)) for part in (full.M, full.K))
        D = np.zeros_like(M)
        if full.D is not None:
            D = np.asarray(V.T @ (full.D @ V))
        elif self.reduced is not None:
            known = la.lstsq(self.reduced.M, self.reduced.T.T @ np.asarray(full.M @ V))[0]
            D = known.T @ self.reduced.D @ known
        rigid = V.T @ np.asarray(full.M @ full.rigid_body)
        return ReducedModel(
            M=(M + M.T) / 2,
            D=(D + D.T) / 2,
            K=(K + K.T) / 2,
            T=V,
            dofs=full.dofs.select(()),
            full_dofs=full.dofs,
            rigid_body=rigid,
            method="a basis at the estimate",
            coordinates=[f"vector {i + 1}" for i in range(V.shape[1])],
        )

    def objective(self, near: Point) -> Objective:
        """Return the residuals of the full model at a point of the reduced one, modes paired."""
        model = self.at(near.p)
        objective = Objective(model, self.parameters, self.residuals, prior=False)
        family, eigen = objective.family, objective.family.at(near.p)
        # shapes of both in coordinates where the mass matrix is the unit matrix
        known: Any = near.family.model
        seen = known.T @ (near.family.V @ near.eigen.X)
        old = family.V.T @ (model.T.T @ np.asarray(self.full.M @ seen))
        found = pair(near.eigen.poles, old, family.weighted(eigen.X))
        labels = np.zeros(eigen.poles.size, dtype=np.int64)
        labels[found[found >= 0]] = near.labels[found >= 0]
        objective.place(Point(family, near.p, eigen, labels))
        return objective

    def _basis(self, p: FloatArray) -> FloatArray:
        """Return the M-orthonormal basis (n, k) at `p`, rigid-body motions of the model first."""
        parts = _changes(self.full, self.parameters, p)
        changed = self.full.replace(M=parts["M"], K=parts["K"], D=None)
        phi, static = self._modes(changed), static_shapes(changed, self.loads)
        M: Any = self.full.M
        V = np.array(self.full.rigid_body)
        for part in (phi, static):
            V = np.hstack([V, beyond(M, V, part)])
        return V

    def _modes(self, model: FEModel) -> FloatArray:
        """Return the shapes of a changed model that belong to the basis."""
        n = model.n_dof
        if self.reduced is not None:
            return np.real(solve_modes(model, count=min(WIDER * self.reduced.n_dof, n)).phi)
        highest = max((number for r in self.residuals for number in compared_modes(r)), default=6)
        top = WIDER * max(residual.top for residual in self.residuals)
        modes = solve_modes(model, count=min(WIDER * highest, n))
        if modes.n_modes < n and modes.omega[-1] < top:
            modes = solve_modes(model, below=top / (2 * np.pi))
        return np.real(modes.phi)
