"""Greedy choice, then exchanges of one candidate at a time, from several starts."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..parallel import mapped
from ..values import FloatArray, Rng, seed_sequence, whole
from .problem import Found, Problem, Search

#: an exchange must gain this, relative, to be made: rounding must not make it go round in circles
_GAIN = 1e-12


@dataclass(frozen=True, eq=False)
class Exchange(Search):
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

    def search(
        self, problem: Problem, rng: Rng, executor: Executor | None, progress: bool | None
    ) -> Found:
        """Return the best of all starts, bounded by relaxation; see `Search.search`."""
        chosen, history, evaluations = best_start(problem, self.starts, rng, executor, progress)
        value = min(steps[-1] for steps in history)
        bound = min(problem.bound(), value) if np.isfinite(value) else -np.inf
        return Found(chosen, value, bound, evaluations, history)


def best_start(
    problem: Problem, starts: int, rng: Rng, executor: Executor | None, progress: bool | None
) -> tuple[tuple[int, ...], tuple[tuple[float, ...], ...], int]:
    """Return the best choice of several starts, the values on the way of each, evaluations."""
    runs = mapped(
        partial(_run, problem),
        range(starts),
        executor=executor,
        progress=progress,
        rng=seed_sequence(rng),
        description="starts",
    )
    chosen, _, _ = min(runs, key=lambda run: run[1][-1])
    return chosen, tuple(run[1] for run in runs), sum(run[2] for run in runs)


def _run(
    problem: Problem, start: int, rng: np.random.Generator
) -> tuple[tuple[int, ...], tuple[float, ...], int]:
    return _Run(problem).from_start(start, rng)


class _Run:
    """One start and its exchanges; start 0 is greedy."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.seen: dict[tuple[int, ...], float] = {}

    def from_start(
        self, start: int, rng: np.random.Generator
    ) -> tuple[tuple[int, ...], tuple[float, ...], int]:
        """Return the choice, the values on the way to it and the number of evaluations."""
        chosen = self._start(start, rng)
        values = [float(self._values([_flat(chosen)])[0])]
        movable = [i for i, unit in enumerate(chosen) if not set(unit) & set(self.problem.required)]
        idle = 0
        while movable and idle < len(movable):
            slot = movable.pop(0)
            movable.append(slot)
            size = len(chosen[slot])
            rest = [u for u in self.problem.units if u not in chosen and len(u) == size]
            trials = [[*chosen[:slot], u, *chosen[slot + 1 :]] for u in rest] or [chosen]
            found = self._values([_flat(units) for units in trials])
            best, value = trials[int(np.argmin(found))], float(found.min())
            if value < values[-1] - _GAIN * abs(values[-1]) or (
                np.isinf(values[-1]) and np.isfinite(value)
            ):
                chosen, idle = best, 0
                values.append(value)
            else:
                idle += 1
        return tuple(sorted(_flat(chosen))), tuple(values), len(self.seen)

    def _values(self, trials: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores of choices, those not seen before at once."""
        keys = [tuple(sorted(chosen)) for chosen in trials]
        new = list(dict.fromkeys(key for key in keys if key not in self.seen))
        self.seen.update(zip(new, self.problem.score(new).tolist(), strict=True))
        return np.array([self.seen[key] for key in keys])

    def _start(self, start: int, rng: np.random.Generator) -> list[tuple[int, ...]]:
        """Return the first choice, as units."""
        problem = self.problem
        chosen = list(problem.start(rng if start else None))
        rest = [i for i in problem.free if i not in chosen]
        if start:
            chosen += list(rng.permutation(rest)[: problem.count - len(chosen)])
        while len(chosen) < problem.count:
            best = int(np.argmin(self._values([[*chosen, i] for i in rest])))
            chosen.append(rest.pop(best))
        units = {i: unit for unit in problem.units for i in unit}
        return list(dict.fromkeys(units.get(int(i), (int(i),)) for i in chosen))


def _flat(units: Sequence[tuple[int, ...]]) -> list[int]:
    return [i for unit in units for i in unit]
