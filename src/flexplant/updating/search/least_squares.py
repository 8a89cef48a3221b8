"""Searches: Gauss-Newton, the paper's (13) and (14), a trust region, or both in turn."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, between, divisor, one_of, positive, whole
from ...errors import ModelError, SolverError, counted
from ...parallel import tick
from ...store import Value, checked
from ...tolerances import CLOSE, MISSED, NULL, SAME
from ..family import Point
from .objective import Objective

Loss: TypeAlias = Literal["linear", "huber", "soft_l1", "cauchy"]
LOSSES = ("linear", "huber", "soft_l1", "cauchy")

#: reason of a search that ends where every step makes the matrices indefinite or loses a mode
EDGE = (
    "no step in the direction of descent is possible: it makes the matrices indefinite or loses "
    "a mode (bounds= limit a parameter to physical values)"
)

#: reason of a search that ends at a jump of the cost, and the predicted relative decrease there
STUCK = (
    "no step lowers the error as its slopes predict, probably since other modes are paired "
    "nearby (use another start=)"
)


#: reason of a search with a limit
STOPPED = "max_iterations reached"

#: label of the progress bar
ITERATIONS = "update, iterations"
#: steps that the searches from all starts of an update take together, on average
_STEPS = 40.0


@dataclass
class Trail:
    """The points a search has moved to."""

    p: list[FloatArray] = field(default_factory=list)
    poles: list[Any] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    fraction: list[float] = field(default_factory=list)

    def add(self, objective: Objective, p: FloatArray, fraction: float) -> None:
        """Add the point at `p`, where the objective is."""
        tick(ITERATIONS, _STEPS)
        point = objective.at(p)
        self.p.append(np.array(p))
        self.poles.append(objective.poles(point))
        self.error.append(float(np.sum(objective.values(point, prior=False) ** 2)))
        self.fraction.append(fraction)

    def joined(self, later: Trail) -> Trail:
        """Return this way and the one that goes on where it ends."""
        parts = zip(vars(self).values(), vars(later).values(), strict=True)
        return Trail(*(own + more[1:] for own, more in parts))


@dataclass
class SearchEnd:
    """Result of a search."""

    p: FloatArray
    cost: float
    trail: Trail
    converged: bool
    reason: str
    #: methods that were tried and their ends, if there were several
    tried: tuple[str, ...] = ()
    #: the model at the end
    point: Point | None = None


class UpdateMethod(Value):
    """The base class of methods that minimise the sum of squares of the residuals.

    A new method is a subclass that defines `search`.

    Examples
    --------
    The library's methods are instances of this class:

    >>> import flexplant as fx
    >>> isinstance(fx.updating.GaussNewton(), fx.updating.UpdateMethod)
    True
    """

    #: default largest number of steps
    steps: ClassVar[int] = 200
    #: whether it keeps to the bounds of parameters
    keeps_bounds: ClassVar[bool] = True
    #: whether eigenvalues alone are weighted by W of the paper's (12), not by their covariance
    weighs_poles: ClassVar[bool] = False

    @property
    def least_squares(self) -> bool:
        """Whether the result is the exact minimum of the sum of squares of all residuals."""
        return not self.penalised

    @property
    def penalised(self) -> bool:
        """Whether the search does not move in directions that the data determine badly.

        The result then depends on the start values, and its covariance is not known.
        """
        return False

    @abstractmethod
    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return the end of a search that starts from given values of the parameters.

        The result contains the parameters at the end and half the sum of squares there. It also
        contains all steps, whether the search converged, and the reason why it ended.

        Parameters
        ----------
        objective : Objective
            Half the sum of squares of the whitened residuals, as a function of the parameters.
        start : (q,) array
            Start values of the parameters.
        most : int, optional
            Largest number of steps; by default the attribute `steps` of the method.
        tolerance : float
            Relative change of the fitted values that counts as zero.

        Raises
        ------
        ModelError, SolverError
            When no step from the start helps.
        """


