"""MATLAB files of systems, plants, reduced models and frequency responses, one or several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy

from ..errors import LabelError, ModelError, require_known, short
from ..labels import DofSet
from ..loop import ClosedLoop
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, System, as_statespace
from ..plant import AnyPlant, StandardPlant
from ..reduction import ReducedModel
from ..store import written
from .files import parsing
from .mat_matrices import mat_variables

#: what a file holds one or several of
MatValue: TypeAlias = StateSpace | StandardPlant | ReducedModel | Frf
_LONGEST = 63  # characters of a name in MATLAB


def write_mat(
    path: str | Path, value: System | AnyPlant | ReducedModel | Frf | Mapping[str, Any]
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
    value : StateSpace, control.StateSpace, plant, ReducedModel, Frf, or mapping of them
        What to write; several as {"plant": plant, "K": controller, "frf": frf}. A weighted plant is
        written with its weights, and read as a StandardPlant. What has a
        `.system`, a controller or an observer, is written as that. Ports and certificates, and of
        a reduced model its bound and truncated modes, stay behind: `.save` keeps them.

    Raises
    ------
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
        return _mat_value(named[name], f"{name} of {path}")
    if not _value_kind(content) and len(named) == 1:
        return _mat_value(next(iter(named.values())), str(path))
    if not _value_kind(content) and named:
        raise LabelError(
            f"{str(path)!r} holds several values, {sorted(named)[:8]}. Say which: "
            "io.read_mat(path, "
            f"{min(named)!r}), or read all: io.read_mat_values(path)."
        )
    return _mat_value(content, str(path))


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
    FlexplantError, ModelError, ShapeError, LabelError
        As for `read_mat`; ModelError when there is no such structure.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "filters.mat")
    ...     slow, fast = fx.lti.low_pass_filter(10.0), fx.lti.low_pass_filter(100.0)
    ...     fx.io.write_mat(path, {"slow": slow, "fast": fast})
    ...     list(fx.io.read_mat_values(path))
    ['slow', 'fast']
    """
    content = mat_variables(path)
    found = {
        key: item for key, item in content.items() if isinstance(item, dict) and _value_kind(item)
    }
    if not found:
        raise ModelError(
            f"{str(path)!r} holds no structures of values, but {sorted(content)[:8]}. One value in "
            "plain variables is read by io.read_mat(path)."
        )
    return {key: _mat_value(item, f"{key} of {path}") for key, item in found.items()}


def _check_name(name: Any) -> None:
    plain = isinstance(name, str) and name.isascii() and name.isidentifier()
    if not plain or not name[0].isalpha() or len(name) > _LONGEST:
        raise LabelError(
            f"{short(name)} is no name of a MATLAB variable: letters, digits and underscores, a "
            f"letter first, at most {_LONGEST}. Name it so."
        )


def _struct_fields(value: Any) -> dict[str, Any]:
    if isinstance(value, ReducedModel):
        return reduced_fields(value)
    if isinstance(value, Frf):
        return frf_fields(value)
    within = getattr(value, "system", value)
    plain = isinstance(value, AnyPlant | ClosedLoop) or not isinstance(within, StateSpace)
    return system_fields(value if plain else within)


def _value_kind(content: Mapping[str, Any]) -> str:
    """Return what some fields are: "system", "reduced", "frf" or "" for nothing of the kind."""
    kinds = {"system": "ABCD", "reduced": ("M", "D", "K", "T", "dofs"), "frf": ("freq", "data")}
    return next((kind for kind, names in kinds.items() if set(names) <= set(content)), "")


def _mat_value(content: Mapping[str, Any], where: str) -> MatValue:
    makers: dict[str, Any] = {"system": system_of, "reduced": reduced_of, "frf": frf_of}
    make = makers.get(_value_kind(content))
    if make is None:
        missing = [name for name in "ABCD" if name not in content]
        raise ModelError(
            f"{where!r} has no {', '.join(missing)}: it holds {sorted(content)[:8]}. A system "
            "object must be taken apart in MATLAB: [A, B, C, D, dt] = ssdata(P)."
        )
    with parsing(where):
        value: MatValue = make(content)
    return value


