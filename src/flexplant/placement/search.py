"""Choose sensors or actuators from candidates by a search, with a bound of how good it can be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InfeasibleError, LabelError, ModelError, unknown_label
from ..plant import StandardPlant
from ..values import Rng, Value, instance, name_list, whole
from .candidates import Port, Side, checked_plant, known_candidates, with_side
from .constraints import Constraint, rows_of
from .criterion import Criterion
from .exchange import Exchange
from .exhaustive import Exhaustive
from .layouts import layouts_of
from .places import places_of
from .problem import Problem, Search

#: up to here every subset is scored when no method is given: it takes seconds, and proves it
_FEW = 1500


@dataclass(frozen=True, eq=False, repr=False)
class Placement(Value):
    """The best choice that was found, and how good any choice could be.

    Parameters
    ----------
    chosen : tuple of str
        Names, in the order of the candidates.
    value : float
        Of the criterion.
    bound : float
        No choice of as many candidates is better than this: the value itself when the optimum is
        proven (by every subset, or by branch and bound); by convex relaxation, and never below what
        all candidates together reach, for PoiVariance of the plant's own modes and PoiLqr (where no
        port has a filter or delay of its own); minus infinity for any other criterion.
    evaluations : int
        Choices that were scored.
    history : tuple of tuples of float
        The value after each improvement, for each start.
    criterion : str
        What was minimised.
    ports : tuple of Sensor or Actuator
        The chosen ones.
    side : {"y", "u"}
        Whether they are sensors or actuators.
    stopped : str
        Why the search ended before it had proven what it should; empty when it did not.
    """

    chosen: tuple[str, ...]
    value: float
    bound: float
    evaluations: int
    history: tuple[tuple[float, ...], ...]
    criterion: str
    ports: tuple[Port, ...]
    side: Side
    stopped: str = ""

    def __repr__(self) -> str:
        ends = [steps[-1] for steps in self.history]
        agree = sum(end <= self.value + 1e-9 * abs(self.value) for end in ends)
        if self.proven:
            proof = "the optimum, proven"
        elif np.isfinite(self.bound):
            proof = f"none is more than {100 * self.gap:.2g} % better"
        else:
            proof = "no bound"
        return (
            f"<Placement {' '.join(self.chosen):.120}: {self.value:.4g} by {self.criterion}, "
            f"{proof}; {agree} of {len(ends)} starts agree, {self.evaluations} evaluations"
            f"{', ' if self.stopped else ''}{self.stopped}>"
        )

    @property
    def gap(self) -> float:
        """The part of the value by which any choice could be better; infinite without a bound."""
        if not np.isfinite(self.bound):
            return np.inf
        return (self.value - self.bound) / abs(self.value) if self.value else 0.0

    @property
    def proven(self) -> bool:
        """Whether no choice is better, apart from rounding."""
        return self.gap <= 1e-8

    def on(self, plant: StandardPlant) -> StandardPlant:
        """Return the plant with the chosen sensors (actuators) instead of its own.

        Parameters
        ----------
        plant : StandardPlant
            Of the same machine; assembled from a structure.
        """
        return with_side(plant, self.side, self.ports)


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
    progress: bool | None = None,
    rng: Rng = None,
) -> Placement:
    """Return the best choice of `count` sensors among candidates.

    A choice must see every rigid-body mode before it is scored at all. The score of the answer is
    confirmed by `design_kalman` (for `PoiVariance`).

    Parameters
    ----------
    plant : StandardPlant
        Sampled, assembled from a structure; its own sensors are not used.
    candidates : sequence of Sensor
        Each may be chosen once; a name stands for one of the plant's own.
    count : int
        How many are chosen, `required` included.
    criterion : PoiVariance or callable, optional
        From a plant to a float, smaller is better; `PoiVariance()` when not given.
    required : sequence of str
        Candidates that any choice includes.
    constraints : sequence of Constraint, optional
        What every choice satisfies: Excluded, OffPoi, Within, MinimumDistance, Together, Mirrored,
        Budget. No sensor is placed on a POI unless OffPoi(-1) is among them.
    method : Exchange, BranchAndBound or Exhaustive, optional
        Every subset where there are at most 1500, else `Exchange()`, when not given.
    executor : concurrent.futures.Executor, optional
        Works on starts (or chunks of subsets); the result is the same to the bit.
    progress : bool, optional
        A bar: None shows one on a terminal for work of more than two seconds.
    rng : int, SeedSequence or Generator, optional
        For the random starts.

    Returns
    -------
    Placement
        With a lower bound for every choice of as many candidates.

    Raises
    ------
    ModelError
        When the plant, a candidate, count or method is not what is needed.
    LabelError
        When a name or a place is unknown or doubled.
    AssumptionError
        When even all candidates miss a rigid-body mode, which is named, or the criterion has no
        meaning on this plant.
    InfeasibleError
        When no choice of this size has a finite score.
    CertificateError
        When the score is not confirmed by the other route.
    """
    return _placed(
        plant,
        "y",
        candidates,
        count,
        criterion,
        required,
        constraints,
        method,
        executor,
        progress,
        rng,
    )


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
    progress: bool | None = None,
    rng: Rng = None,
) -> Placement:
    """Return the best choice of `count` actuators among candidates: the dual of `place_sensors`.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, assembled from a structure; its own actuators are not used.
    candidates : sequence of Actuator
        Each may be chosen once; a name stands for one of the plant's own.
    count : int
        How many are chosen, `required` included.
    criterion : PoiLqr or callable, optional
        From a plant to a float, smaller is better; `PoiLqr()` when not given.
    required : sequence of str
        Candidates that any choice includes.
    constraints : sequence of Constraint, optional
        What every choice satisfies: Excluded, OffPoi, Within, MinimumDistance, Together, Mirrored,
        Budget.
    method : Exchange, BranchAndBound or Exhaustive, optional
        Every subset where there are at most 1500, else `Exchange()`, when not given.
    executor : concurrent.futures.Executor, optional
        Works on starts (or chunks of subsets); the result is the same to the bit.
    progress : bool, optional
        A bar: None shows one on a terminal for work of more than two seconds.
    rng : int, SeedSequence or Generator, optional
        For the random starts.

    Returns
    -------
    Placement
        With a lower bound for every choice of as many candidates.

    Raises
    ------
    ModelError
        When the plant, a candidate, count or method is not what is needed.
    LabelError
        When a name or a place is unknown or doubled.
    AssumptionError
        When even all candidates leave a rigid-body mode alone, which is named, or the criterion
        has no meaning on this plant.
    InfeasibleError
        When no choice of this size has a finite score.
    CertificateError
        When the score is not confirmed by the other route.
    """
    return _placed(
        plant,
        "u",
        candidates,
        count,
        criterion,
        required,
        constraints,
        method,
        executor,
        progress,
        rng,
    )


def _placed(
    plant: StandardPlant,
    side: Side,
    candidates: Sequence[Any],
    count: int,
    criterion: Criterion | Callable[[StandardPlant], float] | None,
    required: Sequence[str],
    constraints: Sequence[Constraint],
    method: Search | None,
    executor: Executor | None,
    progress: bool | None,
    rng: Rng,
) -> Placement:
    checked_plant(plant)
    ports = tuple(known_candidates(plant, side, candidates).values())
    if len(ports) != len(tuple(candidates)):
        raise LabelError("a candidate is listed twice: each may be chosen once.")
    kept = _required([port.name for port in ports], required)
    count = whole(count, "count", maximum=max(len(ports), 1))
    if len(kept) > count:
        raise ModelError(f"{len(kept)} candidates are required, but only {count} are chosen.")
    layouts = layouts_of(plant, side, ports, criterion)
    layouts.require_any()
    places = places_of(plant, ports)
    rows = rows_of(constraints, places, side)
    kept = rows.with_partners(kept)
    problem = Problem(layouts, count, kept, rows)
    _require_start(problem, constraints)
    if method is None:
        method = Exhaustive() if problem.subsets <= _FEW else Exchange()
    instance(method, Search, "method", "Pass Exchange(...), BranchAndBound(...) or Exhaustive().")
    found = method.search(problem, rng, executor, progress)
    if not np.isfinite(found.value):
        raise InfeasibleError(
            f"no choice of {count} of the {len(ports)} candidates has a finite score; the last "
            f"reason: {layouts.reason(found.chosen)} Give more candidates or a larger count."
        )
    layouts.confirm(found.chosen, found.value)
    return Placement(
        tuple(ports[i].name for i in found.chosen),
        found.value,
        found.bound,
        found.evaluations,
        found.history,
        repr(layouts.criterion),
        tuple(ports[i] for i in found.chosen),
        side,
        found.stopped,
    )


def _require_start(problem: Problem, constraints: Sequence[Constraint]) -> None:
    """Raise InfeasibleError when there is no choice to begin with."""
    layouts = problem.layouts
    first = problem.start(None) if len(problem.required) <= problem.count else ()
    what = f"no choice of {problem.count} of the {problem.total} candidates"
    if not first and problem.rows.A.size:
        given = ", ".join(map(repr, constraints)) or "OffPoi()"
        raise InfeasibleError(
            f"{what} satisfies the constraints {given:.300}: {len(problem.free)} candidates are "
            f"free and {len(problem.required)} required. Relax a constraint, or give more "
            "candidates."
        )
    if layouts.missing(first):
        raise InfeasibleError(
            f"{what} will do; of the nearest one: {layouts.reason(first)} Choose more, or require "
            "others."
        )


def _required(names: Sequence[str], required: Sequence[str]) -> tuple[int, ...]:
    listed = name_list(required, "required candidates")
    for name in listed:
        if name not in names:
            raise unknown_label("required candidate", name, names)
    return tuple(sorted({names.index(name) for name in listed}))
