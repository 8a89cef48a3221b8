"""design_stage: the fastest H-infinity controller of a stage that tolerates errors of its modes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import tee
from typing import Any, NamedTuple

import numpy as np

from ...arrays import positive
from ...certificates import Certificate, Verified, deferred
from ...errors import InfeasibleError, ModelError, SolverError, named_modes, warn
from ...loop import ClosedLoop
from ...loop.blocks import joined
from ...loop.broken import axis_bandwidths
from ...loop.modal_tolerances import BEYOND, mode_tolerances
from ...loop.other_machines import loop_beside
from ...lti.interconnection import series
from ...lti.statespace import StateSpace
from ...parallel import Progress
from ...plant import AnyPlant, reference_errors, stage_weights, standard_plant
from ...plant.machine_plants import PlantMachines
from ...plant.realisation import natural
from ...plant.uncertainty.mode_delta import DampingDelta, Dampings, Frequencies
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...plant.visibility import untouched_modes
from ...tolerances import CLOSE, SAME
from ...updating.residuals.residual import USUAL
from ..controller import Controller, warned, with_checks
from ..pipeline import Design, Solution, solved, verified
from .hinf_design import HinfDesign, TolerantDesign
from .hinf_riccati import Riccati, UncheckedRiccati

#: |S| crosses 1 at about two thirds of the bandwidth of these weights, which bound the efforts
_CROSSES = 2.0 / 3.0
#: first guess: |S| crosses 1 at this fraction of the first frequency that the actuators move
_FIRST = 1.0 / 3.0
#: factor between bandwidths tried, how many, and halvings of an interval of it: 3 % of a bandwidth.
#: As many designs for a stated bandwidth: three or four suffice on plates and driven machines.
#: If all of these agree, the first mode does not limit the bandwidth (a cable carrier's swing at
#: 0.2 Hz on an axis of 60 Hz): each further step has one power more, up to twice as many steps.
#: Without a rate no bandwidth is too high, so that the search could go on for ever: it takes _MOST
_STEP, _MOST, _HALVINGS = 1.3, 8, 2
#: modulus margin that is kept with any one mode off, as a fraction of the nominal one
_KEPT = 0.875
#: modes below this multiple of the bandwidth of the weights are damped, not only tolerated; more of
#: them where the loop is not stable on the machines drawn: a tolerated mode may depend on its shape
#: (a margin of 0.43 became 0.33 on a machine by 1 % of other shapes in one mode's)
_DAMPED = (3.5, 6.0)
#: number of machines on which a loop is tested, as many more for each on which it fails, and their
#: largest number: of n with k failures a further one holds with a probability of (n - k) / (n + 1),
#: which is more than 95 % at each n at which the test may end
_DRAWS, _MOST_DRAWN = 20, 100
#: relative error of dampings that are neither measured nor stated: two usual deviations
_DAMPING = 2.0 * USUAL[1]
#: largest bandwidth, relative to the rate, at which the weights can be sampled
_OF_RATE = 0.1


def design_stage(
    plant: AnyPlant | UncertainPlant[Any],
    *,
    bandwidth: float | None = None,
    margin: float = 0.4,
    poi: str | None = None,
    disturbance: float | None = None,
    effort: float | None = None,
    progress: bool | None = None,
) -> Controller:
    """Return the fastest H-infinity controller of a stage that tolerates errors of its modes.

    A controller is designed for each of several bandwidths. The weights of each design are the
    `stage_weights` of its bandwidth. They weight the plant
    ``plant.through(reference_errors(plant))``, or the plant itself if it has no references.
    ``design_hinf(uncertain=)`` computes the controller. The result is the design of largest
    bandwidth that satisfies three conditions. First, the modulus margin at u is at least `margin`.
    This also holds with the truncated modes (which the design model leaves out), if they are known.
    Second, the modulus margin is at least 7/8 of `margin` if the frequency of any one mode is wrong
    by its uncertainty. Third, it is at least 7/8 of `margin` on 95 % of the machines, which are
    possible variants of the plant, drawn at random. Of the first 20 machines, all have to satisfy
    this condition; if one does not, 39 of 40 have to, then 58 of 60, up to 96 of 100. The loop is
    stable on all of them.

    There are two ways to draw the machines. If the plant comes from a calibrated fit and no
    uncertainties of frequencies are stated, the machines are those of `StandardPlant.machines`,
    which agree with the measurement of the fit. Otherwise all frequencies change simultaneously by
    their stated uncertainties, and the mode shapes change with them. The damping ratios change by
    their stated uncertainties, or by 30 % by default. For a plant of a calibrated fit, the
    certificate also has the margin on the machines of the fit.

    Parameters
    ----------
    plant : StandardPlant or UncertainPlant
        Continuous or sampled plant of a machine that follows references, or that is held at rest
        (without references). If no uncertainty is stated, all frequencies are uncertain by 0.5 %.
        ``plant.uncertain(frequency={...})`` and ``plant.uncertain(fit)`` are more accurate. The
        design itself uses only the uncertainties of the frequencies. A mode that
        no actuator moves or no sensor sees is left out.
    bandwidth : float [Hz], optional
        Bandwidth of the loop; by default the largest possible one. It is the frequency at which |S|
        from reference to error crosses 1 on the slowest axis. The weights are adjusted until the
        loop reaches it within 1 %. A plant without references has no such frequency. Its weights
        are then the `stage_weights` of 1.5 times the given bandwidth.
    margin : float
        Smallest allowed modulus margin, with the loop opened at u. The modulus margin is one over
        the largest singular value of the sensitivity S at any frequency.
    poi : str, optional
        Point of interest (POI), as for `stage_weights` and `reference_errors`.
    disturbance, effort : float
        Sizes of the weights of disturbances and efforts, as for `stage_weights`. By default they
        are those for uncertain frequencies.
    progress : as for `design_hinf`

    Returns
    -------
    Controller
        Controller from the sensors and the reference to the actuators, for ``close_loop(plant,
        controller)``. `tried` lists the bandwidths of the weights with their modulus margins. The
        margin is 0 if the loop does not tolerate the errors of its modes. `certificate` has the
        margin of the final design, and the smallest modulus margin of the machines drawn, without
        those that do not satisfy the third condition. What did not decide on the design is computed
        when the certificate is first read or printed.

    Raises
    ------
    AssumptionError, LabelError
        As for `stage_weights` and `reference_errors`.
    InfeasibleError
        When all bandwidths that were tried fail. The message lists them.
    ModelError
        When a number is out of range, or the plant was not assembled from a structure.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> controller = fx.design_stage(plant, bandwidth=10.0)
    >>> fx.close_loop(plant, controller).modulus_margin > 0.4
    True
    """
    given = standard_plant(plant)
    known = given.uncertainty
    stated = known is not None and any(isinstance(kind, Frequencies) for kind in known.kinds)
    uncertain = given.uncertain(frequency=0.005) if known is None else known
    untouched = untouched_modes(uncertain.plant.machine, inputs="u", outputs="y")
    ranges = {n: off for n, off in uncertain.frequencies.items() if n not in untouched}
    margin = positive(margin, "margin")
    wanted = None if bandwidth is None else positive(bandwidth, "bandwidth")
    if margin >= 1.0:
        raise ModelError(f"margin must be below 1, got {margin}: no loop that acts keeps it.")
    if not ranges:
        raise ModelError(
            f"no frequency of {uncertain!r} is uncertain, of a mode that the actuators move and "
            "the sensors see: nothing limits the bandwidth. Pass plant.uncertain(frequency=0.005)."
        )
    weights = partial(
        stage_weights, uncertain.nominal, poi=poi, disturbance=disturbance, effort=effort
    )
    own = uncertain.plant
    errors = reference_errors(own, poi=poi) if own.assembled.ports.references else None
    task = _StageTask(uncertain, ranges, stated, margin, weights, errors, wanted, progress)
    found = solved(task, own)
    return with_checks(verified(task, found), own, warned(found.found.loop))


@dataclass(eq=False)
class _StageTask(Design):
    """The designs of rising bandwidths and their results."""

    uncertain: UncertainPlant[Any]
    #: relative errors of the frequencies of modes that the actuators move and the sensors see
    ranges: dict[int, float]
    stated: bool
    margin: float
    #: those of a bandwidth [Hz]
    weights: Callable[[float], Any]
    #: inputs of the controller; None: the sensors themselves, without references
    errors: StateSpace | None
    #: where |S| crosses 1 [Hz]; None: as high as it can
    wanted: float | None
    progress: bool | None

    def __post_init__(self) -> None:
        self.plant = self.uncertain.plant
        pairs = self.plant.assembled.realisation.pairs[np.array(sorted(self.ranges)) - 1]
        #: the uncertain frequencies [Hz], in the order of the modes
        self.frequencies = natural(pairs)[0] / (2.0 * np.pi)
        #: the highest bandwidth [Hz] whose weights can be sampled
        self.highest = _OF_RATE / self.plant.dt if self.plant.dt else np.inf
        self.tried: dict[float, float] = {}
        #: what was tried, by the bandwidth of the loop [Hz], and why it does not hold
        self.causes: list[str] = []
        self.best: _StageTry | None = None

    def prepare(self, plant: AnyPlant) -> AnyPlant:
        """Return the plant from efforts to errors: each bandwidth poses a separate problem."""
        return plant if self.errors is None else plant.through(self.errors)

    def solve(self, problem: AnyPlant) -> _StageTry:
        """Return the design of the largest bandwidth that holds."""
        self.through = problem
        with Progress(_MOST, "bandwidths", progress=self.progress, even=False) as bar:
            if self.wanted is None:
                self.search(bar)
            elif self.errors is None:
                self.holds(self.wanted / _CROSSES)
            else:
                self._kept(self.wanted / _CROSSES, self._moved, self.wanted)
        vars(self).pop("machines", None)  # no check needs them again: each takes 3 MB
        if self.best is None:
            off, causes = 100.0 * max(self.ranges.values()), dict.fromkeys(self.causes)
            raise InfeasibleError(
                f"no loop keeps the modulus margin {self.margin:g} on the plant, and "
                f"{_KEPT * self.margin:.3g} with any one modal frequency off (by up to {off:.2g} "
                f"%) and on 95 % of machines drawn. Tried for |S| crossing 1 at "
                f"{'; '.join(causes)}. State how well the frequencies and dampings are known, "
                "plant.uncertain(...), lower margin=, ask for another bandwidth=, or move the "
                "actuators."
            )
        return self.best

    def restore(self, plant: AnyPlant, problem: AnyPlant, found: _StageTry) -> StateSpace:
        """Return the controller from the sensors and the reference."""
        return found.loop.blocks[0]

    def certify(self, solution: Solution) -> Controller:
        """Return the controller with the checks of its weighted loop, and what was tried."""
        best: _StageTry = solution.found
        answer = verified(best.design, best.solution)
        route = "a sweep of |1 + L| at u"
        tries = (
            Verified(f"{freq:.4g} Hz", margin, route, self.margin, at_least=True)
            for freq, margin in self.tried.items()
        )
        return answer.replace(
            system=solution.K,
            method="H-infinity of a stage",
            certificate=deferred(lambda: (*answer.certificate.checks, *self._checks(best))),
            notes=(*answer.notes, *self._without()),
            tried=Certificate(tuple(tries)),
            reached=Certificate(),
        )

    def _checks(self, best: _StageTry) -> Iterator[Verified]:
        """Yield the figures of the loop and of its machines."""
        yield Verified(f"least modulus margin of {best.drawn.those} drawn", best.drawn.margin)
        yield Verified("bandwidth of the weights [Hz]", best.bandwidth)
        if self.errors is not None:
            reached = self._crossing(best.loop)
            yield Verified("|S| of the references below 1 up to [Hz]", reached)
        fitted = self._fitted() if self.stated else None
        if fitted is None:
            return
        try:
            found = _margins(best.whole, fitted, 0.0)
        except ModelError as error:  # the stated uncertainties decided, not these machines
            warn(f"the certificate has no margin on machines of the fit: {error}")
        else:
            yield Verified(f"least modulus margin of {found.those} of the fit", found.margin)

    def _without(self) -> list[str]:
        """Return a note on the uncertain modes that do not matter to the loop."""
        left = [mode for mode in self.uncertain.frequencies if mode not in self.ranges]
        why = "which the actuators do not move or the sensors do not see"
        return [f"without {named_modes(left)}, {why}"] if left else []

    def _fitted(self) -> Iterator[AnyPlant] | None:
        """Return machines that agree with the measurement of a fit, None where it is not known."""
        # the first of those of its intervals, one after the other: each takes 3 MB
        measured: PlantMachines = self.uncertain.machines
        fit = measured.fit
        if fit is None or measured.missing:
            return None
        return measured.each(_MOST_DRAWN, rng=fit.seed, fed_back=True)

    @cached_property
    def machines(self) -> Iterator[AnyPlant]:
        """Machines on which a loop must hold, the same for all, drawn as they are needed."""
        fitted = None if self.stated else self._fitted()
        if fitted is not None:
            return fitted
        known = {d.mode: d.scale for d in self.uncertain.deltas if isinstance(d, DampingDelta)}
        # modes that do not matter are known: they do not mix with others
        every = self.uncertain.frequencies
        ranges = {mode: self.ranges.get(mode, SAME * off) for mode, off in every.items()}
        kinds = Dampings(known or _DAMPING), Frequencies(ranges)
        unsure = UncertainPlant(self.plant.machine, kinds)  # without channels of its Deltas
        return PlantMachines(unsure.nominal).each(_MOST_DRAWN, rng=0, fed_back=True)

    def holds(self, bandwidth: float) -> bool:
        """Design for a bandwidth of the weights, and return whether the loop holds."""
        return self._kept(bandwidth, partial(self._designed, bandwidth), _CROSSES * bandwidth)

    def _kept(self, bandwidth: float, design: Callable[[float], _StageTry], asked: float) -> bool:
        """Keep the first design that holds, of those that damp more and more modes."""
        damped = None
        for factor in _DAMPED:
            below = factor * bandwidth
            now = int(np.count_nonzero(self.frequencies < below))
            if now == damped:
                break
            damped = now
            try:
                one = design(below)
            except (SolverError, InfeasibleError) as error:  # more damped modes may serve
                self.tried.setdefault(bandwidth, 0.0)
                self.causes.append(f"{asked:.4g} Hz: {error}")
                continue
            self.tried.setdefault(one.bandwidth, 0.0)
            margin, drawn, cause = self._judged(one)
            self.causes.append(f"{asked:.4g} Hz: modulus margin {cause}")
            if margin < self.margin:  # of the model itself: more damping does not help
                self.tried[one.bandwidth] = max(self.tried[one.bandwidth], margin)
                break
            if drawn.margin >= _KEPT * self.margin:
                self.tried[one.bandwidth] = margin
                if self.best is None or one.bandwidth > self.best.bandwidth:
                    self.best = one._replace(drawn=drawn)
                return True
        return False

    def _designed(
        self, bandwidth: float, below: float, method: type[Riccati] = Riccati
    ) -> _StageTry:
        """Return a controller that is not verified yet."""
        weighted = self.through.weighted(self.weights(bandwidth))
        design = TolerantDesign(
            HinfDesign(method(progress=False)), self.uncertain, below,
            HinfDesign(UncheckedRiccati(progress=False)),
        )  # fmt: skip
        solution = solved(design, weighted)
        return _StageTry(bandwidth, design, solution, self._loop(solution.K))

    def _checked(self, one: _StageTry) -> _StageTry:
        """Return what `Riccati` gives for the same problem, which is mostly the same controller."""
        design = replace(one.design, design=HinfDesign(Riccati(progress=False)))
        (_, weighted, _, found), loop = one.solution, one.loop
        same = UncheckedRiccati().proven(found.problem, found.found)
        if same is None:
            found = design.solve(weighted)
            loop = self._loop(found.K)
        else:
            found = found._replace(found=same)
        solution = one.solution._replace(K=found.K, found=found)
        return one._replace(design=design, solution=solution, loop=loop)

    def _moved(self, below: float) -> _StageTry:
        """Return the design of the slowest weights with which |S| crosses 1 where it is wanted."""
        wanted = at = float(self.wanted or 0.0)
        ends = [0.0, np.inf]  # of weights that are too slow, and too fast
        known: list[tuple[float, float]] = []
        method: type[Riccati] = UncheckedRiccati
        for _ in range(_MOST):
            one = self._designed(at, below, method)
            reached = self._crossing(one.loop)
            if abs(reached / wanted - 1.0) <= CLOSE and method is UncheckedRiccati:
                # checked ones from here on, if the two cross elsewhere
                one, method = self._checked(one), Riccati
                reached = self._crossing(one.loop)
            if abs(reached / wanted - 1.0) <= CLOSE:
                return one
            ends[int(reached > wanted)] = at
            known.append((at, reached))
            if not 0.0 < reached < np.inf or (at == self.highest and reached < wanted):
                break
            at = min(_next(known, wanted, ends), self.highest)
        tried = ", ".join(f"{there:.4g} Hz" for _, there in known)
        raise InfeasibleError(f"|S| crosses 1 at {tried} instead")

    def _crossing(self, loop: ClosedLoop) -> float:
        """Return where |S| of the slowest axis that is followed crosses 1 [Hz]."""
        followed = () if self.errors is None else self.errors.inputs
        return min(hertz for ref, hertz in axis_bandwidths(loop).items() if ref in followed)

    def _judged(self, one: _StageTry) -> tuple[float, _Margins, str]:
        """Return the modulus margin, the least one with modes off, and both in words."""
        # the latter is 0 where a single mode off makes the loop unstable. The truncated modes
        # count: a controller of the reduced plant may make them unstable
        margin = min(one.loop.modulus_margin, one.whole.modulus_margin)
        said = f"{margin:.3g} on the plant"
        if margin < self.margin:
            return margin, _Margins(0.0), said
        if not self._tolerates(one.loop, self.ranges):
            said += f", below {_KEPT * self.margin:.3g} with one frequency off"
            return margin, _Margins(0.0), said
        self.machines, each = tee(self.machines)
        drawn = _margins(one.whole, each, _KEPT * self.margin)
        return margin, drawn, f"{said}, {drawn.margin:.3g} on {drawn.those} drawn"

    def _loop(self, system: StateSpace) -> ClosedLoop:
        """Return the loop; nothing is computed on the evaluation model before it is read."""
        block = system if self.errors is None else series(self.errors, system)
        blocks = (block.replace(name="stage", dt=self.plant.dt),)
        plant, controller = joined(self.plant, blocks)
        return ClosedLoop(plant, blocks, controller)

    def _tolerates(self, loop: ClosedLoop, ranges: Mapping[int, float]) -> bool:
        """Return whether any one mode may be off as far as it is uncertain."""
        limit = {mode: BEYOND * needed for mode, needed in ranges.items() if needed > 0}
        margin = _KEPT * self.margin
        found = mode_tolerances(loop.plant, loop.broken, margin=margin, limit=limit)
        needed = np.array([ranges[int(mode)] for mode in found.modes])
        return not np.any(found.least < needed)

    def search(self, bar: Progress) -> None:
        """Try rising bandwidths until one fails, or falling ones until one holds; then between."""
        # the first bandwidth is of the first mode that matters
        now = min(_FIRST * float(self.frequencies[0]) / _CROSSES, self.highest)
        up = self.holds(now)
        step = _STEP
        for k in range(2 * _MOST if self.plant.dt else _MOST):
            bar.advance()
            step = _STEP ** max(1, 2 + k - _MOST)
            other = now * step if up else now / step
            if other > self.highest or self.holds(other) != up:
                break
            now = other
        if self.best is None:
            return
        low, high = self.best.bandwidth, min(self.best.bandwidth * step, self.highest)
        for _ in range(_HALVINGS + int(np.ceil(np.log2(np.log(step) / np.log(_STEP))))):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if self.holds(middle) else (low, middle)


def _next(known: Sequence[tuple[float, float]], wanted: float, ends: Sequence[float]) -> float:
    """Return the next bandwidth of weights: by the secant, between the ends, at most twice."""
    (at, reached), (low, high) = known[-1], ends
    twice, slope = float(np.log(2.0)), 1.0
    if len(known) > 1:
        before, there = known[-2]
        slope = float(np.log(reached / there) / np.log(at / before))
    # faster weights that do not give a faster loop cannot be extrapolated
    step = float(np.log(wanted / reached)) / slope if slope > 0.0 else np.inf
    step = np.sign(wanted - reached) * min(abs(step), twice)
    guess = at * float(np.exp(step))
    return guess if low < guess < high else float(np.sqrt(low * high))


class _Margins(NamedTuple):
    """The modulus margin that all machines but some keep, of how many, and how many these are."""

    margin: float
    number: int = 0
    below: int = 0

    @property
    def those(self) -> str:
        """The machines in words."""
        of = f"{self.number - self.below} of " if self.below else ""
        return f"{of}{self.number} machines"


def _margins(loop: ClosedLoop, machines: Iterable[AnyPlant], needed: float) -> _Margins:
    """Return the modulus margin that 95 % of machines keep, 0 if the loop is unstable on one."""
    scaled, margins, below = bool(loop.broken.mixed()), list[float](), 0
    for machine in machines:
        one = loop_beside(loop, machine).broken.margin(scaled=scaled)
        margins.append(one)
        below += one < needed
        ends = _DRAWS * (1 + below)
        if not one:
            return _Margins(0.0, len(margins))
        if len(margins) == ends:
            return _Margins(sorted(margins)[below], len(margins), below)
        if ends > _MOST_DRAWN:
            break
    return _Margins(sorted(margins)[below - 1], len(margins), below - 1)


class _StageTry(NamedTuple):
    """The controller for the weights of a bandwidth [Hz], and the machines' least margin."""

    bandwidth: float
    design: TolerantDesign
    solution: Solution
    loop: ClosedLoop
    drawn: _Margins = _Margins(0.0)

    @property
    def whole(self) -> ClosedLoop:
        """Its loop with the truncated modes, if these are known."""
        return self.loop.completed or self.loop