def system_fields(system: Any) -> dict[str, Any]:
    """Return the fields of a system or a plant."""
    plant = system if isinstance(system, AnyPlant) else None
    g = as_statespace(system if plant is None else plant.system)
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
    """Return the system of some fields, a plant when they say which channels are w, u, z and y."""
    blocks = content.get("blocks")
    parts: dict[str, Any] = {name: content[name] for name in "ABCD"}
    parts |= {one: names_in(content.get(one)) for one in ("inputs", "outputs", "states")}
    g = StateSpace(
        **parts,
        dt=float(np.squeeze(content.get("dt", 0.0))),
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


_NUMBERS = ("coherence", "variance", "resolution", "overlap", "freedom")


def reduced_fields(model: ReducedModel) -> dict[str, Any]:
    """Return M, D, K, T, the rigid-body motions, and the DOFs with their coordinates."""
    plain = (*"MDKT", "rigid_body", "method", "condition", "condition_of")
    content: dict[str, Any] = {name: getattr(model, name) for name in plain}
    content |= {name: cells(getattr(model, name)) for name in ("coordinates", "static_at")}
    content["n_vectors"] = float(model.n_vectors)
    content |= {"dofs": _dof_fields(model.dofs), "full_dofs": _dof_fields(model.full_dofs)}
    if model.joint_motions is not None:
        content["joint_motions"] = model.joint_motions
    return content


def reduced_of(content: Mapping[str, Any]) -> ReducedModel:
    """Return the reduced model of some fields."""
    n = content["M"].shape[0]
    motions = content.get("joint_motions")
    names: Any = {name: names_in(content.get(name)) for name in ("coordinates", "static_at")}
    return ReducedModel(
        **{name: content[name] for name in "MDKT"},
        dofs=_dofs_of(content["dofs"]),
        full_dofs=_dofs_of(content["full_dofs"]),
        rigid_body=np.asarray(content["rigid_body"]).reshape(n, -1),
        method=text_in(content.get("method", "")),
        condition=float(np.squeeze(content.get("condition", 1.0))),
        **names,
        condition_of=text_in(content.get("condition_of", "phi_kk")),
        n_vectors=int(np.squeeze(content.get("n_vectors", 0))),
        joint_motions=None if motions is None else np.asarray(motions).reshape(n, -1),
    )


def frf_fields(frf: Frf) -> dict[str, Any]:
    """Return frequencies, responses (n_out, n_in, n_freq), names and what is known of the noise."""
    content: dict[str, Any] = {"freq": frf.freq, "data": frf.data, "quantity": frf.quantity or ""}
    content |= {"inputs": cells(frf.inputs), "outputs": cells(frf.outputs)}
    known = {name: getattr(frf, name) for name in _NUMBERS}
    return content | {name: value for name, value in known.items() if value is not None}


def frf_of(content: Mapping[str, Any]) -> Frf:
    """Return the frequency responses of some fields."""
    freq = np.ravel(content["freq"])
    inputs, outputs = names_in(content.get("inputs")), names_in(content.get("outputs"))
    # MATLAB drops a last axis of one frequency
    shape = (len(outputs), len(inputs), freq.size)
    data = np.asarray(content["data"])
    options: dict[str, Any] = {}
    for name in _NUMBERS:
        if name in content:
            value, each = np.asarray(content[name]), name in ("coherence", "variance")
            options[name] = value.reshape(shape) if each else float(np.squeeze(value))
    return Frf(
        freq,
        data.reshape(shape) if inputs and data.size == np.prod(shape) else data,
        inputs=inputs,
        outputs=outputs,
        quantity=text_in(content.get("quantity", "")) or None,
        **options,
    )


def _dof_fields(dofs: DofSet) -> dict[str, Any]:
    content: dict[str, Any] = {"nodes": dofs.nodes.astype(float), "xyz": dofs.xyz}
    content |= {"directions": cells(dofs.directions), "labels": cells(dofs.labels)}
    if dofs.component_of is not None:
        content["components"] = cells(dofs.components)
        content["component_of"] = np.asarray(dofs.component_of, dtype=float)
    return content


def _dofs_of(content: Mapping[str, Any]) -> DofSet:
    part = content.get("component_of")
    return DofSet(
        np.ravel(content["nodes"]).astype(np.int64),
        names_in(content["directions"]),
        np.asarray(content["xyz"]).reshape(-1, 3),
        components=names_in(content.get("components")),
        component_of=None if part is None else np.ravel(part).astype(np.int64),
    )
