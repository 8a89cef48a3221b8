"""Lower bounds on gamma that hold for every controller, whatever method found one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray, divisor
from ...errors import SolverError
from ...lti.equations import OnAxisError, stabilising
from ...lti.frequency_sweep import (
    DRAWN,
    POINTS,
    ROUNDS,
    SOUGHT,
    highest,
    largest_gains,
    resonance_grid,
)
from ...lti.response_solvers import responses
from ...lti.statespace import StateSpace
from ...lti.zeros import axis_zeros
from ...tolerances import FOUR_DIGITS, NEGLIGIBLE, RANK, SAME, SPLIT
from ..preparation import Prepared

#: a gap between gamma and the bound that is left as it is: methods stay up to 5 % away
_CLOSE = 0.0525


def raised_bound(problem: Prepared, gamma: float, known: float, close: float = _CLOSE) -> float:
    """Return a known lower bound on what controllers reach, raised where it is far from gamma."""
    # by single frequencies, the zeros on the imaginary axis, and the Riccati equations, in turn
    if known * (1.0 + close) < gamma:
        known = max(known, pointwise_bound(problem))
    if known * (1.0 + close) < gamma:
        known = max(known, zero_bound(problem))
    if known * (1.0 + close) < gamma:
        known = relaxed_bound(problem, gamma, known)
    return min(known, gamma)


def pointwise_bound(problem: Prepared, coarse: bool = False) -> float:
    """Return what no controller undercuts at some frequency, nor by the feedthrough."""
    # Parrott: at s = j omega the loop's gain is at least that of Pzw on the outputs which u cannot
    # reach, `N_z' Pzw` with N_z' Pzu = 0, and on the inputs which y does not show, `Pzw N_w` with
    # Pyw N_w = 0
    m1, p1 = problem.B1.shape[1], problem.C1.shape[0]
    system = problem.system
    poles = system.poles()
    around, points = (SOUGHT, POINTS // 2) if coarse else (DRAWN, POINTS)
    grid = np.append(0.0, resonance_grid(poles, 0.0, points=points, around=around))
    undamped = poles[np.abs(poles.real) <= SPLIT * np.max(np.abs(poles), initial=1.0)]
    apart = np.abs(2.0 * np.pi * grid[:, None] - np.abs(undamped.imag))
    grid = grid[np.all(apart > SPLIT * (1.0 + np.abs(undamped.imag)), axis=1)]

    def bounds(freq: FloatArray) -> FloatArray:
        P = np.ascontiguousarray(np.moveaxis(responses(system, freq), 2, 0))
        Pzw, seen = P[:, :p1, :m1], _adjoint(P[:, p1:, :m1])
        return np.maximum(_perp_norms(P[:, :p1, m1:], Pzw), _perp_norms(seen, _adjoint(Pzw)))

    # no frequency is left where all poles are as good as zero next to the loop's speed
    swept = highest(bounds, grid, ROUNDS)[0] if grid.size else 0.0
    return max(swept, *(one.direct for one in both_sides(problem)))


def zero_bound(p: Prepared) -> float:
    """Return what no controller undercuts at the zeros of u -> z, and of w -> y, on the axis."""
    return max(map(_bound_at_zeros, both_sides(p)))


def _bound_at_zeros(side: FullInformation) -> float:
    """Return the largest ``|x' B1 + z' D11| / |z|`` with ``[x' z'] [A - s I, B2; C, D12] = 0``."""
    # z' z(s) = (x' B1 + z' D11) w(s) in any stable loop: x' times the equation of motion added
    A, B1, B2, C, D11, D12, _ = side
    n, outputs = A.shape[0], C.shape[0]
    # the pencil of fewer outputs than inputs loses rank where its transpose does
    tall = outputs >= B2.shape[1]
    zeros = axis_zeros(StateSpace(A, B2, C, D12) if tall else StateSpace(A.T, C.T, B2.T, D12.T))
    found = 0.0
    for s in zeros:
        pencil = np.block([[A - s * np.eye(n), B2], [C, D12]])
        pencil = pencil / divisor(np.linalg.norm(pencil, axis=0))
        rows = divisor(np.linalg.norm(pencil, axis=1))
        left, values, _ = np.linalg.svd(pencil / rows[:, None])
        rank = int(np.count_nonzero(values > SAME))
        null = (left[:, rank:] / rows[:, None]).conj().T
        driven = null @ np.vstack([B1, D11])
        turn, sizes, _ = np.linalg.svd(null[:, n:], full_matrices=False)
        if 0 < sizes.size == len(null) and sizes[-1] > SAME * sizes[0]:
            found = max(found, float(np.linalg.norm(turn.conj().T @ driven / sizes[:, None], 2)))
    return found


def _perp_norms(M: ComplexArray, Pzw: ComplexArray) -> FloatArray:
    """Return the norms of Pzw on what is perpendicular to the columns of M; bounds off the peak."""
    # its dimension is that of M of full rank: more would hang on rounding
    if M.shape[1] <= M.shape[2]:
        return np.zeros(M.shape[0])
    # a basis of the rest: Pzw minus its part along M cancels where an undamped mode makes it large
    rest = np.linalg.qr(M, mode="complete")[0][:, :, M.shape[2] :]
    return largest_gains(np.moveaxis(_adjoint(rest) @ Pzw, 0, 2))


def _adjoint(M: ComplexArray | FloatArray) -> ComplexArray:
    return np.asarray(M.conj().swapaxes(1, 2), dtype=np.complex128)


class FullInformation(NamedTuple):
    """``x1' = A x1 + B1 w + B2 v``, ``z = C x1 + D11 w + D12 v``, all states known; x1 = T' x.

    Whatever a controller does to the plant can be done here, so that no norm is larger.
    """

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C: FloatArray
    D11: FloatArray
    D12: FloatArray
    T: FloatArray

    @property
    def direct(self) -> float:
        """The least norm that D11 and D12 alone allow."""
        beyond = self.D11 - self.D12 @ np.linalg.lstsq(self.D12, self.D11, rcond=None)[0]
        return float(np.linalg.norm(beyond, 2)) if beyond.size else 0.0

    def solution(self, gamma: float) -> tuple[FloatArray, FloatArray]:
        """Return X and its gain: the sup over w of the inf over v of |z|^2 - |gamma w|^2 is x' X x.

        D12 has full rank.
        """
        D, m1 = np.hstack([self.D11, self.D12]), self.D11.shape[1]
        R = D.T @ D
        R[np.arange(m1), np.arange(m1)] -= gamma**2
        B = np.hstack([self.B1, self.B2])
        return stabilising(self.A, B, self.C.T @ self.C, R, self.C.T @ D)

    def least_squares(self) -> tuple[FloatArray, FloatArray]:
        """Return X and its gain where w is zero: the least integral of |z|^2 is x' X x."""
        return self._replace(B1=self.B1[:, :0], D11=self.D11[:, :0]).solution(1.0)

    def refutes(
        self, X: FloatArray, F: FloatArray, values: FloatArray, vectors: FloatArray
    ) -> bool:
        """Return whether a solution with its gain has a negative eigenvalue beyond rounding."""
        if not X.size or values[0] >= -FOUR_DIGITS * max(values[-1], -values[0]):
            return False
        # a residual of the equation moves X by the residual divided by twice the slowest decay
        x = vectors[:, 0]
        terms = np.sum(self.C**2) + 2.0 * np.linalg.norm(X @ x) * np.linalg.norm(self.A @ x)
        poles = la.eigvals(self.A + np.hstack([self.B1, self.B2]) @ F)
        return bool(values[0] < -RANK * terms / np.min(np.abs(poles.real)))

    def regular(self) -> FullInformation:
        """Return the problem in which D12 has full rank."""
        # directions of u that z does not contain move some states at any speed at no cost: these
        # states become inputs, with their columns of A and C; and again, until none is free
        A, B1, B2, C, D11, D12, T = self
        while B2.shape[1]:
            sizes = np.linalg.norm(np.vstack([B2, D12]), axis=0)
            B2, D12 = B2 / divisor(sizes), D12 / divisor(sizes)
            _, values, turn = la.svd(D12, full_matrices=True)
            rank = int(np.count_nonzero(values > SAME))
            if rank == D12.shape[1]:
                break
            free = B2 @ turn[rank:].T
            basis, moved, _ = la.svd(free, full_matrices=True)
            count = int(np.count_nonzero(moved > SAME * max(np.max(moved, initial=0.0), 1.0)))
            left, fast = basis[:, count:], basis[:, :count]
            B2 = left.T @ np.hstack([A @ fast, B2 @ turn[:rank].T])
            D12 = np.hstack([C @ fast, D12 @ turn[:rank].T])
            A, B1, C, T = left.T @ A @ left, left.T @ B1, C @ left, T @ left
        return FullInformation(A, B1, B2, C, D11, D12, T)


