"""The physical system: a structure, and the filters of amplifiers, sensors and disturbances."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..checks import FloatArray
from ..errors import ModelError, counted
from ..lti.interconnection import among, append, series
from ..lti.statespace import StateSpace, as_statespace
from ..structure import FEModel
from ..structure.rigid import SPANNED, Structure
from ..tolerances import ROUNDING, SAME
from .port import QUANTITIES, Seen
from .ports import Ports
from .realisation import ModalRealisation


class PortRows(NamedTuple):
    """What the ports of a structure push and see; sensors stand behind the motions of POIs."""

    inputs: list[str]
    outputs: list[str]
    push: FloatArray  # (m, n) loads over the DOFs
    ground: FloatArray  # (m, 6) rigid-body motions of the ground
    seen: list[Seen]
    orders: list[int]  # time derivatives that are seen
    added: FloatArray  # (p, m) what is added to a sensor


def port_rows(realisation: ModalRealisation, ports: Ports) -> PortRows:
    """Return the rows and loads of all ports."""
    forces, sensors = ports.forces, ports.y
    if not forces or not (ports.z or sensors):
        raise ModelError(
            f"a model needs inputs (w or u) and outputs (z or y), got {ports!r}. Add ports."
        )
    pois = [(poi, axis) for poi in ports.z for axis in poi.axes]
    outputs = ports.motions
    added = [[outputs.index(port.added_to) if port.added_to else -1] for port in forces]
    return PortRows(
        [port.name for port in forces],
        outputs,
        np.array([port.push(realisation) for port in forces]),
        np.array([port.ground for port in forces]),
        [*(p.see(realisation, axis) for p, axis in pois), *(s.see(realisation) for s in sensors)],
        [*(0 for _ in pois), *(sensor.order for sensor in sensors)],
        np.equal(added, np.arange(len(outputs))).T.astype(np.float64),
    )


def structure_system(realisation: ModalRealisation, ports: Ports) -> StateSpace:
    """Return the structure alone, from all forces to the motions of POIs and sensors."""
    own = port_rows(realisation, ports)
    both = zip(own.seen, own.orders, strict=True)
    return StateSpace(
        realisation.A,
        np.array([realisation.force(load) for load in own.push]).T,
        np.array([one.row for one in own.seen]),
        np.array([direct_effect(realisation.model, *one, own.push, own.ground) for one in both])
        + own.added,
        inputs=own.inputs,
        outputs=own.outputs,
        states=realisation.names,
        blocks=realisation.blocks,
    )


def with_filters(structure: StateSpace, realisation: ModalRealisation, ports: Ports) -> StateSpace:
    """Return the structure between the filters of its ports, absolute motions included."""
    # noise at an amplifier's input is an input more, beside the command: it has no states
    # states are those of the sensors' filters, the structure's, those of the forces' filters: what
    # drives stands behind what is driven, so that A is block upper triangular
    before = {port.name: _named_system(port.filter, port.name) for port in ports.forces}
    filters = {sensor.name: sensor.filter for sensor in ports.y}
    after = {name: _named_system(filters.get(name), name) for name in structure.outputs}
    system = structure
    if any(np.any(port.ground) for port in ports.forces):
        system = _with_ground(structure, before, after, port_rows(realisation, ports))
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


def _named_system(part: StateSpace | None, name: str) -> StateSpace:
    return (part or as_statespace(1.0)).replace(inputs=[name], outputs=[name])


#: relative: a gain at 0 Hz smaller than this is a zero there
_ZERO = 1e-9


def direct_effect(
    model: Structure, one: Seen, order: int, push: FloatArray, ground: FloatArray
) -> FloatArray:
    """Return what a channel shows at once (m,) of loads `push` (m, n) and of `ground` (m, 6)."""
    direct = push @ one.direct
    sizes = np.linalg.norm(push, axis=1) * np.linalg.norm(one.direct)
    direct[np.abs(direct) <= ROUNDING * sizes] = 0.0  # lumped masses do not feel each other
    if order < 2:
        return direct
    # an accelerometer on a free body shows none of the ground's: the load -M r takes back what it
    # adds, up to modes left out; on a held structure a part stays, that of the held DOFs' inertia
    along = ground @ one.carried
    total: FloatArray = direct + along
    held = isinstance(model, FEModel) and model.held_inertia is not None
    total[np.abs(total) <= (SAME if held else SPANNED) * np.abs(along)] = 0.0
    return total


def _with_ground(
    structure: StateSpace,
    before: dict[str, StateSpace],
    after: dict[str, StateSpace],
    own: PortRows,
) -> StateSpace:
    """Return the structure with absolute displacements and velocities, its filters changed for it.

    The ground moves by ``a / s^p``, p = 2 for displacements and 1 for velocities. A filter of a
    sensor with m zeros at 0 Hz integrates m times without a state more, ``F / s^m`` being
    ``(A, A^-m B, C, 0)``, and so does a shape, ``(A, B, C A^-m, 0)``.
    """
    needed: dict[str, set[int]] = {}
    entries: dict[tuple[str, str], float] = {}
    for output, order, one in zip(own.outputs, own.orders, own.seen, strict=True):
        moved = {
            n: float(g) for n, g in zip(own.inputs, own.ground @ one.carried, strict=True) if g
        }
        if order == 2 or not moved:
            continue
        times = _integrals(after[output], 2 - order)
        shown, left = output, 2 - order - times
        if times:
            after[output] = _with_ground_input(after[output], output, times)
            shown = after[output].inputs[1]
        for name, gain in moved.items():
            found = _integrals(before[name], left)
            if found < left:
                raise ModelError(_unbounded(output, order, name, left, found))
            if left:
                needed.setdefault(name, set()).add(left)
            entries[shown, _ground_name(name, left)] = gain
    if not entries:
        return structure
    for name, lefts in needed.items():
        before[name] = _with_integrals(before[name], name, sorted(lefts))
    inputs = [name for part in before.values() for name in part.outputs]
    outputs = [name for part in after.values() for name in part.inputs]
    return among(structure, inputs, outputs, entries)


def _ground_name(name: str, times: int) -> str:
    """Return the name of the ground's acceleration, integrated some times."""
    return name if not times else f"{name}:{QUANTITIES[2 - times]}"


