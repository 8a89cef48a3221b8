"""Files of one matrix each: Matrix Market, and Harwell-Boeing in Fortran's fixed fields."""

from __future__ import annotations

import gzip
import re
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
import scipy.sparse as sp

from ..arrays import FloatArray
from ..errors import FlexplantError, ShapeError
from ..labels import DofSet
from ..structure import FEMatrices
from ..structure.matrices import completed
from .files import (
    FORMATS,
    LINE,
    Format,
    check_count,
    check_whole,
    damaged,
    fixed_numbers,
    numbers_of_lines,
    parsing,
    printed_digits,
    refused,
    spaced_numbers,
    unread,
    wrong_line_of,
)
from .foreign_parsers import sound
from .triplets import one_matrix_each

#: number of lines whose digits are counted
_SAMPLE = 4000
#: lines of row, column and a number in the plain form of C, which SciPy's fast reader reads whole
_PLAIN = re.compile(
    rb"(?:[ \t]*+\d++[ \t]++\d++[ \t]++-?(?:\d++(?:\.\d*+)?|\.\d++)(?:[eE][-+]?\d++)?+"
    rb"[ \t]*+\r?(?:\n|\Z))*+\s*+"
)


def read_matrix_market(
    stiffness: str | Path,
    mass: str | Path | None = None,
    *,
    damping: str | Path | None = None,
    dofs: DofSet | str | Path | None = None,
) -> FEMatrices:
    """Return the matrices of Matrix Market files.

    If the file holds one triangle, the other one is added. Rows of held DOFs are dropped, and
    printed digits are counted. `notes` say what was done. The file counts rows and columns from 1.

    Parameters
    ----------
    stiffness, mass, damping : str or Path
        Files (.mtx, also .mtx.gz) of K, M and D.
    dofs : DofSet, or path of a table for `read_dofs`, optional
        DOFs of the rows, which the files do not contain.

    Raises
    ------
    FlexplantError
        When a file is not a Matrix Market file, is cut short, or holds a line of another form. The
        message names the line.
    ModelError
        When a matrix is complex, skew-symmetric or a pattern without numbers.

    Notes
    -----
    Format: [Boisvert1996]_. Exponents of Fortran (7.5D+03, 7.5+03) are read as such.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, scipy.io, scipy.sparse, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "K.mtx")
    ...     scipy.io.mmwrite(path, scipy.sparse.eye_array(2))
    ...     fx.io.read_matrix_market(path).n_dof
    2
    """
    return one_matrix_each({"K": stiffness, "M": mass, "D": damping}, _matrix_market, dofs)


def _matrix_market(path: Path) -> tuple[Any, int | None]:
    try:
        content = path.read_bytes()
        content = gzip.decompress(content) if path.suffix == ".gz" else content
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise FlexplantError(f"{str(path)!r} cannot be unpacked ({error}): cut short?") from None
    head = _header(content, path)
    # without the text after the last number: SciPy's fast reader reads beyond a blank at the end
    body = content[head.start :].rstrip() + b"\n"
    if b"%" in body:
        body = b"\n".join(b"" if line[:1] == b"%" else line for line in body.split(b"\n"))
    if head.listed:
        entries = _plain_entries(body, head)
        if entries is None:
            entries = _entries(_entry_table(body, head, path), head, path)
        if head.symmetric:
            _refuse_both_triangles(entries, head, path)
            entries = completed(entries, path.name)[0]
        matrix = entries
    else:
        matrix = _columns(_entry_table(body, head, path)[:, 0], head)
    if head.whole:
        return matrix, None
    lines = body[: 80 * _SAMPLE].splitlines()[:_SAMPLE]
    words = [line.split()[-1] for line in lines if line.strip()]
    check_whole(content, words, path)
    return matrix, printed_digits(words)


