"""Sampling by zero-order hold and by Tustin, judged rates; a sampled system over a record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..checks import ComplexArray, FloatArray, between, positive
from ..errors import ModelError, warn
from .joining import bilinear_matrices, trapezoidal
from .sampling import held_exactly
from .statespace import StateSpace, System, as_statespace

#: distance of a pole from where a map is singular, relative to it, that counts as none
_SAME = 1e-12


def discretized(
    sys: System, rate: float, *, delay: float = 0.0, delayed: Iterable[str] | None = None
) -> StateSpace:
    """Return the zero-order-hold equivalent at a rate, with the inputs delayed.

    ``x[k+1] = e^(A h) x[k] + (int_0^h e^(A s) ds) B u[k - delay]``, h = 1 / rate; exact, also for
    delays that are no multiple of h. Where A is block diagonal each block is done in closed form.

    Parameters
    ----------
    sys : StateSpace
        A continuous system.
    rate : float [Hz]
    delay : float [samples]
        From the sampling of an input to its arrival; its integer part adds that many states per
        delayed input, a fraction one more.
    delayed : iterable of str, optional
        The inputs that are delayed; all when not given.

    Returns
    -------
    StateSpace
        With dt = 1 / rate; states of `sys` first, then the delay lines `u1:delay1`, ...

    Raises
    ------
    ModelError
        When `sys` is sampled already, rate or delay is not positive, or plausible in another unit
        only: the slowest mode lies far above half the rate, or a delay is next to nothing.

    Warns
    -----
    FlexplantWarning
        When all modes lie above half the rate.

    References
    ----------
    [Franklin1998]_, section 4.3.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.discretized(fx.lti.tf([1.0], [1.0, 1.0]), rate=10.0).poles().real.round(6)  # exp(-0.1)
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


def tustin(sys: System, rate: float, *, prewarp: float | None = None) -> StateSpace:
    """Return the bilinear (Tustin) equivalent of a filter at a rate.

    ``s = a (z - 1) / (z + 1)`` with a = 2 rate, or a = w / tan(w / (2 rate)) so that the response
    at one frequency w is kept exactly.

    Parameters
    ----------
    sys : StateSpace
        A continuous system: a weight or a controller; for a plant use `discretized`.
    rate : float [Hz]
    prewarp : float [Hz], optional
        The frequency at which the response is kept.

    Returns
    -------
    StateSpace
        With dt = 1 / rate, the same names.

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
    """Return whether an eigenvalue lies there; a condition number would see the states' units."""
    distance = np.abs(np.linalg.eigvals(A) - place)
    return bool(np.min(distance, initial=np.inf) <= _SAME * abs(place))


def image_freq(omega: Any, dt: float) -> Any:
    """Return the frequencies [Hz] that those of the bilinear image [rad/s] stand for."""
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


#: times half the rate: where even the lowest mode lies above this, the rate is in another unit
_OTHER_UNIT = 10.0
#: samples: a delay between 0 and this changes nothing that can be measured
_NO_DELAY = 0.01
#: samples: a delay beyond this is in another unit, of a loop, an actuator or a sensor
_LONGEST = 1000.0
#: damping ratio up to which a pole is a mode, not a filter
_LIGHT = 0.3


def check_rate(modes: FloatArray, rate: float, delay: float) -> None:
    """Judge a sampling rate [Hz] by the elastic modes [Hz] of a system, and a delay by the rate."""
    rate, delay = positive(rate, "rate"), positive(delay, "delay", zero=True)
    if 0 < delay < _NO_DELAY:
        raise ModelError(
            f"delay={delay:g} is in samples, which here means {delay / rate:.3g} s and changes "
            f"nothing. If {delay:g} s is meant, it is delay={delay * rate:.4g} at {rate:g} Hz."
        )
    if delay > _LONGEST:
        raise ModelError(
            f"delay={delay:g} is in samples, which here means {delay / rate:.3g} s: no loop runs "
            f"that late. If {delay:g} us are meant, it is delay={1e-6 * delay * rate:.4g} at "
            f"{rate:g} Hz."
        )
    if not modes.size or modes.min() <= 0.5 * rate:
        return
    said = (
        f"all {modes.size} elastic modes, {modes.min():.4g} Hz and above, lie above "
        f"half the sampling rate ({0.5 * rate:g} Hz): in its samples they look like slow ones. The "
        "rate is in Hz"
    )
    if modes.min() > 0.5 * _OTHER_UNIT * rate:
        raise ModelError(f"{said}{_meant(rate, float(modes.min()))}.")
    said = f"{said}, the model in SI units: are both?"
    warn(said)


def _meant(rate: float, lowest: float) -> str:
    """Return which other unit would bring the lowest mode below half the rate."""
    if rate < 1 and 2 * lowest <= 1 / rate:
        return f"; {rate:g} s as a sampling period is rate={1 / rate:g}"
    if 2 * lowest <= 1e3 * rate:
        return f"; {rate:g} kHz is rate={1e3 * rate:g}"
    return ""


def check_latency(name: str, latency: float, rate: float) -> None:
    """Raise ModelError when the latency [s] of a port is more than 1000 samples."""
    if latency * rate > _LONGEST:
        raise ModelError(
            f"the latency of {name!r} is {latency:g} s, {latency * rate:.4g} samples at {rate:g} "
            f"Hz: latencies are in seconds. If {latency:g} samples are meant, it is "
            f"latency={latency / rate:.4g}."
        )


def light_modes(poles: ComplexArray) -> FloatArray:
    """Return the frequencies [Hz] of the lightly damped pairs among continuous poles [rad/s]."""
    size = np.abs(poles)
    return np.asarray(size[(poles.imag > 0) & (-poles.real < _LIGHT * size)] / (2.0 * np.pi))


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
        """Return the outputs (N, p) for inputs (N, m) from a state (n,), and the last state."""
        # N is a whole number of blocks. All is a product of two matrices but `step x`
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
