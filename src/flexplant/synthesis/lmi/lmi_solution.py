"""What follows from a solution of the projected LMIs: a bound on gamma, and a controller."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray
from ...errors import FlexplantError, InfeasibleError, ModelError, SolverError
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...lti.preparation import Prepared
from ...lti.riccati import control_care, solve_care
from ...lti.statespace import StateSpace
from ...tolerances import RANK, TINY, divisor
from ..controller import SolvedController

#: what a closed loop may exceed its target by
_EXCESS = 1e-3

#: A, B, C, D of a controller
Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def dual_bound(p: Plant, U: FloatArray, V: FloatArray, X: FloatArray, Y: FloatArray) -> float:
    """Return a lower bound of gamma by weak duality, from the multipliers of the first two LMIs."""
    # the third is chosen so that the dual equations hold; what is indefinite is paid for by traces
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


#: multiples of the back-off that are tried in turn
LOOSER = np.array([1.0, 2.0, 4.0, 8.0])
#: gamma, relative to the plant's size, that is taken for zero
NOTHING = 1e-7
#: failures that a message lists
_LISTED = 4


class Candidate(NamedTuple):
    """A controller that may keep a target: its name in messages, and how it is computed."""

    name: str
    target: float
    compute: Callable[[], Matrices]


def check_size(method: Any, problem: Prepared) -> None:
    """Raise ModelError when a problem has no states, or more than a method's max_states."""
    n, name = problem.A.shape[0], type(method).__name__
    if not n:
        raise ModelError(f"{name} needs states, got a static plant. Use Riccati().")
    if n > method.max_states:
        raise ModelError(
            f"{name} takes plants of 1 to {method.max_states} states, got {n}: time grows as n^6. "
            f"Reduce the order first, use Riccati(), or raise {name}(max_states=...)."
        )


def check_cost(gamma: float, size: float) -> None:
    """Raise InfeasibleError when gamma is nothing beside the size of the plant."""
    if gamma < NOTHING * size:
        raise InfeasibleError(
            f"there is no smallest gamma: the infimum is 0. {gamma:.3g} is reached, where the "
            f"plant's own size is {size:.3g}. u cancels w in z, at no cost. Weight the efforts in "
            "z, or give the sensors noise in w."
        )


def first_verified(
    problem: Prepared,
    gamma: float,
    lower: float,
    candidates: Iterable[Candidate],
) -> SolvedController:
    """Return the first candidate whose closed loop keeps its target."""
    failures = []
    for name, target, compute in candidates:
        try:
            K = compute()
            norm = verified(problem, K, target)
        except (FlexplantError, la.LinAlgError) as error:
            failures.append(f"{name}: {error}")
            continue
        return SolvedController(*K, norm, min(lower, norm), {})
    raise SolverError(
        f"the LMIs give gamma = {gamma:.6g} as smallest, but no controller. "
        + " ".join(failures[-_LISTED:])
        + " Loosen weights, raise back_off, or use Riccati(), which adds a little noise and effort "
        "where sensors and actuators have none."
    )


