"""ANSYS Mechanical: matrices of .full files, modes of .rst files, coordinates of both and .cdb."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray
from ..dof_columns import at_nodes
from ..errors import FlexplantError, counted
from ..labels import DIRECTIONS, DofSet, node_dofs
from ..structure import FEMatrices
from ..tolerances import SAME
from .fe_modes import MODE_READERS, FileShapes
from .files import ELSEWHERE, FORMATS, Elsewhere, Format, file_path, is_text, no_motion, unread
from .foreign_parsers import in_child
from .tables import read_nodes_table
from .triplets import assembled, missing_extra

#: a local coordinate system that is turned by less than this [deg] counts as the global one
_STRAIGHT = SAME


def read_ansys(
    path: str | Path,
    *,
    nodes: str | Path | Mapping[int, Any] | None = None,
    rotations: Mapping[int, Any] | None = None,
) -> FEMatrices:
    """Return the matrices of an ANSYS .full file, their rows named by node and direction.

    The file holds the upper triangle of each matrix, which is completed. It holds constrained DOFs
    as empty rows, which are dropped and named in `constrained`. The coordinates of the nodes and
    their local coordinate systems (NROTAT) are not in this file, but in the .rst or .cdb file of
    the same model.

    A lumped mass (LUMPM,ON), unsymmetric matrices, DOFs that are not a displacement or rotation,
    and a file without M are refused. A damping matrix in the file is not read, as `notes` state;
    give modal damping instead. The angles of local systems are THXY, THYZ and THZX of ANSYS, which
    turn about z, then about the new x, then about the new y.

    Parameters
    ----------
    path : str or Path
        The .full file. Needs ansys-mapdl-reader: ``pip install 'flexplant[ansys]'``.
    nodes : path, or mapping {node: (x, y, z)}, optional
        A .rst or .cdb file, or a text table `node, x, y, z`. Nodes with a local coordinate system
        in the .rst or .cdb file are turned to global directions. Without `nodes` the result has no
        coordinates (it is not `located`), which is sufficient for held structures.
    rotations : mapping {node: (3, 3) array}, optional
        Direction cosines of local coordinate systems that `nodes` does not give. Row i holds the
        global components of the local axis i.

    Returns
    -------
    FEMatrices
        Matrices in the units of the model; `.converted("mm", "t")` turns them to SI.

    Raises
    ------
    FlexplantError
        When the package is missing, or the file is not a .full file.
    ModelError
        When a matrix is missing or lumped, DOFs are not displacements, or a partly held node has a
        local coordinate system.
    LabelError
        When a node has no coordinates.
    """
    path = file_path(path)
    full = read_parsed("ansys_full", path)
    if "class" in full:
        raise FlexplantError(
            f"{path.name!r} is an ANSYS {full['class']}, not a .full file: it holds no matrices of "
            "the whole structure. It may serve as nodes=..."
        )
    table, K, M = full["table"], full["K"], full["M"]
    if K is None or M is None:
        do = "Write it with a modal analysis: ANTYPE,MODAL; MODOPT,LANB; WRFULL."
        raise unread(path.name, f"holds no {'stiffness' if K is None else 'mass'} matrix", do)
    kinds = np.asarray(table[:, 1], dtype=np.int64)
    strange = sorted(set(kinds.tolist()) - set(range(6)))
    if strange:
        raise no_motion(path.name, f"ANSYS numbers {strange} from 0")
    notes = []
    if full["damped"]:
        notes.append("the damping matrix in the file is not read: give damping by mode")
    numbers = np.asarray(table[:, 0], dtype=np.int64)
    order = np.lexsort((kinds, numbers))
    numbers, kinds = numbers[order], kinds[order]
    xyz, angles = np.zeros((numbers.size, 3)), dict(rotations or {})
    if nodes is not None:
        xyz, found = _coordinates(nodes, numbers)
        angles = found | angles
    dofs = DofSet(numbers, tuple(DIRECTIONS[kind] for kind in kinds.tolist()), xyz)
    result = assembled(
        {"K": K[order][:, order], "M": M[order][:, order]},
        dofs=dofs,
        source=path.name,
        located=nodes is not None,
        notes=notes,
    )
    left = set() if result.dofs is None else set(result.dofs.nodes.tolist())
    turned = {node: cosines for node, cosines in angles.items() if node in left}
    if turned:
        note = f"{counted(len(turned), 'local coordinate system')} turned to global directions"
        result = result.rotated(turned).replace(notes=(*result.notes, note))
    return result


def cosines_of(angles: Any) -> FloatArray:
    """Return the direction cosines (3, 3) of ANSYS nodal angles THXY, THYZ, THZX [deg]."""
    # the axes are turned about z, then about the new x, then about the new y; row i holds the
    # global components of local axis i
    (sz, sx, sy), (cz, cx, cy) = np.sin(np.deg2rad(angles)), np.cos(np.deg2rad(angles))
    about_z = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    return np.asarray(about_y @ about_x @ about_z, dtype=np.float64)


def read_parsed(function: str, path: Path) -> dict[str, Any]:
    """Return what a function of `foreign_parsers` finds in an ANSYS file."""
    kind, found = in_child(function, path, keep="ansys")
    if kind in ("ImportError", "ModuleNotFoundError"):
        raise missing_extra("ansys-mapdl-reader", "ansys", f"reading {path.name!r}")
    if kind == "NotImplementedError":
        do = "Write a symmetric pair: LUMPM,OFF; no contact with friction, no rotating frame."
        raise unread(path.name, f"is not supported: {found}", do)
    if kind != "value":
        raise FlexplantError(
            f"{path.name!r} cannot be read as an ANSYS {path.suffix} file ({kind}: {found!s:.99}). "
            "It is damaged, cut off or another format: write it again."
        )
    content: dict[str, Any] = found
    if "part" in content:
        part = content["part"]
        share = f"{part['nodes']} of {part['of']} nodes" if part["of"] else "some of the nodes"
        what = f"is a part of a distributed run, with {share}"
        do = "Run on shared memory (-smp), or write one file for the whole: COMBINE in /AUX2."
        raise unread(path.name, what, do)
    return content


def _coordinates(nodes: Any, wanted: IntArray) -> tuple[FloatArray, dict[int, FloatArray]]:
    """Return coordinates (n, 3) of the wanted nodes, and cosines of those with local systems."""
    if isinstance(nodes, Mapping):
        known = np.array(list(nodes), dtype=np.int64)
        xyz = np.array([np.asarray(place, dtype=np.float64) for place in nodes.values()])
        return at_nodes(wanted, known, xyz.reshape(-1, 3), "nodes"), {}
    path = file_path(nodes, "nodes")
    if path.suffix.lower() not in (".rst", ".cdb"):
        known, xyz = read_nodes_table(path)
        return at_nodes(wanted, known, xyz, str(path)), {}
    mesh = read_parsed("ansys_mesh", path)
    known = np.asarray(mesh["nodes"], dtype=np.int64)
    places = np.asarray(mesh["xyz"], dtype=np.float64)[:, :3]
    angles = np.asarray(mesh["angles"], dtype=np.float64)
    turned: dict[int, FloatArray] = {}
    if angles.ndim == 2 and angles.shape[1] == 3:
        for row in np.flatnonzero(np.abs(angles).max(axis=1) > _STRAIGHT).tolist():
            turned[int(known[row])] = cosines_of(angles[row])
    return at_nodes(wanted, known, places, str(path)), turned


FORMATS.append(Format((".full",), read_ansys, mesh=(".rst", ".cdb"), mesh_option="nodes"))
ELSEWHERE += [
    Elsewhere((".rst",), "text (reStructuredText?), no results of ANSYS", is_text),
    Elsewhere(
        (".emat", ".esav", ".mode", ".db", ".dbb"),
        "single elements, or data of ANSYS' own. Matrices: a modal analysis with WRFULL,1 writes "
        "the assembled ones as .full, read_ansys",
    ),
]


_KINDS = dict(zip(("UX", "UY", "UZ", "ROTX", "ROTY", "ROTZ"), DIRECTIONS, strict=True))
#: value in the header for a modal analysis
_MODAL = 2


def read_rst_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an ANSYS result file, turned to global directions by its reader."""
    found = read_parsed("ansys_modes", path)
    if found["analysis"] != _MODAL or found["cyclic"]:
        what = "a cyclic sector" if found["cyclic"] else "another analysis"
        do = "Write it with ANTYPE,MODAL of the whole model."
        raise unread(path.name, f"is of {what}, and its steps are not modes of a structure", do)
    strange = [name for name in found["kinds"] if name not in _KINDS]
    if strange or not found["kinds"]:
        raise no_motion(path.name, strange)
    directions = tuple(_KINDS[name] for name in found["kinds"])
    ids = np.asarray(found["ids"], dtype=np.int64)
    values = np.asarray(found["shapes"], dtype=np.float64)  # (k, nodes, DOFs)
    known = np.asarray(found["nodes"], dtype=np.int64)
    places = np.asarray(found["xyz"], dtype=np.float64)[:, :3]
    dofs = node_dofs(ids, directions, at_nodes(ids, known, places, str(path)))
    phi = values.reshape(len(values), -1).T
    omega = 2 * np.pi * np.asarray(found["freq"], dtype=np.float64)
    note = "ANSYS normalises to unit mass unless MODOPT's Nrmkey is ON"
    return FileShapes(omega, phi, dofs, notes=(note,))


MODE_READERS[".rst"] = read_rst_shapes
