"""The inverse of a plant: its expansion at rest, and slow zeros, which no expansion contains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, complex_array, divisor
from ..errors import AssumptionError, ModelError
from ..lti.conversions import even_factors
from ..lti.statespace import StateSpace
from ..store import Value, checked
from ..tolerances import MISSED, NEGLIGIBLE, PRECISION, ROOT, SAME, SPLIT, TYPED
from .axes import apart, complex_gain, felt, resting_frequency, usual_frequency
from .partitioned import Partition
from .port import DERIVATIVES

#: a function of s, real on the real axis, to an array of any shape
OfS: TypeAlias = Callable[[complex], ComplexArray]

#: largest radius [rad/s]: 1 kHz, above the bandwidth of any motion; how often it is halved, to 5e-6
_LARGEST, _RADII = 6e3, 30
#: where the expansion is compared with the function, relative to the radius: in decades, so that
#: poles far inside of the circle are noticed too
_INSIDE = np.logspace(-1, -4, 4)
#: terms that are compared: eight lack 0.1^8 of a function that is regular within the circle, of
#: as many points are taken on its upper half
_TERMS = 8


def at_rest(find: OfS, dt: float, axes: Sequence[str], count: int = 5) -> FloatArray:
    """Return k_0, k_1, ... (..., count) of an inverse ``F(s) = k_0 + k_1 s + ...`` around rest.

    They are those on the largest circle within which F has no pole: two circles agree, which they
    also do where both enclose the same poles, and the expansion is F inside of them.
    """
    radius = min(_LARGEST, 0.5 / dt) if dt else _LARGEST
    powers = np.arange(_TERMS)
    outer = _on_circle(find, radius)
    for _ in range(_RADII):
        inner = _on_circle(find, 0.5 * radius)
        size = np.abs(outer) * radius**powers
        scale = divisor(size.max(axis=tuple(range(1, size.ndim)), keepdims=True))
        low = (0.5 * radius) ** powers
        same = np.abs(outer - inner)[..., :count] * low[:count] <= ROOT * scale
        terms = np.where(np.abs(inner) * low <= ROOT * scale, 0.0, inner)
        if np.all(same) and _is_inside(find, terms, 0.5 * radius):
            return np.asarray(terms[..., :count])
        outer, radius = inner, 0.5 * radius
    raise AssumptionError(
        f"the response of {', '.join(axes)} to the actuators has no inverse that is regular at low "
        "frequency: there is a zero at rest. Check which axes the actuators move."
    )


def _is_inside(find: OfS, terms: FloatArray, radius: float) -> bool:
    """Return whether an expansion is the function inside the circle."""
    for part in _INSIDE:
        s = part * radius
        wanted = find(complex(s)).real
        found = terms @ s ** np.arange(terms.shape[-1])
        scale = np.abs(wanted).max(axis=tuple(range(1, wanted.ndim)), keepdims=True)
        if not np.all(np.abs(found - wanted) <= TYPED * divisor(scale)):
            return False
    return True


def _on_circle(find: OfS, radius: float) -> FloatArray:
    """Return k_m = Re sum F(s_i) s_i^-m / N over N points of the upper half of a circle."""
    turns = np.exp(1j * np.pi * (np.arange(_TERMS) + 0.5) / _TERMS)
    values = np.array([find(radius * complex(turn)) for turn in turns])
    powers = turns[:, None] ** -np.arange(_TERMS)
    summed = np.einsum("t...,tm->...m", values, powers).real
    return np.asarray(summed / _TERMS / radius ** np.arange(_TERMS))


def solved(G: ComplexArray, wanted: ComplexArray, axes: Sequence[str]) -> ComplexArray:
    """Return ``G^-1 wanted`` of square G (..., r, r), which has to be regular."""
    rows = np.max(np.abs(G), axis=-1, keepdims=True)
    columns = np.max(np.abs(G), axis=-2, keepdims=True)
    flat = rows.min(initial=1.0) <= 0 or columns.min(initial=1.0) <= 0
    if flat or np.max(np.linalg.cond(G / np.sqrt(rows * columns))) > 1.0 / SAME:
        raise AssumptionError(
            f"the actuators do not move {', '.join(axes)} apart from each other, so that there is "
            "no inverse. Choose other axes."
        )
    return np.asarray(
        np.linalg.solve(G, np.broadcast_to(wanted, (*G.shape[:-2], *wanted.shape[-2:])))
    )


def moved_at_rest(plant: Partition, channels: Sequence[str], forces: Sequence[str]) -> FloatArray:
    """Return the independent motions (p, r) of channels that forces make at rest.

    Each is one unit of a channel that the forces move apart from those before it: of a free body
    its rigid-body motions, and not what the forces bend, which is far smaller at rest.
    """
    G = felt(plant, 2.0 * np.pi * resting_frequency(plant), channels, forces)
    chosen: list[int] = []
    for i in range(len(channels)):
        if apart(G[[*chosen, i]]):
            chosen.append(i)
    if not chosen:
        return np.zeros((len(channels), 0))
    axes = [channels[i] for i in chosen]
    T = np.asarray(np.linalg.pinv(G[chosen]), dtype=np.float64)
    return followed_at_rest(plant.system, T, forces, axes, channels, plant.dt)[..., 0]


def followed_at_rest(
    g: StateSpace,
    T: FloatArray,
    inputs: Sequence[str],
    axes: Sequence[str],
    seen: Sequence[str],
    dt: float,
    count: int = 1,
) -> FloatArray:
    """Return where outputs are (p, r, count) by derivatives of each axis: ``G_y T (G_z T)^-1``."""
    names = [*axes, *seen]

    def found(s: complex) -> ComplexArray:
        both = complex_gain(g, s, names, inputs) @ T
        moved, seen_there = both[: len(axes)], both[len(axes) :]
        return np.asarray(np.linalg.solve(moved.T, seen_there.T).T, dtype=np.complex128)

    return at_rest(found, dt, axes, count)


@dataclass(frozen=True, eq=False, repr=False)
class SlowZeros(Value):
    """Poles of the inverse of a plant, ``F(s) = sum_i c_i / (s - p_i) + ...``, that are slow.

    F is the response from a set-point to the forces that a feedforward needs. Its poles p_i are the
    zeros of the plant, and c_i are its residues. A feedforward uses the power series
    ``k_0 + ... + k_m s^m`` of F at s = 0. Poles are slow if their frequencies are below a hundredth
    of the sampling rate. The series does not represent these poles well. The feedforward therefore
    adds the term ``s^m H(s)`` for them. Its filter
    ``H(s) = sum_i (c_i / p_i^(m + 1)) (s / (s - p_i))`` is zero at s = 0. In the methods, the
    argument `order` is the exponent m.

    Parameters
    ----------
    poles : (k,) complex array [rad/s]
        Poles in the upper half plane; each counts with its conjugate.
    residues : (r, k) complex array
        Residues c_i of the force of each axis.
    dt : float [s]
        Sampling time; the filters then use ``(z - 1) / dt`` in place of s.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.ball_screw()
    >>> fx.design_feedforward(plant).zeros
    <SlowZeros 13.1 Hz>
    """

    poles: ComplexArray = field(metadata=checked(complex_array, unit="rad/s", shape=(None,)))
    residues: ComplexArray = field(metadata=checked(complex_array, shape=(None, "poles")))
    dt: float = 0.0

    def __repr__(self) -> str:
        return f"<SlowZeros {', '.join(f'{f:.3g}' for f in self.freq)} Hz>"

    @property
    def freq(self) -> FloatArray:
        """Frequencies [Hz] of the poles, in increasing order."""
        return np.sort(np.abs(self.poles)) / (2.0 * np.pi)

    @property
    def _rates(self) -> ComplexArray:
        """The poles as ``(z - 1) / dt``; s where the plant is continuous."""
        rates = np.expm1(self.poles * self.dt) / self.dt if self.dt else self.poles
        return np.asarray(rates, dtype=np.complex128)

    def _gains(self, order: int) -> ComplexArray:
        """Return the gain (k,) of a filter of a derivative for a residue of 1."""
        return np.asarray(np.exp(self.poles * self.dt) / (self.poles**order * self._rates))

    def responses(self, s: ComplexArray, order: int) -> ComplexArray:
        """Return the added term ``s^m H(s)`` (n, 2 k) at n values of s, for unit residues.

        Column i belongs to a residue of 1 at pole i, and column k + i to a residue of sqrt(-1).
        Each includes the term of the conjugate pole. The values s are in rad/s.
        """
        at = np.asarray(s)[:, None]
        rate = np.expm1(at * self.dt) / self.dt if self.dt else at
        gains, rates = self._gains(order), self._rates
        one = gains * rate / (rate - rates)
        other = gains.conj() * rate / (rate - rates.conj())
        return np.asarray(at**order * np.hstack([one + other, 1j * (one - other)]))

    def at(self, s: complex) -> ComplexArray:
        """Return the added term ``s^m H(s)`` (r,) of the axes at a complex s [rad/s], for m = 4."""
        parts = np.hstack([self.residues.real, self.residues.imag])
        return np.asarray(parts @ self.responses(np.array([s]), len(DERIVATIVES))[0])

    def filters(self, order: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, C, D of H, from the m-th derivative of the set-point to the axes' forces."""
        gains, rates = self.residues * self._gains(order), self._rates
        A = la.block_diag(*(np.array([[p.real, -p.imag], [p.imag, p.real]]) for p in rates))
        B = np.tile([[1.0], [0.0]], (rates.size, 1))
        driven = 2.0 * gains * rates
        C = np.stack([driven.real, -driven.imag], axis=-1).reshape(len(gains), -1)
        D = 2.0 * gains.real.sum(axis=1)[:, None]
        return (np.eye(len(A)) + self.dt * A, self.dt * B, C, D) if self.dt else (A, B, C, D)

    def run(self, driving: FloatArray, time: FloatArray, order: int) -> FloatArray:
        """Return the output of the filter H for samples of the m-th derivative of the set-point.

        The result contains the force of each axis at each sample, (n_time, r). `driving` holds the
        derivative, and `time` the instants of the samples [s].
        """
        from scipy.signal import dlsim

        if not self.dt or not np.allclose(np.diff(time), self.dt, rtol=SPLIT):
            raise ModelError(
                f"the filters of {self!r} have a past: give the times of samples of a sampled "
                "plant, np.arange(n) * plant.dt, or close the loop with feedforward.system."
            )
        return np.asarray(dlsim((*self.filters(order), self.dt), driving)[1])


