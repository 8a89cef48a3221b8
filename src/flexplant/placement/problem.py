"""The problem of a search: which `count` of the candidates, some of them required."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from math import comb

import numpy as np

from ..values import FloatArray, Rng, Value
from .layouts import WEAK, Layouts


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
    """

    layouts: Layouts
    count: int
    required: tuple[int, ...]

    @property
    def free(self) -> list[int]:
        """Candidates that may be left out."""
        return [i for i in range(len(self.layouts.candidates)) if i not in self.required]

    @property
    def subsets(self) -> int:
        """How many choices there are."""
        return comb(len(self.free), self.count - len(self.required))

    def bound(self) -> float:
        """Return a number below the score of every choice; minus infinity when none is known."""
        return self.layouts.scorer.bound(self.count, self.required)

    def spanning(self, weights: FloatArray | None = None) -> list[int]:
        """Return the required and those that add most to the rigid-body modes seen, one by one.

        Orthogonalisation with pivoting: it reaches the highest rank that any choice of the size
        has. Weights (N,) favour some candidates.
        """
        chosen = list(self.required)
        left = self.layouts.rigid.copy()
        for i in self.required:
            left = _without(left, left[i])
        while len(chosen) < self.count:
            sizes = np.linalg.norm(left, axis=1) * (1.0 if weights is None else weights)
            sizes[chosen] = 0.0
            pick = int(np.argmax(sizes))
            if np.linalg.norm(left[pick]) < WEAK:
                break
            chosen.append(pick)
            left = _without(left, left[pick])
        return chosen


@dataclass(frozen=True, eq=False)
class Found:
    """The result of a search.

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
    """

    chosen: tuple[int, ...]
    value: float
    bound: float
    evaluations: int
    history: tuple[tuple[float, ...], ...]
    stopped: str = ""


class Search(Value):
    """A way to search; the base of all of them."""

    def search(
        self, problem: Problem, rng: Rng, executor: Executor | None, progress: bool | None
    ) -> Found:
        """Return the best choice that was found.

        Parameters
        ----------
        problem : Problem
            With `layouts.score(sets)`, `bound()`, and choices that see every rigid-body mode.
        rng : int, SeedSequence or Generator, optional
            For what is random.
        executor : concurrent.futures.Executor, optional
            The result is the same to the bit.
        progress : bool, optional
            A bar: None shows one on a terminal for work of more than two seconds.
        """
        raise NotImplementedError


def _without(rows: FloatArray, row: FloatArray) -> FloatArray:
    size = float(np.linalg.norm(row))
    if size < WEAK:
        return rows
    unit = row / size
    return rows - np.outer(rows @ unit, unit)
