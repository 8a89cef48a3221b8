"""The eigenvalue problem of a structure (paper, eq. (2)), solved and checked."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import ComplexArray, FloatArray, divisor, instance, positive
from ..certificates import Certificate, Verified
from ..errors import ModelError, SolverError, counted, short, warn
from ..labels import Place
from ..parallel import Progress
from ..sparse.factor import DENSE_LIMIT
from ..sparse.lowest import STEPS
from ..sparse.other_factors import Cholmod
from ..sparse.symmetric import (
    Absolute,
    beyond,
    by_rows,
    column_groups,
    dense,
    diagonal,
    projected,
    rounding_of,
    width_of,
)
from ..structure import Damping, FEModel, ModalDamping
from ..structure.definite import elastic_modes, signed, signed_root, signed_square
from ..tolerances import MISSED, MOST_STEPS, NEGLIGIBLE, PRECISION, ROOT, ROUNDING, TINY
from .modes import Modes
from .normal_forms import PROPORTIONAL, NormalForm, check_drag, normal_form
from .sparse_modes import counted_modes
from .statics import (
    attachment_vectors,
    is_large,
    labels_of,
    modes_below,
    places,
    projected_zeta,
    stiffness_factor,
)

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
    with Progress(None, STEPS, progress=progress, advice="Fewer modes (count=, below=) take less."):
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
    if damping is None and model.D is not None and not _is_proportional(model, omega, phi):
        return _coupled_modes(model, phi, kept, top, names, factor)
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


def _is_proportional(model: FEModel, omega: FloatArray, phi: FloatArray) -> bool:
    """Return whether the kept modes are modes of the damped model too."""
    D: Any = model.D
    r = model.rigid_body.shape[1]
    check_drag(phi[:, :r], D, omega[r:])
    forces = np.asarray(D @ phi[:, r:])
    rate = np.sum(phi[:, r:] * forces, axis=0)
    # all of D phi, not only its projection on the kept modes, since D may couple to truncated modes
    stray = forces - np.asarray(model.M @ phi[:, r:]) * rate
    coupling = np.linalg.norm(stray / np.sqrt(diagonal(model.M))[:, None], axis=0)
    largest = float(np.max(diagonal(D) / diagonal(model.M), initial=0.0))
    return bool(np.all(coupling <= PROPORTIONAL * largest))


def _coupled_modes(
    model: FEModel,
    phi: FloatArray,
    count: int,
    top: float,
    names: tuple[str, ...],
    factor: Cholmod | None,
) -> Modes:
    if names:
        raise ModelError(
            "the model's D is not proportional: its modes are complex and take no attachment "
            "vectors. Pass damping=ModalDamping(...) in place of D, or leave out compliance_at."
        )
    if is_large(model):
        return damped_modes(model, phi, count, top, factor)
    form = normal_form(
        model.M,
        model.D,
        model.K,
        model.rigid_body,
        lambda: model.body_motions,
        lowest=max(count - model.rigid_body.shape[1], 0),
    )
    omega = form.omega
    keep = np.flatnonzero(signed_square(omega) <= top)[:count]
    found = Modes(omega[keep], form.zeta[keep], form.phi[:, keep], model.dofs, form.n_rigid)
    return leaving_overdamped(form, found, top)


#: largest error of M-orthonormality of a result
_ORTHONORMAL = ROUNDING
#: residual ||K phi - omega^2 M phi||, of omega^2 ||M phi|| and of || |K| |phi| ||
_RESIDUAL = (ROOT, ROUNDING)


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
        limit[at] = _RESIDUAL[0] * _lengths(mass, weight) * omega[at] ** 2
        limit[at] += _RESIDUAL[1] * _lengths(whole, weight)
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


#: additional undamped modes as a fraction and at least; and factor on the end of a band
_MORE, _LEAST, _BEYOND = 4, 8, 1.3


def wider(count: int, top: float, n: int) -> tuple[int, float]:
    """Return the number of undamped modes in a basis of complex ones, and the last omega^2."""
    return min(n, count + max(count // _MORE, _LEAST)), top * _BEYOND**2


def damped_modes(
    model: FEModel, phi: FloatArray, count: int, top: float, method: Cholmod | None
) -> Modes:
    """Return the complex modes of a large model, from a basis that grows until they converge."""
    # Rayleigh-Ritz in real vectors V: the undamped modes, the static responses to the forces of
    # dampers, and `(K - sigma M)^-1` times what the complex modes leave in `(lambda^2 M + lambda D
    # + K) x = 0`, again and again (Davidson's method for the quadratic problem), until their
    # residuals are as small as those allowed for undamped modes [Sleijpen1996]_
    factor, r = stiffness_factor(model, method), model.rigid_body.shape[1]
    V = np.hstack([phi, beyond(model.M, phi, factor.solve(damper_forces(model)))])
    for _ in range(MOST_STEPS):
        form, keep = _ritz(model, V, r, count, top)
        shapes: Any = V @ form.phi[:, keep]
        slow = np.abs(form.overdamped) <= _range(form.poles[keep], top)
        still = V @ form.overdamped_phi[:, slow]
        poles, every = form.poles[keep], _growing(form, shapes, keep)
        rest, size, limit = _rest(
            model, np.concatenate([poles, form.overdamped[slow]]), np.hstack([every, still]), r
        )
        wrong = np.flatnonzero(size > limit)
        if not wrong.size:
            part = np.where(limit > 0, size / divisor(limit), 0.0)
            return leaving_overdamped(
                form,
                Modes(
                    form.omega[keep],
                    form.zeta[keep],
                    shapes,
                    model.dofs,
                    n_rigid=r,
                    residual=_RESIDUAL[0] * part[: keep.size],
                    certificate=Certificate((Verified("basis", float(V.shape[1])),)),
                ),
                top,
            )
        step = factor.solve(np.hstack([rest[:, wrong].real, rest[:, wrong].imag]))
        more = beyond(by_rows(model.M), V, step, dependent=MISSED)
        if not more.shape[1]:
            break
        V = np.hstack([V, more])
    worst = float((size[wrong] / limit[wrong]).max()) * _RESIDUAL[0]
    raise SolverError(
        f"complex modes leave a relative residual of {worst:.2g} (limit {_RESIDUAL[0]:g}) after "
        f"{counted(V.shape[1], 'vector')}: the damping is strong. Want fewer modes, or reduce the "
        "model by CraigBampton at the dampers, which keeps D, and take its modes()."
    )


def _ritz(
    model: FEModel, V: FloatArray, r: int, count: int, top: float
) -> tuple[NormalForm, np.ndarray]:
    M, D, K = (projected(part, V) for part in (model.M, model.D, model.K))
    # rounding of stiff shapes would act as a spring on rigid-body motions
    K[:r], K[:, :r] = 0.0, 0.0
    rigid = np.eye(V.shape[1], r)
    body = V.T @ np.asarray(model.M @ model.body_motions) if model.n_unstable else rigid
    form = normal_form(M, D, K, rigid, lambda: body, lowest=max(count - r, 0))
    return form, np.flatnonzero(signed_square(form.omega) <= top)[:count]


def leaving_overdamped(form: NormalForm, modes: Modes, top: float = np.inf) -> Modes:
    """Return modes up to omega^2 with a note of the real poles there, and warn of these."""
    note = form.overdamped_below(_range(modes.poles, top))
    if not note:
        return modes
    warn(note)
    return modes.replace(notes=(*modes.notes, note))


def _range(poles: ComplexArray, top: float) -> float:
    """Return the largest rate [1/s] of wanted poles: from omega^2, or from the modes."""
    return float(np.sqrt(top) if np.isfinite(top) else np.abs(poles).max(initial=0.0))


def _growing(form: NormalForm, shapes: Any, keep: np.ndarray) -> Any:
    """Return shapes; for an unstable mode, the shape of the growing pole."""
    unstable = form.omega[keep] < 0
    return np.where(unstable, shapes.real + shapes.imag, shapes) if unstable.any() else shapes


def _rest(
    model: FEModel, poles: ComplexArray, x: Any, n_rigid: int
) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return the residuals (n, k) of modes, their size (k,) and their limit (k,)."""
    K, M, D = by_rows(model.K), by_rows(model.M), by_rows(model.D)
    inertia = (M @ x) * poles**2
    rest = inertia + (D @ x) * poles + K @ x
    stiff = diagonal(model.K)
    weight = 1 / np.sqrt(np.where(stiff > 0, stiff, stiff.max(initial=0.0) or 1.0))[:, None]
    size = np.linalg.norm(weight * rest, axis=0)
    # an entry of a shape has the rounding error of the largest entries, as in undamped modes
    moved = np.abs(x)
    moved = moved + NEGLIGIBLE * moved.max(axis=0)
    whole = Absolute(K) @ moved + np.abs(poles) * (Absolute(D) @ moved)
    limit = _RESIDUAL[0] * np.linalg.norm(weight * inertia, axis=0)
    # real poles are not returned: their approximate place suffices
    part = np.where(poles.imag == 0, _RESIDUAL[0], _RESIDUAL[1])
    limit = limit + part * np.linalg.norm(weight * whole, axis=0)
    size[:n_rigid] = 0.0  # zero by convention; rigid-body modes are checked as undamped modes
    return np.asarray(rest), np.asarray(size), np.asarray(limit)


