"""All residuals and priors as one least-squares problem over the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...checks import ComplexArray, FloatArray, instance
from ...errors import ModelError
from ..family import Eigen, Family, repeated_groups
from ..parameters.added import Parameter
from ..point_model import Point, first_point
from ..residuals.eigenvalues import BoundEigenvalues
from ..residuals.residual import Bound, Residual
from ..sensitivities import GroupDerivatives, group_derivatives, mode_columns, split_rotation


class Defect(NamedTuple):
    """What a better model's residuals, and their derivatives, are more than those of the model."""

    #: parameters where both models were compared
    p: FloatArray
    values: FloatArray
    slopes: FloatArray


class Objective:
    """``1/2 |r(p)|^2`` with r the whitened residuals and ``(p - mean) / std`` of the priors.

    Two finite bounds without a prior make one: the model itself (zero, or the bound nearest to it)
    the most probable, the farther bound three standard deviations away. Priors take part where the
    noise of every residual is known: else their weight against the data would not be.
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
        priors = [getattr(q, "prior", None) or _from_bounds(q) for q in parameters]
        self.has_prior = np.array([known is not None for known in priors])
        self.prior_mean = np.array([0.0 if known is None else known[0] for known in priors])
        self.prior_std = np.array([1.0 if known is None else known[1] for known in priors])
        self.uses_prior = bool(prior and self.noisy and self.has_prior.any())
        limits = [getattr(q, "bounds", None) or (-np.inf, np.inf) for q in parameters]
        self.lower = np.array([low for low, _ in limits], dtype=np.float64)
        self.upper = np.array([high for _, high in limits], dtype=np.float64)
        poles = [bound for bound in self.bounds if isinstance(bound, BoundEigenvalues)]
        self.poles_measured = PoleRows(poles) if poles else None
        self.reference: Point | None = None
        self._point: Point | None = None
        self._first: Point | None = None
        #: points through which modes are followed to where a search begins, numbered at the first
        self.path: list[FloatArray] = []
        #: what is added to the residuals, to first order about the parameters it was found at
        self.defect: Defect | None = None

    @property
    def default_start(self) -> FloatArray:
        """Prior means, zeros without, moved between the bounds."""
        middle = np.clip(self.prior_mean, self.lower, self.upper)
        return np.asarray(middle, dtype=np.float64)

    def begin(self, p: FloatArray) -> Point:
        """Return the model at a start, its modes numbered there or where `path` begins."""
        path = [*self.path, p]
        if self._first is None or not np.array_equal(self._first.p, path[0]):
            point = first_point(self.family, path[0])
            last = point.eigen.n_rigid + point.eigen.poles.size
            stopped = (
                np.any(path[0]) and last < max(self.numbers, default=0) <= self.family.massive.size
            )
            if self.numbers and not stopped:
                mode_columns(self.numbers, point.eigen)
            self._first = self._assigned(self._turned(point))
        point = self._set(self._first, refer=True)
        for step in path[1:]:
            point = self.at(step, refer=True)
        return point

    def follow(self, points: Sequence[FloatArray]) -> Point:
        """Return the model at the last of some points, its modes followed from the first one."""
        point = self.begin(points[0])
        for p in points[1:]:
            point = self.at(p, refer=True)
        return point

    def at(self, p: FloatArray, *, refer: bool = False) -> Point:
        """Return the model at `p`, its modes paired with those of the reference point."""
        if self._point is not None and np.array_equal(self._point.p, p):
            return self._set(self._point, refer=refer)
        if self.reference is None:
            return self.begin(p)
        if np.array_equal(self.reference.p, p):
            return self._set(self.reference, refer=refer)
        point = self.reference.continued(np.array(p))
        point = self._assigned(self._turned(point))
        return self._set(point, refer=refer)

    def place(self, point: Point) -> Point:
        """Return a point whose modes are numbered already, as the reference."""
        return self._set(self._assigned(self._turned(point)), refer=True)

    def _set(self, point: Point, *, refer: bool) -> Point:
        self._point = point
        if refer:
            self.reference = point
        return point

    def _assigned(self, point: Point) -> Point:
        for bound in self.bounds:
            point = bound.assigned(point)
        point.columns(self.numbers)
        return point

    def _turned(self, point: Point) -> Point:
        """Return the point with exactly repeated modes turned to the split of the next step."""
        return point if self.poles_measured is None else split_point(point, self.poles_measured)

    def values(self, point: Point, *, prior: bool = True) -> FloatArray:
        """Return the residuals, then those of the priors."""
        rows = [bound.values(point) for bound in self.bounds]
        if self.defect is not None:
            moved = self.defect.slopes @ (point.p - self.defect.p)
            rows = [np.concatenate(rows) + self.defect.values + moved]
        if prior and self.uses_prior:
            gap = (self.prior_mean - point.p) / self.prior_std
            rows.append(gap[self.has_prior])
        return np.concatenate(rows)

    def slopes(self, point: Point, *, prior: bool = True) -> FloatArray:
        """Return the derivatives of `values`."""
        rows = [bound.slopes(point) for bound in self.bounds]
        if self.defect is not None:
            rows = [np.vstack(rows) + self.defect.slopes]
        if prior and self.uses_prior:
            rows.append(-np.diag(1 / self.prior_std)[self.has_prior])
        return np.vstack(rows)

    def size(self, point: Point) -> FloatArray:
        """Return what the whole of a measured value is in each row of `values`."""
        rows = [np.broadcast_to(b.size, b.values(point).shape) for b in self.bounds]
        if self.uses_prior:
            rows.append(np.ones(int(self.has_prior.sum())))
        return np.concatenate(rows)

    @property
    def noise_known(self) -> bool:
        """Whether the covariance of all residuals is known, whatever their weights."""
        return all(bound.noisy or bound.noise is not None for bound in self.bounds)

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
        """What is fitted, in words."""
        return " and ".join(bound.name for bound in self.bounds)

    def omega(self, point: Point) -> float:
        """Return a typical |lambda| of the modes that are followed, of all where none is."""
        poles = self.poles(point) if self.numbers else point.eigen.poles
        return float(np.median(np.abs(poles))) if poles.size else 1.0

    def poles(self, point: Point) -> ComplexArray:
        """Return the eigenvalues of the modes that are followed."""
        return point.eigen.poles[point.columns(self.numbers)]


def checked_residuals(residuals: Any) -> tuple[Residual, ...]:
    """Return the residuals as a tuple, checked."""
    listed = tuple(residuals) if isinstance(residuals, Sequence) else (residuals,)
    for residual in listed:
        instance(
            residual,
            Residual,
            "a residual",
            "Pass the measurement as one: [Eigenvalues(measured)].",
        )
    if not listed:
        raise ModelError("residuals is empty: nothing was measured to update from.")
    return listed


def _from_bounds(parameter: Parameter) -> tuple[float, float] | None:
    low, high = getattr(parameter, "bounds", None) or (-np.inf, np.inf)
    if not np.isfinite(high - low):
        return None
    mean = float(np.clip(0.0, low, high))
    return mean, max(high - mean, mean - low) / 3


def compared_modes(residual: Residual) -> tuple[int, ...]:
    """Return the numbers of the modes a residual compares."""
    measured = getattr(residual, "measured", None)
    return tuple(getattr(measured, "modes", None) or ())


#: a parameter's effect below this share of what it could have is rounding
UNSEEN = 1e-9
#: singular values of S, its columns of length one, below which a step leaves them out
SINGULAR = 1e-7


class PoleRows:
    """All measured eigenvalues of an objective, weighted as its residuals weigh them."""

    def __init__(self, bounds: Sequence[BoundEigenvalues]) -> None:
        self.bounds = bounds
        self.numbers = tuple(n for bound in bounds for n in bound.numbers)
        self.target = np.concatenate([bound.target for bound in bounds])

    def whitened(self, rows: ComplexArray) -> FloatArray:
        """Return weighted [Re; Im] of complex rows (m,) or (m, q)."""
        found, first = [], 0
        for bound in self.bounds:
            last = first + len(bound.numbers)
            found.append(bound.whitened(rows[first:last]))
            first = last
        return np.concatenate(found)


def split_point(point: Point, data: PoleRows) -> Point:
    """Return the point with exactly repeated modes turned to the split of the next step.

    How repeated modes split depends on the step, and the step on how they split: try both
    directions of every parameter, and keep the step that fits best by the split it causes itself.
    Their numbers rise with the frequencies they move to: which of equal modes came first is a
    matter of rounding.
    """
    groups = repeated_groups(point.eigen.poles)
    if not groups:
        return point
    repeated = {i for group in groups for i in group}
    labels = point.labels.copy()
    for group in groups:
        labels[group] = np.sort(labels[group])
    point = Point(point.family, point.p, point.eigen, labels)
    try:
        columns = point.columns(data.numbers)
    except ModelError:
        return point  # a mode is lost: an error where it is needed
    family = point.family
    S = family.sensitivity(point.eigen, columns)
    eigen = point.eigen
    if repeated.intersection(columns):
        S, eigen = _best_split(point, columns, S, data)
    found = Point(family, point.p, eigen, point.labels)
    found.turned = dict(zip(data.numbers, S, strict=True))
    return found


def _best_split(
    point: Point, columns: list[int], S: ComplexArray, data: PoleRows
) -> tuple[ComplexArray, Eigen]:
    """Return S of (11) and the modes as the best step splits them."""
    family, poles = point.family, point.eigen.poles[columns]
    gap = data.target - poles
    scale = family.strength(float(np.median(np.abs(data.target))))
    best = (np.inf, S, point.eigen)
    groups = group_derivatives(family, point.eigen)
    for way in np.vstack([np.eye(scale.size), -np.eye(scale.size)]) / scale:
        S, eigen = _split_along(groups, point.eigen, columns, S, way)
        # rounding in the row of a vector that stays would give a step without bounds
        felt = np.where(np.abs(S) > UNSEEN * scale, S, 0.0)
        scaled, *_ = np.linalg.lstsq(
            data.whitened(felt) / scale, data.whitened(gap), rcond=SINGULAR
        )
        step = scaled / scale
        if np.any(step):
            S, eigen = _split_along(groups, point.eigen, columns, S, step)
        left = float(np.sum(data.whitened(gap - S @ step) ** 2))
        if left < best[0]:
            best = (left, S, eigen)
    return best[1], best[2]


def _split_along(
    groups: GroupDerivatives,
    eigen: Eigen,
    columns: list[int],
    S: ComplexArray,
    direction: FloatArray,
) -> tuple[ComplexArray, Eigen]:
    """Return S with the rows of repeated modes as they split along a direction, and the modes."""
    rotation = split_rotation(groups, eigen, direction)
    rows = [rotation.sensitivity.get(c, row) for c, row in zip(columns, S, strict=True)]
    return np.array(rows), rotation.eigen
