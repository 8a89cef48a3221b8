"""What all pictures share: axes to draw on, and one colour for one thing."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

#: one colour for one thing in every picture: the machine, the drawing, the updated model, and the
#: full model that a reduction stands for
MEASURED, NOMINAL, UPDATED, FULL = "black", "0.55", "tab:blue", "tab:green"
#: what is marked, and small differences
MARK, DIFFERENCE = "tab:red", "tab:orange"
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


def finish(ax: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label the axes, with units, and draw a light grid."""
    ax.set(xlabel=x, ylabel=y)
    if title:
        ax.set_title(title)
    ax.grid(True, which="both", alpha=0.25)
    return ax
