"""Bode diagrams and singular values: responses over frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from ..errors import ModelError, unknown_label
from ..values import FloatArray, name_list
from ._axes import axes, finish, legend
from .gains import Curve, curves, decibel, gain_label, readable, shared_reference

#: channels for which a grid of diagrams can still be read
_MOST = 36


def bode(
    systems: Any,
    *,
    outputs: Sequence[str] | str | None = None,
    inputs: Sequence[str] | str | None = None,
    freq: FloatArray | None = None,
    ax: Sequence[Axes] | None = None,
) -> Axes:
    """Draw magnitude [dB] and phase [deg] over frequency, a pair of panels for each channel.

    Phases of systems are continuous over frequency; those of measurements, drawn as points, follow
    the first system by whole turns, or lie between -180 and 180 degrees where there is none.

    Parameters
    ----------
    systems : StateSpace, Frf, or mapping {label: one of these} or list of them
        What to draw; several share their axes. Systems of python-control and SciPy too.
    outputs, inputs : str or sequence of str, optional
        Channels of the first one; all when not given. Others are drawn by the same names.
    freq : (n_freq,) array [Hz], optional
        Where systems are evaluated; a grid of each, refined at resonances, when not given.
    ax : pair of Axes, optional
        For magnitude and phase, where one channel is drawn.

    Returns
    -------
    Axes
        The magnitude of the first channel; `.figure.axes` are all, row by row.

    Raises
    ------
    ModelError
        When there is nothing to draw, or more channels than can be read.
    LabelError
        When a channel is unknown.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plot.bode(fx.lowpass(10.0)).get_ylabel()
    '|out / in| [dB, 0 dB = 1]'
    """
    drawn = curves(systems, freq)
    first = drawn[0].response
    rows = list(first.outputs) if outputs is None else list(name_list(outputs, "outputs"))
    columns = list(first.inputs) if inputs is None else list(name_list(inputs, "inputs"))
    panels = _panels(ax, len(rows), len(columns))
    for i, output in enumerate(rows):
        for j, name in enumerate(columns):
            pair = panels[2 * i, j], panels[2 * i + 1, j]
            continuous: tuple[FloatArray, FloatArray] | None = None
            for curve in sorted(drawn, key=lambda curve: "marker" in curve.line):
                continuous = _draw(pair, curve, output, name, continuous)
            readable(pair[0])
            _whole_turns(pair[1])
            finish(pair[0], x="", y=gain_label(output, name, first.unit(output, name)))
            last = i == len(rows) - 1
            finish(pair[1], x="frequency [Hz]" if last else "", y="phase [deg]")
    if any(curve.label for curve in drawn):
        legend(panels[0, -1], given=ax is not None or panels.size > 2)
    shown: Axes = panels[0, 0]
    return shown


def _panels(ax: Sequence[Axes] | None, rows: int, columns: int) -> Any:
    if rows * columns > _MOST:
        raise ModelError(
            f"{rows} outputs and {columns} inputs are {rows * columns} channels, more than can be "
            f"read ({_MOST}). Choose some: outputs=, inputs=."
        )
    if ax is None:
        return plt.subplots(
            2 * rows,
            columns,
            sharex=True,
            squeeze=False,
            layout="constrained",
            figsize=(max(7.0, 4.0 * columns), 5.0 * rows),
            height_ratios=[2, 1] * rows,
        )[1]
    given = np.ravel(np.asarray(ax, dtype=object))
    if given.size != 2 or rows * columns != 1:
        raise ModelError(
            f"ax= takes two axes, for the magnitude and phase of one channel; got {given.size} "
            f"axes and {rows * columns} channels. Leave ax out for a grid."
        )
    return given.reshape(2, 1)


def _draw(
    pair: tuple[Axes, Axes],
    curve: Curve,
    output: str,
    name: str,
    continuous: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, FloatArray] | None:
    """Draw a channel; return the phase of the first system, which measurements follow."""
    response = curve.response
    if (output, name) not in response:
        raise unknown_label("channel", f"{output}, {name}", [f"{a}, {b}" for a, b in response])
    values = response[output, name]
    phase = np.degrees(np.angle(values))
    if "marker" not in curve.line:
        phase = np.unwrap(phase, period=360.0)
        # the branch that begins between -360 and 0 degrees: free masses begin at -180
        phase = phase - 360.0 * np.ceil((phase[:1] - 1e-6) / 360.0)
        continuous = continuous or (response.freq, phase)
    elif continuous is not None:
        phase = phase + 360.0 * np.round((np.interp(response.freq, *continuous) - phase) / 360.0)
    pair[0].semilogx(response.freq, decibel(values), label=curve.label or None, **curve.line)
    pair[1].semilogx(response.freq, phase, **curve.line)
    return continuous


def _whole_turns(ax: Axes) -> None:
    """Mark a phase axis at quarter turns, or at whole ones where it spans many."""
    low, high = ax.get_ylim()
    step = next((s for s in (45.0, 90.0, 180.0) if high - low < 5 * s), 360.0)
    ax.yaxis.set_major_locator(MultipleLocator(step))


#: singular values smaller than this part of the largest one are rounding
_ROUNDING = 1e-12


def singular_values(
    systems: Any, *, freq: FloatArray | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the singular values of responses: the largest as a line, the area down to the smallest.

    The largest one is the gain of the worst direction of the inputs at each frequency; its peak is
    the H-infinity norm of a stable system. Channels should have one unit, or be weighted. Singular
    values that are zero at all frequencies are left out: a controller of fewer motions than
    channels has such.

    Parameters
    ----------
    systems : StateSpace, Frf, or mapping {label: one of these} or list of them
        What to draw.
    freq : (n_freq,) array [Hz], optional
        Where systems are evaluated; a grid of each, refined at resonances, when not given.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When there is nothing to draw.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.singular_values({"plant": fx.testbeds.three_masses().Gyu})
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.5))
    drawn = curves(systems, freq)
    for curve in drawn:
        values = np.linalg.svd(np.moveaxis(curve.response.data, 2, 0), compute_uv=False)
        rank = int(np.max(np.sum(values > _ROUNDING * values[:, :1], axis=1), initial=1))
        largest, smallest = (decibel(np.asarray(values[:, k])) for k in (0, rank - 1))
        ax.semilogx(curve.response.freq, largest, label=curve.label or None, **curve.line)
        if rank > 1:
            ax.semilogx(curve.response.freq, smallest, **{**curve.line, "linewidth": 0.6})
            ax.fill_between(
                curve.response.freq, smallest, largest, color=curve.line["color"], alpha=0.12
            )
    reference = shared_reference(drawn[0].response)
    readable(ax)
    if any(curve.label for curve in drawn):
        legend(ax, given=given)
    return finish(ax, x="frequency [Hz]", y=f"singular values [dB, 0 dB = {reference}]")
