"""Matrices that Sierra/SD (Salinas) writes as MATLAB text: Kssr.m, Mssr.m, FetiMap_a.m."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from ..checks import FloatArray, IntArray
from ..errors import FlexplantError, ModelError, ShapeError, counted
from ..labels import DIRECTIONS, DofSet
from ..structure.matrices import FEMatrices
from .assembled import from_triplets
from .exodus import open_exodus
from .numbers import printed_digits, rows_of_numbers, wrong_line
from .paths import (
    FORMATS,
    Format,
    check_count,
    check_whole,
    damaged,
    file_path,
    no_motion,
    wrong_line_of,
)

_WORD = re.compile(rb"[^\s,;]+")
#: a map has so many entries a node: x, y, z, rx, ry, rz and two or three that are no motion
_PER_NODE = (9, 8)
#: x = zeros(5670, 1); x(1) = 1; x(2) = 2; ...
_ZEROS = re.compile(rb"=\s*zeros\(\s*(\d{1,12})\s*,\s*1\s*\)")
_ASSIGNED = re.compile(rb"\w+\(\s*(\d{1,12})\s*\)\s*=\s*(-?\d{1,12})\s*;?\s*")


def read_sierra(
    stiffness: str | Path,
    *,
    mass: str | Path | None = None,
    damping: str | Path | None = None,
    dof_map: str | Path | None = None,
    exodus: str | Path | None = None,
    dofs: DofSet | None = None,
) -> FEMatrices:
    r"""Return the matrices that Sierra/SD (formerly Salinas) wrote as MATLAB text.

    The first bracketed table of each file is read: lines `row column value` counted from 1, one
    triangle or both.

    Parameters
    ----------
    stiffness, mass, damping : str or Path
        The files `Kssr.m`, `Mssr.m` and `Cssr.m` (output option `mfile`).
    dof_map : str or Path, optional
        `FetiMap_a.m` or `..._ASetMap.m`: eight or nine entries a node (x, y, z, rx, ry, rz and two
        or three that are no motion), each the row of the matrices, 0 or less where there is none.
    exodus : str or Path, optional
        The mesh, for numbers and coordinates of the nodes in the order of the map; or the list
        `..._gid.m` of their numbers alone.
    dofs : DofSet, optional
        The rows, where there is no map.

    Returns
    -------
    FEMatrices
        With a map and without `exodus`, nodes are numbered from 1 and not `located`.

    Raises
    ------
    FlexplantError
        When a line has another form; it is named.
    ShapeError
        When the map, the mesh and the matrices do not belong together.
    ModelError
        When rows are no motion of a node, or a map and `dofs` are both given.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "Kssr.m")
    ...     _ = file.write_text("A = [\n1 1 4e5\n1 2 -4e5\n2 2 4e5\n];\n")
    ...     found = fx.io.read_sierra(file, dofs=fx.chain(masses=[1, 1], stiffnesses=[1]).dofs)
    >>> found.K.toarray().tolist()
    [[400000.0, -400000.0], [-400000.0, 400000.0]]
    """
    if dof_map is not None and dofs is not None:
        raise ModelError("the rows are named twice, by dof_map and by dofs: give one of them.")
    files = [stiffness, *(file for file in (mass, damping) if file is not None)]
    tables = {str(file): _read_numbers(file, 3) for file in files}
    n = max(int(table[:, :2].max()) for table, _ in tables.values())
    check_count(n, sum(file_path(file).stat().st_size for file in files), stiffness)

    def matrix(file: str | Path | None) -> sp.csc_array | None:
        if file is None:
            return None
        table = tables[str(file)][0]
        at = table[:, :2].astype(np.int64) - 1
        return from_triplets(table[:, 2], at[:, 0], at[:, 1], n, file)

    located = True
    if dof_map is not None:
        dofs, located = _read_row_names(dof_map, exodus, n)
    K = matrix(stiffness)
    assert K is not None  # noqa: S101 - its file is no option
    return FEMatrices(
        K,
        matrix(mass),
        matrix(damping),
        dofs=dofs,
        digits=max(digits or 0 for _, digits in tables.values()) or None,
        source=str(stiffness),
        located=located,
    )


def _read_numbers(path: str | Path, width: int) -> tuple[FloatArray, int | None]:
    """Return the numbers of the first bracketed table (m, width), and the digits printed."""
    content = file_path(path).read_bytes()
    start, stop = content.find(b"["), content.find(b"]")
    if start < 0:  # a bare table
        start, stop = -1, len(content)
    if stop < start:
        raise damaged(path, "the table does not end with ']'")
    first = content[: start + 1].count(b"\n") + 1
    lines = [
        line.split(b"%")[0].strip(b" \t\r;,") for line in content[start + 1 : stop].split(b"\n")
    ]
    lines = [line.replace(b"...", b" ") for line in lines]
    words = [_WORD.findall(line) for line in lines]
    kept = [line for line in lines if line]
    table = rows_of_numbers(re.sub(rb"[,;]", b" ", b"\n".join(kept)), width)
    if table is None or not kept or not np.all(np.isfinite(table)):
        at = wrong_line((b" ".join(row) for row in words), width)
        if at is not None:
            due, do = f"{counted(width, 'number')} are", "Write it again with 'mfile'."
            if _ZEROS.search(content):
                do = "A map of DOFs goes to dof_map=, a list of nodes to exodus=."
            raise wrong_line_of(path, first + at, due, lines[at], do)
        raise FlexplantError(f"{str(path)!r} holds no table of numbers. Write it with 'mfile'.")
    whole = table[:, : width - 1] if width > 1 else table
    wrong = (whole != np.round(whole)) | ((whole < 1) & (width > 1))
    if np.any(wrong):
        what = f"{whole[wrong][0]:g} is no row or column, which are counted from 1"
        raise damaged(path, what, "Write it again with 'mfile'.")
    shown = [row[-1] for row in words if row][:: max(1, len(kept) // 1000)]
    if stop == len(content):
        check_whole(content, shown, path)
    return table, printed_digits(shown)


def _map_vector(path: str | Path) -> IntArray:
    """Return the whole numbers of a vector: one bracketed, or filled entry by entry."""
    content = file_path(path).read_bytes()
    size = _ZEROS.search(content)
    if size is None:
        return _read_numbers(path, 1)[0].ravel().astype(np.int64)
    count = int(size[1])
    check_count(count, 9 * len(content), path)
    body = content[size.end() :].lstrip(b" \t;,").splitlines()
    lines = [line.split(b"%")[0].strip() for line in body]
    wrong = next((line for line in lines if line and not _ASSIGNED.fullmatch(line)), None)
    pairs = np.array([match.groups() for line in lines if (match := _ASSIGNED.match(line))])
    places, values = pairs.reshape(-1, 2).astype(np.int64).T
    if wrong is not None or np.any((places < 1) | (places > count)):
        got = repr((wrong or b"a place out of the vector")[:72].decode("latin-1"))
        raise damaged(path, f"'x(place) = number;' is due within 1 to {count}, got {got}")
    vector = np.zeros(count, dtype=np.int64)
    vector[places - 1] = values
    return vector


def _mesh(path: str | Path | None) -> tuple[FloatArray | None, IntArray | None]:
    """Return coordinates and numbers of nodes, as far as there are."""
    if path is None:
        return None, None
    if file_path(path).suffix.lower() == ".m":
        return None, _map_vector(path)
    with open_exodus(path) as file:
        return file.nodes()


def _read_row_names(path: str | Path, exodus: str | Path | None, n: int) -> tuple[DofSet, bool]:
    """Return the rows, and whether they have coordinates."""
    places = _map_vector(path)
    if sorted(places[places > 0].tolist()) != list(range(1, n + 1)):
        raise ShapeError(
            f"{str(path)!r} maps {int(np.count_nonzero(places > 0))} of {places.size} entries, but "
            f"the matrices have {n} rows. Is it of the same run?"
        )
    entry = np.flatnonzero(places > 0)[np.argsort(places[places > 0])]
    xyz, ids = _mesh(exodus)
    per = _per_node(path, places.size, entry, None if ids is None else ids.size)
    nodes = places.size // per
    ids = np.arange(1, nodes + 1) if ids is None else ids
    at = entry // per
    directions = tuple(DIRECTIONS[i] for i in (entry % per).tolist())
    place = np.zeros((nodes, 3)) if xyz is None else xyz
    return DofSet(ids[at], directions, place[at]), xyz is not None


def _per_node(path: str | Path, size: int, entry: IntArray, nodes: int | None) -> int:
    """Return how many entries of a map a node has."""
    fits = [per for per in _PER_NODE if size % per == 0 and nodes in (None, size // per)]
    moving = [per for per in fits if np.all(entry % per < len(DIRECTIONS))]
    if len(moving) == 1:
        return moving[0]
    if fits and not moving:
        raise no_motion(path, "by its map")
    raise ShapeError(
        f"{str(path)!r} has {size} entries"
        + (
            ": whether a node has 8 or 9 of them is not clear. Give the mesh: exodus=..."
            if fits
            else ", not 8 or 9 a node. Is it of the same run?"
            if nodes is None
            else f", not 8 or 9 for each of {counted(nodes, 'node')}. Are they of the same mesh?"
        )
    )


FORMATS.append(Format((".m",), read_sierra))