def _integrals(part: StateSpace, most: int) -> int:
    """Return how many zeros at 0 Hz a filter has, up to `most`."""
    if not part.n_states:
        return 0
    B, direct = part.B, float(part.D[0, 0])
    for times in range(most):
        B = np.asarray(np.linalg.solve(part.A, B), dtype=np.float64)
        size = abs(direct) + float((np.abs(part.C) @ np.abs(B))[0, 0])
        if abs(direct - float((part.C @ B)[0, 0])) > _ZERO * size:
            return times
        direct = 0.0
    return most


def _with_ground_input(part: StateSpace, name: str, times: int) -> StateSpace:
    """Return a filter with a second input that it integrates some times besides."""
    B = np.linalg.matrix_power(np.linalg.inv(part.A), times) @ part.B
    return part.replace(
        B=np.hstack([part.B, B]),
        D=np.hstack([part.D, np.zeros((1, 1))]),
        inputs=[name, f"{name}:ground"],
        units={},
    )


def _with_integrals(part: StateSpace, name: str, times: list[int]) -> StateSpace:
    """Return a filter that shows integrals of its output too."""
    inverse = np.linalg.inv(part.A)
    rows = [part.C @ np.linalg.matrix_power(inverse, count) for count in times]
    return part.replace(
        C=np.vstack([part.C, *rows]),
        D=np.vstack([part.D, np.zeros((len(times), 1))]),
        outputs=[name, *(_ground_name(name, count) for count in times)],
        units={},
    )


def _unbounded(output: str, order: int, name: str, left: int, found: int) -> str:
    has = f"the shape of {name!r} has {found or 'none'}"
    return (
        f"{output!r} is an absolute {QUANTITIES[order]}, which grows without bound with the "
        f"acceleration of {name!r}: its integrals need {counted(left, 'zero')} at 0 Hz more "
        f"than the sensor has, and {has}. Give it one that has, shape=highpass(0.1, "
        f"order={left}) say, or dynamics to the sensor (a geophone's), or measure relative to the "
        "ground: absolute=False."
    )
