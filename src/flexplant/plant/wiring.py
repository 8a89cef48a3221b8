"""From a physical system to a plant: noises, references, errors and efforts wired to it."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from ..errors import ModelError
from .channel_units import channel_units
from .dynamics import structure_system, with_filters
from .origin import Assembled
from .partition import Partition
from .ports import Ports
from .realisation import ModalRealisation

P = TypeVar("P", bound=Partition)


def wired(cls: type[P], origin: Assembled) -> P:
    """Return the plant of an origin: what is static is added to its physical system.

    Parameters
    ----------
    cls : type
        Of the plant.
    origin : Assembled
        Its ports and its physical system.
    """
    physical, ports = origin.physical, origin.ports
    pois = [poi.channel(axis) for poi in ports.z for axis in poi.axes]
    sensors, actuators = [s.name for s in ports.y], [a.name for a in ports.u]
    noises = [f"{s.name}:noise" for s in ports.y if s.asd > 0]
    tracked = [ports.poi(reference.poi) for reference in ports.references]
    refs = [poi.derived(poi.axes[0], "ref") for poi in tracked]
    w = [*(d.name for d in ports.w), *noises, *refs]
    z = [
        *pois,
        *(poi.derived(poi.axes[0], "error") for poi in tracked),
        *(f"{name}:effort" for name in actuators),
    ]
    y = [*sensors, *refs]
    inputs, outputs = [*w, *actuators], [*z, *y]
    column = {name: i for i, name in enumerate(inputs)}
    row = {name: i for i, name in enumerate(outputs)}
    B = np.zeros((physical.n_states, len(inputs)))
    C = np.zeros((len(outputs), physical.n_states))
    D = np.zeros((len(outputs), len(inputs)))
    driven = [column[name] for name in physical.inputs]
    seen = [row[name] for name in physical.outputs]
    B[:, driven], C[seen] = physical.B, physical.C
    D[np.ix_(seen, driven)] = physical.D
    for name in noises:
        D[row[name.removesuffix(":noise")], column[name]] = 1.0
    for poi, ref in zip(tracked, refs, strict=True):
        error, motion = row[poi.derived(poi.axes[0], "error")], row[poi.channel(poi.axes[0])]
        C[error], D[error] = -C[motion], -D[motion]
        D[error, column[ref]] += 1.0
        D[row[ref], column[ref]] = 1.0
    for name in actuators:
        D[row[f"{name}:effort"], column[name]] = 1.0
    units = channel_units(ports)
    system = physical.replace(B=B, C=C, D=D, inputs=inputs, outputs=outputs, units=units)
    asd = {d.name: d.asd for d in ports.w if d.asd > 0}
    asd |= {f"{s.name}:noise": s.asd for s in ports.y if s.asd > 0}
    return cls(system, tuple(w), tuple(actuators), tuple(z), tuple(y), asd, origin)


def continuous_plant(cls: type[P], realisation: ModalRealisation, ports: Ports) -> P:
    """Return the continuous plant of a structure's modes with its channels.

    Raises
    ------
    LabelError
        When a place is not on the structure.
    ModelError
        When the ports are no Ports value, or a side is empty.
    """
    given: object = ports
    if not isinstance(given, Ports):
        raise ModelError(
            f"ports must be a Ports value, got {type(given).__name__}. "
            "Put the channels in one: Ports(w=[...], u=[...], z=[...], y=[...])."
        )
    physical = with_filters(structure_system(realisation, ports), ports)
    return wired(cls, Assembled(ports, realisation, physical))
