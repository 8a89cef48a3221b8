"""Symmetric sparse factors: Cholesky on the fronts of a nested dissection, SuperLU; inertia."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg import blas, lapack

from ..arrays import ComplexArray, FloatArray, IntArray, Matrix
from ..errors import SolverError, attempted
from ..parallel import one_thread
from ..tolerances import FOUR_DIGITS
from .ordering import Dissection, Front, dissect
from .symmetric import by_rows, dense, diagonal, unit_diagonal

#: number of DOFs up to which dense LAPACK is as fast as a sparse factorisation, and safer
DENSE_LIMIT = 1500
#: largest number of rows of a full matrix, limited by memory
LARGEST_FULL = 6000
#: number of Lanczos steps for that bound, and the probability that it is wrong
_BOUND_STEPS, _BOUND_CHANCE = 180, 1e-9


def not_definite(who: str) -> SolverError:
    """Return the error of a factorisation that needs a positive definite matrix."""
    return SolverError(
        f"{who} met a pivot that is not positive: the matrix is indefinite or singular. Look for a "
        "sign, or for DOFs without stiffness or mass."
    )


def diagonal_lu(matrix: Any, singular: str) -> Any:
    """Return the SuperLU factorisation of a symmetric sparse matrix, real or complex."""
    # pivots are taken from the diagonal where they are not zero, so that solutions need a
    # refinement
    splu: Any = spla.splu
    try:
        return splu(
            sp.csc_matrix(matrix),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise SolverError(
            f"a sparse symmetric factorisation met a singular matrix ({error}): {singular}"
        ) from error


def dynamic_lu(stiffness: Any) -> Any:
    """Return the factorisation of a sparse dynamic stiffness ``s^2 M + s D + K``."""
    return diagonal_lu(
        stiffness,
        "the frequency of a dynamic stiffness is a resonance of the undamped structure. Move it a "
        "little, or give the structure damping.",
    )


def symmetric_lu(matrix: Matrix) -> Any:
    """Return the SuperLU factorisation of a symmetric sparse matrix with diagonal pivots only."""
    lu = diagonal_lu(
        matrix,
        "the shift hits an eigenvalue, or DOFs without any stiffness are in the model. Remove "
        "those DOFs.",
    )
    if not np.array_equal(lu.perm_r, lu.perm_c):
        raise SolverError(
            "a sparse symmetric factorisation met a zero pivot and left the diagonal: its inertia "
            "is not known. A zero on the diagonal of K or M is the usual reason."
        )
    return lu


def negative_pivots(lu: Any) -> int:
    """Return how many eigenvalues of the factored symmetric matrix are negative (Sylvester)."""
    return int(np.count_nonzero(lu.U.diagonal() < 0))


def is_positive_definite(matrix: Matrix, tolerance: float = 0.0) -> bool:
    """Return whether ``S A S + tolerance I`` is positive definite, S scaling A's diagonal to 1."""
    # large sparse matrices are tried by a bound on their lowest eigenvalue first, then factored
    if np.any(diagonal(matrix) < 0) or (tolerance == 0 and np.any(diagonal(matrix) == 0)):
        return False
    scaled, _ = unit_diagonal(matrix)
    n = scaled.shape[0]
    if sp.issparse(scaled) and n > DENSE_LIMIT:
        shifted = sp.csc_array(scaled + tolerance * sp.eye_array(n)) if tolerance else scaled
        if n > LARGEST_FULL and lowest_eigenvalue_bound(shifted) > 0:
            return True
        try:
            MultifrontalFactor(shifted, dissect(shifted), keep=False)
        except SolverError:
            return False
        return True
    try:
        la.cholesky(dense(scaled) + tolerance * np.eye(n), lower=True, check_finite=False)
    except la.LinAlgError:
        return False
    return True


