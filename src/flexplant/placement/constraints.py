"""What a choice of places must satisfy: linear constraints on which candidates are chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import LabelError, ModelError, unknown_label
from ..structure import Disc
from ..values import FloatArray, Value, name_list, one_of, positive, real_array, short, whole
from .places import Places, Zone
from .rows import LinearRows


class Constraint(Value):
    """The base of all constraints: a new one defines `rows`."""

    def rows(self, places: Places) -> LinearRows:
        """Return linear rows in x, which is 1 for chosen candidates and 0 for others."""
        raise NotImplementedError

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return zones without candidates, seen from above, for pictures."""
        return ()


@dataclass(frozen=True, eq=False)
class Excluded(Constraint):
    """No candidate with a point inside any of the zones, seen from above.

    Parameters
    ----------
    zones : Rectangle, Disc or sequence of them
        At least one.

    Raises
    ------
    ModelError
        When a zone is something else, or there is none.
    """

    zones: Zone | Sequence[Zone]

    def __post_init__(self) -> None:
        self._set(zones=_zones(self.zones, "an excluded zone"))

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
    """

    radius: float = 0.0

    def __post_init__(self) -> None:
        self._set(radius=float(real_array(self.radius, "radius", ())))

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
    """So many of the chosen inside the zones, seen from above; all of them when no count is given.

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
    """

    zones: Zone | Sequence[Zone]
    at_least: int | None = field(default=None, kw_only=True)
    at_most: int | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        low, high = limits(self.at_least, self.at_most)
        self._set(zones=_zones(self.zones, "a zone"), at_least=low, at_most=high)

    def rows(self, places: Places) -> LinearRows:
        """Return the count inside between its limits, or x_i <= 0 outside."""
        inside = places.inside(_listed(self.zones))
        if self.at_least is None and self.at_most is None:
            return LinearRows.closed(inside == 0)
        high = np.inf if self.at_most is None else float(self.at_most)
        return LinearRows(inside[None], np.array([float(self.at_least or 0)]), np.array([high]))


@dataclass(frozen=True, eq=False)
class MinimumDistance(Constraint):
    """No two chosen candidates closer to each other than this.

    Parameters
    ----------
    distance : float [m]
        Between the nearest points of the two.

    Raises
    ------
    ModelError
        When it is not positive.
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


@dataclass(frozen=True, eq=False)
class Together(Constraint):
    """Groups of candidates of which all or none are chosen: symmetric sets, multi-axis units.

    Parameters
    ----------
    groups : sequence of sequences of str
        Names, two or more in each group.

    Raises
    ------
    LabelError
        When a group has fewer than two names; when used, for an unknown name.
    """

    groups: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        if isinstance(self.groups, str) or not isinstance(self.groups, Sequence):
            raise LabelError(
                f"groups are lists of names, got {short(self.groups)}. Type [('a', 'b'), ...]."
            )
        listed = tuple(name_list(group, "a group") for group in self.groups)
        for group in listed:
            if len(set(group)) < 2:
                raise LabelError(f"the group {group} has fewer than two names: name more.")
        self._set(groups=listed)

    def rows(self, places: Places) -> LinearRows:
        """Return x_i - x_j = 0 within each group."""
        pairs = []
        for group in self.groups:
            for name in group:
                if name not in places.names:
                    raise unknown_label("candidate of a group", name, places.names)
            at = [places.names.index(name) for name in group]
            pairs += [(at[0], other) for other in at[1:]]
        return LinearRows.equal(pairs, places.total)


