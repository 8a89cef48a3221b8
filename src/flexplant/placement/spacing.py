"""A minimum distance between devices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..values import positive
from .candidate_places import Places
from .constraint import Constraint
from .rows import LinearRows


@dataclass(frozen=True, eq=False)
class MinimumDistance(Constraint):
    """A smallest distance between any two chosen candidates.

    Parameters
    ----------
    distance : float [m]
        Between the nearest points of the two.

    Raises
    ------
    ModelError
        When it is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> apart = fx.placement.MinimumDistance(1.5)
    >>> fx.place_sensors(plant, candidates, 2, constraints=[apart]).chosen
    ('s1', 's3')
    """

    distance: float

    def __post_init__(self) -> None:
        self._set(distance=positive(self.distance, "distance"))

    def rows(self, places: Places) -> LinearRows:
        """Return x_i + x_j <= 1 for each pair that is too close."""
        close = places.distances(places.points) < self.distance - places.same
        first, second = np.nonzero(np.triu(close, 1))
        pairs = np.zeros((first.size, places.total))
        line = np.arange(first.size)
        pairs[line, first] = pairs[line, second] = 1.0
        return LinearRows(pairs, np.zeros(first.size), np.ones(first.size))
