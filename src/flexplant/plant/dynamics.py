"""The physical system: a structure, and the filters of amplifiers, sensors and disturbances."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError
from ..labels import Place
from ..lti.interconnection import append, series
from ..lti.statespace import StateSpace, as_statespace
from ..values import FloatArray
from .forces import BaseAcceleration, OutputDisturbance
from .ports import QUANTITIES, Poi, Ports, filter_of
from .realisation import ModalRealisation
from .rigid.rigid_body import inertia_load


def load_of(realisation: ModalRealisation, port: Any) -> FloatArray:
    """Return the load over the model's DOFs per unit of an actuator or disturbance."""
    if isinstance(port, BaseAcceleration):
        return inertia_load(realisation, port.direction, np.asarray(port.about))
    if isinstance(port, OutputDisturbance):
        return np.zeros(realisation.outputs.shape[0])
    return realisation.row(port.at, port.direction)


def poi_row(realisation: ModalRealisation, poi: Poi, axis: str) -> FloatArray:
    """Return the row over the model's DOFs of one axis of a POI."""
    at: Place = poi.at
    if isinstance(at, str):
        at = f"{at.split(':')[0]}:{axis}"
    return realisation.row(at, axis)


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
    push = np.array([load_of(realisation, port) for port in ports.forces])
    B = np.array([realisation.force(row) for row in push]).T
    motions = [(poi_row(realisation, poi, axis), 0) for poi in ports.z for axis in poi.axes]
    motions += [(realisation.row(s.at, s.direction), QUANTITIES.index(s.quantity)) for s in ports.y]
    C = np.array([realisation.motion(row, derivative) for row, derivative in motions])
    D = np.array([_direct(realisation, row, derivative, push, B) for row, derivative in motions])
    outputs = [poi.channel(axis) for poi in ports.z for axis in poi.axes]
    outputs += [sensor.name for sensor in ports.y]
    for column, port in enumerate(ports.forces):
        if isinstance(port, OutputDisturbance):
            D[outputs.index(port.sensor, len(outputs) - len(ports.y)), column] = 1.0
    return StateSpace(
        realisation.A,
        B,
        C,
        D,
        inputs=[port.name for port in ports.forces],
        outputs=outputs,
        states=realisation.names,
        blocks=realisation.blocks,
    )


def _direct(
    realisation: ModalRealisation, row: FloatArray, derivative: int, push: FloatArray, B: FloatArray
) -> FloatArray:
    """Return the part (m,) of a motion that follows the forces at once."""
    if derivative == 0:
        return np.asarray(realisation.at_once(row[None], push)[0])
    if derivative == 1:
        return np.zeros(B.shape[1])
    # an acceleration follows a force at once: d2q/dt2 = S A A x + S A N' f
    return np.asarray(realisation.motion(row, 1) @ B)


def with_filters(structure: StateSpace, ports: Ports) -> StateSpace:
    """Return the structure between the filters of its ports.

    States are those of the sensors' filters, the structure's, those of the forces' filters: what
    drives stands behind what is driven, so that A is block upper triangular.
    """
    before = [_named(filter_of(port), port.name) for port in ports.forces]
    seen = structure.outputs[: len(structure.outputs) - len(ports.y)]
    after = [_named(None, name) for name in seen]
    after += [_named(filter_of(sensor), sensor.name) for sensor in ports.y]
    system = structure
    if any(part.n_states for part in before):
        system = series(append(*before), system)
    elif any(part.D[0, 0] != 1.0 for part in before):
        gains = np.array([part.D[0, 0] for part in before])
        system = system.replace(B=system.B * gains, D=system.D * gains)
    if any(part.n_states or part.D[0, 0] != 1.0 for part in after):
        system = series(system, append(*after))
    return system


def with_gains(structure: StateSpace, ports: Ports) -> StateSpace:
    """Return the structure with the static gains of its ports' filters in place of these."""
    push = np.array([static_gain(filter_of(port)) for port in ports.forces])
    others = len(structure.outputs) - len(ports.y)
    see = np.array([1.0] * others + [static_gain(filter_of(sensor)) for sensor in ports.y])
    return structure.replace(
        B=structure.B * push,
        C=see[:, None] * structure.C,
        D=see[:, None] * structure.D * push,
    )


def _named(part: StateSpace | None, name: str) -> StateSpace:
    return (part or as_statespace(1.0)).replace(inputs=[name], outputs=[name])


def static_gain(part: StateSpace | None) -> float:
    """Return the gain of a filter at 0 Hz; 1 without one."""
    return 1.0 if part is None else float(part.evaluated(0.0)[0, 0].real)
