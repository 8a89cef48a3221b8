"""The problem of a search and its answer: layouts with their scores, the choice and its bound."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from math import comb, prod
from typing import Any

import numpy as np

from ..arrays import REFUSED, FloatArray, IntArray, divisor
from ..errors import AssumptionError, CertificateError, counted, some_names
from ..plant import Actuator, Assumption, SensorPort, StandardPlant, assemble_plant
from ..store import Value
from ..tolerances import SAME, SETTLED, TYPED
from ..work import Work
from .candidates import Port, Side, sampled_plant, side_of, with_side
from .closed_loop_h2 import ClosedLoopH2, PoiLqr
from .constraints import LinearRows
from .convex import Branch, Convex
from .criterion import Criterion, OnPlant, Scorer, as_criterion, by_size, in_words
from .poi_variance import PoiVariance

ASSUMPTION = {"y": "detectable", "u": "stabilisable"}
ADVICE = "Fewer candidates, fewer starts or executor=ProcessPoolExecutor() help."
#: choices that are scored at once: always as many, so that rounding does not depend on the executor
_BLOCK = 64


@dataclass(frozen=True, eq=False)
class Layouts:
    """Candidates on a plant, and the scores of choices among them."""

    plant: StandardPlant
    side: Side
    candidates: tuple[Port, ...]
    criterion: Criterion
    rigid: RigidPart
    scorer: Scorer

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, infinite where a choice has no score."""
        ordered = [sorted(chosen) for chosen in sets]
        scored = np.flatnonzero(self.rigid.all_missing(ordered) == 0).tolist()
        values = np.full(len(ordered), np.inf)
        values[scored] = self.scorer.score([ordered[i] for i in scored])
        return values

    def scores(
        self, sets: Sequence[Sequence[int]], work: Work, description: str = "layouts"
    ) -> FloatArray:
        """Return the scores (n,) of many choices, computed on an executor."""
        blocks = [sets[i : i + _BLOCK] for i in range(0, len(sets), _BLOCK)]
        found = work.mapped(self.score, blocks, description=description, advice=ADVICE)
        return np.concatenate([np.zeros(0), *found])

    def missing(self, chosen: Sequence[int]) -> int:
        """Return how many rigid-body modes a choice has no part in."""
        return self.rigid.missing(chosen)

    def reason(self, chosen: Sequence[int]) -> str:
        """Return in words why a choice has no score; empty when it has one."""
        lost = self.missing(chosen)
        if not lost:
            return self.scorer.outcome(sorted(chosen))[1]
        found = self._finding(chosen)
        return f"It misses {counted(lost, 'rigid-body mode')}." if found.holds else found.finding

    def require_any(self) -> None:
        """Raise AssumptionError when even all candidates together miss a rigid-body mode."""
        everything = range(len(self.candidates))
        if self.missing(everything):
            raise AssumptionError(
                f"no choice of these candidates will do: {self.reason(everything)} "
                f"{self._finding(everything).remedy}".strip()
            )

    def confirm(self, chosen: Sequence[int], value: float) -> None:
        """Raise CertificateError unless the criterion itself, on the plant, gives a fast value."""
        if isinstance(self.scorer, OnPlant) or not np.isfinite(value):
            return
        ports = [self.candidates[i] for i in sorted(chosen)]
        direct = float(self.criterion(with_side(self.plant, self.side, ports)))
        if not abs(direct - value) <= TYPED * max(abs(direct), self.criterion.scale):
            raise CertificateError(
                f"the fast score {value:.9g} of the best choice differs from {self.criterion!r} on "
                f"its plant, {direct:.9g}. No score can be trusted: the problem is too badly "
                "conditioned."
            )

    def _finding(self, chosen: Sequence[int]) -> Assumption:
        own = with_side(self.plant, self.side, [self.candidates[i] for i in chosen]).assembled
        report = assemble_plant(own.realisation, own.ports).check()
        found = [report[ASSUMPTION[part]] for part in self.side]
        return next((item for item in found if not item.holds), found[0])


