"""Spectra of signals side by side: predicted and found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..errors import ModelError
from ..loop import Spectrum
from ..values import short
from ._axes import axes, finish, legend, named, shown_in
from ._style import styles


def spectra(
    found: Mapping[str, Spectrum],
    *,
    unit: str | None = None,
    colors: Mapping[str, str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw amplitude spectral densities, such as those of a loop and of its run.

    Parameters
    ----------
    found : mapping {label: Spectrum}
        From `loop.psd(channel)` and `run.psd(channel)`: of one signal.
    unit : str, optional
        SI unit of the signal.
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
        When there is no mapping of spectra.
    """
    wrong: Any = found
    if isinstance(found, Mapping):
        wrong = next((one for one in found.values() if not isinstance(one, Spectrum)), None)
    if not found or wrong is not None:
        raise ModelError(
            f"need a mapping of labels to spectra, got {short(wrong or found)}. Pass {{'model': "
            "loop.psd('die:error'), 'measured': run.psd('die:error')}."
        )
    lines = {str(k): (s.freq[s.freq > 0], np.sqrt(s.psd[s.freq > 0])) for k, s in found.items()}
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.2))
    largest = float(max(size.max(initial=0.0) for _, size in lines.values()))
    density = f"{unit}/\N{SQUARE ROOT}Hz" if unit else None
    factor, shown = shown_in(ax.yaxis, largest, density)
    for (label, (freq, size)), look in zip(lines.items(), styles(lines, colors), strict=True):
        ax.loglog(freq, size / factor, label=label, **look)
    legend(ax, given=given)
    return finish(ax, x="frequency [Hz]", y=named("amplitude spectral density", shown))
