"""H-infinity synthesis by two Riccati equations, accepted by the closed loop's norm only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg as la

from ..errors import AssumptionError, FlexplantError, InfeasibleError
from ..lti.interconnection import lft
from ..lti.norms import peak_gain
from ..lti.preparation import Prepared
from ..lti.statespace import StateSpace
from ..values import FloatArray, Value, positive

if TYPE_CHECKING:
    from .hinf import Solved

#: steps of the search for a feasible gamma, and of the bisection after it
_GROWTH, _BISECTION = 30, 40


@dataclass(frozen=True, eq=False)
class Riccati(Value):
    """Synthesis by the two Riccati equations of Glover and Doyle, gamma by bounded bisection.

    A gamma counts as reached only when the closed loop that it gives is stable and has a norm
    below it, computed anew. The controller is then taken back_off above the smallest one: at the
    optimum it is fast and badly conditioned, and gains nothing.

    Parameters
    ----------
    back_off : float
        Relative distance from the smallest gamma found.
    tolerance : float
        Relative width at which the bisection stops.

    Raises
    ------
    ModelError
        When a value is not positive.
    """

    back_off: float = 0.05
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        self._set(
            back_off=positive(self.back_off, "back_off", zero=True),
            tolerance=positive(self.tolerance, "tolerance"),
        )

    def solve(self, problem: Prepared) -> Solved:
        """Return the controller of a prepared problem.

        Raises
        ------
        AssumptionError
            When D12 or D21 has not full rank.
        InfeasibleError
            When no gamma up to a very large one is reached.
        """
        from .hinf import Solved

        _require_full_rank(problem)
        scale = _open_size(problem)
        high, best = self._reachable(problem, scale)
        low = _direct_bound(problem)
        low = min(low, high)
        for _ in range(_BISECTION):
            if high <= low * (1.0 + self.tolerance) or high < 1e-9 * scale:
                break
            middle = np.sqrt(max(low, 1e-3 * high) * high)
            attempt = _attempt(problem, middle)
            if attempt is None:
                low = middle
            else:
                high, best = min(middle, attempt[1]), attempt
        backed_off = _attempt(problem, high * (1.0 + self.back_off))
        controller, norm = best if backed_off is None else backed_off
        return Solved(controller.A, controller.B, controller.C, controller.D, norm, float(low))

    def _reachable(self, problem: Prepared, start: float) -> tuple[float, tuple[StateSpace, float]]:
        """Return a gamma that is reached, growing it from the size of the open plant."""
        gamma = start
        for _ in range(_GROWTH):
            attempt = _attempt(problem, gamma)
            if attempt is not None:
                return min(gamma, attempt[1]), attempt
            gamma *= 4.0
        raise InfeasibleError(
            f"no stabilising controller with a norm below {gamma:.3g} was found. Check that u "
            "reaches and y sees every unstable mode, and that no weight has a pole on the axis."
        )


def _require_full_rank(problem: Prepared) -> None:
    for name, matrix, short, names in (
        ("D12", problem.D12, "costs nothing in z at high frequencies", problem.u),
        ("D21", problem.D21.T, "is free of noise in w at high frequencies", problem.y),
    ):
        needed = matrix.shape[1]
        rank = int(np.linalg.matrix_rank(matrix, tol=1e-8)) if matrix.size else 0
        if rank < needed:
            raise AssumptionError(
                f"{name} has rank {rank}, {needed} are needed: a combination of {', '.join(names)} "
                f"{short}. Weight the efforts in z (or give each sensor noise in w), or use Lmi()."
            )


def _open_size(problem: Prepared) -> float:
    """Return a gamma to begin with: the size of the problem's gains at its own speed."""
    gain = problem.system.evaluated(1j)
    m1, p1 = problem.B1.shape[1], problem.C1.shape[0]
    return max(float(np.linalg.norm(gain[:p1, :m1], 2)), 1.0)


def _direct_bound(problem: Prepared) -> float:
    """Return the bound that the feedthrough alone puts on gamma (Glover and Doyle, (i))."""
    D, m2, p2 = problem.D11, problem.B2.shape[1], problem.C2.shape[0]
    rows, columns = D.shape[0] - m2, D.shape[1] - p2
    parts = (D[:rows], D[:, :columns])
    sizes = [float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in parts]
    return max(sizes)


