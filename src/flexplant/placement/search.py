"""Choose sensors or actuators from candidates: exchange or exhaustive search, with a bound."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from ..errors import InfeasibleError, LabelError, ModelError, unknown_label
from ..parallel import mapped
from ..plant import StandardPlant
from ..values import FloatArray, Value, name_list, seed_sequence, whole
from .candidates import (
    WEAK,
    Criterion,
    Port,
    Scorer,
    Side,
    checked_plant,
    confirmed,
    known_candidates,
    require_any,
    scorer_of,
    with_side,
)

#: an exchange must gain this, relative, to be made: rounding must not make it go round in circles
_GAIN = 1e-12

#: up to here every subset is scored unless told otherwise: it takes seconds, and leaves no doubt
_FEW = 1500


@dataclass(frozen=True, eq=False)
class Exchange(Value):
    """Greedy choice, then exchanges of one candidate at a time; again from random starts.

    Each start ends where no single exchange helps.

    Parameters
    ----------
    starts : int
        Starts in all: the greedy one and `starts - 1` random ones.

    Raises
    ------
    ModelError
        When starts is not at least 1.
    """

    starts: int = 10

    def __post_init__(self) -> None:
        self._set(starts=whole(self.starts, "starts"))


@dataclass(frozen=True, eq=False)
class Exhaustive(Value):
    """Every subset: the optimum, proven.

    Parameters
    ----------
    limit : int
        More subsets than this are refused.

    Raises
    ------
    ModelError
        When limit is no whole number of at least 1.
    """

    limit: int = 200_000

    def __post_init__(self) -> None:
        self._set(limit=whole(self.limit, "limit"))


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
        No choice of as many candidates is better than this: the value itself when the search was
        exhaustive; by convex relaxation, and never below what all candidates together reach, for
        PoiVariance and PoiLqr (where no port has a filter or delay of its own); minus infinity for
        any other criterion.
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
    """

    chosen: tuple[str, ...]
    value: float
    bound: float
    evaluations: int
    history: tuple[tuple[float, ...], ...]
    criterion: str
    ports: tuple[Port, ...]
    side: Side

    def __repr__(self) -> str:
        ends = [steps[-1] for steps in self.history]
        agree = sum(end <= self.value * (1 + 1e-9) for end in ends)
        if self.value - self.bound <= 1e-8 * abs(self.value):
            proof = "the optimum"
        elif np.isfinite(self.bound):
            proof = f"none is more than {100 * (1 - self.bound / self.value):.2g} % better"
        else:
            proof = "no bound"
        return (
            f"<Placement {' '.join(self.chosen):.120}: {self.value:.4g} by {self.criterion}, "
            f"{proof}; {agree} of {len(ends)} starts agree, {self.evaluations} evaluations>"
        )

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
    criterion: Criterion | None = None,
    *,
    required: Sequence[str] = (),
    method: Exchange | Exhaustive | None = None,
    executor: Executor | None = None,
    progress: bool | None = None,
    rng: int | np.random.SeedSequence | np.random.Generator | None = None,
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
    method : Exchange or Exhaustive, optional
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
        plant, "y", candidates, count, criterion, required, method, executor, progress, rng
    )


def place_actuators(
    plant: StandardPlant,
    candidates: Sequence[Any],
    count: int,
    criterion: Criterion | None = None,
    *,
    required: Sequence[str] = (),
    method: Exchange | Exhaustive | None = None,
    executor: Executor | None = None,
    progress: bool | None = None,
    rng: int | np.random.SeedSequence | np.random.Generator | None = None,
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
    method : Exchange or Exhaustive, optional
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
        plant, "u", candidates, count, criterion, required, method, executor, progress, rng
    )


def _placed(
    plant: StandardPlant,
    side: Side,
    candidates: Sequence[Any],
    count: int,
    criterion: Criterion | None,
    required: Sequence[str],
    method: Exchange | Exhaustive | None,
    executor: Executor | None,
    progress: bool | None,
    rng: int | np.random.SeedSequence | np.random.Generator | None,
) -> Placement:
    checked_plant(plant)
    ports = tuple(known_candidates(plant, side, candidates).values())
    if len(ports) != len(tuple(candidates)):
        raise LabelError("a candidate is listed twice: each may be chosen once.")
    kept = _required([port.name for port in ports], required)
    count = whole(count, "count", maximum=max(len(ports), 1))
    if len(kept) > count:
        raise ModelError(f"{len(kept)} candidates are required, but only {count} are chosen.")
    scorer = scorer_of(plant, side, ports, criterion)
    require_any(scorer)
    spanning = _spanning(scorer, kept, int(count), np.ones(len(ports)))
    if scorer.missing(spanning):
        raise InfeasibleError(
            f"no choice of {count} of the {len(ports)} candidates will do; of the nearest one: "
            f"{scorer.reason(spanning)} Choose more, or require others."
        )
    if method is None:
        few = comb(len(ports) - len(kept), int(count) - len(kept)) <= _FEW
        method = Exhaustive() if few else Exchange()
    if isinstance(method, Exhaustive):
        found = _all(scorer, int(count), kept, method, executor, progress)
    elif isinstance(method, Exchange):
        found = _exchanged(scorer, int(count), kept, method, executor, progress, rng)
    else:
        raise ModelError(
            f"method must be Exchange(...) or Exhaustive(), got {type(method).__name__}. Pass one."
        )
    chosen, value, evaluations, history = found
    if not np.isfinite(value):
        raise InfeasibleError(
            f"no choice of {count} of the {len(ports)} candidates has a finite score; the last "
            f"reason: {_why(scorer, chosen)} Give more candidates or a larger count."
        )
    confirmed(scorer, chosen, value)
    bound = -np.inf
    if isinstance(method, Exhaustive):
        bound = value
    elif scorer.problem is not None:
        bound = min(scorer.problem.bound(int(count), kept), value)
    return Placement(
        tuple(ports[i].name for i in chosen),
        value,
        bound,
        evaluations,
        history,
        repr(scorer.criterion),
        tuple(ports[i] for i in chosen),
        side,
    )


