"""The SI unit of every channel of a machine, as its ports tell."""

from __future__ import annotations

from typing import Any

from .ports import Ports


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
    found = {port.name: port.unit for port in ports.physical}
    for port in ports.w:
        if port.added_to is not None:
            found[port.name] = found[port.added_to]
    found |= {f"{sensor.name}:noise": sensor.unit for sensor in ports.y}
    found |= {f"{actuator.name}:effort": actuator.unit for actuator in ports.u}
    for poi in ports.z:
        for axis in poi.axes:
            found[poi.channel(axis)] = unit = poi.unit(axis)
            found |= {poi.derived(axis, kind): unit for kind in ("ref", "error", "hat")}
    return {name: unit for name, unit in found.items() if unit is not None}


def plant_units(plant: Any) -> dict[str, str]:
    """Return {channel: unit} of a plant, and of what its ports derive: estimates, too."""
    derived = channel_units(plant.assembled.ports) if plant.is_assembled else {}
    return derived | dict(plant.system.units)
