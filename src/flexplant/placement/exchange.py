"""Greedy choice, then exchanges of one candidate at a time, from several starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ..checks import FloatArray, checked, function, whole
from ..work import Work
from .layouts import layouts_of
from .problem import Found, Problem, Search
from .quadratic import Quadratic
from .tangent import Below

#: from so many trials on a lower bound shows first which of them could be better
_MANY = 24
#: an exchange must gain this, relative, to be made: rounding must not make it go round in circles
_GAIN = 1e-12


@dataclass(frozen=True, eq=False)
class Exchange(Search):
    """Greedy choice, then exchanges of one candidate at a time; again from other starts.

    Each start ends where no single exchange helps. Of many exchanges only those are scored that a
    lower bound does not exclude, where the criterion has one.

    Parameters
    ----------
    starts : int
        The greedy one and `starts - 1` random ones. Where the criterion has a relaxation the choice
        of the largest relaxed weights is one more.

    Raises
    ------
    ModelError
        When starts is not at least 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> method = fx.placement.Exchange(starts=2)
    >>> fx.place_sensors(plant, candidates, 2, method=method, rng=0).chosen
    ('s1', 's3')
    """

    starts: int = field(default=10, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> Found:
        """Return the best of all starts, bounded by relaxation; see `Search.search`."""
        relaxed = problem.relaxed()
        chosen, history, evaluations = best_start(problem, self.starts, relaxed, work)
        value = min(steps[-1] for steps in history)
        bound = relaxed[0] if relaxed is not None else problem.bound()
        bound = min(bound, value) if np.isfinite(value) else -np.inf
        return Found(chosen, value, bound, evaluations, history)


def best_start(
    problem: Problem, starts: int, relaxed: tuple[float, FloatArray] | None, work: Work
) -> tuple[tuple[int, ...], tuple[tuple[float, ...], ...], int]:
    """Return the best choice of several starts, the values on the way of each, evaluations."""
    rounded = None if relaxed is None else problem.rounded(relaxed[1])
    runs = work.mapped(
        partial(_run, problem),
        ["greedy", *["random"] * (starts - 1), *([] if rounded is None else [rounded])],
        rng=work.rng,
        description="starts",
        restored=lambda row: (tuple(row[0]), tuple(row[1]), row[2]),
    )
    chosen, _, _ = min(runs, key=lambda run: run[1][-1])
    return chosen, tuple(run[1] for run in runs), sum(run[2] for run in runs)


def _run(
    problem: Problem, first: tuple[int, ...] | str, rng: np.random.Generator
) -> tuple[tuple[int, ...], tuple[float, ...], int]:
    run = _Run(problem)
    if isinstance(first, str):
        return run.exchanged(run.greedy() if first == "greedy" else run.drawn(rng))
    return run.exchanged(first)


class _Run:
    """Exchanges from a first choice; scores that are known are not computed again."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.seen: dict[tuple[int, ...], float] = {}
        self.tangent: tuple[tuple[int, ...], Below | None] | None = None

    def exchanged(self, first: Sequence[int]) -> tuple[tuple[int, ...], tuple[float, ...], int]:
        """Return the choice, the values on the way to it and the number of evaluations."""
        units = {i: unit for unit in self.problem.units for i in unit}
        chosen = list(dict.fromkeys(units.get(int(i), (int(i),)) for i in first))
        values = [float(self._values([_flat(chosen)])[0])]
        movable = [i for i, unit in enumerate(chosen) if not set(unit) & set(self.problem.required)]
        idle = 0
        while movable and idle < len(movable):
            slot = movable.pop(0)
            movable.append(slot)
            size = len(chosen[slot])
            rest = [u for u in self.problem.units if u not in chosen and len(u) == size]
            trials = [[*chosen[:slot], u, *chosen[slot + 1 :]] for u in rest] or [chosen]
            found = self._promising([_flat(units) for units in trials], _flat(chosen), values[-1])
            best, value = trials[int(np.argmin(found))], float(found.min())
            if value < values[-1] - _GAIN * abs(values[-1]) or (
                np.isinf(values[-1]) and np.isfinite(value)
            ):
                chosen, idle = best, 0
                values.append(value)
            else:
                idle += 1
        return tuple(sorted(_flat(chosen))), tuple(values), len(self.seen)

    def _promising(
        self, trials: Sequence[Sequence[int]], chosen: Sequence[int], value: float
    ) -> FloatArray:
        """Return the scores of choices; infinite where a lower bound is above the value already.

        The bound is the tangent where the weights of the choice touch: it costs about as much as
        ten scores, and leaves few of hundreds to be computed.
        """
        low = np.full(len(trials), -np.inf)
        if len(trials) >= _MANY and np.isfinite(value):
            if self.tangent is None or self.tangent[0] != tuple(chosen):
                self.tangent = tuple(chosen), _touching(self.problem, chosen)
            if self.tangent[1] is not None:
                low = self.tangent[1].values(trials)
        found = np.full(len(trials), np.inf)
        kept = np.flatnonzero(low < value).tolist()
        found[kept] = self._values([trials[i] for i in kept])
        return found

    def _values(self, trials: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores of choices, those not seen before at once."""
        keys = [tuple(sorted(chosen)) for chosen in trials]
        new = list(dict.fromkeys(key for key in keys if key not in self.seen))
        self.seen.update(zip(new, self.problem.score(new).tolist(), strict=True))
        return np.array([self.seen[key] for key in keys])

    def greedy(self) -> list[int]:
        """Return a choice made of the best next candidate, again and again."""
        chosen = list(self.problem.start(None))
        rest = [i for i in self.problem.free if i not in chosen]
        while len(chosen) < self.problem.count:
            best = int(np.argmin(self._values([[*chosen, i] for i in rest])))
            chosen.append(rest.pop(best))
        return chosen

    def drawn(self, rng: np.random.Generator) -> list[int]:
        """Return a choice by chance."""
        chosen = list(self.problem.start(rng))
        rest = [i for i in self.problem.free if i not in chosen]
        return [*chosen, *rng.permutation(rest)[: self.problem.count - len(chosen)].tolist()]


def _touching(problem: Problem, chosen: Sequence[int]) -> Below | None:
    """Return the tangent of a convex cost at a choice; None where there is none."""
    scorer = problem.layouts.scorer
    if not isinstance(scorer, Quadratic):
        return None
    weights = np.zeros(problem.total)
    weights[list(chosen)] = 1.0
    return scorer.inner_tangent(problem.root, weights)


def _flat(units: Sequence[tuple[int, ...]]) -> list[int]:
    return [i for unit in units for i in unit]


#: up to so many choices are all scored by the fast criterion
_ALL = 20_000


@dataclass(frozen=True, eq=False, repr=False)
class Screened(Search):
    """Choices ranked by a fast criterion, the first few scored by the one that counts.

    All choices are ranked where there are at most 20 000; else that on which exchanges by the fast
    criterion end, and all that differ from it by one candidate. For a plant with many modes:
    ``Screened(OverMachines(PoiVariance(), [plant_with_few_modes]))``, confirmed by
    ``PoiVariance(larger=all_modes)``, where modes left out are noise.

    Parameters
    ----------
    by : Criterion or callable
        The fast criterion.
    keep : int
        How many choices are scored by the criterion that counts.
    starts : int
        Of the exchanges.

    Raises
    ------
    ModelError
        When `by` is not callable, or a number is not at least 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> method = fx.placement.Screened(fx.PoiVariance("die"), starts=1)
    >>> fx.place_sensors(plant, candidates, 1, fx.PoiVariance("die"), method=method, rng=0).chosen
    ('s1',)
    """

    by: Any = field(
        metadata=checked(function, name="by, a criterion,", hint="Pass PoiVariance(), say.")
    )
    keep: int = field(default=40, kw_only=True, metadata=checked(whole))
    starts: int = field(default=6, kw_only=True, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> Found:
        """Return the best of the first few, bounded by relaxation; see `Search.search`."""
        own = problem.layouts
        fast = layouts_of(own.plant, own.side, own.candidates, self.by)
        ranked = self._ranked(replace(problem, layouts=fast), work)
        values = own.scores(ranked, work, "the best few")
        best = int(np.argmin(values))
        value = float(values[best])
        bound = min(problem.bound(), value) if np.isfinite(value) else -np.inf
        return Found(ranked[best], value, bound, len(ranked), ((value,),))

    def _ranked(self, problem: Problem, work: Work) -> list[tuple[int, ...]]:
        """Return the first few choices by the fast criterion."""
        if problem.subsets <= _ALL:
            sets = list(problem.choices())
        else:
            chosen = Exchange(self.starts).search(problem, work).chosen
            movable = [u for u in problem.units if set(u) <= set(chosen)]
            near = {chosen}
            for out in movable:
                kept = set(chosen) - set(out)
                others = [u for u in problem.units if len(u) == len(out) and not set(u) & kept]
                near |= {tuple(sorted({*kept, *unit})) for unit in others}
            sets = sorted(near)
            sets = [s for s, holds in zip(sets, problem.rows.hold(sets), strict=True) if holds]
        values = problem.layouts.scores(sets, work, "screened")
        return [sets[i] for i in np.argsort(values, kind="stable")[: self.keep].tolist()]
