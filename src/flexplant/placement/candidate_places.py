"""Where candidates and POIs are: points, seen from above where zones are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError, require_known
from ..plant import StandardPlant
from ..structure import Disc, Rectangle
from ..values import FloatArray

Zone = Rectangle | Disc
#: places closer than this part of the largest distance between candidates are the same
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Places:
    """Names of the candidates, the points of each (p, 3) [m] and those of the POIs."""

    names: tuple[str, ...]
    points: tuple[FloatArray, ...]
    pois: tuple[FloatArray, ...]

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return len(self.names)

    @property
    def same(self) -> float:
        """Points closer than this [m] are the same."""
        every = np.vstack([*self.points, *self.pois])
        return _SAME * float(np.max(np.ptp(every, axis=0), initial=0.0))

    def index(self, names: Sequence[str], what: str) -> list[int]:
        """Return the places of candidates by name."""
        require_known(what, names, self.names)
        return [self.names.index(name) for name in names]

    def inside(self, zones: Sequence[Zone]) -> FloatArray:
        """Return 1 for candidates with any point in any zone, seen from above, else 0."""
        self.require_points()
        hit = [any(np.any(zone.holds(p[:, :2])) for zone in zones) for p in self.points]
        return np.array(hit, dtype=np.float64)

    def distances(self, others: Sequence[FloatArray]) -> FloatArray:
        """Return the least distance [m] of each candidate (rows) to each of other points."""
        self.require_points()
        found = [
            [np.min(np.linalg.norm(p[:, None] - q[None], axis=2)) for q in others]
            for p in self.points
        ]
        return np.array(found, dtype=np.float64).reshape(self.total, len(others))

    def require_points(self) -> None:
        """Raise ModelError where it is not known where candidates are."""
        if len(self.points) < self.total:
            raise ModelError(
                "the plant was made elsewhere, and where its sensors and actuators are is not "
                "known: constraints on places have no meaning. Use Together, Among or Budget, "
                "which go by names, or leave candidates out of the list."
            )


def places_of(plant: StandardPlant, candidates: Sequence[Any]) -> Places:
    """Return where candidates and POIs are; a port with several points is at each of them.

    Of a plant made elsewhere no places are known.
    """
    if not plant.is_assembled:
        return Places(tuple(port.name for port in candidates), (), ())
    dofs = plant.assembled.realisation.model.full_dofs

    def points(at: Any) -> FloatArray:
        if isinstance(at, str):
            return np.array(dofs.location(at)[None], dtype=np.float64)
        if isinstance(at, Mapping):
            return np.vstack([points(place) for place in at])
        return np.array([at], dtype=np.float64)

    return Places(
        tuple(port.name for port in candidates),
        tuple(points(port.at) for port in candidates),
        tuple(points(poi.at) for poi in plant.assembled.ports.z),
    )
