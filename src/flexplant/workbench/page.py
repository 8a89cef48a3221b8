"""Page: one tab of the workbench, with its design, history and pictures."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Hashable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from ..errors import FlexplantError, in_unit
from ..synthesis import LoopDesign, Notch, ShapedAxis
from ..synthesis.laws.axis_law import MeasuredAxis
from .bench import Bench, DesignHistory, crossing_axis, first_axis
from .consequences import PERIOD, Consequences, Tuning
from .controls import ElementCards, Number, new_elements, parsed, with_new
from .evaluation import AxisLoop, BenchMachine, Evaluator, coupling
from .side import SideCards, given_file
from .verdict import (
    CARD,
    COMPACT,
    PAGE,
    SMALL,
    heading,
    headline,
    limit_verdicts,
    of_fleet,
    refusal,
    verdict_rows,
)
from .views import KEPT, Gestures, Views

#: delay before drawing, so that only the last of a burst of changes is drawn; delay before long
#: computations, until the sliders rest [ms]
_SOON, _LATER = 3, 350


class Page:
    """A tab. Every action changes its LoopDesign."""

    def __init__(self, bench: Bench) -> None:
        import panel as pn

        self.bench = bench
        self.limits = bench.limits
        self.history = DesignHistory(bench.design)  # a page that is loaded again continues
        self.axis = next(iter(bench.start.axes))
        self.index = 0
        self.kept: list[tuple[str, LoopDesign, Consequences | None]] = []
        self.loop: AxisLoop | None = None
        self.answer: Consequences | None = None
        self.tuning: Tuning | None = None
        self._evaluator = Evaluator()
        self._serial = self._working = self._answered = 0
        self._waiting: dict[str, Any] = {}
        self.gestures = Gestures(self)
        self._fitted = self._closed = False
        self._loaded = pn.state.curdoc is None or pn.state.curdoc.session_context is None
        self._doc = pn.state.curdoc
        self.views = Views(self.limits)
        self._widgets()
        self.side = SideCards(self)
        self.layout = self._layout()
        self._connect()
        self.show_controls()
        self.draw()

    # -- the parts of the page ------------------------------------------------------------------

    def _widgets(self) -> None:
        import panel as pn

        small: dict[str, Any] = SMALL | {"margin": (0, 3, 0, 0)}
        names = list(self.bench.start.axes)
        self.axes = pn.widgets.RadioButtonGroup(
            options=names, value=self.axis, color="primary", variant="outline", **small
        )
        self.closed = pn.widgets.CheckButtonGroup(
            options=names, value=[n for n, a in self.design.axes.items() if a.closed],
            color="primary", variant="outline", **small,
        )  # fmt: skip
        self.buttons = {
            name: pn.widgets.Button(label=text, variant="outline", description=tip, **small)
            for name, text, tip in (
                ("undo", "↶ undo", "one step back"), ("redo", "↷ redo", "one step forward"),
                ("keep", "keep to compare", "draw this design pale, with a button to return to it"),
                ("fit", "fit axes", "choose the ranges of all pictures again"),
            )
        }  # fmt: skip
        self.kept_row = pn.Row(margin=0)
        self.machines = pn.widgets.Select(
            options={m.name: i for i, m in enumerate(self.bench.machines)}, value=0, width=130,
            **small,
        )  # fmt: skip
        self.message, self.verdict, self.judged, self.further = (
            pn.pane.HTML("", sizing_mode="stretch_width", margin=(top, 0, 0, 0))
            for top in (0, 0, 3, 3)
        )
        self.message.visible = False
        gain = self.design.axes[self.axis].gain or 1.0
        self.gain = Number(
            "gain", "", abs(gain) / 20.0, abs(gain) * 20.0, gain, self._set_gain, self.refuse,
            lambda: self.design.axes[self.axis].gain,
        )  # fmt: skip
        self.crossover = pn.widgets.TextInput(
            placeholder="e.g. 60 Hz", width=86, margin=(0, 0, 6, 0), height=26,
            stylesheets=[COMPACT],
        )  # fmt: skip
        self.anew = pn.widgets.Button(
            label="new law", width=74, variant="outline", **small,
            description="PID and low-pass around this crossover, or well below the resonances",
        )  # fmt: skip
        self.cards = ElementCards(self.bench.top, self.change_axis, self.refuse)
        kinds = list(new_elements(100.0, self.bench.top))
        self.kind = pn.widgets.Select(
            options=kinds, value="notch", sizing_mode="stretch_width", **small
        )
        self.add = pn.widgets.Button(label="+ add", color="primary", width=70, **small)

    def _layout(self) -> Any:
        import panel as pn

        wide: dict[str, Any] = {"sizing_mode": "stretch_width"}

        def label(text: str) -> Any:
            html = f'<div style="font-size:11px;color:#5B6670;padding-top:6px">{text}</div>'
            return pn.pane.HTML(html, margin=(0, 5, 0, 6))

        fleet = [label("machine"), self.machines] if len(self.bench.machines) > 1 else []
        several = [label("closed"), self.closed] if len(self.bench.start.axes) > 1 else []
        name = pn.pane.HTML(
            '<div style="font-size:16px;font-weight:700;padding-top:3px">flexplant workbench</div>',
            margin=(0, 10, 0, 0),
        )
        head = pn.FlexBox(
            name, label("axis"), self.axes, *several, *fleet, *self.buttons.values(), self.kept_row,
            styles=CARD, margin=(0, 0, 6, 0), align_items="center", gap="4px 2px", **wide,
        )  # fmt: skip
        cross = pn.Row(label("crossover at"), self.crossover, self.anew, margin=0, **wide)
        law = pn.Column(
            pn.pane.HTML(heading("law of the axis"), margin=0), self.gain.row, cross,
            self.cards.column, pn.Row(self.kind, self.add, margin=0, **wide), styles=CARD,
            margin=(0, 0, 6, 0), **wide,
        )  # fmt: skip
        left = pn.Column(
            law, *self.side.cards, width=344, margin=(0, 8, 0, 0), styles={"flex": "0 0 344px"}
        )
        figures = self.views.figures

        def stack(*names: str, grow: str) -> Any:
            panes = [pn.pane.Bokeh(figures[n], margin=0, **wide) for n in names]
            return pn.Column(*panes, margin=0, styles=CARD | {"flex": grow, "padding": "2px"})

        pictures = pn.FlexBox(
            stack("magnitude", "phase", grow="1 1 430px"), stack("nyquist", grow="1 1 400px"),
            stack("S", grow="1 1 300px"), stack("KS", grow="1 1 280px"),
            stack("PS", grow="1 1 280px"), stack("time", grow="1 1 300px"),
            *([stack("budget", grow="1 1 300px")] if self.bench.question.plant else []),
            *([stack("coupling", grow="1 1 280px")] if len(self.bench.start.axes) > 1 else []),
            gap="6px", **wide,
        )  # fmt: skip
        verdict = pn.Column(
            self.message, self.verdict, self.judged, self.further, styles=CARD,
            margin=(0, 0, 6, 0), **wide,
        )  # fmt: skip
        right = pn.Column(verdict, pictures, margin=0, styles={"flex": "1 1 420px"})
        body = pn.FlexBox(left, right, flex_wrap="wrap", align_items="flex-start", **wide)
        return pn.Column(head, body, styles=PAGE, margin=0, sizing_mode="stretch_width")

    def _connect(self) -> None:
        import panel as pn

        self.axes.param.watch(self._other_axis, "value")
        self.closed.param.watch(self._switch_loops, "value")
        self.machines.param.watch(self._other_machine, "value")
        self.crossover.param.watch(self._cross_at, "value")
        self.buttons["undo"].on_click(lambda _: self._go(self.history.back()))
        self.buttons["redo"].on_click(lambda _: self._go(self.history.forward()))
        self.buttons["keep"].on_click(lambda _: self._keep())
        self.buttons["fit"].on_click(lambda _: self._fit())
        self.anew.on_click(lambda _: self.start_anew())
        self.add.on_click(lambda _: self._add())
        self.gestures.connect()
        if pn.state.curdoc is not None and pn.state.curdoc.session_context:
            pn.state.on_session_destroyed(lambda _: self.close())
            pn.state.onload(self._begin)

    # -- the design and its changes -------------------------------------------------------------

    @property
    def design(self) -> LoopDesign:
        """The present design."""
        return self.history.now

    def take(self, design: LoopDesign, key: Hashable = None, *, cards: bool = True) -> None:
        """Accept a changed design if its control laws exist; show the reason otherwise."""
        try:
            design.laws  # noqa: B018 - an element above half the rate is refused here
        except FlexplantError as problem:
            self.refuse(str(problem))
            return
        self.history.add(design, key)
        if cards:
            self.show_controls()
        self.soon()

    def refuse(self, text: str) -> None:
        """Show an error; the last valid design stays."""
        self.message.object = refusal(text)
        self.message.visible = True

    def change_axis(self, axis: ShapedAxis, key: Hashable, cards: bool) -> None:
        """Accept a changed axis; changes with one key are one step, `cards` rebuilds the cards."""
        design = self.design.with_axis(self.axis, axis)
        self.take(design, None if key is None else (self.axis, key), cards=cards)
        self.cards.axis = self.design.axes[self.axis]

    def change(self, key: Hashable = None, **changes: Any) -> None:
        """Change fields of the present axis."""
        self.change_axis(self.design.axes[self.axis].replace(**changes), key, True)

    def _set_gain(self, value: float) -> None:
        self.change_axis(self.design.axes[self.axis].replace(gain=value), "gain", False)

    def _wanted(self) -> float | None:
        """Return the crossover that is typed, if one is."""
        if not self.crossover.value or self.loop is None:
            return None
        try:
            freq = parsed(self.crossover.value, "Hz")
            if not self.loop.freq[0] <= freq <= self.loop.freq[-1]:
                raise FlexplantError(f"{freq:g} Hz is outside the frequencies of this plant.")
        except FlexplantError as problem:
            self.refuse(str(problem))
            return None
        return freq

    def _cross_at(self, event: Any) -> None:
        """Set the gain so that the loop crosses 1 at a frequency."""
        freq = self._wanted()
        if freq is None or self.loop is None:
            return
        if not np.all(self.loop.L):
            self.refuse(
                "the loop gain is zero: no gain makes it cross 1. Give the axis a gain first."
            )
            return
        there = np.exp(np.interp(np.log(freq), np.log(self.loop.freq), np.log(np.abs(self.loop.L))))
        gain = float(f"{self.design.axes[self.axis].gain / there:.6g}")
        self.change(gain=gain)

    def _add(self) -> None:
        freq = 100.0
        if self.loop is not None and self.loop.margins.crossovers:
            freq = self.loop.margins.crossovers[0]
        element = new_elements(freq, self.bench.top)[self.kind.value]()
        if isinstance(element, Notch) and self.loop is not None:
            element = element.replace(freq=float(f"{_loop_peak(self.loop, 1.5 * freq):.4g}"))
        self.change_axis(with_new(self.design.axes[self.axis], element), None, True)

    def _go(self, design: LoopDesign) -> None:
        self.show_controls()
        self.soon()

    def _keep(self) -> None:
        """Keep the design as a pale curve, and a button to go back to it."""
        first = f"kept {len(self.kept) + 1}", self.design, self.answer
        self.kept = [first, *self.kept][: len(KEPT)]
        self._show_kept()

    def _show_kept(self) -> None:
        import panel as pn

        buttons = []
        for (name, design, _), color in zip(self.kept, KEPT, strict=False):
            button = pn.widgets.Button(
                label=name, margin=(0, 3, 0, 0), height=28, variant="outline",
                description="return to this design, drawn as pale curves in this color",
                stylesheets=[COMPACT, f".bk-btn{{border-color:{color};color:{color}}}"],
            )  # fmt: skip
            button.on_click(lambda _, design=design: self.take(design))
            buttons.append(button)
        self.kept_row[:] = buttons
        for i, (_, design, answer) in enumerate(self.kept):
            self.views.show_other(f"kept {i}", self._of(self.machine, design))
            if answer is not None:
                self.views.show_time(f"kept {i}", answer.time, answer.error)

    @property
    def machine(self) -> BenchMachine:
        """The machine whose curves are drawn."""
        return self.bench.machines[self.index]

    def _other_axis(self, event: Any) -> None:
        self.axis = event.new
        self._fitted = False
        self.show_controls()
        self._show_kept()
        self.soon()

    def _other_machine(self, event: Any) -> None:
        self.index = int(event.new)
        self._show_kept()
        self.soon()

    def _switch_loops(self, event: Any) -> None:
        changed = {
            name: axis.replace(closed=name in event.new)
            for name, axis in self.design.axes.items()
            if axis.closed != (name in event.new)
        }
        if changed:
            self.take(self.design.replace(axes={**self.design.axes, **changed}))

    def show_controls(self) -> None:
        """Show the numbers of the design in all controls."""
        axis = self.design.axes[self.axis]
        self.cards.show(axis)
        self.gain.show(axis.gain)
        self.closed.value = [n for n, a in self.design.axes.items() if a.closed]
        self.side.show(axis)

    def _fit(self) -> None:
        if self.loop is not None:
            self.views.fit(self.loop)

    # -- drawing --------------------------------------------------------------------------------

    def _later(self, name: str, wait: int, call: Any) -> None:
        """Call something once after a while; a newer request takes the place of an older one."""
        doc = self._doc
        if doc is None or doc.session_context is None:  # in a script at once, in a notebook later
            try:
                asyncio.get_running_loop().call_later(1e-3 * wait, call)
            except RuntimeError:
                call()
            return
        if name in self._waiting:
            if name == "draw":  # it is drawn soon, with what is there then
                return
            doc.remove_timeout_callback(self._waiting.pop(name))

        def run() -> None:
            self._waiting.pop(name, None)
            call()

        self._waiting[name] = doc.add_timeout_callback(run, wait)

    def soon(self) -> None:
        """Draw once after a burst of changes."""
        self._later("draw", _SOON, self.draw)

    def draw(self) -> None:
        """Evaluate the axis on all machines, and show curves and verdict."""
        from panel.io import hold

        design = self.design
        try:
            loop, machines = self._of(self.machine, design), self.bench.machines
            fleet = [loop if m is self.machine else self._of(m, design) for m in machines]
        except (FlexplantError, np.linalg.LinAlgError) as problem:
            self.refuse(str(problem))
            return
        self.loop, self.fleet = loop, fleet
        self.bench.design = design
        self._serial += 1
        with hold():
            self.message.visible = False
            # a handle that is dragged stays where the mouse is
            self.views.update(loop, design.axes[self.axis], handles=self.gestures.at is None)
            if not self._fitted:
                self.views.fit(loop)
                self.views.show_coupling(loop.freq, coupling(self.machine, design, self.axis), loop)
                self._fitted = True
            self._draw_model(design)
            self._draw_fleet()
            self.verdict.object = headline(loop)
            self._judge()
        self._later("consequences", _LATER, self._consequences)

    def _of(self, machine: BenchMachine, design: LoopDesign) -> AxisLoop:
        return self._evaluator.loop(machine, design, self.axis)

    def _draw_model(self, design: LoopDesign) -> None:
        """Draw the model with a measurement."""
        model = self.bench.model
        if model is not None and model is not self.machine and self.machine.is_measured:
            self.views.show_other("model", self._of(model, design))

    def _draw_fleet(self) -> None:
        if len(self.fleet) < 2:
            return
        self.views.show_fleet(self.fleet)
        self.fleet_text, worst = of_fleet(self.fleet)
        shown = self.fleet[worst]
        self.views.show_other("worst", None if shown is self.loop else shown)

    def _judge(self) -> None:
        """Show limits, fleet, and what the consequences say."""
        if self.loop is None:
            return
        answer = self.answer
        fresh = self._answered == self._serial
        rms = answer.rms if answer is not None and fresh else None
        self.judged.object = limit_verdicts(list(self.limits.judged(self.loop, rms)))
        rows: list[tuple[str, str, bool | None]] = []
        if len(self.fleet) > 1:
            least = 1.0 / self.limits.peak
            good = all(one.is_stable and one.modulus_margin >= least for one in self.fleet)
            rows.append(("fleet", self.fleet_text, good))
        if answer is not None:
            said = self._said(answer)  # from the previous design at first
            rows += said if fresh else [(f"{name} ...", text, None) for name, text, _ in said]
        self.further.object = verdict_rows(rows)

    def _said(self, answer: Consequences) -> list[tuple[str, str, bool | None]]:
        rows: list[tuple[str, str, bool | None]] = []
        if answer.report is not None and len(answer.report) > 1:
            report = answer.report
            together = repr(report).splitlines()[0].strip("<>").removeprefix("LoopReport: ")
            rows.append(("all axes closed", together, report.is_stable))
            rows += [(one.name, repr(one).partition(": ")[2], None) for one in report.loops]
        if answer.radius:
            rows.append(("on the model", answer.radius, None))
        if answer.left_out:
            rows.append(("truncated modes", answer.left_out, answer.left_out_fine))
        if np.isfinite(answer.rms):
            factor, unit = in_unit(answer.rms, answer.unit)
            rows.append((f"rms of {answer.channel}", f"{answer.rms / factor:.4g} {unit}", None))
        rows += [(f"{name} of machines", text, None) for name, text in answer.on_machines]
        return [*rows, *(("not computed", text, None) for text in answer.missing)]

    # -- long computations ----------------------------------------------------------------------

    def _begin(self) -> None:
        """Begin with what takes longer when the page is on the screen."""
        self._loaded = True
        self._consequences()

    def _consequences(self) -> None:
        """Compute in a thread what a slider must not wait for."""
        if self.loop is None or self._working or not self._loaded:
            return
        serial, design, loop = self._serial, self.design, self.loop
        question, doc = self.bench.question_of(self.index), self._doc
        if doc is None or doc.session_context is None:
            self._show_answer(serial, question.answer(design, loop))
            return
        self._working = serial

        def work() -> None:
            try:
                answer = question.answer(design, loop)
            except Exception as problem:  # it must appear, and the next step must not wait for it
                answer = Consequences(missing=[f"no answer: {problem}"])
            # when a page or its server closes meanwhile, bokeh takes the callbacks apart
            with suppress(AttributeError):
                if not self._closed:
                    doc.add_next_tick_callback(partial(self._show_answer, serial, answer))

        threading.Thread(target=work, daemon=True).start()

    def _show_answer(self, serial: int, answer: Consequences) -> None:
        from panel.io import hold

        self._working = 0
        self.answer, self._answered = answer, serial
        with hold():
            factor, unit = in_unit(answer.rms, answer.unit)
            self.views.show_budget({n: rms / factor for n, rms in answer.sources}, unit)
            self.views.show_time("main", answer.time, answer.error, answer.time_label)
            self.side.script.value = self.design.script(self.bench.source)
            self._judge()
            if self.loop is not None:
                others = coupling(self.machine, self.design, self.axis)
                self.views.show_coupling(self.loop.freq, others, self.loop)
        if serial != self._serial:  # it was changed in the meantime
            self._later("consequences", _LATER, self._consequences)

    def tune(self, notches: int) -> None:
        """Begin a search for laws with the limit of |S| and the axes of the page."""
        if self.tuning is not None:
            return
        plant = self.machine.given
        self.tuning = Tuning(plant, self.design, self.limits.peak, notches)
        self.side.show_tuning(self.tuning.said, True)
        if self._doc is not None:
            self._polled = self._doc.add_periodic_callback(self._poll, int(1e3 * PERIOD))

    def _tuned(self) -> Tuning | None:
        """Return the search, which is over for the page."""
        tuning, self.tuning = self.tuning, None
        if tuning is not None and self._doc is not None:
            self._doc.remove_periodic_callback(self._polled)
        return tuning

    def _poll(self) -> None:
        if self.tuning is None:
            return
        if self.tuning.is_running:
            self.side.show_tuning(self.tuning.said, True)
            return
        tuning = self._tuned()
        if tuning is None:
            return
        try:
            found = tuning.result()
            self._keep()
            self.take(found)
            self.side.show_tuning("taken; what was before is kept", False)
        except FlexplantError as problem:
            self.refuse(str(problem))
            self.side.show_tuning("nothing found", False)

    def stop_tuning(self) -> None:
        """End the search; the design stays."""
        tuning = self._tuned()
        if tuning is not None:
            tuning.stop()
            self.side.show_tuning("stopped; the design is as it was", False)

    def hand_over(self, data: bytes) -> None:
        """Read an uploaded file: a design, or elements of a law."""
        try:
            given = given_file(data)
            if isinstance(given, LoopDesign):
                self._take_design(given)
                return
            axis = self.design.axes[self.axis]
            for one in given:
                gain = isinstance(one, float)
                axis = axis.replace(gain=axis.gain * one) if gain else with_new(axis, one)
            self.change_axis(axis, None, True)
        except FlexplantError as problem:
            self.refuse(str(problem))

    def _take_design(self, given: LoopDesign) -> None:
        now = self.design
        if tuple(given.axes) != tuple(now.axes) or given.rate != now.rate:
            raise FlexplantError(
                f"the design is of axes {', '.join(given.axes)} at {given.rate:g} Hz, the page has "
                f"{', '.join(now.axes)} at {now.rate:g} Hz. Open it with its own plant."
            )
        self.take(now.replace(axes=given.axes))

    def start_anew(self) -> None:
        """Start the law of the axis anew, around the crossover that was typed, if any."""
        at, freq = (
            (self.machine, list(self.design.axes).index(self.axis), self.design),
            self._wanted(),
        )
        self.change_axis(first_axis(*at) if freq is None else crossing_axis(*at, freq), None, True)

    def close(self) -> None:
        """End all work that the tab has started."""
        self._closed = True
        if self.tuning is not None:
            self.tuning.stop()
            self.tuning = None


def _loop_peak(loop: AxisLoop, above: float) -> float:
    """Return the resonance beyond a frequency where the loop gain is highest: notches are there."""
    variance = None if loop.deviation is None else loop.deviation**2
    axis = MeasuredAxis("", loop.freq, loop.others.G, loop.law.rate, True, variance)
    found = axis.resonances[axis.resonances > above] if loop.freq.size > 4 else np.zeros(0)
    if not found.size:
        return 2.0 * above
    size = np.abs(loop.L[np.searchsorted(loop.freq, found)])
    return float(found[np.argmax(size)])
