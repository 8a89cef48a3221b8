"""design_mu: a controller for a whole uncertainty, by D-K iteration, verified by mixed mu."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...checks import FloatArray, whole
from ...errors import AssumptionError, FlexplantError, ModelError, SolverError, counted
from ...lti.discretisation import tustin
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import series, side_by_side
from ...lti.statespace import StateSpace
from ...parallel import Progress, one_thread
from ...plant import StandardPlant
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from ...tolerances import ROUNDING
from ..controller import Controller, SynthesisMethod, with_left_out
from ..hinf.hinf_design import design_hinf
from .mode_dk import by_mode_channels
from .sweep import covered
from .uncertain_loop import OpenPlant, UncertainLoop, open_plant, require_uncertain, uncertain_loop
from .uncertainty_blocks import FullBlock, Scalings, block_places, osborne
from .upper import upper_level

#: frequencies at which D is found
_POINTS = 40
#: relative decrease of mu below which the iteration ends
_SETTLED = 0.01


class _DkStep(NamedTuple):
    """A controller with its mixed mu, and the loop it was found from."""

    mu: float
    controller: StateSpace
    loop: UncertainLoop
    freq: float


@one_thread()
def design_mu(
    uncertain: UncertainPlant[Any],
    *,
    w: Any,
    z: Any,
    method: SynthesisMethod | None = None,
    iterations: int = 4,
    order: int = 1,
    larger: Any = None,
    progress: bool | None = None,
) -> Controller:
    """Return a controller whose weighted gain stays small on every machine of an uncertainty.

    D-K iteration: an H-infinity controller for the plant with its Deltas scaled by D(s), then D
    for its loop, a filter of few states per Delta, and so on. In the design real Deltas count as
    complex, which is cautious; what is judged, and kept, is the controller of the smallest mixed
    mu, real Deltas real, between all frequencies. The first candidate is that without uncertainty.

    Where all Deltas are frequencies, each mode has one channel, as in `design_hinf` of an uncertain
    plant, with the shift of real mu and a constant D, evened out in closed loop; the bound is that
    of a grid through the places of the modes, to first order in their changes. Machines at corners
    of the uncertainty are closed exactly. Where that shows no controller, the general way follows.

    Parameters
    ----------
    uncertain : UncertainPlant
        From `plant.uncertain(fit, neglected=larger)`, continuous or sampled.
    w, z : mapping {name: weight}, or sequence of str
        Weights of performance, as for `StandardPlant.weighted`, those of `stage_weights` too:
        None leaves a channel out, as does not naming it.
    method : Riccati or Lmi, optional
        As for `design_hinf`.
    iterations : int
        Most steps.
    order : int
        Most states of D for each Delta and side.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    Controller
        `gamma` is mu of robust performance from above: below 1 all machines are stable with
        weighted gains below 1. The certificate holds mu of every step.

    Raises
    ------
    AssumptionError, SolverError, InfeasibleError, CertificateError
        When no step gives a controller; see `design_hinf`.
    ModelError, LabelError
        When `uncertain` is no uncertain plant, or channels are missing or unknown.

    Warns
    -----
    FlexplantWarning
        When the modes left out make the loop unstable, or bring |S| at u above 8 dB; it names them.

    References
    ----------
    [Doyle1986]_; [ZhouDoyleGlover1996]_, section 11.4.
    """
    if not w or not z:
        raise ModelError("name the channels of performance: w={'d': 1.0}, z={'tip:x': weight}.")
    require_uncertain(uncertain)
    most = whole(iterations, "iterations")
    states = whole(order, "order", minimum=0)
    if uncertain.neglected is None and all(one.kind == "freq" for one in uncertain.deltas):
        answer = by_mode_channels(uncertain, w, z, most, method, progress)
        if answer is not None:
            return with_left_out(answer, uncertain.plant, larger)
    plant = open_plant(uncertain, w=w, z=z)
    scales = _DFilters.none(plant)
    best: _DkStep | None = None
    found: list[float] = []
    failure: FlexplantError | None = None
    with Progress(most + 1, "steps of D-K", progress=progress) as bar:
        for number in range(most + 1):
            bar.advance(int(number > 0))
            try:
                K = _scaled_controller(plant, scales, method, nominal=not number)
                step = _robust_step(uncertain, K, w, z)
            except FlexplantError as error:
                failure = error
                if number or not isinstance(error, AssumptionError | SolverError):
                    break
                scales = _DFilters.none(plant)
                continue
            found.append(step.mu)
            settled = best is not None and number > 1 and step.mu > (1.0 - _SETTLED) * best.mu
            if best is None or step.mu < best.mu:
                best = step
            if settled:
                break
            scales = _scales_of(plant, step.loop, states)
    if best is None:
        raise failure or SolverError("no step of the D-K iteration gave a controller. Report it.")
    steps = {f"mu of step {i}": value for i, value in enumerate(found)}
    answer = Controller(
        best.controller,
        f"D-K iteration, {counted(len(found), 'step')}",
        gamma=best.mu,
        certificate={"mu": best.mu, "at Hz": best.freq} | steps,
    )
    return with_left_out(answer, uncertain.plant, larger)


class _DFilters(NamedTuple):
    """Filters on each output and each input of the uncertainty's channels."""

    out: tuple[StateSpace, ...]
    into: tuple[StateSpace, ...]

    @classmethod
    def none(cls, plant: OpenPlant) -> _DFilters:
        """Return ones, and the weights of neglected modes by few states."""
        n = sum(block.z for block in plant.blocks)
        m = sum(block.w for block in plant.blocks)
        omega = _fit_grid(plant.system)
        tall = np.array([plant.heights(one, one) for one in omega])[:, :m]
        return cls(
            tuple(StateSpace([], [], [], [[1.0]]) for _ in range(n)),
            tuple(fitted_magnitude(omega, column, 2) for column in tall.T),
        )


