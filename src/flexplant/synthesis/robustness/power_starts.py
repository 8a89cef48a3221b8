"""Power iterations from several starts at once: perturbations with which lower bounds begin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ...plant.uncertainty.delta_blocks import RepeatedScalar
from ...tolerances import MOST_STEPS, TINY, TYPED
from .uncertainty_blocks import Perturbation, Place

#: starts of an iteration; they run at once
STARTS = 4


class _Channels(NamedTuple):
    """The channels of the blocks of one kind in vectors (n, channels) of one side."""

    channels: IntArray
    first: IntArray  # of each block, among these channels
    owner: IntArray  # the block of each channel

    def norms(self, vectors: ComplexArray) -> FloatArray:
        """Return the norm of each block's part."""
        square = np.abs(vectors[:, self.channels]) ** 2
        return np.asarray(np.sqrt(np.add.reduceat(square, self.first, axis=1)))

    def stretched(self, vectors: ComplexArray, size: FloatArray) -> ComplexArray:
        """Return the parts along these vectors, of other sizes."""
        factor = size / np.maximum(self.norms(vectors), TINY)
        return np.asarray(vectors[:, self.channels] * factor[:, self.owner])


def _channels_of(sizes: IntArray, chosen: BoolArray) -> _Channels:
    """Return the parts of chosen blocks."""
    channels = np.flatnonzero(np.repeat(chosen, sizes))
    own = sizes[chosen]
    return _Channels(channels, np.cumsum(own) - own, np.repeat(np.arange(own.size), own))


class _Structure:
    """The parts of scalar and full blocks in w and z, so that one call sums over all of them."""

    def __init__(self, where: Sequence[Place]) -> None:
        scalar = np.array([isinstance(p.block, RepeatedScalar) for p in where], dtype=bool)
        w, z = (np.array([getattr(p.block, side) for p in where]) for side in "wz")
        self.w, self.z = _channels_of(w, scalar), _channels_of(z, scalar)
        self.full_w, self.full_z = _channels_of(w, ~scalar), _channels_of(z, ~scalar)
        kinds = [p.block.real for p in where if isinstance(p.block, RepeatedScalar)]
        self.real: BoolArray = np.array(kinds, dtype=bool)

    def updated(
        self, q: ComplexArray, a: ComplexArray, b: ComplexArray, w: ComplexArray
    ) -> ComplexArray:
        """Return the next numbers of the scalar blocks, of real ones on their interval."""
        if not self.real.size:
            return q
        products = a[:, self.z.channels].conj() * w[:, self.w.channels]
        inner = np.add.reduceat(products, self.z.first, axis=1)
        length = np.abs(inner)
        moved = inner / np.where(length > 0, length, 1.0)
        if self.real.any():
            size = self.w.norms(b) / np.maximum(self.z.norms(a), TINY)
            ends = np.clip(np.where(q.real >= 0, size, -size) + inner.real, -1.0, 1.0)
            moved = np.where(self.real, ends, moved)
        return np.asarray(moved)

    def back(self, q: ComplexArray, a: ComplexArray, w: ComplexArray) -> ComplexArray:
        """Return z vectors: ``conj(q) w`` of scalar blocks, a as long as w of full ones."""
        found = np.empty_like(a)
        found[:, self.z.channels] = q.conj()[:, self.w.owner] * w[:, self.w.channels]
        if self.full_z.first.size:
            found[:, self.full_z.channels] = self.full_z.stretched(a, self.full_w.norms(w))
        return found

    def through(self, q: ComplexArray, a: ComplexArray, w: ComplexArray) -> ComplexArray:
        """Return w vectors: ``q a`` of scalar blocks, w as long as a of full ones."""
        found = np.empty_like(w)
        found[:, self.w.channels] = q[:, self.z.owner] * a[:, self.z.channels]
        if self.full_w.first.size:
            found[:, self.full_w.channels] = self.full_w.stretched(w, self.full_z.norms(a))
        return found


def power_iterations(
    M: ComplexArray,
    where: Sequence[Place],
    rng: np.random.Generator,
    omega: float = 0.0,
    count: int = STARTS,
) -> list[Perturbation]:
    """Return perturbations of size one for which an eigenvalue of ``M Delta`` is large and real.

    The iteration of Young and Doyle for real and complex blocks together. The real Deltas of the
    first half of the starts are positive, those of the others have random signs; they may come out
    inside their interval. It need not converge: its result is judged by its effect. [Young1990]_;
    [PackardDoyle1993]_.
    """
    blocks = _Structure(where)
    drawn = rng.standard_normal((count, 2, 2, M.shape[1]))
    b, w = (_unit(drawn[:, i, 0] + 1j * drawn[:, i, 1]) for i in range(2))
    q = np.ones((count, blocks.real.size), dtype=np.complex128)
    firsts = blocks.w.channels[blocks.w.first]
    half = (count + 1) // 2
    q[half:][blocks.real & (drawn[half:, 0, 0][:, firsts] < 0)] = -1.0
    old, adjoint = b, M.conj()
    on = np.ones(count, dtype=bool)  # starts that have not settled
    kept = [q.copy(), b @ M.T, w.copy()]
    for _ in range(MOST_STEPS):
        a = _unit(b @ M.T)
        q = blocks.updated(q, a, b, w)
        w = _unit(blocks.back(q, a, w) @ adjoint)
        q = blocks.updated(q, a, old, w)
        b = _unit(blocks.through(q, a, w))
        for known, new in zip(kept, (q, a, w), strict=True):
            known[on] = new[on]
        on &= np.linalg.norm(b - old, axis=1) >= TYPED
        if not on.any():
            break
        old = b
    q, a, w = kept
    full = [p for p in where if not isinstance(p.block, RepeatedScalar)]
    return [
        Perturbation(
            tuple(q[k].tolist()),
            tuple((_unit(a[k, None, p.z])[0], _unit(w[k, None, p.w])[0]) for p in full),
            omega,
        )
        for k in range(count)
    ]


def _unit(vectors: ComplexArray) -> ComplexArray:
    """Return rows of size one; a row of zeros becomes the first unit vector."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    if size.all():
        return np.asarray(vectors / size)
    first = np.zeros_like(vectors)
    first[:, 0] = 1.0
    return np.where(size > 0, vectors / np.where(size > 0, size, 1.0), first)
