"""Pictures over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from ..arrays import FloatArray, instance, name_list, positive, real_array
from ..errors import ModelError, require_known
from ..loop import ClosedLoop
from ..loop.blocks import references
from ..lti.statespace import StateSpace, as_statespace
from ..lti.time_responses import decay_time
from ..lti.time_responses import step as step_response
from ..simulation import Response
from ._axes import (
    BLUE,
    GREY,
    apart,
    bottom_only,
    channel_axes,
    finish,
    labelled,
    legend,
    name_panel,
    named,
    panel_axes,
    quantity_of,
    shown_in,
    styles,
)


def response(
    run: Response,
    channels: Sequence[str] | None = None,
    *,
    unit: str | None = None,
    label: str | None = None,
    color: str | None = None,
    span: tuple[float, float] | None = None,
    exposures: npt.ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw channels of a run (the first of several) over time, one panel for each unit.

    If there are more than four channels, which would hide each other, each has a separate panel.

    Parameters
    ----------
    run : Response
        Run from `simulate`.
    channels : sequence of str, optional
        Channels; by default the errors (or else the first channel).
    unit : str, optional
        SI unit of channels that have none in `run.units`. A prefix is chosen in each panel.
    label : str, optional
        Prefix of the channel names in the legend, or name of a single channel in the legend. Use it
        to compare runs on one axes.
    color : str, optional
        Colour of the lines; by default the colours follow `CYCLE`.
    span : (start, end) [s], optional
        Part of the run to draw; all of it by default. The prefix is chosen for that span.
    exposures : (k, 2) array [s], optional
        Beginning and end of each exposure, such as `SetPointProfile.exposures`; they are shaded.
    ax : Axes, optional
        Axes for channels of one unit.

    Returns
    -------
    Axes
        Axes of the first channel; its `.figure.axes` lists all axes, in the order of the channels.

    Raises
    ------
    ModelError
        When `run` is not a Response, nothing of it is within `span`, or channels of several units
        shall go into one axes.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> time = np.arange(100) * 1e-3
    >>> run = fx.Response(time, 1e-9 * np.sin(time)[None], ["die:error"])
    >>> axs = fx.plot.response(run)
    >>> np.ravel(axs)[-1].get_xlabel()
    'time [ms]'
    """
    instance(run, Response, "run", "Pass what simulate returned.")
    run = run if span is None else _within_span(run, span)
    chosen = None if channels is None else name_list(channels, "channels")
    names = list(chosen or [n for n in run if n.endswith(":error")] or list(run)[:1])
    units: dict[str | None, list[str]] = {}
    require_known("channel", names, run)
    for name in names:
        units.setdefault(run.units.get(name, unit), []).append(name)
    if ax is not None and len(units) > 1:
        listed = "; ".join(f"{', '.join(group)} [{u or '?'}]" for u, group in units.items())
        raise ModelError(
            f"one axes holds one unit, got {listed}. Leave ax out, which gives each unit a panel, "
            "or draw them one after the other."
        )
    panels = [
        (own, part)
        for own, group in units.items()
        for part in ([[n] for n in group] if apart(ax, names) else [group])
    ]
    drawn = panel_axes(ax, len(panels))
    for (own, group), panel in zip(panels, drawn, strict=True):
        if exposures is not None:
            shade(panel, exposures, run)
        _draw_panel(panel, run, group, own, names, label=label, color=color, given=ax is not None)
        if len(panels) > len(units) and label is None:
            name_panel(panel, group[0])
            panel.get_lines()[-1].set(color=color or BLUE, linestyle="-")
    bottom_only(drawn)
    return drawn[0]


def shade(ax: Axes, exposures: npt.ArrayLike, run: Response) -> None:
    """Shade exposures (k, 2) [s] of a run."""
    second, _ = time_axis(ax, run)
    for i, (start, end) in enumerate(real_array(exposures, "exposures", (None, 2)).tolist()):
        look: dict[str, Any] = {"color": GREY, "alpha": 0.2, "linewidth": 0.0, "zorder": 0.5}
        ax.axvspan(start / second, end / second, label=None if i else "exposure", **look)


def time_axis(ax: Axes, run: Response) -> tuple[float, str]:
    """Return the factor and the unit of the time axis of a run."""
    return shown_in(ax.xaxis, float(np.max(np.abs(run.time), initial=0.0)), "s")


def _curve_label(label: str | None, name: str, names: Sequence[str]) -> str:
    if label is None:
        return name
    return label if len(names) == 1 else f"{label}: {name}"


def _within_span(run: Response, span: tuple[float, float]) -> Response:
    """Return the samples of a run within a span of time."""
    start, end = real_array(span, "span", (2,)).tolist()
    within = (run.time >= start) & (run.time <= end)
    if not within.any():
        raise ModelError(
            f"the run has no sample between {start:g} and {end:g} s: it lasts from "
            f"{run.time[0]:g} to {run.time[-1]:g} s. Choose another span."
        )
    return run.replace(time=run.time[within], data=run.data[..., within])


