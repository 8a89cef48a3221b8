"""Nyquist diagrams: how near a loop gain comes to -1."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from ..checks import ComplexArray, FloatArray, positive
from ..errors import ModelError, unknown_label
from ..loop import ClosedLoop, sensitivity
from ..lti.frequency import Frf
from ..lti.measured_lines import LINES, followed, steps_between
from ..lti.responses import continuous_poles
from ..lti.statespace import StateSpace, as_statespace
from ..tolerances import SAME, SPLIT
from ._axes import GREY, RED, axes, finish, legend, styles
from .gains import curves, labelled

#: step of L beside its distance from -1 that is filled in
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
    """Draw loop gains L in the complex plane, with -1 and the circle in which ``|S| > modulus``.

    ``S = 1 / (1 + L)``: its size is the inverse of the distance from -1. Frequencies are positive;
    the mirror image is not drawn. Where a measured gain steps over a resonance the curve follows
    the circle through its neighbouring lines.

    Parameters
    ----------
    loop_gains : StateSpace, Frf, ClosedLoop, or mapping {label: one of these}
        L of one channel each, the sign being that of ``1 + L``. Of a closed loop, the gain at each
        actuator while the others stay closed.
    channel : (output, input), optional
        Of systems with several.
    freq : (n_freq,) array [Hz], optional
        Where systems are evaluated; a grid of each, refined at resonances, when not given.
    modulus : float
        Of the circle about -1, of radius 1 / modulus; 2 is 6 dB.
    reach : float
        The picture shows real and imaginary parts up to it.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When there is nothing to draw, or one of several channels is not chosen.
    LabelError
        When the channel is unknown.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.nyquist({"L": fx.lti.tf([25.0], [1.0, 2.0, 0.0])})
    >>> ax.get_legend().get_texts()[0].get_text()
    'L: |S| up to 8.7 dB, at 0.8221 Hz'
    """
    given, ax = ax is not None, axes(ax, figsize=(9.0, 5.0))
    measured = [name for name, one in labelled(loop_gains).items() if isinstance(one, Frf)]
    for curve in curves(_opened(loop_gains, freq), freq):
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
            lines, values = _followed(lines, values)
        nearest = int(np.argmin(np.abs(1.0 + values)))
        size = -20.0 * np.log10(abs(1.0 + values[nearest]))
        text = f"|S| up to {size:.1f} dB, at {lines[nearest]:.4g} Hz"
        label = f"{curve.label}: {text}" if curve.label else text
        ax.plot(values.real, values.imag, label=label, **curve.line)
        near = values[nearest]
        ax.plot(near.real, near.imag, "o", color=curve.line["color"], markersize=5)
    level = 20.0 * np.log10(positive(modulus, "modulus"))
    ax.add_patch(
        Circle(
            (-1, 0),
            1.0 / modulus,
            fill=True,
            alpha=0.15,
            color=RED,
            linewidth=0,
        )
    )
    ax.add_patch(Circle((0, 0), 1.0, fill=False, color=GREY, linestyle=":", linewidth=0.9))
    ax.plot(
        -1,
        0,
        "+",
        color=RED,
        markersize=10,
        label=f"-1, with |S| = {level:.1f} dB about it",
    )
    limit = positive(reach, "reach")
    ax.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    legend(ax, given=given)
    return finish(ax, x="real part of L", y="imaginary part of L")


def _followed(freq: FloatArray, L: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """Return a loop gain with points between lines where it moves much beside 1 + L."""
    if freq.size < LINES:
        return freq, L
    away = np.abs(1.0 + L)
    steep = np.flatnonzero(np.abs(np.diff(L)) > _STEEP * np.minimum(away[1:], away[:-1]))
    if not steep.size:
        return freq, L
    every = np.union1d(freq, steps_between(freq, L, steep))
    return every, followed(freq, L, every)


def _opened(found: Any, freq: FloatArray | None) -> dict[str, Any]:
    """Return what to draw by label; of a closed loop ``L_i = 1 / S_ii - 1`` of each actuator."""
    gains: dict[str, Any] = {}
    for label, one in labelled(found).items():
        if not isinstance(one, ClosedLoop):
            gains[label] = one
            continue
        S = sensitivity(one, freq=freq)
        for i, name in enumerate(S.inputs):
            L = 1.0 / S.data[[i]][:, [i]] - 1.0
            gains[f"{label} {name}".strip()] = Frf(S.freq, L, [name], [name])
    return gains


#: markers of poles and zeros, one of each for a system
_MARKERS = (("x", "o"), ("+", "s"), ("1", "D"), ("2", "^"))
#: damping ratios of the lines
_RATIOS = (1e-3, 1e-2, 0.1, 0.3, 0.7)


def pole_map(systems: Any, *, zeros: bool = False, ax: Axes | None = None) -> Axes:
    """Draw poles (and zeros) by frequency and damping ratio, those right of the axis in red.

    Lightly damped poles of a machine lie on the imaginary axis for the eye: |s| in Hz over the
    damping ratio ``-Re s / |s|`` separates them. Poles of sampled systems are taken to ``log(z)
    / dt``. Poles at zero frequency are named in the legend.

    Parameters
    ----------
    systems : StateSpace, or mapping {label: StateSpace} or list of them
        Whose poles are drawn as crosses.
    zeros : bool
        Whether invariant zeros are drawn too, as circles.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Damping ratio over frequency [Hz], negative where unstable.

    Raises
    ------
    ModelError
        When one is no system.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.pole_map({"plant": fx.testbeds.three_masses().system})
    >>> len(ax.get_lines()) + len(ax.collections) > 0
    True
    """
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.5))
    named = labelled(systems)
    looks = styles(named)
    for i, (label, one) in enumerate(named.items()):
        g, color = as_statespace(one), str(looks[i]["color"])
        pole, zero = _MARKERS[i % len(_MARKERS)]
        _draw(ax, continuous_poles(g), pole, color, f"{label} poles".strip())
        if zeros:
            _draw(ax, _continuous(g.zeros(), g), zero, color, f"{label} zeros".strip())
    ax.set_xscale("log")
    _wide(ax)
    # a drawn root is on the right of the imaginary axis, or on it
    if any(np.any(np.asarray(line.get_ydata()) <= 0.0) for line in ax.get_lines()):
        ax.set_yscale("symlog", linthresh=1e-4)
        ax.axhline(0.0, color="0.3", linewidth=0.9)
    else:
        ax.set_yscale("log")
        ax.set_ylim(bottom=0.5 * ax.dataLim.intervaly[0])
    ax.set_ylim(top=2.0)
    for ratio in _RATIOS:
        ax.axhline(ratio, color=GREY, linewidth=0.6, linestyle=":")
    legend(ax, given=given)
    return finish(ax, x="frequency |s| / 2 pi [Hz]", y="damping ratio [-]")


def _wide(ax: Axes) -> None:
    """Show a decade at least: ticks between those of decades lie on each other in a part of one."""
    low, high = ax.get_xlim()
    room = np.sqrt(10.0 * low / high)
    if room > 1.0:
        ax.set_xlim(low / room, high * room, auto=True)


def _continuous(roots: ComplexArray, g: StateSpace) -> ComplexArray:
    if not g.dt:
        return roots
    kept = roots[np.abs(roots) > 0]
    return np.asarray(np.log(kept) / g.dt)


def _draw(ax: Axes, roots: ComplexArray, marker: str, color: str, label: str) -> None:
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
