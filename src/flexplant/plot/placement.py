"""Pictures of placement, and of a machine over the range of its positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.patches import Circle, Patch
from matplotlib.patches import Rectangle as Box

from ..arrays import FloatArray, IntArray, instance, whole
from ..errors import ModelError, in_unit
from ..placement import Disc, ParetoCurve, SensorMap
from ..placement.candidates import candidate_places
from ..placement.mode_shapes import shapes_of
from ..placement.zones import Zone
from ..plant import Ports, PositionMap, StandardPlant
from ..tolerances import NEGLIGIBLE
from ._axes import (
    BLUE,
    CYCLE,
    LIGHT,
    LISTED,
    RED,
    STYLES,
    Device,
    axes,
    differ,
    finish,
    legend_below,
    mark_devices,
    named,
    panel_axes,
    plan,
)
from .shapes import kinds_of

#: what a map of sensors shows
_RATIO = "POI error with / without a further sensor [-],\nlower is better"


def sensor_map(found: SensorMap, *, ports: Ports | None = None, ax: Axes | None = None) -> Axes:
    """Draw the benefit of one more sensor over its place, seen from above.

    Parameters
    ----------
    found : SensorMap
        Map from `flexplant.placement.sensor_map`.
    ports : Ports, optional
        Existing sensors and actuators, and POIs, if their places are points.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes with filled contours of the error with the sensor relative to the error without it (the
        square root of the ratio of scores). Excluded zones are hatched.

    Raises
    ------
    ModelError
        When `found` is not a SensorMap, or its points lie on one line.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> points = np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.3, 0.3, 0.0)])
    >>> found = fx.placement.SensorMap(points, np.array([4.0, 3.0, 2.0, 1.0]), 5.0, "PoiVariance()")
    >>> fx.plot.sensor_map(found).get_ylabel()
    'y [mm]'
    """
    instance(found, SensorMap, "found", "Pass what sensor_map returned.")
    if np.linalg.matrix_rank(found.points[:, :2] - found.points[:1, :2]) < 2:
        raise ModelError(
            f"{len(found.points)} points on one line span no map: give sensor_map points over an "
            "area, or read found.values."
        )
    ax = axes(ax, figsize=(6.4, 5.4))
    ratio = np.sqrt(found.ratio)
    factor = plan(ax, found.points)
    x, y = found.points[:, :2].T / factor
    contours = ax.tricontourf(x, y, ratio, levels=20, cmap="viridis_r")
    ax.figure.colorbar(contours, ax=ax, label=_RATIO)
    ax.plot(x, y, ".", color="white", markersize=1.5)
    for i, zone in enumerate(found.excluded):
        style = {"facecolor": "white", "edgecolor": "0.3", "hatch": "///", "zorder": 2.5}
        label = "no sensor possible" if i == 0 else None
        ax.add_patch(_patch(zone, factor, label=label, **style))
    mark_devices(ax, factor, {
        kind: [Device.of(one, np.array(one.at)) for one in listed if isinstance(one.at, tuple)]
        for kind, listed in kinds_of(ports).items()
    })  # fmt: skip
    ax.plot(
        *(found.best[:2] / factor), "*", color=RED, markersize=14, label="best place", clip_on=False
    )
    if ports is not None:
        _make_room(ax)
    legend_below(ax)
    return ax


def pareto_curve(found: ParetoCurve, *, ax: Axes | None = None) -> Axes:
    """Draw the benefit of each further device, and the lower bound of all choices.

    Parameters
    ----------
    found : ParetoCurve
        Curve from `flexplant.placement.pareto_curve`.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes with the criterion. If it is a mean square, its root is drawn, in nm, urad and so on.

    Raises
    ------
    ModelError
        When `found` is not a ParetoCurve.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> ax = fx.plot.pareto_curve(fx.placement.pareto_curve(plant, candidates, [1, 2]))
    >>> len(ax.get_lines()) > 0
    True
    """
    instance(found, ParetoCurve, "found", "Pass what pareto_curve returned.")
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.2))
    values, bounds, label = found.values, found.bounds, found.placements[0].criterion
    if found.unit:
        values, bounds = np.sqrt(values), np.sqrt(np.maximum(bounds, 0.0))
        size, unit = in_unit(float(np.max(values)), found.unit)
        values, bounds, label = values / size, bounds / size, named("rms error", unit)
    low = np.isfinite(bounds)
    ax.plot(found.amounts, values, "o-", color=BLUE, label="best found")
    if np.any(low):
        bound = STYLES["bound"]
        ax.plot(found.amounts[low], bounds[low], label="lower bound of all choices", **bound)
        ax.fill_between(found.amounts[low], bounds[low], values[low], color=BLUE, alpha=0.15)
    if not found.by_cost:
        ax.set_xticks(found.amounts)
    ax.set_ylim(bottom=0.0 if found.unit else None)
    x = "cost" if found.by_cost else "number of devices"
    return finish(ax, x=x, y=label, given=given)


def placed(
    plant: StandardPlant,
    *,
    mode: int | None = None,
    zones: Sequence[Zone] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw the sensors, actuators and POIs of a plant on its structure, seen from above.

    Each device has its name. Devices that act or measure in x or y have an arrow in this direction.
    For a solid, devices in its lower half are drawn separately, seen from below.

    Parameters
    ----------
    plant : StandardPlant
        Plant assembled from a structure, such as `placement.on(plant)`.
    mode : int, optional
        Number of a mode, counted from 1 with the rigid-body modes. Its motion in z is drawn as
        contours, with its nodal line.
    zones : sequence of Rectangle or Disc
        Excluded zones, hatched.
    ax : Axes, optional
        Axes on which the view from above is drawn, with all devices.

    Returns
    -------
    Axes
        Axes of the view from above; its `.figure.axes` lists all axes.

    Raises
    ------
    ModelError
        When the plant has no structure, the mode does not exist, or the structure has no z-DOFs.

    Examples
    --------
    >>> import flexplant as fx
    >>> size, mesh = {"size": (0.2, 0.2), "thickness": 0.01}, {"elements": (2, 2)}
    >>> steel = {"density": 7800.0, "youngs_modulus": 2.1e11, "poisson_ratio": 0.3}
    >>> modes = fx.solve_modes(fx.kirchhoff_plate(**size, **mesh, **steel), count=6)
    >>> corners = [(x, y, 0.0) for x in (0.0, 0.2) for y in (0.0, 0.2)]
    >>> ports = fx.Ports(
    ...     w=[fx.Disturbance("floor", at=(0.1, 0.1, 0.0), asd=1e-3)],
    ...     u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(corners, 1)],
    ...     z=[fx.Poi("die", at=(0.1, 0.1, 0.0))],
    ...     y=[fx.Sensor(f"y{i}", at=p, asd=1e-11) for i, p in enumerate(corners, 1)],
    ... )
    >>> fx.plot.placed(fx.assemble_plant(modes, ports), mode=4).get_title()
    'mode 4, 851.5 Hz'
    """
    own = instance(plant, StandardPlant, "plant", "Pass placement.on(plant).").assembled
    model: Any = own.realisation.model
    dofs = model.dofs
    rows = np.flatnonzero(np.array(dofs.directions) == "z")
    if rows.size < 3 or not np.ptp(dofs.xyz[rows, :2], axis=0).any():
        raise ModelError(
            "a picture from above needs at least three DOFs in z at different places: the model "
            "has fewer."
        )
    shape, title = None, ""
    if mode is not None:
        shapes = shapes_of(plant, ())
        whole(mode, "mode", maximum=shapes.omega.size)
        shape = shapes.full[:, mode - 1]
        shape = shape / float(np.max(np.abs(shape[rows])))
        title = f"mode {mode}, {shapes.omega[mode - 1] / 2 / np.pi:.4g} Hz"
    where = candidate_places(plant, (*own.ports.y, *own.ports.u))
    centres = [points.mean(axis=0)[None] for points in where.pois]
    places = iter([*where.points, *centres])
    kinds = {
        kind: [Device.of(port, at) for port in listed for at in next(places)]
        for kind, listed in kinds_of(own.ports).items()
    }
    height = dofs.xyz[rows, 2]
    middle = 0.5 * float(height.min() + height.max())
    low = height < middle - NEGLIGIBLE * float(np.ptp(dofs.xyz[rows], axis=0).max())
    below = {k: [one for one in v if _is_below(one, middle, dofs.xyz)] for k, v in kinds.items()}
    if ax is not None or not low.any() or not any(below.values()):
        ax = axes(ax, figsize=(6.4, 5.4))
        top = rows[height >= height.max() - (1e-9 if low.any() else np.inf)]
        _view(ax, dofs.xyz, top, shape, kinds, zones)
        ax.set_title(title)
        return ax
    above = {
        k: [one for one in v if not _is_below(one, middle, dofs.xyz)] for k, v in kinds.items()
    }
    upper, lower = panel_axes(None, 2, columns=1, figsize=(6.4, 9.0), sharex=False)
    for panel, end, shown in ((upper, height.max(), above), (lower, height.min(), below)):
        _view(panel, dofs.xyz, rows[height == end], shape, shown, zones, various=differ(kinds))
    lower.invert_xaxis()
    for panel, side in ((upper, "from above"), (lower, "lower half, from below")):
        panel.set_title(f"{title}, {side}" if title else side)
    return upper


