"""An upper bound over all frequencies: scalings that hold on intervals, until these cover the axis.

Scalings of one frequency hold on the interval around it in which ``F(j omega) > 0``. F is singular
where a Hamiltonian matrix has an eigenvalue j omega, so the interval ends there, not at a grid
point: no peak between frequencies is missed [Lawrence2000]_.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import ComplexArray, FloatArray
from ...errors import SolverError
from ...lti.equations import state_scale
from ...lti.responses import responder
from ...lti.statespace import StateSpace
from ...parallel import tick
from ...tolerances import ROUNDING, TINY
from .uncertainty_blocks import Block, Scalings, block_places
from .upper import WIDE, centred, reached_level, simple_bound, upper_level

#: relative distance of the level to the largest upper bound found at a frequency
_ABOVE = 5e-3
#: what a bar calls the intervals of frequency that are covered
INTERVALS = "intervals of frequency"
#: intervals at most; larger systems are covered by sampling instead of Hamiltonians
_INTERVALS, _LARGE = 3000, 260
#: sampling within an interval, in half widths of the resonances, and for the rest of it
_BESIDE = np.array([0.0, 0.15, 0.4, 0.8, 1.5, 3.0, 6.0])
_POINTS = 24
#: an eigenvalue this close to the axis, relative to the Hamiltonian, counts as lying on it
_ON_AXIS = 1e-9
#: growth of the heights over an interval that is tried at once, the last if need be
_GROWTH = (3.0, 1.3, 1.03)

#: the largest heights (w,) of the columns of M between two frequencies [rad/s]
Heights = Callable[[float, float], FloatArray]


class Interval(NamedTuple):
    """Frequencies [rad/s] between which some scalings hold."""

    low: float
    high: float


@dataclass(frozen=True)
class Covered:
    """What covers the frequency axis.

    ``level`` is mu^2 (of a skewed problem gain^2) from above; `omega` [rad/s] is where the largest
    bound of one frequency was found, `frequencies`, `bounds` those that were computed.
    """

    level: float
    omega: float
    frequencies: FloatArray
    bounds: FloatArray
    intervals: int
    by_hamiltonian: bool


@dataclass
class _Cover:
    """The state of the search; continuous M, its time in rad/s."""

    M: StateSpace
    blocks: Sequence[Block]
    leveled: Sequence[bool] | None = None
    heights: Heights | None = None
    least: float = 0.0
    accuracy: float = _ABOVE

    def __post_init__(self) -> None:
        g = self.M
        d = state_scale(g.A, g.B, g.C)
        self.A, self.B, self.C, self.D = g.A * d / d[:, None], g.B / d[:, None], g.C * d, g.D
        self.scalings = Scalings(self.blocks, self.leveled)
        self.where = block_places(self.blocks)
        self.respond = responder(g)
        poles = g.poles()
        self.poles = poles[poles.imag >= 0]
        self.level = self.least
        self.omega = 0.0
        self.found: list[tuple[float, float]] = []
        self.gaps: list[Interval] = [Interval(0.0, np.inf)]
        self.last: list[tuple[float, FloatArray]] = []
        self.by_hamiltonian = self.A.shape[0] <= _LARGE

    def at(self, omega: FloatArray) -> ComplexArray:
        """Return M without heights (n, z, w)."""
        return np.moveaxis(self.respond(omega / (2 * np.pi)), 2, 0)

    def tall(self, low: float, high: float) -> FloatArray:
        """Return the factors of the columns between two frequencies."""
        return np.ones(self.B.shape[1]) if self.heights is None else self.heights(low, high)

    def run(self) -> Covered:
        self._start()
        count = 0
        while self.gaps:
            count += 1
            tick(INTERVALS)
            if count > _INTERVALS:
                raise SolverError(
                    f"the frequency axis was not covered by {_INTERVALS} intervals; what is left "
                    f"lies at {self.gaps[0].low / (2 * np.pi):.6g} Hz. A pole of the closed loop "
                    "is too close to the edge of stability there: add damping or loosen the loop."
                )
            gap = self.gaps.pop()
            done = self._certified(gap)
            if not np.isfinite(self.level):
                break
            if done.low > gap.low:
                self.gaps.append(Interval(gap.low, done.low))
            if done.high < gap.high:
                self.gaps.append(Interval(done.high, gap.high))
        frequencies, bounds = np.array(sorted(self.found)).T
        return Covered(
            self.level, self.omega, frequencies, bounds, count, self.by_hamiltonian
        )  # fmt: skip

    def _start(self) -> None:
        """Raise the level to what the most prominent frequencies need."""
        size, swing = np.abs(self.poles), self.poles.imag
        tried = np.unique(np.concatenate([[0.0], swing, size]))
        M = self.at(tried)
        simple = np.array([
            simple_bound(one * self.tall(w, w), self.where)
            for one, w in zip(M, tried, strict=True)
        ])  # fmt: skip
        for i in np.argsort(-simple)[:6]:
            self._raise(M[i] * self.tall(tried[i], tried[i]), float(tried[i]))

    def _raise(self, M: ComplexArray, omega: float) -> FloatArray:
        """Return scalings that hold at a frequency; the level is raised where it is too low."""
        near = min(self.last, key=lambda one: abs(one[0] - omega))[1] if self.last else None
        enough = 0.97 * self.level
        found = upper_level(M, self.scalings, near, enough=enough, widest=WIDE)
        has_G = np.any(self.scalings.of_G) and not self.scalings.skewed
        if found.level > enough and has_G:  # the level is raised only by what no G lowers
            freer = upper_level(M, self.scalings, found.x, enough=enough)
            found = min(found, freer, key=itemgetter(0))
        self.found.append((omega, found.level))
        if not found.level * (1 + self.accuracy) ** 2 <= self.level:
            self.level = max(self.level, found.level * (1 + self.accuracy) ** 2)
            self.omega = omega
        if np.isfinite(self.level):
            self.last = [*self.last[-30:], (omega, found.x)]
        return found.x

    def _certified(self, gap: Interval) -> Interval:
        """Return an interval within a gap in which scalings hold at the level."""
        omega = self._chosen(gap)
        M = self.at(np.array([omega]))[0]
        near = min(self.last, key=lambda one: abs(one[0] - omega))[1] if self.last else None
        x = None
        for growth in _GROWTH[-1:] if self.heights is None else _GROWTH:
            tried = self._tried(gap, omega, growth)
            tall = self.tall(*tried)
            W = np.vstack([np.eye(self.scalings.w), M * tall])
            if near is not None and reached_level(W, self.scalings, near) < 0.995 * self.level:
                x = near
                break
        if x is None:
            x = self._raise(M * tall, omega)
            if not np.isfinite(self.level):
                return tried
            x = centred(W, self.scalings, x, self.level, steps=12)
        own = Interval(omega, omega)
        ends = self._holds(x, tall, tried, omega)
        if ends.low >= own.low and ends.high <= own.high:
            # rounding leaves nothing: take what lies within rounding of the frequency
            width = max(1e-9 * omega, 1e-12 * float(np.abs(self.poles).max(initial=1.0)))
            ends = Interval(max(omega - width, tried.low), min(omega + width, tried.high))
        if ends.low > tried.low or ends.high < tried.high:
            self.last = [*self.last[-30:], (omega, x)]
        return ends

    def _chosen(self, gap: Interval) -> float:
        """Return a frequency inside a gap: a resonance, or its middle."""
        if gap.low == 0.0 and np.isinf(gap.high):
            return float(self.omega)
        top = 4.0 * float(np.abs(self.poles).max(initial=1.0))
        if np.isinf(gap.high):
            return max(4.0 * gap.low, top)
        inside = self.poles.imag[(self.poles.imag > gap.low) & (self.poles.imag < gap.high)]
        if gap.low == 0.0 and not inside.size:
            return 0.0 if not self._has(0.0) else 0.5 * gap.high
        middle = np.sqrt(max(gap.low, 1e-3 * gap.high) * gap.high)
        if inside.size and gap.high > 1.05 * gap.low:
            return float(inside[np.argmin(np.abs(np.log(np.maximum(inside, TINY) / middle)))])
        return 0.5 * (gap.low + gap.high)

    def _has(self, omega: float) -> bool:
        return any(one == omega for one, _ in self.found)

    def _tried(self, gap: Interval, omega: float, growth: float) -> Interval:
        """Return the part of a gap over which the heights grow little."""
        if self.heights is None:
            return gap
        own = self.tall(omega, omega)
        low, high = gap
        for _ in range(60):
            tall = self.tall(low, high)
            if np.all(tall <= growth * own):
                break
            high = omega + 0.5 * (min(high, 4 * omega + TINY) - omega) if high > omega else high
            low = omega - 0.5 * (omega - low)
        return Interval(low, high)

    def _holds(self, x: FloatArray, tall: FloatArray, tried: Interval, omega: float) -> Interval:
        """Return where scalings hold around a frequency, within some bounds."""
        low, high = tried
        S = self.scalings.matrix(x, self.level)
        if self.by_hamiltonian:
            crossings = self._crossings(S, tall)
            low = max([low, *crossings[crossings < omega * (1 - ROUNDING)]])
            high = min([high, *crossings[crossings > omega * (1 + ROUNDING)]])
        points = self._points(low, high, omega)
        M = self.at(points) * tall
        W = np.concatenate(
            [np.broadcast_to(np.eye(tall.size), (points.size, tall.size, tall.size)), M], axis=1
        )
        F = W.conj().swapaxes(1, 2) @ S @ W
        # relative to the sizes of its entries
        size = np.sqrt(np.abs(np.einsum("nii->ni", F)) + TINY)
        least = np.linalg.eigvalsh(F / size[:, :, None] / size[:, None, :])[:, 0]
        bad = points[least <= 0.0]
        below, above = bad[bad < omega], bad[bad > omega]
        if below.size:
            good = points[(points > below[-1]) & (points <= omega)]
            low = float(good[0]) if good.size else omega
        if above.size:
            good = points[(points < above[0]) & (points >= omega)]
            high = float(good[-1]) if good.size else omega
        return Interval(low, high)

    def _points(self, low: float, high: float, omega: float) -> FloatArray:
        """Return frequencies in an interval, through and beside the resonances."""
        swing, width = self.poles.imag, np.abs(self.poles.real)
        beside = np.concatenate([-_BESIDE[:0:-1], _BESIDE])
        near = (swing[:, None] + width[:, None] * beside).ravel()
        top = 100.0 * float(np.abs(self.poles).max(initial=1.0))
        end = min(high, max(top, 10 * low))
        base = np.linspace(low, end, _POINTS)
        # six decades, where the interval begins at 0 Hz
        more = np.geomspace(max(low, 1e-6 * end), end, _POINTS)
        points = np.unique(np.concatenate([near, base, more, [omega]]))
        return points[(points >= low) & (points <= end)]

    def _crossings(self, S: ComplexArray, tall: FloatArray) -> FloatArray:
        """Return the frequencies [rad/s], positive, at which F is singular."""
        A, B, C, D = self.A, self.B * tall, self.C, self.D * tall
        w = B.shape[1]
        S11, S12, S22 = S[:w, :w], S[:w, w:], S[w:, w:]
        Q = C.T @ S22 @ C
        Y = C.T @ (S12.conj().T + S22 @ D)
        R = S11 + S12 @ D + D.T @ S12.conj().T + D.T @ S22 @ D
        RY, RB = (np.linalg.solve(R, part) for part in (Y.conj().T, B.T))
        F = A - B @ RY
        H = np.block([[F, -B @ RB], [-Q + Y @ RY, -F.conj().T]])
        balanced: Any = la.matrix_balance(H, permute=False)[0]
        values = la.eigvals(balanced)
        near = np.abs(values.real) <= _ON_AXIS * np.linalg.norm(balanced)
        swing = values.imag[near]
        return np.sort(np.asarray(swing[swing > 0], dtype=np.float64))


def covered(
    M: StateSpace,
    blocks: Sequence[Block],
    leveled: Sequence[bool] | None = None,
    heights: Heights | None = None,
    least: float = 1e-12,
    accuracy: float = _ABOVE,
) -> Covered:
    """Return an upper level that holds at all frequencies of a stable continuous system."""
    return _Cover(M, blocks, leveled, heights, least, accuracy).run()
