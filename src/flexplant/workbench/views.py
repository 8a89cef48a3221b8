"""Views: the pictures of the page as Bokeh figures, and the actions of the mouse in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..synthesis import Notch, ShapedAxis
from ..tolerances import DEVIATIONS, TINY
from .controls import name_of, with_element
from .evaluation import AxisLoop
from .verdict import LoopLimits

#: colours that differ in brightness too: the loop, its second curve, the worst machine,
#: forbidden areas, and the model of a measured plant
BLUE, ORANGE, RED, GREEN, GREY = "#0B6FB8", "#D98200", "#C23B22", "#2A8C55", "#9AA3AD"
#: earlier designs, the latest first
KEPT = ("#8C6BB1", "#B4935A", "#6AA39B", "#B77E96")
#: number of points of a pale curve; its peaks are kept
_PALE = 360
#: range of a gain below its largest value that is worth drawing [dB]
_DEPTH = 120.0
#: range of a Nyquist picture around the critical point
_NYQUIST = (-2.6, 1.2), (-1.9, 1.9)
#: a curve beyond this is drawn on its edge, so that no line crosses the picture
_EDGE = 60.0


def magnitude_db(value: Any) -> FloatArray:
    """Return magnitudes in dB."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(value), TINY)))


def thinned(freq: FloatArray, values: FloatArray, points: int = _PALE) -> tuple[Any, Any]:
    """Return a curve of fewer points that keeps the largest of each part, in order."""
    if freq.size <= points:
        return freq, values
    step = -(-2 * freq.size // points)
    parts = freq.size // step
    highest = np.argmax(values[: parts * step].reshape(parts, step), axis=1)
    starts = np.arange(0, freq.size, step)
    keep = np.union1d(np.append(starts, freq.size - 1), starts[:parts] + highest)
    return freq[keep], values[keep]


def gapped_line(curves: Sequence[tuple[Any, Any]]) -> dict[str, Any]:
    """Return curves as one line with gaps: one array to send for all machines."""
    gap = np.array([np.nan])
    x = [part for f, _ in curves for part in (f, gap)]
    y = [part for _, v in curves for part in (v, gap)]
    empty = np.zeros(0)
    return {"x": np.concatenate(x) if x else empty, "y": np.concatenate(y) if y else empty}


class Views:
    """The figures of one axis; `update` gives them new data."""

    def __init__(self, limits: LoopLimits) -> None:
        from bokeh.models import ColumnDataSource, Range1d

        self.sources: dict[str, ColumnDataSource] = {}
        self._drawn: dict[str, Any] = {}
        self.freq_range = Range1d(1.0, 1e3)
        self.figures: dict[str, Any] = {}
        for name, title in (
            ("magnitude", "loop gain |L| [dB]"),
            ("phase", "phase of L [deg], without lines of noise"),
            ("S", "|S| blue, |T| orange [dB]"), ("KS", "|KS|: noise to command"),
            ("PS", "|PS|: force to motion"), ("coupling", "coupling |G_i / G_own| [dB]"),
        ):  # fmt: skip
            self.figures[name] = self._figure(title, height=170 if name == "phase" else 250)
        self.figures["magnitude"].height = 300
        self._magnitude()
        self._others()
        self._nyquist()
        self._time()
        self._budget()
        self.draw_limits(limits)

    def _figure(self, title: str, height: int = 250, freq: bool = True, **more: Any) -> Any:
        from bokeh.models import Range1d
        from bokeh.plotting import figure

        ranges = more
        if freq:
            y = Range1d(-60.0, 20.0)  # separate ranges: zooming stays while curves change
            ranges = {"x_range": self.freq_range, "x_axis_type": "log", "y_range": y}
        fig = figure(
            title=title, height=height, min_width=280, sizing_mode="stretch_width",
            tools="pan,wheel_zoom,box_zoom,reset", active_scroll="wheel_zoom",
            output_backend="canvas", **ranges,
        )  # fmt: skip
        fig.toolbar.logo = None
        fig.toolbar.autohide = True
        fig.title.text_font_size = "12px"
        fig.title.text_color = "#33404D"
        fig.title.offset = 2
        fig.axis.major_label_text_font_size = "11px"
        fig.axis.axis_label_text_font_size = "11px"
        fig.axis.axis_label_text_font_style = "normal"
        fig.axis.minor_tick_line_color = None
        fig.grid.grid_line_color = "#E7EAED"
        fig.outline_line_color = "#C9CFD5"
        fig.min_border = 4
        return fig

    def _source(self, key: str, /, **columns: Any) -> Any:
        from bokeh.models import ColumnDataSource

        given = columns or {"x": [], "y": []}
        return self.sources.setdefault(key, ColumnDataSource(data=given))

    def _line(
        self, figure: str, curve: str, color: str, width: float = 1.6, /, **look: Any
    ) -> None:
        """Draw a line of a separate source; the cursor reads the main one."""
        from bokeh.models import HoverTool

        fig, source = self.figures[figure], self._source(f"{figure} {curve}")
        drawn = fig.line("x", "y", source=source, color=color, line_width=width, **look)
        drawn.visible = curve == "main"  # the browser reads the style of each that is visible
        self._drawn[f"{figure} {curve}"] = drawn
        if curve == "main" and figure not in ("nyquist", "time"):
            tips = [("f", "@x{0.00} Hz"), ("", "@y{0.00}")]
            fig.add_tools(HoverTool(tooltips=tips, mode="vline", renderers=[drawn]))

    def _pale(self, figure: str) -> None:
        """Draw what lies behind the loop: machines, the worst, earlier designs."""
        self._line(figure, "fleet", GREY, 0.8, alpha=0.45)
        for i, color in enumerate(KEPT):
            self._line(figure, f"kept {i}", color, 1.3, alpha=0.55)
        self._line(figure, "model", GREEN, 1.3, line_dash="6 3")
        self._line(figure, "worst", ORANGE, 1.4)

    def _magnitude(self) -> None:
        from bokeh.models import PointDrawTool, Span

        fig = self.figures["magnitude"]
        band = self._source("band", x=[], low=[], high=[])
        fig.varea("x", "low", "high", source=band, color=BLUE, alpha=0.16)
        fig.add_layout(Span(location=0.0, dimension="width", line_color="#5B6670", line_width=1))
        self._pale("magnitude")
        self._line("magnitude", "main", BLUE, 1.9)
        marks = self._source("unresolved")
        fig.scatter("x", "y", source=marks, marker="x", size=8, color=RED, line_width=1.6)
        handles = self._source("handles", x=[], y=[], at=[], name=[])
        points = fig.scatter(
            "x", "y", source=handles, size=13, fill_color="#FFFFFF", line_color=RED, line_width=2,
            fill_alpha=0.9,
        )  # fmt: skip
        fig.text(
            "x", "y", text="name", source=handles, y_offset=-10, text_align="center",
            text_font_size="10px", text_color=RED,
        )  # fmt: skip
        tool = PointDrawTool(renderers=[points], add=False, drag=True, num_objects=0)
        fig.add_tools(tool)
        fig.toolbar.active_drag = tool
        phase = self.figures["phase"]
        level = {"dimension": "width", "line_color": "#5B6670", "line_width": 1}
        phase.add_layout(Span(location=-180.0, **level))
        self._pale("phase")
        self._line("phase", "main", BLUE, 1.7)
        phase.xaxis.axis_label = "frequency [Hz]"
        phase.y_range.start, phase.y_range.end = -380.0, 20.0
        phase.yaxis.ticker = [-360, -270, -180, -90, 0]

    def _others(self) -> None:
        from bokeh.models import Span

        for name in ("S", "KS", "PS"):
            self._pale(name)
            self._line(name, "main", BLUE, 1.8)
            self.figures[name].xaxis.axis_label = "frequency [Hz]"
        fig = self.figures["S"]
        fig.add_layout(Span(location=0.0, dimension="width", line_color="#5B6670", line_width=1))
        self._line("S", "T", ORANGE, 1.3)
        fig.y_range.start, fig.y_range.end = -60.0, 20.0
        for i, color in enumerate((BLUE, ORANGE, GREEN, "#8C6BB1", RED)):
            self._line("coupling", f"{i}", color, 1.2)
        self._line("coupling", "closed", "#33404D", 1.4, line_dash="5 3")
        self.figures["coupling"].xaxis.axis_label = "frequency [Hz]"

    def _nyquist(self) -> None:
        from bokeh.models import Range1d

        (left, right), (low, high) = _NYQUIST
        ranges = {"x_range": Range1d(left, right), "y_range": Range1d(low, high)}
        name = "Nyquist: L, closed by negative feedback"
        fig = self._figure(name, height=476, freq=False, match_aspect=True, **ranges)
        self.figures["nyquist"] = fig
        disc = self._source("disc", x=[], y=[])
        fig.patch("x", "y", source=disc, color=RED, alpha=0.13, line_color=RED, line_alpha=0.7)
        turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 181))
        fig.line(turn.real, turn.imag, color="#B9C1C9", line_dash="4 4")
        for margin in (0.25, 0.75):
            fig.line(-1.0 + margin * turn.real, margin * turn.imag, color="#E2B4AC", line_width=0.8)
        self._pale("nyquist")
        self._line("nyquist", "main", BLUE, 2.0)
        fig.scatter([-1.0], [0.0], marker="cross", size=14, color=RED, line_width=2)
        closest = self._source("closest", x=[], y=[], text=[])
        fig.scatter("x", "y", source=closest, size=8, color=BLUE)
        fig.text(
            "x", "y", text="text", source=closest, text_font_size="11px", text_color="#33404D",
            x_offset=8, y_offset=4,
        )  # fmt: skip

    def _time(self) -> None:
        from bokeh.models import Range1d

        ranges = {"x_range": Range1d(0.0, 1.0), "y_range": Range1d(-1.0, 1.0)}
        fig = self.figures["time"] = self._figure("error in time", freq=False, **ranges)
        for i, color in enumerate(KEPT):
            self._line("time", f"kept {i}", color, 1.2, alpha=0.55)
        self._line("time", "main", BLUE, 1.6)
        fig.xaxis.axis_label = "time [ms]"

    def _budget(self) -> None:
        from bokeh.models import FactorRange, Range1d

        source = self._source("budget", y=[], right=[], label=[])
        ranges = {"x_range": Range1d(0.0, 1.0), "y_range": FactorRange(factors=[""])}
        fig = self.figures["budget"] = self._figure("error by source (rms)", freq=False, **ranges)
        fig.hbar("y", right="right", height=0.7, source=source, color=BLUE, alpha=0.75)
        fig.text(
            0, "y", text="label", source=source, text_font_size="11px", x_offset=5,
            text_baseline="middle", text_color="#1D2730",
        )  # fmt: skip
        fig.ygrid.grid_line_color = None

    def draw_limits(self, limits: LoopLimits) -> None:
        """Draw forbidden areas: around -1, above the limit of |S|, and at low frequency."""
        from bokeh.models import BoxAnnotation

        turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 121)) / limits.peak
        self.sources["disc"].data = {"x": -1.0 + turn.real, "y": turn.imag}
        fig, level = self.figures["S"], 20.0 * np.log10(limits.peak)
        look = {"fill_color": RED, "fill_alpha": 0.13, "line_color": RED, "line_alpha": 0.5}
        if not hasattr(self, "_boxes"):
            self._boxes = [BoxAnnotation(**look) for _ in range(2)]
            for box in self._boxes:
                fig.add_layout(box)
        self._boxes[0].bottom = level
        low = limits.suppressed is not None and limits.below is not None
        self._boxes[1].visible = low
        if limits.suppressed is not None and limits.below is not None:
            self._boxes[1].right = limits.below
            self._boxes[1].bottom = 20.0 * np.log10(limits.suppressed)
            self._boxes[1].top = level

    def _put(self, key: str, /, **data: Any) -> None:
        source = self.sources[key]
        if key in self._drawn and self._drawn[key].visible != bool(len(data["x"])):
            self._drawn[key].visible = not self._drawn[key].visible
        same = "x" in data and data.keys() == source.data.keys()
        if same and np.array_equal(data["x"], source.data["x"]):
            for name in data.keys() - {"x"}:  # the rest only: frequencies stay as they are
                source.data[name] = data[name]
        else:
            source.data = data

    def update(self, loop: AxisLoop, axis: ShapedAxis, *, handles: bool = True) -> None:
        """Show a loop; the ranges of the axes do not change."""
        f, L = loop.freq, loop.L
        self._curves("main", loop)
        self._put("S T", x=f, y=magnitude_db(loop.T))
        if loop.deviation is not None:
            wide = DEVIATIONS * np.abs(loop.C) * loop.deviation
            # 60 dB below the largest value
            high, low = np.abs(L) + wide, np.maximum(np.abs(L) - wide, 1e-3 * np.abs(L))
            self._put("band", x=f, low=magnitude_db(low), high=magnitude_db(high))
        i = loop.machine.axes.names.index(loop.name)
        self._name_units(loop, i)
        marked = loop.machine.unresolved(i)
        self._put("unresolved", x=f[marked], y=magnitude_db(L[marked]))
        freq = loop.margins.freq
        closest = complex(np.interp(freq, f, L)) if np.isfinite(freq) else -1.0 + 0.0j
        self._put("closest", x=[closest.real], y=[closest.imag], text=[f"{freq:.4g} Hz"])
        if handles:
            self._handles(loop, axis)

    def _name_units(self, loop: AxisLoop, i: int) -> None:
        """Write what 0 dB is on the gains that have a unit."""
        plant = loop.machine.axes.plant
        force, motion = plant.units.get(plant.inputs[i]), plant.units.get(plant.outputs[i])
        known = bool(force and motion)
        for name, said, above, below in (
            ("KS", "|KS|: noise to command", force, motion),
            ("PS", "|PS|: force to motion", motion, force),
        ):
            zero = f"1 {_ratio(above or '', below or '')}" if known else "1 in SI units"
            self.figures[name].title.text = f"{said} [dB, 0 dB = {zero}]"

    def _handles(self, loop: AxisLoop, axis: ShapedAxis) -> None:
        """Show where elements can be dragged: on the curve at their frequency."""
        shown = [
            (float(freq), k, name_of(element))
            for k, (element, on) in enumerate(zip(axis.elements, axis.on, strict=True))
            if on and (freq := getattr(element, "freq", None)) is not None
            and loop.freq[0] <= freq <= loop.freq[-1]
        ]  # fmt: skip
        x = [freq for freq, _, _ in shown]
        y = np.interp(x, loop.freq, magnitude_db(loop.L)) if x else np.zeros(0)
        at, names = [k for _, k, _ in shown], [name for _, _, name in shown]
        self._put("handles", x=x, y=list(y), at=at, name=names)

    def _curves(self, name: str, loop: AxisLoop) -> None:
        """Show all curves of a loop under a name."""
        f, L = loop.freq, loop.L
        for figure, gain in {"magnitude": L, "S": loop.S, "KS": loop.KS, "PS": loop.PS}.items():
            self._put(f"{figure} {name}", x=f, y=magnitude_db(gain))
        self._put(f"phase {name}", x=f, y=_wrapped(L))
        near = L * np.minimum(1.0, _EDGE / np.maximum(np.abs(L), TINY))
        if name == "main":  # on the wrong side of -1
            color = RED if loop.is_stable is False else BLUE
            self._drawn["nyquist main"].glyph.line_color = color
        self._put(f"nyquist {name}", x=near.real, y=near.imag)

    def show_other(self, name: str, loop: AxisLoop | None) -> None:
        """Show or hide the curves of another loop: kept 0, model, worst."""
        if loop is not None:
            self._curves(name, loop)
            return
        for figure in ("magnitude", "phase", "S", "KS", "PS", "nyquist"):
            self._put(f"{figure} {name}", x=[], y=[])

    def show_fleet(self, loops: Sequence[AxisLoop]) -> None:
        """Show all machines in pale."""
        pick: Mapping[str, Callable[[AxisLoop], Any]] = {
            "magnitude": lambda one: thinned(one.freq, magnitude_db(one.L)),
            "S": lambda one: thinned(one.freq, magnitude_db(one.S)),
            "nyquist": lambda one: _visible_part(one),
        }
        for figure, curve in pick.items():
            self._put(f"{figure} fleet", **gapped_line([curve(one) for one in loops]))

    def show_coupling(
        self, freq: FloatArray, others: Mapping[str, FloatArray], loop: AxisLoop
    ) -> None:
        """Show how the axis moves the others, and how their loops change its response."""
        for k, values in enumerate(list(others.values())[:5]):
            self._put(f"coupling {k}", x=freq, y=magnitude_db(values))
        i = loop.machine.axes.names.index(loop.name)
        own = loop.machine.G[i, i]
        self._put("coupling closed", x=freq, y=magnitude_db(loop.others.G / own - 1.0))
        names = ", ".join(list(others)[:3])
        self.figures["coupling"].title.text = f"to {names}; dashed: by their loops [dB]"

    def show_time(self, name: str, time: Any, error: Any, label: str = "") -> None:
        """Show the error over time [s]; the range contains the main curve."""
        x, y = 1e3 * np.asarray(time), np.asarray(error)
        self._put(f"time {name}", x=x, y=y)
        if name != "main":
            return
        fig = self.figures["time"]
        fig.title.text = label or "error in time: none"
        if x.size:
            low, high = min(float(y.min()), 0.0), max(float(y.max()), 0.0)
            room = 0.06 * ((high - low) or 1.0)
            fig.x_range.end = float(x[-1])
            fig.y_range.start, fig.y_range.end = low - room, high + room

    def show_budget(self, rms: Mapping[str, float], unit: str) -> None:
        """Show the sources of the error as bars, the largest on top."""
        names, values = list(rms)[::-1], list(rms.values())[::-1]
        fig = self.figures["budget"]
        fig.y_range.factors = names or [""]
        fig.x_range.end = 1.05 * max(values, default=1.0) or 1.0
        fig.title.text = f"error by source, rms [{unit}]"
        self._put("budget", y=names, right=values, label=[f"{value:.3g}" for value in values])

    def fit(self, loop: AxisLoop) -> None:
        """Set all ranges for a loop, at the start and by a button."""
        f = loop.freq
        first = next(iter(loop.margins.crossovers), f[0])
        low = f[0] if loop.machine.is_measured else max(f[0], 0.02 * first)
        self.freq_range.start, self.freq_range.end = float(low), float(f[-1])
        inside = f >= low
        for name, values in (("magnitude", loop.L), ("KS", loop.KS), ("PS", loop.PS)):
            size = magnitude_db(values[inside])
            top, bottom = float(size.max()) + 6.0, float(max(size.min(), size.max() - _DEPTH))
            if name == "magnitude":
                top, bottom = min(top, 90.0), max(bottom, -110.0)
            fig = self.figures[name]
            fig.y_range.start, fig.y_range.end = bottom - 4.0, top
        fig = self.figures["nyquist"]
        (fig.x_range.start, fig.x_range.end), (fig.y_range.start, fig.y_range.end) = _NYQUIST


