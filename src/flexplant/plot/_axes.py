"""Common functions of all pictures: axes, units, legends, and responses to draw."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogFormatter, MaxNLocator

from ..arrays import ComplexArray, FloatArray
from ..errors import FlexplantError, ModelError, in_unit, short
from ..lti.frequency import Frf, frequency_response
from ..lti.statespace import as_statespace
from ..plant.port import place_directions
from ..tolerances import TINY
from .coinciding_curves import widen_hidden

#: number of points along a line that a legend must not cover
_DENSE = 500
#: powers of ten for which SI prefixes are used
_POWERS = range(-36, 19)
#: quantity that is measured in a unit
_QUANTITY = {
    "m": "displacement",
    "rad": "rotation",
    "N": "force",
    "N m": "moment",
    "m/s": "velocity",
    "rad/s": "angular velocity",
    "m/s^2": "acceleration",
    "rad/s^2": "angular acceleration",
    "V": "voltage",
    "A": "current",
}


def axes(ax: Axes | None, **figure: Any) -> Axes:
    """Return the given axes, or those of a new figure."""
    if ax is not None:
        return ax
    drawn: Axes = plt.subplots(layout="constrained", **figure)[1]
    return drawn


#: largest number of lines that may overlap on one axes, and largest number of lines in a legend
TOGETHER, _LEGEND = 4, 6


def panel_axes(
    ax: Axes | None, count: int, *, columns: int | None = None, **options: Any
) -> list[Axes]:
    """Return the given axes, or `count` new ones with the same abscissa."""
    # few panels are one above the other; more are small multiples in two columns
    if ax is not None:
        return [ax] * count
    wide = columns or (1 if count <= TOGETHER else 2)
    rows = -(-count // wide)
    height = 4.0 if count == 1 else 1.2 + (2.2 if wide == 1 else 1.7) * rows
    options = dict[str, Any](sharex=True, figsize=(8.0, height)) | options
    grid = plt.subplots(rows, wide, squeeze=False, layout="constrained", **options)[1]
    drawn: list[Axes] = list(grid.ravel())
    for spare in drawn[count:]:
        spare.remove()
    for panel in drawn[:count][-wide:]:
        panel.tick_params(labelbottom=True)
    return drawn[:count]


def three_axes(
    ax: Sequence[Axes] | None, rows: int, columns: int, **options: Any
) -> Sequence[Axes]:
    """Return the three axes given, or those of a new figure."""
    if ax is None:
        return list(plt.subplots(rows, columns, layout="constrained", **options)[1].ravel())
    if np.size(np.asarray(ax, dtype=object)) != 3:
        raise ModelError("ax= needs three axes. Leave it out for a new figure.")
    return ax


def name_panel(ax: Axes, name: str) -> None:
    """Name the only line of a panel above it, in place of a legend."""
    if shown := ax.get_legend():
        shown.remove()
    ax.set_title(name, loc="left", fontsize="medium", pad=3.0)


def bottom_only(panels: Sequence[Axes]) -> None:
    """Leave the label of the abscissa to the lowest panel of each column."""
    lowest = {round(ax.get_position().x0, 3): ax for ax in panels}
    for ax in panels:
        if ax not in lowest.values():
            ax.set_xlabel("")


def quantity_of(unit: str | None) -> str:
    """Return the quantity of a unit; "signal" if not known."""
    return _QUANTITY.get(unit or "", "signal")


def shown_in(axis: Axis, size: float, unit: str | None) -> tuple[float, str]:
    """Return the factor and the unit in which an axis shows values up to a size."""
    # an axis with a unit in its label keeps it, so that later lines use the same scale
    label = re.search(r"\[(.+)\]$", axis.get_label_text())
    if label is None:
        return in_unit(size, unit)
    for prefixed in (in_unit(10.0**k, unit) for k in _POWERS):
        if prefixed[1] == label[1]:
            return prefixed
    raise ModelError(
        f"one axes holds one unit: it shows {axis.get_label_text()!r}, and this is in "
        f"{unit or 'no known unit'}. Draw it on separate axes."
    )


def named(quantity: str, unit: str) -> str:
    """Return the label of an axis: a quantity with its unit where there is one."""
    return f"{quantity} [{unit}]" if unit else quantity


def plan(ax: Axes, points: FloatArray) -> float:
    """Make axes a view from above on points (n, 2 or 3) [m]; return the factor of places on it."""
    factor, unit = shown_in(ax.xaxis, float(np.max(np.abs(points[:, :2]), initial=0.0)), "m")
    ax.set_aspect("equal")
    finish(ax, x=f"x [{unit}]", y=f"y [{unit}]")
    return factor


def solid_axes(xyz: FloatArray, ax: Any, *, beyond: float = 0.0) -> Any:
    """Return axes in three dimensions of one scale, that reach beyond nodes (n, 3) [m]."""
    if ax is None:
        ax = plt.figure(figsize=(7.0, 4.4), layout="constrained").add_subplot(projection="3d")
    elif not hasattr(ax, "get_zlim"):
        raise ModelError("ax must be in three dimensions: plt.subplot(projection='3d').")
    extent = float(np.max(np.ptp(xyz, axis=0)))
    factor, unit = in_unit(extent, "m")
    for k, name in enumerate("xyz"):
        low, high = xyz[:, k].min(), xyz[:, k].max()
        getattr(ax, f"set_{name}lim")((low - beyond) / factor, (high + beyond) / factor)
        getattr(ax, f"set_{name}label")(f"{name} [{unit}]", labelpad=8.0)
        share = (high - low + 2 * beyond) / (extent + 2 * beyond)
        getattr(ax, f"{name}axis").set_major_locator(MaxNLocator(max(2, round(6 * share))))
    ax.set_aspect("equal")
    return ax


def legend_below(ax: Axes) -> None:
    """Draw the legend under a view from above."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncols=3, frameon=False
        )