def both_sides(p: Prepared) -> tuple[FullInformation, FullInformation]:
    """Return a problem with all states known, and its dual: what y is for u."""
    T = np.eye(p.A.shape[0])
    return (
        FullInformation(p.A, p.B1, p.B2, p.C1, p.D11, p.D12, T),
        FullInformation(p.A.T, p.C1.T, p.C2.T, p.B1.T, p.D11.T, p.D21.T, T),
    )


def relaxed_bound(p: Prepared, gamma: float, known: float) -> float:
    """Return the largest gamma, up to the one reached, that is refuted for every controller."""
    # where ||w -> z|| < gamma is reached, it is reached with a little noise and effort added too.
    # Their Riccati equations have solutions X and Y with rho(X Y) < gamma^2, which are at least the
    # values of the same problem with all states known and free states as inputs, and of its dual.
    # [Stoorvogel1992]_ (the two quadratic matrix inequalities of singular problems)
    sides = [side.regular() for side in both_sides(p)]
    low = max(known, *(one.direct for one in sides))
    # gamma is tried just below the value after a back-off, then with squares of that fraction until
    # one is refuted; then intervals are halved
    high, part = gamma, 1.0 / (1.0 + _CLOSE)
    while high > low * (1.0 + NEGLIGIBLE) and (low > 0.0 or part > NEGLIGIBLE):
        middle = max(part * gamma, float(np.sqrt(low * high)))
        part *= part
        if _refuted(sides, middle):
            low = middle
        else:
            high = middle
    return min(low, gamma)


def _refuted(sides: Sequence[FullInformation], gamma: float) -> bool:
    """Return whether a gamma is refuted for one side, or for both together."""
    values = []
    for one in sides:
        try:
            X, F = one.solution(gamma)
        except (OnAxisError, SolverError, la.LinAlgError):  # this side says nothing of that gamma
            continue
        if one.refutes(X, F, *la.eigh(X)):
            return True
        values.append(one.T @ X @ one.T.T)
    if len(values) < 2:
        return False
    return bool(coupling(*values).max(initial=0.0) > gamma**2 * (1.0 + FOUR_DIGITS))


def coupling(X: FloatArray, Y: FloatArray) -> FloatArray:
    """Return the eigenvalues of X Y, real where X or Y is semidefinite."""
    return np.asarray(la.eigvals(X @ Y).real)