def slow_zeros(
    plant: Partition, T: FloatArray, axes: Sequence[str], wanted: FloatArray
) -> tuple[SlowZeros | None, FloatArray]:
    """Return the slow stable poles of the inverse ``(G T)^-1 wanted``, and unstable ones [Hz].

    Slow is below the usual bandwidth of the plant (`driven_axes`), which a continuous plant does
    not tell: its filters would be those of all its modes. Poles that hardly change the
    forces, even at their own frequency, those without damping and stable real ones are left out.
    """
    if not plant.dt:
        return None, np.zeros(0)
    poles, residues = _poles_of_inverse(plant, T, axes, wanted)
    speed, last = np.abs(poles), 2.0 * np.pi * usual_frequency(plant)
    inside = (poles.imag >= 0.0) & (speed < last)
    inside &= speed > 2.0 * np.pi * resting_frequency(plant)
    inside &= np.abs(poles.real) > MISSED * speed
    felt = []
    for i in np.flatnonzero(inside):
        G = complex_gain(plant.system, 1j * speed[i], axes, plant.u) @ T
        force = np.abs(np.linalg.solve(G, wanted)[:, 0])
        part = np.abs(residues[:, i] / poles[i].real)
        if np.any(part > NEGLIGIBLE * np.max(force)):
            felt.append(i)
    chosen = np.array(felt, dtype=int)
    stable = chosen[(poles[chosen].real < 0.0) & (poles[chosen].imag > 0.0)]
    unstable = np.sort(speed[chosen[poles[chosen].real > 0.0]]) / (2.0 * np.pi)
    if not stable.size:
        return None, unstable
    return SlowZeros(poles[stable], residues[:, stable], plant.dt), unstable


