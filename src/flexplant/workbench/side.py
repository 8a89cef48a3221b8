"""SideCards: the smaller cards of the page (feedforward, limits, tuning, files), and the files."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FlexplantError, ModelError
from ..export import write_c
from ..io import write_mat
from ..lti.statespace import StateSpace
from ..plant.port import TERMS
from ..store import load
from ..synthesis import Controller, FixedBlock, Law, LoopDesign, ShapedAxis, second_order_sections
from ..synthesis.laws.law import LawElement
from .controls import digits, parsed
from .verdict import CARD, COMPACT, SMALL, heading, remark

#: largest size of an uploaded file [bytes]
_LARGEST = 64_000_000


def c_code(design: LoopDesign) -> bytes:
    """Return source and header of the controller as a zip archive."""
    out = io.BytesIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for file in write_c(design.controller(), Path(folder) / "loops.c"):
            archive.write(file, file.name)
    return out.getvalue()


def matlab_file(design: LoopDesign) -> bytes:
    """Return the controller, and the laws of the axes, for MATLAB."""
    values: dict[str, Any] = {"controller": design.controller()}
    values |= {f"law{i}": law.system for i, law in enumerate(design.laws.values(), 1)}
    return _written("design.mat", lambda path: write_mat(path, values))


def sections(design: LoopDesign) -> bytes:
    """Return the second-order sections of each law as a table."""
    rows = ["axis,section,b0,b1,b2,a0,a1,a2"]
    for name, law in design.laws.items():
        found = second_order_sections(law.system)["command", "error"]
        rows += [
            f"{name},{k}," + ",".join(repr(float(v)) for v in row) for k, row in enumerate(found, 1)
        ]
    return ("\n".join(rows) + "\n").encode()


def report_page(design: LoopDesign, plant: Any) -> bytes:
    """Return the report page of the design and its loops."""
    from ..plot import report as write_report

    loops = design.loops(plant)
    parts = {"design": design, "loops": loops, "controller": loops.system}
    return _written("loops.html", lambda path: write_report(path, parts, title="Loops by hand"))


def _written(name: str, write: Callable[[Path], Any]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def given_file(data: bytes) -> LoopDesign | tuple[Any, ...]:
    """Return the design of an uploaded file, or the elements of a law in it."""
    # only files of `.save` are read: arrays and JSON, never a pickle
    if len(data) > _LARGEST:
        raise ModelError(f"the file has {len(data) / 1e6:.0f} MB: a design has less than 64.")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "given.npz"
        path.write_bytes(data)
        try:
            value = load(path)
        except FlexplantError as problem:
            raise FlexplantError(str(problem).replace(repr(str(path)), "the file")) from None
    if isinstance(value, LoopDesign):
        return value
    if isinstance(value, Law):
        return (*value.factors,) if value.gain == 1.0 else (*value.factors, value.gain)
    if isinstance(value, LawElement):
        return (value,)
    if isinstance(value, StateSpace | Controller):
        return (FixedBlock.of(value),)
    raise ModelError(
        f"the file holds a {type(value).__name__}: a LoopDesign, a Law, or a controller of one "
        "channel can be taken."
    )


#: limits on the page: field of LoopLimits, label, unit; those in dB are typed in dB
_LIMITS = (
    ("peak", "peak of |S|", "dB"), ("gain_margin", "gain margin", "dB"),
    ("phase_margin", "phase margin", "deg"), ("bandwidth", "bandwidth", "Hz"),
    ("suppressed", "|S| below", "dB"), ("below", "up to", "Hz"), ("rms", "rms of the error", ""),
)  # fmt: skip


class SideCards:
    """The cards next to the law; `page` is their tab."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self._own = False
        self.cards = [
            self._forward_card(), self._limits_card(), self._tune_card(), self._files_card()
        ]  # fmt: skip

    def _card(self, name: str, *items: Any, collapsed: bool) -> Any:
        import panel as pn

        inside = pn.Column(*items, margin=(0, 8, 6, 8), sizing_mode="stretch_width")
        return pn.Card(
            inside, header=pn.pane.HTML(heading(name), margin=(0, 0, 0, 4)),
            collapsed=collapsed, sizing_mode="stretch_width", margin=(0, 0, 6, 0),
            styles=CARD | {"padding": "0", "box-shadow": "none"},
            header_background="#FFFFFF", hide_header=False,
        )  # fmt: skip

    def _text(self, label: str, value: str, take: Callable[[str], None], **more: Any) -> Any:
        import panel as pn

        text = pn.widgets.TextInput(
            label=label, value=value, width=100, margin=(0, 4, 4, 0), stylesheets=[COMPACT], **more
        )

        def typed(event: Any) -> None:
            try:
                if not self._own:
                    take(event.new)
            except FlexplantError as problem:
                self.page.refuse(str(problem))

        text.param.watch(typed, "value")
        return text

    def _forward_card(self) -> Any:
        import panel as pn

        self.forward = [
            self._text(f"{term}", "", partial(self._put_forward, i), placeholder="0")
            for i, term in enumerate(TERMS)
        ]
        box = pn.FlexBox(*self.forward, gap="0px", sizing_mode="stretch_width")
        return self._card("feedforward (command per derivative)", box, collapsed=True)

    def _put_forward(self, i: int, text: str) -> None:
        gains = list(self.page.design.axes[self.page.axis].feedforward)
        gains += [0.0] * (len(TERMS) - len(gains))
        gains[i] = parsed(text) if text.strip() else 0.0
        self.page.change(feedforward=tuple(gains))

    def _limits_card(self) -> Any:
        import panel as pn

        self.limits = [
            self._text(label, self._limit(name, unit), partial(self._put_limit, name))
            for name, label, unit in _LIMITS
        ]
        box = pn.FlexBox(*self.limits, gap="0px", sizing_mode="stretch_width")
        return self._card("specifications", box, collapsed=False)

    def _limit(self, name: str, unit: str) -> str:
        value = getattr(self.page.limits, name)
        if value is None:
            return ""
        return f"{20.0 * np.log10(value):.3g} dB" if unit == "dB" else digits(value, unit)

    def _put_limit(self, name: str, text: str) -> None:
        value = parsed(text) if text.strip() else None
        if name == "peak" and value is None:
            raise FlexplantError("the peak of |S| has a limit: 6 dB unless another is typed.")
        self.page.limits = self.page.limits.replace(**{name: value})
        self.page.views.draw_limits(self.page.limits)
        self.page.draw()

    def _tune_card(self) -> Any:
        import panel as pn

        small: dict[str, Any] = SMALL | {"margin": (2, 4, 2, 0)}
        self.start = pn.widgets.Button(label="tune", color="primary", width=64, **small)
        self.stop = pn.widgets.Button(
            label="stop", color="danger", width=56, disabled=True, **small
        )
        self.notches = pn.widgets.Select(options=[0, 1, 2, 3, 4, 5], value=3, width=56, **small)
        self.tuned = pn.pane.HTML(
            remark("all axes, highest bandwidth below the peak of |S|"), margin=0
        )
        self.start.on_click(lambda _: self.page.tune(int(self.notches.value)))
        self.stop.on_click(lambda _: self.page.stop_tuning())
        label = pn.pane.HTML(remark("notches"), margin=(8, 4, 0, 0))
        row = pn.Row(self.start, self.stop, label, self.notches, margin=0)
        return self._card("automatic", row, self.tuned, collapsed=False)

    def show_tuning(self, said: str, running: bool) -> None:
        """Show the progress of a search."""
        self.tuned.object = remark(said)
        self.start.disabled, self.stop.disabled = running, not running

    def _files_card(self) -> Any:
        import panel as pn

        page = self.page
        kinds: tuple[tuple[str, str, Callable[[], bytes]], ...] = (
            ("design", "design.npz", lambda: _written("design.npz", page.design.save)),
            ("C99", "loops.zip", lambda: c_code(page.design)),
            ("MATLAB", "loops.mat", lambda: matlab_file(page.design)),
            ("sections", "sections.csv", lambda: sections(page.design)),
            ("Python", "loops.py", lambda: page.design.script(page.bench.source).encode()),
            ("report", "loops.html", self._report),
        )
        sampled = page.design.rate > 0.0
        if not sampled:  # only sampled laws run on a computer
            kinds = tuple(kind for kind in kinds if kind[0] not in ("C99", "sections"))
        buttons = [
            pn.widgets.FileDownload(
                callback=lambda make=make: self._made(make), filename=file, label=f"save {label}",
                variant="outline", height=28, margin=(0, 4, 4, 0), embed=False, auto=True,
                stylesheets=[COMPACT],
            )
            for label, file, make in kinds
        ]  # fmt: skip
        self.script = pn.widgets.TextAreaInput(
            value="", height=110, sizing_mode="stretch_width", margin=(4, 0, 0, 0),
            stylesheets=[COMPACT], max_length=200_000,
        )  # fmt: skip
        copy = pn.widgets.Button(
            label="copy as Python", variant="outline", height=28, margin=(0, 4, 4, 0),
            stylesheets=[COMPACT],
        )  # fmt: skip
        copy.js_on_click(
            args={"source": self.script}, code="navigator.clipboard.writeText(source.value)"
        )
        given = pn.widgets.FileInput(
            accept=".npz", multiple=False, margin=(2, 0, 2, 0), sizing_mode="stretch_width"
        )
        given.param.watch(lambda event: event.new and page.hand_over(event.new), "value")
        note = "load a design, or a law or controller as elements"
        if not sampled:
            note = f"C99 and sections need the controller's rate: open the page with it. {note}"
        load = pn.pane.HTML(remark(note), margin=0)
        box = pn.FlexBox(*buttons, copy, gap="0px", sizing_mode="stretch_width")
        return self._card("files", box, load, given, self.script, collapsed=False)

    def _report(self) -> bytes:
        page = self.page
        plant = page.bench.question_of(page.index).plant
        return report_page(page.design, plant or page.machine.given)

    def _made(self, make: Callable[[], bytes]) -> Any:
        """Return a file for the browser; what is wrong with it appears on the page."""
        try:
            return io.BytesIO(make())
        except FlexplantError as problem:
            self.page.refuse(str(problem))
            return io.BytesIO(f"{problem}\n".encode())

    def show(self, axis: ShapedAxis) -> None:
        """Show the numbers of an axis."""
        self._own = True
        gains = [*axis.feedforward, *([0.0] * (len(TERMS) - len(axis.feedforward)))]
        for text, gain in zip(self.forward, gains, strict=True):
            text.value = f"{gain:.6g}" if gain else ""
        self._own = False
