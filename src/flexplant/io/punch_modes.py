"""Eigenvectors that Nastran punches: DISPLACEMENT(PUNCH)=ALL in a run of SOL 103."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..errors import FlexplantError
from ..values import FloatArray
from .file_shapes import FileShapes, ModesFormat
from .nastran_shapes import shapes_at
from .numbers import decimal
from .paths import damaged, wrong_line_of

_EIGENVALUE = re.compile(rb"\$EIGENVALUE\s*=\s*(\S+)\s+MODE\s*=\s*(\d+)")


def read_punch_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of a punch file.

    Two lines a point: number, kind and three displacements, then `-CONT-` and three rotations;
    columns 73 to 80 count lines. A header `$EIGENVALUE = ... MODE = ...` begins each mode.
    """
    lines = [line[:72] for line in path.read_bytes().splitlines()]
    parts: list[tuple[float, dict[int, tuple[bytes, list[float]]]]] = []
    inside, node, kind = False, 0, b""
    first: list[float] = []
    for at, line in enumerate(lines):
        if line[:1] == b"$":
            match = _EIGENVALUE.match(line)
            if match:
                parts.append((_number(match[1], path, at, line), {}))
            elif line[:2] == b"$D" or line[:12] == b"$EIGENVECTOR":
                inside = line[:12] == b"$EIGENVECTOR"
            continue
        if not (inside and parts and line.strip()):
            continue
        values = [_number(line[i : i + 18], path, at, line) for i in (18, 36, 54)]
        if line[:6] == b"-CONT-":
            if not first or node in parts[-1][1]:
                raise _wrong(path, at, line)
            parts[-1][1][node] = (kind, first + values)
            first = []
        else:
            words = line[:18].split()
            if first or len(words) != 2 or not words[0].isdigit():
                raise _wrong(path, at, line)
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


def _number(text: bytes, path: Path, at: int, line: bytes) -> float:
    try:
        return decimal(text.decode("latin-1"))
    except (ValueError, OverflowError):
        raise _wrong(path, at, line) from None


def _wrong(path: Path, at: int, line: bytes) -> FlexplantError:
    do = "The file is cut off or damaged: write it again."
    return wrong_line_of(path, at + 1, "a point of an eigenvector is", line, do)


PUNCH = ModesFormat((".pch",), read_punch_shapes)
