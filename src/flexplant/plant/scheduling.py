"""Positions of a machine that moves, and how the places of its ports depend on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import FloatArray, instance, number, real_array, whole
from ..errors import LabelError, ModelError, require_known, short
from ..labels import Place
from ..store import Value
from ..tolerances import SAME, TYPED

#: points of a position that a mapping of them does not name
_POINTS = 21


@dataclass(frozen=True, eq=False)
class Position(Value):
    """A scheduling variable: one coordinate of the machine's position, within a range.

    Parameters
    ----------
    name : str
        Name of the position; a position x is changed by ``plant.at(x=0.03)``.
    range : (2,) sequence [m or rad]
        Least and largest value.
    start : float, optional [m or rad]
        Position of a plant just after it was assembled. By default 0 if the range contains 0,
        otherwise the middle of the range.

    Raises
    ------
    LabelError
        When the name is not a Python identifier: `at` takes it as a keyword.
    ModelError
        When the range is not increasing, or start lies outside.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.Position("x", range=(-0.1, 0.1)).start
    0.0
    """

    name: str
    range: Sequence[float] | FloatArray
    start: float | None = None

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not name.isidentifier():
            raise LabelError(
                f"a position is named by a word that can be a keyword, got {short(name)}: "
                "plant.at(x=0.03) names it. Name it 'x', say."
            )
        low, high = real_array(self.range, f"range of position {name!r}", (2,)).tolist()
        if not low < high:
            raise ModelError(
                f"the range of position {name!r} goes from {low:g} to {high:g}: give the least "
                "value first, then a larger one."
            )
        start = self.start
        if start is None:
            start = 0.0 if low <= 0.0 <= high else 0.5 * (low + high)
        self._set(range=(low, high))
        self._set(start=self.within(start))

    def within(self, value: Any) -> float:
        """Return a value, limited to the range; ModelError when it is clearly outside."""
        found = number(value, f"position {self.name!r}")
        low, high = self.range
        spare = TYPED * (high - low)
        if not low - spare <= found <= high + spare:
            # all digits: 0.15001 is not printed as 0.15
            raise ModelError(
                f"position {self.name!r} is {found}, outside its range from {low} to {high}: "
                "nothing is known of the machine there. Stay inside, or widen its range."
            )
        return min(max(found, low), high)


def values_over(positions: Sequence[Position], points: Any) -> dict[str, FloatArray]:
    """Return the values of each position: the given ones, or a number over its range."""
    if isinstance(points, Mapping):
        require_known("position", points, [one.name for one in positions])
    return {one.name: _values(one, points) for one in positions}


def _values(position: Position, points: Any) -> FloatArray:
    given = points.get(position.name, _POINTS) if isinstance(points, Mapping) else points
    if np.ndim(given):
        own = real_array(given, f"points of {position.name!r}", (None,))
        return np.array([position.within(value) for value in own.tolist()])
    low, high = position.range
    return np.linspace(low, high, whole(given, "points", minimum=2))


@dataclass(frozen=True, eq=False, repr=False)
class PlaceTable(Value):
    """Places that were measured on the machine, at a grid of positions; linear between them.

    Parameters
    ----------
    grid : mapping {name: (k,) array} [m or rad]
        Values of each position, increasing.
    places : (k, ..., 3) array [m]
        The place at each point of the grid. The array has one axis for each position of `grid`, in
        the same order.

    Examples
    --------
    >>> import flexplant as fx
    >>> table = fx.plant.PlaceTable({"x": [-0.1, 0.1]}, [[0.4, 0.3, 0.0], [0.2, 0.302, 0.0]])
    >>> head = fx.Sensor("y1", at=(0.3, 0.3, 0.0), moves=table)
    >>> [round(c, 9) for c in head.moves.place({"x": 0.0})]
    [0.3, 0.301, 0.0]
    """

    grid: Mapping[str, FloatArray | Sequence[float]]
    places: FloatArray | Sequence[Any]

    def __post_init__(self) -> None:
        instance(self.grid, Mapping, "grid of a PlaceTable", "Pass {'x': values}.")
        grid = {
            str(name): real_array(values, f"grid of {name!r}", (None,))
            for name, values in self.grid.items()
        }
        for name, values in grid.items():
            if values.size < 2 or not np.all(np.diff(values) > 0):
                raise ModelError(
                    f"the values of {name!r} in a PlaceTable must increase, two at least, got "
                    f"{short(values.tolist())}. Sort the table."
                )
        shape = (*(values.size for values in grid.values()), 3)
        self._set(grid=grid, places=real_array(self.places, "places", shape))

    def __repr__(self) -> str:
        sizes = " x ".join(f"{len(values)} {name}" for name, values in self.grid.items())
        return f"<PlaceTable {sizes}>"

    def covers(self, position: Position) -> bool:
        """Return whether the grid covers the whole range of a position."""
        values, (low, high) = np.asarray(self.grid[position.name]), position.range
        spare = SAME * (high - low)
        return bool(values[0] <= low + spare and values[-1] >= high - spare)


@dataclass(frozen=True, eq=False)
class PlaceMotion(Value):
    """Motion of a place with the positions: ``start + sum_i along_i value_i``, or a table.

    It is made from the argument `moves` of a port: a mapping {position: direction}, or a table.

    Parameters
    ----------
    start : (3,) array [m] or mapping {point: weight}
        Place at which all positions are zero.
    along : mapping {name: (3,) array} or PlaceTable
        Displacement of the place per unit of each position. A place with (1, 0, 0) moves with the
        stage's x. A place with (-1, 0, 0) moves against it, like the point of the stage below a
        head on the frame.

    Examples
    --------
    >>> import flexplant as fx
    >>> head = fx.Sensor("y1", at=(0.3, 0.1, 0.0), moves={"x": (-1, 0, 0)})
    >>> head.moves.place({"x": 0.1})
    (0.19999999999999998, 0.1, 0.0)
    """

    start: Place
    along: Mapping[str, Any] | PlaceTable

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the positions on which the place depends."""
        return tuple(self.along.grid if isinstance(self.along, PlaceTable) else self.along)

    def place(self, values: Mapping[str, float]) -> Place:
        """Return the place for given values of the positions."""
        require_known("position", self.names, values, "the values given")
        one = {name: np.array([values[name]]) for name in self.names}
        found = [(tuple(points[0].tolist()), weight) for weight, points in self.points(one)]
        return dict(found) if isinstance(self.start, Mapping) else found[0][0]

    def points(self, values: Mapping[str, FloatArray]) -> list[tuple[float, FloatArray]]:
        """Return weights, and points (n, 3) [m], of the place at values (n,) of the positions."""
        require_known("position", self.names, values, "the values given")
        if isinstance(self.along, PlaceTable):
            from scipy.interpolate import interpn

            axes = tuple(np.asarray(one) for one in self.along.grid.values())
            at = np.column_stack(
                [np.clip(values[n], a[0], a[-1]) for n, a in zip(self.names, axes, strict=True)]
            )
            return [(1.0, np.asarray(interpn(axes, np.asarray(self.along.places), at)))]
        shift = np.sum(
            [np.multiply.outer(values[n], np.asarray(step)) for n, step in self.along.items()],
            axis=0,
        )
        terms = self.start if isinstance(self.start, Mapping) else {self.start: 1.0}
        return [(weight, np.asarray(point) + shift) for point, weight in terms.items()]

    def starting(self, place: Place, values: Mapping[str, float]) -> PlaceMotion:
        """Return the same motion, shifted so that it is at `place` for the given positions."""
        if isinstance(self.along, PlaceTable):
            raise LabelError(
                "a port whose places are a table stands where the table says. Replace its table, "
                "moves=fx.plant.PlaceTable(...)."
            )
        pairs = [np.asarray(step) * values[name] for name, step in self.along.items()]
        return self.replace(start=shifted(place, -np.sum(pairs, axis=0)))


