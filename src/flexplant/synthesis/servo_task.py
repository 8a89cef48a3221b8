"""The task of a servo, whatever its bandwidth: plant, POI, rigid-body motions and observer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from ..errors import AssumptionError, LabelError, ModelError, SolverError, counted
from ..loop import ClosedLoop
from ..loop.blocks import drives, joined
from ..lti.interconnection import loop_poles
from ..lti.joining import stacked
from ..lti.statespace import StateSpace
from ..plant import Poi, StandardPlant, larger_plant, standard_plant
from ..plant.rigid.rigid_motion import RigidModes
from ..values import FloatArray, positive, real_array
from .servo_axis import Axis, rigid_body, rigid_peak
from .servo_loop import (
    ServoLoop,
    decoupling,
    highest,
    observer_system,
    seeing,
    servo_loop,
)

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
    larger: StandardPlant | None

    @property
    def motions(self) -> RigidModes:
        """The plant's rigid-body motions, free or on springs."""
        return self.plant.rigid_motions

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.plant.dt

    def axis(self, bandwidth: float) -> Axis:
        """Return the controller of one axis, with the notches that were given."""
        rolloff = min(8.0 * bandwidth, 0.4 * self.rate) if self.rolloff is None else self.rolloff
        slow = 0.1 * bandwidth if self.integrator is None else self.integrator
        for name, freq in (("rolloff", rolloff), ("integrator", slow)):
            _below_nyquist(freq, name, self.rate)
        return Axis(bandwidth, float(rolloff), float(slow), self.notches or (), self.rate)

    @property
    def loop(self) -> ServoLoop:
        """Over frequency, with the modes left out where they are known."""
        return servo_loop(self.larger or self.plant, self.observer, self.poi, self.plant)

    def notched(self, axis: Axis) -> Axis:
        """Return the axis with notches where they serve, unless they were given."""
        return axis if self.notches is not None else self.loop.notched(axis, self.is_stable)

    @cached_property
    def controller(self) -> Callable[[Axis], StateSpace]:
        """The function of an axis that gives [ref, hats] -> u: errors, axes and decoupling."""
        T_u = decoupling(self.plant, self.poi)
        return cache(lambda axis: _joined(self.plant, self.poi, axis.system, T_u))

    def is_stable(self, axis: Axis) -> bool:
        """Return whether the loop is stable with the modes that the plant has."""
        return self.closed(axis).is_stable

    @cached_property
    def closed(self) -> Callable[[Axis], ClosedLoop]:
        """The function of an axis that gives the loop that will run."""
        plant, larger = self.plant, self.larger
        before = () if self.observer is None else (self.observer,)
        if not before:
            plant = seeing(plant, self.poi)
            larger = None if larger is None else seeing(larger, self.poi)

        def found(axis: Axis) -> ClosedLoop:
            blocks = (*before, self.controller(axis))
            controller = joined(plant, blocks, *drives(plant, blocks, ()))
            return ClosedLoop(plant, blocks, controller, larger=larger)

        return cache(found)

    @cached_property
    def _bodies(self) -> list[StateSpace]:
        """The motions of the rigid body, each as a system of its own."""
        free = np.unique(self.motions.freq)
        return [rigid_body(self.rate, self.plant.delay, float(f)) for f in free]

    def rigid_radius(self, axis: Axis) -> float:
        """Return the spectral radius of the worst axis of the rigid body.

        All axes have the same controller, so that the loop falls apart into those of the body's own
        motions, whatever the axes: free ones (0 Hz) and suspension modes.
        """
        radius = self._rigid_radius(axis)
        if not radius < 1.0:
            raise SolverError(
                f"the rigid-body loop at {axis.bandwidth:g} Hz is unstable (spectral radius "
                f"{radius:.6f}): rate {axis.rate:g} Hz and a delay of {self.plant.delay:g} samples "
                "leave too little phase. Lower the bandwidth or the delay, or raise the rate or "
                "the roll-off."
            )
        return radius

    def _rigid_radius(self, axis: Axis) -> float:
        poles = [loop_poles(body, axis.system) for body in self._bodies]
        return float(max(np.abs(of_body).max() for of_body in poles))

    def rigid_peak(self, axis: Axis) -> float:
        """Return max |S| of the worst axis of the rigid body, stable or not."""
        return max(rigid_peak(body, axis) for body in self._bodies)

    def largest(self, peak: float) -> float:
        """Return the largest bandwidth that holds a peak of |S| at u."""
        slowest = max(3.0 * float(np.abs(self.motions.freq).max()) * (1 + 1e-9), 2e-4 * self.rate)
        best: tuple[float, float, float] = (np.inf, np.nan, np.nan)

        def fine(loop: Any) -> bool:
            return bool(loop.is_stable and loop.modulus_margin >= 1.0 / peak)

        def holds(bandwidth: float) -> bool:
            nonlocal best
            axis = self.axis(bandwidth)
            if self._rigid_radius(axis) >= 1.0:
                return False
            axis = self.notched(axis)
            size, at = self.loop.peak(axis)
            if size < best[0] and self.is_stable(axis):
                best = size, at, bandwidth
            if size > peak:
                return False
            closed = self.closed(axis)
            # the larger loop, which costs most, only where the smaller one is fine
            return fine(closed) and (closed.left_out is None or fine(closed.left_out))

        trials = np.geomspace(0.19 * self.rate, slowest, _TRIALS)
        found = highest(trials.tolist(), holds)
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
    given: StandardPlant,
    poi: str | None,
    rolloff: float | None,
    integrator: float | None,
    notches: Sequence[float] | None,
    observer: Any,
    larger: Any,
) -> ServoTask:
    """Return the task of a servo; parameters as for `design_servo`."""
    plant = standard_plant(given)
    port = _poi(plant, poi)
    if not plant.dt:
        raise AssumptionError(
            "a servo is designed at its sampling rate: pass plant.discretized(rate, delay=...)."
        )
    centres = None if notches is None else real_array(notches, "notches", (None,)).tolist()
    for freq in centres or ():
        _below_nyquist(freq, "notch", 1.0 / plant.dt)
    return ServoTask(
        plant,
        port,
        rolloff,
        integrator,
        None if centres is None else tuple(centres),
        observer_system(observer, plant, port),
        larger_plant(plant, larger),
    )


