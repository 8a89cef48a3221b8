"""Modes from Exodus files, netCDF-3 or netCDF-4."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy

from ..arrays import FloatArray, Matrix, mapping, one_of, real_array
from ..errors import FlexplantError, LabelError, ModelError
from ..labels import DIRECTIONS, DofSet, node_dofs
from ..modes import Modes
from .fe_modes import MODE_READERS, FileShapes, check_mass, damping_ratios, frequencies
from .files import ELSEWHERE, Elsewhere, damaged, file_path, parsing
from .triplets import extra_module

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
    """Return the modes of an Exodus file, in which each time step is a mode.

    Parameters
    ----------
    path : str or Path
        A netCDF-3 file; netCDF-4 (HDF5) needs h5py: pip install 'flexplant[hdf5]'.
    times : {"frequency", "omega", "eigenvalue"}
        Quantity stored as time: Hz (Sierra/SD), rad/s or (rad/s)^2.
    zeta : float or (k,) array
        Damping ratios, which the file does not contain; those of rigid-body modes are ignored.
    rigid_below : float [Hz], optional
        Frequency below which modes count as rigid-body modes and are set to exactly 0.
    variables : mapping {direction: name}, optional
        Nodal variables of the shapes, such as {"z": "DispZ", "rx": "RotX"}; by default DispX ...
        RotZ, in the usual spellings.
    M : (n, n) array or sparse matrix [kg], optional
        Mass matrix in the order of the DOFs (node by node). It is used to check the shapes.

    Returns
    -------
    Modes
        Modes with the shapes of the file. They are assumed to be mass-normalised, which is the
        default of solvers but not stated in the file; `M` checks it.

    Raises
    ------
    FlexplantError
        When it is not an Exodus file, is cut off or has no shapes; when h5py is needed and missing.
    ModelError
        When modes are near zero and `rigid_below` is not given, or the shapes are
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
            f"{path!r} has nodal variables {names[:12]}, and it is not clear which are the "
            f"shapes. Name them: variables={{'x': 'DispX', ...}}."
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
            raise damaged(self.path, "it has no nodal variables and therefore no shapes")
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
    Elsewhere((".g",), "a mesh without modes: write the matrices or the modes"),
]


def read_exodus_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an Exodus file."""
    if nodes is not None:
        raise ModelError(f"{str(path)!r} holds its nodes: leave nodes= out.")
    omega, phi, dofs = read_shapes(path)
    return FileShapes(omega, phi, dofs)


MODE_READERS |= dict.fromkeys((".exo", ".e"), read_exodus_shapes)
