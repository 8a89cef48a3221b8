"""Systems and plants as fields of a MATLAB file: matrices and channel names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..lti.statespace import StateSpace, as_statespace
from ..plant import StandardPlant


def system_fields(system: Any) -> dict[str, Any]:
    """Return the fields of a system or a standard plant.

    Raises
    ------
    ModelError
        When it is neither.
    """
    plant = system if isinstance(system, StandardPlant) else None
    g = as_statespace(system.system if isinstance(system, StandardPlant) else system)
    content: dict[str, Any] = {"A": g.A, "B": g.B, "C": g.C, "D": g.D, "dt": g.dt}
    content |= {side: cells(getattr(g, side)) for side in ("inputs", "outputs", "states")}
    content["name"] = g.name or ""
    if g.blocks is not None:
        content["blocks"] = np.array(g.blocks, dtype=float)
    if plant is not None:
        content |= {side: cells(getattr(plant, side)) for side in "wuzy"}
        content["asd"] = np.array([plant.asd.get(name, 0.0) for name in plant.w])
    return content


def system_of(content: Mapping[str, Any]) -> StateSpace | StandardPlant:
    """Return the system of some fields, a plant when they say which channels are w, u, z and y.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When what they hold is no system.
    """
    blocks = content.get("blocks")
    g = StateSpace(
        content["A"],
        content["B"],
        content["C"],
        content["D"],
        float(np.squeeze(content.get("dt", 0.0))),
        inputs=names_in(content.get("inputs")),
        outputs=names_in(content.get("outputs")),
        states=names_in(content.get("states")),
        name=text_in(content.get("name", "")) or None,
        blocks=None if blocks is None else [int(size) for size in np.ravel(blocks)],
    )
    if not all(side in content for side in "wuzy"):
        return g
    w, u, z, y = (names_in(content[side]) for side in "wuzy")
    asd = dict(zip(w, np.ravel(content.get("asd", np.zeros(len(w)))).tolist(), strict=True))
    return StandardPlant(g, w, u, z, y, {name: value for name, value in asd.items() if value})


def cells(names: Iterable[str]) -> Any:
    """Return names as a cell array (n, 1)."""
    listed = list(names)
    column = np.empty((len(listed), 1), dtype=object)
    column[:, 0] = listed
    return column


def names_in(column: Any) -> tuple[str, ...]:
    """Return the names of a cell array, none where there is none."""
    if column is None:
        return ()
    return tuple(str(np.squeeze(cell)) for cell in np.ravel(column))


def text_in(item: Any) -> str:
    """Return a text of a MATLAB file, which is an array of one or none."""
    return "".join(str(part) for part in np.ravel(item))