def _is_below(one: Device, middle: float, xyz: FloatArray) -> bool:
    return bool(one.place[2] < middle - NEGLIGIBLE * float(np.ptp(xyz, axis=0).max()))


def _view(
    ax: Axes,
    xyz: FloatArray,
    rows: IntArray,
    shape: FloatArray | None,
    kinds: Mapping[str, Sequence[Device]],
    zones: Sequence[Zone],
    *,
    various: bool | None = None,
) -> None:
    """Draw one layer of nodes with devices, and its motion in z where a mode's shape is given."""
    factor = plan(ax, xyz)
    x, y = xyz[rows, :2].T / factor
    ax.plot(x, y, ".", color=LIGHT, markersize=2)
    if shape is not None:
        levels = np.linspace(-1.0, 1.0, 21)
        filled = ax.tricontourf(x, y, shape[rows], levels=levels, cmap="RdBu_r", alpha=0.8)
        ax.figure.colorbar(filled, ax=ax, label="motion in z, largest 1 [-]")
        if shape[rows].min() < 0.0 < shape[rows].max():
            ax.tricontour(x, y, shape[rows], levels=[0.0], colors="black", linewidths=0.8)
    for zone in zones:
        hatched = {"facecolor": "none", "edgecolor": "0.3", "hatch": "///", "zorder": 2.5}
        ax.add_patch(_patch(zone, factor, **hatched))
    mark_devices(ax, factor, kinds, various=various)
    _make_room(ax)
    legend_below(ax)


