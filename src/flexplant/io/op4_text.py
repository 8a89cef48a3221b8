"""The text form of Nastran OUTPUT4 files."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantError
from .numbers import fixed_numbers
from .paths import check_size, damaged

#: digits of single precision (types 1 and 3), however many are printed
_SINGLE = 7
#: characters of a line at most
_LINE = 4096
_FORMAT = re.compile(r"(?:(\d+)P,?)?\s*(\d+)\s*[EDG](\d+)\.(\d+)")


def text_matrices(content: bytes, path: str) -> list[tuple[str, Any, int, int]]:
    """Return (name, matrix, form, significant digits) of each matrix."""
    reader = _Reader(content.splitlines(), path)
    matrices = []
    while reader.more():
        matrices.append(reader.matrix())
    if not matrices:
        raise reader.wrong("no matrix in the file")
    return matrices


@dataclass
class _Reader:
    """Goes through the lines; `at` is the next one (from 0)."""

    lines: list[bytes]
    path: str
    at: int = 0
    width: int = 0
    per_line: int = 1
    chunks: list[bytes] = field(default_factory=list)
    strings: list[tuple[int, int, int]] = field(default_factory=list)  # column, row, count

    def more(self) -> bool:
        while self.at < len(self.lines) and not self.lines[self.at].strip():
            self.at += 1
        return self.at < len(self.lines)

    def wrong(self, what: str) -> FlexplantError:
        return FlexplantError(
            f"{self.path!r}, line {self.at + 1}: {what}. The file is cut off, damaged or no "
            "OUTPUT4 text. Write it again, or in binary form."
        )

    def line(self) -> bytes:
        if self.at >= len(self.lines):
            raise self.wrong("the file ends inside of a matrix")
        self.at += 1
        return self.lines[self.at - 1]

    def integers(self, line: bytes, widths: tuple[int, ...]) -> list[int]:
        """Return numbers in fields of fixed width: they may touch each other."""
        numbers, start = [], 0
        for width in widths:
            try:
                numbers.append(int(line[start : start + width]))
            except ValueError:
                self.at -= 1
                got = line[:72].decode("latin-1")
                raise self.wrong(f"{len(widths)} whole numbers are due here, got {got!r}") from None
            start += width
        return numbers

    def matrix(self) -> tuple[str, Any, int, int]:
        line = self.line()
        head = (16, 16, 8, 8) if b"I16" in line else (8, 8, 8, 8)
        columns, rows, form, kind = self.integers(line, head)
        rest = line[sum(head) :].decode("latin-1")
        name, shown = rest[:8].strip(), rest[8:].strip().upper()
        match = _FORMAT.search(shown) if shown else _FORMAT.search("5E16.9")
        if columns < 1 or not rows or kind not in (1, 2, 3, 4) or match is None:
            self.at -= 1
            raise self.wrong(
                f"no header of a matrix: {columns} columns, {rows} rows, type {kind}, numbers as "
                f"{shown!r}"
            )
        self.per_line, self.width = int(match[2]), int(match[3])
        if not 0 < self.per_line * self.width <= _LINE:
            self.at -= 1
            raise self.wrong(f"numbers as {shown!r}")
        check_shape(columns, rows, sum(map(len, self.lines)), self.path)
        # Fortran's scale factor 1P puts one digit before the point
        digits = int(match[4]) + (int(match[1]) if match[1] else 0)
        digits = min(digits, _SINGLE) if kind in (1, 3) else digits
        self.chunks, self.strings = [], []
        sparse = rows < 0
        per = 2 if kind > 2 else 1
        # lengths of strings are counted in words of 4 bytes, those of dense columns in values
        words = 1 if kind in (1, 3) else 2
        key = (16, 16, 16) if head[0] == 16 and len(self._peek()) > 24 else (8, 8, 8)
        while True:
            column, row, count = self.integers(self.line(), key)
            if column > columns:
                # one number without a meaning, whatever its count says
                if len(self.line()) < self.width:
                    raise self.wrong("the last number is cut off")
                break
            if column < 1 or count < 1 or row < 0:
                self.at -= 1
                raise self.wrong(f"column {column} of {name} from row {row} with {count} values")
            if row:
                if count % per:
                    self.at -= 1
                    raise self.wrong(f"{count} numbers of a complex column of {name}")
                self._take(count)
                self.strings.append((column, row, count // per))
            else:
                sparse = True
                self._sparse(column, count, words, per, rows < 0)
        matrix = self._assembled((abs(rows), columns), kind > 2, sparse, name)
        return name, matrix, form, digits

    def _peek(self) -> bytes:
        return self.lines[self.at].rstrip() if self.at < len(self.lines) else b""

    def _sparse(self, column: int, left: int, words: int, per: int, big: bool) -> None:
        while left > 0:
            line = self.line()
            if big:
                wide = len(line.rstrip()) > 16
                length, row = self.integers(line, (16, 16) if wide else (8, 8))
                length -= 1
                left -= length + 2
            else:
                (number,) = self.integers(line, (len(line),))
                length, row = (number >> 16) - 1, number & 0xFFFF
                left -= length + 1
            if length < 1 or left < 0 or row < 1 or length % (words * per):
                self.at -= 1
                raise self.wrong(f"a string of {length} words from row {row}")
            self._take(length // words)
            self.strings.append((column, row, length // words // per))

    def _take(self, count: int) -> None:
        """Keep the fields of `count` numbers, which fill the next lines."""
        n_lines = -(-count // self.per_line)
        lines = self.lines[self.at : self.at + n_lines]
        full = self.per_line * self.width
        last = (count - (n_lines - 1) * self.per_line) * self.width
        if len(lines) < n_lines or len(lines[-1]) < last:
            self.at = min(self.at + len(lines), len(self.lines))
            raise self.wrong(f"{count} numbers of {self.width} characters are due before here")
        chunk = b"".join(lines)
        if len(chunk) != count * self.width:  # blanks after the numbers
            chunk = b"".join(line[:full].ljust(full) for line in lines)[: count * self.width]
        self.at += n_lines
        self.chunks.append(chunk)

    def _assembled(self, shape: tuple[int, int], complex_: bool, sparse: bool, name: str) -> Any:
        numbers: Any = fixed_numbers(b"".join(self.chunks), self.width)
        if numbers is None:
            raise FlexplantError(
                f"{self.path!r}, before line {self.at + 1}: matrix {name} holds what is no number. "
                "The file is damaged, or a number too large for its field (***): write it in "
                "binary form."
            )
        if complex_:
            numbers = numbers[0::2] + 1j * numbers[1::2]
        column, row, count = np.array(self.strings, dtype=np.int64).reshape(-1, 3).T
        inside = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        rows = np.repeat(row - 1, count) + inside
        if rows.size and rows.max() >= shape[0]:
            reached = f"matrix {name} reaches row {int(rows.max()) + 1} of {shape[0]}"
            raise damaged(self.path, f"before line {self.at + 1}: {reached}")
        columns = np.repeat(column - 1, count)
        if sparse or is_thin(shape, numbers.size):
            return sp.csc_array(sp.coo_array((numbers, (rows, columns)), shape=shape))
        dense = np.zeros(shape, dtype=numbers.dtype, order="F")
        dense[rows, columns] = numbers
        return dense


#: entries that are kept dense however few of them the file holds
_SMALL = 2**20
#: a dense matrix may take so many times the numbers in the file
_TIMES = 16


def check_shape(columns: int, rows: int, held: int, path: str) -> None:
    """Refuse a size of a matrix that a file of `held` bytes cannot hold."""
    check_size(max(columns, abs(rows)), held, path)


def is_thin(shape: tuple[int, int], held: int) -> bool:
    """Return whether a matrix of which the file holds so many numbers is too large to be dense."""
    return shape[0] * shape[1] > max(_SMALL, _TIMES * held)
