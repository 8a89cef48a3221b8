"""The factor of K - sigma M of a model: one for modes, residual vectors and error estimates."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..checks import FloatArray
from ..errors import ModelError, SolverError, attempted, counted
from ..sparse.cholmod import Cholmod, CholmodCholesky
from ..sparse.factor import DENSE_LIMIT, same_pattern
from ..sparse.lanczos import rounding_of
from ..sparse.lowest import SignedFactor, multifrontal_inertia, signed_factor
from ..sparse.multifrontal import MultifrontalCholesky
from ..sparse.ordering import Dissection, dissect
from ..sparse.pardiso import Pardiso, PardisoCholesky
from ..structure.definite import unstable_stiffness
from ..structure.model import FEModel
from ..tolerances import ROUNDING, TINY, divisor

#: the shift, in roundings of the energies of rigid-body motions: far below the first elastic mode
#: of nearly all models, yet K - sigma M is well away from singular
_SHIFT = -3e3
#: the same in single precision: the lowest elastic modes of a bulky structure are higher, or not
#: much lower, and rounding leaves K - sigma M definite
_SINGLE_SHIFT = -30.0
_held: weakref.WeakKeyDictionary[FEModel, weakref.ref[StiffnessFactor]]
_dissected: weakref.WeakKeyDictionary[FEModel, Dissection]


class StiffnessFactor:
    """``K - sigma M = L L^T`` of a sparse model, with sigma just below zero.

    Get it from `stiffness_factor`, which returns the same one as long as it is in use.
    """

    def __init__(
        self, model: FEModel, method: Pardiso | Cholmod | None = None, *, single: bool = False
    ) -> None:
        self.M: Any = sp.csc_array(model.M)
        self.K: Any = sp.csc_array(model.K)
        self.rigid = model.rigid_body
        # of motions, not of single DOFs: next to no inertia in some of these says nothing
        near = self.sigma = _SHIFT * float(np.max(rounding_of(self.K, model.body_motions)))
        self.single = single
        if single:
            self.sigma *= _SINGLE_SHIFT / _SHIFT * (np.finfo(np.float32).eps / np.finfo(float).eps)
        elif model.n_unstable:  # below the lowest eigenvalue
            self.sigma += 2.0 * float(unstable_stiffness(self.K, model.body_motions)[0])
        shifted = _shift_matrix(self.K, self.M, self.sigma)
        self.dissection = dissection_of(model)
        try:
            self._cholesky: MultifrontalCholesky | PardisoCholesky | CholmodCholesky = (
                MultifrontalCholesky(shifted, self.dissection, single=single)
                if method is None
                else method.factored(shifted)
            )
        except SolverError as error:
            if single:
                raise
            negative = multifrontal_inertia(_shift_matrix(self.K, self.M, near), self.dissection)
            if not negative:
                raise
            raise ModelError(
                f"K has {counted(negative, 'negative eigenvalue')}: the structure is "
                "unstable, and not as a rigid body. Look for a sign in K."
            ) from error

    def __repr__(self) -> str:
        # four or eight bytes each
        size = self._cholesky.n_entries * (4e-9 if self.single else 8e-9)
        return f"<StiffnessFactor: {counted(self.K.shape[0], 'DOF')}, {size:.2g} GB>"

    def solve(self, force: FloatArray) -> FloatArray:
        """Return ``(K - sigma M)^-1 force`` for (n,) or (n, m) forces."""
        return self._cholesky.solve(force)

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the elastic static response (n, m) to loads, M-orthogonal to rigid-body motions.

        ``K u = f - M R R^T f`` (inertia relief) by conjugate gradients, preconditioned with the
        factor: a few steps, since sigma is small.
        """
        R = self.rigid
        inertia = np.asarray(self.M @ R)
        residual = loads - inertia @ (R.T @ loads)
        wanted = np.linalg.norm(residual, axis=0)
        u = np.zeros_like(residual)
        direction, old = np.zeros_like(residual), np.ones(residual.shape[1])
        best = np.full(residual.shape[1], np.inf)
        for _ in range(60):
            moved = self.solve(residual)
            moved -= R @ (inertia.T @ moved)
            new = np.sum(residual * moved, axis=0)
            direction = moved + direction * (new / old)
            force = np.asarray(self.K @ direction)
            stored = np.sum(direction * force, axis=0)
            length = np.divide(new, stored, out=np.zeros_like(new), where=stored > 0)
            step = direction * length
            u += step
            residual -= force * length
            residual -= inertia @ (R.T @ residual)
            # measured in energy: in forces, rounding of stiff directions would hide the rest
            part = np.sqrt(new * length / np.maximum(np.sum(u * (self.K @ u), axis=0), TINY))
            if np.all((part <= ROUNDING) | (wanted == 0)) or np.all(part >= best):
                break
            best, old = part, divisor(new)
        # an energy: the shapes that are made of it keep ten digits and more
        if not np.all((part <= 1e-7) | (wanted == 0)):
            raise SolverError(
                f"a static response is not found (the last step is {part.max():.1g} of it): K is "
                f"singular beyond the {counted(R.shape[1], 'rigid-body motion')} of the geometry. "
                "Look for a mechanism, a DOF without stiffness, or wrong coordinates."
            )
        return u - R @ (inertia.T @ u)