def _attempt(problem: Prepared, gamma: float) -> tuple[StateSpace, float] | None:
    """Return the central controller for gamma and its true norm, or None when not reached."""
    try:
        controller = _central(problem, gamma)
        loop = lft(problem.system, controller)
        if not loop.is_stable:
            return None
        norm, _ = peak_gain(loop)
    except (FlexplantError, la.LinAlgError, ValueError):
        return None
    return (controller, norm) if norm <= gamma * (1.0 + 1e-6) else None


def _central(p: Prepared, gamma: float) -> StateSpace:
    """Return the central controller of Glover and Doyle for ||w -> z|| < gamma.

    Their normalisation is D12 = [0; I], D21 = [0, I]; D11 is partitioned accordingly.

    Raises
    ------
    InfeasibleError, LinAlgError
        When gamma is so small that a Riccati equation or a factor does not exist. Their further
        conditions (X, Y >= 0, rho(X Y) < gamma^2) are left to the closed loop, which is stable
        with a norm below gamma only when they hold.
    """
    m1, m2, p1, p2 = p.B1.shape[1], p.B2.shape[1], p.C1.shape[0], p.C2.shape[0]
    B, C = np.hstack([p.B1, p.B2]), np.vstack([p.C1, p.C2])
    row, column = np.hstack([p.D11, p.D12]), np.vstack([p.D11, p.D21])
    R = row.T @ row - la.block_diag(gamma**2 * np.eye(m1), np.zeros((m2, m2)))
    Rt = column @ column.T - la.block_diag(gamma**2 * np.eye(p1), np.zeros((p2, p2)))
    X, F = _stabilising(p.A, B, p.C1.T @ p.C1, R, p.C1.T @ row)
    Y, Ht = _stabilising(p.A.T, C.T, p.B1 @ p.B1.T, Rt, p.B1 @ column.T)
    H = Ht.T
    F12, F2 = F[m1 - p2 : m1], F[m1:]
    H12, H2 = H[:, p1 - m2 : p1], H[:, p1:]
    D11, D12 = p.D11[: p1 - m2, : m1 - p2], p.D11[: p1 - m2, m1 - p2 :]
    D21, D22 = p.D11[p1 - m2 :, : m1 - p2], p.D11[p1 - m2 :, m1 - p2 :]
    inner = np.linalg.solve(gamma**2 * np.eye(p1 - m2) - D11 @ D11.T, D12)
    Dk = -D21 @ D11.T @ inner - D22
    Dk21 = la.cholesky(np.eye(p2) - D12.T @ inner)
    Z = np.linalg.inv(np.eye(p.A.shape[0]) - Y @ X / gamma**2)
    C2k = -Dk21 @ (p.C2 + F12)
    B1k = -Z @ H2 + Z @ (p.B2 + H12) @ Dk
    C1k = F2 + Dk @ np.linalg.solve(Dk21, C2k)
    Ak = p.A + B @ F + B1k @ np.linalg.solve(Dk21, C2k)
    return StateSpace(Ak, B1k, C1k, Dk, inputs=p.y, outputs=p.u)


def _stabilising(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return X and F of ``A'X + X A - (X B + S) R^-1 (B'X + S') + Q = 0``, A + B F stable.

    R is indefinite. By the stable invariant subspace of the Hamiltonian: unlike doubling it does
    not need X to be reached from zero, which an indefinite R does not promise. Accuracy is not
    judged here but by the closed loop.
    """
    n = A.shape[0]
    inner = np.linalg.solve(R, np.hstack([B.T, S.T]))
    BR, SR = inner[:, :n], inner[:, n:]
    drift = A - B @ SR
    hamiltonian = np.block([[drift, -B @ BR], [-(Q - S @ SR), -drift.T]])
    balanced, (scale, _) = la.matrix_balance(hamiltonian, permute=False, separate=True)
    _, vectors, count = la.schur(balanced, sort="lhp")
    if count != n:
        raise InfeasibleError(f"the Hamiltonian has {count} stable eigenvalues, {n} are needed.")
    basis = vectors[:, :n] * scale[:, None]
    top, bottom = basis[:n], basis[n:]
    X = np.linalg.solve(top.T, bottom.T).T
    X = 0.5 * (X + X.T)
    return X, -(BR @ X + SR)