def legend(ax: Axes, *, given: bool) -> None:
    """Draw the legend where it covers nothing: next to new axes, in a given one's emptiest corner.

    The space next to the axes stays empty for any limits. Where no corner is empty, the ordinate of
    given axes is extended. If there are too many lines for a legend, they are labelled at their
    ends.
    """
    handles = ax.get_legend_handles_labels()[0]
    if not handles:
        return
    if len(handles) > _LEGEND and all(isinstance(one, Line2D) for one in handles):
        _name_ends(ax)
        return
    if not given:
        ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return
    shown = ax.legend(frameon=False)
    box = shown.get_window_extent().transformed(ax.transAxes.inverted())
    width, height = box.width + 0.02, box.height + 0.03
    points = _drawn_points(ax)
    across = {"right": points[:, 0] > 1 - width, "left": points[:, 0] < width}
    along = {"upper": points[:, 1] > 1 - height, "lower": points[:, 1] < height}
    corners = {
        f"{v} {h}": int((up & at).sum()) for h, at in across.items() for v, up in along.items()
    }
    emptiest: Any = min(corners, key=lambda corner: corners[corner])
    if corners[emptiest]:
        emptiest = min(("upper right", "upper left"), key=lambda corner: corners[corner])
        side = points[across[emptiest.split()[1]], 1]
        _raise_top(ax, float(side[side <= 1.0].max(initial=0.0)) / (1.0 - min(height, 0.7)))
    ax.legend(frameon=False, loc=emptiest)


def _name_ends(ax: Axes) -> None:
    """Label each line at its right end, in the order of the ends and without overlap."""
    to_axes = ax.transAxes.inverted()
    found, labels = ax.get_legend_handles_labels()
    handles = [one for one in found if isinstance(one, Line2D)]
    right = ax.get_xlim()[1]
    ends = []
    for line in handles:
        points = np.asarray(line.get_xydata(), dtype=np.float64)
        seen = points[np.isfinite(points).all(axis=1) & (points[:, 0] <= right * (1 + 1e-9))]
        ends.append(seen[-1] if len(seen) else (right, np.nan))
    height = np.array([to_axes.transform(ax.transData.transform(end))[1] for end in ends])
    order = np.argsort(np.nan_to_num(height, nan=0.0), kind="stable")
    step = 1.25 * 10.0 / max(ax.get_window_extent().height * 72.0 / ax.figure.dpi, 1.0)
    place = np.clip(np.nan_to_num(height[order]), 0.0, 1.0)
    for _ in range(4 * len(place)):  # neighbours that are too close move apart by equal amounts
        near = np.maximum(step - np.diff(place), 0.0)
        place[1:] += 0.5 * near
        place[:-1] -= 0.5 * near
    for y, k in zip(place.tolist(), order.tolist(), strict=True):
        color = handles[k].get_color()
        leader = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "relpos": (0.0, 0.5)}
        ax.annotate(
            labels[k], ends[k], (1.04, y), "data", ax.transAxes, va="center", color=color,
            fontsize="small", annotation_clip=False, arrowprops=leader,
        )  # fmt: skip


