"""The wafer stage: a plate in polynomials with hidden differences, run like hardware."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la
from numpy.polynomial import legendre

from ..arrays import (
    ComplexArray,
    FloatArray,
    below_half_rate,
    generator,
    instance,
    positive,
    positive_array,
    several,
    whole,
)
from ..dof_columns import Interpolation
from ..errors import LabelError, ModelError, require_known
from ..identification import MeasuredModes
from ..identification.periodic import frf_of_periods, line_spectra, multisine, offsets
from ..labels import DIRECTIONS, DofSet
from ..loop import ClosedLoop, ScheduledLoop, close_loop
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace
from ..plant import Disturbance, GroundSpring, Poi, Ports, StandardPlant, assemble_plant, suspend
from ..plant.realisation import ModalRealisation, realise
from ..reduction import ReducedModel
from ..simulation import Quantiser, Response, simulate
from ..sparse.symmetric import dense
from ..store import Value
from ..structure import FEModel, ModalDamping, kirchhoff_plate, plate, solid_block
from ..synthesis import design_servo
from ..tolerances import SAME

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


#: of a machine: relative scatter of stiffness over the plate and of damping over its modes [-],
#: delay [samples], step of its sensors [m], and a second mass [kg], at most
STIFFNESS, SPREAD, LATENCY, STEP, SECOND = 0.003, 0.3, 1.3, 5e-11, 0.1
#: dampings that a machine draws, of which its modes take the first: its second mass comes after
#: them, and is the same for plates of any order
DAMPINGS = 253


def wafer_stage(
    *,
    elements: tuple[int, int] | None = None,
    size: Sequence[float] = (0.6, 0.6),
    thickness: float = 0.0272,
    damping: float = 0.01,
    added_mass: float = 0.5,
    rate: float = 10e3,
    delay: float | None = None,
    individual: int = 1,
) -> WaferStage:
    """Return a virtual machine: a free plate with the mass of an actuator that no drawing shows.

    The machine is the free plate of Table 1 of [paper]_, an aluminium plate of 0.6 m by 0.6 m by
    27.2 mm, with rotary inertia. It is modelled by polynomial shape functions (Ritz method) of such
    a high order that its frequencies are converged. They therefore differ from those of any mesh of
    the drawing. The mass of the actuator is added at (L/2, L/4), where L is the side of the plate
    (point z_8 of the paper), and another of up to 0.1 kg at a random place. The stiffness is
    scattered over the plate by 0.3 % and the damping over its modes by 30 %. The sensors have steps
    of 0.05 nm, and the delay is not a whole number of samples.

    Parameters
    ----------
    elements : (int, int), optional
        Number of elements along x and y. If it is given, a mesh of the drawn plate takes the place
        of the polynomials. The machine then has the same formulation as the models, without
        scatter, second mass and sensor steps, and its delay is 1 sample by default. (8, 8) is the
        mesh of the paper, with 243 DOFs.
    size : (float, float) [m]
        Sides of the plate along x and y; by default the paper's.
    thickness : float [m]
        Thickness of the plate; by default the paper's.
    damping : float
        Mean modal damping ratio of the elastic modes of the plate without added masses.
    added_mass : float [kg]
        Mass of the actuator that no drawing shows.
    rate : float [Hz]
        Sampling rate of its controller.
    delay : float [samples], optional
        Delay from a measurement to the reaction of the actuators, including fractions; 1.3
        by default.
    individual : int
        Number of the machine, from which its scatter and its second mass are drawn.

    Returns
    -------
    WaferStage
        Machine that gives poles, FRFs and closed-loop runs; its matrices are for tests only.

    Raises
    ------
    ModelError
        When a value is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.wafer_stage().poles([6]).freq.round(1)
    array([455.1])
    >>> fx.testbeds.wafer_stage(size=(0.5, 0.35), thickness=0.03).poles([6]).freq.round(1)
    array([1260.7])
    >>> fx.testbeds.wafer_stage(elements=(4, 4)).poles([4]).freq.round(1)
    array([246.5])
    """
    mass = positive(added_mass, "added_mass", zero=True)
    fast = positive(rate, "rate")
    drawing = _plate_drawing(size, thickness)
    x, y = drawing["size"]
    mass_at: dict[tuple[float, ...], float] = {(x / 2, y / 4, 0.0): mass}
    if elements is None:
        late = positive(LATENCY if delay is None else delay, "delay", zero=True)
        seed = whole(individual, "individual", minimum=0)
        return WaferStage(_individual(drawing, damping, mass_at, seed), fast, late, STEP, drawing)
    late = positive(1.0 if delay is None else delay, "delay", zero=True)
    bare = kirchhoff_plate(elements=elements, name="wafer stage", **drawing)
    truth = _with_masses(bare.with_damping(ModalDamping(damping)), mass_at)
    return WaferStage(truth, fast, late, drawing=drawing)


def _plate_drawing(size: Any, thickness: Any) -> Mapping[str, Any]:
    """Return the drawing of a plate of this size."""
    sides = tuple(positive_array(size, "size", (2,)).tolist())
    return {**DRAWING, "size": sides, "thickness": positive(thickness, "thickness")}


def waves(random: np.random.Generator, sides: Sequence[float]) -> Callable[..., FloatArray]:
    """Return a factor of stiffness over x and y (...): cosines of random heights."""
    height = random.normal(size=(3, 3))

    def factor(x: FloatArray, y: FloatArray) -> FloatArray:
        over_x, over_y = (
            np.cos(np.pi * np.arange(3) * at[..., None] / side)
            for at, side in zip((x, y), sides[:2], strict=True)
        )
        seen = np.einsum("...i,ji,...j->...", over_x, height, over_y)
        return np.asarray(1.0 + STIFFNESS * seen / np.sqrt(9.0 / 4.0))

    return factor


def _individual(
    drawing: Mapping[str, Any], damping: float, known: Mapping[Any, float], seed: int
) -> FEModel:
    """Return one machine: its stiffness, damping and masses."""
    random = np.random.default_rng([seed, 8])
    sides = drawing["size"]
    bare = ritz_plate(stiffer=waves(random, sides), **drawing)
    omega, phi = plate_modes(bare)
    own = random.normal(size=DAMPINGS)[: omega.size]
    zeta = positive(damping, "damping", zero=True) * np.exp(SPREAD * own)
    shapes = bare.M @ phi
    D = shapes * (2.0 * zeta * omega) @ shapes.T
    spot = (sides[0] * random.random(), sides[1] * random.random(), 0.0)
    masses = {**known, spot: SECOND * random.random()}
    return _with_masses(bare.replace(D=0.5 * (D + D.T), name="wafer stage"), masses)


def _with_masses(bare: FEModel, masses: Mapping[tuple[float, ...], float]) -> FEModel:
    """Return a damped plate with point masses [kg] added after its damping."""
    M = bare.M
    for at, mass in masses.items():
        row = bare.dofs.row(np.array(at), "z")
        M = M + mass * np.outer(row, row)
    return FEModel(M, bare.K, bare.D, dofs=bare.dofs, name="wafer stage")


#: order in each direction: of the paper's plate the first twenty frequencies to 2e-6 and forty, to
#: 7 kHz, to 1e-3; one of 15 takes twice as long in every loop
ORDER = 13


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialShape(Interpolation):
    """Lagrange's polynomials through a grid of nodes, x fastest: z of a plate, x, y, z of a block.

    `size` [m] and `orders` have two entries for a plate, and three for a block.
    """

    size: tuple[float, ...]
    orders: tuple[int, ...]

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of all displacements in a motion at a point."""
        return np.asarray(self.rows(np.asarray(xyz)[None], direction)[0])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3); rotations are half the curl."""
        bends = len(self.size) == 2
        moved, known = ("z", ("z", "rx", "ry")) if bends else ("xyz", DIRECTIONS)
        require_known("motion", [direction], known, "a plate in bending" if bends else "a solid")
        places = np.asarray(points)[:, : len(self.size)]
        off = np.any((places / self.size < -SAME) | (places / self.size > 1.0 + SAME), axis=1)
        if np.any(off):
            where = "off the plate" if bends else "outside the block"
            raise LabelError(
                f"the point {tuple(np.asarray(points)[off][0].tolist())} is {where} of "
                f"{self.size} m. Choose one in it."
            )
        # a displacement, the axis of its slope, and the sign: rx is of dz/dy and -dy/dz
        axis = "xyz".index(direction[-1])
        y, z = (axis + 1) % 3, (axis + 2) % 3
        terms: list[tuple[int, int | None, float]] = [(z, y, 1.0), (y, z, -1.0)]
        terms = [(axis, None, 1.0)] if len(direction) == 1 else terms
        terms = [term for term in terms if "xyz"[term[0]] in moved]
        found = np.zeros((len(places), int(np.prod(np.array(self.orders) + 1)), len(moved)))
        for displacement, slope, sign in terms:
            column = moved.index("xyz"[displacement])
            found[:, :, column] = sign / len(terms) * self.polynomials(places, slope)
        return found.reshape(len(places), -1)

    def polynomials(self, places: FloatArray, slope: int | None = None) -> FloatArray:
        """Return all polynomials (p, n), or their slopes along an axis, at places (p, d)."""
        found = np.ones((len(places), 1))
        for i, (order, at, length) in enumerate(zip(self.orders, places.T, self.size, strict=True)):
            k = int(slope == i)
            own = lagrange(lobatto(order), 2.0 * (at / length) - 1.0, k) * (2.0 / length) ** k
            found = np.einsum("pi,pj->pij", own, found).reshape(len(places), -1)
        return found


def lobatto(order: int) -> FloatArray:
    """Return Lobatto's points in [-1, 1], through which Lagrange's polynomials stay small."""
    inner = legendre.legroots(legendre.legder(np.eye(order + 1)[order]))
    return np.concatenate([[-1.0], np.sort(inner.real), [1.0]])


def lagrange(nodes: FloatArray, points: FloatArray, order: int = 0) -> FloatArray:
    """Return derivatives of Lagrange's polynomials through nodes, at points (p, n)."""
    size = nodes.size - 1  # by Legendre's polynomials, which stay well conditioned
    given = legendre.legvander(nodes, size)
    seen = legendre.legval(points, legendre.legder(np.eye(size + 1), order)).T
    return np.asarray(np.linalg.solve(given.T, seen.T).T)


