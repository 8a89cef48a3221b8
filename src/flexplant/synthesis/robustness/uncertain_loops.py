"""A closed loop with the channels of its uncertainty open: what mu is computed of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import FloatArray, name_list
from ...errors import AssumptionError, ModelError, short
from ...loop import ClosedLoop, close_loop
from ...lti.conversions import bilinear, image_freq, tustin
from ...lti.interconnection import lft, series, side_by_side
from ...lti.response_solvers import Responder, responder
from ...lti.statespace import StateSpace, as_statespace, single_channel
from ...plant import AnyPlant
from ...plant.building import at_rate
from ...plant.uncertainty.delta_blocks import Block, FullBlock, RepeatedScalar, channels_of
from ...plant.uncertainty.neglected_dynamics import with_neglected
from ...plant.uncertainty.sampled_channels import DeltaChannels, delta_channels
from ...plant.uncertainty.uncertain_plants import UncertainPlant, made_of
from .uncertainty_blocks import SAMPLES, Perturbation, realised_delta

#: heights are taken this much above the weights at the frequencies that sample an interval
_SAFE = 1.002


@dataclass(frozen=True)
class UncertainLoop:
    """``[z_Delta; neglected; z] = M [w_Delta; neglected; w]``, z and w weighted.

    With the controller closed, or (`loop` None) with all u and y after the other channels.
    Continuous: of a sampled plant the bilinear image. Columns of neglected modes lack their
    weights, whose magnitudes `heights` gives.
    """

    uncertain: UncertainPlant[Any]
    channels: DeltaChannels
    system: StateSpace
    blocks: tuple[Block, ...]
    #: NeglectedModes of the outputs that have channels, None without any; and what drives them
    neglected: Any
    neglected_z: tuple[str, ...]
    before: Mapping[str, StateSpace]
    behind: Mapping[str, StateSpace]
    loop: Any = None

    @property
    def dt(self) -> float:
        """Sampling time [s], 0 when continuous."""
        return float(self.uncertain.plant.dt)

    @property
    def performance(self) -> FullBlock:
        """The block from z back to w."""
        n, m = (sum(getattr(block, side) for block in self.blocks) for side in ("z", "w"))
        return FullBlock(
            len(self.system.inputs) - m, len(self.system.outputs) - n, name="performance"
        )

    def performed(self, plant: AnyPlant) -> StateSpace:
        """Return the weighted w -> z of the loop around a machine, sampled as it is."""
        p, m = self.performance.z, self.performance.w
        closed = self.loop.around(plant).system
        part = closed.select(self.system.outputs[-p:], self.system.inputs[-m:])
        return _with_weights(part, self.before, self.behind)

    def freq(self, omega: Any) -> Any:
        """Return the frequencies [Hz] that those of the image [rad/s] stand for."""
        return image_freq(omega, self.dt)

    def heights(self, low: float, high: float) -> FloatArray:
        """Return the largest magnitudes of the columns' weights between two frequencies [rad/s]."""
        tall = np.ones(len(self.system.inputs))
        if self.neglected is None:
            return tall
        W = self.neglected.weights
        most = np.abs(self._weights(_sampled(W, low, high))).max(axis=2).diagonal()
        if np.isinf(high):
            most = np.maximum(most, np.abs(np.diag(W.D)))
        start = sum(block.w for block in self.blocks[:-1])
        tall[start : start + most.size] = most if low == high else _SAFE * most
        return tall

    @cached_property
    def _weights(self) -> Responder:
        return responder(self.neglected.weights)

    def deltas(self, found: Perturbation, size: float) -> dict[str, float]:
        """Return the real Deltas of a perturbation of some size, by name."""
        scalars = [block for block in self.blocks if isinstance(block, RepeatedScalar)]
        pairs = zip(scalars, found.scalars, strict=False)
        return {block.name: size * number.real for block, number in pairs if block.real}

    def _dynamic(self, found: Perturbation, size: float) -> dict[str, StateSpace]:
        """Return the Deltas of dynamic blocks of a perturbation as systems, by name."""
        scalars, vectors, made = iter(found.scalars), iter(found.vectors), {}
        own = self.blocks[:-1] if self.neglected else self.blocks
        for block in own:
            if isinstance(block, FullBlock):
                one = found._replace(scalars=(), vectors=(next(vectors),))
            else:
                one = found._replace(scalars=(next(scalars),), vectors=())
                if block.real:
                    continue
            delta = realised_delta(one, [block])
            made[block.name] = delta.replace(C=size * delta.C, D=size * delta.D)
        return made

    def machine(self, found: Perturbation, size: float) -> AnyPlant:
        """Return the plant of a perturbation: its modes exact, sampled like the nominal one."""
        # white noises do not pass the neglected modes in a sampled machine: their covariance is
        # that of the modes it has
        values = {**self.deltas(found, size), **self._dynamic(found, size)}
        plant = self.uncertain.lft(values)
        part = self.neglected
        if part is None:
            return plant  # type: ignore[no-any-return]
        delta = self._neglected_delta(found, size)
        if plant.dt:
            rate = 1.0 / plant.dt
            part = part.replace(weights=tustin(part.weights, rate))
            delta = series(_delayed(delta, plant.dt), tustin(delta, rate)).replace(
                inputs=delta.inputs
            )
        system = with_neglected(plant.system.replace(blocks=None), part, 0)
        starts = [f"{name}:neglected:z" for name in part.inputs]
        system = system.select(
            [*(name for name in starts if name in delta.inputs), *plant.z, *plant.y], None
        )
        made: AnyPlant = made_of(plant, lft(system, delta))
        return made

    def _neglected_delta(self, found: Perturbation, size: float) -> StateSpace:
        """Return the Delta of neglected modes as a system, bilinear image of a sampled one."""
        full = self.blocks[-1]
        # the phase that the weights have there is taken out: columns of M bear magnitudes
        W = np.diag(self.neglected.weights.evaluated(1j * found.omega))
        # the last full block; a performance block after it is not a Delta
        a, b = found.vectors[sum(isinstance(block, FullBlock) for block in self.blocks) - 1]
        # a sampled one begins with a delay of one sample, whose phase is made up for
        ahead = 2.0 * np.arctan(0.5 * self.dt * found.omega)
        turned = a, b * np.exp(1j * (ahead - np.angle(W)))
        one = realised_delta(found._replace(scalars=(), vectors=(turned,)), [full])
        ends = [f"{name}:neglected:w" for name in self.neglected.outputs]
        return one.replace(C=size * one.C, D=size * one.D, inputs=self.neglected_z, outputs=ends)


