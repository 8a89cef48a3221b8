"""A plant made again: sampled, with other ports, of other modes, or its structure alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError
from ..lti.discretisation import diagonal_pairs, discretized
from ..lti.noise import noise_factor
from ..lti.statespace import StateSpace
from ..values import FloatArray, positive
from .dynamics import structure_system, with_filters, with_gains
from .origin import Assembled, Foreign
from .ports import Ports
from .rate_check import check_rate
from .realisation import ModalRealisation
from .sampling import sampled_physical
from .wiring import P, continuous_plant, wired


def sampled(plant: P, rate: float, delay: float) -> P:
    """Return a plant sampled at `rate` [Hz] with u delayed by `delay` samples."""
    if plant.dt:
        raise ModelError(
            f"the plant is sampled already (dt {plant.dt:g} s). Start from plant.continuous."
        )
    if plant.is_weighted:
        raise ModelError(
            "the plant is weighted: sample it first, then weight it with sampled weights "
            "(continuous weights would be distorted by the hold)."
        )
    check_rate(plant, rate, delay)
    if not plant.is_assembled:
        system = discretized(plant.system, rate, delay=delay, delayed=plant.u)
        return plant.replace(system=system, origin=Foreign(None, float(delay), plant))
    origin = plant.assembled
    asd = np.array([plant.asd.get(name, 0.0) for name in origin.physical.inputs])
    if origin.ports.delays or diagonal_pairs(origin.physical) is None:
        physical, factor = _with_own_delays(origin, rate, delay, asd)
    else:
        physical = discretized(origin.physical, rate, delay=delay, delayed=plant.u)
        white = noise_factor(origin.physical, asd, physical.dt)
        lines = physical.n_states - origin.physical.n_states
        factor = np.vstack([white, np.zeros((lines, white.shape[1]))])
    return wired(
        type(plant),
        origin.replace(
            physical=physical, noise_factor=factor, delay=float(delay), continuous=plant
        ),
    )


def _with_own_delays(
    origin: Assembled, rate: float, delay: float, asd: FloatArray
) -> tuple[StateSpace, FloatArray]:
    """Sample a plant whose ports have filters or delays: these add to that of all u."""
    ports, g, realisation = origin.ports, origin.physical, origin.realisation
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


def sampled_like(nominal: Any, plant: P) -> P:
    """Return a continuous plant sampled and delayed like another one, if that is sampled."""
    return sampled(plant, 1.0 / nominal.dt, nominal.delay) if nominal.dt else plant


def rebuilt(
    plant: P, *, ports: Ports | None = None, realisation: ModalRealisation | None = None
) -> P:
    """Return a plant with other ports or of other modes, sampled like the old one.

    Raises
    ------
    ModelError
        When the plant was not assembled from a structure, or is weighted.
    """
    if plant.is_weighted:
        raise ModelError(
            "other ports or modes are for a plant that is not weighted: use plant.unweighted."
        )
    own = plant.assembled
    fresh = continuous_plant(
        type(plant),
        own.realisation if realisation is None else realisation,
        own.ports if ports is None else ports,
    )
    return sampled_like(plant, fresh)


def with_flexibility(plant: P, flexibility: FloatArray) -> P:
    """Return a plant whose motions (p, m) also answer forces at once, sampled alike.

    Parameters
    ----------
    plant : StandardPlant
        Assembled, not weighted.
    flexibility : (p, m) array
        From `ports.forces` to the motions of POIs and sensors, between the filters of the ports.
    """
    ports, realisation = plant.assembled.ports, plant.assembled.realisation
    bare = structure_system(realisation, ports)
    physical = with_filters(bare.replace(D=bare.D + flexibility), ports)
    return sampled_like(plant, wired(type(plant), Assembled(ports, realisation, physical)))


def structural(plant: P) -> StateSpace:
    """Return ``[w; u] -> [z; y]`` of the structure alone, filters as their static gains.

    Continuous, its states those of the modes: the rigid-body ones are the first pairs.

    Raises
    ------
    ModelError
        When the plant was not assembled from a structure.
    """
    ports, realisation = plant.assembled.ports, plant.assembled.realisation
    if not ports.has_dynamics and not plant.is_weighted:
        return plant.continuous.system
    bare = with_gains(structure_system(realisation, ports), ports)
    return wired(type(plant), Assembled(ports, realisation, bare)).system
