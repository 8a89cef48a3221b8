"""Bode diagrams and singular values: responses over frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from ..arrays import ComplexArray, FloatArray, name_list, real_array
from ..errors import ModelError, require_known, short, unknown_label
from ..lti.frequency import Frf
from ..tolerances import ROUNDING
from ._axes import (
    GREY,
    STYLES,
    Curve,
    axes,
    channel_axes,
    curves,
    decibel,
    finish,
    gain_label,
    legend,
    panel_axes,
    readable,
    role_of,
    shared_reference,
    singular,
)


def bode(
    systems: Any,
    *,
    outputs: Sequence[str] | str | None = None,
    inputs: Sequence[str] | str | None = None,
    freq: FloatArray | None = None,
    wrap: bool = False,
    ax: Sequence[Axes] | None = None,
) -> Axes:
    """Draw magnitude [dB] and phase [deg] over frequency, a pair of panels for each channel.

    Phases of systems are continuous over frequency. Measurements are drawn as points, and their
    phases are shifted by whole turns to be near those of the first system. Without a system they
    lie between -180 and 180 degrees. With ``wrap=True`` all phases lie between -180 and 180
    degrees, as a dynamic analyser draws them.

    Parameters
    ----------
    systems : StateSpace, Frf, or mapping {label: one of these} or list of them
        Systems to draw, also of python-control and SciPy; several share their axes.
    outputs, inputs : str or sequence of str, optional
        Channels of the first system; all by default. The other systems must have channels with the
        same names.
    freq : (n_freq,) array [Hz], optional
        Frequencies at which systems are evaluated; by default a grid of each, refined at
        resonances.
    wrap : bool
        Whether phases are drawn between -180 and 180 degrees.
    ax : pair of Axes, optional
        Axes of magnitude and phase, for a single channel.

    Returns
    -------
    Axes
        Axes of the magnitude of the first channel; its `.figure.axes` lists all axes, row by row.

    Raises
    ------
    ModelError
        When nothing is given to draw, or there are too many channels.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plot.bode(fx.lti.low_pass_filter(10.0)).get_ylabel()
    '|out / in| [dB, 0 dB = 1]'
    """
    drawn = curves(systems, freq)
    first = drawn[0].response
    rows = list(first.outputs) if outputs is None else list(name_list(outputs, "outputs"))
    columns = list(first.inputs) if inputs is None else list(name_list(inputs, "inputs"))
    panels = channel_axes(ax, len(rows), len(columns), (2, 1), 5.0 * len(rows))
    for i, output in enumerate(rows):
        for j, name in enumerate(columns):
            pair = panels[2 * i, j], panels[2 * i + 1, j]
            continuous: tuple[FloatArray, FloatArray] | None = None
            for curve in sorted(drawn, key=lambda curve: "marker" in curve.line):
                continuous = _draw_channel(pair, curve, output, name, continuous, wrap)
            readable(pair[0])
            _whole_turns(pair[1])
            finish(pair[0], x="", y=gain_label(output, name, first.unit(output, name)))
            last = i == len(rows) - 1
            finish(pair[1], x="frequency [Hz]" if last else "", y="phase [deg]")
    if any(curve.label for curve in drawn):
        legend(panels[0, -1], given=ax is not None or panels.size > 2)
    shown: Axes = panels[0, 0]
    return shown


def _draw_channel(
    pair: tuple[Axes, Axes],
    curve: Curve,
    output: str,
    name: str,
    continuous: tuple[FloatArray, FloatArray] | None,
    wrap: bool,
) -> tuple[FloatArray, FloatArray] | None:
    """Draw a channel; return the phase of the first system, which measurements follow."""
    response = curve.response
    if (output, name) not in response:
        raise unknown_label("channel", f"{output}, {name}", [f"{a}, {b}" for a, b in response])
    values = response[output, name]
    phase = np.degrees(np.angle(values))
    if wrap:
        phase = _half_turns(values, dots="marker" in curve.line)
    elif "marker" not in curve.line:
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


def singular_values(
    systems: Any, *, freq: FloatArray | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the largest singular value of responses as a line, and the area down to the smallest.

    The largest one is the gain of the worst direction of the inputs at each frequency; its peak is
    the H-infinity norm of a stable system. Channels should have one unit, or be weighted. Singular
    values that are zero at all frequencies are left out. They occur, for example, for a controller
    that has more channels than it controls motions.

    Parameters
    ----------
    systems, freq : as for `bode`
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

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
        values = singular(curve.response)
        rank = int(np.max(np.sum(values > ROUNDING * values[:, :1], axis=1), initial=1))
        largest, smallest = (decibel(np.asarray(values[:, k])) for k in (0, rank - 1))
        ax.semilogx(curve.response.freq, largest, label=curve.label or None, **curve.line)
        if rank > 1:
            ax.semilogx(curve.response.freq, smallest, **{**curve.line, "linewidth": 0.6})
            ax.fill_between(
                curve.response.freq, smallest, largest, color=curve.line["color"], alpha=0.12
            )
    readable(ax)
    y = f"singular values [dB, 0 dB = {shared_reference(drawn[0].response)}]"
    return finish(ax, x="frequency [Hz]", y=y, given=given)


def frf(
    responses: Mapping[str, Any],
    output: str,
    input: str,
    *,
    colors: Mapping[str, str] | None = None,
    unit: str | None = None,
    reference: str | None = None,
    band: tuple[float, float] | None = None,
    freq: FloatArray | None = None,
    also: Sequence[str] | str = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw the magnitude of one channel of several responses ([paper]_, Figs. 4, 10 and 11).

    Measurements are black points under the lines. If the label of the first response has no fixed
    style (the labels with a fixed style are listed in `flexplant.plot`), its line is thick, so that
    other lines do not hide it.

    Parameters
    ----------
    responses : mapping {label: Frf or system}
        Responses to compare.
    output, input : str
        Names of the output and the input that are drawn.
    colors : mapping {label: color}, optional
        Colours of some lines.
    unit : str, optional
        Unit of the gain (of 0 dB), if the responses have none.
    reference : str, optional
        Label of one response. The differences of the other responses from this one are drawn too,
        if they are given at the same frequencies.
    band : (low, high) [Hz], optional
        Frequency range to draw; all by default.
    freq : (n_freq,) array [Hz], optional
        Frequencies; by default a grid of each system, refined at its resonances.
    also : sequence of str, optional
        Further quantities to draw. "phase" [deg, between -180 and 180] and "coherence" have a panel
        each. "deviation" draws the standard deviation of measurements as a line below them.
    ax : Axes, optional
        Axes for the magnitude, if neither phase nor coherence is drawn.

    Returns
    -------
    Axes
        Axes of the magnitude; its `.figure.axes` lists all axes.

    Raises
    ------
    LabelError
        When the reference or channel is unknown, or `also` names something else.
    ModelError
        When `responses` is not a mapping, the responses have different units, one has no line in
        the band, or none has the requested coherence or variance.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> frf = fx.frequency_response(fx.testbeds.three_masses().Gyu, np.geomspace(1.0, 900.0, 200))
    >>> ax = fx.plot.frf({"model": frf}, "y1", "u1")
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    if not isinstance(responses, Mapping) or isinstance(responses, Frf):
        raise ModelError(
            f"need a mapping of labels to Frfs, got {short(responses)}. Type {{'model': frf}}."
        )
    drawn = [_within_band(curve, band) for curve in curves(responses, freq, colors)]
    found = {curve.label: curve.response.unit(output, input) or unit for curve in drawn}
    known = {own for own in found.values() if own is not None}
    if len(known) > 1:
        raise ModelError(
            f"{output} / {input} is in different units, which cannot share an axis: {found}. "
            "Convert one (frf.converted), or draw them separately."
        )
    if reference is not None and reference not in found:
        raise unknown_label("response", reference, found)
    more = name_list(also, "also")
    require_known("part of the picture", more, _ALSO)
    below = [part for part in _ALSO if part in more and part != "deviation"]
    if ax is not None and below:
        raise ModelError(f"{' and '.join(below)} need separate panels: leave ax out.")
    given, panels = ax is not None, _magnitude_axes(ax, len(below))
    ax = panels[0]
    plain = role_of(drawn[0].label) is None and "marker" not in drawn[0].line
    wide = {"linewidth": 3.2, "alpha": 0.5} if len(drawn) > 1 and plain else {}
    for i, (label, response, line) in enumerate(drawn):
        look = line | wide if i == 0 else line
        ax.semilogx(response.freq, decibel(response[output, input]), label=label, **look)
        if "deviation" in more and response.variance is not None:
            variance = _channel_values(response, response.variance, output, input)
            text = f"standard deviation of {label}"
            look = {"color": GREY, "linewidth": 1.2, "linestyle": "--", "zorder": 1.7}
            ax.semilogx(response.freq, 0.5 * decibel(variance), label=text, **look)
    for curve, base in ((c, b) for b in drawn if b.label == reference for c in drawn if c is not b):
        if np.array_equal(base.response.freq, curve.response.freq):
            error = curve.response[output, input] - base.response[output, input]
            look = dict(STYLES["difference"])
            if len(drawn) > 2:
                look["color"] = curve.line["color"]
            text = f"{curve.label} minus {reference}"
            ax.semilogx(curve.response.freq, decibel(error), label=text, **look)
    _require_measured(drawn, more)
    readable(ax)
    y = gain_label(output, input, known.pop() if known else None)
    finish(ax, x="" if below else "frequency [Hz]", y=y, given=given)
    for part, panel in zip(below, panels[1:], strict=True):
        for _, response, line in drawn:
            if part == "phase":
                phase = _half_turns(response[output, input], dots="marker" in line)
                panel.semilogx(response.freq, phase, **line)
            elif response.coherence is not None:
                shown = _channel_values(response, response.coherence, output, input)
                panel.semilogx(response.freq, shown, **line)
        y = "phase [deg]" if part == "phase" else "coherence [-]"
        finish(panel, x="frequency [Hz]" if panel is panels[-1] else "", y=y)
        if part == "phase":
            panel.set_ylim(-190.0, 190.0)
            panel.yaxis.set_major_locator(MultipleLocator(90.0))
        else:
            panel.set_ylim(0.0, 1.05)
    return ax


#: what can be drawn in addition to a magnitude
_ALSO = ("phase", "coherence", "deviation")


def _magnitude_axes(ax: Axes | None, count: int) -> list[Axes]:
    """Return axes for a magnitude and a number of lower panels below it."""
    if ax is not None or not count:
        return [axes(ax, figsize=(9.0, 4.5))]
    size, ratios = (9.0, 4.5 + 1.8 * count), [2.5] + count * [1.0]
    return panel_axes(None, 1 + count, columns=1, figsize=size, height_ratios=ratios)


def _channel_values(response: Frf, values: FloatArray, output: str, input: str) -> FloatArray:
    place = list(response.outputs).index(output), list(response.inputs).index(input)
    return np.asarray(values[place])


def _require_measured(drawn: Sequence[Curve], parts: Sequence[str]) -> None:
    """Raise ModelError when no response has the coherence or variance that is asked for."""
    for part, kind in (("coherence", "coherence"), ("deviation", "variance")):
        if part in parts and all(getattr(one.response, kind) is None for one in drawn):
            listed = ", ".join(one.label for one in drawn)
            raise ModelError(
                f"none of the responses has a {kind}: {listed}. Estimate them from records by "
                "estimate_frf, or leave it out of also=."
            )


def _half_turns(values: ComplexArray, *, dots: bool) -> FloatArray:
    """Return phases [deg] within half a turn of 0; lines are broken where they come in again."""
    phase = np.degrees(np.angle(values))
    if not dots:
        phase[1:][np.abs(np.diff(phase)) > 180.0] = np.nan
    return np.asarray(phase)


def _within_band(curve: Curve, band: tuple[float, float] | None) -> Curve:
    """Return the part of a curve within a band of frequencies."""
    if band is None:
        return curve
    low, high = real_array(band, "band", (2,)).tolist()
    freq = curve.response.freq
    inside = (freq >= low) & (freq <= high)
    if not inside.any():
        raise ModelError(
            f"{curve.label!r} has no frequency from {low:g} to {high:g} Hz: it reaches from "
            f"{freq[0]:g} to {freq[-1]:g} Hz. Choose another band."
        )
    parts = {
        kind: values[:, :, inside]
        for kind in ("data", "coherence", "variance", "correlation")
        if (values := getattr(curve.response, kind)) is not None
    }
    return curve._replace(response=curve.response.replace(freq=freq[inside], **parts))
