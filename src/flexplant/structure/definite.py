"""Definiteness checks of structural matrices, and the modes of dense ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, Matrix, real_array
from ..errors import ModelError, ShapeError, counted
from ..labels import DofSet
from ..sparse.factor import DENSE_LIMIT, is_positive_definite
from ..sparse.symmetric import (
    by_rows,
    dense,
    diagonal,
    projected,
    rayleigh_ritz,
    rounding_of,
    soft_group,
    unit_diagonal,
)
from ..tolerances import CLOSE, MOST_STEPS, PRECISION, RESIDUAL, SAME, TYPED
from .zero_energy_motions import most_moved, nonrigid

#: input types that become a matrix of a structure
MatrixLike: TypeAlias = npt.ArrayLike | sp.sparray | sp.spmatrix
#: least energy in M of a rigid translation, as a fraction of the largest possible one
_SOME = 0.1
#: sqrt(K_ii / M_ii) [rad/s] below which, if no DOF is faster, K and M are probably swapped
_SLOW = 1e-2


def check_semidefinite(matrix: Matrix, name: str) -> None:
    """Raise ModelError unless a symmetric matrix is positive semi-definite to rounding."""
    if said := why_indefinite(matrix, name):
        raise ModelError(
            f"{said} Look for a sign or for swapped arguments (the order is M, K, D)."
            + (" Magnets may only make rigid-body motions unstable." if name == "K" else "")
        )


def why_indefinite(matrix: Matrix, name: str) -> str:
    """Return a text on K or D that is not positive semi-definite; empty when it is."""
    if _is_semidefinite(matrix):
        return ""
    return (
        f"{name} is not positive semi-definite: {lowest(matrix)}. The structure would "
        f"{'be unstable' if name == 'K' else 'feed energy in'}."
    )


def square(given: Any, name: str) -> sp.csc_array:
    """Return a square sparse matrix with finite real entries, without stored zeros."""
    stored: Any = given
    if not sp.issparse(given):
        array = real_array(given, name)
        if array.ndim != 2 or array.shape[0] != array.shape[1]:
            raise ShapeError(
                f"{name} must be square, got shape {array.shape}. Pass an (n, n) array."
            )
        return sp.csc_array(array)
    listed: Any = stored.tocoo()
    if listed.ndim != 2 or listed.shape[0] != listed.shape[1]:
        raise ShapeError(f"{name} must be square, got shape {listed.shape}. Pass an (n, n) array.")
    data: FloatArray = real_array(listed.data, f"stored entries of {name}")
    matrix: Any = sp.csc_array((data, (listed.row, listed.col)), shape=listed.shape)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return cast("sp.csc_array", matrix)


def symmetric_matrix(given: Any, name: str, n: int) -> Matrix:
    """Return a finite symmetric (n, n) matrix, dense or sparse."""
    value, matrix = given, cast(Any, None)
    if sp.issparse(given):
        if value.shape != (n, n):
            raise ShapeError(f"{name} must have shape ({n}, {n}), got {value.shape}.")
        matrix = sp.csc_array(value)
        entries = real_array(matrix.data, f"stored entries of {name}")
        # copies, which may be sorted; with 32-bit indices products read a quarter less memory
        width: Any = np.int32 if entries.size < 2**31 else np.int64
        indices, pointer = (a.astype(width) for a in (matrix.indices, matrix.indptr))
        matrix = sp.csc_array((entries, indices, pointer), shape=(n, n))
    else:
        matrix = real_array(value, name, (n, n))
    if sp.issparse(matrix) and _equals_transpose(matrix):
        return cast(Matrix, matrix)
    scaled, _ = unit_diagonal(matrix)
    skew: Any = abs(scaled - scaled.T)
    worst = float(skew.max()) if n else 0.0
    if worst > SAME:
        i, j = (int(k) for k in np.unravel_index(skew.argmax(), (n, n)))
        raise ModelError(
            f"{name} is not symmetric: entry ({i}, {j}) is {matrix[i, j]:.6g} and ({j}, {i}) is "
            f"{matrix[j, i]:.6g} (counted from 0). Reciprocity would not hold. Symmetrise it, "
            f"0.5 * ({name} + {name}.T), when the difference is only rounding."
        )
    return cast(Matrix, matrix)


def _equals_transpose(matrix: Any) -> bool:
    """Return whether a sparse matrix equals its transpose to the bit, entry by entry."""
    matrix.sum_duplicates()
    other: Any = sp.csc_array(matrix.T)
    return all(
        np.array_equal(getattr(matrix, part), getattr(other, part))
        for part in ("indptr", "indices", "data")
    )


def _is_semidefinite(matrix: Matrix) -> bool:
    if sp.issparse(matrix) and matrix.shape[0] > DENSE_LIMIT:
        # the factorisation in solve_modes finds other errors; here it would double the cost
        return not np.any(diagonal(matrix) < 0)
    return is_positive_definite(matrix, SAME)


def without_inertia(M: Matrix, K: Matrix) -> str:
    """Return a text that says why M is not positive definite, and what to do."""
    if not np.any(diagonal(M) <= 0) and is_positive_definite(K) and _is_semidefinite(M):
        return (
            f"{lowest(M)}, as for the stiffness of a free structure, and K is positive definite, "
            "as a mass is: they are swapped. The order is FEModel(M, K, D)."
        )
    return (
        f"{lowest(M)}. Some motion would have no inertia, or a negative one. Condense massless "
        "DOFs out, or look for a sign."
    )


def slow(M: Matrix, K: Matrix, directions: Sequence[str]) -> str:
    """Return a text when every DOF is too slow for a machine; empty otherwise."""
    fastest = _omega_bound(M, K)
    if not 0.0 < fastest < _SLOW:
        return ""
    found = f"no sqrt(K_ii / M_ii) is above {fastest:.3g} rad/s, slower than any machine"
    if (still := _unmoved(M, directions)) > _unmoved(K, directions):
        raise ModelError(
            f"K and M are swapped: {found}, and M gives {still} of its DOFs no inertia when the "
            "structure moves as a whole, as a stiffness does. The order is FEModel(M, K, D)."
        )
    return f"{found}: are K and M swapped (the order is FEModel(M, K, D)), or in different units?"


def are_swapped(K: Matrix, M: Matrix | None, dofs: DofSet | None) -> bool:
    """Return whether M behaves like a stiffness of a free structure, and K like a mass."""
    # judged by the energy of rigid translations; for a held structure by single DOFs, if every
    # motion is too slow for a structure
    if dofs is None or M is None:
        return False
    moves = [(dofs.kinds == axis).astype(np.float64) for axis in range(3)]
    moves = [motion for motion in moves if motion.any()]
    energies = [(_energy(M, motion), _energy(K, motion)) for motion in moves]
    if energies and all(of_M <= TYPED and of_K >= _SOME for of_M, of_K in energies):
        return True
    return bool(0.0 < _omega_bound(M, K) < _SLOW) and _unmoved(M, dofs.directions) > _unmoved(
        K, dofs.directions
    )


def _energy(matrix: Any, motion: FloatArray) -> float:
    """Return ``t^T A t`` relative to its size if nothing cancelled."""
    size = float(motion @ (abs(matrix) @ motion))
    return abs(float(motion @ (matrix @ motion))) / size if size else 0.0


def _omega_bound(M: Matrix, K: Matrix) -> float:
    """Return the largest sqrt(K_ii / M_ii) [rad/s] of a DOF with mass."""
    heavy, stiff = diagonal(M), np.abs(diagonal(K))
    return float(np.sqrt(np.max(stiff[heavy > 0] / heavy[heavy > 0], initial=0.0)))


def _unmoved(matrix: Matrix, directions: Sequence[str]) -> int:
    """Return the number of DOFs without a force when all DOFs of one axis move equally.

    For a stiffness these are the DOFs away from supports; a mass has a force at every one.
    """
    count = 0
    for axis in "xyz":
        along = np.array([one == axis for one in directions])
        force, size = matrix @ along.astype(float), abs(matrix) @ along.astype(float)
        count += int(np.sum((np.abs(force) <= SAME * size) & along))
    return count


def lowest(matrix: Matrix) -> str:
    """Return a text that says why a symmetric matrix is not positive definite."""
    entries = diagonal(matrix)
    i = int(np.argmin(entries))
    if entries[i] <= 0:
        return f"its diagonal entry {i} (from 0) is {entries[i]:.3g}"
    if matrix.shape[0] > DENSE_LIMIT:
        return "its factorisation has negative pivots"
    least = np.linalg.eigvalsh(dense(unit_diagonal(matrix)[0]))[0]
    return f"scaled to a unit diagonal its lowest eigenvalue is {least:.3g}"


def signed_root(squares: FloatArray) -> FloatArray:
    """Return frequencies omega [rad/s] of omega^2, negative ones for a negative omega^2."""
    # as finite-element programs print them: a mode of -3 rad/s has the poles +3 and -3 1/s
    return np.asarray(np.sign(squares) * np.sqrt(np.abs(squares)))


def signed_square(omega: FloatArray) -> FloatArray:
    """Return ``omega |omega|`` [1/s^2], the stiffness of mass-normalised modes."""
    return np.asarray(omega * np.abs(omega))


def are_rigid(M: Any, motions: FloatArray, phi: FloatArray) -> np.ndarray:
    """Return which shapes (k,) are rigid-body motions to 1 % of their kinetic energy."""
    part = np.asarray(by_rows(M) @ motions).T @ phi
    return np.asarray(np.sum(part**2, axis=0) > 1.0 - CLOSE)


def unstable_stiffness(K: Any, motions: FloatArray) -> FloatArray:
    """Return the negative eigenvalues [1/s^2] of ``R' K R``, R M-orthonormal rigid-body motions."""
    # their number equals that of the negative eigenvalues of K when these belong to rigid-body
    # motion; they lie above them (Rayleigh, Courant)
    if not motions.shape[1]:
        return np.zeros(0)
    values = np.linalg.eigvalsh(projected(by_rows(K), motions))
    return np.asarray(values[values < -10.0 * rounding_of(K, motions).max()])


