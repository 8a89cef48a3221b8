"""Sampling a plant whose channels have filters and delays of their own: exact, noise included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray, IntArray
from ..errors import AssumptionError
from ..lti.discretisation import accumulated_noise, acting, block_diagonal, pair_expm
from ..lti.lyapunov import compressed
from ..lti.statespace import StateSpace
from ..tolerances import SAME, TINY


class Late(NamedTuple):
    """A delay per channel: whole samples, and a fraction of one in seconds."""

    whole: IntArray
    fraction: FloatArray

    @classmethod
    def of(cls, names: Sequence[str], delays: Mapping[str, float], h: float) -> Late:
        """Split delays [s] at a sampling time; what is whole to rounding is whole."""
        samples = np.array([delays.get(name, 0.0) for name in names]) / h
        near = np.round(samples)
        samples = np.where(np.abs(samples - near) < SAME * np.maximum(near, 1.0), near, samples)
        whole = np.floor(samples).astype(np.int64)
        return cls(whole, (samples - whole) * h)

    @property
    def length(self) -> IntArray:
        """Samples of an input that must be remembered."""
        return self.whole + (self.fraction > 0)


def sampled_physical(
    g: StateSpace,
    rate: float,
    *,
    head: int,
    pairs: FloatArray,
    late_inputs: Mapping[str, float],
    late_outputs: Mapping[str, float],
    asd: FloatArray,
) -> tuple[StateSpace, FloatArray]:
    """Return the zero-order-hold equivalent of a physical system with delays per channel.

    And the factor (n, r) of the noise that disturbances add to its states.

    ``x(k h + t) = E(t) x[k] + N(t) u[k - m] + O(t) u[k - m - 1]``: an input that is (m h + f) late
    is the new sample for the last t - f and the old one before that. A late output is the motion
    at its own instant between samples, a state of its own; its noise is the part of the same
    noise that has acted until then.
    """
    h = 1.0 / rate
    inputs = Late.of(g.inputs, late_inputs, h)
    outputs = Late.of(g.outputs, late_outputs, h)
    _check_noise(g, asd, outputs)
    layout = _Layout(g, inputs, outputs)
    n, first = g.n_states, layout.first
    states = slice(first, first + n)
    held = HeldFlow(g.A, g.B, head, pairs)
    A = np.zeros((layout.size, layout.size))
    B = np.zeros((layout.size, len(g.inputs)))
    C = np.zeros((len(g.outputs), layout.size))
    E, new, old = _flow_at(held, inputs, h)
    A[states, states] = E
    layout.enter(A, B, states, new, old)
    layout.shift_inputs(A, B)
    D_new, D_old = _acting_sample(g.D, inputs, 0.0)
    now = np.zeros((len(g.outputs), layout.size)), np.zeros_like(g.D)
    now[0][:, states] = g.C
    layout.enter(now[0], now[1], slice(None), D_new, D_old)
    D = now[1].copy()
    D[outputs.length > 0] = 0.0
    C[outputs.length == 0] = now[0][outputs.length == 0]
    for j in np.flatnonzero(outputs.length):
        line = layout.line(int(j))
        C[j, line[0]] = 1.0
        for older, newer in pairwise(line):
            A[older, newer] = 1.0
        row = slice(line[-1], line[-1] + 1)
        if not outputs.fraction[j]:
            A[row], B[row] = now[0][j], now[1][j]
            continue
        t = h - float(outputs.fraction[j])
        E, new, old = _flow_at(held, inputs, t)
        direct_new, direct_old = _acting_sample(g.D[j : j + 1], inputs, t)
        A[row, states] = g.C[j] @ E
        layout.enter(A, B, row, g.C[j] @ new + direct_new, g.C[j] @ old + direct_old)
    blocks = None
    if g.blocks is not None:
        blocks = [*[1] * first, *g.blocks, *[1] * (layout.size - first - n)]
    system = g.replace(A=A, B=B, C=C, D=D, dt=h, states=layout.names, blocks=blocks)
    return system, _sampled_noise(g, Flow(g.A, head, pairs), asd, h, layout, outputs)


class _Layout:
    """Where the states are: late outputs, then those of the system, then late inputs."""

    def __init__(self, g: StateSpace, inputs: Late, outputs: Late) -> None:
        self.inputs, self.outputs = inputs, outputs
        ages, lines = (
            [
                (age, j)
                for age in range(int(late.length.max(initial=0)), 0, -1)
                for j in np.flatnonzero(late.length >= age).tolist()
            ]
            for late in (outputs, inputs)
        )
        self.seen = {key: i for i, key in enumerate(ages)}
        self.first = len(ages)
        start = self.first + g.n_states
        self.pushed = {key: start + i for i, key in enumerate(lines)}
        self.size = start + len(lines)
        self.names = [f"{g.outputs[j]}:late{age}" for age, j in ages]
        self.names += [*g.states, *(f"{g.inputs[i]}:delay{age}" for age, i in lines)]

    def line(self, output: int) -> list[int]:
        """Return the states of a late output, oldest first."""
        length = int(self.outputs.length[output])
        return [self.seen[age, output] for age in range(length, 0, -1)]

    def enter(
        self, A: FloatArray, B: FloatArray, rows: slice, new: FloatArray, old: FloatArray
    ) -> None:
        """Put the effects (rows, m) of the new and the old sample of each input in their places."""
        for effect, age_of in ((new, self.inputs.whole), (old, self.inputs.whole + 1)):
            for i, age in enumerate(age_of.tolist()):
                if not np.any(effect[:, i]):
                    continue
                if age == 0:
                    B[rows, i] += effect[:, i]
                else:
                    A[rows, self.pushed[age, i]] += effect[:, i]

    def shift_inputs(self, A: FloatArray, B: FloatArray) -> None:
        """Shift the delay lines of the inputs by one sample."""
        for (age, i), state in self.pushed.items():
            if age == 1:
                B[state, i] = 1.0
            else:
                A[state, self.pushed[age - 1, i]] = 1.0


def _flow_at(held: HeldFlow, inputs: Late, t: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return E(t), and the effects of the new and the old sample of each input."""
    E, whole = held.at(t)
    new, old = whole.copy(), np.zeros_like(whole)
    for f in np.unique(inputs.fraction[inputs.fraction > 0]):
        columns = inputs.fraction == f
        if t <= f:
            new[:, columns], old[:, columns] = 0.0, whole[:, columns]
            continue
        rest, late = held.at(t - float(f))
        new[:, columns] = late[:, columns]
        old[:, columns] = rest @ held.at(float(f))[1][:, columns]
    return E, new, old


