"""Residuals, orthonormality and rounding of modes, from products of their own."""

from __future__ import annotations

import numpy as np

from ..errors import SolverError
from ..sparse.factor import by_rows, diagonal
from ..sparse.rayleigh_ritz import Absolute, column_groups
from ..structure import FEModel
from ..structure.negative_stiffness import signed_square
from ..values import FloatArray

#: M-orthonormality that every result must have
_ORTHONORMAL = 1e-12
#: residual ||K phi - omega^2 M phi||, of omega^2 ||M phi|| and of || |K| |phi| ||
_RESIDUAL = (1e-8, 1e-12)
#: the part of the largest entry of a shape that counts for the rounding of each
_ENTRY = 1e-3
_EPS = float(np.finfo(np.float64).eps)


def checked(
    model: FEModel, omega: FloatArray, phi: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Raise SolverError unless shapes are M-orthonormal and fulfil the eigenvalue problem.

    Returned are the error of orthonormality, the residual of each mode, and the relative error of
    its frequency that rounding of K's entries may make.
    """
    gram, size, limit, left, rounding = _measured(model, omega, phi)
    error = float(np.abs(gram - np.eye(omega.size)).max(initial=0.0))
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
                "FEMatrices(K, M, dofs=dofs).model(free=True)."
            )
        raise SolverError(
            f"mode {i + 1} at {omega[i] / (2 * np.pi):.5g} Hz leaves a residual of {size[i]:.2g} "
            f"(limit {limit[i]:.2g}) in the eigenvalue problem: not a mode of this model."
        )
    return error, left, rounding


def _measured(model: FEModel, omega: FloatArray, phi: FloatArray) -> tuple[FloatArray, ...]:
    """Return what `checked` judges, from products of their own.

    They are the lower triangle of ``phi^T M phi``, the weighted residuals and their limits, the
    residuals relative to ``||K phi||``, and the relative errors of the frequencies by rounding.
    """
    M, K = by_rows(model.M), by_rows(model.K)
    size_of_K, stiff = Absolute(K), diagonal(model.K)
    # by stiffness: displacements and rotations compare, and DOFs without inertia weigh no more
    weight = 1 / np.sqrt(np.where(stiff > 0, stiff, stiff.max(initial=0.0) or 1.0))[:, None]
    rows = size_of_K @ np.ones((stiff.size, 1))
    gram = np.eye(omega.size)
    size, limit, left, rounding = np.zeros((4, omega.size))
    elastic = omega != 0
    for at in column_groups(omega.size):
        part = np.ascontiguousarray(phi[:, at])
        mass, force, moved = M @ part, K @ part, np.abs(part)
        gram[at.start :, at] = phi[:, at.start :].T @ mass
        whole = size_of_K @ moved
        rounding[at] = _EPS * np.sum(moved * whole, axis=0)
        # an entry of a shape is known to a rounding of its largest ones, which stiff springs
        # multiply
        whole += rows * (_ENTRY * moved.max(axis=0))
        inertia = np.linalg.norm(weight * mass, axis=0) * omega[at] ** 2
        limit[at] = _RESIDUAL[0] * inertia + _RESIDUAL[1] * np.linalg.norm(weight * whole, axis=0)
        residual = force - mass * signed_square(omega[at])
        size[at] = np.linalg.norm(weight * residual, axis=0)
        scale = np.where(elastic[at], np.linalg.norm(force, axis=0), np.inf)
        left[at] = np.linalg.norm(residual, axis=0) / scale
    rounding[elastic] /= 2 * omega[elastic] ** 2
    rounding[~elastic] = 0.0
    return gram, size, limit, left, rounding


def rigid_residual(model: FEModel) -> float:
    """Return ``||K R||``, in terms of what would be there if nothing cancelled."""
    K, R = by_rows(model.K), model.rigid_body
    whole = np.linalg.norm(abs(K) @ np.abs(R), axis=0)
    return float(np.max(np.linalg.norm(K @ R, axis=0) / np.where(whole > 0, whole, 1.0)))
