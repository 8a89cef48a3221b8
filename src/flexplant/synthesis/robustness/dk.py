"""design_mu: a controller for a whole uncertainty, by D-K iteration, verified by mixed mu."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ...arrays import FloatArray, whole
from ...certificates import Certificate, Verified
from ...errors import CertificateError, FlexplantError, ModelError, SolverError, counted
from ...lti.conversions import tustin
from ...lti.filters import zpk
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import lft, series, side_by_side
from ...lti.statespace import StateSpace
from ...parallel import Progress, one_thread
from ...plant import AnyPlant, StandardPlant
from ...plant.uncertainty.delta_blocks import FullBlock, RepeatedScalar
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...tolerances import CLOSE, NEGLIGIBLE, ROUNDING
from ..controller import Controller, SynthesisMethod, swept_norm
from ..hinf.hinf_design import HinfDesign, design_hinf
from ..hinf.hinf_riccati import Riccati
from ..hinf.tolerated_modes import (
    ModeChannel,
    ModeLoop,
    mode_channels,
    rebalanced,
    with_mode_channels,
)
from ..pipeline import Design, Solution, designed, solved
from ..preparation import prepared
from .performance_bounds import performance_bound
from .uncertain_loops import (
    UncertainLoop,
    open_plant,
    require_uncertain,
    uncertain_loop,
    weighted_names,
)
from .uncertainty_blocks import Scalings, block_places, osborne
from .upper import upper_level

#: the route of the certificate of an iteration
STEPS_OF_MU = "upper bound of mu after each step"
#: frequencies at which D is found
_POINTS = 40
#: machines at corners of the uncertainty that are closed exactly, and by how much their gain may
#: exceed the bound: the first order of the channels
_MACHINES, _BEYOND = 8, 0.05


class _DkStep(NamedTuple):
    """A controller with its mixed mu, and the loop or the channels that the next step needs."""

    number: int
    mu: float
    controller: StateSpace
    after: Any
    freq: float = np.nan


class _Iterated(NamedTuple):
    """The step of the smallest mu, mu of each step, and the reason if a step failed after it."""

    best: _DkStep
    checks: list[Verified]
    notes: tuple[str, ...]


@one_thread()
def design_mu(
    uncertain: UncertainPlant[Any],
    *,
    w: Any,
    z: Any,
    method: SynthesisMethod | None = None,
    iterations: int = 4,
    order: int = 1,
    progress: bool | None = None,
) -> Controller:
    """Return a controller whose weighted gain is small on every machine of an uncertain plant.

    The method is D-K iteration (as ``musyn``). A Delta is an uncertainty that is scaled to size 1.
    A machine is the plant with one choice of the Deltas. D(s) are filters of few states that scale
    the channels of the Deltas. Each step has two parts. First, an H-infinity controller is designed
    for the plant whose Deltas are scaled by D. Second, a new D is computed for the best loop so
    far. All filters D are then multiplied by a common factor that makes the H-infinity norm of the
    next design as small as possible. If Deltas are real, the whole iteration is repeated without
    this factor, and the better result is kept. Before the iteration, two candidates are computed:
    the controller designed without uncertainty, and the one for a constant D.

    The design treats real Deltas as complex, which is conservative. The controllers are compared by
    mixed mu, in which real Deltas stay real. Its bound holds at all frequencies, also between grid
    points. The result is the controller with the smallest mixed mu.

    If all Deltas are frequencies, a simpler design is used. As in `design_hinf` of an uncertain
    plant, each mode has one channel, with the scaling matrix G for real Deltas (see `mu`) and a
    constant D. D is chosen so that the closed loop's gains into the channel and out of it are equal
    at the frequency of the mode. The bound is computed to first order in the changes of the
    frequencies, on a frequency grid through the modes. In addition, some machines are drawn whose
    frequencies are all at an end of their intervals. Their loops are computed exactly. This design
    needs a weighted disturbance that moves the modes. Without one, the general iteration is made.

    Parameters
    ----------
    uncertain : UncertainPlant
        Uncertain plant from ``plant.uncertain(fit, fx.plant.Neglected())`` or `uncertain_system(M,
        blocks)`, continuous or sampled.
    w, z : mapping {name: weight}, or sequence of str
        Weights of the performance requirement, as for `StandardPlant.weighted`, for example those
        of `stage_weights`. Channels that are not named, or have the weight None, are left out.
    method : as for `design_hinf`, optional
    iterations : int
        Largest number of steps of the D-K iteration.
    order : int
        Largest number of states of the filter D of one Delta. The filter acts on the outputs of the
        plant that enter the Delta, and its inverse on the inputs that the Delta drives.
    progress
        As for `design_hinf`. Truncated modes give the same warning as there.

    Returns
    -------
    Controller
        The controller. `gamma` is the upper bound of mu of robust performance (see
        `robust_performance`). If it is below 1, all machines of the uncertainty are stable and have
        weighted gains below 1. The certificate holds mu of every step.

    Raises
    ------
    AssumptionError, SolverError, InfeasibleError, CertificateError
        When no step gives a controller. See `design_hinf`.
    ModelError, LabelError
        When `uncertain` is not an uncertain plant, or channels are missing or unknown.

    References
    ----------
    [Doyle1986]_; [ZhouDoyleGlover1996]_, section 11.4.
    """
    if not w or not z:
        raise ModelError("name the channels of performance: w={'d': 1.0}, z={'tip:x': weight}.")
    require_uncertain(uncertain)
    most = whole(iterations, "iterations")
    states = whole(order, "order", minimum=0)
    given = w, z, method, most, states, progress
    by_modes = uncertain.is_of_frequencies and _moves_modes(uncertain, w, z)
    iteration = _ModeIteration if by_modes else _DkIteration
    return designed(iteration(*given), uncertain, uncertain.plant)


def _moves_modes(uncertain: UncertainPlant[Any], w: Any, z: Any) -> bool:
    """Return whether a weighted disturbance moves a mode of uncertain frequency: D begins there."""
    weighted = _performance_plant(uncertain.plant, w, z)
    g, names = weighted.system, uncertain.plant.assembled.realisation.names
    own = [g.states.index(names[2 * mode - k]) for mode in uncertain.frequencies for k in (1, 2)]
    return bool(np.any(g.B[own][:, g.input_index(weighted.w)]))


@dataclass(frozen=True)
class _DkIteration(Design):
    """H-infinity controllers for scaled Deltas, and scales for each controller, in turn."""

    w: Any
    z: Any
    method: SynthesisMethod | None
    most: int
    order: int
    progress: bool | None

    def prepare(self, plant: UncertainPlant[Any]) -> UncertainPlant[Any]:
        return plant  # each step prepares a separate problem

    def solve(self, problem: UncertainPlant[Any]) -> _Iterated:
        found = self._iterated(problem, sized=True)
        if any(isinstance(one, RepeatedScalar) and one.real for one in found.best.after.blocks):
            # real Deltas count as complex in the norm, which then says little of the size of D
            try:
                other = self._iterated(problem, sized=False)
            except FlexplantError as error:
                note = f"the iteration from D = 1 gave no controller: {error}"
                return found._replace(notes=(*found.notes, note))
            found = min(found, other, key=lambda one: one.best.mu)
        return found

    def _iterated(self, problem: UncertainPlant[Any], *, sized: bool) -> _Iterated:
        given = self.w, self.z, self.method, self.most, self.order
        steps = _filter_steps(problem, *given, sized=sized)
        return _best_step(steps, self.most + 1, self.progress)

    def restore(self, plant: UncertainPlant[Any], problem: Any, found: Any) -> StateSpace:
        K: StateSpace = found.best.controller
        return K

    def certify(self, solution: Solution) -> Controller:
        best, found, notes = solution.found
        at = Verified("at Hz", best.freq, STEPS_OF_MU)
        checks = Verified("mu", best.mu, STEPS_OF_MU), at, *found
        return Controller(
            solution.K,
            f"D-K iteration, {counted(len(found), 'step')}",
            gamma=best.mu,
            certificate=Certificate(checks),
            notes=notes,
        )


class _ModeIteration(_DkIteration):
    """The same with one channel a mode and constant scales."""

    def solve(self, problem: UncertainPlant[Any]) -> _Iterated:
        # step k solves the H-infinity problem of Deltas and weights divided by the mu of the step
        # before: at a fixed point the norm is 1 and mu what it was divided by
        weighted = _performance_plant(problem.plant, self.w, self.z)
        steps = _mode_steps(weighted, mode_channels(weighted, problem), self.method, self.most)
        return _best_step(steps, self.most, self.progress)

    def certify(self, solution: Solution) -> Controller:
        best, found, notes = solution.found
        ratio = _corner_ratio(solution.plant, best, self.w, self.z)
        route = "machines at corners, each closed exactly"
        corners = Verified("largest gain of machines over mu", ratio, route)
        checks = Verified("mu", best.mu, STEPS_OF_MU), *found, corners
        return Controller(
            solution.K,
            f"D-K iteration with one channel a mode, {counted(len(found), 'step')}",
            gamma=best.mu,
            certificate=Certificate(checks),
            notes=notes,
        )


def _best_step(steps: Iterator[_DkStep], most: int, progress: bool | None) -> _Iterated:
    """Return the best step; the steps end where mu falls no further, or where one fails."""
    found: list[_DkStep] = []
    notes: tuple[str, ...] = ()
    with Progress(most, "steps of D-K", progress=progress, even=False) as bar:
        try:
            for step in steps:
                bar.advance()
                known = min((one.mu for one in found), default=np.inf)
                found.append(step)
                if step.number > 1 and step.mu > (1.0 - CLOSE) * known:
                    break
        except FlexplantError as error:  # D of a loop near its optimum may be badly conditioned
            if not found:
                raise
            notes = (f"the iteration ended after {counted(len(found), 'step')}: {error}",)
    checks = [Verified(f"mu of step {one.number}", one.mu, STEPS_OF_MU) for one in found]
    return _Iterated(min(found, key=lambda one: one.mu), checks, notes)


def _filter_steps(
    uncertain: UncertainPlant[Any],
    w: Any,
    z: Any,
    method: Any,
    most: int,
    order: int,
    *,
    sized: bool,
) -> Iterator[_DkStep]:
    """Yield the controllers without uncertainty, for constant D, then for D(s) of the best loop."""
    plant = open_plant(uncertain, w=w, z=z)
    # the weights of neglected modes by few states, D one
    omega = _fit_grid(plant.system)
    scales = _filters(plant, omega, np.ones((omega.size, len(plant.blocks))), 1)
    best: _DkStep | None = None
    for number in range(most + 1):
        if best is not None and number > 1:
            scales = _scales_of(plant, best.after, order)
        try:
            if number and sized:
                scales = _best_sized(plant, scales)
            K = _scaled_controller(plant, scales, method, nominal=not number)
            loop = uncertain_loop(uncertain, [K], w=w, z=z)
            mu, freq = performance_bound(loop)
        except FlexplantError:
            if number:
                raise
            continue  # a candidate only: without uncertainty u may cancel w in z at no cost
        step = _DkStep(number, mu, K, loop, freq)
        yield step
        if best is None or mu < best.mu:
            best = step


#: filters on each output and on each input of the uncertainty's channels
_DFilters: TypeAlias = tuple[list[StateSpace], list[StateSpace]]


def _fit_grid(g: StateSpace) -> FloatArray:
    """Return frequencies [rad/s] over which D is fitted."""
    return 2 * np.pi * resonance_grid(g.poles(), 0.0, points=_POINTS, around=())


def _best_sized(plant: UncertainLoop, scales: _DFilters) -> _DFilters:
    """Return D times the number with which the scaled plant has the smallest H-infinity norm."""
    # D and K in turn take small steps towards it: with one of them fixed the other hardly gains
    from scipy.optimize import minimize_scalar  # not loaded with the package

    own, (out, into) = plant.uncertain.plant, scales

    def sized(log_size: float) -> _DFilters:
        c = float(np.exp(log_size))
        return [c * one for one in out], [(1.0 / c) * one for one in into]

    def norm(log_size: float) -> float:
        try:
            g = _scaled(plant, sized(log_size))
            return Riccati(tolerance=CLOSE, progress=False).solve(prepared(g, own.u, own.y)).gamma
        except FlexplantError:
            return np.inf

    most = -np.log(NEGLIGIBLE)
    found = minimize_scalar(norm, bounds=(-most, most), method="bounded", options={"xatol": 0.1})
    return sized(found.x) if found.fun < norm(0.0) else scales


def _scaled(plant: UncertainLoop, scales: _DFilters) -> StateSpace:
    """Return the plant with D on the channels of its Deltas."""
    g, (out, into) = plant.system, scales
    ones = [StateSpace([], [], [], [[1.0]])]
    into, out = into + ones * (len(g.inputs) - len(into)), out + ones * (len(g.outputs) - len(out))
    return series(series(side_by_side(into, g.inputs), g), side_by_side(out, g.outputs))


def _scaled_controller(
    plant: UncertainLoop, scales: _DFilters, method: SynthesisMethod | None, *, nominal: bool
) -> StateSpace:
    """Return the H-infinity controller of the scaled plant, sampled like the plant."""
    g, own = plant.system, plant.uncertain.plant
    performance = g.outputs[len(scales[0]) :], g.inputs[len(scales[1]) :]
    scaled = g.select(*performance) if nominal else _scaled(plant, scales)
    standard = StandardPlant.from_statespace(scaled, u=own.u, y=own.y)
    K = design_hinf(standard, method).system
    return tustin(K, 1.0 / plant.dt) if plant.dt else K


def _scales_of(plant: UncertainLoop, loop: UncertainLoop, order: int) -> _DFilters:
    """Return D of a loop as filters: one for each block, its Delta taken as complex."""
    blocks = [FullBlock(block.w, block.z) for block in (*loop.blocks, loop.performance)]
    scalings, where = Scalings(blocks), block_places(blocks)
    omega = _fit_grid(loop.system)
    rows, levels = [], []
    for one in omega:
        M = loop.system.evaluated(1j * one) * loop.heights(one, one)
        if not np.any(M):
            rows.append(np.ones(len(blocks)))
            levels.append(0.0)
            continue
        start = scalings.scaled(scalings.start, osborne(M, where))
        found = upper_level(M, scalings, start)
        rows.append(np.sqrt(scalings.stacks(found.x)[0][:, 0, 0].real))  # all are numbers
        levels.append(found.level)
    d, matters = np.array(rows), np.array(levels) / max(levels)
    d /= d[:, -1:]  # performance is not scaled
    highest = d[int(np.argmax(matters))]
    return _filters(plant, omega, np.clip(d, highest / _SPREAD, highest * _SPREAD), order, matters)


def _filters(
    plant: UncertainLoop, omega: FloatArray, d: FloatArray, order: int, matters: Any = 1.0
) -> _DFilters:
    """Return filters of D (n_freq, blocks), and of the weights of columns over D."""
    weights = iter(np.array([plant.heights(one, one) for one in omega]).T)
    out: list[StateSpace] = []
    into: list[StateSpace] = []
    for block, size in zip(plant.blocks, d.T, strict=False):
        one = fitted_magnitude(omega, size, order, matters)
        out += [one] * block.z
        for weight in islice(weights, block.w):
            flat = np.ptp(weight) < ROUNDING * weight.max()
            into.append(
                inverse(one) if flat else fitted_magnitude(omega, weight / size, order + 1, matters)
            )
    return out, into


#: factor by which D differs at most from where mu is largest: where one channel is much larger than
#: the others D is nearly free, and a tenth of the best D costs 0.5 % of mu there
_SPREAD = 10.0
#: mean error of the logarithm with which a fit of fewer states is taken
_FITTED = 0.05


def fitted_magnitude(
    omega: FloatArray, size: FloatArray, order: int, matters: Any = 1.0
) -> StateSpace:
    """Return ``k prod (s + a_i) / (s + b_i)`` near a magnitude, of at most some order."""
    # least squares of the logarithm, errors weighted; the fewest factors that come close
    from scipy.optimize import least_squares  # not loaded with the package

    # a fit of logarithms: zeros would count without limit
    goal = np.log(np.maximum(size, 1e-12 * size.max()))
    at = np.log(omega)
    found = StateSpace([], [], [], [[float(np.exp(goal.mean()))]])
    if np.std(goal) < _FITTED:
        return found
    for count in range(1, order + 1):
        corners = np.interp(np.linspace(0, 1, 2 * count + 2)[1:-1], np.linspace(0, 1, at.size), at)

        def error(q: FloatArray, n: int = count) -> FloatArray:
            a, b = np.exp(2 * q[1 : n + 1]), np.exp(2 * q[n + 1 :])
            square = omega[:, None] ** 2
            ratio = 0.5 * (np.log(square + a) - np.log(square + b)).sum(axis=1)
            return np.asarray(matters * (q[0] + ratio - goal))

        start = np.concatenate([[goal.mean()], corners[::2], corners[1::2]])
        best = least_squares(error, start, max_nfev=200)
        a, b = np.exp(best.x[1 : count + 1]), np.exp(best.x[count + 1 :])
        found = zpk(-a, -b, float(np.exp(best.x[0])))
        if np.std(best.fun) < _FITTED:
            break
    return found


def inverse(g: StateSpace) -> StateSpace:
    """Return the inverse of a filter of one input and output with feedthrough."""
    d = 1.0 / g.D[0, 0]
    return g.replace(A=g.A - d * g.B @ g.C, B=d * g.B, C=-d * g.C, D=[[d]], blocks=None)


def _mode_steps(
    weighted: AnyPlant, channels: Sequence[ModeChannel], method: Any, most: int
) -> Iterator[_DkStep]:
    """Yield controllers, each for Deltas and weights over the mu of the step before."""
    level = 1.0
    for number in range(1, most + 1):
        step = _dk_iteration(weighted, number, channels, level, method)
        yield step
        level, channels = min(step.mu, 2.0 * level), step.after


def _dk_iteration(
    weighted: AnyPlant,
    number: int,
    channels: Sequence[ModeChannel],
    level: float,
    method: SynthesisMethod | None,
) -> _DkStep:
    """Return the controller for Deltas and weights over a level, its mu, and channels for it."""
    sized = [
        one.replace(share=one.share / level, v=one.v / level, c=one.c / level) for one in channels
    ]
    plant = with_mode_channels(weighted, sized)
    g = plant.system
    scale = np.ones(len(g.outputs))
    scale[g.output_index(weighted.z)] = 1.0 / level
    system = g.replace(C=g.C * scale[:, None], D=g.D * scale[:, None])
    design = HinfDesign(Riccati(progress=False) if method is None else method)
    K = solved(design, plant.replace(system=system)).K.replace(name="mu")
    if not lft(system, K).is_stable:
        raise SolverError("the controller does not stabilise in rounding.")
    again = rebalanced(channels, with_mode_channels(weighted, channels), K)
    loop = ModeLoop(again, with_mode_channels(weighted, again), K, 2.0, weighted=True)
    mu = loop.level(level)
    if abs(mu / level - 1.0) > CLOSE:  # D is found for a level
        mu = min(mu, loop.level(mu))
    return _DkStep(number, mu, K, again)


def _performance_plant(plant: AnyPlant, w: Any, z: Any) -> AnyPlant:
    """Return a plant with the channels of performance alone, weighted."""
    sides = {}
    for side, given in (("z", z), ("w", w)):
        names, weights = weighted_names(given, side)
        own = {name: weights.get(name, 1.0) for name in names}
        sides[side] = dict.fromkeys(getattr(plant, side)) | own  # None leaves one out
    return plant.weighted(**sides)


def _corner_ratio(uncertain: UncertainPlant[Any], best: _DkStep, w: Any, z: Any) -> float:
    """Return the largest weighted gain of machines at corners, each closed exactly, over mu."""
    chance, size = np.random.default_rng(0), min(1.0, 1.0 / best.mu)
    names = [delta.name for delta in uncertain.deltas]
    most = 0.0
    for _ in range(_MACHINES):
        ends = size * chance.choice([-1.0, 1.0], len(names))
        machine = uncertain.lft(dict(zip(names, ends.tolist(), strict=True)))
        loop = lft(_performance_plant(machine, w, z).system, best.controller)
        most = max(most, swept_norm(loop) / best.mu if loop.is_stable else np.inf)
    if most > 1.0 + _BEYOND:
        raise CertificateError(
            f"of machines within {size:.3g} of the uncertainty one has {most:.4g} times the gain "
            f"of mu <= {best.mu:.4g} (inf: it is unstable): the changes are too large for the "
            "first order of one channel a mode. State less uncertainty, or raise the rate."
        )
    return most