def _acting_sample(D: FloatArray, inputs: Late, t: float) -> tuple[FloatArray, FloatArray]:
    """Return which sample of each input acts at t within the sample: the new or the old one."""
    new = np.where(inputs.fraction <= t, D, 0.0)
    return new, D - new


def _check_noise(g: StateSpace, asd: FloatArray, outputs: Late) -> None:
    loud = np.flatnonzero(asd > 0)
    late = np.flatnonzero(outputs.length > 0)
    direct = np.argwhere(g.D[np.ix_(late, loud)])
    if direct.size:
        output, name = g.outputs[late[direct[0][0]]], g.inputs[loud[direct[0][1]]]
        raise AssumptionError(
            f"white noise of {name!r} reaches {output!r} at once, so that a sample of it would "
            "have infinite variance. Give the sensor dynamics that roll off (an anti-alias "
            "filter), or shape the noise."
        )


def _sampled_noise(
    g: StateSpace, flow: Flow, asd: FloatArray, h: float, layout: _Layout, outputs: Late
) -> FloatArray:
    """Return G (N, r), ``G G'`` the covariance that white inputs add in one sample."""
    # piece by piece between the instants at which late outputs are taken
    loud = np.flatnonzero(asd)
    if not loud.size or not g.n_states:
        return np.zeros((layout.size, 0))
    force = g.B[:, loud] * (np.asarray(asd)[loud] / np.sqrt(2.0))
    # late outputs by the instant within the sample at which they are taken
    taken: dict[float, list[int]] = {}
    for j in np.flatnonzero(outputs.fraction > 0).tolist():
        taken.setdefault(h - float(outputs.fraction[j]), []).append(j)
    edges = np.unique([0.0, h, *taken])
    states = slice(layout.first, layout.first + g.n_states)
    parts = []
    for start, end in pairwise(edges):
        G = flow.noise(force, end - start)
        column = np.zeros((layout.size, G.shape[1]))
        column[states] = flow.at(h - end) @ G
        for instant, seen in taken.items():
            if end <= instant:
                rows = [layout.line(j)[-1] for j in seen]
                column[rows] = g.C[seen] @ flow.at(instant - end) @ G
        parts.append(column)
    return compressed(np.hstack(parts))


class Flow:
    """``e^(A t)`` of a block upper triangular A: head (sensors), modes, tail (amplifiers, inputs).

    The modes are 2 x 2 blocks that do not see each other, so e^(A t) is a sum over them of
    exponentials of the size of head, pair and tail: O(n) for n modes instead of O(n^3), and the
    modes' own blocks in closed form, rigid-body ones exact.
    """

    def __init__(self, A: FloatArray, head: int, pairs: FloatArray) -> None:
        b, n = pairs.shape[0], A.shape[0]
        self.A, self.pairs, self.n = A, pairs, n
        ends = (0, head, head + 2 * b, n)
        self.head, self.modes, self.tail = (slice(*two) for two in pairwise(ends))
        h, t = head, n - head - 2 * b
        self.h, self.t, self.b = h, t, b
        # coupling no larger than the rates: large units would make expm square too often
        rate = max(float(np.abs(A[self.modes, self.modes]).max(initial=0.0)), TINY)
        self.up = rate / max(float(np.abs(A[self.head, self.modes]).max(initial=0.0)), rate)
        self.down = rate / max(
            float(np.abs(A[self.modes, self.tail]).max(initial=0.0)),
            float(np.abs(A[self.head, self.tail]).max(initial=0.0)) * self.up,
            rate,
        )
        self.size = np.repeat([self.up, 1.0, 1.0 / self.down], np.diff(ends))
        self.whole = whole = self.size[:, None] * A / self.size
        self.direct = np.zeros((h + t, h + t))
        self.direct[:h, :h], self.direct[h:, h:] = A[self.head, self.head], A[self.tail, self.tail]
        self.direct[:h, h:] = whole[self.head, self.tail]
        self.small = np.zeros((b, h + 2 + t, h + 2 + t))
        self.small[:, :h, :h] = A[self.head, self.head]
        self.small[:, h + 2 :, h + 2 :] = A[self.tail, self.tail]
        self.small[:, h : h + 2, h : h + 2] = pairs
        seen = whole[self.head, self.modes].reshape(h, b, 2)
        self.small[:, :h, h : h + 2] = seen.transpose(1, 0, 2)
        self.small[:, h : h + 2, h + 2 :] = whole[self.modes, self.tail].reshape(b, 2, t)
        #: modes that see each other: no sum over pairs, the exponential of the whole
        self.coupled = np.count_nonzero(A[self.modes, self.modes]) > np.count_nonzero(pairs)
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
        # rounding of expm would leave entries below the blocks of a filter of several
        direct = np.where(acting(self.direct != 0), la.expm(self.direct * time), 0.0)
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
