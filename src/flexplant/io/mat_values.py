"""MATLAB files of systems, plants, reduced models and frequency responses, one or several."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import scipy.io

from ..errors import LabelError, ModelError, require_known
from ..loop import ClosedLoop
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, System
from ..plant import StandardPlant
from ..reduction import ReducedModel
from ..store import written
from ..values import short
from .mat_models import frf_fields, frf_of, reduced_fields, reduced_of, system_fields, system_of
from .mat_variables import mat_variables
from .paths import parsing

#: what a file holds one or several of
MatValue: TypeAlias = StateSpace | StandardPlant | ReducedModel | Frf
_LONGEST = 63


def write_mat(
    path: str | Path,
    value: System | StandardPlant | ReducedModel | Frf | Mapping[str, Any],
) -> None:
    """Write a system, a plant, a reduced model or frequency responses, or several, for MATLAB.

    Of a system the variables are `A, B, C, D, dt` (0 is continuous) and cell arrays of names
    `inputs`, `outputs`, `states`; of a plant also `w, u, z, y` and the densities `asd` of w (0
    where there is none); of a reduced model `M, D, K, T`, `rigid_body`, and `dofs` with nodes,
    directions and coordinates; of responses `freq` [Hz] and `data` (n_out, n_in, n_freq). Of
    several values each is a structure of these, by its name::

        S = load('design.mat');
        P = ss(S.plant.A, S.plant.B, S.plant.C, S.plant.D, S.plant.dt, ...
               'InputName', S.plant.inputs, 'OutputName', S.plant.outputs);
        G = frd(S.frf.data, 2*pi*S.frf.freq);

    Parameters
    ----------
    path : str or Path
        The file, written atomically; no ending is added.
    value : StateSpace, control.StateSpace, StandardPlant, ReducedModel, Frf, or mapping of them
        What to write; several as {"plant": plant, "K": controller, "frf": frf}. What has a
        `.system`, a controller or an observer, is written as that. Ports and certificates, and of
        a reduced model its bound and truncated modes, stay behind: `.save` keeps them.

    Raises
    ------
    ModelError
        When it is none of these.
    LabelError
        When a name is no name of a MATLAB variable.
    OSError
        When the file cannot be written.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "filters.mat")
    ...     fx.io.write_mat(path, {"slow": fx.lowpass(10.0), "fast": fx.lowpass(100.0)})
    ...     fx.io.read_mat(path, "fast")
    <StateSpace: 1 state, continuous, in -> out>
    """
    if isinstance(value, Mapping) and not isinstance(value, Frf):
        for name in value:
            _check_name(name)
        content = {str(name): _fields(item) for name, item in value.items()}
    else:
        content = _fields(value)
    file: Any  # the type stubs take names of files only
    with written(path) as file:
        scipy.io.savemat(file, content, oned_as="column", long_field_names=True)


def read_mat(path: str | Path, name: str | None = None) -> MatValue:
    """Return the system, plant, reduced model or frequency responses of a MATLAB file.

    Parameters
    ----------
    path : str or Path
        A file with the variables of `write_mat`; `A, B, C, D` are enough, or `freq, data`.
    name : str, optional
        Which one, in a file of several.

    Returns
    -------
    StateSpace, StandardPlant, ReducedModel or Frf
        A plant when the file says which channels are w, u, z and y.

    Raises
    ------
    FlexplantError
        When it is no MATLAB file (version 7.3 is HDF5: save with '-v7').
    ModelError, ShapeError, LabelError
        When matrices are missing, what they hold is no system, or which of several is not said.
    FileNotFoundError
        When there is no such file.

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
        return _value(named[name], f"{name!r} of {str(path)!r}")
    if not _kind(content) and len(named) == 1:
        return _value(next(iter(named.values())), repr(str(path)))
    if not _kind(content) and named:
        raise LabelError(
            f"{str(path)!r} holds several values, {sorted(named)[:8]}. Say which: read_mat(path, "
            f"{min(named)!r}), or read all: read_mat_values(path)."
        )
    return _value(content, repr(str(path)))


def read_mat_values(path: str | Path) -> dict[str, MatValue]:
    """Return all systems, plants, reduced models and responses that a MATLAB file names.

    Parameters
    ----------
    path : str or Path
        A file of structures, as `write_mat` writes several values.

    Returns
    -------
    dict {name: value}
        Structures that are none of these are left out.

    Raises
    ------
    FlexplantError
        When it is no MATLAB file (version 7.3 is HDF5: save with '-v7').
    ModelError, ShapeError, LabelError
        When there is no such structure, or what one holds does not belong together.
    FileNotFoundError
        When there is no such file.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "filters.mat")
    ...     fx.io.write_mat(path, {"slow": fx.lowpass(10.0), "fast": fx.lowpass(100.0)})
    ...     list(fx.io.read_mat_values(path))
    ['slow', 'fast']
    """
    content = mat_variables(path)
    found = {key: item for key, item in content.items() if isinstance(item, dict) and _kind(item)}
    if not found:
        raise ModelError(
            f"{str(path)!r} holds no structures of values, but {sorted(content)[:8]}. One value in "
            "plain variables is read by read_mat(path)."
        )
    return {key: _value(item, f"{key!r} of {str(path)!r}") for key, item in found.items()}


def _check_name(name: Any) -> None:
    plain = isinstance(name, str) and name.isascii() and name.isidentifier()
    if not plain or not name[0].isalpha() or len(name) > _LONGEST:
        raise LabelError(
            f"{short(name)} is no name of a MATLAB variable: letters, digits and underscores, a "
            f"letter first, at most {_LONGEST}. Name it so."
        )


def _fields(value: Any) -> dict[str, Any]:
    if isinstance(value, ReducedModel):
        return reduced_fields(value)
    if isinstance(value, Frf):
        return frf_fields(value)
    within = getattr(value, "system", value)
    plain = isinstance(value, StandardPlant | ClosedLoop) or not isinstance(within, StateSpace)
    return system_fields(value if plain else within)


def _kind(content: Mapping[str, Any]) -> str:
    """Return what some fields are: "system", "reduced", "frf" or "" for nothing of the kind."""
    kinds = {"system": "ABCD", "reduced": ("M", "D", "K", "T", "dofs"), "frf": ("freq", "data")}
    return next((kind for kind, names in kinds.items() if set(names) <= set(content)), "")


def _value(content: Mapping[str, Any], where: str) -> MatValue:
    kind = _kind(content)
    if not kind:
        missing = [name for name in "ABCD" if name not in content]
        raise ModelError(
            f"{where} has no {', '.join(missing)}: it holds {sorted(content)[:8]}. A system "
            "object must be taken apart in MATLAB: [A, B, C, D, dt] = ssdata(P)."
        )
    makers: dict[str, Any] = {"system": system_of, "reduced": reduced_of, "frf": frf_of}
    with parsing(where):
        value: MatValue = makers[kind](content)
    return value