@dataclass(frozen=True, eq=False)
class Mirrored(Constraint):
    """Each chosen candidate with its mirror image: layouts are symmetric about a plane.

    Candidates without an image among the others are excluded, those on the plane are their own.

    Parameters
    ----------
    axis : {"x", "y", "z"}
        Normal of the plane.
    at : float [m]
        Where the plane is.

    Raises
    ------
    ModelError
        When the axis is none of these or the place no number.
    """

    axis: str
    at: float

    def __post_init__(self) -> None:
        self._set(axis=one_of(self.axis, "axis", "xyz"), at=float(real_array(self.at, "at", ())))

    def rows(self, places: Places) -> LinearRows:
        """Return x_i - x_j = 0 for images, x_i <= 0 without one."""
        places.inside(())  # refuses where places are not known
        k = "xyz".index(self.axis)
        images = []
        for points in places.points:
            image = points.copy()
            image[:, k] = 2.0 * self.at - image[:, k]
            images.append(image)
        near = np.array([[_apart(p, q) for q in images] for p in places.points])
        found = near.argmin(axis=1)
        lone = near.min(axis=1) > places.same
        pairs = [(i, int(j)) for i, j in enumerate(found) if i < j and not lone[i]]
        return LinearRows.equal(pairs, places.total).and_(LinearRows.closed(lone))


@dataclass(frozen=True, eq=False)
class Budget(Constraint):
    """The costs of the chosen candidates together are at most this.

    Parameters
    ----------
    total : float
        What they may cost.
    costs : mapping {str: float}, optional
        Cost of candidates by name.
    default : float
        Cost of the others.

    Raises
    ------
    ModelError
        When a number is negative.
    LabelError
        When used, for an unknown name.
    """

    total: float
    costs: Mapping[str, float] = field(default_factory=dict)
    default: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.costs, Mapping):
            raise ModelError(f"costs are a mapping from name to cost, got {short(self.costs)}.")
        self._set(
            total=positive(self.total, "total", zero=True),
            costs={
                str(name): positive(cost, f"cost of {name!r}", zero=True)
                for name, cost in self.costs.items()
            },
            default=positive(self.default, "default", zero=True),
        )

    def rows(self, places: Places) -> LinearRows:
        """Return the sum of costs, at most the total."""
        for name in self.costs:
            if name not in places.names:
                raise unknown_label("candidate with a cost", name, places.names)
        costs = np.array([self.costs.get(name, self.default) for name in places.names])
        return LinearRows(costs[None], np.array([0.0]), np.array([self.total]))


def limits(at_least: Any, at_most: Any) -> tuple[int | None, int | None]:
    """Return two counts, checked; None where there is no limit.

    Raises
    ------
    ModelError
        When they are no whole numbers, or at_least is above at_most.
    """
    low, high = (
        None if n is None else whole(n, name, minimum=0)
        for n, name in ((at_least, "at_least"), (at_most, "at_most"))
    )
    if low is not None and high is not None and low > high:
        raise ModelError(
            f"at_least {low} is above at_most {high}: no choice is both. Exchange them."
        )
    return low, high


def rows_of(constraints: Any, places: Places, side: str) -> LinearRows:
    """Return the rows of all constraints, OffPoi() among them for sensors unless one is given.

    Raises
    ------
    ModelError
        When something is no constraint.
    """
    return LinearRows.stacked([c.rows(places) for c in all_of(constraints, side)], places.total)


def all_of(constraints: Any, side: str) -> tuple[Constraint, ...]:
    """Return constraints as a tuple, OffPoi() among them for sensors unless one is given."""
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
    usual = "y" in side and not any(isinstance(item, OffPoi) for item in given)
    return (*given, OffPoi()) if usual else tuple(given)


def _zones(given: Any, what: str) -> tuple[Zone, ...]:
    listed = (given,) if isinstance(given, Zone) or not isinstance(given, Sequence) else given
    for zone in listed:
        if not isinstance(zone, Zone):
            raise ModelError(
                f"{what} is a Rectangle or a Disc, got {short(zone)}. Type "
                "Disc((0.3, 0.3), radius=0.05)."
            )
    if not listed:
        raise ModelError(f"there is no zone: {what} is a Rectangle or a Disc. Give one.")
    return tuple(listed)


def _listed(zones: Zone | Sequence[Zone]) -> tuple[Zone, ...]:
    return (zones,) if isinstance(zones, Zone) else tuple(zones)


def _apart(points: FloatArray, others: FloatArray) -> float:
    """Return the largest distance from any point of one set to the other; inf if sizes differ."""
    if len(points) != len(others):
        return np.inf
    between = np.linalg.norm(points[:, None] - others[None], axis=2)
    return float(max(between.min(axis=0).max(), between.min(axis=1).max()))
