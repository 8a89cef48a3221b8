"""Exodus files, and matrices that Sierra/SD (Salinas) writes as MATLAB text: Kssr.m, Mssr.m."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy
import scipy.sparse as sp

from ..checks import FloatArray, IntArray, Matrix, mapping, one_of, real_array
from ..errors import FlexplantError, LabelError, ModelError, ShapeError, counted
from ..labels import DIRECTIONS, DofSet, node_dofs
from ..modes import Modes
from ..structure.matrices import FEMatrices
from .assembled import extra_module, from_triplets
from .fe_modes import MODE_READERS, FileShapes, check_mass, damping_ratios, frequencies
from .files import (
    ELSEWHERE,
    FORMATS,
    Elsewhere,
    Format,
    check_count,
    check_whole,
    damaged,
    file_path,
    no_motion,
    numbers_of_lines,
    parsing,
    printed_digits,
    wrong_line_of,
)

_NAME = re.compile(r"(?:disp\w*?|displ\w*?|d|u|(rot\w*?|r))_?([xyz])", re.IGNORECASE)


def read_exodus_modes(
    path: str | Path,
    *,
    times: str = "frequency",
    zeta: float | FloatArray = 0.0,
    rigid_below: float | None = None,
    variables: Mapping[str, str] | None = None,
    M: Matrix | None = None,
) -> Modes:
    """Return the modes of an Exodus file: one time step a mode.

    Parameters
    ----------
    path : str or Path
        A netCDF-3 file; netCDF-4 (HDF5) needs h5py: pip install 'flexplant[hdf5]'.
    times : {"frequency", "omega", "eigenvalue"}
        What stands in the place of time: Hz (Sierra/SD), rad/s or (rad/s)^2.
    zeta : float or (k,) array
        Damping ratios, which the file does not hold; rigid-body modes have none.
    rigid_below : float [Hz], optional
        Modes below this are rigid-body modes, and set to exactly 0.
    variables : mapping {direction: name}, optional
        Which nodal variables are the shapes, such as {"z": "DispZ", "rx": "RotX"}; when not given
        those called DispX ... RotZ, in the usual spellings.
    M : (n, n) array or sparse matrix [kg], optional
        The mass matrix in the order of the DOFs (node by node), to check the shapes with.

    Returns
    -------
    Modes
        With the shapes as they are. Modes are mass-normalised, which solvers write by default but
        the file does not say: only `M` makes it sure.

    Raises
    ------
    FlexplantError
        When it is no Exodus file, cut off, or without shapes; when h5py is needed and not there.
    ModelError
        When modes are near zero and `rigid_below` does not say what they are, or the shapes are
        not mass-normalised with `M`.

    Notes
    -----
    Format: Schoof and Yarberry, "EXODUS II: A Finite Element Data Model", SAND92-2137.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, scipy.io, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "modes.exo")
    ...     with scipy.io.netcdf_file(path, "w") as file:
    ...         for name, size in (("time_step", None), ("num_nodes", 2), ("num_nod_var", 1)):
    ...             file.createDimension(name, size)
    ...         file.createDimension("len_name", 5)
    ...         for axis, at in zip("xyz", ([0.0, 1.0], [0.0, 0.0], [0.0, 0.0])):
    ...             file.createVariable(f"coord{axis}", "d", ("num_nodes",))[:] = at
    ...         names = file.createVariable("name_nod_var", "c", ("num_nod_var", "len_name"))
    ...         names[:] = [list("DispX")]
    ...         file.createVariable("time_whole", "d", ("time_step",))[:1] = [100.0]
    ...         shape = file.createVariable("vals_nod_var1", "d", ("time_step", "num_nodes"))
    ...         shape[:1] = [[1.0, -1.0]]
    ...     modes = fx.io.read_exodus_modes(path, zeta=0.01)
    >>> modes.freq, modes.at("2:x")
    (array([100.]), array([-1.]))
    """
    omega, phi, dofs = read_shapes(path, times, variables)
    omega, n_rigid, order = frequencies(omega, rigid_below, str(path))
    damping = damping_ratios(zeta, order)
    damping[:n_rigid] = 0.0
    if M is not None:
        check_mass(phi[:, order], M, str(path))
    return Modes(omega, damping, phi[:, order], dofs, n_rigid)


def read_shapes(
    path: str | Path, times: str = "frequency", variables: Mapping[str, str] | None = None
) -> tuple[FloatArray, FloatArray, DofSet]:
    """Return frequencies [rad/s], shapes and DOFs of a file, as `read_exodus_modes` does."""
    one_of(times, "times", ("frequency", "omega", "eigenvalue"))
    if variables is not None:
        mapping(variables, "variables", "Pass {'x': 'DispX'}.", error=LabelError)
    with open_exodus(path) as file:
        xyz, ids = file.nodes()
        chosen = _motion_variables(file.variables(), variables, str(path))
        values = np.asarray(file.array("time_whole"), dtype=np.float64)
        shapes = [np.asarray(file.shapes(at), dtype=np.float64) for at in chosen.values()]
    n, k = ids.size, values.size
    if not k:
        raise FlexplantError(f"{str(path)!r} has no time steps, hence no modes. Write them.")
    if any(shape.shape != (k, n) for shape in shapes):
        raise damaged(path, f"shapes of other sizes than {k} steps and {n} nodes")
    names = list(chosen)
    phi = np.stack(shapes).transpose(2, 0, 1).reshape(n * len(names), k)
    dofs = node_dofs(ids, names, xyz)
    if not np.all(np.isfinite(values)):
        raise damaged(path, "NaN in the place of time")
    if times == "eigenvalue":
        return np.sign(values) * np.sqrt(np.abs(values)), phi, dofs
    return values * (2 * np.pi if times == "frequency" else 1.0), phi, dofs


def _motion_variables(
    names: list[str], given: Mapping[str, str] | None, path: str
) -> dict[str, int]:
    """Return {direction: place of the variable} in the order of directions."""
    if given is not None:
        wrong = sorted(set(given) - set(DIRECTIONS))
        missing = sorted(set(given.values()) - set(names))
        if wrong or missing or not given:
            raise LabelError(
                f"variables={dict(given)!r:.80}: directions are {', '.join(DIRECTIONS)}, and nodal "
                f"variables of {path!r} {names[:12]}."
            )
        return {d: names.index(given[d]) for d in DIRECTIONS if d in given}
    found: dict[str, list[int]] = {}
    for at, name in enumerate(names):
        match = _NAME.fullmatch(name.strip())
        if match:
            found.setdefault(("r" if match[1] else "") + match[2].lower(), []).append(at)
    doubled = {d: [names[i] for i in places] for d, places in found.items() if len(places) > 1}
    if doubled or not found:
        raise FlexplantError(
            f"{path!r} has nodal variables {names[:12]}, among which the shapes are not clear. Say "
            "which they are: variables={'x': 'DispX', ...}."
        )
    return {d: found[d][0] for d in DIRECTIONS if d in found}


@contextlib.contextmanager
def open_exodus(path: str | Path) -> Iterator[ExodusFile]:
    """Return an Exodus file, netCDF-3 or netCDF-4, to be used in a `with` block."""
    with file_path(path).open("rb") as raw:
        is_hdf = raw.read(8) == b"\x89HDF\r\n\x1a\n"
    what = f"{str(path)!r} is a netCDF-4 file, and reading it"
    h5py: Any = extra_module("h5py", "hdf5", what) if is_hdf else None
    do = "Is it an Exodus (netCDF) file, and whole? Write it again."
    with parsing(path, do), np.errstate(all="ignore"):  # sizes of a damaged file overflow
        file = h5py.File(path, "r") if is_hdf else scipy.io.netcdf_file(path, "r", mmap=False)
        with contextlib.closing(file):
            yield ExodusFile(str(path), file)


class ExodusFile:
    """Arrays of an Exodus file by name."""

    def __init__(self, path: str, file: Any) -> None:
        self.path, self.held = path, getattr(file, "variables", file)

    def array(self, name: str) -> Any:
        """Return a variable as an array."""
        if name not in self.held:
            raise damaged(self.path, f"it has no {name!r}")
        array = np.array(self.held[name][...])
        return array.astype(array.dtype.newbyteorder("="))

    def nodes(self) -> tuple[FloatArray, Any]:
        """Return coordinates (n, 3) and node numbers (n,)."""
        if "coord" in self.held:
            rows = list(self.array("coord"))
        else:
            rows = [self.array(f"coord{a}") for a in "xyz" if f"coord{a}" in self.held]
        if not rows:
            raise damaged(self.path, "it has no coordinates of nodes")
        rows += [np.zeros_like(rows[0])] * (3 - len(rows))
        xyz = real_array(np.stack(rows, axis=1), "coordinates", (None, 3))
        name = next((one for one in ("node_num_map", "node_map") if one in self.held), None)
        ids = np.arange(1, len(xyz) + 1) if name is None else self.array(name).astype(np.int64)
        if ids.size != len(xyz):
            raise damaged(self.path, f"{ids.size} node numbers, {len(xyz)} nodes")
        return xyz, ids

    def variables(self) -> list[str]:
        """Return the names of the nodal variables."""
        if "name_nod_var" not in self.held:
            raise damaged(self.path, "it has no nodal variables, hence no shapes")
        table = self.array("name_nod_var")
        return [
            b"".join(np.atleast_1d(row).tolist()).split(b"\0")[0].decode("latin-1").strip()
            for row in table
        ]

    def shapes(self, place: int) -> Any:
        """Return a nodal variable (steps, nodes) by its place (from 0)."""
        if "vals_nod_var" in self.held:
            return cast(Any, self.array("vals_nod_var"))[:, place]
        return self.array(f"vals_nod_var{place + 1}")


ELSEWHERE += [
    Elsewhere((".exo", ".e"), "modes: flexplant.io.read_modes reads them"),
    Elsewhere((".g",), "a mesh: give it to read_sierra(..., exodus=...)"),
]


def read_exodus_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an Exodus file."""
    if nodes is not None:
        raise ModelError(f"{str(path)!r} holds its nodes: leave nodes= out.")
    omega, phi, dofs = read_shapes(path)
    return FileShapes(omega, phi, dofs)


