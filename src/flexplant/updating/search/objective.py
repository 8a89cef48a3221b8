"""All residuals and priors as one least-squares problem; its goodness of fit, its covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from ...arrays import ComplexArray, FloatArray, divisor, instance
from ...errors import SHOWN, ModelError
from ...tolerances import CHANCE, MISSED, NEGLIGIBLE, ROUNDING, SAME, TINY, TYPED
from ..family import Eigen, Family, Point, first_point, repeated_groups
from ..parameters import Parameter
from ..residuals.residual import Bound, BoundEigenvalues, Residual, mode_columns, splitting


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


class PoleRows:
    """All measured eigenvalues of an objective, weighted as its residuals weigh them."""

    def __init__(self, bounds: Sequence[BoundEigenvalues]) -> None:
        self.bounds = bounds
        self.numbers = tuple(n for bound in bounds for n in bound.numbers)
        self.target = np.concatenate([bound.target for bound in bounds])

    def whitened(self, rows: ComplexArray) -> FloatArray:
        """Return weighted [Re; Im] of complex rows (m,) or (m, q)."""
        ends = np.cumsum([len(bound.numbers) for bound in self.bounds])[:-1]
        parts = zip(self.bounds, np.split(rows, ends), strict=True)
        return np.concatenate([bound.whitened(part) for bound, part in parts])


def split_point(point: Point, data: PoleRows) -> Point:
    """Return the point with exactly repeated modes turned to the split of the next step."""
    # the split depends on the step, and the step on the split: among both directions of every
    # parameter, the step that fits best with its own split is used. Their numbers rise with their
    # new frequencies
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
        return point  # a mode is lost, which raises an error where it is needed
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
    split = splitting(family, point.eigen)

    def along(direction: FloatArray) -> tuple[ComplexArray, Eigen]:
        eigen, rows = split(direction)
        return np.array([rows.get(c, row) for c, row in zip(columns, S, strict=True)]), eigen

    for way in np.vstack([np.eye(scale.size), -np.eye(scale.size)]) / scale:
        turned, eigen = along(way)
        # rounding in the row of a vector that stays would give a step without bounds
        felt = np.where(np.abs(turned) > SAME * scale, turned, 0.0)
        white = data.whitened(felt) / scale
        step = np.linalg.lstsq(white, data.whitened(gap), rcond=MISSED)[0] / scale
        if np.any(step):
            turned, eigen = along(step)
        left = float(np.sum(data.whitened(gap - turned @ step) ** 2))
        if left < best[0]:
            best = (left, turned, eigen)
    return best[1], best[2]


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


def chi_square(objective: Objective, point: Point, free: FloatArray) -> tuple[float | None, int]:
    """Return `noise_misfit` and its degrees of freedom; those of all rows where no noise is known.

    The degrees of freedom are the number of rows minus the part of the parameters: the trace of
    these rows of the projector on all slopes, which is its rank where all noise is known. Rows
    with shared errors count by their share of independent ones, `Bound.independent`.
    """
    misfit = noise_misfit(objective, point, free)
    taken = np.sum(_orthonormal(objective.slopes(point)[:, free]) ** 2, axis=1)
    dof, data = 0.0, 0
    for bound, rows in objective.rows(point):
        data = rows.stop
        if misfit is None or bound.has_noise:
            left = rows.stop - rows.start - bound.lost - float(np.sum(taken[rows]))
            dof += bound.independent * left
    return misfit, max(round(dof + float(np.sum(1.0 - taken[data:]))), 0)


def independent_share(objective: Objective, point: Point) -> float:
    """Return the share of all rows that count as independent."""
    rows = [(bound.independent, at.stop - at.start) for bound, at in objective.rows(point)]
    return float(sum(share * count for share, count in rows) / sum(count for _, count in rows))


def noise_misfit(objective: Objective, point: Point, free: FloatArray) -> float | None:
    """Return ``|N^-1/2 r|^2`` of the residuals with known noise N, None without such.

    ``min_d |N^-1/2 (r + J d)|^2``, to first order, where all noise is known but other weights are
    given: it is distributed as chi-square for any weights.
    """
    if not any(bound.has_noise for bound in objective.bounds):
        return None
    r = objective.values(point)
    anew = objective.noise_known and not objective.noisy
    J = objective.slopes(point)[:, free] if anew else np.zeros((r.size, 0))
    for bound, at in objective.rows(point):
        if not bound.has_noise:
            r[at] = 0.0
        elif bound.noise is not None:
            r[at], J[at] = _whitened(bound.noise, r[at]), _whitened(bound.noise, J[at])
    Q = _orthonormal(J)
    r -= Q @ (Q.T @ r)
    data = objective.rows(point)
    found = sum(bound.independent * np.sum(r[at] ** 2) for bound, at in data)
    return float(found + np.sum(r[data[-1][1].stop :] ** 2))


def _orthonormal(J: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the columns of J."""
    if not J.size:
        return J
    U, s, _ = np.linalg.svd(J / divisor(np.linalg.norm(J, axis=0)), full_matrices=False)
    return np.asarray(U[:, s > TYPED * s[0]])


