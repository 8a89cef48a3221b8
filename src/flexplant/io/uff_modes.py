"""Modes of a model in universal files: normal modes (dataset 55) and nodes (15, 2411)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..dof_columns import at_nodes
from ..errors import FlexplantError
from ..labels import DIRECTIONS, DofSet
from .shapes import FileShapes, ModesFormat
from .tables import read_nodes_table
from .uff import read_nodes_uff
from .uff_records import datasets, whole_entry

_NORMAL = 2


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
    parts = [p for p in datasets(path, (55,)) if whole_entry(p, "analysis_type") == _NORMAL]
    if not parts:
        raise FlexplantError(
            f"{str(path)!r} holds no normal modes (dataset 55, analysis type 2). Measured or "
            "complex ones are read by read_modes_uff, as MeasuredModes."
        )
    ids = np.asarray(parts[0]["node_nums"]).astype(np.int64)
    shapes = []
    for part in parts:
        rows = [part[f"r{i}"] for i in range(1, 7) if part.get(f"r{i}") is not None]
        same = np.array_equal(np.asarray(part["node_nums"]).astype(np.int64), ids)
        if not same or any(np.size(row) != ids.size for row in rows):
            raise FlexplantError(
                f"{str(path)!r}: modes are at different nodes, or numbers are cut off. Export all "
                "at the same nodes."
            )
        rows += [np.zeros(ids.size)] * (6 - len(rows))
        shapes.append(np.real(np.stack(rows, axis=1)).ravel())
    where = path if nodes is None else nodes
    if where.suffix.lower() in UNIVERSAL_MODES.suffixes:
        points = read_nodes_uff(where, directions=("x",))
        known, xyz = points.nodes, points.xyz
    else:
        known, xyz = read_nodes_table(where)
    dofs = DofSet(
        np.repeat(ids, 6),
        DIRECTIONS * ids.size,
        np.repeat(at_nodes(ids, np.asarray(known), xyz, str(where)), 6, axis=0),
    )

    def column(name: str) -> Any:
        return np.array([float(part.get(name) or 0.0) for part in parts])

    viscous, structural = column("modal_damp_vis"), column("modal_damp_his")
    zeta = np.where(viscous != 0, viscous, structural / 2)
    masses = column("modal_m")
    return FileShapes(
        2 * np.pi * column("freq"),
        np.array(shapes).T,
        dofs,
        masses=masses if np.any(masses) else None,
        zeta=zeta if np.any(zeta) else None,
    )


UNIVERSAL_MODES = ModesFormat((".uff", ".unv", ".uf"), read_uff_shapes)
