"""design_servo: a rigid-body decoupled PID with roll-off, on the estimated point of interest."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import AssumptionError, FlexplantWarning, LabelError, ModelError, SolverError
from ..loop import ClosedLoop, close_loop
from ..loop.spill_over import growing_modes
from ..lti.interconnection import append, lft, series
from ..lti.statespace import StateSpace, as_statespace
from ..plant import Poi, StandardPlant, larger_plant, standard_plant
from ..plant.rigid.rigid_motion import carried_of, require_weak, rigid_gain
from ..values import FloatArray, positive, real_array
from .controller import Controller
from .servo_axis import Axis, rigid_body, rigid_peak
from .servo_loop import (
    TARGET,
    ServoLoop,
    elastic,
    estimates,
    highest,
    observer_system,
    seeing,
    servo_loop,
)
from .spill_over import unchecked

#: bandwidths that `servo_bandwidth` tries from 0.19 of the rate down, before it halves intervals
_TRIALS = 80
#: steps of 1 % that it goes down from what the grid says
_STEPS = 30


def design_servo(
    plant: StandardPlant,
    *,
    bandwidth: float,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
    larger: Any = None,
) -> Controller:
    """Return a decoupled PID controller of the rigid-body motion at a POI.

    Each axis of the POI is a double integrator of the acceleration a commanded there;
    ``u = T_u a`` with T_u the least-force right inverse of the rigid-body gain. Each axis gets
    ``a = k (1 + w_i / s) (1 + 4 s / w_b) / (1 + s / (4 w_b)) F(s) (ref - hat)``, where F is a
    second-order roll-off and the notches, and k makes the open loop of the rigid body cross 1 at
    the bandwidth. On weak springs (`suspend`) it is the same controller, by the geometry of the
    rigid body: its motions are ``1 / (s^2 + w_s^2)`` then, w_s the suspension's frequencies.

    Then the loop that will run is certified: with the observer, the flexible modes and the delay,
    and on the plant with the modes left out where they are known. `servo_bandwidth` gives the
    largest bandwidth at which this loop holds 6 dB.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, with a POI whose axes span its rigid-body modes; free, or on springs that hold it
        at no more than a third of the bandwidth.
    bandwidth : float [Hz]
        Where the open loop of each axis crosses 1; below a fifth of the rate.
    poi : str, optional
        Which POI, when the plant has several.
    rolloff : float [Hz], optional
        Corner of the second-order low-pass, below half the rate; unless given 8 bandwidths, or 0.4
        of the rate where that is less.
    integrator : float [Hz], optional
        Corner of the integral action; a tenth of the bandwidth unless given.
    notches : sequence of float [Hz], optional
        Frequencies of resonances to notch, each below half the rate: a sampled controller has no
        notch above that, where the map would fold it to another frequency. Unless given they are
        placed at the plant's modes, one by one, while |S| at u is above 6 dB (or the loop
        unstable) and a notch lowers it; an empty sequence means none.
    observer : KalmanEstimator, StaticEstimator or StateSpace, optional
        What will give the estimates `die:hat`, ...; unless given, the POI itself.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`. Unless given, those
        that the plant's reduced model still knows.

    Returns
    -------
    Controller
        Inputs: the reference `die:ref` where there is one and the estimates `die:hat`,
        `die:rx:hat`, ...; outputs: the actuators. The certificate holds the spectral radius and the
        modulus margin of the sampled, delayed loop: of the rigid body alone, the worst of its
        motions (on springs, without their damping), of the plant with the observer, and of that
        with the modes left out; where |S| at u exceeds 6 dB, the largest bandwidth that holds it.

    Raises
    ------
    AssumptionError
        When the plant is continuous or held, its springs are too stiff for the bandwidth, or the
        axes or actuators do not span the rigid-body modes.
    LabelError
        When the POI is unknown, or the observer does not give its estimates.
    ModelError
        When the plant is weighted, a frequency is not positive or not below half the rate, or
        `larger` does not go with the plant.
    SolverError
        When the rigid-body loop is unstable (the bandwidth is too high for rate and delay), or the
        loop with the observer is; the message names the modes and the largest bandwidth.

    Warns
    -----
    FlexplantWarning
        When the loop on the POI itself is unstable, or the modes left out make the loop unstable.
    """
    plant, port = _stage(plant, poi)
    rate = 1.0 / plant.dt
    if positive(bandwidth, "bandwidth") >= 0.2 * rate:
        raise ModelError(
            f"bandwidth {bandwidth:g} Hz is not well below the rate, {rate:g} Hz: the lead needs "
            f"room above it. Stay below {0.2 * rate:g} Hz, or raise the rate."
        )
    motions = carried_of(plant)
    require_weak(motions, bandwidth, "a servo")
    task = _task(plant, port, rolloff, integrator, notches, observer, larger)
    axis = task.axis(float(bandwidth))
    certificate = _certified(axis, task.plant.delay, np.unique(motions.freq))
    plain = axis
    if notches is None:
        axis = task.loop.notched(axis, task.is_stable)
    if axis is not plain:
        certificate = _certified(axis, task.plant.delay, np.unique(motions.freq))
    system = task.controller(axis)
    closed = task.closed(system)
    certificate["spectral radius"] = closed.spectral_radius
    certificate["modulus margin"] = closed.modulus_margin
    left_out = closed.left_out
    if left_out is not None:
        certificate |= left_out.certificate
    worst = min(certificate[key] for key in certificate if key.startswith("modulus margin"))
    advice = ""
    if worst < 1.0 / TARGET:
        try:
            reach = task.largest(TARGET)
        except SolverError as none:
            advice = str(none)
        else:
            certificate["largest bandwidth at 6 dB [Hz]"] = reach
            advice = f"The largest bandwidth that holds 6 dB there is {reach:.3g} Hz."
    if not closed.is_stable:
        _refuse(closed, float(bandwidth), observer is not None, advice)
    elif left_out is not None and not left_out.is_stable:
        warnings.warn(
            f"with the modes that the plant left out the servo's loop at {bandwidth:g} Hz is "
            f"{left_out.summary}. The machine has these modes. {advice}",
            FlexplantWarning,
            stacklevel=2,
        )
    return Controller(
        system,
        f"servo {bandwidth:g} Hz on {task.poi.name!r}",
        certificate=certificate,
        left_out=left_out,
        notes=_notes(task, axis, left_out is not None),
    )


def servo_bandwidth(
    plant: StandardPlant,
    *,
    peak: float = TARGET,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
    larger: Any = None,
) -> float:
    """Return the largest bandwidth [Hz] at which `design_servo` keeps |S| at u below a peak.

    Plant and observer are swept once over a grid through their resonances; each bandwidth then
    costs the closed form of the axis and small inverses, all frequencies at once. What is found is
    stable by its eigenvalues and holds the peak by `modulus_margin`, with the modes left out too
    where they are known. Bandwidths are tried in steps of 9 %, from the top down, then between the
    first that holds and the one above it.

    Parameters
    ----------
    plant, poi, rolloff, integrator, notches, observer, larger
        As for `design_servo`.
    peak : float
        Bound on the largest singular value of S at u; 2 is 6 dB.

    Returns
    -------
    float [Hz]

    Raises
    ------
    AssumptionError, LabelError, ModelError
        As `design_servo`; ModelError when peak is not above 1.
    SolverError
        When no bandwidth holds it.
    """
    if positive(peak, "peak") <= 1.0:
        raise ModelError(f"peak must be above 1, got {peak:g}: no loop keeps |S| below 1. Try 2.")
    plant, port = _stage(plant, poi)
    task = _task(plant, port, rolloff, integrator, notches, observer, larger)
    return task.largest(float(peak))


@dataclass(frozen=True)
class _Task:
    """What does not depend on the bandwidth."""

    plant: StandardPlant
    poi: Poi
    decoupling: FloatArray
    rolloff: float | None
    integrator: float | None
    notches: tuple[float, ...] | None
    observer: StateSpace | None
    larger: StandardPlant | None

    @property
    def rate(self) -> float:
        return 1.0 / self.plant.dt

    def axis(self, bandwidth: float) -> Axis:
        rolloff = min(8.0 * bandwidth, 0.4 * self.rate) if self.rolloff is None else self.rolloff
        slow = 0.1 * bandwidth if self.integrator is None else self.integrator
        for name, freq in (("rolloff", rolloff), ("integrator", slow)):
            _below_nyquist(freq, name, self.rate)
        return Axis(bandwidth, float(rolloff), float(slow), self.notches or (), self.rate)

    @cached_property
    def loop(self) -> ServoLoop:
        """Over frequency, with the modes left out where they are known."""
        found = servo_loop(self.larger or self.plant, self.observer, self.poi, self.decoupling)
        return found if self.larger is None else replace(found, modes=elastic(self.plant))

    @cached_property
    def _estimates(self) -> StateSpace:
        return estimates(self.plant, self.observer, self.poi)

    def is_stable(self, axis: Axis) -> bool:
        system = self.controller(axis)
        hats = self._estimates.outputs
        return lft(self._estimates, system.select(inputs=hats)).is_stable

    def controller(self, axis: Axis) -> StateSpace:
        return _joined(self.plant, self.poi, axis.system, self.decoupling)

    def closed(self, system: StateSpace) -> ClosedLoop:
        """Return the loop that will run, without a warning of its own."""
        plant, larger, blocks = self.plant, self.larger, [system]
        if self.observer is None:
            plant = seeing(plant, self.poi)
            larger = None if larger is None else seeing(larger, self.poi)
        else:
            blocks = [self.observer, system]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FlexplantWarning)
            return close_loop(plant, *blocks, larger=larger)

    def largest(self, peak: float) -> float:
        """Return the largest bandwidth that holds a peak of |S| at u.

        Raises
        ------
        SolverError
            When none does.
        """
        motions = carried_of(self.plant)
        springs = np.unique(motions.freq)
        bodies = [rigid_body(self.rate, self.plant.delay, float(f)) for f in springs]
        slowest = max(3.0 * float(springs.max()) * (1 + 1e-9), 2e-4 * self.rate)

        def notched(bandwidth: float) -> Axis:
            axis = self.axis(bandwidth)
            return axis if self.notches is not None else self.loop.notched(axis, self.is_stable)

        def holds(bandwidth: float) -> bool:
            if max(rigid_peak(body, self.axis(bandwidth)) for body in bodies) > peak:
                return False
            axis = notched(bandwidth)
            return self.loop.peak(axis) <= peak and self.is_stable(axis)

        def verified(bandwidth: float) -> bool:
            closed = self.closed(self.controller(notched(bandwidth)))
            checks = [(closed.is_stable, closed.modulus_margin)]
            if closed.left_out is not None:
                checks.append((closed.left_out.is_stable, closed.left_out.modulus_margin))
            return all(stable and margin >= 1.0 / peak for stable, margin in checks)

        trials = np.geomspace(0.19 * self.rate, slowest, _TRIALS)
        found = highest(trials.tolist(), holds)
        # the grid may miss the very top of a peak: a step down, by the exact margins
        steps = () if found is None else found * 0.99 ** np.arange(_STEPS)
        for reached in map(float, steps):
            if verified(reached):
                return reached
        raise SolverError(
            f"no bandwidth above {slowest:.3g} Hz holds |S| at u below "
            f"{20 * np.log10(peak):.2g} dB: rate, delay, observer and modes leave too little "
            "phase. Raise the rate, lower the delay, or move sensors and actuators."
        )


def _stage(given: StandardPlant, poi: str | None) -> tuple[StandardPlant, Poi]:
    """Return a sampled plant and the POI that the servo moves."""
    plant = standard_plant(given)
    port = _poi(plant, poi)
    if not plant.dt:
        raise AssumptionError(
            "a servo is designed at its sampling rate: pass plant.discretized(rate, delay=...)."
        )
    return plant, port


def _task(
    plant: StandardPlant,
    port: Poi,
    rolloff: float | None,
    integrator: float | None,
    notches: Sequence[float] | None,
    observer: Any,
    larger: Any,
) -> _Task:
    centres = None if notches is None else real_array(notches, "notches", (None,)).tolist()
    for freq in centres or ():
        _below_nyquist(freq, "notch", 1.0 / plant.dt)
    motions = carried_of(plant)
    return _Task(
        plant,
        port,
        _decoupling(plant, port, motions.modes.size),
        rolloff,
        integrator,
        None if centres is None else tuple(centres),
        observer_system(observer, plant, port),
        larger_plant(plant, larger),
    )


def _refuse(closed: ClosedLoop, bandwidth: float, observed: bool, advice: str) -> None:
    """Raise SolverError for the loop that will run, warn of a loop on the POI itself."""
    modes, freq = growing_modes(closed.monitored, closed.plant.system.states)
    named = ", ".join(f"mode {n} ({f:.4g} Hz)" for n, f in zip(modes, freq, strict=True))
    what = "with its observer" if observed else "on the POI itself"
    text = (
        f"the servo's loop at {bandwidth:g} Hz {what} is unstable (spectral radius "
        f"{closed.spectral_radius:.6f}; takes part most: {named or 'no mode'}). {advice} "
        "Lower the bandwidth or the delay, or raise the rate."
    )
    if observed:
        raise SolverError(text)
    warnings.warn(
        f"{text} Pass observer= to check the loop that will run.", FlexplantWarning, stacklevel=3
    )


def _notes(task: _Task, axis: Axis, checked: bool) -> tuple[str, ...]:
    notes = []
    if axis.notches:
        notes.append(f"notches at {', '.join(f'{f:.4g}' for f in axis.notches)} Hz")
    if task.observer is None:
        notes.append("certified on the POI itself: observer= certifies the loop that will run")
    return (*notes, *(() if checked else unchecked(task.plant)))


def _below_nyquist(freq: float, name: str, rate: float) -> None:
    if positive(freq, name) >= 0.5 * rate:
        raise ModelError(
            f"{name} {freq:g} Hz is not below half the rate, {0.5 * rate:g} Hz: sampled, it would "
            "act at another frequency. Leave it out, lower it, or raise the rate."
        )


def _poi(plant: StandardPlant, name: str | None) -> Poi:
    if plant.is_weighted:
        raise ModelError(
            "the plant is weighted: a servo acts on physical channels. Use plant.unweighted."
        )
    ports = plant.assembled.ports
    if not ports.z:
        raise AssumptionError(
            "a servo needs a plant with a POI, assembled from a structure: "
            "assemble_plant(model, ports)."
        )
    if name is None and len(ports.z) > 1:
        names = ", ".join(poi.name for poi in ports.z)
        raise LabelError(
            f"the plant has {len(ports.z)} POIs ({names}): say which one the servo moves, "
            f"such as poi={ports.z[0].name!r}."
        )
    return ports.poi(name if name is not None else ports.z[0].name)


def _decoupling(plant: StandardPlant, poi: Poi, r: int) -> FloatArray:
    """Return T_u: accelerations of the POI's axes to actuator forces, of least norm."""
    continuous = plant.continuous
    continuous.check().require(("stabilisable",), "a servo of the rigid body")
    gain = rigid_gain(plant, [poi.channel(axis) for axis in poi.axes], list(plant.u))
    size = np.linalg.norm(gain, axis=1, keepdims=True)
    if len(poi.axes) != r or np.linalg.matrix_rank(gain / np.where(size > 0, size, 1.0)) < r:
        raise AssumptionError(
            f"POI {poi.name!r} has axes {poi.axes}, the plant {r} rigid-body modes: the servo "
            "needs axes that span them, one each (for a plate z, rx, ry). Give the POI these axes."
        )
    return np.asarray(np.linalg.pinv(gain))


def _certified(axis: Axis, delay: float, suspensions: FloatArray) -> dict[str, float]:
    """Return radius and margin of the worst axis of the rigid body.

    All axes have the same controller, so that the loop falls apart into those of the body's own
    motions, whatever the axes: free ones (0 Hz) and suspension modes.
    """
    bodies = [rigid_body(axis.rate, delay, float(freq)) for freq in suspensions]
    radius = max(float(np.max(np.abs(lft(body, axis.system).poles()))) for body in bodies)
    if not radius < 1.0:
        raise SolverError(
            f"the rigid-body loop at {axis.bandwidth:g} Hz is unstable (spectral radius "
            f"{radius:.6f}): rate {axis.rate:g} Hz and a delay of {delay:g} samples leave too "
            "little phase. Lower the bandwidth or the delay, or raise the rate or the roll-off."
        )
    margin = 1.0 / max(rigid_peak(body, axis) for body in bodies)
    return {"rigid-body spectral radius": radius, "rigid-body modulus margin": margin}


def _joined(plant: StandardPlant, poi: Poi, axis: StateSpace, decoupling: FloatArray) -> StateSpace:
    """Return [ref, hats] -> u: errors, one controller an axis, decoupling."""
    first = poi.axes[0]
    reference = poi.derived(first, "ref")
    inputs = [reference] if reference in plant.y else []
    hats = [poi.derived(name, "hat") for name in poi.axes]
    errors = -np.eye(len(hats), len(hats) + len(inputs), len(inputs))
    errors[0, : len(inputs)] = 1.0
    comparison = as_statespace(errors).replace(
        dt=plant.dt, inputs=[*inputs, *hats], outputs=[f"{name}:e" for name in hats]
    )
    bank = append(
        *(
            axis.replace(
                inputs=[f"{name}:e"],
                outputs=[f"{name}:a"],
                states=[f"{name}|{state}" for state in axis.states],
            )
            for name in hats
        )
    )
    forces = as_statespace(decoupling).replace(dt=plant.dt, inputs=bank.outputs, outputs=plant.u)
    return series(series(comparison, bank), forces).replace(name="servo", blocks=None)
