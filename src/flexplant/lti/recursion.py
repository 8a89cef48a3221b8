"""A sampled system over a record: in blocks of samples, by products of matrices."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..checks import FloatArray

#: samples in a piece, whose arrays stay in the cache; a whole number of blocks of any size
PIECE = 4096
#: sizes of a block [samples]
_SIZES = (1, 2, 4, 8, 16, 32, 64, 128)
#: in operations of a product of two matrices: one of a product with a single vector, and a call
ONE_VECTOR, CALL = 3.0, 3e4


def cheapest(n: int, p: int, m: int, samples: int) -> tuple[int, float]:
    """Return the size of a block that costs least, and the operations that a sample then takes."""

    # n states, p outputs, m inputs; the preparation is shared by so many samples
    def cost(size: int) -> float:
        prepare = 2 * size * n * n * (m + p) + 4 * np.log2(size) * n**3
        step = (2 * ONE_VECTOR * n * n + CALL) / size
        return float(step + 2 * n * (m + p) + 2 * size * p * m + prepare / max(samples, 1))

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
        """Return the size of a block that costs least for a record of so many samples."""
        p, m = self.J.shape
        return cheapest(self.F.shape[0], p, m, samples)[0]

    def in_blocks(self, size: int) -> Blocks:
        """Return the matrices of a block of so many samples."""
        # out = O x + T v and x[k+b] = F^b x[k] + R v: observability, reachability, Toeplitz of
        # Markov
        b, n, (p, m) = size, self.F.shape[0], self.J.shape
        see, enter = np.empty((b, p, n)), np.empty((b, n, m))
        see[0], enter[b - 1] = self.H, self.G
        power, done = self.F, 1
        while done < b:  # twice as many each time, by one product each
            more = min(done, b - done)
            see[done : done + more] = see[:more] @ power
            enter[b - done - more : b - done] = power @ enter[b - more :]
            done += more
            power = power @ power if done < b else power
        T = np.zeros((b, p, b, m))
        late = self.H @ enter  # the Markov parameters, the oldest first
        for i in range(b):
            T[i, :, i] = self.J
            T[i, :, :i] = np.moveaxis(late[b - i :], 0, 1)
        return Blocks(
            np.linalg.matrix_power(self.F, b),
            np.ascontiguousarray(np.moveaxis(enter, 1, 2).reshape(b * m, n)),
            np.ascontiguousarray(see.reshape(b * p, n).T),
            np.ascontiguousarray(T.reshape(b * p, b * m).T),
            b,
        )


class Blocks(NamedTuple):
    """``x[k+b] = step x[k] + v enter``, ``out = x see + v direct``, rows v and out of b samples."""

    step: FloatArray
    enter: FloatArray
    see: FloatArray
    direct: FloatArray
    size: int

    def run(self, v: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) for inputs (N, m) from a state (n,), and the last state.

        N is a whole number of blocks. All is a product of two matrices but ``step x``.
        """
        count = v.shape[0] // self.size
        inputs = np.ascontiguousarray(v).reshape(count, -1)
        states = np.empty((count + 1, x.size))
        states[0] = x
        np.matmul(inputs, self.enter, out=states[1:])
        moved = np.empty(x.size)
        for now, following in pairwise(states):
            np.dot(self.step, now, out=moved)
            following += moved
        out = inputs @ self.direct
        out += states[:-1] @ self.see
        return out.reshape(count * self.size, -1), states[-1]
