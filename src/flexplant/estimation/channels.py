"""Which channels of a plant an estimator uses, and what its estimates are called."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..errors import AssumptionError, ModelError, unknown_label
from ..plant import StandardPlant
from ..values import short

#: z channels that are not motions of a POI
DERIVED = (":error", ":effort")


def checked_plant(plant: StandardPlant) -> StandardPlant:
    """Return a StandardPlant that has something to estimate and to measure.

    Raises
    ------
    ModelError
        When it is no plant, or weighted.
    AssumptionError
        When it has no POI or no sensor.
    """
    if not isinstance(plant, StandardPlant):
        raise not_a_plant(plant)
    if plant.unweighted is not None:
        raise ModelError(
            "the plant is weighted: an estimator is of physical channels. Use plant.unweighted."
        )
    for side, names in (("POI in z", poi_channels(plant)), ("sensor in y", sensors(plant))):
        if not names:
            raise AssumptionError(f"the plant has no {side}: there is nothing to estimate with.")
    return plant


def not_a_plant(given: object) -> ModelError:
    """Return the error for something else where a StandardPlant is needed, with what to type."""
    if hasattr(given, "A") and hasattr(given, "B"):
        return ModelError(
            f"need a StandardPlant, got a {type(given).__name__}, whose channels do not tell which "
            "are disturbances and POIs. Type StandardPlant.from_statespace(sys, w=[...], u=[...], "
            "z=[...], y=[...], asd={...}) and pass what it returns; for a Kalman filter with "
            ".replace(noise_factor=G), G G' the covariance that w adds to x in one sample."
        )
    return ModelError(
        f"need a StandardPlant, got {short(given)}. Make it by assemble_plant(model, ports)."
    )


def sensors(plant: StandardPlant) -> tuple[str, ...]:
    """Return the names in y that are measurements; references are in w as well."""
    return tuple(name for name in plant.y if name not in plant.w)


def poi_channels(plant: StandardPlant) -> tuple[str, ...]:
    """Return the names in z that are motions of POIs."""
    return tuple(name for name in plant.z if not name.endswith(DERIVED))


def estimates(channels: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the estimates, such as `die:hat` and `die:rx:hat`."""
    return tuple(_derived(channels, "hat"))


def row_of(channels: Sequence[str], name: str) -> int:
    """Return which POI channel a name means: `die`, `die:z`, `die:hat` and `die:error` are one.

    Raises
    ------
    LabelError
        When it means none.
    """
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
