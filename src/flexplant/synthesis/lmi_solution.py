"""What follows from a solution of the projected LMIs: a bound on gamma, and a controller."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..lti.interconnection import lft
from ..lti.norms import peak_gain
from ..lti.preparation import Prepared
from ..lti.statespace import StateSpace
from ..values import FloatArray
from .lmi_plant import Plant, factor, half

#: what a closed loop may exceed its target by
_EXCESS = 1e-3

#: A, B, C, D of a controller
Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def dual_bound(p: Plant, U: FloatArray, V: FloatArray, X: FloatArray, Y: FloatArray) -> float:
    """Return a lower bound of gamma by weak duality, from the multipliers of the first two LMIs.

    The third multiplier is chosen here, so that the dual equations hold exactly; what of it is
    not positive semidefinite is paid for with the traces of X and Y.
    """
    n, nw, nz = p.A.shape[0], p.B1.shape[1], p.C1.shape[0]
    U, V = _positive_part(U)[0], _positive_part(V)[0]
    total = np.trace(U[n:, n:]) + np.trace(V[n:, n:])
    if not total > 0:
        return 0.0
    U, V = U / total, V / total
    of_Y = 2 * half(U[:n, :n] @ p.A + U[:n, n : n + nz] @ p.C1)
    of_X = 2 * half(p.A @ V[:n, :n] + p.B1 @ V[n : n + nw, :n])
    (of_Y, less_Y), (of_X, less_X) = _positive_part(of_Y), _positive_part(of_X)
    fixed = (
        np.sum(p.B1 * U[:n, n + nz :])
        + np.sum(p.D11 * U[n : n + nz, n + nz :])
        + np.sum(p.C1.T * V[:n, n + nw :])
        + np.sum(p.D11.T * V[n : n + nw, n + nw :])
    )
    coupling = np.sum(la.svdvals(factor(of_Y).T @ factor(of_X)))
    paid = less_Y * np.trace(Y) + less_X * np.trace(X)
    return max(float(2 * fixed + 2 * coupling - paid), 0.0)


def _positive_part(M: FloatArray) -> tuple[FloatArray, float]:
    values, vectors = la.eigh(half(M))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, max(0.0, -float(values[0]))


def reconstructed(
    p: Plant,
    gamma: float,
    X: FloatArray,
    Y: FloatArray,
    B: FloatArray,
    C: FloatArray,
    D: FloatArray,
) -> Matrices:
    """Return the controller from the changed variables."""
    nw, nz = p.B1.shape[1], p.C1.shape[0]
    Bw, Cz = p.B1 + p.B2 @ D @ p.D21, p.C1 + p.D12 @ D @ p.C2
    Dzw = p.D11 + p.D12 @ D @ p.D21
    inner = np.block([[gamma * np.eye(nw), -Dzw.T], [-Dzw, gamma * np.eye(nz)]])
    of_Y = np.hstack([Bw, (p.C1 @ Y + p.D12 @ C).T])
    of_X = np.hstack([X @ p.B1 + B @ p.D21, Cz.T])
    A = p.A + p.B2 @ D @ p.C2
    # the off-diagonal block of Schur's complement is made zero
    A_hat = -A.T - of_X @ np.linalg.solve(inner, of_Y.T)
    return changed_back(p, X, Y, (A_hat, B, C, D))


def changed_back(p: Plant, X: FloatArray, Y: FloatArray, changed: Matrices) -> Matrices:
    """Return the controller of changed variables in the plant's units, with ``N M' = I - X Y``."""
    A, B, C, D = changed
    left, values, right = la.svd(np.eye(len(X)) - X @ Y)
    N, M = left * np.sqrt(values), right.T * np.sqrt(values)
    C, B = C - D @ p.C2 @ Y, B - X @ p.B2 @ D
    A = A - X @ (p.A + p.B2 @ D @ p.C2) @ Y - X @ p.B2 @ C - B @ p.C2 @ Y
    A, B, C = la.solve(N, la.solve(M, A.T).T), la.solve(N, B), la.solve(M, C.T).T
    root, u_size = np.sqrt(p.speed), p.u_size[:, None]
    return p.speed * A, root * B / p.y_size, root * C / u_size, D / p.y_size / u_size


def verified(problem: Prepared, K: Matrices, target: float) -> float:
    """Return the norm of the closed loop of a controller, computed anew."""
    A, B, C, D = K
    loop = lft(problem.system, StateSpace(A, B, C, D, inputs=problem.y, outputs=problem.u))
    if not loop.is_stable:
        raise SolverError(
            f"its closed loop is unstable (largest real part {np.max(loop.poles().real):.3g})."
        )
    norm, _ = peak_gain(loop)
    if not norm <= target * (1.0 + _EXCESS):
        raise SolverError(f"its closed loop has the norm {norm:.6g}, not {target:.6g}.")
    return norm
