"""design_structured: norms minimised by a controller of given structure, verified on each plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ...arrays import MOST_DRAWS, FloatArray, Rng, generator, whole
from ...certificates import Certificate, Verified, stability_check
from ...errors import AssumptionError, CertificateError, InfeasibleError, ModelError, short
from ...lti.interconnection import lft
from ...lti.statespace import StateSpace, System
from ...parallel import Progress, one_thread
from ...plant import AnyPlant, StandardPlant
from ...tolerances import CLOSE, NEGLIGIBLE, ROOT, SAME, TINY, TYPED
from ..controller import Controller, certified_norm, reached_norms, required_stability
from ..hinf.moved_design import PlantRange
from ..lmi.objectives import H2, Hinf, PeakGain
from ..pipeline import Design, Solution, designed, posed
from ..preparation import Prepared, require_reach
from .judges import PART, GainJudge, Judge, LoopObjective, Matrices, ScaledLoop
from .measured_objective import MeasuredObjective
from .nonsmooth import Pieces, bfgs, decrease_left, minimax
from .structures import ControllerFamily, ControllerStructure, as_system

#: steps for stability, from each start towards the least norm, and on from the best of them
_STABLE, _FEW, _MANY = 300, 40, 300
#: how many starts are continued
_CONTINUED = 4
#: of the evaluations, what is for the starts; the rest is for continuing the best of them, and as
#: large a part of those that are left is for each smaller structure at most
_SHARE = 0.7
#: spreads of starts around the structure's own, in turn, and around the best end
_SPREADS, _NARROWER = (0.0, 1.0, 0.3, 3.0), 0.5
#: the norm that the search claims and the one verified on the plant as given agree to this
_AGREEMENT = 5e-4


@one_thread()
def design_structured(
    plant: AnyPlant | System | Sequence[StandardPlant] | Mapping[float, StandardPlant],
    structure: ControllerStructure,
    *,
    objective: LoopObjective | Sequence[LoopObjective] = Hinf(),  # noqa: B008 - a frozen value
    u: Sequence[str] | None = None,
    y: Sequence[str] | None = None,
    starts: int = 8,
    rng: Rng = 0,
    evaluations: int = 10_000,
    progress: bool | None = None,
) -> Controller:
    """Return the controller of a given structure with the smallest norm from w to z that was found.

    The search begins at several starts. From each start, the largest real part of the closed-loop
    poles is lowered first, until the loop is stable. Then the largest norm over all plants is
    lowered. If there are several objectives, each norm is divided by its `below`. At a minimum of
    the H-infinity norm, several peaks of the gain are often equally high. Each step therefore uses
    the gains at all high peaks together, with their gradients and second derivatives. The gradients
    are ``d|T| = Re u* dT v``, where T is the response from w to z, and u and v are its singular
    vectors. The searches with the best results are continued. The problem is not convex, so that
    another start may give a smaller norm.

    Parameters
    ----------
    plant : StandardPlant, sequence of StandardPlant, or mapping {position: StandardPlant}
        Continuous or sampled plant. If several plants are given, one controller is designed for all
        of them. They must have the same u, y and rate. For a mapping by position, the loop is also
        checked half way between positions, on plants that are interpolated linearly. A StateSpace
        with named channels is accepted.
    structure : FixedOrder, TunedLaws, ObserverGains or Parametrised
        Structure of the controller. It also gives the first start of the search.
    objective : Hinf, H2, PeakGain, MeasuredObjective, or sequence of these
        Objective to be minimised. If several objectives are given, each must have its bound
        `below`, and the largest ratio of an objective to its bound is minimised. Your own objective
        is a subclass of `synthesis.MeasuredObjective`. For a continuous plant with D12 and D21
        (feedthrough from u to z and from w to y), the H2 norm is finite only without a feedthrough
        of the controller: ``FixedOrder(n, direct=False)``.
    u, y : sequences of str, optional
        For a StateSpace: inputs that the controller drives, and outputs that it reads.
    starts : int
        Number of starts. The first start is given by the structure. The others are drawn at random
        around it and around the best result.
    rng : int, SeedSequence or Generator
        Random generator of the starts, or its seed.
    evaluations : int
        Largest number of closed loops that are computed for each plant. The search then ends with
        the best result so far.
    progress : bool, optional
        Whether to show a progress bar. By default (None) it is shown on a terminal or in a
        notebook, for work of more than two seconds.

    Returns
    -------
    Controller
        The controller. Its `structure` is the given one with the parameters found, from which a
        further design can begin. `gamma` is the largest verified norm (divided by `below`), and
        `tried` lists the result of each start. The certificate holds the norm of each plant and
        objective. For plants by position it is the worst one, also between positions. Three further
        entries show how near the result is to a local minimum. `slope` is the norm of the smallest
        convex combination of the gradients of log gamma at its peaks; it is zero at a minimum.
        `decrease left` is the relative decrease of gamma, to first order, that a small step of the
        parameters can still give. `radius` is the length of this step.

    Raises
    ------
    AssumptionError
        When u does not excite, or y does not measure, a mode that is not stable.
    InfeasibleError
        When no start leads to a stable loop. The message has the frequency of the pole that remains
        unstable.
    CertificateError
        When the norm of a loop differs from that of the search, or the loop is unstable between
        positions.
    ModelError, ShapeError, LabelError
        When the channels of plants and structure do not match.

    Warns
    -----
    FlexplantWarning
        When truncated modes make the loop unstable, or raise |S| at u above 8 dB. The warning names
        these modes.

    References
    ----------
    [ApkarianNoll2006]_; [LewisOverton2013]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> found = fx.synthesis.design_structured(sys, fx.synthesis.FixedOrder(0), starts=1)
    >>> found.system.n_states, found.gamma < 1
    (0, True)
    """
    moving = PlantRange.of(plant) if isinstance(plant, Mapping) else None
    plants = _plants(plant if moving is None else moving.plants, u, y)
    if isinstance(structure, type) or not hasattr(structure, "family"):
        raise ModelError(
            "structure must be FixedOrder, TunedLaws, ObserverGains or Parametrised, got "
            f"{short(structure)}. Pass one of them, such as synthesis.TunedLaws(law) or "
            "synthesis.FixedOrder(2)."
        )
    starts, random = whole(starts, "starts", maximum=MOST_DRAWS), generator(rng)
    search = starts, random, whole(evaluations, "evaluations"), progress
    design = _Structured(structure, _objectives(objective), moving, *search)
    return designed(design, plants, plants[0])


@dataclass(frozen=True)
class _Structured(Design):
    """The least norm that is found from several starts, by the parameters of a structure."""

    structure: ControllerStructure
    objectives: list[LoopObjective]
    moving: PlantRange | None
    starts: int
    rng: np.random.Generator
    evaluations: int
    progress: bool | None
    name = "structured"

    def prepare(self, plant: list[AnyPlant]) -> _StructureSearch:
        problems = [super(_Structured, self).prepare(one) for one in plant]
        for problem in problems:
            require_reach(problem)
        family = self.structure.family(plant[0], problems[0])
        if not plant[0].dt:
            _require_no_feedthrough(family, plant[0], self.objectives)

        def judging(order: int) -> _Judged:
            return [
                (judge, objective.below or 1.0)
                for one in plant
                for objective in self.objectives
                for judge in objective.judges(one, order)
            ]

        given = None if _measure_word(self.objectives) == "H-infinity" else judging
        return _StructureSearch(family, problems, self.evaluations, given)

    def solve(self, problem: _StructureSearch) -> _End:
        steps = self.starts + _CONTINUED
        with Progress(steps, "starts of the search", progress=self.progress) as bar:
            return problem.best(self.starts, self.rng, bar)

    def restore(self, plant: list[AnyPlant], problem: _StructureSearch, found: _End) -> StateSpace:
        one = plant[0]
        K = as_system(problem.family.matrices(found.x), (one.y, one.u), one.dt)
        return K.replace(name=self.name, units=one.units)

    def certify(self, solution: Solution) -> Controller:
        plants, search, K, found = solution
        claim, kind = _end_norm(found), _measure_word(self.objectives)

        def on(plant: AnyPlant, claim: float = np.inf) -> Certificate:
            return _verified_loop(plant, lft(plant.system, K), self.objectives, claim)

        each = [on(plant, claim) for plant in plants]
        norms = [one["norm"] for one in each]
        worst = int(np.argmax(norms))
        if not abs(norms[worst] - claim) <= _AGREEMENT * claim:
            raise CertificateError(
                f"the closed loop has the norm {norms[worst]:.6g} on the plant as given, "
                f"{claim:.6g} by the search: {_blame(self.objectives)}."
            )
        radius = NEGLIGIBLE * max(1.0, float(np.linalg.norm(found.x)))
        slope, decrease = decrease_left(search.pieces(found.x), radius)
        route = "a linear model"
        found_left = (
            Verified("slope", slope, route),
            Verified("radius", radius),
            Verified("decrease left", decrease, route, CLOSE),
        )
        certificate = Certificate((*each[worst].checks, *found_left))
        if self.moving is not None:
            certificate |= self.moving.certified(lambda plant: on(plant)["norm"], norms)
        elif len(plants) > 1:
            each_norm = (Verified(f"norm of plant {i}", one) for i, one in enumerate(norms, 1))
            certificate = certificate.extended(*each_norm)
        notes = search.notes
        if decrease > CLOSE:
            notes += ("not yet a local minimum (decrease left): more evaluations or another order",)
        final, loop = search.family.structure(found.x), lft(plants[worst].system, K)
        reached = Certificate()
        if kind == "H-infinity":
            reached = reached_norms(plants[worst], loop)
        return Controller(
            K,
            f"{kind} of structure {(self.structure if final is None else final)!r}",
            gamma=norms[worst],
            certificate=certificate,
            reached=reached,
            notes=notes,
            structure=final,
            tried=search.tried,
        )


def _blame(objectives: Sequence[LoopObjective]) -> str:
    """Return why the search and the loop give two numbers."""
    foreign = [one for one in objectives if not isinstance(one, Hinf | H2 | PeakGain)]
    if foreign and isinstance(foreign[0], MeasuredObjective):
        return (
            f"`measured` of {foreign[0]!r} gives one loop two numbers. It must follow from the "
            "loop from w to z alone: not from its states, earlier calls or random numbers"
        )
    if foreign:
        return (
            f"`measured` of {foreign[0]!r} and what its `judges` minimise are not one number. "
            "Judges work in scaled time (see synthesis.Judge): derive from "
            "synthesis.MeasuredObjective, which needs `measured` alone"
        )
    return (
        "the loop is too badly conditioned to trust. Bring the sizes of the weights closer together"
    )


def _plants(given: Any, u: Sequence[str] | None, y: Sequence[str] | None) -> list[AnyPlant]:
    """Return the plants, all with the same channels and rate."""
    many = given if isinstance(given, list | tuple) else [given]
    plants = [posed(one, u, y, "structured synthesis") for one in many]
    if not plants:
        raise ModelError("plant is an empty list: pass at least one plant.")
    first = plants[0]
    for i, one in enumerate(plants, 1):
        if (one.u, one.y) != (first.u, first.y) or not np.isclose(
            one.dt, first.dt, rtol=SAME, atol=0.0
        ):
            raise ModelError(
                f"plant {i} has other u, y or rate than the first: one controller cannot serve "
                "both. Assemble all with the same ports and rate."
            )
    return plants


#: judges, and the bounds that their numbers are counted in
_Judged: TypeAlias = "list[tuple[Judge, float]]"


def _objectives(given: Any) -> list[LoopObjective]:
    """Return the objectives, each with the methods of one."""
    every = list(given) if isinstance(given, list | tuple) else [given]
    for one in every:
        if isinstance(one, type) or not hasattr(one, "judges"):
            raise ModelError(
                "objective must be synthesis.Hinf(...), synthesis.H2(...), "
                "synthesis.PeakGain(...), a synthesis.MeasuredObjective of yours or several of "
                f"them, got {short(one)}."
            )
        if len(every) > 1 and one.below is None:
            raise ModelError(
                f"{one!r} is one of several objectives and has no bound: give each `below=`, in "
                "multiples of which they are compared."
            )
    if not every:
        raise ModelError("objective is an empty list: pass at least one.")
    return every


def _measure_word(objectives: Sequence[LoopObjective]) -> str:
    """Return what is minimised, in a word."""
    if len(objectives) > 1:
        return "several objectives"
    one = objectives[0]
    if isinstance(one, Hinf) and one.w is None and one.z is None and one.below is None:
        return "H-infinity"
    return repr(one)


def _require_no_feedthrough(
    family: ControllerFamily, plant: AnyPlant, objectives: Sequence[LoopObjective]
) -> None:
    """Raise AssumptionError where white noise of an H2 norm passes through a controller at once."""
    k, g = family.order, plant.system
    free = np.any(family.jacobian(family.first)[:, k:, k:], axis=0)
    free = free | (family.matrices(family.first).D != 0.0)
    for one in objectives:
        w, z = one.chosen(plant)
        out, into = g[list(z), list(plant.u)].D, g[list(plant.y), list(w)].D
        if isinstance(one, H2) and np.any((out != 0) @ free @ (into != 0)):
            raise AssumptionError(
                "the structure has a feedthrough from y to u, through which white noise of a "
                "continuous plant passes at once: the H2 norm is infinite. Take "
                "synthesis.FixedOrder(n, direct=False), laws with a LowPass, or sample the plant."
            )


def _verified_loop(
    plant: AnyPlant, loop: StateSpace, objectives: Sequence[LoopObjective], claim: float
) -> Certificate:
    """Return what was verified of a closed loop: `norm` is the largest, over its bound."""
    if _measure_word(objectives) == "H-infinity":
        return certified_norm(loop, claim)
    least = required_stability(loop)
    found, norm = [], 0.0
    for one in objectives:
        w, z = one.chosen(plant)
        value = one.measured(loop.select(z, w))
        found.append(Verified(repr(one), value, "measured on the closed loop"))
        norm = max(norm, value / (one.below or 1.0))
    checks = (
        Verified("norm", norm, "objectives of the closed loop", claim * (1.0 + _AGREEMENT)),
        stability_check(least, loop.dt),
        Verified("claim", claim, "the search in scaled time"),
    )
    return Certificate((*checks, *found))


class _End(NamedTuple):
    """Where a start ended: log of the norm (infinite when not stabilised), and the abscissa."""

    value: float
    x: FloatArray
    decay: float
    name: str
    settled: bool = False


class _StructureSearch:
    """The functions of the parameters, how often they were computed, and the search from starts."""

    def __init__(
        self,
        family: ControllerFamily,
        problems: list[Prepared],
        limit: float,
        judging: Callable[[int], _Judged] | None = None,
    ) -> None:
        self.family, self.problems, self.limit = family, problems, limit
        self.loops = [ScaledLoop(p, family.order) for p in problems]
        self._judging = judging or (lambda order: [(GainJudge(p, order), 1.0) for p in problems])
        self.judged = self._judging(family.order)
        self.evaluations = 0
        self.notes: tuple[str, ...] = ()
        #: the parameters of the last value, and the number and place of each judge there
        self._latest: tuple[FloatArray, list[tuple[float, Any]]] = np.zeros(0), []
        #: the norm that each start reached
        self.tried = Certificate()

    def _spent(self, share: float = 1.0) -> Callable[[], bool]:
        return lambda: self.evaluations >= share * self.limit

    def _controller(self, theta: FloatArray) -> Matrices | None:
        """Return the controller; None where parameters are beyond their limits or overflow."""
        self.evaluations += 1
        K = self.family.matrices(theta)
        return K if self.family.allows(theta) and np.all(np.isfinite(K.joined)) else None

    def stability(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return the largest spectral abscissa of the loops and its gradient."""
        if (K := self._controller(theta)) is None:
            return np.inf, np.zeros(theta.size)
        value, by, _ = max((loop.stability(K) for loop in self.loops), key=lambda one: one[0])
        return value, np.tensordot(self.family.jacobian(theta), by, axes=2)

    def value(self, theta: FloatArray) -> tuple[float, tuple[int, Any]]:
        """Return the logarithm of the largest number of the loops, and which and where it is."""
        # a little more for large parameters: ends infima that are only neared as gains grow
        if (K := self._controller(theta)) is None:
            return np.inf, (0, 0.0)
        values = [(judge.value(K), below) for judge, below in self.judged]
        each = [(number / below, place) for (number, place), below in values]
        self._latest = theta, each
        worst = int(np.argmax([number for number, _ in each]))
        number, place = each[worst]
        return float(np.log(max(number, TINY))) + TYPED * _theta_size(theta), (worst, place)

    def pieces(self, theta: FloatArray) -> Pieces:
        """Return the numbers that are near the largest, as `value` counts them."""
        if not np.array_equal(theta, self._latest[0]):
            self.value(theta)
        _, each = self._latest
        least = PART * max(gain for gain, _ in each)
        near = [(i, place) for i, (gain, place) in enumerate(each) if gain >= least]
        return reduce(Pieces.and_those, (self._of_judge(theta, *one, sweep=True) for one in near))

    def piece(self, theta: FloatArray, place: tuple[int, Any]) -> Pieces:
        """Return the numbers at the place of a peak elsewhere."""
        return self._of_judge(theta, *place, sweep=False)

    def _of_judge(self, theta: FloatArray, which: int, place: Any, *, sweep: bool) -> Pieces:
        K, by = self.family.matrices(theta), self.family.jacobian(theta)
        judge, below = self.judged[which]
        found, size = judge.pieces(K, by, place, sweep=sweep), _theta_size(theta)
        return found._replace(
            value=found.value - np.log(below) + TYPED * size,
            gradient=found.gradient + TYPED / size * theta,
        )

    def best(self, starts: int, rng: np.random.Generator, bar: Progress) -> _End:
        """Return the best end of all starts."""
        ends: list[_End] = []
        nested = self.family.nested(self._minimised)
        if nested is not None:
            ends.append(self._descended("lower orders", nested))
        for i in range(starts):
            if ends and self._spent(_SHARE)():
                break
            ends.append(self._started(i, ends, rng))
            bar.advance()
        stable = [end for end in ends if np.isfinite(end.value)]
        if not stable:
            raise self._infeasible(min(ends, key=lambda end: end.decay).x, len(ends))
        stable.sort(key=lambda end: (end.settled, end.value))  # a settled one gains little
        for i in range(min(_CONTINUED, len(stable))):
            stable[i] = self._continued(stable[i])
            bar.advance()
        lowest = min(range(len(stable)), key=lambda i: stable[i].value)
        stable[lowest] = self._continued(stable[lowest])
        self.tried = Certificate(
            tuple(Verified(end.name, _end_norm(end)) for end in (*ends, *stable))
        )
        best = min(stable, key=lambda end: end.value)
        same = sum(end.value <= best.value + CLOSE for end in stable)
        self.notes = (f"{same} of {len(ends)} starts end within 1 % of the best",)
        if self._spent()():
            self.notes += (f"{self.limit} evaluations ended the search: more may find less",)
        return best

    def _continued(self, end: _End) -> _End:
        """Return where an end goes with many steps more."""
        found = minimax(self, end.x, steps=_MANY, spent=self._spent())
        return end._replace(x=found.x, value=found.value, settled=found.settled)

    def _started(self, i: int, ends: list[_End], rng: np.random.Generator) -> _End:
        """Return the end of the structure's own start, of one around it or around the best end."""
        name, first, width = f"start {i + 1}", self.family.first, self.family.spread
        if i == 0:
            return self._descended(name, first)
        best = min(ends, key=lambda end: end.value)
        for again in range(len(_SPREADS)):  # until one is stabilised
            draw = width * rng.standard_normal(first.size)
            if i % 2 or not np.isfinite(best.value):
                spread = _SPREADS[(i // 2 + again) % len(_SPREADS)]
                end = self._descended(name, first + spread * draw, deeper=_FEW)
            else:
                size = max(1.0, float(np.sqrt(np.mean(best.x**2))))
                end = self._descended(name, best.x + _NARROWER * size * draw)
            if np.isfinite(end.value) or self._spent(_SHARE)():
                break
        return end

    def _descended(self, name: str, theta: FloatArray, steps: int = _FEW, deeper: int = 0) -> _End:
        """Return where a start ends after a few steps."""
        spent = self._spent(_SHARE)
        # drawn starts decay first: a loop that is barely stable has peaks that hide the others
        for enough, most in ((-10 * ROOT, _STABLE), (-CLOSE, deeper)):
            theta, decay = bfgs(self.stability, theta, enough=enough, steps=most, spent=spent)
            if decay > enough:
                break
        if not (decay < -ROOT and np.isfinite(self.value(theta)[0])):
            return _End(np.inf, theta, decay, name)
        found = minimax(self, theta, steps=steps, spent=spent)
        return _End(found.value, found.x, decay, name, found.settled)

    def _minimised(self, family: ControllerFamily) -> FloatArray | None:
        """Return the best parameters of another structure, from its first start and one near it.

        None when it is not stabilised.
        """
        left = self.limit - self.evaluations
        other = _StructureSearch(family, self.problems, (1.0 - _SHARE) * left, self._judging)
        # a plant without a controller may be stationary: a free mass is
        draw = np.random.default_rng(family.order).standard_normal(family.first.size)
        starts = (family.first, family.first + family.spread * draw)
        end = min((other._descended("", one, _MANY) for one in starts), key=lambda end: end.value)
        self.evaluations += other.evaluations
        return end.x if np.isfinite(end.value) else None

    def _infeasible(self, theta: FloatArray, starts: int) -> InfeasibleError:
        K = self.family.matrices(theta)
        if all(loop.stable(K) is not None for loop in self.loops):
            return InfeasibleError(
                f"the objective is infinite for the stable loops at the end of all {starts} starts."
                " Give it a number for every stable loop, or a structure that starts elsewhere."
            )
        worst = max(range(len(self.loops)), key=lambda i: self.loops[i].stability(K)[0])
        value, _, pole = self.loops[worst].stability(K)
        freq = self.problems[worst].frequency(abs(pole.imag))
        size = self.problems[worst].frequency(abs(pole))
        return InfeasibleError(
            f"no controller of this structure was found that stabilises plant {worst + 1}: of "
            f"{starts} starts the best leaves a pole at {freq:.4g} Hz (size {size:.4g} Hz, real "
            f"part {value:.3g} of the plant's speed). Give the structure more freedom (a higher "
            "order, a lead), the gain of a law the other sign, a start that stabilises, or more "
            "starts and evaluations."
        )


def _theta_size(theta: FloatArray) -> float:
    return float(np.sqrt(1.0 + theta @ theta))


def _end_norm(end: _End) -> float:
    return float(np.exp(end.value - TYPED * _theta_size(end.x)))