MODE_READERS |= dict.fromkeys((".exo", ".e"), read_exodus_shapes)


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

    def matrix(file: str | Path) -> sp.csc_array:
        table = tables[str(file)][0]
        at = table[:, :2].astype(np.int64) - 1
        return from_triplets(table[:, 2], at[:, 0], at[:, 1], n, file)

    located = True
    if dof_map is not None:
        dofs, located = _read_row_names(dof_map, exodus, n)
    M, D = (None if file is None else matrix(file) for file in (mass, damping))
    return FEMatrices(
        matrix(stiffness), M, D, dofs=dofs, source=str(stiffness), located=located,
        digits=max(digits or 0 for _, digits in tables.values()) or None,
    )  # fmt: skip


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
    text = re.sub(rb"[,;]|\.\.\.", b" ", b"\n".join(lines))
    kept = [line for line in text.split(b"\n") if line.strip()]
    if not kept:
        raise FlexplantError(f"{str(path)!r} holds no table of numbers. Write it with 'mfile'.")
    do = "Write it again with 'mfile'."
    if _ZEROS.search(content):
        do = "A map of DOFs goes to dof_map=, a list of nodes to exodus=."

    def wrong_at(place: int, line: bytes) -> FlexplantError:
        due = f"{counted(width, 'number')} are"
        return wrong_line_of(path, first + place, due, lines[place], do)

    table = numbers_of_lines(text, width, wrong_at)
    whole = table[:, : width - 1] if width > 1 else table
    wrong = (whole != np.round(whole)) | ((whole < 1) & (width > 1))
    if np.any(wrong):
        what = f"{whole[wrong][0]:g} is no row or column, which are counted from 1"
        raise damaged(path, what, "Write it again with 'mfile'.")
    shown = [line.split()[-1] for line in kept[:: max(1, len(kept) // 1000)]]
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
