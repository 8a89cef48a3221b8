"""Block shift-invert Lanczos, repeated modes included; Rayleigh-Ritz in the span of shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..checks import FloatArray, IntArray, Matrix, Rng
from ..errors import SolverError, counted
from ..parallel import tick
from ..tolerances import ROUNDING, divisor
from .factor import by_rows, without_zeros

#: eigenvalues closer together than this are found to 1e-9 of themselves in one go
SPREAD = 1e-6
#: a group of soft modes ends below this part of the largest eigenvalue, at the widest gap
_END = 1e-3
#: rows that are worked on at a time
_ROWS = 65536
#: shapes that are multiplied at a time: a product of all at once is memory at its peak
_COLUMNS = 16
_EPS = float(np.finfo(np.float64).eps)


def rayleigh_ritz(K: Any, M: Any, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 (k,), ascending, and M-orthonormal shapes (n, k) in the span of X."""
    # LAPACK's error is a rounding of the largest eigenvalue. The soft modes, separated from the
    # stiff ones to first order, are therefore solved for again by themselves, group by group, as
    # often as the spread of the eigenvalues needs it. X is overwritten
    K, M = by_rows(K), by_rows(M)
    squares, mix = _eigh(K, M, X)
    X = mixed(X, mix)
    end = squares.size
    while end > 1 and squares[0] < SPREAD * squares[end - 1]:
        end = soft_group(squares[:end])
        part = np.ascontiguousarray(X[:, :end])
        squares[:end], mix = _eigh(K, M, part)
        X[:, :end] = mixed(part, mix)
    return squares, X


def soft_group(squares: FloatArray) -> int:
    """Return how many of some ascending eigenvalues form a soft group, up to the widest gap."""
    top = float(squares[-1])
    # those below are wrong by a rounding of the largest one: gaps among them say nothing
    sure = np.maximum(squares, 0.1 * SPREAD * top)
    ratio = np.where(sure[:-1] <= _END * top, sure[1:] / sure[:-1], 0.0)
    return int(np.argmax(ratio)) + 1


def rounding_of(K: Any, phi: FloatArray) -> FloatArray:
    """Return ``eps |phi|^T |K| |phi|`` of each M-orthonormal shape [1/s^2]."""
    # by so much the eigenvalue of a shape may change when the entries of K are rounded to double
    # precision: no method finds it closer to that of the structure
    size_of_K, found = Absolute(K), np.zeros(phi.shape[1])
    for at in column_groups(phi.shape[1]):
        size = np.abs(phi[:, at])
        found[at] = _EPS * np.einsum("ij,ij->j", size, size_of_K @ size)
    return found


