"""A closed loop with the channels of its uncertainty open: what mu is computed of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from ...checks import FloatArray, name_list, short
from ...errors import AssumptionError, ModelError
from ...loop import ClosedLoop, close_loop
from ...lti.discretisation import bilinear, image_freq, tustin
from ...lti.interconnection import lft, series, side_by_side
from ...lti.responses import Responder, responder
from ...lti.statespace import StateSpace, as_statespace
from ...plant import StandardPlant
from ...plant.building import at_rate
from ...plant.uncertainty.delta_channels import DeltaChannels, delta_channels
from ...plant.uncertainty.neglected import with_neglected
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from .uncertainty_blocks import Block, FullBlock, Perturbation, RepeatedScalar, realised_delta

#: heights are taken this much above the weights at the frequencies that sample an interval
_SAFE = 1.002
#: frequencies that sample it
_POINTS = 9


@dataclass(frozen=True)
class OpenPlant:
    """``[z_Delta; neglected; z; y] = G [w_Delta; neglected; w; u]``, z and w weighted.

    Continuous: of a sampled plant the bilinear image. Columns of neglected modes lack their
    weights, whose magnitudes `heights` gives.
    """

    uncertain: UncertainPlant[Any]
    channels: DeltaChannels
    system: StateSpace
    blocks: tuple[Block, ...]
    neglected_w: tuple[str, ...]
    neglected_z: tuple[str, ...]
    before: Mapping[str, Any]
    behind: Mapping[str, Any]

    def with_weights(self, closed: StateSpace) -> StateSpace:
        """Return a closed loop, sampled as it is, with the weights of its w and z."""
        return _with_weights(closed, closed.inputs, closed.outputs, self.before, self.behind)

    @property
    def u(self) -> tuple[str, ...]:
        """The inputs that a controller drives."""
        return tuple(self.uncertain.plant.u)

    @property
    def y(self) -> tuple[str, ...]:
        """The outputs that it reads."""
        return tuple(self.uncertain.plant.y)

    @property
    def dt(self) -> float:
        """Sampling time [s], 0 when continuous."""
        return float(self.uncertain.plant.dt)

    @property
    def n_real(self) -> int:
        """Channels of the real Deltas."""
        return sum(size for _, size in self.channels.deltas)

    def freq(self, omega: float) -> float:
        """Return the frequency [Hz] that one of the image [rad/s] stands for."""
        return float(image_freq(omega, self.dt))

    def heights(self, low: float, high: float) -> FloatArray:
        """Return the largest magnitudes of the columns' weights between two frequencies [rad/s]."""
        tall = np.ones(len(self.system.inputs))
        if not self.neglected_w or self.channels.neglected is None:
            return tall
        W = self.channels.neglected.weights
        freq = self._sampled(W, low, high)
        gain = np.abs(self._weights(freq))
        own = [W.outputs.index(name.removesuffix(":neglected:w")) for name in self.neglected_w]
        most = gain[own, own].max(axis=1)
        if np.isinf(high):
            most = np.maximum(most, np.abs(np.diag(W.D))[own])
        start = self.n_real
        tall[start : start + len(own)] = most if low == high else _SAFE * most
        return tall

    @cached_property
    def _weights(self) -> Responder:
        assert self.channels.neglected is not None  # noqa: S101 - there are columns of it
        return responder(self.channels.neglected.weights)

    def _sampled(self, W: StateSpace, low: float, high: float) -> FloatArray:
        """Return frequencies [Hz] between two [rad/s], the resonances of weights among them."""
        if low == high:
            return np.array([low / (2 * np.pi)])
        own = np.unique(np.abs(W.poles()))
        end = high if np.isfinite(high) else max(100.0 * low, 100.0 * float(own.max(initial=1.0)))
        inside = own[(own > low) & (own < end)]
        points = np.concatenate([np.linspace(low, end, _POINTS), inside])
        if end > 2 * low:
            points = np.concatenate([points, np.geomspace(max(low, 1e-4 * end), end, 4 * _POINTS)])
        return np.unique(points / (2 * np.pi))


@dataclass(frozen=True)
class UncertainLoop(OpenPlant):
    """``[z_Delta; neglected; z] = M [w_Delta; neglected; w]`` with the controller closed."""

    loop: ClosedLoop

    @property
    def performance(self) -> FullBlock:
        """The block from z back to w."""
        n, m = (sum(getattr(block, side) for block in self.blocks) for side in ("z", "w"))
        return FullBlock(
            len(self.system.inputs) - m, len(self.system.outputs) - n, name="performance"
        )

    def around(self, plant: StandardPlant) -> ClosedLoop:
        """Return the controller's loop around another machine."""
        return self.loop.around(plant)


