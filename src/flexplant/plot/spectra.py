"""Spectra of signals side by side: predicted and found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..errors import ModelError
from ..loop import ClosedLoop, Spectrum
from ..simulation import Response
from ..values import short
from ._axes import axes, finish, legend, named, shown_in
from ._style import styles
from .gains import by_label


def spectra(
    found: Any,
    channel: str | None = None,
    *,
    unit: str | None = None,
    colors: Mapping[str, str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw amplitude spectral densities, such as those of a loop and of its run.

    Parameters
    ----------
    found : ClosedLoop, Response, Spectrum, or mapping {label: one of these}
        Of one signal.
    channel : str, optional
        Which signal of loops and runs; a Spectrum, from `loop.psd(channel)`, is of one already.
    unit : str, optional
        SI unit of the signal; that of the channel when not given.
    colors : mapping {label: color}, optional
        Of some lines.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        The roots of the one-sided densities.

    Raises
    ------
    ModelError
        When there is nothing that has a spectrum, or no channel is named.
    LabelError
        When there is no such channel.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> fx.plot.spectra({"model": loop}, "die:error").get_ylabel()
    'amplitude spectral density [nm/√Hz]'
    """
    named_ones = by_label(found, Response)
    spectra_of = {label: _spectrum(one, channel) for label, one in named_ones.items()}
    known = [getattr(one, "units", {}).get(channel) for one in named_ones.values()]
    unit = unit or next(filter(None, known), None)
    lines = {k: (s.freq[s.freq > 0], np.sqrt(s.psd[s.freq > 0])) for k, s in spectra_of.items()}
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.2))
    largest = float(max(size.max(initial=0.0) for _, size in lines.values()))
    density = f"{unit}/\N{SQUARE ROOT}Hz" if unit else None
    factor, shown = shown_in(ax.yaxis, largest, density)
    shown = shown or "SI unit/\N{SQUARE ROOT}Hz"
    for (label, (freq, size)), look in zip(lines.items(), styles(lines, colors), strict=True):
        ax.loglog(freq, size / factor, label=label or None, **look)
    legend(ax, given=given)
    return finish(ax, x="frequency [Hz]", y=named("amplitude spectral density", shown))


def _spectrum(one: Any, channel: str | None) -> Spectrum:
    if isinstance(one, Spectrum):
        return one
    if not isinstance(one, ClosedLoop | Response):
        raise ModelError(
            f"a loop, a run or the spectrum of one has a density to draw, got {short(one)}. Pass "
            "{'model': loop, 'measured': run}, 'die:error'."
        )
    if channel is None:
        raise ModelError(f"which signal? {list(one.units)[:6]} are there: name a channel.")
    return one.psd(channel)
