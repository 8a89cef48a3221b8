"""Modes in ANSYS .rst files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..dof_columns import at_nodes
from ..labels import DIRECTIONS, DofSet
from .ansys import read_parsed
from .file_shapes import FileShapes, ModesFormat
from .paths import no_motion, unread

_KINDS = dict(zip(("UX", "UY", "UZ", "ROTX", "ROTY", "ROTZ"), DIRECTIONS, strict=True))
#: of the header: a modal analysis
_MODAL = 2


def read_rst_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an ANSYS result file, turned to global directions by its reader.

    Parameters
    ----------
    path : Path
        The .rst file of a modal analysis. Needs ansys-mapdl-reader.
    nodes : Path, optional
        Not needed: the file holds its nodes.

    Raises
    ------
    FlexplantError
        When the package is missing, or the file is damaged.
    ModelError
        When it is of another analysis or a cyclic sector, or DOFs are no displacements.
    """
    found = read_parsed("ansys_modes", path)
    if found["analysis"] != _MODAL or found["cyclic"]:
        what = "a cyclic sector" if found["cyclic"] else "another analysis"
        do = "Write it with ANTYPE,MODAL of the whole model."
        raise unread(path.name, f"is of {what}: its steps are no modes of a structure", do)
    strange = [name for name in found["kinds"] if name not in _KINDS]
    if strange or not found["kinds"]:
        raise no_motion(path.name, strange)
    directions = tuple(_KINDS[name] for name in found["kinds"])
    ids = np.asarray(found["ids"], dtype=np.int64)
    values = np.asarray(found["shapes"], dtype=np.float64)  # (k, nodes, DOFs)
    known = np.asarray(found["nodes"], dtype=np.int64)
    places = np.asarray(found["xyz"], dtype=np.float64)[:, :3]
    xyz = at_nodes(ids, known, places, str(path))
    m = len(directions)
    dofs = DofSet(np.repeat(ids, m), directions * ids.size, np.repeat(xyz, m, axis=0))
    phi = values.reshape(len(values), -1).T
    omega = 2 * np.pi * np.asarray(found["freq"], dtype=np.float64)
    note = "ANSYS normalises to unit mass unless MODOPT's Nrmkey is ON"
    return FileShapes(omega, phi, dofs, notes=(note,))


RESULTS = ModesFormat((".rst",), read_rst_shapes)
