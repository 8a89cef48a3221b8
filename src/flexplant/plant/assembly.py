"""assemble_plant: the one bridge from a structure and its ports to a standard plant."""

from __future__ import annotations

import numpy as np

from ..errors import ModelError
from ..labels import Place
from ..lti.discretisation import discretized
from ..lti.noise import noise_factor
from ..lti.statespace import StateSpace
from ..values import FloatArray
from .ports import QUANTITIES, Poi, Ports
from .realisation import ModalRealisation, Structure, realised
from .standard import StandardPlant


def assemble_plant(model: Structure | ModalRealisation, ports: Ports) -> StandardPlant:
    """Return the standard plant of a structure with its channels.

    ``M q'' + D q' + K q = f`` (the paper's (1), or (8) when reduced) in modal states, with forces
    at the disturbances and actuators and motions at the POIs and sensors.

    Parameters
    ----------
    model : FEModel, Modes or ReducedModel
        The structure; residual attachment vectors of Modes become fast modes. A plant's
        `realisation` serves too: the modes are then not solved again.
    ports : Ports
        The channels.

    Returns
    -------
    StandardPlant
        Continuous. w: disturbances, sensor noises `y1:noise`, references; u: actuators;
        z: POI axes `die:z`, errors `die:error`, efforts `u1:effort`; y: sensors, references.

    Raises
    ------
    LabelError
        When a place is not on the structure.
    ModelError
        When the model or the ports have another type, or a side is empty.

    References
    ----------
    The paper, equations (1)-(8) and Fig. 2.
    """
    if not isinstance(ports, Ports):
        raise ModelError(f"ports must be a Ports value, got {type(ports).__name__}.")
    return _assembled(realised(model), ports)


def _assembled(realisation: ModalRealisation, ports: Ports) -> StandardPlant:
    if not (ports.w or ports.u) or not (ports.z or ports.y):
        raise ModelError(
            f"a plant needs inputs (w or u) and outputs (z or y), got {ports!r}. Add ports."
        )
    forces = [realisation.row(port.at, port.direction) for port in ports.forces]
    B = np.array([realisation.force(row) for row in forces]).T
    motions = [(_poi_row(realisation, poi, axis), 0) for poi in ports.z for axis in poi.axes]
    motions += [(realisation.row(s.at, s.direction), QUANTITIES.index(s.quantity)) for s in ports.y]
    C = np.array([realisation.motion(row, derivative) for row, derivative in motions])
    # an acceleration follows a force at once: d2q/dt2 = S A A x + S A N' f
    D = np.array(
        [
            realisation.motion(row, 1) @ B if derivative == 2 else np.zeros(B.shape[1])
            for row, derivative in motions
        ]
    )
    physical = StateSpace(
        realisation.A,
        B,
        C,
        D,
        inputs=[port.name for port in ports.forces],
        outputs=[poi.channel(axis) for poi in ports.z for axis in poi.axes]
        + [sensor.name for sensor in ports.y],
        states=realisation.names,
        blocks=[2] * realisation.pairs.shape[0],
    )
    return _wired(physical, ports, realisation)


def _poi_row(realisation: ModalRealisation, poi: Poi, axis: str) -> FloatArray:
    at: Place = poi.at
    if isinstance(at, str):
        at = f"{at.split(':')[0]}:{axis}"
    return realisation.row(at, axis)


def _wired(physical: StateSpace, ports: Ports, realisation: ModalRealisation) -> StandardPlant:
    """Add noises, references, errors and efforts to the physical system: all static."""
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
    asd = {d.name: d.asd for d in ports.w if d.asd > 0}
    asd |= {f"{s.name}:noise": s.asd for s in ports.y if s.asd > 0}
    system = physical.replace(B=B, C=C, D=D, inputs=inputs, outputs=outputs)
    return StandardPlant(
        system,
        tuple(w),
        tuple(actuators),
        tuple(z),
        tuple(y),
        asd,
        ports=ports,
        realisation=realisation,
        physical=physical,
    )


def sampled(plant: StandardPlant, rate: float, delay: float) -> StandardPlant:
    """Return a plant sampled at `rate` [Hz] with u delayed by `delay` samples."""
    if plant.dt:
        raise ModelError(
            f"the plant is sampled already (dt {plant.dt:g} s). Start from plant.continuous."
        )
    if plant.unweighted is not None:
        raise ModelError(
            "the plant is weighted: sample it first, then weight it with sampled weights "
            "(continuous weights would be distorted by the hold)."
        )
    if plant.physical is None or plant.ports is None or plant.realisation is None:
        system = discretized(plant.system, rate, delay=delay, delayed=plant.u)
        return plant.replace(system=system, continuous=plant, delay=float(delay))
    physical = discretized(plant.physical, rate, delay=delay, delayed=plant.u)
    wired = _wired(physical, plant.ports, plant.realisation)
    asd = np.array([plant.asd.get(name, 0.0) for name in plant.physical.inputs])
    factor = noise_factor(plant.physical, asd, physical.dt)
    lines = physical.n_states - plant.physical.n_states
    return wired.replace(
        continuous=plant,
        delay=float(delay),
        noise_factor=np.vstack([factor, np.zeros((lines, factor.shape[1]))]),
    )


def reassembled(plant: StandardPlant, ports: Ports) -> StandardPlant:
    """Return a plant with other ports, from the same modes, sampled like the old one."""
    if plant.realisation is None or plant.unweighted is not None:
        raise ModelError(
            "other ports need a plant assembled from a structure and not weighted: use "
            "assemble_plant(model, ports), or plant.unweighted."
        )
    fresh = _assembled(plant.realisation, ports)
    return sampled(fresh, 1.0 / plant.dt, plant.delay) if plant.dt else fresh
