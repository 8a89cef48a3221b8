"""All residuals and priors as one least-squares problem, and the base class of searches."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...arrays import ComplexArray, FloatArray, divisor
from ...errors import ModelError
from ...parallel import tick
from ...store import Value
from ...words import instance
from ..family import Family, Point, first_point
from ..parameters import Parameter
from ..residuals.modal_residuals import BoundEigenvalues
from ..residuals.residual import Bound, Residual
from ..sensitivities import PoleRows, mode_columns, split_point


class Defect(NamedTuple):
    """Difference of the residuals of a better model, and of their derivatives."""

    #: parameters at which both models were compared
    p: FloatArray
    values: FloatArray
    slopes: FloatArray


class Objective:
    """``1/2 |r(p)|^2`` with r the whitened residuals and ``(p - mean) / std`` of the priors.

    Two finite bounds without a prior imply one: the model itself (zero, or the bound closest to it)
    is most probable, and the farther bound is three standard deviations away. Priors are used if
    the noise of every residual is known; otherwise their weight relative to the data is not
    defined.
    """

    def __init__(
        self,
        model: Any,
        parameters: Sequence[Parameter],
        residuals: Sequence[Residual],
        *,
        prior: bool = True,
        family: Family | None = None,
    ) -> None:
        self.parameters = tuple(parameters)
        self.residuals = checked_residuals(residuals)
        own = [n for r in self.residuals for n in compared_modes(r)]
        if family is None:
            family = Family(model, parameters, highest=max(own, default=6))
        self.family = family
        self.bounds = [residual.bound(family) for residual in self.residuals]
        self.numbers = tuple(dict.fromkeys(n for b in self.bounds for n in b.numbers))
        self.noisy = all(bound.noisy for bound in self.bounds)
        priors = [q.prior or _from_bounds(q) for q in parameters]
        self.has_prior = np.array([known is not None for known in priors], dtype=bool)
        self.prior_mean = np.array([0.0 if known is None else known[0] for known in priors])
        self.prior_std = np.array([1.0 if known is None else known[1] for known in priors])
        self.uses_prior = bool(prior and self.noisy and self.has_prior.any())
        #: derivatives (m, q) of the residuals of the priors that are used
        self.pull = -np.diag(1 / self.prior_std)[self.has_prior & self.uses_prior]
        limits = [q.bounds or (-np.inf, np.inf) for q in parameters]
        self.lower = np.array([low for low, _ in limits], dtype=np.float64)
        self.upper = np.array([high for _, high in limits], dtype=np.float64)
        poles = [bound for bound in self.bounds if isinstance(bound, BoundEigenvalues)]
        self.poles_measured = PoleRows(poles) if poles else None
        self.reference: Point | None = None
        self._point: Point | None = None
        self._first: Point | None = None
        #: the point from which modes are followed to the start of a search; None: numbered there
        self.origin: Point | None = None
        #: correction of the residuals, to first order about its parameters
        self.defect: Defect | None = None

    @property
    def default_start(self) -> FloatArray:
        """Prior means or zeros, moved between the bounds."""
        middle = np.clip(self.prior_mean, self.lower, self.upper)
        return np.asarray(middle, dtype=np.float64)

    def begin(self, p: FloatArray) -> Point:
        """Return the model at a start, its modes numbered there or followed from `origin`."""
        if self.origin is not None:
            self.back_to(self.origin)
            return self.at(p, refer=True)
        if self._first is None or not np.array_equal(self._first.p, p):
            point = first_point(self.family, p)
            last = point.eigen.n_rigid + point.eigen.poles.size
            stopped = np.any(p) and last < max(self.numbers, default=0) <= self.family.massive.size
            if self.numbers and not stopped:
                mode_columns(self.numbers, point.eigen)
            self._first = self._numbered(point)
        return self.back_to(self._first)

    def follow(self, points: Sequence[FloatArray], origin: Point | None = None) -> Point:
        """Return the model at the last of some points, its modes followed from `origin`.

        None: they are numbered at the first of the points.
        """
        self.origin = origin
        point = self.begin(points[0])
        for p in points[1:]:
            point = self.at(p, refer=True)
        return point

    def at(self, p: FloatArray, *, refer: bool = False) -> Point:
        """Return the model at `p`, its modes paired with those of the reference point."""
        if self.reference is None:
            return self.begin(p)
        if self._point is None or not np.array_equal(self._point.p, p):
            near = self.reference
            there = np.array_equal(near.p, p)
            self._point = near if there else self._numbered(near.continued(np.array(p)))
        return self.back_to(self._point) if refer else self._point

    def place(self, point: Point) -> Point:
        """Return a point with numbered modes as the reference."""
        return self.back_to(self._numbered(point))

    def back_to(self, point: Point) -> Point:
        """Return a point whose modes have numbers, as the reference."""
        self._point = self.reference = point
        return point

    def _numbered(self, point: Point) -> Point:
        """Return the point as numbered by the residuals, with repeated modes split."""
        if self.poles_measured is not None:
            point = split_point(point, self.poles_measured)
        for bound in self.bounds:
            point = bound.assigned(point)
        point.columns(self.numbers)
        return point

    def values(self, point: Point, *, prior: bool = True) -> FloatArray:
        """Return the residuals, then those of the priors."""
        rows = [bound.values(point) for bound in self.bounds]
        if self.defect is not None:
            moved = self.defect.slopes @ (point.p - self.defect.p)
            rows = [np.concatenate(rows) + self.defect.values + moved]
        if prior:
            rows.append(self.pull @ (point.p - self.prior_mean))
        return np.concatenate(rows)

    def slopes(self, point: Point, *, prior: bool = True) -> FloatArray:
        """Return the derivatives of `values`."""
        rows = [bound.slopes(point) for bound in self.bounds]
        if self.defect is not None:
            rows = [np.vstack(rows) + self.defect.slopes]
        if prior:
            rows.append(self.pull)
        return np.vstack(rows)

    def size(self, point: Point) -> FloatArray:
        """Return the measured value in units of each row of `values`."""
        rows = [np.broadcast_to(b.size, b.values(point).shape) for b in self.bounds]
        return np.concatenate([*rows, np.ones(len(self.pull))])

    @property
    def noise_known(self) -> bool:
        """Whether the covariance of all residuals is known, whatever their weights."""
        return all(bound.has_noise for bound in self.bounds)

    def rows(self, point: Point) -> list[tuple[Bound, slice]]:
        """Return which rows of `values` belong to each residual; those of the priors follow."""
        found, first = [], 0
        for bound in self.bounds:
            last = first + bound.values(point).size
            found.append((bound, slice(first, last)))
            first = last
        return found

    @property
    def text(self) -> str:
        """Text on the fitted data."""
        return " and ".join(bound.name for bound in self.bounds)

    def omega(self, point: Point) -> float:
        """Return a typical |lambda| of the followed modes, or of all modes."""
        poles = self.poles(point) if self.numbers else point.eigen.poles
        return float(np.median(np.abs(poles))) if poles.size else 1.0

    def poles(self, point: Point) -> ComplexArray:
        """Return the eigenvalues of the modes that are followed."""
        return point.eigen.poles[point.columns(self.numbers)]


def checked_residuals(residuals: Any) -> tuple[Residual, ...]:
    """Return the residuals as a tuple, checked."""
    listed = tuple(residuals) if isinstance(residuals, Sequence) else (residuals,)
    hint = "Pass the measurement as one: [Eigenvalues(measured)]."
    for residual in listed:
        instance(residual, Residual, "a residual", hint)
    if not listed:
        raise ModelError("residuals is empty: give at least one measurement.")
    return listed


def _from_bounds(parameter: Parameter) -> tuple[float, float] | None:
    low, high = parameter.bounds or (-np.inf, np.inf)
    if not np.isfinite(high - low):
        return None
    mean = float(np.clip(0.0, low, high))
    return mean, max(high - mean, mean - low) / 3


def compared_modes(residual: Residual) -> tuple[int, ...]:
    """Return the numbers of the modes a residual compares."""
    measured = getattr(residual, "measured", None)
    return tuple(getattr(measured, "modes", None) or ())


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
