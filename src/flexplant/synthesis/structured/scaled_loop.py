"""The closed loop of a controller with parameters: its gains, its stability, their derivatives."""

from __future__ import annotations

from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import ComplexArray, FloatArray
from ...lti.frequency_sweep import climbed_grid, resonance_grid
from ...lti.norms import peak_gain
from ...lti.preparation import Prepared
from ...lti.responses import responses
from ...lti.statespace import StateSpace
from .nonsmooth import Pieces

#: a loop counts as stable with this decay, in the scaled unit of time
DECAY = 1e-7
#: frequencies at which gains are sought, how often these are refined at peaks, and the part of the
#: largest gain from which on they count
_POINTS, _REFINEMENTS, _PART = 60, 2, 0.5
#: singular values of one frequency that count
_SINGULAR = 3
#: relative: singular values as close as this are taken as apart by it (the gradient of the other
#: is in the model too)
_APART = 1e-2
#: relative: a frequency is that of a peak where the parabola there rises no further
_PEAK = 1e-3


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
        n, k = p.A.shape[0], order
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
            rows, columns = self._out.shape[0], self._in.shape[0]
            return np.inf, np.zeros((rows, columns)), complex(np.inf)
        found: Any = la.eig(loop.A, left=True, right=True)
        values, lefts, rights = found
        worst = int(np.argmax(values.real))
        y, x = lefts[:, worst], rights[:, worst]
        overlap = np.vdot(y, x)
        overlap = overlap if abs(overlap) > 1e-12 else 1e-12  # a defective pole: any direction
        slope = np.real(np.outer((y.conj() @ loop.Bu) / overlap, loop.Cy @ x))
        by = self.by_controller(slope)
        return float(values[worst].real), by, complex(values[worst])

    def stable(self, K: Matrices) -> Closed | None:
        """Return the loop with a controller; None where it is not stable."""
        loop = self.closed(K)
        if loop is None or float(loop.system.poles().real.max(initial=-1.0)) >= -DECAY:
            return None
        return loop

    def by_controller(self, slope: FloatArray) -> FloatArray:
        """Return a derivative by the scaled [A, B; C, D] as one by that in the user's units."""
        return np.asarray(self._out.T @ slope @ self._in.T)

    def gain(self, K: Matrices) -> tuple[float, float]:
        """Return the H-infinity norm, infinite when the loop is not stable, and its frequency."""
        loop = self.stable(K)
        return (np.inf, 0.0) if loop is None else peak_gain(loop.system)

    def pieces(self, K: Matrices, jacobian: FloatArray, freq: float, *, sweep: bool) -> Pieces:
        """Return the logarithms of the gains at a frequency, and where others are near them."""
        loop = self.closed(K)
        assert loop is not None  # noqa: S101 - K stabilises
        by = self._out @ jacobian @ self._in
        places = np.append(loop.high() if sweep else np.zeros(0), freq)
        o, i, T, _ = loop.channels(places)
        U, S, Vh = np.linalg.svd(T, full_matrices=False)
        counted = S[:, :_SINGULAR] >= _PART * S[-1, 0]
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
        beside = np.concatenate([[-np.inf], gain, [-np.inf]])
        peak = (gain >= beside[:-2]) & (gain >= beside[2:])
        chosen = (peak | np.isin(freq, first)) & (gain >= _PART * gain.max())
        return np.asarray(freq[chosen])

    def channels(self, freq: FloatArray, order: int = 0) -> tuple[ComplexArray, ...]:
        """Return the responses of w and u to z and y, (k, ., .): zu, yw, zw, yu.

        Their derivatives by the angular frequency for order 1 and 2.
        """
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
        """Return the second derivatives (n, n) of the logarithm of a singular value.

        ``T(K + dK) = T + To dK (I - G dK)^-1 Ti``; the singular value s of u and v changes by
        ``Re u* T'' v``, and by the parts of ``T' v`` and ``T'* u`` along the others, over their
        distances to s. At a peak also by the frequency's way to the peak of the changed loop.
        """
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
        apart = np.maximum(size - S[later], _APART * size) / size
        H += weigh(onto_u[later] + onto_v[later], 0.5 / apart)
        H += weigh(onto_u[later] - onto_v[later], 0.5 / (1.0 + S[later] / size))
        for rest in (onto_u[S.size :], onto_v[S.size :]):
            H += weigh(rest, np.ones(rest.shape[0]))
        rise, turning, bending = onto_u[which, -1].real, H[:count, count], H[count, count]
        H = H[:count, :count]
        if bending < 0.0 and rise * rise < -2.0 * bending * _PEAK * size:
            H = H - np.outer(turning, turning) / bending
        slope = onto_u[which, :count].real / size
        return np.asarray(H / size - np.outer(slope, slope))


def _squares(rows: ComplexArray | FloatArray, weights: FloatArray, size: float) -> FloatArray:
    """Return ``sum_j w_j Re(r_j* r_j) / size``."""
    return np.asarray((rows.conj().T * (weights / size) @ rows).real)