def lowest_eigenvalue_bound(matrix: Any) -> float:
    """Return a lower bound of a sparse symmetric matrix' eigenvalues, wrong once in 1e9 matrices.

    Lanczos from a random vector sees the lowest eigenvalue from above, as theta; with c above all
    eigenvalues, ``(theta - lowest) / (c - lowest) > eps`` has a probability below ``1.648 sqrt(n)
    exp(-sqrt(eps) (2 k - 1))`` after k steps ([KuczynskiWozniakowski1992]_, theorem 4.2),
    whatever the matrix is.
    """
    n = matrix.shape[0]
    fast = by_rows(matrix)
    above = float(abs(fast).sum(axis=1).max())
    vector = np.random.default_rng(0).standard_normal(n)
    vector /= np.linalg.norm(vector)
    bound = -np.inf
    before, beta = np.zeros(n), 0.0
    main: list[float] = []
    off: list[float] = []
    for k in range(1, _BOUND_STEPS + 1):
        step = fast @ vector - beta * before
        main.append(float(vector @ step))
        step -= main[-1] * vector
        if k % 20 == 0 or k == _BOUND_STEPS:
            ritz = la.eigvalsh_tridiagonal(np.array(main), np.array(off))
            theta = float(ritz[0])
            eps = (np.log(1.648 * np.sqrt(n) / _BOUND_CHANCE) / (2 * k - 1)) ** 2
            if eps >= 1:
                continue
            # the highest eigenvalue from below, by the same theorem
            highest = min(above, (float(ritz[-1]) - eps * theta) / (1 - eps))
            bound = (theta - eps * highest) / (1 - eps)
            if bound > 0 or theta <= 0:
                break
        before, beta = vector, float(np.linalg.norm(step))
        off.append(beta)
        vector = step / beta
    return bound


#: mean number of entries of a block below which blocks are added by index lists, larger ones as
#: slices
_SLICE = 600
#: largest number of DOFs of a pivot block that is stored as its inverse
_INVERTED = 128