def _sampled(W: StateSpace, low: float, high: float) -> FloatArray:
    """Return frequencies [Hz] between two [rad/s], the resonances of weights among them."""
    if low == high:
        return np.array([low / (2 * np.pi)])
    own = np.unique(np.abs(W.poles()))
    end = high if np.isfinite(high) else max(100.0 * low, 100.0 * float(own.max(initial=1.0)))
    inside = own[(own > low) & (own < end)]
    points = np.concatenate([np.linspace(low, end, SAMPLES), inside])
    if end > 2 * low:
        # four decades, as many points in each
        more = np.geomspace(max(low, 1e-4 * end), end, 4 * SAMPLES)
        points = np.concatenate([points, more])
    return np.unique(points / (2 * np.pi))


def _delayed(delta: StateSpace, dt: float) -> StateSpace:
    """Return a sample of delay for each input: no command acts within its own sample."""
    n = len(delta.inputs)
    return StateSpace(np.zeros((n, n)), np.eye(n), np.eye(n), np.zeros((n, n)), dt,
                      inputs=delta.inputs, outputs=delta.inputs)  # fmt: skip


def open_plant(
    uncertain: UncertainPlant[Any], *, w: Any = (), z: Any = (), loop: ClosedLoop | None = None
) -> UncertainLoop:
    """Return an uncertain plant with its channels, weighted w and z, and all y and u."""
    # given a loop, with the channels of neglected modes that it drives and sees
    require_uncertain(uncertain)
    channels = delta_channels(uncertain)
    (into, before), (out, behind) = weighted_names(w, "w"), weighted_names(z, "z")
    g, plant, part = channels.system, uncertain.plant, channels.neglected
    own = uncertain.delta_blocks
    n_real, k, p = (
        sum(size for _, size in channels.deltas), sum(b.w for b in own), sum(b.z for b in own)
    )  # fmt: skip
    ends = [n for n in (part.outputs if part else ()) if loop is None or n in loop.fed_back]
    starts = [n for n in (part.inputs if part else ()) if loop is None or n in loop.driven]
    if not ends or not starts:
        part, ends, starts = None, [], []
    z_names = [f"{name}:neglected:z" for name in starts]
    listed: list[Block] = [
        RepeatedScalar(size, real=True, name=name) for name, size in channels.deltas
    ]
    listed += own
    if part is not None:
        part = part.narrowed(ends)
        listed.append(FullBlock(len(ends), len(starts), name="neglected modes"))
    block_ends = [channels_of(block) for block in own]
    inputs = [
        *g.inputs[k : k + n_real], *(name for one, _ in block_ends for name in one),
        *(f"{name}:neglected:w" for name in ends), *into, *plant.u,
    ]  # fmt: skip
    outputs = [
        *g.outputs[p : p + n_real], *(name for _, one in block_ends for name in one),
        *z_names, *out, *plant.y,
    ]  # fmt: skip
    before, behind = _checked_weights(before, plant.dt), _checked_weights(behind, plant.dt)
    images = (
        {n: bilinear(W, 1.0 / plant.dt) if plant.dt and W.n_states else W for n, W in side.items()}
        for side in (before, behind)
    )
    system = _with_weights(g.select(outputs, inputs), *images)
    return UncertainLoop(
        uncertain, channels, system, tuple(listed), part, tuple(z_names), before, behind
    )


