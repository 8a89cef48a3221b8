"""Abaqus matrix output (*MATRIX GENERATE, *MATRIX OUTPUT): text files, one matrix each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import LARGEST_NODE, FloatArray, IntArray
from ..dof_columns import at_nodes
from ..errors import FlexplantError, ModelError
from ..labels import DIRECTIONS, DofSet
from ..structure.matrices import FEMatrices
from .files import (
    FORMATS,
    Format,
    check_count,
    check_whole,
    decimal,
    defined_twice,
    file_path,
    no_motion,
    numbers_of_lines,
    printed_digits,
    unread,
    wrong_line_of,
)
from .triplets import from_triplets

#: value that Abaqus writes on the diagonal for a degree of freedom with a boundary condition
_HELD = 1e35
_WORD = re.compile(rb"[^\s,]+")


def read_abaqus(
    stiffness: str | Path,
    *,
    mass: str | Path | None = None,
    damping: str | Path | None = None,
    inp: str | Path | None = None,
    dofs: DofSet | None = None,
) -> FEMatrices:
    r"""Return the matrices that Abaqus wrote with `*MATRIX OUTPUT`.

    Three formats are read: FORMAT=MATRIX INPUT (the default), FORMAT=LABELS (lines `node, dof,
    node, dof, value`, one triangle or both) and FORMAT=COORDINATE (lines `row column value`,
    counted from 1). Degrees of freedom held by a boundary condition, which Abaqus marks with 1e36
    on the diagonal of K, are dropped.

    Parameters
    ----------
    stiffness, mass, damping : str or Path
        Files of step 1: `job_STIF1.mtx`, `job_MASS1.mtx` and (viscous damping) `job_DMPV1.mtx`.
    inp : str or Path, optional
        The input file, for the coordinates in its `*NODE` blocks.
    dofs : DofSet, optional
        DOFs of the rows. Give them for FORMAT=COORDINATE, which does not name the rows.

    Returns
    -------
    FEMatrices
        Matrices; `digits` is the number of printed digits. Without `inp` the nodes have no
        coordinates (the matrices are not `located`).

    Raises
    ------
    FlexplantError
        When a line has another form; the message names the line.
    ModelError
        When there are internal nodes (Lagrange multipliers of contact, couplings or hybrid
        elements), degrees of freedom that are not displacements, or nodes in transformed systems.
    LabelError
        When a node has no coordinates in `inp`.

    Notes
    -----
    Format: Abaqus Analysis User's Guide, "Generating structural matrices"; Keywords Reference,
    `*MATRIX INPUT` and `*MATRIX OUTPUT`. Units are those of the model: `.converted(...)`.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "job_STIF1.mtx")
    ...     _ = file.write_text("1,1, 1,1, 4e5\n2,1, 1,1, -4e5\n2,1, 2,1, 4e5\n")
    ...     found = fx.io.read_abaqus(file)
    >>> found.dofs.labels, found.K.toarray().tolist()
    (('1:x', '2:x'), [[400000.0, -400000.0], [-400000.0, 400000.0]])
    """
    first = _triplets(stiffness)
    others = [None if file is None else _triplets(file) for file in (mass, damping)]
    there = [first, *(part for part in others if part is not None)]
    if len({part.named for part in there}) > 1:
        raise ModelError(
            "the files are of two formats, MATRIX INPUT and COORDINATE: their rows cannot be "
            "matched. Write all with the same FORMAT."
        )
    order = np.unique(
        np.concatenate([code for part in there for code in (part.rows, part.columns)])
    )
    if not first.named:
        check_count(int(order[-1] >> 4), file_path(stiffness).stat().st_size, stiffness)
        order = np.arange(16, 16 * (order[-1] >> 4) + 1, 16)
    M, D = (None if part is None else part.matrix(order) for part in others)
    located = True
    if first.named:
        if dofs is not None:
            raise ModelError("the files name their rows: dofs= is for FORMAT=COORDINATE only.")
        dofs, located = _dofs(order, inp), inp is not None
    found = FEMatrices(
        first.matrix(order), M, D, dofs=dofs, source=str(stiffness), located=located,
        digits=max(part.digits or 0 for part in there) or None,
    )  # fmt: skip
    held = found.K.diagonal() >= _HELD
    if not held.any():
        return found
    if dofs is None:
        raise ModelError(
            f"rows {(np.flatnonzero(held)[:6] + 1).tolist()} of {str(stiffness)!r} are held by "
            "boundary conditions (1e36 on the diagonal), and rows without names cannot be dropped. "
            "Write FORMAT=MATRIX INPUT, or give dofs=."
        )
    return found.without([label for label, out in zip(dofs.labels, held, strict=True) if out])


@dataclass
class _Triplets:
    """Entries of one matrix. A code is 16 node + degree of freedom, or 16 row."""

    path: str
    named: bool
    rows: IntArray
    columns: IntArray
    values: FloatArray
    digits: int | None

    def matrix(self, order: IntArray) -> sp.csc_array:
        i, j = np.searchsorted(order, self.rows), np.searchsorted(order, self.columns)
        return from_triplets(self.values, i, j, order.size, self.path)


def _triplets(path: str | Path) -> _Triplets:
    content = file_path(path).read_bytes()
    lines = content.splitlines()
    scale = 1.0
    data = [line for line in lines if line.strip() and line[:1] != b"*"]
    for line in lines:
        match = re.search(rb"SCALE\s*FACTOR\s*=\s*([^,\s]+)", line.upper())
        if match and line[:1] == b"*" and line[:2] != b"**":
            scale = _unit_factor(match[1], path)
    if not data:
        raise FlexplantError(f"{str(path)!r} holds no matrix. Write it again.")
    width = len(_WORD.findall(data[0]))
    if width not in (3, 5) or (width == 3 and b"," in data[0]):
        raise _abaqus_line_error(path, lines, data[0], 5)

    def wrong_at(place: int, line: bytes) -> FlexplantError:
        return _abaqus_line_error(path, lines, data[place], width)

    table = numbers_of_lines(b"\n".join(data).replace(b",", b" "), width, wrong_at)
    labels = table[:, :-1]
    wrong = (labels != np.round(labels)) | (np.abs(labels) > LARGEST_NODE)
    if np.any(wrong := wrong.any(axis=1)):
        raise _abaqus_line_error(path, lines, data[int(np.argmax(wrong))], width)
    whole: Any = labels.astype(np.int64)
    inner = whole[:, :: 2 if width == 5 else 1]
    if np.any(inner < 1):
        what = (
            f"has internal nodes {np.unique(inner[inner < 1])[:6].tolist()}: Lagrange multipliers "
            "(of contact, couplings, hybrid elements) make the system indefinite"
        )
        raise unread(path, what, "Use penalty or direct constraints.")
    if width == 3:
        whole = np.column_stack([whole[:, 0], 0 * whole[:, 0], whole[:, 1], 0 * whole[:, 1]])
    elif np.any((whole[:, 1::2] < 1) | (whole[:, 1::2] > 6)):
        other = np.unique(whole[:, 1::2])
        raise no_motion(path, other[(other < 1) | (other > 6)].tolist())
    words = [_WORD.findall(line)[-1] for line in data[:: max(1, len(data) // 1000)]]
    check_whole(content.replace(b",", b" "), words, path)
    return _Triplets(
        str(path),
        width == 5,
        16 * whole[:, 0] + whole[:, 1],
        16 * whole[:, 2] + whole[:, 3],
        scale * table[:, -1],
        printed_digits(words),
    )


def _unit_factor(word: bytes, path: str | Path) -> float:
    try:
        return decimal(word.decode("latin-1"))
    except ValueError as error:
        raise FlexplantError(f"{str(path)!r}: SCALE FACTOR={error}. Write it again.") from None


def _abaqus_line_error(
    path: str | Path, lines: list[bytes], line: bytes, width: int
) -> FlexplantError:
    form = "node, dof, node, dof, value" if width == 5 else "row column value"
    do = "Write it with *MATRIX OUTPUT, FORMAT=MATRIX INPUT."
    return wrong_line_of(path, lines.index(line) + 1, f"{form!r} is", line, do)


def _dofs(order: IntArray, inp: str | Path | None) -> DofSet:
    ids = order >> 4
    directions = [DIRECTIONS[i - 1] for i in (order & 15).tolist()]
    if inp is None:
        return DofSet(ids, tuple(directions), np.zeros((ids.size, 3)))
    places = _input_nodes(inp)
    xyz = np.array(list(places.values())).reshape(-1, 3)
    known = np.array(list(places), dtype=np.int64)
    return DofSet(ids, tuple(directions), at_nodes(ids, known, xyz, f"{inp}, *NODE"))


def _input_nodes(path: str | Path) -> dict[int, list[float]]:
    """Return the coordinates of an input file's nodes."""
    places: dict[int, list[float]] = {}
    defined: dict[int, str] = {}
    part = ""
    inside, instances, in_instance = False, 0, False
    for number, raw in enumerate(
        file_path(path, "inp").read_text(encoding="latin-1").splitlines(), 1
    ):
        line, at = raw.strip(), f"is not read from line {number}"
        if not line or line.startswith("**"):
            continue
        if line.startswith("*"):
            word, *options = [part.strip().upper() for part in line.split(",")]
            settings = dict(part.split("=", 1) for part in options if "=" in part)
            if word in ("*TRANSFORM", "*SYSTEM") or settings.get("SYSTEM", "R") != "R":
                raise unread(path, f"{at}: nodes in another coordinate system", _PLACE)
            if word in ("*INCLUDE", "*NGEN", "*NFILL", "*NCOPY", "*NMAP") or (
                word == "*NODE" and "INPUT" in settings
            ):
                raise unread(path, f"{at}: nodes generated or in another file", _FLAT)
            instances += word == "*INSTANCE"
            in_instance = word == "*INSTANCE"
            if instances > 1:
                raise unread(path, f"{at}: several instances, whose nodes get new numbers", _FLAT)
            inside = word == "*NODE"
            if word in ("*PART", "*ASSEMBLY"):
                part = f" ({word.lower()})"
            elif word in ("*END PART", "*END ASSEMBLY"):
                part = ""
        elif in_instance:
            raise unread(path, f"{at}: an instance that is moved", _FLAT)
        elif inside:
            try:
                node, *xyz = [word.strip() for word in line.rstrip(",").split(",")]
                place = ([decimal(word or "0") for word in xyz[:3]] + [0.0] * 3)[:3]
                key = int(node)
            except ValueError:
                due = "a node and its coordinates are"
                raise wrong_line_of(path, number, due, line, "Correct the line.") from None
            if key in defined:
                again = f"line {number}{part}"
                raise defined_twice(f"{str(path)!r}: node {key}", defined[key], again, _FLAT)
            places[key], defined[key] = place, f"line {number}{part}"
    return places


#: advice for an input file that is not flat, or rotates its nodes
_FLAT = "Write the flattened input file (no parts and assemblies)."
_PLACE = "Remove it, or name rows and places yourself: .with_dofs(DofSet(...))."
FORMATS.append(Format((".mtx",), read_abaqus, mesh=(".inp",), mesh_option="inp"))
