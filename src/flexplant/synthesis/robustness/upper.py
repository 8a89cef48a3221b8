"""The upper bound of the structured singular value of one matrix: scalings D and G by centres."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ...arrays import ComplexArray, FloatArray, IntArray
from ...tolerances import MOST_STEPS, NEGLIGIBLE, RANK, RESIDUAL, TINY, TYPED
from .uncertainty_blocks import Scalings, osborne

#: Newton decrement at which a centre is left
_CENTRED = 0.3
#: growth of the weight of a skewed level from one centre to the next
_GROWTH = 10.0
#: part of the way from the level that scalings reach back to the level they were centred at
_BACK = 0.15
#: G relative to the trace of D times the size of M, above which it is too large: G can only cancel
#: Im M, where D of the blocks are similar; a larger G lowers a bound by up to a few percent, but
#: its scalings hold on shorter intervals only
WIDE, FREE = 1.0, 30.0


class Certified(NamedTuple):
    """Scalings x and the smallest level for which they hold."""

    level: float
    x: FloatArray


def upper_level(
    M: ComplexArray,
    scalings: Scalings,
    start: FloatArray | None = None,
    *,
    enough: float = 0.0,
    widest: float = FREE,
) -> Certified:
    """Return the smallest level that scalings D, G reach: mu^2 (of a skewed problem, gain^2)."""
    # generalised eigenvalue minimisation by the method of centres [BoydElGhaoui1993]_: at a level,
    # Newton steps to the maximum of `log det F + sum log det D` with the trace of D fixed; the next
    # level lies between it and what those scalings reach
    W = np.vstack([np.eye(scalings.w), M])
    size = float(np.linalg.norm(M)) ** 2
    if not size:
        return Certified(0.0, scalings.start)
    evened = scalings.scaled(scalings.start, osborne(M, scalings.places))
    tried = [evened, scalings.shifted(evened, M), *([] if start is None else [start])]
    # the size of the leveled blocks' D relative to the others' is found by trial
    if scalings.skewed:
        tried += [_leveled_by(scalings, one, 10.0**k) for one in tried[1:] for k in range(-8, 3)]
    reached, x = min(((reached_level(W, scalings, one), one) for one in tried), key=itemgetter(0))
    if not np.isfinite(reached):
        found = _admissible(M, scalings, x)
        if found is None:
            return Certified(np.inf, x)
        x, reached = found, reached_level(W, scalings, found)
    if scalings.skewed and reached > enough:
        return _skewed(W, scalings, x, reached, enough)
    x = x / np.sum(scalings.start * x)
    best = Certified(max(reached, 0.0), x)
    level = 1.5 * max(reached, RESIDUAL * size)
    for _ in range(MOST_STEPS):
        if best.level <= enough:
            return best
        x = centred(W, scalings, x, level, widest=widest)
        reached = reached_level(W, scalings, x)
        if reached <= RESIDUAL * size:
            return Certified(RESIDUAL * size, x)
        if reached < best.level:
            best = Certified(reached, x)
        if level - reached <= NEGLIGIBLE * level:
            break
        level = reached + _BACK * (level - reached)
    return best


def _admissible(M: ComplexArray, scalings: Scalings, x: FloatArray) -> FloatArray | None:
    """Return scalings of a skewed problem for which some level is finite, None without any."""
    kept = np.flatnonzero(~scalings.chosen)
    inner = [scalings.places[i] for i in kept]
    plain = Scalings([p.block for p in inner])
    rows = np.concatenate([np.arange(p.z.start, p.z.stop) for p in inner])
    columns = np.concatenate([np.arange(p.w.start, p.w.stop) for p in inner])
    part = M[np.ix_(rows, columns)]
    found = upper_level(part, plain, enough=0.98)
    if found.level >= 1.0:
        return None
    # D of the leveled blocks as small as necessary relative to those of the others
    own = centred(np.vstack([np.eye(plain.w), part]), plain, found.x, 1.0, steps=20)
    x = x.copy()
    for i, fro in zip(kept, plain.ranges, strict=True):
        x[scalings.ranges[i]] = own[fro]
    for factor in 10.0 ** np.arange(0, -13, -1.0):
        tried = _leveled_by(scalings, x, factor)
        if np.isfinite(reached_level(np.vstack([np.eye(scalings.w), M]), scalings, tried)):
            return tried
    return None


def _leveled_by(scalings: Scalings, x: FloatArray, factor: float) -> FloatArray:
    """Return scalings whose leveled blocks' D is larger by a factor."""
    return scalings.scaled(x, np.where(scalings.chosen, factor, 1.0))


