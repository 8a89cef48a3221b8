"""Everything that flexplant raises or warns with, and texts of names, numbers and units.

::

    FlexplantError
    ├── LabelError       (ValueError)    a name or a point that the model does not have
    ├── ShapeError       (ValueError)    arrays whose sizes do not belong together
    ├── ModelError       (ValueError)    a model that is not physical, or not what is needed here
    ├── AssumptionError  (ValueError)    a standard assumption of the design does not hold
    ├── InfeasibleError  (RuntimeError)  no solution of the required quality exists
    ├── SolverError      (RuntimeError)  a numerical method did not reach its own tolerance
    └── CertificateError (RuntimeError)  an answer failed the check by another route
    FlexplantWarning     (UserWarning)

In all functions an unknown name raises a `LabelError`, sizes that do not match raise a
`ShapeError`, and a value out of range raises a `ModelError`. The section Raises of a function lists
further cases. Every message says what is wrong, which value was given, why it matters and what to
do next. If an internal attempt fails and another method replaces it, this is not an error. The
logger ``logging.getLogger("flexplant")`` reports it at the level INFO
(``logging.basicConfig(level="INFO")`` shows it).
"""

import logging
import re
import sys
import warnings
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import numpy as np
from scipy import constants

__all__ = [
    "AssumptionError",
    "CertificateError",
    "FlexplantError",
    "FlexplantWarning",
    "InfeasibleError",
    "LabelError",
    "ModelError",
    "ShapeError",
    "SolverError",
]

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


def __dir__() -> list[str]:
    return __all__


class FlexplantError(Exception):
    """Base of all errors of this package.

    Examples
    --------
    >>> import flexplant as fx
    >>> try:
    ...     fx.testbeds.three_masses().system["y3", "u1"]
    ... except fx.FlexplantError as error:
    ...     print(type(error).__name__)
    LabelError
    """


class LabelError(FlexplantError, ValueError):
    """A name or a point is unknown, doubled or not allowed."""


class ChannelError(LabelError, KeyError):
    """A record or an estimate does not have a channel; also a KeyError, as for any Mapping."""

    __str__ = Exception.__str__


class ShapeError(FlexplantError, ValueError):
    """The sizes of the arrays do not belong together."""


class ModelError(FlexplantError, ValueError):
    """The model is not physical (for example an indefinite M) or not suitable for the operation."""


class AssumptionError(FlexplantError, ValueError):
    """A standard assumption of the design does not hold."""


class InfeasibleError(FlexplantError, RuntimeError):
    """No solution of the required quality exists."""


class SolverError(FlexplantError, RuntimeError):
    """A numerical method did not reach its own tolerance."""


class CertificateError(FlexplantError, RuntimeError):
    """A computed answer failed its check by another route."""

    def __init__(self, *said: object) -> None:
        super().__init__(*said)
        self.add_note(
            "Where the input is right this is a mistake of flexplant: report it, with what "
            "flexplant.show_versions() prints."
        )