class MultifrontalFactor:
    """``A = L D L^T`` of a sparse symmetric matrix, D of +1 and -1 [DuffReid1983]_.

    Cholesky (D = I) unless `signed`, for matrices that need not be definite: pivots are then not
    moved between fronts, and the residual shows whether this was stable.
    """

    def __init__(
        self,
        matrix: Any,
        dissection: Dissection | None = None,
        *,
        keep: bool = True,
        single: bool = False,
        signed: bool = False,
    ) -> None:
        lower, self._scale = sp.csc_array(matrix), 0.0
        if single:  # single precision has a small range of numbers
            self._scale = float(np.abs(lower.data).max(initial=0.0)) or 1.0
            lower = _in_single(lower, self._scale)
        self.dissection = dissect(lower) if dissection is None else dissection
        self._blocks: list[tuple[Pivots | None, FloatArray]] = []
        #: negative eigenvalues of ``L D L^T``
        self.negative = 0
        with one_thread():
            for _, pivots, below in eliminated(lower, self.dissection, signed=signed):
                self.negative += pivots.negative
                if keep:
                    self._blocks.append(_stored(pivots, below))

    @property
    def n_entries(self) -> int:
        """Stored entries of the factor."""
        return sum(below.size + (p.size**2 if p else 0) for p, below in self._blocks)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return ``(L D L^T)^-1 right`` for (n,) or (n, m) right-hand sides, blocked."""
        order, fronts = self.dissection.order, self.dissection.fronts
        # rows in C order: one right-hand side after the other in each, for BLAS 3 on the fronts
        x = np.ascontiguousarray(right.reshape(order.size, -1)[order], dtype=np.float64)
        scale = None
        if self._scale:
            largest = np.abs(x).max(axis=0, initial=np.finfo(np.float64).tiny)
            x, scale = (x / largest).astype(np.float32), self._scale / largest
        with one_thread():
            for front, (pivots, below) in zip(fronts, self._blocks, strict=True):
                part = x[front.first : front.last]
                if pivots is None:
                    moved = below @ part
                    part[:] = moved[: len(part)]
                    x[front.rows] -= moved[len(part) :]
                else:
                    part[:] = pivots.signed(pivots.after(part.T).T)
                    x[front.rows] -= below @ part
            for front, (pivots, below) in zip(fronts[::-1], self._blocks[::-1], strict=True):
                part = x[front.first : front.last]
                if pivots is None:
                    own, below = below[: len(part)], below[len(part) :]
                    part[:] = own.T @ part - below.T @ x[front.rows]
                else:
                    part -= pivots.signed(below.T @ x[front.rows])
                    part[:] = pivots.before(part.T).T
        answer = np.empty(x.shape)
        answer[order] = x if scale is None else x / scale
        return answer.reshape(right.shape)


def _in_single(matrix: Any, scale: float) -> Any:
    """Return a sparse matrix over `scale` in single precision."""
    data = np.empty(matrix.data.shape, np.float32)
    np.divide(matrix.data, scale, out=data, casting="same_kind")
    return sp.csc_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


@cache
def _kernels(kind: str) -> dict[str, Any]:
    """Return the LAPACK and BLAS routines that fronts need in a precision."""
    names = ("potrf", "trtri", "sytrf", "sytrf_lwork", "syconv")
    found: Any = lapack.get_lapack_funcs(names, dtype=kind)
    more: Any = blas.get_blas_funcs(("trsm", "syrk"), dtype=kind)
    return dict(zip((*names, "trsm", "syrk"), (*found, *more), strict=True))


def _stored(pivots: Pivots, below: FloatArray) -> tuple[Pivots | None, FloatArray]:
    """Return a front in stored form: small ones as ``[L^-1; B L^-1]``, one product per solve."""
    if pivots.size > _INVERTED or isinstance(pivots, _SignedPivots):
        return pivots, below
    inverse = pivots.inverse()
    return None, np.vstack([inverse, below @ inverse])


def eliminated(
    lower: Any, dissection: Dissection, *, signed: bool
) -> Iterator[tuple[Front, Pivots, FloatArray]]:
    """Yield fronts with their factored pivots ``G diag(s) G^T``, and the rows below times ``G^-T``.

    Cholesky where the pivot block is positive definite; where it is not, Bunch-Kaufman when signed.
    """
    potrf, syrk = (_kernels(lower.dtype.char)[name] for name in ("potrf", "syrk"))
    for front, block, below, rest in assembled_fronts(lower, dissection):
        kept = block.copy(order="F") if signed else block
        _, info = potrf(block, lower=1, overwrite_a=1, clean=0)
        if info and not signed:
            raise not_definite("a sparse Cholesky factorisation")
        pivots = _SignedPivots(kept) if info else Pivots(block)
        del kept
        if front.rows.size:
            below = pivots.after(below)
            syrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1)
            if pivots.negative:
                # the few with a negative sign are added, not subtracted
                few = np.asfortranarray(below[:, pivots.signs < 0])
                syrk(2.0, few, beta=1.0, c=rest, lower=1, overwrite_c=1)
        yield front, pivots, below


class Pivots:
    """``A = G G^T`` of a positive definite block, by its Cholesky factor."""

    #: s of +1 and -1 in ``G diag(s) G^T``; None where all are +1
    signs: Any = None
    #: number of entries -1
    negative = 0

    def __init__(self, factor: FloatArray) -> None:
        self._factor, self.size = factor, len(factor)

    def after(self, rows: FloatArray) -> FloatArray:
        """Return ``rows G^-T``; rows in Fortran's order are overwritten."""
        return self._solved(rows, trans_a=1)

    def before(self, rows: FloatArray) -> FloatArray:
        """Return ``rows G^-1``; rows in Fortran's order are overwritten."""
        return self._solved(rows)

    def signed(self, part: FloatArray) -> FloatArray:
        """Return ``diag(s) part``."""
        return part if self.signs is None else np.asarray(self.signs[:, None] * part)

    def inverse(self) -> FloatArray:
        """Return ``G^-1``, in the place of G."""
        found, _ = _kernels(self._factor.dtype.char)["trtri"](self._factor, lower=1, overwrite_c=1)
        return np.tril(found)

    def _solved(self, rows: FloatArray, **options: int) -> FloatArray:
        trsm = _kernels(self._factor.dtype.char)["trsm"]
        return np.asarray(trsm(1.0, self._factor, rows, side=1, lower=1, overwrite_b=1, **options))


