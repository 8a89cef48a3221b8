"""The factor of K - sigma M for modes and statics; static correction of kept modes."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, Matrix, divisor
from ..errors import ModelError, SolverError, attempted, counted, short
from ..labels import DofSet, Place
from ..sparse.factor import DENSE_LIMIT, MultifrontalFactor
from ..sparse.lowest import multifrontal_inertia, signed_factor
from ..sparse.ordering import Dissection, dissect
from ..sparse.other_factors import Cholmod, CholmodCholesky
from ..sparse.symmetric import dense, diagonal, rounding_of, same_pattern
from ..structure import FEModel
from ..structure.definite import signed, unstable_stiffness
from ..tolerances import ROUNDING, SAME, TINY

#: shift in units of the rounding of rigid-body energies: far below the first elastic mode of nearly
#: all models, and K - sigma M is still well-conditioned
_SHIFT = -3e3
#: the same in single precision: the lowest elastic modes of a bulky structure lie above it, or not
#: far below, and K - sigma M stays definite in spite of rounding
_SINGLE_SHIFT = -30.0
#: cache of the factors of models that are in use
_held: weakref.WeakKeyDictionary[FEModel, weakref.ref[StiffnessFactor]] = (
    weakref.WeakKeyDictionary()
)
_dissected: weakref.WeakKeyDictionary[FEModel, Dissection] = weakref.WeakKeyDictionary()


class StiffnessFactor:
    """``K - sigma M = L L^T`` of a sparse model, with sigma just below zero.

    Made by `stiffness_factor`, which returns the same object as long as it is in use.
    """

    def __init__(
        self, model: FEModel, method: Cholmod | None = None, *, single: bool = False
    ) -> None:
        self.M: Any = sp.csc_array(model.M)
        self.K: Any = sp.csc_array(model.K)
        self.rigid = model.rigid_body
        # use motions, not single DOFs: a DOF may have almost no inertia
        near = self.sigma = _SHIFT * float(np.max(rounding_of(self.K, model.body_motions)))
        self.single = single
        if single:
            self.sigma *= _SINGLE_SHIFT / _SHIFT * (np.finfo(np.float32).eps / np.finfo(float).eps)
        elif model.n_unstable:  # below the lowest eigenvalue
            self.sigma += 2.0 * float(unstable_stiffness(self.K, model.body_motions)[0])
        shifted = _shift_matrix(self.K, self.M, self.sigma)
        self.dissection = dissection_of(model)
        try:
            self._cholesky: MultifrontalFactor | CholmodCholesky = (
                MultifrontalFactor(shifted, self.dissection, single=single)
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
            # error measured as energy: among forces, the rounding of stiff directions would hide
            # the rest
            part = np.sqrt(new * length / np.maximum(np.sum(u * (self.K @ u), axis=0), TINY))
            if np.all((part <= ROUNDING) | (wanted == 0)) or np.all(part >= best):
                break
            best, old = part, divisor(new)
        # tolerance in energy: shapes built from the response keep at least ten digits
        if not np.all((part <= 1e-7) | (wanted == 0)):
            raise SolverError(
                f"a static response did not converge (relative last step {part.max():.1g}): K is "
                f"singular beyond the {counted(R.shape[1], 'rigid-body motion')} of the "
                "geometry. "
                "Look for a mechanism, a DOF without stiffness, or wrong coordinates."
            )
        return u - R @ (inertia.T @ u)


class CountingFactor:
    """``K - sigma M = L D L^T`` in single precision, sigma above the modes that are wanted.

    One factor counts the modes below sigma and is what their search needs [Grimes1994]_. Get it
    from `counting_factor`.
    """

    single = True

    def __init__(self, signed: MultifrontalFactor, sigma: float) -> None:
        self._signed, self.sigma, self.below = signed, sigma, signed.negative

    def solve(self, force: FloatArray) -> FloatArray:
        """Return ``(K - sigma M)^-1 force`` for (n, m) forces, to single precision."""
        return self._signed.solve(force)


def counting_factor(model: FEModel, square: float) -> CountingFactor | None:
    """Return the factor at omega^2 = `square` of a bulky stable model, else None."""
    order = dissection_of(model)
    if not order.is_costly or model.n_unstable:
        return None
    signed = signed_factor(_shift_matrix(sp.csc_array(model.K), model.M, square), order)
    return None if signed is None else CountingFactor(signed, square)


def stiffness_factor(model: FEModel, method: Cholmod | None = None) -> StiffnessFactor:
    """Return the factor of a sparse model, the same one as long as it is in use."""
    known = _held.get(model)
    factor = known() if known is not None else None
    if factor is None:
        factor = StiffnessFactor(model, method)
        _held[model] = weakref.ref(factor)
    return factor


def is_large(model: Any) -> bool:
    """Return whether a model is sparse, and factored as such."""
    large: bool = model.M.shape[0] > DENSE_LIMIT
    return large and sp.issparse(model.K) and sp.issparse(model.M)


def held_factor(model: FEModel) -> StiffnessFactor | None:
    """Return the factor of a large sparse model, in use as long as it is held; else None."""
    return stiffness_factor(model) if is_large(model) else None


def search_factor(model: FEModel, method: Cholmod | None = None) -> StiffnessFactor:
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
        # the pattern of both matrices: entries that cancel in one stay in the other
        pattern = K if same_pattern(K, M) else sp.csc_array(abs(K) + abs(M))
        found = dissect(pattern, model.dofs.node_index, model.dofs.xyz)
        _dissected[model] = found
    return found


def modes_below(model: FEModel, square: float, *, single: bool = True) -> int:
    """Return how many modes, rigid-body ones included, have an omega^2 below `square` (Sturm)."""
    # without `single`, single precision is skipped, since it failed before
    shifted = _shift_matrix(model.K, model.M, square)
    return multifrontal_inertia(shifted, dissection_of(model), single=single)


def _shift_matrix(K: Any, M: Any, square: float) -> Any:
    """Return ``K - square M``, its indices those of K where both have the same."""
    if not same_pattern(K, M):
        return sp.csc_array(K - square * M)
    return sp.csc_array((K.data - square * M.data, K.indices, K.indptr), shape=K.shape)


def places(at: Place | Iterable[Place], name: str = "a place") -> tuple[Place, ...]:
    """Return one place, or several, as a tuple."""
    if isinstance(at, str | Mapping):
        return (at,)
    try:
        listed: list[Any] = list(at)
    except TypeError as error:
        raise _no_place(at, name) from error
    numbers = [item for item in listed if np.ndim(item) == 0 and not isinstance(item, str)]
    odd = [item for item in numbers if not isinstance(item, Mapping | int | float | np.number)]
    if odd:
        raise _no_place(odd[0], name)
    if listed and all(
        np.ndim(item) == 0 and not isinstance(item, str | Mapping) for item in listed
    ):
        return (listed,)
    return tuple(listed)


def _no_place(given: object, name: str) -> ModelError:
    return ModelError(
        f"{name} must be a DOF label, a point (x, y, z) or a mapping of these to weights, got "
        f"{short(given)}. Name it, such as '41:z', or several in a list."
    )


def place_of(place: Place) -> str:
    """Return a short text for a place."""
    if isinstance(place, str):
        return place
    if isinstance(place, Mapping):
        return " + ".join(f"{weight:g} {label}" for label, weight in place.items())
    return "(" + ", ".join(f"{float(x):g}" for x in place) + ")"


def attachment_vectors(
    model: FEModel, phi: FloatArray, at: Sequence[Place]
) -> tuple[FloatArray, FloatArray]:
    """Return residual attachment vectors (n, m) and their frequencies (m,) [rad/s]."""
    # the static response to a unit load at each place (free structures accelerate as rigid bodies
    # under it: inertia relief), less the part that the modes give; then made M-orthogonal to the
    # modes, mass-normalised, and diagonal in K among each other
    M, K = model.M, model.K
    loads = np.column_stack([model.dofs.row(place) for place in at])
    response = static_response(model, loads)
    whole = np.sum(loads * response, axis=0)
    for _ in range(2):
        response = response - phi @ (phi.T @ np.asarray(M @ response))
    left = np.sum(loads * response, axis=0)
    for place, part, total in zip(at, left, whole, strict=True):
        if not part > SAME * total:
            raise ModelError(
                f"the {phi.shape[1]} modes already hold all of the static compliance at "
                f"{place_of(place)} ({part:.2g} of {total:.3g} m/N is left): an attachment vector "
                "there adds nothing. Leave it out of compliance_at, or keep fewer modes."
            )
    response = response / np.sqrt(left)
    gram = response.T @ np.asarray(M @ response)
    size = np.sqrt(np.diag(gram))
    lowest = la.eigvalsh(gram / np.outer(size, size))[0]
    # squared: vectors with an angle below 1e-5 count as one
    if lowest < 1e-10:
        raise ModelError(
            f"the attachment vectors of {', '.join(place_of(place) for place in at)} depend on "
            f"each other (least eigenvalue {lowest:.2g} of their Gram matrix): is a place twice?"
        )
    squares, mix = la.eigh(response.T @ np.asarray(K @ response), gram)
    vectors = response @ mix
    vectors = vectors - phi @ (phi.T @ np.asarray(M @ vectors))
    return signed(vectors), np.sqrt(squares)


def static_response(model: Any, loads: FloatArray) -> FloatArray:
    """Return the elastic static response (n, m) to loads, M-orthogonal to the rigid-body motions.

    The equation is ``K u = f - M R R^T f``, with the M-orthonormal rigid-body motions R (n, r). The
    term ``M R R^T f`` is the inertia force of the rigid-body acceleration that the load f causes.
    The right-hand side is therefore in equilibrium. A large model is solved with its sparse
    factorisation. A small model is held at r DOFs that prevent its rigid-body motions. The forces
    at these supports are zero because of the equilibrium.

    Parameters
    ----------
    model : FEModel
        Model, or any object with the attributes M, K and rigid_body.
    loads : (n, m) array
        Forces on the DOFs [N, N m], a column for each case.

    Returns
    -------
    (n, m) array [m, rad]
        Displacements and rotations u, a column for each case.

    Raises
    ------
    ModelError
        When K has a motion without energy that is not a rigid-body motion.

    Examples
    --------
    Two opposite forces compress the spring between two free masses:

    >>> import numpy as np
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5])
    >>> fx.modes.static_response(model, np.array([[1.0], [-1.0]])).ravel().round(9).tolist()
    [1.25e-06, -1.25e-06]
    """
    if is_large(model):
        return stiffness_factor(model).static(loads)
    M, rigid = model.M, model.rigid_body
    balanced = loads - np.asarray(M @ (rigid @ (rigid.T @ loads)))
    n, r = rigid.shape
    held = np.zeros(n, dtype=bool)
    if r:
        # in units of sqrt(energy), so that rotations and displacements compare
        weighted = np.sqrt(diagonal(M))[:, None] * rigid
        held[la.qr(weighted.T, mode="economic", pivoting=True)[2][:r]] = True
    free = np.flatnonzero(~held)
    stiffness = dense(model.K)[np.ix_(free, free)]
    size = np.sqrt(np.diag(stiffness))[:, None]
    try:
        factor = la.cho_factor(stiffness / size / size.T)
    except la.LinAlgError as error:
        raise ModelError(
            f"K is singular beyond the {counted(r, 'rigid-body motion')} of the geometry (a "
            "mechanism, a DOF without stiffness, or wrong coordinates), so that the static "
            "response does not exist."
        ) from error
    response = np.zeros_like(balanced)
    response[free] = la.cho_solve(factor, balanced[free] / size) / size
    for _ in range(2):
        response = response - rigid @ (rigid.T @ np.asarray(M @ response))
    return np.asarray(response, dtype=np.float64)


def projected_zeta(D: Matrix | None, vectors: FloatArray, omega: FloatArray) -> FloatArray:
    """Return the damping ratio (m,) of each vector for a damping matrix D."""
    if D is None or not omega.size:
        return np.zeros(omega.size)
    rate = np.sum(vectors * np.asarray(D @ vectors), axis=0)
    return np.asarray(rate / (2 * np.abs(omega)), dtype=np.float64)


def labels_of(at: Sequence[Place], dofs: DofSet) -> tuple[str, ...]:
    """Return the names of places, after checking that the model has them."""
    for place in at:
        dofs.row(place)
    return tuple(place_of(place) for place in at)
