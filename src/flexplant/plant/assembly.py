"""assemble_plant: the one bridge from a structure and its ports to a standard plant."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from ..errors import FlexplantWarning, ModelError
from ..lti.discretisation import diagonal_pairs, discretized
from ..lti.noise import noise_factor
from ..lti.statespace import StateSpace
from ..values import FloatArray, positive
from .channel_units import channel_units
from .dynamics import structure_system, with_filters, with_gains
from .ports import Ports
from .rate_check import check_rate
from .realisation import MODAL, ModalRealisation, Structure, realised
from .residual import FastStates, ResidualForm
from .sampling import sampled_physical
from .standard import StandardPlant


def assemble_plant(
    model: Structure | ModalRealisation, ports: Ports, *, residual: ResidualForm | None = None
) -> StandardPlant:
    """Return the standard plant of a structure with its channels.

    ``M q'' + D q' + K q = f`` (the paper's (1), or (8) when reduced) in modal states, with forces
    at the disturbances and actuators and motions at the POIs and sensors. The filters of the ports
    (shapes, dynamics) add their states.

    Parameters
    ----------
    model : FEModel, Modes or ReducedModel
        The structure. A plant's `realisation` serves too: the modes are then not solved again.
    ports : Ports
        The channels.
    residual : FastStates or Feedthrough, optional
        What residual attachment vectors of Modes become: fast modes (when not given), or a
        compliance that answers at once.

    Returns
    -------
    StandardPlant
        Continuous. w: disturbances, sensor noises `y1:noise`, references; u: actuators;
        z: POI axes `die:z`, errors `die:error`, efforts `u1:effort`; y: sensors, references.
        Delays of ports act once it is sampled. `plant.form` says whether A is in modal blocks.

    Raises
    ------
    LabelError
        When a place is not on the structure.
    ModelError
        When the model or the ports have another type, or a side is empty.

    Warns
    -----
    FlexplantWarning
        When damping couples the modes so that blocks cannot hold it: an overdamped pair, two poles
        that (nearly) coalesce, or a damper to ground that drags rigid-body motion at more than
        1e-4 of the first elastic frequency (what drags less is left out: rigid-body modes are
        undamped by convention). The undamped modes are then kept with all of D between them, the
        dense form.

    References
    ----------
    The paper, equations (1)-(8) and Fig. 2.
    """
    _check_ports(ports)
    way = FastStates() if residual is None else residual
    if not isinstance(way, ResidualForm):
        raise ModelError(
            f"residual must be FastStates() or Feedthrough(), got {type(residual).__name__}."
        )
    realisation = realised(model)
    if realisation.form != MODAL and realisation is not model:
        warnings.warn(
            f"this plant is not in modal blocks but {realisation.form}. It is exact all the same; "
            "the damping couples its modes, so that what costs O(n) a frequency or sample costs "
            "O(n^2) or more, and mode by mode uncertainty is not defined. See plant.form.",
            FlexplantWarning,
            stacklevel=2,
        )
    return _assembled(way.applied(realisation), ports)


def _check_ports(ports: Ports) -> None:
    given: object = ports
    if not isinstance(given, Ports):
        raise ModelError(
            f"ports must be a Ports value, got {type(given).__name__}. "
            "Put the channels in one: Ports(w=[...], u=[...], z=[...], y=[...])."
        )


def _assembled(realisation: ModalRealisation, ports: Ports) -> StandardPlant:
    physical = with_filters(structure_system(realisation, ports), ports)
    return _plant(physical, ports, realisation)


def structural(plant: StandardPlant) -> StateSpace:
    """Return ``[w; u] -> [z; y]`` of the structure alone, filters as their static gains.

    Continuous, its states those of the modes: the rigid-body ones are the first pairs.

    Raises
    ------
    ModelError
        When the plant was not assembled from a structure.
    """
    if plant.realisation is None or plant.ports is None:
        raise ModelError(
            "this plant was not assembled from a structure: assemble_plant(model, ports)."
        )
    if not plant.ports.has_dynamics and plant.unweighted is None:
        return (plant.continuous or plant).system
    bare = with_gains(structure_system(plant.realisation, plant.ports), plant.ports)
    return _wired(bare, plant.ports).system


class _Wired(NamedTuple):
    system: StateSpace
    w: list[str]
    u: list[str]
    z: list[str]
    y: list[str]


def _wired(physical: StateSpace, ports: Ports) -> _Wired:
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
    units = channel_units(ports)
    system = physical.replace(B=B, C=C, D=D, inputs=inputs, outputs=outputs, units=units)
    return _Wired(system, w, actuators, z, y)


def _plant(physical: StateSpace, ports: Ports, realisation: ModalRealisation) -> StandardPlant:
    wired = _wired(physical, ports)
    asd = {d.name: d.asd for d in ports.w if d.asd > 0}
    asd |= {f"{s.name}:noise": s.asd for s in ports.y if s.asd > 0}
    return StandardPlant(
        wired.system,
        tuple(wired.w),
        tuple(wired.u),
        tuple(wired.z),
        tuple(wired.y),
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
    check_rate(plant, rate, delay)
    if plant.physical is None or plant.ports is None or plant.realisation is None:
        system = discretized(plant.system, rate, delay=delay, delayed=plant.u)
        return plant.replace(system=system, continuous=plant, delay=float(delay))
    asd = np.array([plant.asd.get(name, 0.0) for name in plant.physical.inputs])
    if plant.ports.delays or diagonal_pairs(plant.physical) is None:
        physical, factor = _with_own_delays(plant, rate, delay, asd)
    else:
        physical = discretized(plant.physical, rate, delay=delay, delayed=plant.u)
        white = noise_factor(plant.physical, asd, physical.dt)
        lines = physical.n_states - plant.physical.n_states
        factor = np.vstack([white, np.zeros((lines, white.shape[1]))])
    return _plant(physical, plant.ports, plant.realisation).replace(
        continuous=plant, delay=float(delay), noise_factor=factor
    )


def _with_own_delays(
    plant: StandardPlant, rate: float, delay: float, asd: FloatArray
) -> tuple[StateSpace, FloatArray]:
    """Sample a plant whose ports have filters or delays: these add to that of all u."""
    ports, g, realisation = plant.ports, plant.physical, plant.realisation
    if ports is None or g is None or realisation is None:
        raise ModelError("the plant was not assembled from a structure.")
    common = positive(delay, "delay", zero=True) / positive(rate, "rate")
    return sampled_physical(
        g,
        rate,
        head=g.states.index(realisation.names[0]) if realisation.names else 0,
        pairs=realisation.pairs,
        late_inputs={port.name: port.delay + common for port in ports.u},
        late_outputs={port.name: port.delay for port in ports.y},
        asd=asd,
    )


def with_flexibility(plant: StandardPlant, flexibility: FloatArray) -> StandardPlant:
    """Return a plant whose motions (p, m) also answer forces at once, sampled alike.

    Parameters
    ----------
    plant : StandardPlant
        Assembled, not weighted.
    flexibility : (p, m) array
        From `ports.forces` to the motions of POIs and sensors, between the filters of the ports.
    """
    if plant.realisation is None or plant.ports is None:
        raise ModelError("the plant was not assembled from a structure.")
    bare = structure_system(plant.realisation, plant.ports)
    physical = with_filters(bare.replace(D=bare.D + flexibility), plant.ports)
    fresh = _plant(physical, plant.ports, plant.realisation)
    return sampled(fresh, 1.0 / plant.dt, plant.delay) if plant.dt else fresh


def reassembled(plant: StandardPlant, ports: Ports) -> StandardPlant:
    """Return a plant with other ports, from the same modes, sampled like the old one."""
    _check_ports(ports)
    if plant.realisation is None or plant.unweighted is not None:
        raise ModelError(
            "other ports need a plant assembled from a structure and not weighted: use "
            "assemble_plant(model, ports), or plant.unweighted."
        )
    fresh = _assembled(plant.realisation, ports)
    return sampled(fresh, 1.0 / plant.dt, plant.delay) if plant.dt else fresh
