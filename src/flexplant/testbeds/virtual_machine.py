"""WaferStage: a full-order truth with hidden differences, measured and run like hardware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, below_half_rate, generator, positive, whole
from ..errors import ModelError, require_known
from ..identification import MeasuredModes
from ..identification.periodic import frf_of_periods, line_spectra, multisine, offsets
from ..loop import ClosedLoop, ScheduledLoop, close_loop
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace
from ..plant import Disturbance, GroundSpring, Poi, Ports, StandardPlant, assemble_plant, suspend
from ..plant.realisation import ModalRealisation, realise
from ..reduction import ReducedModel
from ..simulation import Quantiser, Response, simulate
from ..store import Value
from ..structure import FEModel, ModalDamping, plate, solid_block
from ..synthesis import design_servo
from ..tolerances import SAME
from ..words import instance, several

#: the plate of the paper's Table 1, as its drawing says
DRAWING: Mapping[str, Any] = {
    "size": (0.6, 0.6),
    "thickness": 0.0272,
    "density": 2702.0,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.35,
}
#: Hz, of the servo that holds a stage on magnets while it is measured
HELD = 50.0


@dataclass(frozen=True, eq=False, repr=False)
class WaferStage(Value):
    """A machine that can be measured and run, but whose model is hidden.

    Parameters
    ----------
    truth : FEModel
        Model of the machine as it is, for tests and for judging results; a design must not read it.
    rate : float [Hz]
        Sampling rate of its controller.
    delay : float [samples]
        Delay from a measurement to the reaction of the actuators, including fractions.
    step : float [m]
        Step (resolution) of the sensors; 0 if they have no steps.
    drawing : mapping
        Size, thickness and material of its plate (or block) as drawn; by default the plate of Table
        1 of [paper]_.
    magnets : tuple of GroundSpring
        Magnets on which a block floats, as drawn; empty for a free plate or block.

    Examples
    --------
    >>> import flexplant as fx
    >>> machine = fx.testbeds.wafer_stage()
    >>> machine.rate, machine.delay
    (10000.0, 1.3)
    """

    truth: FEModel | ReducedModel
    rate: float
    delay: float
    step: float = 0.0
    drawing: Mapping[str, Any] = field(default_factory=lambda: dict(DRAWING))
    magnets: tuple[GroundSpring, ...] = ()

    def __repr__(self) -> str:
        late = f"{self.delay:g} sample" + ("" if self.delay == 1 else "s")
        return f"<WaferStage: rate {self.rate:g} Hz, delay {late}>"

    @cached_property
    def _realisation(self) -> ModalRealisation:
        return realise(self.truth)

    @cached_property
    def _own_poles(self) -> ComplexArray:
        """Poles of the elastic modes that swing, by frequency; coupled blocks have none."""
        found = self._realisation
        uncoupled = found.coupling is None
        poles = np.linalg.eigvals(found.pairs if uncoupled else found.A).reshape(-1)
        # double integrators come out of a dense A at the root of rounding, on circles around zero
        slowest = 1e-6 * float(np.abs(found.pairs[found.n_rigid :]).max(axis=(1, 2)).min())
        poles = poles[poles.imag > slowest]
        return np.asarray(poles[np.argsort(np.abs(poles))], dtype=np.complex128)

    @property
    def _n_rigid(self) -> int:
        """How many modes are motions of a rigid body, free or on magnets."""
        return 6 if self.magnets else self._realisation.n_rigid

    def _plant(self, ports: Ports) -> StandardPlant:
        return assemble_plant(self._realisation, ports).discretized(self.rate, delay=self.delay)

    def poles(
        self, modes: Sequence[int], *, deviation: float = 0.0, rng: Any = None
    ) -> MeasuredModes:
        """Return the poles of some modes, as an experimental modal analysis would.

        Parameters
        ----------
        modes : sequence of int
            Numbers of the modes, counted from 1, the rigid-body modes first. Elastic modes are
            sorted by frequency; overdamped ones are not counted.
        deviation : float
            Standard deviation of the errors of the poles, relative to their size. With 0 the poles
            are exact and the result has no covariance.
        rng : int or Generator, optional
            Random generator of the errors, or its seed.

        Raises
        ------
        LabelError
            When a mode does not exist, or is a rigid-body mode, which has no pole to measure.
        ModelError
            When a mode is not a whole number, or the deviation is negative. Also when a mode lies
            above half the machine's rate, where no sampled measurement shows it.
        """
        own = self._own_poles
        known = range(self._n_rigid + 1, self._n_rigid + own.size + 1)
        numbers = tuple(whole(mode, "mode") for mode in (modes if several(modes) else [modes]))
        require_known("elastic mode", numbers, known)
        exact = np.array([own[mode - 1 - self._n_rigid] for mode in numbers], dtype=np.complex128)
        for mode, pole in zip(numbers, exact, strict=True):
            below_half_rate(abs(pole) / (2.0 * np.pi), f"mode {mode}", self.rate)
        if not positive(deviation, "deviation", zero=True):
            return MeasuredModes(poles=exact, modes=numbers)
        size = deviation * np.abs(exact)
        error = generator(rng).normal(size=(2, exact.size)) * size / np.sqrt(2.0)
        return MeasuredModes(
            poles=exact + error[0] + 1j * error[1], modes=numbers, covariance=size**2
        )

    def loop(self, ports: Ports, *blocks: Any) -> ClosedLoop:
        """Return the closed loop of the machine, for its margins; arguments as for `run`."""
        return close_loop(self._plant(ports), *blocks)

    def scheduled(self, ports: Ports, schedule: ScheduledLoop) -> ScheduledLoop:
        """Return the loops of the machine with controllers that follow its position.

        Parameters
        ----------
        ports : Ports
            Channels of the machine, with positions.
        schedule : ScheduledLoop
            Schedule of a model's controllers, which then run on the machine.
        """
        return schedule.around(self._plant(ports))

    def run(
        self,
        ports: Ports,
        *blocks: Any,
        duration: float,
        reference: Any = None,
        rng: Any = None,
        runs: int | None = None,
        moving: Any = None,
    ) -> Response:
        """Return what the machine does in closed loop; see `simulate`.

        Parameters
        ----------
        ports : Ports
            Channels of the machine, with the noise that acts.
        *blocks : StateSpace, KalmanEstimator or Controller; or one ScheduledLoop
            Observers and controllers that run on the machine.
        duration : float [s]
            Duration of the run.
        reference : SetPointProfile, array or mapping, optional
            Set-points of the run, as for `simulate`.
        rng : int or Generator, optional
            Seed of the noise.
        runs : int, optional
            Repetitions with independent noise.
        moving : mapping {position: path}, optional
            Paths of the positions of moving ports.
        """
        schedule = blocks[0] if blocks and isinstance(blocks[0], ScheduledLoop) else None
        own = self.loop(ports, *blocks) if schedule is None else self.scheduled(ports, schedule)
        return simulate(
            own, reference=reference, duration=duration, rng=rng, runs=runs, moving=moving,
            elements=self._steps(ports),
        )  # fmt: skip

    @property
    def _middle(self) -> Poi:
        """The middle of the top, which the servo holds."""
        x, y, z = (*self.drawing["size"], 0.0)[:3]
        axes = ("x", "y", "z", "rx", "ry", "rz") if z else ("z", "rx", "ry")
        return Poi("centre", at=(x / 2, y / 2, z), axes=axes)

    def _steps(self, ports: Ports) -> dict[str, Quantiser] | None:
        """Return the steps of its sensors."""
        if not self.step:
            return None
        return {port.name: Quantiser(self.step) for port in ports.y}

    def measure_frf(
        self,
        ports: Ports,
        *,
        period: float = 1.0,
        periods: int = 4,
        discard: int = 2,
        amplitude: float = 1.0,
        rng: Any = None,
    ) -> Frf:
        """Return the FRFs from actuator forces to sensors, measured under feedback.

        A servo that is designed with the drawing holds the machine, because a free plate drifts and
        a stage on magnets falls. Random-phase multisines are added to all actuators at once. There
        are as many experiments as actuators, and the multisines of different experiments are
        orthogonal. The response is ``G = Y F^-1``, with the total forces F and the outputs Y (joint
        input-output method). Y divided by the excitation alone would be biased by the feedback.

        Parameters
        ----------
        ports : Ports
            Actuators and sensors. The disturbances and sensor noises of the ports act during the
            measurement.
        period : float [s]
            Period of the multisine; its inverse is the frequency resolution.
        periods, discard : int
            Number of averaged periods, and number of periods before these, in which the transient
            decays.
        amplitude : float [N]
            Rms excitation of each actuator.
        rng : int or Generator, optional
            Seed of phases and noise.

        Returns
        -------
        Frf
            Responses of the plant with its zero-order hold and without the delay, from the first
            frequency above zero. With two periods or more, the differences between periods give
            coherence, variance and correlation.
        """
        instance(ports, Ports, "ports", "Pass Ports(u=[...], y=[...]).")
        if not ports.u or not ports.y:
            raise ModelError(f"an FRF needs actuators and sensors, got {ports!r}.")
        random = generator(rng)
        # whole samples, so that periods are equal
        period = round(positive(period, "period") * self.rate) / self.rate
        count, duration = len(ports.u), whole(periods, "periods") * period
        duration += whole(discard, "discard", minimum=0) * period
        signal = multisine(
            count, rate=self.rate, period=period, periods=periods + discard,
            rms=positive(amplitude, "amplitude"), rng=random,
        ).swapaxes(0, 1)  # fmt: skip
        samples = signal.shape[-1] // (periods + discard)
        shakers = [
            Disturbance(f"{port.name}:excitation", at=port.at, direction=port.direction)
            for port in ports.u
        ]
        own = Ports(w=[*ports.w, *shakers], u=ports.u, z=[self._middle], y=ports.y)
        loop = close_loop(self._plant(own), *_holding(own, self))
        lines = np.arange(1, (samples + 1) // 2)
        near = offsets(periods)[0][:, None] / periods
        lag = np.exp(-2j * np.pi * (lines + near) * self.delay / samples)
        run = simulate(
            loop,
            disturbance=dict(zip((one.name for one in shakers), signal, strict=True)),
            duration=duration,
            elements=self._steps(own),
            rng=random,
            runs=count,
        )
        sent, seen = ([run[port.name] for port in side] for side in (ports.u, ports.y))
        commands, motions, shaken = (
            line_spectra(of.swapaxes(0, 1), samples, periods)[..., : lines.size]
            for of in (np.array(sent), np.array(seen), signal)
        )
        forces = shaken + lag * commands
        kinds = {sensor.quantity for sensor in ports.y}
        return frf_of_periods(
            lines / period, motions, forces, shaken, periods, resolution=1.0 / period,
            inputs=tuple(port.name for port in ports.u),
            outputs=tuple(port.name for port in ports.y),
            quantity=kinds.pop() if len(kinds) == 1 else None,
        )  # fmt: skip


def _holding(ports: Ports, machine: WaferStage) -> tuple[Any, ...]:
    """Return the slow controller that keeps the machine in place, made from its drawing."""
    if machine.magnets:
        model = solid_block(elements=(4, 3, 1), **machine.drawing)
    else:
        model = plate(elements=(4, 4), **machine.drawing)
    model = model.with_damping(ModalDamping(0.01))
    model = suspend(model, machine.magnets) if machine.magnets else model
    plant = assemble_plant(model, ports).discretized(machine.rate, delay=machine.delay)
    # against magnets a loop must be several times as fast as what they make grow
    slow = HELD if machine.magnets else 8.0
    return _of_a_rigid_body(plant, model.body_motions), design_servo(
        plant, bandwidth=slow, rolloff=5.0 * slow
    )


def _of_a_rigid_body(plant: StandardPlant, motions: FloatArray) -> StateSpace:
    """Return where the POIs of a rigid body are by what its sensors read."""
    own, ports = plant.assembled.realisation, plant.assembled.ports
    read = [port for port in ports.y if not port.order]
    seen = [poi.row(own, axis) for poi in ports.z for axis in poi.axes]
    rows = np.array([*seen, *(port.static_row(own) for port in read)])
    Z, Y = np.split(rows @ motions, [len(seen)])
    hats = [poi.derived(axis, "hat") for poi in ports.z for axis in poi.axes]
    names = [port.name for port in read]
    gain = Z @ np.linalg.pinv(Y, rcond=SAME)
    return StateSpace([], [], [], gain, plant.dt, inputs=names, outputs=hats, name="static")