def uncertain_loop(
    uncertain: UncertainPlant[Any], blocks: Sequence[Any], *, w: Any = (), z: Any = ()
) -> UncertainLoop:
    """Return the loop of an uncertain plant with its channels, and some of w and z."""
    require_uncertain(uncertain)
    loop = _nominal_loop(uncertain.plant, blocks)
    if loop.obstacle is not None:
        raise AssumptionError(
            f"the loop is {loop.obstacle.reason} without any uncertainty. Design a controller that "
            "stabilises the nominal plant first."
        )
    # stability: what the loop does not see has no part
    plant = open_plant(uncertain, w=w, z=z, loop=None if z else loop)
    controller = loop.controller.select(outputs=loop.driven)
    if plant.dt:
        controller = bilinear(controller, 1.0 / plant.dt)
    g = plant.system
    idle = set(uncertain.plant.u) - set(loop.driven)
    M = lft(g.select(inputs=[name for name in g.inputs if name not in idle]), controller)
    return replace(
        plant, system=M.replace(states=[f"x{i}" for i in range(1, M.n_states + 1)]), loop=loop
    )


def _nominal_loop(plant: AnyPlant, blocks: Sequence[Any]) -> ClosedLoop:
    """Return the nominal loop; a plant without actuators is a loop that is closed already."""
    if plant.u or blocks:
        return close_loop(plant, *blocks)
    return ClosedLoop(plant, (), StateSpace([], [], [], np.zeros((0, 0)), plant.dt), ())


def require_uncertain(given: object) -> None:
    """Raise ModelError when a value is not an uncertain plant."""
    if not isinstance(given, UncertainPlant):
        raise ModelError(
            f"need an UncertainPlant, got {short(given)}. Make it by plant.uncertain(fit), or "
            "synthesis.uncertain_system(M, blocks)."
        )


def weighted_names(given: Any, side: str) -> tuple[list[str], dict[str, Any]]:
    """Return the names of channels and their weights; None leaves a channel out."""
    if isinstance(given, Mapping):
        kept = {name: weight for name, weight in given.items() if weight is not None}
        return list(kept), kept
    return list(name_list(given, side)), {}


def _checked_weights(given: Mapping[str, Any], dt: float) -> dict[str, StateSpace]:
    """Return weights as systems of the loop's sampling time."""
    return {
        name: at_rate(single_channel(weight, f"the weight of {name!r}"), name, dt)
        for name, weight in given.items()
    }


def _with_weights(
    M: StateSpace, before: Mapping[str, StateSpace], behind: Mapping[str, StateSpace]
) -> StateSpace:
    """Return M with weights of one input and one output on some channels."""
    if before:
        M = series(_diagonal(M.inputs, before, M.dt), M)
    return series(M, _diagonal(M.outputs, behind, M.dt)) if behind else M


def _diagonal(names: Sequence[str], weights: Mapping[str, StateSpace], dt: float) -> StateSpace:
    each = [as_statespace(weights.get(name, 1.0)).replace(dt=dt) for name in names]
    return side_by_side(each, names, ":weight:")
