"""Searches from one start, through easier problems, and from several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..checks import FloatArray, Rng, generator, real_array, whole
from ..errors import FlexplantError, ModelError, ShapeError, SolverError
from ..tolerances import divisor
from .judgement.goodness import chance, chi_square, is_bad
from .parameters.added import PointParameter
from .residuals.eigenvalues import Eigenvalues
from .residuals.frf_residual import FrfResidual
from .residuals.mode_shapes import ModeShapes
from .residuals.residual import Residual
from .search import Objective, SearchEnd, TrustRegion, UpdateMethod
from .search.update_method import Trail
from .sensitivities import checked_values
from .update_result import Starts

#: relative variance of each entry of a response in the first fit, beside its noise
EVEN = 0.1
#: relative tolerance of a fit that only has to come near
ENOUGH = 1e-3


def _approach(
    objective: Objective, begin: FloatArray, most: int | None, tolerance: float
) -> Trail | None:
    """Return the way from `begin` to a better start, None if there is none; `objective` follows it.

    Complex responses have a minimum wherever a peak of the model lies between two measured ones;
    the logarithm of their magnitude, all entries weighted equally, hardly any. Shapes turn when
    modes are near each other, so poles come first.
    """
    easier = _easier(objective.residuals)
    if easier is None:
        return None
    stage = Objective(
        objective.family.model,
        objective.parameters,
        easier,
        prior=objective.uses_prior,
        family=objective.family,
    )
    trail, near = Trail(), max(tolerance, ENOUGH)
    try:
        found = TrustRegion().search(stage, begin, most=most, tolerance=near)
        path = [begin, *found.trail.p[1:]]
        # the modes are numbered at the start, and followed from there
        objective.begin(begin)
        for p in path:
            objective.at(p, refer=True)
            trail.add(objective, p, 1.0 if trail.p else 0.0)
    except FlexplantError:
        return None
    objective.path = path[:-1]
    return trail if len(path) > 1 else None


def _easier(residuals: Sequence[Residual]) -> list[Residual] | None:
    """Return residuals that converge from farther away, None when they are those given."""
    has_poles = any(isinstance(r, Eigenvalues) for r in residuals)
    found: list[Residual] = []
    for residual in residuals:
        if isinstance(residual, ModeShapes) and has_poles:
            continue
        found.append(_magnitude(residual) if isinstance(residual, FrfResidual) else residual)
    same = len(found) == len(residuals) and all(
        a is b for a, b in zip(found, residuals, strict=True)
    )
    return None if same else found


def _magnitude(residual: FrfResidual) -> FrfResidual:
    """Return the residual of the logarithm of the magnitude, all entries about equally weighted."""
    size = np.abs(residual.measured.data) ** 2
    if residual.magnitude or np.any(size[:, :, residual.lines] == 0):
        return residual
    noise = 0.0 if residual.variance is None else residual.variance
    # lines that are not used may be zero
    variance = np.maximum(EVEN * size + noise, np.finfo(float).tiny)
    return residual.replace(magnitude=True, variance=variance)


#: part of the measured power that a minimum leaves which has little to do with the measurement
ABSURD = 0.1
#: relative distance of a pole from the measured one, beyond noise, that a wrong pairing may leave
FAR = 1e-3
#: other starts that are tried after such an end, for models of up to so many DOFs and larger ones
RETRIES, SMALL, RETRIES_LARGE = 20, 100, 4


def from_one_start(
    objective: Objective,
    begin: FloatArray,
    method: UpdateMethod,
    most: int | None,
    tolerance: float,
    rng: Rng,
) -> tuple[SearchEnd, list[FloatArray], list[SearchEnd | None]]:
    """Return the best end, the objective being there, all starts that were tried and their ends.

    Where the end explains nothing of responses (a peak of the model lies on a wrong measured one),
    or is far from poles alone (modes may have been paired wrongly), other starts are tried.
    """
    begins = [begin]
    best = _led(objective, begin, method, most, tolerance)
    ends: list[SearchEnd | None] = [best]
    if not _improvable(objective, best):
        return best, begins, ends
    small = len(objective.family.V) <= SMALL
    for other in scattered(objective, RETRIES if small else RETRIES_LARGE, rng):
        begins.append(other)
        try:
            found = _led(objective, other, method, most, tolerance)
        except (ModelError, SolverError):
            ends.append(None)
            continue
        ends.append(found)
        done = not _improvable(objective, found)
        # poles are only paired anew where that explains them: an outlier is no wrong pairing
        if done or (not objective.numbers and found.cost < best.cost):
            best = found
        if done:
            break
    objective.path = []
    objective.follow(best.trail.p)
    return best, begins, ends


def _led(
    objective: Objective,
    begin: FloatArray,
    method: UpdateMethod,
    most: int | None,
    tolerance: float,
) -> SearchEnd:
    """Return the end of a search from `begin` that goes through easier problems first."""
    objective.path = []
    before = _approach(objective, begin, most, tolerance)
    first = begin if before is None else before.p[-1]
    found = method.search(objective, first, most=most, tolerance=tolerance)
    if before is not None:
        found.trail = before.joined(found.trail)
    return found


def _improvable(objective: Objective, end: SearchEnd) -> bool:
    """Return whether another start may lead to a better end."""
    if not objective.numbers:
        return _absurd(objective, end.p)
    poles = objective.poles_measured
    alone = all(isinstance(residual, Eigenvalues) for residual in objective.residuals)
    if poles is None or not alone or end.p.size < 2:
        return False
    point = objective.at(end.p)
    found = point.eigen.poles[point.columns(poles.numbers)]
    if np.max(np.abs(found - poles.target) / np.abs(poles.target)) < FAR:
        return False
    chi2, dof = chi_square(objective, point, np.ones(end.p.size, dtype=bool))
    return dof > 0 and (chi2 is None or is_bad(chance(chi2, dof)))


def _absurd(objective: Objective, p: FloatArray) -> bool:
    """Return whether a fit leaves far more than noise or a small error of the model would."""
    point = objective.at(p)
    r, size = objective.values(point, prior=False), objective.size(point)
    chi2, dof = chi_square(objective, point, np.ones(p.size, dtype=bool))
    likely = chi2 is not None and not is_bad(chance(chi2, dof))
    return not likely and bool(np.sum(r**2) > ABSURD * np.sum(size[: r.size] ** 2))


def from_starts(
    objective: Objective,
    begins: list[FloatArray],
    method: UpdateMethod,
    most: int | None,
    tolerance: float,
) -> tuple[SearchEnd, list[SearchEnd | None]]:
    """Return the best end, the objective being there, and what every start led to."""
    ends: list[SearchEnd | None] = []
    trouble: FlexplantError | None = None
    for begin in begins:
        try:
            ends.append(method.search(objective, begin, most=most, tolerance=tolerance))
        except (ModelError, SolverError) as error:
            if len(begins) == 1:
                raise
            trouble = error
            ends.append(None)
    reached = [found for found in ends if found is not None]
    if not reached:
        raise SolverError(f"none of {len(begins)} starts leads anywhere; the last: {trouble}")
    best = min(reached, key=lambda found: found.cost)
    # the modes of the best end are numbered from its own start
    if len(begins) > 1:
        objective.begin(begins[[f is best for f in ends].index(True)])
        for p in best.trail.p[1:]:
            objective.at(p, refer=True)
    return best, ends


#: relative change of the model's eigenvalues that starts far away make at most, each parameter
#: alone, and how many decades they may be nearer
FIRST_CHANGE, DECADES = 0.1, 1.5


def all_starts(objective: Objective, start: Any, starts: Any, rng: Rng) -> list[FloatArray]:
    """Return the start and the others: those given, or a Latin hypercube in bounds or priors."""
    first = objective.default_start
    if start is not None:
        first = checked_values(start, objective.parameters, "start")
        _check_inside(objective, first)
    if starts is None:
        return [first]
    if np.ndim(starts) == 0:
        return [first, *_drawn(objective, whole(starts, "starts") - 1, rng)]
    values = real_array(starts, "starts")
    if values.ndim != 2 or values.shape[1] != first.size or not values.shape[0]:
        raise ShapeError(f"starts must have shape (any, {first.size}), got {values.shape}.")
    for value in values:
        _check_inside(objective, value)
    return list(values)


def summary(begins: list[FloatArray], ends: list[SearchEnd | None]) -> Starts | None:
    """Return what several starts led to, None for one."""
    if len(begins) == 1:
        return None
    nan = np.full(begins[0].size, np.nan)
    return Starts(
        np.array(begins),
        np.array([nan if found is None else found.p for found in ends]),
        np.array([np.inf if found is None else found.cost for found in ends]),
    )


def scattered(objective: Objective, count: int, rng: Rng) -> list[FloatArray]:
    """Return starts around the default one, as far as each parameter moves eigenvalues by 10 %.

    Sizes are drawn evenly over decades; masses, springs and dampers are added, not taken away.
    """
    middle = objective.default_start
    eigen = objective.begin(middle).eigen
    every = list(range(eigen.poles.size))
    moved = np.abs(objective.family.sensitivity(eigen, every)) / np.abs(eigen.poles)[:, None]
    typical = np.median(moved, axis=0)
    scale = np.where(typical > 0, FIRST_CHANGE / divisor(typical), 0.0)
    scale = np.where(objective.has_prior, objective.prior_std, scale)
    chance = generator(rng)
    added = np.array([isinstance(q, PointParameter) for q in objective.parameters])
    found = []
    for _ in range(count):
        sign = np.where(added & ~objective.has_prior, 1.0, chance.choice([-1.0, 1.0], middle.size))
        step = sign * scale * 10 ** (-DECADES * chance.random(middle.size))
        found.append(np.clip(middle + step, objective.lower, objective.upper))
    return found


def _drawn(objective: Objective, count: int, rng: Rng) -> FloatArray:
    from scipy.stats import qmc

    low = np.where(objective.has_prior, objective.prior_mean - 2 * objective.prior_std, -np.inf)
    high = np.where(objective.has_prior, objective.prior_mean + 2 * objective.prior_std, np.inf)
    low, high = np.maximum(low, objective.lower), np.minimum(high, objective.upper)
    open_ = [
        p.name
        for p, width in zip(objective.parameters, high - low, strict=True)
        if not np.isfinite(width)
    ]
    if open_:
        raise ModelError(
            f"starts of {', '.join(open_)} cannot be drawn: give them bounds= or prior=, or "
            "give starts as values."
        )
    drawn = qmc.LatinHypercube(low.size, rng=generator(rng)).random(count)
    return np.asarray(low + (high - low) * drawn, dtype=np.float64)


def _check_inside(objective: Objective, start: FloatArray) -> None:
    for q, value, low, high in zip(
        objective.parameters, start, objective.lower, objective.upper, strict=True
    ):
        if not low <= value <= high:
            raise ModelError(
                f"start of {q.name} is {value:g}, outside its bounds ({low:g}, {high:g})."
            )


#: how near the ratio of measured poles to those of the model is to 2 pi, all of them
NEAR = 0.15


def check_units(objective: Objective, begin: FloatArray, start: Any = None) -> None:
    """Raise ModelError where all measured poles are 2 pi below or above those of the model."""
    data = objective.poles_measured
    if data is None:
        return
    if start is None:
        try:
            start = objective.poles(objective.begin(begin))
        except ModelError:
            return  # the search raises what is wrong at the start
    known = dict(zip(objective.numbers, np.abs(start), strict=True))
    ratio = np.abs(data.target) / np.array([known[n] for n in data.numbers])
    below = bool(np.all(np.abs(2 * np.pi * ratio - 1) < NEAR))
    above = bool(np.all(np.abs(ratio / (2 * np.pi) - 1) < NEAR))
    if below or above:
        advice = "multiply Hz by 2 pi" if below else "look at the units of the model too"
        raise ModelError(
            f"the measured poles are a factor of 2 pi {'below' if below else 'above'} those of the "
            f"model, all {ratio.size} of them ({np.median(np.abs(data.target)):.4g} against "
            f"{np.median(np.abs(start)):.4g} rad/s). MeasuredModes takes poles in rad/s: {advice}."
        )