def column_groups(count: int, most: int = _COLUMNS) -> Iterator[slice]:
    """Yield the columns of a wide array in groups of one size: made of one, little is large."""
    groups = -(-count // most)
    for k in range(groups):
        yield slice(k * count // groups, (k + 1) * count // groups)


class Absolute:
    """``|K|``, entry by entry, for products: a copy of a large matrix is memory at its peak."""

    def __init__(self, K: Any) -> None:
        self._K: Any = by_rows(K) if sp.issparse(K) else np.abs(K)

    def __matmul__(self, X: FloatArray) -> FloatArray:
        if not sp.issparse(self._K):
            return np.asarray(self._K @ X)
        K: Any = self._K
        found = np.empty((K.shape[0], *X.shape[1:]))
        for begin in range(0, K.shape[0], _ROWS):
            pointer = K.indptr[begin : begin + _ROWS + 1]
            at = slice(int(pointer[0]), int(pointer[-1]))
            rows = sp.csr_array(
                (np.abs(K.data[at]), K.indices[at], pointer - pointer[0]),
                shape=(pointer.size - 1, K.shape[1]),
            )
            found[begin : begin + _ROWS] = rows @ X
        return found


def mixed(X: FloatArray, mix: FloatArray) -> FloatArray:
    """Return ``X mix`` in the place of X: a second array of this size is memory at its peak."""
    for begin in range(0, X.shape[0], _ROWS):
        rows = slice(begin, begin + _ROWS)
        X[rows, : mix.shape[1]] = X[rows] @ mix
    return X[:, : mix.shape[1]]


def _eigh(K: Any, M: Any, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    stiffness, mass = np.zeros((2, X.shape[1], X.shape[1]))
    for at in column_groups(X.shape[1]):
        part, later = np.ascontiguousarray(X[:, at]), X[:, at.start :].T
        # lower triangles
        stiffness[at.start :, at] = later @ (K @ part)
        mass[at.start :, at] = later @ (M @ part)
    squares, mix = la.eigh(stiffness, mass)
    return np.asarray(squares), np.asarray(mix)


#: part of a vector, beyond the basis, below which it depends on it
_DEPENDENT = 1e-5


def beyond(M: Any, V: FloatArray, part: FloatArray, *, dependent: float = _DEPENDENT) -> FloatArray:
    """Return M-orthonormal vectors that span, with V, what V and `part` span."""
    if not part.shape[1]:
        return part
    length = np.sqrt(np.sum(part * np.asarray(M @ part), axis=0))
    part = part / divisor(length)
    for _ in range(2):
        part = part - V @ (V.T @ np.asarray(M @ part))
    gram = part.T @ np.asarray(M @ part)
    size, mix = la.eigh((gram + gram.T) / 2)
    keep = size > dependent**2
    new = part @ (mix[:, keep] / np.sqrt(size[keep]))
    # once more: what was nearly dependent has lost digits
    new = new - V @ (V.T @ np.asarray(M @ new))
    factor = la.cholesky(new.T @ np.asarray(M @ new), lower=True)
    return np.asarray(la.solve_triangular(factor, new.T, lower=True).T)


#: vectors that are solved for at a time
BLOCK = 12
#: residual of a Ritz pair of the inverse, relative to its value, at which it counts as found
FOUND = 1e-8
#: residual at which the value, in error by its square, is known to rounding
VALUE = 1e-6
#: what a bar calls the blocks that extend the basis
STEPS = "modes, steps of Lanczos"
#: steps between two restarts, with a large block
_STEPS, _FEW_STEPS = 12, 6
_RESTARTS = 60
#: a block with directions this much shorter than others is orthonormalised again
_LOST = 1e-3
#: what one orthogonalisation may take away, relative, for rounding to leave nothing of it
_SMALL = 1e-4
#: a change of M W, relative, that the later Rayleigh-Ritz step on the modes makes up for
_STALE = 1e-11
#: relative error of a Ritz pair below which its shape needs no tolerance of its own
_SURE = 1e-12
#: values below this part of the largest one, times FOUND, are not found beside it
_ROUNDING = 1e-14
#: residuals of this part of the largest value are rounding: no step reduces them
REACHED = 1e-15
#: values this close (relative) are of one repeated mode
SAME = 1e-8
#: shapes that are solved for at a time: each time, the whole factor is read
_SOLVED = 32
#: entries of a vector worked on at a time
_PIECE = 8192


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
        first = np.hstack([known, self._random(self._block - known.shape[1])])
        self._next, self._loaded, _ = self._orthonormal(first)
        self._over = np.zeros((self._next.shape[1], 0))

    def _reserve(self, want: int) -> None:
        # after a restart want + block vectors are kept; more than as many or _STEPS blocks follow,
        # of a large block fewer
        room = 2 * self._block + max(
            _STEPS * BLOCK, _FEW_STEPS * self._block, 5 * want // 4 + self._block
        )
        self._capacity = self._r + want + self._block + room

    def lowest(
        self,
        count: int,
        tolerance: float = FOUND,
        *,
        extra: int = 0,
        needed: Callable[[FloatArray], FloatArray] | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the `count` largest theta found and their shapes (n, count)."""
        # the last `extra` of them need not be shapes yet, only values. Of shapes (n, m) that are
        # found to `tolerance` but no further, `needed` says which tolerance (m,) each must reach.
        # Fewer than `count` are returned where the others are so much smaller than the largest that
        # its rounding hides them, or where a value has as many copies as the block has vectors,
        # which see no more of them: with those returned locked, another search, of a larger block,
        # finds the rest
        n = self._V.shape[1]
        count = min(count, n - self._r)
        check_at = self.steps
        for _ in range(_RESTARTS * _STEPS):
            if self._m + self._r >= n or not self._next.shape[1]:
                theta, mix, _ = self._pairs()
                return theta[:count], self._shapes(mix[:, :count])
            self._step()
            full = self._r + self._m + 2 * self._next.shape[1] > self._capacity
            if self.steps < check_at and not full:
                continue
            theta, mix, error = self._pairs()
            # what rounding of the largest value lets be found in this search
            sure = int(np.count_nonzero(theta * FOUND >= _ROUNDING * theta[0]))
            limited = sure < min(count, theta.size)
            wanted = sure if limited else count
            # a shape is as good as those of the same value: they may be mixed
            last = theta[min(count, theta.size) - extra - 1] if theta.size > extra else 0.0
            shapes = int(np.count_nonzero(theta[:count] >= (1 - SAME) * last))
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
                # the memory of the others is needed; a copy would need more first
                self._V.resize((self._r + keep, n), refcheck=False)
                return theta[:wanted], self._V[self._r :][:wanted].T.copy()
            # a step brings no more than a block of new ones, usually half of it
            check_at = self.steps + max(left, wanted - theta.size) // (2 * self._block)
        raise SolverError(
            f"Lanczos did not converge for {counted(count, 'mode')} in {self.steps} steps: M and K "
            "are badly conditioned. Look for DOFs with next to no mass, or request fewer modes."
        )

    def _random(self, columns: int) -> FloatArray:
        return self._rng.standard_normal((self._V.shape[1], columns))

    def _shapes(self, mix: FloatArray) -> FloatArray:
        return self._V[self._r : self._r + self._m].T @ mix

    def _step(self) -> None:
        """Extend the basis by the next block."""
        width, at = self._next.shape[1], self._r + self._m
        self._append(self._next)
        self._next = np.zeros((0, width))  # the basis has it
        moved = self._solve(self._loaded)
        # nearly all of it along the basis lies along the last block and those before it that T
        # couples to it: what is left is small, and one orthogonalisation enough
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
        # Gram-Schmidt until it takes next to nothing away, twice at most: that is enough
        # [Giraud2005]_; and again where the block itself had next to nothing new in some direction
        basis = self._V[: self._r + self._m]
        along = np.zeros((basis.shape[0], W.shape[1]))
        over = np.eye(W.shape[1])
        W = np.ascontiguousarray(W)
        # rounding of W is along what is locked: M times that is known
        _subtract(W, self._V[: self._r], self._locked.T @ W)
        loaded = self._M @ W
        for _ in range(3):
            for _ in range(2):
                part = along_basis(basis, loaded)
                _subtract(W, basis, part)
                along += part @ over
                before = float(np.sqrt(np.abs(np.sum(W * loaded, axis=0)).min()))
                taken = np.abs(part).max(initial=0.0)
                # where next to nothing is taken away, M W stays what it is
                if taken > _STALE * before:
                    loaded = self._M @ W
                if taken <= _SMALL * before:
                    break
            poor = False
            # twice: the first turn is exact only to the condition of the block
            for _ in range(2):
                size, turn = la.eigh(W.T @ loaded)
                # squares of lengths: 1e-12 of the longest direction is rounding
                keep = size > ROUNDING**2 * max(size[-1], 0.0)
                if size[-1] <= 0 or not np.any(keep):
                    empty = np.zeros((W.shape[0], 0))
                    return empty, empty, (along, np.zeros((0, over.shape[1])))
                root = np.sqrt(size[keep])
                W, loaded = (mixed(X, turn[:, keep] / root) for X in (W, loaded))
                over = (turn[:, keep] * root).T @ over
                poor = poor or bool(size[0] < _LOST**2 * size[-1])
            if not poor:
                break
            loaded = self._M @ W
        return W, loaded, (along, over)


def iterated(
    solve: Callable[[FloatArray], FloatArray], M: Matrix, locked: FloatArray, phi: FloatArray
) -> None:
    """Move shapes on by one inverse iteration beside the locked ones, in place."""
    # what is left in them of high modes, most of their residual, is gone then
    deflated = np.asarray(M @ locked)
    for at in column_groups(phi.shape[1], _SOLVED):
        force = np.asarray(M @ phi[:, at])
        force -= deflated @ (locked.T @ force)
        moved = solve(force)
        moved -= locked @ (deflated.T @ moved)
        phi[:, at] = moved


def _unconverged(theta: FloatArray, error: FloatArray, required: FloatArray) -> IntArray:
    """Return which Ritz pairs have not reached their tolerance."""
    limit = np.maximum(required[: theta.size] * theta, REACHED * theta[0])
    return np.flatnonzero(error[: theta.size] > limit)


def _most_copies(theta: FloatArray) -> int:
    """Return how many descending values the largest group of equal ones has."""
    ends = np.flatnonzero(theta[:-1] - theta[1:] > SAME * theta[:-1])
    return int(np.diff(np.concatenate([[-1], ends, [theta.size - 1]])).max(initial=0))


def along_basis(basis: FloatArray, loaded: FloatArray) -> FloatArray:
    """Return `basis @ loaded`, rows of the basis in pieces that fit the cache."""
    found = np.zeros((basis.shape[0], loaded.shape[1]))
    for begin in range(0, loaded.shape[0], _PIECE):
        piece = slice(begin, begin + _PIECE)
        found += basis[:, piece] @ loaded[piece]
    return found


def _subtract(W: FloatArray, basis: FloatArray, part: FloatArray) -> None:
    """Take `basis.T @ part` from W, in place."""
    for begin in range(0, W.shape[0], _PIECE):
        piece = slice(begin, begin + _PIECE)
        W[piece] -= (part.T @ basis[:, piece]).T
