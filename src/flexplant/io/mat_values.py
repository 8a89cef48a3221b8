"""Systems, plants and frequency responses for MATLAB, and systems of its files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ..errors import LabelError, ModelError, require_known, short
from ..loop import ClosedLoop
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, System, as_statespace
from ..plant import AnyPlant, StandardPlant
from ..store import written
from .files import parsing
from .mat_matrices import mat_variables

#: largest number of characters of a variable's name in MATLAB (namelengthmax)
_LONGEST = 63


def write_mat(
    path: str | Path, value: System | AnyPlant | Frf | Mapping[str, System | AnyPlant | Frf]
) -> None:
    """Write a system, a plant or frequency responses, or several of them, for MATLAB.

    The variables of a system are `A, B, C, D, dt` (0 is continuous) and cell arrays of names
    `inputs`, `outputs`, `states`. A plant also has `w, u, z, y` and the densities `asd` of w, which
    are 0 for channels without a density. Responses have `freq` [Hz] and `data` (n_out, n_in,
    n_freq). Each of several values is a structure with these fields::

        S = load('design.mat');
        P = ss(S.plant.A, S.plant.B, S.plant.C, S.plant.D, S.plant.dt, ...
               'InputName', S.plant.inputs, 'OutputName', S.plant.outputs);
        G = frd(S.frf.data, 2*pi*S.frf.freq);

    Parameters
    ----------
    path : str or Path
        Path of the file, which is written completely or not at all. No ending is added.
    value : StateSpace, control.StateSpace, plant, Frf, or mapping of them
        Value to write; several values as {"plant": plant, "K": controller, "frf": frf}. A
        controller or an observer is written as its `.system`, a weighted plant with its weights.
        Ports and certificates are not written: `.save` keeps them.

    Raises
    ------
    LabelError
        When a name is not a valid name of a MATLAB variable.
    OSError
        When the file cannot be written.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "filters.mat")
    ...     slow, fast = fx.lti.low_pass_filter(10.0), fx.lti.low_pass_filter(100.0)
    ...     fx.io.write_mat(path, {"slow": slow, "fast": fast})
    ...     fx.io.read_mat(path, "fast")
    <StateSpace: 1 state, continuous, in -> out>
    """
    if isinstance(value, Mapping) and not isinstance(value, Frf):
        for name in value:
            _check_name(name)
        content = {str(name): _struct_fields(item) for name, item in value.items()}
    else:
        content = _struct_fields(value)
    file: Any  # the type stubs only allow names of files
    with written(path) as file:
        scipy.io.savemat(file, content, oned_as="column", long_field_names=True)


def read_mat(path: str | Path, name: str | None = None) -> StateSpace | StandardPlant:
    """Return the system or plant of a MATLAB file; `read_frf_mat` reads frequency responses.

    Parameters
    ----------
    path : str or Path
        A file with the variables of `write_mat`; `A, B, C, D` are enough.
    name : str, optional
        Name of the structure, in a file of several.

    Returns
    -------
    StateSpace or StandardPlant
        A plant when the file says which channels are w, u, z and y.

    Raises
    ------
    FlexplantError
        When it is not a MATLAB file (version 7.3 is HDF5: save with '-v7').
    ModelError, ShapeError, LabelError
        When matrices are missing, do not form a system, or the structure does not exist.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, scipy.io, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "from_matlab.mat")
    ...     scipy.io.savemat(path, {"A": [[-2.0]], "B": [[1.0]], "C": [[2.0]], "D": [[0.0]]})
    ...     fx.io.read_mat(path).poles()
    array([-2.+0.j])
    """
    content = mat_variables(path)
    named = {key: item for key, item in content.items() if isinstance(item, dict)}
    if name is not None:
        require_known("structure", [name], named, repr(str(path)))
        content = named[name]
    missing = [part for part in "ABCD" if part not in content]
    if missing:
        structures = f" Structures are read by name, {sorted(named)[:8]}." if named else ""
        raise ModelError(
            f"{str(path)!r} has no {', '.join(missing)}: it holds {sorted(content)[:8]}. A "
            "system object must be converted in MATLAB: [A, B, C, D, dt] = "
            f"ssdata(P).{structures}"
        )
    with parsing(str(path)):
        return _system_of(content)


def _check_name(name: Any) -> None:
    plain = isinstance(name, str) and name.isascii() and name.isidentifier()
    if not plain or not name[0].isalpha() or len(name) > _LONGEST:
        raise LabelError(
            f"{short(name)} is not a valid name of a MATLAB variable: letters, digits and "
            f"underscores, a letter first, at most {_LONGEST}. Choose such a name."
        )


def _struct_fields(value: Any) -> dict[str, Any]:
    """Return the variables of a system, a plant or responses."""
    if isinstance(value, Frf):
        named = {side: _cells(getattr(value, side)) for side in ("inputs", "outputs")}
        return {"freq": value.freq, "data": value.data, "quantity": value.quantity or "", **named}
    plant = value if isinstance(value, AnyPlant) else None
    within = getattr(value, "system", value)
    loop = isinstance(value, ClosedLoop) or not isinstance(within, StateSpace)
    g = as_statespace(value if loop else within)
    content: dict[str, Any] = {"A": g.A, "B": g.B, "C": g.C, "D": g.D, "dt": g.dt}
    content |= {side: _cells(getattr(g, side)) for side in ("inputs", "outputs", "states")}
    content["name"] = g.name or ""
    if plant is not None:
        content |= {side: _cells(getattr(plant, side)) for side in "wuzy"}
        content["asd"] = np.array([plant.asd.get(name, 0.0) for name in plant.w])
    return content


def _system_of(content: Mapping[str, Any]) -> StateSpace | StandardPlant:
    """Return the system of some variables, or the plant where they name w, u, z and y."""
    parts: dict[str, Any] = {name: content[name] for name in "ABCD"}
    parts |= {one: _names_in(content.get(one)) for one in ("inputs", "outputs", "states")}
    name = "".join(str(part) for part in np.ravel(content.get("name", "")))
    g = StateSpace(**parts, dt=float(np.squeeze(content.get("dt", 0.0))), name=name or None)
    if not all(side in content for side in "wuzy"):
        return g
    w, u, z, y = (_names_in(content[side]) for side in "wuzy")
    asd = dict(zip(w, np.ravel(content.get("asd", np.zeros(len(w)))).tolist(), strict=True))
    return StandardPlant(g, w, u, z, y, {name: value for name, value in asd.items() if value})


def _cells(names: Iterable[str]) -> Any:
    """Return names as a cell array (n, 1)."""
    listed = list(names)
    column = np.empty((len(listed), 1), dtype=object)
    column[:, 0] = listed
    return column


def _names_in(column: Any) -> tuple[str, ...]:
    """Return the names of a cell array; empty without one."""
    return () if column is None else tuple(str(np.squeeze(cell)) for cell in np.ravel(column))
