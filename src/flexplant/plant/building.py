"""Building plants: from modes, ports and their filters; sampled, with other ports or weights."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..arrays import FloatArray, IntArray, positive
from ..errors import ModelError, counted, warn
from ..lti.conversions import tustin
from ..lti.frequency import QUANTITIES
from ..lti.interconnection import among, append, series
from ..lti.sampling import (
    check_latency,
    check_rate,
    held_exactly,
    light_modes,
    reaches_at_once,
    sample_and_hold,
)
from ..lti.statespace import StateSpace, as_statespace
from ..structure import FEModel
from ..structure.rigid import Structure
from ..tolerances import NEGLIGIBLE, ROUNDING, SAME
from .origins import Assembled, Foreign
from .partitioned import EvaluationModel, Partition, PartitionedSystem
from .port import ForcePort, MeasuredRow, SensorPort
from .ports import Ports
from .realisation import ModalRealisation, natural


class PortRows(NamedTuple):
    """What the ports of a structure push and see; sensors stand behind the motions of POIs."""

    inputs: list[str]
    outputs: list[str]
    push: FloatArray  # (m, n) loads over the DOFs
    ground: FloatArray  # (m, 6) rigid-body motions of the ground
    seen: list[MeasuredRow]
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
    # noise at an amplifier's input is a further input next to the command: it has no states
    # states are those of the sensors' filters, the structure's, those of the forces' filters: what
    # drives stands behind what is driven, so that A is block upper triangular
    before, after = _named_filters(ports.forces), _named_filters(ports.y)
    system = structure
    if any(np.any(port.ground) for port in ports.forces):
        system = _with_ground(structure, before, after, port_rows(realisation, ports))
    if before:
        system = series(_filters_of_channels(before, structure.inputs), system)
    if after:
        system = series(system, _filters_of_channels(after, structure.outputs))
    noisy = [name.rpartition(":")[0] for name in ports.input_noises]
    if not noisy:
        return system
    twice = [*range(len(system.inputs)), *system.input_index(noisy).tolist()]
    return system.replace(
        B=system.B[:, twice], D=system.D[:, twice], inputs=[*system.inputs, *ports.input_noises]
    )


def _named_filters(ports: Iterable[ForcePort | SensorPort]) -> dict[str, StateSpace]:
    """Return the filters of the ports that have one, their channels named like the port."""
    found = {port.name: port.filter for port in ports}
    return {n: g.replace(inputs=[n], outputs=[n]) for n, g in found.items() if g is not None}


def _filters_of_channels(filters: Mapping[str, StateSpace], names: Iterable[str]) -> StateSpace:
    """Return the filters of channels as one; a channel without a filter passes through."""
    one = as_statespace(1.0)
    return append(*(filters.get(n) or one.replace(inputs=[n], outputs=[n]) for n in names))


def direct_effect(
    model: Structure, one: MeasuredRow, order: int, push: FloatArray, ground: FloatArray
) -> FloatArray:
    """Return what a channel shows at once (m,) of loads `push` (m, n) and of `ground` (m, 6)."""
    direct = push @ one.direct
    sizes = np.linalg.norm(push, axis=1) * np.linalg.norm(one.direct)
    direct[np.abs(direct) <= ROUNDING * sizes] = 0.0  # lumped masses do not feel each other
    if order < 2:
        return direct
    # an accelerometer on a free body shows none of the ground's: the load -M r takes back what it
    # adds, up to truncated modes; on a held structure a part stays, that of the held DOFs' inertia
    along = ground @ one.carried
    total: FloatArray = direct + along
    held = isinstance(model, FEModel) and model.held_inertia is not None
    total[np.abs(total) <= (SAME if held else NEGLIGIBLE) * np.abs(along)] = 0.0
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
        times = _integrals(after.get(output), 2 - order)
        shown, left = output, 2 - order - times
        if times:
            after[output] = _with_ground_input(after[output], output, times)
            shown = after[output].inputs[1]
        for name, gain in moved.items():
            found = _integrals(before.get(name), left)
            if found < left:
                raise ModelError(_unbounded(output, order, name, left, found))
            if left:
                needed.setdefault(name, set()).add(left)
            entries[shown, _ground_name(name, left)] = gain
    if not entries:
        return structure
    for name, lefts in needed.items():
        before[name] = _with_integrals(before[name], name, sorted(lefts))
    inputs = [n for one in own.inputs for n in (before[one].outputs if one in before else [one])]
    outputs = [n for one in own.outputs for n in (after[one].inputs if one in after else [one])]
    return among(structure, inputs, outputs, entries)


def _ground_name(name: str, times: int) -> str:
    """Return the name of the ground's acceleration, integrated some times."""
    return name if not times else f"{name}:{QUANTITIES[2 - times]}"


