"""Elastic modes of a dense undamped structure, its rigid-body motions taken out first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray
from ..errors import ModelError
from ..labels import DofSet
from ..sparse.factor import DENSE_LIMIT, dense, unit_diagonal
from ..sparse.lanczos import rayleigh_ritz, rounding_of, soft_group
from ..tolerances import TYPED
from .definite import are_rigid, signed_root
from .zero_energy import most_moved, nonrigid

#: eigenvalues above this part of the largest one are right to 1e-9 when M is made the identity
_DIRECT = 1e-6
#: the shift of the inverse problem, in roundings of K: K + s M is well away from singular
_SHIFT = 1e3
#: steps of inverse iteration, until the eigenvalues change by no more than this
_STEPS, _SETTLED = 5, 1e-10


def elastic_modes(
    M: FloatArray,
    K: FloatArray,
    rigid: FloatArray,
    count: int | None = None,
    dofs: DofSet | None = None,
    motions: Callable[[], FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the elastic frequencies (k,) [rad/s] and M-orthonormal shapes (n, k), ascending.

    Where springs of negative stiffness act on a structure that `motions` gives the M-orthonormal
    rigid-body motions (n, r) of, its unstable modes come first: those are rigid-body motions, and
    their frequency is ``-sigma`` for the poles +-sigma, ``omega |omega|`` their omega^2.

    ``K phi = omega^2 M phi`` is solved in the M-orthogonal complement of the M-orthonormal
    rigid-body motions (n, r), so that these mix with no elastic mode. Each frequency is right to
    1e-8 of itself, or to its own rounding ``eps |phi|^T |K| |phi| / (2 omega^2)``, whichever is
    larger: the entries of K, as stored, define it no better.

    The transformation that makes M the identity leaves an error of a rounding of the largest
    eigenvalue in all of them. Soft modes are therefore improved by inverse iteration with the
    scaled Cholesky factor of K + s M, whose error is a rounding of each entry [Demmel1989]_.
    """
    n, r = rigid.shape
    kept = n - r if count is None else min(count, n - r)
    scaled, scale = unit_diagonal(M)
    try:
        lower = la.cholesky(dense(scaled), lower=True)
    except la.LinAlgError as error:
        raise ModelError(
            "M is not positive definite: some motion would have no inertia, or a negative one."
        ) from error
    if kept <= 0:
        return np.zeros(0), np.zeros((n, 0))
    # q = reach^T y turns M into the identity
    reach = la.solve_triangular(lower, np.diag(scale), lower=True)
    stiffness = reach @ K @ reach.T
    largest = float(np.abs(stiffness).max())
    elastic: FloatArray = np.eye(n)
    if r:
        elastic = np.asarray(la.qr(lower.T @ (rigid / scale[:, None]))[0][:, r:], dtype=np.float64)
        stiffness = elastic.T @ stiffness @ elastic
    stiffness = 0.5 * (stiffness + stiffness.T)
    # the lowest few alone are faster; divide and conquer gives all of them
    few = kept <= (n - r) // 4
    squares, vectors = la.eigh(
        stiffness,
        subset_by_index=(0, kept - 1) if few else None,
        driver="evr" if few else "evd",
    )
    if squares.size > 1 and squares[0] < _DIRECT * largest:
        if few:  # all of them, for the space of the soft ones to be right
            squares, vectors = la.eigh(stiffness, driver="evd")
        squares, phi = _improved(M, K, rigid, squares, reach.T @ (elastic @ vectors))
    else:
        phi = reach.T @ (elastic @ vectors)
    squares, phi = squares[:kept], phi[:, :kept]
    unstable = squares < 0
    if np.any(unstable) and motions is not None:
        unstable[unstable] = are_rigid(M, motions(), phi[:, unstable])
    else:
        unstable[:] = False
    check_stiffness(squares, phi, rounding_of(K, phi), rigid, dofs, unstable)
    return signed_root(squares), signed(phi)


def has_negative_springs(model: Any) -> bool:
    """Return whether an FEModel's K has negative eigenvalues, all of them of rigid-body motion."""
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
    scaled, scale = unit_diagonal(K + shift * M)
    try:
        factor = la.cho_factor(dense(scaled), lower=True)
    except la.LinAlgError:
        raise ModelError(
            f"an elastic mode has a negative stiffness (K + s M is indefinite, s = {shift:.2g} "
            "1/s^2): the structure is unstable. Look for a sign in K."
        ) from None
    inertia = M @ rigid
    for _ in range(_STEPS):
        before = values
        moved = scale[:, None] * la.cho_solve(factor, scale[:, None] * (M @ soft))
        for _ in range(2):
            moved -= rigid @ (inertia.T @ moved)
        values, soft = rayleigh_ritz(K, M, moved)
        if np.all(np.abs(values - before) <= _SETTLED * np.abs(values)):
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
) -> None:
    """Raise ModelError when an elastic omega^2 (k,) is not above its rounding (k,).

    `unstable` (k,) says which are rigid-body motions on springs of negative stiffness: those may
    be negative, by more than their rounding.
    The DOFs that the first such motion moves most are named as `check` names those of a mechanism.
    """
    meant = False if unstable is None else unstable & (squares < -rounding)
    lost = np.flatnonzero((squares <= rounding) & ~np.asarray(meant))
    if not lost.size:
        return
    first, r = lost[0], rigid.shape[1]
    found = f"omega^2 = {squares[first]:.3g} 1/s^2, rounding is about {rounding[first]:.1g}"
    if squares[first] < -10 * rounding[first]:
        raise ModelError(
            f"an elastic mode has a negative stiffness ({found}): K is indefinite, and the motion "
            "bends the structure. Negative stiffness is taken only where it moves the structure as "
            "a rigid body, as magnets do. Look for a sign in K, or for springs of negative "
            "stiffness that are too strong."
        )
    moved = ""
    if dofs is not None:
        basis = np.asarray(la.qr(rigid, mode="economic")[0] if r else rigid, dtype=np.float64)
        motion = nonrigid(np.hstack([basis, phi[:, lost]]), basis)[:, 0]
        moved = f" The first moves {', '.join(dofs.labels[i] for i in most_moved(motion)[:4])}."
    several = "an elastic mode has" if lost.size == 1 else f"{lost.size} elastic modes have"
    raise ModelError(
        f"{several} no stiffness ({found}): a mechanism, a zero-energy motion beyond the {r} "
        f"rigid-body motions of the geometry, or springs too soft for the digits of K.{moved} Join "
        "or hold these, look for wrong coordinates (see check(model)), or suspend the modes "
        "rather than the model on soft springs."
    )


def signed(phi: FloatArray) -> FloatArray:
    """Return shapes with the first of their largest entries positive: repeatable signs."""
    size = np.abs(phi)
    first = np.argmax(size >= (1 - TYPED) * size.max(axis=0), axis=0)
    return np.asarray(phi * np.where(phi[first, np.arange(phi.shape[1])] < 0, -1.0, 1.0))
