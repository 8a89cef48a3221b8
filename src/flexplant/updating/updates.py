"""The update of a model from measurements: the paper's equations (9) to (14), extended."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from ..arrays import FloatArray, Rng, flag, generator, instance, positive, whole
from ..errors import FlexplantError, ModelError, counted, some_names, warn
from ..parallel import Progress, expect
from ..structure.model import FEModel
from ..tolerances import CLOSE, MOST_STEPS, TINY, TYPED
from .discrepancy import weigh_discrepancy
from .family import changed_model, is_large
from .full_basis import FullBasis
from .parameters import Parameter, checked_parameters, checked_values
from .residuals.residual import Eigenvalues, Residual
from .search import Auto, Objective, SearchEnd, TrustRegion, UpdateMethod, checked_residuals
from .search.least_squares import ITERATIONS, SearchPlan, unit_changes
from .search.objective import Defect, chi_square, covariance, is_bad, resolution, worst
from .searching import all_starts, check_units, from_one_start, from_starts, summary
from .update_result import History, UpdateResult

#: number of standard deviations by which the last round of defect correction may change the
#: estimate
UNSETTLED = 0.5


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
    full: FEModel | None = None,
    progress: bool | None = None,
    rounds: int = 4,
) -> UpdateResult:
    """Find the parameters with which the model reproduces the measurement.

    A typical call is ``fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(found)])``.
    Its result is in `fit.parameters`, `fit.values` and `fit.std`. The updated model for
    `assemble_plant` is `fit.model`, and the full one is `fit.applied_to(full)`. `fx.plot.update`
    draws the result. Start with poles (`Eigenvalues`), then add `ModeShapes` or `FrfResidual`.
    `identifiability` shows which parameters the data determine, and `localise` finds the place of
    an error. Modes are followed by number and shape, so that they may swap order. The method is
    described in `algorithms`.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Model to update. An FEModel of more than 300 DOFs is updated in a basis of its modes. The
        basis is computed again at each estimate until the estimate is constant. An FEModel of more
        than 20 000 DOFs should be reduced first.
    parameters : sequence of q Parameter
        Unknowns with their bounds and priors: `AddedMass`, `AddedDamping`, `AddedStiffness`,
        `ModeDamping`, `MatrixParameter`, `PolynomialParameter`, or a `Parameter` of your own.
    residuals : sequence of Residual
        Measurements to fit: `Eigenvalues`, `ModeShapes`, `FrfResidual`, `Antiresonances`,
        `StaticCompliance`, or a `Residual` of your own, in any mixture.
    method : UpdateMethod, optional
        `GaussNewton` or `TrustRegion`. None: the trust region. If only poles are fitted, without
        bounds and priors, Gauss-Newton is tried first, and the trust region if it fails.
    start : (q,) array [kg, N s/m, N/m], optional
        Start values. None: zeros or the means of priors, moved inside the bounds. Without start
        values, responses are first fitted by the logarithm of their magnitude, and poles are fitted
        before shapes. These fits converge from farther away. Four other starts are always tried to
        find other minima (two with more than 100 DOFs). print(fit) names minima with a similar
        chi-square. Up to 20 starts (4 with more than 100 DOFs) are tried if no start leads to a
        solution. They are also tried if noise does not explain the residual and the residual is
        large: a tenth of the power of responses, or 0.1 % of a pole. After a solution is found,
        each further start gets ten steps, and more if its cost is close to the best one. The search
        stops when eight starts have reached the best minimum. `UpdateResult.starts` lists them.
    starts : int or (s, q) array, optional
        Start values, or their number. A number of starts includes `start`, and the others are drawn
        between the bounds or from the priors. The best result is kept. 1: only `start` is used.
    rng : int, SeedSequence or Generator
        Random generator of drawn starts, or its seed.
    prior : bool
        Whether to use priors. They can be used only if the noise of all residuals is known. A
        parameter with two finite bounds but no prior gets a prior from its bounds. Its mean is zero
        (or the bound closest to zero), and the farther bound is three standard deviations away.
    max_iterations : int, optional
        Largest number of steps from one start. None: 20 for Gauss-Newton, 200 for other methods.
    tolerance : float
        Relative tolerance of the search. The search ends when a full step changes every eigenvalue
        by less than this fraction, or when the residual is smaller than this fraction.
    full : FEModel, optional
        FEModel from which the reduced model was made. The error of the reduction may be larger than
        the noise, and chi-square does not always show this. With `full`, defect correction removes
        the error. It solves the full model at the estimate, adds the difference between its
        residuals and those of the reduced model, and repeats the fit. The damping is the full
        model's D, or that of the reduced model if the full model has no D.
    rounds : int
        Largest number of rounds of defect correction. It stops earlier if a round changes the
        estimate by less than 0.01 standard deviations.
    progress : bool, optional
        Whether to show a progress bar. None: a bar is shown on a terminal or in a notebook, for
        work of more than two seconds.

    Returns
    -------
    UpdateResult
        Parameters, covariance and updated model. `converged` is False if the tolerance was not met,
        or the data do not determine the parameters.

    Warns
    -----
    FlexplantWarning
        When the tolerance was not met. When the data, with active bounds and priors, do not
        determine the parameters (the warning names the determined combinations). When a solution is
        found, but not from the given `start`. When the last round of defect correction changed the
        estimate by more than half a standard deviation. When the residual exceeds known noise with
        a p-value below 1e-3. The model error of each kind of residual is then estimated together
        with the parameters (`UpdateResult.discrepancy`). If responses are fitted, the covariance is
        instead multiplied by chi-square over its degrees of freedom, and no standard deviations are
        printed.

    Raises
    ------
    ModelError
        When the measured eigenvalues do not depend on a parameter or cannot distinguish several
        parameters, so that the sensitivity matrix S is singular. When the matrices are indefinite
        at `start`. When an FEModel cannot be made with the result, for example because of a
        negative damper. Bounds prevent this.
    SolverError
        When every step makes the matrices indefinite, or no start leads to a solution.

    References
    ----------
    [paper]_, section 3.

    Examples
    --------
    The third mass of the machine is 0.2 kg heavier than in the drawing:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> heavier = fx.chain(masses=[1.0, 1.0, 1.2], stiffnesses=[4e5, 4e5])
    >>> measured = fx.MeasuredModes(poles=fx.solve_modes(heavier, count=3).poles[1:], modes=[2, 3])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> fit.parameters, fit.units, fit.values.round(6), fit.converged
    (('mass at 3:x',), ('kg',), array([0.2]), True)
    """
    listed = checked_parameters(parameters)
    given = checked_residuals(residuals)
    hint = "Pass updating.GaussNewton() or updating.TrustRegion()."
    instance(method, UpdateMethod | None, "method", hint)
    if max_iterations is not None:
        whole(max_iterations, "max_iterations")
    tolerance = positive(tolerance, "tolerance")
    rng = generator(rng)
    takes_part = flag(prior, "prior")
    rounds = whole(rounds, "rounds")
    bounded = any(q.bounds is not None for q in listed)
    known = any(q.prior is not None for q in listed)
    # the paper's problem: only eigenvalues, no prior knowledge
    plain = all(isinstance(r, Eigenvalues) and not r.clusters for r in given) and not known
    if method is None:
        method = Auto() if plain and not bounded else TrustRegion()
    if bounded and not method.keeps_bounds:
        raise ModelError(
            f"{type(method).__name__} takes no bounds: use updating.TrustRegion(), or drop bounds=."
        )
    if plain and method.weighs_poles:
        given = tuple(r.replace(weights=r.W) for r in given if isinstance(r, Eigenvalues))
    search = SearchPlan(method, max_iterations, tolerance)
    basis, used = None, model
    if full is not None:
        basis = FullBasis(full, listed, given, model)
    elif is_large(model):
        basis, rounds = FullBasis(model, listed, given), MOST_STEPS
        used = basis.at(checked_values(start, listed, "start"))
    objective = Objective(used, listed, given, prior=takes_part)
    begins = all_starts(objective, start, starts, rng)
    with Progress(None, ITERATIONS, progress=progress, advice=_ADVICE):
        check_units(objective, begins[0])
        # a result that depends on its start is not a minimum of the misfit
        if starts is None and not method.penalised:
            best, begins, ends = from_one_start(
                objective, begins[0], search, rng, given=start is not None
            )
        else:
            best, ends = from_starts(objective, begins, search)
        tried = summary(objective, best, begins, ends)
        estimates = [best.p]
        if basis is not None:
            best, estimates = corrected(objective, basis, search, best, rounds)
    lost = ends[0] if start is not None and starts is None else None
    _ends_warned(objective, best, estimates, lost if isinstance(lost, FlexplantError) else None)
    fit = _result(model, objective, method, best, begins[0])
    fit = fit.replace(starts=tried, rounds=np.array(estimates), residuals=given)
    if known and takes_part and not objective.uses_prior:
        warn(_unused_priors(objective))
    if fit.determined is not None:
        warn(_undetermined(fit, objective.text))
    if not method.least_squares or not is_bad(fit.p_value):
        return fit
    named = worst(objective, objective.at(best.p))
    end, found = weigh_discrepancy(objective, search, best)
    if found:
        again = _result(model, objective, method, end, begins[0])
        kept = {"starts": fit.starts, "rounds": fit.rounds, "residuals": given}
        # the model is judged by the noise only, at the smallest chi-square
        fit = again.replace(chi2=fit.chi2, dof=fit.dof, discrepancy=found, **kept)
    elif fit.covariance is not None and fit.chi2 is not None:
        fit = fit.replace(covariance=fit.widened(fit.chi2 / fit.dof))
    warn(_complaint(fit, named))
    return fit


def _ends_warned(
    objective: Objective, best: SearchEnd, estimates: list[FloatArray], lost: FlexplantError | None
) -> None:
    """Warn of rounds without convergence, a failed start, or a search that was cut short.

    `estimates`: the first and that of each round; `lost`: reason of failure of the given start.
    """
    still = normalised_step(objective, best.p, estimates[-2]) if len(estimates) > 1 else 0.0
    if still > UNSETTLED:
        warn(
            f"defect correction has not converged: round {len(estimates) - 1} still changed the "
            f"estimate by {still:.2g} standard deviations. Give more rounds=, or a reduced model "
            "with more modes."
        )
    if lost is not None:
        warn(
            f"the search from the given start failed: {lost} The result is from another start "
            "(.starts lists all of them)."
        )
    if not best.converged:
        error = best.trail.error
        warn(
            f"the update did not converge in {counted(len(best.trail.p) - 1, 'step')}: "
            f"{best.reason}, error {error[-1]:.3g} from {error[0]:.3g}. Look at .history; try "
            "other mode numbers, start=, starts= or more iterations."
        )


def _result(
    model: Any, objective: Objective, method: UpdateMethod, best: SearchEnd, begin: FloatArray
) -> UpdateResult:
    """Return the result of the best search with its covariance."""
    point = objective.at(best.p)
    low, high, p = objective.lower, objective.upper, best.p
    unit = unit_changes(objective, objective.slopes(point, prior=False))
    near = TYPED * np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(p), unit))
    names = np.array([q.name for q in objective.parameters], dtype=object)
    at_bound = tuple(names[(p - low <= near) | (high - p <= near)].tolist())
    fitted = np.array([q.name not in at_bound for q in objective.parameters])
    if method.penalised:
        fitted &= best.p != begin
    chi2, dof = chi_square(objective, point, fitted)
    spread, correlation = covariance(objective, point)
    determined: tuple[str, ...] | None = None
    if not method.penalised:
        # a parameter at a bound or with a prior is known, independent of the data
        found = resolution(objective, point, ~fitted | (objective.has_prior & objective.uses_prior))
        if not found.clear.all():
            determined = tuple(found.combinations(names.tolist()))
    spread = spread if determined is None and not method.penalised else None
    std = None if spread is None else np.sqrt(np.diag(spread))
    trail = best.trail
    return UpdateResult(
        parameters=tuple(q.name for q in objective.parameters),
        units=tuple(q.unit for q in objective.parameters),
        values=best.p,
        covariance=spread,
        correlation=correlation,
        model=changed_model(model, objective.parameters, best.p, objective.family, std),
        history=History(*map(np.array, (trail.p, trail.poles, trail.error, trail.fraction))),
        converged=best.converged and determined is None,
        reason=best.reason if determined is None else "not determined",
        determined=determined,
        prior_std=np.where(objective.has_prior, objective.prior_std, np.inf)
        if objective.uses_prior
        else None,
        at_bound=at_bound,
        unknowns=objective.parameters,
        chi2=chi2,
        dof=dof,
    )


def _unused_priors(objective: Objective) -> str:
    """Return a text on unused priors, and the residuals with unknown noise."""
    named = [q.name for q in objective.parameters if q.prior is not None]
    silent = " and ".join(bound.name for bound in objective.bounds if not bound.noisy)
    return (
        f"the priors of {some_names(named)} are not used: their weight relative to {silent}, "
        "whose noise is not known, is undefined. Give the noise (covariance=, std=, variance=) "
        "without "
        "weights, or pass prior=False."
    )


def _undetermined(fit: UpdateResult, text: str) -> str:
    """Return a text on the combinations that the data determine, if not all parameters."""
    names, known = fit.parameters, fit.determined or ()
    listed = f": {'; '.join(known[:6])}" if known else ""
    return (
        f"the parameters are not determined: {text} determine {len(known)} of "
        f"{counted(len(names), 'combination')} of {some_names(names)}, to first order{listed}. "
        "Other values fit equally well, and the covariance is not known. Measure "
        "more (identifiability(model, parameters, residuals) names the modes), drop parameters, or "
        "give priors and the noise of the measurement."
    )


def _complaint(fit: UpdateResult, named: str) -> str:
    """Return a text on a fit whose residual exceeds noise; `named`: its worst residuals."""
    masses = fit.negative_masses
    negative = f"{', '.join(masses)} became negative. " if masses else ""
    tried = f"{counted(len(fit.starts or ()), 'start')} tried. "
    kept = (
        f"The covariance is multiplied by {(fit.chi2 or 0.0) / max(fit.dof, 1):.3g} and is valid "
        "for small model errors only."
    )
    if fit.discrepancy:
        kept = (
            f"A discrepancy of {fit.discrepancy_text} counts as noise, so that values are "
            "weighted by the accuracy of the model; fit.uncertainty() gives the uncertainty of "
            "modes."
        )
    return (
        f"the updated model leaves more than noise: chi-square {fit.chi2:.4g} for {fit.dof} "
        f"degrees of freedom. It fits worst {named}. {negative}"
        "Something else differs between model and machine, or the noise is understated; "
        f"localise(model, candidates, residuals) searches for the place. {tried}{kept}"
    )


#: what makes an update shorter
_ADVICE = "A smaller reduced model, fewer lines or channels of responses, or starts=1 take less."


def corrected(
    objective: Objective, basis: FullBasis, search: SearchPlan, end: SearchEnd, rounds: int
) -> tuple[SearchEnd, list[FloatArray]]:
    """Return the end of the last round, with the objective there, and all estimates.

    In each round the full model is solved at the estimate, and the difference of its residuals
    from those of the reduced model, with its derivative, is added to the reduced model's::

        r(p) = r_reduced(p) + d + d' (p - p_0),   d = r_full(p_0) - r_reduced(p_0)

    When the estimate is constant, r and dr/dp are those of the full model. [Stetter1978]_;
    [AlexandrovLewis2001]_ (the derivative).
    """
    first = end.trail.p[0]
    estimates = [end.p]
    for _ in range(rounds):
        begin = perf_counter()
        point = objective.at(end.p)
        full = basis.objective(point)
        there = full.at(end.p)
        objective.defect = None
        objective.defect = Defect(
            end.p,
            full.values(there, prior=False) - objective.values(point, prior=False),
            full.slopes(there, prior=False) - objective.slopes(point, prior=False),
        )
        # the end of a penalised search depends on its start
        again = search.method.penalised
        end = search.begun(objective, first) if again else search.resumed(objective, end)
        estimates.append(end.p)
        if normalised_step(objective, end.p, estimates[-2]) < CLOSE:
            break
        expect(seconds=perf_counter() - begin, more=True)  # another round takes as long
    return end, estimates


def normalised_step(objective: Objective, p: FloatArray, before: FloatArray) -> float:
    """Return how far an estimate moved, in standard deviations: ``|J dp| / sqrt(q)``."""
    # of residuals of unit variance where the noise is known; else relative to what is left of them
    point = objective.at(p)
    change = objective.slopes(point) @ (p - before)
    size = 1.0
    if not objective.noise_known:
        left = objective.values(point)
        size = float(left @ left) / max(left.size - p.size, 1)
    return float((change @ change / max(size, TINY) / p.size) ** 0.5)