def _ratio(above: str, below: str) -> str:
    """Return the unit of a ratio: N/m, N m/rad, m/(N m), (m/s^2)/m."""
    top = f"({above})" if "/" in above else above
    return f"{top}/({below})" if set(" /") & set(below) else f"{top}/{below}"


def _wrapped(L: Any) -> FloatArray:
    """Return the phase between -360 and 0 deg, with gaps where it is wrapped or noise."""
    phase = -np.mod(-np.degrees(np.angle(L)), 360.0)
    jump = np.abs(np.diff(phase, prepend=phase[:1])) > 270.0
    return np.asarray(np.where(jump | _is_noise(L), np.nan, phase))


#: lines among which the middle change of the phase tells noise from a loop, and that change [deg]:
#: of noise it is 90 deg on average, at a resonance few lines change by more than 45 deg
_AMONG, _TURNED = 21, 45.0


def _is_noise(L: Any) -> NDArray[np.bool_]:
    """Return where the phase of most neighbouring lines is random."""
    from scipy.ndimage import median_filter

    ratio = L[1:] * np.conj(L[:-1])
    turned = np.abs(np.degrees(np.angle(np.append(ratio, ratio[-1:]))))
    return np.asarray(median_filter(turned, _AMONG, mode="nearest") > _TURNED)