class SearchPlan(NamedTuple):
    """A method with its largest number of steps (None: its default) and relative tolerance."""

    method: UpdateMethod
    most: int | None
    tolerance: float

    def begun(self, objective: Objective, begin: FloatArray) -> SearchEnd:
        """Return the end of a search whose modes are numbered where it begins."""
        objective.origin = None
        return self._ended(objective, begin)

    def resumed(self, objective: Objective, end: SearchEnd) -> SearchEnd:
        """Return the end of a search that goes on from another's."""
        objective.origin = end.point
        found = self._ended(objective, end.p)
        found.trail, found.tried = end.trail.joined(found.trail), end.tried or found.tried
        return found

    def _ended(self, objective: Objective, begin: FloatArray) -> SearchEnd:
        found = self.method.search(objective, begin, most=self.most, tolerance=self.tolerance)
        found.point = objective.at(found.p, refer=True)
        return found


def unit_changes(objective: Objective, J: FloatArray) -> FloatArray:
    """Return what counts as one change of each parameter."""
    width = (objective.upper - objective.lower) / 2
    length = np.linalg.norm(J, axis=0)
    felt = 1 / divisor(length)
    unit = np.where(np.isfinite(width), width, felt)
    return np.asarray(np.where(objective.has_prior, objective.prior_std, unit), dtype=np.float64)


class _ImpossibleError(Exception):
    """No step from the last point is possible."""


@dataclass(frozen=True, eq=False)
class TrustRegion(UpdateMethod):
    """Levenberg-Marquardt steps in a trust region that keeps to the bounds of the parameters.

    The search is `scipy.optimize.least_squares` (method "trf") with exact gradients.

    Parameters
    ----------
    loss : {"linear", "huber", "soft_l1", "cauchy"}
        Loss function rho(r^2) of each whitened residual r, which is the residual divided by its
        standard deviation. All losses except "linear" reduce the effect of outliers.
    scale : float
        Number of standard deviations above which a residual counts as an outlier.

    References
    ----------
    [Branch1999]_.

    Examples
    --------
    The estimate ends at the upper bound:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[615.0j], modes=[2]))
    >>> bounded = [fx.AddedMass("3:x", bounds=(0.0, 0.1))]
    >>> fx.update(drawing, bounded, [poles], method=fx.updating.TrustRegion()).values.round(4)
    array([0.1])
    """

    loss: Loss = field(default="linear", kw_only=True, metadata=checked(one_of, choices=LOSSES))
    scale: float = field(default=1.0, kw_only=True, metadata=checked(positive))

    @property
    def least_squares(self) -> bool:
        """Whether the sum of squares is minimised, which is the loss "linear"."""
        return self.loss == "linear"

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return the end of a search from start values; see `UpdateMethod.search`."""
        most = whole(most or self.steps, "most")  # the step counter raises it
        return self._fitted(objective, start, objective.lower, objective.upper, most, tolerance)

    def _fitted(
        self,
        objective: Objective,
        start: FloatArray,
        low: FloatArray,
        high: FloatArray,
        most: int,
        tolerance: float,
    ) -> SearchEnd:
        """Minimise by least_squares; its points are references for pairing modes."""
        from scipy.optimize import least_squares

        trail = Trail()
        point = objective.begin(start)
        rows, count = (objective.values(point, prior=prior).size for prior in (False, True))
        loss: Any = self.loss if self.loss == "linear" else _data_loss(self.loss, rows)

        def values(p: FloatArray) -> FloatArray:
            try:
                return objective.values(objective.at(p))
            except ModelError:
                # least_squares would shorten the step to the last digit: the tolerance is enough
                if trail.p and la.norm((p - trail.p[-1]) / unit) <= tolerance * max(
                    1.0, float(la.norm(trail.p[-1] / unit))
                ):
                    raise _ImpossibleError from None
                return np.full(count, np.inf)

        def slopes(p: FloatArray) -> FloatArray:
            point = objective.at(p, refer=True)
            if not trail.p or not np.array_equal(trail.p[-1], p):
                trail.add(objective, p, 1.0 if trail.p else 0.0)
            return objective.slopes(point)

        # a start on a bound cannot move
        room = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(start), 1.0)) * 1e-8
        inside = np.clip(start, low + room, high - room)
        if not np.array_equal(inside, start):
            point = objective.begin(inside)
        unit = unit_changes(objective, objective.slopes(point, prior=False))

        def searched(start: FloatArray, most: int) -> Any:
            return least_squares(
                values,
                start,
                slopes,
                bounds=(low, high),
                method="trf",
                x_scale=unit,
                # the cost is flat at its minimum: a relative change of 1e-12 means 1e-6 standard
                # deviations
                ftol=max(1e-2 * tolerance, 2.3e-16),
                xtol=max(tolerance, 2.3e-16),
                gtol=1e-15,
                loss=loss,
                f_scale=self.scale,
                max_nfev=most,
            )

        stopped = STOPPED
        try:
            answer = searched(inside, most)
        except _ImpossibleError:
            answer, stopped = searched(trail.p[-1], 1), EDGE
        p = np.asarray(answer.x, dtype=np.float64)
        objective.at(p, refer=True)
        if not np.array_equal(trail.p[-1], p):
            trail.add(objective, p, 1.0)
        known = {0: stopped, 1: "gradient is zero", 2: "error no longer falls"}
        reason = known.get(answer.status, "step below the tolerance")
        converged = answer.status > 0
        judged = converged and self.loss == "linear"
        if judged and _is_stuck(answer, objective.size(point), tolerance):
            converged, reason = False, STUCK
        return SearchEnd(p, float(answer.cost), trail, converged, reason)


def _is_stuck(answer: Any, size: FloatArray, tolerance: float) -> bool:
    """Return whether slopes predict a lower cost, though every step was refused."""
    # at a minimum they predict almost no decrease, at a jump of the cost they do
    J = answer.jac[:, answer.active_mask == 0]
    Q = la.qr(J / divisor(np.linalg.norm(J, axis=0)), mode="economic")[0]
    change = Q @ (Q.T @ answer.fun)
    if np.sum(change**2) <= CLOSE * np.sum(answer.fun**2):
        return False
    return bool(np.max(np.abs(change[: size.size]) / size) > tolerance)


def _data_loss(name: Loss, rows: int) -> Callable[[FloatArray], FloatArray]:
    """Return rho, rho', rho'' with the named loss on the first rows and squares on the others."""
    # a prior does not count as an outlier

    def rho(z: FloatArray) -> FloatArray:
        out = np.vstack([z, np.ones_like(z), np.zeros_like(z)])
        t = 1 + z[:rows]
        if name == "cauchy":
            parts = np.log(t), 1 / t, -1 / t**2
        elif name == "soft_l1":
            parts = 2 * (np.sqrt(t) - 1), t**-0.5, -0.5 * t**-1.5
        else:
            root = np.sqrt(np.maximum(z[:rows], 1.0))
            far = z[:rows] > 1
            parts = (
                np.where(far, 2 * root - 1, z[:rows]),
                1 / root,
                np.where(far, -0.5 / root**3, 0),
            )
        out[:, :rows] = parts
        return out

    return rho


