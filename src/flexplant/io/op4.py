"""Nastran OUTPUT4 files, binary and text, dense and sparse, of either byte order."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from ..arrays import name_list
from ..errors import FlexplantError, ModelError, require_known
from ..labels import DofSet
from ..structure.definite import digits_of
from ..structure.matrices import FEMatrices, completed
from .files import FORMATS, LINE, USUAL, Format, check_count, damaged, file_path, fixed_numbers
from .nastran import named_matrices


class _Words:
    """The records of a binary file, seen as words of either byte order."""

    def __init__(self, content: bytes, path: str) -> None:
        self.path, self.content, self.size = path, content, len(content)
        for order in "<>":
            for marker in (8, 4):  # 8 first: in little endian its first half looks like one of 4
                length = int(np.frombuffer(content, f"{order}i{marker}", 1)[0])
                if length in (24, 48):
                    #: byte order; bytes of an integer or word, and of the length of a record
                    self.order, self.integer, self.marker = order, length // 6, marker
                    self.real = (f"{order}f{self.integer}", f"{order}f8")
                    return
        raise FlexplantError(
            f"{path!r}, byte 0: an OUTPUT4 file begins with a record of 24 or 48 bytes, got "
            f"{content[:8].hex(' ')}. It is another format (OUTPUT2?), or was changed in transfer: "
            "copy it in binary mode."
        )

    def record(self, at: int) -> tuple[int, int]:
        """Return the first and the last byte + 1 of the record that begins at a byte."""
        marker, order = self.marker, "little" if self.order == "<" else "big"
        length = int.from_bytes(self.content[at : at + marker], order, signed=True)  # type: ignore[arg-type]
        start = at + marker
        stop = start + length
        if start > self.size or length < 0 or stop + marker > self.size:
            raise FlexplantError(
                f"{self.path!r}, byte {at}: the record of {length} bytes goes beyond the end of "
                f"the file ({self.size} bytes): it is cut off or damaged. Write or copy it again."
            )
        if self.content[at : at + marker] != self.content[stop : stop + marker]:
            what = f"byte {stop}: the record of {length} bytes does not end with its length again"
            raise damaged(self.path, what, "Write or copy it again, in binary mode.")
        return start, stop

    def integers(self, at: int, count: int) -> list[int]:
        form = f"{self.order}{count}{'i' if self.integer == 4 else 'q'}"
        return list(struct.unpack_from(form, self.content, at))


def binary_matrices(content: bytes, path: str) -> Iterable[tuple[str, Any, int, int | None]]:
    """Yield (name, matrix, form, significant digits or None) of each matrix."""
    words = _Words(content, path)
    size, marker = words.integer, words.marker
    at = 0
    while at < words.size:
        start, stop = words.record(at)
        if stop - start != 6 * size:
            due = f"a matrix begins with a record of {6 * size} bytes, got {stop - start}"
            raise damaged(path, f"byte {at}: {due}")
        columns, rows, form, kind = words.integers(start, 4)
        name = _header_name(content[start + 4 * size : stop].decode("latin-1"))
        if columns < 1 or not rows or kind not in (1, 2, 3, 4) or not name.isprintable():
            got = f"{columns} columns, {rows} rows, type {kind}, name {name!r}"
            raise damaged(path, f"byte {start}: not a header of a matrix: {got}")
        check_count(max(columns, abs(rows)), words.size, path)
        at = stop + marker
        places: list[tuple[int, int]] = []
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
            places.append((start, stop))
        matrix = _matrix(words, name, (abs(rows), columns), rows < 0, kind, places)
        yield name, matrix, form, digits_of(np.zeros(0, dtype=words.real[kind % 2 == 0]))


def _header_name(text: str) -> str:
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
    places: list[tuple[int, int]],
) -> Any:
    """Return one matrix from the places of its columns."""
    # a column begins with (column, first row, number of words); the values follow. In a sparse
    # matrix the first row is 0, and the values are in strings with a header each: for L words of
    # values (L + 1, row) in the big form, and row + 65536 (L + 1) in the other form
    size, dtype = words.integer, np.dtype(words.real[0] if kind in (1, 3) else words.real[1])
    per = dtype.itemsize * (2 if kind > 2 else 1)
    value: Any = np.dtype(f"{words.order}c{per}") if kind > 2 else dtype
    column, row, counts = (
        np.array([words.integers(start, 3) for start, _ in places], np.int64).reshape(-1, 3).T
    )
    starts, stops = np.array(places, dtype=np.int64).reshape(-1, 2).T
    first = starts + 3 * size
    dense = bool(np.all(row > 0)) and not (big and not places)
    if dense:
        place, length = first, (stops - first) // per
    else:
        held = np.clip(counts, 0, words.size)  # sums of them must not wrap
        place, length, row, of = _strings(
            words, first, np.minimum(first + held * size, stops), big, per, name
        )
        column = column[of]
    outside = (row < 1) | (row > shape[0] + 1 - length)
    if np.any(outside):
        bad = int(np.argmax(outside))
        raise _outside(
            words.path, f"byte {place[bad]}", name, int(row[bad] - 1 + length[bad]), shape
        )
    target: Any = np.complex128 if kind > 2 else np.float64
    if dense:  # each string at its place in the file, without a copy
        each = zip(length.tolist(), place.tolist(), strict=True)
        numbers = [np.frombuffer(words.content, value, n, at) for n, at in each]
    else:
        inside = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
        at = np.repeat(place, length) + inside * per
        numbers = [_gather(words.content, at, per).view(value)]
    return _placed((column, row, length), numbers, shape, target, sparse=not dense)


def _placed(
    strings: tuple[Any, Any, Any],
    numbers: list[Any],
    shape: tuple[int, int],
    target: Any,
    *,
    sparse: bool,
) -> Any:
    """Return a matrix from strings of numbers, given by column, first row (from 1) and length.

    Numbers are in the order of the strings, with a separate array for each string of a dense
    matrix. The matrix is also sparse if a dense one would be very large for the numbers in the
    file.
    """
    column, row, count = strings
    if not sparse and shape[0] * shape[1] <= max(_SMALL, _TIMES * int(count.sum())):
        dense = np.zeros(shape, dtype=target, order="F")
        for j, i, part in zip(column.tolist(), row.tolist(), numbers, strict=True):
            dense[i - 1 : i - 1 + part.size, j - 1] = part
        return dense
    inside = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    at = np.repeat(row - 1, count) + inside, np.repeat(column - 1, count)
    data = np.concatenate([np.zeros(0, target), *numbers])
    return sp.csc_array(sp.coo_array((data, at), shape=shape))


def _strings(words: _Words, first: Any, end: Any, big: bool, per: int, name: str) -> Any:
    """Return start, number, row and column of the values of each string."""
    # the strings of a column are a chain; those of all columns are followed at once
    size, integer = words.integer, np.dtype(f"{words.order}i{words.integer}")
    head = 2 * size if big else size
    unfinished = np.arange(first.size)
    at = first.copy()
    found = []
    while unfinished.size:
        here = at[unfinished]
        if np.any(here + head > end[unfinished]):
            raise _broken(words.path, int(here[np.argmax(here + head > end[unfinished])]), name)
        numbers = _gather(words.content, here, head).view(integer).astype(np.int64)
        if big:
            length, row = numbers.reshape(-1, 2).T - np.array([[1], [0]])
        else:
            length, row = (numbers >> 16) - 1, numbers & 0xFFFF
        wrong = (length < 1) | (length > (end[unfinished] - here - head) // size)
        bytes_ = np.where(wrong, 0, length) * size  # no product wraps
        wrong |= bytes_ % per != 0
        if np.any(wrong):
            raise _broken(words.path, int(here[np.argmax(wrong)]), name)
        found.append((here + head, bytes_ // per, row, unfinished))
        at[unfinished] = here + head + bytes_
        unfinished = unfinished[at[unfinished] < end[unfinished]]
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


def _outside(path: str, where: str, name: str, row: int, shape: tuple[int, int]) -> FlexplantError:
    return damaged(path, f"{where}: a string of {name} reaches row {row} of {shape[0]}")


def _broken(path: str, at: int, name: str) -> FlexplantError:
    what = f"byte {at}: a string of {name} has an impossible length"
    return damaged(path, what, "Write it again (above 65535 rows with BIGMAT=YES).")


#: number of digits of single precision (types 1 and 3), even if more are printed
_SINGLE: Any = digits_of(np.float32())
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
    """A reader of lines; `at` is the position of the next line, from 0."""

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
        if not 0 < self.per_line * self.width <= LINE:
            self.at -= 1
            raise self.wrong(f"numbers as {shown!r}")
        check_count(max(columns, abs(rows)), sum(map(len, self.lines)), self.path)
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
                # one number without a meaning, for any count
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
                f"{self.path!r}, before line {self.at + 1}: matrix {name} contains an entry that "
                "is not a number. "
                "The file is damaged, or a number too large for its field (***): write it in "
                "binary form."
            )
        if complex_:
            numbers = numbers[0::2] + 1j * numbers[1::2]
        column, row, count = np.array(self.strings, dtype=np.int64).reshape(-1, 3).T
        if (last := int(np.max(row + count - 1, initial=0))) > shape[0]:
            raise _outside(self.path, f"before line {self.at + 1}", name, last, shape)
        ends = zip(count.tolist(), np.cumsum(count).tolist(), strict=True)
        parts = [numbers] if sparse else [numbers[end - n : end] for n, end in ends]
        return _placed((column, row, count), parts, shape, numbers.dtype, sparse=sparse)


#: number of entries up to which a matrix is always stored as dense
_SMALL = 2**20
#: largest ratio of the entries of a dense matrix to the numbers in the file
_TIMES = 16


#: a matrix of the file, real or complex; dense if the file stores it as dense
Op4Matrix: TypeAlias = Any
_ENDINGS = ("AA", "AAX", "GG", "XX", "FF", "LL", "2GG", "TT", "")


def read_op4(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | None = None,
    damping: str | None = USUAL,
    dofs: DofSet | None = None,
) -> FEMatrices:
    r"""Return the stiffness, mass and damping matrices of a Nastran OUTPUT4 file.

    The file contains the names of its matrices, but no nodes and no units. Rows that are zero are
    kept.

    Parameters
    ----------
    path : str or Path
        An .op4 file, binary (32 or 64 bit integers, either byte order) or text.
    stiffness, mass, damping : str, optional
        Names of the matrices. By default the usual names (KAA, KAAX, KGG, KXX, KFF, KLL; MAA, ...;
        BAA, ...) are searched, one of which must exist. With `damping=None` no damping is read. A
        zero matrix of 1 x 1, as EXTSEOUT writes it, counts as missing.
    dofs : DofSet, optional
        DOFs of the rows of the matrices.

    Returns
    -------
    FEMatrices
        Matrices; `digits` is the number of digits of K as printed in a text file, or 7 in single
        precision (type 1).

    Raises
    ------
    FlexplantError
        When the file is cut off, damaged, or not an OUTPUT4 file. The message names the byte or the
        line.
    ModelError
        When the choice of a matrix is not clear, or M or D is complex.

    Notes
    -----
    Format: MSC Nastran Quick Reference Guide and DMAP manual, OUTPUT4; matrices of form 6
    (symmetric) with one triangle only are completed.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> text = "       2       2       6       2KAA     1P,3E16.9\n"
    >>> for i, (a, b) in enumerate([(4e5, -4e5), (-4e5, 4e5), (1.0, None)], 1):
    ...     text += f"{i:8d}{1:8d}{2 if b else 1:8d}\n{a:16.9E}" + (f"{b:16.9E}\n" if b else "\n")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "run.op4")
    ...     _ = file.write_text(text)
    ...     found = fx.io.read_op4(file, dofs=fx.chain(masses=[1, 1], stiffnesses=[1]).dofs)
    >>> found.K.toarray().tolist(), found.digits
    ([[400000.0, -400000.0], [-400000.0, 400000.0]], 10)
    """
    found = _read(path)
    given = {"stiffness": stiffness, "mass": mass, "damping": damping}
    chosen = named_matrices(found, given, _ENDINGS, str(path))
    K = _named_matrix(found, chosen[0], path, stiffness=True)
    M, D = (_named_matrix(found, name, path) for name in chosen[1:])
    assert K is not None  # noqa: S101 - its name is known
    M, D = (None if _is_absent(part, K.shape[0]) else part for part in (M, D))
    digits = found[str(chosen[0])][2]
    return FEMatrices(K, M, D, dofs=dofs, digits=digits, source=str(path))


def read_op4_matrices(
    path: str | Path, *, names: Iterable[str] | None = None
) -> dict[str, Op4Matrix]:
    r"""Return the matrices of a Nastran OUTPUT4 file by their names.

    Parameters
    ----------
    path : str or Path
        An .op4 file, binary (32 or 64 bit integers, either byte order) or text.
    names : sequence of str, optional
        Names of the returned matrices; all by default.

    Returns
    -------
    dict {name: (m, n) array or csc_array}
        Matrices of float64 or complex128. A matrix is sparse if it is sparse in the file, or if it
        is large and nearly empty. If a name occurs twice, the second one gets `_2`.

    Raises
    ------
    FlexplantError, LabelError
        As for `read_op4`.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp(), "run.op4")
    >>> last = f"{2:8d}{1:8d}{1:8d}\n{1.0:16.9E}\n"
    >>> _ = file.write_text(f"{1:8d}{1:8d}{2:8d}{2:8d}T       1P,3E16.9\n{1:8d}{1:8d}{1:8d}\n"
    ...                     f"{7.5:16.9E}\n{last}")
    >>> read_op4_matrices(file)
    {'T': array([[7.5]])}
    """
    found = _read(path)
    wanted = found if names is None else name_list(names, "matrices")
    require_known("matrix", wanted, found, repr(str(path)))
    return {name: found[name][0] for name in wanted}


def _is_absent(matrix: sp.csc_array | None, n: int) -> bool:
    """Return whether a matrix is the 1 x 1 zero that stands for a missing one."""
    return matrix is None or (n > 1 and matrix.shape == (1, 1) and not matrix.count_nonzero())


def _named_matrix(
    found: dict[str, Any], name: str | None, path: str | Path, *, stiffness: bool = False
) -> sp.csc_array | None:
    """Return a matrix, both triangles; that of the stiffness may be complex."""
    if name is None:
        return None
    matrix, form, _ = found[name]
    if np.iscomplexobj(matrix) and not stiffness:
        raise ModelError(
            f"matrix {name} of {str(path)!r} is complex: a structure's M and D are real. "
            "read_op4_matrices reads it."
        )
    sparse = sp.csc_array(matrix)
    if form == 6 and sparse.shape[0] == sparse.shape[1]:
        return completed(sparse, name)[0]
    return sparse


def _read(path: str | Path) -> dict[str, tuple[Op4Matrix, int, int | None]]:
    """Return {name: (matrix, form, decimal digits of its entries)}; None is double precision."""
    content = file_path(path).read_bytes()
    if len(content) < 16:
        raise FlexplantError(
            f"{str(path)!r} has {len(content)} bytes, too few for an OUTPUT4 file. Write it again."
        )
    try:
        form_of_file = binary_matrices if content[:4].count(0) else text_matrices
        parts = list(form_of_file(content, str(path)))
    except MemoryError:
        raise FlexplantError(
            f"{str(path)!r} holds a matrix that does not fit into memory. Write it again, sparse."
        ) from None
    found: dict[str, tuple[Op4Matrix, int, int | None]] = {}
    for name, matrix, form, digits in parts:
        entries = matrix.data if hasattr(matrix, "indptr") else matrix
        if not np.all(np.isfinite(entries)):
            raise FlexplantError(
                f"matrix {name} of {str(path)!r} has NaN or infinite entries: the file is damaged, "
                "or the run that wrote it failed. Write it again."
            )
        key, count = name, 1
        while key in found:
            count += 1
            key = f"{name}_{count}"
        found[key] = (matrix, form, digits)
    return found


FORMATS.append(Format((".op4",), read_op4))
