"""What the position of a machine does: decoupling, modes and own figures over its range."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from ..checks import FloatArray, Value, function, number, real_array
from ..errors import AssumptionError, LabelError, ModelError
from .assumptions import WEAK, mode_visibility
from .partition import Partition
from .rigid.decoupling import Decoupling, decouple
from .rigid.rigid_body import rigid_body_of
from .rigid.rigid_motion import rigid_parts
from .scheduling import values_over

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, repr=False)
class PositionMap(Value):
    """Figures of a machine over its positions; made by `StandardPlant.map`.

    Parameters
    ----------
    grid : mapping {name: (k,) array} [m or rad]
        The values of each position.
    decoupling : (..., 2) array
        Largest gain by which the transformations of the plant as it stands (`decouple`) miss the
        identity at each place of the grid: those of the sensors, then of the actuators; 0 where
        they hold. Rotations count by the radius of gyration. NaN where the structure has no rigid
        body that its channels decouple.
    seen, reached : (..., m) arrays
        Shares of each elastic mode at the best sensor and actuator (`ModeVisibility`).
    modes : (m,) sequence of str
        The elastic modes; of a sampled plant those below half its rate.
    figures : mapping {name: (...) array}
        Figures of one's own.

    Examples
    --------
    >>> import flexplant as fx
    >>> one = fx.plant.PositionMap(
    ...     {"x": [0.0, 0.1]}, [[0, 0], [0.1, 0.2]], [[1.0], [0.5]], [[1.0], [0.9]], ["mode 7"], {}
    ... )
    >>> print(one)
    <PositionMap: x 0 to 0.1, 2 points
      decoupling off by up to 0.2, at x = 0.1
      mode 7 least seen or reached: 0.5 of its best, at x = 0.1>
    """

    grid: Mapping[str, FloatArray]
    decoupling: FloatArray
    seen: FloatArray
    reached: FloatArray
    modes: tuple[str, ...]
    figures: Mapping[str, FloatArray]

    def __post_init__(self) -> None:
        grid = {name: real_array(values, name, (None,)) for name, values in self.grid.items()}
        shape = tuple(values.size for values in grid.values())
        modes = tuple(self.modes)
        own = {"decoupling": np.asarray(self.decoupling, dtype=np.float64)}
        for name in ("seen", "reached"):
            own[name] = real_array(getattr(self, name), name, (*shape, len(modes)))
        figures = {
            str(name): np.asarray(values, dtype=np.float64).reshape(shape)
            for name, values in self.figures.items()
        }
        self._set(grid=grid, modes=modes, figures=figures, **own)

    def __repr__(self) -> str:
        ranges = ", ".join(f"{n} {v[0]:g} to {v[-1]:g}" for n, v in self.grid.items())
        lines = [f"<PositionMap: {ranges}, {self.size} points"]
        if np.any(np.isfinite(self.decoupling)):
            worst = self.decoupling.max(axis=-1)
            lines.append(f"decoupling off by up to {worst.max():.3g}, {self._where(worst, True)}")
        if np.any(self.ever):
            least = self.weakest
            at = np.unravel_index(int(np.argmin(least)), least.shape)
            mode = np.array(self.modes)[self.ever][int(np.argmin(self.visible[at][self.ever]))]
            lines.append(
                f"{mode} least seen or reached: {least[at]:.2g} of its best, "
                f"{self._where(least, False)}"
            )
        for name, values in self.figures.items():
            lines.append(
                f"{name} {np.nanmin(values):.4g}, {self._where(values, False)}, "
                f"to {np.nanmax(values):.4g}, {self._where(values, True)}"
            )
        return "\n  ".join(lines) + ">"

    @property
    def size(self) -> int:
        """The number of places."""
        return int(np.prod([values.size for values in self.grid.values()]))

    @property
    def visible(self) -> FloatArray:
        """The share (..., m) of each mode in the loop: the smaller of what is seen and reached."""
        return np.minimum(self.seen, self.reached)

    @property
    def ever(self) -> npt.NDArray[np.bool_]:
        """Which modes (m,) are in the loop somewhere, with a share of one percent."""
        most = self.visible.reshape(-1, len(self.modes)).max(axis=0, initial=0.0)
        return np.asarray(most >= WEAK)

    @property
    def weakest(self) -> FloatArray:
        """The least share (...) of the modes that are in the loop somewhere."""
        return np.asarray(self.visible[..., self.ever].min(axis=-1, initial=1.0))

    def _where(self, values: FloatArray, largest: bool) -> str:
        best = np.nanargmax(values) if largest else np.nanargmin(values)
        at = np.unravel_index(int(best), values.shape)
        pairs = zip(self.grid.items(), at, strict=True)
        return "at " + ", ".join(f"{name} = {grid[i]:.3g}" for (name, grid), i in pairs)


def position_map(plant: Any, judge: Any, points: Any) -> PositionMap:
    """Return the figures of a plant over its positions."""
    positions = plant.assembled.ports.positions
    if not positions:
        raise LabelError(
            "the plant has no positions: nothing of it moves. Give ports moves={'x': (-1, 0, 0)} "
            "and Ports(..., positions=[fx.plant.Position('x', range=(-0.1, 0.1))])."
        )
    judges = _named_judges(judge)
    grid = values_over(positions, points)
    own = _decoupled(plant)
    rows: list[tuple[Any, ...]] = []
    modes: tuple[str, ...] = ()
    for values in product(*grid.values()):
        there = plant.at(**dict(zip(grid, values, strict=True)))
        # of a sampled plant the modes that its controller sees as they are
        most = 0.5 / plant.dt if plant.dt else np.inf
        shares = [one for one in mode_visibility(there) if one.freq < most]
        modes = tuple(f"mode {one.mode} ({one.freq:.4g} Hz)" for one in shares)
        sees, pushes = ([one.shares.get(side, 0.0) for one in shares] for side in "yu")
        rows.append((_misses(own, there), sees, pushes, list(_figures_at(judges, there))))
    shape = tuple(values.size for values in grid.values())
    decoupling, seen, reached, judged = (
        np.array(part, dtype=float) for part in zip(*rows, strict=True)
    )
    judged = judged.reshape(*shape, len(judges))
    return PositionMap(
        grid,
        decoupling.reshape(*shape, 2),
        seen.reshape(*shape, len(modes)),
        reached.reshape(*shape, len(modes)),
        modes,
        {name: judged[..., i] for i, name in enumerate(judges)},
    )


def _named_judges(judge: Any) -> dict[str, Callable[[Any], float]]:
    """Return named functions of a plant."""
    hint = "Pass a function of a plant, or {'margin': function}."
    if judge is None:
        return {}
    given = judge if isinstance(judge, Mapping) else {getattr(judge, "__name__", "figure"): judge}
    return {
        "figure" if name == "<lambda>" else str(name): function(one, f"judge {name!r}", hint)
        for name, one in given.items()
    }


def _figures_at(judges: Mapping[str, Callable[[Any], float]], plant: Partition) -> Iterator[float]:
    """Return figures of a plant; each is one number."""
    for name, one in judges.items():
        try:
            yield number(one(plant), name)
        except ModelError as error:
            raise ModelError(f"{name!r} at {plant.assembled.ports.standing}: {error}") from error


def _decoupled(plant: Any) -> Decoupling | None:
    """Return the transformations of a plant as it stands; None where it has none."""
    try:
        return decouple(plant.unweighted)
    except (AssumptionError, ModelError) as error:
        logger.info("no decoupling is shown over the positions: %s", error)
        return None


def _misses(own: Decoupling | None, plant: Any) -> tuple[float, float]:
    """Return by what transformations miss the identity at another place: of sensors, actuators."""
    if own is None:
        return np.nan, np.nan
    realisation, ports = plant.assembled.realisation, plant.assembled.ports
    body = rigid_body_of(realisation)
    inertia = np.sqrt(np.diag(body.mass))  # a rotation counts by its radius of gyration
    rows = [body.axes.index(axis) for axis in own.axes]
    scale = inertia[rows][:, None] / inertia
    sensors = [sensor for sensor in ports.y if sensor.order == 0]
    see = rigid_parts([sensor.static_row(realisation) for sensor in sensors], body.motions)
    push = rigid_parts([port.static_push(realisation) for port in ports.u], body.motions).T
    one = np.eye(len(body.axes))[rows]
    seen, pushed = scale * (own.T_y @ see - one), scale * (own.T_u.T @ push.T - one)
    return float(np.linalg.norm(seen, 2)), float(np.linalg.norm(pushed, 2))
