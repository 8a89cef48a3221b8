"""Errors of a moving machine: of every channel of a loop, and of Kalman filters.

All filters know the position of the machine: the rows of sensors and POIs, and the columns of
forces, belong to the present position. They differ in the gain by which innovations correct the
state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ..arrays import FloatArray, flag, instance, name_list, positive, real_array, whole
from ..errors import (
    AssumptionError,
    ModelError,
    SolverError,
    counted,
    require_known,
    sizes_of,
    with_unit,
)
from ..loop import ClosedLoop, ScheduledLoop
from ..lti.equations import solve_stein, symmetrised
from ..lti.riccati import filter_dare
from ..parallel import one_thread
from ..plant import StandardPlant
from ..plant.partitioned import require_noise
from ..store import Value, checked
from ..tolerances import SAME, TYPED
from .moving_machine import (
    MovingMachine,
    MovingPlant,
    Sample,
    Trajectory,
    known_positions,
    trajectory,
)
from .sampled_runs import unscheduled

#: number of repetitions of a trajectory after which its errors must repeat
_REPEATED = 100
#: ratio to the smallest error above which a filter with a steady gain counts as diverged
_DIVERGED = 100.0
#: ratio to the first error above which an unstable filter is not followed further
_LOST = 1e6
#: the gains, in the order of their columns
GAINS = ("exact", "scheduled", "frozen")


@dataclass(frozen=True, eq=False, repr=False)
class PathRms(Value):
    """Standard deviations of a loop's channels along a trajectory: the result of `rms_along`.

    Parameters
    ----------
    time : (n_time,) array [s]
        Instants of the samples.
    rms : (n_channels, n_time) array
        Standard deviation of each channel, in its unit.
    names : sequence of str
        Names of the channels: z, y, driven u and the monitored outputs of blocks.
    units : mapping {str: str}
        Units of the channels.
    """

    time: FloatArray = field(metadata=checked(real_array, shape=(None,)))
    rms: FloatArray = field(metadata=checked(real_array, shape=("names", "time")))
    names: tuple[str, ...] = field(metadata=checked(name_list))
    units: Mapping[str, str]

    def __repr__(self) -> str:
        largest = dict(zip(self.names, self.rms.max(axis=1).tolist(), strict=True))
        errors = {name: size for name, size in largest.items() if name.endswith(":error")}
        shown = sizes_of(errors or {self.names[0]: largest[self.names[0]]}, self.units)
        return f"<PathRms: {self.time.size} samples; largest {shown}>"

    def __getitem__(self, name: str) -> FloatArray:
        """Return the standard deviation (n_time,) of a channel."""
        require_known("channel", [name], self.names)
        return np.asarray(self.rms[self.names.index(name)])


@one_thread()
def rms_along(
    loop: ClosedLoop | ScheduledLoop,
    *,
    moving: Mapping[str, Any],
    duration: float,
    repeats: bool = False,
) -> PathRms:
    """Return the standard deviation of every channel of a loop whose machine moves.

    The covariance P of the states of plant and controller is computed without random numbers, by
    ``P[k + 1] = A[k] P[k] A[k]' + G[k] G[k]'`` from sample to sample. A is the system matrix of the
    closed loop at the position of the sample, and G the gain from white noises of unit variance to
    the states. In a ClosedLoop the controller with its observer is constant. In a ScheduledLoop it
    changes with the position.

    Parameters
    ----------
    loop : ClosedLoop or ScheduledLoop
        Loop around a sampled plant with positions.
    moving : mapping {position: path}
        Paths, as for `simulate`: each is a SetPoint, a function of time, or a value for each
        sample.
    duration : float [s]
        Duration of the trajectory.
    repeats : bool
        Whether the trajectory repeats without end. The covariance is then periodic, ``P[0] =
        P[duration]``. Otherwise the machine was at rest for a long time before the beginning.

    Returns
    -------
    PathRms
        Standard deviations by channel and time.

    Raises
    ------
    AssumptionError
        When the loop is not stable at the beginning, or over a period of a repeated trajectory.
    ModelError
        When no position moves, or a moving port has a filter or latency or is not a displacement.

    References
    ----------
    [BittantiColaneri2009]_ (periodic Lyapunov equations).

    Examples
    --------
    >>> import flexplant as fx
    >>> plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8),
    ...     density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> places = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    >>> ports = fx.Ports(
    ...     w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(places)],
    ...     u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(places)],
    ...     z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves={"x": (-1, 0, 0)})],
    ...     y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves={"x": (-1, 0, 0)})
    ...        for i, p in enumerate(places)],
    ...     references=[fx.Reference("die")],
    ...     positions=[fx.plant.Position("x", range=(-0.1, 0.1))],
    ... )
    >>> modes = fx.solve_modes(plate, count=12, damping=fx.ModalDamping(0.01))
    >>> plant = fx.assemble_plant(modes, ports).discretized(1e4, delay=1)
    >>> observer = fx.design_kalman(plant)
    >>> loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=40.0,
    ...     observer=observer))
    >>> move = fx.setpoint(0.02, velocity=0.5, acceleration=10.0, jerk=1e3)
    >>> found = fx.simulation.rms_along(loop, moving={"x": move}, duration=0.05)
    >>> found["die:error"].shape
    (500,)
    """
    loop, schedule = unscheduled(loop)
    plant = loop.machine
    known_positions(plant, "errors along a trajectory need")
    steps = round(positive(duration, "duration") / plant.dt)
    time = np.asarray(np.arange(steps) * float(plant.dt), dtype=np.float64)
    machine = MovingMachine(loop, trajectory(plant, moving, time), noise=True, schedule=schedule)
    P = _periodic(machine, steps if flag(repeats, "repeats") else 1)
    rms = np.zeros((len(plant.z) + len(plant.y) + len(loop.controller.outputs), steps))
    for k, sample in enumerate(machine.each(steps)):
        A, G, C, D = machine.closed(k, sample)
        rms[:, k] = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", C, P, C) + np.sum(D**2, axis=1), 0))
        P = A @ P @ A.T + G @ G.T
    names = (*plant.z, *plant.y, *loop.driven, *loop.watched)
    return PathRms(time, rms, names, {n: u for n, u in loop.units.items() if n in names})


def _periodic(machine: MovingMachine, steps: int) -> FloatArray:
    """Return the covariance at the beginning of samples that repeat without end."""
    Phi = np.eye(machine.plant.system.n_states + machine.loop.controller.n_states)
    P = np.zeros_like(Phi)
    for k, sample in enumerate(machine.each(steps)):
        A, G, _, _ = machine.closed(k, sample)
        Phi, P = A @ Phi, A @ P @ A.T + G @ G.T
    radius = float(np.abs(np.linalg.eigvals(Phi)).max(initial=0.0))
    if radius >= 1.0 and steps == 1:
        raise AssumptionError(
            "the loop is not stable where the trajectory begins: it has no variance there. Design "
            "it for that position, or pass repeats=True if the machine only passes it."
        )
    if radius >= 1.0:
        raise AssumptionError(
            f"the loop grows {radius:.3g} times in each repetition of the trajectory: it is not "
            "stable on this trajectory. Lower its gain, or schedule it."
        )
    return solve_stein(Phi, P)


@dataclass(frozen=True, eq=False, repr=False)
class PathFilters(Value):
    """Errors of estimated POI motions along a trajectory: the result of `filters_along`.

    A POI is a point of interest, whose motion is estimated.

    Parameters
    ----------
    time : (n_time,) array [s]
        Instants of the samples.
    names : sequence of str
        Motions of POIs, such as `die:z`.
    exact, scheduled, frozen : (n_names, n_time) arrays [m or rad]
        Standard deviation of the error of each estimate at each sample. The estimate uses the
        measurement y of the same sample. The `exact` filter has the time-varying gain of the
        Riccati recursion and the smallest error. The `scheduled` filter interpolates linearly
        between the steady gains of several positions. The `frozen` filter has the steady gain of
        the plant's present position.
    units : mapping {str: str}
        Units of the motions.
    """

    time: FloatArray = field(metadata=checked(real_array, shape=(None,)))
    names: tuple[str, ...] = field(metadata=checked(name_list))
    exact: FloatArray = field(metadata=checked(real_array, shape=("names", "time")))
    scheduled: FloatArray = field(metadata=checked(real_array, shape=("names", "time")))
    frozen: FloatArray = field(metadata=checked(real_array, shape=("names", "time")))
    units: Mapping[str, str]

    def __repr__(self) -> str:
        count = counted(self.time.size, "sample")
        lines = [f"<PathFilters: {count}; rms error, steady gains more"]
        for i, name in enumerate(self.names):
            unit = self.units.get(name)
            exact, *others = (float(np.sqrt(np.mean(getattr(self, g)[i] ** 2))) for g in GAINS)
            parts = [f"exact {with_unit(exact, unit)}"]
            for gain, rms in zip(GAINS[1:], others, strict=True):
                more = with_unit(max(rms - exact, 0.0), unit) if rms - exact > SAME * exact else "0"
                parts.append(f"{gain} {'diverges' if rms > _DIVERGED * exact else '+' + more}")
            lines.append(f"  {name} " + ", ".join(parts))
        return "\n".join(lines) + ">"

    def price(self, gain: str) -> dict[str, FloatArray]:
        """Return the error (n_time,) of "scheduled" or "frozen" minus that of "exact".

        The result is a dictionary with an entry for each motion.
        """
        require_known("gain", [gain], GAINS)
        extra = getattr(self, gain) - self.exact
        return {name: np.asarray(extra[i]) for i, name in enumerate(self.names)}


@one_thread()
def filters_along(
    plant: StandardPlant,
    *,
    moving: Mapping[str, Any],
    duration: float,
    repeats: bool = False,
    positions: int = 9,
) -> PathFilters:
    """Return the errors of three Kalman filters along a trajectory of a moving machine.

    At each sample the exact filter has the gain of the Riccati recursion. The scheduled filter
    interpolates between the steady gains of several positions. The frozen filter always has the
    steady gain of the position of `plant`.

    P is the covariance of the error before a measurement. One sample later it is ``P+ = A (I - M C)
    P (I - M C)' A' + A M R M' A' + Q``. M is the gain of the filter, Q and R are the covariances of
    process noise and sensor noise, and A and C belong to the plant at the position of the sample.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant with moving ports.
    moving, duration, repeats
        Path and duration, as for `rms_along`. On a repeated trajectory, the exact filter is the
        solution of a periodic Riccati equation.
    positions : int
        Number of positions along the trajectory whose steady gains the scheduled filter uses.

    Returns
    -------
    PathFilters
        Standard deviations of the errors of the exact, the scheduled and the frozen filter.

    Raises
    ------
    AssumptionError
        When no steady filter exists, because a rigid-body mode is not excited by noise or is not
        visible to the sensors.
    ModelError
        When no position or more than one moves. Also when a moving port has a filter or latency, or
        is not a displacement.
    SolverError
        When the errors along a repeated trajectory do not converge.

    References
    ----------
    [AndersonMoore1979]_, [BittantiColaneri2009]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8),
    ...     density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> places = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    >>> ports = fx.Ports(
    ...     u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(places)],
    ...     z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z",), moves={"x": (-1, 0, 0)})],
    ...     y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves={"x": (-1, 0, 0)})
    ...        for i, p in enumerate(places)],
    ...     positions=[fx.plant.Position("x", range=(-0.1, 0.1))],
    ... )
    >>> modes = fx.solve_modes(plate, count=10, damping=fx.ModalDamping(0.01))
    >>> plant = fx.assemble_plant(modes, ports).discretized(1e4, delay=1)
    >>> found = fx.simulation.filters_along(plant, moving={"x": lambda t: 0.1 * np.sin(100 * t)},
    ...     duration=0.02)
    >>> bool(np.all(found.exact <= found.frozen * 1.0001))
    True
    """
    filters = _Filters(plant, moving, duration, positions)
    start = filters.steady()
    found: dict[str, FloatArray] = {}
    gains = dict(zip(GAINS, (None, filters.scheduled(), filters.frozen()), strict=True))
    for name, gain in gains.items():
        rms, P = filters.run(start, gain)
        for _ in range(_REPEATED if flag(repeats, "repeats") else 0):
            before = rms
            rms, P = filters.run(P, gain)
            if np.all(np.abs(rms - before) <= TYPED * rms):
                break
            # a steady gain may be unstable at some positions: its errors then grow without bound
            if gain is not None and np.any(rms > _DIVERGED * found["exact"]):
                break
        else:
            if repeats:
                raise SolverError(
                    f"the errors change by more than {TYPED:g} after {_REPEATED} repetitions: "
                    "the trajectory is short compared with the memory of the filter. Use several "
                    "repetitions as one trajectory, or repeats=False."
                )
        found[name] = rms
    names = tuple(filters.names)
    units = {name: unit for name, unit in plant.units.items() if name in names}
    return PathFilters(filters.time, names, **found, units=units)


class _Filters:
    """A moving plant for filters: sensors with noise, motions of POIs."""

    def __init__(self, plant: Any, moving: Any, duration: Any, positions: Any) -> None:
        instance(plant, StandardPlant, "plant", "Pass a sampled plant with positions.")
        known_positions(plant, "filters along a trajectory need")
        self.plant, ports = plant, plant.assembled.ports
        self.steps = round(positive(duration, "duration") / plant.dt)
        self.time = np.arange(self.steps) * float(plant.dt)
        self.machine = MovingPlant(plant, trajectory(plant, moving, self.time))
        rows = np.array([plant.y.index(sensor.name) for sensor in ports.y])
        self.y = len(plant.z) + rows
        self.names = [poi.channel(axis) for poi in ports.z for axis in poi.axes]
        self.z = [plant.z.index(name) for name in self.names]
        self.R = plant.sensor_noise[np.ix_(rows, rows)]
        names = [sensor.name for sensor in ports.y]
        require_noise(dict(zip(names, np.diag(self.R).tolist(), strict=True)))
        self.moved = list(self.machine.path.paths)
        self.count = whole(positions, "positions", minimum=2)

    def _sample(self, values: Mapping[str, FloatArray]) -> Sample:
        """Return the matrices of a plant that stands at values of the positions."""
        there = {name: float(value[0]) for name, value in values.items()}
        paths = {n: partial(_constant, there[n]) for n in self.moved}
        standing = Trajectory(self.machine.path.positions, paths, there)
        return next(MovingPlant(self.plant, standing).each(1))

    def steady(self, values: Mapping[str, FloatArray] | None = None) -> FloatArray:
        """Return the covariance of the steady filter, by default where the trajectory begins."""
        sample = self._sample(self.machine.path.at(np.zeros(1)) if values is None else values)
        return filter_dare(sample.A, sample.C[self.y], Q=sample.G @ sample.G.T, R=self.R).P

    def frozen(self) -> Callable[[int], FloatArray]:
        """Return the steady gain at the present position of the plant."""
        standing = {n: np.array([v]) for n, v in self.machine.path.standing.items()}
        gain = self._correcting(standing)
        return lambda k: gain

    def scheduled(self) -> Callable[[int], FloatArray]:
        """Return steady gains of some positions on the way, linear between them."""
        if len(self.moved) != 1:
            raise ModelError(
                f"gains are scheduled by one position, and {', '.join(self.moved) or 'none'} "
                "moves. Name one, or make others functions of it in a PlaceTable."
            )
        (name,), still = self.moved, self.machine.path.at(np.zeros(1))
        path = self.machine.path.at(self.time)[name]
        grid = np.linspace(path.min(), path.max(), self.count)
        if np.ptp(path) == 0.0:
            gain = self._correcting(still)
            return lambda k: gain
        gains = np.array([self._correcting(still | {name: np.array([v])}) for v in grid])
        step = grid[1] - grid[0]

        def gain_at(k: int) -> FloatArray:
            place = min((path[k] - grid[0]) / step, self.count - 1.0)
            i = min(int(place), self.count - 2)
            share = place - i
            return np.asarray((1.0 - share) * gains[i] + share * gains[i + 1])

        return gain_at

    def _correcting(self, values: Mapping[str, FloatArray]) -> FloatArray:
        return self._best(self._sample(values), self.steady(values))

    def _best(self, sample: Sample, P: FloatArray) -> FloatArray:
        """Return the gain M (n, ny) of the correction x[k|k] = x[k|k-1] + M e."""
        C = sample.C[self.y]
        return np.asarray(np.linalg.solve(C @ P @ C.T + self.R, C @ P).T)

    def corrected(
        self, P: FloatArray, gain: Callable[[int], FloatArray] | None
    ) -> Iterator[tuple[Sample, FloatArray, FloatArray, FloatArray]]:
        """Yield the matrices, the gain, P[k|k] and P[k+1|k] of each sample; None: the best gain."""
        for k, sample in enumerate(self.machine.each(self.steps)):
            M = self._best(sample, P) if gain is None else gain(k)
            left = np.eye(len(P)) - M @ sample.C[self.y]
            after = left @ P @ left.T + M @ self.R @ M.T
            P = symmetrised(sample.A @ after @ sample.A.T + sample.G @ sample.G.T)
            yield sample, M, after, P

    def run(
        self, P: FloatArray, gain: Callable[[int], FloatArray] | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the deviations along the trajectory, and the covariance after it."""
        rms = np.zeros((len(self.z), self.steps))
        for k, (sample, _, after, ahead) in enumerate(self.corrected(P, gain)):
            P, shown = ahead, sample.C[self.z]
            rms[:, k] = np.sqrt(np.einsum("ij,jk,ik->i", shown, after, shown))
            if np.any(rms[:, k] > _LOST * rms[:, 0]):
                rms[:, k:] = rms[:, k : k + 1]  # grows without bound: soon beyond all numbers
                break
        return rms, P


