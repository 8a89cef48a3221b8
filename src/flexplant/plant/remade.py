"""Plants made of plants: with other ports or some of the channels; a plant that judges one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import instance, name_list
from ..errors import LabelError, ModelError, require_known, some_names
from ..lti.sampling import acting
from ..lti.statespace import StateSpace
from ..store import Value
from ..tolerances import SAME
from .building import (
    PASS_PORTS,
    P,
    changed_densities,
    remade,
    sampled_like,
    warn_of_another_body,
    wired,
)
from .origins import Assembled, Foreign, PlantChannel
from .partitioned import EvaluationModel, Partition
from .ports import Poi, Ports


def rebuilt(plant: P, ports: Ports) -> P:
    """Return a plant with other ports, sampled like the old one."""
    instance(ports, Ports, "ports", PASS_PORTS)
    if isinstance(plant.origin, Foreign):
        if not all(isinstance(port, PlantChannel) for port in (*ports.physical, *ports.z)):
            _ = plant.assembled  # other ports need a structure
        kept = {"u": [port.name for port in ports.u], "y": [port.name for port in ports.y]}
        return selected(plant, {"w": None, "z": None, **kept})
    own = plant.assembled
    judged = None if plant.evaluation is None else plant.evaluation.with_ports(ports)
    # ports that are among its own are rows and columns of it
    found = None if changed_densities(plant) else with_ports_of(own, ports)
    if found is None:
        return remade(plant, own.realisation, ports, judged)
    whole = None if own.continuous is None else rebuilt(own.continuous, ports)
    return wired(type(plant), found.replace(continuous=whole), judged)


def selected(plant: P, names: Mapping[str, Iterable[str] | None]) -> P:
    """Return a plant with some of its channels, by side; None keeps all of a side."""
    kept = {}
    for side, given in names.items():
        own = getattr(plant, side)
        kept[side] = own if given is None else name_list(given, side)
        require_known(f"channel of {side}", kept[side], own)
    if isinstance(plant.origin, Foreign):
        return _with_rows(plant, kept)
    own = plant.ports
    axes = {poi.name: _axes_among(poi, kept["z"]) for poi in own.z}
    u = [port for port in own.u if port.name in kept["u"]]
    y = [port for port in own.y if port.name in kept["y"]]
    seen = {port.name for port in y}
    w = [p for p in own.w if p.name in kept["w"] and (p.added_to is None or p.added_to in seen)]
    z = [poi.replace(axes=axes[poi.name]) for poi in own.z if axes[poi.name]]
    references = []
    for one in own.references:
        left = [axis for poi, axis in own.followed if poi.name == one.poi and axis in axes[one.poi]]
        references += [one.replace(axes=left)] if left else []
    return rebuilt(plant, own.replace(w=w, u=u, z=z, y=y, references=references))


def _axes_among(poi: Poi, names: Sequence[str]) -> list[str]:
    """Return the axes of a POI whose motion or error is among some channels."""
    shown = {axis: {poi.channel(axis), poi.derived(axis, "error")} for axis in poi.axes}
    return [axis for axis, own in shown.items() if own & set(names)]


def _with_rows(plant: P, kept: Mapping[str, Sequence[str]]) -> P:
    """Return foreign matrices with some of their rows and columns."""
    gone = {f"{name}:noise" for name in plant.y if name not in kept["y"]}
    gone |= {f"{name}:effort" for name in plant.u if name not in kept["u"]}
    derived = {name for name in (*plant.w, *plant.z) if name.endswith((":noise", ":effort"))}
    derived |= set(plant.w) & set(plant.y)  # references
    w, u, z, y = (
        [n for n in getattr(plant, side) if n not in gone and (n in kept[side] or n in derived)]
        for side in "wuzy"
    )
    asd = {name: size for name, size in plant.asd.items() if name in w}
    judged: Any = plant
    whole = judged.evaluation_plant
    return plant.replace(
        system=plant.system.select([*z, *y], [*w, *u]), w=w, u=u, z=z, y=y, asd=asd,
        evaluation=None if whole is None else selected(whole, kept),
    )  # fmt: skip


def with_ports_of(own: Assembled, ports: Ports) -> Assembled | None:
    """Return a plant's origin with some of its sensors, actuators and POIs in their order."""
    # None for ports that are others or in another order, or whose noise the states hold mixed
    if not _among(ports, own.ports):
        return None
    outputs = ports.motions
    inputs = [*(port.name for port in ports.forces), *ports.input_noises]
    if not inputs or not outputs:
        return None
    modes = np.isin(own.physical.states, own.realisation.names)
    chosen = own.physical.select(outputs, inputs)
    reached = acting(own.physical.A != 0)
    stay = modes | _linked(chosen, reached, modes) | ~_linked(own.physical, reached, modes)
    factor = own.noise_factor
    return own.replace(
        ports=ports,
        physical=_with_states(chosen, stay),
        noise_factor=None if factor is None else factor[stay],
    )


