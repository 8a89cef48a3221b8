"""The lowest eigenvalues of matrices that need not be a model yet: number and rounding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from ..checks import FloatArray, IntArray
from ..errors import SolverError, attempted
from ..parallel import one_thread
from .factor import (
    DENSE_LIMIT,
    MultifrontalFactor,
    by_rows,
    dense,
    diagonal,
    eliminated,
    negative_pivots,
    symmetric_lu,
)
from .lanczos import VALUE, BlockLanczos, beyond, iterated, rayleigh_ritz
from .ordering import Dissection, dissect

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
    """Return how many eigenvalues of a sparse symmetric matrix are negative."""
    # with `single`, and where the factorisation is most of the work, it is tried in single
    # precision first, and taken if refinement shows that its rounding changes no sign. In double
    # precision the factor is not kept. A random `b = A x` is eliminated along:
    # `x^T A x = y^T D^-1 y` with `L y = b` shows whether pivots restricted to the blocks were
    # stable
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
    if not np.all(np.abs(energy - wanted) <= _ENERGY * size):
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


#: up to this many DOFs dense LAPACK finds every eigenvalue
_DENSE = 300
#: relative to the typical K_ii / M_ii: the first shift
_FIRST_SHIFT = 1e-8
#: eigenvalues that rounding of this many units in the last place could make are zero
ROUNDING = 30 * 2.0**-52
#: relative error of an entry in double precision
PRECISION = float(np.finfo(np.float64).eps)
#: more zero eigenvalues than this are not listed one by one
_MOST = 64


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
    """Return the `count` lowest eigenvalues and more, until one of them is not zero."""
    # by inverse iteration at a shift below zero, hence exact to rounding also where K is singular
    # and M has massless rows
    K, M = sp.csc_array(K), sp.csc_array(M)
    first = np.zeros((K.shape[0], 0)) if known is None else known
    stiff, heavy = np.abs(diagonal(K)), diagonal(M)
    ratios = stiff[heavy > 0] / heavy[heavy > 0]
    typical = float(np.median(ratios[ratios > 0])) if np.any(ratios > 0) else 1.0
    shift, number, size = _FIRST_SHIFT * typical, count, cast(Any, abs(K))
    floor = max(rounding, ROUNDING)
    of_known = np.einsum("ij,ij->j", np.abs(first), np.asarray(size @ np.abs(first)))
    # one elimination order serves all shifts
    large = K.shape[0] > DENSE_LIMIT
    order = dissect(sp.csc_array(K + shift * M), nodes, xyz) if large else None
    limit = min(int(np.count_nonzero(heavy > 0)) - first.shape[1], _MOST)
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
        # close to the elastic modes, these separate well; as near to zero as rounding allows
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
        return _inverse_iteration(K, M, shift, min(count, _MOST), order, none)
    return None


def _inverse_iteration(
    K: Any, M: Any, shift: float, count: int, order: Dissection | None, known: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return `count` eigenvalues of smallest lambda + shift, M-orthonormal shapes, beside known."""
    n, r = known.shape
    if count <= 0:
        return np.zeros(0), np.zeros((n, 0))
    if n <= _DENSE or count > n // 3:
        stiff, heavy = dense(K + shift * M), dense(M)
        try:
            mu, shapes = la.eigh(heavy, stiff)
        except la.LinAlgError:
            # K is indefinite: M must then be definite, or there is nothing to work with
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
        # what rounding of the largest hides is found beside it
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
    # the same start every time: the same answer every time
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
