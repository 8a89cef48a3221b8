"""A virtual wafer stage: a full-order truth with a hidden mass, which answers like hardware."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..checks import ComplexArray, FloatArray, Value, generator, positive, short, whole
from ..errors import ModelError, counted, unknown_label
from ..estimation import design_static
from ..identification import MeasuredModes
from ..identification.periodic import frf_of_periods, line_spectra, offsets
from ..loop import ClosedLoop, close_loop
from ..lti.frequency import Frf
from ..plant import Disturbance, Poi, Ports, StandardPlant, assemble_plant
from ..plant.realisation import ModalRealisation, realised
from ..simulation import Response, simulate
from ..structure import FEModel, ModalDamping, kirchhoff_plate
from ..synthesis import design_servo

SIZE = (0.6, 0.6)
#: the plate of the paper's Table 1, as its drawing says
DRAWING: Mapping[str, Any] = {
    "size": SIZE,
    "thickness": 0.0272,
    "density": 2702.0,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.35,
}


def wafer_stage(
    *,
    elements: tuple[int, int] = (8, 8),
    damping: float = 0.01,
    added_mass: float = 0.5,
    rate: float = 10e3,
    delay: int = 1,
) -> WaferStage:
    """Return the virtual machine: the paper's plate with an actuator's mass that no drawing shows.

    The plate of Table 1, free, with all its DOFs; D is the modal damping of the bare plate, then a
    point mass is added at (L/2, L/4), the paper's z_8.

    Parameters
    ----------
    elements : (int, int)
        Mesh; (8, 8) is the paper's with 243 DOFs.
    damping : float
        Modal damping ratio of the bare plate's elastic modes.
    added_mass : float [kg]
        The hidden mass.
    rate : float [Hz]
        Sampling rate of its controller.
    delay : int [samples]
        From measurement to actuation.

    Returns
    -------
    WaferStage
        It answers with poles, FRFs and closed-loop runs; its matrices are for tests only.

    Raises
    ------
    ModelError
        When a value is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> machine = fx.testbeds.wafer_stage(elements=(4, 4))
    >>> machine.poles([4]).freq.round(1)
    array([246.5])
    """
    given = tuple(elements) if isinstance(elements, tuple | list) else ()
    if len(given) != 2:
        raise ModelError(
            f"elements are two whole numbers (nx, ny), got {short(elements)}. Try (8, 8)."
        )
    elements = (whole(given[0], "elements along x"), whole(given[1], "elements along y"))
    late = whole(delay, "delay", minimum=0)
    bare = kirchhoff_plate(elements=elements, name="wafer stage", **DRAWING)
    damped = bare.with_damping(ModalDamping(damping))
    row = damped.dofs.row((SIZE[0] / 2, SIZE[1] / 4, 0.0), "z")
    mass = positive(added_mass, "added_mass", zero=True) * np.outer(row, row)
    truth = FEModel(damped.M + mass, damped.K, damped.D, dofs=damped.dofs, name="wafer stage")
    return WaferStage(truth, positive(rate, "rate"), late)


@dataclass(frozen=True, eq=False, repr=False)
class WaferStage(Value):
    """A machine that can be measured and run, but whose model is hidden.

    Parameters
    ----------
    truth : FEModel
        What it really is: for tests and for judging an answer; no design may read it.
    rate : float [Hz]
        Of its controller.
    delay : int [samples]
        From measurement to actuation.

    Examples
    --------
    >>> import flexplant as fx
    >>> machine = fx.testbeds.wafer_stage(elements=(4, 4))
    >>> machine.rate, machine.delay
    (10000.0, 1)
    """

    truth: FEModel
    rate: float
    delay: int

    def __repr__(self) -> str:
        return f"<WaferStage: rate {self.rate:g} Hz, delay {counted(self.delay, 'sample')}>"

    @cached_property
    def _realisation(self) -> ModalRealisation:
        return realised(self.truth)

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

    def _plant(self, ports: Ports) -> StandardPlant:
        return assemble_plant(self._realisation, ports).discretized(self.rate, delay=self.delay)

    def poles(self, modes: Sequence[int]) -> MeasuredModes:
        """Return the poles of some modes, as an ideal experimental modal analysis would.

        Parameters
        ----------
        modes : sequence of int
            Numbers from 1, rigid-body modes included, as in the paper; elastic ones by frequency,
            those left out that damping keeps from swinging.

        Raises
        ------
        LabelError
            When a mode is not there, or is a rigid-body mode (a drift has no pole to measure).
        ModelError
            When a mode is no whole number, or lies above half the machine's rate, where no
            sampled measurement shows it.
        """
        own = self._own_poles
        known = range(self._realisation.n_rigid + 1, self._realisation.n_rigid + own.size + 1)
        found = []
        listed = [modes] if not isinstance(modes, Iterable) or isinstance(modes, str) else modes
        numbers = tuple(whole(mode, "mode") for mode in listed)
        for mode in numbers:
            if mode not in known:
                raise unknown_label("elastic mode", mode, map(str, known))
            pole = own[mode - 1 - self._realisation.n_rigid]
            if (freq := abs(pole) / (2.0 * np.pi)) >= 0.5 * self.rate:
                raise ModelError(
                    f"mode {mode} at {freq:.4g} Hz is not below half the rate, {0.5 * self.rate:g} "
                    "Hz: no measurement of this machine shows it. Choose lower modes, or raise "
                    "the rate."
                )
            found.append(pole)
        return MeasuredModes(poles=np.array(found, dtype=np.complex128), modes=numbers)

    def loop(self, ports: Ports, *blocks: Any) -> ClosedLoop:
        """Return the machine's own closed loop, for its margins.

        Parameters
        ----------
        ports : Ports
            Its channels.
        *blocks : StateSpace, KalmanEstimator or Controller
            What is to run on it.
        """
        return close_loop(self._plant(ports), *blocks)

    def run(
        self,
        ports: Ports,
        *blocks: Any,
        duration: float,
        reference: Any = None,
        rng: Any = None,
        runs: int | None = None,
    ) -> Response:
        """Return what the machine does in closed loop; see `simulate`.

        Parameters
        ----------
        ports : Ports
            Its channels, with the noise that acts.
        *blocks : StateSpace, KalmanEstimator or Controller
            What runs on it.
        duration : float [s]
            Length of the run.
        reference : SetPoint, array or mapping, optional
            The reference.
        rng : int or Generator, optional
            Of the noise.
        runs : int, optional
            Repetitions with independent noise.
        """
        loop = self.loop(ports, *blocks)
        return simulate(loop, reference=reference, duration=duration, rng=rng, runs=runs)

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

        A free plate drifts, so a slow servo from the drawing holds it. Random-phase multisines are
        added to all actuators at once, orthogonal over as many experiments as there are actuators;
        total forces F and outputs Y then give ``G = Y F^-1`` (joint input-output: dividing Y by
        the excitation alone would be biased by the feedback).

        Parameters
        ----------
        ports : Ports
            Actuators and sensors; its disturbances and sensor noises act.
        period : float [s]
            Of the multisine; its inverse is the frequency resolution.
        periods, discard : int
            Periods that are averaged, and those before, for the transient to die out.
        amplitude : float [N]
            Rms excitation of each actuator.
        rng : int or Generator, optional
            Of phases and noise.

        Returns
        -------
        Frf
            Of the plant with its zero-order hold, without the delay; zero frequency left out. With
            two periods or more, what changes between them gives coherence, variance and
            correlation.

        Raises
        ------
        ModelError
            When ports lack actuators or sensors, or a number is out of range.
        """
        if not ports.u or not ports.y:
            raise ModelError(f"an FRF needs actuators and sensors, got {ports!r}.")
        random = generator(rng)
        count, samples = len(ports.u), round(positive(period, "period") * self.rate)
        _check_multisine(samples, periods, discard)
        shakers = [f"{port.name}:excitation" for port in ports.u]
        own = Ports(
            w=[
                *ports.w,
                *(
                    Disturbance(name, at=port.at, direction=port.direction)
                    for name, port in zip(shakers, ports.u, strict=True)
                ),
            ],
            u=ports.u,
            z=[Poi("centre", at=(SIZE[0] / 2, SIZE[1] / 2, 0.0), axes=("z", "rx", "ry"))],
            y=ports.y,
        )
        loop = close_loop(self._plant(own), *_holding(own, self.rate, self.delay))
        lines = np.arange(1, samples // 2)
        spectrum = np.exp(2j * np.pi * random.random(lines.size)) * np.sqrt(samples / 2.0)
        turns = np.exp(2j * np.pi * np.outer(np.arange(count), np.arange(count)) / count)
        near = offsets(periods)[0][:, None] / periods
        lag = np.exp(-2j * np.pi * (lines + near) * self.delay / samples)
        shaken = np.zeros((count, count, *lag.shape), dtype=np.complex128)
        forces = np.zeros_like(shaken)
        motions = np.zeros((count, len(ports.y), *lag.shape), dtype=np.complex128)
        for experiment in range(count):
            waves = _multisine(spectrum[None, :] * turns[:, experiment, None], lines, samples)
            waves = positive(amplitude, "amplitude") * waves
            signal = np.tile(waves, periods + discard)
            run = simulate(
                loop,
                disturbance=dict(zip(shakers, signal, strict=True)),
                duration=(periods + discard) * samples / self.rate,
                rng=int(random.integers(2**63)),
            )
            sent, seen = ([run[port.name] for port in side] for side in (ports.u, ports.y))
            commands, motions[experiment], shaken[experiment] = (
                line_spectra(np.array(part), samples, periods)[..., : lines.size]
                for part in (sent, seen, signal)
            )
            forces[experiment] = shaken[experiment] + lag * commands
        kinds = {sensor.quantity for sensor in ports.y}
        return frf_of_periods(
            lines / period,
            motions,
            forces,
            shaken,
            periods,
            inputs=tuple(port.name for port in ports.u),
            outputs=tuple(port.name for port in ports.y),
            quantity=kinds.pop() if len(kinds) == 1 else None,
            resolution=1.0 / period,
        )


def _holding(ports: Ports, rate: float, delay: int) -> tuple[Any, ...]:
    """Return the slow controller that keeps the machine in place, made from its drawing."""
    drawing = kirchhoff_plate(elements=(4, 4), **DRAWING).with_damping(ModalDamping(0.01))
    plant = assemble_plant(drawing, ports).discretized(rate, delay=delay)
    return design_static(plant), design_servo(plant, bandwidth=8.0, rolloff=40.0)


def _check_multisine(samples: int, periods: int, discard: int) -> None:
    if samples < 4:
        raise ModelError(
            f"a period of {samples} samples has no frequencies to measure at. Lengthen period."
        )
    for name, number, least in (("periods", periods, 1), ("discard", discard, 0)):
        whole(number, name, minimum=least)


def _multisine(spectrum: Any, lines: Any, samples: int) -> FloatArray:
    """Return waves (n, samples) of unit rms with the given relative spectrum at the lines."""
    full = np.zeros((spectrum.shape[0], samples // 2 + 1), dtype=np.complex128)
    full[:, lines] = spectrum
    waves = np.fft.irfft(full, samples)
    return np.asarray(waves / np.sqrt(np.mean(waves**2, axis=1, keepdims=True)))
