"""Modes of a structure (paper, eq. (2)) and its static responses, solved and checked."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, Matrix, divisor, instance, positive
from ..certificates import Certificate, Verified
from ..errors import ModelError, SolverError, counted, short
from ..labels import DofSet, Place
from ..parallel import Progress
from ..sparse.factor import DENSE_LIMIT
from ..sparse.other_factors import Cholmod
from ..sparse.symmetric import (
    LANCZOS_STEPS,
    Absolute,
    by_rows,
    column_groups,
    dense,
    diagonal,
    rounding_of,
    width_of,
)
from ..structure import Damping, FEModel, ModalDamping
from ..structure.definite import elastic_modes, signed, signed_root, signed_square
from ..tolerances import NEGLIGIBLE, PRECISION, ROUNDING, SAME
from .complex_modes import RESIDUAL, coupled_modes, is_proportional, is_rayleigh, wider
from .modes import Modes
from .sparse_modes import counted_modes, is_large, modes_below, stiffness_factor

#: least number of elastic modes in the basis of responses
_FEW = 6
#: cache: modes of models that are in use
_solved: weakref.WeakKeyDictionary[FEModel, weakref.ref[Modes]] = weakref.WeakKeyDictionary()
#: fraction of all modes above which a dense solution of a model of this size is faster
_MANY, _DENSE_MANY = 10, 6000


def solve_modes(
    model: FEModel,
    *,
    count: int | None = None,
    below: float | None = None,
    damping: Damping | None = None,
    compliance_at: Place | Iterable[Place] = (),
    compliance_damping: Damping | float | None = None,
    factor: Cholmod | None = None,
    progress: bool | None = None,
) -> Modes:
    """Return the lowest modes of a structure, with rigid-body modes at exactly 0.

    Parameters
    ----------
    model : FEModel
        Structure whose modes are computed.
    count : int, optional
        Number of modes, rigid-body modes included. If two modes have the same frequency and only
        one of them is returned, its shape is an arbitrary combination of the two.
    below : float [Hz], optional
        Highest frequency of the modes that are kept. Without `count` and `below`, all modes of a
        small model are returned.
    damping : ModalDamping or Rayleigh, optional
        Damping used in place of the model's D. None: the model's D, or no damping if it has no D.
        ``ModalDamping(solve_modes(model, count=9).zeta, others=0.005)`` keeps the damping ratios
        that D gives the first nine modes, for example those of a machine on isolators.
    compliance_at : place or sequence of places
        Places where the static compliance of the truncated modes is kept: DOF labels, points
        (motion z) or mappings of DOF labels to weights. Each place adds a residual attachment
        vector (see `Modes`).
    compliance_damping : Damping or float, optional
        Damping of the attachment vectors. None: the damping of the modes.
    factor : Cholmod, optional
        Sparse factorisation by CHOLMOD in place of the library's own, for a large model. CHOLMOD
        must be installed separately.
    progress : bool, optional
        Whether to show a progress bar. None: a bar is shown on a terminal or in a notebook, for
        work of more than two seconds.

    Returns
    -------
    Modes
        Mass-normalised modes. Their shapes are complex if the model's own D is not proportional.
        The residuals and the M-orthonormality are checked, and a count shows that no mode is
        missing. Each undamped frequency has a relative error of at most 1e-8 or its `rounding`,
        whichever is larger. This also holds for soft suspensions next to stiff elements, fine
        meshes and stiff springs to ground. Springs of negative stiffness give unstable modes, with
        negative frequencies (see `Modes`).

    Raises
    ------
    ModelError
        When an argument does not fit the model, when a deformation of the structure has negative
        elastic energy, or when a motion without elastic energy is not a rigid-body motion.
    SolverError
        When a check of the modes fails.

    Warns
    -----
    FlexplantWarning
        When overdamped motions have real poles in the frequency range of the modes. The result does
        not include these motions.

    References
    ----------
    [paper]_, equations (2)-(5); [Grimes1994]_ (large models).

    Examples
    --------
    Modes of a free plate, with an attachment vector at a corner:

    >>> from flexplant.structure import kirchhoff_plate
    >>> plate = kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702,
    ...                         youngs_modulus=70e9, poisson_ratio=0.35)
    >>> modes = solve_modes(plate, count=24, damping=ModalDamping(0.01), compliance_at="1:z")
    >>> modes
    <Modes: 24 of 243 DOFs (3 rigid-body, 21 elastic at 245.8 to 3768 Hz), vectors at 1:z>
    >>> modes.freq[3:6].round(2)
    array([245.75, 359.31, 463.13])
    """
    if not isinstance(model, FEModel):
        raise ModelError(
            f"solve_modes needs an FEModel, got {type(model).__name__}."
            + (" A reduced model has .modes()." if hasattr(model, "modes") else "")
            + (" Matrices alone have .frequencies()." if hasattr(model, "frequencies") else "")
        )
    if damping is not None:
        instance(damping, Damping, "damping", "Pass ModalDamping(0.01) for 1 %.")
    if factor is not None:
        instance(factor, Cholmod, "factor", "Leave it out for the library's own factor.")
    kept, top = _mode_request(model, count, below)
    at = places(compliance_at)
    if at and model.n_unstable:
        raise ModelError(
            "compliance_at needs a structure that is free or held: the static response on springs "
            "of negative stiffness does not measure what the truncated modes leave out. Solve "
            "the free structure "
            "with compliance_at, then fx.plant.suspend(modes, springs)."
        )
    names = labels_of(at, model.dofs)
    # complex modes of a large model are found in a basis of more undamped ones
    perhaps = damping is None and model.D is not None and is_large(model)
    more = wider(kept, top, model.n_dof) if perhaps and not is_rayleigh(model) else (kept, top)
    with Progress(
        None, LANCZOS_STEPS, progress=progress, advice="Fewer modes (count=, below=) take less."
    ):
        # one factor for the modes and for the attachment vectors, while it is held here
        factored = stiffness_factor(model, factor) if at and is_large(model) else None
        omega, phi, certificate = _undamped(model, *more, factor)
    orthonormality, residual, rounding = check_modes(model, omega, phi)
    certificate = certificate.extended(
        Verified("orthonormality", orthonormality, "phi^T M phi - I", _ORTHONORMAL)
    )
    if model.rigid_body.shape[1]:
        held = float(rounding_of(model.K, model.rigid_body).max())
        route = "K times the rigid-body motions"
        certificate = certificate.extended(
            Verified("rigid_residual", rigid_residual(model), route),
            Verified("rigid_rounding", float(np.sqrt(held) / (2 * np.pi)), route),
        )
    if damping is None and model.D is not None and not is_proportional(model, omega, phi):
        return coupled_modes(model, phi, kept, top, names, factor)
    inside = np.flatnonzero(signed_square(omega) <= top)[:kept]
    if inside.size < omega.size:
        omega, phi, residual = omega[inside], phi[:, inside], residual[inside]
    vectors, vector_omega = np.zeros((model.n_dof, 0)), np.zeros(0)
    if at:
        vectors, vector_omega = attachment_vectors(model, phi, at)
    del factored
    r = model.rigid_body.shape[1]
    if damping is None:
        zeta = np.concatenate([np.zeros(r), projected_zeta(model.D, phi[:, r:], omega[r:])])
    else:
        zeta = damping.zeta(omega)
    found = Modes(
        omega,
        zeta,
        phi,
        model.dofs,
        n_rigid=r,
        vectors=vectors,
        vector_omega=vector_omega,
        vector_zeta=_vector_zeta(model, vectors, vector_omega, damping, compliance_damping),
        vector_dofs=names,
        residual=residual,
        rounding=rounding[inside],
        certificate=certificate,
    )
    _solved[model] = weakref.ref(found)
    return found


def modes_reaching(model: FEModel, freq: float, *, least: int = 0) -> Modes:
    """Return the undamped modes of a structure up to a frequency, and perhaps further."""
    # modes that `solve_modes` found for this model are used again while they are in memory
    known = _solved.get(model)
    modes = known() if known is not None else None
    least = min(least, model.n_dof)
    real = modes is not None and not np.iscomplexobj(modes.phi)
    if modes is not None and real and modes.n_modes >= least and (
        modes.n_modes == model.n_dof or modes.freq[-1] > freq
    ):  # fmt: skip
        return modes
    modes = solve_modes(model, below=1.5 * freq, damping=ModalDamping(0.0))
    few = modes.n_rigid + _FEW
    if modes.n_modes < max(least, few):
        count = min(max(least, few), model.n_dof)
        modes = solve_modes(model, count=count, damping=ModalDamping(0.0))
    return modes


def _mode_request(model: FEModel, count: int | None, below: float | None) -> tuple[int, float]:
    n, r = model.n_dof, model.rigid_body.shape[1]
    top = np.inf if below is None else (2 * np.pi * positive(below, "below")) ** 2
    if count is None:
        if below is None and n > DENSE_LIMIT:
            raise ModelError(
                f"a model of {n} DOFs is too large for all its modes. Give count= or below= (Hz)."
            )
        return n, top
    number = isinstance(count, int | np.integer) and not isinstance(count, bool)
    if not number or not max(r, 1) <= count <= n:
        raise ModelError(
            f"count must be a whole number from {max(r, 1)} (rigid-body modes stay: {r}) "
            f"to {n} (all modes), got {short(count)}. Choose a number in this range, or give "
            "below= in Hz."
        )
    return int(count), top


def _vector_zeta(
    model: FEModel,
    vectors: FloatArray,
    omega: FloatArray,
    damping: Damping | None,
    given: Damping | float | None,
) -> FloatArray:
    if not omega.size:
        return np.zeros(0)
    if given is not None:
        law = given if isinstance(given, Damping) else ModalDamping(given)
        return law.zeta(omega)
    if damping is None:
        return projected_zeta(model.D, vectors, omega)
    if isinstance(damping, ModalDamping) and not isinstance(damping.ratio, float):
        raise ModelError(
            "damping is given mode by mode, so that the attachment vectors have none: "
            "pass compliance_damping=, a ratio."
        )
    return damping.zeta(omega)


def _undamped(
    model: FEModel, count: int, top: float, method: Cholmod | None
) -> tuple[FloatArray, FloatArray, Certificate]:
    rigid = model.rigid_body
    n, r = rigid.shape
    certificate = Certificate()
    if np.isfinite(top) and DENSE_LIMIT < n <= _DENSE_MANY and is_large(model):
        # their number decides whether a dense solution is faster
        count = min(count, max(modes_below(model, top), r))
    small = n <= DENSE_LIMIT or (n <= _DENSE_MANY and _MANY * count > n)
    if small or not sp.issparse(model.K) or not sp.issparse(model.M):
        omega, phi = elastic_modes(
            dense(model.M),
            dense(model.K),
            rigid,
            count - r,
            model.dofs,
            motions=lambda: model.body_motions,
        )
    elif count > r:
        squares, phi, certificate = counted_modes(model, count - r, top, method)
        omega = signed_root(squares)
        for at in column_groups(omega.size, width_of(n)):
            phi[:, at] = signed(phi[:, at])
    else:
        omega, phi = np.zeros(0), np.zeros((n, 0))
    omega = omega[signed_square(omega) <= top]
    shapes = np.empty((n, r + omega.size))
    shapes[:, :r], shapes[:, r:] = rigid, phi[:, : omega.size]
    return np.concatenate([np.zeros(r), omega]), shapes, certificate


#: largest error of M-orthonormality of a result
_ORTHONORMAL = ROUNDING


def check_modes(
    model: FEModel, omega: FloatArray, phi: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Raise SolverError unless shapes are M-orthonormal and fulfil the eigenvalue problem.

    Returns the error of orthonormality, the residual of each mode, and the relative error of its
    frequency from rounding of K's entries.
    """
    stray, size, limit, left, rounding = _mode_residuals(model, omega, phi)
    error = float(stray.max(initial=0.0))
    if not error <= _ORTHONORMAL:
        raise SolverError(
            f"modes are M-orthonormal only to {error:.2g} (limit {_ORTHONORMAL:g}): M is too badly "
            "conditioned. Look for DOFs with next to no mass."
        )
    if not np.all(size <= limit):
        i = int(np.argmax(size / limit))
        if omega[i] == 0:
            raise SolverError(
                f"rigid-body motion {i + 1} leaves a force (of {size[i]:.2g}, limit "
                f"{limit[i]:.2g}): the entries of K carry too few digits. check(model) says how "
                "many; export in double precision, or take "
                "fx.structure.FEMatrices(K, M, dofs=dofs).model(free=True)."
            )
        raise SolverError(
            f"mode {i + 1} at {omega[i] / (2 * np.pi):.5g} Hz leaves a residual of {size[i]:.2g} "
            f"(limit {limit[i]:.2g}) in the eigenvalue problem: not a mode of this model."
        )
    return error, left, rounding


