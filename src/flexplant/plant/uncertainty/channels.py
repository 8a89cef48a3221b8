"""Channels `name:w`, `name:z` of a system, by which Deltas change it: ``w = delta z``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, divisor
from ...lti.equations import state_scale
from ...lti.interconnection import lft
from ...lti.statespace import StateSpace
from ...tolerances import NEGLIGIBLE, ROUNDING, TINY, TYPED

#: largest norm of a fraction's feedback: its pole lies well beyond the ends of the Delta
_FEEDBACK = 0.5


class Opened(NamedTuple):
    """A system with the channels of Deltas before its own, those of each Delta side by side."""

    system: StateSpace
    #: name and number of channels of each Delta, in order
    sizes: tuple[tuple[str, int], ...] = ()

    @property
    def width(self) -> int:
        """Number of channels."""
        return sum(size for _, size in self.sizes)

    def amounts(self, values: Mapping[str, float]) -> FloatArray:
        """Return the value of each channel (k,), from those of the Deltas; 0 of others."""
        return np.concatenate([np.zeros(0), *([values.get(n, 0.0)] * k for n, k in self.sizes)])

    def closed(self, values: Mapping[str, float]) -> StateSpace:
        """Return the system at some values of the Deltas."""
        g, k = self.system, self.width
        amounts = np.diag(self.amounts(values))
        return lft(g, StateSpace([], [], [], amounts, inputs=g.outputs[:k], outputs=g.inputs[:k]))


class DeltaChannel(NamedTuple):
    """A channel of a Delta: what it moves (n + p,), and what it reads of states and inputs.

    By `rate`, of the states' rates (n,) instead, with what all Deltas make of them.
    """

    left: FloatArray
    right: FloatArray
    name: str = ""
    rate: FloatArray | None = None


class DeltaPart(NamedTuple):
    """Channels of a Delta: ``delta L (1 - delta F)^-1 R`` is its change of [A B; C D]."""

    name: str
    left: FloatArray
    right: FloatArray
    feed: FloatArray


def system_matrix(g: StateSpace) -> FloatArray:
    """Return ``[A B; C D]``."""
    return np.block([[g.A, g.B], [g.C, g.D]])


def with_channels(
    g: StateSpace,
    before: int,
    names: Sequence[str],
    left: FloatArray,
    right: FloatArray,
    feed: FloatArray | None = None,
) -> StateSpace:
    """Return a system with channels `name:w` and `name:z` after its first inputs and outputs."""
    # left (n + p, k): what w adds to states and later outputs; right (k, n + m): what z reads of
    # states and all inputs; feed (k, k): from w to z, zero when not given
    n, k = g.n_states, len(names)
    feed = np.zeros((k, k)) if feed is None else feed
    D = np.block([
        [g.D[:before, :before], np.zeros((before, k)), g.D[:before, before:]],
        [right[:, n : n + before], feed, right[:, n + before :]],
        [g.D[before:, :before], left[n:], g.D[before:, before:]],
    ])  # fmt: skip
    return StateSpace(
        g.A,
        np.hstack([g.B[:, :before], left[:n], g.B[:, before:]]),
        np.vstack([g.C[:before], right[:, :n], g.C[before:]]),
        D,
        g.dt,
        inputs=[*g.inputs[:before], *(f"{name}:w" for name in names), *g.inputs[before:]],
        outputs=[*g.outputs[:before], *(f"{name}:z" for name in names), *g.outputs[before:]],
        states=g.states,
        name=g.name,
        blocks=g.blocks,
    )


def with_each(opened: Opened, found: Sequence[tuple[str, float, Sequence[DeltaChannel]]]) -> Opened:
    """Return a system with the channels of Deltas, given by name and scale, after those it has."""
    g, before = opened.system, opened.width
    n, m = g.n_states, len(g.inputs) - before
    every = [(name, np.sqrt(scale), one) for name, scale, own in found for one in own]
    left = np.array([size * one.left for _, size, one in every]).T
    right, feed = np.zeros((len(every), n + before + m)), np.zeros((len(every), len(every)))
    rates = np.hstack([g.A, g.B])
    for i, (_, size, one) in enumerate(every):
        if one.rate is None:
            right[i] = size * np.insert(one.right, [n] * before, 0.0)
        else:
            right[i], feed[i] = size * one.rate @ rates, size * one.rate @ left[:n]
    names = [f"{name}{one.name}" for name, _, one in every]
    sizes = tuple((name, len(own)) for name, _, own in found)
    return Opened(with_channels(g, before, names, left, right, feed), (*opened.sizes, *sizes))


def with_parts(opened: Opened, parts: Sequence[DeltaPart]) -> Opened:
    """Return a system with channels that are given by both ends, after those it has already."""
    g, before = opened.system, opened.width
    n, p, m = g.n_states, len(g.outputs) - before, len(g.inputs) - before
    names = [f"{part.name}:{i}" for part in parts for i in range(1, len(part.right) + 1)]
    left = np.hstack([np.zeros((n + p, 0)), *(part.left for part in parts)])
    right = np.vstack([np.zeros((0, n + m)), *(part.right for part in parts)])
    feed = la.block_diag(np.zeros((0, 0)), *(part.feed for part in parts))
    right = np.insert(right, [n] * before, 0.0, axis=1)
    sizes = tuple((part.name, len(part.right)) for part in parts)
    return Opened(with_channels(g, before, names, left, right, feed), (*opened.sizes, *sizes))


class Change(NamedTuple):
    """Half the difference of the machines at both ends of a Delta, and of it what is curved."""

    matrix: FloatArray
    bend: FloatArray

    @property
    def curved(self) -> float:
        """Size of what is curved, relative to the difference of the ends."""
        return float(0.5 * la.norm(self.bend) / max(float(la.norm(self.matrix)), TINY))


class EvenUnits(NamedTuple):
    """Factors of the rows of [A B; C D] and of its columns that even out their sizes."""

    row: FloatArray
    column: FloatArray

    @classmethod
    def of(cls, g: StateSpace) -> EvenUnits:
        """Return those of a system."""
        d = state_scale(g.A, g.B, g.C)
        size = max(float(np.linalg.norm(g.A * d / d[:, None], 2)), TINY)
        into = np.abs(g.B / d[:, None]).max(axis=0, initial=0.0)
        out = np.abs(g.C * d).max(axis=1, initial=0.0)
        into, out = (divisor(part) for part in (into, out))
        return cls(np.concatenate([1.0 / d, size / out]), np.concatenate([d, size / into]))

    def scaled(self, g: StateSpace) -> FloatArray:
        """Return [A B; C D] with even sizes."""
        return np.asarray(self.row[:, None] * system_matrix(g) * self.column)

    def change(self, base: StateSpace, plus: StateSpace, minus: StateSpace) -> Change:
        """Return how a system changes between both ends of a Delta."""
        up, down = self.scaled(plus) - self.scaled(base), self.scaled(minus) - self.scaled(base)
        return Change(0.5 * (up - down), 0.5 * (up + down))

    def part(self, name: str, change: Change) -> DeltaPart:
        """Return the channels of a Delta, widened by what is curved and no fraction."""
        # half the difference of the ends is `L (1 - F^2)^-1 R`, half their sum, which is zero of
        # what is affine, `L F (1 - F^2)^-1 R`
        left, values, right = la.svd(change.matrix, full_matrices=False)
        rank = int(np.count_nonzero(values > TYPED * values[0]))
        left, right, root = left[:, :rank], right[:rank], np.sqrt(values[:rank])
        feed = np.zeros((rank, rank))
        bend = change.bend
        if change.curved > NEGLIGIBLE:
            core = left.T @ bend @ right.T
            fraction = core / np.outer(root, root)
            if la.norm(fraction, 2) < _FEEDBACK:
                feed, bend = fraction, bend - left @ core @ right
        width = np.sqrt(1.0 + 2.0 * change._replace(bend=bend).curved)
        seen = (np.eye(rank) - feed @ feed) @ (root[:, None] * right)
        left, right = left * root / self.row[:, None], seen / self.column
        return DeltaPart(name, width * left, width * right, feed)


def missed(
    opened: Opened, base: StateSpace, wanted: StateSpace, values: Mapping[str, float]
) -> str:
    """Return a state or output that the channels miss on a machine at some values, or nothing."""
    made, own, new = (system_matrix(g) for g in (opened.closed(values), base, wanted))
    # of the change six digits, where rounding of the whole leaves them
    allowed = TYPED * np.abs(new - own).max(axis=1) + ROUNDING * np.abs(new).max(axis=1)
    bad = np.flatnonzero(np.abs(made - new).max(axis=1) > allowed)
    return (*base.states, *base.outputs)[int(bad[0])] if bad.size else ""
