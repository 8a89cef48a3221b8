"""The inertia of sparse symmetric matrices: how many eigenvalues are negative (Sylvester)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import blas, lapack

from ..checks import FloatArray, IntArray
from ..errors import SolverError
from ..parallel import one_thread
from .factor import by_rows
from .multifrontal import assembled, in_single
from .ordering import Dissection, Front, dissect

#: rounding let pass in the energies that accompany a count
_ENERGY = 1e-4
#: spectral radius of the error of a factor, relative to it, up to which its inertia is accepted
_RADIUS = 0.5
#: random vectors that estimate it, and the part of its largest effect that all may miss: with a
#: chance of (0.8 _MISSED)^_VECTORS, 1e-13; the largest power that is tried
_VECTORS, _MISSED, _POWER = 12, 0.1, 10


def multifrontal_inertia(
    matrix: Any, dissection: Dissection | None = None, *, single: bool = True
) -> int:
    """Return how many eigenvalues of a sparse symmetric matrix are negative.

    With `single`, and where the factorisation is most of the work, it is tried in single precision
    first, and taken if refinement shows that its rounding changes no sign. In double precision the
    factor is not kept. A random ``b = A x`` is eliminated along: ``x^T A x = y^T D^-1 y`` with
    ``L y = b`` shows whether pivots restricted to the blocks were stable.
    """
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
        for front, pivots, below in _eliminated(lower, chosen):
            y = pivots.after(b[front.first : front.last].T).T
            moved = pivots.signs[:, None] * y
            energy += np.sum(y * moved, axis=0)
            b[front.rows] -= below @ moved
            negative += pivots.negative
    if not np.all(np.abs(energy - wanted) <= _ENERGY * size):
        raise SolverError(
            f"a count of eigenvalues by L D L^T is not accurate (energies differ by "
            f"{np.max(np.abs(energy - wanted) / size):.1g}): the shift is too close to an "
            "eigenvalue. Count at another frequency."
        )
    return negative


def signed_factor(matrix: Any, dissection: Dissection) -> SignedFactor | None:
    """Return a factor in single precision that counts; None where rounding may change a sign."""
    try:
        factor = SignedFactor(matrix, dissection)
    except SolverError:
        return None
    return factor if factor.error_radius(matrix) < _RADIUS else None


class SignedFactor:
    """``A = L D L^T`` of a sparse symmetric matrix in single precision, D of +1 and -1.

    Pivots are not moved between fronts: `error_radius` shows whether that was stable.
    """

    def __init__(self, matrix: Any, dissection: Dissection) -> None:
        self._order = dissection.order
        self._scale = float(np.abs(matrix.data).max(initial=0.0)) or 1.0
        lower = in_single(matrix, self._scale)
        with one_thread():
            self._blocks = list(_eliminated(lower, dissection))

    @property
    def negative(self) -> int:
        """Negative eigenvalues of ``L D L^T``."""
        return sum(pivots.negative for _, pivots, _ in self._blocks)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return ``(L D L^T)^-1 right`` for (n, m) right-hand sides, to single precision."""
        largest = np.abs(right).max(axis=0, initial=np.finfo(np.float64).tiny)
        x: Any = np.ascontiguousarray(right[self._order] / largest, dtype=np.float32)
        with one_thread():
            for front, pivots, below in self._blocks:
                part = pivots.signs[:, None] * pivots.after(x[front.first : front.last].T).T
                x[front.first : front.last] = part
                x[front.rows] -= below @ part
            for front, pivots, below in self._blocks[::-1]:
                part = x[front.first : front.last]
                part -= pivots.signs[:, None] * (below.T @ x[front.rows])
                x[front.first : front.last] = pivots.before(part.T).T
        answer = np.empty(right.shape)
        answer[self._order] = x
        answer *= largest / self._scale
        return answer

    def error_radius(self, matrix: Any) -> float:
        """Return a bound of the spectral radius of ``G = I - (L D L^T)^-1 A``, wrong once in 1e12.

        With ``L D L^T = A + E`` the matrices ``A + t E``, t from 0 to 1, are regular when it is
        below 1: no eigenvalue changes its sign, and A has the inertia of D. ``G^k`` stretches some
        direction v most; of Gaussian x nearly all have ``|v^T x| > 0.1``, and then
        ``rho^k <= ||G^k|| <= ||G^k x|| / |v^T x|``.
        """
        A = by_rows(matrix)
        x = np.random.default_rng(0).standard_normal((A.shape[0], _VECTORS))
        size, bound = np.inf, np.inf
        for k in range(1, _POWER + 1):
            before = size
            x -= self.solve(A @ x)
            size = float(np.linalg.norm(x, axis=0).max())
            bound = min(bound, (size / _MISSED) ** (1 / k))
            if bound < _RADIUS or (k > 2 and size > _RADIUS * before):
                break
        return bound


