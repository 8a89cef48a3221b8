"""Harwell-Boeing and Rutherford-Boeing files: a matrix in fixed fields, as Fortran writes it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantError
from ..labels import DofSet
from ..structure import FEMatrices
from .assembled import one_matrix_each
from .foreign_parsers import sound
from .numbers import fixed_numbers, printed_digits, spaced_numbers
from .paths import FORMATS, Format, check_count, check_whole, parsing, refused, unread

#: lines whose digits are counted
_SAMPLE = 4000
#: characters of a line at most; lines of cards have 80
_LINE = 4096
_FORMAT = re.compile(r"\(?\s*(?:\d+P\s*,?\s*)?(\d*)\s*([IEFDG])\s*(\d+)", re.IGNORECASE)


def read_harwell_boeing(
    stiffness: str | Path,
    mass: str | Path | None = None,
    *,
    damping: str | Path | None = None,
    dofs: DofSet | str | Path | None = None,
) -> FEMatrices:
    """Return the matrices of Harwell-Boeing (or Rutherford-Boeing) files.

    Assembled real or integer matrices, symmetric (RSA, of which the file holds the lower triangle)
    or not (RUA). The rest is as in `read_matrix_market`.

    Parameters
    ----------
    stiffness, mass, damping : str or Path
        Files (.rsa, .rua, .hb, .rb) of K, M and D.
    dofs : DofSet, or path of a table for `read_dofs`, optional
        What the rows stand for: the files do not say.

    Raises
    ------
    FlexplantError
        When a file is no Harwell-Boeing file, or cut short.
    ModelError
        When a matrix is complex, skew-symmetric, a pattern, or not assembled.
    ShapeError
        When sizes differ.

    Notes
    -----
    Format: [Duff1992]_, section 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, scipy.io, scipy.sparse, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "K.rua")
    ...     scipy.io.hb_write(path, scipy.sparse.csc_array([[2.0, -1.0], [-1.0, 1.0]]))
    ...     fx.io.read_harwell_boeing(path).K.toarray()
    array([[ 2., -1.],
           [-1.,  1.]])
    """
    return one_matrix_each({"K": stiffness, "M": mass, "D": damping}, _harwell_boeing, dofs)


def _harwell_boeing(path: Path) -> tuple[Any, int | None]:
    content = path.read_bytes()
    lines = content.splitlines()
    try:
        counts = [int(lines[1][i : i + 14] or 0) for i in range(0, 56, 14)]
        kind = lines[2][:3].decode("ascii").upper()
        n_rows, n_columns, n_entries = (int(lines[2][i : i + 14]) for i in (14, 28, 42))
        formats = lines[3].decode("ascii")
        forms = [_fortran_format(formats[a:b]) for a, b in ((0, 16), (16, 32), (32, 52))]
        if min(*counts, n_rows, n_columns, n_entries) < 0:
            raise ValueError("a count below 0")
    except (IndexError, ValueError, UnicodeDecodeError) as error:
        what = f"is no Harwell-Boeing file: its header cannot be read ({error})"
        raise refused(path, what, "Write it again, or give its format another suffix.") from None
    check_count(max(n_rows, n_columns), sum(map(len, lines)), path)
    if kind[:1] not in ("R", "I") or kind[1:2] not in ("S", "U") or kind[2:] != "A":
        do = (
            "Only real or integer (R, I), symmetric or unsymmetric (S, U), assembled (A) matrices "
            "are a stiffness or mass: assemble elemental ones, leave gyroscopic ones out."
        )
        raise unread(path, f"is of kind {kind!r}", do)
    right_hand = 1 if len(lines[1]) >= 70 and lines[1][56:70].strip() not in (b"", b"0") else 0
    first = 4 + right_hand
    blocks = []
    needed = (n_columns + 1, n_entries, n_entries)
    for count, form, size in zip(counts[1:4], forms, needed, strict=True):
        blocks.append(
            _read_number_block(lines[first : first + count], form, size, f"{str(path)!r}", first)
        )
        first += count
    with parsing(path), np.errstate(invalid="raise"):
        pointer, index = (block.astype(np.int64) - 1 for block in blocks[:2])
        matrix: Any = sp.csc_array((blocks[2], index, pointer), shape=(n_rows, n_columns))
        sound(matrix)
    matrix.sum_duplicates()
    if kind[1] == "S":
        matrix = sp.csc_array(matrix + sp.tril(matrix, -1).T + sp.triu(matrix, 1).T)
    if kind[0] == "I":
        return matrix, None
    per_line, width = forms[2]
    start = 4 + right_hand + counts[1] + counts[2]
    sample = lines[start : start + _SAMPLE // max(per_line, 1) + 1]
    words = [line[i : i + width] for line in sample for i in range(0, len(line.rstrip()), width)]
    check_whole(content, words, path)
    return matrix, printed_digits(words)


def _fortran_format(text: str) -> tuple[int, int]:
    """Return numbers a line and the width of one from a Fortran format such as (1P,4E20.12)."""
    match = _FORMAT.search(text)
    if match is None:
        raise ValueError(f"format {text.strip()!r}")
    per_line, width = int(match[1] or 1), int(match[3])
    if not 0 < per_line * width <= _LINE:
        raise ValueError(f"format {text.strip()!r}")
    return per_line, width


def _read_number_block(
    lines: list[bytes], form: tuple[int, int], size: int, source: str, before: int
) -> Any:
    """Return the `size` numbers of a block that follows `before` lines."""
    per_line, width = form
    full = per_line * width
    text = b"".join(line[:full].ljust(full) for line in lines)
    numbers = fixed_numbers(text[: size * width], width) if len(text) >= size * width else None
    if numbers is None:
        # not in the fields that the header names, as some programs write; blanks still separate
        numbers = spaced_numbers(b" ".join(lines), size)
    if numbers is None:
        raise FlexplantError(
            f"{source} holds fewer than {size} numbers in fields of {width} characters"
            f"{_damage(lines, form, size, before)}. Is it cut short, or were its blanks lost?"
        )
    return numbers


def _damage(lines: list[bytes], form: tuple[int, int], size: int, before: int) -> str:
    """Return which line holds something else than numbers, in words; empty when none does."""
    per_line, width = form
    for place, line in enumerate(lines):
        due = max(0, min(per_line, size - place * per_line))
        fields = line[: due * width].ljust(due * width)
        if fixed_numbers(fields, width) is None and spaced_numbers(line, due) is None:
            return f", line {before + place + 1} is {line[:72].decode('latin-1')!r}"
    return ""


FORMATS.append(Format((".rsa", ".rua", ".hb", ".rb"), read_harwell_boeing))
