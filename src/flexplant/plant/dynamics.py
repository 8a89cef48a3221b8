"""The physical system: a structure, and the filters of amplifiers, sensors and disturbances."""

from __future__ import annotations

import numpy as np

from ..errors import ModelError
from ..lti.interconnection import append, series
from ..lti.statespace import StateSpace, as_statespace
from .ports import Ports
from .realisation import ModalRealisation


def structure_system(realisation: ModalRealisation, ports: Ports) -> StateSpace:
    """Return the structure alone, from all forces to the motions of POIs and sensors.

    Raises
    ------
    ModelError
        When a side is empty.
    """
    if not ports.forces or not (ports.z or ports.y):
        raise ModelError(
            f"a plant needs inputs (w or u) and outputs (z or y), got {ports!r}. Add ports."
        )
    push = np.array([port.push(realisation) for port in ports.forces])
    B = np.array([realisation.force(load) for load in push]).T
    motions = {
        poi.channel(axis): poi.see(realisation, axis) for poi in ports.z for axis in poi.axes
    }
    measured = [sensor.see(realisation) for sensor in ports.y]
    found = [*motions.values(), *measured]
    C, D = np.array([one.row for one in found]), np.array([push @ one.direct for one in found])
    sensors = [sensor.name for sensor in ports.y]
    for column, port in enumerate(ports.forces):
        if port.added_to is not None:
            D[len(motions) + sensors.index(port.added_to), column] = 1.0
    return StateSpace(
        realisation.A,
        B,
        C,
        D,
        inputs=[port.name for port in ports.forces],
        outputs=[*motions, *sensors],
        states=realisation.names,
        blocks=realisation.blocks,
    )


def with_filters(structure: StateSpace, ports: Ports) -> StateSpace:
    """Return the structure between the filters of its ports.

    States are those of the sensors' filters, the structure's, those of the forces' filters: what
    drives stands behind what is driven, so that A is block upper triangular.
    """
    before = [_named(port.filter, port.name) for port in ports.forces]
    seen = structure.outputs[: len(structure.outputs) - len(ports.y)]
    after = [_named(None, name) for name in seen]
    after += [_named(sensor.filter, sensor.name) for sensor in ports.y]
    system = structure
    if any(part.n_states for part in before):
        system = series(append(*before), system)
    elif any(part.D[0, 0] != 1.0 for part in before):
        gains = np.array([part.D[0, 0] for part in before])
        system = system.replace(B=system.B * gains, D=system.D * gains)
    if any(part.n_states or part.D[0, 0] != 1.0 for part in after):
        system = series(system, append(*after))
    return system


def _named(part: StateSpace | None, name: str) -> StateSpace:
    return (part or as_statespace(1.0)).replace(inputs=[name], outputs=[name])
