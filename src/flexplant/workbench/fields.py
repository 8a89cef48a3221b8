"""Field: a number of an element as the page shows it, and what an engineer types for it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from ..synthesis import FixedBlock, Integrator, Lag, Lead, LowPass, Notch, Pid, ShapedAxis
from ..synthesis.laws.law import SingleElement

#: factors of what may follow a number
_UNITS = {
    "": 1.0, "hz": 1.0, "khz": 1e3, "mhz": 1e-3, "%": 0.01, "s": 1.0, "ms": 1e-3, "us": 1e-6,
    "m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "deg": 1.0, "rad/s": 0.5 / np.pi,
}  # fmt: skip
#: units of a frequency, and of a number without a unit
_KINDS = {"Hz": {"", "hz", "khz", "mhz", "rad/s"}, "": {"", "%", "db"}}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


class Field(NamedTuple):
    """A number of an element: its unit, the range of its slider, how it is read and set."""

    label: str
    unit: str
    low: float
    high: float
    read: Callable[[Any], float]
    put: Callable[[Any, float], Any]


def parsed(text: str, unit: str | None = None) -> float:
    """Return the number that was typed, in SI: ``1.2 kHz``, ``-20 dB``, ``0.1 %``.

    Of a known unit, "Hz" or none, others are refused.
    """
    found = _NUMBER.fullmatch(text.replace(",", ".").replace("µ", "u"))
    typed = found.group(2).lower() if found else ""
    if not found or typed not in _KINDS.get("any" if unit is None else unit, {*_UNITS, "db"}):
        of = {None: "number with a unit", "Hz": "frequency"}.get(unit, "number")
        raise ModelError(f"{text!r} is no {of}. Type one such as 130, 1.2 kHz, 0.1 % or -20 dB.")
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


def _corner(name: str, label: str, unit: str, low: float, high: float) -> Field:
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
    low = 1e-4 * top
    freq = _numeric("freq", "frequency", "Hz", low, top)
    if isinstance(element, Pid):
        corners = element.as_corners()
        if corners is None:  # complex zeros: as gains
            free = (_numeric(n, n, u, 1e-6, 1e9) for n, u in (("p", ""), ("i", "/s"), ("d", "s")))
            return (*free, *([_numeric("pole", "pole", "Hz", low, top)] if element.pole else []))
        some = [_corner("integrator", "integrator", "Hz", low, top)]
        if corners["zero"] is not None:
            some += [
                _corner("zero", "zero", "Hz", low, top), _corner("pole", "pole", "Hz", low, top)
            ]  # fmt: skip
        return (
            (*some, _corner("gain", "gain", "", 1e-3, 1e3)) if corners["gain"] != 1.0 else (*some,)
        )
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
    """Return what the page calls an element."""
    if isinstance(element, Pid):
        return "PID" if element.d or element.pole else "PI" if element.i else "gain"
    if isinstance(element, LowPass):
        return f"low-pass {element.order}"
    return element.label if isinstance(element, FixedBlock) else type(element).__name__.lower()


def new_elements(crossover: float, top: float) -> Mapping[str, Callable[[], SingleElement]]:
    """Return what can be added, at the places where one begins: around a crossover [Hz]."""

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
    keep = [i for i in range(len(axis.elements)) if i != at]
    return axis.replace(
        elements=tuple(axis.elements[i] for i in keep), on=tuple(axis.on[i] for i in keep)
    )


def swap(axis: ShapedAxis, at: int, by: int) -> ShapedAxis:
    """Return an axis with one element exchanged with its neighbour."""
    to = at + by
    if not 0 <= to < len(axis.elements):
        return axis
    order = list(range(len(axis.elements)))
    order[at], order[to] = order[to], order[at]
    return axis.replace(
        elements=tuple(axis.elements[i] for i in order), on=tuple(axis.on[i] for i in order)
    )


def switched(axis: ShapedAxis, at: int, on: bool) -> ShapedAxis:
    """Return an axis with one element on or off."""
    return axis.replace(on=(*axis.on[:at], on, *axis.on[at + 1 :]))