class _SignedPivots(Pivots):
    """``A = G diag(s) G^T`` of an indefinite block, s of +1 and -1 (Bunch-Kaufman).

    The lower triangle of A is overwritten.
    """

    def __init__(self, block: FloatArray) -> None:
        of = _kernels(block.dtype.char)
        work, _ = of["sytrf_lwork"](block.shape[0], lower=1)
        block, exchanges, _ = of["sytrf"](block, lower=1, lwork=int(work), overwrite_a=1)
        factor, off, _ = of["syconv"](block, exchanges, lower=1, overwrite_a=1)
        self._order = _exchanged(exchanges)
        main = np.diag(factor).copy()
        # 2 x 2 pivots by a rotation each
        self._one = one = np.flatnonzero(off)
        self._two = two = one + 1
        pivots = np.array([[main[one], off[one]], [off[one], main[two]]]).transpose(2, 0, 1)
        values, self._turn = np.linalg.eigh(pivots)
        main[one], main[two] = values.T
        if np.any(main == 0):
            raise SolverError(
                "a count of eigenvalues by L D L^T met a zero pivot: the shift hits an eigenvalue. "
                "Count at another frequency."
            )
        self._size = np.sqrt(np.abs(main))
        super().__init__(factor)
        self.signs, self.negative = np.sign(main), int(np.count_nonzero(main < 0))

    def after(self, rows: FloatArray) -> FloatArray:
        """Return ``rows G^-T``."""
        rows = rows.T[self._order].T
        if rows.size:
            rows = self._solved(rows, trans_a=1, diag=1)
        self._rotate(rows.T, self._turn)
        return rows / self._size

    def before(self, rows: FloatArray) -> FloatArray:
        """Return ``rows G^-1``."""
        rows = rows / self._size
        self._rotate(rows.T, self._turn.transpose(0, 2, 1))
        found = np.empty_like(rows)
        found[:, self._order] = self._solved(rows, diag=1)
        return found

    def _rotate(self, part: FloatArray, turn: FloatArray) -> None:
        one, two = self._one, self._two
        part[one], part[two] = (
            turn[:, 0, j, None] * part[one] + turn[:, 1, j, None] * part[two] for j in (0, 1)
        )


def _exchanged(exchanges: IntArray) -> IntArray:
    """Return the order of the rows after LAPACK's exchanges by Bunch-Kaufman, lower triangle."""
    order = np.arange(exchanges.size)
    k = 0
    while k < order.size:
        pair = exchanges[k] < 0
        last, other = k + int(pair), abs(int(exchanges[k])) - 1
        order[[last, other]] = order[[other, last]]
        k = last + 1
    return order


def assembled_fronts(
    lower: Any, dissection: Dissection
) -> Iterator[tuple[Front, FloatArray, FloatArray, FloatArray]]:
    """Yield each front with its assembled blocks: pivots, below, rest; its caller eliminates it."""
    # the blocks are real or complex, as the matrix is, their lower triangles `rest` must contain
    # the remainder for the parent before the next front is allocated
    pointer, index, value = _permuted_triangle(lower, dissection.order)
    place = np.zeros(dissection.order.size, dtype=np.int64)
    left: dict[int, FloatArray] = {}
    fronts = dissection.fronts
    for k, front in enumerate(fronts):
        first, last, rows = front.first, front.last, front.rows
        p, q = last - first, rows.size
        place[first:last] = np.arange(p)
        place[rows] = np.arange(p, p + q)
        pivots = np.zeros((p, p), value.dtype, order="F")
        below = np.zeros((q, p), value.dtype, order="F")
        rest = np.zeros((q, q), value.dtype, order="F")
        begin, end = int(pointer[first]), int(pointer[last])
        at = place[index[begin:end]]
        column = np.repeat(np.arange(p), np.diff(pointer[first : last + 1]))
        inside = at < p
        entries = value[begin:end]
        pivots.T[column[inside], at[inside]] = entries[inside]
        if q:
            outside = ~inside
            below.T[column[outside], at[outside] - p] = entries[outside]
        for child in front.children:
            _add(pivots, below, rest, place[fronts[child].rows], left.pop(child))
        yield front, pivots, below, rest
        left[k] = rest


