"""An uncertain plant with the channels of each Delta side by side, sampled or not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...errors import CertificateError, ModelError
from ...lti.conversions import bilinear, tustin
from ...lti.sampling import discretized
from ...lti.statespace import StateSpace
from ...tolerances import CLOSE
from .channels import Change, DeltaPart, EvenUnits, Opened, with_parts
from .neglected_dynamics import NeglectedModes, with_neglected
from .uncertain_plants import UncertainPlant

#: largest relative distance of the channels from machines at the corners of the uncertainty
_LARGEST = 0.05


class DeltaChannels(NamedTuple):
    """``[blocks; z_Delta; neglected; z; y] = G [blocks; w_Delta; neglected; w; u]``, continuous.

    For a sampled plant G is its bilinear image, with the same gains and stability. The weights of
    neglected modes are not included: `neglected` holds them.
    """

    system: StateSpace
    #: name and number of channels of each Delta, in order
    deltas: tuple[tuple[str, int], ...]
    neglected: NeglectedModes | None
    #: largest relative distance of G from sampled machines at the corners: 0 when continuous
    distance: float = 0.0


def delta_channels(uncertain: UncertainPlant[Any]) -> DeltaChannels:
    """Return the channels of an uncertain plant's Deltas, those of each side by side."""
    # a continuous plant is the exact LFT that `UncertainPlant.system` is. The matrices of a sampled
    # one, mapped to continuous time (`s = 2 / dt (z - 1) / (z + 1)`, which keeps an undamped mode
    # undamped), are nearly affine in the Deltas: each Delta's channels are the difference of the
    # machines at its ends, widened by what is curved, and the whole is compared with machines at
    # corners of the uncertainty. A gain is exact: it is a channel of what all others act on
    plant, neglected = uncertain.plant, uncertain.neglected
    if not plant.dt:
        return _with_others(uncertain, uncertain.opened, neglected, 0.0)
    opened = _sampled_channels(uncertain)
    distance = _distance(uncertain, opened)
    if distance > _LARGEST:
        raise CertificateError(
            f"sampled machines at the corners of the uncertainty lie {100 * distance:.3g} % off "
            f"the affine channels of their Deltas: {_not_affine(uncertain)}"
        )
    if neglected is not None and neglected.sampled is None:
        raise ModelError(
            "the bound on neglected modes is of a continuous plant, this one is sampled: pass the "
            "whole model itself, plant.Neglected(whole)."
        )
    bound = None if neglected is None else neglected.sampled
    return _with_others(uncertain, opened, bound, distance)


def _not_affine(uncertain: UncertainPlant[Any]) -> str:
    """Return why sampled machines are not affine in the Deltas, and what to do."""
    moving = [sensor.name for sensor in uncertain.plant.assembled.ports.y if sensor.order]
    if moving and any(delta.kind == "shape" for delta in uncertain.deltas):
        return (
            f"what {', '.join(moving)} measure (velocities, accelerations) holds the product of a "
            "mode's shape there and where a force acts, which is not affine in an uncertain shape. "
            "Lower the deviations of shapes, or measure displacements there."
        )
    return (
        "the uncertainty is too large at this rate. Lower deviations, measure better, or raise the "
        "rate."
    )


def _with_others(
    uncertain: UncertainPlant[Any],
    opened: Opened,
    neglected: NeglectedModes | None,
    distance: float,
) -> DeltaChannels:
    """Return the channels of Deltas with those of neglected modes and of blocks."""
    system = opened.system
    if neglected is not None:
        names = neglected.outputs
        plain = StateSpace([], [], [], np.eye(len(names)), inputs=names, outputs=names)
        system = with_neglected(system, neglected.replace(weights=plain), opened.width)
    return DeltaChannels(uncertain.with_blocks(system), opened.sizes, neglected, distance)


