"""Frequency responses of one channel side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..errors import ModelError, unknown_label
from ..lti.frequency import Frf
from ..values import FloatArray, real_array, short
from ._axes import axes, finish, legend
from ._style import STYLES, role_of
from .gains import Curve, curves, decibel, gain_label, readable


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
    ax: Axes | None = None,
) -> Axes:
    """Draw the magnitude of one channel of several responses (paper, Figs. 4, 10 and 11).

    Measurements are black points under the lines. The first of lines whose labels name nothing is
    thick, so that those that cover it do not hide it.

    Parameters
    ----------
    responses : mapping {label: Frf or system}
        What to compare.
    output, input : str
        The channel.
    colors : mapping {label: color}, optional
        Of some lines.
    unit : str, optional
        Of the gain, where the responses have none; 0 dB is one of it.
    reference : str, optional
        A label: the differences of the other responses from this one are drawn as well, where
        they share its frequencies.
    band : (low, high) [Hz], optional
        The frequencies to draw; all when not given.
    freq : (n_freq,) array [Hz], optional
        Where systems are evaluated; a grid of each, refined at resonances, when not given.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    LabelError
        When there is no such reference or channel.
    ModelError
        When there is no such mapping, the responses are of different units, or nothing of one is
        in the band.

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
    drawn = [_part(curve, band) for curve in curves(responses, freq, colors)]
    found = {curve.label: curve.response.unit(output, input) or unit for curve in drawn}
    known = {own for own in found.values() if own is not None}
    if len(known) > 1:
        raise ModelError(
            f"{output} / {input} is in different units, which share no axis: {found}. Convert one "
            "(frf.converted), or draw them apart."
        )
    if reference is not None and reference not in found:
        raise unknown_label("response", reference, found)
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.5))
    plain = role_of(drawn[0].label) is None and "marker" not in drawn[0].line
    wide = {"linewidth": 3.2, "alpha": 0.5} if len(drawn) > 1 and plain else {}
    for i, (label, response, line) in enumerate(drawn):
        look = line | wide if i == 0 else line
        ax.semilogx(response.freq, decibel(response[output, input]), label=label, **look)
    for curve, base in ((c, b) for b in drawn if b.label == reference for c in drawn if c is not b):
        if np.array_equal(base.response.freq, curve.response.freq):
            error = curve.response[output, input] - base.response[output, input]
            look = dict(STYLES["difference"])
            if len(drawn) > 2:
                look["color"] = curve.line["color"]
            text = f"{curve.label} less {reference}"
            ax.semilogx(curve.response.freq, decibel(error), label=text, **look)
    readable(ax)
    legend(ax, given=given)
    gain = known.pop() if known else None
    return finish(ax, x="frequency [Hz]", y=gain_label(output, input, gain))


def _part(curve: Curve, band: tuple[float, float] | None) -> Curve:
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
    whole = curve.response
    data, units = whole.data[:, :, inside], whole.channel_units
    shown = Frf(freq[inside], data, whole.inputs, whole.outputs, units=units)
    return curve._replace(response=shown)
