"""The full structure of a model in a basis for its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray
from ..errors import ModelError, ShapeError
from ..modes import solve_modes
from ..modes.dynamic_basis import static_shapes
from ..modes.matching import pair
from ..reduction import ReducedModel
from ..sparse.symmetric import beyond, projected
from ..structure.model import FEModel
from .family import Point, changed_matrices
from .parameters import Parameter, PointParameter
from .residuals.residual import Residual
from .search import Objective
from .search.objective import compared_modes

#: number of modes of the basis for each coordinate of the reduced model
WIDER = 4


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
        D = np.zeros((V.shape[1], V.shape[1]))
        if full.D is not None:
            D = projected(full.D, V)
        elif self.reduced is not None:
            known = la.lstsq(self.reduced.M, self.reduced.T.T @ np.asarray(full.M @ V))[0]
            D = projected(self.reduced.D, known)
        rigid = V.T @ np.asarray(full.M @ full.rigid_body)
        return ReducedModel(
            M=projected(full.M, V),
            D=D,
            K=projected(full.K, V),
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
        objective.place(near.followed(found, family, near.p, eigen))
        return objective

    def _basis(self, p: FloatArray) -> FloatArray:
        """Return the M-orthonormal basis (n, k) at `p`, rigid-body motions of the model first."""
        parts = changed_matrices(self.full, self.parameters, p)
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
