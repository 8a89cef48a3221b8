"""A closed loop by the parameters of its controller: norms, stability, and their derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray
from ...errors import AssumptionError
from ...lti.equations import solve_lyapunov
from ...lti.frequency_sweep import climbed_grid, local_maxima, resonance_grid
from ...lti.norms import peak_gain
from ...lti.response_solvers import responses
from ...lti.statespace import StateSpace
from ...plant import AnyPlant
from ...tolerances import CLOSE, NEGLIGIBLE, PRECISION, ROOT, ROUNDING, SPLIT, TINY
from ..preparation import Prepared, prepared
from .nonsmooth import Pieces

#: frequencies at which gains are sought, how often these are refined at peaks, and the part of the
#: largest gain from which on they count
_POINTS, _REFINEMENTS, PART = 60, 2, 0.5


class Matrices(NamedTuple):
    """A controller in continuous time (a sampled one by Tustin's rule)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def joined(self) -> FloatArray:
        """``[A, B; C, D]``."""
        return np.asarray(np.block([[self.A, self.B], [self.C, self.D]]))

    def moved(self, change: FloatArray) -> Matrices:
        """Return the controller with a change of `joined`."""
        k = len(self.A)
        new = self.joined + change
        return Matrices(new[:k, :k], new[:k, k:], new[k:, :k], new[k:, k:])


class ScaledLoop:
    """A prepared plant that a controller of k states is closed on.

    With ``K = [AK, BK; CK, DK]`` the loop is static feedback of the plant with k integrators, its
    matrices ``Acl = A + B Q C`` and so on, ``Q = (I - K D22)^-1 K``, and every change is
    ``dQ = (I - K D22)^-1 dK (I - D22 K)^-1``.
    """

    def __init__(self, p: Prepared, order: int) -> None:
        self.p, n, k = p, p.A.shape[0], order
        nu, ny = len(p.u), len(p.y)
        self.A = la.block_diag(p.A, np.zeros((k, k)))
        self.B1 = np.vstack([p.B1, np.zeros((k, p.B1.shape[1]))])
        self.C1 = np.hstack([p.C1, np.zeros((p.C1.shape[0], k))])
        self.B = np.block([[np.zeros((n, k)), p.B2], [np.eye(k), np.zeros((k, nu))]])
        self.C = np.block([[np.zeros((k, n)), np.eye(k)], [p.C2, np.zeros((ny, k))]])
        self.D11 = p.D11
        self.D12 = np.hstack([np.zeros((p.D12.shape[0], k)), p.D12])
        self.D21 = np.vstack([np.zeros((k, p.D21.shape[1])), p.D21])
        self.D22 = la.block_diag(np.zeros((k, k)), p.D22)
        slow = np.eye(k) / np.sqrt(p.speed)
        self._out = la.block_diag(slow, np.linalg.inv(p.u_scale))
        self._in = la.block_diag(slow, np.linalg.inv(p.y_scale))

    def closed(self, K: Matrices) -> Closed | None:
        """Return the loop with a controller in the user's units; None when it is not finite."""
        scaled = self._out @ K.joined @ self._in
        left = np.asarray(np.linalg.inv(np.eye(scaled.shape[0]) - scaled @ self.D22))
        right = np.asarray(np.linalg.inv(np.eye(scaled.shape[1]) - self.D22 @ scaled))
        Q = left @ scaled
        if not np.all(np.isfinite(Q)):
            return None
        return Closed(
            self.A + self.B @ Q @ self.C,
            self.B1 + self.B @ Q @ self.D21,
            self.C1 + self.D12 @ Q @ self.C,
            self.D11 + self.D12 @ Q @ self.D21,
            self.B @ left,
            right @ self.C,
            self.D12 @ left,
            np.asarray(right @ self.D21),
            self.D22 @ left,
        )

    def stability(self, K: Matrices) -> tuple[float, FloatArray, complex]:
        """Return the spectral abscissa [1], its gradient by [A, B; C, D], and the pole."""
        loop = self.closed(K)
        if loop is None:
            return np.inf, np.zeros((len(self._out), len(self._in))), complex(np.inf)
        found: Any = la.eig(loop.A, left=True, right=True)
        values, lefts, rights = found
        worst = int(np.argmax(values.real))
        y, x = lefts[:, worst], rights[:, worst]
        overlap = np.vdot(y, x)
        overlap = (
            overlap if abs(overlap) > ROUNDING else ROUNDING
        )  # a defective pole: any direction
        slope = np.real(np.outer((y.conj() @ loop.Bu) / overlap, loop.Cy @ x))
        by = self.by_controller(slope)
        return float(values[worst].real), by, complex(values[worst])

    def stable(self, K: Matrices) -> Closed | None:
        """Return the loop with a controller; None where it is not stable."""
        loop = self.closed(K)
        if loop is None or float(loop.system.poles().real.max(initial=-1.0)) >= -ROOT:
            return None
        return loop

    def by_controller(self, slope: FloatArray) -> FloatArray:
        """Return a derivative by the scaled [A, B; C, D] as one by that in the user's units."""
        return np.asarray(self._out.T @ slope @ self._in.T)


class Closed(NamedTuple):
    """A closed loop, and what changes of the controller do to it: from its outputs, to y."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    Bu: FloatArray
    Cy: FloatArray
    Du: FloatArray
    Dy: FloatArray
    Dyu: FloatArray

    def slope(self, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> FloatArray:
        """Return the derivative by the scaled controller, from those by the loop's matrices."""
        states = A @ self.Cy.T + B @ self.Dy.T
        return np.asarray(self.Bu.T @ states + self.Du.T @ (C @ self.Cy.T + D @ self.Dy.T))

    @property
    def system(self) -> StateSpace:
        """The loop from w to z."""
        return StateSpace(self.A, self.B, self.C, self.D)

    def high(self) -> FloatArray:
        """Return frequencies at which gains are high: those of a sweep, and of peaks."""
        system = self.system
        first = np.append(0.0, resonance_grid(system.poles(), 0.0, points=_POINTS, around=(0.0,)))

        def gains(freq: FloatArray) -> FloatArray:
            all_ = np.moveaxis(responses(system, freq), 2, 0)
            return np.asarray(np.linalg.norm(all_, 2, axis=(1, 2)))

        freq, gain = climbed_grid(gains, first, _REFINEMENTS)
        chosen = np.isin(freq, first)
        chosen[local_maxima(gain)] = True
        chosen &= gain >= PART * gain.max()
        return np.asarray(freq[chosen])

    def channels(self, freq: FloatArray, order: int = 0) -> tuple[ComplexArray, ...]:
        """Return the responses of w and u to z and y, (k, ., .): zu, yw, zw, yu."""
        # their derivatives by the angular frequency for order 1 and 2
        B, C = np.hstack([self.B, self.Bu]), np.vstack([self.C, self.Cy])
        D = np.block([[self.D, self.Du], [self.Dy, self.Dyu]])
        p, m, n = self.D.shape[0], self.D.shape[1], self.A.shape[0]
        all_: ComplexArray = np.zeros((freq.size, *D.shape), dtype=np.complex128)
        finite = np.isfinite(freq)
        if n and np.any(finite):
            resolvent = 2j * np.pi * freq[finite, None, None] * np.eye(n) - self.A
            X = np.linalg.solve(resolvent, np.broadcast_to(B, (resolvent.shape[0], *B.shape)))
            for power in range(1, order + 1):
                X = -1j * power * np.linalg.solve(resolvent, X)
            all_[finite] = C @ X
        all_ = all_ if order else all_ + D
        return all_[:, :p, m:], all_[:, p:, :m], all_[:, :p, :m], all_[:, p:, m:]

    def hessian(self, freq: float, which: int, by: FloatArray) -> FloatArray:
        """Return the second derivatives (n, n) of the logarithm of a singular value."""
        # `T(K + dK) = T + To dK (I - G dK)^-1 Ti`; the singular value s of u and v changes by
        # `Re u* T'' v`, and by the parts of `T' v` and `T'* u` along the others, over their
        # distances to s. At a peak also by the frequency's way to the peak of the changed loop
        at = np.array([freq])
        (o, i, T, G), (o1, i1, T1, _) = (
            [part[0] for part in self.channels(at, order)] for order in (0, 1)
        )
        U, S, Vh = np.linalg.svd(T)
        V, size, count = Vh.conj().T, S[which], by.shape[0]
        u, v = U[:, which], V[:, which]
        lefts = np.einsum("r,nrc->nc", u.conj() @ o, by)
        rights = np.einsum("nrc,c->nr", by, i @ v)
        # changes of T by each parameter, and by the frequency last
        onto_u = np.hstack([U.conj().T @ o @ rights.T, (U.conj().T @ T1 @ v)[:, None]])
        onto_v = np.hstack([(lefts @ i @ V).conj().T, (u.conj() @ T1 @ V).conj()[:, None]])
        turn = np.einsum("r,nrc,c->n", u.conj() @ o1, by, i @ v) + lefts @ (i1 @ v)
        bend = u.conj() @ self.channels(at, 2)[2][0] @ v
        H = np.zeros((count + 1, count + 1))
        own = 2.0 * (lefts @ G @ rights.T).real
        H[:count, :count] = 0.5 * (own + own.T)
        H[:count, count] = H[count, :count] = turn.real
        H[count, count] = bend.real
        weigh = partial(_squares, size=size)
        H += weigh(onto_u[which : which + 1].imag, np.ones(1))
        later = slice(which + 1, S.size)  # those above are not its own to push away
        apart = np.maximum(size - S[later], CLOSE * size) / size
        H += weigh(onto_u[later] + onto_v[later], 0.5 / apart)
        H += weigh(onto_u[later] - onto_v[later], 0.5 / (1.0 + S[later] / size))
        for rest in (onto_u[S.size :], onto_v[S.size :]):
            H += weigh(rest, np.ones(rest.shape[0]))
        rise, turning, bending = onto_u[which, -1].real, H[:count, count], H[count, count]
        H = H[:count, :count]
        if bending < 0.0 and rise * rise < -2.0 * bending * NEGLIGIBLE * size:
            H = H - np.outer(turning, turning) / bending
        slope = onto_u[which, :count].real / size
        return np.asarray(H / size - np.outer(slope, slope))


def _squares(rows: ComplexArray | FloatArray, weights: FloatArray, size: float) -> FloatArray:
    """Return ``sum_j w_j Re(r_j* r_j) / size``."""
    return np.asarray((rows.conj().T * (weights / size) @ rows).real)


#: step of the controller, in parameters of size 1, of a central difference: its own error is that
#: of rounding
STEP = float(np.cbrt(PRECISION))
#: time constants of the slowest pole after which an impulse response is over: the rest is rounding
OVER = -float(np.log(ROUNDING))
#: points of the times at which its sign is taken: a period of the fastest pole that rings, each
#: decade of the others, and at most; samples at most
_PERIOD, _DECADE, _MOST = 40, 100, 200_000
#: Newton's steps from a secant's crossing, in error by 1e-3 of a period, to rounding
_NEWTON = 2


class Judge(Protocol):
    """Interface of objects that compute the number `design_structured` minimises, such as a norm.

    The number is the largest of many smooth functions of the controller, such as the gains at all
    frequencies. The place of a function identifies it, and is for example its frequency. The search
    minimises the logarithm of the number and uses gradients. The judge receives controllers K, with
    the matrices A, B, C and D, in the user's units. An objective makes its judge from the
    problem p, in which `design_structured` has scaled the plant: one unit of its time is
    ``1 / p.speed`` seconds. A judge that works on the matrices of p must therefore convert its
    number to the user's units.
    """

    def value(self, K: Matrices, /) -> tuple[float, Any]:
        """Return the number (infinite for an unstable loop), and the place of its function."""

    def pieces(self, K: Matrices, by: FloatArray, place: Any, /, *, sweep: bool) -> Pieces:
        """Return the logarithms of the functions that are close to the largest, with gradients.

        The array `by` (n, rows, columns) holds the derivatives of [A, B; C, D] with respect to the
        n parameters. The function at `place` is always included. If `sweep` is False, no other
        function is.
        """


class LoopObjective(Protocol):
    """Objective of `design_structured`: `Hinf`, `H2`, `PeakGain` or a `MeasuredObjective`.

    It is a number of the loop from some w to some z, in multiples of `below` where that is given.
    Your own objective derives from `MeasuredObjective`.
    """

    @property
    def below(self) -> float | None:
        """What the number is counted in; None for one objective alone."""

    def chosen(self, plant: AnyPlant, /) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of w and z."""

    def measured(self, closed: Any, /) -> float:
        """Return the number of a closed loop by another computation: it checks the claim."""

    def judges(self, plant: AnyPlant, order: int, /) -> Sequence[Judge]:
        """Return what finds the number, the largest of several, for controllers of an order."""


class GainJudge(ScaledLoop):
    """The H-infinity norm: peaks at several frequencies count together."""

    def value(self, K: Matrices) -> tuple[float, float]:
        """Return the H-infinity norm, infinite when the loop is not stable, and its frequency."""
        loop = self.stable(K)
        return (np.inf, 0.0) if loop is None else peak_gain(loop.system)

    def pieces(self, K: Matrices, by: FloatArray, freq: float, *, sweep: bool) -> Pieces:
        """Return the logarithms of the gains at a frequency, and where others are near them."""
        loop = self.closed(K)
        assert loop is not None  # noqa: S101 - K stabilises
        by = self._out @ by @ self._in
        places = np.append(loop.high() if sweep else np.zeros(0), freq)
        o, i, T, _ = loop.channels(places)
        U, S, Vh = np.linalg.svd(T, full_matrices=False)
        counted = PART * S[-1, 0] <= S
        counted[-1, 0] = True
        at, which = np.nonzero(counted)
        value = S[at, which]
        alpha = np.einsum("kp,kpr->kr", U[at, :, which].conj(), o[at])
        beta = np.einsum("kcm,km->kc", i[at], Vh[at, which].conj())
        slope = np.einsum("kr,kc->krc", alpha, beta).real / value[:, None, None]
        return Pieces(
            np.log(value),
            np.tensordot(slope, by, axes=([1, 2], [1, 2])),
            cache(lambda j: loop.hessian(float(places[at[j]]), int(which[j]), by)),
        )


class SmoothJudge(ScaledLoop, ABC):
    """A number with one gradient, whose derivative is found by differences."""

    @abstractmethod
    def found(self, loop: Closed) -> tuple[float, FloatArray]:
        """Return the number, and its derivative by the scaled controller."""

    def value(self, K: Matrices) -> tuple[float, None]:
        """Return the number."""
        loop = self.stable(K)
        return (np.inf if loop is None else self.found(loop)[0]), None

    def pieces(self, K: Matrices, by: FloatArray, place: None, *, sweep: bool) -> Pieces:
        """Return the logarithm of the number."""
        value, gradient = self._logarithm(K, by)
        return Pieces(np.array([value]), gradient[None], cache(lambda _: self._bent(K, by)))

    def _logarithm(self, K: Matrices, by: FloatArray) -> tuple[float, FloatArray]:
        loop = self.stable(K)
        if loop is None:
            return np.inf, np.zeros(len(by))
        value, slope = self.found(loop)
        along = np.tensordot(by, self.by_controller(slope), axes=2)
        return float(np.log(max(value, TINY))), along / max(value, TINY)

    def _bent(self, K: Matrices, by: FloatArray) -> FloatArray:
        """Return the second derivatives, for parameters that the controller is linear in."""
        up, down = (
            np.array([self._logarithm(K.moved(step * move), by)[1] for move in by])
            for step in (STEP, -STEP)
        )
        H = (up - down) / (2.0 * STEP)
        return np.asarray(0.5 * (H + H.T))


class H2Judge(SmoothJudge):
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
        by_A, by_B, by_C, by_D = Q @ P / norm, Q @ B / norm, C @ P / norm, np.zeros_like(loop.D)
        if self.p.dt:
            by_A, by_B, by_C, by_D = by_A[:n, :n], by_A[:n, n:], by_C[:, :n], by_C[:, n:]
        return scale * norm, scale * loop.slope(by_A, by_B, by_C, by_D)


class PeakJudge(SmoothJudge):
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
        near = np.abs(apart) < SPLIT * np.abs(poles)  # a divided difference is a derivative there
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
        count = min(int(OVER / max(-np.log(max(slowest, TINY)), OVER / _MOST)) + 2, _MOST)
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
        end = OVER / slow
        even = min(int(_PERIOD * end * ringing / (2.0 * np.pi)) + 2, _MOST)
        decades = np.log10(end * fast) + 3.0
        t = np.union1d(
            np.linspace(0.0, end, even),
            # before the fastest pole acts
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
    """Return where the response changes its sign, by secants and Newton's steps."""
    # the value's error is of second order in that of a crossing, but the gradient's of first order
    h = np.real(np.exp(np.outer(t, poles)) @ residues)
    at = np.flatnonzero(h[1:] * h[:-1] < 0)
    low, high, before, after = t[at], t[at + 1], h[at], h[at + 1]
    found = low + (high - low) * before / (before - after)
    for _ in range(_NEWTON):
        e = np.exp(np.outer(found, poles))
        step = np.real(e @ residues) / np.real(e @ (poles * residues))
        found = np.clip(found - step, low, high)
    return np.asarray(found)


def problem_on(plant: AnyPlant, w: Sequence[str], z: Sequence[str]) -> Prepared:
    """Return the problem of some channels, ready for synthesis."""
    system = plant.system.select([*z, *plant.y], [*w, *plant.u])
    return prepared(system, plant.u, plant.y)


def require_finite_h2(plant: AnyPlant, w: Sequence[str], z: Sequence[str]) -> None:
    """Raise AssumptionError where white noise reaches z of a continuous plant at once."""
    direct = plant.system[list(z), list(w)].D
    if not plant.dt and np.any(direct):
        i, k = np.argwhere(direct)[0]
        raise AssumptionError(
            f"white noise on {w[k]} reaches {z[i]} at once: the H2 norm is infinite. Weight "
            "that w or z by a low-pass, leave one of them out, or sample the plant."
        )