def _draw_panel(
    ax: Axes,
    run: Response,
    group: Sequence[str],
    unit: str | None,
    names: Sequence[str],
    *,
    label: str | None,
    color: str | None,
    given: bool,
) -> None:
    """Draw channels of one unit; colours follow the position among all channels."""
    signals = [np.atleast_2d(run[name])[0] for name in group]
    size = max(float(np.max(np.abs(signal), initial=0.0)) for signal in signals)
    factor, shown = shown_in(ax.yaxis, size, unit)
    second, time = time_axis(ax, run)
    labels = [_curve_label(label, name, names) for name in names]
    looks = dict(zip(names, styles(labels, taken=len(ax.get_lines())), strict=True))
    for name, signal in zip(group, signals, strict=True):
        look = looks[name] | {"linewidth": 0.8} | ({"color": color} if color else {})
        ax.plot(run.time / second, signal / factor, label=_curve_label(label, name, names), **look)
    errors = all(name.endswith(":error") for name in group)
    quantity = "error" if errors else quantity_of(unit)
    finish(ax, x=named("time", time), y=named(quantity, shown), given=given)


def step(
    systems: Any,
    *,
    outputs: Sequence[str] | str | None = None,
    inputs: Sequence[str] | str | None = None,
    duration: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the responses to a step of one unit at each input, a panel for each channel.

    The response is exact at the drawn instants: continuous systems are sampled with a zero-order
    hold.

    Parameters
    ----------
    systems : StateSpace, ClosedLoop, or mapping {label: one of these} or list of them
        Systems to draw, also of python-control and SciPy; several share their axes.
    outputs, inputs : str or sequence of str, optional
        Channels of the first system; all by default. For a loop with references, the default is the
        references and the motions of their POIs. The other systems must have the same names.
    duration : float [s], optional
        Duration. By default the response ends when the slowest pole has decayed to 1 % or made 20
        oscillations.
    ax : Axes, optional
        Axes for a single channel.

    Returns
    -------
    Axes
        Axes of the first channel; its `.figure.axes` lists all axes, row by row.

    Raises
    ------
    ModelError
        When one is not a system, there is nothing to draw, or more channels than can be read.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plot.step(fx.lti.low_pass_filter(10.0)).get_xlabel()
    'time [ms]'
    """
    given = labelled(systems)
    found = {label: as_statespace(g) for label, g in given.items()}
    first = next(iter(found.values()))
    moved, moves = _set_points(next(iter(given.values()))) or (first.outputs, first.inputs)
    rows = list(moved if outputs is None else name_list(outputs, "outputs"))
    columns = list(moves if inputs is None else name_list(inputs, "inputs"))
    for label, g in found.items():
        for name, known in [(r, g.outputs) for r in rows] + [(c, g.inputs) for c in columns]:
            require_known("channel", [name], known, f"the system {label}".strip())
    end = (
        max(map(decay_time, found.values())) if duration is None else positive(duration, "duration")
    )
    panels = channel_axes(ax, len(rows), len(columns), (1,), max(3.6, 2.4 * len(rows)))
    for (label, g), look in zip(found.items(), styles(found), strict=True):
        answer = step_response(g.select(rows, columns), duration=end)
        for i, output in enumerate(rows):
            for j, name in enumerate(columns):
                _draw_step(
                    panels[i, j],
                    answer.time,
                    answer.data[i, j],
                    g,
                    (output, name),
                    label or None,
                    look,
                )
    for panel in panels[:-1].ravel():
        panel.set_xlabel("")
    for panel, name in zip(panels[0], columns, strict=True):
        panel.set_title(f"step of {f'1 {first.units.get(name, str())}'.rstrip()} at {name}")
    if any(found):
        legend(panels[0, -1], given=ax is not None)
    shown: Axes = panels[0, 0]
    return shown


def _set_points(found: Any) -> tuple[list[str], list[str]] | None:
    """Return the motions that references move, and the references, of a loop."""
    if not isinstance(found, ClosedLoop) or not (refs := references(found.plant)):
        return None
    owners = {name.rpartition(":")[0] for name in refs}
    return [name for name in found.plant.z if name.rpartition(":")[0] in owners], refs


def _draw_step(
    ax: Axes,
    time: FloatArray,
    signal: FloatArray,
    g: StateSpace,
    channel: tuple[str, str],
    text: str | None,
    look: dict[str, Any],
) -> None:
    second, clock = shown_in(ax.xaxis, float(time[-1]), "s")
    size = float(np.max(np.abs(signal), initial=0.0))
    factor, unit = shown_in(ax.yaxis, size, g.units.get(channel[0]))
    form: dict[str, Any] = {"drawstyle": "steps-post"} if g.dt else {}
    ax.plot(time / second, signal / factor, label=text, **look, **form)
    finish(ax, x=named("time", clock), y=named(channel[0], unit))
