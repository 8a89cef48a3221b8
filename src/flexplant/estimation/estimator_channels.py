"""Which channels of a plant an estimator uses, and what its estimates are called."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import AssumptionError, ModelError, unknown_label
from ..lti.statespace import System
from ..plant import StandardPlant, standard_plant

#: z channels that are not motions of a POI
DERIVED = (":error", ":effort")


def checked_plant(given: StandardPlant | System) -> StandardPlant:
    """Return a StandardPlant that has something to estimate and to measure."""
    plant = standard_plant(given)
    if plant.origin.scaled:
        raise ModelError(
            f"the plant is {plant.alteration}: an estimator is of physical channels. Use "
            "plant.unweighted."
        )
    _check_reading(plant)
    for side, names in (("POI in z", poi_channels(plant)), ("sensor in y", sensors(plant))):
        if not names:
            raise AssumptionError(f"the plant has no {side}: there is nothing to estimate with.")
    return plant


def _check_reading(plant: StandardPlant) -> None:
    """Raise ModelError unless y is a static combination of sensors alone."""
    plain = plant.unweighted
    mixed = [plain.y.index(name) for name in plain.y if name in plain.w]
    rows = [plant.y.index(name) for name in sensors(plant)]
    if np.any(plant.reading_gain[np.ix_(rows, mixed)]):
        raise ModelError(
            "the block that the plant is read through mixes references with sensors: a reference "
            "would look like a motion. Estimate from the sensors, on plant.unweighted."
        )


def read_alike(plant: StandardPlant, other: StandardPlant) -> StandardPlant:
    """Return another plant read through the block of the first, where that has one."""
    reading = plant.origin.reading
    return other if reading is None else other.through(reading)


def sensors(plant: StandardPlant) -> tuple[str, ...]:
    """Return the names in y that are measurements; references are in w as well."""
    return tuple(name for name in plant.y if name not in plant.w)


def poi_channels(plant: StandardPlant) -> tuple[str, ...]:
    """Return the names in z that are motions of POIs."""
    return tuple(name for name in plant.z if not name.endswith(DERIVED))


def same_pois(plant: StandardPlant, on: StandardPlant | System) -> StandardPlant:
    """Return another plant that has the sensors and POIs of the first."""
    other = read_alike(plant, standard_plant(on).unweighted)
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


def estimates(channels: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the estimates, such as `die:hat` and `die:rx:hat`."""
    return tuple(_derived(channels, "hat"))


def row_of(channels: Sequence[str], name: str) -> int:
    """Return which POI channel a name means: `die`, `die:z`, `die:hat` and `die:error` are one."""
    known: dict[str, int] = {}
    for kind in ("hat", "error"):
        known |= {alias: i for i, alias in enumerate(_derived(channels, kind))}
    known |= _firsts(channels)
    known |= {channel: i for i, channel in enumerate(channels)}
    if name not in known:
        raise unknown_label("POI channel", name, channels)
    return known[name]


def _firsts(channels: Sequence[str]) -> Mapping[str, int]:
    first: dict[str, int] = {}
    for i, channel in enumerate(channels):
        first.setdefault(channel.rpartition(":")[0] or channel, i)
    return first


def _derived(channels: Sequence[str], kind: str) -> list[str]:
    first = _firsts(channels)
    names = []
    for i, channel in enumerate(channels):
        poi = channel.rpartition(":")[0] or channel
        names.append(f"{poi if first[poi] == i else channel}:{kind}")
    return names