def _entry_table(body: bytes, head: _Header, path: Path) -> FloatArray:
    """Return the numbers (entries, 3 or 1) of all lines, in any notation of C or Fortran."""
    width, due = (3, "row, column and value") if head.listed else (1, "one number")
    do = "A number is finite, with a decimal point and E, D or a sign before its exponent."

    def wrong_at(place: int, line: bytes) -> FlexplantError:
        return wrong_line_of(path, head.lines + place + 1, f"expected {due} is", line, do)

    table = numbers_of_lines(body, width, wrong_at)
    if len(table) != head.entries:
        raise damaged(path, f"announces {head.entries} entries and holds {len(table)}")
    return table


class _Header(NamedTuple):
    """Content of the first lines, and start of the entries."""

    listed: bool  # coordinate form; else all entries column by column
    whole: bool  # integers
    symmetric: bool
    shape: tuple[int, int]
    entries: int
    start: int  # bytes
    lines: int


def _header(content: bytes, path: Path) -> _Header:
    start = content.find(b"\n") + 1 or len(content)
    words = content[:start].decode("latin-1").lower().split()
    if len(words) < 5 or words[0] != "%%matrixmarket":
        raise FlexplantError(
            f"{str(path)!r} is not a Matrix Market file: it begins with {content[:40]!r}. Abaqus "
            "writes .mtx files of another kind: read_abaqus."
        )
    form, kind, symmetry = words[2:5]
    if kind in ("complex", "pattern") or symmetry in ("skew-symmetric", "hermitian"):
        do = "M, D and K are real and symmetric: leave gyroscopic and complex terms out."
        raise unread(path, f"is {kind} {symmetry}", do)
    lines = 1
    line = b"%"
    while start < len(content) and (not line.strip() or line[:1] == b"%"):
        stop = content.find(b"\n", start) + 1 or len(content)
        line, start, lines = content[start:stop], stop, lines + 1
    sizes = [int(word) if word.isdigit() else -1 for word in line.split()]
    known = form in ("coordinate", "array") and symmetry in ("general", "symmetric")
    if not known or len(sizes) != (3 if form == "coordinate" else 2) or min(sizes) < 0:
        due = f"the size of a matrix of {form} {symmetry} form is"
        raise wrong_line_of(path, lines, due, line, "Is it cut short?")
    n, m = sizes[:2]
    if symmetry == "symmetric" and n != m:
        raise ShapeError(f"{str(path)!r} is called symmetric and is not square: {n} x {m}.")
    check_count(max(n, m), len(content), path)
    full = n * (n + 1) // 2 if symmetry == "symmetric" else n * m
    return _Header(
        form == "coordinate",
        kind in ("integer", "unsigned-integer"),
        symmetry == "symmetric",
        (n, m),
        sizes[2] if form == "coordinate" else full,
        start,
        lines,
    )


def _plain_entries(body: bytes, head: _Header) -> Any | None:
    """Return the matrix of the entries by SciPy's reader; None where the reader does not apply.

    SciPy drops what it cannot parse (`7.5D+03` becomes 7.5), so that it gets plain lines only.
    """
    if head.whole or body.count(b"\n") < head.entries or not _PLAIN.fullmatch(body):
        return None
    sizes = f"{head.shape[0]} {head.shape[1]} {head.entries}"
    first = f"%%MatrixMarket matrix coordinate real general\n{sizes}\n".encode()
    try:
        entries = scipy.io.mmread(BytesIO(first + body), spmatrix=False)
    except (ValueError, OverflowError):  # a wrong index, count or size: the error of ours names it
        return None
    return entries if np.all(np.isfinite(entries.data)) else None


def _entries(table: FloatArray, head: _Header, path: Path) -> Any:
    """Return the matrix of lines `row column value`."""
    at = table[:, :2]
    wrong = np.any((at != np.floor(at)) | (at < 1) | (at > head.shape), axis=1)
    if wrong.any():
        k, size = int(np.argmax(wrong)), f"{head.shape[0]} x {head.shape[1]}, counted from 1"
        i, j = at[k]
        raise damaged(path, f"entry {k + 1}: row {i:g}, column {j:g} of a matrix of {size}")
    i, j = at.T.astype(np.int64) - 1
    return sp.coo_array((table[:, 2], (i, j)), shape=head.shape)


