"""Sensitivities over frequency: what feedback does to errors, noise and commands."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from ..checks import FloatArray, real_array, short
from ..errors import LabelError, ModelError, ShapeError
from ..loop import ClosedLoop, complementary_sensitivity, control_sensitivity
from ..loop import sensitivity as sensitivity_of
from ..loop.comparison import error_sensitivity
from ..lti.frequency import Frf, frequency_response
from ..lti.statespace import as_statespace
from ._axes import GREY, STYLES, Style, axes, finish, legend, styles
from .gains import by_label, decibel, readable, shared_reference

#: what weights limit
_LIMITED = ("S", "T", "KS")
#: a frequency axis and sizes over it
_Line = tuple[FloatArray, FloatArray]


def sensitivity(
    curves: Any,
    *,
    colors: Mapping[str, str] | None = None,
    dashed: Collection[str] = (),
    weight: Any = None,
    freq: FloatArray | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the size of sensitivities over frequency, with lines at 0 and 6 dB.

    Parameters
    ----------
    curves : ClosedLoop, Frf, (plant, controller), (freq [Hz], size), or mapping {label: of these}
        What to draw. Of a loop with a reference |S| from that to the error at the POI; of others,
        and of `(plant, controller)`, the largest singular value of S at u; of an `Frf`, such as
        `sensitivity(loop)`, its largest singular value.
    colors : mapping {label: color}, optional
        Of some lines.
    dashed : collection of str
        Labels of lines to draw thin and dashed, so that they show on equal ones.
    weight : StateSpace or float, optional
        W of ``|W S| < 1``: its inverse is drawn as the bound.
    freq : (n_freq,) array [Hz], optional
        Where pairs of plant and controller are evaluated; a grid of each when not given.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When one of them is none of these, or the weight has several channels.
    ShapeError
        When frequencies and sizes are not of one length.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> ax = fx.plot.sensitivity({"S": fx.loop.sensitivity(fx.close_loop(plant, observer, servo))})
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    lines = {label: _size(one, freq) for label, one in by_label(curves).items()}
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.5))
    for (label, line), style in zip(lines.items(), styles(lines, colors), strict=True):
        if label in dashed:
            style |= {"linestyle": "--", "linewidth": 1.2, "zorder": 2.5}
        elif dashed:
            style |= {"linestyle": "-", "linewidth": 2.6, "alpha": 0.7}
        ax.semilogx(line[0], decibel(line[1]), label=label or None, **style)
    _limit(ax, weight, "S", list(lines.values()))
    if not given:
        _from_where_it_rises(ax, list(lines.values()))
    _levels(ax)
    legend(ax, given=given)
    return finish(ax, x="frequency [Hz]", y="|S| [dB]")


def sensitivities(
    loops: Any,
    *,
    weights: Mapping[str, Any] | None = None,
    at: Literal["u", "y"] = "u",
    freq: FloatArray | None = None,
    colors: Mapping[str, str] | None = None,
    ax: Sequence[Axes] | None = None,
) -> Axes:
    """Draw S, T and KS of loops below each other, with the bounds that weights set.

    ``S = (I - L)^-1``, ``T = I - S``, ``K S`` from measurements y to commands u, broken where `at`
    says. Of several channels the largest singular value, which is the gain of the worst direction;
    of S the smallest as well, as a thin line: more actuators than axes leave a direction free.

    Parameters
    ----------
    loops : ClosedLoop, (plant, controller), or mapping {label: one of these}
        The plant may be a measured Frf.
    weights : mapping {"S", "T" or "KS": StateSpace or float}, optional
        W of ``|W S| < 1`` and so on: their inverses are drawn as bounds, as `mixed_sensitivity`
        takes them.
    at : {"u", "y"}
        Where the loop is broken for S and T.
    freq : (n_freq,) array [Hz], optional
        A grid of each loop, refined at its resonances, when not given.
    colors : mapping {label: color}, optional
        Of some lines.
    ax : three Axes, optional
        Where to draw S, T and KS.

    Returns
    -------
    Axes
        Of S; `.figure.axes` are all.

    Raises
    ------
    ModelError
        When one is no loop, weights are of other names or of several channels, or there are not
        three axes.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> [ax.get_ylabel() for ax in fx.plot.sensitivities(loop).figure.axes]
    ['|S| [dB]', '|T| [dB]', '|KS| [dB, 0 dB = 1 N/m]']
    """
    named, limits = by_label(loops), dict(weights or {})
    if unknown := set(limits) - set(_LIMITED):
        raise ModelError(f"weights are of {', '.join(_LIMITED)}, got {sorted(map(str, unknown))}.")
    responses = {
        what: [_kind_of(what, one, at, freq) for one in named.values()] for what in _LIMITED
    }
    if ax is not None and np.size(np.asarray(ax, dtype=object)) != 3:
        raise ModelError("ax= takes three axes: for S, T and KS. Leave it out for a new figure.")
    panels = ax if ax is not None else plt.subplots(
        3, 1, sharex=True, figsize=(8.0, 8.5), layout="constrained"
    )[1]  # fmt: skip
    looks = styles(named, colors)
    for what, panel in zip(_LIMITED, panels, strict=True):
        found = responses[what]
        lines = [(response.freq, largest(response)) for response in found]
        for label, line, style in zip(named, lines, looks, strict=True):
            text = label if label and what == "S" else None
            panel.semilogx(line[0], decibel(line[1]), label=text, **style)
        _limit(panel, limits.get(what), what, lines)
        if what == "S":
            _smallest(panel, found, looks)
        if what == "KS":
            readable(panel)
        else:
            _levels(panel)
        unit = f", 0 dB = {shared_reference(found[0])}" if what == "KS" else ""
        finish(panel, x="frequency [Hz]" if what == "KS" else "", y=f"|{what}| [dB{unit}]")
        legend(panel, given=ax is not None)
    first: Axes = panels[0]
    return first


def _smallest(ax: Axes, found: Sequence[Frf], looks: Sequence[Style]) -> None:
    """Draw the smallest singular values of S, and all from a hundredth of where they rise on."""
    lines = [(response.freq, singular(response)[:, -1]) for response in found]
    for line, response, style in zip(lines, found, looks, strict=True):
        if response.data.shape[0] > 1:
            ax.semilogx(line[0], decibel(line[1]), **(style | {"linewidth": 0.6}))
            ax.set_title("largest singular values; thin: the smallest of S", fontsize="medium")
    _from_where_it_rises(ax, lines)


def _from_where_it_rises(ax: Axes, lines: Sequence[_Line]) -> None:
    """Begin two decades below the frequency where a sensitivity first reaches 1/2."""
    rises = [freq[np.argmax(size > 0.5)] for freq, size in lines if np.any(size > 0.5)]
    start = min(freq[0] for freq, _ in lines)
    if rises and 0.01 * min(rises) > start:
        ax.set_xlim(left=0.01 * min(rises))


def singular(response: Frf) -> FloatArray:
    """Return the singular values (n_freq, k) of a response, the largest first."""
    return np.asarray(np.linalg.svd(np.moveaxis(response.data, 2, 0), compute_uv=False))


def largest(response: Frf) -> FloatArray:
    """Return the largest singular value of a response at each frequency."""
    return singular(response)[:, 0]


def _kind_of(what: str, loop: Any, at: Literal["u", "y"], freq: FloatArray | None) -> Frf:
    if what == "KS":
        return control_sensitivity(loop, freq=freq)
    found = sensitivity_of if what == "S" else complementary_sensitivity
    return found(loop, freq=freq, at=at)


def _size(one: Any, freq: FloatArray | None) -> _Line:
    """Return frequencies and sizes of one sensitivity."""
    if isinstance(one, Frf):
        return one.freq, largest(one)
    if isinstance(one, ClosedLoop):
        try:
            return error_sensitivity(one)
        except LabelError:  # no reference
            pass
    elif _is_line(one):
        line = real_array(one[0], "freq", (None,)), real_array(one[1], "size", (None,))
        if line[0].size != line[1].size:
            raise ShapeError(f"{line[0].size} frequencies and {line[1].size} sizes: pass pairs.")
        return line
    elif not isinstance(one, tuple):
        raise ModelError(
            f"need a ClosedLoop, (plant, controller), an Frf or (freq, size), got {short(one)}. "
            "Type {'model': close_loop(plant, controller)}."
        )
    S = sensitivity_of(one, freq=freq)
    return S.freq, largest(S)


def _is_line(one: Any) -> bool:
    return isinstance(one, tuple) and len(one) == 2 and all(
        isinstance(part, np.ndarray | list) for part in one
    )  # fmt: skip


def _limit(ax: Axes, weight: Any, what: str, lines: Sequence[_Line]) -> None:
    """Draw the inverse of a weight over the frequencies of the lines."""
    if weight is None:
        return
    g = as_statespace(np.array([[weight]]) if isinstance(weight, int | float) else weight)
    shape = len(g.outputs), len(g.inputs)
    if shape != (1, 1):
        raise ModelError(
            f"the weight of {what} has {shape[0]} outputs and {shape[1]} inputs: a bound on "
            "singular values needs one of each. Draw channels one by one."
        )
    ends = [f for freq, _ in lines for f in (freq[0], freq[-1])]
    top = min(max(ends), 0.5 / g.dt) if g.dt else max(ends)
    # six decades, where a line begins at 0 Hz
    freq = np.geomspace(max(min(ends), 1e-6 * top), top, 400)
    size = np.abs(frequency_response(g, freq).data[0, 0])
    ax.semilogx(freq, -decibel(size), label=f"1 / |W| of {what}", **STYLES["bound"])


def _levels(ax: Axes) -> None:
    for level, style in ((0.0, "-"), (6.0, ":")):
        ax.axhline(level, color=GREY, linestyle=style, linewidth=0.8, zorder=1.0)
    ax.annotate("6 dB", (1.0, 6.0), (-3.0, 2.0), xycoords=ax.get_yaxis_transform(),
                textcoords="offset points", ha="right", fontsize="x-small", color=GREY)  # fmt: skip
    readable(ax)