def _constant(value: float, time: FloatArray) -> FloatArray:
    return np.full(time.size, value)


def estimate_along(
    plant: StandardPlant, records: Mapping[str, Any], *, moving: Mapping[str, Any]
) -> dict[str, FloatArray]:
    """Return the estimates of the time-varying Kalman filter (exact filter) of a moving machine.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant with moving ports.
    records : mapping {name: (n_time,) array}
        Records of the sensors y and commands u by name, or the `Response` that `simulate` returned.
    moving : mapping {position: path}
        Positions of the machine, as for `simulate`.

    Returns
    -------
    dict {str: (n_time,) array}
        Estimates of every motion of the POIs, such as `die:z`. The estimate of a sample uses the
        measurement y of this sample.

    Raises
    ------
    LabelError, ModelError, ShapeError
        As for `filters_along`; also when a record is missing or has another length.

    Examples
    --------
    >>> import flexplant as fx
    >>> "exact filter" in fx.simulation.estimate_along.__doc__
    True
    """
    sensors = [sensor.name for sensor in plant.assembled.ports.y]
    needed = [*sensors, *plant.u]
    require_known("record", needed, list(getattr(records, "names", records)))
    count = np.asarray(records[needed[0]]).size
    data = np.array([real_array(records[n], n, (count,)) for n in needed]).T
    filters = _Filters(plant, moving, count * float(plant.dt), 2)
    P, found = filters.steady(), np.zeros((len(filters.z), count))
    x = np.zeros(len(P))
    for k, (sample, M, *_) in enumerate(filters.corrected(P, None)):
        y, u = data[k, : len(sensors)], data[k, len(sensors) :]
        x = x + M @ (y - sample.C[filters.y] @ x)
        found[:, k] = sample.C[filters.z] @ x
        x = sample.A @ x + sample.B[:, len(plant.w) :] @ u
    return dict(zip(filters.names, found, strict=True))