def _make_room(ax: Axes) -> None:
    """Leave room for names at an edge, also where contours end there."""
    ax.use_sticky_edges = False
    ax.margins(0.1)


def _patch(zone: Zone, factor: float, **style: Any) -> Patch:
    """Return the outline of a zone."""
    if isinstance(zone, Disc):
        x, y = zone.centre[0] / factor, zone.centre[1] / factor
        return Circle((x, y), zone.radius / factor, **style)
    x, y, right, top = (side / factor for side in (*zone.lower, *zone.upper))
    return Box((x, y), right - x, top - y, **style)


def position_map(found: PositionMap, *, kind: str = "m") -> list[Axes]:
    """Draw decoupling, modes and figures of a machine over its positions.

    Parameters
    ----------
    found : PositionMap
        Map from `StandardPlant.map`, over one or two positions.
    kind : {"m", "rad"}
        Unit of the positions.

    Returns
    -------
    list of Axes
        A panel for the decoupling error, one for the share of each mode in the loop
        (`PositionMap.visible`), and one for each figure. Over two positions, the smallest share of
        all modes is drawn. The smallest and largest values are marked.

    Raises
    ------
    ModelError
        When `found` is not a PositionMap, or has three or more positions.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.plant.PositionMap(
    ...     {"x": [0.0, 0.1]}, [[0, 0], [0.1, 0.2]], [[1.0], [0.5]], [[1.0], [0.9]], ["mode 7"], {}
    ... )
    >>> [ax.get_ylabel() for ax in fx.plot.position_map(found)]
    ['decoupling error [%]', '']
    """
    instance(found, PositionMap, "found", "Pass what plant.map returned.")
    if len(found.grid) > 2:
        raise ModelError(
            f"the map has {len(found.grid)} positions, a picture shows two at most: hold the "
            "others, for example points={'z': [0.0]}."
        )
    draw = _curve_panels if len(found.grid) == 1 else _image_panels
    return draw(found, kind)