def layouts_of(
    plant: StandardPlant, side: Side, candidates: Sequence[Port], criterion: Any
) -> Layouts:
    """Return the layouts of candidates on a plant, with everything checked."""
    plant = sampled_plant(plant)
    if criterion is None:
        criterion = {"y": PoiVariance(), "u": PoiLqr(), "yu": ClosedLoopH2()}[side]
    criterion = as_criterion(criterion, side)
    candidates = tuple(candidates)
    plainly = OnPlant(plant, side, candidates, criterion)
    _ = plainly.whole  # names and places, all at once
    rigid = RigidPart.of(plant, side, candidates)
    layouts = Layouts(plant, side, candidates, criterion, rigid, plainly)
    criterion.check(plant, candidates)
    # without a single feasible choice there is nothing that choices could share
    if layouts.missing(range(len(candidates))):
        return layouts
    return replace(layouts, scorer=criterion.scorer(plainly.whole, candidates))


@dataclass(frozen=True, eq=False)
class RigidPart:
    """Rows (N, r) of candidates in rigid-body modes, of unit size or zero.

    Sensors see positions and actuators move velocities. Where both are chosen, columns of their
    own keep them apart: as many for the sensors as for the actuators.
    """

    rows: FloatArray

    @classmethod
    def of(cls, plant: StandardPlant, side: str, candidates: Sequence[Port]) -> RigidPart:
        """Return the part of candidates on a plant; of one made elsewhere nothing is known."""
        realisation = plant.realisation
        r = realisation.n_rigid
        if not r:
            return cls(np.zeros((len(candidates), 0)))
        parts = np.zeros((len(candidates), len(side), r))
        for part, port in zip(parts, candidates, strict=True):
            own = part[side.index(side_of(port))]
            if isinstance(port, SensorPort):
                own[:] = port.see(realisation).row[0 : 2 * r : 2]
            elif isinstance(port, Actuator):
                own[:] = realisation.force(port.push(realisation))[1 : 2 * r : 2]
        rows = parts.reshape(len(candidates), -1)
        sizes = np.linalg.norm(rows, axis=1, keepdims=True)
        return cls(rows / divisor(sizes))

    def missing(self, chosen: Sequence[int]) -> int:
        """Return how many rigid-body modes a choice has no part in: ranks decide."""
        return int(self.all_missing([chosen])[0])

    def all_missing(self, sets: Sequence[Sequence[int]]) -> IntArray:
        """Return how many rigid-body modes each of some choices (m,) has no part in."""
        wanted = self.rows.shape[1]

        def missed(chosen: IntArray) -> IntArray:
            values = np.linalg.svd(self.rows[chosen], compute_uv=False)
            strong = (values > SAME * values[:, :1]) & (values > 0)
            return np.asarray(wanted - np.count_nonzero(strong, axis=1))

        return by_size(sets, missed).astype(np.int64)


