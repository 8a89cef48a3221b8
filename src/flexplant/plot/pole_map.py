"""Poles and zeros in the complex plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..lti.responses import continuous_poles
from ..lti.statespace import StateSpace, as_statespace
from ..values import ComplexArray, FloatArray
from ._axes import axes, finish, legend
from ._style import GREY, RED, styles
from .gains import labelled

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
    upper = roots[roots.imag >= -1e-9 * np.abs(roots)]
    size = np.abs(upper)
    still = size < 1e-6 * size.max(initial=0.0)
    if still.any():
        label = f"{label}, {int(still.sum())} more at 0 Hz"
    freq: FloatArray = size[~still] / (2 * np.pi)
    ratio = -upper[~still].real / size[~still]
    ax.plot(freq, ratio, marker, color=color, label=label, markersize=7, fillstyle="none")
    unstable: dict[str, Any] = {"color": RED, "markersize": 11, "fillstyle": "none"}
    ax.plot(freq[ratio < 0], ratio[ratio < 0], marker, **unstable)