def reached_level(W: ComplexArray, scalings: Scalings, x: FloatArray) -> float:
    """Return the smallest level for which F(x) >= 0: infinite if none exists."""
    S0, S1 = scalings.matrix(x, 0.0), scalings.matrix(x, 1.0)
    fixed = _half(W.conj().T @ S0 @ W)
    grows = _half((S1 - S0)[: scalings.w, : scalings.w])
    if not scalings.skewed:
        return float(la.eigh(-fixed, grows, eigvals_only=True)[-1])
    moving = np.flatnonzero(np.abs(grows).sum(axis=0) > 0)
    still = np.setdiff1d(np.arange(scalings.w), moving)
    try:
        root = la.cho_factor(fixed[np.ix_(still, still)])
    except la.LinAlgError:  # not positive definite
        return float("inf")
    across = fixed[np.ix_(still, moving)]
    schur = _half(across.conj().T @ la.cho_solve(root, across) - fixed[np.ix_(moving, moving)])
    return float(la.eigh(schur, grows[np.ix_(moving, moving)], eigvals_only=True)[-1])


def reached_levels(W: ComplexArray, scalings: Scalings, x: FloatArray) -> FloatArray:
    """Return the smallest level for which F(x) >= 0 of each W (n, w + z, w); not skewed."""
    S0, S1 = scalings.matrix(x, 0.0), scalings.matrix(x, 1.0)
    root = np.linalg.cholesky((S1 - S0)[: scalings.w, : scalings.w])
    even = W @ np.linalg.inv(root).conj().T
    return np.asarray(np.linalg.eigvalsh(-(even.conj().swapaxes(1, 2) @ S0 @ even))[:, -1])