def open_plant(
    uncertain: UncertainPlant[Any],
    *,
    w: Any = (),
    z: Any = (),
    seen: Sequence[str] | None = None,
    driven: Sequence[str] | None = None,
) -> OpenPlant:
    """Return an uncertain plant with its channels, weighted w and z, and all y and u."""
    require_uncertain(uncertain)
    channels = delta_channels(uncertain)
    into, weights_in = weighted_names(w, "w")
    out, weights_out = weighted_names(z, "z")
    g, plant = channels.system, uncertain.plant
    n_real = sum(size for _, size in channels.deltas)
    neglected = channels.neglected
    ends = [] if neglected is None else list(neglected.outputs)
    starts = [] if neglected is None else list(neglected.inputs)
    if seen is not None and driven is not None:
        ends = [name for name in ends if name in seen]
        starts = [name for name in starts if name in driven]
    w_names = [f"{name}:neglected:w" for name in ends]
    z_names = [f"{name}:neglected:z" for name in starts]
    listed: list[Block] = [
        RepeatedScalar(size, real=True, name=name) for name, size in channels.deltas
    ]
    if w_names and z_names:
        listed.append(FullBlock(len(w_names), len(z_names), name="neglected modes"))
    else:
        w_names, z_names = [], []
    inputs = [*g.inputs[:n_real], *w_names, *into, *plant.u]
    outputs = [*g.outputs[:n_real], *z_names, *out, *plant.y]
    before, behind = _checked_weights(weights_in, plant.dt), _checked_weights(weights_out, plant.dt)
    system = _with_weights(
        g.select(outputs, inputs), inputs, outputs,
        *(_bilinear_images(part, plant.dt) for part in (before, behind)),
    )  # fmt: skip
    return OpenPlant(
        uncertain, channels, system, tuple(listed), tuple(w_names), tuple(z_names), before, behind
    )


def uncertain_loop(
    uncertain: UncertainPlant[Any],
    blocks: Sequence[Any],
    *,
    w: Any = (),
    z: Any = (),
) -> UncertainLoop:
    """Return the loop of an uncertain plant with its channels, and some of w and z."""
    require_uncertain(uncertain)
    loop = close_loop(uncertain.plant, *blocks)
    if loop.obstacle is not None:
        raise AssumptionError(
            f"the loop is {loop.obstacle.reason} without any uncertainty: there is nothing to be "
            "robust about. Design a controller that stabilises the nominal plant first."
        )
    confined = None if z else (loop.fed_back, loop.driven)
    seen, driven = confined or (None, None)  # stability: what the loop does not see has no part
    plant = open_plant(uncertain, w=w, z=z, seen=seen, driven=driven)
    controller = loop.controller.select(outputs=loop.driven)
    if plant.dt:
        controller = bilinear(controller, 1.0 / plant.dt)
    g = plant.system
    idle = [name for name in plant.u if name not in loop.driven]
    M = lft(g.select(inputs=[name for name in g.inputs if name not in idle]), controller)
    M = M.replace(states=[f"x{i}" for i in range(1, M.n_states + 1)])
    return UncertainLoop(**{f.name: getattr(plant, f.name) for f in fields(plant)} | {
        "system": M, "loop": loop,
    })  # fmt: skip


def require_uncertain(given: object) -> None:
    """Raise ModelError when a value is no uncertain plant."""
    if not isinstance(given, UncertainPlant):
        raise ModelError(
            f"need an UncertainPlant, got {short(given)}. Make it by plant.uncertain(fit)."
        )


def weighted_names(given: Any, side: str) -> tuple[list[str], dict[str, Any]]:
    """Return the names of channels and their weights; None leaves a channel out."""
    if isinstance(given, Mapping):
        kept = {name: weight for name, weight in given.items() if weight is not None}
        return list(kept), kept
    return list(name_list(given, side)), {}


def _checked_weights(given: Mapping[str, Any], dt: float) -> dict[str, StateSpace]:
    """Return weights as systems of the loop's sampling time."""
    found = {}
    for name, weight in given.items():
        one = as_statespace(weight)
        if one.D.shape != (1, 1):
            raise ModelError(
                f"the weight of {name!r} must have one input and one output, got {one!r}."
            )
        found[name] = at_rate(one, name, dt)
    return found


def _bilinear_images(weights: Mapping[str, StateSpace], dt: float) -> dict[str, StateSpace]:
    """Return the bilinear images of sampled weights."""
    return {
        name: bilinear(one, 1.0 / dt) if dt and one.n_states else one
        for name, one in weights.items()
    }


def _with_weights(
    M: StateSpace,
    inputs: Sequence[str],
    outputs: Sequence[str],
    before: Mapping[str, StateSpace],
    behind: Mapping[str, StateSpace],
) -> StateSpace:
    """Return M with weights of one input and one output on some channels."""
    if any(name in before for name in inputs):
        M = series(_diagonal(inputs, before, M.dt), M)
    if any(name in behind for name in outputs):
        M = series(M, _diagonal(outputs, behind, M.dt))
    return M.replace(inputs=tuple(inputs), outputs=tuple(outputs))


def _diagonal(names: Sequence[str], weights: Mapping[str, StateSpace], dt: float) -> StateSpace:
    each = [as_statespace(weights.get(name, 1.0)).replace(dt=dt) for name in names]
    return side_by_side(each, names, ":weight:")


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
    one = realised_delta(turned, [full])
    return one.replace(
        C=size * one.C, D=size * one.D, inputs=loop.neglected_z, outputs=loop.neglected_w
    )


def machine_at(
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
    system = with_neglected(plant.system.replace(blocks=None), part, 0)
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
