"""One door for the files of all finite-element programs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FlexplantError, ModelError
from ..labels import DofSet
from ..structure import FEMatrices, FEModel
from ..values import short
from .abaqus import read_abaqus
from .ansys import read_ansys
from .dmig import read_dmig
from .matlab import read_matlab, read_npz
from .matrix_market import read_harwell_boeing, read_matrix_market
from .op4 import read_op4
from .paths import file_path
from .sierra import read_sierra
from .tables import at_nodes, read_dofs, read_nodes_table

#: formats whose files hold one matrix each: mass= and damping= are files then
_ONE_EACH = ("matrix market", "abaqus", "harwell-boeing", "numpy", "sierra")
_BY_SUFFIX = {
    ".rsa": "harwell-boeing",
    ".rua": "harwell-boeing",
    ".hb": "harwell-boeing",
    ".rb": "harwell-boeing",
    ".mat": "matlab",
    ".npz": "numpy",
    ".npy": "numpy",
    ".full": "ansys",
    ".op4": "op4",
    ".pch": "dmig",
    ".dmig": "dmig",
    ".m": "sierra",
}
_READERS: dict[str, Callable[..., FEMatrices]] = {
    "matrix market": read_matrix_market,
    "harwell-boeing": read_harwell_boeing,
    "numpy": read_npz,
    "matlab": read_matlab,
    "abaqus": read_abaqus,
    "sierra": read_sierra,
    "op4": read_op4,
    "dmig": read_dmig,
    "ansys": read_ansys,
}
#: what a reader calls the file that holds its nodes
_OWN_NODES = {"abaqus": "inp", "dmig": "bdf", "ansys": "nodes"}
#: what holds results, not matrices, and who reads it
_OTHERS = {
    ".exo": "modes: flexplant.io.read_exodus_modes",
    ".e": "modes: flexplant.io.read_exodus_modes",
    ".g": "a mesh: give it to read_sierra(..., exodus=...)",
    ".unv": "measured data: read_frf_uff, read_modes_uff, read_nodes_uff of flexplant.io",
    ".uff": "measured data: read_frf_uff, read_modes_uff, read_nodes_uff of flexplant.io",
    ".rst": "results: give it to read_ansys(..., nodes=...)",
    ".cdb": "a mesh: give it to read_ansys(..., nodes=...)",
    ".bdf": "a mesh: give it to read_dmig(..., bdf=...)",
    ".inp": "a mesh: give it to read_abaqus(..., inp=...)",
}


def read_matrices(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | Path | None = None,
    damping: str | Path | None = None,
    dofs: DofSet | str | Path | None = None,
    nodes: str | Path | None = None,
    scalar_direction: str | None = None,
    dof_map: str | Path | None = None,
    exodus: str | Path | None = None,
    rotations: Mapping[int, Any] | None = None,
) -> FEMatrices:
    """Return the matrices of a file, whichever program wrote it, for `check` to look at.

    By suffix and content: Matrix Market or Abaqus .mtx; Harwell-Boeing .rsa, .rua; MATLAB .mat;
    NumPy and SciPy .npz, .npy; ANSYS .full; Nastran .op4 and .pch; Sierra .m.

    Parameters
    ----------
    path : str or Path
        The file; where each matrix has its own, that of K.
    stiffness : str, optional
        Name of the variable, in files that hold several (.mat, .op4, .pch).
    mass, damping : str or Path, optional
        Their files, or names of variables, likewise.
    dofs : DofSet, or path of a table for `read_dofs`, optional
        What the rows stand for, where the file does not say.
    nodes : str or Path, optional
        Coordinates, where the file names its rows but has none: a table `node, x, y, z`; an ANSYS
        .rst or .cdb, a Nastran .bdf, an Abaqus .inp.
    scalar_direction, dof_map, exodus, rotations : optional
        Of one format each: what scalar points move in (`read_dmig`), the map and the mesh of
        `read_sierra`, local systems (`read_ansys`).

    Returns
    -------
    FEMatrices

    Raises
    ------
    FlexplantError
        When the format is not known, holds no matrices, or the file is damaged; when the reader of
        this format has no such option (those that it has are named).
    ModelError, LabelError, ShapeError
        What the reader of the format raises.
    FileNotFoundError
        When there is no such file.
    """
    path = file_path(path)
    form = _format(path)
    if form in _ONE_EACH and stiffness is not None:
        raise ModelError(
            f"stiffness= names a variable; {path.name!r} holds one matrix. Leave it out."
        )
    named = read_dofs(dofs) if isinstance(dofs, str | Path) else dofs
    table, own = _split(nodes, form)
    given: dict[str, Any] = {"mass": mass, "damping": damping}
    if form not in _ONE_EACH:
        given["stiffness"] = stiffness
    given = {} if form == "ansys" else given
    if form not in ("dmig", "ansys"):
        given["dofs"] = named
    if form in _OWN_NODES:
        given[_OWN_NODES[form]] = own
    if form == "ansys" and not (stiffness is mass is damping is None):
        raise ModelError(f"{path.name!r} holds one K and one M: leave stiffness=, mass= out.")
    reader = _READERS[form]
    options = _told(
        scalar_direction=scalar_direction, dof_map=dof_map, exodus=exodus, rotations=rotations
    )
    _check_options(options, reader, given, path.name)
    found = reader(path, **given, **options)
    if form in ("dmig", "ansys") and named is not None:
        found = found.with_dofs(named)
    if table is not None:
        if found.dofs is None:
            raise ModelError(
                f"{path.name!r} does not name its rows, so that coordinates of nodes are not "
                "enough: give dofs=, a table node, direction, x, y, z in the order of the rows."
            )
        known, xyz = read_nodes_table(table)
        wanted = np.unique(found.dofs.nodes)
        found = found.located_at(wanted.tolist(), at_nodes(wanted, known, xyz, str(table)))
    return found.trimmed()


def read_model(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | Path | None = None,
    damping: str | Path | None = None,
    dofs: DofSet | str | Path | None = None,
    nodes: str | Path | None = None,
    units: Sequence[str | float] = ("m", "kg", "s"),
    massless: str = "refuse",
    free: bool = False,
    name: str | None = None,
    scalar_direction: str | None = None,
    dof_map: str | Path | None = None,
    exodus: str | Path | None = None,
    rotations: Mapping[int, Any] | None = None,
) -> FEModel:
    """Return the model of a file, whichever program wrote it.

    As `read_matrices(...).converted(*units).model(massless=...)`: what is wrong with a file is
    refused with a reason, and `check(read_matrices(...))` tells it all at once.

    Parameters
    ----------
    path : str or Path
        The file; where each matrix has its own, that of K.
    stiffness : str, optional
        Name of the variable, in files that hold several (.mat, .op4, .pch).
    mass, damping : str or Path, optional
        Their files, or names of variables, likewise.
    dofs : DofSet, or path of a table for `read_dofs`, optional
        What the rows stand for, where the file does not say. Its coordinates are in the unit of
        length of the file, too.
    nodes : str or Path, optional
        Coordinates, where the file names its rows but has none.
    units : (length, mass, time)
        Of the file: ("mm", "t", "s") for instance; the model is in SI.
    massless : "refuse" or "condense"
        What to do with DOFs and motions without mass; condensing them is exact.
    free : bool
        Free the rigid-body motions that only lost digits of a text hold.
    name : str, optional
        For display; the name of the file when not given.
    scalar_direction, dof_map, exodus, rotations : optional
        Of one format each; see `read_matrices`.

    Returns
    -------
    FEModel

    Raises
    ------
    FlexplantError
        When the format is not known, holds no matrices, or the file is damaged; when the reader of
        this format has no such option (those that it has are named).
    ModelError, LabelError, ShapeError
        What the reader of the format raises, or when the matrices make no model.
    FileNotFoundError
        When there is no such file.

    Warns
    -----
    FlexplantWarning
        When the digits of a text file endanger the soft modes.
    """
    sizes = tuple(units) if isinstance(units, Iterable) and not isinstance(units, str) else ()
    if len(sizes) != 3:
        raise ModelError(
            f"units must be three, of length, mass and time, got {short(units)}: "
            "('mm', 't', 's') for instance."
        )
    found = read_matrices(
        path,
        stiffness=stiffness,
        mass=mass,
        damping=damping,
        dofs=dofs,
        nodes=nodes,
        scalar_direction=scalar_direction,
        dof_map=dof_map,
        exodus=exodus,
        rotations=rotations,
    )
    if sizes != ("m", "kg", "s"):
        found = found.converted(*sizes)
    return found.model(massless=massless, free=free, name=name or Path(path).name)


def _told(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _check_options(
    options: dict[str, Any], reader: Callable[..., FEMatrices], given: dict[str, Any], name: str
) -> None:
    """Raise FlexplantError for an option that the reader does not take, naming those it does."""
    taken = {
        parameter.name
        for parameter in inspect.signature(reader).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    } - set(given)
    wrong = sorted(set(options) - taken)
    if wrong:
        more = f"beside these it takes {sorted(taken)}" if taken else "it takes no others"
        raise FlexplantError(
            f"{name!r} is read by {reader.__name__}, which has no option {wrong[0]!r}: {more}. "
            "Common to all formats are stiffness, mass, damping, dofs, nodes."
        )


def _split(nodes: str | Path | None, form: str) -> tuple[Any, Any]:
    """Return the coordinates as a text table, or as a file that the reader knows itself."""
    if nodes is None:
        return None, None
    suffix = Path(nodes).suffix.lower()
    own = {
        "ansys": (".rst", ".cdb"),
        "dmig": (".bdf", ".dat", ".nas"),
        "abaqus": (".inp",),
    }
    return (None, nodes) if suffix in own.get(form, ()) else (nodes, None)


def _format(path: Path) -> str:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    last = suffixes[-1] if suffixes else ""
    if last == ".gz" and suffixes[-2:-1] == [".mtx"]:
        return "matrix market"
    with path.open("rb") as file:
        head = file.read(80)
    # what a file says of itself goes before its name
    if head.lower().startswith(b"%%matrixmarket"):
        return "matrix market"
    if head.startswith(b"MATLAB "):
        return "matlab"
    if last == ".mtx":
        return "abaqus"
    if last in _BY_SUFFIX:
        return _BY_SUFFIX[last]
    if last in _OTHERS:
        raise FlexplantError(f"{path.name!r} holds no matrices but {_OTHERS[last]}.")
    if head.startswith((b"DMIG", b"$")) and b"DMIG" in path.read_bytes()[:20000]:
        return "dmig"
    raise FlexplantError(
        f"the format of {path.name!r} is not known, neither by its suffix {last!r} nor by what it "
        f"begins with. Known suffixes: .mtx, {', '.join(_BY_SUFFIX)}. Readers of one format are in "
        "flexplant.io."
    )
