"""worst_case_gain: the largest gain of a loop over an uncertainty, and the machine that has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...checks import ComplexArray, FloatArray, Value, generator
from ...errors import AssumptionError, CertificateError, ModelError
from ...lti.frequency import frequency_response
from ...lti.norms import peak_gain
from ...lti.statespace import StateSpace
from ...parallel import Progress, one_thread
from ...plant import StandardPlant
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from .lower import power_iteration
from .sweep import INTERVALS, Covered, covered
from .uncertain_loop import UncertainLoop, machine_at, neglected_delta, uncertain_loop, values_of
from .uncertainty_blocks import Perturbation, block_places, matrix_of

#: frequencies that start a search, starts at each, rounds over all real Deltas
_SOUGHT, _STARTS, _ROUNDS = 5, 3, 3
#: frequencies around the worst one at which gains are compared
_BAND = np.concatenate([[0.0], np.geomspace(1e-4, 0.3, 20), -np.geomspace(1e-4, 0.3, 20)])


@dataclass(frozen=True, eq=False, repr=False)
class WorstCaseGain(Value):
    """The largest gain from w to z over all machines of an uncertainty.

    Parameters
    ----------
    upper : float
        No machine of the uncertainty has a larger gain at any frequency.
    lower : float
        The gain of `machine`, its norm computed from its own closed loop.
    nominal : float
        The gain without uncertainty.
    freq : float [Hz]
        Where `machine` has it.
    values : mapping {str: float}
        The Deltas of that machine.
    machine : StandardPlant
        It can be simulated.
    frequencies, bounds : (k,) arrays [Hz, gain]
        Upper bounds at single frequencies.
    """

    upper: float
    lower: float
    nominal: float
    freq: float
    values: Mapping[str, float]
    machine: StandardPlant
    frequencies: FloatArray
    bounds: FloatArray

    def __repr__(self) -> str:
        most = sorted(self.values.items(), key=lambda one: -abs(one[1]))[:4]
        shown = ", ".join(f"{name} {value:+.3g}" for name, value in most)
        return (
            f"<WorstCaseGain: {self.lower:.4g} to {self.upper:.4g}, nominal {self.nominal:.4g}\n"
            f"  reached at {self.freq:.5g} Hz by {shown}>"
        )


@one_thread()
def worst_case_gain(
    uncertain: UncertainPlant[Any],
    *blocks: Any,
    w: Any,
    z: Any,
    rng: Any = 0,
    progress: bool | None = None,
) -> WorstCaseGain:
    """Return bounds on the largest gain from w to z over an uncertainty, and the worst machine.

    From above by skewed mu: ``|Delta| <= 1`` is kept and the size of the performance block grows,
    on intervals that cover all frequencies. From below by the machine that a search found, closed
    exactly, sampled and delayed as the plant is.

    Parameters
    ----------
    uncertain, *blocks
        As for `robust_stability`.
    w, z : sequence of str, or mapping {name: weight}
        Channels of the gain; weights are numbers or systems of one input and output.
    rng : int, SeedSequence, Generator or None
        Of the search.
    progress : bool, optional
        As for `robust_stability`.

    Returns
    -------
    WorstCaseGain

    Raises
    ------
    AssumptionError
        When the nominal loop is not stable, or machines of the uncertainty may be unstable.
    CertificateError
        When the machine found has a larger gain than was proven possible.
    ModelError, LabelError
        When `uncertain` is no uncertain plant, or channels are missing or unknown.
    SolverError
        When intervals do not cover the frequency axis.

    References
    ----------
    [FanTits1992]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5])
    >>> modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.02))
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x"]))
    >>> spread = [[1.0, 0.0], [0.0, 4.0]]
    >>> measured = fx.MeasuredModes(poles=[-17 + 890j], modes=[2], covariance=spread)
    >>> fit = fx.update(drawing, [fx.AddedMass("2:x")], [fx.Eigenvalues(measured)])
    >>> ports = fx.Ports(
    ...     w=[fx.Disturbance("d", "1:x", "x", asd=1e-3)],
    ...     u=[fx.Actuator("u1", "1:x", "x")],
    ...     z=[fx.Poi("tip", "2:x", ("x",))],
    ...     y=[fx.Sensor("y1", "1:x", "x", asd=1e-9)],
    ... )
    >>> plant = fx.assemble_plant(fit.model, ports)
    >>> lead = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    >>> uncertain = plant.uncertain(fit)
    >>> found = fx.synthesis.worst_case_gain(uncertain, lead, w=["d"], z=["tip:x"])
    >>> found.nominal <= found.lower <= found.upper
    True
    """
    chance = generator(rng)
    if not w or not z:
        raise ModelError(
            "a gain is from some w to some z: name them, w=['die:ref'], z=['die:error']."
        )
    loop = uncertain_loop(uncertain, blocks, w=w, z=z)
    listed = [*loop.blocks, loop.performance]
    inside = np.zeros(len(listed), dtype=bool)
    inside[-1] = True
    nominal, _ = peak_gain(_performance(loop, loop.uncertain.plant))
    size = nominal or 1.0
    M = _in_units(loop.system, size, loop.performance.z)
    with Progress(None, INTERVALS, progress=progress):
        found = covered(M, listed, inside.tolist(), loop.heights)
    if not np.isfinite(found.level):
        raise AssumptionError(
            "machines of the uncertainty may be unstable (at "
            f"{loop.freq(float(found.frequencies[np.argmax(found.bounds)])):.5g} Hz), so that the "
            "largest gain is infinite. See synthesis.robust_stability(uncertain, ...): lower "
            "the bandwidth, "
            "notch the mode there, or measure it better."
        )
    upper = size * float(np.sqrt(found.level))
    candidates = _candidates(loop, M, listed, found, chance)
    reached = [_machine_gain(loop, one) for one in candidates]
    lower, freq, values, made = max(reached, key=lambda one: one[0])
    if not lower <= upper * (1.0 + 1e-2):
        raise CertificateError(
            f"a machine of the uncertainty has the gain {lower:.6g}, {upper:.6g} was proven as "
            "largest: the loop is too badly conditioned. Report it."
        )
    return WorstCaseGain(
        max(upper, lower),
        lower,
        nominal,
        freq,
        values,
        made,
        np.array([loop.freq(one) for one in found.frequencies]),
        size * np.sqrt(np.maximum(found.bounds, 0.0)),
    )


def _in_units(M: StateSpace, size: float, p: int) -> StateSpace:
    """Return the system with its last p outputs in units of a size: the level sought is near 1.

    A level of 1e-18, of 1e-9 m/N, is below what is resolved beside Deltas of size one.
    """
    unit = np.ones((len(M.outputs), 1))
    unit[len(unit) - p :] = 1.0 / size
    return M.replace(C=unit * M.C, D=unit * M.D)


def _machine_gain(
    loop: UncertainLoop, one: Perturbation
) -> tuple[float, float, dict[str, float], StandardPlant]:
    """Return the gain of the machine of a perturbation, where it is, its Deltas, and itself."""
    values = values_of(loop, one, 1.0)
    made = machine_at(loop, values, neglected_delta(loop, one, 1.0))
    closed = _performance(loop, made)
    if not loop.neglected_w:
        gain, freq = peak_gain(closed)
        return gain, freq, values, made
    # its weights have many states: the gain at frequencies around the worst
    omega = np.unique(np.abs(one.omega * (1.0 + _BAND)))
    freqs = np.unique([loop.freq(float(each)) for each in omega])
    gains = np.linalg.norm(np.moveaxis(frequency_response(closed, freqs).data, 2, 0), 2, (1, 2))
    where = int(np.argmax(gains))
    return float(gains[where]), float(freqs[where]), values, made


def _performance(loop: UncertainLoop, plant: StandardPlant) -> StateSpace:
    """Return the weighted w -> z of the loop around a machine, sampled as it is."""
    p, m = loop.performance.z, loop.performance.w
    closed = loop.around(plant).system
    return loop.with_weights(closed.select(loop.system.outputs[-p:], loop.system.inputs[-m:]))


def _candidates(
    loop: UncertainLoop,
    M: StateSpace,
    listed: list[Any],
    found: Covered,
    rng: np.random.Generator,
) -> list[Perturbation]:
    """Return perturbations of size one that are bad at some frequency, the worst first."""
    where = block_places(listed)
    chosen = [float(found.omega)]
    for omega in found.frequencies[np.argsort(-found.bounds)]:
        if len(chosen) < _SOUGHT and all(abs(omega - one) > 1e-2 * one for one in chosen):
            chosen.append(float(omega))
    results: list[tuple[float, Perturbation]] = []
    for omega in chosen:
        band = np.abs(omega * (1.0 + _BAND))
        tall = loop.heights(omega, omega)
        gains = np.array([M.evaluated(1j * one) * tall for one in band])
        skewed = gains[0].copy()
        skewed[where[-1].z] /= np.sqrt(found.level)
        for _ in range(_STARTS):
            one = power_iteration(skewed, where, rng, omega)
            results.append(_corner_gain(gains, where, one))
    results.sort(key=lambda pair: -pair[0])
    return [one for _, one in results[:2]]


def _corner_gain(
    gains: ComplexArray, where: list[Any], one: Perturbation
) -> tuple[float, Perturbation]:
    """Return the largest gain in a band, real Deltas moved one after the other to an end or 0."""
    one = one._replace(vectors=one.vectors[:-1])
    best = _perturbed_gain(gains, where, one)
    for _ in range(_ROUNDS):
        before = best
        for i, number in enumerate(one.scalars):
            for value in (-1.0, 1.0, 0.0):
                if value == number:
                    continue
                scalars = (*one.scalars[:i], complex(value), *one.scalars[i + 1 :])
                moved = one._replace(scalars=scalars)
                gain = _perturbed_gain(gains, where, moved)
                if gain > best:
                    best, one = gain, moved
        if best <= before * (1.0 + 1e-4):
            break
    return best, one


def _perturbed_gain(gains: ComplexArray, where: list[Any], one: Perturbation) -> float:
    """Return the largest gain over a band of the loop with a perturbation."""
    performance = where[-1]
    delta = matrix_of(one, where[:-1])
    w, z = performance.w.start, performance.z.start
    inner = np.eye(z) - gains[:, :z, :w] @ delta
    through = gains[:, z:, :w] @ delta @ np.linalg.solve(inner, gains[:, :z, w:])
    return float(np.linalg.norm(gains[:, z:, w:] + through, 2, axis=(1, 2)).max())
