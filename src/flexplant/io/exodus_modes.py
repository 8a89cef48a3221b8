"""Modes of Exodus files for `read_modes`, with the usual names and frequencies in Hz."""

from __future__ import annotations

from pathlib import Path

from ..errors import ModelError
from .exodus import read_shapes
from .file_shapes import FileShapes, ModesFormat


def read_exodus_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an Exodus file.

    Parameters
    ----------
    path : Path
        The file.
    nodes : Path, optional
        Must not be given: the file holds its nodes.

    Raises
    ------
    FlexplantError
        When it is no Exodus file, cut off, or without shapes.
    ModelError
        When `nodes` is given.
    """
    if nodes is not None:
        raise ModelError(f"{str(path)!r} holds its nodes: leave nodes= out.")
    omega, phi, dofs = read_shapes(path)
    return FileShapes(omega, phi, dofs)


EXODUS = ModesFormat((".exo", ".e"), read_exodus_shapes)
