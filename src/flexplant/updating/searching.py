"""Searches from one start, through easier problems, and from several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import FloatArray, Rng, divisor, generator, real_array, whole
from ..errors import (
    FlexplantError,
    LabelError,
    ModelError,
    ShapeError,
    SolverError,
    attempted,
    counted,
)
from ..modes.matching import NEAR
from ..tolerances import FOUR_DIGITS, NEGLIGIBLE, ROOT, ROUNDING, TINY, TYPED
from .family import Point, changed_model
from .parameters import PointParameter, checked_values
from .residuals.frf_residual import FrfResidual
from .residuals.residual import Eigenvalues, Residual
from .residuals.shape_residuals import ModeShapes
from .search import Objective, SearchEnd, TrustRegion
from .search.least_squares import SearchPlan, Trail
from .search.objective import chance, chi_square, is_bad, noise_misfit
from .update_result import Starts

#: the end of a search, or the reason why it failed
Reached: TypeAlias = SearchEnd | FlexplantError


def _led(search: SearchPlan, objective: Objective, begin: FloatArray) -> SearchEnd:
    """Return the end of a search from `begin` that goes through easier problems first."""
    # responses have a minimum wherever a peak of the model lies between two measured ones; the
    # logarithm of their magnitude hardly has any. Shapes mix when modes are close, so that poles
    # come first
    easier = _easier(objective.residuals)
    if easier is None:
        return search.begun(objective, begin)
    stage = Objective(
        objective.family.model,
        objective.parameters,
        easier,
        prior=objective.uses_prior,
        family=objective.family,
    )
    objective.origin = None
    near = SearchPlan(TrustRegion(), search.most, max(search.tolerance, NEGLIGIBLE))
    before = None
    with attempted("poles first, before shapes and responses"):
        points = near.begun(stage, begin).trail.p
        # the modes are numbered at the start, and followed from there
        objective.begin(begin)
        trail = Trail()
        for p in [begin, *points[1:]]:
            objective.at(p, refer=True)
            trail.add(objective, p, 1.0 if trail.p else 0.0)
        if len(points) > 1:
            before = SearchEnd(points[-1], np.inf, trail, converged=False, reason="")
            before.point = objective.at(points[-1], refer=True)
    return search.resumed(objective, before) if before else search.begun(objective, begin)


def _easier(residuals: Sequence[Residual]) -> list[Residual] | None:
    """Return residuals that converge from farther away, None if these are the given ones."""
    has_poles = any(isinstance(r, Eigenvalues) for r in residuals)
    found = [
        _magnitude(r) if isinstance(r, FrfResidual) else r
        for r in residuals
        if not (has_poles and isinstance(r, ModeShapes))
    ]
    return None if list(map(id, found)) == list(map(id, residuals)) else found


def _magnitude(residual: FrfResidual) -> FrfResidual:
    """Return the residual of the logarithm of the magnitude, all entries about equally weighted."""
    size = np.abs(residual.measured.data) ** 2
    if residual.magnitude or np.any(size[:, :, residual.lines] == 0):
        return residual
    noise = 0.0 if residual.variance is None else residual.variance
    # lines that are not used may be zero
    variance = np.maximum(POOR_FIT * size + noise, np.finfo(float).tiny)
    return residual.replace(magnitude=True, variance=variance)


#: remaining fraction of the measured power above which a minimum does not explain the measurement;
#: the first fit of a response gives each entry this relative variance in addition to its noise
POOR_FIT = 0.1
#: number of additional starts that are always tried, for models up to a number of DOFs and for
#: larger ones; near a second minimum about half of them end in the other one
ALWAYS, ALWAYS_LARGE, SMALL = 4, 2, 100
#: the same for cases where the best end may not be the solution
RETRIES, RETRIES_LARGE = 20, 4
#: number of steps from another start after an end is found, and largest ratio of costs for the
#: search to continue
GLANCE, WORTH = 10, 10.0
#: number of starts in the best minimum after which no other is tried: a minimum that a third of all
#: starts reach is then missed in 4 % of cases
AGREED = 8


class _GradedEnd(NamedTuple):
    """An end of a search, and its quality."""

    end: SearchEnd
    #: whether its modes are paired from the given start or from the default
    named: bool
    #: whether another start may lead to a better one
    improvable: bool
    #: whether noise explains the residual, and the model is possible
    likely: bool


class _Tried:
    """Searches from one start after the other; the objective is where the last one left it."""

    def __init__(self, objective: Objective, search: SearchPlan) -> None:
        self.objective = objective
        self.search = search
        self.begins: list[FloatArray] = []
        self.ends: list[Reached] = []
        self.found: list[_GradedEnd] = []
        #: difference of costs due to rounding
        self.rounding = 0.0

    def add(self, begin: FloatArray, *, led: bool, named: bool = False) -> None:
        """Search from a start; `led`: through easier problems first."""
        best, search = self.best, self.search
        if self.ends:
            search = search._replace(tolerance=max(search.tolerance, TYPED))
        ended = best is not None and best.end.converged
        glance = search._replace(most=GLANCE) if ended and search.most is None else search
        end = _reached(_led if led else SearchPlan.begun, glance, self.objective, begin)
        if glance is not search and best is not None and isinstance(end, SearchEnd):
            near = end.cost < WORTH * best.end.cost
            if near and not end.converged:
                end = _reached(SearchPlan.resumed, search, self.objective, end)
        self.begins.append(begin)
        self.ends.append(end)
        if isinstance(end, SearchEnd):
            if not self.found:
                size = self.objective.size(self.objective.at(end.p))
                self.rounding = (ROOT * float(np.linalg.norm(size))) ** 2
            named = named or self._paired_as_named(end)
            self.found.append(_graded_end(self.objective, end, named=named))

    def _paired_as_named(self, end: SearchEnd) -> bool:
        """Return whether the modes of a better end are paired as from the given start."""
        best = self.best
        if best is None or not (best.named and end.converged):
            return False
        if end.cost >= (1 - TYPED) * best.end.cost:
            return False
        there, same = self.objective.at(end.p), False
        line = np.linspace(best.end.p, end.p, GLANCE)[1:]
        with attempted("following the modes to a better minimum", (ModelError, LabelError)):
            followed = self.objective.follow([*line], best.end.point)
            own, other = map(self.objective.values, (there, followed))
            same = float(np.linalg.norm(own - other)) <= TYPED * float(np.linalg.norm(own))
        self.objective.back_to(there)
        return same

    @property
    def best(self) -> _GradedEnd | None:
        """The end of least cost, of those that noise explains where one does; the earliest."""
        # poles are only paired again if this explains them: an outlier is not a wrong pairing
        pool = [one for one in self.found if one.named or not one.improvable] or self.found
        pool = [one for one in pool if one.likely] or pool
        best: _GradedEnd | None = None
        for one in pool:
            if best is None or one.end.cost < (1 - TYPED) * best.end.cost - self.rounding:
                best = one
        return best

    @property
    def agreed(self) -> bool:
        """Whether several starts ended in the best minimum, so that more starts would too."""
        best = self.best
        if best is None or not best.end.converged:
            return False
        near = (1 + TYPED) * best.end.cost + self.rounding
        return sum(one.end.converged and one.end.cost <= near for one in self.found) >= AGREED

    @property
    def alike(self) -> bool:
        """Whether all starts failed in the same way, so that more starts would fail too."""
        return not self.found and len({_message(end) for end in self.ends}) == 1


def from_one_start(
    objective: Objective, begin: FloatArray, search: SearchPlan, rng: Rng, *, given: bool
) -> tuple[SearchEnd, list[FloatArray], list[Reached]]:
    """Return the best end, the objective being there, all starts that were tried and their ends."""
    # a few others are always tried, the default first where a start was given; more where no start
    # leads to an end, or the residual exceeds noise (a peak on a wrong one, a wrong pairing)
    if given:
        # a start with an impossible model is an error of the caller
        objective.family.at(begin)
    default = objective.default_start
    tried = _Tried(objective, search)
    tried.add(begin, led=not given, named=True)
    # modes are numbered at each start
    middles = [(begin, not given)]
    if given and not np.array_equal(begin, default):
        tried.add(default, led=True, named=True)
        best = tried.best
        well = best is not None and best.end is tried.ends[0] and not best.improvable
        middles.insert(1 if well else 0, (default, True))
    small = len(objective.family.V) <= SMALL
    always, retries = (ALWAYS, RETRIES) if small else (ALWAYS_LARGE, RETRIES_LARGE)
    others, led = _other_starts(objective, middles, retries + 1 - len(tried.ends), rng)
    for other in others:
        best = tried.best
        enough = tried.alike if best is None else not best.improvable or tried.agreed
        if len(tried.ends) > always and enough:
            break
        tried.add(other, led=led)
    best = tried.best
    if best is None:
        raise none_found(objective, tried.begins, tried.ends)
    end = best.end
    if end is not tried.ends[0]:
        settled = _reached(SearchPlan.resumed, search, objective, end)
        end = settled if isinstance(settled, SearchEnd) else end
    objective.follow([end.p], end.point)
    return end, tried.begins, tried.ends


def _other_starts(
    objective: Objective, middles: list[tuple[FloatArray, bool]], count: int, rng: Rng
) -> tuple[list[FloatArray], bool]:
    """Return starts around the first of some where the modes can be numbered, and its `led`."""
    for middle, led in middles:
        with attempted("starts around another", (ModelError, LabelError)):
            return _scattered(objective, middle, count, rng), led
    return [], False


def none_found(
    objective: Objective, begins: list[FloatArray], ends: list[Reached]
) -> FlexplantError:
    """Return the error for the case that no start leads to an end, with all reasons."""
    failed = [end for end in ends if isinstance(end, FlexplantError)]
    met = Counter(map(_message, failed))
    if len(met) == 1:
        # the values at the default start are not the reason
        default = (np.array_equal(begin, objective.default_start) for begin in begins)
        return next((end for end, one in zip(failed, default, strict=True) if one), failed[0])
    said = "; ".join(f"{head} ({counted(count, 'start')})" for head, count in met.most_common())
    error = SolverError(
        f"none of {len(begins)} starts leads to a solution: {said}. Begin closer to the solution "
        "(start=) or limit the parameters to physical values (bounds=). identifiability(model, "
        "parameters, residuals) shows whether the measurement determines them. The notes of "
        "this error list every start."
    )
    for begin, end in zip(begins, failed, strict=True):
        error.add_note(f"from {objective.family.text(begin)}: {end}")
    return error


def _message(end: Reached) -> str:
    """Return the reason of a failed search without its place."""
    return str(end).split(": ")[0]


def _graded_end(objective: Objective, end: SearchEnd, *, named: bool) -> _GradedEnd:
    """Return the present end with its quality."""
    point = objective.at(end.p)
    chi2, dof = chi_square(objective, point, np.ones(end.p.size, dtype=bool))
    explained = end.converged and chi2 is not None and not is_bad(chance(chi2, dof))
    improvable = not explained and dof > 0 and _improvable(objective, end, point)
    likely = False
    with attempted("the model at an end", ModelError):
        if explained:
            changed_model(objective.family.model, objective.parameters, end.p, objective.family)
            likely = True
    return _GradedEnd(end, named, improvable, likely)


def _reached(search: Callable[..., SearchEnd], *given: Any) -> Reached:
    """Return the end of a search, or the reason why it failed."""
    try:
        return search(*given)
    except FlexplantError as error:
        return error


def _improvable(objective: Objective, end: SearchEnd, point: Point) -> bool:
    """Return whether another start may lead to a better end."""
    if not objective.numbers:
        r, size = objective.values(point, prior=False), objective.size(point)
        return bool(np.sum(r**2) > POOR_FIT * np.sum(size[: r.size] ** 2))
    poles = objective.poles_measured
    alone = all(isinstance(residual, Eigenvalues) for residual in objective.residuals)
    if poles is None or not alone or point.p.size < 2:
        return False
    found = point.eigen.poles[point.columns(poles.numbers)]
    far = np.max(np.abs(found - poles.target) / np.abs(poles.target)) >= NEGLIGIBLE
    return bool(far) or not end.converged


def from_starts(
    objective: Objective, begins: list[FloatArray], search: SearchPlan
) -> tuple[SearchEnd, list[Reached]]:
    """Return the best end, the objective being there, and what every start led to."""
    ends = [_reached(SearchPlan.begun, search, objective, one) for one in begins]
    reached = [found for found in ends if isinstance(found, SearchEnd)]
    if not reached:
        raise none_found(objective, begins, ends)
    best = min(reached, key=lambda found: found.cost)
    # the modes of the best end are numbered from its own start
    objective.follow([best.p], best.point)
    return best, ends


#: largest relative change of eigenvalues by each parameter of a distant start, and range of smaller
#: changes in decades
FIRST_CHANGE, DECADES = 0.1, 1.5


def all_starts(objective: Objective, start: Any, starts: Any, rng: Rng) -> list[FloatArray]:
    """Return the start and the others: given ones, or a Latin hypercube in bounds or priors."""
    first = objective.default_start
    if start is not None:
        first = checked_values(start, objective.parameters, "start")
        _check_inside(objective, first)
    if starts is None:
        return [first]
    if np.ndim(starts) == 0:
        others = whole(starts, "starts") - 1
        return [first, *_random_starts(objective, others, rng)] if others else [first]
    values = real_array(starts, "starts")
    if values.ndim != 2 or values.shape[1] != first.size or not values.shape[0]:
        raise ShapeError(f"starts must have shape (any, {first.size}), got {values.shape}.")
    for value in values:
        _check_inside(objective, value)
    return list(values)


def summary(
    objective: Objective, best: SearchEnd, begins: list[FloatArray], ends: list[Reached]
) -> Starts:
    """Return the results of all starts, with the objective at the best end."""
    point, nan = objective.at(best.p), np.full(best.p.size, np.nan)
    found = [end for end in ends if isinstance(end, SearchEnd) and end.converged]
    minima: list[SearchEnd] = []
    for end in sorted(found, key=lambda one: one.cost):
        if not any(_same_minimum(objective, point, end, other) for other in (best, *minima)):
            minima.append(end)
    above = _above(objective, best, minima)
    return Starts(
        np.array(begins),
        np.array([end.p if isinstance(end, SearchEnd) else nan for end in ends]),
        np.array([end.cost if isinstance(end, SearchEnd) else np.inf for end in ends]),
        tuple(
            "; then ".join(end.tried) or end.reason if isinstance(end, SearchEnd) else str(end)
            for end in ends
        ),
        np.array([end.p for end in minima]).reshape(-1, best.p.size),
        above,
    )


def _same_minimum(objective: Objective, point: Point, a: SearchEnd, b: SearchEnd) -> bool:
    """Return whether two ends are one minimum: their difference does not change the fit.

    The change is less than a standard deviation if the noise is known, and relatively small.
    """
    change = np.abs(objective.slopes(point) @ (a.p - b.p))
    noise = objective.noise_known and float(np.linalg.norm(change)) < a.p.size**0.5
    return noise or bool(np.max(change / objective.size(point)) < FOUR_DIGITS)


def _above(objective: Objective, best: SearchEnd, minima: list[SearchEnd]) -> FloatArray:
    """Return the increase of -2 ln of the likelihood at other minima."""
    # the difference of chi-square, or `n ln(e/e_least)` where the residual exceeds noise
    if not minima:
        return np.zeros(0)
    point, free = objective.at(best.p), np.ones(best.p.size, dtype=bool)
    rows, (least, dof) = objective.values(point).size, chi_square(objective, point, free)
    if least is None or not objective.noise_known or is_bad(chance(least, dof)):
        costs = np.array([max(end.cost, TINY) for end in minima])
        return np.asarray(rows * np.log(costs / max(best.cost, TINY)), dtype=np.float64)
    found = []
    for end in minima:
        chi2 = noise_misfit(objective, objective.follow([end.p], end.point), free)
        found.append((chi2 or 0.0) - least)
    objective.follow([best.p], best.point)
    above = np.array(found, dtype=np.float64)
    return np.asarray(np.where(np.abs(above) < TYPED * least, 0.0, above), dtype=np.float64)


def _scattered(objective: Objective, middle: FloatArray, count: int, rng: Rng) -> list[FloatArray]:
    """Return starts around one, at which each parameter changes eigenvalues by up to 10 %."""
    # sizes are drawn uniformly over decades; masses, springs and dampers are added, not removed
    eigen = objective.follow([middle]).eigen
    every = list(range(eigen.poles.size))
    moved = np.abs(objective.family.sensitivity(eigen, every)) / np.abs(eigen.poles)[:, None]
    typical = np.median(moved, axis=0)
    for k in np.flatnonzero(typical < ROUNDING * np.max(moved, axis=0)):
        # a parameter that moves fewer than half of the modes: the others change by rounding
        typical[k] = np.median(moved[moved[:, k] > ROUNDING * np.max(moved[:, k]), k])
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


def _random_starts(objective: Objective, count: int, rng: Rng) -> FloatArray:
    from scipy.stats import qmc

    low = np.where(objective.has_prior, objective.prior_mean - 2 * objective.prior_std, -np.inf)
    high = np.where(objective.has_prior, objective.prior_mean + 2 * objective.prior_std, np.inf)
    low, high = np.maximum(low, objective.lower), np.minimum(high, objective.upper)
    widths = zip(objective.parameters, high - low, strict=True)
    open_ = [p.name for p, width in widths if not np.isfinite(width)]
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
                f"start of {q.name} is {value}, outside its bounds ({low}, {high}). Begin inside."
            )


def check_units(objective: Objective, begin: FloatArray) -> None:
    """Raise ModelError if all measured poles differ from those of the model by a factor of 2 pi."""
    data = objective.poles_measured
    if data is None:
        return
    try:
        start = objective.poles(objective.begin(begin))
    except FlexplantError:
        return  # the search raises errors of the start
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
