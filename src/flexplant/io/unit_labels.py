"""Labels of units from measuring systems, and their size in SI."""

from __future__ import annotations

import re

from scipy import constants

from ..lti.frequency import PER_TIME
from ..structure.unit_systems import GRAVITY, LENGTHS, POUND

#: prefixes of SI are case-sensitive: mN is a millinewton and MN a meganewton
PREFIXES = {
    "": 1.0,
    "M": constants.mega,
    "k": constants.kilo,
    "m": constants.milli,
    "u": constants.micro,
    "n": constants.nano,
}


def prefixed(unit: str, prefixes: str) -> dict[str, float]:
    """Return the sizes of a unit with and without some prefixes, by label."""
    return {f"{prefix}{unit}": PREFIXES[prefix] for prefix in ("", *prefixes)}


_LENGTHS = {**LENGTHS, **prefixed("m", "n")}
_ANGLES = prefixed("rad", "mu")
#: nm is a length, Nm a moment
_OTHERS = {
    label: (size, unit)
    for unit, sizes in {
        "N": prefixed("N", "kmM") | {"lbf": POUND * GRAVITY},
        "N m": prefixed("Nm", "") | prefixed("N*m", ""),
        "V": prefixed("V", "m"),
        "A": prefixed("A", "m"),
        "m/s^2": {"g": GRAVITY},
    }.items()
    for label, size in sizes.items()
}
_TIMES = prefixed("s", "mu") | prefixed("sec", "") | prefixed("seconds", "")
_SECONDS = re.compile(r"\(?s(?:ec)?((?:\^|\*\*)?2)?\)?")


def plain_label(text: str) -> str:
    """Return a label without blanks and brackets, its signs those of ASCII; empty for none."""
    label = text.strip().strip("[]").replace(" ", "").replace("²", "^2").replace("·", "*")
    label = label.replace("µ", "u").replace("\u03bc", "u")
    return "" if label.upper() in ("NONE", "UNKNOWN", "-") else label


def unit_of(text: str) -> tuple[float, str] | None:
    """Return the size in SI of one of a unit, and the unit of SI; None where it is not known."""
    label = plain_label(text)
    while label[:1] == "(" and label[-1:] == ")":
        label = label[1:-1]
    if label in _OTHERS:
        return _OTHERS[label]
    first, *rest = label.split("/")
    size = (_LENGTHS | _ANGLES).get(first)
    found = [_SECONDS.fullmatch(item.lower()) for item in rest]
    if size is None or not all(found):
        return None
    order = sum(2 if match and match[1] else 1 for match in found)
    if order >= len(PER_TIME):
        return None
    return size, ("rad" if first in _ANGLES else "m") + PER_TIME[order]


def seconds_of(text: str) -> float | None:
    """Return the size of a unit of time [s], 1 where none is named."""
    label = plain_label(text).lower()
    return 1.0 if not label else _TIMES.get(label)


def density_of(text: str) -> float | None:
    """Return the factor of a power spectral density to SI: (m/s^2)^2/Hz, g^2/Hz."""
    label = plain_label(text)
    match = re.fullmatch(r"(.*?)(?:\^|\*\*)?2?/Hz", label)
    squared = re.fullmatch(r"\(?(.*?)\)?(?:\^|\*\*)2/Hz", label)
    if match is None or squared is None:
        return None
    unit = unit_of(squared[1])
    return None if unit is None else unit[0] ** 2
