"""The elements of an axis as cards: numbers with sliders and text fields, and switches."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..errors import FlexplantError, ModelError
from ..io.unit_labels import prefixed
from ..synthesis import FixedBlock, Integrator, Lag, Lead, LowPass, Notch, Pid, ShapedAxis
from ..synthesis.laws.law import SingleElement
from ..tolerances import SAME
from .verdict import COMPACT, ELEMENT, OFF

#: factors of what may follow a number
_UNITS = {
    **prefixed("", ""), **prefixed("hz", "km"), **prefixed("s", "mu"), **prefixed("m", "mun"),
    **prefixed("deg", ""), "%": 0.01, "rad/s": 0.5 / np.pi,
}  # fmt: skip
#: units of a frequency, and of a number without a unit
_KINDS = {"Hz": {"", "hz", "khz", "mhz", "rad/s"}, "": {"", "%", "db"}}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


class Field(NamedTuple):
    """A number of an element: its unit, the range of its slider, and its getter and setter."""

    label: str
    unit: str
    low: float
    high: float
    read: Callable[[Any], float]
    put: Callable[[Any, float], Any]


def parsed(text: str, unit: str | None = None) -> float:
    """Return the number that was typed, in SI: ``1.2 kHz``, ``-20 dB``, ``0.1 %``."""
    # of a known unit, "Hz" or none, others are refused
    found = _NUMBER.fullmatch(text.replace(",", ".").replace("µ", "u"))
    typed = found.group(2).lower() if found else ""
    if not found or typed not in _KINDS.get("any" if unit is None else unit, {*_UNITS, "db"}):
        of = {None: "number with a unit", "Hz": "frequency"}.get(unit, "number")
        raise ModelError(f"{text!r} is not a {of}. Type one such as 130, 1.2 kHz, 0.1 % or -20 dB.")
    value = float(found.group(1))
    return float(10.0 ** (value / 20.0)) if typed == "db" else value * _UNITS[typed]


def digits(value: float, unit: str) -> str:
    """Return a number as the page writes it."""
    if unit == "Hz" and abs(value) >= 1e4:
        return f"{value / 1e3:.5g} kHz"
    return f"{value:.5g} {unit}".strip()


def _numeric(name: str, label: str, unit: str, low: float, high: float) -> Field:
    return Field(
        label,
        unit,
        low,
        high,
        lambda e: float(getattr(e, name)),
        lambda e, v: e.replace(**{name: v}),
    )


def _corner_field(name: str, label: str, unit: str, low: float, high: float) -> Field:
    """Return a number of a Pid by its corners."""

    def read(element: Pid) -> float:
        return float((element.as_corners() or {})[name] or 0.0)

    def put(element: Pid, value: float) -> Pid:
        corners: dict[str, Any] = {**(element.as_corners() or {}), name: value}
        zero = corners["zero"]
        if zero is not None and not corners["integrator"] < zero:  # the two would change places
            raise ModelError(
                f"the integrator's corner lies below the zero: {corners['integrator']:.4g} Hz is "
                f"not below {zero:.4g} Hz."
            )
        return Pid.corners(**corners)

    return Field(label, unit, low, high, read, put)


def _zeros_damping(element: Notch, value: float) -> Notch:
    return element.replace(depth=value / element.width)


def _poles_damping(element: Notch, value: float) -> Notch:
    """Change the damping of the poles, that of the zeros stays."""
    if value <= 0.0:
        raise ModelError(f"the damping of a notch's poles is positive, got {value:g}.")
    return element.replace(width=value, depth=element.depth * element.width / value)


def fields_of(element: SingleElement, top: float) -> tuple[Field, ...]:
    """Return the numbers of an element; `top` is the highest frequency of a slider [Hz]."""
    low = 1e-4 * top  # four decades on a slider
    freq = _numeric("freq", "frequency", "Hz", low, top)
    if isinstance(element, Pid):
        corners = element.as_corners()
        if corners is None:  # complex zeros: as gains
            free = (_numeric(n, n, u, 1e-6, 1e9) for n, u in (("p", ""), ("i", "/s"), ("d", "s")))
            return (*free, *([_numeric("pole", "pole", "Hz", low, top)] if element.pole else []))
        some = [_corner_field("integrator", "integrator", "Hz", low, top)]
        if corners["zero"] is not None:
            some += [_corner_field(name, name, "Hz", low, top) for name in ("zero", "pole")]
        if corners["gain"] != 1.0:
            some.append(_corner_field("gain", "gain", "", 1e-3, 1e3))
        return tuple(some)
    if isinstance(element, Lead):
        return freq, _numeric("ratio", "pole / zero", "", 1.0, 100.0)
    if isinstance(element, Lag):
        return freq, _numeric("ratio", "zero / pole", "", 1.0, 100.0)
    if isinstance(element, Notch):
        return (
            freq,
            Field("damping zeros", "", 1e-4, 1.0, lambda e: e.depth * e.width, _zeros_damping),
            Field("damping poles", "", 1e-3, 2.0, lambda e: e.width, _poles_damping),
            _numeric("skew", "skew", "", 0.5, 2.0),
        )
    if isinstance(element, LowPass) and element.order == 2:
        return freq, _numeric("damping", "damping", "", 0.05, 2.0)
    return (freq,) if isinstance(element, LowPass | Integrator) else ()


def name_of(element: SingleElement) -> str:
    """Return the name of an element on the page."""
    if isinstance(element, Pid):
        return "PID" if element.d or element.pole else "PI" if element.i else "gain"
    if isinstance(element, LowPass):
        return f"low-pass {element.order}"
    return element.label if isinstance(element, FixedBlock) else type(element).__name__.lower()


def new_elements(crossover: float, top: float) -> Mapping[str, Callable[[], SingleElement]]:
    """Return the elements that can be added, with first values around a crossover [Hz]."""

    def below(freq: float) -> float:
        return float(f"{min(freq, 0.9 * top):.3g}")

    f = crossover
    return {
        "PID": lambda: Pid.corners(
            1.0, integrator=below(f / 6), zero=below(f / 3), pole=below(3 * f)
        ),
        "PI": lambda: Pid(1.0, i=float(f"{2 * np.pi * f / 6:.3g}")),
        "lead": lambda: Lead(below(f)),
        "lag": lambda: Lag(below(f / 5), 3.0),
        "integrator": lambda: Integrator(below(f / 6)),
        "notch": lambda: Notch(below(3 * f), depth=0.1, width=0.2),
        "low-pass 1": lambda: LowPass(below(8 * f), order=1),
        "low-pass 2": lambda: LowPass(below(8 * f)),
    }


def with_element(axis: ShapedAxis, at: int, element: SingleElement) -> ShapedAxis:
    """Return an axis with another element in the place of one."""
    return axis.replace(elements=(*axis.elements[:at], element, *axis.elements[at + 1 :]))


def with_new(axis: ShapedAxis, element: SingleElement) -> ShapedAxis:
    """Return an axis with one more element, at the end."""
    return axis.replace(elements=(*axis.elements, element), on=(*axis.on, True))


def removed(axis: ShapedAxis, at: int) -> ShapedAxis:
    """Return an axis without one of its elements."""
    return _picked(axis, [i for i in range(len(axis.elements)) if i != at])


def swap(axis: ShapedAxis, at: int, by: int) -> ShapedAxis:
    """Return an axis with one element exchanged with its neighbour."""
    to = at + by
    if not 0 <= to < len(axis.elements):
        return axis
    order = list(range(len(axis.elements)))
    order[at], order[to] = order[to], order[at]
    return _picked(axis, order)


def _picked(axis: ShapedAxis, order: list[int]) -> ShapedAxis:
    return axis.replace(
        elements=tuple(axis.elements[i] for i in order), on=tuple(axis.on[i] for i in order)
    )


def switched(axis: ShapedAxis, at: int, on: bool) -> ShapedAxis:
    """Return an axis with one element on or off."""
    return axis.replace(on=(*axis.on[:at], on, *axis.on[at + 1 :]))


#: takes a changed axis, a key by which changes of one number are one step, and whether cards change
Change = Callable[[ShapedAxis, Hashable, bool], None]
#: steps of a slider in a decade, and what Panel waits for more moves of it [ms]
_STEPS, _WAIT = 200, 1


class Number:
    """A slider in logarithmic steps next to a number that can be typed."""

    def __init__(
        self, label: str, unit: str, low: float, high: float, value: float,
        take: Callable[[float], None], refuse: Callable[[str], None], held: Callable[[], float],
    ) -> None:  # fmt: skip
        import panel as pn

        self.unit, self._take, self._refuse, self._held = unit, take, refuse, held
        self._sign, self._own = 1.0, False
        self.slider = pn.widgets.FloatSlider(
            start=float(np.log10(low)), end=float(np.log10(high)), step=1.0 / _STEPS,
            show_value=False, sizing_mode="stretch_width", margin=(6, 6, 0, 6), height=20,
            min_width=60, stylesheets=[COMPACT],
        )  # fmt: skip
        self.text = pn.widgets.TextInput(
            width=86, height=26, margin=(0, 0, 2, 0), stylesheets=[COMPACT]
        )
        # Panel waits 50 ms for more of the same; the page has its own way with bursts of moves
        self.slider._debounce = _WAIT
        self.show(value)
        self.slider.param.watch(self._slid, "value")
        self.text.param.watch(self._typed, "value")
        name = pn.pane.HTML(
            f'<div style="font-size:11px;color:#44505B;padding-top:4px">{label}</div>', width=84,
            margin=0,
        )  # fmt: skip
        self.row = pn.Row(name, self.slider, self.text, sizing_mode="stretch_width", margin=0)

    def show(self, value: float) -> None:
        """Show a number that was changed elsewhere; the range of the slider grows to contain it."""
        self._own = True
        try:
            self._sign = -1.0 if value < 0.0 else 1.0
            if value:
                place = float(np.log10(abs(value)))
                self.slider.start = min(self.slider.start, place)
                self.slider.end = max(self.slider.end, place)
                self.slider.value = place
            self.text.value = digits(value, self.unit)
        finally:
            self._own = False

    def _slid(self, event: Any) -> None:
        if self._own:
            return
        value = self._sign * float(f"{10.0**event.new:.4g}")
        self._own = True
        self.text.value = digits(value, self.unit)
        self._own = False
        self._offer(value)

    def _offer(self, value: float) -> None:
        """Hand a number to the design, and show what the design has then."""
        try:
            self._take(value)
        except FlexplantError as problem:
            self._refuse(str(problem))
        if not np.isclose(self._held(), value, rtol=SAME, atol=0.0):  # refused
            self.show(self._held())

    def _typed(self, event: Any) -> None:
        if self._own:
            return
        try:
            value = parsed(event.new, self.unit)
        except FlexplantError as problem:
            self._refuse(str(problem))
            self.show(self._held())
            return
        self._offer(value)
        self.show(self._held())


class ElementCards:
    """The cards of an axis: rebuilt when elements are added, removed or moved, else updated."""

    def __init__(self, top: float, change: Change, refuse: Callable[[str], None]) -> None:
        import panel as pn

        self.top, self._change, self._refuse = top, change, refuse
        self.axis = ShapedAxis()
        self.column = pn.Column(sizing_mode="stretch_width", margin=0)
        self._numbers: list[list[tuple[Field, Number]]] = []
        self._kinds: list[tuple[str, int]] = []

    def show(self, axis: ShapedAxis) -> None:
        """Show an axis."""
        self.axis = axis
        kinds = [(name_of(e), len(fields_of(e, self.top))) for e in axis.elements]
        if kinds != self._kinds or len(self.column) != len(kinds):
            self._kinds = kinds
            self._numbers = []
            self.column[:] = [self._card(i) for i in range(len(axis.elements))]
        for i, element in enumerate(axis.elements):
            for field, number in self._numbers[i]:
                number.show(field.read(element))
            self.column[i].styles = ELEMENT if axis.on[i] else OFF
            if self._switches[i].value != axis.on[i]:
                self._switches[i].value = axis.on[i]

    @property
    def _switches(self) -> list[Any]:
        return [card[0][0] for card in self.column]

    def _card(self, i: int) -> Any:
        import panel as pn

        element = self.axis.elements[i]
        switch = pn.widgets.Checkbox(
            label=name_of(element), value=self.axis.on[i], sizing_mode="stretch_width",
            margin=(3, 0, 0, 0), stylesheets=[COMPACT, "label span{font-weight:600}"],
        )  # fmt: skip
        switch.param.watch(lambda event: self._switch(i, event.new), "value")
        buttons = []
        for sign, act in (
            ("▲", lambda: swap(self.axis, i, -1)), ("▼", lambda: swap(self.axis, i, 1)),
            ("✕", lambda: removed(self.axis, i)),
        ):  # fmt: skip
            button = pn.widgets.Button(
                label=sign, width=28, height=24, margin=(0, 0, 0, 2), stylesheets=[COMPACT],
                color="default", variant="outline",
            )  # fmt: skip
            button.on_click(lambda event, act=act: self._change(act(), None, True))
            buttons.append(button)
        numbers = []
        for field in fields_of(element, self.top):
            value = field.read(element)
            low, high = field.low, field.high
            if value and not low <= abs(value) <= high:
                low, high = min(low, abs(value)), max(high, abs(value))
            number = Number(
                field.label, field.unit, low, high, value,
                partial(self._put, i, field), self._refuse, partial(self._held, i, field),
            )  # fmt: skip
            numbers.append((field, number))
        self._numbers.append(numbers)
        header = pn.Row(switch, *buttons, sizing_mode="stretch_width", margin=0)
        return pn.Column(
            header, *(number.row for _, number in numbers), sizing_mode="stretch_width",
            margin=(0, 0, 5, 0), styles=ELEMENT,
        )  # fmt: skip

    def _switch(self, i: int, on: bool) -> None:
        if on != self.axis.on[i]:
            self._change(switched(self.axis, i, on), None, True)

    def _held(self, i: int, field: Field) -> float:
        """Return the number that the design has."""
        return field.read(self.axis.elements[i])

    def _put(self, i: int, field: Field, value: float) -> None:
        element = field.put(self.axis.elements[i], value)
        self._change(with_element(self.axis, i, element), (i, field.label), False)
