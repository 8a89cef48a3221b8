"""Gauss-Newton secured by a trust region: what poles alone are fitted with by default."""

from __future__ import annotations

from dataclasses import dataclass

from ...checks import FloatArray
from ...errors import ModelError, SolverError
from .gauss_newton import GaussNewton
from .objective import Objective
from .trust_region import TrustRegion
from .update_method import SearchEnd, Trail, UpdateMethod


class Quick(GaussNewton):
    """Gauss-Newton that gives up where its steps reach too far: a trust region goes on."""

    halvings = 3


@dataclass(frozen=True, eq=False)
class Secured(UpdateMethod):
    """The paper's (13) and (14); from a start where they lead nowhere, a trust region.

    Both lower the same error (12). The end of the trust region is settled by the paper's steps,
    which say so where its S is singular.
    """

    keeps_bounds = False
    weighs_poles = True

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where the search from `start` ends; see `UpdateMethod.search`."""
        path, way, trouble = list(objective.path), [start], None
        before: Trail | None = None
        try:
            found = Quick().search(objective, start, most=most, tolerance=tolerance)
        except (ModelError, SolverError) as error:
            trouble, reason = error, str(error)
        else:
            # a limit that was given is kept to
            if found.converged or (most is not None and most <= GaussNewton.steps):
                return found
            before, way, reason = found.trail, found.trail.p, found.reason
        objective.path = [*path, *way[:-1]]
        try:
            found = TrustRegion().search(objective, way[-1], most=most, tolerance=tolerance)
        except (ModelError, SolverError) as error:
            raise trouble or error from None
        if trouble is not None and not found.converged:
            raise trouble
        found.tried = (f"Gauss-Newton: {reason}", f"trust region: {found.reason}")
        found.trail = found.trail if before is None else before.joined(found.trail)
        objective.path = [*path, *found.trail.p[:-1]]
        if not found.converged:
            return found
        try:
            settled = GaussNewton().search(objective, found.p, tolerance=tolerance)
        except SolverError:
            settled = found
        if settled is found or not settled.converged:
            objective.begin(found.p)
            return found
        settled.trail, settled.tried = found.trail.joined(settled.trail), found.tried
        return settled
