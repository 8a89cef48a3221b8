"""Searches: greedy choice and exchanges; branch and bound, whose optimum is proven."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, between, function, whole
from ..errors import ModelError, warn
from ..parallel import Progress, expect
from ..store import checked
from ..tolerances import ROUNDING
from ..work import Work
from .convex import Below, Branch, Convex, Groups, Quadratic, chosen_rows
from .problem import ADVICE, Problem, Search, SearchResult, layouts_of


@dataclass(frozen=True, eq=False)
class Exchange(Search):
    """Greedy choice, followed by exchanges of one candidate at a time, from several starts.

    Each start ends when no exchange of one candidate lowers the score. If the criterion has a lower
    bound, an exchange is not scored when its bound is above the present score.

    Parameters
    ----------
    starts : int
        Number of starts: one is greedy, the others are random. If the criterion has a convex
        relaxation, one more start chooses the candidates with the largest weights in the relaxed
        problem. In the relaxed problem each candidate has a weight between 0 and 1 instead of
        being chosen or not.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> method = fx.placement.Exchange(starts=2)
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, method=method, rng=0).chosen
    ('y1',)
    """

    starts: int = field(default=10, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> SearchResult:
        """Return the best choice of all starts, with a lower bound by relaxation."""
        relaxed = problem.relaxed()
        chosen, history, evaluations = best_start(problem, self.starts, relaxed, work)
        value = min(steps[-1] for steps in history)
        bound = relaxed[0] if relaxed else problem.bound()
        bound = min(bound, value) if np.isfinite(value) else -np.inf
        return SearchResult(chosen, value, bound, evaluations, history)


def best_start(
    problem: Problem, starts: int, relaxed: tuple[float, FloatArray] | None, work: Work
) -> tuple[tuple[int, ...], tuple[tuple[float, ...], ...], int]:
    """Return the best choice of several starts, the values on the way of each, evaluations."""
    rounded = None if relaxed is None else problem.rounded(relaxed[1])
    runs = work.mapped(
        partial(_run, problem, starts),
        ["greedy", *["random"] * (starts - 1), *([rounded] if rounded else [])],
        rng=work.rng,
        description="starts",
        advice=ADVICE,
        restored=lambda row: (tuple(row[0]), tuple(row[1]), row[2]),
    )
    chosen, _, _ = min(runs, key=lambda run: run[1][-1])
    return chosen, tuple(run[1] for run in runs), sum(run[2] for run in runs)


def _run(
    problem: Problem, starts: int, first: tuple[int, ...] | str, rng: np.random.Generator
) -> tuple[tuple[int, ...], tuple[float, ...], int]:
    run = _Run(problem, starts)
    if isinstance(first, str):
        first = tuple(run.greedy() if first == "greedy" else run.drawn(rng))
    return run.exchanged(first)


class _Run:
    """Exchanges from a first choice; scores that are known are not computed again."""

    def __init__(self, problem: Problem, starts: int) -> None:
        self.problem, self.starts = problem, starts
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
            if value < values[-1] - ROUNDING * abs(values[-1]) or (
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
        """Return the scores of choices; infinite where a lower bound is above the value already."""
        # the bound is the tangent where the weights of the choice touch: it costs about as much as
        # ten scores, and leaves few of hundreds to be computed
        low = np.full(len(trials), -np.inf)
        scorer = self.problem.layouts.scorer
        if np.isfinite(value) and isinstance(scorer, Quadratic):
            if self.tangent is None or self.tangent[0] != tuple(chosen):
                weights = chosen_rows([chosen], self.problem.total)[0]
                self.tangent = tuple(chosen), scorer.inner_tangent(self.problem.root, weights)
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
            begin = perf_counter()
            best = int(np.argmin(self._values([[*chosen, i] for i in rest])))
            # of all starts; said once, so that the first scores decide
            scores = 1 + _SCORES * self.starts
            expect(seconds=(perf_counter() - begin) * self.problem.count * scores)
            chosen.append(rest.pop(best))
        return chosen

    def drawn(self, rng: np.random.Generator) -> list[int]:
        """Return a choice by chance."""
        chosen = list(self.problem.start(rng))
        rest = [i for i in self.problem.free if i not in chosen]
        return [*chosen, *rng.permutation(rest)[: self.problem.count - len(chosen)].tolist()]


def _flat(units: Sequence[tuple[int, ...]]) -> list[int]:
    return [i for unit in units for i in unit]


#: scores of a start relative to candidates times count, on average (bounds leave most out)
_SCORES = 0.45
#: up to this number of choices all are scored by the fast criterion
_ALL = 20_000


@dataclass(frozen=True, eq=False, repr=False)
class Screened(Search):
    """A search that ranks choices by a fast criterion and scores the best with the slow one.

    All choices are ranked if there are at most 20 000. Otherwise exchanges find one good choice by
    the fast criterion. Then this choice and all choices that differ from it by one candidate are
    ranked. As an example, the slow criterion is `PoiVariance` on a plant whose evaluation model
    treats truncated modes as noise. The fast criterion is then ``OverMachines(PoiVariance(),
    [plant_with_few_modes])``.

    Parameters
    ----------
    by : Criterion or callable
        The fast criterion.
    keep : int
        Number of choices that are scored by the slow criterion, which is the argument `criterion`
        of `place_sensors`.
    starts : int
        Number of starts of the exchanges.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> method = fx.placement.Screened(fx.placement.ModeInformation(), starts=1)
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, method=method, rng=0).chosen
    ('y1',)
    """

    by: Any = field(
        metadata=checked(function, name="by, a criterion,", hint="Pass PoiVariance(), say.")
    )
    keep: int = field(default=40, kw_only=True, metadata=checked(whole))
    starts: int = field(default=6, kw_only=True, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> SearchResult:
        """Return the best of the `keep` first choices, with a lower bound by relaxation."""
        own = problem.layouts
        fast = layouts_of(own.plant, own.side, own.candidates, self.by)
        ranked = self._ranked(replace(problem, layouts=fast), work)
        values = own.scores(ranked, work, "the best few")
        best = int(np.argmin(values))
        value = float(values[best])
        bound = min(problem.bound(), value) if np.isfinite(value) else -np.inf
        return SearchResult(ranked[best], value, bound, len(ranked), ((value,),))

    def _ranked(self, problem: Problem, work: Work) -> list[tuple[int, ...]]:
        """Return the first few choices by the fast criterion."""
        if problem.subsets <= _ALL:
            sets = list(problem.choices())
        else:
            chosen = Exchange(self.starts).search(problem, work).chosen
            near = {chosen}
            for out in (u for u in problem.units if set(u) <= set(chosen)):
                kept = set(chosen) - set(out)
                others = [u for u in problem.units if len(u) == len(out) and not set(u) & kept]
                near |= {tuple(sorted({*kept, *unit})) for unit in others}
            sets = problem.rows.holding(sorted(near))
        values = problem.layouts.scores(sets, work, "screened")
        return [sets[i] for i in np.argsort(values, kind="stable")[: self.keep].tolist()]


#: branches that are opened in one round, on an executor or not: results do not depend on it
_ROUND = 8
#: number of choices up to which a branch is screened, and number left from which all are scored
_SCREENED, _SCORED = 600, 40
_PART = "It is a part of the value, below 1: try 0.05."


@dataclass(frozen=True, eq=False)
class BranchAndBound(Search):
    """Branch and bound with convex relaxations. It proves the optimum, or states its gap.

    The candidates are divided into groups of similar candidates. A branch is the set of all choices
    that take a given number of candidates from each group. A branch is discarded when its lower
    bound shows that it contains no better choice than the best one found. In small branches all
    choices are listed, and the lower bound of each single choice is compared with the best value.
    The search starts from the result of `Exchange`.

    Parameters
    ----------
    gap : float
        Relative gap at which the search ends. At a gap of 0.01, no choice is better by more than 1
        % of the value. If the value is a variance, the relative gap of the rms is about half of it.
        With 0 the search finds the optimum.
    branches : int
        Largest number of branches to open. When it is reached, the search ends with a warning and
        reports its gap. With 0 no branch is opened: the result is the best choice of `Exchange`,
        with the lower bound of the relaxation.
    starts : int
        Number of starts of the exchanges, as in `Exchange`.

    Notes
    -----
    In the relaxation each candidate has a weight between 0 and 1 instead of being chosen or not.
    The relaxed criterion must be a convex function of the weights. This holds for `ModeInformation`
    and for `ModalObservability` and `ModalControllability` with the measure "log det". If no sensor
    or actuator has its own filter or delay, it also holds for three other criteria. These are
    `PoiVariance` of the plant's own modes with the measure "sum", `PoiLqr`, and `ClosedLoopH2` when
    only sensors or only actuators are chosen.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> method = fx.placement.BranchAndBound()
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, method=method, rng=0).proven
    True
    """

    gap: float = field(
        default=0.0, metadata=checked(between, low=0.0, high=1.0, hint=_PART, ends="[")
    )
    branches: int = field(default=20_000, metadata=checked(whole, minimum=0))
    starts: int = field(default=4, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> SearchResult:
        """Return the best choice and the bound that was proven; see `Search.search`."""
        scorer = problem.layouts.scorer
        if not isinstance(scorer, Convex):
            raise ModelError(
                f"{problem.layouts.criterion!r} has no convex relaxation here, so nothing can be "
                "bounded: it takes PoiVariance(own_modes=True), PoiLqr or ClosedLoopH2, "
                "of ports without a filter or delay. Use placement.Exhaustive() "
                "or placement.Exchange()."
            )
        opened, stopped = 0, ""
        chosen, history, evaluations = best_start(problem, self.starts, problem.relaxed(), work)
        value = min(steps[-1] for steps in history)
        tree = _Tree(problem, scorer, self.gap, chosen, value)
        with Progress(problem.root.size, "choices settled", progress=work.progress) as bar:
            while (batch := tree.next_batch()) and opened < self.branches:
                batch = batch[: self.branches - opened]
                opened += len(batch)
                tree.pop(len(batch))
                found = work.mapped(
                    partial(_open, problem, scorer, tree.cutoff),
                    batch,
                    progress=False,
                    restored=_opened_from,
                )
                bar.advance(sum(map(tree.take, found)))
        bound = tree.bound
        if batch:
            stopped = f"the limit of {self.branches} branches was reached"
            warn(
                f"{stopped}: no choice is more than {100 * (1 - bound / tree.value):.2g} % better "
                f"in value than the one found, but {100 * self.gap:.2g} % was wanted. Raise "
                "branches, or accept a larger gap."
            )
        evaluations += tree.evaluations
        return SearchResult(tree.chosen, tree.value, bound, evaluations, history, stopped)


class _Node(NamedTuple):
    """A branch that is not settled: a lower bound of its choices, and weights near the least."""

    bound: float
    groups: Groups
    weights: FloatArray

    @classmethod
    def of(cls, bound: float, groups: Any, weights: Any) -> _Node:
        """Return the node of nested lists."""
        parts = tuple((np.array(group, dtype=np.int64), count) for group, count in groups)
        return cls(bound, parts, np.array(weights))


class _Opened(NamedTuple):
    """What opening a branch showed."""

    nodes: list[_Node]
    value: float
    chosen: tuple[int, ...]
    settled: int
    left: float
    evaluations: int


def _opened_from(row: Any) -> _Opened:
    """Return what opening a branch showed, from the nested lists of a file."""
    nodes, value, chosen, *rest = row
    return _Opened([_Node.of(*node) for node in nodes], value, tuple(chosen), *rest)


class _Tree:
    """Branches not settled, the smallest bound first, and the best choice."""

    def __init__(
        self, problem: Problem, scorer: Convex, gap: float, chosen: tuple[int, ...], value: float
    ) -> None:
        self.chosen, self.value, self.gap = chosen, value, gap
        self.left, self.evaluations, self.count = np.inf, 0, 0
        bound, weights = scorer.relaxation(problem.root)
        self.heap: list[tuple[float, int, _Node]] = []
        self._push(_Node(bound, problem.root.groups, weights))

    @property
    def cutoff(self) -> float:
        """A branch whose bound is above this is left."""
        return self.value - self.gap * abs(self.value) if np.isfinite(self.value) else np.inf

    @property
    def bound(self) -> float:
        """No choice is better than this."""
        return min(self.value, self.left, *(bound for bound, _, _ in self.heap[:1]))

    def next_batch(self) -> list[_Node]:
        """Return the branches to open next, smallest bounds first."""
        while self.heap and self.heap[0][0] >= self.cutoff:
            self.left = min(self.left, heapq.heappop(self.heap)[0])
        first = heapq.nsmallest(_ROUND, self.heap, key=lambda entry: entry[:2])
        return [node for _, _, node in first]

    def pop(self, count: int) -> None:
        """Take the next branches off."""
        for _ in range(count):
            heapq.heappop(self.heap)

    def take(self, opened: _Opened) -> int:
        """Note what opening a branch showed; return how many choices it settled."""
        if opened.value < self.value:
            self.value, self.chosen = opened.value, opened.chosen
        self.left = min(self.left, opened.left)
        self.evaluations += opened.evaluations
        for node in opened.nodes:
            self._push(node)
        return opened.settled

    def _push(self, node: _Node) -> None:
        self.count += 1
        heapq.heappush(self.heap, (node.bound, self.count, node))


def _open(problem: Problem, scorer: Convex, cutoff: float, node: _Node) -> _Opened:
    """Check each choice of a small branch, or divide it into branches with new bounds."""
    branch = Branch(node.groups)
    # no choice in it satisfies the constraints or has a score
    if not problem.rows.possible(branch) or problem.layouts.missing(branch.members.tolist()):
        return _Opened([], np.inf, (), branch.size, np.inf, 0)
    tangent = scorer.inner_tangent(branch, node.weights)
    bound, weights = node.bound, node.weights
    if tangent is not None:
        found, weights = tangent.least(branch, weights)
        bound = max(bound, found)
    if bound >= cutoff:
        return _Opened([], np.inf, (), branch.size, bound, 0)
    if branch.size <= _SCREENED:
        sets = problem.rows.holding(branch.choices())
        bounds = np.full(len(sets), bound)
        if tangent is not None:
            bounds = np.maximum(bounds, tangent.values(sets))
        if np.count_nonzero(bounds < cutoff) <= _SCORED:
            return _score_branch(problem, cutoff, sets, bounds, branch.size)
    rows = np.eye(weights.size) if tangent is None else tangent.rows
    nodes, left, settled = [], np.inf, 0
    for part in branch.halves(rows, weights):
        low, near = bound, part.nearest(weights)
        if tangent is not None:
            found, near = tangent.least(part, near)
            low = max(bound, found)
        if low < cutoff:
            nodes.append(_Node(low, part.groups, near))
        else:
            left, settled = min(left, low), settled + part.size
    return _Opened(nodes, np.inf, (), settled, left, 0)


def _score_branch(
    problem: Problem, cutoff: float, sets: list[tuple[int, ...]], bounds: FloatArray, settled: int
) -> _Opened:
    """Score the choices of a branch that could be better, the smallest bound first."""
    best, chosen, evaluations = np.inf, (), 0
    for i in np.argsort(bounds, kind="stable").tolist():
        if bounds[i] >= min(cutoff, best):
            return _Opened([], best, chosen, settled, float(bounds[i]), evaluations)
        value = float(problem.layouts.score([sets[i]])[0])
        evaluations += 1
        if value < best:
            best, chosen = value, sets[i]
    return _Opened([], best, chosen, settled, np.inf, evaluations)
