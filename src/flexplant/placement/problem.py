"""The problem of a search: which `count` of the candidates, some of them required."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from math import comb, prod

import numpy as np

from ..checks import FloatArray, Value
from ..work import Work
from .layouts import WEAK, Layouts
from .rows import Branch, LinearRows
from .tangent import Convex

#: draws of an admissible choice until one sees every rigid-body mode
_DRAWS = 20


@dataclass(frozen=True, eq=False)
class Problem:
    """The best choice of candidates, as an optimisation problem.

    Parameters
    ----------
    layouts : Layouts
        The candidates and the score of each set of them.
    count : int
        How many to choose.
    required : tuple of int
        Indices of candidates that every choice holds.
    rows : LinearRows
        What every choice satisfies.
    """

    layouts: Layouts
    count: int
    required: tuple[int, ...]
    rows: LinearRows

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return len(self.layouts.candidates)

    @cached_property
    def units(self) -> list[tuple[int, ...]]:
        """Candidates that may be left out, those that are chosen together as one."""
        shut = self.rows.shut(self.required)
        units = [u for u in self.rows.units() if not set(u) & set(self.required)]
        return [u for u in units if not np.any(shut[list(u)])]

    @property
    def free(self) -> list[int]:
        """Candidates that may be left out."""
        return sorted(i for unit in self.units for i in unit)

    @cached_property
    def subsets(self) -> int:
        """How many choices of units there are; some may be against other constraints."""
        sizes = self._by_size
        return sum(
            prod(comb(len(sizes[size]), n) for size, n in mix.items()) for mix in self._mixes()
        )

    def choices(self) -> Iterator[tuple[int, ...]]:
        """Yield every choice that satisfies the constraints, indices ascending."""
        for mix in self._mixes():
            parts = [combinations(self._by_size[size], n) for size, n in mix.items()]
            for units in product(*parts):
                chosen = tuple(sorted((*self.required, *(i for p in units for u in p for i in u))))
                if not self.rows.A.size or self.rows.hold([chosen])[0]:
                    yield chosen

    @property
    def root(self) -> Branch:
        """All choices, apart from those constraints that exclude no single candidate."""
        groups = (
            (np.array(self.required, dtype=np.int64), len(self.required)),
            (np.array(self.free, dtype=np.int64), self.count - len(self.required)),
        )
        return Branch(tuple((group, count) for group, count in groups if count))

    def bound(self) -> float:
        """Return a number below the score of every choice; minus infinity when none is known."""
        relaxed = self.relaxed()
        if relaxed is None:
            return self.layouts.scorer.bound(self.count, self.required)
        return relaxed[0]

    def relaxed(self) -> tuple[float, FloatArray] | None:
        """Return a lower bound and weights (N,) near the least relaxed cost, where it is convex."""
        scorer, root = self.layouts.scorer, self.root
        if not isinstance(scorer, Convex) or self.layouts.missing(root.members.tolist()):
            return None
        return scorer.relaxation(root) if self.rows.possible(root) else None

    def rounded(self, weights: FloatArray) -> tuple[int, ...] | None:
        """Return the choice with the largest weights (N,); None where it misses something."""
        if self.rows.A.size:
            found = self.rows.best(weights, self.count, self.required)
        else:
            order = np.argsort(-weights, kind="stable")
            rest = [i for i in order.tolist() if i not in self.required]
            found = tuple(sorted((*self.required, *rest[: self.count - len(self.required)])))
        return found if found is None or not self.layouts.missing(found) else None

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, infinite where a constraint is not satisfied."""
        values = np.full(len(sets), np.inf)
        kept = np.flatnonzero(self.rows.hold(sets)).tolist() if len(sets) else []
        values[kept] = self.layouts.score([sets[i] for i in kept])
        return values

    def start(self, random: np.random.Generator | None) -> tuple[int, ...]:
        """Return a choice that satisfies the constraints and sees every rigid-body mode.

        By chance where there is a generator, else by relaxed weights; the nearest one when none
        was found, and no index at all when no choice satisfies the constraints.
        """
        if not self.rows.A.size:
            weights = None if random is None else random.uniform(0.1, 1.0, self.total)
            return tuple(self.spanning(weights))
        draws = np.random.default_rng(0) if random is None else random
        nearest: tuple[int, ...] = ()
        for draw in range(_DRAWS):
            worth = draws.uniform(0.0, 1.0, self.total)
            worth[self.spanning(worth)] += 2.0
            if random is None and not draw and (relaxed := self.relaxed()) is not None:
                worth = relaxed[1]
            found = self.rows.best(worth, self.count, self.required)
            if found is None:
                break
            missed = self.layouts.missing(found)
            if not nearest or missed < self.layouts.missing(nearest):
                nearest = found
            if not missed:
                break
        return nearest

    @cached_property
    def _by_size(self) -> dict[int, list[tuple[int, ...]]]:
        found: dict[int, list[tuple[int, ...]]] = {}
        for unit in self.units:
            found.setdefault(len(unit), []).append(unit)
        return dict(sorted(found.items()))

    def _mixes(self) -> Iterator[dict[int, int]]:
        """Yield how many units of each size make up the count."""
        more, sizes = self.count - len(self.required), list(self._by_size)
        limits = [range(min(len(self._by_size[s]), more // s) + 1) for s in sizes]
        for numbers in product(*limits):
            if sum(s * n for s, n in zip(sizes, numbers, strict=True)) == more:
                yield dict(zip(sizes, numbers, strict=True))

    def spanning(self, weights: FloatArray | None = None) -> list[int]:
        """Return the required and those that add most to the rigid-body modes seen, one by one.

        Orthogonalisation with pivoting: it reaches the highest rank that any choice of the size
        has. Weights (N,) favour some candidates.
        """
        chosen, shut = list(self.required), self.rows.shut(self.required)
        left = self.layouts.rigid.rows.copy()
        for i in self.required:
            left = _without(left, left[i])
        while len(chosen) < self.count:
            sizes = np.linalg.norm(left, axis=1) * (1.0 if weights is None else weights)
            sizes[chosen] = 0.0
            sizes[shut] = 0.0
            pick = int(np.argmax(sizes))
            if np.linalg.norm(left[pick]) < WEAK:
                break
            chosen.append(pick)
            left = _without(left, left[pick])
        return chosen


@dataclass(frozen=True, eq=False)
class Found:
    """The result of a search: chosen names, value, bound, evaluations.

    Parameters
    ----------
    chosen : tuple of int
        Indices of the candidates chosen.
    value, bound : float
        Their score, and a number below the score of every choice.
    evaluations : int
        How many sets were scored.
    history : tuple of tuple of float
        The best score after each step, for each start.
    stopped : str
        Why the search ended before it had proven what it should; empty when it did not.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.placement.Found(("s1",), 2.0, 1.5, 7, (3.0, 2.0))
    >>> found.value - found.bound
    0.5
    """

    chosen: tuple[int, ...]
    value: float
    bound: float
    evaluations: int
    history: tuple[tuple[float, ...], ...]
    stopped: str = ""


class Search(Value):
    """The base class of search methods.

    Examples
    --------
    >>> import flexplant as fx
    >>> isinstance(fx.placement.Exchange(), fx.placement.Search)
    True
    """

    @abstractmethod
    def search(self, problem: Problem, work: Work) -> Found:
        """Return the best choice that was found.

        Parameters
        ----------
        problem : Problem
            With `score(sets)`, `bound()`, `choices()` and a `start`.
        work : Work
            Its `mapped` and `rng`: the result is the same to the bit on any executor, and work
            that was stopped goes on from a file.
        """


def _without(rows: FloatArray, row: FloatArray) -> FloatArray:
    size = float(np.linalg.norm(row))
    if size < WEAK:
        return rows
    unit = row / size
    return rows - np.outer(rows @ unit, unit)
