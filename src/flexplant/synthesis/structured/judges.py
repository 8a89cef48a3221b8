"""What a loop is judged by: norms of a controller with parameters, their values and gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np

from ...checks import ComplexArray, FloatArray
from ...errors import AssumptionError
from ...lti.lyapunov import solve_lyapunov
from ...lti.preparation import Prepared, prepared
from ...plant import StandardPlant
from ...tolerances import ROUNDING, TINY
from .nonsmooth import Pieces
from .scaled_loop import Closed, Matrices, ScaledLoop

#: step of the controller, in parameters of size 1, by which a gradient's derivative is found
_STEP = 1e-5
#: time constants of the slowest pole after which an impulse response is over: e^-25 is rounding
_OVER = 25.0
#: points of the times at which its sign is taken: a period of the fastest pole that rings, each
#: decade of the others, and at most; samples at most
_PERIOD, _DECADE, _MOST = 40, 100, 200_000
#: relative distance of poles below which a divided difference is a derivative
_CLOSE = 1e-7


class Judge(Protocol):
    """A number that a stable loop has, in logarithms, with its gradient: what is minimised."""

    def value(self, K: Matrices, /) -> tuple[float, Any]:
        """Return the number, infinite when the loop is not stable, and its place."""

    def pieces(self, K: Matrices, by: FloatArray, place: Any, /, *, sweep: bool) -> Pieces:
        """Return logarithms of functions near it, the number of the place among them.

        `by` (n, rows, columns) are derivatives of [A, B; C, D] by the parameters; without `sweep`
        the place alone counts.
        """


class LoopObjective(Protocol):
    """What `design_structured` minimises; `Hinf`, `H2` and `PeakGain` are such values.

    A number of the loop from some w to some z, in multiples of `below` where that is given.
    """

    @property
    def below(self) -> float | None:
        """What the number is counted in; None for one objective alone."""

    def chosen(self, plant: StandardPlant, /) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of w and z."""

    def measured(self, closed: Any, /) -> float:
        """Return the number of a closed loop by another computation: it checks the claim."""

    def judges(self, plant: StandardPlant, order: int, /) -> Sequence[Judge]:
        """Return what finds the number, the largest of several, for controllers of an order."""


class GainJudge:
    """The H-infinity norm: peaks at several frequencies count together."""

    def __init__(self, p: Prepared, order: int) -> None:
        self.loop = ScaledLoop(p, order)

    def value(self, K: Matrices) -> tuple[float, float]:
        """Return the norm and its frequency."""
        return self.loop.gain(K)

    def pieces(self, K: Matrices, by: FloatArray, place: float, *, sweep: bool) -> Pieces:
        """Return the gains at this frequency, and where others are near them."""
        return self.loop.pieces(K, by, place, sweep=sweep)


class _SmoothJudge(ABC):
    """A number with one gradient, whose derivative is found by differences."""

    def __init__(self, p: Prepared, order: int) -> None:
        self.p, self.loop = p, ScaledLoop(p, order)

    @abstractmethod
    def found(self, loop: Closed) -> tuple[float, FloatArray]:
        """Return the number, and its derivative by the scaled controller."""

    def value(self, K: Matrices) -> tuple[float, None]:
        """Return the number."""
        loop = self.loop.stable(K)
        return (np.inf if loop is None else self.found(loop)[0]), None

    def pieces(self, K: Matrices, by: FloatArray, place: None, *, sweep: bool) -> Pieces:
        """Return the logarithm of the number."""
        value, gradient = self._logarithm(K, by)
        return Pieces(
            np.array([value]),
            gradient[None],
            cache(lambda _: self._bent(K, by)),
        )

    def _logarithm(self, K: Matrices, by: FloatArray) -> tuple[float, FloatArray]:
        loop = self.loop.stable(K)
        if loop is None:
            return np.inf, np.zeros(len(by))
        value, slope = self.found(loop)
        along = np.tensordot(by, self.loop.by_controller(slope), axes=2)
        return float(np.log(max(value, TINY))), along / max(value, TINY)

    def _bent(self, K: Matrices, by: FloatArray) -> FloatArray:
        """Return the second derivatives, for parameters that the controller is linear in."""
        rows = []
        for move in by:
            ends = [self._logarithm(K.moved(sign * _STEP * move), by)[1] for sign in (1.0, -1.0)]
            rows.append((ends[0] - ends[1]) / (2.0 * _STEP))
        H = np.array(rows)
        return np.asarray(0.5 * (H + H.T))


