"""Errors over exposures, and over a wafer: moving average and moving standard deviation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from ..checks import in_unit, instance, short, with_unit
from ..errors import LabelError, ModelError
from ..simulation import ErrorMap, Response, exposure_errors
from ..simulation.exposure import error_channels
from ._axes import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    axes,
    finish,
    legend,
    legend_below,
    named,
    plan,
    shown_in,
)
from .response import shade, time_axis


def exposures(
    run: Response,
    channel: str | None = None,
    *,
    window: float = 5e-3,
    start: float = 0.0,
    exposures: npt.ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw an error with its moving average (MA) and moving standard deviation (MSD).

    The windows in which the figures of `exposure_errors` are taken are shaded; those figures are
    in the legend. Of several runs the first is drawn, and the figures are of all.

    Parameters
    ----------
    run : Response
        From `simulate`.
    channel : str, optional
        The first error of a POI when not given.
    window : float [s]
        The time for which one point is exposed.
    start : float [s]
        Without `exposures`: all after this time is exposed.
    exposures : (k, 2) array [s], optional
        Beginning and end of each, such as `SetPoint.exposures`.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When `run` is no Response, or an exposure is not within it or shorter than the window.
    LabelError
        When the channel is unknown, or the run has no error.
    ShapeError
        When `exposures` are no pairs.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> time = np.arange(1000) * 1e-4
    >>> run = fx.Response(time, 1e-8 * np.sin(600 * time)[None], ["die:error"], {"die:error": "m"})
    >>> fx.plot.exposures(run, "die:error", window=5e-3).get_ylabel()
    'error [nm]'
    """
    instance(run, Response, "run", "Pass what simulate returned.")
    known = error_channels(run)
    if channel is None and not known:
        raise LabelError("the run has no error of a POI: name the channel, channel='y1'.")
    name = known[0] if channel is None else channel
    found = exposure_errors(run, [name], window=window, start=start, exposures=exposures)
    parts = [[max(start, run.time[0]), run.time[-1]]] if exposures is None else exposures
    given, ax = ax is not None, axes(ax, figsize=(9.5, 4.0))
    unit = run.units.get(name)
    signal, average, deviation = (
        np.atleast_2d(values)[0]
        for values in (
            run[name],
            run.moving_average(name, window=window),
            run.moving_std(name, window=window),
        )
    )
    inside = np.zeros(run.time.size, dtype=bool)
    for begin, end in np.asarray(parts, dtype=np.float64).tolist():
        inside |= (run.time >= begin) & (run.time <= end)
    factor, shown = shown_in(ax.yaxis, float(np.max(np.abs(signal[inside]))), unit)
    second, time = time_axis(ax, run)
    shade(ax, parts, run)
    largest = found[name]
    looks: tuple[dict[str, Any], ...] = (
        {"label": name, "color": GREY, "linewidth": 0.6},
        {"label": f"MA, at most {with_unit(largest.ma, unit)}", "color": BLUE, "linewidth": 1.8},
        {
            "label": f"MSD, at most {with_unit(largest.msd, unit)}",
            "color": ORANGE,
            "linewidth": 1.6,
            "linestyle": "--",
        },
    )
    for values, look in zip((signal, average, deviation), looks, strict=True):
        ax.plot(run.time / second, values / factor, **look)
    ax.axhline(0.0, color=BLACK, linewidth=0.6)
    limit = 1.25 * float(np.max(np.abs(signal[inside]))) / factor
    if limit:
        ax.set_ylim(-limit, limit)
    legend(ax, given=given)
    text = f"moving windows of {with_unit(found.window, 's')}"
    return finish(ax, x=named("time", time), y=named("error", shown), title=text)


def error_map(found: ErrorMap, *, what: str = "ma", ax: Axes | None = None) -> Axes:
    """Draw the error over a wafer, seen from above.

    Parameters
    ----------
    found : ErrorMap
        From `flexplant.simulation.exposure`; points that span an area.
    what : str
        "ma" or "msd".
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Filled contours, the worst point marked.

    Raises
    ------
    ModelError
        When `found` is no ErrorMap, has fewer than three points, or `what` is neither.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> points = np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.3, 0.3, 0.0)])
    >>> ma, msd = np.array([3e-9, 2e-9, 2e-9, 1e-9]), np.full(4, 1e-9)
    >>> found = fx.simulation.ErrorMap("z", "m", points, ma, msd, window=5e-3)
    >>> fx.plot.error_map(found).get_xlabel()
    'x [mm]'
    """
    instance(found, ErrorMap, "found", "Pass what error_map returned.")
    if what not in ("ma", "msd"):
        raise ModelError(f"what must be 'ma' or 'msd', got {short(what)}. Pass one of them.")
    if len(found.points) < 3:
        raise ModelError("a picture needs at least three points that span an area: add some.")
    ax = axes(ax, figsize=(6.0, 5.0))
    values = found.ma if what == "ma" else found.msd
    factor, unit = in_unit(float(values.max()), found.unit)
    x, y = found.points[:, :2].T / plan(ax, found.points)
    contours = ax.tricontourf(x, y, values / factor, levels=20, cmap="viridis")
    label = f"{what.upper()} of the error along {found.axis}"
    ax.figure.colorbar(contours, ax=ax, label=named(label, unit))
    ax.plot(x, y, ".", color="white", markersize=2.0)
    worst = int(values.argmax())
    ax.plot(x[worst], y[worst], "x", color=RED, markersize=10, label="worst point")
    legend_below(ax)
    return ax