def _mode_residuals(model: FEModel, omega: FloatArray, phi: FloatArray) -> tuple[FloatArray, ...]:
    """Return what `check_modes` judges, from separate products."""
    M, K = by_rows(model.M), by_rows(model.K)
    size_of_K, stiff = Absolute(K), diagonal(model.K)
    # scaled by stiffness, so that displacements compare with rotations and DOFs without inertia
    # weigh the same
    weight = 1 / np.where(stiff > 0, stiff, stiff.max(initial=0.0) or 1.0)
    rows = size_of_K @ np.ones((stiff.size, 1))
    elastic = omega != 0
    error, size, limit, left, rounding = np.zeros((5, omega.size))
    for at in column_groups(omega.size, width_of(stiff.size)):
        part = np.ascontiguousarray(phi[:, at])
        mass, force, moved = M @ part, K @ part, np.abs(part)
        gram = phi[:, at.start :].T @ mass
        np.fill_diagonal(gram, gram.diagonal() - 1.0)
        error[at] = np.abs(gram, out=gram).max(axis=0)
        whole = size_of_K @ moved
        rounding[at] = PRECISION * np.einsum("ij,ij->j", moved, whole)
        # an entry of a shape has the rounding error of the largest entries, which stiff springs
        # multiply
        whole += rows * (NEGLIGIBLE * moved.max(axis=0))
        limit[at] = RESIDUAL[0] * _lengths(mass, weight) * omega[at] ** 2
        limit[at] += RESIDUAL[1] * _lengths(whole, weight)
        scale = np.where(elastic[at], _lengths(force), np.inf)
        mass *= signed_square(omega[at])
        force -= mass
        size[at], left[at] = _lengths(force, weight), _lengths(force) / scale
    rounding[elastic] /= 2 * omega[elastic] ** 2
    rounding[~elastic] = 0.0
    return error, size, limit, left, rounding


def _lengths(columns: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Return the lengths of columns whose squared entries have weights."""
    if weight is None:
        return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))
    return np.asarray(np.sqrt(weight @ columns**2))


def rigid_residual(model: FEModel) -> float:
    """Return ``||K R||`` relative to its size if nothing cancelled."""
    K, R = by_rows(model.K), model.rigid_body
    whole = np.linalg.norm(abs(K) @ np.abs(R), axis=0)
    return float(np.max(np.linalg.norm(K @ R, axis=0) / divisor(whole)))


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