def centred(
    W: ComplexArray,
    scalings: Scalings,
    x: FloatArray,
    level: float,
    *,
    steps: int = MOST_STEPS,
    widest: float = WIDE,
) -> FloatArray:
    """Return scalings after Newton steps to the analytic centre of ``F > 0, D > 0`` at a level."""
    # where no real Delta makes the loop singular (M is complex near a resonance) F grows with G
    # without limit, and scalings that hold at one frequency hold nowhere else: therefore a square
    # of G is added above `widest` times the trace of D and the size of M
    slopes = _Slopes.of(scalings, scalings.coefficients(level))
    size = float(np.linalg.norm(W[scalings.w :])) * float(scalings.start @ x)
    wide = np.where(scalings.of_G, 1.0 / max(widest * size, TINY) ** 2, 0.0)

    def merit(x: FloatArray) -> float:
        return _barrier(W, scalings, x, level) + float(wide @ x**2)

    def derivatives(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        gradient, hessian = slopes.derivatives(W, scalings, x, level)
        _add_of_D(scalings, x, gradient, hessian)
        hessian.reshape(-1)[:: len(x) + 1] += 2.0 * wide
        return gradient + 2.0 * wide * x, hessian

    return _descended(x, merit, derivatives, steps, scalings.start)


def _descended(
    x: FloatArray,
    merit: Callable[[FloatArray], float],
    derivatives: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    steps: int,
    trace: FloatArray | None = None,
) -> FloatArray:
    """Return x after Newton steps that lower a self-concordant function, to near its minimum."""
    value = merit(x)
    if not np.isfinite(value):
        return x
    for _ in range(steps):
        gradient, hessian = derivatives(x)
        step, decrement = _newton_step(hessian, gradient, trace)
        # the value is off by the square of it
        if not decrement > TYPED:
            break
        # full steps from afar lower it too, but end in scalings that hold at one frequency only
        t = 1.0 / (1.0 + decrement) if decrement > _CENTRED else 1.0
        # shorter steps are rounding of x
        while t > 1e-10 and not (new := merit(x + t * step)) < value:  # a step of rounding
            t *= 0.5
        if t <= 1e-10:
            break
        x, value = x + t * step, new
        if decrement < _CENTRED:
            break
    return x


class _Slopes(NamedTuple):
    """The derivatives S_p of S: numbers (n_x, n) at n places that they share.

    `across` are the places in P of what each pair of them multiplies; `room` (2, n, n) is written
    to in every step: new memory of this size takes longer than what is computed in it.
    """

    across: IntArray
    values: sp.csr_array
    room: ComplexArray

    @classmethod
    def of(cls, scalings: Scalings, value: ComplexArray) -> _Slopes:
        """Return those of values for each entry of S, zero where an entry does not move."""
        n = len(scalings.across)
        values = sp.csr_array((value, (scalings.owner, scalings.at)), (scalings.count, n))
        return cls(scalings.across, values, np.empty((2, n, n), dtype=np.complex128))

    def derivatives(
        self, W: ComplexArray, scalings: Scalings, x: FloatArray, level: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return -tr(P S_p) and tr(P S_p P S_q) with ``P = W F^-1 W*``: those of -log det F."""
        F = _half(W.conj().T @ scalings.matrix(x, level) @ W)
        P = W @ np.linalg.solve(F, W.conj().T)
        across, product = self.room
        P.take(self.across, out=across, mode="clip")
        np.multiply(across, across.T, out=product)
        gradient: Any = self.values @ across.diagonal()
        hessian: Any = self.values @ (self.values @ product).T
        return -gradient.real, hessian.real.copy()


def _add_of_D(scalings: Scalings, x: FloatArray, gradient: FloatArray, hessian: FloatArray) -> None:
    """Add the derivatives of ``-sum log det D``."""
    for (own, basis), D in zip(scalings.alike, scalings.stacks(x), strict=True):
        if len(basis) == 1:  # numbers
            inverse = 1.0 / D[:, 0, 0].real
            gradient[own[:, 0]] -= inverse
            hessian[own[:, 0], own[:, 0]] += inverse**2
            continue
        turned = np.linalg.inv(D)[:, None] @ basis
        gradient[own] -= np.einsum("bpii->bp", turned).real
        flat = turned.reshape(*own.shape, -1)
        back = turned.swapaxes(2, 3).reshape(flat.shape).swapaxes(1, 2)
        hessian[own[:, :, None], own[:, None]] += (flat @ back).real


def _skewed(
    W: ComplexArray, scalings: Scalings, x: FloatArray, reached: float, enough: float
) -> Certified:
    """Return the smallest level of a skewed problem: linear in it once D of its block is one."""
    # path following: Newton steps on `t level - log det F - sum log det D` for growing t
    fixed = int(scalings.owner[np.flatnonzero(scalings.leveled)[0]])
    x = x / x[fixed]
    # the level takes the place of the parameter that is fixed at one
    moves = (scalings.owner != fixed) | scalings.leveled
    slopes = _Slopes.of(scalings, np.where(moves, scalings.value, 0.0))
    best = Certified(reached, x)
    barriers = scalings.w + sum(basis.shape[1] for _, basis in scalings.d_ranges) - 1
    y = x.copy()
    y[fixed] = 1.5 * max(reached, TINY)
    t = barriers / y[fixed]

    def split(y: FloatArray) -> tuple[FloatArray, float]:
        x = y.copy()
        x[fixed] = 1.0
        return x, float(y[fixed])

    def merit(y: FloatArray) -> float:
        return float(_barrier(W, scalings, *split(y)) + t * y[fixed])

    def derivatives(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, level = split(y)
        gradient, hessian = slopes.derivatives(W, scalings, x, level)
        of_level = gradient[fixed] + t, hessian[fixed, fixed]
        _add_of_D(scalings, x, gradient, hessian)
        gradient[fixed], hessian[fixed, fixed] = of_level
        return gradient, hessian

    for _ in range(MOST_STEPS):
        y = _descended(y, merit, derivatives, MOST_STEPS)
        x, level = split(y)
        reached = reached_level(W, scalings, x)
        if reached < best.level:
            best = Certified(reached, x)
        if best.level <= enough or barriers / t <= NEGLIGIBLE * max(level, TINY):
            break
        t *= _GROWTH
    return Certified(max(best.level, 0.0), best.x)


def _newton_step(
    hessian: FloatArray, gradient: FloatArray, trace: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Return the Newton step, one that keeps a trace where there is one, and its decrement."""
    size = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), TINY))
    scaled = hessian * size * size[:, None]
    # of a unit diagonal: keeps a singular Hessian solvable
    scaled.reshape(-1)[:: len(size) + 1] += RANK
    right = gradient[:, None] if trace is None else np.column_stack([gradient, trace])
    _, solution, failed = la.lapack.dposv(scaled, size[:, None] * right)
    if failed:
        return np.zeros_like(gradient), 0.0
    both = size[:, None] * solution
    step = -both[:, 0]
    if trace is not None:
        step = step + (trace @ both[:, 0]) / (trace @ both[:, 1]) * both[:, 1]
    return step, float(np.sqrt(max(-float(gradient @ step), 0.0)))


def _barrier(W: ComplexArray, scalings: Scalings, x: FloatArray, level: float) -> float:
    """Return ``-log det F - sum log det D``, infinite outside."""
    total = 0.0
    for matrix in (_half(W.conj().T @ scalings.matrix(x, level) @ W), *scalings.stacks(x)):
        try:
            total -= 2.0 * float(
                np.sum(np.log(np.linalg.cholesky(matrix).diagonal(0, -2, -1).real))
            )
        except np.linalg.LinAlgError:  # not positive definite
            return float("inf")
    return total if np.isfinite(total) else float("inf")


def _half(M: ComplexArray) -> ComplexArray:
    return np.asarray(0.5 * (M + M.conj().T))
