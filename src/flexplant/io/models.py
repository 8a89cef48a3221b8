"""Matrices and models from the files of all known finite-element programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..dof_columns import at_nodes
from ..errors import FlexplantError, ModelError
from ..labels import DofSet
from ..structure import FEMatrices, FEModel
from .files import ELSEWHERE, FORMATS, HEAD, USUAL, Elsewhere, Format, ends, file_path, three_units
from .tables import read_dofs, read_nodes_table

_NASTRAN = (
    "Matrices: EXTSEOUT(ASMBULK,EXTID=1,MATOP4=31) in the case control and ASSIGN "
    "OUTPUT4='run.op4',UNIT=31 above it write them as .op4, read_op4"
)
ELSEWHERE += [
    Elsewhere((".op2",), f"results, of which flexplant.io.read_modes reads the modes. {_NASTRAN}"),
    Elsewhere((".f06", ".f04", ".out"), f"what a run printed, with too few digits. {_NASTRAN}"),
    Elsewhere(
        (".odb", ".fil", ".sim"),
        "results in a form of Abaqus' own. Matrices: *MATRIX GENERATE, STIFFNESS, MASS and *MATRIX "
        "OUTPUT, STIFFNESS, MASS write them as .mtx, read_abaqus",
    ),
    Elsewhere(
        (".mph",),
        "a model of COMSOL. Matrices: LiveLink's mphmatrix(model, 'sol1', 'out', {'Kc', 'Ec'}), "
        "of which Ec is M, saved as .mat: read_matlab",
    ),
]


def read_matrices(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | Path | None = None,
    damping: str | Path | None = USUAL,
    dofs: DofSet | str | Path | None = None,
    nodes: str | Path | None = None,
    scalar_direction: str | None = None,
    rotations: Mapping[int, Any] | None = None,
) -> FEMatrices:
    """Return the matrices of a file in any known format, for example for `check`.

    The suffix and the content of the file determine the format: Matrix Market or Abaqus .mtx;
    Harwell-Boeing .rsa, .rua; MATLAB .mat; NumPy and SciPy .npz, .npy; ANSYS .full; Nastran .op4
    and .pch.

    Parameters
    ----------
    path : str or Path
        Path of the file. If each matrix has a separate file, it is the file of K.
    stiffness, mass, damping, dofs, nodes, scalar_direction, rotations : optional
        As for `read_model`.

    Raises
    ------
    FileNotFoundError, FlexplantError, ModelError, LabelError, ShapeError
        As for `read_model`.

    Examples
    --------
    >>> import flexplant as fx
    >>> import scipy.io, scipy.sparse, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     scipy.io.mmwrite(f"{folder}/K.mtx", scipy.sparse.eye_array(2))
    ...     found = fx.read_matrices(f"{folder}/K.mtx")
    >>> found.n_dof, found.M is None
    (2, True)
    """
    path = file_path(path)
    form = _format(path)
    named = read_dofs(dofs) if isinstance(dofs, str | Path) else dofs
    known_nodes = nodes is not None and ends(file_path(nodes, "nodes"), form.mesh)
    given = {
        "stiffness": stiffness,
        "mass": mass,
        "damping": damping,
        "dofs": named if "dofs" in form.options else None,
        "nodes": nodes if known_nodes else None,
        "scalar_direction": scalar_direction,
        "rotations": rotations,
    }
    options: dict[str, Any] = {
        name: value for name, value in given.items() if value not in (None, USUAL)
    }
    if damping is None and form.several:
        options["damping"] = None
    _check_options(options, form, path.name)
    if known_nodes:
        options[form.mesh_option] = options.pop("nodes")
    found = form.read(path, **options)
    if named is not None and "dofs" not in form.options:
        found = found.with_dofs(named)
    if nodes is not None and not known_nodes:
        if found.dofs is None:
            raise ModelError(
                f"{path.name!r} does not name its rows, so that coordinates of nodes are not "
                "enough: give dofs=, a table node, direction, x, y, z in the order of the rows, "
                "or, where each node has the same DOFs, dofs=fx.io.read_dofs("
                f"{Path(nodes).name!r}, directions=('x', 'y', 'z')), or all six to 'rz'."
            )
        known, xyz = read_nodes_table(nodes)
        wanted = np.unique(found.dofs.nodes)
        found = found.located_at(wanted.tolist(), at_nodes(wanted, known, xyz, str(nodes)))
    return found.trimmed()


def read_model(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | Path | None = None,
    damping: str | Path | None = USUAL,
    dofs: DofSet | str | Path | None = None,
    nodes: str | Path | None = None,
    units: Sequence[str | float] = ("m", "kg", "s"),
    massless: str = "refuse",
    free: bool = False,
    name: str | None = None,
    scalar_direction: str | None = None,
    rotations: Mapping[int, Any] | None = None,
) -> FEModel:
    """Return the model of a file in any known format.

    This is `read_matrices(...).converted(*units).model(massless=...)`. An error gives the first
    reason why a model is refused; `check(read_matrices(...))` reports all problems.

    Parameters
    ----------
    path : str or Path
        Path of the file. If each matrix has a separate file, it is the file of K.
    stiffness : str, optional
        Name of the variable, in files that hold several (.mat, .op4, .pch).
    mass, damping : str or Path, optional
        Files of M and D, or names of variables in a file of several matrices. By default such a
        file is searched for the usual names. With `damping=None` no damping is read.
    dofs : DofSet, or path of a table for `read_dofs`, optional
        DOFs of the rows, where the file does not contain them. Their coordinates use the unit of
        length of the file too.
    nodes : str or Path, optional
        File of the coordinates, if the first file names its rows but has no coordinates. It is a
        table `node, x, y, z`, an ANSYS .rst or .cdb, a Nastran .bdf, or an Abaqus .inp.
    units : (length, mass, time)
        Units of the file, for example ("mm", "t", "s"). The model that is returned is in SI units.
    massless : "refuse" or "condense"
        Treatment of DOFs and motions without mass; condensing them is exact.
    free : bool
        Whether to remove the small stiffness against rigid-body motions that the rounding of the
        numbers in the file causes.
    name : str, optional
        Name for display; by default that of the file.
    scalar_direction, rotations : optional
        Options of one format: the direction in which scalar points move (`read_dmig`), and local
        coordinate systems (`read_ansys`).

    Raises
    ------
    FileNotFoundError
        When the file does not exist, as with every reader.
    FlexplantError
        When the format is not known, holds no matrices, or the file is damaged.
    ModelError, LabelError, ShapeError
        When the reader of this format does not have an option or finds an error, or the matrices do
        not form a model.

    Warns
    -----
    FlexplantWarning
        When the digits of a text file are too few for the soft modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> import scipy.io, scipy.sparse, tempfile
    >>> K = scipy.sparse.csc_array([[2.0, -1.0], [-1.0, 1.0]])  # N/mm
    >>> dofs = fx.DofSet([1, 2], ["x", "x"], [[0.0, 0, 0], [10.0, 0, 0]])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     k, m = f"{folder}/K.mtx", f"{folder}/M.mtx"
    ...     scipy.io.mmwrite(k, K)
    ...     scipy.io.mmwrite(m, scipy.sparse.eye_array(2) * 1e-3)  # t
    ...     model = fx.read_model(k, mass=m, dofs=dofs, units=("mm", "t", "s"))
    >>> model.K.toarray()
    array([[ 2000., -1000.],
           [-1000.,  1000.]])
    """
    sizes = three_units(units)
    found = read_matrices(
        path,
        stiffness=stiffness,
        mass=mass,
        damping=damping,
        dofs=dofs,
        nodes=nodes,
        scalar_direction=scalar_direction,
        rotations=rotations,
    )
    if sizes != ("m", "kg", "s"):
        found = found.converted(*sizes)
    return found.model(massless=massless, free=free, name=name or Path(path).name)


def _check_options(options: Iterable[str], form: Format, name: str) -> None:
    """Raise ModelError for an unknown option of the reader, with the known ones."""
    wrong = sorted(set(options) - set(form.options))
    if wrong:
        why = "its files hold one matrix of a kind, without names; " * (
            wrong[0] in "stiffness mass"
        )
        raise ModelError(
            f"{name!r} is read by {form.read.__name__}, which has no option {wrong[0]!r}: {why}it "
            f"takes {sorted({*form.options, 'dofs', 'nodes'})}. Leave {wrong[0]}= out."
        )


def _format(path: Path) -> Format:
    with path.open("rb") as file:
        head = file.read(HEAD)
    known = [form for form in FORMATS if form.begins(head)]
    known += [form for form in FORMATS if ends(path, form.suffixes)]
    if known:
        return known[0]
    for other in ELSEWHERE:
        if ends(path, other.suffixes) and other.begins(head):
            raise FlexplantError(f"{path.name!r} holds no matrices but {other.reader}.")
    for form in FORMATS:
        if ends(path, form.mesh):
            raise FlexplantError(
                f"{path.name!r} holds no matrices but a mesh or results: give it to "
                f"{form.read.__name__}(..., {form.mesh_option}=...)."
            )
    raise FlexplantError(
        f"the format of {path.name!r} is not known, neither by its suffix {path.suffix!r} nor by "
        f"what it begins with. Known suffixes: {', '.join(s for f in FORMATS for s in f.suffixes)}."
        " Readers of one format are in flexplant.io. Numbers in a plain text: numpy.loadtxt, then "
        "FEModel(M, K, dofs=DofSet(nodes, directions, xyz))."
    )
