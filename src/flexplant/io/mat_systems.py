"""MATLAB files of systems and plants: matrices and channel names."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from ..errors import ModelError
from ..lti.statespace import StateSpace, System, as_statespace
from ..plant import StandardPlant
from ..store import written
from .mat_variables import mat_variables


def write_mat(path: str | Path, system: System | StandardPlant) -> None:
    """Write a system or a standard plant as a MATLAB file.

    Variables `A, B, C, D, dt` (0 is continuous) and cell arrays of names `inputs`, `outputs`,
    `states`; for a plant also `w, u, z, y` and the densities `asd` of w (0 where there is none)::

        S = load('plant.mat');
        P = ss(S.A, S.B, S.C, S.D, S.dt, 'InputName', S.inputs, 'OutputName', S.outputs);

    Parameters
    ----------
    path : str or Path
        The file, written atomically; no ending is added.
    system : StateSpace, control.StateSpace or StandardPlant
        What to write. Ports and the structure of a plant stay behind: `.save` keeps them.

    Raises
    ------
    ModelError
        When it is none of these.
    OSError
        When the file cannot be written.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "filter.mat")
    ...     fx.io.write_mat(path, fx.lowpass(100.0))
    ...     fx.io.read_mat(path)
    <StateSpace: 1 states, continuous, in -> out>
    """
    plant = system if isinstance(system, StandardPlant) else None
    g = as_statespace(system.system if isinstance(system, StandardPlant) else system)
    content: dict[str, Any] = {"A": g.A, "B": g.B, "C": g.C, "D": g.D, "dt": g.dt}
    content |= {side: _cells(getattr(g, side)) for side in ("inputs", "outputs", "states")}
    content["name"] = g.name or ""
    if g.blocks is not None:
        content["blocks"] = np.array(g.blocks, dtype=float)
    if plant is not None:
        content |= {side: _cells(getattr(plant, side)) for side in "wuzy"}
        content["asd"] = np.array([plant.asd.get(name, 0.0) for name in plant.w])
    file: Any  # the type stubs take names of files only
    with written(path) as file:
        scipy.io.savemat(file, content, oned_as="column")


def read_mat(path: str | Path) -> StateSpace | StandardPlant:
    """Return the system of a MATLAB file.

    Parameters
    ----------
    path : str or Path
        A file with the variables of `write_mat`; `A, B, C, D` are enough.

    Returns
    -------
    StateSpace or StandardPlant
        A plant when the file says which channels are w, u, z and y.

    Raises
    ------
    FlexplantError
        When it is no MATLAB file (version 7.3 is HDF5: save with '-v7').
    ModelError, ShapeError, LabelError
        When matrices are missing, or what they hold is no system.
    FileNotFoundError
        When there is no such file.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "plant.mat")
    ...     fx.io.write_mat(path, fx.testbeds.three_masses())
    ...     fx.io.read_mat(path).y
    ('y1', 'y2', 'die:ref')
    """
    content = mat_variables(path)
    missing = [name for name in "ABCD" if name not in content]
    if missing:
        raise ModelError(
            f"{str(path)!r} has no {', '.join(missing)}: it holds {sorted(content)[:8]}. A system "
            "object must be taken apart in MATLAB: [A, B, C, D, dt] = ssdata(P)."
        )
    blocks = content.get("blocks")
    g = StateSpace(
        content["A"],
        content["B"],
        content["C"],
        content["D"],
        float(np.squeeze(content.get("dt", 0.0))),
        inputs=_names(content.get("inputs")),
        outputs=_names(content.get("outputs")),
        states=_names(content.get("states")),
        name="".join(str(part) for part in np.ravel(content.get("name", ""))) or None,
        blocks=None if blocks is None else [int(size) for size in np.ravel(blocks)],
    )
    if not all(side in content for side in "wuzy"):
        return g
    w, u, z, y = (_names(content[side]) for side in "wuzy")
    asd = dict(zip(w, np.ravel(content.get("asd", np.zeros(len(w)))).tolist(), strict=True))
    return StandardPlant(g, w, u, z, y, {name: value for name, value in asd.items() if value})


def _cells(names: Iterable[str]) -> Any:
    listed = list(names)
    cells = np.empty((len(listed), 1), dtype=object)
    cells[:, 0] = listed
    return cells


def _names(cells: Any) -> tuple[str, ...]:
    if cells is None:
        return ()
    return tuple(str(np.squeeze(cell)) for cell in np.ravel(cells))
