"""A machine within an uncertainty: given values of its Deltas, as a plant one can simulate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...lti.discretisation import tustin
from ...lti.interconnection import lft, series
from ...lti.statespace import StateSpace
from ...plant import StandardPlant
from ...plant.uncertainty.neglected import opened
from ...values import FloatArray
from .perturbation import Perturbation, realised
from .uncertain_loop import UncertainLoop
from .uncertainty_blocks import FullBlock


def values_of(loop: UncertainLoop, found: Perturbation, size: float) -> dict[str, float]:
    """Return the real Deltas of a perturbation, by name."""
    names = [block.name for block in loop.blocks if not isinstance(block, FullBlock)]
    numbers = [size * number.real for number in found.scalars[: len(names)]]
    return dict(zip(names, numbers, strict=True))


def neglected_delta(loop: UncertainLoop, found: Perturbation, size: float) -> StateSpace | None:
    """Return the Delta of neglected modes as a system, bilinear image of a sampled one."""
    if not loop.neglected_w:
        return None
    full = next(block for block in loop.blocks if isinstance(block, FullBlock))
    # the phase that the weights have there is taken out: columns of M bear magnitudes
    neglected = loop.channels.neglected
    assert neglected is not None  # noqa: S101 - the loop has channels of it
    own = [neglected.outputs.index(n.removesuffix(":neglected:w")) for n in loop.neglected_w]
    W = np.diag(neglected.weights.evaluated(1j * found.omega))[own]
    a, b = found.vectors[0]
    # a sampled one begins with a delay of one sample, whose phase is made up for
    ahead = 2.0 * np.arctan(0.5 * loop.dt * found.omega)
    turned = found._replace(
        scalars=(), vectors=((a, b * np.exp(1j * (ahead - np.angle(W)))),)
    )  # fmt: skip
    one = realised(turned, [full])
    return one.replace(
        C=size * one.C, D=size * one.D, inputs=loop.neglected_z, outputs=loop.neglected_w
    )


def machine(
    loop: UncertainLoop, values: Mapping[str, float], delta: StateSpace | None
) -> StandardPlant:
    """Return the plant of given Deltas: its modes exact, sampled like the nominal one.

    White noises do not pass the neglected modes in a sampled machine: their covariance is that of
    the modes it has.
    """
    plant: StandardPlant = loop.uncertain.lft(values)
    neglected = loop.channels.neglected
    if delta is None or neglected is None:
        return plant
    own = [name.removesuffix(":neglected:w") for name in loop.neglected_w]
    part = neglected.narrowed(own)
    if plant.dt:
        rate = 1.0 / plant.dt
        part = part.replace(weights=tustin(part.weights, rate))
        delta = series(_delayed(delta, plant.dt), tustin(delta, rate)).replace(inputs=delta.inputs)
    system = opened(plant.system.replace(blocks=None), part, 0)
    starts = [f"{name}:neglected:z" for name in part.inputs]
    system = system.select(
        [*(name for name in starts if name in delta.inputs), *plant.z, *plant.y], None
    )
    closed = lft(system, delta)
    factor: FloatArray | None = None
    if plant.dt:
        extra = closed.n_states - plant.system.n_states
        known = plant.noise_factor
        factor = np.vstack([known, np.zeros((extra, known.shape[1]))])
    return StandardPlant.from_statespace(
        closed.replace(units=plant.system.units),
        w=plant.w, u=plant.u, z=plant.z, y=plant.y, asd=plant.asd, noise_factor=factor,
    )  # fmt: skip


def _delayed(delta: StateSpace, dt: float) -> StateSpace:
    """Return a sample of delay for each input: no command acts within its own sample."""
    n = len(delta.inputs)
    return StateSpace(np.zeros((n, n)), np.eye(n), np.eye(n), np.zeros((n, n)), dt,
                      inputs=delta.inputs, outputs=delta.inputs)  # fmt: skip