def shifted(place: Place, shift: FloatArray) -> Place:
    """Return a point, or the points of a sum, elsewhere."""
    if isinstance(place, Mapping):
        return {
            tuple((np.asarray(point) + shift).tolist()): weight for point, weight in place.items()
        }
    return tuple((np.asarray(place) + shift).tolist())


def checked_moves(name: str, at: Any, moves: Any) -> PlaceMotion | None:
    """Return how a port's place follows positions; None where it stays."""
    if moves is None or isinstance(moves, PlaceMotion):
        return moves
    if not isinstance(moves, Mapping | PlaceTable) or not getattr(moves, "grid", moves):
        raise ModelError(
            f"moves of {name!r} is a direction for each position, {{'x': (-1, 0, 0)}}, or a "
            f"PlaceTable, got {short(moves)}. Leave it out of a port that stays."
        )
    points = list(at) if isinstance(at, Mapping) else [at]
    if any(isinstance(point, str) for point in points):
        raise LabelError(
            f"{name!r} moves, but is at a node: {short(at)}. Give the point where it is when all "
            "positions are zero, at=(x, y, z): it moves between the nodes."
        )
    if isinstance(moves, PlaceTable):
        if isinstance(at, Mapping):
            raise LabelError(f"{name!r} is a sum of points, which a PlaceTable does not move.")
        return PlaceMotion(at, moves)
    along = {
        str(key): tuple(real_array(step, f"moves of {name!r} with {key!r}", (3,)).tolist())
        for key, step in moves.items()
    }
    return PlaceMotion(at, along)


def port_at(port: Any, values: Mapping[str, float]) -> Any:
    """Return a port where it is at values of the positions."""
    moves = getattr(port, "moves", None)
    if moves is None:
        return port
    place = moves.place(values)
    return port if place == port.at else port.replace(at=place)


def require_positions(ports: Sequence[Any], positions: Sequence[Position]) -> None:
    """Refuse ports that move with a position that nobody named, or by a table too short for it."""
    known = {one.name: one for one in positions}
    moving = [port for port in ports if getattr(port, "moves", None) is not None]
    followed = [(port, name) for port in moving for name in port.moves.names]
    for port, name in followed:
        if name not in known:
            raise LabelError(
                f"{port.name!r} moves with {name!r}, which is not among the positions "
                f"({', '.join(known) or 'there are none'}). Name it and its range: "
                f"Ports(..., positions=[fx.plant.Position({name!r}, range=(-0.1, 0.1))])."
            )
        along = port.moves.along
        if isinstance(along, PlaceTable) and not along.covers(known[name]):
            low, high = known[name].range
            raise ModelError(
                f"the PlaceTable of {port.name!r} does not span position {name!r} from {low:g} to "
                f"{high:g}: nothing is known of its place beyond. Measure on, or narrow the range."
            )
