"""Score layouts: how well each set would do, and where one more sensor helps most."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, IntArray, instance, positive, real_array, whole
from ..errors import SHOWN, LabelError, ModelError, counted, short
from ..lti.frequency import Quantity
from ..plant import Sensor, StandardPlant
from ..store import Value
from ..work import Work
from .candidates import Port, Side, candidate_places, known_candidates, sampled_plant, with_side
from .constraints import Constraint, all_of, constraint_rows, constraints_of
from .criterion import Criterion, in_words
from .problem import Placement, layouts_of
from .zones import Zone


@dataclass(frozen=True, eq=False, repr=False)
class Scores(Value):
    """Layouts with their scores, the best first.

    Parameters
    ----------
    layouts : sequence of tuples of str
        Names of the chosen sensors or actuators.
    values : (n,) array
        Scores in ascending order; infinite for an infeasible layout.
    reasons : sequence of str
        Reason why each layout is infeasible; empty for a feasible one.
    order : (n,) array of int
        Position of each layout in the list that was given to the function, from 0.
    criterion : str
        Name of the criterion.
    candidates : sequence of Sensor or Actuator
        Sensors or actuators that appear in at least one layout.
    side : {"y", "u"}
        Whether they are sensors or actuators.
    unit : str
        Unit of the square root of a value, if the values are mean squares of a motion.
    unjudged : str
        Remark that the scores do not include truncated modes. It is empty if the plant has an
        evaluation model.
    interval : str
        Text of an interval for the error of the best layout divided by that of the next one. It is
        a 95 % interval for a machine that agrees with the measurement. Such machines are known if
        the plant comes from ``fit.calibrated(measured)`` with an evaluation model. If they are
        known but there is no interval, the text is the reason. If they are not known, the text is
        empty.
    """

    layouts: tuple[tuple[str, ...], ...]
    values: FloatArray
    reasons: tuple[str, ...]
    order: IntArray
    criterion: str
    candidates: tuple[Port, ...]
    side: Side
    unit: str = ""
    unjudged: str = ""
    interval: str = ""

    def __len__(self) -> int:
        return len(self.layouts)

    def __repr__(self) -> str:
        feasible = int(np.count_nonzero(np.isfinite(self.values)))
        listed = counted(len(self), "layout")
        head = f"<Scores of {listed} by {self.criterion}, {feasible} feasible>"
        lines = [head, self.table(5), *([f"  {self.unjudged}"] if self.unjudged else [])]
        lines += [f"  the best over the next: {self.interval}"] if self.interval else []
        return "\n".join(lines)

    @property
    def best(self) -> tuple[str, ...]:
        """The names of the best layout."""
        return self.layouts[0]

    def table(self, count: int = 10) -> str:
        """Return a text with the `count` best layouts, one per line."""
        lines = []
        for i, value in enumerate(self.values[: whole(count, "count")]):
            why = f": {self.reasons[i]:.90}" if self.reasons[i] else ""
            lines.append(f"  {in_words(value, self.unit):<13} {' '.join(self.layouts[i]):.80}{why}")
        return "\n".join(lines)

    def on(self, plant: StandardPlant, *, rank: int = 0) -> StandardPlant:
        """Return the plant with the layout of a given rank; rank 0 is the best layout."""
        rank = whole(rank, "rank", minimum=0, maximum=len(self) - 1)
        known = {port.name: port for port in self.candidates}
        return with_side(plant, self.side, [known[name] for name in self.layouts[rank]])


def score_sensors(
    plant: StandardPlant,
    layouts: Sequence[Sequence[Any]],
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    candidates: Sequence[Any] = (),
    constraints: Sequence[Constraint] = (),
    executor: Executor | None = None,
    progress: bool | None = None,
) -> Scores:
    """Return the scores of layouts of sensors, each instead of the plant's own sensors.

    A layout that does not observe every rigid-body mode is infeasible and is not scored. Its
    computed score would have no meaning, and could be the smallest. For `PoiVariance`, layouts
    differ only in rows of the output matrix C and of the noise covariance R. One score therefore
    takes about as long as the solution of one Riccati equation by the doubling algorithm.
    `design_kalman` confirms the score of the best layout.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant that was assembled from a structure.
    layouts : sequence of layouts
        Layouts to be scored. A layout is a sequence of `Sensor` values or of names. A name may
        refer to a sensor of the plant, of `candidates`, or of an earlier layout.
    criterion : PoiVariance or callable, optional
        Function of a plant that returns a float, smaller is better; by default `PoiVariance()`.
    candidates : sequence of Sensor
        Candidates that names may stand for, in addition to the plant's own sensors.
    constraints : sequence of Constraint, optional
        Constraints, as for `place_sensors`. A layout that violates one of them is infeasible.
        Unlike in `place_sensors`, sensors may lie on a POI (point of interest), unless OffPoi() is
        among the constraints.
    executor, progress : as for `place_sensors`

    Returns
    -------
    Scores
        Layouts with their scores, the best first. Infeasible layouts are last, with the reason.

    Raises
    ------
    ModelError
        When the plant is not sampled or has no structure, a layout is empty or an entry is not a
        sensor.
    AssumptionError
        When the criterion cannot be computed on this plant with any sensors.
    CertificateError
        When a second calculation does not confirm the score of the best layout.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> scores = fx.score_sensors(plant, [["s1"], ["s2"], ["s3"]], candidates=candidates)
    >>> scores.best  # the POI is on mass 2
    ('s2',)
    >>> off = [fx.placement.OffPoi()]
    >>> fx.score_sensors(plant, scores.layouts, candidates=candidates, constraints=off).reasons
    ('', '', 'against OffPoi(radius=0.0).')
    """
    work = Work(executor, progress)
    return _score_layouts(plant, "y", layouts, criterion, candidates, constraints, work)


def score_actuators(
    plant: StandardPlant,
    layouts: Sequence[Sequence[Any]],
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    candidates: Sequence[Any] = (),
    constraints: Sequence[Constraint] = (),
    executor: Executor | None = None,
    progress: bool | None = None,
) -> Scores:
    """Return the scores of layouts of actuators, each instead of the plant's own actuators.

    Parameters
    ----------
    plant, layouts, candidates, constraints, executor, progress
        As for `score_sensors`, with `Actuator` values in place of `Sensor` values.
    criterion : PoiLqr or callable, optional
        Function of a plant that returns a float, smaller is better; by default `PoiLqr()`.

    Returns
    -------
    Scores
        Layouts with their scores, the best first. Layouts that do not move every rigid-body mode
        are last, with the reason.

    Raises
    ------
    ModelError, LabelError, AssumptionError, CertificateError
        As `score_sensors`.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> scores = fx.placement.score_actuators(plant, [["a1"], ["a2"]], candidates=candidates)
    >>> scores.best
    ('a2',)
    """
    work = Work(executor, progress)
    return _score_layouts(plant, "u", layouts, criterion, candidates, constraints, work)


def _score_layouts(
    plant: StandardPlant,
    side: Side,
    layouts: Sequence[Sequence[Any]],
    criterion: Any,
    candidates: Sequence[Any],
    constraints: Sequence[Constraint],
    work: Work,
) -> Scores:
    plant = sampled_plant(plant)
    if isinstance(layouts, str) or not isinstance(layouts, Sequence):
        raise ModelError(f"layouts are a list of lists of names, got {short(layouts)}. Pass such.")
    wrong = [layout for layout in layouts if not isinstance(layout, Iterable)]
    if wrong:
        raise ModelError(f"a layout is a list of names, got {short(wrong[0])}. Pass such a list.")
    listed = [(layout,) if isinstance(layout, str) else tuple(layout) for layout in layouts]
    if not listed or not all(listed):
        raise ModelError("there is nothing to score: give at least one layout, none of them empty.")
    instance(candidates, Iterable, "candidates", "Pass sensors or actuators in [...].")
    known = known_candidates(plant, side, [*candidates, *(p for part in listed for p in part)])
    names = [tuple(p if isinstance(p, str) else p.name for p in layout) for layout in listed]
    for layout in names:
        if len(set(layout)) != len(layout):
            raise LabelError(f"the layout {layout} holds a name twice: each port is used once.")
    used = {name for layout in names for name in layout}
    ports = tuple(port for name, port in known.items() if name in used)
    position = {port.name: i for i, port in enumerate(ports)}
    judged = layouts_of(plant, side, ports, criterion)
    chosen = [tuple(position[name] for name in layout) for layout in names]
    places, values = candidate_places(plant, ports), np.full(len(chosen), np.inf)
    reasons: dict[int, str] = {}
    for constraint in constraints_of(constraints):
        held = constraint.rows(places).hold(chosen)
        reasons |= dict.fromkeys(np.flatnonzero(~held).tolist(), f"against {constraint!r}.")
    kept = [i for i in range(len(chosen)) if i not in reasons]
    values[kept] = judged.scores([chosen[i] for i in kept], work)
    lost = [i for i in kept if not np.isfinite(values[i])]
    reasons |= dict(zip(lost, work.mapped(judged.reason, [chosen[i] for i in lost]), strict=True))
    order = np.argsort(values, kind="stable")
    judged.confirm(chosen[order[0]], float(values[order[0]]))
    first = [with_side(plant, side, [ports[j] for j in chosen[i]]) for i in order[:2]]
    several = np.count_nonzero(np.isfinite(values)) > 1
    return Scores(
        tuple(names[i] for i in order),
        values[order],
        tuple(reasons.get(i, "") for i in order.tolist()),
        order,
        repr(judged.criterion),
        ports,
        side,
        unit := judged.criterion.unit(plant),
        plant.unjudged if unit else "",
        judged.criterion.compared(first[0], first[1]) if several else "",
    )


@dataclass(frozen=True, eq=False, repr=False)
class DeviceWorth(Value):
    """The value of the criterion when one device is left out, for each device; prints as a table.

    Parameters
    ----------
    names : sequence of str
        Names of the n devices.
    value : float
        Value of the criterion with all devices.
    without : (n,) array
        Value without each device; infinite if the other devices miss a rigid-body mode.
    unit : str
        Unit of the square root of a value, if the values are mean squares of a motion.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.placement.device_worth(plant, fx.place_sensors(plant, ["y1", "y2"], 2)).names
    ('y1', 'y2')
    """

    names: Sequence[str]
    value: float
    without: FloatArray
    unit: str = ""

    def __repr__(self) -> str:
        lines = [f"<DeviceWorth: {in_words(self.value, self.unit)} with all>"]
        order = np.argsort(-self.without, kind="stable").tolist()
        for i in order[:SHOWN]:
            lost = self.without[i]
            what = in_words(lost, self.unit) if np.isfinite(lost) else "the others do not suffice"
            lines.append(f"  without {self.names[i]}: {what}")
        if len(order) > SHOWN:
            lines.append(f"  and {len(order) - SHOWN} that matter less")
        return "\n".join(lines)

    def __getitem__(self, name: str) -> float:
        """Return the value without one device."""
        return float(self.without[self.names.index(name)])


def device_worth(
    plant: StandardPlant,
    placement: Placement,
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    executor: Executor | None = None,
    progress: bool | None = None,
) -> DeviceWorth:
    """Return the value of a criterion without each chosen device, to show what each one is worth.

    The result is a `DeviceWorth`, which prints as a table.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant of the placement, or another plant of the same machine.
    placement : Placement
        Result of `place_sensors`, `place_actuators` or `place_both`.
    criterion : Criterion or callable, optional
        Criterion; by default the criterion of the placement.
    executor, progress : as for `place_sensors`

    Raises
    ------
    AssumptionError
        When all devices together do not observe (or move) every rigid-body mode.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> worth = fx.placement.device_worth(plant, fx.place_sensors(plant, ["y1", "y2"], 2))
    >>> bool(worth.without[0] > worth.without[1])  # y1, next to the disturbance, is worth more
    True
    """
    plant = sampled_plant(plant)
    instance(placement, Placement, "placement", "Pass what place_sensors returned.")
    layouts = layouts_of(plant, placement.side, placement.ports, criterion)
    layouts.require_any()
    every = tuple(range(len(placement.ports)))
    sets = [every, *(tuple(j for j in every if j != i) for i in every)]
    values = layouts.scores(sets, Work(executor, progress), "devices")
    unit = layouts.criterion.unit(plant)
    return DeviceWorth(placement.chosen, float(values[0]), values[1:], unit)


@dataclass(frozen=True, eq=False, repr=False)
class SensorMap(Value):
    """The score with one more sensor at each of many points.

    Parameters
    ----------
    points : (n, 3) array [m]
        Points at which the sensor was tried.
    values : (n,) array
        Scores with the sensor at each point; infinite if a rigid-body mode is still not observed.
    without : float
        Score of the plant's own sensors alone; infinite if they do not observe every rigid-body
        mode.
    criterion : str
        Name of the criterion.
    excluded : sequence of Rectangle or Disc
        Zones in which no sensor was tried.
    unit : str
        Unit of the square root of a value, if the values are mean squares of a motion.
    """

    points: FloatArray
    values: FloatArray
    without: float
    criterion: str
    excluded: Sequence[Zone] = ()
    unit: str = ""

    def __repr__(self) -> str:
        x, y, z = self.best
        return (
            f"<SensorMap of {counted(self.values.size, 'point')} by {self.criterion}: "
            f"{in_words(self.without, self.unit)} without, "
            f"{in_words(float(self.values.min()), self.unit)} with a sensor at "
            f"({x:.4g}, {y:.4g}, {z:.4g}) m>"
        )

    @property
    def best(self) -> FloatArray:
        """The point (3,) where the sensor helps most."""
        return np.array(self.points[int(np.argmin(self.values))])

    @property
    def ratio(self) -> FloatArray:
        """Score with the sensor divided by the score without it (n,); 1 if it does not help."""
        if not np.isfinite(self.without):
            return np.where(np.isfinite(self.values), 0.0, 1.0)
        return np.asarray(self.values / self.without)


def sensor_map(
    plant: StandardPlant,
    points: npt.ArrayLike,
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    asd: float,
    direction: str = "z",
    quantity: Quantity = "displacement",
    constraints: Sequence[Constraint] = (),
    executor: Executor | None = None,
    progress: bool | None = None,
) -> SensorMap:
    """Return how much one more sensor would help at each of many points.

    Parameters
    ----------
    plant, criterion, executor, progress
        Plant, criterion and options, as for `score_sensors`. The plant keeps its own sensors.
    points : (n, 3) array [m]
        Points on the structure.
    asd : float [m/sqrt(Hz), ...]
        Noise of the new sensor, as in `Sensor`.
    direction, quantity : str
        Direction and quantity that the new sensor measures, as in `Sensor`.
    constraints : sequence of Constraint, optional
        Constraints, as for `place_sensors`. A point is left out if a sensor there violates a
        constraint. Points on a POI are left out as well, unless OffPoi(-1) is one of the
        constraints.

    Returns
    -------
    SensorMap
        Scores in the order of the points that are not left out.

    Raises
    ------
    ModelError, AssumptionError, CertificateError
        As `score_sensors`; or when no point satisfies the constraints.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.placement.sensor_map(plant, [(0, 0, 0), (1, 0, 0)], asd=1e-10, direction="x")
    >>> found.best
    array([0., 0., 0.])
    """
    plant = sampled_plant(plant)
    places = real_array(points, "points", (None, 3))
    noise = positive(asd, "asd", zero=True)
    own = plant.assembled.ports.y
    taken = {sensor.name for sensor in own}
    prefix = next(p for p in ("extra", "extra_", "extra__", "extra___") if f"{p}1" not in taken)
    tried = [
        Sensor(f"{prefix}{i}", at=place, direction=direction, quantity=quantity, asd=noise)
        for i, place in enumerate(places, 1)
    ]
    where = candidate_places(plant, (*own, *tried))
    free = constraint_rows(constraints, where, "y").added(range(len(own)))[len(own) :]
    if not np.any(free):
        raise ModelError("no point can be tried: give at least one that satisfies the constraints.")
    places, tried = places[free], [sensor for sensor, kept in zip(tried, free, strict=True) if kept]
    zones = tuple(zone for item in all_of(constraints, "y") for zone in item.drawn(where))
    layouts = layouts_of(plant, "y", (*own, *tried), criterion)
    layouts.require_any()
    base = tuple(range(len(own)))
    sets = [base, *((*base, len(own) + i) for i in range(len(tried)))]
    values = layouts.scores(sets, Work(executor, progress), "points")
    best = 1 + int(np.argmin(values[1:]))
    layouts.confirm(sets[best], float(values[best]))
    criterion, unit = layouts.criterion, layouts.criterion.unit(plant)
    return SensorMap(places, values[1:], float(values[0]), repr(criterion), zones, unit)