def _among(ports: Ports, own: Ports) -> bool:
    """Return whether the ports are some of a plant's own, in their order, without lost noise."""
    some = _is_subsequence(ports.u, own.u) and _is_subsequence(ports.y, own.y)
    same = len(ports.w) == len(own.w) and _is_subsequence(ports.w, own.w)
    noisy = own.input_noises.keys() == ports.input_noises.keys()
    known = {poi.name: poi for poi in own.z}
    return some and same and noisy and all(_is_part(poi, known.get(poi.name)) for poi in ports.z)


def _is_subsequence(ports: Sequence[Value], own: Sequence[Value]) -> bool:
    """Return whether all of some ports are among others, in their order."""
    left = iter(own)
    return all(any(port is other for other in left) for port in ports)


def _is_part(poi: Poi, own: Poi | None) -> bool:
    """Return whether a POI is one of the plant's, or has some of its axes."""
    if own is None or not set(poi.axes) <= set(own.axes):
        return False
    return poi is own or own.replace(axes=poi.axes)._fields() == poi._fields()


def _linked(
    g: StateSpace, reached: npt.NDArray[np.bool_], modes: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Return which states an input or a mode acts on and an output or a mode sees."""
    driven = reached @ (np.any(g.B, axis=1) | modes)
    return np.asarray(driven & ((np.any(g.C, axis=0) | modes) @ reached))


def _with_states(g: StateSpace, stay: npt.NDArray[np.bool_]) -> StateSpace:
    """Return a system without some of its states, which nothing reaches or nothing shows."""
    if np.all(stay):
        return g
    blocks = None
    if g.blocks is not None:
        owner = np.repeat(np.arange(len(g.blocks)), g.blocks)
        sizes = np.bincount(owner[stay], minlength=len(g.blocks))
        blocks = sizes[sizes > 0].tolist()
    return g.replace(
        A=g.A[np.ix_(stay, stay)],
        B=g.B[stay],
        C=g.C[:, stay],
        states=[name for name, kept in zip(g.states, stay.tolist(), strict=True) if kept],
        blocks=blocks,
    )


def check_channels(plant: Partition, other: Partition) -> None:
    """Raise LabelError unless an evaluation model that is a plant has the plant's channels."""
    for side in "wuzy":
        own, others = getattr(plant, side), getattr(other, side)
        if own != others:
            raise LabelError(
                f"the evaluation model has other channels in {side}: {some_names(others)}, the "
                f"plant has {some_names(own)}. Assemble both with the same ports."
            )


def own_plant(kind: type[P], model: EvaluationModel) -> P:
    """Return the plant that is an evaluation model, with the ports that it got since."""
    found = kind.of(model.source)
    return found if model.ports is None else rebuilt(found, model.ports)


def matched(plant: P, model: EvaluationModel) -> P:
    """Return the evaluation plant of a plant whose evaluation model is a plant."""
    other = own_plant(type(plant), model)
    check_channels(plant, other)
    other = other.replace(evaluation=None)
    if plant.dt and not other.dt:
        other = sampled_like(plant, other)
    same = bool(np.isclose(other.dt, plant.dt, rtol=SAME, atol=0.0))
    if not same or other.delay != plant.delay:
        raise ModelError(
            f"the evaluation model has dt {other.dt:g} s and delay {other.delay:g}, the plant "
            f"{plant.dt:g} s and {plant.delay:g}: their responses could not be compared. Pass it "
            "continuous, or sampled like the plant."
        )
    warn_of_another_body(plant, other)
    return other
