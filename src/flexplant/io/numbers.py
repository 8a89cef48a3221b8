"""Numbers out of text written by Fortran: fixed fields, exponents with D or without a letter."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..checks import FloatArray

#: characters of a number that a program printed, at least; shorter ones may be typed by hand
_PRINTED = 12
#: numbers of fewer digits may be exact; longer ones were rounded to so many digits
_ROUNDED = 6
#: digits that a sign and one more digit of the exponent take from a number in a fixed field
_FIELD = 2
#: part of the numbers that have all digits: fewer end in several zeros by chance
_ALIKE = 0.6
#: a number of so many digits was printed in double precision, however short the others are
_DOUBLE = 15
#: an exponent without its letter: 1.5-100, 3.+7
_BARE = re.compile(rb"([\d.])([+-]\d)")
_DECIMAL = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+))(?:[eEdDqQ]([+-]?[0-9]+)|([+-][0-9]+))?")
_DIGITS = re.compile(rb"[+-]?0*(\d*)\.?(\d*)")


def decimal(text: str) -> float:
    """Return a decimal number as Fortran or C writes it: 7.5, 7.5e3, 7.5D+03, 7.5+03."""
    match = _DECIMAL.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text.strip()!r:.40} is no decimal number")
    return float(f"{match[1]}e{match[2] or match[3] or 0}")


def fixed_numbers(text: bytes, width: int) -> FloatArray | None:
    """Return the numbers in fields of `width` characters, None when one is no number."""
    fields = np.frombuffer(text, np.uint8).reshape(-1, width)
    shown = np.zeros((fields.shape[0], width + 1), dtype=bool)
    shown[:, 1:] = fields != ord(" ")
    # one number in each: a blank within a field beside an empty field would shift all that follow
    if np.any(np.count_nonzero(shown[:, 1:] & ~shown[:, :-1], axis=1) != 1):
        return None
    return spaced_numbers(_separated(fields).tobytes(), len(fields))


def _separated(fields: Any) -> Any:
    spaced = np.full((fields.shape[0], fields.shape[1] + 1), ord(" "), dtype=np.uint8)
    spaced[:, :-1] = fields
    return spaced


def spaced_numbers(text: bytes, count: int | None = None) -> FloatArray | None:
    """Return the numbers of a text that separates them with spaces or line ends.

    None when one is no number, or there are not `count`.
    """
    clean = text.translate(_LETTERS)
    seen = np.frombuffer(clean, np.uint8)
    signs = np.flatnonzero((seen[1:] == ord("+")) | (seen[1:] == ord("-")))
    before = seen[signs]
    if np.any((before >= ord("0")) & (before <= ord("9")) | (before == ord("."))):
        clean = _BARE.sub(rb"\1e\2", clean)
    numbers = _parse_numbers(clean)
    return None if numbers is None or (count is not None and numbers.size != count) else numbers


def rows_of_numbers(text: bytes, width: int) -> FloatArray | None:
    r"""Return the numbers (m, width) of m lines, None when a line does not hold `width` numbers."""
    seen = np.frombuffer(text, np.uint8)
    shown = np.zeros(seen.size + 1, dtype=bool)
    shown[1:] = (seen > ord(" ")) & (seen != 127)
    starts = np.flatnonzero(shown[1:] & ~shown[:-1])
    ends = np.append(np.flatnonzero(seen == ord("\n")), seen.size)
    held = np.diff(np.searchsorted(starts, ends), prepend=0)
    if np.any((held != width) & (held != 0)):
        return None
    numbers = spaced_numbers(text, starts.size)
    return None if numbers is None else numbers.reshape(-1, width)


def wrong_line(lines: Iterable[bytes], width: int) -> int | None:
    """Return the place (from 0) of the first line that does not hold `width` finite numbers."""
    for place, line in enumerate(lines):
        words = line.decode("latin-1").split()
        try:
            if words and len([decimal(word) for word in words]) != width:
                return place
        except ValueError:
            return place
    return None


_LETTERS = bytes.maketrans(b"DdEQ", b"eeee")


def _parse_numbers(text: bytes) -> FloatArray | None:
    with warnings.catch_warnings():
        # what NumPy says when it stops before the end
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.asarray(np.fromstring(text.decode("latin-1"), sep=" "), dtype=np.float64)
        except (DeprecationWarning, ValueError):
            return None


def printed_digits(words: Iterable[bytes]) -> int | None:
    """Return with how many significant digits numbers were printed; None where that does not show.

    A program that rounds prints all numbers alike: in a fixed field, up to the places that sign and
    exponent take, or with as many digits, less the zeros at the end. Numbers of a few digits, such
    as 5 or 2.5, and some long ones among them, may be exact.
    """
    found = []
    for word in words:
        match = _DIGITS.match(word.strip())
        if match:
            whole, part = match[1], match[2]
            found.append(len(whole) + len(part if whole else part.lstrip(b"0")))
    counts = [count for count in found if count]
    most = max(counts, default=0)
    alike = sum(count >= most - _FIELD for count in counts) >= _ALIKE * len(counts)
    return most if most >= _DOUBLE or (most >= _ROUNDED and alike) else None


def cut_short(content: bytes, words: Iterable[bytes]) -> bool:
    r"""Return whether a text ends, without a line end, in a number shorter than all others.

    A number without its last digits still is a number.
    """
    last = content[-80:].split()[-1:]
    if content.endswith((b"\n", b"\r")) or not last:
        return False
    # the last itself may be among them
    others = [len(word) for word in (w.strip().lstrip(b"+-") for w in words) if word not in last[0]]
    return bool(others) and len(last[0].lstrip(b"+-")) < min(others) >= _PRINTED
