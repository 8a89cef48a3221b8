"""Symmetric sparse factorisation, with the inertia of the matrix as a by-product."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from ..checks import FloatArray, IntArray, Matrix
from ..errors import SolverError
from .multifrontal import MultifrontalCholesky
from .ordering import dissect

#: up to this many DOFs dense LAPACK is as fast as a sparse factorisation, and safer
DENSE_LIMIT = 1500
#: stored zeros are left out for products where fewer entries than this part are none
_FULL = 0.8
#: from here on a bound by Lanczos is cheaper than a factorisation
_BOUND_LIMIT = 10_000
#: steps of that bound, and the chance that it is wrong
_BOUND_STEPS, _BOUND_CHANCE = 180, 1e-9


def dense(matrix: Matrix) -> FloatArray:
    """Return a matrix as a dense array."""
    if sp.issparse(matrix):
        sparse: Any = matrix
        return np.asarray(sparse.toarray(), dtype=np.float64)
    return np.asarray(matrix, dtype=np.float64)


def by_rows(matrix: Any) -> Any:
    """Return a symmetric sparse matrix (dense: itself) stored by rows: faster times many vectors.

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
    return all(a.size == b.size and (_same_memory(a, b) or np.array_equal(a, b)) for a, b in pairs)


def _same_memory(a: IntArray, b: IntArray) -> bool:
    return a.dtype == b.dtype and a.ctypes.data == b.ctypes.data


def with_pattern_of(given: Any, other: Matrix) -> Any:
    """Return a matrix that shares the index arrays of another where both store the same entries."""
    matrix: Any = given
    beside: Any = other
    if not sp.issparse(given) or not sp.issparse(other) or not same_pattern(given, other):
        return given
    return sp.csc_array((matrix.data, beside.indices, beside.indptr), shape=beside.shape)


def without_zeros(matrix: Any) -> Any:
    """Return a sparse matrix without stored zeros, a copy where there are many."""
    given: Any = matrix
    if not sp.issparse(matrix) or np.count_nonzero(given.data) > _FULL * given.nnz:
        return given
    kept = given.copy()
    kept.eliminate_zeros()
    return kept


def diagonal(matrix: Matrix) -> FloatArray:
    """Return the diagonal of a dense or sparse matrix."""
    return np.asarray(matrix.diagonal(), dtype=np.float64)


def unit_diagonal(matrix: Matrix) -> tuple[Matrix, FloatArray]:
    """Return ``S A S`` with ones (or zeros) on its diagonal, and the diagonal of S.

    Displacements and rotations have different units: only after this scaling do entries compare.
    """
    size = np.sqrt(np.abs(diagonal(matrix)))
    scale = 1.0 / np.where(size > 0, size, size.max(initial=0.0) or 1.0)
    if sp.issparse(matrix):
        weight = sp.diags_array(scale)
        return sp.csc_array(weight @ matrix @ weight), scale
    return scale[:, None] * np.asarray(matrix) * scale, scale


def diagonal_lu(matrix: Any, singular: str) -> Any:
    """Return the SuperLU factorisation of a symmetric sparse matrix, real or complex.

    Pivots are taken from the diagonal where they are not zero, so that solutions need a refinement.
    """
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


def is_positive_definite(
    matrix: Matrix,
    tolerance: float = 0.0,
    *,
    nodes: IntArray | None = None,
    xyz: FloatArray | None = None,
) -> bool:
    """Return whether ``S A S + tolerance I`` is positive definite, S scaling A's diagonal to 1.

    Large sparse matrices are tried by a bound on their lowest eigenvalue first, then factored;
    the node and coordinates of each DOF make the factorisation cheaper.
    """
    if np.any(diagonal(matrix) < 0) or (tolerance == 0 and np.any(diagonal(matrix) == 0)):
        return False
    scaled, _ = unit_diagonal(matrix)
    n = scaled.shape[0]
    if sp.issparse(scaled) and n > DENSE_LIMIT:
        shifted = sp.csc_array(scaled + tolerance * sp.eye_array(n)) if tolerance else scaled
        if n > _BOUND_LIMIT and lowest_eigenvalue_bound(shifted) > 0:
            return True
        try:
            MultifrontalCholesky(shifted, dissect(shifted, nodes, xyz), keep=False)
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
