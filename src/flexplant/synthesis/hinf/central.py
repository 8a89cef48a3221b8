"""The formulas of Glover and Doyle: central controllers from two Riccati equations.

They are for prepared problems, D12 = [0; I] and D21 = [0, I].
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray
from ...errors import AssumptionError, SolverError
from ...lti.lyapunov import solve_continuous
from ...lti.preparation import Prepared
from ...lti.scaling import state_scale
from ...lti.statespace import StateSpace

#: relative: what counts as on the imaginary axis; the largest residual of a Riccati equation
_AXIS, _RESIDUAL = 1e-10, 1e-6
#: residuals that are examined: Newton's correction between them squares the error
_CORRECTIONS = 4
#: relative: a difference of the costs of z that is rounding
_CANCELLED = 1e-12
#: sensitivity at infinite frequency below which a controller is taken for one of infinite gain
_SINGULAR = 1e-3


class OnAxisError(Exception):
    """A Hamiltonian has eigenvalues on the imaginary axis."""

    def __init__(self, omega: FloatArray) -> None:
        super().__init__(f"eigenvalues at {omega} rad/s")
        self.omega = omega


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
    reached = gains > 1e-12 * np.max(gains, initial=0.0)
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


def quadratic(p: Prepared) -> StateSpace:
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
        f"z does not feel all that u moves at {_listed(p, found)}: an undamped (rigid-body or "
        "integrating) mode there is left out of z, or u -> z (a weight) has a zero there. Keep "
        "that motion in z with a weight of finite gain, or give it damping."
    )


def _missed_by_w(p: Prepared, found: OnAxisError) -> AssumptionError:
    return AssumptionError(
        f"w does not excite all that y sees at {_listed(p, found)}: an undamped (rigid-body or "
        "integrating) mode there has no disturbance, or w -> y (a weight) has a zero there. "
        "Add a disturbance that reaches it, or give it damping."
    )


def _correction(closed: FloatArray, residual: FloatArray, d: FloatArray) -> FloatArray:
    """Return Newton's correction: what rounding of the invariant subspace left, in states x / d."""
    try:
        found = solve_continuous(closed * d[:, None] / d, residual * d * d[:, None])
    except SolverError as error:
        raise la.LinAlgError("the solution found does not stabilise.") from error
    return np.asarray(found / d / d[:, None])


def _require_full_columns(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> None:
    """Raise OnAxisError when [A - s I, B; C, D] loses rank at an undamped pole s of A.

    The Hamiltonian would show it, but four of its eigenvalues meet at a rigid-body mode that costs
    nothing, and rounding spreads them over 1e-4.
    """
    poles = np.linalg.eigvals(A)
    size = float(np.linalg.norm(A, 2)) if A.size else 0.0
    near = poles[np.abs(poles.real) <= 1e-6 * size]
    for omega in np.unique(np.where(np.abs(near) < 1e-6 * size, 0.0, np.abs(near.imag))):
        pencil = np.block([[A - 1j * omega * np.eye(A.shape[0]), B], [C, D]])
        if la.svdvals(pencil)[-1] < 1e-12 * size:
            raise OnAxisError(np.array([omega]))


def _listed(p: Prepared, found: OnAxisError) -> str:
    omega = float(np.min(found.omega))
    # a double pole at zero comes out of rounding beside it
    return f"{p.frequency(omega if omega > 1e-6 else 0.0):.3g} Hz"


def stabilising(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return X and F of ``A'X + X A - (X B + S) R^-1 (B'X + S') + Q = 0``, A + B F stable.

    R is indefinite. By the stable invariant subspace of the Hamiltonian: unlike doubling it does
    not need X to be reached from zero, which an indefinite R does not guarantee.
    """
    n = A.shape[0]
    inner = np.linalg.solve(R, np.hstack([B.T, S.T]))
    BR, SR = inner[:, :n], inner[:, n:]
    if not n:
        return np.zeros((0, 0)), np.asarray(-SR)
    drift, spread = A - B @ SR, B @ BR
    rest = Q - S @ SR
    # units of the states from A, B and C together, and one of the adjoint states: still Hamiltonian
    d = state_scale(A, B, np.sqrt(np.abs(Q.diagonal()))[None, :])
    scaled = (
        drift * d / d[:, None],
        spread / d / d[:, None],
        rest * d * d[:, None],
        Q * d * d[:, None],
    )
    inner_size, reach, cost, own = (float(np.linalg.norm(part)) for part in scaled)
    if cost <= _CANCELLED * own:  # nothing but rounding: X has the size of drift over spread
        cost = inner_size**2 / reach if reach else 0.0
    unit = float(2.0 ** np.round(0.5 * np.log2(cost / reach))) if cost and reach else 1.0
    scale = np.concatenate([d, unit / d])
    hamiltonian = np.block([[drift, -spread], [-rest, -drift.T]])
    balanced = hamiltonian * scale / scale[:, None]
    triangle, vectors, count = la.schur(balanced, sort="lhp")
    values = la.eigvals(triangle)
    margin = _AXIS * (np.abs(values) + 1e-2 * np.linalg.norm(balanced))
    on_axis = np.abs(values.real) <= margin
    if count != n or np.any(on_axis):
        near = np.argsort(np.abs(values.real))[:2]
        raise OnAxisError(np.unique(np.abs(values.imag[on_axis if np.any(on_axis) else near])))
    basis = vectors[:, :n] * scale[:, None]
    top, bottom = basis[:n], basis[n:]
    X = np.linalg.solve(top.T, bottom.T).T
    X = 0.5 * (X + X.T)
    for _ in range(_CORRECTIONS):
        moved, bent = drift.T @ X, X @ spread @ X
        residual = moved + moved.T - bent + rest
        # Q itself: where it cancels with S R^-1 S' the solution is zero but for rounding
        sizes = (float(np.linalg.norm(term)) for term in (moved, bent, Q))
        if np.linalg.norm(residual) <= _RESIDUAL * sum(sizes):
            break
        X = X + _correction((drift - spread @ X).T, residual, d)
    else:
        raise la.LinAlgError("the stabilising solution is too inaccurate.")
    return X, np.asarray(-(BR @ X + SR))


def indefinite(X: FloatArray, size: float) -> bool:
    """Return whether X has a negative eigenvalue beyond rounding; size is what X comes from."""
    values = la.eigvalsh(X) if X.size else np.zeros(1)
    return bool(values[0] < -1e-5 * max(values[-1], -values[0]) and values[0] < -1e-9 * size)
