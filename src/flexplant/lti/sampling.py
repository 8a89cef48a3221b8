"""Exact zero-order hold with delays of channels and noise, and a check of the rate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, check_names, divisor, positive, real_array
from ..errors import AssumptionError, ModelError, warn
from ..store import rebuild
from ..tolerances import CLOSE, SAME, TINY
from .blocks_of_states import (
    block_diagonal,
    block_eigenvalues,
    diagonal_blocks,
    turning_parts,
    uncoupled_run,
)
from .equations import compressed, state_scale
from .statespace import StateSpace, System, as_statespace


def discretized(
    sys: System, rate: float, *, delay: float = 0.0, delayed: Iterable[str] | None = None
) -> StateSpace:
    """Return the zero-order-hold equivalent at a rate, with the inputs delayed.

    ``x[k+1] = e^(A h) x[k] + (int_0^h e^(A s) ds) B u[k - delay]`` with h = 1 / rate. The result is
    exact, also for delays that are not a multiple of h. If A is block diagonal, a closed form is
    used for each block.

    Parameters
    ----------
    sys : StateSpace
        A continuous system.
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay of the inputs. A delay of n samples adds n states for each delayed input; a further
        fraction of a sample adds one more state.
    delayed : iterable of str, optional
        Delayed inputs; all by default.

    Returns
    -------
    StateSpace
        System with dt = 1 / rate; states of `sys` first, then the delay lines `u1:delay1`, ...

    Raises
    ------
    ModelError
        When `sys` is sampled already, the rate is not positive, or a delay is negative or longer
        than 1000 samples.

    Warns
    -----
    FlexplantWarning
        When all modes lie above half the rate, or a delay is shorter than 0.01 samples: it is
        probably given in the wrong unit.

    References
    ----------
    [Franklin1998]_, section 4.3.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.discretized(fx.lti.tf([1.0], [1.0, 1.0]), rate=10.0).poles().real.round(6)
    array([0.904837])
    """
    g = as_statespace(sys)
    if g.dt and g.n_states:
        raise ModelError(
            f"{g!r} is sampled already: a rate cannot be changed exactly without the continuous "
            "model. Discretise that one."
        )
    check_rate(light_modes(g.poles()), rate, delay)
    return held_exactly(g, rate, delay=delay, delayed=delayed)


def held_exactly(
    g: StateSpace, rate: float, *, delay: float = 0.0, delayed: Iterable[str] | None = None
) -> StateSpace:
    """Return the zero-order-hold equivalent of a continuous system; see `discretized`."""
    late = positive(delay, "delay", zero=True) / positive(rate, "rate")
    names = g.inputs if delayed is None else [g.inputs[i] for i in g.input_index(delayed)]
    check_names(names, "inputs that are delayed")
    pairs = uncoupled_pairs(g.A) if not late and set(g.blocks or ()) == {2} else None
    if pairs is None:
        return sample_and_hold(g, rate, dict.fromkeys(names, late))[0]
    own, integral = pair_exponential(pairs, 1.0 / rate)
    # e^(A h) has the blocks of A: the numbers alone are checked
    A = block_diagonal(real_array(own, "e^(A h)", copy=False))
    B = (integral @ g.B.reshape(len(pairs), 2, -1)).reshape(g.B.shape)
    B = real_array(B, "B of the sampled system", copy=False)
    return rebuild(StateSpace, g._fields() | {"A": A, "B": B, "dt": 1.0 / rate})


#: `e^(A t)` and `int_0^t e^(A s) ds B` of a time [s]
HeldFlow: TypeAlias = Callable[[float], tuple[FloatArray, FloatArray]]


class Late(NamedTuple):
    """Delay of each channel: integer number of samples, and a fraction of a sample in seconds."""

    whole: IntArray
    fraction: FloatArray

    @classmethod
    def of(cls, names: Sequence[str], delays: Mapping[str, float], h: float) -> Late:
        """Split delays [s] at a sampling time; values within rounding of integers are integers."""
        samples = np.array([delays.get(name, 0.0) for name in names]) / h
        near = np.round(samples)
        samples = np.where(np.abs(samples - near) < SAME * np.maximum(near, 1.0), near, samples)
        whole = np.floor(samples).astype(np.int64)
        return cls(whole, (samples - whole) * h)

    @property
    def length(self) -> IntArray:
        """Number of past samples of an input that are states."""
        return self.whole + (self.fraction > 0)


def sample_and_hold(
    g: StateSpace,
    rate: float,
    late_inputs: Mapping[str, float],
    late_outputs: Mapping[str, float] | None = None,
    asd: FloatArray | None = None,
) -> tuple[StateSpace, FloatArray]:
    """Return the zero-order-hold equivalent of a continuous system with delays [s] per channel.

    And the factor (n, r) of what white inputs of densities `asd` add to its states in a sample.
    """
    # x(k h + t) = E(t) x[k] + N(t) u[k - m] + O(t) u[k - m - 1]: an input that is (m h + f) late is
    # the new sample for the last t - f and the old one before that. A late output is the motion at
    # an instant between samples and a separate state; its noise is the part of the same noise that
    # has acted until then
    h = 1.0 / rate
    inputs = Late.of(g.inputs, late_inputs, h)
    outputs = Late.of(g.outputs, late_outputs or {}, h)
    loud = np.zeros(len(g.inputs)) if asd is None else asd
    _check_noise(g, loud, outputs)
    layout = _Layout(g, inputs, outputs)
    n, first = g.n_states, layout.first
    states = slice(first, first + n)
    alone = not n or uncoupled_pairs(g.A) is not None  # closed form, independent of units
    units = np.ones(n) if alone else state_scale(g.A, g.B, g.C)
    held = _held_flow(g, units)
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
    return system, _sampled_noise(g, units, loud, h, layout, outputs)


class _Layout:
    """Order of the states: late outputs, then the system, then late inputs."""

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
    E, whole = held(t)
    new, old = whole.copy(), np.zeros_like(whole)
    for f in np.unique(inputs.fraction[inputs.fraction > 0]):
        columns = inputs.fraction == f
        if t <= f:
            new[:, columns], old[:, columns] = 0.0, whole[:, columns]
            continue
        rest, late = held(t - float(f))
        new[:, columns] = late[:, columns]
        old[:, columns] = rest @ held(float(f))[1][:, columns]
    return E, new, old


def _acting_sample(D: FloatArray, inputs: Late, t: float) -> tuple[FloatArray, FloatArray]:
    """Return which sample of each input acts at t within the sample: the new or the old one."""
    new = np.where(inputs.fraction <= t, D, 0.0)
    return new, D - new


def reaches_at_once(noise: str, output: str) -> AssumptionError:
    """Return the error of white noise of which a sensor takes single samples."""
    return AssumptionError(
        f"white noise of {noise!r} reaches {output!r} without delay (for example an "
        "acceleration), so that a sample of it would have infinite variance. Measure "
        "displacement or velocity, give the "
        "sensor dynamics that roll off, or shape the noise or hold it over each sample (held=True)."
    )


def _check_noise(g: StateSpace, asd: FloatArray, outputs: Late) -> None:
    loud = np.flatnonzero(asd > 0)
    late = np.flatnonzero(outputs.length > 0)
    direct = np.argwhere(g.D[np.ix_(late, loud)])
    if direct.size:
        output, name = g.outputs[late[direct[0][0]]], g.inputs[loud[direct[0][1]]]
        raise reaches_at_once(name, output)


def _sampled_noise(
    g: StateSpace, units: FloatArray, asd: FloatArray, h: float, layout: _Layout, outputs: Late
) -> FloatArray:
    """Return G (N, r), ``G G'`` the covariance that white inputs add in one sample."""
    # piece by piece between the instants at which late outputs are taken
    loud = np.flatnonzero(asd)
    if not loud.size or not g.n_states:
        return np.zeros((layout.size, 0))
    flow = Flow(g.A, g.blocks, units)
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
        column[states] = flow.on(G, h - end)
        for instant, seen in taken.items():
            if end <= instant:
                rows = [layout.line(j)[-1] for j in seen]
                column[rows] = g.C[seen] @ flow.on(G, instant - end)
        parts.append(column)
    return compressed(np.hstack(parts))


