"""Names, units and texts: their checks, and numbers in words."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import constants

from .errors import FlexplantError, LabelError, ModelError, ShapeError, short

_PREFIXES = (
    (constants.femto, "f"),
    (constants.pico, "p"),
    (constants.nano, "n"),
    (constants.micro, "\N{MICRO SIGN}"),
    (constants.milli, "m"),
    (1.0, ""),
    (constants.kilo, "k"),
    (constants.mega, "M"),
)
#: units that take a prefix, alone or before others: m^2, N m, rad/s
_PREFIXED = re.compile(r"(m|g|s|N|rad|Hz|V|A|W|J|Pa|T)(?:\^(\d))?(?![A-Za-z])")
#: number of names, rows or findings that a text shows of many
SHOWN = 4


def known_units(units: Any, names: Iterable[str]) -> dict[str, str]:
    """Return the units of some channels; those of other names are left out."""
    if not isinstance(units, Mapping) or not all(isinstance(u, str) for u in units.values()):
        raise ModelError(
            f"units must be a mapping {{channel: unit}}, got {short(units)}: {{'y1': 'm'}}."
        )
    return {name: units[name] for name in names if name in units}


def in_unit(size: float, unit: str | None) -> tuple[float, str]:
    """Return the factor and the unit with its SI prefix that bring a size to 1 .. 1000."""
    base, per = (unit[1:], 1e-3) if unit and unit.startswith("kg") else (unit or "", 1.0)
    head = _PREFIXED.match(base)
    if head is None or not size or not np.isfinite(size):
        return 1.0, unit or ""
    power = int(head[2] or 1)
    known = ((factor**power, prefix) for factor, prefix in _PREFIXES)
    most = size / (per * 1e3**power) * (1.0 + 1e-9)  # 1e-6 m is 1 um, whatever rounding says
    factor, prefix = next((s for s in known if most < s[0]), (1e6**power, "M"))
    return per * factor, prefix + base


def with_unit(value: float, unit: str | None) -> str:
    """Return a number in words: `0.527 nm`; without a unit as it is."""
    factor, shown = in_unit(abs(value), unit)
    return f"{value / factor:.3g} {shown}".rstrip()


def with_deviation(value: float, deviation: float | None) -> str:
    """Return a number in words, without digits below its standard deviation."""
    if deviation is None:
        return f"{value:.7g}"
    known = 7
    if value and deviation > 0 and np.isfinite(deviation):
        known = min(max(int(np.floor(np.log10(abs(value) / deviation))) + 2, 1), 7)
    return f"{value:.{known}g} +- {deviation:.2g}"


def sizes_of(sizes: Mapping[str, float], units: Mapping[str, str], most: int = 4) -> str:
    """Return sizes of channels in words, `die:z 0.527 nm, die:rx 3.1 nrad`, and how many more."""
    shown = [f"{name} {with_unit(size, units.get(name))}" for name, size in sizes.items()]
    more = [f"... ({len(shown) - most} more)"] if len(shown) > most else []
    return ", ".join(shown[:most] + more)


def flag(value: Any, name: str) -> bool:
    """Return `value` as a bool; it must be True or False, not a number."""
    if not isinstance(value, bool | np.bool_):
        raise ModelError(f"{name} must be True or False, got {short(value)}. Pass one of them.")
    return bool(value)


def instance(
    value: Any, kind: Any, name: str, hint: str, error: type[FlexplantError] = ModelError
) -> Any:
    """Return `value`, which must be of a class, or of one of several."""
    if not isinstance(value, kind) or (kind is Iterable and not several(value)):
        listed = [one.__name__ for one in getattr(kind, "__args__", (kind,))]
        kinds = " or ".join(name for name in listed if name != "NoneType")
        raise error(f"{name} must be of type {kinds}, got {type(value).__name__}. {hint}")
    return value


def one_of(value: Any, name: str, choices: Iterable[str]) -> str:
    """Return the allowed text that `value` is equal to; an underscore counts as a space."""
    listed = list(choices)
    if isinstance(value, str) and value in listed:
        return value
    spaced = [one for one in listed if isinstance(value, str) and one == value.replace("_", " ")]
    if not spaced:
        raise ModelError(f"{name} must be one of {listed}, got {short(value)}. Pass one of them.")
    return spaced[0]


def signal_names(names: Iterable[str], count: int, prefix: str, side: str) -> tuple[str, ...]:
    """Return `count` unique signal names, `prefix1`, `prefix2`, ... when none are given."""
    listed = name_list(names, side) if names is not None else ()
    if not listed:
        return tuple(f"{prefix}{i}" for i in range(1, count + 1))
    if len(listed) != count:
        raise ShapeError(
            f"{count} {side} need {count} names, got {len(listed)}: {short(listed)}. Name each "
            f"once, or none to have {prefix}1, {prefix}2, ..."
        )
    check_names(listed, side)
    return listed


def several(value: Any) -> bool:
    """Return whether a value is iterable (a list, a generator, an array), but not a text."""
    if isinstance(value, str | bytes) or (isinstance(value, np.ndarray) and not value.ndim):
        return False
    return isinstance(value, Iterable)


def as_list(items: Any, name: str, form: str) -> list[Any]:
    """Return items as a list; LabelError when there is nothing to list."""
    if not several(items):
        raise LabelError(f"{name} must be {form}, got {items!r:.60}. Pass it in [...].")
    return list(items)


def name_list(names: Any, name: str) -> tuple[str, ...]:
    """Return names as a tuple of str; one str is one name."""
    if type(names) is tuple and set(map(type, names)) <= {str}:
        return names
    if isinstance(names, str):
        return (names,)
    if not several(names):
        raise LabelError(f"{name} are chosen by name, got {short(names)}. Pass a list of names.")
    listed = tuple(names)
    wrong = [one for one in listed if not isinstance(one, str)]
    if wrong:
        raise LabelError(
            f"{name} are chosen by name, got {short(wrong[0])} among them. Pass a list of names."
        )
    return tuple(str(one) for one in listed)


def inner_names(names: Iterable[str], taken: Iterable[str]) -> tuple[str, ...]:
    """Return internal names, lengthened by '|' until they differ from all names of the user."""
    found, known = tuple(names), set(taken)
    while not known.isdisjoint(found):
        found = tuple(f"{name}|" for name in found)
    return found


def check_names(names: Sequence[str], side: str) -> None:
    """Raise LabelError unless the names are unique and of the allowed form."""
    text = "\n".join(["", *names, ""])
    if not ("." in text or "\n-" in text or "\n\n" in text) and len(set(names)) == len(names):
        return
    for name in names:
        if not name or "." in name or name.startswith("-"):
            raise LabelError(
                f"{name!r} cannot name one of the {side}: names are not empty, hold no '.' and do "
                "not begin with '-' (python-control refuses those). Rename it."
            )
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise LabelError(
            f"the {side} hold {doubled} more than once: names select channels, so each must be "
            "unique. Rename all but one."
        )


def members(values: Any, kind: Any, name: str, hint: str, *, least: int = 1) -> tuple[Any, ...]:
    """Return several values as a tuple, all of a class."""
    listed = tuple(values) if several(values) else ()
    if (
        not several(values)
        or len(listed) < least
        or not all(isinstance(one, kind) for one in listed)
    ):
        kinds = " or ".join(one.__name__ for one in getattr(kind, "__args__", (kind,)))
        many = "" if not least else "at least one " if least == 1 else f"at least {least} "
        raise ModelError(f"{name} must be a list of {many}{kinds}, got {short(values)}. {hint}")
    return listed


def mapping(
    value: Any,
    name: str,
    hint: str,
    *,
    least: int = 0,
    kind: Any = object,
    error: type[FlexplantError] = ModelError,
) -> dict[Any, Any]:
    """Return a mapping with a least number of entries, all of a class, as a dict."""
    if not isinstance(value, Mapping) or len(value) < least:
        filled = f" with {least} or more entries" if least else ""
        raise error(f"{name} must be a mapping{filled}, got {short(value)}. {hint}")
    return {
        key: instance(one, kind, f"{key!r} of {name}", hint, error) for key, one in value.items()
    }


def why_not_called(function: Any, *arguments: Any) -> str:
    """Return why a function does not take such arguments; empty if it does, or cannot be told."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        return str(error)
    except ValueError:  # a function of C has no signature
        pass
    return ""


def function(value: Any, name: str, hint: str) -> Any:
    """Return `value`, which must be callable."""
    if not callable(value):
        raise ModelError(f"{name} must be a function, got {short(value)}. {hint}")
    return value
