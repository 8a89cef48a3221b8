"""A machine that moves: its plants with ports elsewhere, and what the position does."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, function, instance, number, real_array
from ..errors import AssumptionError, LabelError, ModelError, only_one, short, unknown_label
from ..store import Value
from .axes import real_gain
from .building import P, changed_densities, wired
from .decoupling import Decoupling, decouple
from .forces import Actuator, Disturbance
from .partitioned import Partition
from .ports import Poi, Ports, Sensor
from .remade import rebuilt
from .scheduling import values_over
from .visibility import WEAK, mode_visibility


@dataclass(frozen=True, eq=False, repr=False)
class PortPath(Value):
    """Rows of C and D, or columns of B and D, of one port that is placed at many points.

    Parameters
    ----------
    name : str
        Name of the port.
    points : (p, 3) array [m]
        Points at which the port is placed.
    channels : sequence of str
        Channels of z for a POI, or the one input of an actuator or disturbance.
    C : (p, channels, n) array
        Rows of a POI over the states of the plant. While the POI is at point i,
        ``z = C[i] x + D[i] [w; u]``.
    D : (p, channels, inputs) or (p, outputs, 1) array
        Rows of a POI, or columns of a force.
    B : (p, n, 1) array
        Columns of a force; empty for a POI.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> along = plant.along("die", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    >>> along.C.shape  # points, channels, states
    (2, 2, 7)
    """

    name: str
    points: FloatArray
    channels: tuple[str, ...]
    C: FloatArray
    D: FloatArray
    B: FloatArray


def moved_ports(ports: Ports, places: Any) -> Ports:
    """Return ports with some of them elsewhere; one POI, or {name: place} of any ports."""
    if not isinstance(places, Mapping):
        places = {only_one("POI", [p.name for p in ports.z], None, "at({name: point})"): places}
    for name in places:
        _port(ports, name)

    def there(side: Any) -> list[Any]:
        return [_put(p, places[p.name], ports) if p.name in places else p for p in side]

    return ports.replace(w=there(ports.w), u=there(ports.u), z=there(ports.z), y=there(ports.y))


def _put(port: Any, place: Any, ports: Ports) -> Any:
    """Return a port elsewhere; one that moves goes on from there."""
    if not isinstance(place, Mapping):
        _require_single(port)
    moves = getattr(port, "moves", None)
    if moves is None:
        return port.replace(at=place)
    new = port.replace(at=place, moves=None)
    return new.replace(moves=moves.starting(new.at, ports.values))


def seen_elsewhere(plant: P, ports: Ports) -> P | None:
    """Return a plant whose sensors and POIs alone are elsewhere: rows of C; None where more is."""
    own = plant.assembled
    sides = [(getattr(own.ports, side), getattr(ports, side)) for side in "wuzy"]
    pairs = [pair for old, new in sides for pair in zip(old, new, strict=True)]
    moves = [new for old, new in pairs if getattr(old, "at", None) != getattr(new, "at", None)]
    grounds = any(np.any(port.ground) for port in ports.w)
    more = grounds or own.realisation.static_outputs.size or changed_densities(plant)
    if not moves or more or not all(map(_is_row, moves)):
        return None
    rows: dict[str, FloatArray] = {}
    for port in moves:
        if isinstance(port, Poi):
            seen = {port.channel(axis): port.see(own.realisation, axis) for axis in port.axes}
        else:
            seen = {port.name: port.see(own.realisation)}
        rows |= {name: one.row for name, one in seen.items()}
    outputs, names = own.physical.output_index(list(rows)), own.realisation.names
    if np.any(own.physical.D[outputs]):
        return None  # what follows a force at once depends on the place too
    C = np.array(own.physical.C)
    at = np.ix_(outputs, own.physical.states.index(names[0]) + np.arange(len(names)))
    C[at] = np.array(list(rows.values()))
    before = own.continuous
    whole = None if before is None else seen_elsewhere(before, ports)
    physical = own.physical.replace(C=C)
    judged = None if plant.evaluation is None else plant.evaluation.with_ports(ports)
    return wired(type(plant), own.replace(ports=ports, physical=physical, continuous=whole), judged)


def _is_row(port: Any) -> bool:
    """Return whether a port is a row of C and nothing else."""
    if isinstance(port, Poi):
        return True
    is_sensor = isinstance(port, Sensor) and not port.order
    return is_sensor and port.filter is None and not port.latency


def along(plant: Partition, name: str, points: npt.ArrayLike) -> PortPath:
    """Return what depends on the place of a POI or a force, at many points at once."""
    places = real_array(points, "points", (None, 3))
    port = _port(plant.assembled.ports, name)
    _require_single(port)
    if isinstance(port, Poi):
        return _poi_along(plant, port, places)
    if isinstance(port, Actuator | Disturbance):
        return _force_along(plant, port, places)
    raise ModelError(
        f"{name!r} is a {type(port).__name__}: POIs, actuators and disturbances move along points. "
        "plant.at({name: point}) moves any port."
    )


def _port(ports: Ports, name: str) -> Any:
    instance(name, str, "name", "Pass the name of a port.", LabelError)
    pois = [poi for poi in ports.z if poi.name == name]
    others = [port for port in ports.physical if port.name == name]
    found = pois or others
    if not found:
        known = [port.name for port in (*ports.z, *ports.physical)]
        raise unknown_label("POI", name, known)
    if len(found) > 1:
        raise LabelError(f"{name!r} names an input and a sensor: rename one to move the other.")
    if not hasattr(found[0], "at"):
        raise LabelError(f"{name!r} has no place: it is a {type(found[0]).__name__}.")
    return found[0]


def _require_single(port: Any) -> None:
    """Raise ModelError for a port between points: one place does not say where all of them are."""
    weights = list(port.at.values()) if isinstance(port.at, Mapping) else []
    if weights and min(weights) < 0.0 < max(weights):
        raise ModelError(
            f"{port.name!r} is a motion or force between points, {short(dict(port.at))}: one place "
            "does not say where each of them moves. Pass the new mapping, "
            "plant.at({name: mapping}), for each position."
        )


def _poi_along(plant: Partition, poi: Poi, points: FloatArray) -> PortPath:
    g, realisation = plant.system, plant.assembled.realisation
    tracked = [axis for own, axis in plant.assembled.ports.followed if own.name == poi.name]
    channels = [poi.channel(axis) for axis in poi.axes]
    shown = [*channels, *(poi.derived(axis, "error") for axis in tracked)]
    at = g.output_index(shown)
    C = np.zeros((points.shape[0], len(shown), g.n_states))
    D = np.repeat(g.D[at][None], points.shape[0], axis=0)
    carried = poi.absolute and any(np.any(port.ground) for port in plant.assembled.ports.w)
    if realisation.static_outputs.size or carried:
        # forces reach a POI at once too, the ground by its shape: of the whole plant
        for i, point in enumerate(points):
            there = _elsewhere(plant, poi.name, point).system
            C[i], D[i] = there.C[at], there.D[at]
    else:
        for k, axis in enumerate(poi.axes):
            rows = realisation.model.rows(points, axis)
            C[:, k, plant.modal_states] = realisation.motion(rows, 0)
        for k, axis in enumerate(tracked, len(channels)):
            C[:, k] = -C[:, list(poi.axes).index(axis)]
    return PortPath(poi.name, points, tuple(shown), C, D, np.zeros((points.shape[0], 0, 1)))


def _force_along(plant: Partition, port: Actuator | Disturbance, points: FloatArray) -> PortPath:
    if plant.dt or port.filter is not None:
        raise ModelError(
            f"the place of {port.name!r} acts through a filter, a hold or a delay, so that more "
            "than a column of B depends on it. Use plant.continuous.along for a force without "
            "dynamics, or plant.at({name: point}) point by point."
        )
    g, realisation = plant.system, plant.assembled.realisation
    i = int(g.input_index([port.name])[0])
    B = np.zeros((points.shape[0], g.n_states, 1))
    rows = realisation.model.rows(points, port.direction)
    B[:, plant.modal_states, 0] = rows @ realisation.inputs
    D = np.repeat(g.D[None, :, i : i + 1], points.shape[0], axis=0)
    at_once = any(np.any(one.see(realisation).direct) for one in plant.assembled.ports.y)
    if at_once or realisation.static_inputs.size:
        for k, point in enumerate(points):
            D[k] = _elsewhere(plant, port.name, point).system.D[:, i : i + 1]
    return PortPath(
        port.name, points, (port.name,), np.zeros((points.shape[0], 0, g.n_states)), D, B
    )


def _elsewhere(plant: Partition, name: str, point: FloatArray) -> Partition:
    """Return the plant with one port at a point."""
    return rebuilt(plant, moved_ports(plant.assembled.ports, {name: point.tolist()}))


logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, repr=False)
class PositionMap(Value):
    """Figures of a machine as functions of its position; made by `StandardPlant.map`.

    Parameters
    ----------
    grid : mapping {name: (k,) array} [m or rad]
        The values of each position.
    decoupling : (..., 2) array
        Errors of the decoupling at each place of the grid, first of the sensors, then of the
        actuators. The transformations that `decouple` gives for the plant at its present position
        are applied to the plant at each place of the grid. The error is the largest gain of the
        difference between the result and the identity; it is 0 where the decoupling is still exact.
        To compare displacements and rotations, each axis is scaled by the displacement that it
        causes at the sensors. NaN where the actuators cannot move the axes independently.
    seen, reached : (..., m) arrays
        Shares of each elastic mode at the best sensor and actuator (`ModeVisibility`).
    modes : (m,) sequence of str
        The elastic modes; for a sampled plant those below half its sampling rate.
    figures : mapping {name: (...) array}
        Additional figures that you compute.

    Examples
    --------
    >>> import flexplant as fx
    >>> one = fx.plant.PositionMap(
    ...     {"x": [0.0, 0.1]}, [[0, 0], [0.1, 0.2]], [[1.0], [0.5]], [[1.0], [0.9]], ["mode 7"], {}
    ... )
    >>> print(one)
    <PositionMap: x 0 to 0.1, 2 points
      decoupling off by up to 0.2, at x = 0.1
      mode 7 least seen or reached: 0.5 of its best, at x = 0.1>
    """

    grid: Mapping[str, FloatArray]
    decoupling: FloatArray
    seen: FloatArray
    reached: FloatArray
    modes: tuple[str, ...]
    figures: Mapping[str, FloatArray]

    def __post_init__(self) -> None:
        grid = {name: real_array(values, name, (None,)) for name, values in self.grid.items()}
        shape = tuple(values.size for values in grid.values())
        modes = tuple(self.modes)
        own = {"decoupling": np.asarray(self.decoupling, dtype=np.float64)}
        for name in ("seen", "reached"):
            own[name] = real_array(getattr(self, name), name, (*shape, len(modes)))
        figures = {
            str(name): np.asarray(values, dtype=np.float64).reshape(shape)
            for name, values in self.figures.items()
        }
        self._set(grid=grid, modes=modes, figures=figures, **own)

    def __repr__(self) -> str:
        ranges = ", ".join(f"{n} {v[0]:g} to {v[-1]:g}" for n, v in self.grid.items())
        lines = [f"<PositionMap: {ranges}, {self.size} points"]
        if np.any(np.isfinite(self.decoupling)):
            worst = self.decoupling.max(axis=-1)
            lines.append(f"decoupling off by up to {worst.max():.3g}, {self._where(worst, True)}")
        if np.any(self.ever):
            least = self.weakest
            at = np.unravel_index(int(np.argmin(least)), least.shape)
            mode = np.array(self.modes)[self.ever][int(np.argmin(self.visible[at][self.ever]))]
            lines.append(
                f"{mode} least seen or reached: {least[at]:.2g} of its best, "
                f"{self._where(least, False)}"
            )
        for name, values in self.figures.items():
            lines.append(
                f"{name} {np.nanmin(values):.4g}, {self._where(values, False)}, "
                f"to {np.nanmax(values):.4g}, {self._where(values, True)}"
            )
        return "\n  ".join(lines) + ">"

    @property
    def size(self) -> int:
        """The number of places."""
        return int(np.prod([values.size for values in self.grid.values()]))

    @property
    def visible(self) -> FloatArray:
        """The share (..., m) of each mode in the loop: the smaller one of `seen` and `reached`."""
        return np.minimum(self.seen, self.reached)

    @property
    def ever(self) -> npt.NDArray[np.bool_]:
        """Whether each mode (m,) has a share of at least 1 % at some place of the grid."""
        most = self.visible.reshape(-1, len(self.modes)).max(axis=0, initial=0.0)
        return np.asarray(most >= WEAK)

    @property
    def weakest(self) -> FloatArray:
        """The smallest share (...) at each place, of the modes for which `ever` is true."""
        return np.asarray(self.visible[..., self.ever].min(axis=-1, initial=1.0))

    def _where(self, values: FloatArray, largest: bool) -> str:
        best = np.nanargmax(values) if largest else np.nanargmin(values)
        at = np.unravel_index(int(best), values.shape)
        pairs = zip(self.grid.items(), at, strict=True)
        return "at " + ", ".join(f"{name} = {grid[i]:.3g}" for (name, grid), i in pairs)


def position_map(plant: Any, judge: Any, points: Any) -> PositionMap:
    """Return the figures of a plant over its positions."""
    positions = plant.assembled.ports.positions
    if not positions:
        raise LabelError(
            "the plant has no positions: nothing of it moves. Give ports moves={'x': (-1, 0, 0)} "
            "and Ports(..., positions=[fx.plant.Position('x', range=(-0.1, 0.1))])."
        )
    judges = _named_judges(judge)
    grid = values_over(positions, points)
    own = _decoupled(plant)
    rows: list[tuple[Any, ...]] = []
    modes: tuple[str, ...] = ()
    for values in product(*grid.values()):
        there = plant.at(**dict(zip(grid, values, strict=True)))
        # of a sampled plant the modes that its controller sees as they are
        most = 0.5 / plant.dt if plant.dt else np.inf
        shares = [one for one in mode_visibility(there) if one.freq < most]
        modes = tuple(f"mode {one.mode} ({one.freq:.4g} Hz)" for one in shares)
        sees, pushes = ([one.shares.get(side, 0.0) for one in shares] for side in "yu")
        rows.append((_misses(own, there), sees, pushes, list(_figures_at(judges, there))))
    shape = tuple(values.size for values in grid.values())
    decoupling, seen, reached, judged = (
        np.array(part, dtype=float).reshape(*shape, len(part[0]))
        for part in zip(*rows, strict=True)
    )
    figures = {name: judged[..., i] for i, name in enumerate(judges)}
    return PositionMap(grid, decoupling, seen, reached, modes, figures)


def _named_judges(judge: Any) -> dict[str, Callable[[Any], float]]:
    """Return named functions of a plant."""
    hint = "Pass a function of a plant, or {'margin': function}."
    if judge is None:
        return {}
    given = judge if isinstance(judge, Mapping) else {getattr(judge, "__name__", "figure"): judge}
    return {
        "figure" if name == "<lambda>" else str(name): function(one, f"judge {name!r}", hint)
        for name, one in given.items()
    }


def _figures_at(judges: Mapping[str, Callable[[Any], float]], plant: Any) -> Iterator[float]:
    """Return figures of a plant; each is one number."""
    for name, one in judges.items():
        try:
            yield number(one(plant), name)
        except ModelError as error:
            raise ModelError(f"{name!r} at {plant.assembled.ports.standing}: {error}") from error


def _decoupled(plant: Any) -> Decoupling | None:
    """Return the transformations of a plant as it stands; None where it has none."""
    try:
        return decouple(plant.machine)
    except (AssumptionError, ModelError) as error:
        logger.info("no decoupling is shown over the positions: %s", error)
        return None


def _misses(own: Decoupling | None, plant: Any) -> tuple[float, float]:
    """Return by what transformations miss the identity at another place: of sensors, actuators."""
    if own is None:
        return np.nan, np.nan
    plant, r = plant.machine, len(own.axes)
    sigma = 2.0 * np.pi * float(own.driven.freq[0])
    late = sigma**2 * np.exp(sigma * plant.dt * (plant.delay + 0.5))
    moved = late * real_gain(plant.system, sigma, own.axes, plant.u)
    shown = late * real_gain(plant.system, sigma, own.to_motions.inputs, plant.u)
    there = np.linalg.pinv(moved)
    # an axis counts by the length that makes it a displacement at the sensors
    arm = np.linalg.norm(np.linalg.pinv(own.T_y), axis=0)
    scale = arm[:, None] / arm
    seen = scale * (own.T_y @ shown @ there - np.eye(r))
    pushed = scale * (moved @ own.T_u - np.eye(r))
    return float(np.linalg.norm(seen, 2)), float(np.linalg.norm(pushed, 2))
