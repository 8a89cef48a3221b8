"""Pictures of loops: Nyquist diagrams, poles, and sensitivity functions."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from ..arrays import ComplexArray, FloatArray, positive, real_array
from ..errors import LabelError, ModelError, ShapeError, short, unknown_label
from ..loop import ClosedLoop, complementary_sensitivity, control_sensitivity
from ..loop import sensitivity as sensitivity_of
from ..loop.blocks import references
from ..loop.broken import axis_sensitivities, error_sensitivity
from ..lti.frequency import Frf, frequency_response
from ..lti.measured_lines import LINES, on_lines, steps_between
from ..lti.response_solvers import continuous_poles
from ..lti.statespace import StateSpace, as_statespace
from ..tolerances import SAME, SPLIT
from ._axes import (
    BLUE,
    GREY,
    RED,
    STYLES,
    Style,
    apart,
    axes,
    bottom_only,
    by_label,
    curves,
    decibel,
    finish,
    labelled,
    legend,
    name_panel,
    panel_axes,
    readable,
    shared_reference,
    singular,
    styles,
    three_axes,
)

#: step of L relative to its distance from -1 above which points are added
_STEEP = 0.15


def nyquist(
    loop_gains: Any,
    *,
    channel: tuple[str, str] | None = None,
    freq: FloatArray | None = None,
    modulus: float = 2.0,
    reach: float = 2.5,
    ax: Axes | None = None,
) -> Axes:
    """Draw loop gains L in the complex plane, with -1 and the circle ``|S| = modulus`` about it.

    If there are more than four curves, each has a separate panel.

    The magnitude of ``S = 1 / (1 + L)`` is the inverse of the distance of L from -1. It is larger
    than `modulus` inside the circle. Only positive frequencies are drawn, without the mirror image.
    Near a resonance the curve of L is nearly a circle. If a measured gain has too few frequencies
    there, the drawn curve follows the circle through the neighbouring points.

    Parameters
    ----------
    loop_gains : StateSpace, Frf, ClosedLoop, or mapping {label: one of these}
        Loop gains L of one channel each, for negative feedback (``1 + L``). For a closed loop, the
        gain at each actuator is drawn while the loops of the other actuators stay closed.
    channel : (output, input), optional
        Channel of systems with several channels.
    freq : (n_freq,) array [Hz], optional
        Frequencies; by default a grid of each system, refined at its resonances.
    modulus : float
        Value of |S| on the circle about -1, which has the radius 1 / modulus; 2 is 6 dB.
    reach : float
        Largest real and imaginary part of the picture.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Raises
    ------
    ModelError
        When nothing is given to draw, or one of several channels must be chosen.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.nyquist({"L": fx.lti.tf([25.0], [1.0, 2.0, 0.0])})
    >>> ax.get_legend().get_texts()[0].get_text()
    'L: |S| up to 8.7 dB, at 0.8221 Hz'
    """
    level = 20.0 * np.log10(positive(modulus, "modulus"))
    limit = positive(reach, "reach")
    measured = [name for name, one in labelled(loop_gains).items() if isinstance(one, Frf)]
    drawn = curves(_loop_gains(loop_gains, freq), freq)
    alone = apart(ax, [curve.label for curve in drawn])
    if alone:
        rows = -(-len(drawn) // 2)
        height = 0.8 + 3.2 * rows
        panels = panel_axes(None, len(drawn), figsize=(7.0, height), sharey=True)
    else:
        panels = [axes(ax, figsize=(9.0, 5.0))] * len(drawn)
    for curve, panel in zip(drawn, panels, strict=True):
        known = list(curve.response)
        if channel is None and len(known) > 1:
            raise ModelError(
                f"the loop gain {curve.label or 'given'!r} has {len(known)} channels: choose one, "
                f"channel={known[0]!r}."
            )
        chosen = known[0] if channel is None else channel
        if chosen not in known:
            raise unknown_label("channel", str(chosen), [str(one) for one in known])
        lines, values = curve.response.freq, curve.response[chosen]
        if curve.label in measured:
            lines, values = _refine_loop_gain(lines, values)
        nearest = int(np.argmin(np.abs(1.0 + values)))
        size = -20.0 * np.log10(abs(1.0 + values[nearest]))
        text = f"|S| up to {size:.1f} dB, at {lines[nearest]:.4g} Hz"
        label = f"{curve.label}: {text}" if curve.label else text
        look = curve.line | ({"color": BLUE, "linestyle": "-"} if alone else {})
        panel.plot(values.real, values.imag, label=label, **look)
        near = values[nearest]
        panel.plot(near.real, near.imag, "o", color=look["color"], markersize=5)
        if alone:
            name_panel(panel, f"{curve.label}: {text.removeprefix('|S| ')}")
    about = f"-1, with |S| = {level:.1f} dB about it"
    for panel in dict.fromkeys(panels):
        shaded = {"alpha": 0.15, "color": RED, "linewidth": 0}
        panel.add_patch(Circle((-1, 0), 1.0 / modulus, **shaded))
        panel.add_patch(Circle((0, 0), 1.0, fill=False, color=GREY, linestyle=":", linewidth=0.9))
        panel.plot(-1, 0, "+", color=RED, markersize=10, label=about)
        panel.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
        finish(panel, x="real part of L", y="imaginary part of L")
    if alone:
        bottom_only(panels)
        panels[0].figure.suptitle(f"|S|; shaded: above {level:.1f} dB", fontsize="medium")
    else:
        legend(panels[0], given=ax is not None)
    return panels[0]


def _refine_loop_gain(freq: FloatArray, L: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """Return a loop gain with points between lines where it moves much relative to 1 + L."""
    if freq.size < LINES:
        return freq, L
    away = np.abs(1.0 + L)
    steep = np.flatnonzero(np.abs(np.diff(L)) > _STEEP * np.minimum(away[1:], away[:-1]))
    if not steep.size:
        return freq, L
    every = np.union1d(freq, steps_between(freq, L, steep))
    return every, on_lines(freq, L, every)


def _loop_gains(found: Any, freq: FloatArray | None) -> dict[str, Any]:
    """Return what to draw by label; of a closed loop ``L_i = 1 / S_ii - 1`` of each actuator."""
    gains: dict[str, Any] = {}
    for label, one in labelled(found).items():
        if not isinstance(one, ClosedLoop):
            gains[label] = one
            continue
        S = sensitivity_of(one, freq=freq)
        for i, name in enumerate(S.inputs):
            L = 1.0 / S.data[[i]][:, [i]] - 1.0
            gains[f"{label} {name}".strip()] = Frf(S.freq, L, [name], [name])
    return gains


#: markers of poles and zeros, one of each for a system
_MARKERS = (("x", "o"), ("+", "s"), ("1", "D"), ("2", "^"))
#: damping ratios of the lines
_RATIOS = (1e-3, 1e-2, 0.1, 0.3, 0.7)


def pole_map(systems: Any, *, zeros: bool = False, ax: Axes | None = None) -> Axes:
    """Draw poles (and zeros) by frequency and damping ratio, unstable ones in red.

    In the complex plane, lightly damped poles seem to lie on the imaginary axis. A diagram of the
    damping ratio ``-Re s / |s|`` over |s| in Hz separates them. Poles of sampled systems are mapped
    to ``log(z) / dt``. Poles at zero frequency are named in the legend.

    Parameters
    ----------
    systems : StateSpace, or mapping {label: StateSpace} or list of them
        Systems whose poles are drawn as crosses.
    zeros : bool
        Whether invariant zeros are drawn too, as circles.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Damping ratio over frequency [Hz], negative where unstable.

    Raises
    ------
    ModelError
        When one is not a system, or no system has states.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.pole_map({"plant": fx.testbeds.three_masses().system})
    >>> len(ax.get_lines()) + len(ax.collections) > 0
    True
    """
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.5))
    named = {label: as_statespace(one) for label, one in labelled(systems).items()}
    if not any(g.n_states for g in named.values()):
        raise ModelError("static gains have no poles to draw. Pass a system with states.")
    looks = styles(named)
    for i, (label, g) in enumerate(named.items()):
        color = str(looks[i]["color"])
        pole, zero = _MARKERS[i % len(_MARKERS)]
        _draw_roots(ax, continuous_poles(g), pole, color, f"{label} poles".strip())
        if zeros:
            _draw_roots(ax, _log_poles(g.zeros(), g), zero, color, f"{label} zeros".strip())
    ax.set_xscale("log")
    _wide(ax)
    # a drawn root is on the right of the imaginary axis, or on it
    if any(np.any(np.asarray(line.get_ydata()) <= 0.0) for line in ax.get_lines()):
        ax.set_yscale("symlog", linthresh=1e-4)  # smaller values cannot be distinguished
        ax.axhline(0.0, color="0.3", linewidth=0.9)
    else:
        ax.set_yscale("log")
        ax.set_ylim(bottom=0.5 * ax.dataLim.intervaly[0])
    ax.set_ylim(top=2.0)
    for ratio in _RATIOS:
        ax.axhline(ratio, color=GREY, linewidth=0.6, linestyle=":")
    return finish(ax, x="frequency |s| / 2 pi [Hz]", y="damping ratio [-]", given=given)


def _wide(ax: Axes) -> None:
    """Show at least a decade, since minor ticks overlap otherwise."""
    low, high = ax.get_xlim()
    room = np.sqrt(10.0 * low / high)
    if room > 1.0:
        ax.set_xlim(low / room, high * room, auto=True)


def _log_poles(roots: ComplexArray, g: StateSpace) -> ComplexArray:
    if not g.dt:
        return roots
    kept = roots[np.abs(roots) > 0]
    return np.asarray(np.log(kept) / g.dt)


def _draw_roots(ax: Axes, roots: ComplexArray, marker: str, color: str, label: str) -> None:
    upper = roots[roots.imag >= -SAME * np.abs(roots)]
    size = np.abs(upper)
    still = size < SPLIT * size.max(initial=0.0)
    if still.any():
        label = f"{label}, {int(still.sum())} more at 0 Hz"
    freq: FloatArray = size[~still] / (2 * np.pi)
    ratio = -upper[~still].real / size[~still]
    ax.plot(freq, ratio, marker, color=color, label=label, markersize=7, fillstyle="none")
    unstable: dict[str, Any] = {"color": RED, "markersize": 11, "fillstyle": "none"}
    ax.plot(freq[ratio < 0], ratio[ratio < 0], marker, **unstable)


#: sensitivity functions that weights can limit
_LIMITED = ("S", "T", "KS")
#: a frequency axis, and magnitudes at its frequencies
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

    If there are more than four curves, each has a separate panel.

    Parameters
    ----------
    curves : ClosedLoop, Frf, (plant, controller), (freq [Hz], size), or mapping {label: of these}
        Curves to draw. For a loop with references, |S| from each reference to the error of its axis
        is drawn. For a loop without references, and for `(plant, controller)`, the largest singular
        value of S at u is drawn. For an `Frf`, such as `sensitivity(loop)`, its largest singular
        value is drawn.
    colors : mapping {label: color}, optional
        Colours of some lines.
    dashed : collection of str
        Labels of lines to draw thin and dashed, so that lines below them are visible.
    weight : StateSpace or float, optional
        Weight W of ``|W S| < 1``. Its inverse is drawn as a bound.
    freq : (n_freq,) array [Hz], optional
        Frequencies for pairs of plant and controller; by default a grid of each.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Raises
    ------
    ModelError
        When a curve has another type, or the weight has several channels.

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
    lines: dict[str, _Line] = {}
    for label, one in by_label(curves).items():
        several = isinstance(one, ClosedLoop) and len(references(one.plant)) > 1
        found = axis_sensitivities(one) if several else {"": _sensitivity_size(one, freq)}
        lines |= {" ".join(filter(None, (label, axis))): line for axis, line in found.items()}
    alone = apart(ax, lines) and not dashed
    if alone:
        panels = panel_axes(None, len(lines), sharey=True)
    else:
        panels = [axes(ax, figsize=(8.0, 4.5))] * len(lines)
    looks = [{"color": BLUE}] * len(lines) if alone else styles(lines, colors)
    for (label, line), style, panel in zip(lines.items(), looks, panels, strict=True):
        if label in dashed:
            style |= {"linestyle": "--", "linewidth": 1.2, "zorder": 2.5}
        elif dashed:
            style |= {"linestyle": "-", "linewidth": 2.6, "alpha": 0.7}
        panel.semilogx(line[0], decibel(line[1]), label=label or None, **style)
        if alone:
            at = int(np.argmax(line[1]))
            text = f"{label}: up to {decibel(line[1][at]):.1f} dB, at {line[0][at]:.4g} Hz"
            name_panel(panel, text)
    for panel in dict.fromkeys(panels):
        _draw_limit(panel, weight, "S", list(lines.values()))
        if ax is None:
            _from_where_it_rises(panel, list(lines.values()))
        _draw_levels(panel)
        finish(panel, x="frequency [Hz]", y="|S| [dB]")
    if alone:
        bottom_only(panels)
    else:
        legend(panels[0], given=ax is not None)
    return panels[0]


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

    The functions are ``S = (I - L)^-1``, ``T = I - S``, and ``K S`` from measurements y to commands
    u. L is the gain of the loop that is broken at `at`. For several channels the largest singular
    value is drawn, which is the gain of the worst direction. For S the smallest one is drawn too,
    as a thin line: if there are more actuators than axes, the largest one is never below 1, because
    one direction is not controlled.

    Parameters
    ----------
    loops : ClosedLoop, (plant, controller), or mapping {label: one of these}
        The plant may be a measured Frf.
    weights : mapping {"S", "T" or "KS": StateSpace or float}, optional
        Weights W of ``|W S| < 1`` and so on, as for `mixed_sensitivity`. Their inverses are drawn
        as bounds.
    at : {"u", "y"}
        Place at which the loop is broken for S and T.
    freq : (n_freq,) array [Hz], optional
        Frequencies; by default a grid of each loop, refined at its resonances.
    colors : mapping {label: color}, optional
        Colours of some lines.
    ax : three Axes, optional
        Axes of S, T and KS.

    Returns
    -------
    Axes
        Axes of S; its `.figure.axes` lists all axes.

    Raises
    ------
    ModelError
        When one is not a loop, weights have other names or several channels, or there are not three
        axes.

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
    responses: dict[str, list[Frf]] = {
        "S": [sensitivity_of(one, freq=freq, at=at) for one in named.values()],
        "T": [complementary_sensitivity(one, freq=freq, at=at) for one in named.values()],
        "KS": [control_sensitivity(one, freq=freq) for one in named.values()],
    }
    panels = three_axes(ax, 3, 1, sharex=True, figsize=(8.0, 8.5))
    looks = styles(named, colors)
    for what, panel in zip(_LIMITED, panels, strict=True):
        found = responses[what]
        lines = [(response.freq, singular(response)[:, 0]) for response in found]
        for label, line, style in zip(named, lines, looks, strict=True):
            text = label if label and what == "S" else None
            panel.semilogx(line[0], decibel(line[1]), label=text, **style)
        _draw_limit(panel, limits.get(what), what, lines)
        if what == "S":
            _draw_smallest(panel, found, looks)
        if what == "KS":
            readable(panel)
        else:
            _draw_levels(panel)
        unit = f", 0 dB = {shared_reference(found[0])}" if what == "KS" else ""
        x, y = "frequency [Hz]" if what == "KS" else "", f"|{what}| [dB{unit}]"
        finish(panel, x=x, y=y, given=ax is not None)
    return panels[0]


def _draw_smallest(ax: Axes, found: Sequence[Frf], looks: Sequence[Style]) -> None:
    """Draw the smallest singular values of S, and limit the frequency axis."""
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


def _sensitivity_size(one: Any, freq: FloatArray | None) -> _Line:
    """Return frequencies and sizes of one sensitivity."""
    if isinstance(one, Frf):
        return one.freq, singular(one)[:, 0]
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
    return S.freq, singular(S)[:, 0]


def _is_line(one: Any) -> bool:
    return isinstance(one, tuple) and len(one) == 2 and all(
        isinstance(part, np.ndarray | list) for part in one
    )  # fmt: skip


def _draw_limit(ax: Axes, weight: Any, what: str, lines: Sequence[_Line]) -> None:
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


def _draw_levels(ax: Axes) -> None:
    for level, style in ((0.0, "-"), (6.0, ":")):
        ax.axhline(level, color=GREY, linestyle=style, linewidth=0.8, zorder=1.0)
    # outside the axes, where neither a curve nor the level of 0 dB crosses it
    ax.annotate("6 dB", (1.0, 6.0), (2.0, 0.0), xycoords=ax.get_yaxis_transform(),
                textcoords="offset points", ha="left", va="center", fontsize="x-small", color=GREY,
                annotation_clip=True)  # fmt: skip
    readable(ax)
