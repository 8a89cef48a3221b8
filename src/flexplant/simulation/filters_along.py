"""Kalman filters of a machine on the move: the exact one, and steady gains beside it.

All of them know where the machine is: the rows of sensors and POIs, and the columns of forces, are
those of the present position. They differ in the gain by which innovations correct the state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, Value, flag, instance, positive, real_array, whole, with_unit
from ..errors import ModelError, SolverError, counted, require_known
from ..lti.equations import symmetrised
from ..lti.riccati import solve_dare
from ..parallel import one_thread
from ..plant import StandardPlant
from ..tolerances import SAME
from .moving_machine import MovingPlant, Sample, Trajectory, trajectory

#: repetitions of a trajectory after which its errors have to repeat, and to which part
_REPEATED, _SETTLED = 100, 1e-6
#: times the least error at which a filter with a steady gain is of no use any more
_DIVERGED = 100.0
#: times the first error from which on an unstable filter is not followed
_LOST = 1e6
#: the gains, in the order of their columns
GAINS = ("exact", "scheduled", "frozen")


@dataclass(frozen=True, eq=False, repr=False)
class FiltersAlong(Value):
    """Errors of estimated POIs along a trajectory; made by `filters_along`.

    Parameters
    ----------
    time : (n_time,) array [s]
        The samples.
    names : sequence of str
        Motions of POIs, such as `die:z`.
    exact, scheduled, frozen : (n_names, n_time) arrays [m or rad]
        Standard deviation of the error of each estimate y[k] included: with the time-varying gain
        of the Riccati recursion, which is the least; with steady gains of some positions, linear
        between them; with the steady gain where the plant stands.
    units : mapping {str: str}
        Of the motions.
    """

    time: FloatArray
    names: tuple[str, ...]
    exact: FloatArray
    scheduled: FloatArray
    frozen: FloatArray
    units: Mapping[str, str]

    def __post_init__(self) -> None:
        names, time = tuple(self.names), real_array(self.time, "time", (None,))
        shape = (len(names), time.size)
        own = {gain: real_array(getattr(self, gain), gain, shape) for gain in GAINS}
        self._set(names=names, time=time, units=dict(self.units), **own)

    def __repr__(self) -> str:
        lines = [
            f"<FiltersAlong: {counted(self.time.size, 'sample')}; rms error, steady gains more"
        ]
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
        """Return what a steady gain adds to each error (n_time,), "scheduled" or "frozen"."""
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
) -> FiltersAlong:
    """Return the errors of three Kalman filters along a trajectory of a machine's positions.

    ``P+ = A (I - M C) P (I - M C)' A' + A M R M' A' + Q`` with the matrices of each sample; M is
    the gain of the recursion itself, or a steady one.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, with ports that move.
    moving : mapping {position: path}
        As for `simulate`.
    duration : float [s]
        Of the trajectory.
    repeats : bool
        Whether the trajectory repeats for ever (a periodic Riccati equation). Else the machine has
        stood at the beginning for a long time.
    positions : int
        Places along the trajectory whose steady gains are scheduled.

    Returns
    -------
    FiltersAlong

    Raises
    ------
    AssumptionError
        When no steady filter exists: a rigid-body mode is not excited or not seen.
    LabelError
        When a position is unknown.
    ModelError
        When nothing moves, a port that moves has dynamics of its own, or two positions move.
    SolverError
        When the errors along a repeated trajectory do not settle.

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
    start = filters.steady(filters.machine.path.at(np.zeros(1)))
    found: dict[str, FloatArray] = {}
    gains = dict(zip(GAINS, (None, filters.scheduled(), filters.frozen()), strict=True))
    for name, gain in gains.items():
        rms, P = filters.run(start.P, gain)
        for _ in range(_REPEATED if flag(repeats, "repeats") else 0):
            before = rms
            rms, P = filters.run(P, gain)
            if np.all(np.abs(rms - before) <= _SETTLED * rms):
                break
            # a steady gain may be unstable on the way: its errors then grow for ever
            if gain is not None and np.any(rms > _DIVERGED * found["exact"]):
                break
        else:
            if repeats:
                raise SolverError(
                    f"the errors change by more than {_SETTLED:g} after {_REPEATED} repetitions: "
                    "the trajectory is short beside what the filter remembers. Take several of "
                    "its repetitions as one, or repeats=False."
                )
        found[name] = rms
    names = tuple(filters.names)
    units = {name: unit for name, unit in plant.units.items() if name in names}
    return FiltersAlong(filters.time, names, **found, units=units)