def _visible_part(loop: AxisLoop) -> tuple[Any, Any]:
    """Return the part of a Nyquist curve that the picture shows, of fewer points."""
    L = loop.L[np.abs(loop.L) < 4.0]
    step = max(1, L.size // _PALE)
    return L.real[::step], L.imag[::step]


#: distance from the mouse within which a handle or curve is picked, relative to the picture
_NEAR = 0.06


class Gestures:
    """Dragging and clicking in the pictures of a page."""

    def __init__(self, page: Any) -> None:
        self.page = page
        #: element that is dragged
        self.at: int | None = None
        self._height = 0.0

    def connect(self) -> None:
        """Connect the events of the mouse."""
        from bokeh.events import Pan, PanEnd, PanStart, Tap

        figure = self.page.views.figures["magnitude"]
        figure.on_event(PanStart, self.grasp)
        figure.on_event(Pan, self.drag)
        figure.on_event(PanEnd, self.drop)
        for name in ("magnitude", "S"):
            self.page.views.figures[name].on_event(Tap, partial(self.tap, name))

    def _distances(self, x: float, y: float, xs: Any, ys: Any) -> Any:
        """Return distances to points of the magnitude picture, relative to its size."""
        fig, span = self.page.views.figures["magnitude"], self.page.views.freq_range
        wide = np.log(span.end / span.start)
        tall = fig.y_range.end - fig.y_range.start
        return np.hypot(np.log(np.asarray(xs) / x) / wide, (np.asarray(ys) - y) / tall)

    def grasp(self, event: Any) -> None:
        """Begin to drag the handle next to the mouse, if there is one."""
        handles = self.page.views.sources["handles"].data
        self.at = None
        if event.x is None or event.x <= 0.0 or not len(handles["x"]):
            return
        distance = self._distances(event.x, event.y, handles["x"], handles["y"])
        nearest = int(np.argmin(distance))
        if distance[nearest] < _NEAR:
            self.at = int(handles["at"][nearest])
            self._height = event.y

    def drag(self, event: Any) -> None:
        """Move the dragged element: its frequency sideways, the depth of a notch up and down."""
        if self.at is None or event.x is None or not 0.0 < event.x < self.page.bench.top:
            return
        axis = self.page.design.axes[self.page.axis]
        element: Any = axis.elements[self.at].replace(freq=float(f"{event.x:.4g}"))
        if isinstance(element, Notch):  # up and down: its depth
            depth = element.depth * 10.0 ** ((event.y - self._height) / 20.0)
            # as with its slider
            element = element.replace(depth=float(f"{min(max(depth, 1e-3), 10.0):.3g}"))
        self._height = event.y
        self.page.change_axis(with_element(axis, self.at, element), ("drag", self.at), True)

    def drop(self, event: Any) -> None:
        """End the dragging of an element."""
        if self.at is not None:
            self.drag(event)
        self.at = None
        self.page.soon()

    def tap(self, name: str, event: Any) -> None:
        """Show the machine of a fleet whose curve is clicked."""
        if len(self.page.bench.machines) < 2 or event.x is None or event.x <= 0.0:
            return
        fig = self.page.views.figures[name]
        tall = fig.y_range.end - fig.y_range.start
        distances = []
        for loop in self.page.fleet:
            curve = magnitude_db(loop.L if name == "magnitude" else loop.S)
            distances.append(abs(float(np.interp(event.x, loop.freq, curve)) - event.y) / tall)
        nearest = int(np.argmin(distances))
        if distances[nearest] < _NEAR:
            self.page.machines.value = nearest
