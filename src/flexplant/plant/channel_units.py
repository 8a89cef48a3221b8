"""The SI unit of every channel of a machine, as its ports tell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..labels import Place
from .forces import BaseAcceleration, OutputDisturbance
from .ports import Ports, Sensor

_PER_TIME = {"displacement": "", "velocity": "/s", "acceleration": "/s^2"}


def channel_units(ports: Ports) -> dict[str, str]:
    """Return {channel: unit} of w, u, z, y and of what is derived from them.

    Forces N or N m, motions m or rad (per s, per s^2), as the directions say; noises like their
    sensors, references, errors and estimates like their POI, efforts like their actuator. A sum of
    displacements and rotations has no unit, and is left out. Filters of ports do not change units.

    Parameters
    ----------
    ports : Ports
        The channels.
    """
    found: dict[str, str | None] = {}
    for sensor in ports.y:
        found[sensor.name] = found[f"{sensor.name}:noise"] = _sensed(sensor)
    for port in ports.forces:
        if isinstance(port, OutputDisturbance):
            found[port.name] = _sensed(ports.sensor(port.sensor))
        elif isinstance(port, BaseAcceleration):
            found[port.name] = _motion(_turns({}, port.direction), "acceleration")
        else:
            turns = _turns(port.at, port.direction)
            found[port.name] = None if turns is None else "N m" if turns else "N"
    for actuator in ports.u:
        found[f"{actuator.name}:effort"] = found[actuator.name]
    for poi in ports.z:
        for axis in poi.axes:
            # a label gives the place alone: its direction is replaced by the axis
            turns = _turns(poi.at if isinstance(poi.at, Mapping) else {}, axis)
            found[poi.channel(axis)] = unit = _motion(turns, "displacement")
            found |= {poi.derived(axis, kind): unit for kind in ("ref", "error", "hat")}
    return {name: unit for name, unit in found.items() if unit is not None}


def plant_units(plant: Any) -> dict[str, str]:
    """Return {channel: unit} of a plant, and of what its ports derive: estimates, too."""
    derived = channel_units(plant.assembled.ports) if plant.is_assembled else {}
    return derived | dict(plant.system.units)


def _sensed(sensor: Sensor) -> str | None:
    return _motion(_turns(sensor.at, sensor.direction), sensor.quantity)


def _motion(turns: bool | None, quantity: str) -> str | None:
    return None if turns is None else ("rad" if turns else "m") + _PER_TIME[quantity]


def _turns(at: Place, direction: str) -> bool | None:
    """Return whether a place moves by rotation; None for a sum of both kinds."""
    places = list(at) if isinstance(at, Mapping) else [at]
    kinds = {
        (place.rpartition(":")[2] if isinstance(place, str) else direction).startswith("r")
        for place in places
    } or {direction.startswith("r")}
    return kinds.pop() if len(kinds) == 1 else None
