"""The binary form of Nastran OUTPUT4 files, of either byte order."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantError
from ..structure.precision import digits_of
from .op4_text import check_shape, is_thin
from .paths import damaged


@dataclass(frozen=True)
class _MatrixLayout:
    """How integers and record lengths are stored."""

    order: str  # "<" or ">"
    integer: int  # bytes of an integer and of a word: 4 or 8
    marker: int  # bytes of a record length: 4 or 8


def _layout(content: bytes, path: str) -> _MatrixLayout:
    for order in "<>":
        for marker in (8, 4):  # 8 first: in little endian its first half looks like one of 4
            length = int(np.frombuffer(content, f"{order}i{marker}", 1)[0])
            if length in (24, 48):
                return _MatrixLayout(order, length // 6, marker)
    raise FlexplantError(
        f"{path!r}, byte 0: an OUTPUT4 file begins with a record of 24 or 48 bytes, got "
        f"{content[:8].hex(' ')}. It is another format (OUTPUT2?), or was changed in transfer: "
        "copy it in binary mode."
    )


class _Words:
    """The records of a binary file, seen as words."""

    def __init__(self, content: bytes, path: str) -> None:
        self.path, self.content, self.size = path, content, len(content)
        self.layout = _layout(content, path)
        self.kind: Any = np.dtype(f"{self.layout.order}i{self.layout.integer}")
        self.length: Any = np.dtype(f"{self.layout.order}i{self.layout.marker}")
        self.real = (f"{self.layout.order}f{self.layout.integer}", f"{self.layout.order}f8")

    def record(self, at: int) -> tuple[int, int]:
        """Return the first and the last byte + 1 of the record that begins at a byte."""
        marker = self.layout.marker
        order = "little" if self.layout.order == "<" else "big"
        length = int.from_bytes(self.content[at : at + marker], order, signed=True)  # type: ignore[arg-type]
        start = at + marker
        stop = start + length
        if at + marker > self.size or length < 0 or stop + marker > self.size:
            raise FlexplantError(
                f"{self.path!r}, byte {at}: the record of {length} bytes goes beyond the end of "
                f"the file ({self.size} bytes): it is cut off or damaged. Write or copy it again."
            )
        if self.content[at : at + marker] != self.content[stop : stop + marker]:
            what = f"byte {stop}: the record of {length} bytes does not end with its length again"
            raise damaged(self.path, what, "Write or copy it again, in binary mode.")
        return start, stop

    def integers(self, at: int, count: int) -> list[int]:
        form = f"{self.layout.order}{count}{'i' if self.layout.integer == 4 else 'q'}"
        return list(struct.unpack_from(form, self.content, at))


def binary_matrices(content: bytes, path: str) -> Iterable[tuple[str, Any, int, int | None]]:
    """Yield (name, matrix, form, significant digits or None) of each matrix."""
    words = _Words(content, path)
    size, marker = words.layout.integer, words.layout.marker
    at = 0
    while at < words.size:
        start, stop = words.record(at)
        if stop - start != 6 * size:
            due = f"a matrix begins with a record of {6 * size} bytes, got {stop - start}"
            raise damaged(path, f"byte {at}: {due}")
        columns, rows, form, kind = words.integers(start, 4)
        name = _name(content[start + 4 * size : stop].decode("latin-1"))
        if columns < 1 or not rows or kind not in (1, 2, 3, 4) or not name.isprintable():
            got = f"{columns} columns, {rows} rows, type {kind}, name {name!r}"
            raise damaged(path, f"byte {start}: no header of a matrix: {got}")
        check_shape(columns, rows, words.size, path)
        at = stop + marker
        starts: list[int] = []
        stops: list[int] = []
        while True:
            start, stop = words.record(at)
            if stop - start < 3 * size:
                few = f"a column of {name} has {stop - start} bytes, too few for its header"
                raise damaged(path, f"byte {at}: {few}")
            column = words.integers(start, 1)[0]
            at = stop + marker
            if column > columns:
                break
            if column < 1:
                raise damaged(path, f"byte {start}: column {column} of {name}")
            starts.append(start)
            stops.append(stop)
        matrix = _matrix(words, name, (abs(rows), columns), rows < 0, kind, starts, stops)
        yield name, matrix, form, digits_of(np.zeros(0, dtype=words.real[kind % 2 == 0]))


def _name(text: str) -> str:
    """Return the name in a header; words of 8 bytes may hold 4 letters each."""
    clean = text.replace("\0", " ")
    if len(clean) == 16 and clean[8:].strip() and not clean[4:8].strip():
        clean = clean[:4] + clean[8:12]
    return clean.strip()


def _matrix(
    words: _Words,
    name: str,
    shape: tuple[int, int],
    big: bool,
    kind: int,
    starts: list[int],
    stops: list[int],
) -> Any:
    """Return one matrix from the places of its columns.

    A column is (column, first row, words of data) and then the values; the first row is 0 where
    it is sparse, and the data are strings, each with a header: (L + 1, row) in the big form,
    row + 65536 (L + 1) in the other, for L words of values.
    """
    size = words.layout.integer
    dtype: Any = np.dtype(words.real[0] if kind in (1, 3) else words.real[1])
    per = dtype.itemsize * (2 if kind > 2 else 1)
    target = np.complex128 if kind > 2 else np.float64
    value: Any = np.dtype(f"{words.layout.order}c{per}") if kind > 2 else dtype
    heads = [words.integers(start, 3) for start in starts]
    if not heads and not big:
        thin = is_thin(shape, 0)
        return sp.csc_array(shape, dtype=target) if thin else np.zeros(shape, dtype=target)
    if heads and all(row > 0 for _, row, _ in heads):
        parts: list[Any] = []
        thin = is_thin(shape, words.size // per)
        dense = np.zeros((0, 0) if thin else shape, dtype=target, order="F")
        for start, stop, (column, row, _) in zip(starts, stops, heads, strict=True):
            count = (stop - start - 3 * size) // per
            if row - 1 + count > shape[0]:
                raise _outside(words.path, start, name, row - 1 + count, shape)
            part = np.frombuffer(words.content, value, count, start + 3 * size)
            if thin:
                parts.append(
                    (part, np.arange(row - 1, row - 1 + count), np.full(count, column - 1))
                )
            else:
                dense[row - 1 : row - 1 + count, column - 1] = part
        if not thin:
            return dense
        data, rows, places = (np.concatenate(part) for part in zip(*parts, strict=True))
        return sp.csc_array(sp.coo_array((data.astype(target), (rows, places)), shape=shape))
    first = np.array(starts, dtype=np.int64) + 3 * size
    counts = np.clip([count for _, _, count in heads], 0, words.size)  # sums of them must not wrap
    end = np.minimum(first + counts * size, np.array(stops, dtype=np.int64))
    place, length, row, column = _strings(words, first, end, big, per, name)
    column = np.array([c for c, _, _ in heads], dtype=np.int64)[column] - 1
    outside = (row < 1) | (row > shape[0] + 1 - length)
    if np.any(outside):
        bad = int(np.argmax(outside))
        raise _outside(words.path, int(place[bad]), name, int(row[bad] - 1 + length[bad]), shape)
    # strings in the order of columns, as they are in the file
    order = np.argsort(column, kind="stable")
    place, length, row, column = place[order], length[order], row[order], column[order]
    # where each value of each string lies in the file, and which row it is of
    inside = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
    at = np.repeat(place, length) + inside * per
    data = _gather(words.content, at, per).view(value).astype(target)
    rows = np.repeat(row - 1, length) + inside
    counts = np.bincount(column, weights=length, minlength=shape[1])
    pointers = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    matrix = sp.csc_array((data, rows, pointers), shape=shape)
    matrix.sum_duplicates()
    return matrix


def _strings(words: _Words, first: Any, end: Any, big: bool, per: int, name: str) -> Any:
    """Return where each string's values begin, how many there are, their row and their column.

    The strings of a column are a chain; those of all columns are followed at once.
    """
    size = words.layout.integer
    head = 2 * size if big else size
    alive = np.arange(first.size)
    at = first.copy()
    found = []
    while alive.size:
        here = at[alive]
        if np.any(here + head > end[alive]):
            raise _broken(words.path, int(here[np.argmax(here + head > end[alive])]), name)
        numbers = _gather(words.content, here, head).view(words.kind).astype(np.int64)
        if big:
            length, row = numbers.reshape(-1, 2).T - np.array([[1], [0]])
        else:
            length, row = (numbers >> 16) - 1, numbers & 0xFFFF
        wrong = (length < 1) | (length > (end[alive] - here - head) // size)
        bytes_ = np.where(wrong, 0, length) * size  # no product wraps
        wrong |= bytes_ % per != 0
        if np.any(wrong):
            raise _broken(words.path, int(here[np.argmax(wrong)]), name)
        found.append((here + head, bytes_ // per, row, alive))
        at[alive] = here + head + bytes_
        alive = alive[at[alive] < end[alive]]
    if not found:
        return tuple(np.zeros(0, dtype=np.int64) for _ in range(4))
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def _gather(content: bytes, at: Any, width: int) -> Any:
    """Return the `width` bytes at each place, side by side (records are whole 4-byte words)."""
    raw = np.frombuffer(content, np.uint32, len(content) // 4)
    if np.any(at % 4):
        index = at[:, None] + np.arange(width)
        return np.ascontiguousarray(np.frombuffer(content, np.uint8)[index]).reshape(-1)
    index = (at // 4)[:, None] + np.arange(width // 4)
    return np.ascontiguousarray(raw[index]).reshape(-1)


def _outside(path: str, at: int, name: str, row: int, shape: tuple[int, int]) -> FlexplantError:
    return damaged(path, f"byte {at}: a string of {name} reaches row {row} of {shape[0]}")


def _broken(path: str, at: int, name: str) -> FlexplantError:
    what = f"byte {at}: a string of {name} has an impossible length"
    return damaged(path, what, "Write it again (above 65535 rows with BIGMAT=YES).")
