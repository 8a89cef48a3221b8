"""A sampled system over a record: in blocks of samples, by products of matrices."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..values import FloatArray

#: samples in a block; a block costs 2 _BLOCK^2 p m operations, a state 4 n^2 for each block
_BLOCK = 8
#: samples in a piece, whose arrays stay in the cache
_PIECE = 4096


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
        """Yield samples, their outputs (k, p) and the state after them, piece by piece.

        With ``F^i`` and the Markov parameters over a block of b samples,
        ``out = O x + T v`` and ``x[k+b] = F^b x[k] + R v`` are products of large matrices. The
        states at the starts of blocks are found in chains of blocks side by side from zero, then
        the starts of the chains one after the other. A piece fits into the cache.
        """
        p, m = self.J.shape
        n, x = self.F.shape[0], start
        enter, see, step = self._block()
        see, toeplitz = see.reshape(_BLOCK * p, n).T, self._toeplitz().T
        whole = v.shape[0] // _BLOCK * _BLOCK
        for first in range(0, whole, _PIECE):
            piece = slice(first, min(first + _PIECE, whole))
            inputs = np.ascontiguousarray(v[piece]).reshape(-1, _BLOCK * m)
            states = _states(step, inputs @ enter.T, x)
            out = inputs @ toeplitz
            out += states[:-1] @ see
            x = states[-1]
            yield piece, out.reshape(-1, p), x
        if whole < v.shape[0]:
            rest, x = self._plain(v[whole:], x, np.empty((v.shape[0] - whole, p)))
            yield slice(whole, v.shape[0]), rest, x

    def _plain(
        self, v: FloatArray, x: FloatArray, out: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        for k in range(v.shape[0]):
            out[k] = self.H @ x + self.J @ v[k]
            x = self.F @ x + self.G @ v[k]
        return out, x

    def _block(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return R (n, b m), O (b, p, n) and F^b of a block."""
        see, enter = [self.H], [self.G]
        for _ in range(_BLOCK - 1):
            see.append(see[-1] @ self.F)
            enter.append(self.F @ enter[-1])
        return np.hstack(enter[::-1]), np.array(see), np.linalg.matrix_power(self.F, _BLOCK)

    def _toeplitz(self) -> FloatArray:
        """Return T (b p, b m), the answers of a block's outputs to its inputs."""
        p, m = self.J.shape
        T = np.zeros((_BLOCK, p, _BLOCK, m))
        part, moved = self.J, self.G
        for age in range(_BLOCK):
            for i in range(age, _BLOCK):
                T[i, :, i - age] = part
            part, moved = self.H @ moved, self.F @ moved
        return T.reshape(_BLOCK * p, _BLOCK * m)


def _states(step: FloatArray, entering: FloatArray, start: FloatArray) -> FloatArray:
    """Return x (J + 1, n) of ``x[j+1] = step x[j] + entering[j]``."""
    count, n = entering.shape
    length = max(int(np.sqrt(count)), 1)
    chains = count // length
    whole = chains * length
    x = np.empty((count + 1, n))
    x[0] = start
    if chains > 1:
        parts = entering[:whole].reshape(chains, length, n)
        own = np.zeros((chains, n))
        for i in range(length):  # the end of each chain when it starts from zero
            own = own @ step.T + parts[:, i]
        jump = np.linalg.matrix_power(step, length)
        first = np.empty((chains, n))
        first[0] = start
        for j in range(chains - 1):
            first[j + 1] = jump @ first[j] + own[j]
        inside = x[:whole].reshape(chains, length, n)
        inside[:, 0] = first
        for i in range(1, length):
            inside[:, i] = inside[:, i - 1] @ step.T + parts[:, i - 1]
        x[whole] = step @ x[whole - 1] + entering[whole - 1]
    else:
        whole = 0
    for j in range(whole, count):
        x[j + 1] = step @ x[j] + entering[j]
    return x
