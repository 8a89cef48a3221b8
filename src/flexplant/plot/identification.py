"""Pictures of an identification; picking poles by eye in a stabilisation diagram."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..arrays import ComplexArray, FloatArray, instance
from ..identification import IdentifiedModes, StabilisationDiagram
from ..lti.frequency import Frf
from ._axes import (
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    STYLES,
    Style,
    axes,
    finish,
    named,
    shared_unit,
    shown_in,
)

#: marker, colour and legend of the flags 0 to 3
_MARKS = (
    (".", GREY, "new"),
    ("o", ORANGE, "steady frequency"),
    ("d", BLUE, "and damping"),
    ("+", RED, "and shape: stable"),
)


def stabilisation(
    diagram: StabilisationDiagram, *, frf: Frf | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the poles of models of increasing order; a column of crosses is a mode.

    Parameters
    ----------
    diagram : StabilisationDiagram
        Result of `flexplant.identification.stabilisation_diagram`.
    frf : Frf, optional
        Response whose sum over all channels is drawn in the background.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.arange(10.0, 40.0, 0.1)
    >>> frf = fx.Frf(freq, (1 / (20.0**2 - freq**2 + 0.4j * freq))[None, None])
    >>> ax = fx.plot.stabilisation(fx.identification.stabilisation_diagram(frf), frf=frf)
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    instance(diagram, StabilisationDiagram, "diagram", "Pass what stabilisation_diagram returned.")
    given: bool | None = ax is not None
    ax = axes(ax, figsize=(10.0, 5.0))
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
        inside = (frf.freq >= diagram.band[0]) & (frf.freq <= diagram.band[1])
        factor, unit = shown_in(
            behind.yaxis, float(np.max(size[inside], initial=0.0)), shared_unit(frf)
        )
        behind.semilogy(frf.freq[inside], size[inside] / factor, color=GREY, linewidth=0.8)
        behind.set_ylabel(named("sum of all |FRF|", unit))
    if frf is not None and not given:  # the other ordinate is that of the responses
        ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
        given = None
    return finish(ax, x="frequency [Hz]", y="model order", given=given)


def identified(
    frf: Frf, modes: IdentifiedModes, output: str, input: str, *, ax: Axes | None = None
) -> Axes:
    """Draw a measured response, the identified one and their difference.

    Parameters
    ----------
    frf : Frf
        Measured frequency responses.
    modes : IdentifiedModes
        Modes that were identified from it.
    output, input : str
        Names of the output and the input that are drawn.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes with displacement per input. A dotted line marks every pole, and the standard deviation
        of the measurement is grey where it is known.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.arange(10.0, 40.0, 0.1)
    >>> frf = fx.Frf(freq, (1 / (20.0**2 - freq**2 + 0.4j * freq))[None, None])
    >>> ax = fx.plot.identified(frf, fx.identify_modes(frf), frf.outputs[0], frf.inputs[0])
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    instance(modes, IdentifiedModes, "modes", "Pass what identify_modes returned.")
    given, ax = ax is not None, axes(ax, figsize=(10.0, 5.0))
    if frf.quantity is not None:
        frf = frf.converted("displacement")
    band = modes.freq.min() * 0.8, max(modes.top, float(modes.freq.max()))
    inside = (frf.freq >= band[0]) & (frf.freq <= band[1])
    freq = frf.freq[inside]
    known, fit = frf[output, input][inside], modes.frf(freq, as_measured=True)[output, input]
    factor, unit = shown_in(ax.yaxis, float(np.max(np.abs(known))), frf.unit(output, input))

    def draw(values: FloatArray | ComplexArray, label: str, style: Style) -> None:
        ax.semilogy(freq, np.abs(values) / factor, label=label, **style)

    draw(known, "measured", STYLES["measured"])
    draw(fit, "identified", STYLES["model"] | {"linestyle": "--"})
    draw(known - fit, "difference", STYLES["difference"] | {"linestyle": "-", "linewidth": 0.7})
    if frf.variance is not None:
        place = list(frf.outputs).index(output), list(frf.inputs).index(input)
        deviation = np.sqrt(frf.variance[place][inside])
        draw(deviation, "standard deviation", {"color": GREY, "linewidth": 1.2, "linestyle": "--"})
    for pole in modes.freq.tolist():
        ax.axvline(pole, color=LIGHT, linestyle=":", linewidth=0.8, zorder=1.0)
    ax.set_xlim(float(freq[0]), float(freq[-1]))
    return finish(ax, x="frequency [Hz]", y=named(f"|{output} / {input}|", unit), given=given)
