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
from ..structure.factor import DENSE_LIMIT, dense, diagonal, negative_pivots, symmetric_lu
from ..values import FloatArray, positive
from .attachment import attachment_vectors, labels_of, places, projected_zeta
from .modes import Modes
from .normal_form import elastic_modes, normal_form, polished, signed

#: M-orthonormality that is asked of every answer
_ORTHONORMAL = 1e-12
#: residual ||K phi - omega^2 M phi||, of omega^2 and of the largest eigenvalue of the model
_RESIDUAL = (1e-8, 1e-12)
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
        None: the model's D, and no damping when it has none.
    compliance_at : place or sequence of places
        DOF labels, points (motion z) or mappings at which the static compliance of the truncated
        modes is kept, by residual attachment vectors.
    compliance_damping : Damping or float, optional
        Of the attachment vectors; None: damped like the modes.

    Returns
    -------
    Modes
        Checked: residuals, M-orthonormality, and that no mode was left out.

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
    <Modes: 24 (3 rigid-body and 21 elastic at 245.8 to 3768 Hz) of 243 DOFs, attachment vectors at 1:z>
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
    if damping is None and model.D is not None and (found := _damped(model, kept, top, names)):
        return found
    omega, phi = _undamped(model, kept, top)
    _check(model, omega, phi)
    vectors, vector_omega = np.zeros((model.n_dof, 0)), np.zeros(0)
    if at:
        vectors, vector_omega = attachment_vectors(model, omega, phi, at)
    if damping is None:
        zeta = np.zeros(omega.size)
        elastic = omega > 0
        zeta[elastic] = projected_zeta(model.D, phi[:, elastic], omega[elastic])
        vector_zeta = projected_zeta(model.D, vectors, vector_omega)
    else:
        zeta = damping.zeta(omega)
        vector_zeta = np.zeros(0)
    if at and (compliance_damping is not None or damping is not None):
        vector_zeta = _vector_damping(damping, compliance_damping).zeta(vector_omega)
    return Modes(
        omega,
        zeta,
        phi,
        model.dofs,
        n_rigid=model.rigid_body.shape[1],
        vectors=vectors,
        vector_omega=vector_omega,
        vector_zeta=vector_zeta,
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


def _vector_damping(damping: Damping | None, given: Damping | float | None) -> Damping:
    if isinstance(given, Damping):
        return given
    if given is not None:
        return ModalDamping(given)
    assert damping is not None  # noqa: S101
    if isinstance(damping, ModalDamping) and not isinstance(damping.ratio, float):
        raise ModelError(
            "damping is given mode by mode, so that the attachment vectors have none: "
            "pass compliance_damping=, a ratio."
        )
    return damping


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
    M, K, rigid = model.M, model.K, model.rigid_body
    n, r = rigid.shape
    if count <= 0:
        return np.zeros(0), np.zeros((n, 0))
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
        inside = negative_pivots(symmetric_lu(K - top * M)) - r
        count = min(count, inside)
        if count <= 0:
            return np.zeros(0), np.zeros((n, 0))
    loaded = np.asarray(M @ rigid)

    def solve(force: FloatArray) -> FloatArray:
        moved = lu.solve(force - loaded @ (rigid.T @ force))
        return np.asarray(moved - rigid @ (loaded.T @ moved))

    inverse = spla.LinearOperator((n, n), matvec=solve, dtype=np.float64)
    for attempt in range(3):
        # repeated pairs may lose a partner: over-ask, count, and try again from elsewhere
        asked = min(count + max(8, count // 4) * (attempt + 1), n - r - 1)
        start = np.random.default_rng(attempt).standard_normal(n)
        start -= rigid @ (loaded.T @ start)
        try:
            squares, phi = spla.eigsh(
                K, asked, M, sigma=shift, OPinv=inverse, v0=start, ncv=min(3 * asked + 20, n)
            )
        except spla.ArpackNoConvergence as error:
            raise SolverError(f"Lanczos did not converge for {asked} modes: {error}.") from error
        order = np.argsort(squares)
        squares, phi = squares[order], phi[:, order]
        gaps = np.flatnonzero(np.diff(squares) > _GAP * squares[1:]) + 1
        gaps = gaps[gaps >= count]
        if not gaps.size:
            continue
        sure = int(gaps[0])
        between = 0.5 * (squares[sure - 1] + squares[sure])
        if negative_pivots(symmetric_lu(K - between * M)) - r == sure:
            phi = polished(M, phi[:, :sure], rigid)
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


def _damped(model: FEModel, count: int, top: float, names: tuple[str, ...]) -> Modes | None:
    """Return the complex modes of a model with its own D; None when D is proportional."""
    omega, phi = _undamped(model, count, top)
    damped: Any = np.asarray(model.D @ phi)
    rate = np.sum(phi * damped, axis=0)
    # of the whole D phi, not only its part in the kept modes: D may couple to truncated ones
    weight = np.sqrt(diagonal(model.M))[:, None]
    coupling = np.linalg.norm((damped - np.asarray(model.M @ phi) * rate) / weight, axis=0)
    largest = float(np.max(np.abs(diagonal(model.D)) / diagonal(model.M), initial=0.0))
    r = model.rigid_body.shape[1]
    if np.all(coupling[r:] <= 1e-9 * largest) and not np.any(rate[:r] > 1e-9 * largest):
        return None
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
    zeta[r:] = -form.poles[keep[r:]].real / size[keep[r:]]
    return Modes(size[keep], zeta, form.phi[:, keep], model.dofs, n_rigid=r)