def _integrals(part: StateSpace | None, most: int) -> int:
    """Return how many zeros at 0 Hz a filter has, up to `most`."""
    if part is None or not part.n_states:
        return 0
    B, direct = part.B, float(part.D[0, 0])
    # what rounding of one solution may reach: a state that is zero may be read
    spread = np.abs(part.C) @ np.abs(np.linalg.inv(part.A)) @ np.abs(part.A)
    for times in range(most):
        B = np.asarray(np.linalg.solve(part.A, B), dtype=np.float64)
        size = abs(direct) + float((spread @ np.abs(B))[0, 0])
        if abs(direct - float((part.C @ B)[0, 0])) > SAME * size:
            return times
        direct = 0.0
    return most


def _with_ground_input(part: StateSpace, name: str, times: int) -> StateSpace:
    """Return a filter with a second input that it also integrates some times."""
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
        f"than the sensor has, and {has}. Give it one that has, shape=fx.lti.high_pass_filter("
        f"0.1, order={left}) say, or dynamics to the sensor (a geophone's), or measure relative "
        "to the ground: absolute=False."
    )


P = TypeVar("P", bound=Partition)
#: what to do when something else is given as ports
PASS_PORTS = "Pass Ports(w=[...], u=[...], z=[...], y=[...])."


def wired(cls: type[P], origin: Assembled, evaluation: EvaluationModel | None) -> P:
    """Return the plant of an origin: what is static is added to its physical system."""
    physical, ports = origin.physical, origin.ports
    actuators = [a.name for a in ports.u]
    noises = [f"{s.name}:noise" for s in ports.y if s.asd > 0]
    refs, errors = (
        [poi.derived(axis, kind) for poi, axis in ports.followed] for kind in ("ref", "error")
    )
    w = [*(d.name for d in ports.w), *ports.input_noises, *noises, *refs]
    pois = ports.motions[: len(ports.motions) - len(ports.y)]
    z = [*pois, *errors, *(f"{name}:effort" for name in actuators)]
    y = [*(s.name for s in ports.y), *refs]
    inputs, outputs = [*w, *actuators], [*z, *y]
    motions = physical.output_index([poi.channel(axis) for poi, axis in ports.followed])
    pairs = [(name.removesuffix(":noise"), name) for name in noises]
    pairs += [*zip(errors, refs, strict=True), *zip(refs, refs, strict=True)]
    pairs += [(f"{name}:effort", name) for name in actuators]
    shown = physical.replace(
        C=np.vstack([physical.C, -physical.C[motions]]),
        D=np.vstack([physical.D, -physical.D[motions]]),
        outputs=[*physical.outputs, *errors],
    )
    system = among(shown, inputs, outputs, dict.fromkeys(pairs, 1.0)).replace(units=ports.units)
    return cls(
        system, tuple(w), tuple(actuators), tuple(z), tuple(y), ports.densities, origin,
        evaluation=evaluation,
    )  # fmt: skip