class _Filters:
    """A moving plant, as filters see it: sensors with noise, motions of POIs."""

    def __init__(self, plant: Any, moving: Any, duration: Any, positions: Any) -> None:
        instance(plant, StandardPlant, "plant", "Pass a sampled plant with positions.")
        if not plant.dt or not plant.is_assembled or not plant.assembled.ports.positions:
            raise ModelError(
                "filters along a trajectory need a sampled plant whose ports move: Ports(..., "
                "positions=[fx.plant.Position('x', range=...)]) and plant.discretized(rate)."
            )
        self.plant = plant
        self.steps = round(positive(duration, "duration") / plant.dt)
        self.time = np.arange(self.steps) * float(plant.dt)
        self.machine = MovingPlant(plant, trajectory(plant, moving, self.time))
        ports = plant.assembled.ports
        self.y = [len(plant.z) + plant.y.index(sensor.name) for sensor in ports.y]
        self.names = [poi.channel(axis) for poi in ports.z for axis in poi.axes]
        self.z = [plant.z.index(name) for name in self.names]
        noise = {int(c): float(d) for c, d in zip(
            self.machine.noise.columns, self.machine.noise.deviation, strict=True
        )}  # fmt: skip
        columns = [plant.w.index(f"{s.name}:noise") if s.asd else -1 for s in ports.y]
        self.R = np.diag([noise.get(column, 0.0) ** 2 for column in columns])
        if not np.all(np.diag(self.R) > 0):
            raise ModelError("a filter needs noise of every sensor: Sensor(..., asd=...).")
        self.moved = list(self.machine.path.paths)
        self.count = whole(positions, "positions", minimum=2)

    def _sample(self, values: Mapping[str, FloatArray]) -> Any:
        """Return the matrices of a plant that stands at values of the positions."""
        there = {name: float(value[0]) for name, value in values.items()}
        standing = Trajectory(
            self.machine.path.positions, {n: _constant(there[n]) for n in self.moved}, there
        )
        return next(MovingPlant(self.plant, standing).each(1))

    def steady(self, values: Mapping[str, FloatArray]) -> Any:
        """Return the steady filter at values of the positions."""
        sample = self._sample(values)
        return solve_dare(sample.A, sample.C[self.y], Q=sample.G @ sample.G.T, R=self.R)

    def frozen(self) -> Callable[[int], FloatArray]:
        """Return the steady gain where the plant stands."""
        standing = {n: np.array([v]) for n, v in self.machine.path.standing.items()}
        gain = self._correcting(standing)
        return lambda k: gain

    def scheduled(self) -> Callable[[int], FloatArray]:
        """Return steady gains of some positions on the way, linear between them."""
        if len(self.moved) != 1:
            raise ModelError(
                f"gains are scheduled by one position, and {', '.join(self.moved) or 'none'} "
                "moves. Name one, or take others as functions of it in a PlaceTable."
            )
        (name,) = self.moved
        path = self.machine.path.at(self.time)[name]
        grid = np.linspace(path.min(), path.max(), self.count)
        if np.ptp(path) == 0.0:
            gain = self._correcting(self.machine.path.at(np.zeros(1)))
            return lambda k: gain
        still = self.machine.path.at(np.zeros(1))
        gains = np.array([self._correcting(still | {name: np.array([v])}) for v in grid])
        step = grid[1] - grid[0]

        def gain_at(k: int) -> FloatArray:
            place = min((path[k] - grid[0]) / step, self.count - 1.0)
            i = min(int(place), self.count - 2)
            share = place - i
            return np.asarray((1.0 - share) * gains[i] + share * gains[i + 1])

        return gain_at

    def _correcting(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return the gain M (n, ny) of the correction x[k|k] = x[k|k-1] + M e."""
        C = self._sample(values).C[self.y]
        P = self.steady(values).P
        return np.asarray(np.linalg.solve(C @ P @ C.T + self.R, C @ P).T)

    def run(
        self, P: FloatArray, gain: Callable[[int], FloatArray] | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the deviations along the trajectory, and the covariance after it."""
        rms = np.zeros((len(self.z), self.steps))
        one = np.eye(len(P))
        for k, sample in enumerate(self.machine.each(self.steps)):
            C = sample.C[self.y]
            M = np.linalg.solve(C @ P @ C.T + self.R, C @ P).T if gain is None else gain(k)
            left = one - M @ C
            P = left @ P @ left.T + M @ self.R @ M.T
            shown = sample.C[self.z]
            rms[:, k] = np.sqrt(np.einsum("ij,jk,ik->i", shown, P, shown))
            if np.any(rms[:, k] > _LOST * rms[:, 0]):
                rms[:, k:] = rms[:, k : k + 1]  # grows for ever: soon beyond all numbers
                break
            P = symmetrised(sample.A @ P @ sample.A.T + sample.G @ sample.G.T)
        return rms, P


def _constant(value: float) -> Callable[[FloatArray], FloatArray]:
    return lambda time: np.full(time.size, value)


def estimate_along(
    plant: StandardPlant, records: Mapping[str, Any], *, moving: Mapping[str, Any]
) -> dict[str, FloatArray]:
    """Return what the exact filter of a machine on the move makes of a record.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, with ports that move.
    records : mapping {name: (n_time,) array}
        Sensors y and commands u, by name; a `Response` serves.
    moving : mapping {position: path}
        Where the machine was, as for `simulate`.

    Returns
    -------
    dict {str: (n_time,) array}
        Estimates `die:z` of every motion of the POIs, y of the same sample included.

    Raises
    ------
    LabelError
        When a sensor, command or position is unknown.
    ModelError, ShapeError
        As `filters_along`; when records differ in length.

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
    data = np.array([real_array(records[n], n, (count,)) for n in needed])
    filters = _Filters(plant, moving, count * float(plant.dt), 2)
    P = filters.steady(filters.machine.path.at(np.zeros(1))).P
    x, one = np.zeros(len(P)), np.eye(len(P))
    found = np.zeros((len(filters.z), count))
    u = slice(len(plant.w), None)
    y, commands = data[: len(sensors)], data[len(sensors) :]
    for k, sample in enumerate(filters.machine.each(count)):
        x, P = _measurement_update(sample, filters, x, P, y[:, k], one)
        found[:, k] = sample.C[filters.z] @ x
        x = sample.A @ x + sample.B[:, u] @ commands[:, k]
        P = symmetrised(sample.A @ P @ sample.A.T + sample.G @ sample.G.T)
    return dict(zip(filters.names, found, strict=True))


def _measurement_update(
    sample: Sample, filters: _Filters, x: FloatArray, P: FloatArray, y: FloatArray, one: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return state and covariance corrected by a measurement."""
    C = sample.C[filters.y]
    M = np.linalg.solve(C @ P @ C.T + filters.R, C @ P).T
    left = one - M @ C
    return x + M @ (y - C @ x), left @ P @ left.T + M @ filters.R @ M.T