def sampled_machine(uncertain: UncertainPlant[Any], values: Mapping[str, float]) -> StateSpace:
    """Return the sampled [w; u] -> [z; y] at some values of the Deltas, its states comparable."""
    plant = uncertain.plant
    if not uncertain.of_matrices:
        exact: StateSpace = uncertain.lft(values).system
        return exact
    if plant.assembled.ports.latencies:
        raise ModelError(
            "Deltas on the parameters of a fit are sampled with one delay for all actuators, and "
            "some ports of this plant have their own delay. Model these by filters."
        )
    late = plant.delay + sum(
        delta.scale * values.get(delta.name, 0.0)
        for delta in uncertain.deltas
        if delta.kind == "delay"
    )
    closed = uncertain.opened.closed(values)
    return discretized(closed, 1.0 / plant.dt, delay=late, delayed=plant.u)


def _sampled_channels(uncertain: UncertainPlant[Any]) -> Opened:
    """Return the bilinear image with channels."""
    rate = 1.0 / uncertain.plant.dt
    exact = [delta for delta in uncertain.deltas if delta.outermost]
    deltas = [delta for delta in uncertain.deltas if not delta.outermost]
    machines = {
        (delta.name, end): sampled_machine(uncertain, {delta.name: end})
        for delta in deltas
        for end in (1.0, -1.0)
    }
    base = sampled_machine(uncertain, {})
    for delta in deltas:
        if any(machines[delta.name, end].states != base.states for end in (1.0, -1.0)):
            raise ModelError(
                f"the delay of {uncertain.plant.delay:g} +- {delta.scale:g} samples passes a whole "
                "number of samples, where its effect is not affine in it, so that no Delta "
                "expresses it. Bound it on each side (1.1 +- 0.1 and 0.9 +- 0.1), or draw "
                "machines: uncertain.machines.plants."
            )
    slow = bilinear(base, rate)
    direct, mapped = EvenUnits.of(base), EvenUnits.of(slow)
    found: dict[str, tuple[Change, Change]] = {}
    for delta in deltas:
        ends = [machines[delta.name, end] for end in (1.0, -1.0)]
        images = [bilinear(g, rate) for g in ends]
        found[delta.name] = direct.change(base, *ends), mapped.change(slow, *images)
    # a mode near half the rate, which the bilinear map sends far away, is affine in z instead
    far = {
        delta.mode
        for delta in deltas
        if found[delta.name][1].curved > max(CLOSE, found[delta.name][0].curved)
    }
    sides: tuple[list[DeltaPart], list[DeltaPart]] = ([], [])
    for delta in deltas:
        side = 0 if delta.mode in far else 1
        sides[side].append((direct, mapped)[side].part(delta.name, found[delta.name][side]))
    first = with_parts(Opened(base), sides[0])
    opened = with_parts(first._replace(system=bilinear(first.system, rate)), sides[1])
    for kind in dict.fromkeys(type(delta) for delta in exact):
        own = [delta for delta in exact if type(delta) is kind]
        opened = kind.opened(uncertain.plant, opened, own)
    return opened


def _distance(uncertain: UncertainPlant[Any], opened: Opened) -> float:
    """Return how far sampled machines at corners are from the channels, relative to their change.

    In z, where no frequency counts more than another. What is exact, such as gains, is left at 0
    here: its channels act on commands, those of a machine behind the delay, so that states differ.
    """
    names = [delta.name for delta in uncertain.deltas]
    even = np.array([0.0 if delta.outermost else 1.0 for delta in uncertain.deltas])
    if not np.any(even):
        return 0.0
    base = sampled_machine(uncertain, {})
    units = EvenUnits.of(base)
    found = 0.0
    for corner in even * np.random.default_rng(0).choice([-1.0, 1.0], (4, even.size)):
        values = dict(zip(names, corner.tolist(), strict=True))
        exact = units.scaled(sampled_machine(uncertain, values))
        closed = units.scaled(tustin(opened.closed(values), 1.0 / base.dt))
        found = max(found, float(la.norm(exact - closed) / la.norm(exact - units.scaled(base))))
    return found
