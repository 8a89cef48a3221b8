"""Pictures of placement."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Patch
from matplotlib.patches import Rectangle as Box

from ..placement import SensorMap
from ..plant import Ports
from ..structure import Disc, Rectangle
from ..values import FloatArray, instance
from ._axes import MARK, MEASURED, axes, finish


def sensor_map(found: SensorMap, *, ports: Ports | None = None, ax: Axes | None = None) -> Axes:
    """Draw where one more sensor helps, seen from above.

    Parameters
    ----------
    found : SensorMap
        From `flexplant.sensor_map`.
    ports : Ports, optional
        Sensors that are there already, where their places are points.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Filled contours of the square root of the score's ratio: the error with the sensor over
        the error without it; excluded zones hatched.

    Raises
    ------
    ModelError
        When `found` is no SensorMap.
    """
    instance(found, SensorMap, "found", "Pass what sensor_map returned.")
    ax = axes(ax, figsize=(6.4, 5.4))
    ratio = np.sqrt(found.ratio)
    x, y = found.points[:, 0], found.points[:, 1]
    contours = ax.tricontourf(x, y, ratio, levels=20, cmap="viridis_r")
    ax.figure.colorbar(contours, ax=ax, label="POI error with / without a further sensor [1]")
    ax.plot(x, y, ".", color="white", markersize=1.5)
    for i, zone in enumerate(found.excluded):
        style = {"facecolor": "white", "edgecolor": "0.3", "hatch": "///", "zorder": 2.5}
        label = "no sensor possible" if i == 0 else None
        ax.add_patch(_patch(zone, label=label, **style))
    there = [port.at for port in ports.y if isinstance(port.at, tuple)] if ports else []
    if there:
        points: FloatArray = np.array(there, dtype=np.float64)
        ax.plot(points[:, 0], points[:, 1], "P", color=MEASURED, label="sensors", clip_on=False)
    ax.plot(*found.best[:2], "*", color=MARK, markersize=14, label="best place", clip_on=False)
    ax.set_aspect("equal")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False)
    return finish(ax, x="x [m]", y="y [m]")


def _patch(zone: Rectangle | Disc, **style: Any) -> Patch:
    """Return the outline of a zone."""
    if isinstance(zone, Disc):
        return Circle((zone.centre[0], zone.centre[1]), zone.radius, **style)
    (x, y), (right, top) = zone.lower, zone.upper
    return Box((x, y), right - x, top - y, **style)
