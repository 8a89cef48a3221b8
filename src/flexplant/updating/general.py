"""The general update: any residuals, methods, bounds, priors and several starts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import qmc

from ..errors import FlexplantError, FlexplantWarning, ModelError, ShapeError, SolverError
from ..values import FloatArray, generator, real_array, short
from .methods import GaussNewton, Lasso, Method, Tikhonov, TrustRegion
from .objective import Objective
from .parameters import Parameter
from .residuals_base import Residual
from .result import History, Starts, UpdateResult
from .search import Found, gauss_newton, tikhonov, trust_region
from .sensitivity import checked_values
from .sparse_search import lasso
from .updated_model import changed_model

#: a parameter this close to its bound, relative to their distance, is at it
AT_BOUND = 1e-6
#: singular values of the scaled sensitivities below this part of the largest say nothing
SINGULAR = 1e-9


def general_update(
    model: Any,
    parameters: tuple[Parameter, ...],
    residuals: Sequence[Residual],
    *,
    method: Method,
    start: Any,
    starts: Any,
    seed: int,
    prior: bool,
    most: int,
    tolerance: float,
) -> UpdateResult:
    """Return the answer of a search with any residuals; see `update`."""
    objective = Objective(model, parameters, residuals, prior=prior)
    first = objective.default_start
    if start is not None:
        first = checked_values(start, parameters, "start")
        _check_inside(objective, first)
    begins = _all_starts(objective, first, starts, seed)
    ends: list[Found | None] = []
    trouble: FlexplantError | None = None
    for begin in begins:
        try:
            ends.append(_searched(objective, begin, method, most, tolerance))
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
    point = objective.at(best.p)
    if not best.converged:
        warnings.warn(
            f"the update did not converge in {len(best.trail.p) - 1} steps: {best.reason}. Look "
            "at .history; try other mode numbers, start=, starts= or more iterations.",
            FlexplantWarning,
            stacklevel=3,
        )
    covariance, correlation = _doubt(objective, point, method, best.p - first)
    at = _at_bound(objective, best.p)
    return UpdateResult(
        parameters=tuple(q.name for q in parameters),
        units=tuple(q.unit for q in parameters),
        values=best.p,
        covariance=covariance,
        correlation=correlation,
        model=changed_model(model, objective.family, best.p),
        history=History(
            np.array(best.trail.p),
            np.array(best.trail.poles),
            np.array(best.trail.error),
            np.array(best.trail.fraction),
        ),
        converged=best.converged,
        reason=best.reason,
        at_bound=tuple(q.name for q, flag in zip(parameters, at, strict=True) if flag),
        starts=None if len(begins) == 1 else _summary(begins, ends),
        unknowns=tuple(parameters),
    )


def _searched(
    objective: Objective, begin: FloatArray, method: Method, most: int, tolerance: float
) -> Found:
    if isinstance(method, TrustRegion):
        return trust_region(objective, begin, method, most=most, tolerance=tolerance)
    if isinstance(method, GaussNewton):
        return gauss_newton(objective, begin, method.truncate, most=most, tolerance=tolerance)
    if isinstance(method, Tikhonov):
        return tikhonov(objective, begin, method.weight, most=most, tolerance=tolerance)
    if isinstance(method, Lasso):
        return lasso(objective, begin, method.weight, most=most, tolerance=tolerance)
    raise ModelError(f"update does not know the method {type(method).__name__}.")


def _check_inside(objective: Objective, start: FloatArray) -> None:
    for q, value, low, high in zip(
        objective.parameters, start, objective.lower, objective.upper, strict=True
    ):
        if not low <= value <= high:
            raise ModelError(
                f"start of {q.name} is {value:g}, outside its bounds ({low:g}, {high:g})."
            )


def _all_starts(
    objective: Objective, first: FloatArray, starts: Any, seed: int
) -> list[FloatArray]:
    """Return the start and the others: those given, or a Latin hypercube in bounds or priors."""
    q = first.size
    if starts is None:
        return [first]
    if np.ndim(starts) == 0:
        if isinstance(starts, bool) or not isinstance(starts, int | np.integer) or starts < 1:
            raise ModelError(f"starts must be whole or values, got {short(starts)}. Pass 20, say.")
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
        drawn = qmc.LatinHypercube(q, rng=generator(seed, "seed")).random(int(starts) - 1)
        return [first, *(low + (high - low) * drawn)]
    values = real_array(starts, "starts")
    if values.ndim != 2 or values.shape[1] != q or not values.shape[0]:
        raise ShapeError(f"starts must have shape (any, {q}), got {values.shape}.")
    for value in values:
        _check_inside(objective, value)
    return list(values)


def _summary(begins: list[FloatArray], ends: list[Found | None]) -> Starts:
    nan = np.full(begins[0].size, np.nan)
    return Starts(
        np.array(begins),
        np.array([nan if found is None else found.p for found in ends]),
        np.array([np.inf if found is None else found.cost for found in ends]),
    )


def _at_bound(objective: Objective, p: FloatArray) -> Any:
    low, high = objective.lower, objective.upper
    width = high - low
    near = AT_BOUND * np.where(np.isfinite(width), width, np.maximum(np.abs(p), 1e-12))
    return (p - low <= near) | (high - p <= near)


def _doubt(
    objective: Objective, point: Any, method: Method, change: FloatArray
) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation: Laplace's approximation at the answer."""
    J = objective.slopes(point)
    q = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    scaled = J / np.where(length > 0, length, 1.0)
    _, s, Vt = np.linalg.svd(scaled, full_matrices=True)
    s = np.concatenate([s, np.zeros(q - s.size)])
    regular = bool(s[-1] > SINGULAR * s[0])
    inverse = np.where(s > SINGULAR * s[0], 1 / np.maximum(s, 1e-300), 0.0)
    half = (Vt.T * inverse) / np.where(length > 0, length, 1.0)[:, None]
    unit = half @ half.T
    std = np.sqrt(np.diag(unit))
    safe = np.where(std > 0, std, 1.0)
    correlation = unit / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    penalised = isinstance(method, Tikhonov | Lasso) or (
        isinstance(method, GaussNewton) and method.truncate > 0
    )
    if not regular or penalised:
        return None, correlation
    if objective.noisy:
        return unit, correlation
    r = objective.values(point)
    spare = r.size - q
    return (unit * float(r @ r) / spare if spare > 0 else None), correlation
