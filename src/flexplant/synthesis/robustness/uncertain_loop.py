"""A closed loop with the channels of its uncertainty open: what mu is computed of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...errors import AssumptionError, ModelError
from ...loop import ClosedLoop, close_loop
from ...lti.discretisation import bilinear
from ...lti.interconnection import append, lft, series
from ...lti.responses import Responder, responder
from ...lti.statespace import StateSpace, as_statespace
from ...plant.uncertainty.delta_channels import DeltaChannels, delta_channels
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from ...values import FloatArray, name_list, short
from .blocks import Block, FullBlock, RepeatedScalar

#: heights are taken this much above the weights at the frequencies that sample an interval
_SAFE = 1.002
#: frequencies that sample it
_POINTS = 9


@dataclass(frozen=True)
class UncertainLoop:
    """``[z_Delta; neglected; z] = M [w_Delta; neglected; w]`` with the controller closed.

    Continuous: of a sampled loop the bilinear image. Columns of neglected modes lack their
    weights, whose magnitudes `heights` gives; `weighted` has them as states.
    """

    uncertain: UncertainPlant[Any]
    loop: ClosedLoop
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
    def dt(self) -> float:
        """Sampling time [s], 0 when continuous."""
        return float(self.uncertain.plant.dt)

    @property
    def n_real(self) -> int:
        """Channels of the real Deltas."""
        return sum(size for _, size in self.channels.deltas)

    def freq(self, omega: float) -> float:
        """Return the frequency [Hz] that one of the image [rad/s] stands for."""
        if not self.dt:
            return omega / (2 * np.pi)
        return float(np.arctan(0.5 * self.dt * omega) / (np.pi * self.dt))

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

    def weighted(self) -> StateSpace:
        """Return M with the weights of neglected modes as states."""
        if not self.neglected_w or self.channels.neglected is None:
            return self.system
        own = [name.removesuffix(":neglected:w") for name in self.neglected_w]
        W = self.channels.neglected.weights.select(own, own)
        others = [name for name in self.system.inputs if name not in self.neglected_w]
        order = list(self.system.inputs)
        plain = StateSpace(
            np.zeros((0, 0)), np.zeros((0, len(others))), np.zeros((len(others), 0)),
            np.eye(len(others)), inputs=others, outputs=others,
        )  # fmt: skip
        W = W.replace(inputs=[f"{n}:neglected:w" for n in own], outputs=list(self.neglected_w))
        both = append(plain, W)
        return series(both.select(order, order), self.system).replace(inputs=order)


def uncertain_loop(
    uncertain: UncertainPlant[Any],
    blocks: Sequence[Any],
    *,
    w: Any = (),
    z: Any = (),
) -> UncertainLoop:
    """Return the loop of an uncertain plant with its channels, and some of w and z.

    Raises
    ------
    AssumptionError
        When the loop is not stable on the nominal plant.
    ModelError
        When `uncertain` is no uncertain plant.
    """
    if not isinstance(uncertain, UncertainPlant):
        raise ModelError(
            f"need an UncertainPlant, got {short(uncertain)}. Make it by plant.uncertain(fit)."
        )
    loop = close_loop(uncertain.plant, *blocks)
    if loop.obstacle is not None:
        raise AssumptionError(
            f"the loop is {loop.obstacle.reason} without any uncertainty: there is nothing to be "
            "robust about. Design a controller that stabilises the nominal plant first."
        )
    channels = delta_channels(uncertain)
    controller = loop.controller.select(outputs=loop.driven)
    if loop.plant.dt:
        controller = bilinear(controller, 1.0 / loop.plant.dt)
    into, weights_in = _weighted_names(w, "w")
    out, weights_out = _weighted_names(z, "z")
    g = channels.system
    n_real = sum(size for _, size in channels.deltas)
    neglected = channels.neglected
    ends = [] if neglected is None else list(neglected.outputs)
    starts = [] if neglected is None else list(neglected.inputs)
    if not out:  # stability: what the loop does not see of them has no part in it
        ends = [name for name in ends if name in loop.fed_back]
        starts = [name for name in starts if name in loop.driven]
    w_names = [f"{name}:neglected:w" for name in ends]
    z_names = [f"{name}:neglected:z" for name in starts]
    listed: list[Block] = [
        RepeatedScalar(size, real=True, name=name) for name, size in channels.deltas
    ]
    if w_names and z_names:
        listed.append(FullBlock(len(w_names), len(z_names), name="neglected modes"))
    else:
        w_names, z_names = [], []
    inputs = [*g.inputs[:n_real], *w_names, *into]
    outputs = [*g.outputs[:n_real], *z_names, *out]
    plant = g.select([*outputs, *loop.plant.y], [*inputs, *loop.driven])
    M = lft(plant, controller)
    dt = loop.plant.dt
    before, behind = _checked_weights(weights_in, dt), _checked_weights(weights_out, dt)
    M = _with_weights(M, inputs, outputs, *(_images(part, dt) for part in (before, behind)))
    return UncertainLoop(
        uncertain, loop, channels, M, tuple(listed), tuple(w_names), tuple(z_names), before, behind
    )


def _weighted_names(given: Any, side: str) -> tuple[list[str], dict[str, Any]]:
    """Return the names of channels and their weights."""
    if isinstance(given, Mapping):
        return list(given), dict(given)
    return list(name_list(given, side)), {}


def _checked_weights(given: Mapping[str, Any], dt: float) -> dict[str, StateSpace]:
    """Return weights as systems of the loop's sampling time."""
    found = {}
    for name, weight in given.items():
        one = as_statespace(weight)
        if one.D.shape != (1, 1) or (one.n_states and one.dt != dt):
            raise ModelError(
                f"the weight of {name!r} must have one input, one output and the sampling time "
                f"{dt:g} s of the loop, got {one!r}."
            )
        found[name] = one
    return found


def _images(weights: Mapping[str, StateSpace], dt: float) -> dict[str, StateSpace]:
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
    parts = []
    for name in names:
        one = as_statespace(weights.get(name, 1.0))
        states = [f"{name}:weight:{i}" for i in range(one.n_states)]
        parts.append(one.replace(inputs=[name], outputs=[name], dt=dt, states=states))
    return append(*parts)