class Plant(NamedTuple):
    """The eight matrices of ``[w; u] -> [z; y]``, D22 = 0."""

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    C2: FloatArray
    D11: FloatArray
    D12: FloatArray
    D21: FloatArray
    #: its u is u_size times that of the problem, its y that of the problem over y_size
    u_size: FloatArray
    y_size: FloatArray
    #: unit of its frequency, in that of the problem
    speed: float = 1.0

    @classmethod
    def of(cls, p: Prepared) -> Plant:
        """Return the plant of a prepared problem."""
        matrices = (p.A, p.B1, p.B2, p.C1, p.C2, p.D11, p.D12, p.D21)
        return cls(*matrices, np.ones(p.B2.shape[1]), np.ones(p.C2.shape[0])).with_unit_channels()

    def with_unit_channels(self) -> Plant:
        """Return the plant with u and y in units that make columns [B2; D12], rows [C2, D21] one.

        What is not seen of noise or effort has no unit of its own.
        """
        u_size = np.linalg.norm(np.vstack([self.B2, self.D12]), axis=0)
        y_size = np.linalg.norm(np.hstack([self.C2, self.D21]), axis=1)
        u_size, y_size = (divisor(size) for size in (u_size, y_size))
        return self._replace(
            B2=self.B2 / u_size,
            D12=self.D12 / u_size,
            C2=self.C2 / y_size[:, None],
            D21=self.D21 / y_size[:, None],
            u_size=self.u_size * u_size,
            y_size=self.y_size * y_size,
        )

    def timed(self, speed: float) -> Plant:
        """Return the plant in a unit of frequency larger by speed; norms stay."""
        root = np.sqrt(speed)
        return self._replace(
            A=self.A / speed,
            B1=self.B1 / root,
            B2=self.B2 / root,
            C1=self.C1 / root,
            C2=self.C2 / root,
            speed=self.speed * speed,
        )

    def scaled(self, gamma: float) -> Plant:
        """Return the plant whose norms w -> z are divided by gamma."""
        root = np.sqrt(gamma)
        return self._replace(
            B1=self.B1 / root,
            C1=self.C1 / root,
            D11=self.D11 / gamma,
            D12=self.D12 / root,
            D21=self.D21 / root,
        )

    def balanced(self, X: FloatArray, Y: FloatArray) -> Plant:
        """Return the plant in states where X (of x' X x) and Y (of its dual) are equal, diagonal.

        Moore's balancing, of the LMIs' matrices instead of Gramians.
        """
        Lx, Ly = factor(X), factor(Y)
        left, values, right = la.svd(Lx.T @ Ly)
        # directions that are uncontrollable or unobservable but for rounding
        root = np.sqrt(np.maximum(values, 1e-12 * values[0]))
        T, back = (left / root).T @ Lx.T, Ly @ right.T / root
        return self._replace(
            A=T @ self.A @ back,
            B1=T @ self.B1,
            B2=T @ self.B2,
            C1=self.C1 @ back,
            C2=self.C2 @ back,
        )

    def size(self) -> float:
        """Return a gamma of the plant's own size: its open gain beside its unit of frequency."""
        shifted = (1.3 + 0.7j) * np.eye(self.A.shape[0]) - self.A
        gain = float(np.linalg.norm(self.C1 @ np.linalg.solve(shifted, self.B1) + self.D11, 2))
        bound = float(np.linalg.norm(self.C1) * np.linalg.norm(self.B1))
        return max(gain, 1e-3 * bound) or 1.0


def same_states(p: Plant) -> Plant:
    """Return the plant as it is."""
    return p


def lqg_states(p: Plant) -> Plant:
    """Return the plant in LQG-balanced states, in the unit of frequency of the LQG loop."""
    # the Riccati solutions stand in for X and Y
    n, nu, ny = p.A.shape[0], p.B2.shape[1], p.C2.shape[0]
    # a little of everything: no rank of D12, D21 or observability of z is assumed
    Q, W = p.C1.T @ p.C1, p.B1 @ p.B1.T
    Q = Q + 1e-8 * np.linalg.norm(Q) * np.eye(n)
    W = W + 1e-8 * np.linalg.norm(W) * np.eye(n)
    try:
        control = control_care(p.A, p.B2, Q=Q, R=p.D12.T @ p.D12 + 0.1 * np.eye(nu))
        filtered = solve_care(p.A, p.C2, Q=W, R=p.D21 @ p.D21.T + 0.1 * np.eye(ny))
    except (SolverError, la.LinAlgError) as error:
        raise SolverError("rounding hides every stabilising controller.") from error
    sizes = np.abs(np.concatenate([control.poles, filtered.poles]))
    speed = float(np.exp(np.mean(np.log(np.maximum(sizes, TINY)))))
    return p.balanced(control.P, filtered.P).timed(speed)


def factor(P: FloatArray) -> FloatArray:
    """Return L with ``L L' = P``, P kept barely positive definite."""
    values, vectors = la.eigh(half(P))
    return np.asarray(vectors * np.sqrt(np.maximum(values, RANK * max(values[-1], TINY))))


def half(M: Any) -> Any:
    """Return the symmetric part."""
    return 0.5 * (M + M.T)