def _whitened(noise: Any, rows: FloatArray) -> FloatArray:
    """Return ``L^-1 rows`` with ``noise = L L^T``, which is banded where it is sparse."""
    if not sp.issparse(noise):
        return np.asarray(la.solve_triangular(la.cholesky(noise, lower=True), rows, lower=True))
    sparse: Any = noise
    coo = sparse.tocoo()
    apart = coo.row - coo.col
    width = int(apart.max())
    band = np.zeros((width + 1, coo.shape[0]))
    below = apart >= 0
    band[apart[below], coo.col[below]] = coo.data[below]
    return np.asarray(la.solve_banded((width, 0), la.cholesky_banded(band, lower=True), rows))


def chance(chi2: float | None, dof: int) -> float | None:
    """Return the probability of a larger chi-square by noise, None if not known."""
    if chi2 is None or dof < 1:
        return None
    from scipy.special import chdtrc

    return float(chdtrc(dof, chi2))


def is_bad(probability: float | None) -> bool:
    """Return whether noise hardly explains the residual."""
    return probability is not None and probability < CHANCE


def worst(objective: Objective, point: Point) -> str:
    """Return the residuals of known noise that fit worst, in words."""
    r = objective.values(point)
    found: dict[str, float] = {}
    for bound, rows in objective.rows(point):
        if not bound.has_noise:
            continue
        part, noise = r[rows], bound.noise
        size = np.abs(part) if noise is None else np.abs(part) / np.sqrt(noise.diagonal())
        for row in np.argsort(-size, kind="stable")[: 2 * SHOWN].tolist():
            name = bound.row_name(row)
            found[name] = max(found.get(name, 0.0), float(size[row]))
    order = sorted(found, key=lambda name: -found[name])[:SHOWN]
    return ", ".join(f"{name} ({found[name]:.3g} standard deviations)" for name in order)


