"""POIs that move along a path: how each point sees the state, and the noise of modes left out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import LabelError, ShapeError, counted, require_known
from ..plant import StandardPlant
from ..values import FloatArray, real_array, short
from .filter_model import FilterModel, filter_model
from .left_out import LeftOut, left_out
from .sight import Sight

#: points of a path that are assembled together
_TOGETHER = 128


def moving_sight(
    plant: StandardPlant, found: LeftOut | None, model: FilterModel, path: Any, count: int
) -> Sight:
    """Return the rows of all POIs at each sample, those on a path at its points.

    Each distinct point is a POI of its own of the same plant: its rows of C and D are exact, and so
    are the covariances of the modes left out there.
    """
    pois = {poi.name: poi for poi in plant.assembled.ports.z}
    if not isinstance(path, Mapping):
        if len(pois) != 1:
            raise LabelError(
                f"the plant has the POIs {', '.join(pois)}: name those that move, "
                f"path={{name: points}}, got {short(path)}."
            )
        path = {next(iter(pois)): path}
    nz = model.C1.shape[0]
    c = np.repeat(np.hstack([model.C1, model.N])[None], count, axis=0)
    D1 = np.repeat(model.D1[None], count, axis=0)
    V = np.repeat(np.diagonal(model.V)[None], count, axis=0)
    for name, points in path.items():
        require_known("POI", [name], pois)
        points = real_array(points, f"the path of {name!r}", (None, 3))
        if len(points) != count:
            raise ShapeError(
                f"the path of {name!r} has {counted(len(points), 'point')}, the record {count} "
                "samples. Pass the point at each sample."
            )
        distinct, which = np.unique(points, axis=0, return_inverse=True)
        which = which.reshape(-1)
        rows = [model.channels.index(pois[name].channel(axis)) for axis in pois[name].axes]
        for first in range(0, len(distinct), _TOGETHER):
            some = distinct[first : first + _TOGETHER]
            there = _model_at(plant, found, pois[name], some)
            at = np.flatnonzero((which >= first) & (which < first + len(some)))
            place = which[at] - first
            for i, row in enumerate(rows):
                own = nz + place * len(rows) + i
                c[at, row] = np.hstack([there.C1, there.N])[own]
                D1[at, row], V[at, row] = there.D1[own], there.V.diagonal()[own]
    return Sight(c, D1, V)


def _model_at(
    plant: StandardPlant, found: LeftOut | None, poi: Any, points: FloatArray
) -> FilterModel:
    """Return the model with a further POI at each point, after the plant's own."""
    ports = plant.assembled.ports
    more = [poi.replace(name=f"{poi.name}@{i}", at=p.tolist()) for i, p in enumerate(points)]
    wider = ports.replace(z=[*ports.z, *more])
    moved = plant.with_ports(wider)
    if found is None:
        return filter_model(moved)
    assert found.larger is not None  # noqa: S101 - left_out sets it
    whole = found.larger.with_ports(wider)
    return filter_model(moved, left_out(moved, whole))
