"""Nastran punch files: matrices as DMIG cards, with nodes and components; eigenvectors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import LARGEST_NODE, FloatArray, IntArray
from ..errors import FlexplantError, LabelError, ModelError, counted, require_known
from ..labels import DIRECTIONS, DofSet
from ..structure.matrices import FEMatrices, completed
from .fe_modes import MODE_READERS, FileShapes
from .files import (
    FORMATS,
    USUAL,
    Format,
    check_whole,
    damaged,
    decimal,
    file_path,
    fixed_numbers,
    printed_digits,
    unread,
    wrong_line_of,
)
from .nastran import Nodes, named_matrices, nastran_float, read_nodes, shapes_at

_ENDINGS = ("AAX", "AA", "GG", "2GG", "2PP", "")


def read_dmig(
    path: str | Path,
    *,
    bdf: str | Path | None = None,
    stiffness: str | None = None,
    mass: str | None = None,
    damping: str | None = USUAL,
    scalar_direction: str | None = None,
) -> FEMatrices:
    """Return the matrices of a Nastran punch file (DMIG cards), their rows named by node.

    Components 1..6 become x, y, z, rx, ry, rz. Rows are sorted by node and component. Nodes that
    are named only in the vector VAX of the analysis set are kept as empty rows.

    Parameters
    ----------
    path : str or Path
        A .pch file with DMIG cards in large, small or free fields.
    bdf : str or Path, optional
        File of the bulk data, with the coordinates of the nodes (GRID, CORD2R, CORD2C, CORD2S).
        Nodes that move in local directions (field CD) are turned into the basic system.
    stiffness, mass, damping : str, optional
        Names of the matrices. By default the usual names (KAAX, KAA, KGG, K2GG; MAAX, ...; BAAX,
        ...) are searched, one of which must exist. `damping=None`: no damping is read. Structural
        damping (K4AAX) is not viscous and is not read.
    scalar_direction : {"x", "y", "z", "rx", "ry", "rz"}, optional
        Direction of scalar points (component 0); without it they are refused.

    Returns
    -------
    FEMatrices
        Matrices; `digits` is the number of printed digits. A usual punch file has ten, which may be
        too few for soft modes. Without `bdf` the nodes have no coordinates (the matrices are not
        `located`).

    Raises
    ------
    FlexplantError
        When a card cannot be read; the message names the line.
    LabelError
        When a named matrix does not exist, or a node has no coordinates in `bdf`.
    ModelError
        When a matrix is complex, not square, gives an entry twice, or the file has scalar points.

    Notes
    -----
    Format: MSC Nastran Quick Reference Guide, DMIG. Lengths and masses are in the units of the
    model: `.converted(...)` brings them to SI.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> cards = ["DMIG,KAAX,0,6,2,0,,,2", "DMIG,KAAX,1,1,,1,1,5.0", "DMIG,KAAX,2,1,,2,1,7.0"]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "stage.pch")
    ...     with open(path, "w") as file:
    ...         for card in cards:
    ...             print(card, file=file)
    ...     found = fx.io.read_dmig(path)
    >>> found.dofs.labels, found.K.toarray().diagonal()
    (('1:x', '2:x'), array([5., 7.]))
    """
    content = file_path(path).read_bytes()
    lines = content.splitlines()
    blocks = _read_blocks(lines, str(path))
    check_whole(content, [line[8:].split()[-1] for line in lines[-9:-1] if line[8:].split()], path)
    if not blocks:
        raise FlexplantError(
            f"{str(path)!r} has no DMIG cards. Request them in the run: PARAM,EXTOUT,DMIGPCH or "
            "EXTSEOUT(DMIGPCH). Eigenvectors are read by flexplant.io.read_modes."
        )
    wanted = {"stiffness": stiffness, "mass": mass, "damping": damping}
    names = named_matrices(blocks, wanted, _ENDINGS, str(path))
    K, M, D = (None if name is None else blocks[name] for name in names)
    assert K is not None  # noqa: S101 - its name is known
    given = [part for part in (K, M, D) if part is not None]
    # a DOF is coded as one number: 16 node + component
    codes = [code for part in given for code in (part.rows, part.columns)]
    if "VAX" in blocks:
        codes.append(blocks["VAX"].rows)
    order = np.unique(np.concatenate(codes))
    nodes = None if bdf is None else read_nodes(bdf)
    ids = set((order >> 4).tolist())
    dofs = _matrix_dofs(order, nodes, scalar_direction, str(path))
    most, n = max((part.size for part in given if part.form == 6), default=0), order.size
    note = f"the header says {most} rows, {n} are named: the others are empty, or the file is cut"
    notes = (note,) if most > n else ()
    found = FEMatrices(
        K.matrix(order, str(path)),
        None if M is None else M.matrix(order, str(path)),
        None if D is None else D.matrix(order, str(path)),
        dofs=dofs,
        digits=max(part.digits or 0 for part in given) or None,
        source=str(path),
        located=nodes is not None,
        notes=notes,
    )
    local = {} if nodes is None else {n: axes.T for n, axes in nodes.axes.items() if n in ids}
    # axes equal to those of the file within the rounding of a rotation matrix
    turned = {n: C for n, C in local.items() if np.abs(C - np.eye(3)).max() > 1e-14}
    if not turned:
        return found
    note = f"{counted(len(turned), 'node')} moved in local directions: turned into the basic ones"
    return found.rotated(turned).replace(notes=(*found.notes, note))


@dataclass
class _Block:
    """One matrix: values with the codes (16 node + component) of rows and columns."""

    name: str
    form: int
    kind: int
    size: int  # number of columns in the header; 0 if not stated
    rows: IntArray
    columns: IntArray
    values: FloatArray
    digits: int | None

    def matrix(self, order: IntArray, path: str) -> sp.csc_array:
        if self.kind > 2 or self.form not in (1, 6):
            kind = "complex" if self.kind > 2 else f"of form {self.form}"
            do = "A structure's M, D and K are real, square (1) or symmetric (6): write them so."
            raise unread(path, f"holds the matrix {self.name}, which is {kind}", do)
        if not np.all(np.isfinite(self.values)):
            raise damaged(path, f"NaN or infinite entries of {self.name}")
        i, j = np.searchsorted(order, self.rows), np.searchsorted(order, self.columns)
        n = order.size
        low, high = (i, j) if self.form == 1 else (np.minimum(i, j), np.maximum(i, j))
        keys, counts = np.unique(low * n + high, return_counts=True)
        if np.any(counts > 1):
            twice = int(keys[np.argmax(counts > 1)])
            codes = order[[twice // n, twice % n]]
            nodes = " and ".join(f"{code >> 4} component {code & 15}" for code in codes)
            do = "A symmetric matrix has one triangle only: write the file again."
            raise unread(path, f"gives the entry of {self.name}, node {nodes} twice", do)
        listed = sp.coo_array((self.values, (i, j)), shape=(n, n))
        return sp.csc_array(listed) if self.form == 1 else completed(listed, self.name)[0]


def _read_blocks(lines: list[bytes], path: str) -> dict[str, _Block]:
    """Return the matrices of a file by name."""
    blocks: dict[str, _Block] = {}
    heads = [i for i, line in enumerate(lines) if line[:4].upper() == b"DMIG" and _is_head(line)]
    for at, head in enumerate(heads):
        fields, first = _first_fields(lines, head)
        last = heads[at + 1] if at + 1 < len(heads) else len(lines)
        try:
            name, form, kind = fields[0].strip(), int(fields[2]), int(fields[3])
            sound = bool(name) and kind in (1, 2, 3, 4)
        except (ValueError, IndexError):
            sound = False
        if not sound:
            raise _dmig_line_error(path, head, lines[head], "a header DMIG, NAME, 0, IFO, TIN")
        if name in blocks:
            raise _dmig_line_error(path, head, lines[head], f"one matrix {name} only")
        size = fields[7].strip() if len(fields) > 7 else ""
        announced = int(size) if size.isdecimal() and size.isascii() else 0
        blocks[name] = _read_block(lines, first, last, (name, form, kind, announced), path)
    return blocks


def _is_head(line: bytes) -> bool:
    fields = _split_card(line)
    return len(fields) > 1 and fields[1].strip() == b"0"


def _first_fields(lines: list[bytes], at: int) -> tuple[list[str], int]:
    fields = [field.decode("latin-1") for field in _split_card(lines[at])]
    if b"*" in lines[at][:8] and at + 1 < len(lines):
        return fields + [field.decode("latin-1") for field in _split_card(lines[at + 1])], at + 2
    return fields, at + 1


def _split_card(line: bytes) -> list[bytes]:
    if b"," in line:
        return line.split(b",")[1:]
    width = 16 if b"*" in line[:8] else 8
    return [line[i : i + width] for i in range(8, min(len(line), 72), width)]


def _read_block(
    lines: list[bytes], first: int, last: int, head: tuple[str, int, int, int], path: str
) -> _Block:
    stop = first
    while stop < last and (lines[stop][:1] in b"*+ ,$" or lines[stop][:4].upper() == b"DMIG"):
        stop += 1
    part = lines[first:stop]
    if all(line[:5] == b"DMIG*" or line[:1] == b"*" for line in part) and part:
        columns, rows, values, words = _large(part, first, head[2] < 3, path)
    else:
        columns, rows, values, words = _any(part, first, head[0], head[2] < 3, path)
    return _Block(*head, rows, columns, values, printed_digits(words))


def _large(part: list[bytes], first: int, real: bool, path: str) -> Any:
    """Return columns, rows and values of all cards in large fields, in one step."""
    # of a real matrix the last field, the imaginary part, must be empty or 0
    table = np.frombuffer(b"".join(line[:72].ljust(72) for line in part), np.uint8)
    table = table.reshape(-1, 72)
    heads = table[:, 0] == ord("D")
    if not heads[0]:
        raise _dmig_line_error(path, first, part[0], "DMIG*, NAME, GJ, CJ of the first column")

    def whole(rows: Any, start: int) -> IntArray:
        numbers = _field(table[rows, start : start + 16])
        if numbers is None or np.any(numbers != np.round(numbers)) or np.any(numbers < 0):
            raise _error_at_line(part, np.flatnonzero(rows), start, first, path, "a whole number")
        return numbers.astype(np.int64)

    columns = _codes(whole(heads, 24), whole(heads, 40), path)
    rows = _codes(whole(~heads, 8), whole(~heads, 24), path)
    values = _field(table[~heads, 40:56])
    if values is None:
        raise _error_at_line(part, np.flatnonzero(~heads), 40, first, path, "a number")
    if real:
        beyond = _field(table[~heads, 56:72])
        if beyond is None or np.any(beyond):
            wrong = 0 if beyond is None else int(np.argmax(beyond != 0))
            at = int(np.flatnonzero(~heads)[wrong])
            raise _dmig_line_error(
                path, first + at, part[at], "no imaginary part (the matrix is real)"
            )
    places = np.flatnonzero(~heads)
    words = [part[i][40:56] for i in places[:: max(1, places.size // 1000)]]
    return columns[np.cumsum(heads)[~heads] - 1], rows, values, words


def _field(table: Any) -> FloatArray | None:
    blank = (table == ord(" ")).all(axis=1)
    if blank.any():
        table = table.copy()
        table[blank, -1] = ord("0")
    return fixed_numbers(np.ascontiguousarray(table).tobytes(), 16)


def _error_at_line(
    part: list[bytes], places: IntArray, start: int, first: int, path: str, due: str
) -> FlexplantError:
    for i in places.tolist():
        try:
            number = nastran_float(part[i][start : start + 16].decode("latin-1"))
            if due == "a number" or (number >= 0 and number == round(number)):
                continue
        except (ValueError, OverflowError):
            pass
        return _dmig_line_error(
            path, first + i, part[i], f"{due} in columns {start + 1} to {start + 16}"
        )
    return _dmig_line_error(path, first, part[0], "numbers in every field")


def _any(part: list[bytes], first: int, name: str, real: bool, path: str) -> Any:
    """Return columns, rows and values of cards in small or free fields, line by line."""
    columns, rows, values, words = list[int](), list[int](), list[float](), list[bytes]()
    column, started = 0, False
    for at, line in enumerate(part, first):
        bare = line.split(b"$")[0].rstrip()
        if not bare:
            continue
        fields = [field.strip() for field in _split_card(bare)]
        try:
            if bare[:4].upper() == b"DMIG":
                if fields[0].decode("latin-1") != name:
                    raise ValueError
                column = _code(fields[1], fields[2] if len(fields) > 2 else b"")
                started = True
                fields = fields[4:]
            if not started:
                raise ValueError
            for i in range(0, len(fields), 4):
                entry = [*fields[i : i + 4], b"", b"", b"", b""]
                if entry[0]:
                    rows.append(_code(entry[0], entry[1]))
                    values.append(nastran_float(entry[2].decode("latin-1")))
                    # a decimal comma would leave its digits in the field of the imaginary part
                    if real and nastran_float(entry[3].removesuffix(b"+").decode("latin-1")):
                        raise ValueError
                    columns.append(column)
                    words.append(entry[2])
        except (ValueError, IndexError, OverflowError):
            raise _dmig_line_error(path, at, line, f"DMIG, {name}, GJ, CJ, , G1, C1, A1") from None
    return np.array(columns, np.int64), np.array(rows, np.int64), np.array(values), words[:1000]


def _code(node: bytes, component: bytes) -> int:
    number, kind = int(node), int(component or b"0")
    if not 0 < number <= LARGEST_NODE or not 0 <= kind <= 6:
        raise ValueError
    return 16 * number + kind


def _codes(nodes: IntArray, components: IntArray, path: str) -> IntArray:
    if np.any(components > 6):
        node = int(nodes[np.argmax(components)])
        raise damaged(path, f"component {components.max()} of node {node}: components are 0 to 6")
    return np.asarray(16 * nodes + components, dtype=np.int64)


def _matrix_dofs(order: IntArray, nodes: Nodes | None, scalar: str | None, path: str) -> DofSet:
    ids, components = order >> 4, order & 15
    if np.any(components == 0) and scalar is None:
        raise ModelError(
            f"{path!r} has scalar points {ids[components == 0][:6].tolist()}: they have no "
            "position and no direction. Give their direction, scalar_direction='z' (generalised "
            "coordinates of a reduced model do not belong to a node: punch the g-set instead)."
        )
    if scalar is not None:
        require_known("direction", [scalar], DIRECTIONS)
    directions = [scalar or "" if c == 0 else DIRECTIONS[c - 1] for c in components.tolist()]
    if nodes is None:
        return DofSet(ids, tuple(directions), np.zeros((ids.size, 3)))
    held = set(ids[components > 0].tolist())
    missing = sorted(held - set(nodes.xyz))
    if missing:
        raise LabelError(
            f"{len(missing)} nodes of {path!r} have no GRID card in the bulk data, the first "
            f"{missing[:6]}: it may be INCLUDEd from another file. Give the file that holds them."
        )
    origin = np.zeros(3)
    return DofSet(
        ids, tuple(directions), np.array([nodes.xyz.get(i, origin) for i in ids.tolist()])
    )


def _dmig_line_error(path: str, at: int, line: bytes, due: str) -> FlexplantError:
    return wrong_line_of(
        path, at + 1, f"{due} is", line, "It is cut off or damaged: write it again."
    )


def _begins(head: bytes) -> bool:
    return (head.startswith(b"$") and b"DMIG" in head.upper()) or head[:4].upper() == b"DMIG"


FORMATS.append(Format((".pch", ".dmig"), read_dmig, _begins, (".bdf", ".dat", ".nas"), "bdf"))


_EIGENVALUE = re.compile(rb"\$EIGENVALUE\s*=\s*(\S+)\s+MODE\s*=\s*(\d+)")


def read_punch_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of a punch file."""
    # two lines a point: number, kind and three displacements, then `-CONT-` and three rotations;
    # columns 73 to 80 count lines. A header `$EIGENVALUE = ... MODE = ...` begins each mode
    lines = [line[:72] for line in path.read_bytes().splitlines()]
    parts: list[tuple[float, dict[int, tuple[bytes, list[float]]]]] = []
    inside, node, kind = False, 0, b""
    first: list[float] = []
    for at, line in enumerate(lines):
        if line[:1] == b"$":
            match = _EIGENVALUE.match(line)
            if match:
                parts.append((_punch_number(match[1], path, at, line), {}))
            elif line[:2] == b"$D" or line[:12] == b"$EIGENVECTOR":
                inside = line[:12] == b"$EIGENVECTOR"
            continue
        if not (inside and parts and line.strip()):
            continue
        values = [_punch_number(line[i : i + 18], path, at, line) for i in (18, 36, 54)]
        if line[:6] == b"-CONT-":
            if not first or node in parts[-1][1]:
                raise _punch_line_error(path, at, line)
            parts[-1][1][node] = (kind, first + values)
            first = []
        else:
            words = line[:18].split()
            if first or len(words) != 2 or not words[0].isdigit():
                raise _punch_line_error(path, at, line)
            node, kind, first = int(words[0]), words[1], values
    if first or not any(points for _, points in parts):
        raise FlexplantError(
            f"{str(path)!r} holds no {'whole ' * bool(first)}eigenvectors. Write them in a run of "
            "SOL 103 with DISPLACEMENT(PUNCH)=ALL; DMIG matrices are read by read_model."
        )
    parts = [part for part in parts if part[1]]
    ids = np.array(list(parts[0][1]), dtype=np.int64)
    if any(list(points) != list(parts[0][1]) for _, points in parts):
        raise damaged(path, "the modes are at different nodes")
    kinds = np.array([1 if kind == b"G" else 2 for kind, _ in parts[0][1].values()])
    columns = [np.array([values for _, values in points.values()]) for _, points in parts]
    eigenvalues: FloatArray = np.array([value for value, _ in parts])
    omega = np.sign(eigenvalues) * np.sqrt(np.abs(eigenvalues))
    table = (ids, kinds, np.stack(columns, axis=2))
    return shapes_at(table, omega, nodes=nodes, turned=False, masses=None, path=str(path))


def _punch_number(text: bytes, path: Path, at: int, line: bytes) -> float:
    try:
        return decimal(text.decode("latin-1"))
    except (ValueError, OverflowError):
        raise _punch_line_error(path, at, line) from None


def _punch_line_error(path: Path, at: int, line: bytes) -> FlexplantError:
    do = "The file is cut off or damaged: write it again."
    return wrong_line_of(path, at + 1, "a point of an eigenvector is", line, do)


MODE_READERS[".pch"] = read_punch_shapes
