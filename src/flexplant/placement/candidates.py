"""Candidates: the sensors or actuators that may be chosen, by name, on one plant."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal, TypeAlias

from ..errors import LabelError, ModelError, unknown_label
from ..plant import Actuator, SensorPort, StandardPlant, standard_plant
from ..values import short

Port: TypeAlias = "SensorPort | Actuator"
Side: TypeAlias = Literal["y", "u"]

_NAME = {"y": "Sensor", "u": "Actuator"}
KIND: dict[str, type[Any]] = {"y": SensorPort, "u": Actuator}


def checked_plant(plant: StandardPlant) -> None:
    """Raise ModelError unless the plant is sampled, not weighted, and made of a structure."""
    plant = standard_plant(plant)  # a system with labels is one too, without a structure
    _ = plant.assembled
    if plant.is_weighted:
        raise ModelError(
            f"the plant is {plant.alteration}, placement needs the one before: plant.unweighted."
        )
    if not plant.dt:
        raise ModelError(
            "the plant is continuous, scores are of the sampled one: use "
            "plant.discretized(rate, delay=1)."
        )


def with_side(plant: StandardPlant, side: Side, chosen: Sequence[Port]) -> StandardPlant:
    """Return the plant with these sensors or actuators instead of its own."""
    return plant.with_ports(plant.assembled.ports.replace(**{side: tuple(chosen)}))


def known_candidates(plant: StandardPlant, side: Side, given: Iterable[Any]) -> dict[str, Port]:
    """Return candidates by name; a text stands for the plant's own sensor (actuator).

    Raises
    ------
    LabelError
        When a name is unknown, or two different candidates have the same one.
    ModelError
        When something is no Sensor (Actuator).
    """
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ModelError(
            f"candidates are a list of {_NAME[side]}s or names, got {short(given)}. "
            "Put them in a list."
        )
    own: dict[str, Port] = {p.name: p for p in getattr(plant.assembled.ports, side)}
    found: dict[str, Port] = {}
    for item in given:
        port = item
        if isinstance(item, str):
            port = found.get(item) or own.get(item)
            if port is None:
                raise unknown_label(_NAME[side].lower(), item, [*own, *found])
        if not isinstance(port, KIND[side]):
            raise ModelError(
                f"candidates are {_NAME[side]}s or names of the plant's, got "
                f"{short(port)}. Pass {_NAME[side]}(name, at=...)."
            )
        other = found.setdefault(port.name, port)
        if other is not port and other._fields() != port._fields():
            raise LabelError(
                f"two different candidates are called {port.name!r}: scores are kept by name. "
                "Rename one."
            )
    return found