@dataclass(frozen=True, eq=False, repr=False)
class Placement(Value):
    """The best choice that was found, and a lower bound on all choices.

    Parameters
    ----------
    chosen : tuple of str
        Names of the chosen sensors or actuators, in the order of the candidates.
    value : float
        Value of the criterion.
    bound : float
        Lower bound on the value of every choice of the same number of candidates. If the optimum is
        proven, by trying every subset or by branch and bound, it is the value itself. Otherwise it
        follows from a convex relaxation, in which each candidate has a weight between 0 and 1. The
        relaxation exists for criteria that are the log det of a matrix, such as `ModeInformation`.
        If no port has a filter or delay, it also exists for mean squares. Mean squares are
        `PoiVariance` of the plant's own modes, `PoiLqr`, `ClosedLoopH2`, and criteria that wrap
        them. For the trace of a Gramian the bound is the smallest value without constraints. For
        its smallest eigenvalue, which grows with each device, the bound is the value with all
        candidates together. If the criterion is a plain function, the bound is minus infinity.
    evaluations : int
        Number of choices that were scored.
    history : tuple of tuples of float
        Values after each improvement, one tuple for each start of the search.
    criterion : str
        Name of the criterion that was minimised.
    ports : tuple of Sensor or Actuator
        Chosen sensors or actuators.
    side : {"y", "u", "yu"}
        Whether the ports are sensors, actuators, or both.
    stopped : str
        Reason why the search ended early; empty if it was completed.
    unit : str
        Unit of the square root of the value, if the value is a mean square of a motion.
    unjudged : str
        Remark that the value does not include truncated modes. It is empty if the plant has an
        evaluation model.
    left_out : tuple of str
        Sensors or actuators of the plant that were not among the candidates. They are not part of
        the choice, and the value is computed without them.
    interval : str
        Text of an interval for the error divided by the error with the plant's own sensors. It is a
        95 % interval for a machine that agrees with the measurement. Such machines are known if the
        plant comes from ``fit.calibrated(measured)`` with an evaluation model. If they are known
        but there is no interval, the text is the reason. If they are not known, the text is empty.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.place_sensors(plant, ["y1", "y2"], 1).on(plant).y
    ('y1', 'die:ref')
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
    unit: str = ""
    unjudged: str = ""
    left_out: tuple[str, ...] = ()
    interval: str = ""

    def __repr__(self) -> str:
        ends = [steps[-1] for steps in self.history]
        agree = sum(end <= self.value + SETTLED * abs(self.value) for end in ends)
        if self.proven:
            proof = "the optimum, proven"
        elif not np.isfinite(self.bound) or (self.unit and self.bound <= 0.0):
            proof = "no bound"
        elif self.unit:
            proof = f"no choice below {in_words(self.bound, self.unit)}"
        else:
            proof = f"none is more than {100 * self.gap:.2g} % better"
        own = f", without the plant's own {some_names(self.left_out)}: not among the candidates"
        return (
            f"<Placement {' '.join(self.chosen):.120}: {in_words(self.value, self.unit)} by "
            f"{self.criterion}, {proof}; {agree} of {len(ends)} starts agree, "
            f"{counted(self.evaluations, 'evaluation')}"
            f"{', ' if self.stopped else ''}{self.stopped}"
            f"{', ' if self.unjudged else ''}{self.unjudged}{own if self.left_out else ''}"
            f"{', over the own sensors ' if self.interval else ''}{self.interval}>"
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the chosen sensors."""
        return tuple(port.name for port in self.ports if side_of(port) == "y")

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the chosen actuators."""
        return tuple(port.name for port in self.ports if side_of(port) == "u")

    @property
    def gap(self) -> float:
        """Fraction of the value by which a better choice could be lower; infinite if unknown.

        If the value is a mean square, the rms could be better by about half this fraction.
        """
        if not np.isfinite(self.bound):
            return np.inf
        return (self.value - self.bound) / abs(self.value) if self.value else 0.0

    @property
    def proven(self) -> bool:
        """Whether it is proven that no choice is better, apart from rounding."""
        return self.gap <= 1e-8  # ten times what rounding adds to a bound

    def on(self, plant: StandardPlant) -> StandardPlant:
        """Return the given plant with the chosen sensors (actuators, or both)."""
        return with_side(plant, self.side, self.ports)


@dataclass(frozen=True, eq=False)
class Problem:
    """The best choice of candidates, as an optimisation problem.

    Parameters
    ----------
    layouts : Layouts
        The candidates and the score of each set of them.
    count : int
        Number of candidates to choose.
    required : tuple of int
        Indices of candidates that every choice contains.
    rows : LinearRows
        Linear constraints that every choice satisfies.
    """

    layouts: Layouts
    count: int
    required: tuple[int, ...]
    rows: LinearRows

    @property
    def total(self) -> int:
        """Number of candidates."""
        return len(self.layouts.candidates)

    @cached_property
    def units(self) -> list[tuple[int, ...]]:
        """Candidates that may be left out; candidates that are chosen together form one set."""
        shut = self.rows.shut(self.required)
        units = [u for u in self.rows.units() if not set(u) & set(self.required)]
        return [u for u in units if not np.any(shut[list(u)])]

    @property
    def free(self) -> list[int]:
        """Candidates that may be left out."""
        return sorted(i for unit in self.units for i in unit)

    @cached_property
    def subsets(self) -> int:
        """Number of choices of `count` candidates, before constraints on several are applied."""
        numbers = {size: len(units) for size, units in self._by_size.items()}
        return sum(prod(comb(numbers[s], n) for s, n in mix.items()) for mix in self._mixes())

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
        """The branch (set of choices) that contains all choices.

        Its choices contain all required candidates. They need not satisfy the constraints that
        concern several candidates together.
        """
        return Branch.containing(self.required, self.free, self.count)

    def bound(self) -> float:
        """Return a lower bound on the score of every choice; minus infinity if none is known."""
        relaxed = self.relaxed()
        return relaxed[0] if relaxed else self.layouts.scorer.bound(self.count, self.required)

    def relaxed(self) -> tuple[float, FloatArray] | None:
        """Return a lower bound from a convex relaxation, and weights (N,) near its minimum.

        The result is None if there is no relaxation.
        """
        scorer, root = self.layouts.scorer, self.root
        if not isinstance(scorer, Convex) or self.layouts.missing(root.members.tolist()):
            return None
        return scorer.relaxation(root) if self.rows.possible(root) else None

    def rounded(self, weights: FloatArray) -> tuple[int, ...] | None:
        """Return the choice with the largest weights (N,); None if it is not feasible."""
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
        kept = np.flatnonzero(self.rows.hold(sets)).tolist()
        values[kept] = self.layouts.score([sets[i] for i in kept])
        return values

    def start(self, random: np.random.Generator | None) -> tuple[int, ...]:
        """Return a choice that satisfies the constraints and observes every rigid-body mode.

        The choice is random if a generator is given; otherwise it is the same in each call. If
        every choice that was found misses a rigid-body mode, one of these is returned. If no choice
        satisfies the constraints, the result is empty.
        """
        if not self.rows.A.size:
            weights = None if random is None else random.uniform(0.1, 1.0, self.total)
            return tuple(self.spanning(weights))
        draws = random or np.random.default_rng(0)
        nearest: tuple[int, ...] = ()
        least = self.layouts.missing(self.spanning())  # no choice of this size misses fewer
        for draw in range(REFUSED):
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
            if missed <= least:
                break
        return nearest

    @cached_property
    def _by_size(self) -> dict[int, list[tuple[int, ...]]]:
        sizes = sorted({len(unit) for unit in self.units})
        return {size: [unit for unit in self.units if len(unit) == size] for size in sizes}

    def _mixes(self) -> Iterator[dict[int, int]]:
        """Yield how many units of each size make up the count."""
        more, sizes = self.count - len(self.required), list(self._by_size)
        limits = [range(min(len(self._by_size[s]), more // s) + 1) for s in sizes]
        mixes = (dict(zip(sizes, numbers, strict=True)) for numbers in product(*limits))
        return (mix for mix in mixes if sum(s * n for s, n in mix.items()) == more)

    def spanning(self, weights: FloatArray | None = None) -> list[int]:
        """Return a choice that observes as many rigid-body modes as possible.

        It contains the required candidates. Others are added one by one, each time the one that
        adds most to the observed (or moved) rigid-body modes. The method is orthogonalisation with
        pivoting, which reaches the highest rank of any choice of this size. Candidates with larger
        weights (N,) are preferred.
        """
        chosen, shut = list(self.required), self.rows.shut(self.required)
        left = self.layouts.rigid.rows
        for i in self.required:
            left = _rows_without(left, left[i])
        while len(chosen) < self.count:
            sizes = np.linalg.norm(left, axis=1) * (1.0 if weights is None else weights)
            sizes[chosen] = sizes[shut] = 0.0
            pick = int(np.argmax(sizes))
            if np.linalg.norm(left[pick]) < SAME:
                break
            chosen.append(pick)
            left = _rows_without(left, left[pick])
        return chosen


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of a search: chosen candidates, value, bound, number of evaluations.

    Parameters
    ----------
    chosen : tuple of int
        Positions of the chosen candidates in the list of candidates, from 0.
    value, bound, evaluations, history, stopped
        Value, lower bound, number of evaluations, history and reason of an early end, as in
        `Placement`.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.placement.SearchResult((0,), 2.0, 1.5, 7, (3.0, 2.0))
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
    def search(self, problem: Problem, work: Work) -> SearchResult:
        """Return the best choice that was found.

        A method uses the methods `score(sets)`, `bound()`, `choices()` and `start` of the problem,
        which is a `Problem`. The second argument, `work`, runs the calculations: the method calls
        functions through ``work.mapped`` and draws random numbers from ``work.rng``. With these two
        rules its result is identical on every executor (pool of processes), and a search that was
        stopped continues from its checkpoint file.
        """


def _rows_without(rows: FloatArray, row: FloatArray) -> FloatArray:
    size = float(np.linalg.norm(row))
    if size < SAME:
        return rows
    unit = row / size
    return rows - np.outer(rows @ unit, unit)