def covariance(objective: Objective, point: Point) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation of the estimate, to first order."""
    # `G N G^T` with `G = (J^T J)^-1 J^T` and N the covariance of the weighted residuals where it is
    # known, the residual variance s^2 of the residuals without a scale
    J, r = objective.slopes(point), objective.values(point)
    q = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    safe = divisor(length)
    U, s, Vt = np.linalg.svd(J / safe, full_matrices=False)
    inverse = np.where(s > SAME * s[0], 1 / np.maximum(s, TINY), 0.0)
    half = (Vt.T * inverse) / safe[:, None]
    unit = half @ half.T
    # U^T N U, with N the covariance of known rows (a unit matrix of priors) and of the others
    known, other = np.zeros((s.size, s.size)), np.zeros((s.size, s.size))
    left, spare, data = 0.0, 0.0, 0
    for bound, rows in objective.rows(point):
        part, data = U[rows].T @ U[rows], rows.stop
        if bound.has_noise:
            known += bound.scatter * (U[rows].T @ bound.noise_times(U[rows]))
        else:
            other += part
            left += float(r[rows] @ r[rows])
            spare += r[rows].size - bound.lost - float(np.trace(part))
    known += U[data:].T @ U[data:]
    found: FloatArray | None = None
    if objective.noise_known or spare > 0.5:
        # half a row: a smaller trace of a projector is rounding
        variance = left / spare if spare > 0.5 else 0.0
        found = half @ (known + variance * other) @ half.T
        unit = found if objective.noise_known else unit
    std = np.sqrt(np.diag(unit))
    size = divisor(std)
    correlation = unit / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    regular = s.size == q and bool(s[-1] > SAME * s[0])
    return (found if regular else None), correlation


@dataclass(frozen=True, eq=False)
class Resolution:
    """Combinations of q parameters that residuals determine at a point, by singular values.

    The sensitivities have columns of length one: ``J diag(1/length) = U diag(values) axes``.
    """

    values: FloatArray
    axes: FloatArray
    #: (q,) one where a parameter is not seen
    length: FloatArray
    #: (q,) whether any residual depends on a parameter
    seen: npt.NDArray[np.bool_]

    @property
    def clear(self) -> npt.NDArray[np.bool_]:
        """Which combinations (q,) are determined."""
        return np.asarray(self.values > TYPED * self.values[0])

    def combinations(self, names: Sequence[str]) -> list[str]:
        """Return a text for each determined combination, with as few parameters as possible."""
        # the rows that span them, solved for the same number of parameters, each of which appears
        # once
        rows = self.axes[self.clear] * self.length
        rank = len(rows)
        pivots = la.qr(self.axes[self.clear], mode="r", pivoting=True)[1][:rank]
        reduced = np.linalg.solve(rows[:, pivots], rows)
        felt = np.abs(reduced) / self.length > NEGLIGIBLE / self.length[pivots][:, None]
        return [
            " ".join(
                [
                    names[pivot],
                    *(
                        f"{'-' if reduced[i, j] < 0 else '+'} {abs(reduced[i, j]):.3g} {names[j]}"
                        for j in np.flatnonzero(felt[i]).tolist()
                        if j not in pivots
                    ),
                ]
            )
            for i, pivot in sorted(enumerate(pivots.tolist()), key=lambda pair: pair[1])
        ]


def resolution(
    objective: Objective, point: Point, pinned: npt.NDArray[np.bool_] | None = None
) -> Resolution:
    """Return what the residuals determine at a point; `pinned`: known otherwise, as by a prior."""
    J = objective.slopes(point, prior=False)
    length = np.linalg.norm(J, axis=0)
    own = np.abs(J).max(initial=0.0) * ROUNDING
    omega = float(np.median(np.abs(point.eigen.poles))) if point.eigen.poles.size else 1.0
    reach = objective.family.strength(omega)
    # a column far below the possible effect of the parameter on this model is rounding: relative to
    # the strongest one, and, for a single parameter, as a relative change of the data
    strongest = float(np.max(length / reach, initial=0.0))
    change = np.linalg.norm(J / divisor(objective.size(point)[: len(J)])[:, None], axis=0)
    # nine decades below the strongest there is only rounding
    seen = (length > own) & (length > 1e-9 * strongest * reach)
    seen &= change > ROUNDING * reach / omega
    length = np.where(seen, length, 1.0)
    known = np.eye(seen.size)[[] if pinned is None else pinned]
    _, s, Vt = np.linalg.svd(np.vstack([np.where(seen, J / length, 0.0), known]))
    s = np.concatenate([s, np.zeros(seen.size - s.size)])
    return Resolution(s, Vt, length, seen)
