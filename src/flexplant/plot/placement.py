"""Pictures of placement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Patch
from matplotlib.patches import Rectangle as Box

from ..checks import FloatArray, in_unit, instance, whole
from ..errors import ModelError
from ..placement import ParetoCurve, SensorMap
from ..placement.candidates import Zone, places_of
from ..placement.gramian import shapes_of
from ..plant import Ports, StandardPlant
from ..structure import Disc
from ._axes import BLUE, LIGHT, PORTS, RED, STYLES, axes, finish, legend, legend_below, named, plan


def sensor_map(found: SensorMap, *, ports: Ports | None = None, ax: Axes | None = None) -> Axes:
    """Draw where one more sensor helps, seen from above.

    Parameters
    ----------
    found : SensorMap
        From `flexplant.sensor_map`.
    ports : Ports, optional
        Sensors and actuators that are there already and POIs, where their places are points.
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
        When `found` is no SensorMap, or its points lie on one line.

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
    ax.figure.colorbar(contours, ax=ax, label="POI error with / without a further sensor [-]")
    ax.plot(x, y, ".", color="white", markersize=1.5)
    for i, zone in enumerate(found.excluded):
        style = {"facecolor": "white", "edgecolor": "0.3", "hatch": "///", "zorder": 2.5}
        label = "no sensor possible" if i == 0 else None
        ax.add_patch(_patch(zone, factor, label=label, **style))
    if ports is not None:
        _devices(ax, factor, ports.y, ports.u)
        _pois(ax, factor, [np.asarray(poi.at) for poi in ports.z if isinstance(poi.at, tuple)])
    ax.plot(
        *(found.best[:2] / factor), "*", color=RED, markersize=14, label="best place", clip_on=False
    )
    legend_below(ax)
    return ax


def pareto_curve(found: ParetoCurve, *, ax: Axes | None = None) -> Axes:
    """Draw what each further device buys, and the bound below which no choice can be.

    Parameters
    ----------
    found : ParetoCurve
        From `flexplant.placement.pareto_curve`.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        The root of a mean square in nm, urad and so on; other criteria as they are.

    Raises
    ------
    ModelError
        When `found` is no ParetoCurve.

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
        ax.plot(found.amounts[low], bounds[low], label="no choice is below this", **bound)
        ax.fill_between(found.amounts[low], bounds[low], values[low], color=BLUE, alpha=0.15)
    if not found.by_cost:
        ax.set_xticks(found.amounts)
    ax.set_ylim(bottom=0.0 if found.unit else None)
    legend(ax, given=given)
    return finish(ax, x="cost" if found.by_cost else "number of devices", y=label)


def placed(
    plant: StandardPlant,
    *,
    mode: int | None = None,
    zones: Sequence[Zone] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw the sensors, actuators and POIs of a plant on its structure, seen from above.

    Parameters
    ----------
    plant : StandardPlant
        Assembled from a structure, such as `placement.on(plant)`.
    mode : int, optional
        Number of a mode from 1, rigid-body modes included: its motion in z is drawn as contours,
        and its nodal line.
    zones : sequence of Rectangle or Disc
        Where nothing may be, hatched.
    ax : Axes, optional
        Where to draw.

    Raises
    ------
    ModelError
        When the plant has no structure, the mode does not exist, or there are no z-DOFs to draw.

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
    ax = axes(ax, figsize=(6.4, 5.4))
    model: Any = own.realisation.model
    dofs = model.dofs
    rows = np.flatnonzero(np.array(dofs.directions) == "z")
    if rows.size < 3:
        raise ModelError("a picture from above needs at least three DOFs in z: the model has less.")
    factor = plan(ax, dofs.xyz[rows])
    x, y = dofs.xyz[rows, :2].T / factor
    ax.plot(x, y, ".", color=LIGHT, markersize=2)
    title = ""
    if mode is not None:
        shapes = shapes_of(plant, ())
        whole(mode, "mode", maximum=shapes.omega.size)
        shape = shapes.full[rows, mode - 1]
        size = float(np.max(np.abs(shape)))
        levels = np.linspace(-1.0, 1.0, 21)
        filled = ax.tricontourf(x, y, shape / size, levels=levels, cmap="RdBu_r", alpha=0.8)
        ax.figure.colorbar(filled, ax=ax, label="motion in z, largest 1 [-]")
        if shape.min() < 0.0 < shape.max():
            ax.tricontour(x, y, shape / size, levels=[0.0], colors="black", linewidths=0.8)
        title = f"mode {mode}, {shapes.omega[mode - 1] / 2 / np.pi:.4g} Hz"
    for zone in zones:
        hatched = {"facecolor": "none", "edgecolor": "0.3", "hatch": "///", "zorder": 2.5}
        ax.add_patch(_patch(zone, factor, **hatched))
    where = places_of(plant, (*own.ports.y, *own.ports.u))
    _devices(ax, factor, own.ports.y, own.ports.u, where.points)
    _pois(ax, factor, [points.mean(axis=0) for points in where.pois])
    legend_below(ax)
    ax.set_title(title)
    return ax


def _devices(
    ax: Axes,
    factor: float,
    sensors: Sequence[Any],
    actuators: Sequence[Any],
    points: Sequence[FloatArray] = (),
) -> None:
    """Mark sensors and actuators; those whose place is no point only where points are given."""
    listed = points or [
        np.array([port.at] if isinstance(port.at, tuple) else np.zeros((0, 3)))
        for port in (*sensors, *actuators)
    ]
    kinds = ("sensors", listed[: len(sensors)]), ("actuators", listed[len(sensors) :])
    for label, parts in kinds:
        if parts and len(found := np.vstack(parts) / factor):
            over: dict[str, Any] = {"linestyle": "", "zorder": 4, "clip_on": False}
            ax.plot(found[:, 0], found[:, 1], label=label, **over, **PORTS[label])


def _pois(ax: Axes, factor: float, points: Sequence[FloatArray]) -> None:
    """Mark POIs."""
    if points:
        at = np.array(points) / factor
        ax.plot(at[:, 0], at[:, 1], linestyle="", zorder=4, label="POI", **PORTS["POI"])


def _patch(zone: Zone, factor: float, **style: Any) -> Patch:
    """Return the outline of a zone."""
    if isinstance(zone, Disc):
        x, y = zone.centre[0] / factor, zone.centre[1] / factor
        return Circle((x, y), zone.radius / factor, **style)
    x, y, right, top = (side / factor for side in (*zone.lower, *zone.upper))
    return Box((x, y), right - x, top - y, **style)
