"""Modes of the result files of all finite-element programs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..checks import FloatArray, instance
from ..errors import FlexplantError, LabelError, ModelError
from ..modes import Modes
from ..structure import FEMatrices, FEModel
from ..structure.units import units as unit_system
from . import ansys, exodus, op2, uff
from .file_shapes import FileShapes, ModesFormat, check_mass, scaled_modes
from .nastran import shapes_at
from .numbers import decimal
from .paths import damaged, ends, file_path, three_units, wrong_line_of

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


PUNCH = ModesFormat((".pch",), read_punch_shapes)

FORMATS: tuple[ModesFormat, ...] = (
    op2.OUTPUT2,
    PUNCH,
    ansys.RESULTS,
    exodus.EXODUS,
    uff.UNIVERSAL_MODES,
)


def read_modes(
    path: str | Path,
    *,
    zeta: float | FloatArray | None,
    nodes: str | Path | None = None,
    rigid_below: float | None = None,
    units: Sequence[str | float] | None = None,
    matrices: FEMatrices | FEModel | None = None,
) -> Modes:
    r"""Return the modes that a finite-element program computed, whichever wrote the file.

    For models that are too large to be solved here: shapes at all nodes become Modes, and these a
    plant or a reduced model. By suffix: Nastran .op2, and .pch of DISPLACEMENT(PUNCH); ANSYS .rst;
    Exodus .exo, .e (frequencies in Hz in the place of time); universal files .uff, .unv of normal
    modes.

    Residual attachment vectors are not in such files, and cannot be made without M and K: the
    static motion that the modes left out have is missing, which `notes` say. Nastran and ANSYS
    write residual vectors as further modes of high frequency (RESVEC), which bring most of it back.

    Parameters
    ----------
    path : str or Path
        The file.
    zeta : float, (k,) array or None
        Damping ratios, which only universal files hold: None takes those of the file. Rigid-body
        modes have none.
    nodes : str or Path, optional
        Where the nodes are, if not in the file: the bulk data of Nastran (.bdf, .dat), a universal
        file, or a table `node, x, y, z`.
    rigid_below : float [Hz], optional
        Modes below this are rigid-body modes, and set to exactly 0.
    units : (length, mass, time), optional
        Of the file: ("mm", "t", "s") for instance; the modes are in SI. None: as a universal file
        says (dataset 164), or SI.
    matrices : FEMatrices or FEModel, optional
        In SI, with the same nodes: the shapes are checked to be mass-normalised with its M.

    Returns
    -------
    Modes
        In global directions, with unit generalised masses where the file has them (LAMA, dataset
        55) and else as they are. `certificate["mass"]` is the largest entry of phi^T M phi - I
        where `matrices` are given.

    Raises
    ------
    FileNotFoundError
        When there is no such file, as with every reader.
    FlexplantError
        When the format is not known, holds no modes, or the file is damaged.
    ModelError
        When damping is not said, modes are near zero and `rigid_below` does not say what they are,
        several sets of modes are there, or the shapes are not mass-normalised with `matrices`.
    LabelError
        When a node has no place or its coordinate system is not there.

    Examples
    --------
    A file of one mode at one node, as Nastran punches it:

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> head = "$EIGENVECTOR\n$EIGENVALUE =  0.4000000E+05  MODE =     1\n"
    >>> row = "".join(f"{number:18.6E}" for number in (0.0, 0.0, 2.0))
    >>> text = f"{head}{7:10}       G{row}\n{'-CONT-':18}{3 * f'{0.0:18.6E}'}\n"
    >>> _ = (folder / "run.pch").write_text(text)
    >>> _ = (folder / "run.bdf").write_text("GRID,7,,0.1,0.2,0.\n")
    >>> modes = read_modes(folder / "run.pch", zeta=0.01, nodes=folder / "run.bdf")
    >>> modes.dofs.labels, modes.omega, modes.phi
    (('7:z',), array([200.]), array([[2.]]))
    """
    path = file_path(path)
    sizes = () if units is None else three_units(units)
    form = next((f for f in FORMATS if ends(path, f.suffixes)), None)
    if form is None:
        known = ", ".join(suffix for f in FORMATS for suffix in f.suffixes)
        raise FlexplantError(
            f"{path.name!r} is no file of modes that is read here; known are {known}. Nastran "
            "writes .op2 with DISPLACEMENT=ALL and PARAM,POST,-1, ANSYS .rst; of the others export "
            "a universal file, or matrices, which read_model reads."
        )
    shapes = form.read(path, None if nodes is None else file_path(nodes, "nodes"))
    system = shapes.units or unit_system() if units is None else unit_system(*sizes)
    modes = scaled_modes(shapes, zeta=zeta, rigid_below=rigid_below, system=system, path=str(path))
    if matrices is None:
        return modes
    instance(matrices, FEMatrices | FEModel, "matrices", "read_matrices(...) reads them.")
    return modes.replace(certificate={"mass": _with_mass(modes, matrices, str(path))})


def _with_mass(modes: Modes, matrices: FEMatrices | FEModel, path: str) -> float:
    """Return how far the shapes are from mass-normalised with the M of a model."""
    if matrices.M is None or matrices.dofs is None:
        raise ModelError(
            "matrices need M, and names of their rows, to check the shapes with. Give them: "
            "read_matrices(..., mass=, dofs=)."
        )
    row = {label: i for i, label in enumerate(modes.dofs.labels)}
    known = set(matrices.dofs.labels)
    lost = [label for label in row if label not in known]
    if lost:
        raise LabelError(
            f"the modes of {path!r} move {len(lost)} DOFs that the matrices do not have, the first "
            f"{lost[:4]}. Are both of one model, with the same supports?"
        )
    # a row that no mode moves was left out
    found = [row.get(label, -1) for label in matrices.dofs.labels]
    phi = np.vstack([np.real(modes.phi), np.zeros(modes.n_modes)])[found]
    return check_mass(phi, matrices.M, path)
