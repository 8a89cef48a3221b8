"""Where one more sensor helps most: a score at every point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..checks import FloatArray, Value, positive, real_array
from ..errors import ModelError, counted
from ..plant import Sensor, StandardPlant
from ..plant.ports import Quantity
from ..structure import Disc, Rectangle
from ..work import Work
from .candidates import checked_plant, places_of
from .criterion import Criterion, in_words
from .groups import Constraint
from .layouts import layouts_of
from .zones import all_of, rows_of


@dataclass(frozen=True, eq=False, repr=False)
class SensorMap(Value):
    """The score with one more sensor at each of many points.

    Parameters
    ----------
    points : (n, 3) array [m]
        Where the sensor was tried.
    values : (n,) array
        Scores, infinite where even with it a rigid-body mode is missed.
    without : float
        The score of the plant's own sensors alone (infinite when they do not suffice).
    criterion : str
        What was scored.
    excluded : sequence of Rectangle or Disc
        Zones in which nothing was tried.
    unit : str
        Of the square roots of the values, where they are mean squares of a motion.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.sensor_map(plant, [(0, 0, 0), (2, 0, 0)], asd=1e-10, direction="x")
    >>> found.values.shape, bool((found.values <= found.without).all())
    ((2,), True)
    """

    points: FloatArray
    values: FloatArray
    without: float
    criterion: str
    excluded: Sequence[Rectangle | Disc] = ()
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
        """Score with the sensor over score without it (n,): 1 where it is of no use."""
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
    plant : StandardPlant
        Sampled, assembled from a structure; its own sensors stay.
    points : (n, 3) array [m]
        On the structure.
    criterion : PoiVariance or callable, optional
        From a plant to a float, smaller is better; `PoiVariance()` when not given.
    asd : float [m/sqrt(Hz), ...]
        Noise of the new sensor, as in `Sensor`.
    direction : str
        What it measures at the point.
    quantity : {"displacement", "velocity", "acceleration"}
        What it measures.
    constraints : sequence of Constraint, optional
        As for `place_sensors`: points at which one more sensor breaks one are left out. A point on
        a POI is, unless OffPoi(-1) is among them.
    executor, progress : optional
        As for `score_sensors`.

    Returns
    -------
    SensorMap
        In the order of the points that are not left out.

    Raises
    ------
    ModelError
        When the plant is not sampled or has no structure, something is no constraint, or no point
        satisfies them.
    ShapeError
        When the points are not (n, 3).
    LabelError
        When a point is off the structure or the direction is unknown.
    AssumptionError
        When even a sensor at every point misses a rigid-body mode, which is named.
    CertificateError
        When the best score is not confirmed by the other route.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.sensor_map(plant, [(0, 0, 0), (1, 0, 0)], asd=1e-10, direction="x")
    >>> found.best
    array([0., 0., 0.])
    """
    plant = checked_plant(plant)
    places = real_array(points, "points", (None, 3))
    noise = positive(asd, "asd", zero=True)
    own = plant.assembled.ports.y
    taken = {sensor.name for sensor in own}
    prefix = next(p for p in ("extra", "extra_", "extra__", "extra___") if f"{p}1" not in taken)
    tried = [
        Sensor(f"{prefix}{i}", at=place, direction=direction, quantity=quantity, asd=noise)
        for i, place in enumerate(places, 1)
    ]
    where = places_of(plant, (*own, *tried))
    free = rows_of(constraints, where, "y").added(range(len(own)))[len(own) :]
    if not np.any(free):
        raise ModelError(
            "there is no point to try: give at least one"
            + (" that satisfies the constraints." if len(tried) else ".")
        )
    places, tried = places[free], [sensor for sensor, kept in zip(tried, free, strict=True) if kept]
    zones = tuple(zone for item in all_of(constraints, "y") for zone in item.drawn(where))
    layouts = layouts_of(plant, "y", (*own, *tried), criterion)
    layouts.require_any()
    base = tuple(range(len(own)))
    sets = [base, *((*base, len(own) + i) for i in range(len(tried)))]
    values = layouts.scores(sets, Work(executor, progress), "points")
    best = 1 + int(np.argmin(values[1:]))
    layouts.confirm(sets[best], float(values[best]))
    return SensorMap(
        places,
        values[1:],
        float(values[0]),
        repr(layouts.criterion),
        zones,
        layouts.criterion.unit(plant),
    )