def _below_nyquist(freq: float, name: str, rate: float) -> None:
    if positive(freq, name) >= 0.5 * rate:
        raise ModelError(
            f"{name} {freq:g} Hz is not below half the rate, {0.5 * rate:g} Hz: sampled, it would "
            "act at another frequency. Leave it out, lower it, or raise the rate."
        )


def _poi(plant: StandardPlant, name: str | None) -> Poi:
    if plant.is_weighted:
        raise ModelError(
            f"the plant is {plant.alteration}: a servo acts on physical channels. Use "
            "plant.unweighted."
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
            f"the plant has {counted(len(ports.z), 'POI')} ({names}): say which one the servo "
            f"moves, such as poi={ports.z[0].name!r}."
        )
    return ports.poi(name if name is not None else ports.z[0].name)


def _joined(plant: StandardPlant, poi: Poi, axis: StateSpace, T_u: FloatArray) -> StateSpace:
    """Return [ref, hats] -> u: ``T_u (I x c) E``, E the errors, c the controller of an axis."""
    reference = poi.derived(poi.axes[0], "ref")
    inputs = [reference] if reference in plant.y else []
    hats = [poi.derived(name, "hat") for name in poi.axes]
    errors = -np.eye(len(hats), len(hats) + len(inputs), len(inputs))
    errors[0, : len(inputs)] = 1.0
    A, B, C, D = (stacked([one] * len(hats)) for one in (axis.A, axis.B, axis.C, axis.D))
    return StateSpace(
        A,
        B @ errors,
        T_u @ C,
        T_u @ D @ errors,
        plant.dt,
        inputs=[*inputs, *hats],
        outputs=plant.u,
        states=[f"{name}|{state}" for name in hats for state in axis.states],
        name="servo",
        units=plant.units,
    )
