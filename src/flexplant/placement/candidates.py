"""Candidates: the sensors or actuators that may be chosen, by name, on one plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from ..arrays import FloatArray, several
from ..errors import LabelError, ModelError, require_known, short
from ..plant import Actuator, SensorPort, StandardPlant, standard_plant
from ..plant.origins import PlantChannel as PlantChannel
from ..plant.partitioned import require_sampled
from ..plant.scheduling import port_at, require_positions
from ..tolerances import TYPED
from .zones import Zone

Port: TypeAlias = SensorPort | Actuator | PlantChannel


#: what is chosen: sensors, actuators, or both
Side: TypeAlias = Literal["y", "u", "yu"]

#: what users call them
SIDES = {"sensors": "y", "actuators": "u"}
_NAME = {"y": "Sensor", "u": "Actuator"}


def side_of(port: Port) -> str:
    """Return "y" of a sensor and "u" of an actuator."""
    return str(port.home)


def sides_of(ports: Iterable[Port]) -> Any:
    """Return "y", "u" or "yu": what there is among some ports."""
    found = {side_of(port) for port in ports}
    return "".join(side for side in "yu" if side in found)


def sampled_plant(given: Any) -> StandardPlant:
    """Return a plant that is sampled and not weighted."""
    plant: StandardPlant = standard_plant(given)
    require_sampled(plant, "scores are of samples", ModelError)
    return plant


def with_side(plant: StandardPlant, side: str, chosen: Sequence[Port]) -> StandardPlant:
    """Return the plant with these sensors (actuators, or both) in place of those it has."""
    plant = standard_plant(plant)
    parts = {s: tuple(port for port in chosen if side_of(port) == s) for s in side}
    return plant.with_ports(plant.ports.replace(**parts))


def known_candidates(plant: StandardPlant, side: str, given: Iterable[Any]) -> dict[str, Port]:
    """Return candidates by name; a text stands for the plant's own sensor (actuator)."""
    if not several(given):
        raise ModelError(
            f"candidates are a list of {_NAME[side]}s or names, got {short(given)}. "
            "Put them in a list."
        )
    ports = plant.ports
    own = {port.name: port for port in getattr(ports, side)}
    found: dict[str, Port] = {}
    for port in given:
        if isinstance(port, str):
            known = own | found
            require_known(_NAME[side].lower(), [port], known)
            port = known[port]
        if not isinstance(port, SensorPort | Actuator | PlantChannel) or port.home != side:
            raise ModelError(
                f"candidates are {_NAME[side]}s or names of the plant's, got "
                f"{short(port)}. Pass {_NAME[side]}(name, at=...)."
            )
        require_positions([port], ports.positions)
        port = port_at(port, ports.values)  # one that moves is where the machine stands
        other = found.setdefault(port.name, port)
        if other is not port and other._fields() != port._fields():
            raise LabelError(
                f"two different candidates are called {port.name!r}: scores are kept by name. "
                "Rename one."
            )
    return found


@dataclass(frozen=True, eq=False)
class Places:
    """Names of the candidates, the points of each (p, 3) [m] and those of the POIs.

    Points of negative weight are what a port measures (or pushes) against. A relative POI is only
    where it is mounted, at its points of positive weight, or at the others if only the positive
    ones are touched by the plant's own relative sensors; a candidate is at all of its points.
    """

    names: tuple[str, ...]
    points: tuple[FloatArray, ...]
    pois: tuple[FloatArray, ...]
    mounted: tuple[FloatArray, ...] = ()
    #: the candidates that the plant has: what is measured there can be measured
    fitted: tuple[str, ...] = ()

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return len(self.names)

    @property
    def same(self) -> float:
        """Points closer than this [m] are the same."""
        every = np.vstack([*self.points, *self.pois])
        return TYPED * float(np.max(np.ptp(every, axis=0), initial=0.0))

    def index(self, names: Sequence[str], what: str) -> list[int]:
        """Return the places of candidates by name."""
        require_known(what, names, self.names)
        return [self.names.index(name) for name in names]

    def inside(self, zones: Sequence[Zone]) -> FloatArray:
        """Return 1 for candidates with any point in any zone, seen from above, else 0."""
        self.require_points()
        hit = [any(np.any(zone.holds(p[:, :2])) for zone in zones) for p in self.points]
        return np.array(hit, dtype=np.float64)

    def between(self) -> FloatArray:
        """Return the least distance [m] (N, N) of candidates; several may measure against one."""
        self.require_points()
        found = _least_distances(self.points, self.mounted)
        return np.minimum(found, found.T)

    def from_pois(self) -> FloatArray:
        """Return the least distance [m] (N,) of each candidate to any POI."""
        self.require_points()
        return np.asarray(_least_distances(self.points, self.pois).min(axis=1, initial=np.inf))

    def require_points(self) -> None:
        """Raise ModelError where it is not known where candidates are."""
        if len(self.points) < self.total:
            raise ModelError(
                "the plant was made elsewhere, and where its sensors and actuators are is not "
                "known: constraints on places have no meaning. Use JointGroups, CountLimits or "
                "Budget, which go by names, or leave candidates out of the list."
            )


def _least_distances(some: Sequence[FloatArray], others: Sequence[FloatArray]) -> FloatArray:
    """Return the least distance [m] of each set of points (rows) to each of other sets."""
    found = [[np.min(np.linalg.norm(p[:, None] - q[None], axis=2)) for q in others] for p in some]
    return np.array(found, dtype=np.float64).reshape(len(some), len(others))


#: [m] what lies between nodes of a structure whose coordinates are not known: beyond any distance
#: that a constraint may ask for
_APART = 1e6


def candidate_places(plant: StandardPlant, candidates: Sequence[Any]) -> Places:
    """Return where candidates and POIs are; a port with several points is at each of them."""
    names = tuple(port.name for port in candidates)
    if plant.model is None:  # foreign matrices: no places are known
        return Places(names, (), ())
    dofs, pois = plant.model.full_dofs, plant.ports.z
    relative = [port.at for port in plant.ports.y if isinstance(port.at, Mapping)]
    touched = {place for at in relative for place in at}
    own = (*plant.y, *plant.u)
    located = bool(np.any(np.ptp(dofs.xyz, axis=0)))

    def points(at: Any) -> FloatArray:
        if isinstance(at, str) and not located:  # nodes without coordinates are far apart
            return np.array([[_APART * dofs.nodes[dofs.index(at)], 0.0, 0.0]])
        if isinstance(at, str):
            return np.array(dofs.location(at)[None], dtype=np.float64)
        if isinstance(at, list):
            return np.vstack([points(place) for place in at])
        return np.array([at], dtype=np.float64)

    return Places(
        names,
        tuple(points(_several(port.at)) for port in candidates),
        tuple(points(_mounted(poi.at, touched)) for poi in pois),
        tuple(points(_mounted(port.at)) for port in candidates),
        tuple(name for name in names if name in own),
    )


def _several(at: Any) -> list[Any]:
    """Return the places of a port as a list."""
    return list(at) if isinstance(at, Mapping) else [at]


def _mounted(at: Any, touched: Set[Any] = frozenset()) -> list[Any]:
    """Return the places of positive weight; the others if only the positive ones are `touched`."""
    weights = at if isinstance(at, Mapping) else {at: 1.0}
    positive = [place for place, weight in weights.items() if weight > 0]
    others = [place for place in weights if place not in positive]
    swapped = not touched.isdisjoint(positive) and touched.isdisjoint(others)
    return (others if swapped else positive) or list(weights)
