"""Numbers out of text written by Fortran: fixed fields, exponents with D or without a letter."""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np

from ..values import FloatArray

#: an exponent without its letter: 1.5-100, 3.+7
_BARE = re.compile(rb"([\d.])([+-]\d)")
_DIGITS = re.compile(rb"[+-]?0*(\d*)\.?(\d*)")


def fixed_numbers(text: bytes, width: int) -> FloatArray | None:
    """Return the numbers in fields of `width` characters, None when one is no number.

    Parameters
    ----------
    text : bytes
        The fields side by side; numbers of neighbours may touch.
    width : int
        Characters of a field.

    Examples
    --------
    >>> fixed_numbers(b" 1.5D+00-2.5E+00", 8)
    array([ 1.5, -2.5])
    """
    fields = np.frombuffer(text, np.uint8).reshape(-1, width)
    return spaced_numbers(_separated(fields).tobytes(), len(fields))


def _separated(fields: Any) -> Any:
    spaced = np.full((fields.shape[0], fields.shape[1] + 1), ord(" "), dtype=np.uint8)
    spaced[:, :-1] = fields
    return spaced


def spaced_numbers(text: bytes, count: int | None = None) -> FloatArray | None:
    """Return the numbers of a text that separates them with spaces or line ends.

    None when one is no number, or there are not `count`.

    Parameters
    ----------
    text : bytes
        Exponents may be written as 1e5, 1d5 or 1+5.
    count : int, optional
        How many there must be.
    """
    clean = text.translate(_LETTERS)
    numbers = _parsed(clean)
    if numbers is None or (count is not None and numbers.size != count):
        numbers = _parsed(_BARE.sub(rb"\1e\2", clean))
    return None if numbers is None or (count is not None and numbers.size != count) else numbers


_LETTERS = bytes.maketrans(b"DdEQ", b"eeee")


def _parsed(text: bytes) -> FloatArray | None:
    with warnings.catch_warnings():
        # what NumPy says when it stops before the end
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.asarray(np.fromstring(text.decode("latin-1"), sep=" "), dtype=np.float64)
        except (DeprecationWarning, ValueError):
            return None


def printed_digits(words: list[bytes]) -> int:
    """Return how many significant digits the longest of some printed numbers has.

    Parameters
    ----------
    words : list of bytes
        Numbers as printed.

    Examples
    --------
    >>> printed_digits([b"1.5", b"-3.245226567D+06"])
    10
    """
    found = 0
    for word in words:
        match = _DIGITS.match(word.strip())
        if match:
            whole, part = match[1], match[2]
            found = max(found, len(whole) + len(part if whole else part.lstrip(b"0")))
    return found