EXACT, STEP = "residual below the tolerance", "step below the tolerance"


@dataclass(frozen=True, eq=False)
class GaussNewton(UpdateMethod):
    """The paper's weighted Gauss-Newton iteration, (13) and (14), with step halving.

    The equations are those of the paper that is cited below. If only eigenvalues are fitted, they
    are weighted by the matrix W of equation (12). The iteration ends when a full step changes the
    fitted values by less than the relative tolerance.

    Parameters
    ----------
    truncate : float
        Relative limit of the singular values of the (column-scaled) sensitivities S. Singular
        values below this fraction of the largest one are left out of a step (truncated SVD). Zero:
        all are used, and a singular S raises an error.

    References
    ----------
    [paper]_, equations (13) and (14).

    Examples
    --------
    An added mass is fitted to one pole:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[615.0j], modes=[2]))
    >>> fx.update(drawing, [fx.AddedMass("3:x")], [poles], method=GaussNewton()).converged
    True
    """

    truncate: float = field(
        default=0.0,
        kw_only=True,
        metadata=checked(between, low=0.0, high=1.0, hint="Choose for example 1e-3.", ends="["),
    )

    #: largest number of halvings of a step
    halvings: ClassVar[int] = 30
    steps = 20
    keeps_bounds = False
    weighs_poles = True

    @property
    def penalised(self) -> bool:
        """Whether singular values are left out, so that the result depends on the start values."""
        return self.truncate > 0

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return the end of a search by Gauss-Newton steps; see `UpdateMethod.search`."""
        trail = Trail()
        p, point = start, objective.begin(start)
        r, size = objective.values(point), objective.size(point)
        trail.add(objective, p, 0.0)
        step, change = _gauss_newton_step(objective, point, r, self.truncate)
        converged = _is_small(r, size, tolerance)
        reason = EXACT if converged else STOPPED
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
    """Return the step of (13) and the change of the residuals to first order."""
    # as the real least-squares problem behind (13)
    J = objective.slopes(point)
    length = np.linalg.norm(J, axis=0)
    names = [parameter.name for parameter in objective.parameters]
    reach = objective.family.strength(objective.omega(point)) / objective.omega(point)
    # the reason may hold only at this point
    first = np.array_equal(point.p, objective.default_start)
    there = "" if first else f"with {objective.family.text(point.p)}, "
    unseen = length <= SAME * reach * float(np.max(objective.size(point)))
    if unseen.any():
        missed = [name for name, none in zip(names, unseen, strict=True) if none]
        why = (
            "(it may lie on the nodal lines of these modes). Measure a mode that moves there, or "
            "drop the parameter."
        )
        if there:
            why = (
                "(a mass or spring may be so large that its place does not move). Begin closer "
                "to the solution (start=), or limit the parameters to physical values (bounds=)."
            )
        raise ModelError(
            f"{', '.join(missed)} cannot be found from {objective.text}: {there}the fitted "
            f"values do not depend on it {why}"
        )
    U, s, Vt = np.linalg.svd(J / length, full_matrices=False)
    keep = s > max(truncate, MISSED) * s[0]
    if not truncate and not (keep.all() and s.size == len(names)):
        mixed = np.abs(np.linalg.svd(J / length)[2][-1])
        together = [name for name, part in zip(names, mixed, strict=True) if part > 0.1]
        raise ModelError(
            f"{', '.join(together)} cannot be distinguished by {objective.text} ({r.size} real "
            f"equations, {counted(len(names), 'unknown')}, S is singular): {there}some "
            "combination of them has no effect. Measure more modes, drop one of them, give "
            "priors, use another start= or truncate, updating.GaussNewton(truncate=1e-3). "
            "fx.updating.identifiability(...) "
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
    """Return the fraction of a step and the residuals there, None if no fraction lowers (12)."""
    rounding = NULL * float(np.linalg.norm(size))
    limit = float(np.linalg.norm(r)) * (1 + NULL) + rounding
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
        raise SolverError(
            f"every fraction of a Gauss-Newton step makes the model unphysical: {trouble}"
        )
    return None


class Quick(GaussNewton):
    """Gauss-Newton that gives up where its steps are too long; a trust region continues."""

    halvings = 3


@dataclass(frozen=True, eq=False)
class Auto(UpdateMethod):
    """The paper's (13) and (14); where they fail, a trust region.

    The paper's steps refine its end, and report a singular S.
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
        """Return the end of a search from start values; see `UpdateMethod.search`."""
        begin, trouble = start, None
        before: Trail | None = None
        try:
            found = Quick().search(objective, start, most=most, tolerance=tolerance)
        except (ModelError, SolverError) as error:
            trouble, reason = error, str(error)
        else:
            # a given limit is respected
            if found.converged or (most is not None and most <= GaussNewton.steps):
                return found
            before, begin, reason = found.trail, found.p, found.reason
            objective.origin = objective.at(begin, refer=True)
        try:
            found = TrustRegion().search(objective, begin, most=most, tolerance=tolerance)
        except (ModelError, SolverError) as error:
            raise trouble or error from None
        # a search that was cut short may still find a minimum
        if trouble is not None and not found.converged and found.reason != STOPPED:
            raise trouble
        found.tried = (f"Gauss-Newton: {reason}", f"trust region: {found.reason}")
        found.trail = found.trail if before is None else before.joined(found.trail)
        if not found.converged:
            return found
        objective.origin = objective.at(found.p, refer=True)
        try:
            settled = GaussNewton().search(objective, found.p, tolerance=tolerance)
        except SolverError:
            settled = found
        except ModelError as error:
            # where S was singular before, this is the reason
            raise trouble if isinstance(trouble, ModelError) else error from None
        if settled is found or not settled.converged:
            objective.begin(found.p)
            return found
        settled.trail, settled.tried = found.trail.joined(settled.trail), found.tried
        return settled
