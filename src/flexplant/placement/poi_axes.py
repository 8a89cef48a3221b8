"""The axes of a POI that a criterion sums over, and their rows in a plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from ..errors import LabelError, unknown_label
from ..plant import Actuator, Disturbance, Poi, StandardPlant
from ..values import FloatArray, positive

#: axes of a POI that count, each once or by a factor
Axes: TypeAlias = "str | Sequence[str] | Mapping[str, float] | None"


def checked_axes(axes: Axes) -> tuple[str, ...] | Mapping[str, float] | None:
    """Return axes as a tuple, or as a mapping to factors.

    Raises
    ------
    LabelError
        When an axis appears twice, or there is none.
    ModelError
        When a factor is not positive.
    """
    if axes is None:
        return None
    if isinstance(axes, Mapping):
        named = {str(a): positive(f, f"factor of axis {a!r}") for a, f in axes.items()}
    else:
        listed = (axes,) if isinstance(axes, str) else tuple(str(a) for a in axes)
        if len(set(listed)) != len(listed):
            raise LabelError(f"axes {listed} hold one twice: name each once, with a factor.")
        named = dict.fromkeys(listed, 1.0)
    if not named:
        raise LabelError("a criterion without axes has nothing to sum over: name one.")
    return named if isinstance(axes, Mapping) else tuple(named)


def shown(poi: str | None, axes: Axes) -> str:
    """Return a POI and its axes as arguments, for a repr."""
    parts = [] if poi is None else [repr(poi)]
    if axes is not None:
        parts.append(f"axes={dict(axes) if isinstance(axes, Mapping) else axes!r}")
    return ", ".join(parts)


def poi_of(plant: StandardPlant, name: str | None) -> Poi:
    """Return the POI of this name, or the only one."""
    ports = plant.assembled.ports
    if name is not None:
        return ports.poi(name)
    if len(ports.z) != 1:
        raise LabelError(
            f"the plant has {len(ports.z)} POIs ({', '.join(p.name for p in ports.z)}): say which "
            f"one counts, such as PoiVariance({ports.z[0].name!r})."
        )
    return ports.z[0]


def factors_of(
    plant: StandardPlant, name: str | None, axes: Axes, *, every: bool
) -> dict[str, float]:
    """Return {z channel: factor}."""
    poi = poi_of(plant, name)
    if axes is None:
        axes = poi.axes if every else poi.axes[:1]
    named = dict(axes) if isinstance(axes, Mapping) else dict.fromkeys(axes, 1.0)
    for axis in named:
        if axis not in poi.axes:
            raise unknown_label(f"axis of POI {poi.name!r}", axis, poi.axes)
    return {poi.channel(axis): factor for axis, factor in named.items()}


def poi_rows(plant: StandardPlant, factors: Mapping[str, float]) -> FloatArray:
    """Return the rows of C of z channels, each times its factor."""
    g = plant.system
    scale = np.array(list(factors.values()))
    return np.asarray(g.C[g.output_index(list(factors))] * scale[:, None])


def structure_part(
    plant: StandardPlant, factors: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, the noise factor and the rows of the POI on the structure's own states."""
    n = plant.assembled.realisation.outputs.shape[1]
    return plant.system.A[:n, :n], plant.noise_factor[:n], poi_rows(plant, factors)[:, :n]


def plain(plant: StandardPlant, candidates: Sequence[Any]) -> bool:
    """Return whether candidates change rows of B or C only: no port has a filter or delay.

    Parameters
    ----------
    plant : StandardPlant
        With ports.
    candidates : sequence of Sensor or Actuator
        All that may be chosen.
    """
    ports, realisation = plant.assembled.ports, plant.assembled.realisation
    forces = all(isinstance(port, Disturbance) for port in ports.w)
    rigidly = not realisation.static_inputs.size
    # noise of an actuator comes and goes with it
    forces = forces and not any(isinstance(c, Actuator) and c.asd > 0 for c in candidates)
    return forces and rigidly and all(map(bare, (*ports.w, *ports.u, *ports.y, *candidates)))


def bare(port: Any) -> bool:
    """Return whether a port is without filter and delay."""
    return not any(getattr(port, name, None) for name in ("dynamics", "shape", "latency"))
