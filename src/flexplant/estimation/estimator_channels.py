"""Channels of a plant and of a record for an estimator, and names of its estimates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, floats, real_array
from ..errors import AssumptionError, LabelError, ModelError, ShapeError, short, unknown_label
from ..lti.statespace import System
from ..parallel import PIECE
from ..plant import AnyPlant, GeneralizedPlant, plant_of, standard_plant
from ..tolerances import SAME

#: z channels that are not motions of a POI
DERIVED = (":error", ":effort")


class ChannelError(LabelError, KeyError):
    """A record or an estimate does not have a channel; also a KeyError, as for any Mapping."""

    __str__ = Exception.__str__


def checked_plant(given: AnyPlant | System) -> AnyPlant:
    """Return a StandardPlant that has something to estimate and to measure."""
    plant = plant_of(given)
    if isinstance(plant, GeneralizedPlant) and plant.scaled:
        plant = standard_plant(plant)  # refuses weights: an estimator is of physical channels
    plain = plant.machine
    mixed = [plain.y.index(name) for name in plain.y if name in plain.w]
    rows = [plant.y.index(name) for name in sensors(plant)]
    if np.any(plant.reading_gain[np.ix_(rows, mixed)]):
        raise ModelError(
            "the block that the plant is read through mixes references with sensors: a reference "
            "would look like a motion. Estimate from the sensors, on plant.unweighted."
        )
    for side, names in (("POI in z", poi_channels(plant)), ("sensor in y", sensors(plant))):
        if not names:
            raise AssumptionError(f"the plant has no {side}, which an estimator needs.")
    return plant


def sensors(plant: AnyPlant) -> tuple[str, ...]:
    """Return the names in y that are measurements; references are in w as well."""
    return tuple(name for name in plant.y if name not in plant.w)


def poi_channels(plant: AnyPlant) -> tuple[str, ...]:
    """Return the names in z that are motions of POIs."""
    return tuple(name for name in plant.z if not name.endswith(DERIVED))


def same_pois(plant: AnyPlant, on: AnyPlant | System) -> AnyPlant:
    """Return another plant that has the sensors, POIs and sampling time of the first."""
    other: AnyPlant = plant.around(plant_of(on).machine)
    if not np.isclose(other.dt, plant.dt, rtol=SAME, atol=0.0):
        raise ModelError(
            "the error of an estimator needs a plant of its sampling time, "
            f"{plant.dt:g} s, got {other.dt:g} s. Sample both at one rate."
        )
    for side, names in (("z", poi_channels(plant)), ("y", sensors(plant))):
        for name in names:
            if name not in getattr(other, side):
                raise unknown_label(f"channel of {side} of the other plant", name, names)
    if poi_channels(other) != poi_channels(plant):
        raise ModelError(
            f"the other plant has the POIs {', '.join(poi_channels(other))}, the filter's has "
            f"{', '.join(poi_channels(plant))}. Assemble both with the same ports."
        )
    return other


def estimates(channels: Sequence[str], kind: str = "hat") -> tuple[str, ...]:
    """Return the names of the estimates, such as `die:hat` and `die:rx:hat`."""
    first = _firsts(channels)
    owners = [channel.rpartition(":")[0] or channel for channel in channels]
    return tuple(
        f"{poi if first[poi] == i else channels[i]}:{kind}" for i, poi in enumerate(owners)
    )


def row_of(channels: Sequence[str], name: str) -> int:
    """Return the POI channel of a name: `die`, `die:z`, `die:hat` and `die:error` are equal."""
    known: dict[str, int] = {}
    for kind in ("hat", "error"):
        known |= {alias: i for i, alias in enumerate(estimates(channels, kind))}
    known |= _firsts(channels)
    known |= {channel: i for i, channel in enumerate(channels)}
    if not isinstance(name, str) or name not in known:
        raise unknown_label("POI channel", name, channels)
    return known[name]


def _firsts(channels: Sequence[str]) -> dict[str, int]:
    """Return the first channel of each POI."""
    last_first = reversed([*enumerate(channels)])
    return {channel.rpartition(":")[0] or channel: i for i, channel in last_first}


class Recorded(NamedTuple):
    """A record: time (N,), measurements y with NaN where missing, and commands u.

    `both` is [y u] (N, ny + nu).
    """

    time: FloatArray
    both: FloatArray
    ny: int

    @property
    def y(self) -> FloatArray:
        """Measurements (N, ny)."""
        return self.both[:, : self.ny]

    @property
    def u(self) -> FloatArray:
        """Commands (N, nu)."""
        return self.both[:, self.ny :]


def recorded(records: Any, model: Any) -> Recorded:
    """Return the sensors and commands of a filter's model from what was recorded."""
    if not hasattr(records, "keys") or not hasattr(records, "__getitem__"):
        raise ModelError(
            f"records must give channels by name, got {short(records)}. Pass a Response, a data "
            "frame, or a mapping such as {'y1': array, 'u1': array}."
        )
    known = [str(name) for name in records.keys()]  # noqa: SIM118 - a data frame iterates so too
    for name in (*model.sensors, *model.commands):
        if name not in known:
            missing = unknown_label("channel", name, known, "the records")
            what = (
                "A sensor that was not recorded is an array of NaN"
                if name in model.sensors
                else "A command that was not given is an array of zeros"
            )
            raise LabelError(f"{missing} {what}: the filter needs all of its channels.")
    names = (*model.sensors, *model.commands)
    parts = [_run_values(records[n], n, missing=n in model.sensors) for n in names]
    sizes = {name: part.size for name, part in zip(names, parts, strict=True)}
    if len(set(sizes.values())) > 1:
        raise ShapeError(
            f"channels of one record have one length, got {short(sizes)}. Cut them to the same "
            "samples, or fill what is missing of a sensor with NaN."
        )
    count, ny = parts[0].size, len(model.sensors)
    if not count:
        raise ShapeError("the record is empty: give at least one sample.")
    both = np.empty((count, len(parts)))
    for first in range(0, count, PIECE):  # a piece of all columns stays in the cache
        piece = slice(first, first + PIECE)
        for i, part in enumerate(parts):
            both[piece, i] = part[piece]
    return Recorded(_time(records, known, count, model.dt), both, ny)


def _run_values(values: Any, name: str, *, missing: bool) -> FloatArray:
    array = floats(values, f"channel {name!r}")
    if array.ndim != 1:
        raise ShapeError(
            f"channel {name!r} must be (N,), one run over time, got {array.shape}. Of several runs "
            "take one: response.replace(data=response.data[0])."
        )
    if missing and not np.any(np.isinf(array)):
        return array
    return real_array(values, f"channel {name!r}")


def _time(records: Any, known: list[str], count: int, dt: float) -> FloatArray:
    """Return the times, which must be in steps of dt."""
    given = records["time"] if "time" in known else getattr(records, "time", None)
    if given is None or callable(given):
        return np.asarray(dt * np.arange(count))
    time = real_array(given, "time", (count,))
    steps = np.diff(time)
    if steps.size and np.max(np.abs(steps - dt)) > 1e-3 * dt:  # clocks of recorders
        k = int(np.argmax(np.abs(steps - dt)))
        raise ModelError(
            f"the record goes from {time[k]:.9g} to {time[k + 1]:.9g} s in one sample, the samples "
            f"of the filter are {dt:.9g} s apart. Design it at the rate of the record, and put NaN "
            "in the place of samples that were lost."
        )
    return time
