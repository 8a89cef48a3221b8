"""What all pictures share: axes to draw on, and the colours of the paper's figures."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

#: one colour a role, in every picture
MEASURED, REDUCED, UPDATED, FULL = "black", "tab:blue", "tab:red", "tab:green"
CYCLE = (REDUCED, UPDATED, FULL, "tab:orange", "tab:purple", "tab:brown")


def axes(ax: Axes | None, **figure: Any) -> Axes:
    """Return the given axes, or those of a new figure."""
    if ax is not None:
        return ax
    drawn: Axes = plt.subplots(layout="constrained", **figure)[1]
    return drawn


def finish(ax: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label the axes, with units, and draw a light grid."""
    ax.set(xlabel=x, ylabel=y)
    if title:
        ax.set_title(title)
    ax.grid(True, which="both", alpha=0.25)
    return ax
