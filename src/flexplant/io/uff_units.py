"""Units of universal files: labels of axes and dataset 164, brought to SI or refused."""

from __future__ import annotations

import re
from typing import Any

from ..errors import ModelError

#: specific data types of dataset 58
KINDS = {8: "displacement", 11: "velocity", 12: "acceleration"}
ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
_LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6}
_GRAVITY = 9.80665
_FORCES = {"n": 1.0, "kn": 1e3, "mn": 1e-3, "lbf": 4.4482216152605, "nm": 1.0, "n*m": 1.0}
_SECONDS = re.compile(r"\(?s(?:ec)?(?:\^|\*\*)?2?\)?")


def record_scale(
    part: dict[str, Any], factors: dict[str, Any] | None, quantity: str | None, path: str
) -> float:
    """Return the factor that brings a response of dataset 58 to SI.

    Parameters
    ----------
    part : dict
        The record.
    factors : dict or None
        Dataset 164: numbers divided by its factors are in SI.
    quantity : str or None
        What the output is.
    path : str
        For messages.

    Raises
    ------
    ModelError
        When a label is unknown, or contradicts dataset 164.
    """
    above = _label(part, "ordinate_axis_units_lab")
    below = _label(part, "orddenom_axis_units_lab")
    if "/" in above and not below:  # all in one label: m/s^2/N
        head, _, last = above.rpartition("/")
        if last.lower() in _FORCES and not _SECONDS.fullmatch(last):
            above, below = head, last
    length, force = _motion(above, quantity), _FORCES.get(below.lower()) if below else 1.0
    # "nm" is a length above and a moment below; "mn" a millinewton
    if length is None or force is None:
        raise ModelError(
            f"{path!r}: the units of a response are {above or '?'!r} per {below or '?'!r}, which "
            "are not known here. Say what brings the numbers to SI: scale=9.80665 where they are "
            "g/N, scale=1 where they are SI."
        )
    if factors is None:
        return length / force
    to_length, to_force = 1 / float(factors["length"]), 1 / float(factors["force"])
    named_length = to_length if not above else length
    named_force = to_force if not below else force
    if abs(named_length / to_length - 1) > 1e-3 or abs(named_force / to_force - 1) > 1e-3:
        raise ModelError(
            f"{path!r}: the axes say {above!r} per {below!r}, dataset 164 (units) factors "
            f"{factors['length']:g} and {factors['force']:g} for length and force: they contradict "
            "each other. Say what brings the numbers to SI: scale=..."
        )
    return to_length / to_force


def _label(part: dict[str, Any], name: str) -> str:
    text = str(part.get(name) or "").strip().strip("[]").replace(" ", "")
    return "" if text.upper() in ("NONE", "UNKNOWN", "-") else text


def _motion(label: str, quantity: str | None) -> float | None:
    if not label:
        return 1.0
    first, *rest = label.strip("()").replace("²", "2").split("/")
    if any(not _SECONDS.fullmatch(item.lower()) for item in rest):
        return None
    if first == "g" and quantity in ("acceleration", None) and not rest:
        return _GRAVITY
    return (_LENGTHS | _ANGLES).get(first.replace("µ", "u").replace("\xb5", "u"))