class Flow:
    """``e^(A t)`` in given units of the states, exactly 0 where a state does not act on another.

    Uncoupled modes lie between states that see them (head: sensors) and drive them (tail:
    amplifiers, inputs). Then e^(A t) is a sum over modes of small exponentials of head, mode and
    tail, O(n) for n modes instead of O(n^3), and the blocks of modes have a closed form, which is
    exact for rigid-body modes. Without such modes it is the exponential of the whole matrix.
    """

    def __init__(self, A: FloatArray, blocks: Sequence[int] | None, units: FloatArray) -> None:
        n, self.units = len(A), units
        self.A = A = A * units / units[:, None]
        self.rate = float(np.linalg.norm(A, 1)) if n else 0.0
        h, end, own = uncoupled_run(A, blocks or ())
        #: the tail is constant and only modes see it: held inputs
        self.still = not h and not A[end:].any()
        self.modal = end > h and (self.still or 2 * (end - h) >= n)
        if not self.modal:
            self.reached = acting(A != 0)
            return
        if end - h == n:  # the norm of a block is up to twice its pole
            self.rate = float(np.abs(block_eigenvalues(A, own)).max())
        pairs, slots = diagonal_blocks(A[h:end, h:end], own)
        self.pairs, self.h, self.t = pairs, h, n - end
        #: the two states of each mode; the missing state of a mode with one state comes after all
        #: others
        self.at_modes = at = np.where(slots < 0, n, slots + h)
        wide = np.pad(A, ((0, 1), (0, 1)))
        self.entering = wide[at][:, :, end:n]
        self.direct = np.zeros((h + self.t, h + self.t))
        self.direct[:h, :h], self.direct[h:, h:] = A[:h, :h], A[end:, end:]
        self.direct[:h, h:] = A[:h, end:]
        self.reached = acting(self.direct != 0)
        self.small = np.zeros((len(pairs), h + 2 + self.t, h + 2 + self.t))
        self.small[:, :h, :h], self.small[:, h + 2 :, h + 2 :] = A[:h, :h], A[end:, end:]
        self.small[:, h : h + 2, h : h + 2] = pairs
        self.small[:, :h, h : h + 2] = wide[:h][:, at].transpose(1, 0, 2)
        self.small[:, h : h + 2, h + 2 :] = self.entering

    def at(self, time: float) -> FloatArray:
        """Return ``e^(A time)`` (n, n)."""
        n = len(self.A)
        if not self.modal:
            E = np.where(self.reached, la.expm(self.A * time), 0.0)
            return np.asarray(E * self.units[:, None] / self.units)
        E, at, h, t = np.zeros((n + 1, n + 1)), self.at_modes, self.h, self.t
        tail = slice(n - t, n)
        if t and self.still:
            own, integral = pair_exponential(self.pairs, time)
            E[at, tail] = integral @ self.entering
            E[tail, tail] = np.eye(t)
        else:
            own = pair_expm(self.pairs, time)
            if h + t:
                # rounding of expm would leave entries below the blocks of a filter of several
                direct = np.where(self.reached, la.expm(self.direct * time), 0.0)
                parts = la.expm(self.small * time)
                E[:h, :h], E[tail, tail] = direct[:h, :h], direct[h:, h:]
                E[:h, tail] = direct[:h, h:] + parts[:, :h, h + 2 :].sum(axis=0)
                E[:h, at] = parts[:, :h, h : h + 2].transpose(1, 0, 2)
                E[at, tail] = parts[:, h : h + 2, h + 2 :]
        E[at[:, :, None], at[:, None, :]] = own
        return np.asarray(E[:n, :n] * self.units[:, None] / self.units)

    def on(self, vectors: FloatArray, time: float) -> FloatArray:
        """Return ``e^(A time)`` times vectors (n, r), without (n, n) matrices for modes alone."""
        if not self.modal or self.h or self.t:
            return self.at(time) @ vectors
        wide = np.vstack([vectors / self.units[:, None], np.zeros((1, vectors.shape[1]))])
        wide[self.at_modes] = pair_expm(self.pairs, time) @ wide[self.at_modes]
        return np.asarray(wide[:-1] * self.units[:, None])

    def noise(self, force: FloatArray, time: float) -> FloatArray:
        """Return G (n, r) with ``G G' = int_0^time e^(A s) force force' e^(A' s) ds``."""
        return accumulated_noise(self.on, force, time, self.rate)


