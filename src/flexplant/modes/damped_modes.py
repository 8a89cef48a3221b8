"""Complex modes of a large sparse model whose damping is not proportional."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..checks import ComplexArray, FloatArray
from ..errors import SolverError, counted, warn
from ..sparse.cholmod import Cholmod
from ..sparse.factor import by_rows, diagonal
from ..sparse.lanczos import Absolute, beyond
from ..sparse.pardiso import Pardiso
from ..structure import FEModel
from ..structure.definite import signed_square
from ..tolerances import ROUNDING, TINY, divisor
from .modes import Modes
from .normal_form import NormalForm, normal_form
from .shifted import stiffness_factor

#: what a mode may leave: part of its inertia forces, and of its elastic ones in absolute size
_RESIDUAL = (1e-8, 1e-12)
#: the part of the largest entry of a shape that counts for the rounding of each
_ENTRY = 1e-3
#: steps after which no more is expected
_STEPS = 30
#: part of a correction, beyond the basis, below which it is rounding
_NEW = 1e-7
#: more undamped modes than wanted, as a part and at least; and how far beyond a band
_MORE, _LEAST, _BEYOND = 4, 8, 1.3


def wider(count: int, top: float, n: int) -> tuple[int, float]:
    """Return how many undamped modes, and up to which omega^2, make a basis of complex ones."""
    return min(n, count + max(count // _MORE, _LEAST)), top * _BEYOND**2


def damped_modes(
    model: FEModel,
    phi: FloatArray,
    count: int,
    top: float,
    method: Pardiso | Cholmod | None,
) -> Modes:
    """Return the complex modes of a large model, by a basis that grows until they are right.

    Rayleigh-Ritz in real vectors V: the undamped modes, the static responses to the forces of
    dampers, and ``(K - sigma M)^-1`` times what the complex modes leave in ``(lambda^2 M + lambda D
    + K) x = 0``, again and again (Davidson's method for the quadratic problem), until they leave no
    more than undamped modes may [Sleijpen1996]_.
    """
    factor, r = stiffness_factor(model, method), model.rigid_body.shape[1]
    V = np.hstack([phi, beyond(model.M, phi, factor.solve(damper_forces(model)))])
    for _ in range(_STEPS):
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
                    certificate={"basis": V.shape[1]},
                ),
                top,
            )
        step = factor.solve(np.hstack([rest[:, wrong].real, rest[:, wrong].imag]))
        more = beyond(by_rows(model.M), V, step, dependent=_NEW)
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
    M, D, K = (_projected(part, V) for part in (model.M, model.D, model.K))
    K[:r], K[:, :r] = 0.0, 0.0  # rounding of stiff shapes would hold rigid-body motions
    rigid = np.eye(V.shape[1], r)
    body = V.T @ np.asarray(model.M @ model.body_motions) if model.n_unstable else rigid
    form = normal_form(M, D, K, rigid, lambda: body, lowest=max(count - r, 0))
    return form, np.flatnonzero(signed_square(form.omega) <= top)[:count]


def _projected(matrix: Any, V: FloatArray) -> FloatArray:
    product = V.T @ np.asarray(matrix @ V)
    return np.asarray(0.5 * (product + product.T))


def leaving_overdamped(form: NormalForm, modes: Modes, top: float = np.inf) -> Modes:
    """Return modes up to omega^2 with a note of the real poles there, which are warned of."""
    note = form.overdamped_below(_range(modes.poles, top))
    if not note:
        return modes
    warn(note)
    return modes.replace(notes=(*modes.notes, note))


def _range(poles: ComplexArray, top: float) -> float:
    """Return up to which rate [1/s] poles are wanted: omega^2, or as far as these reach."""
    return float(np.sqrt(top) if np.isfinite(top) else np.abs(poles).max(initial=0.0))


def _growing(form: NormalForm, shapes: Any, keep: np.ndarray) -> Any:
    """Return shapes, those of unstable modes of the growing pole."""
    unstable = form.omega[keep] < 0
    return np.where(unstable, shapes.real + shapes.imag, shapes) if unstable.any() else shapes


def _rest(
    model: FEModel, poles: ComplexArray, x: Any, n_rigid: int
) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return what modes leave in the eigenvalue problem (n, k), its size and its limit (k,)."""
    K, M, D = by_rows(model.K), by_rows(model.M), by_rows(model.D)
    inertia = (M @ x) * poles**2
    rest = inertia + (D @ x) * poles + K @ x
    stiff = diagonal(model.K)
    weight = 1 / np.sqrt(np.where(stiff > 0, stiff, stiff.max(initial=0.0) or 1.0))[:, None]
    size = np.linalg.norm(weight * rest, axis=0)
    # an entry of a shape is known to a rounding of its largest ones, as in undamped modes
    moved = np.abs(x)
    moved = moved + _ENTRY * moved.max(axis=0)
    whole = Absolute(K) @ moved + np.abs(poles) * (Absolute(D) @ moved)
    limit = _RESIDUAL[0] * np.linalg.norm(weight * inertia, axis=0)
    # real poles are not among what is returned: their place suffices
    part = np.where(poles.imag == 0, _RESIDUAL[0], _RESIDUAL[1])
    limit = limit + part * np.linalg.norm(weight * whole, axis=0)
    size[:n_rigid] = 0.0  # at zero by convention: checked as undamped modes
    return np.asarray(rest), np.asarray(size), np.asarray(limit)


#: DOFs at which dampers act, at most, and their forces, at most: more of them are a material's
_TOUCHED, _FORCES = 600, 200
#: relative: a damper below this is none
_NONE = 1e-12


def damper_forces(model: FEModel) -> FloatArray:
    """Return orthonormal forces (n, m) that span those of dampers."""
    # none where D is a multiple of K and M, or at so many DOFs that it is a material's
    none = np.zeros((model.n_dof, 0))
    if model.D is None or is_rayleigh(model):
        return none
    rows = sp.csr_array(model.D)
    touched = np.flatnonzero(np.diff(rows.indptr))
    if touched.size > _TOUCHED:
        return none
    values, vectors = la.eigh(rows[touched][:, touched].toarray())
    kept = np.flatnonzero(values > _NONE * values.max(initial=0.0))
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