#: largest number of DOFs at which dampers act, and of their forces; above it D is material damping
_TOUCHED, _FORCES = 600, 200


def damper_forces(model: FEModel) -> FloatArray:
    """Return orthonormal forces (n, m) that span those of dampers."""
    # empty where D is a combination of K and M, or acts at so large a number of DOFs that it is
    # material damping
    none = np.zeros((model.n_dof, 0))
    if model.D is None or is_rayleigh(model):
        return none
    rows = sp.csr_array(model.D)
    touched = np.flatnonzero(np.diff(rows.indptr))
    if touched.size > _TOUCHED:
        return none
    values, vectors = la.eigh(rows[touched][:, touched].toarray())
    kept = np.flatnonzero(values > ROUNDING * values.max(initial=0.0))
    if kept.size > _FORCES:
        return none
    forces = np.zeros((model.n_dof, kept.size))
    forces[touched] = vectors[:, kept]
    return forces


def is_rayleigh(model: FEModel) -> bool:
    """Return whether ``D = alpha M + beta K``, seen on one vector."""
    x = np.random.default_rng(0).standard_normal(model.n_dof) / np.sqrt(diagonal(model.K) + TINY)
    sides: Any = [np.asarray(part @ x) for part in (model.M, model.K)]
    basis = np.column_stack([side / np.linalg.norm(side) for side in sides])
    damped = np.asarray(model.D @ x)  # type: ignore[operator]
    left = damped - basis @ np.linalg.lstsq(basis, damped)[0]
    return bool(np.linalg.norm(left) <= ROUNDING * np.linalg.norm(damped))
