"""The physical system: a structure, and the filters of amplifiers, sensors and disturbances."""

from __future__ import annotations

import numpy as np

from ..errors import ModelError
from ..lti.interconnection import append, series
from ..lti.statespace import StateSpace, as_statespace
from .ground import Carried, Parts, followed, with_ground
from .ports import Ports
from .realisation import ModalRealisation


def structure_system(realisation: ModalRealisation, ports: Ports) -> StateSpace:
    """Return the structure alone, from all forces to the motions of POIs and sensors."""
    if not ports.forces or not (ports.z or ports.y):
        raise ModelError(
            f"a plant needs inputs (w or u) and outputs (z or y), got {ports!r}. Add ports."
        )
    push = np.array([port.push(realisation) for port in ports.forces])
    B = np.array([realisation.force(load) for load in push]).T
    motions = {
        poi.channel(axis): poi.see(realisation, axis) for poi in ports.z for axis in poi.axes
    }
    found = [*motions.values(), *(sensor.see(realisation) for sensor in ports.y)]
    orders = [*(0 for _ in motions), *(sensor.order for sensor in ports.y)]
    ground = np.array([port.ground for port in ports.forces])
    C = np.array([one.row for one in found])
    D = np.array([followed(*one, push, ground) for one in zip(found, orders, strict=True)])
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


def with_filters(structure: StateSpace, realisation: ModalRealisation, ports: Ports) -> StateSpace:
    """Return the structure between the filters of its ports, absolute motions included.

    Noise at an amplifier's input is an input more, beside the command: it has no states.

    States are those of the sensors' filters, the structure's, those of the forces' filters: what
    drives stands behind what is driven, so that A is block upper triangular.
    """
    before = {port.name: _named(port.filter, port.name) for port in ports.forces}
    filters = {sensor.name: sensor.filter for sensor in ports.y}
    after = {name: _named(filters.get(name), name) for name in structure.outputs}
    moving = _carried(realisation, ports)
    if moving:
        structure, before, after = with_ground(Parts(structure, before, after), moving)
    system = structure
    if any(part.n_states for part in before.values()):
        system = series(append(*before.values()), system)
    elif any(part.D[0, 0] != 1.0 for part in before.values()):
        gains = np.array([part.D[0, 0] for part in before.values()])
        system = system.replace(B=system.B * gains, D=system.D * gains)
    if any(part.n_states or part.D[0, 0] != 1.0 for part in after.values()):
        system = series(system, append(*after.values()))
    noisy = [name.rpartition(":")[0] for name in ports.input_noises]
    if not noisy:
        return system
    twice = [*range(len(system.inputs)), *system.input_index(noisy).tolist()]
    return system.replace(
        B=system.B[:, twice], D=system.D[:, twice], inputs=[*system.inputs, *ports.input_noises]
    )


def _carried(realisation: ModalRealisation, ports: Ports) -> dict[str, Carried]:
    """Return which displacements and velocities move with the ground, and how far."""
    grounds = {port.name: port.ground for port in ports.forces if np.any(port.ground)}
    if not grounds:
        return {}
    seen = {poi.channel(a): (0, poi.see(realisation, a)) for poi in ports.z for a in poi.axes}
    seen |= {port.name: (port.order, port.see(realisation)) for port in ports.y if port.order < 2}
    found = {}
    for output, (order, one) in seen.items():
        gains = {name: float(one.carried @ ground) for name, ground in grounds.items()}
        moved = {name: gain for name, gain in gains.items() if gain}
        if moved:
            found[output] = Carried(order, moved)
    return found


def _named(part: StateSpace | None, name: str) -> StateSpace:
    return (part or as_statespace(1.0)).replace(inputs=[name], outputs=[name])
