"""Constraints by name (all or none, a number, a budget) and on where devices may be, as rows."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from ..arrays import FloatArray, mapping, members, name_list, number, positive, whole
from ..errors import LabelError, ModelError, short, some_names
from ..store import Value, checked
from ..tolerances import SAME, TINY
from .candidates import Places
from .convex import Branch, chosen_rows
from .zones import Disc, Zone


@dataclass(frozen=True, eq=False)
class LinearRows:
    """``lower <= A x <= upper``, x 1 for chosen candidates and 0 for others."""

    A: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def closed(cls, which: npt.NDArray[np.bool_]) -> LinearRows:
        """Return rows that exclude some candidates (N,)."""
        rows = np.eye(which.size)[which]
        return cls(rows, np.zeros(len(rows)), np.zeros(len(rows)))

    @classmethod
    def counted(cls, row: FloatArray, at_least: int | None, at_most: int | None) -> LinearRows:
        """Return one row (N,) between two limits, of which either may be absent."""
        high = np.inf if at_most is None else float(at_most)
        return cls(row[None], np.array([float(at_least or 0)]), np.array([high]))

    @classmethod
    def equal(cls, pairs: Sequence[tuple[int, int]], total: int) -> LinearRows:
        """Return rows by which both or none of each pair are chosen."""
        first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        rows = np.eye(total)[first] - np.eye(total)[second]
        return cls(rows, np.zeros(len(rows)), np.zeros(len(rows)))

    @classmethod
    def stacked(cls, parts: Sequence[LinearRows], total: int) -> LinearRows:
        """Return the rows of all parts."""
        return cls(
            np.vstack([np.zeros((0, total)), *(part.A for part in parts)]),
            np.concatenate([np.zeros(0), *(part.lower for part in parts)]),
            np.concatenate([np.zeros(0), *(part.upper for part in parts)]),
        )

    def and_(self, other: LinearRows) -> LinearRows:
        """Return the rows of both."""
        return LinearRows.stacked([self, other], self.A.shape[1])

    def hold(self, sets: Sequence[Sequence[int]]) -> npt.NDArray[np.bool_]:
        """Return which of some choices (m,) satisfy every row."""
        sums = chosen_rows(sets, self.A.shape[1]) @ self.A.T
        within = (sums >= self.lower - self._slack) & (sums <= self.upper + self._slack)
        return np.asarray(np.all(within, axis=1))

    def holding(self, sets: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
        """Return those of some choices that satisfy every row."""
        return [s for s, holds in zip(sets, self.hold(sets), strict=True) if holds]

    def added(self, base: Sequence[int]) -> npt.NDArray[np.bool_]:
        """Return which candidates (N,) exceed no upper limit that `base` keeps."""
        used = self.A[:, list(base)].sum(axis=1)
        over = (used[:, None] + self.A > (self.upper + self._slack)[:, None]) & (self.A > 0)
        return np.asarray(~np.any(over & (used <= self.upper + self._slack)[:, None], axis=0))

    def shut(self, required: Sequence[int]) -> npt.NDArray[np.bool_]:
        """Return which candidates (N,) no choice with `required` can hold, by one row alone."""
        used = np.zeros(self.A.shape[1])
        used[list(required)] = 1.0
        least = np.minimum(self.A, 0.0) @ (1.0 - used) + self.A @ used
        with_it = least[:, None] + np.maximum(self.A, 0.0)
        found = np.any(with_it > (self.upper + self._slack)[:, None], axis=0)
        found[list(required)] = False
        return np.asarray(found)

    def possible(self, branch: Branch) -> bool:
        """Return whether a branch holds choices, and each row alone leaves one of them."""
        low, high = np.zeros(len(self.A)), np.zeros(len(self.A))
        if any(count > group.size for group, count in branch.groups):
            return False
        for group, count in branch.groups:
            part = np.sort(self.A[:, group], axis=1)
            low += part[:, :count].sum(axis=1)
            high += part[:, part.shape[1] - count :].sum(axis=1)
        return bool(
            np.all(low <= self.upper + self._slack) and np.all(high >= self.lower - self._slack)
        )

    def units(self) -> list[tuple[int, ...]]:
        """Return the sets of candidates that are chosen together, single ones included."""
        from scipy.sparse.csgraph import connected_components

        zero = (self.lower == 0) & (self.upper == 0)
        pair = zero & (np.count_nonzero(self.A, axis=1) == 2) & (self.A.sum(axis=1) == 0)
        total = self.A.shape[1]
        ends = np.nonzero(self.A[pair])[1].reshape(-1, 2)
        graph = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(total, total))
        count, label = connected_components(graph, directed=False)
        return [tuple(np.flatnonzero(label == i).tolist()) for i in range(count)]

    def with_partners(self, chosen: Sequence[int]) -> tuple[int, ...]:
        """Return a choice with all that its members are chosen together with."""
        return tuple(sorted(i for unit in self.units() if set(unit) & set(chosen) for i in unit))

    def best(
        self, worth: FloatArray, count: int, required: Sequence[int]
    ) -> tuple[int, ...] | None:
        """Return the choice of `count` with the largest sum of worth (N,); None if none exists.

        A mixed-integer linear program (HiGHS).
        """
        from scipy.optimize import Bounds, LinearConstraint, milp

        total, slack = self.A.shape[1], self._slack
        low = np.zeros(total)
        low[list(required)] = 1.0
        found = milp(
            -np.asarray(worth) / max(float(np.max(np.abs(worth))), TINY),
            constraints=[
                LinearConstraint(csr_array(self.A), self.lower - slack, self.upper + slack),
                LinearConstraint(np.ones((1, total)), count, count),
            ],
            integrality=np.ones(total, dtype=np.int64),
            bounds=Bounds(low, 1.0),
        )
        if found.x is None:
            return None
        return tuple(np.flatnonzero(found.x > 0.5).tolist())

    @property
    def _slack(self) -> FloatArray:
        return np.asarray(SAME * np.abs(self.A).max(axis=1, initial=0.0))


class Constraint(Value):
    """The base class of all constraints; a new constraint defines `rows`.

    Examples
    --------
    >>> import flexplant as fx
    >>> isinstance(fx.placement.MinimumDistance(0.1), fx.placement.Constraint)
    True
    """

    @abstractmethod
    def rows(self, places: Places) -> LinearRows:
        """Return linear inequalities in a vector x. x_i is 1 if candidate i is chosen, else 0."""

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return zones of the x-y plane without candidates, for drawing."""
        return ()


