"""The update of a model from measurements: the paper's equations (9) to (14), and beyond."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import FlexplantError, FlexplantWarning, ModelError, SolverError
from ..values import FloatArray, Rng, flag, generator, instance, positive
from .approach import approached
from .judgement.covariance import covariance
from .judgement.goodness import chance, chi_square, is_bad, worst
from .parameters.added import Parameter
from .residuals.eigenvalues import Eigenvalues
from .residuals.residual import Residual
from .search import GaussNewton, Objective, SearchEnd, TrustRegion, UpdateMethod, checked_residuals
from .search.update_method import Trail
from .sensitivities import checked_parameters
from .starts import all_starts, scattered, summary
from .unit_check import check_units
from .update_result import History, UpdateResult
from .updated_model import changed_model

#: a parameter this close to its bound, relative to their distance, is at it
AT_BOUND = 1e-6
#: part of the measured power that a minimum leaves which has little to do with the measurement
ABSURD = 0.1
#: other starts that are tried after such an end, for models of up to so many DOFs and larger ones
RETRIES, SMALL, RETRIES_LARGE = 20, 100, 4


def update(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Residual],
    *,
    method: UpdateMethod | None = None,
    start: Sequence[float] | FloatArray | None = None,
    starts: int | FloatArray | None = None,
    rng: Rng = 0,
    prior: bool = True,
    max_iterations: int | None = None,
    tolerance: float = 1e-10,
) -> UpdateResult:
    """Find the parameters with which the model reproduces the measurement.

    With eigenvalues alone, without bounds and priors: the paper's (13) and (14), Gauss-Newton with
    real unknowns in complex equations::

        Re[S^H W S] dp = Re[S^H W d lambda],    p <- p + dp

    Otherwise ``1/2 |r(p)|^2 + 1/2 |(p - mean)/std|^2``, r the whitened residuals of all kinds, in a
    trust region within the bounds. The second term, of the parameters with a prior, takes part
    where the noise of every residual is known (the answer is then the maximum a posteriori).

    Modes are found by their number in the model at `start` and followed by shape (see
    `flexplant.updating.pairing`), so they may swap order on the way; those with measured shapes
    are assigned by MAC at each step. Modes that are exactly
    repeated there are first turned to the vectors in which the step splits them, the lower mode
    number going to the lower frequency. Steps are shortened while M or K would become indefinite,
    a measured mode would cease to oscillate, or the error (12) would grow.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model; an FEModel is treated densely.
    parameters : sequence of q Parameter
        `AddedMass`, `AddedDamping`, `AddedStiffness`, `ModeDamping`, `MatrixParameter`.
    residuals : sequence of Residual
        What to fit: `Eigenvalues`, `ModeShapes`, `FrfResidual`, `Antiresonances`,
        `StaticCompliance`, mixed freely.
    method : UpdateMethod, optional
        `GaussNewton`, `TrustRegion`, `Tikhonov` or `Lasso`. None: as said above.
    start : (q,) array [kg, N s/m, N/m], optional
        Values to begin with. When not given zeros, or the means of priors, inside the bounds; then
        complex responses are fitted by the logarithm of their magnitude first, all entries about
        equally weighted, and poles before shapes, since these converge from farther away. Where
        responses alone are fitted and a tenth of their power is left, which noise does not
        explain, up to 20 other starts are tried (`UpdateResult.starts`), 4 with a model of more
        than 100 DOFs.
    starts : int or (s, q) array, optional
        Search from several starts, drawn between the bounds (or from the priors), and keep
        the best; `start` is one of them.
    rng : int, SeedSequence or Generator
        For drawn starts.
    prior : bool
        Whether priors take part. A parameter with two finite bounds and no prior has one from
        them: zero (or the bound nearest to it) most probable, the farther bound three standard
        deviations away.
    max_iterations : int, optional
        Most steps from one start; 20 for Gauss-Newton, 200 for the others when not given.
    tolerance : float
        Done when a full step, or the residual, changes no eigenvalue by more than this,
        relatively.

    Returns
    -------
    UpdateResult
        With `converged` False when the tolerance was not met.

    Warns
    -----
    FlexplantWarning
        When the tolerance was not met; when the noise is known and the fit leaves more than noise
        does in one of 10 000 cases (the covariance is then widened by chi-square over its degrees
        of freedom).

    Raises
    ------
    ModelError
        When the measured eigenvalues do not depend on a parameter or cannot distinguish some (S is
        singular), or the matrices are indefinite at `start`.
    LabelError
        When a mode number or a place is unknown.
    SolverError
        When no part of a step keeps the model physical, or no start leads anywhere.

    References
    ----------
    The paper, section 3.
    """
    listed = checked_parameters(parameters)
    given = checked_residuals(residuals)
    if method is not None:
        instance(
            method,
            UpdateMethod,
            "method",
            "Pass GaussNewton() or TrustRegion().",
        )
    if max_iterations is not None:
        _checked_count(max_iterations)
    enough = positive(tolerance, "tolerance")
    rng = generator(rng)
    takes_part = flag(prior, "prior")
    bounded = any(getattr(q, "bounds", None) is not None for q in listed)
    known = any(getattr(q, "prior", None) is not None for q in listed)
    # the paper's problem: eigenvalues alone, nothing known beforehand
    plain = all(isinstance(r, Eigenvalues) and not r.clusters for r in given) and not known
    if method is None:
        method = GaussNewton() if plain and not bounded and starts is None else TrustRegion()
    if bounded and not method.keeps_bounds:
        raise ModelError(
            f"{type(method).__name__} takes no bounds: use TrustRegion(), or drop bounds=."
        )
    if plain and method.weighs_poles:
        given = tuple(r.replace(weights=r.W) for r in given if isinstance(r, Eigenvalues))
    objective = Objective(model, listed, given, prior=takes_part)
    begins = all_starts(objective, start, starts, rng)
    cold = start is None and starts is None and not method.penalised
    try:
        if cold:
            best, begins, ends = _cold(objective, begins[0], method, max_iterations, enough, rng)
        else:
            best, ends = _searched(objective, begins, method, max_iterations, enough)
    except (ModelError, SolverError):
        check_units(objective, begins[0])
        raise
    check_units(objective, begins[0], best.trail.poles[0])
    if not best.converged:
        error = best.trail.error
        warnings.warn(
            f"the update did not converge in {len(best.trail.p) - 1} steps: {best.reason}, error "
            f"{error[-1]:.3g} from {error[0]:.3g}. Look at .history; try other mode numbers, "
            "start=, starts= or more iterations.",
            FlexplantWarning,
            stacklevel=2,
        )
    fit = _result(model, objective, method, best, begins[0]).replace(starts=summary(begins, ends))
    if method.least_squares and is_bad(fit.p_value):
        fit = _widened(fit)
        warnings.warn(_complaint(fit, objective, best.p), FlexplantWarning, stacklevel=2)
    return fit


def _approach(
    objective: Objective, begin: FloatArray, most: int | None, tolerance: float
) -> Trail | None:
    """Return the way to a better start, None where there is none; `objective` follows it."""
    path = approached(objective, begin, most, tolerance)
    if len(path) == 1:
        return None
    trail = Trail()
    objective.begin(begin)
    for p in path:
        objective.at(p, refer=True)
        trail.add(objective, p, 1.0 if trail.p else 0.0)
    objective.path = path[:-1]
    return trail


def _cold(
    objective: Objective,
    begin: FloatArray,
    method: UpdateMethod,
    most: int | None,
    tolerance: float,
    rng: Rng,
) -> tuple[SearchEnd, list[FloatArray], list[SearchEnd | None]]:
    """Return the best end, the objective being there, all starts that were tried and their ends.

    Where responses alone are fitted and the first end explains nothing of them (a peak of the
    model lies on a wrong measured one), other starts are tried until one does.
    """
    begins = [begin]
    best = _led(objective, begin, method, most, tolerance)
    ends: list[SearchEnd | None] = [best]
    if objective.numbers or not _absurd(objective, best.p):
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
        best = min(best, found, key=lambda one: one.cost)
        if best is found and not _absurd(objective, best.p):
            break
    objective.path = []
    objective.begin(best.trail.p[0])
    for p in best.trail.p[1:]:
        objective.at(p, refer=True)
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


def _absurd(objective: Objective, p: FloatArray) -> bool:
    """Return whether a fit leaves far more than noise or a small error of the model would."""
    point = objective.at(p)
    r, size = objective.values(point, prior=False), objective.size(point)
    chi2, dof = chi_square(objective, point, np.ones(p.size, dtype=bool))
    likely = chi2 is not None and not is_bad(chance(chi2, dof))
    return not likely and bool(np.sum(r**2) > ABSURD * np.sum(size[: r.size] ** 2))


def _result(
    model: Any, objective: Objective, method: UpdateMethod, best: SearchEnd, begin: FloatArray
) -> UpdateResult:
    """Return what the best search found and how well it is known."""
    point = objective.at(best.p)
    at_bound = _at_bound(objective, best.p)
    fitted = np.array([q.name not in at_bound for q in objective.parameters])
    if method.penalised:
        fitted &= best.p != begin
    chi2, dof = chi_square(objective, point, fitted)
    spread, correlation = covariance(objective, point)
    trail = best.trail
    return UpdateResult(
        parameters=tuple(q.name for q in objective.parameters),
        units=tuple(q.unit for q in objective.parameters),
        values=best.p,
        covariance=None if method.penalised else spread,
        correlation=correlation,
        model=changed_model(model, objective.family, best.p),
        history=History(
            np.array(trail.p),
            np.array(trail.poles),
            np.array(trail.error),
            np.array(trail.fraction),
        ),
        converged=best.converged,
        reason=best.reason,
        at_bound=at_bound,
        unknowns=objective.parameters,
        chi2=chi2,
        dof=dof,
    )


def _widened(fit: UpdateResult) -> UpdateResult:
    """Return the result with a covariance that holds what the model does not explain."""
    if fit.covariance is None or fit.chi2 is None:
        return fit
    return fit.replace(covariance=fit.covariance * (fit.chi2 / fit.dof))


def _complaint(fit: UpdateResult, objective: Objective, p: FloatArray) -> str:
    """Return what is wrong with a fit that leaves more than noise."""
    negative = ""
    if fit.negative_masses:
        negative = f"{', '.join(fit.negative_masses)} came out negative. "
    tried = "" if fit.starts is None else f"{len(fit.starts)} starts were tried. "
    return (
        f"the updated model leaves more than noise: chi-square {fit.chi2:.4g} for {fit.dof} "
        f"degrees of freedom. It fits worst {worst(objective, objective.at(p))}. {negative}"
        "Something else differs between model and machine, or the noise is understated; "
        f"localise(model, residuals, candidates) searches for the place. {tried}The covariance is "
        f"widened by {(fit.chi2 or 0.0) / max(fit.dof, 1):.3g} and holds for small errors of the "
        "model only."
    )


def _searched(
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


def _at_bound(objective: Objective, p: FloatArray) -> tuple[str, ...]:
    """Return the names of the parameters at one of their bounds."""
    low, high = objective.lower, objective.upper
    width = high - low
    near = AT_BOUND * np.where(np.isfinite(width), width, np.maximum(np.abs(p), 1e-12))
    at = (p - low <= near) | (high - p <= near)
    return tuple(q.name for q, there in zip(objective.parameters, at, strict=True) if there)


def _checked_count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ModelError(
            f"max_iterations must be a whole number from 1, got {value!r}. Pass an int."
        )
    return int(value)
