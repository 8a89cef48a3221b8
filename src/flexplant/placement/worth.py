"""What each device of a choice is worth: the value without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from ..plant import StandardPlant
from ..values import FloatArray, Value, instance
from ..work import Work
from .candidates import checked_plant
from .criterion import Criterion, in_words
from .layouts import layouts_of
from .placement import Placement

#: devices in the printed table
_SHOWN = 6


@dataclass(frozen=True, eq=False, repr=False)
class DeviceWorth(Value):
    """The value of a choice without each of its devices; prints as a table.

    Parameters
    ----------
    names : sequence of str
        The devices.
    value : float
        With all of them.
    without : (n,) array
        Without each one; infinite where the others do not suffice.
    unit : str
        Of the square roots of the values, where they are mean squares of a motion.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> fx.placement.device_worth(plant, fx.place_sensors(plant, candidates, 2)).names
    ('s1', 's3')
    """

    names: Sequence[str]
    value: float
    without: FloatArray
    unit: str = ""

    def __post_init__(self) -> None:
        self._set(names=tuple(self.names), without=self.without)

    def __repr__(self) -> str:
        lines = [f"<DeviceWorth: {in_words(self.value, self.unit)} with all>"]
        order = np.argsort(-self.without, kind="stable").tolist()
        for i in order[:_SHOWN]:
            lost = self.without[i]
            what = in_words(lost, self.unit) if np.isfinite(lost) else "the others do not suffice"
            lines.append(f"  without {self.names[i]}: {what}")
        if len(order) > _SHOWN:
            lines.append(f"  and {len(order) - _SHOWN} that matter less")
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
    """Return what each chosen device is worth: the value when it alone is left out.

    Parameters
    ----------
    plant : StandardPlant
        Sampled; that of the placement, or another one of the machine.
    placement : Placement
        From `place_sensors`, `place_actuators` or `place_both`.
    criterion : Criterion or callable, optional
        As for the placement.
    executor, progress : optional
        As for `place_sensors`.

    Raises
    ------
    ModelError
        When the plant or the placement is not what is needed.
    AssumptionError
        When the devices miss a rigid-body mode even together.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> worth = fx.placement.device_worth(plant, fx.place_sensors(plant, candidates, 2))
    >>> bool(worth.without[0] > worth.without[1])  # s1, beside the disturbance, is worth more
    True
    """
    plant = checked_plant(plant)
    instance(placement, Placement, "placement", "Pass what place_sensors returned.")
    layouts = layouts_of(plant, placement.side, placement.ports, criterion)
    layouts.require_any()
    every = tuple(range(len(placement.ports)))
    sets = [every, *(tuple(j for j in every if j != i) for i in every)]
    values = layouts.scores(sets, Work(executor, progress), "devices")
    unit = layouts.criterion.unit(plant)
    return DeviceWorth(placement.chosen, float(values[0]), values[1:], unit)
