"""The eigenvalue problem of a structure (paper, eq. (2)), solved and checked."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from ..errors import ModelError, SolverError
from ..labels import Place
from ..structure import Damping, FEModel, ModalDamping
from ..structure.eigen import check_stiffness, elastic_modes, signed
from ..structure.factor import DENSE_LIMIT, dense, diagonal, negative_pivots, symmetric_lu
from ..values import FloatArray, positive
from .attachment import attachment_vectors, labels_of, places, projected_zeta
from .modes import Modes
from .normal_form import PROPORTIONAL, check_drag, normal_form

#: M-orthonormality that is asked of every answer
_ORTHONORMAL = 1e-12
#: residual ||K phi - omega^2 M phi||, of omega^2 and of the largest eigenvalue of the model
_RESIDUAL = (1e-8, 1e-12)
#: part of the largest omega^2 below which an elastic one is rounding
_ROUNDING = 1e-14
#: frequencies closer than this (relative, squared) belong together
_GAP = 1e-6


def solve_modes(
    model: FEModel,
    *,
    count: int | None = None,
    below: float | None = None,
    damping: Damping | None = None,
    compliance_at: Place | Iterable[Place] = (),
    compliance_damping: Damping | float | None = None,
) -> Modes:
    """Return the lowest modes of a structure, mass-normalised, rigid-body modes exactly at 0.

    Parameters
    ----------
    model : FEModel
        The structure.
    count : int, optional
        Number of modes, rigid-body modes included. A cut through a repeated pair keeps an
        arbitrary half of it.
    below : float [Hz], optional
        Keep modes up to this frequency. With neither, all modes (of a model that is not large).
    damping : ModalDamping or Rayleigh, optional
        In place of the model's D. None: its D, and no damping when it has none.
    compliance_at : place or sequence of places
        DOF labels, points (motion z) or mappings at which the static compliance of the truncated
        modes is kept, by residual attachment vectors.
    compliance_damping : Damping or float, optional
        Of the attachment vectors; None: damped like the modes.

    Returns
    -------
    Modes
        Complex where the model's own D is not proportional. Checked: residuals,
        M-orthonormality, and that no mode was left out.

    Raises
    ------
    ModelError
        When the request does not fit the model, K is indefinite, or it has a zero-energy motion
        that is not a rigid-body one.
    SolverError
        When the answer fails its check.
    LabelError
        When a place is unknown.

    Examples
    --------
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
        )
    if damping is not None and not isinstance(damping, Damping):
        raise ModelError(
            f"damping must be a ModalDamping or Rayleigh, got {type(damping).__name__}: "
            "1 % in all modes is ModalDamping(0.01)."
        )
    kept, top = _asked(model, count, below)
    at = places(compliance_at)
    names = labels_of(at, model.dofs)
    omega, phi = _undamped(model, kept, top)
    _check(model, omega, phi)
    if damping is None and model.D is not None and not _is_proportional(model, omega, phi):
        return _complex_modes(model, kept, top, names)
    vectors, vector_omega = np.zeros((model.n_dof, 0)), np.zeros(0)
    if at:
        vectors, vector_omega = attachment_vectors(model, omega, phi, at)
    r = model.rigid_body.shape[1]
    if damping is None:
        zeta = np.concatenate([np.zeros(r), projected_zeta(model.D, phi[:, r:], omega[r:])])
    else:
        zeta = damping.zeta(omega)
    return Modes(
        omega,
        zeta,
        phi,
        model.dofs,
        n_rigid=r,
        vectors=vectors,
        vector_omega=vector_omega,
        vector_zeta=_vector_zeta(model, vectors, vector_omega, damping, compliance_damping),
        vector_dofs=names,
    )