def refuse_unstable(model: Any, what: str) -> None:
    """Raise ModelError when springs of negative stiffness make a model unstable."""
    count = int(getattr(model, "n_unstable", 0))
    if count:
        raise ModelError(
            f"springs of negative stiffness make {counted(count, 'rigid-body motion')} of "
            f"this structure unstable: {what} is for structures that are free or held. Do it with "
            "the free structure, then suspend the result: fx.plant.suspend(model, springs)."
        )


#: shift of the inverse problem in units of the rounding of K, so that K + s M is well-conditioned
_SHIFT = 1e3


def elastic_modes(
    M: FloatArray,
    K: FloatArray,
    rigid: FloatArray,
    count: int | None = None,
    dofs: DofSet | None = None,
    motions: Callable[[], FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the elastic frequencies (k,) [rad/s] and M-orthonormal shapes (n, k), ascending.

    Where springs of negative stiffness act on a structure whose M-orthonormal rigid-body motions
    (n, r) are given by `motions`, the unstable modes come first. They are rigid-body motions, and
    their frequency is ``-sigma`` for the poles +-sigma, ``omega |omega|`` their omega^2.

    ``K phi = omega^2 M phi`` is solved in the M-orthogonal complement of the M-orthonormal
    rigid-body motions (n, r), so that these mix with no elastic mode. Each frequency has a relative
    error of at most 1e-8, or that of rounding ``eps |phi|^T |K| |phi| / (2 omega^2)``, whichever is
    larger: the stored entries of K do not define it more accurately.

    The transformation that makes M the identity leaves an error of a rounding of the largest
    eigenvalue in all of them. Soft modes are therefore improved by inverse iteration with the
    scaled Cholesky factor of K + s M, whose error is a rounding of each entry [Demmel1989]_.
    """
    n, r = rigid.shape
    kept = n - r if count is None else min(count, n - r)
    scaled, scale = unit_diagonal(M)
    try:
        lower = la.cholesky(dense(scaled), lower=True, overwrite_a=True)
    except la.LinAlgError as error:
        raise ModelError(
            "M is not positive definite: some motion would have no inertia, or a negative one."
        ) from error
    if kept <= 0:
        return np.zeros(0), np.zeros((n, 0))
    basis = _Unit(lower, scale, rigid)
    stiffness = basis.stiffness(K)
    # the lowest few alone are faster; divide and conquer gives all of them
    few = kept <= (n - r) // 4
    squares, vectors = la.eigh(
        stiffness,
        subset_by_index=(0, kept - 1) if few else None,
        driver="evr" if few else "evd",
        check_finite=False,
    )
    if squares.size > 1 and squares[0] < TYPED * basis.largest:
        if few:  # all of them, so that the space of the soft ones is accurate
            squares, vectors = la.eigh(stiffness, driver="evd")
        squares, phi = _improved(M, K, rigid, squares, basis.shapes(vectors))
    else:
        phi = basis.shapes(vectors)
    squares, phi = squares[:kept], phi[:, :kept]
    unstable = squares < 0
    if np.any(unstable) and motions is not None:
        unstable[unstable] = are_rigid(M, motions(), phi[:, unstable])
    else:
        unstable[:] = False
    expected = 0 if motions is None else motions().shape[1]
    # |K_ij| is at most the root of the largest entries of both rows: few modes need the sum itself
    rounding = PRECISION * (np.sqrt(np.abs(K).max(axis=0)) @ np.abs(phi)) ** 2
    near = squares <= rounding
    rounding[near] = rounding_of(K, phi[:, near])
    check_stiffness(squares, phi, rounding, rigid, dofs, unstable, expected)
    return signed_root(squares), signed(phi)


class _Unit:
    """Coordinates y in which M is the identity and rigid-body motions are the first entries.

    ``q = S L^-T H y``: S M S = L L', and H is a product of one reflector for each motion.
    """

    def __init__(self, lower: FloatArray, scale: FloatArray, rigid: FloatArray) -> None:
        self.lower, self.scale = lower, scale
        self.reflectors, self.tau, *_ = la.lapack.dgeqrf(lower.T @ (rigid / scale[:, None]))
        self.largest = 0.0

    def _reflected(self, side: str, trans: str, matrix: FloatArray) -> FloatArray:
        """Return H matrix, H' matrix ("L") or matrix H ("R")."""
        if not self.tau.size:
            return matrix
        given, work = np.asfortranarray(matrix), 64 * max(matrix.shape)
        la.lapack.dormqr(side, trans, self.reflectors, self.tau, given, work, overwrite_c=1)
        return given

    def stiffness(self, K: FloatArray) -> FloatArray:
        """Return the stiffness of elastic motions, and remember the largest entry of all."""
        scaled = np.asfortranarray(self.scale[:, None] * K)
        scaled *= self.scale
        whole = la.lapack.dsygst(scaled, self.lower, lower=1, overwrite_a=1)[0]
        np.copyto(whole, whole.T, where=~np.tri(len(K), dtype=bool))
        self.largest = float(max(whole.max(), -whole.min()))
        r = self.tau.size
        found = self._reflected("R", "N", self._reflected("L", "T", whole))
        return np.asarray(found[r:, r:])

    def shapes(self, vectors: FloatArray) -> FloatArray:
        """Return the motions of all DOFs that elastic vectors stand for."""
        y = np.zeros((len(self.scale), vectors.shape[1]), order="F")
        y[self.tau.size :] = vectors
        found = la.solve_triangular(
            self.lower, self._reflected("L", "N", y), lower=True, trans="T", overwrite_b=True
        )
        found *= self.scale[:, None]
        return np.asarray(found)


def has_negative_springs(model: Any) -> bool:
    """Return whether K has negative eigenvalues that all belong to rigid-body motion."""
    count = model.n_unstable
    if not count or model.n_dof > DENSE_LIMIT:
        return False
    M, K = dense(model.M), dense(model.K)
    try:
        elastic_modes(M, K, model.rigid_body, count + 1, motions=lambda: model.body_motions)
    except ModelError:
        return False
    return True


def _improved(
    M: FloatArray, K: FloatArray, rigid: FloatArray, squares: FloatArray, phi: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return all modes with the soft ones found again, in the span of those given."""
    end = soft_group(squares)
    values, soft = rayleigh_ritz(K, M, np.ascontiguousarray(phi[:, :end]))
    rounding = float(rounding_of(K, np.hstack([rigid, soft])).max())
    shift = _SHIFT * (rounding or float(np.finfo(np.float64).eps * squares[end]))
    shift = max(shift, -2.0 * float(values[0]))
    inertia = M @ rigid
    # rigid-body motions are lifted among the soft modes: K holds them only up to its rounding
    lifted = K + shift * M + max(shift, float(values[-1])) * (inertia @ inertia.T)
    scaled, scale = unit_diagonal(lifted)
    try:
        factor = la.cho_factor(dense(scaled), lower=True)
    except la.LinAlgError:
        raise ModelError(
            f"an elastic mode has a negative stiffness (K + s M is indefinite, s = {shift:.2g} "
            "1/s^2): the structure is unstable. Look for a sign in K."
        ) from None
    for _ in range(MOST_STEPS):
        before = values
        moved = scale[:, None] * la.cho_solve(factor, scale[:, None] * (M @ soft))
        for _ in range(2):
            moved -= rigid @ (inertia.T @ moved)
        values, soft = rayleigh_ritz(K, M, moved)
        if np.all(np.abs(values - before) <= RESIDUAL * np.abs(values)):
            break
    stiff = phi[:, end:]
    for _ in range(2):
        stiff = stiff - soft @ (soft.T @ (M @ stiff))
    return np.concatenate([values, squares[end:]]), np.hstack([soft, stiff])


def check_stiffness(
    squares: FloatArray,
    phi: FloatArray,
    rounding: FloatArray,
    rigid: FloatArray,
    dofs: DofSet | None = None,
    unstable: np.ndarray | None = None,
    expected: int = 0,
) -> None:
    """Raise ModelError when an elastic omega^2 (k,) is not above its rounding (k,)."""
    # `expected` is the number of motions of the geometry and of `joint_motions`, held or not
    # `unstable` (k,) says which are rigid-body motions on springs of negative stiffness: those may
    # be negative, by more than their rounding. The DOFs that the first such motion moves most are
    # named as `check` names those of a mechanism
    meant = False if unstable is None else unstable & (squares < -rounding)
    lost = np.flatnonzero((squares <= rounding) & ~np.asarray(meant))
    if not lost.size:
        return
    first, r = lost[0], rigid.shape[1]
    found = f"omega^2 = {squares[first]:.3g} 1/s^2, rounding is about {rounding[first]:.1g}"
    if squares[first] < -10 * rounding[first]:
        raise ModelError(
            f"an elastic mode has a negative stiffness ({found}): K is indefinite, and the "
            "motion bends the structure. Negative stiffness is accepted only where it moves the "
            "structure as a rigid body, as magnets do. Look for a sign in K, or for springs of "
            "negative "
            "stiffness that are too strong."
        )
    moved = ""
    if dofs is not None:
        basis = np.asarray(la.qr(rigid, mode="economic")[0] if r else rigid, dtype=np.float64)
        motion = nonrigid(np.hstack([basis, phi[:, lost]]), basis)[:, 0]
        moved = f" The first moves {', '.join(dofs.labels[i] for i in most_moved(motion)[:4])}."
    costly = (
        f" {expected - r} of the motions of the geometry and of joint_motions stretch the "
        "structure: if a column of joint_motions is meant to be this slide, mend its entries."
        if expected > r
        else ""
    )
    several = "an elastic mode has" if lost.size == 1 else f"{lost.size} elastic modes have"
    raise ModelError(
        f"{several} no stiffness ({found}): a mechanism, a zero-energy motion beyond the {r} "
        f"rigid-body motions of the geometry, or springs too soft for the digits of K.{moved} If "
        "drives move them, they are slides: pass structure.sliding(model), which names them and "
        f"gives them as joint_motions.{costly} Join others (fx.joined) or hold them, look for "
        "wrong coordinates (see check(model)), or suspend the modes rather than the model on soft "
        "springs."
    )


def signed(phi: FloatArray) -> FloatArray:
    """Return shapes with the first of their largest entries positive: repeatable signs."""
    size = np.abs(phi)
    first = np.argmax(size >= (1 - TYPED) * size.max(axis=0), axis=0)
    return np.asarray(phi * np.where(phi[first, np.arange(phi.shape[1])] < 0, -1.0, 1.0))


#: number of digits: numbers with fewer may be exact; numbers with more look like computed ones
_WRITTEN = range(5, 15)


#: least and largest number of different entries that show how many digits were written
_SAMPLE = (20, 400)


#: fraction of entries that need every digit: one in ten last digits is zero
EVERY_DIGIT = 0.6


def digits_of(given: Any) -> int | None:
    """Return the decimal digits that entries hold, None for double precision."""
    # rounding in single precision changes an entry by half a unit in the last place, 2^-24, hence 7
    # digits. Entries in double precision that were read from a text with few digits are recognised,
    # since their shortest text has as few digits
    if not hasattr(given, "dtype"):
        real_array(given, "K")
        given = np.asarray(given)
    kind = np.dtype(given.dtype)
    if kind.kind not in "fc":
        return None
    digits = int(-np.log10(np.finfo(kind).eps / 2))
    return digits if digits < np.finfo(np.float64).precision else _written_digits(given)


def _written_digits(given: Any) -> int | None:
    """Return the number of digits with which numbers were written, None when unknown."""
    columns: Any = sp.csc_array
    held: Any = columns(given).data if sp.issparse(given) else np.ravel(given)
    entries = np.abs(held.real)
    step = max(1, entries.size // (20 * _SAMPLE[1]))
    some = np.unique(entries[::step])
    some = some[(some > 0) & np.isfinite(some)]
    if some.size < _SAMPLE[0]:
        return None
    chosen = some[:: max(1, some.size // _SAMPLE[1])]
    count = [len(f"{x!r}".partition("e")[0].replace(".", "").strip("0")) for x in chosen.tolist()]
    most = max(count)
    return most if most in _WRITTEN and count.count(most) >= EVERY_DIGIT * len(count) else None