def _poles_of_inverse(
    plant: Partition, T: FloatArray, axes: Sequence[str], wanted: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return the finite poles [rad/s] of ``(G T)^-1 wanted``, and their residues (r, k)."""
    # [A - p I, B T; C, D T] x = 0 has the residue -x_u (y_u . wanted) / (y . E x), y from the left
    g, dt = plant.system, plant.dt
    n, rows, columns = g.n_states, g.output_index(list(axes)), g.input_index(list(plant.u))
    A, B = (g.A - np.eye(n)) / dt, g.B / dt
    pencil = np.block([[A, B[:, columns] @ T], [g.C[rows], g.D[np.ix_(rows, columns)] @ T]])
    E = np.zeros_like(pencil)
    E[:n, :n] = np.eye(n)
    left, right = even_factors(np.abs(pencil))
    both = left[:, None] * pencil * right, left[:, None] * E * right
    values, y, x = la.eig(*both, left=True, right=True, homogeneous_eigvals=True)
    finite = np.abs(values[1]) > PRECISION * np.abs(values[0])
    rates = values[0, finite] / values[1, finite]
    x, y = right[:, None] * x[:, finite], left[:, None] * y[:, finite].conj()
    size = np.einsum("ij,ij->j", y, E @ x)
    residues = -x[n:] * (y[n:].T @ wanted)[:, 0] / np.where(size == 0.0, np.inf, size)
    turned = 1.0 + dt * rates
    turned = np.where(turned == 0.0, PRECISION, turned)
    return np.asarray(np.log(turned) / dt), np.asarray(residues / turned)