def _raise_top(ax: Axes, top: float) -> None:
    """Extend the axes upwards: the present `top`, in units of the axes, becomes the upper end."""
    scale = ax.yaxis.get_transform()
    low, high = scale.transform(np.array(ax.get_ylim()))
    further = scale.inverted().transform(np.array([low + max(top, 1.0) * (high - low)]))
    ax.set_ylim(top=float(further[0]), auto=True)  # for what is drawn later


def _drawn_points(ax: Axes) -> FloatArray:
    """Return points (k, 2) along all lines and at the edges of areas, in units of the axes."""
    _ = ax.get_xlim(), ax.get_ylim()  # updates the limits, which transforms do not
    to_axes = ax.transData + ax.transAxes.inverted()
    parts = [_resample_line(np.asarray(line.get_xydata(), dtype=float)) for line in ax.get_lines()]
    for area in ax.collections:
        if isinstance(area, PolyCollection):
            parts += [_resample_line(np.asarray(path.vertices)) for path in area.get_paths()]
    return np.vstack([np.zeros((0, 2)), *(to_axes.transform(part) for part in parts)])


def _resample_line(points: FloatArray) -> FloatArray:
    """Return points (k, 2) along a line, also between those far apart."""
    if len(points) > _DENSE or len(points) < 2:
        return points
    at = np.linspace(0, len(points) - 1, _DENSE)
    return np.column_stack([np.interp(at, np.arange(len(points)), values) for values in points.T])


class _Decades(LogFormatter):
    """Plain numbers on a logarithmic axis, 20 30 50 100, since powers overlap."""

    def __call__(self, x: float, pos: Any = None) -> str:
        """Return the label of a tick, or nothing where there are too many."""
        return f"{x:g}" if super().__call__(x, pos) else ""


def finish(ax: Axes, *, x: str, y: str, title: str = "", given: bool | None = None) -> Axes:
    """Label the axes, with units, and draw a light grid; `given` or new ones get a legend too."""
    widen_hidden(ax)
    if given is not None:
        legend(ax, given=given)
    ax.set(xlabel=x, ylabel=y)
    if title:
        ax.set_title(title)
    ax.grid(True, which="both", alpha=0.25)
    if ax.get_xscale() == "log":
        ax.xaxis.set_major_formatter(_Decades())
        ax.xaxis.set_minor_formatter(_Decades(minor_thresholds=(1.5, 0.4)))
    return ax


#: colours that remain different for colour-blind readers [OkabeIto2008]_
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9",
)  # fmt: skip
BLACK, GREY, LIGHT = "black", "0.55", "0.8"

Style = dict[str, Any]

#: styles of the roles in every picture; a line below others is wide, others have the usual width
STYLES: Mapping[str, Style] = {
    "measured": {"color": BLACK, "linestyle": "-", "linewidth": 0.9, "zorder": 1.8},
    "truth": {"color": GREEN, "linestyle": "-", "linewidth": 4.0, "alpha": 0.35, "zorder": 1.5},
    "model": {"color": BLUE, "linestyle": "-"},
    "nominal": {"color": GREY, "linestyle": "--"},
    "reduced": {"color": ORANGE, "linestyle": "-."},
    "bound": {"color": RED, "linestyle": ":"},
    "difference": {"color": PURPLE, "linestyle": "-.", "linewidth": 0.9},
}
#: other labels for the same roles
_WORDS = {
    "measurement": "measured",
    "drawing": "nominal", "before": "nominal", "initial": "nominal",
    "after": "model", "updated": "model", "identified": "model", "estimate": "model",
    "full": "truth", "full model": "truth", "machine": "truth", "true": "truth",
    "reduced model": "reduced", "weight": "bound", "difference": "difference",
}  # fmt: skip
#: styles of all other lines, in their order
CYCLE: Sequence[Style] = (
    {"color": BLUE, "linestyle": "-"}, {"color": ORANGE, "linestyle": "-"},
    {"color": GREEN, "linestyle": "--"}, {"color": RED, "linestyle": "-."},
    {"color": PURPLE, "linestyle": ":"}, {"color": SKY, "linestyle": ":", "linewidth": 2.5},
)  # fmt: skip
#: markers of ports in views of a structure
PORTS: Mapping[str, Style] = {
    "sensors": {"marker": "P", "color": BLACK, "markeredgecolor": "white", "markersize": 11},
    "actuators": {"marker": "^", "color": RED, "markeredgecolor": "white", "markersize": 11},
    "POI": {"marker": "o", "color": RED, "fillstyle": "none", "markersize": 11},
}
#: length of an arrow of a direction, relative to the size of a view from above
_ARROW = 0.07