def _fit_grid(g: StateSpace) -> FloatArray:
    """Return frequencies [rad/s] over which D is fitted."""
    grid = resonance_grid(g.poles(), 0.0, points=200)
    return 2 * np.pi * np.geomspace(grid[0], grid[-1], _POINTS)


def _scaled_controller(
    plant: OpenPlant, scales: _DFilters, method: SynthesisMethod | None, *, nominal: bool
) -> StateSpace:
    """Return the H-infinity controller of the scaled plant, sampled like the plant."""
    g, n, m = plant.system, len(scales.out), len(scales.into)
    if nominal:
        scaled = g.select(g.outputs[n:], g.inputs[m:])
    else:
        ones = [StateSpace([], [], [], [[1.0]])]
        into = [*scales.into, *ones * (len(g.inputs) - m)]
        out = [*scales.out, *ones * (len(g.outputs) - n)]
        scaled = series(series(side_by_side(into, g.inputs), g), side_by_side(out, g.outputs))
    standard = StandardPlant.from_statespace(scaled, u=plant.u, y=plant.y)
    K = design_hinf(standard, method).system
    return tustin(K, 1.0 / plant.dt) if plant.dt else K


def _robust_step(uncertain: UncertainPlant[Any], K: StateSpace, w: Any, z: Any) -> _DkStep:
    """Return mu of robust performance of a controller, real Deltas real."""
    loop = uncertain_loop(uncertain, [K], w=w, z=z)
    blocks = [*loop.blocks, loop.performance]
    found = covered(loop.system, blocks, heights=loop.heights, accuracy=0.02)
    return _DkStep(float(np.sqrt(found.level)), K, loop, loop.freq(found.omega))


def _scales_of(plant: OpenPlant, loop: UncertainLoop, order: int) -> _DFilters:
    """Return D of a loop as filters: one for each block, its Delta taken as complex."""
    blocks = [FullBlock(block.w, block.z) for block in (*loop.blocks, loop.performance)]
    scalings, where = Scalings(blocks), block_places(blocks)
    omega = _fit_grid(loop.system)
    rows = []
    for one in omega:
        M = loop.system.evaluated(1j * one) * loop.heights(one, one)
        if not np.any(M):
            rows.append(np.ones(len(blocks)))
            continue
        start = scalings.scaled(scalings.start, osborne(M, where))
        x = upper_level(M, scalings, start).x
        rows.append(np.sqrt(scalings.stacks(x)[0][:, 0, 0].real))  # all are numbers
    d = np.array(rows)
    d = d / d[:, -1:]  # performance is not scaled
    tall = np.array([plant.heights(one, one) for one in omega])
    out, into, column = [], [], 0
    for i, block in enumerate(loop.blocks):
        one = fitted_magnitude(omega, d[:, i], order)
        out += [one] * block.z
        for _ in range(block.w):
            weight = tall[:, column]
            flat = np.ptp(weight) < ROUNDING * weight.max()
            into.append(
                inverse(one) if flat else fitted_magnitude(omega, weight / d[:, i], order + 1)
            )
            column += 1
    return _DFilters(tuple(out), tuple(into))


#: mean error of the logarithm with which a fit of fewer states is taken
_CLOSE = 0.05


def fitted_magnitude(omega: FloatArray, size: FloatArray, order: int) -> StateSpace:
    """Return ``k prod (s + a_i) / (s + b_i)`` near a magnitude, of at most some order.

    Least squares of the logarithm; the fewest factors that come close.
    """
    from scipy.optimize import least_squares  # not loaded with the package

    # a fit of logarithms: zeros would count without limit
    goal = np.log(np.maximum(size, 1e-12 * size.max()))
    at = np.log(omega)
    found = StateSpace([], [], [], [[float(np.exp(goal.mean()))]])
    if np.std(goal) < _CLOSE:
        return found
    for count in range(1, order + 1):
        corners = np.interp(np.linspace(0, 1, 2 * count + 2)[1:-1], np.linspace(0, 1, at.size), at)

        def error(q: FloatArray, n: int = count) -> FloatArray:
            a, b = np.exp(2 * q[1 : n + 1]), np.exp(2 * q[n + 1 :])
            square = omega[:, None] ** 2
            ratio = 0.5 * (np.log(square + a) - np.log(square + b)).sum(axis=1)
            return np.asarray(q[0] + ratio - goal)

        start = np.concatenate([[goal.mean()], corners[::2], corners[1::2]])
        best = least_squares(error, start, max_nfev=200)
        a, b = np.exp(best.x[1 : count + 1]), np.exp(best.x[count + 1 :])
        found = _scaled_series(float(np.exp(best.x[0])), a, b)
        if np.std(best.fun) < _CLOSE:
            break
    return found


def inverse(g: StateSpace) -> StateSpace:
    """Return the inverse of a filter of one input and output with feedthrough."""
    d = 1.0 / g.D[0, 0]
    return g.replace(A=g.A - d * g.B @ g.C, B=d * g.B, C=-d * g.C, D=[[d]])


def _scaled_series(k: float, a: FloatArray, b: FloatArray) -> StateSpace:
    """Return the factors in series, the gain in the last."""
    g = StateSpace([], [], [], [[k]])
    for zero, pole in zip(a, b, strict=True):
        root = np.sqrt(abs(zero - pole)) or 1.0
        one = StateSpace([[-pole]], [[root]], [[(zero - pole) / root]], [[1.0]])
        g = one * g
    return g
