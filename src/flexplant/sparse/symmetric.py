"""Symmetric matrices, sparse or dense; their eigenvalues in the span of shapes, or by Lanczos."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import COLUMNS, FloatArray, IntArray, Matrix, Rng, divisor
from ..errors import ModelError, SolverError, counted
from ..parallel import PIECE, tick
from ..tolerances import (
    FOUR_DIGITS,
    MOST_STEPS,
    NEGLIGIBLE,
    NULL,
    PRECISION,
    RANK,
    ROOT,
    ROUNDING,
    SAME,
    SPLIT,
)

#: fraction of non-zero entries below which stored zeros are removed before products
_FULL = 0.8
#: ratio of eigenvalues below which one solution finds all with a relative error of 1e-9
SPREAD = SPLIT
#: number of rows, or of numbers in a group of columns, processed together: arrays below 128 kB, for
#: which no memory is fetched from the system
_ROWS = 16_000
#: number of units in the last place below which an eigenvalue counts as zero
ZERO = 30 * PRECISION


def dense(matrix: Matrix) -> FloatArray:
    """Return a matrix as a dense array."""
    if sp.issparse(matrix):
        sparse: Any = matrix
        return np.asarray(sparse.toarray(), dtype=np.float64)
    return np.asarray(matrix, dtype=np.float64)


def by_rows(matrix: Any) -> Any:
    """Return a symmetric sparse matrix stored by rows, which multiplies faster; dense: itself.

    No copy is made: the columns of a symmetric matrix are its rows.
    """
    if not sp.issparse(matrix):
        return np.asarray(matrix, dtype=np.float64)
    given: Any = matrix
    if given.format == "csr":
        return given
    stored: Any = sp.csc_array(given)
    return sp.csr_array((stored.data, stored.indices, stored.indptr), shape=stored.shape)


def same_pattern(given: Any, other: Any) -> bool:
    """Return whether the same entries of two sparse matrices are stored."""
    pairs = ((given.indptr, other.indptr), (given.indices, other.indices))
    # arrays in one place in memory need no comparison
    return all(
        a.size == b.size
        and ((a.dtype == b.dtype and a.ctypes.data == b.ctypes.data) or np.array_equal(a, b))
        for a, b in pairs
    )


def with_pattern_of(given: Any, other: Matrix) -> Any:
    """Return a matrix that shares the index arrays of another where both store the same entries."""
    matrix: Any = given
    shared: Any = other
    if not sp.issparse(given) or not sp.issparse(other) or not same_pattern(given, other):
        return given
    return sp.csc_array((matrix.data, shared.indices, shared.indptr), shape=shared.shape)


def without_zeros(matrix: Any) -> Any:
    """Return a sparse matrix without stored zeros, a copy where there are many."""
    given: Any = matrix
    if not sp.issparse(matrix) or np.count_nonzero(given.data) > _FULL * given.nnz:
        return given
    kept = given.copy()
    kept.eliminate_zeros()
    return kept


def matrix_sum(matrix: Matrix | None, change: Matrix | None) -> Matrix | None:
    """Return the sum of two matrices, either may be None; sparse where the first one is."""
    if matrix is None or change is None:
        return change if matrix is None else matrix
    if sp.issparse(matrix):
        return sp.csc_array(matrix + sp.csc_array(change))
    return np.asarray(matrix + change, dtype=np.float64)


def projected(matrix: Any, V: FloatArray) -> FloatArray:
    """Return ``V^T A V``, exactly symmetric."""
    product = V.T @ np.asarray(matrix @ V)
    return np.asarray(0.5 * (product + product.T), dtype=np.float64)


def diagonal(matrix: Matrix) -> FloatArray:
    """Return the diagonal of a dense or sparse matrix."""
    return np.asarray(matrix.diagonal(), dtype=np.float64)


def unit_diagonal(matrix: Matrix) -> tuple[Matrix, FloatArray]:
    """Return ``S A S`` with ones (or zeros) on its diagonal, and the diagonal of S."""
    # displacements and rotations have different units, and entries compare only after this scaling
    size = np.sqrt(np.abs(diagonal(matrix)))
    scale = 1.0 / np.where(size > 0, size, size.max(initial=0.0) or 1.0)
    if sp.issparse(matrix):
        weight = sp.diags_array(scale)
        return sp.csc_array(weight @ matrix @ weight), scale
    return scale[:, None] * np.asarray(matrix) * scale, scale


#: largest rank that is searched
FEW = 4


def factors(
    matrix: FloatArray, *, most: int = FEW, rounding: float = NULL
) -> list[tuple[float, FloatArray]] | None:
    """Return s_i = +-1 and b_i of ``A = sum_i s_i b_i b_i^T``, by pivots; None when there are more.

    Also None without a non-zero diagonal entry, as for [[0, 1], [1, 0]].
    """
    size = float(np.abs(matrix).max(initial=0.0))
    found: list[tuple[float, FloatArray]] = []
    left = matrix
    for _ in range(most):
        i = int(np.argmax(np.abs(np.diag(left))))
        pivot = float(left[i, i])
        if abs(pivot) <= rounding * size:
            return None
        b, sign = left[:, i] / np.sqrt(abs(pivot)), float(np.sign(pivot))
        left = left - sign * np.outer(b, b)
        found.append((sign, b))
        if np.abs(left).max() <= rounding * size:
            return found
    return None


def congruence(stack: FloatArray, V: FloatArray) -> FloatArray:
    """Return ``V^T A V`` for all A (q, k, k), as ``s (V^T b)(V^T b)^T`` for a single factor."""
    found = np.zeros((stack.shape[0], V.shape[1], V.shape[1]))
    for A, own in zip(stack, found, strict=True):
        if not A.any():
            continue
        one = factors(A, most=1, rounding=RANK)
        if one is None:
            own[:] = V.T @ A @ V
        else:
            c = one[0][1] @ V
            own[:] = one[0][0] * np.outer(c, c)
    return found


def rayleigh_ritz(K: Any, M: Any, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 (k,), ascending, and M-orthonormal shapes (n, k) in the span of X."""
    # LAPACK's error is of the order of the rounding of the largest eigenvalue. The soft modes are
    # therefore separated from the stiff ones to first order and solved again, group by group, as
    # often as the spread of the eigenvalues requires. X is overwritten
    K, M = by_rows(K), by_rows(M)
    squares, mix = _eigh(K, M, X)
    X = mixed(X, mix)
    end = squares.size
    # a largest eigenvalue of zero or below is rounding
    while end > 1 and squares[0] < SPREAD * squares[end - 1] > 0.0:
        end = soft_group(squares[:end])
        part = np.ascontiguousarray(X[:, :end])
        squares[:end], mix = _eigh(K, M, part)
        X[:, :end] = mixed(part, mix)
    return squares, X