def port_directions(port: Any) -> tuple[str, ...]:
    """Return the directions along which a port acts or measures; the axes of a POI."""
    at: Any = getattr(port, "at", None)
    axes = getattr(port, "axes", None)
    if axes is not None and not isinstance(at, Mapping):
        return tuple(axes)
    own = getattr(port, "direction", None) or "".join(axes or ())
    return () if not own and at is None else place_directions(at, own)


class Device(NamedTuple):
    """A port in a view of a structure: its name, x to rz or "" of its direction, its place [m]."""

    name: str
    direction: str
    place: FloatArray

    @classmethod
    def of(cls, port: Any, place: FloatArray) -> Device:
        """Return the device of a port at a place; without a direction of a POI or of several."""
        along = () if hasattr(port, "axes") else port_directions(port)
        return cls(port.name, along[0] if len(along) == 1 else "", place)

    @property
    def along(self) -> FloatArray | None:
        """The unit vector of the direction; None of rotations and POIs."""
        known = self.direction and self.direction in "xyz"
        return np.eye(3)["xyz".index(self.direction)] if known else None


def differ(kinds: Mapping[str, Sequence[Device]]) -> bool:
    """Return whether devices have different directions."""
    return len({one.direction for listed in kinds.values() for one in listed} - {""}) > 1


def mark_devices(
    ax: Axes, factor: float, kinds: Mapping[str, Sequence[Device]], *, various: bool | None = None
) -> None:
    """Mark and name devices by kind in a view from above, in x and y with arrows."""
    # directions without an arrow are written next to the names if they differ
    various = differ(kinds) if various is None else various
    extent = np.ptp(ax.dataLim.get_points(), axis=0).max() or 1.0
    names: dict[tuple[float, ...], list[str]] = {}
    arrows_up: set[tuple[float, ...]] = set()
    for kind, listed in kinds.items():
        if not listed:
            continue
        at = np.array([one.place for one in listed]) / factor
        over: dict[str, Any] = {"linestyle": "", "zorder": 4, "clip_on": False}
        ax.plot(at[:, 0], at[:, 1], label=kind, **over, **PORTS[kind])
        for one, point in zip(listed, at, strict=True):
            arrow = one.direction in ("x", "y")
            text = one.name if arrow or not various or not one.direction else (
                f"{one.name} ({one.direction})")  # fmt: skip
            spot = tuple(np.round(point[:2] / extent, 2))
            names.setdefault(spot, []).append(text)
            if various and one.direction == "y":
                arrows_up.add(spot)
            if various and arrow:
                turned = np.array(one.along)[:2] * _ARROW * extent
                look = {"arrowstyle": "-|>", "color": PORTS[kind]["color"]}
                ax.annotate(
                    "", tuple(point[:2] + turned), tuple(point[:2]), arrowprops=look, zorder=3.9
                )
    for spot, texts in names.items():
        place: Any = {"xytext": (0, 9), "ha": "center", "va": "bottom"}
        if spot in arrows_up:  # above is the arrow
            place = {"xytext": (9, 0), "ha": "left", "va": "center"}
        shown = ax.annotate(
            ", ".join(texts), (spot[0] * extent, spot[1] * extent), textcoords="offset points",
            fontsize="small", zorder=5, annotation_clip=False, **place,
        )  # fmt: skip
        shown.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


