"""The axes of POIs that a criterion sums over, and their rows in a plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from ..checks import FloatArray, positive, short
from ..errors import LabelError, ModelError, counted, require_known
from ..estimation.estimator_channels import sensors
from ..lti.discretisation import held_exactly
from ..lti.statespace import StateSpace
from ..plant import Actuator, StandardPlant
from .candidates import with_side

#: POIs, or axes of a POI, that count, each once or by a factor
Named: TypeAlias = "str | Sequence[str] | Mapping[str, float] | None"


def checked_names(given: Any, name: str) -> tuple[str, ...] | Mapping[str, float] | None:
    """Return names as a tuple, or as a mapping to factors; None stays None."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        named = {str(a): positive(f, f"factor of {name} {a!r}") for a, f in given.items()}
    elif isinstance(given, str | Sequence):
        listed = (given,) if isinstance(given, str) else tuple(str(a) for a in given)
        if len(set(listed)) != len(listed):
            raise LabelError(f"{name} {listed} twice: name each once, with a factor.")
        named = dict.fromkeys(listed, 1.0)
    else:
        raise ModelError(
            f"{name} is a name, several, or a mapping to factors, got {short(given)}. Type "
            "('die', 'lens'), say."
        )
    if not named:
        raise LabelError(f"a criterion without any {name} has nothing to sum over: name one.")
    return named if isinstance(given, Mapping) else tuple(named)


def shown(poi: Named, axes: Named) -> list[str]:
    """Return POIs and their axes as arguments, for a repr."""
    parts = [] if poi is None else [repr(_plain(poi))]
    return parts if axes is None else [*parts, f"axes={_plain(axes)!r}"]


def _plain(named: Any) -> Any:
    if isinstance(named, Mapping):
        return dict(named)
    return named[0] if isinstance(named, tuple) and len(named) == 1 else named


def channels_of(plant: StandardPlant) -> dict[str, dict[str, str]]:
    """Return {POI: {axis: z channel}}; of a plant made elsewhere by the channels' names."""
    if plant.is_assembled:
        pois = plant.assembled.ports.z
        return {poi.name: {axis: poi.channel(axis) for axis in poi.axes} for poi in pois}
    found: dict[str, dict[str, str]] = {}
    for name in plant.z:
        poi, _, axis = name.partition(":")
        if axis not in ("effort", "error"):
            found.setdefault(poi, {})[axis] = name
    return found


def factors_of(plant: StandardPlant, poi: Named, axes: Named, *, every: bool) -> dict[str, float]:
    """Return {z channel: factor}, the factor of the POI times that of the axis."""
    known = channels_of(plant)
    if poi is None and len(known) != 1:
        raise LabelError(
            f"the plant has {counted(len(known), 'POI')} ({', '.join(known)}): say which count, "
            f"such as PoiVariance({next(iter(known), 'die')!r}), or all of them in a list."
        )
    found: dict[str, float] = {}
    for name, weight in _factors(poi if poi is not None else tuple(known)).items():
        require_known("POI", [name], known)
        own = known[name]
        usual = tuple(own) if every else tuple(own)[:1]
        for axis, factor in _factors(usual if axes is None else axes).items():
            require_known(f"axis of POI {name!r}", [axis], own)
            found[own[axis]] = weight * factor
    return found


def _factors(named: Any) -> dict[str, float]:
    if isinstance(named, Mapping):
        return dict(named)
    return dict.fromkeys((named,) if isinstance(named, str) else named, 1.0)


def unit_of(plant: StandardPlant, factors: Mapping[str, float]) -> str:
    """Return "rad" where only rotations count, each by the factor 1; else "m"."""
    units = {plant.system.units.get(name) for name in factors}
    return "rad" if units == {"rad"} and set(factors.values()) == {1.0} else "m"


def poi_rows(plant: StandardPlant, factors: Mapping[str, float]) -> FloatArray:
    """Return the rows of C of z channels, each times its factor."""
    g = plant.system
    scale = np.array(list(factors.values()))
    return np.asarray(g.C[g.output_index(list(factors))] * scale[:, None])


def structure_part(
    plant: StandardPlant, factors: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, the noise factor and the rows of the POI on all states but delay lines of u."""
    n = _own_states(plant)
    return plant.system.A[:n, :n], plant.noise_factor[:n], poi_rows(plant, factors)[:, :n]


def _own_states(plant: StandardPlant) -> int:
    """Return how many states are no delay lines: all of a plant made elsewhere."""
    return (plant.continuous if plant.is_assembled else plant).system.n_states


def measured_rows(plant: StandardPlant, candidates: Sequence[Any]) -> FloatArray:
    """Return what sensors see of these states, over the deviation of one sample."""
    whole = with_side(plant, "y", candidates)
    rows = [whole.y.index(port.name) for port in candidates]
    size = np.sqrt(np.diagonal(whole.sensor_noise)[rows])
    return np.asarray(whole.C2[rows, : _own_states(plant)] / size[:, None])


def sensor_rows(plant: StandardPlant) -> list[int]:
    """Return which channels of y are sensors, not references."""
    return [plant.y.index(name) for name in sensors(plant)]


def pushed_columns(plant: StandardPlant, candidates: Sequence[Any]) -> FloatArray:
    """Return what a unit of each actuator, held over one sample, does to these states."""
    if not plant.is_assembled:
        return np.asarray(plant.B2[:, [plant.u.index(port.name) for port in candidates]])
    silent = np.zeros((0, _own_states(plant)))
    return held_exactly(pushed(plant, candidates, silent), 1.0 / plant.dt).B


def pushed(plant: StandardPlant, candidates: Sequence[Any], rows: FloatArray) -> StateSpace:
    """Return the system between actuators and some rows of its states, continuous."""
    g = with_side(plant.continuous, "u", candidates).system
    B = g.B[:, g.input_index([port.name for port in candidates])]
    return StateSpace(g.A, B, rows, np.zeros((len(rows), B.shape[1])), blocks=g.blocks)


def plain(plant: StandardPlant, candidates: Sequence[Any]) -> bool:
    """Return whether candidates change rows of B or C only: they, y and u have no states.

    Disturbances may have: a shape, the acceleration of the base.
    """
    if not plant.is_assembled:
        return not np.any(plant.D22)
    ports, realisation = plant.assembled.ports, plant.assembled.realisation
    # what is added to a sensor, and noise of an actuator, come and go with it
    apart = all(port.added_to is None for port in ports.w)
    apart = apart and not any(isinstance(c, Actuator) and c.asd > 0 for c in candidates)
    rigidly = not realisation.static_inputs.size
    return apart and rigidly and all(map(bare, (*ports.u, *ports.y, *candidates)))


def bare(port: Any) -> bool:
    """Return whether a port is without filter and delay."""
    return not any(getattr(port, name, None) for name in ("dynamics", "shape", "latency"))