def continuous_plant(
    cls: type[P], realisation: ModalRealisation, ports: Ports, evaluation: EvaluationModel | None
) -> P:
    """Return the continuous plant of a structure's modes with its channels."""
    physical = with_filters(structure_system(realisation, ports), realisation, ports)
    return wired(cls, Assembled(ports, realisation, physical), evaluation)


def sampled(plant: P, rate: float, delay: float) -> P:
    """Return a plant sampled at `rate` [Hz] with u delayed by `delay` samples."""
    if plant.dt:
        raise ModelError(
            f"the plant is sampled already (dt {plant.dt:g} s). Start from plant.continuous."
        )
    check_rate(_elastic_frequencies(plant), rate, delay)
    for name, late in plant.ports.latencies.items():
        check_latency(name, late, rate)
    origin = plant.origin
    if isinstance(origin, Foreign):
        system = held_exactly(plant.system, rate, delay=delay, delayed=plant.u)
        return plant.replace(system=system, origin=Foreign(None, float(delay), plant))
    held = plant.held
    asd = np.array(
        [0.0 if name in held else plant.asd.get(name, 0.0) for name in origin.physical.inputs]
    )
    physical, factor = _held(origin, rate, delay, asd)
    sizes = np.array([plant.asd.get(name, 0.0) for name in held]) * np.sqrt(0.5 * rate)
    factor = np.hstack([factor, physical.B[:, physical.input_index(held)] * sizes])
    known = {"noise_factor": factor, "delay": float(delay), "continuous": plant}
    found = wired(type(plant), origin.replace(physical=physical, **known), plant.evaluation)
    own = {name: level for name, level in plant.asd.items() if name in found.w}
    return found if own == found.asd else found.replace(asd=own, origin=found.origin)


def sampled_motions(
    plant: Partition, blocks: Iterable[FloatArray], outputs: Sequence[str], inputs: Sequence[str]
) -> list[StateSpace]:
    """Return only the path from actuators to sensors, for each set of modes' blocks (b, 2, 2)."""
    # sampled like the plant; the states are some of the plant's
    origin = plant.continuous.assembled
    some, found = origin.replace(physical=origin.physical.select(outputs, inputs)), []
    for pairs in blocks:
        own = with_modes(some, origin.realisation.replace(pairs=pairs))
        found.append(_held(own, 1.0 / plant.dt, plant.delay)[0] if plant.dt else own.physical)
    return found


def with_modes(origin: Assembled, realisation: ModalRealisation) -> Assembled:
    """Return an origin with A of a realisation, whose modes move and are driven as its own do."""
    g = origin.physical
    where = [g.states.index(name) for name in realisation.names]
    A = np.array(g.A)
    A[np.ix_(where, where)] = realisation.A
    return origin.replace(physical=g.replace(A=A), realisation=realisation)


def _elastic_frequencies(plant: Partition) -> FloatArray:
    """Return the frequencies [Hz] of the elastic modes of a plant."""
    if not plant.modal_blocks.size:
        return light_modes(plant.system.poles())
    size, _ = natural(plant.modal_blocks)
    return np.asarray(size[size > 0] / (2.0 * np.pi))


def _held(
    origin: Assembled, rate: float, delay: float, asd: FloatArray | None = None
) -> tuple[StateSpace, FloatArray]:
    """Return the sampled physical system and its noise; delays of ports add to that of all u."""
    common = positive(delay, "delay", zero=True) / positive(rate, "rate")
    late_inputs = {port.name: port.latency + common for port in origin.ports.u}
    late_outputs = {port.name: port.latency for port in origin.ports.y}
    return sample_and_hold(origin.physical, rate, late_inputs, late_outputs, asd)


def sampled_like(nominal: Any, plant: P) -> P:
    """Return a continuous plant sampled and delayed like another one, if that is sampled."""
    return sampled(plant, 1.0 / nominal.dt, nominal.delay) if nominal.dt else plant


