"""Systems, plants, reduced models and frequency responses as fields of a MATLAB file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..labels import DofSet
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, as_statespace
from ..plant import StandardPlant
from ..reduction import ReducedModel


def system_fields(system: Any) -> dict[str, Any]:
    """Return the fields of a system or a standard plant."""
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
    """Return the system of some fields, a plant when they say which channels are w, u, z and y."""
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


_NUMBERS = ("coherence", "variance", "resolution", "overlap", "freedom")


def reduced_fields(model: ReducedModel) -> dict[str, Any]:
    """Return M, D, K, T, the rigid-body motions, and the DOFs with their coordinates."""
    content: dict[str, Any] = {name: getattr(model, name) for name in "MDKT"}
    content["rigid_body"] = model.rigid_body
    content["coordinates"] = cells(model.coordinates)
    content["static_at"] = cells(model.static_at)
    content |= {"method": model.method, "condition": model.condition}
    content |= {"condition_of": model.condition_of, "n_vectors": float(model.n_vectors)}
    content |= {"dofs": _dof_fields(model.dofs), "full_dofs": _dof_fields(model.full_dofs)}
    if model.joint_motions is not None:
        content["joint_motions"] = model.joint_motions
    return content


def reduced_of(content: Mapping[str, Any]) -> ReducedModel:
    """Return the reduced model of some fields."""
    n = content["M"].shape[0]
    motions = content.get("joint_motions")
    return ReducedModel(
        M=content["M"],
        D=content["D"],
        K=content["K"],
        T=content["T"],
        dofs=_dofs_of(content["dofs"]),
        full_dofs=_dofs_of(content["full_dofs"]),
        rigid_body=np.asarray(content["rigid_body"]).reshape(n, -1),
        method=text_in(content.get("method", "")),
        condition=float(np.squeeze(content.get("condition", 1.0))),
        coordinates=names_in(content.get("coordinates")),
        condition_of=text_in(content.get("condition_of", "phi_kk")),
        n_vectors=int(np.squeeze(content.get("n_vectors", 0))),
        static_at=names_in(content.get("static_at")),
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
            value = np.asarray(content[name])
            options[name] = value.reshape(shape) if value.size > 1 else float(np.squeeze(value))
    for name in ("coherence", "variance"):
        if name in options:
            options[name] = np.reshape(options[name], shape)
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