def _refuse_both_triangles(entries: Any, head: _Header, path: Path) -> None:
    """Refuse a symmetric file that lists entries on both sides of the diagonal."""
    i, j = (np.asarray(place, dtype=np.int64) for place in entries.coords)
    above, below = np.flatnonzero(i < j), np.flatnonzero(i > j)
    if not above.size or not below.size:
        return
    n = head.shape[0]
    both = np.intersect1d((i * n + j)[below], (j * n + i)[above])
    if both.size:
        row, column = divmod(int(both[0]), n)
        raise FlexplantError(
            f"{str(path)!r} is called symmetric and lists both ({row + 1}, {column + 1}) and "
            f"({column + 1}, {row + 1}): by the format an entry stands for the pair, which would "
            "double both. Write one triangle, or call the matrix general."
        )


def _columns(values: FloatArray, head: _Header) -> FloatArray:
    """Return the matrix of all entries, column by column (of a symmetric one the lower half)."""
    if not head.symmetric:
        return np.asarray(values.reshape(head.shape[::-1]).T)
    n = head.shape[0]
    matrix = np.zeros((n, n))
    matrix.T[np.triu_indices(n)] = values
    return np.asarray(matrix + np.tril(matrix, -1).T)


FORMATS.append(
    Format((".mtx.gz",), read_matrix_market, lambda head: head[:14].lower() == b"%%matrixmarket")
)


_FORMAT = re.compile(r"\(?\s*(?:\d+P\s*,?\s*)?(\d*)\s*([IEFDG])\s*(\d+)", re.IGNORECASE)


def read_harwell_boeing(
    stiffness: str | Path,
    mass: str | Path | None = None,
    *,
    damping: str | Path | None = None,
    dofs: DofSet | str | Path | None = None,
) -> FEMatrices:
    """Return the matrices of Harwell-Boeing (or Rutherford-Boeing) files.

    The matrices must be assembled and real (or integer). They may be symmetric (RSA; the file then
    holds the lower triangle) or not (RUA).

    Parameters
    ----------
    stiffness, mass, damping, dofs
        As for `read_matrix_market`, but with files .rsa, .rua, .hb or .rb.

    Raises
    ------
    FlexplantError, ModelError, ShapeError
        As for `read_matrix_market`; also ModelError for element matrices that are not assembled.

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
        what = f"is not a Harwell-Boeing file: its header cannot be read ({error})"
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
        blocks.append(_number_block(lines[first : first + count], form, size, path, first))
        first += count
    with parsing(path), np.errstate(invalid="raise"):
        pointer, index = (block.astype(np.int64) - 1 for block in blocks[:2])
        matrix: Any = sp.csc_array((blocks[2], index, pointer), shape=(n_rows, n_columns))
        sound(matrix)
    matrix.sum_duplicates()
    if kind[1] == "S":
        matrix = completed(matrix, path.name)[0]
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
    if not 0 < per_line * width <= LINE:
        raise ValueError(f"format {text.strip()!r}")
    return per_line, width


def _number_block(
    lines: list[bytes], form: tuple[int, int], size: int, path: Path, before: int
) -> Any:
    """Return the `size` numbers of a block that follows `before` lines."""
    per_line, width = form
    full = per_line * width
    text = b"".join(line[:full].ljust(full) for line in lines)
    numbers = fixed_numbers(text[: size * width], width) if len(text) >= size * width else None
    if numbers is None:
        # some programs do not keep to the fields of the header; blanks still separate numbers
        numbers = spaced_numbers(b" ".join(lines), size)
    if numbers is None:
        where = ""
        for place, line in enumerate(lines):
            due = max(0, min(per_line, size - place * per_line))
            fields = line[: due * width].ljust(due * width)
            if fixed_numbers(fields, width) is None and spaced_numbers(line, due) is None:
                where = f", line {before + place + 1} is {line[:72].decode('latin-1')!r}"
                break
        raise FlexplantError(
            f"{str(path)!r} holds fewer than {size} numbers in fields of {width} characters"
            f"{where}. Is it cut short, or were its blanks lost?"
        )
    return numbers


FORMATS.append(Format((".rsa", ".rua", ".hb", ".rb"), read_harwell_boeing))
