"""Pictures of errors: budgets, errors during exposures, and maps over a wafer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from ..arrays import instance, one_of
from ..errors import LabelError, ModelError, counted, in_unit, short, with_unit
from ..loop import ClosedLoop, ErrorBudget, Spectrum
from ..simulation import ErrorMap, Response, exposure_errors
from ..simulation.exposure import error_channels
from ._axes import (
    BLACK,
    BLUE,
    CYCLE,
    GREY,
    ORANGE,
    RED,
    axes,
    by_label,
    finish,
    legend_below,
    named,
    plan,
    shown_in,
    styles,
)
from .run_pictures import shade, time_axis

#: hatching of the areas, which then differ without colour too
_HATCHES = ("", "//", "", "\\\\", "", "..")
_RIGHT_OF_AXES: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}


def budget(found: ErrorBudget, *, most: int = 5, ax: Axes | None = None) -> Axes:
    """Draw the cumulative spectra of an error budget, stacked by source.

    The height of each area is the variance that a source causes below a frequency. At the last
    frequency the heights are the variances of the budget, and their sum is the square of the rms.

    Parameters
    ----------
    found : ErrorBudget
        Budget from `ClosedLoop.budget`.
    most : int
        Number of sources that are drawn separately, the largest first; the others form one area.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Raises
    ------
    ModelError
        When it is not an ErrorBudget.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> ax = fx.plot.budget(fx.close_loop(plant, observer, servo).budget("die:x"))
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    instance(found, ErrorBudget, "found", "Pass loop.budget(channel).")
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.0))
    order = [int(i) for i in np.argsort(-found.variances, kind="stable")]
    shown, rest = order[: max(most, 1)], order[max(most, 1) :]
    factor, unit = in_unit(found.rms, found.unit)
    # starts where a thousandth of the variance is reached
    low = found.cumulative.sum(axis=0) < 1e-3 * found.variances.sum()
    inside = np.isfinite(found.freq) & (found.freq > 0) & ~low
    freq, stairs = found.freq[inside], found.cumulative[:, inside] / factor**2
    layers = [(found.names[i], stairs[i], found[found.names[i]]) for i in shown]
    if rest:
        others = float(np.sqrt(found.variances[rest].sum()))
        layers.append((f"{counted(len(rest), 'other')}", stairs[rest].sum(axis=0), others))
    base = np.zeros(freq.size)
    for i, (name, rows, rms) in enumerate(layers):
        ax.fill_between(
            freq, base, base + rows, facecolor=CYCLE[i % len(CYCLE)]["color"],
            hatch=_HATCHES[i % len(_HATCHES)], alpha=0.75, edgecolor="white", linewidth=0.8,
            label=f"{name}: {with_unit(rms, found.unit)} rms",
        )  # fmt: skip
        base = base + rows
    ax.set(xscale="log", ylim=(0.0, None))
    where = {"loc": "upper left"} if given else _RIGHT_OF_AXES
    ax.legend(reverse=True, frameon=False, **where)  # the uppermost area comes first
    total = f"{found.channel}: {with_unit(found.rms, found.unit)} rms"
    squared = f"({unit})^2" if set(unit) & set(" /") else f"{unit}^2" if unit else ""
    label = named("variance below the frequency", squared)
    return finish(ax, x="frequency [Hz]", y=label, title=total)


