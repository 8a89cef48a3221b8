"""design_servo: a rigid-body decoupled PID with roll-off, on the estimated point of interest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from ...checks import below_half_rate, between, positive, real_array
from ...errors import AssumptionError, ModelError, SolverError, only_one, warn
from ...loop import ClosedLoop
from ...loop.blocks import drives, driving_blocks
from ...loop.other_machines import growing_modes, modes_in_words
from ...loop.sensitivity import taken_apart
from ...lti.interconnection import loop_poles
from ...lti.statespace import StateSpace
from ...parallel import one_thread
from ...plant import Poi, StandardPlant, standard_plant
from ...plant.partition import require_plain, require_sampled
from ...plant.rigid_motion import require_weak
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from ...tolerances import SAME
from ..controller import CLOSE, Controller, with_checks
from .loop_design import Axes, axes_controller, connected
from .servo_loop import (
    TARGET,
    Axis,
    ServoLoop,
    decoupling,
    highest_bandwidth,
    observer_system,
    rigid_body,
    seeing,
    servo_loop,
)


@one_thread()
def design_servo(
    plant: StandardPlant | UncertainPlant[Any],
    *,
    bandwidth: float,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
) -> Controller:
    """Return a decoupled PID controller of the rigid-body motion at a POI.

    Each axis of the POI is a double integrator of the acceleration a commanded there (on weak
    springs, `suspend`, ``1 / (s^2 + w_s^2)``); ``u = T_u a``, T_u the least-force right inverse of
    the rigid-body gain. Each axis gets
    ``a = k (1 + w_i / s) (1 + 4 s / w_b) / (1 + s / (4 w_b)) F(s) (ref - hat)``, F a second-order
    roll-off and the notches; with k the open loop of the rigid body crosses 1 at the bandwidth.

    Certified is the loop that will run: with observer, flexible modes and delay, and with the modes
    left out where they are known. `servo_bandwidth` gives the largest bandwidth that holds 6 dB.

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
        Frequencies of resonances to notch, each below half the rate. Unless given they are placed
        at the plant's modes, one by one, while |S| at u is above 6 dB (or the loop unstable) and a
        notch lowers it; an empty sequence means none.
    observer : KalmanEstimator, StaticEstimator or StateSpace, optional
        What will give the estimates `die:hat`, ...; unless given, the POI itself.

    Returns
    -------
    Controller
        From the reference `die:ref` where there is one and the estimates `die:hat`, `die:rx:hat`,
        ... to the actuators. The certificate holds spectral radius and modulus margin: of the worst
        motion of the rigid body alone (on springs, without their damping), of the plant with the
        observer, and with the modes left out; where |S| at u exceeds 6 dB, the largest bandwidth.

    Raises
    ------
    AssumptionError
        When the plant is continuous or held, its springs are too stiff for the bandwidth, or the
        axes or actuators do not span the rigid-body modes.
    LabelError
        When the POI is unknown, or the observer does not give its estimates.
    ModelError
        When the plant is weighted, or a frequency is not positive or not below half the rate.
    SolverError
        When the rigid-body loop is unstable (the bandwidth is too high for rate and delay), or the
        loop with the observer is; the message names the modes and the largest bandwidth.

    Warns
    -----
    FlexplantWarning
        When the loop on the POI itself is unstable, or the modes left out make it unstable or bring
        |S| at u above 8 dB.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.close_loop(plant, observer, servo).is_stable
    True
    """
    task = servo_task(plant, poi, rolloff, integrator, notches, observer)
    if positive(bandwidth, "bandwidth") >= 0.2 * task.rate:
        raise ModelError(
            f"bandwidth {bandwidth:g} Hz is not well below the rate, {task.rate:g} Hz: the lead "
            f"needs room above it. Stay below {0.2 * task.rate:g} Hz, or raise the rate."
        )
    require_weak(task.plant.rigid_motions, bandwidth, "a servo")
    axis = task.notched(task.axis(float(bandwidth)))
    radius = task.rigid_radius(axis)
    if not radius < 1.0:
        raise SolverError(
            f"the rigid-body loop at {bandwidth:g} Hz is unstable (spectral radius {radius:.6f}): "
            f"rate {task.rate:g} Hz and a delay of {task.plant.delay:g} samples leave too little "
            "phase. Lower the bandwidth or the delay, or raise the rate or the roll-off."
        )
    closed = task.closed(axis)
    certificate = {
        "rigid-body spectral radius": radius,
        "rigid-body modulus margin": 1.0 / task.rigid_peak(axis),
        "spectral radius": closed.spectral_radius,
        "modulus margin": closed.modulus_margin,
    }
    left_out, advice = closed.left_out, ""
    known = certificate | ({} if left_out is None else left_out.certificate)
    if min(known[key] for key in known if key.startswith("modulus margin")) < 1.0 / TARGET:
        try:
            reach = task.largest(TARGET)
        except SolverError as none:
            advice = str(none)
        else:
            certificate["largest bandwidth at 6 dB [Hz]"] = reach
            advice = f"The largest bandwidth that holds 6 dB there is {reach:.3g} Hz."
    if not closed.is_stable:
        _refuse(closed, float(bandwidth), observer is not None, advice)
    elif left_out is not None and not left_out.is_fine:
        warn(
            f"with the modes that the plant left out the servo's loop at {bandwidth:g} Hz is "
            f"{left_out.summary}. The machine has these modes{CLOSE if left_out.is_high else ''}. "
            f"{advice}"
        )
    if closed.tolerances is not None:
        closed.tolerances.warn_of_critical()
    notes = [f"notches at {', '.join(f'{f:.4g}' for f in axis.notches)} Hz"] if axis.notches else []
    if observer is None:
        notes.append("certified on the POI itself: observer= certifies the loop that will run")
    method = f"servo {bandwidth:g} Hz on {task.poi.name!r}"
    answer = Controller(task.controller(axis), method, certificate=certificate, notes=tuple(notes))
    return with_checks(answer, task.plant, closed)


@one_thread()
def servo_bandwidth(
    plant: StandardPlant,
    *,
    peak: float = TARGET,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
) -> float:
    """Return the largest bandwidth [Hz] at which `design_servo` keeps |S| at u below a peak.

    Plant and observer are swept once over a grid through their resonances. The loop is broken at
    the plant's input, as by `modulus_margin`: what the observer reads of u stays closed. What holds
    there is accepted when its eigenvalues are stable and `modulus_margin` holds the peak, with the
    modes left out too where they are known. Bandwidths are tried in steps of 9 %, from the top
    down, then between the first that holds and the one above it.

    Parameters
    ----------
    plant, poi, rolloff, integrator, notches, observer : as for `design_servo`
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
        When no bandwidth holds it; the message says what comes nearest, and what limits it.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.servo_bandwidth(plant, observer=fx.design_kalman(plant)) > 20.0
    True
    """
    peak = between(peak, "peak", 1.0, float("inf"), "No loop keeps |S| below 1: try 2.")
    task = servo_task(plant, poi, rolloff, integrator, notches, observer)
    return task.largest(float(peak))


def _refuse(closed: ClosedLoop, bandwidth: float, observed: bool, advice: str) -> None:
    """Raise SolverError for the loop that will run, warn of a loop on the POI itself."""
    modes = modes_in_words(*growing_modes(closed.monitored, closed.plant.system.states))
    what = "with its observer" if observed else "on the POI itself"
    text = (
        f"the servo's loop at {bandwidth:g} Hz {what} is unstable (spectral radius "
        f"{closed.spectral_radius:.6f}; takes part most: {modes}). {advice} "
        "Lower the bandwidth or the delay, or raise the rate."
    )
    if observed:
        raise SolverError(text)
    warn(f"{text} Pass observer= to check the loop that will run.")


#: bandwidths that `ServoTask.largest` tries from 0.19 of the rate down, before it halves intervals
_TRIALS = 80


@dataclass(frozen=True)
class ServoTask:
    """What does not depend on the bandwidth."""

    plant: StandardPlant
    poi: Poi
    rolloff: float | None
    integrator: float | None
    notches: tuple[float, ...] | None
    observer: StateSpace | None

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.plant.dt

    def axis(self, bandwidth: float) -> Axis:
        """Return the controller of one axis, with the notches that were given."""
        rolloff = min(8.0 * bandwidth, 0.4 * self.rate) if self.rolloff is None else self.rolloff
        slow = 0.1 * bandwidth if self.integrator is None else self.integrator
        for name, freq in (("rolloff", rolloff), ("integrator", slow)):
            below_half_rate(freq, name, self.rate)
        return Axis(bandwidth, float(rolloff), float(slow), self.notches or (), self.rate)

    @property
    def loop(self) -> ServoLoop:
        """Over frequency, with the modes left out where they are known."""
        return servo_loop(
            self.plant.evaluation_plant or self.plant, self.observer, self.poi, self.plant
        )

    def notched(self, axis: Axis) -> Axis:
        """Return the axis with notches where they serve, unless they were given."""
        if self.notches is not None:
            return axis
        return self.loop.notched(axis, lambda one: self.closed(one).is_stable)

    @cached_property
    def controller(self) -> Callable[[Axis], StateSpace]:
        """The function of an axis that gives [refs, hats] -> u: its law for each, decoupled."""
        hats = tuple(self.poi.derived(name, "hat") for name in self.poi.axes)
        refs = (self.poi.derived(name, "ref") for name in self.poi.axes)
        read = {hat: ref for hat, ref in zip(hats, refs, strict=True) if ref in self.plant.y}
        T_u = decoupling(self.plant, self.poi)
        before = StateSpace([], [], [], T_u, inputs=hats, outputs=self.plant.u)
        after = StateSpace([], [], [], np.eye(len(hats)), inputs=hats, outputs=hats)
        axes = Axes(None, before, after, self.rate)

        def found(axis: Axis) -> StateSpace:
            inner = axes_controller(axes, dict.fromkeys(hats, axis.law))
            system = connected(axes, inner, read).select(inputs=[*read.values(), *hats])
            return system.replace(name="servo", units=self.plant.units)

        return cache(found)

    @cached_property
    def closed(self) -> Callable[[Axis], ClosedLoop]:
        """The function of an axis that gives the loop that will run."""
        plant = self.plant
        before = () if self.observer is None else (self.observer,)
        if not before:
            plant = seeing(plant, self.poi)

        def found(axis: Axis) -> ClosedLoop:
            blocks = (*before, self.controller(axis))
            controller = driving_blocks(plant, blocks, *drives(plant, blocks, ()))
            return ClosedLoop(plant, blocks, controller)

        return cache(found)

    @cached_property
    def _bodies(self) -> list[StateSpace]:
        """The motions of the rigid body, each as a system of its own."""
        free = np.unique(self.plant.rigid_motions.freq)
        return [rigid_body(self.rate, self.plant.delay, float(f)) for f in free]

    def rigid_radius(self, axis: Axis) -> float:
        """Return the spectral radius of the worst axis of the rigid body."""
        # all axes have one controller: the loop falls apart into the body's own motions
        poles = [loop_poles(body, axis.law.system) for body in self._bodies]
        return float(max(np.abs(of_body).max() for of_body in poles))

    def rigid_peak(self, axis: Axis) -> float:
        """Return max |S| of the worst axis of the rigid body, stable or not."""
        act = axis.law.system
        loops = (
            taken_apart((one, act.replace(inputs=one.outputs, outputs=one.inputs)))
            for one in self._bodies
        )
        return max(loop.worst("u", False)[0] for loop in loops)

    def largest(self, peak: float) -> float:
        """Return the largest bandwidth that holds a peak of |S| at u."""
        slowest = max(
            # slower loops lose digits
            3.0 * float(np.abs(self.plant.rigid_motions.freq).max()) * (1 + SAME),
            2e-4 * self.rate,
        )
        best: tuple[float, float, float] = (np.inf, np.nan, np.nan)

        def fine(loop: Any) -> bool:
            return bool(loop.is_stable and loop.modulus_margin >= 1.0 / peak)

        def holds(bandwidth: float) -> bool:
            nonlocal best
            axis = self.axis(bandwidth)
            if self.rigid_radius(axis) >= 1.0:
                return False
            axis = self.notched(axis)
            size, at = self.loop.peak(axis)
            if size < best[0] and self.closed(axis).is_stable:
                best = size, at, bandwidth
            if size > peak:
                return False
            closed = self.closed(axis)
            # the loop on the evaluation model, which costs most, only where the smaller one is fine
            return fine(closed) and (closed.left_out is None or fine(closed.left_out))

        trials = np.geomspace(0.19 * self.rate, slowest, _TRIALS)
        found = highest_bandwidth(trials.tolist(), holds)
        if found is None:
            raise SolverError(
                f"no bandwidth from {slowest:.3g} to {trials[0]:.3g} Hz holds |S| at u below "
                f"{20 * np.log10(peak):.2g} dB{self._why(peak, *best)}"
            )
        return found

    def _why(self, peak: float, size: float, at: float, bandwidth: float) -> str:
        """Return what is nearest to holding a peak, what stops it and what to change, in words."""
        if not np.isfinite(size):
            return (
                ": none gives a stable loop. Check the observer's signs and units, or design it "
                "on this plant."
            )
        nearest = f"; the least is {20 * np.log10(size):.3g} dB, of {bandwidth:.3g} Hz, at {at:.4g}"
        if self.rigid_peak(self.axis(bandwidth)) > peak:
            return (
                f"{nearest} Hz. The rigid body by itself does not hold it there: raise the rate, "
                "lower the delay, or raise peak=."
            )
        return (
            f"{nearest} Hz. The rigid body by itself holds it there, so rate and delay do not "
            "limit it but what the flexible modes and the observer add at that frequency: place a "
            "notch there, change the observer's noise intensities, or raise peak=."
        )


def servo_task(
    given: StandardPlant | UncertainPlant[Any],
    poi: str | None,
    rolloff: float | None,
    integrator: float | None,
    notches: Sequence[float] | None,
    observer: Any,
) -> ServoTask:
    """Return the task of a servo; parameters as for `design_servo`."""
    plant = standard_plant(given)
    port = _poi(plant, poi)
    require_sampled(plant, "a servo is designed at its sampling rate")
    centres = None if notches is None else real_array(notches, "notches", (None,)).tolist()
    for freq in centres or ():
        below_half_rate(freq, "notch", 1.0 / plant.dt)
    return ServoTask(
        plant,
        port,
        rolloff,
        integrator,
        None if centres is None else tuple(centres),
        observer_system(observer, plant, port),
    )


def _poi(plant: StandardPlant, name: str | None) -> Poi:
    require_plain(plant, "a servo acts on physical channels")
    ports = plant.assembled.ports
    if not ports.z:
        raise AssumptionError(
            "a servo needs a plant with a POI, assembled from a structure: "
            "assemble_plant(model, ports)."
        )
    return ports.poi(only_one("POI", [poi.name for poi in ports.z], name, "poi="))
