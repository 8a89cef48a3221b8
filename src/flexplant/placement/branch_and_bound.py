"""Branch and bound: the optimum, proven, or how far from it the answer can be."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..checks import FloatArray, between, checked, whole
from ..errors import ModelError, warn
from ..parallel import Progress
from ..work import Work
from .exchange import best_start
from .problem import Found, Problem, Search
from .rows import Branch, Groups
from .tangent import Convex

#: branches that are opened in one round, on an executor or not: results do not depend on it
_ROUND = 8
#: a branch of at most so many choices is screened, and ended when so few are left to be scored
_SCREENED, _SCORED = 600, 40
_PART = "It is a part of the value, below 1: try 0.05."


@dataclass(frozen=True, eq=False)
class BranchAndBound(Search):
    """Branch and bound with convex relaxations: the optimum with a proof, or a gap.

    The candidates are cut in groups of similar ones, and a branch holds the choices with so many
    of each group. It is left where no choice in it can be better than the best one found; small
    branches are screened by a lower bound of each choice. The start is that of `Exchange`.

    Parameters
    ----------
    gap : float
        It ends when no choice can be better by more than this part of the value (a variance: of
        its root about half as much); 0 for the optimum.
    branches : int
        It ends after opening so many, with the gap that was reached and a warning; 0 leaves the
        exchanges at the start and the bound of the relaxation.
    starts : int
        Starts of the exchanges, as in `Exchange`.

    Raises
    ------
    ModelError
        When the gap is not in [0, 1), branches are negative or starts not at least 1.

    Notes
    -----
    It needs a criterion whose relaxation is convex: `PoiVariance` of the plant's own modes (sum),
    `PoiLqr`, `ClosedLoopH2` of one kind of device, all of ports without a filter or delay of their
    own; `ModeInformation` and log det of Gramians.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 1, method=fx.placement.BranchAndBound(), rng=0).proven
    True
    """

    gap: float = field(
        default=0.0, metadata=checked(between, low=0.0, high=1.0, hint=_PART, ends="[")
    )
    branches: int = field(default=20_000, metadata=checked(whole, minimum=0))
    starts: int = field(default=4, metadata=checked(whole))

    def search(self, problem: Problem, work: Work) -> Found:
        """Return the best choice and the bound that was proven; see `Search.search`.

        Raises
        ------
        ModelError
            When the criterion has no convex relaxation.
        """
        scorer = problem.layouts.scorer
        if not isinstance(scorer, Convex):
            raise ModelError(
                f"{problem.layouts.criterion!r} has no convex relaxation here, so nothing can be "
                "bounded: it takes PoiVariance(own_modes=True), PoiLqr or ClosedLoopH2, "
                "of ports without a filter or delay of their own. Use Exhaustive() or Exchange()."
            )
        opened = 0
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
                    restored=_restored,
                )
                bar.advance(sum(map(tree.take, found)))
        bound = tree.bound
        stopped = ""
        if batch:
            stopped = f"the limit of {self.branches} branches was reached"
            warn(
                f"{stopped}: no choice is more than {100 * (1 - bound / tree.value):.2g} % better "
                f"in value than the one found, but {100 * self.gap:.2g} % was wanted. Raise "
                "branches, or accept a larger gap."
            )
        return Found(
            tree.chosen,
            tree.value,
            bound,
            evaluations + tree.evaluations,
            history,
            stopped,
        )


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


def _restored(row: Any) -> _Opened:
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
        branch = problem.root
        bound, weights = scorer.relaxation(branch)
        self.heap: list[tuple[float, int, _Node]] = []
        self._push(_Node(bound, branch.groups, weights))

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
    """Settle a small branch choice by choice, or cut it in parts with bounds of their own."""
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
        sets = branch.choices()
        sets = [s for s, holds in zip(sets, problem.rows.hold(sets), strict=True) if holds]
        bounds = np.full(len(sets), bound)
        if tangent is not None:
            bounds = np.maximum(bounds, tangent.values(sets))
        if np.count_nonzero(bounds < cutoff) <= _SCORED:
            return _scored(problem, cutoff, sets, bounds, branch.size)
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


def _scored(
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
