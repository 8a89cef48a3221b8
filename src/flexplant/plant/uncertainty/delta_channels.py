"""An uncertain plant with the channels of each Delta side by side, sampled or not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray
from ...errors import CertificateError, ModelError
from ...lti.discretisation import bilinear, tustin
from ...lti.equations import state_scale
from ...lti.interconnection import lft
from ...lti.sampling import discretized
from ...lti.statespace import StateSpace
from ...tolerances import TINY, divisor
from .neglected import NeglectedModes, with_neglected
from .opening import system_matrix, with_channels, with_gain_channels
from .uncertain_plant import UncertainPlant

#: directions of a Delta's change below this, relative to the largest, are left out
_RANK = 1e-5
#: relative curvature over a Delta above which another mapping is tried
_CURVED = 0.01
#: relative curvature over a Delta that is taken as that of a fraction, as masses have: affine
#: channels miss the machine by twice this, and are widened by as much
_BENT = 1e-3
#: largest norm of a fraction's feedback: its pole lies well beyond the ends of the Delta
_FEEDBACK = 0.5
#: largest relative distance of the channels from machines at the corners of the uncertainty
_LARGEST = 0.05


class DeltaChannels(NamedTuple):
    """``[z_Delta; neglected; z; y] = G [w_Delta; neglected; w; u]``, continuous.

    Of a sampled plant G is its bilinear image, with the same gains and stability; the weights of
    neglected modes are not in it: `neglected` has them.
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
    plant = uncertain.plant
    if not plant.dt:
        system, sizes = _paired_channels(uncertain)
        return _with_neglected(system, sizes, uncertain.neglected, 0.0)
    system, sizes = _sampled_channels(uncertain)
    distance = _distance(uncertain, system, sizes)
    if distance > _LARGEST:
        raise CertificateError(
            f"sampled machines at the corners of the uncertainty lie {100 * distance:.3g} % off "
            f"the affine channels of their Deltas: {_not_affine(uncertain)}"
        )
    if uncertain.neglected is not None and uncertain.neglected.sampled is None:
        raise ModelError(
            "the bound on neglected modes is of a continuous plant, this one is sampled: pass the "
            "whole model itself, plant.uncertain(fit, neglected=whole)."
        )
    sampled = None if uncertain.neglected is None else uncertain.neglected.sampled
    return _with_neglected(system, sizes, sampled, distance)


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


def _paired_channels(uncertain: UncertainPlant[Any]) -> tuple[StateSpace, list[tuple[str, int]]]:
    """Return the continuous system without weights, each Delta's channels side by side."""
    g, channels, plant = uncertain.system, uncertain.channels, uncertain.plant
    order, sizes = [], []
    for delta in uncertain.deltas:
        own = [channel for channel, name in channels.items() if name == delta.name]
        order += own
        sizes.append((delta.name, len(own)))
    chosen = g.select(
        [*(f"{name}:z" for name in order), *plant.z, *plant.y],
        [*(f"{name}:w" for name in order), *plant.w, *plant.u],
    )
    if uncertain.neglected is None:
        return chosen, sizes
    n = g.n_states - uncertain.neglected.weights.n_states  # the last states are those of weights
    blocks = None
    if g.blocks is not None:
        blocks = list(g.blocks[: int(np.searchsorted(np.cumsum(g.blocks), n, side="right"))])
    return chosen.replace(
        A=g.A[:n, :n], B=chosen.B[:n], C=chosen.C[:, :n], states=g.states[:n], blocks=blocks
    ), sizes


def _with_neglected(
    system: StateSpace,
    sizes: list[tuple[str, int]],
    neglected: NeglectedModes | None,
    distance: float,
) -> DeltaChannels:
    if neglected is None:
        return DeltaChannels(system, tuple(sizes), None, distance)
    names = neglected.outputs
    plain = StateSpace([], [], [], np.eye(len(names)), inputs=names, outputs=names)
    total = sum(size for _, size in sizes)
    whole = with_neglected(system, neglected.replace(weights=plain), total)
    return DeltaChannels(whole, tuple(sizes), neglected, distance)


