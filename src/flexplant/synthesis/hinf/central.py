"""The formulas of Glover and Doyle: central controllers from two Riccati equations.

They are for prepared problems, D12 = [0; I] and D21 = [0, I].
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray
from ...errors import AssumptionError
from ...lti.equations import OnAxisError, stabilising
from ...lti.preparation import Prepared
from ...lti.statespace import StateSpace
from ...tolerances import ROUNDING, SPLIT

#: sensitivity at infinite frequency below which a controller is taken for one of infinite gain
_SINGULAR = 1e-3


def riccati_solutions(
    p: Prepared, gamma: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return X, F, Y, H of Glover and Doyle's two Riccati equations."""
    m1, m2, p1, p2 = p.B1.shape[1], p.B2.shape[1], p.C1.shape[0], p.C2.shape[0]
    B, C = np.hstack([p.B1, p.B2]), np.vstack([p.C1, p.C2])
    row, column = np.hstack([p.D11, p.D12]), np.vstack([p.D11, p.D21])
    R = row.T @ row - la.block_diag(gamma**2 * np.eye(m1), np.zeros((m2, m2)))
    Rt = column @ column.T - la.block_diag(gamma**2 * np.eye(p1), np.zeros((p2, p2)))
    X, F = stabilising(p.A, B, p.C1.T @ p.C1, R, p.C1.T @ row)
    Y, Ht = stabilising(p.A.T, C.T, p.B1 @ p.B1.T, Rt, p.B1 @ column.T)
    return X, F, Y, Ht.T


def central(
    p: Prepared, gamma: float, X: FloatArray, F: FloatArray, Y: FloatArray, H: FloatArray
) -> StateSpace:
    """Return a controller of Glover and Doyle for ||w -> z|| < gamma: central unless D22 forbids.

    Their normalisation is D12 = [0; I], D21 = [0, I]; D11 is partitioned accordingly. All
    controllers are F_l(K, Q) with ||Q|| < gamma, the central one has Q = 0. It may need infinite
    gain once D22 is put back (where D12 and D21 are square it makes the sensitivity zero at
    infinite frequency); then Q is a constant that keeps I + D22 K away from singular.
    """
    m1, m2, p1, p2 = p.B1.shape[1], p.B2.shape[1], p.C1.shape[0], p.C2.shape[0]
    B = np.hstack([p.B1, p.B2])
    F12, F2 = F[m1 - p2 : m1], F[m1:]
    H12, H2 = H[:, p1 - m2 : p1], H[:, p1:]
    D11, D12 = p.D11[: p1 - m2, : m1 - p2], p.D11[: p1 - m2, m1 - p2 :]
    D21, D22 = p.D11[p1 - m2 :, : m1 - p2], p.D11[p1 - m2 :, m1 - p2 :]
    inner = np.linalg.solve(gamma**2 * np.eye(p1 - m2) - D11 @ D11.T, D12)
    outer = np.linalg.solve(gamma**2 * np.eye(m1 - p2) - D11.T @ D11, D21.T)
    Dk = -D21 @ D11.T @ inner - D22
    Dk12 = la.cholesky(np.eye(m2) - D21 @ outer, lower=True)
    Dk21 = la.cholesky(np.eye(p2) - D12.T @ inner)
    Z = np.linalg.inv(np.eye(p.A.shape[0]) - Y @ X / gamma**2)
    C2k = -Dk21 @ (p.C2 + F12)
    B2k = Z @ (p.B2 + H12) @ Dk12
    Q = gamma * _contraction(np.eye(p2) + p.D22 @ Dk, p.D22 @ Dk12, Dk21)
    B1k = -Z @ H2 + Z @ (p.B2 + H12) @ Dk
    C1k = F2 + Dk @ np.linalg.solve(Dk21, C2k)
    Ak = p.A + B @ F + B1k @ np.linalg.solve(Dk21, C2k)
    return StateSpace(
        Ak + B2k @ Q @ C2k,
        B1k + B2k @ Q @ Dk21,
        C1k + Dk12 @ Q @ C2k,
        Dk + Dk12 @ Q @ Dk21,
        inputs=p.y,
        outputs=p.u,
    )