def check_limits(low: int | None, high: int | None) -> None:
    """Raise ModelError when no count is within two limits; None for no limit."""
    if low is not None and high is not None and low > high:
        raise ModelError(
            f"at_least {low} is above at_most {high}: no choice is both. Exchange them."
        )


@dataclass(frozen=True, eq=False)
class JointGroups(Constraint):
    """Groups of candidates that are chosen together or not at all, such as multi-axis units.

    Parameters
    ----------
    groups : sequence of sequences of str
        Names, two or more in each group.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> pair = fx.placement.JointGroups([["y1", "y2"]])
    >>> fx.place_sensors(plant, ["y1", "y2"], 2, constraints=pair).chosen
    ('y1', 'y2')
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
        """Return ``x_i - x_j = 0`` for candidates of a group; x_i is 1 if candidate i is chosen."""
        pairs = []
        for group in self.groups:
            at = places.index(group, "candidate of a group")
            pairs += [(at[0], other) for other in at[1:]]
        return LinearRows.equal(pairs, places.total)


@dataclass(frozen=True, eq=False)
class CountLimits(Constraint):
    """Limits on the number of chosen candidates among some named ones.

    For example, at most two of the candidates that are accelerometers are chosen.

    Parameters
    ----------
    names : sequence of str
        Names of these candidates.
    at_least, at_most : int, optional
        Smallest and largest number of these candidates in a choice.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> last = fx.placement.CountLimits(["y2"], at_least=1)
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, constraints=last).chosen
    ('y2',)
    """

    names: Sequence[str] = field(metadata=checked(name_list))
    at_least: int | None = field(default=None, kw_only=True, metadata=checked(whole, minimum=0))
    at_most: int | None = field(default=None, kw_only=True, metadata=checked(whole, minimum=0))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(self.at_least, self.at_most)

    def rows(self, places: Places) -> LinearRows:
        """Return the linear inequalities for the number of chosen candidates."""
        row = np.zeros(places.total)
        row[places.index(self.names, "candidate among others")] = 1.0
        return LinearRows.counted(row, self.at_least, self.at_most)


@dataclass(frozen=True, eq=False, repr=False)
class Budget(Constraint):
    """An upper limit on the total cost of the chosen candidates.

    Parameters
    ----------
    total : float
        Largest total cost of a choice, in the unit of `costs`.
    costs : mapping {str: float}, optional
        Cost of candidates by name.
    default : float
        Cost of each candidate that `costs` does not name.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> cheap = fx.placement.Budget(2.0, {"y1": 5.0})  # y1 costs 5, y2 costs 1
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, constraints=cheap).chosen
    ('y2',)
    """

    total: float = field(metadata=checked(positive, zero=True))
    costs: Mapping[str, float] = field(
        default_factory=dict, metadata=checked(mapping, hint="Give {name: cost}.")
    )
    default: float = field(default=1.0, kw_only=True, metadata=checked(positive, zero=True))

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.costs.items()
        self._set(costs={str(n): positive(cost, f"cost of {n!r}", zero=True) for n, cost in given})

    def rows(self, places: Places) -> LinearRows:
        """Return one linear inequality: the sum of costs is at most the total."""
        places.index(list(self.costs), "candidate with a cost")
        costs = np.array([self.costs.get(name, self.default) for name in places.names])
        return LinearRows(costs[None], np.array([0.0]), np.array([self.total]))


def _checked_zones(given: Any, name: str) -> tuple[Zone, ...]:
    listed = (given,) if isinstance(given, Zone) or not isinstance(given, Sequence) else given
    for zone in listed:
        if not isinstance(zone, Zone):
            raise ModelError(
                f"{name} is a Rectangle or a Disc, got {short(zone)}. Type "
                "fx.placement.Disc((0.3, 0.3), radius=0.05)."
            )
    if not listed:
        raise ModelError(f"no zone is given: give {name} a Rectangle or a Disc.")
    return tuple(listed)


@dataclass(frozen=True, eq=False)
class Excluded(Constraint):
    """Zones of the x-y plane (the plate seen from above) in which no candidate is chosen.

    Parameters
    ----------
    zones : Rectangle, Disc or sequence of them
        Excluded zones, at least one.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> first_mass = fx.placement.Disc((0.0, 0.0), radius=0.5)
    >>> off = fx.placement.Excluded(first_mass)
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, constraints=off).chosen
    ('y2',)
    """

    zones: Zone | Sequence[Zone] = field(metadata=checked(_checked_zones, name="an excluded zone"))

    def rows(self, places: Places) -> LinearRows:
        """Return ``x_i <= 0`` for each candidate i in a zone; x_i is 1 if it is chosen."""
        return LinearRows.closed(places.inside(_zone_list(self.zones)) > 0)

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return the zones."""
        return _zone_list(self.zones)