def ritz_plate(
    *,
    size: Sequence[float],
    thickness: float,
    density: float,
    youngs_modulus: float,
    poisson_ratio: float,
    order: int = ORDER,
    stiffer: Any = None,
) -> FEModel:
    """Return a free rectangular plate with rotary inertia by the method of Ritz, dense."""
    # the energies of bending, `D/2 (w_xx^2 + w_yy^2 + 2 nu w_xx w_yy + 2 (1 - nu) w_xy^2)` with `D
    # = E h^3 / (12 (1 - nu^2))`, and of `rho h w_t^2 / 2 + rho h^3 (w_xt^2 + w_yt^2) / 24`, in
    # polynomials that meet each boundary condition in the limit; integrals exact. `stiffer` is a
    # function of (x, y): a factor of E there
    nodes = lobatto(order)
    points, weights = legendre.leggauss(order + 3)
    a, b = (0.5 * float(length) for length in size)
    N = [lagrange(nodes, points, k) for k in range(3)]

    def derived(x_order: int, y_order: int) -> FloatArray:
        both = np.einsum("pj,qi->pqji", N[y_order], N[x_order]).reshape(points.size**2, -1)
        return np.asarray(both / (a**x_order * b**y_order))

    area = a * b * np.outer(weights, weights).reshape(-1)
    x, y = np.meshgrid(a * (1.0 + points), b * (1.0 + points))
    share = np.ones(area.size) if stiffer is None else np.asarray(stiffer(x, y)).reshape(-1)
    nu = poisson_ratio
    bending = (area * share * youngs_modulus * thickness**3 / (12.0 * (1.0 - nu**2)))[:, None]
    xx, yy, xy = derived(2, 0), derived(0, 2), derived(1, 1)
    K = xx.T @ (bending * (xx + nu * yy)) + yy.T @ (bending * (yy + nu * xx))
    K += 2.0 * (1.0 - nu) * xy.T @ (bending * xy)
    mass = (density * area)[:, None]
    M, turning = np.zeros_like(K), thickness**3 / 12.0
    for inertia, motion in ((thickness, (0, 0)), (turning, (1, 0)), (turning, (0, 1))):
        part = derived(*motion)
        M += part.T @ (inertia * mass * part)
    at_x, at_y = np.meshgrid(a * (1.0 + nodes), b * (1.0 + nodes))
    xyz = np.column_stack([at_x.reshape(-1), at_y.reshape(-1), np.zeros(at_x.size)])
    shape = PolynomialShape((float(size[0]), float(size[1])), (order, order))
    dofs = DofSet(np.arange(1, at_x.size + 1), ("z",) * at_x.size, xyz, shape)
    return FEModel(0.5 * (M + M.T), 0.5 * (K + K.T), dofs=dofs, name="plate by Ritz")


def plate_modes(plate: FEModel) -> tuple[FloatArray, FloatArray]:
    """Return omega (k,) [rad/s] and mass-normalised shapes (n, k) of all modes but three."""
    values, phi = la.eigh(dense(plate.K), dense(plate.M))
    return np.sqrt(values[3:]), phi[:, 3:]
