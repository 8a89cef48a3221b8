"""Gauss-Newton: the paper's (13) and (14) for any residuals, alone or secured by a trust region."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ...checks import FloatArray, between, checked
from ...errors import ModelError, SolverError, counted
from ..family import Point
from .objective import Objective, SearchEnd, Trail, UpdateMethod
from .trust_region import TrustRegion

#: what rounding leaves of an eigenvalue, relatively; the error may rise by as much
ROUNDING = 1e-11
#: a parameter's effect below this share of what it could have is none
UNSEEN = 1e-9
#: singular values of S, its columns of length one, below which parameters cannot be distinguished
SINGULAR = 1e-7
EXACT, STEP = "residual below the tolerance", "step below the tolerance"


@dataclass(frozen=True, eq=False)
class GaussNewton(UpdateMethod):
    """The paper's weighted Gauss-Newton iteration, (13) and (14), steps halved where they harm.

    Eigenvalues alone are weighted by W of (12). It ends where a full step would change nothing
    that is fitted by more than the tolerance, relatively.

    Parameters
    ----------
    truncate : float
        Singular values of the (column-scaled) sensitivities below this part of the largest are
        left out of a step: truncated SVD. Zero: all are used, and a singular S raises.

    References
    ----------
    [paper]_, equations (13) and (14).

    Examples
    --------
    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[615.0j], modes=[2]))
    >>> method = fx.updating.GaussNewton()
    >>> fx.update(drawing, [fx.AddedMass("3:x")], [poles], method=method).converged
    True
    """

    truncate: float = field(
        default=0.0,
        kw_only=True,
        metadata=checked(between, low=0.0, high=1.0, hint="Choose 1e-3, say.", ends="["),
    )

    #: how often a step that harms is halved
    halvings: ClassVar[int] = 30
    steps = 20
    keeps_bounds = False
    weighs_poles = True

    @property
    def penalised(self) -> bool:
        """Whether directions are left out, in which the answer stays at the start."""
        return self.truncate > 0

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where Gauss-Newton steps from `start` end; see `UpdateMethod.search`."""
        trail = Trail()
        p, point = start, objective.begin(start)
        r, size = objective.values(point), objective.size(point)
        trail.add(objective, p, 0.0)
        step, change = _gauss_newton_step(objective, point, r, self.truncate)
        converged = _is_small(r, size, tolerance)
        reason = EXACT if converged else "max_iterations reached"
        for _ in range(most or self.steps):
            if converged:
                break
            small = _is_small(change, size, tolerance)
            advanced = _advanced(objective, p, step, r, size, self.halvings)
            if advanced is None:
                converged, reason = small, STEP if small else "no part of a step helps"
                break
            fraction, r = advanced
            p = p + fraction * step
            point = objective.at(p, refer=True)
            trail.add(objective, p, fraction)
            step, change = _gauss_newton_step(objective, point, r, self.truncate)
            exact = _is_small(r, size, tolerance)
            if exact or small:
                converged, reason = True, EXACT if exact else STEP
        return SearchEnd(p, float(r @ r) / 2, trail, converged, reason)


def _is_small(rows: FloatArray, size: FloatArray, tolerance: float) -> bool:
    return bool(np.max(np.abs(rows) / size) < tolerance)


def _gauss_newton_step(
    objective: Objective, point: Point, r: FloatArray, truncate: float
) -> tuple[FloatArray, FloatArray]:
    """Return the step of (13) and the change of the residuals to first order.

    As the real least-squares problem that (13) comes from.
    """
    J = objective.slopes(point)
    length = np.linalg.norm(J, axis=0)
    names = [parameter.name for parameter in objective.parameters]
    reach = objective.family.strength(objective.omega(point)) / objective.omega(point)
    # what holds there alone is no matter of the measurement
    first = np.array_equal(point.p, objective.default_start)
    there = "" if first else f"with {objective.family.text(point.p)}, "
    unseen = length <= UNSEEN * reach * float(np.max(objective.size(point)))
    if unseen.any():
        missed = [name for name, none in zip(names, unseen, strict=True) if none]
        why = (
            "(it sits on the nodal lines of these modes, say). Measure a mode that moves there, or "
            "drop the parameter."
        )
        if there:
            why = (
                "(a mass or spring so large that its place stands still, say). Begin nearer to the "
                "answer (start=), or keep the parameters to what is possible (bounds=)."
            )
        raise ModelError(
            f"{', '.join(missed)} cannot be found from {objective.text}: {there}what is fitted "
            f"does not depend on it {why}"
        )
    U, s, Vt = np.linalg.svd(J / length, full_matrices=False)
    keep = s > max(truncate, SINGULAR) * s[0]
    if not truncate and not (keep.all() and s.size == len(names)):
        mixed = np.abs(np.linalg.svd(J / length)[2][-1])
        together = [name for name, part in zip(names, mixed, strict=True) if part > 0.1]
        raise ModelError(
            f"{', '.join(together)} cannot be distinguished by {objective.text} ({r.size} real "
            f"equations, {counted(len(names), 'unknown')}, S is singular): {there}some combination "
            "of them changes nothing. Measure more modes, drop one of them, give priors, begin "
            "elsewhere (start=) or cut it off, updating.GaussNewton(truncate=1e-3). "
            "identifiability(...) "
            "shows which."
        )
    step = -(Vt[keep].T @ ((U[:, keep].T @ r) / s[keep])) / length
    return step, J @ step


def _advanced(
    objective: Objective,
    p: FloatArray,
    step: FloatArray,
    r: FloatArray,
    size: FloatArray,
    halvings: int,
) -> tuple[float, FloatArray] | None:
    """Return the part of a step taken and the residuals there, None when no part lowers (12)."""
    rounding = ROUNDING * float(np.linalg.norm(size))
    limit = float(np.linalg.norm(r)) * (1 + ROUNDING) + rounding
    fraction, trouble = 1.0, ""
    for _ in range(halvings):
        try:
            found = objective.values(objective.at(p + fraction * step))
        except ModelError as error:
            trouble = str(error)
        else:
            trouble = ""
            if float(np.linalg.norm(found)) <= limit:
                return fraction, found
        fraction /= 2
    if trouble:
        raise SolverError(f"no part of a Gauss-Newton step keeps the model physical: {trouble}")
    return None


class Quick(GaussNewton):
    """Gauss-Newton that gives up where its steps reach too far: a trust region goes on."""

    halvings = 3


@dataclass(frozen=True, eq=False)
class Secured(UpdateMethod):
    """The paper's (13) and (14); from a start where they lead nowhere, a trust region.

    Its end is settled by the paper's steps, which say so where their S is singular.
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
        except ModelError as error:
            # where S was singular before, that is the reason
            raise trouble if isinstance(trouble, ModelError) else error from None
        if settled is found or not settled.converged:
            objective.begin(found.p)
            return found
        settled.trail, settled.tried = found.trail.joined(settled.trail), found.tried
        return settled
