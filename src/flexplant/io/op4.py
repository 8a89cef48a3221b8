"""Nastran OUTPUT4 files, binary and text, dense and sparse, of either byte order."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantError, ModelError, unknown_label
from ..labels import DofSet
from ..structure.matrices import FEMatrices
from ..structure.precision import digits_of
from ..values import name_list
from .formats import Format
from .op4_text import text_matrices
from .paths import file_path

#: a matrix of the file: dense where the file holds it dense, real or complex
Op4Matrix: TypeAlias = Any
_STIFFNESS = ("KAA", "KAAX", "KGG", "KXX", "KFF", "KLL", "K2GG", "KTT", "K")
_MASS = ("MAA", "MAAX", "MGG", "MXX", "MFF", "MLL", "M2GG", "MTT", "M")
_DAMPING = ("BAA", "BAAX", "BGG", "BXX", "BFF", "BLL", "B2GG", "BTT", "B")


def read_op4(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | None = None,
    damping: str | None = None,
    dofs: DofSet | None = None,
) -> FEMatrices:
    """Return the stiffness, mass and damping matrices of a Nastran OUTPUT4 file.

    The file names its matrices, but neither nodes nor units. Rows that are zero are kept.

    Parameters
    ----------
    path : str or Path
        An .op4 file, binary (32 or 64 bit integers, either byte order) or text.
    stiffness, mass, damping : str, optional
        Names of the matrices; when not given, the one of the usual names (KAA, KAAX, KGG, KXX,
        KFF, KLL; MAA, ...; BAA, ...) that is there.
    dofs : DofSet, optional
        The rows of the matrices.

    Returns
    -------
    FEMatrices
        With the `digits` of K as printed in a text file, 7 in single precision (type 1).

    Raises
    ------
    FlexplantError
        When the file is cut off, damaged, or no OUTPUT4 file; the byte or line is named.
    LabelError
        When there is no matrix of such a name.
    ModelError
        When which matrix is meant is not clear, or it is complex.
    FileNotFoundError
        When there is no such file.

    Notes
    -----
    Format: MSC Nastran Quick Reference Guide and DMAP manual, OUTPUT4; matrices of form 6
    (symmetric) with one triangle only are completed.
    """
    found = _read(path, None)
    chosen = {
        "stiffness": _chosen(stiffness, _STIFFNESS, "stiffness", found, path),
        "mass": _chosen(mass, _MASS, "mass", found, path),
        "damping": _chosen(damping, _DAMPING, "damping", found, path),
    }
    if chosen["stiffness"] is None:
        raise ModelError(
            f"{str(path)!r} holds {sorted(found)}, none of which has a usual name of a stiffness "
            f"matrix ({', '.join(_STIFFNESS)}). Say which it is: stiffness='...'."
        )
    K, M, D = (_real(found, name, path) for name in chosen.values())
    assert K is not None  # noqa: S101 - its name is known
    digits = found[chosen["stiffness"]][2]
    return FEMatrices(K, M, D, dofs=dofs, digits=digits, source=str(path))


def read_op4_matrices(
    path: str | Path, *, names: Iterable[str] | None = None
) -> dict[str, Op4Matrix]:
    """Return the matrices of a Nastran OUTPUT4 file by their names.

    Parameters
    ----------
    path : str or Path
        An .op4 file, binary (32 or 64 bit integers, either byte order) or text.
    names : sequence of str, optional
        Those to return; all when not given.

    Returns
    -------
    dict {name: (m, n) array or csc_array}
        Sparse where the file holds it sparse; float64, or complex128. A doubled name gets `_2`.

    Raises
    ------
    FlexplantError
        When the file is cut off, damaged, or no OUTPUT4 file; the byte or line is named.
    LabelError
        When there is no matrix of such a name.
    FileNotFoundError
        When there is no such file.
    """
    found = _read(path, None if names is None else name_list(names, "matrices"))
    return {name: matrix for name, (matrix, _, _) in found.items()}


def _chosen(
    given: str | None, usual: Sequence[str], what: str, found: dict[str, Any], path: str | Path
) -> str | None:
    if given is not None:
        if given not in found:
            raise unknown_label("matrix", given, found, repr(str(path)))
        return given
    there = [name for name in usual if name in found]
    if len(there) > 1:
        raise ModelError(
            f"{str(path)!r} holds {there}, any of which may be the {what}. Say which: "
            f"{what}={there[0]!r}."
        )
    return there[0] if there else None


def _real(found: dict[str, Any], name: str | None, path: str | Path) -> sp.csc_array | None:
    if name is None:
        return None
    matrix, form, _ = found[name]
    if np.iscomplexobj(matrix):
        raise ModelError(
            f"matrix {name} of {str(path)!r} is complex: a structure's M, D and K are real. "
            "Structural damping belongs into a damping matrix; read_op4_matrices reads it."
        )
    sparse = sp.csc_array(matrix)
    if form == 6 and sparse.shape[0] == sparse.shape[1]:
        lower, upper = sp.tril(sparse, -1), sp.triu(sparse, 1)
        if not lower.count_nonzero() or not upper.count_nonzero():
            sparse = sp.csc_array(sparse + (lower + upper).T)
    return sparse


def _read(
    path: str | Path, names: tuple[str, ...] | None
) -> dict[str, tuple[Op4Matrix, int, int | None]]:
    """Return {name: (matrix, form, decimal digits of its entries)}; None is double precision."""
    content = file_path(path).read_bytes()
    if len(content) < 16:
        raise FlexplantError(
            f"{str(path)!r} has {len(content)} bytes, too few for an OUTPUT4 file. Write it again."
        )
    try:
        form_of_file = _binary if content[:4].count(0) else text_matrices
        parts = list(form_of_file(content, str(path)))
    except MemoryError:
        raise FlexplantError(
            f"{str(path)!r} names a size that does not fit into memory: the header is damaged, or "
            "a large matrix is held dense. Write it again, sparse."
        ) from None
    found: dict[str, tuple[Op4Matrix, int, int | None]] = {}
    matrix: Any
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
    if names is None:
        return found
    for name in names:
        if name not in found:
            raise unknown_label("matrix", name, found, repr(str(path)))
    return {name: found[name] for name in names}


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
            raise FlexplantError(
                f"{self.path!r}, byte {stop}: the record of {length} bytes does not end with its "
                "length again: the file is damaged. Write or copy it again, in binary mode."
            )
        return start, stop

    def integers(self, at: int, count: int) -> list[int]:
        form = f"{self.layout.order}{count}{'i' if self.layout.integer == 4 else 'q'}"
        return list(struct.unpack_from(form, self.content, at))


def _binary(content: bytes, path: str) -> Iterable[tuple[str, Op4Matrix, int, int | None]]:
    words = _Words(content, path)
    size, marker = words.layout.integer, words.layout.marker
    at = 0
    while at < words.size:
        start, stop = words.record(at)
        if stop - start != 6 * size:
            raise FlexplantError(
                f"{path!r}, byte {at}: a matrix begins with a record of {6 * size} bytes, got "
                f"{stop - start}: the file is damaged. Write it again."
            )
        columns, rows, form, kind = words.integers(start, 4)
        name = content[start + 4 * size : stop].decode("latin-1").replace("\0", "").strip()
        if columns < 1 or not rows or kind not in (1, 2, 3, 4) or not name.isprintable():
            raise FlexplantError(
                f"{path!r}, byte {start}: no header of a matrix: {columns} columns, {rows} rows, "
                f"type {kind}, name {name!r}. The file is damaged. Write it again."
            )
        at = stop + marker
        starts: list[int] = []
        stops: list[int] = []
        while True:
            start, stop = words.record(at)
            if stop - start < 3 * size:
                raise FlexplantError(
                    f"{path!r}, byte {at}: a column of {name} has {stop - start} bytes, too few "
                    "for its header: the file is damaged. Write it again."
                )
            column = words.integers(start, 1)[0]
            at = stop + marker
            if column > columns:
                break
            if column < 1:
                raise FlexplantError(
                    f"{path!r}, byte {start}: column {column} of {name}: the file is damaged. "
                    "Write it again."
                )
            starts.append(start)
            stops.append(stop)
        matrix = _matrix(words, name, (abs(rows), columns), rows < 0, kind, starts, stops)
        yield name, matrix, form, digits_of(np.zeros(0, dtype=words.real[kind % 2 == 0]))


def _matrix(
    words: _Words,
    name: str,
    shape: tuple[int, int],
    big: bool,
    kind: int,
    starts: list[int],
    stops: list[int],
) -> Op4Matrix:
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
    if shape[0] * shape[1] > 2**44 and not big:
        raise MemoryError
    if not heads and not big:
        return np.zeros(shape, dtype=target)
    if heads and all(row > 0 for _, row, _ in heads):
        dense = np.zeros(shape, dtype=target, order="F")
        for start, stop, (column, row, _) in zip(starts, stops, heads, strict=True):
            count = (stop - start - 3 * size) // per
            if row - 1 + count > shape[0]:
                raise _outside(words.path, start, name, row - 1 + count, shape)
            part = np.frombuffer(words.content, value, count, start + 3 * size)
            dense[row - 1 : row - 1 + count, column - 1] = part
        return dense
    first = np.array(starts, dtype=np.int64) + 3 * size
    counts = np.array([count for _, _, count in heads], dtype=np.int64)
    end = np.minimum(first + counts * size, np.array(stops, dtype=np.int64))
    place, length, row, column = _strings(words, first, end, big, per, name)
    column = np.array([c for c, _, _ in heads], dtype=np.int64)[column] - 1
    if row.size and (row.min() < 1 or np.any(row - 1 + length > shape[0])):
        bad = int(np.argmax((row < 1) | (row - 1 + length > shape[0])))
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
        bytes_ = length * size
        wrong = (length < 1) | (bytes_ % per != 0) | (here + head + bytes_ > end[alive])
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
    return FlexplantError(
        f"{path!r}, byte {at}: a string of {name} reaches row {row} of {shape[0]}: the file is "
        "damaged. Write it again."
    )


def _broken(path: str, at: int, name: str) -> FlexplantError:
    return FlexplantError(
        f"{path!r}, byte {at}: a string of {name} has an impossible length: the file is damaged. "
        "Write it again (above 65535 rows with BIGMAT=YES)."
    )


OUTPUT4 = Format((".op4",), read_op4)
