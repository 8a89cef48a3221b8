"""Residual attachment vectors: the static compliance that the kept modes leave out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..checks import FloatArray, Matrix, short
from ..errors import ModelError, counted
from ..labels import DofSet, Place
from ..sparse.factor import DENSE_LIMIT, dense, diagonal
from ..sparse.multifrontal import MultifrontalCholesky
from ..structure import FEModel
from ..structure.eigen import signed
from .shifted import stiffness_factor

#: of a place's whole elastic compliance: what is less than this beyond the modes is rounding
_NEGLIGIBLE = 1e-9


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
    """Return residual attachment vectors (n, m) and their frequencies (m,) [rad/s].

    The static response to a unit load at each place (free structures accelerate as rigid bodies
    under it: inertia relief), less the part that the modes give; then made M-orthogonal to the
    modes, mass-normalised, and diagonal in K among each other.
    """
    M, K, rigid = model.M, model.K, model.rigid_body
    loads = np.column_stack([model.dofs.row(place) for place in at])
    if sp.issparse(K) and sp.issparse(M) and model.n_dof > DENSE_LIMIT:
        response = stiffness_factor(model).static(loads)
    else:
        response = static_response(M, K, rigid, loads)
    whole = np.sum(loads * response, axis=0)
    for _ in range(2):
        response = response - phi @ (phi.T @ np.asarray(M @ response))
    left = np.sum(loads * response, axis=0)
    for place, part, total in zip(at, left, whole, strict=True):
        if not part > _NEGLIGIBLE * total:
            raise ModelError(
                f"the {phi.shape[1]} modes already hold all of the static compliance at "
                f"{place_of(place)} ({part:.2g} of {total:.3g} m/N is left): an attachment vector "
                "there adds nothing. Leave it out of compliance_at, or keep fewer modes."
            )
    response = response / np.sqrt(left)
    gram = response.T @ np.asarray(M @ response)
    size = np.sqrt(np.diag(gram))
    lowest = la.eigvalsh(gram / np.outer(size, size))[0]
    # squares: vectors whose angle is below 1e-5 are one
    if lowest < 1e-10:
        raise ModelError(
            f"the attachment vectors of {', '.join(place_of(place) for place in at)} depend on "
            f"each other (least eigenvalue {lowest:.2g} of their Gram matrix): is a place twice?"
        )
    squares, mix = la.eigh(response.T @ np.asarray(K @ response), gram)
    vectors = response @ mix
    vectors = vectors - phi @ (phi.T @ np.asarray(M @ vectors))
    return signed(vectors), np.sqrt(squares)


def static_response(M: Matrix, K: Matrix, rigid: FloatArray, loads: FloatArray) -> FloatArray:
    """Return the elastic static response (n, m) to loads, M-orthogonal to the rigid-body motions.

    ``K u = f - M R R^T f``: the load less the inertia of the rigid-body acceleration it causes,
    held at the r DOFs that distinguish rigid-body motions best; in balance these carry no force.
    """
    balanced = loads - np.asarray(M @ (rigid @ (rigid.T @ loads)))
    n, r = rigid.shape
    held = np.zeros(n, dtype=bool)
    if r:
        # in units of sqrt(energy), so that rotations and displacements compare
        weighted = np.sqrt(diagonal(M))[:, None] * rigid
        held[la.qr(weighted.T, mode="economic", pivoting=True)[2][:r]] = True
    free = np.flatnonzero(~held)
    response = np.zeros_like(balanced)
    if sp.issparse(K) and n > DENSE_LIMIT:
        sparse: Any = K
        part_of_K = sparse[free][:, free]
        solve = MultifrontalCholesky(part_of_K).solve
        part = solve(balanced[free])
        part = part + solve(balanced[free] - part_of_K @ part)
    else:
        stiffness = dense(K)[np.ix_(free, free)]
        size = np.sqrt(np.diag(stiffness))[:, None]
        try:
            factor = la.cho_factor(stiffness / size / size.T)
        except la.LinAlgError as error:
            raise ModelError(
                f"K is singular beyond the {counted(r, 'rigid-body motion')} of the geometry (a "
                "mechanism, a DOF without stiffness, or wrong coordinates): there is no static "
                "response."
            ) from error
        part = np.asarray(la.cho_solve(factor, balanced[free] / size) / size)
    response[free] = part
    for _ in range(2):
        response = response - rigid @ (rigid.T @ np.asarray(M @ response))
    return np.asarray(response, dtype=np.float64)


def projected_zeta(D: Matrix | None, vectors: FloatArray, omega: FloatArray) -> FloatArray:
    """Return the damping ratios (m,) that a matrix D gives to vectors, taken one by one."""
    if D is None or not omega.size:
        return np.zeros(omega.size)
    rate = np.sum(vectors * np.asarray(D @ vectors), axis=0)
    return np.asarray(rate / (2 * np.abs(omega)), dtype=np.float64)


def labels_of(at: Sequence[Place], dofs: DofSet) -> tuple[str, ...]:
    """Return the names of places, after checking that the model has them."""
    for place in at:
        dofs.row(place)
    return tuple(place_of(place) for place in at)