def _contraction(M: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Return Q, zero or of norm 1/2, that lifts the small singular values of M + left Q right."""
    U, sizes, Vt = la.svd(M)
    small = sizes < _SINGULAR
    pull = left.T @ U[:, small] @ Vt[small] @ right.T
    W, gains, Xt = la.svd(pull, full_matrices=False)
    reached = gains > ROUNDING * np.max(gains, initial=0.0)
    return np.asarray(0.5 * W[:, reached] @ Xt[reached])


def require_shown(p: Prepared) -> None:
    """Raise AssumptionError when z or w misses an undamped mode, whatever D12 and D21 are."""
    try:
        _require_full_columns(p.A, p.B2, p.C1, p.D12)
    except OnAxisError as found:
        raise _missed_by_z(p, found) from found
    try:
        _require_full_columns(p.A.T, p.C2.T, p.B1.T, p.D21.T)
    except OnAxisError as found:
        raise _missed_by_w(p, found) from found


def h2_controller(p: Prepared) -> StateSpace:
    """Return the controller of least H2 norm, feedthrough apart (gamma without bound)."""
    rows, columns = p.B2.shape[1], p.C2.shape[0]
    require_shown(p)
    try:
        _, F = stabilising(p.A, p.B2, p.C1.T @ p.C1, np.eye(rows), p.C1.T @ p.D12)
    except OnAxisError as found:
        raise _missed_by_z(p, found) from found
    try:
        _, Ht = stabilising(p.A.T, p.C2.T, p.B1 @ p.B1.T, np.eye(columns), p.B1 @ p.D21.T)
    except OnAxisError as found:
        raise _missed_by_w(p, found) from found
    H = Ht.T
    return StateSpace(
        p.A + p.B2 @ F + H @ p.C2,
        -H,
        F,
        np.zeros((rows, columns)),
        inputs=p.y,
        outputs=p.u,
    )


def _missed_by_z(p: Prepared, found: OnAxisError) -> AssumptionError:
    return AssumptionError(
        f"z does not feel all that u moves at {_axis_freq(p, found)}: an undamped (rigid-body or "
        "integrating) mode there is left out of z, or u -> z (a weight) has a zero there. Keep "
        "that motion in z with a weight of finite gain, or give it damping."
    )


def _missed_by_w(p: Prepared, found: OnAxisError) -> AssumptionError:
    return AssumptionError(
        f"w does not excite all that y sees at {_axis_freq(p, found)}: an undamped (rigid-body or "
        "integrating) mode there has no disturbance, or w -> y (a weight) has a zero there. "
        "Add a disturbance that reaches it, or give it damping."
    )


def _require_full_columns(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> None:
    """Raise OnAxisError when [A - s I, B; C, D] loses rank at an undamped pole s of A."""
    # of the Hamiltonian four eigenvalues meet at a rigid-body mode, spread by rounding over 1e-4
    poles = np.linalg.eigvals(A)
    size = float(np.linalg.norm(A, 2)) if A.size else 0.0
    near = poles[np.abs(poles.real) <= SPLIT * size]
    for omega in np.unique(np.where(np.abs(near) < SPLIT * size, 0.0, np.abs(near.imag))):
        pencil = np.block([[A - 1j * omega * np.eye(A.shape[0]), B], [C, D]])
        if la.svdvals(pencil)[-1] < ROUNDING * size:
            raise OnAxisError(np.array([omega]))


def _axis_freq(p: Prepared, found: OnAxisError) -> str:
    omega = float(np.min(found.omega))
    # a double pole at zero comes out of rounding beside it
    return f"{p.frequency(omega if omega > 1e-6 else 0.0):.3g} Hz"


def is_indefinite(X: FloatArray, size: float) -> bool:
    """Return whether X has a negative eigenvalue beyond rounding; size is what X comes from."""
    values = la.eigvalsh(X) if X.size else np.zeros(1)
    # an accurate X to 1e-6 of its size (the residual), and beyond what its equation rounds
    return bool(values[0] < -1e-5 * max(values[-1], -values[0]) and values[0] < -1e-9 * size)
