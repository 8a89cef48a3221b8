"""Pictures over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from ..errors import ModelError, require_known
from ..simulation import Response
from ..values import instance, name_list, real_array
from ._axes import finish, legend, named, panel_axes, quantity_of, shown_in
from ._style import GREY, styles


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
    """Draw channels of a run over time, one panel for each unit; of several runs the first.

    Parameters
    ----------
    run : Response
        From `simulate`.
    channels : sequence of str, optional
        Which; the errors (or else the first channel) when not given.
    unit : str, optional
        SI unit of channels that have none in `run.units`. A prefix is chosen in each panel.
    label : str, optional
        Put before the channels' names, or in place of a single one, to compare runs in one axes.
    color : str, optional
        Of the lines; a cycle when not given.
    span : (start, end) [s], optional
        The part of the run to draw; all of it when not given. The prefix is chosen for this part.
    exposures : (k, 2) array [s], optional
        Beginning and end of each, such as `SetPoint.exposures`: they are shaded.
    ax : Axes, optional
        Where to draw channels of one unit.

    Returns
    -------
    Axes
        The panel of the first channel; `.figure.axes` are all, in the order of the channels.

    Raises
    ------
    LabelError
        When a channel is unknown.
    ModelError
        When `run` is no Response, nothing of it is within `span`, or channels of several units
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
    run = run if span is None else _part(run, span)
    chosen = None if channels is None else name_list(channels, "channels")
    names = list(chosen or [n for n in run if n.endswith(":error")] or list(run)[:1])
    panels: dict[str | None, list[str]] = {}
    require_known("channel", names, run)
    for name in names:
        panels.setdefault(run.units.get(name, unit), []).append(name)
    if ax is not None and len(panels) > 1:
        listed = "; ".join(f"{', '.join(group)} [{u or '?'}]" for u, group in panels.items())
        raise ModelError(
            f"one axes holds one unit, got {listed}. Leave ax out, which gives each unit a panel, "
            "or draw them one after the other."
        )
    drawn = panel_axes(ax, len(panels))
    for (own, group), panel in zip(panels.items(), drawn, strict=True):
        if exposures is not None:
            shade(panel, exposures, run)
        _panel(panel, run, group, own, names, label=label, color=color, given=ax is not None)
    if len(drawn) > 1:
        for panel in drawn[:-1]:
            panel.set_xlabel("")
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


def _label(label: str | None, name: str, names: Sequence[str]) -> str:
    if label is None:
        return name
    return label if len(names) == 1 else f"{label}: {name}"


def _part(run: Response, span: tuple[float, float]) -> Response:
    """Return the samples of a run within a span of time."""
    start, end = real_array(span, "span", (2,)).tolist()
    within = (run.time >= start) & (run.time <= end)
    if not within.any():
        raise ModelError(
            f"the run has no sample between {start:g} and {end:g} s: it lasts from "
            f"{run.time[0]:g} to {run.time[-1]:g} s. Choose another span."
        )
    return run.replace(time=run.time[within], data=run.data[..., within])


def _panel(
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
    """Draw channels of one unit; colours follow the place among all channels."""
    signals = [np.atleast_2d(run[name])[0] for name in group]
    size = max(float(np.max(np.abs(signal), initial=0.0)) for signal in signals)
    factor, shown = shown_in(ax.yaxis, size, unit)
    second, time = time_axis(ax, run)
    labels = [_label(label, name, names) for name in names]
    looks = dict(zip(names, styles(labels, taken=len(ax.get_lines())), strict=True))
    for name, signal in zip(group, signals, strict=True):
        look = looks[name] | {"linewidth": 0.8} | ({"color": color} if color else {})
        ax.plot(run.time / second, signal / factor, label=_label(label, name, names), **look)
    legend(ax, given=given)
    errors = all(name.endswith(":error") for name in group)
    quantity = "error" if errors else quantity_of(unit)
    finish(ax, x=named("time", time), y=named(quantity, shown))
