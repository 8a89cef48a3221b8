"""Pictures over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ..errors import ModelError, unknown_label
from ..simulation import Response
from ..values import name_list, short
from ._axes import CYCLE, axes, finish

SCALES = ((1e-9, "n"), (1e-6, "u"), (1e-3, "m"), (1.0, ""))


def response(
    run: Response,
    channels: Sequence[str] | None = None,
    *,
    unit: str = "m",
    label: str | None = None,
    color: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw channels of a run over time; of several runs the first.

    Parameters
    ----------
    run : Response
        From `simulate`.
    channels : sequence of str, optional
        Which; the errors (or else the first channel) when not given.
    unit : str
        SI unit of the channels; a prefix is chosen.
    label : str, optional
        Put before the channels' names, to compare runs in one axes.
    color : str, optional
        Of the lines; a cycle when not given.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    LabelError
        When a channel is unknown.
    ModelError
        When `run` is no Response.
    """
    if not isinstance(run, Response):
        raise ModelError(f"need a Response, got {short(run)}. Pass what simulate returned.")
    chosen = None if channels is None else name_list(channels, "channels")
    ax = axes(ax, figsize=(8.0, 4.0))
    names = list(chosen or [n for n in run if n.endswith(":error")] or list(run)[:1])
    signals = []
    for name in names:
        if name not in run:
            raise unknown_label("channel", name, list(run))
        signals.append(np.atleast_2d(run[name])[0])
    size = max(float(np.max(np.abs(signal))) for signal in signals)
    factor, prefix = next((s for s in SCALES if size < 1e3 * s[0]), SCALES[-1])
    for i, (name, signal) in enumerate(zip(names, signals, strict=True)):
        ax.plot(
            run.time,
            signal / factor,
            color=color or CYCLE[i % len(CYCLE)],
            label=name if label is None else f"{label}: {name}",
            linewidth=0.8,
        )
    ax.legend(frameon=False, loc="upper right")
    return finish(ax, x="time [s]", y=f"[{prefix}{unit}]")