#: style of a measurement drawn with models over frequency: points behind the lines
POINTS: Style = {
    "color": BLACK, "linestyle": "none", "marker": ".", "markersize": 3.0, "zorder": 1.8,
}  # fmt: skip


def role_of(label: str) -> str | None:
    """Return the style of `STYLES` that a label names, or None: "drawing" is "nominal"."""
    word = label.lower()
    role = _WORDS.get(word, word)
    return role if role in STYLES else None


def apart(ax: Axes | None, labels: Iterable[str]) -> bool:
    """Return whether lines need separate panels: many lines without a role of `STYLES`."""
    return ax is None and sum(role_of(label) is None for label in labels) > TOGETHER


def styles(
    labels: Iterable[str], colors: Mapping[str, str] | None = None, *, taken: int = 0
) -> list[Style]:
    """Return the styles of lines by their labels; those without a role follow the cycle."""
    # this number of lines exists already. Lines beyond the cycle are solid, in other colours; the
    # colours of roles are not used for other lines, if the cycle has enough others
    found, others = [], taken
    labels = list(labels)
    used = {STYLES[role]["color"] for role in map(role_of, labels) if role}
    free = [style for style in CYCLE if style["color"] not in used]
    plain = sum(role_of(label) is None for label in labels)
    shades = plt.get_cmap("turbo")(np.linspace(0.05, 0.95, plain)) if plain > len(CYCLE) else None
    cycle = free if taken + plain <= len(free) else CYCLE
    for label in labels:
        role = role_of(label)
        style = dict(STYLES[role] if role else cycle[others % len(cycle)])
        if role is None and shades is not None:
            shade = to_hex(shades[others - taken])
            style = {"color": shade, "linestyle": "-"}
        others += role is None
        if colors and label in colors:
            style["color"] = colors[label]
        found.append(style)
    return found


#: largest drawn range of a magnitude [dB]; zeros at half the rate would extend it
_DEPTH = 160.0
#: fraction of the decades in which a line may lie below the axis, and margin [dB] below the rest
_SHARE, _MORE = 0.03, 15.0


class Curve(NamedTuple):
    """A response with its label and the style of its line; measured ones are black points."""

    label: str
    response: Frf
    line: Style


def labelled(found: Any) -> dict[str, Any]:
    """Return what to draw by label: of a mapping, a list of systems (numbered from 1), or one."""
    numbers = (int, float, list, tuple)  # types of a static gain
    if isinstance(found, list | tuple) and not any(isinstance(one, numbers) for one in found):
        found = {f"system {k}": one for k, one in enumerate(found, 1)}
    return by_label(found)


def by_label(found: Any, one: type = Frf) -> dict[str, Any]:
    """Return the entries of a mapping, or {"": found} of anything else and of kind `one`."""
    several = isinstance(found, Mapping) and not isinstance(found, one)
    named = {str(label): part for label, part in found.items()} if several else {"": found}
    if not named:
        raise ModelError("the mapping or list is empty: give at least one value to draw.")
    return named


def curves(
    found: Any, freq: FloatArray | None = None, colors: Mapping[str, str] | None = None
) -> list[Curve]:
    """Return what to draw of a system, an Frf, or a mapping {label: one of these} or list."""
    # systems are evaluated at `freq`; when it is not given, on their own grids
    named = labelled(found)
    measured = [label for label, one in named.items() if _is_measured(label, one)]
    modelled = iter(styles([label for label in named if label not in measured], colors))
    drawn = []
    for label, one in named.items():
        line = dict(POINTS) if label in measured else next(modelled)
        if colors and label in colors:
            line["color"] = colors[label]
        drawn.append(Curve(label, _response_to_draw(one, freq), line))
    return drawn


def _is_measured(label: str, one: Any) -> bool:
    if role_of(label) == "measured":
        return True
    return isinstance(one, Frf) and (one.variance is not None or one.coherence is not None)


def _response_to_draw(one: Any, freq: FloatArray | None) -> Frf:
    if isinstance(one, Frf):
        return one
    if isinstance(one, int | float):
        raise ModelError(f"need systems or Frfs to draw, got {short(one)}. Pass StateSpaces.")
    try:
        return frequency_response(as_statespace(one), freq)
    except FlexplantError as error:
        if freq is not None:
            raise
        raise ModelError(
            f"need a system, an Frf or a mapping of labels to such, got {short(one)}: {error}"
        ) from error


