"""Choose sensors, actuators or both by a search, with a bound; what one more device buys."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, Rng, instance, name_list, positive, whole
from ..errors import (
    InfeasibleError,
    LabelError,
    ModelError,
    counted,
    require_known,
    short,
    some_names,
)
from ..fingerprints import fingerprint
from ..plant import Actuator, StandardPlant
from ..store import Value, checked
from ..work import Work
from .branch_and_bound import Exchange
from .candidates import (
    Places,
    Port,
    candidate_places,
    known_candidates,
    sampled_plant,
    side_of,
    with_side,
)
from .closed_loop_h2 import Separation
from .constraints import Budget, Constraint, LinearRows, constraint_rows, constraints_in_words
from .criterion import Criterion, in_words
from .problem import Placement, Problem, Search, SearchResult, layouts_of

#: up to here every subset is scored when no method is given: it takes seconds, and proves it
_FEW = 1500


def place_sensors(
    plant: StandardPlant,
    candidates: Sequence[Any],
    count: int,
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    required: Sequence[str] = (),
    constraints: Sequence[Constraint] = (),
    method: Search | None = None,
    executor: Executor | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | None = None,
    rng: Rng = None,
) -> Placement:
    """Return the best choice of `count` sensors among candidates.

    Only choices that observe every rigid-body mode are scored. For `PoiVariance`, the score of the
    result is confirmed by `design_kalman`.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant that was assembled from a structure. Its own sensors are used only if they are
        candidates; `Placement.left_out` names the others.
    candidates : sequence of Sensor
        Candidates, each chosen at most once. A name stands for a sensor of the plant.
    count : int
        Number of sensors to choose, including the `required` ones.
    criterion : PoiVariance or callable, optional
        Function of a plant that returns a float, smaller is better; by default `PoiVariance()`.
    required : sequence of str
        Candidates that any choice includes.
    constraints : sequence of Constraint, optional
        Constraints on every choice: Excluded, OffPoi, ZoneLimits, MinimumDistance,
        CountLimits, JointGroups, Budget. No sensor is placed on a POI unless OffPoi(-1) is
        among them.
    method : Search, optional
        Exchange, BranchAndBound, Exhaustive, Screened or RowSelection. By default every
        subset is tried if there are at most 1500, otherwise `Exchange()`.
    executor : concurrent.futures.Executor, optional
        Executor that processes starts, groups of subsets or branches in parallel. The result is
        identical to that without it. When a process of a pool dies, its work is repeated.
    checkpoint : path, optional
        File to which each finished part of the work is saved. If the file exists, the search
        continues where it was stopped, also after the process was killed.
    progress : bool, optional
        Whether to show a progress bar. By default (None) it is shown on a terminal or in a
        notebook, for work of more than two seconds.
    rng : int, SeedSequence or Generator, optional
        Random generator of the random starts, or its seed.

    Returns
    -------
    Placement
        The best choice, and a lower bound on the score of all choices of this size.

    Raises
    ------
    AssumptionError
        When all candidates together do not observe a rigid-body mode (the message names it), or the
        criterion does not apply to this plant.
    InfeasibleError
        When no choice of this size has a finite score.
    CertificateError
        When the second calculation does not confirm the score.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> best = fx.place_sensors(plant, candidates, 1)
    >>> best.chosen, best.proven
    (('s1',), True)
    """
    problem = problem_of(plant, {"y": (candidates, count)}, criterion, required, constraints)
    return _solution(problem, method, executor, checkpoint, progress, rng)


def place_actuators(
    plant: StandardPlant,
    candidates: Sequence[Any],
    count: int,
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    required: Sequence[str] = (),
    constraints: Sequence[Constraint] = (),
    method: Search | None = None,
    executor: Executor | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | None = None,
    rng: Rng = None,
) -> Placement:
    """Return the best choice of `count` actuators among candidates, as `place_sensors` for sensors.

    Parameters
    ----------
    plant, candidates, count, required, constraints, method, executor, checkpoint, progress, rng
        As for `place_sensors`, with `Actuator` values in place of `Sensor` values. Actuators may be
        placed on a POI (point of interest), unless OffPoi() is among the constraints.
    criterion : PoiLqr or callable, optional
        Function of a plant that returns a float, smaller is better; by default `PoiLqr()`.

    Returns
    -------
    Placement
        The best choice, and a lower bound on the score of all choices of this size.

    Raises
    ------
    ModelError, LabelError, AssumptionError, InfeasibleError, CertificateError
        As `place_sensors`.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> fx.place_actuators(plant, candidates, 1).proven
    True
    """
    problem = problem_of(plant, {"u": (candidates, count)}, criterion, required, constraints)
    return _solution(problem, method, executor, checkpoint, progress, rng)


def place_both(
    plant: StandardPlant,
    sensors: Sequence[Any],
    actuators: Sequence[Any],
    counts: Sequence[int],
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    required: Sequence[str] = (),
    constraints: Sequence[Constraint] = (),
    method: Search | None = None,
    executor: Executor | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | None = None,
    rng: Rng = None,
) -> Placement:
    """Return the best choice of sensors and actuators together, by a cost of the closed loop.

    Sensors and actuators are exchanged, one at a time, until no exchange lowers the cost. The
    result may be better than that of two separate searches, first for actuators and then for
    sensors.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant that was assembled from a structure. Its sensors and actuators are not used.
    sensors, actuators : sequence of Sensor, sequence of Actuator
        Candidates among which the sensors and the actuators are chosen.
    counts : (int, int)
        Number of sensors and number of actuators to choose, including `required`.
    criterion : ClosedLoopH2 or callable, optional
        Function of a plant that returns a float, smaller is better; by default `ClosedLoopH2()`.
    required, constraints, method, executor, checkpoint, progress, rng : optional
        As for `place_sensors`, for candidates of both kinds. A constraint does not distinguish
        sensors from actuators: a minimum distance also applies between a sensor and an actuator.

    Returns
    -------
    Placement
        The chosen `sensors` and `actuators`, and a lower bound on the cost of all pairs of choices.

    Raises
    ------
    ModelError, LabelError, AssumptionError, InfeasibleError, CertificateError
        As for `place_sensors`. ModelError also when `counts` is not a pair.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> sensors = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> actuators = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2)]
    >>> found = fx.placement.place_both(plant, sensors, actuators, (1, 1))
    >>> len(found.sensors), len(found.actuators)
    (1, 1)
    """
    if isinstance(counts, str) or not isinstance(counts, Sequence) or len(counts) != 2:
        raise ModelError(
            f"counts are two numbers, of sensors and actuators, got {short(counts)}. Type (4, 3)."
        )
    wanted = {"y": (sensors, counts[0]), "u": (actuators, counts[1])}
    problem = problem_of(plant, wanted, criterion, required, constraints)
    return _solution(problem, method, executor, checkpoint, progress, rng)


def _solution(
    problem: Problem,
    method: Search | None,
    executor: Executor | None,
    checkpoint: str | Path | None,
    progress: bool | None,
    rng: Rng,
) -> Placement:
    layouts, plant, ports = problem.layouts, problem.layouts.plant, problem.layouts.candidates
    if method is None:
        method = Exhaustive() if problem.subsets <= _FEW else Exchange()
    hint = "Pass placement.Exchange(...), placement.BranchAndBound(...) or placement.Exhaustive()."
    instance(method, Search, "method", hint)
    header = {}
    if checkpoint is not None:
        parts = [plant, *ports, layouts.criterion, problem.count, problem.required, problem.rows]
        header = {"problem": fingerprint([*parts, method])}
    with Work(executor, progress, rng, checkpoint, "search", header) as work:
        found = method.search(problem, work)
    if not np.isfinite(found.value):
        raise InfeasibleError(
            f"no choice of {problem.count} of the {len(ports)} candidates has a finite score; the "
            f"last reason: {layouts.reason(found.chosen)} Give more candidates or a larger count."
        )
    layouts.confirm(found.chosen, found.value)
    chosen = tuple(ports[i] for i in found.chosen)
    known = {port.name for port in ports}
    own = [port.name for side in layouts.side for port in getattr(plant.ports, side)]
    other = with_side(plant, layouts.side, chosen)
    moved = layouts.side == "y" and {port.name for port in chosen} != set(own)
    return Placement(
        chosen=tuple(port.name for port in chosen),
        left_out=tuple(name for name in own if name not in known),
        criterion=repr(layouts.criterion),
        ports=chosen,
        side=layouts.side,
        unit=(unit := layouts.criterion.unit(plant)),
        unjudged=plant.unjudged if unit else "",
        interval=layouts.criterion.compared(other, plant) if moved else "",
        **{name: value for name, value in vars(found).items() if name != "chosen"},
    )


@dataclass(frozen=True, eq=False)
class Exhaustive(Search):
    """A search that tries every subset, and therefore finds the optimum with a proof.

    Parameters
    ----------
    limit : int
        Largest number of subsets. If there are more, the search raises a ModelError.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, method=fx.placement.Exhaustive()).proven
    True
    """

    limit: int = field(default=200_000, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> SearchResult:
        """Return the best of all subsets, without random numbers."""
        if problem.subsets > self.limit:
            raise ModelError(
                f"there are {counted(problem.subsets, 'subset')}, more than "
                f"placement.Exhaustive(limit={self.limit}) allows. Use placement.Exchange(), "
                "whose bound shows how far from the optimum it can be, or a higher limit."
            )
        sets = list(problem.choices())
        values = problem.layouts.scores(sets, work, "every subset")
        best = int(np.argmin(values))
        value = float(values[best])
        return SearchResult(sets[best], value, value, len(sets), ((value,),))


def problem_of(
    plant: StandardPlant,
    wanted: Mapping[str, tuple[Sequence[Any], int]],
    criterion: Any,
    required: Sequence[str],
    constraints: Sequence[Constraint],
) -> Problem:
    """Return the checked problem of choosing a number of candidates of each side."""
    plant = sampled_plant(plant)
    listed = {side: _candidate_ports(plant, side, given) for side, (given, _) in wanted.items()}
    ports = tuple(port for part in listed.values() for port in part)
    names = [port.name for port in ports]
    needed = name_list(required, "required candidates")
    require_known("required candidate", needed, names)
    kept = tuple(sorted({names.index(name) for name in needed}))
    counts = {}
    for part, (_, count) in wanted.items():
        counts[part] = whole(count, "count", maximum=max(len(listed[part]), 1))
        least = sum(side_of(ports[i]) == part for i in kept)
        if least > counts[part]:
            raise ModelError(f"count is {counts[part]}, and {least} candidates are required.")
    side: Any = "".join(wanted)
    layouts = layouts_of(plant, side, ports, criterion)
    layouts.require_any()
    places = candidate_places(plant, ports)
    rows = constraint_rows(constraints, places, side)
    if len(wanted) > 1:
        own = np.array([[side_of(port) == part for port in ports] for part in counts], dtype=float)
        exact = np.array(list(counts.values()), dtype=np.float64)
        rows = rows.and_(LinearRows(own, exact, exact))
        if isinstance(layouts.scorer, Separation):
            numbers = (counts["y"], counts["u"])
            layouts = replace(layouts, scorer=replace(layouts.scorer, counts=numbers))
    problem = Problem(layouts, sum(counts.values()), rows.with_partners(kept), rows)
    _require_start(problem, constraints, places, [names[i] for i in kept])
    return problem


def _candidate_ports(plant: StandardPlant, side: str, given: Sequence[Any]) -> tuple[Port, ...]:
    ports = tuple(known_candidates(plant, side, given).values())
    if not ports:
        raise ModelError("no candidates: pass a list of at least one to choose from.")
    if len(ports) != len(tuple(given)):
        raise LabelError("a candidate is listed twice: each may be chosen once.")
    return ports


def _require_start(
    problem: Problem, constraints: Sequence[Constraint], places: Places, required: Sequence[str]
) -> None:
    """Raise InfeasibleError when no choice satisfies the constraints."""
    layouts = problem.layouts
    first = problem.start(None) if len(problem.required) <= problem.count else ()
    what = f"no choice of {problem.count} of the {problem.total} candidates"
    if not first and problem.rows.A.size:
        given = constraints_in_words(constraints, places, layouts.side)
        together = f" together with the required {some_names(required)}" if required else ""
        raise InfeasibleError(
            f"{what} satisfies the constraints {given}{together}. Relax one (placement.OffPoi(-1) "
            "allows sensors on a POI), require others, or give more candidates."
        )
    if layouts.missing(first):
        raise InfeasibleError(
            f"{what} will do; of the nearest one: {layouts.reason(first)} Choose more, or require "
            "others."
        )


@dataclass(frozen=True, eq=False, repr=False)
class ParetoCurve(Value):
    """The best choice for each count, or for each budget; prints as a table.

    Parameters
    ----------
    amounts : (n,) array
        Counts or budgets, ascending.
    placements : sequence of Placement
        The best choice that was found for each count or budget.
    bounds : (n,) array
        Lower bounds for every choice of that count (or within that budget).
    by_cost : bool
        Whether the amounts are budgets; otherwise they are counts.
    """

    amounts: FloatArray
    placements: Sequence[Placement]
    bounds: FloatArray
    by_cost: bool = False

    def __repr__(self) -> str:
        what = "cost" if self.by_cost else "count"
        lines = [f"<ParetoCurve by {what}, {self.placements[0].criterion}>"]
        for i, best in enumerate(self.placements[:6]):
            amount, bound = self.amounts[i], self.bounds[i]
            low = f", none below {in_words(bound, self.unit)}" if np.isfinite(bound) else ""
            value, chosen = in_words(best.value, self.unit), " ".join(best.chosen)
            lines.append(f"  {amount:<6g} {value}{low}: {chosen:.60}")
        if len(self.placements) > 6:
            lines.append(f"  and {len(self.placements) - 6} more")
        return "\n".join(lines)

    @property
    def values(self) -> FloatArray:
        """Value of the criterion (n,) of each placement."""
        return np.array([one.value for one in self.placements])

    @property
    def unit(self) -> str:
        """Unit of the square root of a value, if it is a mean square of a motion."""
        return self.placements[0].unit


def pareto_curve(
    plant: StandardPlant,
    candidates: Sequence[Any],
    amounts: Sequence[float],
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    costs: Mapping[str, float] | None = None,
    required: Sequence[str] = (),
    constraints: Sequence[Constraint] = (),
    method: Search | None = None,
    executor: Executor | None = None,
    progress: bool | None = None,
    rng: Rng = None,
) -> ParetoCurve:
    """Return the best choice for each of several counts, or of several budgets.

    Parameters
    ----------
    plant, candidates, criterion, required, constraints, method, executor, progress, rng
        As for `place_sensors` or `place_actuators`.
    amounts : sequence of int or float
        Numbers of devices, or budgets if `costs` is given. Amounts for which no choice is possible
        are left out.
    costs : mapping {str: float}, optional
        Cost of candidates by name; the cost of the others is 1. If it is given, `amounts` are
        budgets. For each budget, every number of devices that the budget allows is tried.

    Returns
    -------
    ParetoCurve
        Best choice for each amount; ``fx.plot.pareto_curve`` draws it.

    Raises
    ------
    ModelError, LabelError, AssumptionError, CertificateError
        As `place_sensors`.
    InfeasibleError
        When no choice is possible for any amount.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> curve = fx.placement.pareto_curve(plant, ["y1", "y2"], [1, 2])
    >>> bool(curve.values[1] < curve.values[0])
    True
    """
    plant = sampled_plant(plant)
    if not isinstance(amounts, Sequence | np.ndarray | range) or isinstance(amounts, str):
        raise ModelError(f"amounts are counts or budgets, got {short(amounts)}. Type range(3, 8).")
    given = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
    listed = isinstance(candidates, Sequence)
    pushing = listed and any(isinstance(c, Actuator) or c in plant.u for c in candidates)
    place = place_actuators if pushing else place_sensors

    def best(count: int, extra: tuple[Constraint, ...]) -> Placement | None:
        try:
            return place(
                plant, candidates, count, criterion, required=required, executor=executor,
                constraints=(*given, *extra), method=method, progress=progress, rng=rng,
            )  # fmt: skip
        except InfeasibleError:
            return None

    rows: list[tuple[float, Placement, float]] = []
    for amount in sorted(amounts):
        if costs is None:
            number = isinstance(amount, int | np.integer)  # others are refused by the search
            enough = not (number and listed and candidates) or amount <= len(candidates)
            tried = [best(amount, ())] if enough else []  # type: ignore[arg-type]
        else:
            limit = Budget(positive(amount, "a budget"), dict(costs))
            names = [c if isinstance(c, str) else c.name for c in candidates]
            prices = np.cumsum(sorted(limit.costs.get(name, limit.default) for name in names))
            most = int(np.searchsorted(prices, limit.total, side="right"))
            tried = [best(count, (limit,)) for count in range(max(len(required), 1), most + 1)]
        found = [one for one in tried if one is not None]
        if found:
            low = min(one.bound for one in found)
            rows.append((float(amount), min(found, key=lambda one: one.value), low))
    if not rows:
        raise InfeasibleError(
            f"no choice exists for any of the amounts {short(list(amounts))}. Give larger ones, "
            "or relax a constraint."
        )
    return ParetoCurve(
        np.array([row[0] for row in rows]),
        tuple(row[1] for row in rows),
        np.array([row[2] for row in rows]),
        costs is not None,
    )