def _held_flow(g: StateSpace, units: FloatArray) -> HeldFlow:
    """Return ``e^(A t)`` and ``int_0^t e^(A s) ds B`` of t: held inputs are states at rest."""
    n, m = g.B.shape
    grown = np.pad(g.A, (0, m))
    grown[:n, n:] = g.B
    # inputs not larger than the rates: large units would cause too many squarings in expm
    rate = float(np.abs(g.A * units / units[:, None]).max(initial=TINY))
    drive = float(np.abs(g.B / units[:, None]).max(initial=rate))
    both = np.append(units, np.full(m, np.exp2(np.floor(np.log2(rate / drive)))))
    flow = Flow(grown, None if g.blocks is None else [*g.blocks, *[1] * m], both)

    def at(time: float) -> tuple[FloatArray, FloatArray]:
        E = flow.at(time)
        return E[:n, :n], E[:n, n:]

    return at


def acting(direct: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which states (n, n) act on which: entries of the exponential that may be non-zero."""
    reached = direct | np.eye(direct.shape[0], dtype=bool)
    while True:
        wider = (reached.astype(np.float32) @ reached.astype(np.float32)) > 0
        if np.array_equal(wider, reached):
            return reached
        reached = wider


def uncoupled_pairs(A: FloatArray) -> FloatArray | None:
    """Return the (n/2, 2, 2) diagonal blocks of A, or None when A has other entries."""
    b, odd = divmod(len(A), 2)
    if odd:
        return None
    pairs = A.reshape(b, 2, b, 2)[np.arange(b), :, np.arange(b), :]
    return pairs if np.count_nonzero(A) == np.count_nonzero(pairs) else None


#: terms of the integral's Taylor series are four times four: at 0.5 the next one is rounding
_ROWS = 4


@cache
def _series() -> FloatArray:
    """Return the coefficients 1 / (k + 1)! of the series."""
    return 1.0 / np.cumprod(np.arange(1.0, 1.0 + _ROWS**2)).reshape(_ROWS, _ROWS)


def pair_exponential(pairs: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Return ``e^(A h)`` and ``int_0^h e^(A s) ds`` of (b, 2, 2) blocks, both (b, 2, 2)."""
    # the integral is a Taylor series on t = h / 2^s, doubled by `I(2 t) = I(t) + e^(A t) I(t)`,
    # where e^(A t), first `1 + A I(t)`, is squared: no division by small frequencies. There both
    # states of a pair have units in which they are of one size, so that s is small
    units = _even_units(pairs)
    even = pairs.copy()
    even[:, 0, 1] /= units
    even[:, 1, 0] *= units
    size = float(np.abs(even).sum(axis=2).max()) * h
    doublings = max(0, int(np.ceil(np.log2(max(size, TINY) / 0.5))))
    t, identity = h / 2**doublings, np.eye(2)
    step = even * t
    powers = np.empty((_ROWS, *pairs.shape))
    powers[0], powers[1] = identity, step
    np.matmul(step, step, out=powers[2])
    np.matmul(powers[2], step, out=powers[3])
    fourth = powers[2] @ powers[2]
    terms = (_series() @ powers.reshape(_ROWS, -1)).reshape(powers.shape)
    integral = t * (terms[0] + fourth @ (terms[1] + fourth @ (terms[2] + fourth @ terms[3])))
    if doublings:
        flow = identity + even @ integral
        for _ in range(doublings - 1):
            integral += flow @ integral
            flow = flow @ flow
        integral += flow @ integral
    integral[:, 0, 1] *= units
    integral[:, 1, 0] /= units
    return pair_expm(pairs, h), integral


def _even_units(pairs: FloatArray) -> FloatArray:
    """Return the unit (b,) of each first state, a power of two, that makes a pair symmetric."""
    ahead, back = pairs[:, 0, 1], pairs[:, 1, 0]
    gap = np.frexp(ahead)[1] - np.frexp(back)[1]
    return np.ldexp(1.0, np.where((ahead != 0) & (back != 0), gap // 2, 0))


def pair_expm(pairs: FloatArray, h: float) -> FloatArray:
    """Return ``e^(A h)`` of (b, 2, 2) blocks in closed form."""
    # `e^(A h) = e^(m h) (cosh(r h) I + sinh(r h) / r N)` with A = m I + N, N^2 = q I and r^2 = q:
    # trigonometric for an oscillating pair, linear in h for a rigid-body pair
    mean, N, q = turning_parts(pairs)
    root, still = np.sqrt(np.abs(q)), q >= 0
    decay, turning = np.exp(mean * h), root * h
    even, odd = decay * np.cos(turning), decay * np.sin(turning) / divisor(root)
    if still.any():
        even[still], odd[still] = _overdamped(pairs[still], mean[still], root[still], h)
    E = odd[:, None, None] * N
    E[:, 0, 0] += even
    E[:, 1, 1] += even
    return E


def _overdamped(
    pairs: FloatArray, mean: FloatArray, root: FloatArray, h: float
) -> tuple[FloatArray, FloatArray]:
    """Return ``e^(m h) cosh(r h)`` and ``e^(m h) sinh(r h) / r`` where poles m +- r are real."""
    # exponentials of both poles, because cosh(r h) overflows long before e^(m h) has decayed; the
    # smaller pole is the determinant over the larger, because m +- r would cancel its digits
    determinant = pairs[:, 0, 0] * pairs[:, 1, 1] - pairs[:, 0, 1] * pairs[:, 1, 0]
    large = mean + np.where(mean > 0, root, -root)
    small = determinant / np.where(large != 0, large, 1.0)
    decay = np.exp(np.maximum(large, small) * h)
    even = 0.5 * (decay + np.exp(np.minimum(large, small) * h))
    odd = -0.5 * np.expm1(-2.0 * root * h) / divisor(root)
    return even, decay * np.where(root > 0, odd, h)


#: Gauss nodes of an interval that is short against the fastest pole: exact to rounding
_NODES = 10


def accumulated_noise(
    on: Callable[[FloatArray, float], FloatArray], force: FloatArray, time: float, rate: float
) -> FloatArray:
    """Return G (n, r) with ``G G' = int_0^time e^(A s) force force' e^(A' s) ds``.

    ``on(vectors, t)`` are vectors times ``e^(A t)``.
    """
    # Gauss-Legendre quadrature. It covers the whole interval where the number of nodes for rounding
    # accuracy gives less than n columns, as for a large structure with few forces. Otherwise it
    # covers an interval so short that ten nodes are exact, followed by `G(2 t) = [G(t), e^(A t)
    # G(t)]`: log2(time rate) steps, for modes of any speed. These are sums of squares, so that G G'
    # is positive semidefinite in any units, unlike the block exponential of [VanLoan1978]_ on large
    # models
    n, m = force.shape
    # the error is a Bessel function of order 2 count and argument |A| time, which is negligible
    # beyond; ten nodes more are for motions that are polynomials in time, as of rigid bodies
    size = min(rate * time, 2.0 * n)
    count, doublings = _NODES + int(np.ceil(0.5 * size + 4.0 * np.cbrt(size))), 0
    if count * m >= n:
        count, doublings = _NODES, max(0, int(np.ceil(np.log2(max(rate * time, TINY)))))
    piece = time / 2**doublings
    nodes, weights = np.polynomial.legendre.leggauss(count)
    # the moments in Legendre polynomials have the same sum of squares (an orthogonal combination of
    # the nodes), and fall fast with their degree
    degrees = np.arange(count)
    moments = np.polynomial.legendre.legvander(nodes, count - 1) * weights[:, None]
    moments *= np.sqrt(0.5 * piece * (degrees + 0.5))
    parts = np.stack([on(force, 0.5 * piece * (node + 1.0)) for node in nodes], axis=2)
    G = compressed((parts @ moments).reshape(n, -1))
    for k in range(doublings):
        G = compressed(np.hstack([G, on(G, piece * 2**k)]))
    return G


#: longest delay in samples of a loop or a port: each sample is a state of each channel
_LONGEST = 1000.0
#: largest damping ratio of a mode; poles with more damping are filters
LIGHT = 0.3


def check_rate(modes: FloatArray, rate: float, delay: float) -> None:
    """Check a sampling rate [Hz] and a delay [samples]; warn of a probably wrong unit."""
    rate, delay = positive(rate, "rate"), positive(delay, "delay", zero=True)
    if 0 < delay < CLOSE:  # samples
        warn(
            f"delay={delay:g} is in samples, {delay / rate:.3g} s, and has almost no effect. If "
            f"{delay:g} s is meant, pass delay={delay * rate:.4g} at {rate:g} Hz."
        )
    _check_length("delay", delay, rate)
    if modes.size and modes.min() > 0.5 * rate:
        lowest = float(modes.min())
        other = f"{rate:g} kHz is rate={1e3 * rate:g}" if rate >= 1 else ""
        other = other or f"{rate:g} s as a sampling period is rate={1 / rate:g}"
        warn(
            f"all {modes.size} elastic modes, {lowest:.4g} Hz and above, lie above half the "
            f"sampling rate ({0.5 * rate:g} Hz): in its samples they appear as slow modes. The "
            f"rate is in Hz and the model in SI units; {other}."
        )


def check_latency(name: str, latency: float, rate: float) -> None:
    """Raise ModelError when the latency [s] of a port is more than 1000 samples."""
    _check_length(f"the latency of {name!r}", latency * rate, rate)


def _check_length(what: str, samples: float, rate: float) -> None:
    if samples > _LONGEST:
        raise ModelError(
            f"{what} is {samples:.4g} samples, {samples / rate:.3g} s at {rate:g} Hz; at most "
            f"{_LONGEST:g} samples are possible, each of which is a state. Delays of loops are in "
            "samples, latencies of ports in seconds."
        )


def light_modes(poles: ComplexArray) -> FloatArray:
    """Return the frequencies [Hz] of the lightly damped pairs among continuous poles [rad/s]."""
    size = np.abs(poles)
    return np.asarray(size[(poles.imag > 0) & (-poles.real < LIGHT * size)] / (2.0 * np.pi))