#: largest number of rows, bars or modes that a picture shows one by one
LISTED = 16
#: largest number of channels in a readable grid of panels
_MOST = 36
#: largest number of channels that a page or a notebook draws without being asked
CHANNELS = 9


def channel_axes(ax: Any, rows: int, columns: int, ratios: Sequence[int], height: float) -> Any:
    """Return the axes of channels, one below the other, one for each height."""
    # given axes for one channel, or new ones
    channels, each = rows * columns, len(ratios)
    if not channels:
        raise ModelError(
            f"{rows} outputs and {columns} inputs give no channel to draw. Choose some with "
            "outputs=, inputs=, or leave both out for all."
        )
    given = np.ravel(np.asarray(ax, dtype=object))
    if ax is not None and (given.size != each or channels != 1):
        raise ModelError(
            f"ax= takes {each} axes, for one channel; got {given.size} axes and {channels} "
            "channels. Leave ax out for a grid, or choose one: outputs=, inputs=."
        )
    if channels > _MOST:
        raise ModelError(
            f"{rows} outputs and {columns} inputs are {channels} channels, more than can be read "
            f"({_MOST}). Choose some: outputs=, inputs=."
        )
    if ax is not None:
        return given.reshape(each, 1)
    return plt.subplots(
        each * rows, columns, sharex=True, squeeze=False, layout="constrained",
        figsize=(max(7.0, 4.0 * columns), height), height_ratios=[*ratios] * rows,
    )[1]  # fmt: skip


def decibel(values: ComplexArray | FloatArray) -> FloatArray:
    """Return 20 log10 of magnitudes; zero gives a value far below all others."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(values), TINY)))


def singular(response: Frf) -> FloatArray:
    """Return the singular values (n_freq, k) of a response, the largest first."""
    return np.asarray(np.linalg.svd(np.moveaxis(response.data, 2, 0), compute_uv=False))


def readable(ax: Axes) -> None:
    """Limit a decibel axis to readable magnitudes: zeros at half the rate would extend it.

    Over a small share of the decades, lines may lie below the axis.
    """
    left, right = ax.get_xlim()
    lines = [np.asarray(line.get_xydata(), dtype=float) for line in ax.get_lines()]
    whole = [line[line[:, 0] > 0] for line in lines if len(line) > 2]
    over = [line[(line[:, 0] >= left) & (line[:, 0] <= right)] for line in whole]
    over = [line for line in over if len(line) > 1]
    if not over:
        return
    top = max(float(line[:, 1].max()) for line in over)
    deep = min(_depth(line) for line in over)
    lowest = min(float(line[:, 1].min()) for line in over)
    floor = max(deep - _MORE, top - _DEPTH)
    if lowest < floor or sum(map(len, over)) < sum(map(len, whole)):
        bottom = max(lowest, floor)
        room = 0.05 * (top - bottom)
        ax.set_ylim(bottom - room, top + room, auto=True)  # for what is drawn later


def _depth(line: FloatArray) -> float:
    """Return the level below which a line lies in the fraction `_SHARE` of its decades."""
    decades = np.log10(line[:, 0])
    levels = np.interp(np.linspace(decades[0], decades[-1], 400), decades, line[:, 1])
    return float(np.quantile(levels, _SHARE))


def gain_label(output: str, input: str, unit: str | None) -> str:
    """Return the label of a decibel axis, with the unit of 0 dB."""
    return f"|{output} / {input}| [dB, 0 dB = {reference_of(unit)}]"


def shared_unit(response: Frf) -> str | None:
    """Return the unit of a gain that all channels share; None when they do not."""
    units = {response.unit(*channel) for channel in response}
    return units.pop() if len(units) == 1 else None


def shared_reference(response: Frf) -> str:
    """Return the unit of 0 dB for all gains together: 1 in SI units if units differ."""
    alike = len({response.unit(*channel) for channel in response}) == 1
    return reference_of(shared_unit(response)) if alike else "1 in SI units"


def reference_of(unit: str | None) -> str:
    """Return the text for 0 dB: a gain of one, with its unit."""
    return "1" if unit in (None, "1") else f"1 {unit}"
