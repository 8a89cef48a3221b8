"""Checks of arguments that many functions share: ranges, lists of values, mappings, functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import FlexplantError, ModelError, ShapeError
from .values import FloatArray, positive, real_array, short


def between(value: Any, name: str, low: float, high: float, hint: str, *, ends: str = "") -> float:
    """Return `value` as a float between two bounds."""
    number = positive(value, name, zero=low == 0.0)
    above = number >= low if "[" in ends else number > low
    if not above or not (number <= high if "]" in ends else number < high):
        where = f"be above {low:g}" if np.isinf(high) else f"lie between {low:g} and {high:g}"
        raise ModelError(f"{name} must {where}, got {number:g}. {hint}")
    return number


def positive_array(
    value: Any,
    name: str,
    shape: tuple[int | None, ...] | None = None,
    *,
    hint: str = "Check its sign and its unit (SI).",
    zero: bool = False,
) -> FloatArray:
    """Return `value` as a finite array of a shape whose entries are positive, or not negative."""
    array = real_array(value, name, shape)
    least = float(array.min(initial=np.inf))
    if least < 0.0 or (least == 0.0 and not zero):
        must = "must not be negative" if zero else "must be positive"
        raise ModelError(f"{name} {must}, got {least:g}. {hint}")
    return array


def members(values: Any, kind: Any, name: str, hint: str, *, least: int = 1) -> tuple[Any, ...]:
    """Return several values as a tuple, all of a class."""
    several = isinstance(values, Iterable) and not isinstance(values, str)
    listed = tuple(values) if several else ()
    if not several or len(listed) < least or not all(isinstance(one, kind) for one in listed):
        kinds = " or ".join(one.__name__ for one in getattr(kind, "__args__", (kind,)))
        many = "" if not least else "at least one " if least == 1 else f"at least {least} "
        raise ModelError(f"{name} must be a list of {many}{kinds}, got {short(values)}. {hint}")
    return listed


def mapping(
    value: Any, name: str, hint: str, *, least: int = 0, error: type[FlexplantError] = ModelError
) -> dict[Any, Any]:
    """Return a mapping of so many entries at least as a dict."""
    if not isinstance(value, Mapping) or len(value) < least:
        filled = f" with {least} or more entries" if least else ""
        raise error(f"{name} must be a mapping{filled}, got {short(value)}. {hint}")
    return dict(value)


def element_mask(value: Any, name: str) -> npt.NDArray[np.bool_]:
    """Return which elements of a mesh are chosen, some at least."""
    mask = np.asarray(value)
    if mask.dtype != bool or not mask.any():
        raise ShapeError(
            f"{name} must be True or False for each element and choose some, got {short(value)}. "
            "Pass a comparison, x < 0.3, say."
        )
    return mask


def function(value: Any, name: str, hint: str) -> Any:
    """Return what can be called."""
    if not callable(value):
        raise ModelError(f"{name} must be a function, got {short(value)}. {hint}")
    return value