class CountingFactor:
    """``K - sigma M = L D L^T`` in single precision, sigma above the modes that are wanted.

    One factor counts the modes below sigma and is what their search needs [Grimes1994]_. Get it
    from `counting_factor`.
    """

    single = True

    def __init__(self, signed: SignedFactor, sigma: float) -> None:
        self._signed, self.sigma, self.below = signed, sigma, signed.negative

    def solve(self, force: FloatArray) -> FloatArray:
        """Return ``(K - sigma M)^-1 force`` for (n, m) forces, to single precision."""
        return self._signed.solve(force)


def counting_factor(model: FEModel, square: float) -> CountingFactor | None:
    """Return the factor at omega^2 = `square` of a bulky stable model; None: it does not pay."""
    order = dissection_of(model)
    if not order.is_costly or model.n_unstable:
        return None
    signed = signed_factor(_shift_matrix(sp.csc_array(model.K), model.M, square), order)
    return None if signed is None else CountingFactor(signed, square)


def stiffness_factor(model: FEModel, method: Pardiso | Cholmod | None = None) -> StiffnessFactor:
    """Return the factor of a sparse model, the same one as long as it is in use."""
    known = _held.get(model)
    factor = known() if known is not None else None
    if factor is None:
        factor = StiffnessFactor(model, method)
        _held[model] = weakref.ref(factor)
    return factor


def held_factor(model: FEModel) -> StiffnessFactor | None:
    """Return the factor of a large sparse model, in use as long as it is held; else None."""
    large = model.n_dof > DENSE_LIMIT and sp.issparse(model.K) and sp.issparse(model.M)
    return stiffness_factor(model) if large else None


def search_factor(model: FEModel, method: Pardiso | Cholmod | None = None) -> StiffnessFactor:
    """Return a factor to search modes with: the one in use, or one in single precision."""
    known, order = _held.get(model), dissection_of(model)
    unused = known is None or known() is None
    if unused and method is None and not model.n_unstable and order.is_costly:
        with attempted("a factor in single precision", SolverError):
            return StiffnessFactor(model, single=True)
    return stiffness_factor(model, method)


def dissection_of(model: FEModel) -> Dissection:
    """Return the elimination order of a model's matrices, found once."""
    found = _dissected.get(model)
    if found is None:
        M, K = sp.csc_array(model.M), sp.csc_array(model.K)
        # of both matrices: entries that cancel in one stay in the other
        pattern = K if same_pattern(K, M) else sp.csc_array(abs(K) + abs(M))
        found = dissect(pattern, model.dofs.node_index, model.dofs.xyz)
        _dissected[model] = found
    return found


def modes_below(model: FEModel, square: float, *, single: bool = True) -> int:
    """Return how many modes, rigid-body ones included, have an omega^2 below `square` (Sturm)."""
    # without `single`, single precision is not tried: it was refused before
    shifted = _shift_matrix(model.K, model.M, square)
    return multifrontal_inertia(shifted, dissection_of(model), single=single)


def _shift_matrix(K: Any, M: Any, square: float) -> Any:
    """Return ``K - square M``, its indices those of K where both have the same."""
    if not same_pattern(K, M):
        return sp.csc_array(K - square * M)
    return sp.csc_array((K.data - square * M.data, K.indices, K.indptr), shape=K.shape)


_held = weakref.WeakKeyDictionary()
_dissected = weakref.WeakKeyDictionary()
