"""The exponential of a structure between the filters of its ports, pair by pair if it can."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..lti.discretisation import acting, block_diagonal, pair_expm
from ..lti.noise import accumulated_noise
from ..values import FloatArray


class Flow:
    """``e^(A t)`` of a block upper triangular A: head (sensors), modes, tail (amplifiers, inputs).

    The modes are 2 x 2 blocks that do not see each other, so e^(A t) is a sum over them of
    exponentials of the size of head, pair and tail: O(n) for n modes instead of O(n^3), and the
    modes' own blocks in closed form, rigid-body ones exact.
    """

    def __init__(self, A: FloatArray, head: int, pairs: FloatArray) -> None:
        b, n = pairs.shape[0], A.shape[0]
        self.A, self.pairs, self.n = A, pairs, n
        self.head, self.modes, self.tail = (
            slice(0, head),
            slice(head, head + 2 * b),
            slice(head + 2 * b, n),
        )
        h, t = head, n - head - 2 * b
        self.h, self.t, self.b = h, t, b
        # coupling no larger than the rates: large units would make expm square too often
        rate = max(float(np.abs(A[self.modes, self.modes]).max(initial=0.0)), 1e-300)
        self.up = rate / max(float(np.abs(A[self.head, self.modes]).max(initial=0.0)), rate)
        self.down = rate / max(
            float(np.abs(A[self.modes, self.tail]).max(initial=0.0)),
            float(np.abs(A[self.head, self.tail]).max(initial=0.0)) * self.up,
            rate,
        )
        self.direct = np.zeros((h + t, h + t))
        self.direct[:h, :h], self.direct[h:, h:] = A[self.head, self.head], A[self.tail, self.tail]
        self.direct[:h, h:] = A[self.head, self.tail] * (self.up * self.down)
        self.small = np.zeros((b, h + 2 + t, h + 2 + t))
        self.small[:, :h, :h] = A[self.head, self.head]
        self.small[:, h + 2 :, h + 2 :] = A[self.tail, self.tail]
        self.small[:, h : h + 2, h : h + 2] = pairs
        seen = A[self.head, self.modes].reshape(h, b, 2).transpose(1, 0, 2)
        driven = A[self.modes, self.tail].reshape(b, 2, t)
        self.small[:, :h, h : h + 2] = seen * self.up
        self.small[:, h : h + 2, h + 2 :] = driven * self.down
        #: modes that see each other: no sum over pairs, the exponential of the whole
        self.coupled = np.count_nonzero(A[self.modes, self.modes]) > np.count_nonzero(pairs)
        size = np.ones(n)
        size[self.head], size[self.tail] = self.up, 1.0 / self.down
        self.size = size
        self.whole = size[:, None] * A / size
        self.rate = float(np.linalg.norm(self.whole, 1)) if n else 0.0
        if self.coupled:
            self.reached = acting(A != 0)

    def at(self, time: float) -> FloatArray:
        """Return ``e^(A time)`` (n, n)."""
        if self.coupled:
            E = np.where(self.reached, la.expm(self.whole * time), 0.0)
            return np.asarray(E / self.size[:, None] * self.size)
        E = np.zeros((self.n, self.n))
        b, h = self.b, self.h
        E[self.modes, self.modes] = block_diagonal(pair_expm(self.pairs, time))
        if not h + self.t:
            return E
        direct = la.expm(self.direct * time)
        parts = np.asarray(la.expm(self.small * time)) if b else self.small
        E[self.head, self.head], E[self.tail, self.tail] = direct[:h, :h], direct[h:, h:]
        through = direct[:h, h:] + parts[:, :h, h + 2 :].sum(axis=0)
        E[self.head, self.tail] = through / (self.up * self.down)
        E[self.head, self.modes] = (
            parts[:, :h, h : h + 2].transpose(1, 0, 2).reshape(h, 2 * b) / self.up
        )
        E[self.modes, self.tail] = parts[:, h : h + 2, h + 2 :].reshape(2 * b, self.t) / self.down
        return E

    def noise(self, force: FloatArray, time: float) -> FloatArray:
        """Return G (n, r) with ``G G' = int_0^time e^(A s) force force' e^(A' s) ds``."""
        return accumulated_noise(self.at, force, time, self.rate)


class HeldFlow:
    """``e^(A t)`` and ``int_0^t e^(A s) ds B``: held inputs are states that stand still."""

    def __init__(self, A: FloatArray, B: FloatArray, head: int, pairs: FloatArray) -> None:
        n, m = B.shape
        self.n = n
        grown = np.zeros((n + m, n + m))
        grown[:n, :n], grown[:n, n:] = A, B
        self.flow = Flow(grown, head, pairs)

    def at(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Return both at one time."""
        E = self.flow.at(time)
        return E[: self.n, : self.n], E[: self.n, self.n :]