def changed_densities(plant: Partition) -> dict[str, float]:
    """Return the densities of a plant's noise that are not those of its ports."""
    own, now = plant.assembled.ports.densities, plant.asd
    names = [*now, *(name for name in own if name not in now)]
    return {n: now.get(n, 0.0) for n in names if now.get(n, 0.0) != own.get(n, 0.0)}


def loud_like(plant: Partition, fresh: P) -> P:
    """Return a continuous plant with the densities that were changed in another one."""
    # ports that were given a new density keep the new one
    own = plant.assembled.ports.densities
    kept = {
        name: level
        for name, level in changed_densities(plant).items()
        if name in fresh.w and fresh.asd.get(name, 0.0) == own.get(name, 0.0)
    }
    return fresh.replace(asd={**fresh.asd, **kept}) if kept else fresh


def remade(
    plant: P, realisation: ModalRealisation, ports: Ports, evaluation: EvaluationModel | None
) -> P:
    """Return a plant of other modes or with other ports, sampled and loud like the old one."""
    own = plant.assembled
    if ports is own.ports and _moves_alike(own, realisation):
        before = with_modes(plant.continuous.assembled, realisation)
        fresh = wired(type(plant), before, evaluation)
    else:
        fresh = continuous_plant(type(plant), realisation, ports, evaluation)
    return sampled_like(plant, loud_like(plant, fresh))


def _moves_alike(own: Assembled, realisation: ModalRealisation) -> bool:
    """Return whether modes differ from a plant's in their poles alone, and its ports by them in A.

    What a velocity or an acceleration shows of a mode hangs on its poles.
    """
    before = own.realisation
    same = all(
        getattr(realisation, name) is value or np.array_equal(getattr(realisation, name), value)
        for name, value in before._fields().items()
        if name != "pairs"
    )
    held = set(before.names) <= set(own.physical.states)
    return same and held and not any(sensor.order for sensor in own.ports.y)


def another_machine(plant: P, realisation: ModalRealisation, ports: Ports) -> P:
    """Return the plant of another machine, of other modes, sampled like the old one."""
    # the evaluation model does not describe it. What a reduced model left out follows a change of
    # that model
    judged = plant.evaluation
    if judged is not None and judged.source is not plant.model:
        judged = None
    elif judged is not None and realisation.model is not plant.model:
        judged = EvaluationModel.known_to(realisation.model)
    return remade(plant, realisation, ports, judged)


def noiseless(plant: P, realisation: ModalRealisation, ports: Ports, late: float) -> P:
    """Return the plant of another machine without noise, delayed by `late` samples more."""
    structure = structure_system(realisation, ports)
    origin = Assembled(ports, realisation, with_filters(structure, realisation, ports))
    if plant.dt:
        delay = plant.delay + late
        physical, _ = _held(origin, 1.0 / plant.dt, delay)
        origin = origin.replace(physical=physical, delay=delay)
    return wired(type(plant), origin, None)


def at_rate(weight: StateSpace, name: str, dt: float) -> StateSpace:
    """Return a weight of sampling time dt; a continuous one is sampled (Tustin)."""
    if not weight.n_states:
        return weight.replace(dt=dt)
    if dt and not weight.dt:
        return tustin(weight, 1.0 / dt)
    if not np.isclose(weight.dt, dt, rtol=SAME, atol=0.0):
        raise ModelError(
            f"the weight of {name!r} has dt {weight.dt:g} s, the plant {dt:g} s. Give it as a "
            "continuous system, which is sampled at the plant's rate."
        )
    return weight


#: relative difference of rigid-body accelerations above which two models are different bodies; an
#: updated mass stays below it
_ANOTHER_BODY = 0.1


def evaluation_plant(plant: P, model: EvaluationModel) -> P:
    """Return the plant of a structure that judges another, with its channels, sampled alike."""
    before: Any = plant.continuous
    if before is not plant:
        found: P = before.evaluation_plant
    else:
        found = continuous_plant(type(plant), model.realisation, plant.assembled.ports, None)
    found = sampled_like(plant, loud_like(plant, found))
    if before is plant:  # others were compared before they were sampled
        warn_of_another_body(plant, found)
    return found