@dataclass(frozen=True, eq=False)
class OffPoi(Constraint):
    """Excludes candidates on a POI (point of interest), at which no sensor can be mounted.

    A sensor that the plant already has at a POI stays allowed if the radius is 0. A POI may be
    relative, such as ``at={"tip:x": 1, "frame:x": -1}``. Sensors are then excluded only on one side
    of it: as a rule at its points of positive weight, here the tip. If the plant's own relative
    sensors touch only these points, sensors are excluded at the points of negative weight instead.
    The other side stays allowed, because sensors may measure against it.

    Parameters
    ----------
    radius : float [m]
        Distance from a POI up to which candidates are excluded, for example half the size of the
        die. A candidate with several points is excluded if any of them is within this distance.
        With a negative radius nothing is excluded.

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
        """Return ``x_i <= 0`` for each candidate i near a POI; x_i is 1 if it is chosen."""
        if self.radius < 0 or not places.pois:
            return LinearRows.closed(np.zeros(places.total, dtype=bool))
        near = places.from_pois() <= self.radius + places.same
        if not self.radius:
            near &= ~np.isin(places.names, places.fitted)
        return LinearRows.closed(near)

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return discs about the POIs."""
        if self.radius <= 0:
            return ()
        return tuple(Disc(point[:2], self.radius) for poi in places.pois for point in poi)


