"""Nyquist diagrams: how near a loop gain comes to -1."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from ..errors import ModelError, unknown_label
from ..loop import ClosedLoop, sensitivity
from ..lti.between_lines import LINES, followed, steps_between
from ..lti.frequency import Frf
from ..values import ComplexArray, FloatArray, positive
from ._axes import axes, finish, legend
from ._style import GREY, RED
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