def _curve_panels(found: PositionMap, kind: str) -> list[Axes]:
    """Draw panels above each other, over one position."""
    ((name, values),) = found.grid.items()
    factor, unit = in_unit(float(np.abs(values).max()), kind)
    x = values / factor
    decoupled = bool(np.any(np.isfinite(found.decoupling)))
    modes = min(int(np.count_nonzero(found.ever)), LISTED)
    heights = [1.6] * decoupled + [max(1.2, 0.2 * modes)] * (modes > 0)
    heights += [1.6] * len(found.figures)
    figure, drawn = plt.subplots(
        len(heights), 1, sharex=True, squeeze=False, layout="constrained",
        height_ratios=heights, figsize=(7.5, 1.2 + sum(heights)),
    )  # fmt: skip
    panels = iter(drawn[:, 0])
    if decoupled:
        ax = next(panels)
        for label, line, style in zip(
            ("sensors", "actuators"), found.decoupling.T, CYCLE, strict=False
        ):
            ax.plot(x, 100 * line, label=label, **style)
        ax.set_ylim(bottom=0.0)
        finish(ax, x="", y="decoupling error [%]").legend(loc="best", fontsize=8)
    if modes:
        ax = next(panels)
        # modes that leave the loop most, by number
        least = np.where(found.ever, found.visible.min(axis=0), np.inf)
        kept = np.sort(np.argsort(least, kind="stable")[:modes])
        shown = ax.pcolormesh(
            x, np.arange(modes), np.maximum(found.visible[:, kept].T, NEGLIGIBLE), cmap="viridis",
            norm=LogNorm(NEGLIGIBLE, 1.0), shading="nearest",
        )  # fmt: skip
        ax.set_yticks(np.arange(modes), [found.modes[i] for i in kept], fontsize=7)
        figure.colorbar(shown, ax=ax, label="share in the loop [-]")
    for (label, line), ax in zip(found.figures.items(), panels, strict=True):
        ax.plot(x, line, **CYCLE[0])
        for i in {int(np.nanargmin(line)), int(np.nanargmax(line))}:
            ax.plot(x[i], line[i], "o", color=RED)
            side = "left" if i < len(x) // 2 else "right"
            ax.annotate(
                f"{line[i]:.3g}", (x[i], line[i]), textcoords="offset points", ha=side, va="center",
                xytext=(8 if side == "left" else -8, 0),
            )  # fmt: skip
        ax.margins(y=0.2)
        finish(ax, x="", y=label)
    drawn[-1, 0].set_xlabel(f"position {name} [{unit}]")
    return list(drawn[:, 0])


def _image_panels(found: PositionMap, kind: str) -> list[Axes]:
    """Draw panels side by side, over two positions."""
    images: dict[str, FloatArray] = {}
    if np.any(np.isfinite(found.decoupling)):
        images["decoupling error [%]"] = 100 * found.decoupling.max(axis=-1)
    if np.any(found.ever):
        images["least share of a mode in the loop [-]"] = found.weakest
    images |= found.figures
    (first, across), (second, up) = found.grid.items()
    size = max(float(np.abs(across).max()), float(np.abs(up).max()))
    factor, unit = in_unit(size, kind)
    figure, drawn = plt.subplots(
        1, len(images), squeeze=False, layout="constrained", figsize=(4.6 * len(images), 4.0)
    )
    for ax, (label, values) in zip(drawn[0], images.items(), strict=True):
        shown = ax.pcolormesh(across / factor, up / factor, values.T, shading="nearest")
        figure.colorbar(shown, ax=ax, label=label)
        worst = np.nanargmax(values) if "decoupling" in label else np.nanargmin(values)
        i, j = np.unravel_index(int(worst), values.shape)
        ax.plot(across[i] / factor, up[j] / factor, "x", color=RED, markersize=10, clip_on=False)
        ax.set_title(f"worst, at the cross: {values[i, j]:.3g}", fontsize=9)
        ax.set(xlabel=f"position {first} [{unit}]", ylabel=f"position {second} [{unit}]")
    return list(drawn[0])
