"""The bilinear map (Tustin) between sampled and continuous time; a sampled system over a record."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, between, positive
from ..errors import ModelError
from ..parallel import PIECE
from ..tolerances import ROUNDING
from .blocks_of_states import bilinear_matrices, trapezoidal
from .statespace import StateSpace, System, as_statespace


def tustin(sys: System, rate: float, *, prewarp: float | None = None) -> StateSpace:
    """Return the bilinear (Tustin) equivalent of a filter at a rate.

    ``s = a (z - 1) / (z + 1)`` with a = 2 rate, or a = w / tan(w / (2 rate)) so that the response
    at one frequency w is kept exactly.

    Parameters
    ----------
    sys : StateSpace
        A continuous system: a weight or a controller; for a plant use `discretized`.
    rate : float [Hz]
        Sampling rate.
    prewarp : float [Hz], optional
        The frequency at which the response is kept.

    Returns
    -------
    StateSpace
        System with dt = 1 / rate and the same names.

    Raises
    ------
    ModelError
        When `sys` is sampled already, prewarp is not below half the rate, or a pole lies at a.

    References
    ----------
    [Franklin1998]_, section 6.1.

    Examples
    --------
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([1.0], [1.0, 1.0])
    >>> fx.lti.tustin(lag, 10.0).poles().real.round(6)  # (20 - 1) / (20 + 1)
    array([0.904762])
    """
    g = as_statespace(sys)
    if g.dt and g.n_states:
        raise ModelError(f"{g!r} is sampled already. Pass the continuous system.")
    a = 2.0 * positive(rate, "rate")
    if prewarp is not None:
        why = "It is in Hz, below half the rate."
        w = 2.0 * np.pi * between(prewarp, "prewarp", 0.0, 0.5 * rate, why)
        a = w / np.tan(w / a)
    if _has_pole_at(a, g.A):
        raise ModelError(f"{g!r} has a pole at {a:g} rad/s, which Tustin maps to infinity.")
    A, B, C, D = trapezoidal((g.A, g.B, g.C, g.D), a)
    return g.replace(A=A, B=B, C=C, D=D, dt=1.0 / rate)


def _has_pole_at(place: float, A: FloatArray) -> bool:
    """Return whether an eigenvalue lies there; a condition number would depend on units."""
    distance = np.abs(np.linalg.eigvals(A) - place)
    return bool(np.min(distance, initial=np.inf) <= ROUNDING * abs(place))


def image_freq(omega: Any, dt: float) -> Any:
    """Return the frequencies [Hz] that belong to those of the bilinear image [rad/s]."""
    return np.arctan(0.5 * dt * omega) / (np.pi * dt) if dt else omega / (2.0 * np.pi)


def bilinear(sys: System, rate: float) -> StateSpace:
    """Return the continuous system that `tustin` would sample to this one."""
    # z = (a + s) / (a - s), a = 2 rate: stability and norms are kept; w = a tan(theta / 2)
    g = as_statespace(sys)
    a = 2.0 * positive(rate, "rate")
    if _has_pole_at(-1.0, g.A):
        raise ModelError(f"{g!r} has a pole at z = -1, which the bilinear map sends to infinity.")
    A, B, C, D = bilinear_matrices((g.A, g.B, g.C, g.D), a)
    return g.replace(A=A, B=B, C=C, D=D, dt=0.0, blocks=None)


#: sizes of a block [samples]
_SIZES = [2**k for k in range(8)]
#: cost of an operation with a single vector, and of a call, relative to an operation in a matrix
#: product
ONE_VECTOR, CALL = 3.0, 3e4


def cheapest(n: int, p: int, m: int, samples: int) -> tuple[int, float]:
    """Return the cheapest size of a block, and its number of operations per sample."""

    # n states, p outputs, m inputs; the preparation is shared by a number of samples
    def cost(size: int) -> float:
        prepare = 2 * size * n * n * (m + p) + 2 * np.log2(size) * n**3 + size**2 * n * p * m
        step = (2 * ONE_VECTOR * n * n + CALL) / size
        return float(step + 2 * n * (m + p) + (size + 1) * p * m + prepare / max(samples, 1))

    size = min(_SIZES, key=cost)
    return size, cost(size)


class Recursion(NamedTuple):
    """``x[k+1] = F x[k] + G v[k], out[k] = H x[k] + J v[k]``."""

    F: FloatArray
    G: FloatArray
    H: FloatArray
    J: FloatArray

    def run(self, v: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) for inputs (N, m) from a first state (n,), and the last one."""
        out, x = np.empty((v.shape[0], self.J.shape[0])), start
        for piece, part, after in self.pieces(v, start):
            out[piece], x = part, after
        return out, x

    def pieces(
        self, v: FloatArray, start: FloatArray
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield samples, their outputs (k, p) and the state after them, piece by piece."""
        x, blocks = start, self.in_blocks(self.best_size(v.shape[0]))
        whole = v.shape[0] // blocks.size * blocks.size
        for first in range(0, whole, PIECE):
            piece = slice(first, min(first + PIECE, whole))
            out, x = blocks.run(v[piece], x)
            yield piece, out, x
        if whole < v.shape[0]:
            rest, x = self.sample_by_sample(v[whole:], x)
            yield slice(whole, v.shape[0]), rest, x

    def sample_by_sample(self, v: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) and the last state, as the equations are written."""
        out = np.empty((v.shape[0], self.J.shape[0]))
        for k in range(v.shape[0]):
            out[k] = self.H @ x + self.J @ v[k]
            x = self.F @ x + self.G @ v[k]
        return out, x

    def best_size(self, samples: int) -> int:
        """Return the size of a block that costs least for a record of this length."""
        p, m = self.J.shape
        return cheapest(self.F.shape[0], p, m, samples)[0]

    def in_blocks(self, size: int) -> Blocks:
        """Return the matrices of a block of a number of samples, a power of two."""
        # with rows: x+ = x F' + v G'. what the first half of a block does to the second passes
        # through the state between them
        step, enter, see = (np.ascontiguousarray(part.T) for part in (self.F, self.G, self.H))
        direct, done = [np.ascontiguousarray(self.J.T)], 1
        while done < size:
            direct.append(enter @ see)
            enter, see = np.vstack([enter @ step, enter]), np.hstack([see, step @ see])
            step, done = step @ step, 2 * done
        return Blocks(step, enter, see, direct, size)


class Blocks(NamedTuple):
    """``x[k+b] = x[k] step + v enter``, ``out = x see + v direct``, rows v and out of b samples.

    `direct` of a sample acts on itself, and then of 1, 2, 4, ... samples on as many that follow.
    """

    step: FloatArray
    enter: FloatArray
    see: FloatArray
    direct: list[FloatArray]
    size: int

    def run(self, v: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) for inputs (N, m) from a state (n,), and the last state."""
        # N is a whole number of blocks. everything except `x step` is a product of two matrices
        count = v.shape[0] // self.size
        v = np.ascontiguousarray(v)
        states = np.empty((count + 1, x.size))
        states[0] = x
        np.matmul(v.reshape(count, -1), self.enter, out=states[1:])
        moved = np.empty(x.size)
        for now, following in pairwise(states):
            np.dot(now, self.step, out=moved)
            following += moved
        out = v @ self.direct[0]
        for k, later in enumerate(self.direct[1:], 1):
            first, second = ((len(v) >> k, 2, size) for size in later.shape)
            out.reshape(second)[:, 1] += v.reshape(first)[:, 0] @ later
        by_block = out.reshape(count, -1)
        by_block += states[:-1] @ self.see
        return out, states[-1]
