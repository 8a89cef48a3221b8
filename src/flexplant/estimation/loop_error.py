"""The error of an estimator while a controller moves the machine, its own model or another one."""

from __future__ import annotations

import numpy as np

from ..errors import ModelError
from ..loop import ClosedLoop, close_loop
from ..loop.budget import source_variances
from ..loop.noise_sources import check_stationary, sources
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray
from .estimator_channels import estimates, poi_channels, same_pois


def loop_variances(plant: StandardPlant, estimator: StateSpace, loop: ClosedLoop) -> FloatArray:
    """Return the variances (nz,) of ``z - hat`` in a closed loop, at the sample instants.

    What u does to a machine that is not the estimator's model enters the error, although the
    estimator reads u: the Stein equation of the whole loop, ``X = A X A' + G G'``, each noise
    twice (`loop.budget`).
    """
    same_pois(plant, loop.plant)
    channels = poi_channels(plant)
    hats = estimates(channels)
    own = [block for block in loop.blocks if set(hats) & set(block.outputs)]
    if not own:
        loop = close_loop(loop.plant, *loop.blocks, estimator)
    elif not all(_same(block, estimator) for block in own):
        raise ModelError(
            f"the loop has {', '.join(hats)} from another estimator. Close it with this one: "
            "close_loop(machine, observer, servo)."
        )
    check_stationary(loop.obstacle, "the error of an estimator")
    g = loop.monitored
    z, hat = g.output_index(channels), g.output_index(hats)
    error = StateSpace(
        g.A, g.B, g.C[z] - g.C[hat], g.D[z] - g.D[hat], g.dt,
        inputs=g.inputs, outputs=hats, states=g.states,
    )  # fmt: skip
    noises = sources(loop.plant, error)
    return np.array([source_variances(error, row, noises)[0].sum() for row in range(len(hats))])


def _same(one: StateSpace, other: StateSpace) -> bool:
    pairs = ((one.A, other.A), (one.B, other.B), (one.C, other.C), (one.D, other.D))
    return all(np.array_equal(a, b) for a, b in pairs)