def _required(names: Sequence[str], required: Sequence[str]) -> tuple[int, ...]:
    listed = name_list(required, "required candidates")
    for name in listed:
        if name not in names:
            raise unknown_label("required candidate", name, names)
    return tuple(sorted({names.index(name) for name in listed}))


def _why(scorer: Scorer, chosen: Sequence[int]) -> str:
    reason = scorer(chosen)[1]
    return scorer.reason(chosen) if reason == "rigid" else reason


#: chosen, value, evaluations, history
_Found = tuple[tuple[int, ...], float, int, tuple[tuple[float, ...], ...]]


def _all(
    scorer: Scorer,
    count: int,
    kept: tuple[int, ...],
    method: Exhaustive,
    executor: Executor | None,
    progress: bool | None,
) -> _Found:
    free = [i for i in range(len(scorer.candidates)) if i not in kept]
    total = comb(len(free), count - len(kept))
    if total > method.limit:
        raise ModelError(
            f"there are {total} subsets, more than Exhaustive(limit={method.limit}) allows. Use "
            "Exchange(), whose bound tells how far from the optimum it can be, or a higher limit."
        )
    subsets = [tuple(sorted((*kept, *rest))) for rest in combinations(free, count - len(kept))]
    scores = mapped(
        scorer, subsets, executor=executor, progress=progress, description="every subset"
    )
    values = np.array([value for value, _ in scores])
    best = int(np.argmin(values))
    return subsets[best], float(values[best]), total, ((float(values[best]),),)


def _exchanged(
    scorer: Scorer,
    count: int,
    kept: tuple[int, ...],
    method: Exchange,
    executor: Executor | None,
    progress: bool | None,
    rng: int | np.random.SeedSequence | np.random.Generator | None,
) -> _Found:
    search = _Search(scorer, count, kept)
    seed = seed_sequence(rng)
    runs = mapped(
        search,
        range(method.starts),
        executor=executor,
        progress=progress,
        rng=seed,
        description="starts",
    )
    chosen, history, _ = min(runs, key=lambda run: run[1][-1])
    return (
        chosen,
        history[-1],
        sum(run[2] for run in runs),
        tuple(run[1] for run in runs),
    )


class _Search:
    """One start and its exchanges; start 0 is greedy."""

    def __init__(self, scorer: Scorer, count: int, kept: tuple[int, ...]) -> None:
        self.scorer, self.count, self.kept = scorer, count, kept

    def __call__(
        self, start: int, rng: np.random.Generator
    ) -> tuple[tuple[int, ...], tuple[float, ...], int]:
        """Return the choice, the values on the way to it and the number of evaluations."""
        seen: dict[tuple[int, ...], float] = {}

        def value(chosen: Sequence[int]) -> float:
            key = tuple(sorted(chosen))
            if key not in seen:
                seen[key] = self.scorer(key)[0]
            return seen[key]

        total = len(self.scorer.candidates)
        chosen = self._start(start, rng, value)
        values = [value(chosen)]
        idle = 0
        movable = [i for i in range(self.count) if chosen[i] not in self.kept]
        while movable and idle < len(movable):
            slot = movable.pop(0)
            movable.append(slot)
            rest = [i for i in range(total) if i not in chosen]
            trials = [[*chosen[:slot], i, *chosen[slot + 1 :]] for i in rest]
            best = min(trials, key=value, default=chosen)
            if value(best) < values[-1] - _GAIN * abs(values[-1]) or (
                np.isinf(values[-1]) and np.isfinite(value(best))
            ):
                chosen, idle = best, 0
                values.append(value(best))
            else:
                idle += 1
        return tuple(sorted(chosen)), tuple(values), len(seen)

    def _start(self, start: int, rng: np.random.Generator, value: Any) -> list[int]:
        total = len(self.scorer.candidates)
        weights = np.ones(total) if start == 0 else rng.uniform(0.1, 1.0, total)
        chosen = _spanning(self.scorer, self.kept, self.count, weights)
        rest = [i for i in range(total) if i not in chosen]
        if start:
            return chosen + list(rng.permutation(rest)[: self.count - len(chosen)])
        while len(chosen) < self.count:
            best = min(
                (i for i in range(total) if i not in chosen), key=lambda i: value([*chosen, i])
            )
            chosen.append(best)
        return chosen


def _spanning(scorer: Scorer, kept: tuple[int, ...], count: int, weights: FloatArray) -> list[int]:
    """Return `kept` and candidates that add most to the rigid-body modes seen, one by one.

    Orthogonalisation with pivoting: it reaches the highest rank that any choice of the size has.
    """
    chosen = list(kept)
    left = scorer.rigid.copy()
    for i in kept:
        left = _without(left, left[i])
    while len(chosen) < count:
        sizes = np.linalg.norm(left, axis=1) * weights
        sizes[chosen] = 0.0
        pick = int(np.argmax(sizes))
        if np.linalg.norm(left[pick]) < WEAK:
            break
        chosen.append(pick)
        left = _without(left, left[pick])
    return chosen


def _without(rows: FloatArray, row: FloatArray) -> FloatArray:
    size = float(np.linalg.norm(row))
    if size < WEAK:
        return rows
    unit = row / size
    return rows - np.outer(rows @ unit, unit)
