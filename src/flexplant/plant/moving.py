"""Places that move: POIs along a trajectory, and actuators or sensors put elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..checks import FloatArray, Value, instance, real_array
from ..errors import LabelError, ModelError, unknown_label
from .building import P, rebuilt, wired
from .forces import Actuator, Disturbance
from .partition import Partition
from .ports import Poi, Ports, Sensor


@dataclass(frozen=True, eq=False, repr=False)
class Along(Value):
    """What depends on the place of one port, at many points: rows of C and D, or a column of B.

    Parameters
    ----------
    name : str
        The port.
    points : (p, 3) array [m]
        The places.
    channels : sequence of str
        Of z for a POI, the one input of an actuator or disturbance.
    C : (p, channels, n) array
        A POI's rows over the plant's states: ``z = C[i] x + D[i] [w; u]`` while it is at point i.
    D : (p, channels, inputs) or (p, outputs, 1) array
        Rows of a POI, or columns of a force.
    B : (p, n, 1) array
        Columns of a force; without any for a POI.

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
        if len(ports.z) != 1:
            raise LabelError(
                f"the plant has {len(ports.z)} POIs "
                f"({', '.join(port.name for port in ports.z) or 'none'}): say which moves, "
                "at({name: point})."
            )
        places = {ports.z[0].name: places}
    for name in places:
        _port(ports, name)

    def there(side: Any) -> list[Any]:
        return [_put(p, places[p.name], ports) if p.name in places else p for p in side]

    return ports.replace(w=there(ports.w), u=there(ports.u), z=there(ports.z), y=there(ports.y))


def _put(port: Any, place: Any, ports: Ports) -> Any:
    """Return a port elsewhere; one that moves goes on from there."""
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
    if not moves or grounds or own.realisation.static_outputs.size or not all(map(_is_row, moves)):
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
    return wired(type(plant), own.replace(ports=ports, physical=physical, continuous=whole))


def _is_row(port: Any) -> bool:
    """Return whether a port is a row of C and nothing else."""
    if isinstance(port, Poi):
        return True
    is_sensor = isinstance(port, Sensor) and not port.order
    return is_sensor and port.filter is None and not port.latency


def along(plant: Partition, name: str, points: npt.ArrayLike) -> Along:
    """Return what depends on the place of a POI or a force, at many points at once."""
    if plant.is_weighted:
        raise ModelError(f"the plant is {plant.alteration}: a port moves on plant.unweighted.")
    places = real_array(points, "points", (None, 3))
    port = _port(plant.assembled.ports, name)
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


def _poi_along(plant: Partition, poi: Poi, points: FloatArray) -> Along:
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
        return Along(poi.name, points, tuple(shown), C, D, np.zeros((points.shape[0], 0, 1)))
    for k, axis in enumerate(poi.axes):
        rows = realisation.model.rows(points, axis)
        C[:, k, plant.modal_states] = realisation.motion(rows, 0)
    for k, axis in enumerate(tracked, len(channels)):
        C[:, k] = -C[:, list(poi.axes).index(axis)]
    return Along(poi.name, points, tuple(shown), C, D, np.zeros((points.shape[0], 0, 1)))


def _force_along(plant: Partition, port: Actuator | Disturbance, points: FloatArray) -> Along:
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
    return Along(port.name, points, (port.name,), np.zeros((points.shape[0], 0, g.n_states)), D, B)


def _elsewhere(plant: Partition, name: str, point: FloatArray) -> Partition:
    """Return the plant with one port at a point."""
    return rebuilt(plant, ports=moved_ports(plant.assembled.ports, {name: point.tolist()}))
