"""Pictures of an identification; picking poles by eye in a stabilisation diagram."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from ..arrays import ComplexArray, FloatArray
from ..errors import FlexplantError, ModelError
from ..identification import IdentifiedModes, StabilisationDiagram, identify_modes
from ..identification.diagram import PoleSelection
from ..lti.frequency import Frf
from ..words import instance
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
    """Draw poles over model orders; columns of crosses are modes.

    Parameters
    ----------
    diagram : StabilisationDiagram
        What to choose poles from.
    frf : Frf, optional
        Its sum over all channels is drawn behind.
    ax : Axes, optional

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
    if frf is not None and not given:  # beside is the ordinate of the responses
        ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
        given = None
    return finish(ax, x="frequency [Hz]", y="model order", given=given)


def identified(
    frf: Frf, modes: IdentifiedModes, output: str, input: str, *, ax: Axes | None = None
) -> Axes:
    """Draw a measured response, the identified one and what is left between them.

    Parameters
    ----------
    frf : Frf
    modes : IdentifiedModes
        Identified from it.
    output, input : str
    ax : Axes, optional

    Returns
    -------
    Axes
        Displacement per input; a dotted line at every pole, the standard deviation of the
        measurement in grey where known.

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


#: lines of the table of poles: more do not fit beside the diagram
_LISTED = 16


class PolePicker:
    """A window in which poles are picked: `selection` for scripts, `modes` for a first look.

    A click with the left button takes the pole nearest in frequency, one with the right button
    gives the nearest pole back. Beneath the diagram the sum of all measured responses stands beside
    that of the modes picked; at its right are frequencies, damping ratios and the shape of the pole
    that was picked last. Keep the picker while its window is open: matplotlib holds it weakly.

    Parameters
    ----------
    diagram : StabilisationDiagram
        What poles are picked from.
    frf : Frf
    **options
        For `identify_modes`, by which picked modes are fitted: ``hold=``, ``lower=``, ...

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.arange(10.0, 40.0, 0.1)
    >>> frf = fx.Frf(freq, (1 / (20.0**2 - freq**2 + 0.4j * freq))[None, None])
    >>> picker = fx.plot.PolePicker(fx.identification.stabilisation_diagram(frf), frf)
    >>> picker.pick(20.1)  # as a click there does
    >>> fx.identify_modes(frf, start=picker.selection).freq.round(3)
    array([20.])
    """

    def __init__(self, diagram: StabilisationDiagram, frf: Frf, **options: Any) -> None:
        instance(
            diagram, StabilisationDiagram, "diagram", "Pass what stabilisation_diagram returned."
        )
        instance(frf, Frf, "frf", "Pass the FRF that the diagram was made of.")
        self.diagram, self.frf, self.options = diagram, frf, options
        self.picked: list[float] = []
        self._selection: PoleSelection | None = None
        self.modes: IdentifiedModes | None = None
        self.figure = plt.figure(figsize=(13.0, 8.0), layout="constrained")
        grid = self.figure.add_gridspec(2, 2, width_ratios=[3.0, 1.0])
        top: Axes = self.figure.add_subplot(grid[0, 0])
        self.axes = (top, self.figure.add_subplot(grid[1, 0], sharex=top))
        self.aside = (self.figure.add_subplot(grid[0, 1]), self.figure.add_subplot(grid[1, 1]))
        stabilisation(diagram, ax=top)
        self._marks: list[Any] = []
        self.figure.canvas.mpl_connect("button_press_event", self._clicked)
        self._drawn()

    @property
    def selection(self) -> PoleSelection:
        """The poles picked, as ``identify_modes(frf, start=...)`` takes them."""
        if self._selection is None:
            raise ModelError("no pole is picked: click into the diagram, or call pick(freq).")
        return self._selection

    def pick(self, freq: float) -> None:
        """Take the pole nearest to a frequency [Hz]; ModelError when none lies within 3 %."""
        self._take([*self.picked, float(freq)])

    def drop(self, freq: float) -> None:
        """Give the picked pole back that is nearest to a frequency [Hz]."""
        if self.picked:
            nearest = int(np.argmin(np.abs(np.array(self.picked) - freq)))
            self._take([one for i, one in enumerate(self.picked) if i != nearest])

    def _take(self, freq: list[float]) -> None:
        """Select poles at frequencies and fit the responses with them."""
        selection = self.diagram.select(freq) if freq else None
        band = float(self.diagram.band[0]), float(self.diagram.band[1])
        given: dict[str, Any] = {"band": band, "refine": False} | self.options
        self.modes = None
        if selection is not None:
            self.modes = identify_modes(self.frf, start=selection, **given)
        self._selection, self.picked = selection, freq
        self._drawn()

    def _clicked(self, event: Any) -> None:
        """Pick or drop a pole; what cannot be is said in the title."""
        over = {ax.bbox.bounds for ax in self.axes}
        toolbar = getattr(self.figure.canvas, "toolbar", None)
        if event.inaxes is None or event.inaxes.bbox.bounds not in over:
            return
        if toolbar is not None and toolbar.mode:  # the mouse zooms or moves the picture
            return
        try:
            if event.button == 1:
                self.pick(event.xdata)
            elif event.button == 3:
                self.drop(event.xdata)
        except FlexplantError as error:
            self.figure.suptitle(str(error).split(":")[0], fontsize="medium", color=ORANGE)
            self.figure.canvas.draw_idle()

    def _drawn(self) -> None:
        """Draw what is picked."""
        for mark in self._marks:
            mark.remove()
        modes = self.modes
        found = [] if modes is None else modes.freq.tolist()
        self._marks = [
            self.axes[0].axvline(one, color=ORANGE, linewidth=0.9, zorder=1.0) for one in found
        ]
        self._responses()
        table, shape = self.aside
        for ax in self.aside:
            ax.clear()
        table.axis("off")
        if modes is None:
            shape.axis("off")
            rows = ["left click: take a pole", "right click: give one back"]
        else:
            self._shape(shape, modes)
            rows = ["      Hz     damping"]
            rows += [
                f"{freq:8.5g}   {100 * zeta:7.3g} %"
                for freq, zeta in zip(found[:_LISTED], modes.zeta.tolist(), strict=False)
            ]
        if len(found) > _LISTED:
            rows.append(f"... and {len(found) - _LISTED} more")
        table.text(0.0, 1.0, "\n".join(rows), va="top", family="monospace", fontsize="small")
        self.figure.suptitle("")
        self.figure.canvas.draw_idle()

    def _responses(self) -> None:
        """Draw the sum of all responses, measured and of the modes picked."""
        ax, frf = self.axes[1], self.frf
        if frf.quantity is not None:
            frf = frf.converted("displacement")
        band = self.diagram.band
        inside = (frf.freq >= band[0]) & (frf.freq <= band[1]) & (frf.freq > 0)
        size = np.abs(frf.data[:, :, inside]).sum(axis=(0, 1))
        ax.clear()
        factor, unit = shown_in(ax.yaxis, float(size.max(initial=0.0)), shared_unit(frf))
        ax.semilogy(frf.freq[inside], size / factor, label="measured", **STYLES["measured"])
        if self.modes is not None:
            own = self.modes.frf(frf.freq[inside], as_measured=True)
            sum_of_all = np.abs(own.data).sum(axis=(0, 1)) / factor
            style = STYLES["model"] | {"linestyle": "--"}
            ax.semilogy(frf.freq[inside], sum_of_all, label="of the poles picked", **style)
        ax.legend(frameon=False, fontsize="small")
        ax.set_xlim(float(band[0]), float(band[1]))
        finish(ax, x="frequency [Hz]", y=named("sum of all |FRF|", unit))

    def _shape(self, ax: Axes, modes: IdentifiedModes) -> None:
        """Draw the shape of the pole picked last, turned to be as real as it can be."""
        last = int(np.argmin(np.abs(modes.freq - self.picked[-1])))
        shape = np.asarray(modes.shapes)[:, last]
        turned = (shape * np.exp(-0.5j * np.angle(np.sum(shape**2)))).real
        turned = turned / np.abs(turned).max()
        names = list(modes.outputs)
        ax.barh(range(len(names)), turned, color=STYLES["model"]["color"])
        ax.axvline(0.0, color=LIGHT, linewidth=0.8)
        ax.set_yticks(range(len(names)), names, fontsize="small")
        ax.invert_yaxis()
        ax.set_xlim(-1.1, 1.1)
        ax.set_title(f"shape at {modes.freq[last]:.5g} Hz", fontsize="medium")
