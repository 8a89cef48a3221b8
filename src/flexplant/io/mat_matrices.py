"""MATLAB and SciPy files of matrices."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantError
from ..labels import DofSet
from ..structure import FEMatrices
from .files import FORMATS, USUAL, Format, check_count, file_path, parsing
from .foreign_parsers import in_child
from .triplets import assembled, chosen, extra_module

#: largest compression ratio of a compressed file
_DEFLATED = 1100
_HDF5 = b"\x89HDF\r\n\x1a\n"


def read_matlab(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | None = None,
    damping: str | None = USUAL,
    dofs: DofSet | str | Path | None = None,
) -> FEMatrices:
    """Return the matrices of a MATLAB file, version 4 to 7.3.

    Parameters
    ----------
    path : str or Path
        The .mat file; version 7.3 (HDF5) needs h5py: ``pip install 'flexplant[hdf5]'``.
    stiffness, mass, damping : str, optional
        Names of the variables; a field of a structure has a name like "model.K0". By default the
        usual names are searched: K, M and C or D. With `damping=None` no damping is read.
    dofs : DofSet, or path of a table for `read_dofs`, optional
        DOFs of the rows, which the file does not contain.

    Raises
    ------
    FlexplantError
        When it is not a MATLAB file, or h5py is missing.
    ModelError
        When a variable is missing, or entries are not finite real numbers.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> import os, scipy.io, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "model.mat")
    ...     scipy.io.savemat(path, {"K": np.eye(2), "M": np.eye(2)})
    ...     fx.io.read_matlab(path).n_dof
    2
    """
    path = file_path(path)
    with path.open("rb") as file:
        head = file.read(512 + len(_HDF5))
    wanted = {"K": stiffness, "M": mass, "D": damping}
    if _HDF5 in (head[: len(_HDF5)], head[512:]):
        parts = _version73(path, wanted)
    else:
        parts = _version5(path, wanted)
    return assembled(parts, dofs=dofs, source=path.name)


def read_npz(
    stiffness: str | Path,
    mass: str | Path | None = None,
    *,
    damping: str | Path | None = None,
    dofs: DofSet | str | Path | None = None,
) -> FEMatrices:
    """Return the matrices of NumPy files.

    Parameters
    ----------
    stiffness, mass, damping : str or Path
        A file for each matrix, as `scipy.sparse.save_npz` or `numpy.save` writes it. Instead,
        `stiffness` alone may be an .npz file of `numpy.savez(path, K=K, M=M, D=D)`.
    dofs : as for `read_matlab`

    Raises
    ------
    FlexplantError, ModelError, ShapeError
        As for `read_matlab`.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, scipy.sparse, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "K.npz")
    ...     scipy.sparse.save_npz(path, scipy.sparse.eye_array(2, format="csc"))
    ...     fx.io.read_npz(path).n_dof
    2
    """
    parts: dict[str, Any] = {}
    for name, path in (("K", stiffness), ("M", mass), ("D", damping)):
        if path is not None or name == "K":
            found = _numpy(file_path(path, name), name)
            parts |= found if name == "K" else {name: found[name]}
    return assembled(parts, dofs=dofs, source=Path(stiffness).name)


def _numpy(path: Path, name: str) -> dict[str, Any]:
    do = "Write it with scipy.sparse.save_npz(path, K)."
    with path.open("rb") as file, parsing(path, do):
        content: Any = np.load(file, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return {name: content}
        if "__flexplant__" in content.files:
            raise FlexplantError(f"{str(path)!r} is flexplant's own: flexplant.load(path).")
        arrays = {key: content[key] for key in content.files}
    if "format" in arrays and "shape" in arrays:
        with parsing(path, do):
            check_count(int(np.max(arrays["shape"])), path.stat().st_size, path)
            return {name: sp.load_npz(path)}
    if name != "K":
        if len(arrays) != 1:
            raise FlexplantError(f"{str(path)!r} holds {list(arrays)}: one array was expected.")
        return {name: next(iter(arrays.values()))}
    return chosen(arrays, {"K": None, "M": None, "D": USUAL}, path.name)


def _version5(path: Path, wanted: Mapping[str, str | None]) -> dict[str, Any]:
    variables: dict[str, Any] = {}
    for name, value in mat_variables(path).items():
        _flatten(name, value, variables)
    return chosen(variables, wanted, path.name)


def _flatten(name: str, value: Any, found: dict[str, Any]) -> None:
    """List square matrices, and those in structures as 'structure.field'."""
    if isinstance(value, dict):
        for field, item in value.items():
            _flatten(f"{name}.{field}", item, found)
    elif sp.issparse(value) or (isinstance(value, np.ndarray) and value.dtype.kind in "fiubc"):
        matrix: Any = value
        if matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]:
            found[name] = matrix


def _version73(path: Path, wanted: Mapping[str, str | None]) -> dict[str, Any]:
    what = f"{path.name!r} is a MATLAB file of version 7.3 (HDF5), and reading it"
    h5py = extra_module("h5py", "hdf5", what)
    with parsing(path), h5py.File(path, "r") as file:
        variables: dict[str, Any] = {}

        def visit(prefix: str, group: Any) -> None:
            for key, item in group.items():
                if key.startswith("#"):
                    continue
                name = f"{prefix}{key}"
                if isinstance(item, h5py.Group) and "MATLAB_sparse" not in item.attrs:
                    visit(f"{name}.", item)
                elif isinstance(item, h5py.Group) or (
                    item.ndim == 2 and item.shape[0] == item.shape[1] and item.dtype.kind in "fiu"
                ):
                    variables[name] = item

        visit("", file)
        size, found = path.stat().st_size, chosen(variables, wanted, path.name)
        return {part: _hdf5(item, path, size) for part, item in found.items()}


def _hdf5(item: Any, path: Path, size: int) -> Any:
    """Return a dense (MATLAB stores columns first) or sparse (data, ir, jc) matrix."""
    if "MATLAB_sparse" not in item.attrs:
        check_count(item.size, _DEFLATED * size, path)
        return np.asarray(item[()]).T
    for part in item.values():
        check_count(part.size, _DEFLATED * size, path)
    columns = np.asarray(item["jc"][()], dtype=np.int64)
    shape = (int(item.attrs["MATLAB_sparse"]), columns.size - 1)
    check_count(shape[0], size, path)
    if "data" not in item:
        return sp.csc_array(shape)
    return sp.csc_array(
        (np.asarray(item["data"][()]), np.asarray(item["ir"][()], dtype=np.int64), columns),
        shape=shape,
    )


FORMATS += [
    Format((".mat",), read_matlab, lambda head: head[:7].upper() == b"MATLAB "),
    Format((".npz", ".npy"), read_npz),
]


def mat_variables(path: str | Path) -> dict[str, Any]:
    """Return {name: value}, structures as dicts, cells as arrays of objects."""
    wrong = _cut(file_path(path).read_bytes())
    kind, found = ("cut off", {}) if wrong else in_child("matlab", path, keep="matlab")
    if kind != "value":
        raise FlexplantError(
            f"{str(path)!r} cannot be read as a MATLAB file ({wrong or found!s:.80}). It is "
            "damaged or of version 7.3, which is another format: save it with '-v7'."
        )
    content: dict[str, Any] = found
    return content


def _cut(content: bytes) -> str:
    """Return what is wrong with the lengths of the variables of a file of version 5, in words."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    at = 128
    while order and at < len(content):
        size = struct.unpack_from(f"{order}I", content[at : at + 8].ljust(8, b"\0"), 4)[0]
        if at + 8 + size > len(content):
            return f"a variable at byte {at} of {size} bytes in a file of {len(content)}"
        at += 8 + size
    return ""
