"""Pictures of an identification: the stabilisation diagram, and the responses it explains."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..identification import IdentifiedModes, StabilisationDiagram
from ..lti.frequency import Frf
from ..values import instance
from ._axes import DIFFERENCE, MARK, MEASURED, UPDATED, axes, finish

#: marker, colour and legend of the flags 0 to 3
_MARKS = (
    (".", "0.7", "new"),
    ("o", DIFFERENCE, "frequency"),
    ("d", UPDATED, "and damping"),
    ("+", MARK, "and shape: stable"),
)


def stabilisation(
    diagram: StabilisationDiagram, *, frf: Frf | None = None, ax: Axes | None = None
) -> Axes:
    """Draw poles over model orders; columns of crosses are modes.

    Parameters
    ----------
    diagram : StabilisationDiagram
        What to choose poles from.
    frf : Frf, optional
        Its sum over all channels is drawn behind.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
    """
    instance(diagram, StabilisationDiagram, "diagram", "Pass what stabilisation_diagram returned.")
    ax = axes(ax, figsize=(9.0, 5.0))
    for flag, (marker, color, label) in enumerate(_MARKS):
        mine = diagram.flags == flag
        ax.plot(
            diagram.freq[mine], diagram.orders[mine], marker, color=color, label=label, markersize=5
        )
    ax.set_xlim(float(diagram.band[0]), float(diagram.band[1]))
    if frf is not None:
        behind = ax.twinx()
        assert isinstance(behind, Axes)  # noqa: S101 - of the same class as ax
        size = np.sum(np.abs(frf.data), axis=(0, 1))
        behind.semilogy(frf.freq, size, color="0.5", linewidth=0.8)
        behind.set_ylabel("sum of |FRF|")
    ax.legend(frameon=False, loc="upper right")
    return finish(ax, x="frequency [Hz]", y="model order")


def identified(
    frf: Frf,
    modes: IdentifiedModes,
    output: str,
    input: str,
    *,
    ax: Axes | None = None,
) -> Axes:
    """Draw a measured response, the identified one and what is left between them.

    Parameters
    ----------
    frf : Frf
        The measurement.
    modes : IdentifiedModes
        Identified from it.
    output, input : str
        The channel.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Displacement per input; a dotted line at every pole, the standard deviation of the
        measurement in grey where known.
    """
    instance(modes, IdentifiedModes, "modes", "Pass what identify_modes returned.")
    ax = axes(ax, figsize=(9.0, 5.0))
    if frf.quantity is not None:
        frf = frf.converted("displacement")
    band = modes.freq.min() * 0.8, max(modes.top, float(modes.freq.max()))
    inside = (frf.freq >= band[0]) & (frf.freq <= band[1])
    freq = frf.freq[inside]
    known, fit = frf[output, input][inside], modes.frf(freq)[output, input]
    ax.semilogy(freq, np.abs(known), color=MEASURED, label="measured", linewidth=1.4)
    ax.semilogy(freq, np.abs(fit), "--", color=UPDATED, label="identified", linewidth=1.1)
    ax.semilogy(freq, np.abs(known - fit), color=DIFFERENCE, label="difference", linewidth=0.7)
    if frf.variance is not None:
        place = list(frf.outputs).index(output), list(frf.inputs).index(input)
        deviation = np.sqrt(frf.variance[place][inside])
        ax.semilogy(freq, deviation, color="0.6", label="standard deviation", linewidth=0.7)
    for pole in modes.freq.tolist():
        ax.axvline(pole, color="0.8", linestyle=":", linewidth=0.8)
    ax.legend(frameon=False)
    ax.set_xlim(float(freq[0]), float(freq[-1]))
    return finish(ax, x="frequency [Hz]", y=f"|{output} / {input}| [m per unit]")