def _eliminated(lower: Any, dissection: Dissection) -> Iterator[tuple[Front, _Pivots, FloatArray]]:
    """Yield each front with its factored pivots ``G diag(s) G^T``, and what is below by ``G^-T``.

    Cholesky where the pivot block is positive definite, Bunch-Kaufman where it is not.
    """
    of_lapack: Any = lapack.get_lapack_funcs(("potrf",), dtype=lower.dtype)
    of_blas: Any = blas.get_blas_funcs(("syrk",), dtype=lower.dtype)
    (potrf,), (syrk,) = of_lapack, of_blas
    for front, block, below, rest in assembled(lower, dissection):
        kept = block.copy(order="F")
        _, info = potrf(block, lower=1, overwrite_a=1, clean=0)
        pivots = _SignedPivots(kept) if info else _Pivots(block, np.ones(len(block), block.dtype))
        del kept
        if front.rows.size:
            below = pivots.after(below)
            syrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1)
            if pivots.negative:
                # the few with a negative sign are added, not taken away
                few = np.asfortranarray(below[:, pivots.signs < 0])
                syrk(2.0, few, beta=1.0, c=rest, lower=1, overwrite_c=1)
        yield front, pivots, below


class _Pivots:
    """``A = G G^T`` of a positive definite block, by its Cholesky factor."""

    def __init__(self, factor: FloatArray, signs: FloatArray) -> None:
        self._factor, self.signs = factor, signs
        self.negative = int(np.count_nonzero(signs < 0))
        trsm: Any = blas.get_blas_funcs(("trsm",), dtype=factor.dtype)
        (self._trsm,) = trsm

    def after(self, rows: FloatArray) -> FloatArray:
        """Return ``rows G^-T``; rows in Fortran's order are overwritten."""
        return self._solved(rows, trans_a=1)

    def before(self, rows: FloatArray) -> FloatArray:
        """Return ``rows G^-1``; rows in Fortran's order are overwritten."""
        return self._solved(rows)

    def _solved(self, rows: FloatArray, **options: int) -> FloatArray:
        solved = self._trsm(1.0, self._factor, rows, side=1, lower=1, overwrite_b=1, **options)
        return np.asarray(solved)


class _SignedPivots(_Pivots):
    """``A = G diag(s) G^T`` of an indefinite block, s of +1 and -1 (Bunch-Kaufman).

    The lower triangle of A is overwritten.
    """

    def __init__(self, block: FloatArray) -> None:
        names = ("sytrf", "sytrf_lwork", "syconv")
        of_lapack: Any = lapack.get_lapack_funcs(names, dtype=block.dtype)
        sytrf, sytrf_lwork, syconv = of_lapack
        work, _ = sytrf_lwork(block.shape[0], lower=1)
        block, exchanges, _ = sytrf(block, lower=1, lwork=int(work), overwrite_a=1)
        factor, off, _ = syconv(block, exchanges, lower=1, overwrite_a=1)
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
        super().__init__(factor, np.sign(main))

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