def _permuted_triangle(matrix: Any, order: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the lower triangle of a matrix in an order, by columns."""
    n = order.size
    position = np.empty(n, dtype=np.int32)
    position[order] = np.arange(n, dtype=np.int32)
    rows = position[matrix.indices]
    columns = np.repeat(position, np.diff(matrix.indptr))
    keep = rows >= columns
    triangle: Any = sp.csc_array(
        sp.coo_array((matrix.data[keep], (rows[keep], columns[keep])), shape=(n, n))
    )
    pointer: IntArray = triangle.indptr.astype(np.int64)
    return pointer, triangle.indices, triangle.data


def _add(
    pivots: FloatArray, below: FloatArray, rest: FloatArray, at: IntArray, child: FloatArray
) -> None:
    """Add a child's remainder (lower triangle) to its parent's blocks, row i at `at[i]`."""
    p = pivots.shape[0]
    if not at.size:
        return
    split = int(np.searchsorted(at, p))
    cuts = np.flatnonzero(np.diff(at) != 1) + 1
    runs = np.unique(np.concatenate([[0, split], cuts, [at.size]]))
    if at.size**2 < _SLICE * (runs.size - 1) ** 2:
        low, high = at[:split], at[split:] - p
        if split:
            pivots.T[low[:, None], low] += child.T[:split, :split]
            if high.size:
                below.T[low[:, None], high] += child.T[:split, split:]
        if high.size:
            rest.T[high[:, None], high] += child.T[split:, split:]
        return
    begins, ends = runs[:-1].tolist(), runs[1:].tolist()
    targets = at[runs[:-1]].tolist()
    for j, (cb, ce) in enumerate(zip(begins, ends, strict=True)):
        c = targets[j]
        for i in range(j, len(begins)):
            rb, re, r = begins[i], ends[i], targets[i]
            if r < p:
                pivots[r : r + re - rb, c : c + ce - cb] += child[rb:re, cb:ce]
            elif c < p:
                below[r - p : r - p + re - rb, c : c + ce - cb] += child[rb:re, cb:ce]
            else:
                rest[r - p : r - p + re - rb, c - p : c - p + ce - cb] += child[rb:re, cb:ce]


#: number of columns of a remainder updated together: little of the symmetric upper part is computed
_STRIP = 256


class ComplexSymmetricFactor:
    """``A = L D L^T`` (not conjugated) of a sparse complex symmetric matrix, by fronts.

    Each pivot block D is factored with its own row exchanges; pivots are not moved between
    fronts. That is stable for the dynamic stiffness ``K + i omega D - omega^2 M`` of a damped
    structure; the residual of a solution shows it.
    """

    def __init__(self, matrix: Any, dissection: Dissection | None = None) -> None:
        lower = sp.csc_array(matrix, dtype=np.complex128)
        self.dissection = dissect(lower) if dissection is None else dissection
        #: for each front: LU of its pivot block, the exchanges, and ``D^-1 B^T``
        self._blocks: list[tuple[ComplexArray, Any, ComplexArray]] = []
        with one_thread():
            for _, pivots, below, rest in assembled_fronts(lower, self.dissection):
                block = np.asfortranarray(np.tril(pivots) + np.tril(pivots, -1).T)
                factor, exchanges, info = lapack.zgetrf(block, overwrite_a=1)
                if info:
                    raise SolverError(
                        "a dynamic stiffness is singular: its frequency is a resonance of an "
                        "undamped structure. Move it a little, or give the structure damping."
                    )
                solved: Any = below.T
                if rest.size:
                    solved, _ = lapack.zgetrs(factor, exchanges, below.T)
                    for j in range(0, rest.shape[0], _STRIP):
                        strip = slice(j, j + _STRIP)
                        # in the order in which both are stored, columns of `rest` as rows
                        rest.T[strip, j:] -= solved[:, strip].T @ below[j:].T
                self._blocks.append((factor, exchanges, solved))

    @property
    def n_entries(self) -> int:
        """Stored entries of the factor."""
        return sum(factor.size + solved.size for factor, _, solved in self._blocks)

    def solve(self, right: FloatArray | ComplexArray) -> ComplexArray:
        """Return ``A^-1 right`` for (n,) or (n, m) right-hand sides."""
        order = self.dissection.order
        x = np.ascontiguousarray(right.reshape(order.size, -1)[order], dtype=np.complex128)
        fronts = self.dissection.fronts
        with one_thread():
            for front, (_, _, solved) in zip(fronts, self._blocks, strict=True):
                if front.rows.size:
                    x[front.rows] -= solved.T @ x[front.first : front.last]
            for front, (factor, exchanges, solved) in zip(
                fronts[::-1], self._blocks[::-1], strict=True
            ):
                part, _ = lapack.zgetrs(factor, exchanges, x[front.first : front.last])
                if front.rows.size:
                    part -= solved @ x[front.rows]
                x[front.first : front.last] = part
        answer = np.empty_like(x)
        answer[order] = x
        return answer.reshape(right.shape)


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