def sampled_machine(uncertain: UncertainPlant[Any], values: Mapping[str, float]) -> StateSpace:
    """Return the sampled [w; u] -> [z; y] at some values of the Deltas, its states comparable."""
    plant = uncertain.plant
    if not uncertain.of_matrices:
        exact: StateSpace = uncertain.lft(values).system
        return exact
    if plant.assembled.ports.latencies:
        raise ModelError(
            "Deltas on the parameters of a fit are sampled with one delay for all actuators, and "
            "the ports of this plant have delays of their own. Model these by filters."
        )
    g, sizes = _paired_channels(uncertain)
    amounts = np.concatenate([[values.get(name, 0.0)] * size for name, size in sizes])
    late = plant.delay + sum(
        delta.scale * values.get(delta.name, 0.0)
        for delta in uncertain.deltas
        if delta.kind == "delay"
    )
    return discretized(_at_values(g, amounts), 1.0 / plant.dt, delay=late, delayed=plant.u)


def _at_values(g: StateSpace, amounts: FloatArray) -> StateSpace:
    """Return the system at some values (k,) of the Deltas, its first k channels."""
    k = amounts.size
    block = StateSpace([], [], [], np.diag(amounts), inputs=g.outputs[:k], outputs=g.inputs[:k])
    return lft(g, block)


class _Change(NamedTuple):
    """Half the difference of the machines at both ends of a Delta, and of it what is curved."""

    matrix: FloatArray
    bend: FloatArray

    @property
    def curved(self) -> float:
        """Size of what is curved, relative to the difference of the ends."""
        return float(0.5 * la.norm(self.bend) / la.norm(self.matrix))


class _Part(NamedTuple):
    """Channels of a Delta: ``delta L (1 - delta F)^-1 R`` is its change of [A B; C D]."""

    name: str
    left: FloatArray
    right: FloatArray
    feed: FloatArray


def _sampled_channels(uncertain: UncertainPlant[Any]) -> tuple[StateSpace, list[tuple[str, int]]]:
    """Return the bilinear image with channels, and the number of each Delta's."""
    rate = 1.0 / uncertain.plant.dt
    gains = [delta for delta in uncertain.deltas if delta.kind == "gain"]
    deltas = [delta for delta in uncertain.deltas if delta.kind != "gain"]
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
                "number of samples, where what it does is not affine in it, so that no Delta "
                "expresses it. Bound it on each side (1.1 +- 0.1 beside 0.9 +- 0.1), or draw "
                "machines: uncertain.sample(rng, n)."
            )
    slow = bilinear(base, rate)
    direct, mapped = _EvenUnits.of(base), _EvenUnits.of(slow)
    found: dict[str, tuple[_Change, _Change]] = {}
    for delta in deltas:
        ends = [machines[delta.name, end] for end in (1.0, -1.0)]
        images = [bilinear(g, rate) for g in ends]
        found[delta.name] = direct.change(base, *ends), mapped.change(slow, *images)
    # a mode near half the rate, which the bilinear map sends far away, is affine in z instead
    far = {
        delta.mode
        for delta in deltas
        if found[delta.name][1].curved > max(_CURVED, found[delta.name][0].curved)
    }
    sides: tuple[list[_Part], list[_Part]] = ([], [])
    for delta in deltas:
        side = 0 if delta.mode in far else 1
        sides[side].append((direct, mapped)[side].part(delta.name, found[delta.name][side]))
    opened_z = bilinear(_with_channels(base, sides[0]), rate)
    sizes = [(part.name, len(part.right)) for side in sides for part in side]
    system = _with_channels(slow, sides[1], opened_z)
    system, first = with_gain_channels(uncertain.plant, system, gains)
    return system, [*first, *sizes]


