"""Singular values of a response over frequency."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..values import FloatArray
from ._axes import axes, finish, legend
from .gains import curves, decibel, readable, shared_reference

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
