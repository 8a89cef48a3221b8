"""Constraints on where devices may be: zones, off the die, at a distance from each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..checks import checked, number, positive, short, whole
from ..errors import ModelError
from ..structure import Disc
from .candidates import Places, Zone
from .groups import Constraint, check_limits
from .rows import LinearRows


def _zones(given: Any, name: str) -> tuple[Zone, ...]:
    listed = (given,) if isinstance(given, Zone) or not isinstance(given, Sequence) else given
    for zone in listed:
        if not isinstance(zone, Zone):
            raise ModelError(
                f"{name} is a Rectangle or a Disc, got {short(zone)}. Type "
                "Disc((0.3, 0.3), radius=0.05)."
            )
    if not listed:
        raise ModelError(f"there is no zone: {name} is a Rectangle or a Disc. Give one.")
    return tuple(listed)


@dataclass(frozen=True, eq=False)
class Excluded(Constraint):
    """Zones in which no candidate is chosen, seen from above.

    Parameters
    ----------
    zones : Rectangle, Disc or sequence of them
        At least one.

    Raises
    ------
    ModelError
        When a zone is something else, or there is none.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> off = fx.placement.Excluded(fx.Disc((0.0, 0.0), radius=0.5))  # where the first mass is
    >>> fx.place_sensors(plant, candidates, 1, constraints=[off]).chosen
    ('s3',)
    """

    zones: Zone | Sequence[Zone] = field(metadata=checked(_zones, name="an excluded zone"))

    def rows(self, places: Places) -> LinearRows:
        """Return x_i <= 0 inside."""
        return LinearRows.closed(places.inside(_listed(self.zones)) > 0)

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return the zones."""
        return _listed(self.zones)


@dataclass(frozen=True, eq=False)
class OffPoi(Constraint):
    """No candidate on a POI: what is there cannot be measured.

    Sensors are never placed on the point of a POI. A radius keeps them off the whole die; a
    negative one allows all places.

    Parameters
    ----------
    radius : float [m]
        Candidates with a point no farther from any POI are excluded.

    Raises
    ------
    ModelError
        When the radius is no finite number.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> anywhere = fx.placement.OffPoi(-1)  # the middle mass, where the POI is, is free too
    >>> fx.place_sensors(plant, candidates, 1, constraints=[anywhere]).chosen
    ('s2',)
    """

    radius: float = field(default=0.0, metadata=checked(number))

    def rows(self, places: Places) -> LinearRows:
        """Return x_i <= 0 near a POI."""
        if self.radius < 0 or not places.pois:
            return LinearRows.closed(np.zeros(places.total, dtype=bool))
        near = places.distances(places.pois).min(axis=1)
        return LinearRows.closed(near <= self.radius + places.same)

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return discs about the POIs."""
        if self.radius <= 0:
            return ()
        return tuple(Disc(point[:2], self.radius) for poi in places.pois for point in poi)


@dataclass(frozen=True, eq=False)
class Within(Constraint):
    """Limits on how many chosen candidates lie in zones, seen from above; by default all do.

    Parameters
    ----------
    zones : Rectangle, Disc or sequence of them
        At least one; their union counts.
    at_least, at_most : int, optional
        How many. A candidate is inside when any of its points is.

    Raises
    ------
    ModelError
        When a zone or a count is not of its kind, or at_least is above at_most.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> right = fx.placement.Within(fx.Rectangle((1.5, -1.0), (2.5, 1.0)), at_least=1)
    >>> fx.place_sensors(plant, candidates, 1, constraints=[right]).chosen
    ('s3',)
    """

    zones: Zone | Sequence[Zone] = field(metadata=checked(_zones, name="a zone"))
    at_least: int | None = field(default=None, kw_only=True, metadata=checked(whole, minimum=0))
    at_most: int | None = field(default=None, kw_only=True, metadata=checked(whole, minimum=0))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(self.at_least, self.at_most)

    def rows(self, places: Places) -> LinearRows:
        """Return the count inside between its check_limits, or x_i <= 0 outside."""
        inside = places.inside(_listed(self.zones))
        if self.at_least is None and self.at_most is None:
            return LinearRows.closed(inside == 0)
        return LinearRows.counted(inside, self.at_least, self.at_most)


def _listed(zones: Zone | Sequence[Zone]) -> tuple[Zone, ...]:
    return (zones,) if isinstance(zones, Zone) else tuple(zones)


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

    distance: float = field(metadata=checked(positive))

    def rows(self, places: Places) -> LinearRows:
        """Return x_i + x_j <= 1 for each pair that is too close."""
        close = places.distances(places.points) < self.distance - places.same
        first, second = np.nonzero(np.triu(close, 1))
        pairs = np.zeros((first.size, places.total))
        line = np.arange(first.size)
        pairs[line, first] = pairs[line, second] = 1.0
        return LinearRows(pairs, np.zeros(first.size), np.ones(first.size))


def rows_of(constraints: Any, places: Places, side: str) -> LinearRows:
    """Return the rows of all constraints, OffPoi() among them for sensors unless one is given."""
    return LinearRows.stacked([c.rows(places) for c in all_of(constraints, side)], places.total)


def all_of(constraints: Any, side: str) -> tuple[Constraint, ...]:
    """Return constraints as a tuple, OffPoi() among them for sensors unless one is given."""
    given = constraints_of(constraints)
    usual = "y" in side and not any(isinstance(item, OffPoi) for item in given)
    return (*given, OffPoi()) if usual else given


def constraints_of(constraints: Any) -> tuple[Constraint, ...]:
    """Return a constraint, or several, as a tuple."""
    given = (constraints,) if isinstance(constraints, Constraint) else constraints
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise ModelError(
            f"constraints are a list of Excluded(...), MinimumDistance(...) and others, got "
            f"{short(given)}. Put them in a list."
        )
    for item in given:
        if not isinstance(item, Constraint):
            raise ModelError(
                f"a constraint is Excluded(...), MinimumDistance(...) or another such value, got "
                f"{short(item)}. Write Excluded(Disc((0.3, 0.3), radius=0.05)), say."
            )
    return tuple(given)
