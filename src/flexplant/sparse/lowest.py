"""The lowest eigenvalues of sparse matrices: block shift-invert Lanczos, counts, rounding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from ..arrays import COLUMNS, FloatArray, IntArray, Matrix, Rng
from ..errors import SolverError, attempted, counted
from ..parallel import PIECE, one_thread, tick
from ..tolerances import (
    FOUR_DIGITS,
    MOST_STEPS,
    NEGLIGIBLE,
    NULL,
    PRECISION,
    RANK,
    ROOT,
    ROUNDING,
    SPLIT,
)
from .factor import DENSE_LIMIT, MultifrontalFactor, eliminated, negative_pivots, symmetric_lu
from .ordering import Dissection, dissect
from .symmetric import (
    ZERO,
    beyond,
    by_rows,
    column_groups,
    dense,
    diagonal,
    mixed,
    rayleigh_ritz,
    without_zeros,
)

#: number of vectors solved together
BLOCK = 12
#: number of values above the last wanted one among which a gap for a count is searched
EXTRA = 4
#: residual below which the value is exact to rounding, since its error is the square of the
#: residual
VALUE = SPLIT
#: label of the progress bar
STEPS = "modes, steps of Lanczos"
#: number of steps between two restarts with a large block
_STEPS, _FEW_STEPS = 12, 6
#: relative error of a Ritz pair below which its shape needs no separate tolerance
_SURE = ROUNDING


class BlockLanczos:
    """The largest eigenvalues ``theta = 1 / (omega^2 - sigma)`` of ``(K - sigma M)^-1 M``.

    Every new block is made M-orthogonal to all before it, so that no value appears twice
    [Grimes1994]_.
    """

    def __init__(
        self,
        solve: Callable[[FloatArray], FloatArray],
        M: Matrix,
        locked: FloatArray,
        *,
        want: int,
        rng: Rng = 0,
        block: int = BLOCK,
        start: FloatArray | None = None,
    ) -> None:
        self._solve = solve
        self._M = without_zeros(by_rows(M))
        n, self._r = locked.shape
        self._block = min(block, n - self._r)
        self._rng = np.random.default_rng(rng)
        self._reserve(want)
        # rows: locked vectors, then the basis; only touched rows take memory
        self._V = np.empty((self._capacity, n))
        self._V[: self._r] = locked.T
        self._locked = np.asarray(self._M @ locked)
        self._m = 0
        self._T = np.zeros((0, 0))
        self.steps = 0
        known = np.zeros((n, 0)) if start is None else start[:, : self._block // 2]
        first = np.hstack([known, self._rng.standard_normal((n, self._block - known.shape[1]))])
        self._next, self._loaded, _ = self._orthonormal(first)
        self._over = np.zeros((self._next.shape[1], 0))

    def _reserve(self, want: int) -> None:
        # a restart keeps want + block vectors; then at least the same number again or _STEPS blocks
        # follow, fewer for a large block
        room = 2 * self._block + max(
            _STEPS * BLOCK, _FEW_STEPS * self._block, 5 * want // 4 + self._block
        )
        self._capacity = self._r + want + self._block + room

    def lowest(
        self,
        count: int,
        tolerance: float = ROOT,
        *,
        extra: int = 0,
        needed: Callable[[FloatArray], FloatArray] | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the `count` largest theta found and their shapes (n, count)."""
        # only the values of the last `extra` are needed. For shapes (n, m) that are found to
        # `tolerance`, `needed` gives the tolerance (m,) that each must reach. Fewer than `count`
        # are returned where the others are hidden by rounding of the largest value, or where a
        # value has as many copies as the block has vectors. A new search with a larger block, with
        # the returned ones locked, finds the rest
        n = self._V.shape[1]
        count = min(count, n - self._r)
        check_at = self.steps
        for _ in range(MOST_STEPS * _STEPS):
            if self._m + self._r >= n or not self._next.shape[1]:
                theta, mix, _ = self._pairs()
                return theta[:count], self._shapes(mix[:, :count])
            self._step()
            full = self._r + self._m + 2 * self._next.shape[1] > self._capacity
            if self.steps < check_at and not full:
                continue
            theta, mix, error = self._pairs()
            # smallest value that this search can find, by the rounding of the largest one
            sure = int(np.count_nonzero(theta * ROOT >= RANK * theta[0]))
            limited = sure < min(count, theta.size)
            wanted = sure if limited else count
            # shapes of equal values have the same accuracy, since they may be mixed
            last = theta[min(count, theta.size) - extra - 1] if theta.size > extra else 0.0
            shapes = int(np.count_nonzero(theta[:count] >= (1 - ROOT) * last))
            required = np.full(count, tolerance)
            required[shapes:] = max(tolerance, VALUE)
            strict = np.minimum(required, tolerance) if limited else required
            left = _unconverged(theta[:wanted], error, strict).size
            if theta.size >= wanted and not left and needed is not None:
                shapes = wanted if limited else shapes
                close = np.flatnonzero(error[:shapes] > _SURE * theta[:shapes])
                strict[close] = np.minimum(tolerance, needed(self._shapes(mix[:, close])))
                left, needed = _unconverged(theta[:wanted], error, strict).size, None
            if left:
                late = _unconverged(theta[:wanted], error, np.full(wanted, _SURE))
                held = int(late[0]) if late.size else min(wanted, theta.size)
                if _most_copies(theta[:held]) >= self._block:
                    wanted, left = held, 0
            done = theta.size >= wanted and not left
            if done or full:
                keep = min(count + self._block, theta.size)
                self._restart(theta, mix, keep)
                self._over = self._over @ mix[-self._over.shape[1] :, :keep]
            if done:
                # in place, since a copy would need more memory
                self._V.resize((self._r + keep, n), refcheck=False)
                return theta[:wanted], self._V[self._r :][:wanted].T.copy()
            # a step adds at most one block of new values, usually half a block
            check_at = self.steps + max(left, wanted - theta.size) // (2 * self._block)
        raise SolverError(
            f"Lanczos did not converge for {counted(count, 'mode')} in {self.steps} steps: M and K "
            "are badly conditioned. Look for DOFs with next to no mass, or request fewer modes."
        )

    def _shapes(self, mix: FloatArray) -> FloatArray:
        return self._V[self._r : self._r + self._m].T @ mix

    def _step(self) -> None:
        """Extend the basis by the next block."""
        width, at = self._next.shape[1], self._r + self._m
        self._append(self._next)
        self._next = np.zeros((0, width))  # it is now part of the basis
        moved = self._solve(self._loaded)
        # its component in the basis lies almost entirely along the last block and the blocks that T
        # couples to it; the remainder is small, and one orthogonalisation is enough
        near = np.vstack([self._over.T, self._loaded.T @ moved])
        rows = slice(at + width - near.shape[0], at + width)
        _subtract(moved, self._V[rows], near)
        self._next, self._loaded, (along, self._over) = self._orthonormal(moved)
        along[rows] += near
        along = along[self._r :]
        grown_T = np.zeros((self._m, self._m))
        grown_T[:-width, :-width] = self._T
        grown_T[:, -width:] = along
        grown_T[-width:, :-width] = along[:-width].T
        grown_T[-width:, -width:] = 0.5 * (along[-width:] + along[-width:].T)
        self._T = grown_T
        self.steps += 1
        tick(STEPS)

    def _append(self, block: FloatArray) -> None:
        """Add a block to the basis."""
        at, width = self._r + self._m, block.shape[1]
        if at + width > self._V.shape[0]:
            grown = np.empty((at + 2 * width + _STEPS * width, self._V.shape[1]))
            grown[:at] = self._V[:at]
            self._V, self._capacity = grown, grown.shape[0]
        self._V[at : at + width] = block.T
        self._m += width

    def _pairs(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Ritz values, vectors in terms of the basis, and residuals."""
        theta, mix = la.eigh(self._T)
        theta, mix = theta[::-1], mix[:, ::-1]
        over = self._over
        return theta, mix, np.linalg.norm(over @ mix[-over.shape[1] :], axis=0)

    def _restart(self, theta: FloatArray, mix: FloatArray, keep: int) -> None:
        """Keep the best Ritz vectors only."""
        basis = self._V[self._r : self._r + self._m]
        n = basis.shape[1]
        for begin in range(0, n, 65536):  # in place
            columns = slice(begin, min(begin + 65536, n))
            basis[:keep, columns] = mix[:, :keep].T @ basis[:, columns]
        self._m, self._T = keep, np.diag(theta[:keep])

    def _orthonormal(
        self, W: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
        """Return the M-orthonormal part of W beyond the basis, M times it, and the coefficients."""
        # Gram-Schmidt until it removes almost nothing, at most twice, which is enough
        # [Giraud2005]_; again where the block had almost nothing new in some direction
        basis = self._V[: self._r + self._m]
        along = np.zeros((basis.shape[0], W.shape[1]))
        over = np.eye(W.shape[1])
        W = np.ascontiguousarray(W)
        # rounding of W lies along the locked vectors, whose products with M are known
        _subtract(W, self._V[: self._r], self._locked.T @ W)
        loaded = self._M @ W
        for _ in range(3):
            for _ in range(2):
                part = along_basis(basis, loaded)
                _subtract(W, basis, part)
                along += part @ over
                before = float(np.sqrt(np.abs(np.sum(W * loaded, axis=0)).min()))
                taken = np.abs(part).max(initial=0.0)
                # where almost nothing is removed, M W does not change but for what the final
                # Rayleigh-Ritz step on the modes corrects
                if taken > NULL * before:
                    loaded = self._M @ W
                if taken <= FOUR_DIGITS * before:
                    break
            poor = False
            # twice, since the accuracy of the first pass is limited by the condition of the block
            for _ in range(2):
                size, turn = la.eigh(W.T @ loaded)
                # squared lengths: 1e-12 of the longest direction counts as zero
                keep = size > ROUNDING**2 * max(size[-1], 0.0)
                if size[-1] <= 0 or not np.any(keep):
                    empty = np.zeros((W.shape[0], 0))
                    return empty, empty, (along, np.zeros((0, over.shape[1])))
                root = np.sqrt(size[keep])
                W, loaded = (mixed(X, turn[:, keep] / root) for X in (W, loaded))
                over = (turn[:, keep] * root).T @ over
                poor = poor or bool(size[0] < NEGLIGIBLE**2 * size[-1])
            if not poor:
                break
            loaded = self._M @ W
        return W, loaded, (along, over)


def iterated(
    solve: Callable[[FloatArray], FloatArray], M: Matrix, locked: FloatArray, phi: FloatArray
) -> None:
    """Move shapes on by one inverse iteration next to the locked ones, in place."""
    # this removes the remainders of high modes, which make up most of the residual
    deflated = np.asarray(M @ locked)
    for at in column_groups(phi.shape[1], COLUMNS):
        force = np.asarray(M @ phi[:, at])
        force -= deflated @ (locked.T @ force)
        moved = solve(force)
        moved -= locked @ (deflated.T @ moved)
        phi[:, at] = moved


def _unconverged(theta: FloatArray, error: FloatArray, required: FloatArray) -> IntArray:
    """Return which Ritz pairs have not reached their tolerance."""
    limit = np.maximum(required[: theta.size] * theta, PRECISION * theta[0])
    return np.flatnonzero(error[: theta.size] > limit)


def _most_copies(theta: FloatArray) -> int:
    """Return the size of the largest group of equal values among descending ones."""
    ends = np.flatnonzero(theta[:-1] - theta[1:] > ROOT * theta[:-1])
    return int(np.diff(np.concatenate([[-1], ends, [theta.size - 1]])).max(initial=0))


def along_basis(basis: FloatArray, loaded: FloatArray) -> FloatArray:
    """Return `basis @ loaded`, rows of the basis in pieces that fit the cache."""
    found = np.zeros((basis.shape[0], loaded.shape[1]))
    for begin in range(0, loaded.shape[0], PIECE):
        piece = slice(begin, begin + PIECE)
        found += basis[:, piece] @ loaded[piece]
    return found


def _subtract(W: FloatArray, basis: FloatArray, part: FloatArray) -> None:
    """Take `basis.T @ part` from W, in place."""
    for begin in range(0, W.shape[0], PIECE):
        piece = slice(begin, begin + PIECE)
        W[piece] -= (part.T @ basis[:, piece]).T


#: largest relative spectral radius of the error of a factor whose inertia is accepted
_RADIUS = 0.5
#: number of random vectors that estimate it, and the fraction of its largest effect that all may
#: miss, with a probability of (0.8 _MISSED)^_VECTORS = 1e-13; largest power that is tried
_VECTORS, _MISSED, _POWER = 12, 0.1, 10


def multifrontal_inertia(
    matrix: Any, dissection: Dissection | None = None, *, single: bool = True
) -> int:
    """Return how many eigenvalues of a sparse symmetric matrix are negative."""
    # with `single`, and where the factorisation dominates the cost, single precision is tried
    # first, and accepted if refinement shows that its rounding changes no sign. In double precision
    # the factor is not stored. A random `b = A x` is eliminated along: `x^T A x = y^T D^-1 y` with
    # `L y = b` shows whether pivots restricted to the blocks were stable
    lower = sp.csc_array(matrix)
    chosen = dissect(lower) if dissection is None else dissection
    if single and chosen.is_costly:
        factor = signed_factor(lower, chosen)
        if factor is not None:
            return factor.negative
    x = np.random.default_rng(0).standard_normal((lower.shape[0], 3))
    b = np.asarray(lower @ x)
    wanted, size = np.sum(x * b, axis=0), np.sum(np.abs(x * b), axis=0)
    b = b[chosen.order]
    energy = np.zeros(3)
    negative = 0
    with one_thread():
        for front, pivots, below in eliminated(lower, chosen, signed=True):
            y = pivots.after(b[front.first : front.last].T).T
            moved = pivots.signed(y)
            energy += np.sum(y * moved, axis=0)
            b[front.rows] -= below @ moved
            negative += pivots.negative
    if not np.all(np.abs(energy - wanted) <= FOUR_DIGITS * size):
        raise SolverError(
            f"a count of eigenvalues by L D L^T is not accurate (energies differ by "
            f"{np.max(np.abs(energy - wanted) / size):.1g}): the shift is too close to an "
            "eigenvalue. Count at another frequency."
        )
    return negative


def signed_factor(matrix: Any, dissection: Dissection) -> MultifrontalFactor | None:
    """Return a factor in single precision that counts; None where rounding may change a sign."""
    with attempted("a factor in single precision", SolverError):
        factor = MultifrontalFactor(matrix, dissection, single=True, signed=True)
        return factor if _error_radius(factor, matrix) < _RADIUS else None
    return None


def _error_radius(factor: MultifrontalFactor, matrix: Any) -> float:
    """Return a bound of the spectral radius of ``G = I - (L D L^T)^-1 A``, wrong once in 1e12."""
    # with `L D L^T = A + E` the matrices `A + t E`, t from 0 to 1, are regular when it is below 1:
    # no eigenvalue changes its sign, and A has the inertia of D. `G^k` stretches some direction v
    # most; of Gaussian x nearly all have `|v^T x| > 0.1`, and then
    # `rho^k <= ||G^k|| <= ||G^k x|| / |v^T x|`
    A = by_rows(matrix)
    x = np.random.default_rng(0).standard_normal((A.shape[0], _VECTORS))
    size, bound = np.inf, np.inf
    for k in range(1, _POWER + 1):
        before = size
        x -= factor.solve(A @ x)
        size = float(np.linalg.norm(x, axis=0).max())
        bound = min(bound, (size / _MISSED) ** (1 / k))
        if bound < _RADIUS or (k > 2 and size > _RADIUS * before):
            break
    return bound


#: number of DOFs up to which dense LAPACK finds every eigenvalue
_DENSE = 300
#: largest number of zero eigenvalues that are listed one by one
MOST_ZEROS = 64


@dataclass(frozen=True)
class Lowest:
    """The lowest eigenvalues of ``K phi = lambda M phi``."""

    values: FloatArray
    shapes: FloatArray
    spread: FloatArray
    n_zero: int
    below: int | None
    negative: tuple[FloatArray, FloatArray] | None = None


def lowest_modes(
    K: Any,
    M: Any,
    count: int,
    *,
    known: FloatArray | None = None,
    rounding: float = 0.0,
    nodes: IntArray | None = None,
    xyz: FloatArray | None = None,
) -> Lowest:
    """Return the `count` lowest eigenvalues, or more until one of them is not zero."""
    # by inverse iteration at a shift below zero, hence exact to rounding also where K is singular
    # and M has massless rows
    K, M = sp.csc_array(K), sp.csc_array(M)
    first = np.zeros((K.shape[0], 0)) if known is None else known
    stiff, heavy = np.abs(diagonal(K)), diagonal(M)
    ratios = stiff[heavy > 0] / heavy[heavy > 0]
    typical = float(np.median(ratios[ratios > 0])) if np.any(ratios > 0) else 1.0
    shift, number, size = ROOT * typical, count, cast(Any, abs(K))
    floor = max(rounding, ZERO)
    of_known = np.einsum("ij,ij->j", np.abs(first), np.asarray(size @ np.abs(first)))
    # one elimination order serves all shifts
    large = K.shape[0] > DENSE_LIMIT
    order = dissect(sp.csc_array(K + shift * M), nodes, xyz) if large else None
    limit = min(int(np.count_nonzero(heavy > 0)) - first.shape[1], MOST_ZEROS)
    for _ in range(6):
        number = min(number, limit)
        values, shapes = _inverse_iteration(K, M, shift, number, order, first)
        spread = np.einsum("ij,ij->j", np.abs(shapes), np.asarray(size @ np.abs(shapes)))
        alone = floor if known is None else max(rounding, PRECISION)
        zero = np.abs(values) <= alone * spread
        rank = np.lexsort((np.abs(values), ~zero))
        values, shapes, spread = values[rank], shapes[:, rank], spread[rank]
        n_zero = int(np.count_nonzero(zero))
        if n_zero == number and number < limit:
            number *= 3
            continue
        elastic = np.abs(values[n_zero:])
        # a shift close to the elastic modes separates them well; it is as close to zero as rounding
        # allows
        if elastic.size and shift > 1e3 * elastic[0]:
            most = float(np.concatenate([spread[:n_zero], of_known]).max(initial=0.0))
            shift = max(float(elastic[0]), 10 * floor * most)
            continue
        break
    values = np.concatenate([np.zeros(of_known.size), values])
    shapes, spread = np.hstack([first, shapes]), np.concatenate([of_known, spread])
    n_zero += of_known.size
    below = _count_below(K, M, values, n_zero, order)
    negative = None
    if below is not None and below > n_zero:
        negative = _most_negative(K, M, shift, below - n_zero, order)
    return Lowest(values, shapes, spread, n_zero, below, negative)


def _most_negative(
    K: Any, M: Any, shift: float, count: int, order: Dissection | None
) -> tuple[FloatArray, FloatArray] | None:
    """Return the lowest eigenvalues and shapes: by a shift at which K + s M is definite."""
    for _ in range(30):
        try:
            if order is not None:
                MultifrontalFactor(K + shift * M, order, keep=False)
            else:
                la.cholesky(dense(K + shift * M), check_finite=False)
        except (SolverError, la.LinAlgError):
            shift *= 10.0
            continue
        none = np.zeros((K.shape[0], 0))
        return _inverse_iteration(K, M, shift, min(count, MOST_ZEROS), order, none)
    return None


def _inverse_iteration(
    K: Any, M: Any, shift: float, count: int, order: Dissection | None, known: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return `count` eigenvalues of smallest lambda + shift, with their shapes, next to known."""
    n, r = known.shape
    if count <= 0:
        return np.zeros(0), np.zeros((n, 0))
    if n <= _DENSE or count > n // 3:
        stiff, heavy = dense(K + shift * M), dense(M)
        try:
            mu, shapes = la.eigh(heavy, stiff)
        except la.LinAlgError:
            # K is indefinite: M must then be definite
            try:
                found, shapes = la.eigh(stiff, heavy)
            except la.LinAlgError as error:
                raise SolverError(
                    "both K and M are indefinite or singular in one motion: no eigenvalues follow. "
                    "Look at the DOFs without mass or stiffness first."
                ) from error
            mu = 1 / np.where(found == 0, np.finfo(float).tiny, found)
        best = np.argsort(-np.abs(mu))[: count + r]
        return rayleigh_ritz(K, M, beyond(M, known, shapes[:, best]))
    factor = _factorise(K + shift * M, order)
    if not isinstance(factor, MultifrontalFactor):
        return rayleigh_ritz(K, M, beyond(M, known, _both_ways(K, M, shift, count + r, factor)))
    values, shapes = np.zeros(0), np.zeros((n, 0))
    while shapes.shape[1] < count:
        # values hidden by the rounding of the largest one are found with it locked
        locked, want = np.hstack([known, shapes]), count - shapes.shape[1]
        more = BlockLanczos(factor.solve, M, locked, want=want).lowest(want, VALUE)[1]
        if not more.shape[1]:
            break
        iterated(factor.solve, M, locked, more)
        values, shapes = rayleigh_ritz(K, M, np.hstack([shapes, more]))
    return values, shapes


def _both_ways(K: Any, M: Any, shift: float, count: int, factor: Any) -> FloatArray:
    """Return shapes (n, count) with the largest |1 / (lambda + shift)|, K + shift M indefinite."""
    n = K.shape[0]
    inverse: Any = spla.LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
    # a fixed start vector gives the same result in every run
    start = factor.solve(M @ np.random.default_rng(0).standard_normal(n))
    basis = min(n, 2 * count + 20)
    try:
        found = spla.eigsh(K, count, M, -shift, v0=start, ncv=basis, OPinv=inverse)
    except (spla.ArpackError, spla.ArpackNoConvergence) as error:
        raise SolverError(
            f"the lowest eigenvalues of K and M did not converge ({error}). Look at the scales "
            "of K and M: penalties and wrong units spread them."
        ) from error
    return np.asarray(found[1], dtype=np.float64)


def definite_solver(K: Any, M: Any, shift: float) -> Callable[[FloatArray], FloatArray]:
    """Return the solution of ``(K + shift M) x = b`` as a function of b (n, m)."""
    small = K.shape[0] <= _DENSE
    if small or not all(sp.issparse(part) for part in (K, M)):
        try:
            factor = la.cho_factor(dense(K) + shift * dense(M))
        except la.LinAlgError as error:
            raise SolverError("K + s M is not positive definite: K has a negative part.") from error
        return lambda b: np.asarray(la.cho_solve(factor, b))
    matrix = sp.csc_array(K + shift * M)
    held = _factorise(matrix, dissect(matrix) if K.shape[0] > DENSE_LIMIT else None)
    return lambda b: np.asarray(held.solve(b))


def _factorise(matrix: Any, order: Dissection | None) -> Any:
    """Return a factorisation with a method solve; by fronts where K + s M is definite and large."""
    if order is not None:
        with attempted("a multifrontal Cholesky factor", SolverError):
            return MultifrontalFactor(matrix, order)
    return symmetric_lu(matrix)


def _count_below(
    K: Any, M: Any, values: FloatArray, n_zero: int, order: Dissection | None
) -> int | None:
    """Return how many eigenvalues lie below the first positive one, by Sylvester's law."""
    positive = np.sort(values[n_zero:][values[n_zero:] > 0])
    if not positive.size:
        return None
    shifted = sp.csc_array(K - 0.5 * positive[0] * M)
    with attempted("a count of the eigenvalues below the first positive one", SolverError):
        if order is not None:
            return multifrontal_inertia(shifted, order)
        return negative_pivots(symmetric_lu(shifted))
    return None
