"""Modes of a model in universal files: normal modes (2414, 55) and nodes (15, 2411)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..dof_columns import at_nodes
from ..errors import FlexplantError
from ..labels import DIRECTIONS, DofSet
from ..structure.units import Units
from .file_shapes import FileShapes, ModesFormat
from .tables import read_nodes_table
from .uff import raw_nodes
from .uff_analysis import NORMAL_MODE, mode_records


def read_uff_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the normal modes of a universal file.

    Parameters
    ----------
    path : Path
        A .uff, .unv or .uf file. Needs pyuff.
    nodes : Path, optional
        Another universal file, or a table `node, x, y, z`, for the nodes.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged, or holds no normal modes.
    LabelError
        When a node has no place.
    """
    parts = [p for p in mode_records(path, measured=False) if p.analysis == NORMAL_MODE]
    if not parts:
        raise FlexplantError(
            f"{str(path)!r} holds no normal modes: displacements at nodes in dataset 2414, or 55, "
            "of analysis type 2. Measured or complex ones are read by read_modes_uff, as "
            "MeasuredModes."
        )
    ids = parts[0].nodes
    where = path if nodes is None else nodes
    if where.suffix.lower() in UNIVERSAL_MODES.suffixes:
        known, xyz, factors = raw_nodes(where)
    else:
        (known, xyz), factors = read_nodes_table(where), (1.0, 1.0)
    dofs = DofSet(
        np.repeat(ids, 6),
        DIRECTIONS * ids.size,
        np.repeat(at_nodes(ids, np.asarray(known), xyz, str(where)), 6, axis=0),
    )
    zeta, masses = np.array([part.zeta for part in parts]), np.array([part.mass for part in parts])
    length, force = factors
    return FileShapes(
        2 * np.pi * np.array([part.freq for part in parts]),
        np.array([np.real(part.motions).ravel() for part in parts]).T,
        dofs,
        masses=masses if np.any(masses) else None,
        zeta=zeta if np.any(zeta) else None,
        # numbers over factors are in SI, and mass is force over acceleration
        units=None if factors == (1.0, 1.0) else Units(1 / length, length / force, 1.0),
    )


UNIVERSAL_MODES = ModesFormat((".uff", ".unv", ".uf"), read_uff_shapes)
