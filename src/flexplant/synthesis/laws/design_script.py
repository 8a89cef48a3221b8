"""design_script: the Python script that makes a design of loops, each number to its last digit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np

from ...checks import Value
from ...lti.statespace import StateSpace


def design_script(design: Any, plant: str = "") -> str:
    """Return the script; `plant` is the line that makes the plant."""
    axes = list(design.axes.items())
    used = {type(e).__name__ for _, axis in axes for e in axis.elements}
    names = sorted({"LoopDesign", "ShapedAxis", *used})
    rows = [f"    {name!r}: {_call(axis, 1)}," for name, axis in axes]
    given = {f.name: getattr(design, f.name) for f in fields(design)}
    others = [
        f"    {key}={literal(value)},"
        for key, value in given.items()
        if key != "axes" and value not in ({}, "")
    ]
    array = any("np." in row for row in (*rows, *others))
    lines = ['"""Loops shaped by hand: made again by this script, to the last digit."""', ""]
    lines += ["import numpy as np", ""] if array else []
    lines += ["import flexplant as fx", f"from flexplant.synthesis import {', '.join(names)}", ""]
    lines += ["axes = {", *rows, "}"]
    lines += ["design = LoopDesign(", "    axes,", *others, ")"]
    lines += ["controller = design.controller()  # y (and references) -> u", ""]
    if plant:
        lines += [plant, "print(design.loops(plant))"]
    else:
        lines += ["# plant = fx.load(...)  # what it was made on", "# print(design.loops(plant))"]
    return "\n".join(lines) + "\n"


def literal(value: Any) -> str:
    """Return an expression for a value of a design."""
    if isinstance(value, Value):
        return _call(value, 0)
    if isinstance(value, np.ndarray):
        if not value.size:
            return f"np.zeros({value.shape})"
        return f"np.array({value.tolist()!r})"
    if isinstance(value, np.generic):
        return repr(value.item())
    if isinstance(value, tuple | list):
        return f"[{', '.join(literal(one) for one in value)}]"
    if hasattr(value, "items"):
        return f"{{{', '.join(f'{k!r}: {literal(v)}' for k, v in value.items())}}}"
    return repr(value)


def _call(value: Value, depth: int) -> str:
    """Return the constructor's call of a value, with what is not its default."""
    kind = type(value).__name__
    name = f"fx.{kind}" if isinstance(value, StateSpace) else kind
    parts = [f"{key}={literal(one)}" for key, one in _fields_given(value)]
    if not depth:
        return f"{name}({', '.join(parts)})"
    elements = getattr(value, "elements", ())
    inner = "".join(f"\n            {_call(one, 0)}," for one in elements)
    listed = f"[{inner}\n        ]" if elements else "[]"
    rest = [part for part in parts if not part.startswith("elements=")]
    return f"{name}(\n        {', '.join([listed, *rest])},\n    )"


def _fields_given(value: Value) -> Iterable[tuple[str, Any]]:
    for one in fields(value):  # type: ignore[arg-type]
        item = getattr(value, one.name)
        if one.name == "on" and all(item):
            continue
        empty = item is None or (not isinstance(item, np.ndarray) and item in ((), {}, ""))
        if not empty and not (isinstance(item, float | int | bool) and item == one.default):
            yield one.name, item