class _EvenUnits(NamedTuple):
    """Factors of the rows of [A B; C D] and of its columns that even out their sizes."""

    row: FloatArray
    column: FloatArray

    @classmethod
    def of(cls, g: StateSpace) -> _EvenUnits:
        d = state_scale(g.A, g.B, g.C)
        size = max(float(np.linalg.norm(g.A * d / d[:, None], 2)), TINY)
        into = np.abs(g.B / d[:, None]).max(axis=0, initial=0.0)
        out = np.abs(g.C * d).max(axis=1, initial=0.0)
        into, out = (divisor(part) for part in (into, out))
        return cls(np.concatenate([1.0 / d, size / out]), np.concatenate([d, size / into]))

    def scaled(self, g: StateSpace) -> FloatArray:
        return np.asarray(self.row[:, None] * system_matrix(g) * self.column)

    def change(self, base: StateSpace, plus: StateSpace, minus: StateSpace) -> _Change:
        up, down = self.scaled(plus) - self.scaled(base), self.scaled(minus) - self.scaled(base)
        return _Change(0.5 * (up - down), 0.5 * (up + down))

    def part(self, name: str, change: _Change) -> _Part:
        """Return the channels of a Delta, widened by what is curved and no fraction."""
        # half the difference of the ends is `L (1 - F^2)^-1 R`, half their sum, which is zero of
        # what is affine, `L F (1 - F^2)^-1 R`
        left, values, right = la.svd(change.matrix, full_matrices=False)
        rank = int(np.count_nonzero(values > _RANK * values[0]))
        left, right, root = left[:, :rank], right[:rank], np.sqrt(values[:rank])
        feed = np.zeros((rank, rank))
        bend = change.bend
        if change.curved > _BENT:
            core = left.T @ bend @ right.T
            fraction = core / np.outer(root, root)
            if la.norm(fraction, 2) < _FEEDBACK:
                feed, bend = fraction, bend - left @ core @ right
        width = np.sqrt(1.0 + 2.0 * change._replace(bend=bend).curved)
        seen = (np.eye(rank) - feed @ feed) @ (root[:, None] * right)
        left, right = left * root / self.row[:, None], seen / self.column
        return _Part(name, width * left, width * right, feed)


def _with_channels(
    g: StateSpace, parts: Sequence[_Part], opened: StateSpace | None = None
) -> StateSpace:
    """Return g with channels of Deltas before its own, after those that `opened` has already."""
    other = g if opened is None else opened
    n, before = g.n_states, len(other.inputs) - len(g.inputs)
    names = [f"{part.name}:{i}" for part in parts for i in range(1, len(part.right) + 1)]
    left = np.hstack([np.zeros((n + len(g.outputs), 0)), *(part.left for part in parts)])
    right = np.vstack([np.zeros((0, n + len(g.inputs))), *(part.right for part in parts)])
    right = np.insert(right, [n] * before, 0.0, axis=1)
    feed = la.block_diag(np.zeros((0, 0)), *(part.feed for part in parts))
    return with_channels(other, before, names, left, right, feed)


def _distance(
    uncertain: UncertainPlant[Any], system: StateSpace, sizes: list[tuple[str, int]]
) -> float:
    """Return how far sampled machines at corners are from the channels, relative to their change.

    In z, where no frequency counts more than another. Gains are exact, and left at 0 here: their
    channels act on commands, those of a machine behind the delay, so that states differ.
    """
    gains = {delta.name for delta in uncertain.deltas if delta.kind == "gain"}
    if len(gains) == len(sizes):
        return 0.0
    base = sampled_machine(uncertain, {})
    units = _EvenUnits.of(base)
    found = 0.0
    even = np.array([0.0 if name in gains else 1.0 for name, _ in sizes])
    for corner in even * np.random.default_rng(0).choice([-1.0, 1.0], (4, len(sizes))):
        values = dict(zip([name for name, _ in sizes], corner.tolist(), strict=True))
        exact = units.scaled(sampled_machine(uncertain, values))
        amounts = np.repeat(corner, [size for _, size in sizes])
        closed = units.scaled(tustin(_at_values(system, amounts), 1.0 / base.dt))
        found = max(found, float(la.norm(exact - closed) / la.norm(exact - units.scaled(base))))
    return found
