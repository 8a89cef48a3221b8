"""Controls: the elements of an axis as cards with sliders, numbers to type, and switches."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

import numpy as np

from ..errors import FlexplantError
from ..synthesis import ShapedAxis
from ..tolerances import SAME
from .fields import Field, digits, fields_of, name_of, parsed, removed, swap, switched, with_element
from .style import COMPACT, ELEMENT, OFF

#: takes a changed axis, a key by which changes of one number are one step, and whether cards change
Change = Callable[[ShapedAxis, Hashable, bool], None]
#: steps of a slider in a decade, and what Panel waits for more moves of it [ms]
_STEPS, _WAIT = 200, 1


class Number:
    """A slider in logarithmic steps beside a number that can be typed."""

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
        """Show a number that was changed elsewhere; one beyond the slider widens it."""
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
    """The cards of an axis; rebuilt when elements come, go or move, else only their numbers."""

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