def soft_group(squares: FloatArray) -> int:
    """Return the number of ascending eigenvalues in the soft group, up to the widest gap."""
    top = float(squares[-1])
    # lower values have an error of the rounding of the largest one, so that gaps among them mean
    # nothing
    sure = np.maximum(squares, 0.1 * SPREAD * top)
    ratio = np.where(sure[:-1] <= NEGLIGIBLE * top, sure[1:] / sure[:-1], 0.0)
    return int(np.argmax(ratio)) + 1


def rounding_of(K: Any, phi: FloatArray) -> FloatArray:
    """Return ``eps |phi|^T |K| |phi|`` of each M-orthonormal shape [1/s^2]."""
    # this is the change of an eigenvalue when the entries of K are rounded to double precision; no
    # method can find it more accurately
    size_of_K, found = Absolute(K), np.zeros(phi.shape[1])
    for at in column_groups(phi.shape[1], width_of(len(phi))):
        size = np.abs(phi[:, at])
        found[at] = PRECISION * np.einsum("ij,ij->j", size, size_of_K @ size)
    return found


def width_of(rows: int) -> int:
    """Return how many shapes of a number of rows are multiplied at a time."""
    return max(COLUMNS, _ROWS // max(rows, 1))


def column_groups(count: int, most: int = COLUMNS) -> Iterator[slice]:
    """Yield the columns of a wide array in groups of one size, which limits the memory."""
    groups = -(-count // most)
    for k in range(groups):
        yield slice(k * count // groups, (k + 1) * count // groups)


class Absolute:
    """Products with ``|K|``, entry by entry, without a copy of a large matrix."""

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
    """Return ``X mix`` in place of X, without a second array of this size."""
    for begin in range(0, X.shape[0], _ROWS):
        rows = slice(begin, begin + _ROWS)
        X[rows, : mix.shape[1]] = X[rows] @ mix
    return X[:, : mix.shape[1]]


def _eigh(K: Any, M: Any, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    stiffness, mass = np.zeros((2, X.shape[1], X.shape[1]))
    for at in column_groups(X.shape[1], width_of(len(X))):
        part, later = np.ascontiguousarray(X[:, at]), X[:, at.start :].T
        # lower triangles
        stiffness[at.start :, at] = later @ (K @ part)
        mass[at.start :, at] = later @ (M @ part)
    squares, mix = la.eigh(stiffness, mass)
    return np.asarray(squares), np.asarray(mix)


#: fraction of a vector outside of a basis below which it depends on the basis: five digits
DEPENDENT = 1e-5


def beyond(M: Any, V: FloatArray, part: FloatArray, *, dependent: float = DEPENDENT) -> FloatArray:
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
    # again, since nearly dependent vectors have lost digits
    new = new - V @ (V.T @ np.asarray(M @ new))
    factor = la.cholesky(new.T @ np.asarray(M @ new), lower=True)
    return np.asarray(la.solve_triangular(factor, new.T, lower=True).T)


def orthonormalised(M: Matrix, basis: FloatArray, *, dependent: str = "raise") -> FloatArray:
    """Return the M-orthonormal vectors of a basis, in order, by Gram-Schmidt done twice."""
    done = np.zeros((basis.shape[0], 0))
    loaded = np.zeros((basis.shape[0], 0))  # M times the basis, stored to save products with M
    for i in range(basis.shape[1]):
        vector = basis[:, i]
        length = _mass_norm(M, vector) if vector.any() else 0.0
        if length:
            for _ in range(2):
                vector = vector - done @ (loaded.T @ vector)
        left = _mass_norm(M, vector) if length else 0.0
        if left <= SAME * length:
            if dependent == "drop":
                continue
            raise ModelError(
                f"vector {i + 1} of a basis depends on those before it "
                f"(M-norm {left:.3g} of {length:.3g} is left): give independent vectors."
            )
        vector = vector / left
        # again, to remove the rounding of the normalisation
        vector = vector - done @ (loaded.T @ vector)
        forces = np.asarray(M @ vector)
        size = np.sqrt(vector @ forces)
        done = np.column_stack([done, vector / size])
        loaded = np.column_stack([loaded, forces / size])
    return done


def _mass_norm(M: Matrix, vector: FloatArray) -> float:
    square = float(vector @ np.asarray(M @ vector))
    if square < 0:
        raise ModelError(
            f"M is not positive definite: a motion has the inertia {square:.3g}. Look for a sign, "
            "or for a negative added mass that is larger than the mass at its place."
        )
    return float(np.sqrt(square))


#: number of vectors solved together
LANCZOS_VECTORS = 12
#: number of values above the last wanted one among which a gap for a count is searched
EXTRA_VALUES = 4
#: residual below which the value is exact to rounding, since its error is the square of the
#: residual
VALUE_SETTLED = SPLIT
#: label of the progress bar
LANCZOS_STEPS = "modes, steps of Lanczos"
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
        block: int = LANCZOS_VECTORS,
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
            _STEPS * LANCZOS_VECTORS, _FEW_STEPS * self._block, 5 * want // 4 + self._block
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
            required[shapes:] = max(tolerance, VALUE_SETTLED)
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
        tick(LANCZOS_STEPS)

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
