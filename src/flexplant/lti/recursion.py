"""A sampled system over a record: in blocks of samples, by products of matrices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..values import FloatArray

#: samples in a block; a block costs 2 _BLOCK^2 p m operations, a state 4 n^2 for each block
_BLOCK = 8


class Recursion(NamedTuple):
    """``x[k+1] = F x[k] + G v[k], out[k] = H x[k] + J v[k]``."""

    F: FloatArray
    G: FloatArray
    H: FloatArray
    J: FloatArray

    def run(self, v: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) for inputs (N, m) and a first state (n,), and the last state.

        With ``F^i`` and the Markov parameters over a block of b samples,
        ``out = O x + T v`` and ``x[k+b] = F^b x[k] + R v`` are products of large matrices. The
        states at the starts of blocks are found in chains of blocks side by side from zero, then
        the starts of the chains one after the other.
        """
        count, (p, m) = v.shape[0], self.J.shape
        n = self.F.shape[0]
        blocks = count // _BLOCK
        out = np.empty((count, p))
        if not blocks:
            return self._plain(v, start, out)
        whole = blocks * _BLOCK
        enter, see, step = self._block()
        inputs = np.ascontiguousarray(v[:whole]).reshape(blocks, _BLOCK * m)
        states = _states(step, inputs @ enter.T, start)
        joined = out[:whole].reshape(blocks, _BLOCK * p)
        np.matmul(inputs, self._toeplitz().T, out=joined)
        joined += states[:-1] @ see.reshape(_BLOCK * p, n).T
        _, last = self._plain(v[whole:], states[-1], out[whole:])
        return out, last

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
    x = np.zeros((count + 1, n))
    x[0] = start
    if chains > 1:
        parts = entering[:whole].reshape(chains, length, n)
        own = np.empty((length + 1, chains, n))
        own[0] = 0.0
        for i in range(length):
            np.matmul(own[i], step.T, out=own[i + 1])
            own[i + 1] += parts[:, i]
        powers = [np.eye(n)]
        for _ in range(length):
            powers.append(step @ powers[-1])
        first = np.empty((chains + 1, n))
        first[0] = start
        for j in range(chains):
            first[j + 1] = powers[length] @ first[j] + own[length, j]
        moved = first[:-1] @ np.vstack(powers[:length]).T
        x[:whole] = (moved.reshape(chains, length, n) + own[:length].transpose(1, 0, 2)).reshape(
            whole, n
        )
        x[whole] = first[-1]
    else:
        whole = 0
    for j in range(whole, count):
        x[j + 1] = step @ x[j] + entering[j]
    return x
