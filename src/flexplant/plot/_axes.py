"""What all pictures share: axes to draw on, and one colour for one thing."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ..values import FloatArray

#: one colour for one thing in every picture: the machine, the drawing, the updated model, and the
#: full model that a reduction stands for
MEASURED, NOMINAL, UPDATED, FULL = "black", "0.55", "tab:blue", "tab:green"
#: what is marked, and small differences
MARK, DIFFERENCE = "tab:red", "tab:orange"
#: points along a line, of which none shall lie under a legend
_DENSE = 500
CYCLE = (UPDATED, "tab:orange", FULL, "tab:purple", "tab:brown", "tab:red")


def axes(ax: Axes | None, **figure: Any) -> Axes:
    """Return the given axes, or those of a new figure."""
    if ax is not None:
        return ax
    drawn: Axes = plt.subplots(layout="constrained", **figure)[1]
    return drawn


def panel_axes(ax: Axes | None, count: int) -> list[Axes]:
    """Return the given axes, or `count` new ones, one above the other with the same abscissa."""
    if ax is not None:
        return [ax]
    height = 4.0 if count == 1 else 1.2 + 2.2 * count
    _, drawn = plt.subplots(
        count, 1, sharex=True, squeeze=False, layout="constrained", figsize=(8.0, height)
    )
    return list(drawn[:, 0])


def legend(ax: Axes, *, given: bool) -> None:
    """Draw the legend where it covers no line: beside new axes, in a given one's emptiest corner.

    Beside is empty whatever part of the lines is shown later.
    """
    if not given:
        ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return
    shown = ax.legend(frameon=False)
    box = shown.get_window_extent().transformed(ax.transAxes.inverted())
    width, height = box.width + 0.02, box.height + 0.02
    to_axes = ax.transData + ax.transAxes.inverted()
    points = np.vstack([to_axes.transform(_polyline(line)) for line in ax.get_lines()])
    across = {"right": points[:, 0] > 1 - width, "left": points[:, 0] < width}
    along = {"upper": points[:, 1] > 1 - height, "lower": points[:, 1] < height}
    corners = {
        f"{v} {h}": int((up & at).sum()) for h, at in across.items() for v, up in along.items()
    }
    emptiest: Any = min(corners, key=lambda corner: corners[corner])
    ax.legend(frameon=False, loc=emptiest)


def _polyline(line: Line2D) -> FloatArray:
    """Return points (k, 2) along a line, also between those far apart, in data coordinates."""
    points = np.asarray(line.get_xydata(), dtype=np.float64)
    if len(points) > _DENSE or len(points) < 2:
        return points
    at = np.linspace(0, len(points) - 1, _DENSE)
    return np.column_stack([np.interp(at, np.arange(len(points)), values) for values in points.T])


def finish(ax: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label the axes, with units, and draw a light grid."""
    ax.set(xlabel=x, ylabel=y)
    if title:
        ax.set_title(title)
    ax.grid(True, which="both", alpha=0.25)
    return ax
