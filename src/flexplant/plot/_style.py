"""One look for one thing: the palette, and how measurements, models, truths and bounds are drawn.

The colours are those of Okabe and Ito [OkabeIto2008]_, which remain different for
every kind of colour vision; dashes and widths differ too, for print without colour.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

BLUE, ORANGE, GREEN, RED, PURPLE, SKY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9",
)  # fmt: skip
BLACK, GREY, LIGHT = "black", "0.55", "0.8"

Style = dict[str, Any]

#: what is drawn in every picture, and how. What lies below others is wide
STYLES: Mapping[str, Style] = {
    "measured": {"color": BLACK, "linestyle": "-", "linewidth": 0.9, "zorder": 1.8},
    "truth": {"color": GREEN, "linestyle": "-", "linewidth": 4.0, "alpha": 0.35, "zorder": 1.5},
    "model": {"color": BLUE, "linestyle": "-", "linewidth": 1.4},
    "nominal": {"color": GREY, "linestyle": (0, (5, 1.5)), "linewidth": 1.4},
    "reduced": {"color": ORANGE, "linestyle": (0, (2.5, 1)), "linewidth": 1.6},
    "bound": {"color": RED, "linestyle": (0, (1, 1)), "linewidth": 1.6},
    "difference": {"color": PURPLE, "linestyle": "-.", "linewidth": 1.3},
}
#: other words for the same things
_WORDS = {
    "measurement": "measured",
    "drawing": "nominal", "before": "nominal", "initial": "nominal",
    "after": "model", "updated": "model", "identified": "model", "estimate": "model",
    "full": "truth", "full model": "truth", "machine": "truth", "true": "truth",
    "reduced model": "reduced", "weight": "bound", "difference": "difference",
}  # fmt: skip
#: lines that are none of these, in their order
CYCLE: Sequence[Style] = (
    {"color": BLUE, "linestyle": "-", "linewidth": 1.4},
    {"color": ORANGE, "linestyle": "-", "linewidth": 1.4},
    {"color": GREEN, "linestyle": "--", "linewidth": 1.4},
    {"color": RED, "linestyle": "-.", "linewidth": 1.4},
    {"color": PURPLE, "linestyle": (0, (4, 1, 1, 1, 1, 1)), "linewidth": 1.6},
    {"color": SKY, "linestyle": ":", "linewidth": 1.8},
)
#: where ports are, in views of a structure
PORTS: Mapping[str, Style] = {
    "sensors": {"marker": "P", "color": BLACK, "markeredgecolor": "white", "markersize": 11},
    "actuators": {"marker": "^", "color": RED, "markeredgecolor": "white", "markersize": 11},
    "POI": {"marker": "o", "color": RED, "fillstyle": "none", "markersize": 12},
}
#: a measurement beside models over frequency: points, none of which hides a line
POINTS: Style = {
    "color": BLACK, "linestyle": "none", "marker": ".", "markersize": 3.0, "zorder": 1.8,
}  # fmt: skip


def role_of(label: str) -> str | None:
    """Return which of `STYLES` a label names, or None: "drawing" is "nominal"."""
    word = label.lower()
    role = _WORDS.get(word, word)
    return role if role in STYLES else None


def styles(
    labels: Iterable[str], colors: Mapping[str, str] | None = None, *, taken: int = 0
) -> list[Style]:
    """Return the styles of lines by their labels; those that name nothing follow the cycle.

    So many lines are there already.
    """
    found, others = [], taken
    for label in labels:
        role = role_of(label)
        style = dict(STYLES[role] if role else CYCLE[others % len(CYCLE)])
        others += role is None
        if colors and label in colors:
            style["color"] = colors[label]
        found.append(style)
    return found