@dataclass(frozen=True, eq=False)
class ZoneLimits(Constraint):
    """Limits on the number of chosen candidates in zones of the x-y plane.

    If no limit is given, all chosen candidates must lie in the zones.

    Parameters
    ----------
    zones : Rectangle, Disc or sequence of them
        Zones, at least one. A candidate in any of them counts once.
    at_least, at_most : int, optional
        Smallest and largest number of chosen candidates inside. A candidate is inside if any of its
        points is inside.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> right = fx.placement.ZoneLimits(fx.placement.Rectangle((1.5, -1.0), (2.5, 1.0)), at_least=1)
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, constraints=right).chosen
    ('y2',)
    """

    zones: Zone | Sequence[Zone] = field(metadata=checked(_checked_zones, name="a zone"))
    at_least: int | None = field(default=None, kw_only=True, metadata=checked(whole, minimum=0))
    at_most: int | None = field(default=None, kw_only=True, metadata=checked(whole, minimum=0))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(self.at_least, self.at_most)

    def rows(self, places: Places) -> LinearRows:
        """Return limits on the number inside, or ``x_i <= 0`` for each candidate i outside."""
        inside = places.inside(_zone_list(self.zones))
        if self.at_least is None and self.at_most is None:
            return LinearRows.closed(inside == 0)
        return LinearRows.counted(inside, self.at_least, self.at_most)


def _zone_list(zones: Zone | Sequence[Zone]) -> tuple[Zone, ...]:
    return (zones,) if isinstance(zones, Zone) else tuple(zones)


@dataclass(frozen=True, eq=False)
class MinimumDistance(Constraint):
    """A smallest distance between any two chosen candidates.

    Parameters
    ----------
    distance : float [m]
        Distance between the nearest points of two candidates. Points of negative weight
        (references) do not count, because two relative sensors may use the same reference.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> apart = fx.placement.MinimumDistance(1.5)
    >>> fx.place_sensors(plant, ["y1", "y2"], 2, constraints=apart).chosen
    ('y1', 'y2')
    """

    distance: float = field(metadata=checked(positive))

    def rows(self, places: Places) -> LinearRows:
        """Return ``x_i + x_j <= 1`` for each pair of candidates that are too close."""
        close = places.between() < self.distance - places.same
        first, second = np.nonzero(np.triu(close, 1))
        pairs = np.eye(places.total)[first] + np.eye(places.total)[second]
        return LinearRows(pairs, np.zeros(first.size), np.ones(first.size))


def constraint_rows(constraints: Any, places: Places, side: str) -> LinearRows:
    """Return the rows of `all_of` the constraints."""
    return LinearRows.stacked([c.rows(places) for c in all_of(constraints, side)], places.total)


def constraints_in_words(constraints: Any, places: Places, side: str) -> str:
    """Return `all_of` the constraints, each with the candidates that it removes."""
    parts = []
    for constraint in all_of(constraints, side):
        shut = np.flatnonzero(constraint.rows(places).shut(())).tolist()
        removed = f" (removes {some_names([places.names[i] for i in shut])})" if shut else ""
        parts.append(f"{constraint!r:.120}{removed}")
    return ", ".join(parts)


def all_of(constraints: Any, side: str) -> tuple[Constraint, ...]:
    """Return constraints as a tuple, OffPoi() among them for sensors unless one is given."""
    given = constraints_of(constraints)
    usual = "y" in side and not any(isinstance(item, OffPoi) for item in given)
    return (*given, OffPoi()) if usual else given


def constraints_of(constraints: Any) -> tuple[Constraint, ...]:
    """Return a constraint, or several, as a tuple."""
    given = (constraints,) if isinstance(constraints, Constraint) else constraints
    hint = "Write [placement.Excluded(Disc((0.3, 0.3), radius=0.05))], say."
    return members(given, Constraint, "constraints", hint, least=0)