def spectra(
    found: Any,
    channel: str | None = None,
    *,
    unit: str | None = None,
    colors: Mapping[str, str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw amplitude spectral densities, such as those of a loop and of its run.

    Parameters
    ----------
    found : ClosedLoop, Response, Spectrum, or mapping {label: one of these}
        Loops, runs or spectra of one signal.
    channel : str, optional
        Signal of loops and runs. A Spectrum, from `loop.psd(channel)`, belongs to one signal
        already.
    unit : str, optional
        SI unit of the signal; by default that of the channel.
    colors : mapping {label: color}, optional
        Colours of some lines.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes with the square roots of the one-sided densities.

    Raises
    ------
    ModelError
        When nothing has a spectrum, or no channel is named.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> fx.plot.spectra({"model": loop}, "die:error").get_ylabel()
    'amplitude spectral density [nm/√Hz]'
    """
    named_ones = by_label(found, Response)
    spectra_of = {label: _spectrum(one, channel) for label, one in named_ones.items()}
    known = [getattr(one, "units", {}).get(channel) for one in named_ones.values()]
    unit = unit or next(filter(None, known), None)
    lines = {k: (s.freq[s.freq > 0], np.sqrt(s.psd[s.freq > 0])) for k, s in spectra_of.items()}
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.2))
    largest = float(max(size.max(initial=0.0) for _, size in lines.values()))
    density = f"{unit}/\N{SQUARE ROOT}Hz" if unit else None
    factor, shown = shown_in(ax.yaxis, largest, density)
    shown = shown or "SI unit/\N{SQUARE ROOT}Hz"
    for (label, (freq, size)), look in zip(lines.items(), styles(lines, colors), strict=True):
        ax.loglog(freq, size / factor, label=label or None, **look)
    y = named("amplitude spectral density", shown)
    return finish(ax, x="frequency [Hz]", y=y, given=given)


def _spectrum(one: Any, channel: str | None) -> Spectrum:
    if isinstance(one, Spectrum):
        return one
    if not isinstance(one, ClosedLoop | Response):
        raise ModelError(
            f"a loop, a run or the spectrum of one has a density to draw, got {short(one)}. Pass "
            "{'model': loop, 'measured': run}, 'die:error'."
        )
    if channel is None:
        raise ModelError(f"which signal? {list(one.units)[:6]} are there: name a channel.")
    return one.psd(channel)


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

    The exposures are shaded, and the results of `exposure_errors` are in the legend. The picture
    begins shortly before the first exposure. The first of several runs is drawn, but the figures
    hold for all runs.

    Parameters
    ----------
    run : Response
        Run from `simulate`.
    channel : str, optional
        Channel of the error; by default the first error of a POI.
    window : float [s]
        Exposure time of one point.
    start : float [s]
        Time after which the whole run counts as exposed, if `exposures` is not given.
    exposures : (k, 2) array [s], optional
        Beginning and end of each exposure, such as `SetPointProfile.exposures`.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Raises
    ------
    ModelError
        When `run` is not a Response, or an exposure is not within it or shorter than the window.
    LabelError
        When the channel is unknown, or the run has no error.

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
    moving = (of(name, window=window) for of in (run.moving_average, run.moving_std))
    signal, average, deviation = (np.atleast_2d(values)[0] for values in (run[name], *moving))
    inside = np.zeros(run.time.size, dtype=bool)
    for begin, end in np.asarray(parts, dtype=np.float64).tolist():
        inside |= (run.time >= begin) & (run.time <= end)
    factor, shown = shown_in(ax.yaxis, float(np.max(np.abs(signal[inside]))), unit)
    second, time = time_axis(ax, run)
    shade(ax, parts, run)
    largest, lines = found[name], (signal, average, deviation)
    ma, msd = (f"at most {with_unit(one, unit)}" for one in (largest.ma, largest.msd))
    looks = (
        (name, GREY, 0.6, "-"),
        (f"MA, {ma}", BLUE, 1.8, "-"),
        (f"MSD, {msd}", ORANGE, 1.6, "--"),
    )
    for values, (label, color, width, style) in zip(lines, looks, strict=True):
        ax.plot(run.time / second, values / factor, style, label=label, color=color, lw=width)
    ax.axhline(0.0, color=BLACK, linewidth=0.6)
    limit = 1.25 * float(np.max(np.abs(signal[inside]))) / factor
    if limit:
        ax.set_ylim(-limit, limit)
    begin, end = float(np.min(parts)), float(np.max(parts))
    ax.set_xlim((begin - 0.05 * (end - begin)) / second, (end + 0.02 * (end - begin)) / second)
    text = f"moving windows of {with_unit(found.window, 's')}"
    return finish(ax, x=named("time", time), y=named("error", shown), title=text, given=given)


def error_map(found: ErrorMap, *, what: str = "ma", ax: Axes | None = None) -> Axes:
    """Draw the error over a wafer, seen from above.

    Parameters
    ----------
    found : ErrorMap
        Result of `flexplant.simulation.error_map`, whose points span an area.
    what : str
        Quantity to draw: "ma" (moving average) or "msd" (moving standard deviation).
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Filled contours, the worst point marked.

    Raises
    ------
    ModelError
        When `found` is not an ErrorMap, has fewer than three points, or `what` is neither.

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
    one_of(what, "what", ("ma", "msd"))
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