class H2Judge(_SmoothJudge):
    """The H2 norm by both Gramians.

    ``d trace(C P C') = 2 trace(Q P dA' + Q B dB' + C P dC')``. In the image of a sampled loop,
    ``z = (1 + a s) / (1 - a s)``, its norm is that of ``G(s) sqrt(T) / (1 + a s)``, a = T / 2: the
    angles of z are weighted as the frequencies of s are not.
    """

    def found(self, loop: Closed) -> tuple[float, FloatArray]:
        """Return the norm, and its derivative by the scaled controller."""
        n, m, speed = len(loop.A), loop.B.shape[1], self.p.speed
        A, B, C, scale = loop.A, loop.B, loop.C, np.sqrt(speed)
        if self.p.dt:
            a = 0.5 * speed * self.p.dt
            A = np.block([[A, B], [np.zeros((m, n)), -np.eye(m) / a]])
            B = np.vstack([np.zeros((n, m)), np.eye(m) / a])
            C, scale = np.hstack([C, loop.D]), np.sqrt(speed * self.p.dt)
        elif np.any(np.abs(loop.D) > ROUNDING):
            return np.inf, np.zeros((loop.Bu.shape[1], loop.Cy.shape[0]))
        P, Q = solve_lyapunov(A, B @ B.T), solve_lyapunov(A.T, C.T @ C)
        norm = float(np.sqrt(max(np.sum((C @ P) * C), TINY)))
        by_A, by_B, by_C = Q @ P / norm, Q @ B / norm, C @ P / norm
        parts = (by_A, by_B, by_C, np.zeros_like(loop.D))
        if self.p.dt:
            parts = (by_A[:n, :n], by_A[:n, n:], by_C[:, :n], by_C[:, n:])
        return scale * norm, scale * loop.slope(*parts)