class FlexplantWarning(UserWarning):
    """A result that the caller should use with care.

    Examples
    --------
    >>> import flexplant as fx
    >>> import warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", fx.FlexplantWarning)  # of this library alone
    >>> issubclass(fx.FlexplantWarning, UserWarning)
    True
    """


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 mode`, `2 modes`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def named_modes(numbers: Iterable[int | str]) -> str:
    """Return modes with their noun: `mode 7`, `modes 7, 8`."""
    names = [*map(str, numbers)]
    return f"mode{'s' * (len(names) > 1)} {some_names(names, total=False)}"


def some_names(names: Sequence[str], most: int = 6, *, total: bool = True) -> str:
    """Return the first names as text, and, if there are more, the number of all."""
    more = f", ...{f' ({len(names)} in all)' if total else ''}" if len(names) > most else ""
    return ", ".join(names[:most]) + more


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


def aligned(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return a table: names (the first column, and what has no head) flush left, others right."""
    columns = list(zip(head, *rows, strict=True))
    columns = [column for column in columns if any(column[1:])] or columns  # none of empty cells
    sides = ["<" if not i or not column[0] else ">" for i, column in enumerate(columns)]
    wide = [max(map(len, column)) for column in columns]
    form = "  ".join(f"{{:{side}{width}}}" for side, width in zip(sides, wide, strict=True))
    return [form.format(*row).rstrip() for row in zip(*columns, strict=True)]


def plain_repr(value: Any) -> str:
    """Return the repr of a value without addresses, so that it is equal in each process."""
    if isinstance(value, BuiltinFunctionType | FunctionType | MethodType):
        return f"{value.__module__}.{value.__qualname__}"
    if isinstance(value, set | frozenset):
        return f"{{{', '.join(sorted(map(plain_repr, value)))}}}"
    return re.sub(r" at 0x[0-9A-Fa-f]+", "", repr(value))


def short(value: Any) -> str:
    """Return a value for a message: its repr, cut after 80 characters; arrays by their shape."""
    if isinstance(value, np.ndarray) and value.size > 6:
        return f"an array of shape {value.shape}"
    try:
        text = " ".join(plain_repr(value).split())
    except ValueError:  # Python writes no integer of more than 4300 digits
        text = f"a {type(value).__name__} that is too long to write"
    return text if len(text) <= 80 else text[:77] + "..."


@contextmanager
def attempted(
    what: str, kind: type[Exception] | tuple[type[Exception], ...] = FlexplantError
) -> Iterator[None]:
    """Suppress an error of an optional attempt, and report it in the log of "flexplant".

    Examples
    --------
    >>> with attempted("a factor in single precision", SolverError):
    ...     raise SolverError("a pivot is zero")
    """
    try:
        yield
    except kind as error:
        logging.getLogger("flexplant").info("%s failed and is dropped: %s", what, error)


def warn(said: str) -> None:
    """Warn with a FlexplantWarning, at the line outside this package that led there."""
    level, frame = 2, sys._getframe(1)
    inner = (__package__, "contextlib")  # that of decorators
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(inner):
        level, frame = level + 1, frame.f_back
    warnings.warn(said, FlexplantWarning, level)


def unknown_label(kind: str, name: object, known: Iterable[str], owner: str = "") -> LabelError:
    """Return the LabelError for an unknown `name`, with the closest known ones.

    Examples
    --------
    >>> print(unknown_label("DOF", "41:zz", ["41:z", "4:z"]))
    no DOF '41:zz' (2 known). Close matches: '41:z', '4:z'.
    """
    known = list(known)
    if not known:
        return LabelError(f"no {kind} {name!r}{f' in {owner}' if owner else ''}: none exists yet.")
    close = get_close_matches(str(name), [k for k in known if isinstance(k, str)], n=3, cutoff=0.5)
    shown = close or known[:6]
    listed = ", ".join(repr(label) for label in shown) + (
        ", ..." if not close and len(known) > len(shown) else ""
    )
    lead = "Close matches" if close else "Known are"
    where = f" in {owner}" if owner else ""
    return LabelError(f"no {kind} {name!r}{where} ({len(known)} known). {lead}: {listed}.")


def unknown_attribute(owner: str, name: str, known: Iterable[str]) -> AttributeError:
    """Return the AttributeError for a name that a value does not have, with those near to it.

    Examples
    --------
    >>> print(unknown_attribute("ClosedLoop", "margins", ["modulus_margin", "rms"]))
    ClosedLoop has no 'margins'. Close matches: modulus_margin. dir() of it lists all.
    >>> print(unknown_attribute("Response", "plot", ["rms"]))
    Response has no 'plot'. Pictures are functions: flexplant.plot. dir() of it lists all.
    """
    listed = sorted(n for n in known if not n.startswith("_"))
    near = f" Close matches: {', '.join(close)}." if (close := _similar_names(name, listed)) else ""
    if name.startswith("plot"):
        near = " Pictures are functions: flexplant.plot."
    return AttributeError(f"{owner} has no {name!r}.{near} dir() of it lists all.")


def _similar_names(name: str, listed: list[str]) -> list[str]:
    """Return up to four names of a list that look like another, or contain it."""
    stem = name.rstrip("s").lower()
    within = [n for n in listed if len(stem) > 2 and (stem in n or n.rstrip("s") in name)]
    return list(dict.fromkeys([*get_close_matches(name, listed, n=3, cutoff=0.6), *within]))[:4]


def only_one(kind: str, names: Iterable[str], given: Any, how: str) -> str:
    """Return the given one of some names, or the only one; LabelError if there are several."""
    known = list(names)
    if given is not None:
        require_known(kind, [given], known)
    elif not known:
        raise LabelError(f"the plant has no {kind}. Add one to its ports, or say {how}.")
    elif len(known) != 1:
        named = repr(known[0]) if how.endswith("=") else ""
        listed = f"{counted(len(known), kind)} ({some_names(known)})"
        raise LabelError(f"there are {listed}: say which, {how}{named}.")
    return known[0] if given is None else str(given)


def require_known(
    kind: str, names: Iterable[object], known: Iterable[object], owner: str = ""
) -> None:
    """Raise the LabelError of `unknown_label` for the first of some names that is not known."""
    listed = list(known)
    for name in names:
        if not isinstance(name, Hashable) or name not in listed:
            raise unknown_label(kind, name, map(str, listed), owner)