def warn_of_another_body(own: Partition, other: Partition) -> None:
    """Warn where forces accelerate the rigid body of an evaluation model differently."""
    if not (own.n_rigid and other.n_rigid):
        return  # held, on springs, or of foreign matrices: no mode shows the mass alone
    channels = own.assembled.ports.motions
    one, two = (rigid_gain(plant, channels, own.u) for plant in (own, other))
    size = float(np.linalg.norm(one))
    if not size or not np.any(two):
        return  # no force moves the body
    off = float(np.linalg.norm(two - one)) / size
    if off > _ANOTHER_BODY:
        warn(
            "the evaluation model moves as another rigid body: its acceleration per force differs "
            f"by {off:.0%} from the plant's, so that answers would be judged on another machine. "
            "Pass the model that the plant was made of, with more modes."
        )


def rigid_gain(plant: Partition, outputs: Sequence[str], inputs: Sequence[str]) -> FloatArray:
    """Return the accelerations at outputs per force at inputs, of the modes at 0 Hz alone."""
    seen, push = rigid_shapes(plant, outputs, inputs)
    return np.asarray(seen @ push.T)


def rigid_shapes(
    plant: Partition, outputs: Sequence[str], inputs: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return what outputs (p, r) show and inputs (m, r) push of the modes at 0 Hz, of unit mass."""
    # their product is `rows R m^-1 R' pushes'` with R the free motions and m their mass; filters of
    # the ports count with their static gains
    realisation, ports = plant.assembled.realisation, plant.assembled.ports
    r = realisation.n_rigid
    motions = realisation.outputs[:, 2 * np.arange(r)] * realisation.pairs[:r, 0, 1]
    forces = {port.name: port.static_push(realisation) for port in ports.forces}
    places = {p.channel(axis): p.row(realisation, axis) for p in ports.z for axis in p.axes}
    places |= {s.name: s.static_row(realisation) for s in ports.y}
    seen, push = (
        np.array([side[name] for name in names]).reshape(-1, len(motions)) @ motions
        for side, names in ((places, outputs), (forces, inputs))
    )
    return np.asarray(seen), np.asarray(push)


class WhiteNoise(NamedTuple):
    """How white samples enter: `factor` (n, r) into x, `deviation` at the `columns` of w."""

    factor: FloatArray
    columns: IntArray
    deviation: FloatArray


def white_names(plant: PartitionedSystem) -> tuple[list[str], list[str]]:
    """Return the channels of w that are white noise: disturbances, then noises per sample."""
    # per sample: those of sensors, and disturbances that are held over each sample
    loud = [name for name, level in plant.asd.items() if level > 0]
    held = plant.held if plant.dt else ()
    sensors = [name for name in loud if name.removesuffix(":noise") in plant.y or name in held]
    white = [name for name in loud if name not in sensors]
    direct = plant.system.select(inputs=white).D
    if np.any(direct):
        i, j = np.argwhere(direct)[0]
        raise reaches_at_once(white[j], plant.system.outputs[i])
    return white, sensors


def white_noise(plant: PartitionedSystem) -> WhiteNoise:
    """Return the noises of a sampled plant, all disturbances together."""
    # exact over a sample, including aliasing; the variance of a sensor is asd^2 rate / 2
    white, sensors = white_names(plant)
    factor = continuous_factor(plant) if white else np.zeros((plant.system.n_states, 0))
    columns = np.array([plant.w.index(name) for name in sensors], dtype=np.int64)
    asd = np.array([plant.asd[name] for name in sensors])
    return WhiteNoise(factor, columns, asd * np.sqrt(0.5 / plant.dt))


def continuous_factor(plant: PartitionedSystem) -> FloatArray:
    """Return the noise factor of the disturbances that are not held over each sample."""
    total = plant.noise_factor
    return total[:, : total.shape[1] - len(plant.held)]
