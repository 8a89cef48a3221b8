"""Modes of a structure whose damping matrix couples its undamped modes: complex ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import ComplexArray, FloatArray, divisor
from ..certificates import Certificate, Verified
from ..errors import ModelError, SolverError, counted
from ..sparse.other_factors import Cholmod
from ..sparse.symmetric import Absolute, beyond, by_rows, diagonal, projected
from ..structure import FEModel
from ..structure.definite import signed_square
from ..tolerances import MISSED, MOST_STEPS, NEGLIGIBLE, ROOT, ROUNDING, TINY
from .modes import Modes
from .normal_forms import PROPORTIONAL, NormalForm, check_drag, normal_form, overdamped_notes
from .sparse_modes import is_large, stiffness_factor

#: largest residual of a mode, relative to its inertia forces and to the sizes of all its forces
RESIDUAL = (ROOT, ROUNDING)
#: additional undamped modes as a fraction and at least; and factor on the end of a band
_MORE, _LEAST, _BEYOND = 4, 8, 1.3


def is_proportional(model: FEModel, omega: FloatArray, phi: FloatArray) -> bool:
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


def coupled_modes(
    model: FEModel,
    phi: FloatArray,
    count: int,
    top: float,
    names: tuple[str, ...],
    factor: Cholmod | None,
) -> Modes:
    """Return the complex modes of a model with coupling damping."""
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
    notes = overdamped_notes(form, _range(form.poles[keep], top))
    shapes = form.phi[:, keep]
    return Modes(omega[keep], form.zeta[keep], shapes, model.dofs, form.n_rigid, notes=notes)


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
            return Modes(
                form.omega[keep],
                form.zeta[keep],
                shapes,
                model.dofs,
                n_rigid=r,
                residual=RESIDUAL[0] * part[: keep.size],
                certificate=Certificate((Verified("basis", float(V.shape[1])),)),
                notes=overdamped_notes(form, _range(poles, top)),
            )
        step = factor.solve(np.hstack([rest[:, wrong].real, rest[:, wrong].imag]))
        more = beyond(by_rows(model.M), V, step, dependent=MISSED)
        if not more.shape[1]:
            break
        V = np.hstack([V, more])
    worst = float((size[wrong] / limit[wrong]).max()) * RESIDUAL[0]
    raise SolverError(
        f"complex modes leave a relative residual of {worst:.2g} (limit {RESIDUAL[0]:g}) after "
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
    limit = RESIDUAL[0] * np.linalg.norm(weight * inertia, axis=0)
    # real poles are not returned: their approximate place suffices
    part = np.where(poles.imag == 0, RESIDUAL[0], RESIDUAL[1])
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