class PeakJudge(_SmoothJudge):
    """The integral (sampled: the sum) of an absolute impulse response, one w to one z.

    ``int s(t) h(t) dt`` with the sign s of h is ``C S(A) B``, S a function of the poles; its
    derivative by A has divided differences of S between poles [Higham2008]_.
    """

    def found(self, loop: Closed) -> tuple[float, FloatArray]:
        """Return the sum, and its derivative by the scaled controller."""
        poles, V = np.linalg.eig(loop.A)
        poles, V = poles.astype(np.complex128), V.astype(np.complex128)
        c, b = (loop.C @ V)[0], np.linalg.solve(V, loop.B)[:, 0]
        a = 0.5 * self.p.speed * self.p.dt
        first, S, slope = (self._sampled if a else self._continuous)(poles, c * b, loop.D[0, 0], a)
        total = first * loop.D[0, 0] + float(np.real(np.sum(c * b * S)))
        apart = poles[:, None] - poles
        near = np.abs(apart) < _CLOSE * np.abs(poles)
        divided = np.where(near, 0.5 * (slope[:, None] + slope), S[:, None] - S)
        divided = divided / np.where(near, 1.0, apart)
        back = np.linalg.inv(V)
        by_A = np.real((V @ (divided * np.outer(b, c)) @ back).T)
        by_B = np.real((loop.C @ (V * S) @ back).T)
        by_C = np.real(((V * S) @ b)[None])
        return total, loop.slope(by_A, by_B, by_C, np.array([[first]]))

    @staticmethod
    def _sampled(
        poles: ComplexArray, residues: ComplexArray, direct: float, a: float
    ) -> tuple[float, ComplexArray, ComplexArray]:
        """Return the sign at once, and S and its derivative: a (z + 1) / (z - p) / (1 - a s)."""
        phi = 1.0 / (1.0 - a * poles)
        z = 2.0 * phi - 1.0
        slowest = float(np.max(np.abs(z), initial=0.0))
        count = min(int(_OVER / max(-np.log(max(slowest, TINY)), _OVER / _MOST)) + 2, _MOST)
        k = np.arange(count)[:, None]
        powers = z**k  # z^(k-1) of h[k], k from 1
        f = a * phi * (z + 1.0) * powers
        first = 1.0 if direct + float(np.real(np.sum(residues * a * phi))) >= 0 else -1.0
        s = np.where(np.real(f @ residues) >= 0, 1.0, -1.0)
        rise = 2.0 * a * phi**2  # dz / ds
        df = a * a * phi**2 * (z + 1.0) * powers
        inner = np.zeros_like(powers)
        inner[1:] = k[1:] * powers[:-1]
        df += a * phi * rise * (powers + (z + 1.0) * inner)
        return first, first * a * phi + s @ f, first * a * a * phi**2 + s @ df

    @staticmethod
    def _continuous(
        poles: ComplexArray, residues: ComplexArray, direct: float, a: float
    ) -> tuple[float, ComplexArray, ComplexArray]:
        """Return the sign at once, and S and its derivative over times that resolve all poles."""
        slow, fast = float(np.min(-poles.real)), float(np.max(np.abs(poles)))
        ringing = float(np.abs(poles.imag).max(initial=0.0))
        end = _OVER / slow
        even = min(int(_PERIOD * end * ringing / (2.0 * np.pi)) + 2, _MOST)
        decades = np.log10(end * fast) + 3.0
        t = np.union1d(
            np.linspace(0.0, end, even),
            np.geomspace(1e-3 / fast, end, int(_DECADE * max(decades, 1.0))),
        )
        t = np.union1d(t, _crossings(t, poles, residues))
        middle = 0.5 * (t[1:] + t[:-1])
        s = np.where(np.real(np.exp(np.outer(middle, poles)) @ residues) >= 0, 1.0, -1.0)
        e = np.exp(np.outer(t, poles))
        whole = e / poles
        # d/dp of e^(pt) / p
        bent = (t[:, None] - 1.0 / poles) * whole
        return (
            1.0 if direct >= 0 else -1.0,
            np.asarray(s @ np.diff(whole, axis=0)),
            np.asarray(s @ np.diff(bent, axis=0)),
        )


def _crossings(t: FloatArray, poles: ComplexArray, residues: ComplexArray) -> FloatArray:
    """Return where the response changes its sign, by secants."""
    h = np.real(np.exp(np.outer(t, poles)) @ residues)
    at = np.flatnonzero(h[1:] * h[:-1] < 0)
    low, high, before, after = t[at], t[at + 1], h[at], h[at + 1]
    return np.asarray(low + (high - low) * before / (before - after))


def problem_on(plant: StandardPlant, w: Sequence[str], z: Sequence[str]) -> Prepared:
    """Return the problem of some channels, ready for synthesis."""
    system = plant.system.select([*z, *plant.y], [*w, *plant.u])
    return prepared(system, plant.u, plant.y)


def require_finite_h2(plant: StandardPlant, w: Sequence[str], z: Sequence[str]) -> None:
    """Raise AssumptionError where white noise reaches z of a continuous plant at once."""
    direct = plant.system[list(z), list(w)].D
    if not plant.dt and np.any(direct):
        i, k = np.argwhere(direct)[0]
        raise AssumptionError(
            f"white noise on {w[k]} reaches {z[i]} at once: the H2 norm is infinite. Weight "
            "that w or z by a low-pass, leave one of them out, or sample the plant."
        )