def _asked(model: FEModel, count: int | None, below: float | None) -> tuple[int, float]:
    n, r = model.n_dof, model.rigid_body.shape[1]
    top = np.inf if below is None else (2 * np.pi * positive(below, "below")) ** 2
    if count is None:
        if below is None and n > DENSE_LIMIT:
            raise ModelError(f"a model of {n} DOFs needs count= or below= (Hz): not all its modes.")
        return n, top
    if isinstance(count, bool) or int(count) != count or not max(r, 1) <= count <= n:
        raise ModelError(
            f"count must be a whole number from {max(r, 1)} ({r} rigid-body modes are always kept) "
            f"to {n} (all modes), got {count!r}."
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
        return (given if isinstance(given, Damping) else ModalDamping(given)).zeta(omega)
    if damping is None:
        return projected_zeta(model.D, vectors, omega)
    if isinstance(damping, ModalDamping) and not isinstance(damping.ratio, float):
        raise ModelError(
            "damping is given mode by mode, so that the attachment vectors have none: "
            "pass compliance_damping=, a ratio."
        )
    return damping.zeta(omega)


def _undamped(model: FEModel, count: int, top: float) -> tuple[FloatArray, FloatArray]:
    rigid = model.rigid_body
    n, r = rigid.shape
    if n <= DENSE_LIMIT or not sp.issparse(model.K) or not sp.issparse(model.M):
        omega, phi = elastic_modes(dense(model.M), dense(model.K), rigid, count - r)
    else:
        omega, phi = _sparse_modes(model, count - r, top)
    keep = omega**2 <= top
    return np.concatenate([np.zeros(r), omega[keep]]), np.hstack([rigid, phi[:, keep]])


def _sparse_modes(model: FEModel, count: int, top: float) -> tuple[FloatArray, FloatArray]:
    """Return the lowest elastic modes by shift-invert Lanczos, complete by a Sturm count."""
    M, rigid = model.M, model.rigid_body
    K: Any = model.K
    n, r = rigid.shape
    # far below the first elastic mode, yet K - shift M is well away from singular; what rounding
    # leaves in the rigid-body directions is projected out
    shift = -1e-12 * _largest(model)
    lu = symmetric_lu(K - shift * M)
    if negative_pivots(lu):
        raise ModelError(
            f"K has {negative_pivots(lu)} negative eigenvalues: the structure is unstable. Look "
            "for a sign in K."
        )
    if np.isfinite(top):
        count = min(count, negative_pivots(symmetric_lu(K - top * M)) - r)
    if count <= 0:
        return np.zeros(0), np.zeros((n, 0))
    if count > n // 10:
        return elastic_modes(dense(M), dense(K), rigid, count)
    loaded = np.asarray(M @ rigid)

    def solve(force: FloatArray) -> FloatArray:
        moved = lu.solve(force - loaded @ (rigid.T @ force))
        return np.asarray(moved - rigid @ (loaded.T @ moved))

    inverse = spla.LinearOperator((n, n), matvec=solve, dtype=np.float64)
    for attempt in range(3):
        # repeated pairs may lose a partner: over-ask, count, and try again from elsewhere
        asked = min(count + max(8, count // 4) * (attempt + 1), n - r - 1)
        start: Any = np.random.default_rng(attempt).standard_normal(n)
        start = start - rigid @ (loaded.T @ start)
        try:
            found: Any = spla.eigsh(K, asked, M, shift, v0=start, ncv=3 * asked + 20, OPinv=inverse)
        except spla.ArpackNoConvergence as error:
            raise SolverError(f"Lanczos did not converge for {asked} modes: {error}.") from error
        order = np.argsort(found[0])
        squares, phi = found[0][order], found[1][:, order]
        check_stiffness(squares, _ROUNDING * _largest(model), r)
        gaps = np.flatnonzero(np.diff(squares) > _GAP * squares[1:]) + 1
        gaps = gaps[gaps >= count]
        if not gaps.size:
            continue
        sure = int(gaps[0])
        between = 0.5 * (squares[sure - 1] + squares[sure])
        if negative_pivots(symmetric_lu(K - between * M)) - r == sure:
            return np.sqrt(squares[:count]), signed(phi[:, :count])
    raise SolverError(
        f"Lanczos left out some of the {count} lowest elastic modes three times over (a Sturm "
        "count tells): closely repeated frequencies. Ask for some more or fewer modes."
    )


def _largest(model: FEModel) -> float:
    """Return about the largest eigenvalue omega^2 of a model."""
    return float(np.max(diagonal(model.K) / diagonal(model.M)))


def _check(model: FEModel, omega: FloatArray, phi: FloatArray) -> None:
    """Raise SolverError unless shapes are M-orthonormal and fulfil the eigenvalue problem."""
    mass = np.asarray(model.M @ phi)
    error = float(np.abs(phi.T @ mass - np.eye(omega.size)).max(initial=0.0))
    if not error <= _ORTHONORMAL:
        raise SolverError(
            f"modes are M-orthonormal only to {error:.2g} (limit {_ORTHONORMAL:g}): M is too badly "
            "conditioned. Look for DOFs with next to no mass."
        )
    residual = np.asarray(model.K @ phi) - mass * omega**2
    size = np.linalg.norm(residual / np.sqrt(diagonal(model.M))[:, None], axis=0)
    limit = _RESIDUAL[0] * omega**2 + _RESIDUAL[1] * _largest(model)
    if not np.all(size <= limit):
        i = int(np.argmax(size / limit))
        raise SolverError(
            f"mode {i + 1} at {omega[i] / (2 * np.pi):.5g} Hz leaves a residual of {size[i]:.2g} "
            f"(limit {limit[i]:.2g}) in the eigenvalue problem: not a mode of this model."
        )


def _is_proportional(model: FEModel, omega: FloatArray, phi: FloatArray) -> bool:
    """Return whether the kept modes are modes of the damped model too."""
    D: Any = model.D
    r = model.rigid_body.shape[1]
    check_drag(phi[:, :r], D, omega[r:])
    forces = np.asarray(D @ phi[:, r:])
    rate = np.sum(phi[:, r:] * forces, axis=0)
    # all of D phi, not only its part in the kept modes: D may couple to truncated ones
    stray = forces - np.asarray(model.M @ phi[:, r:]) * rate
    coupling = np.linalg.norm(stray / np.sqrt(diagonal(model.M))[:, None], axis=0)
    largest = float(np.max(diagonal(D) / diagonal(model.M), initial=0.0))
    return bool(np.all(coupling <= PROPORTIONAL * largest))


def _complex_modes(model: FEModel, count: int, top: float, names: tuple[str, ...]) -> Modes:
    if model.n_dof > DENSE_LIMIT:
        raise ModelError(
            f"the damping D of this model of {model.n_dof} DOFs is not proportional: its complex "
            "modes need a dense solution, too large here. Solve with damping=ModalDamping(...), "
            "reduce, and add the dampers to the reduced model."
        )
    if names:
        raise ModelError(
            "the model's D is not proportional: its modes are complex and take no attachment "
            "vectors. Pass damping=ModalDamping(...) in place of D, or leave out compliance_at."
        )
    form = normal_form(model.M, model.D, model.K, model.rigid_body)
    size = np.abs(form.poles)
    keep = np.flatnonzero(size**2 <= top)[:count]
    zeta = np.zeros(keep.size)
    zeta[form.n_rigid :] = -form.poles[keep].real[form.n_rigid :] / size[keep][form.n_rigid :]
    return Modes(size[keep], zeta, form.phi[:, keep], model.dofs, n_rigid=form.n_rigid)
