"""The semidefinite programs of H-infinity synthesis, and what their solutions are checked by."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ..errors import InfeasibleError, SolverError
from ..lti.preparation import Prepared
from ..lti.riccati import control_care, solve_care
from ..values import FloatArray

#: part of the back-off that goes into X Y >= (1 + ...)^2, away from the singular I - X Y
APART = 0.6
#: weight of the size of the controller's matrices beside the traces of X and Y
MODERATION = 0.1
#: largest violation of an LMI, relative to its largest eigenvalue
VIOLATION = 1e-6
#: settings of Clarabel, tried in turn: its own; without its scaling of the data; regularised more
ATTEMPTS: tuple[dict[str, Any], ...] = (
    {},
    {"equilibrate_enable": False},
    {"static_regularization_constant": 1e-7},
)

#: A, B, C, D of a controller
Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


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
        u_size, y_size = (np.where(size > 0, size, 1.0) for size in (u_size, y_size))
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
        Lx, Ly = _factor(X), _factor(Y)
        left, values, right = la.svd(Lx.T @ Ly)
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


class Optimum(NamedTuple):
    """The smallest gamma and its lower bound, and the plant of that size."""

    value: float
    lower: float
    #: scaled by value and balanced
    plant: Plant
    #: in which it was sought
    scale: float


def same_states(p: Plant) -> Plant:
    """Return the plant as it is."""
    return p


def lqg_states(p: Plant) -> Plant:
    """Return the plant in LQG-balanced states, in the unit of frequency of the LQG loop.

    The Riccati solutions stand in for X and Y.

    Raises
    ------
    SolverError
        When a Riccati equation has no solution.
    """
    n, nu, ny = p.A.shape[0], p.B2.shape[1], p.C2.shape[0]
    # a little of everything: no rank of D12, D21 or observability of z is assumed
    Q, W = p.C1.T @ p.C1, p.B1 @ p.B1.T
    Q = Q + 1e-8 * np.linalg.norm(Q) * np.eye(n)
    W = W + 1e-8 * np.linalg.norm(W) * np.eye(n)
    try:
        control = control_care(p.A, p.B2, Q=Q, R=p.D12.T @ p.D12 + 0.1 * np.eye(nu))
        filtered = solve_care(p.A, p.C2, Q=W, R=p.D21 @ p.D21.T + 0.1 * np.eye(ny))
    except la.LinAlgError as error:
        raise SolverError(f"no LQG design for the choice of states: {error}.") from error
    sizes = np.abs(np.concatenate([control.poles, filtered.poles]))
    speed = float(np.exp(np.mean(np.log(np.maximum(sizes, 1e-300)))))
    return p.balanced(control.P, filtered.P).timed(speed)


def _factor(P: FloatArray) -> FloatArray:
    """Return L with ``L L' = P``, P kept barely positive definite."""
    values, vectors = la.eigh(half(P))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-13 * max(values[-1], 1e-300))))


def _cvxpy() -> Any:
    """Return cvxpy, which takes more than a second to import."""
    import cvxpy

    return cvxpy


def half(M: Any) -> Any:
    """Return the symmetric part."""
    return 0.5 * (M + M.T)


def symmetric_blocks(rows: list[list[Any]]) -> Any:
    """Return the symmetric block matrix (cvxpy) whose upper triangle of blocks is given.

    cvxpy's ``M >> 0`` constrains only the symmetric part of M and says nothing: every LMI is
    made here, where the lower triangle is a mirror and diagonal blocks are symmetrised.
    """
    cp = _cvxpy()
    count = len(rows)
    full = [
        [
            rows[i][j - i] if j > i else half(rows[i][0]) if j == i else rows[j][i - j].T
            for j in range(count)
        ]
        for i in range(count)
    ]
    return cp.bmat(full)


def _null(M: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the null space."""
    _, values, right = la.svd(M)
    rank = int(np.count_nonzero(values > 1e-10 * max(float(values[0]), 1e-300)))
    return np.asarray(right[rank:].T)


def smallest_gamma(p: Plant, scale: float, settings: dict[str, float]) -> Optimum:
    """Return the smallest gamma of the projected LMIs (Gahinet and Apkarian, theorem 4.3)."""
    cp = _cvxpy()
    n, nw, nz = p.A.shape[0], p.B1.shape[1], p.C1.shape[0]
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    gamma = cp.Variable()
    onto_u = la.block_diag(_null(np.hstack([p.B2.T, p.D12.T])), np.eye(nw))
    onto_y = la.block_diag(_null(np.hstack([p.C2, p.D21])), np.eye(nz))
    AY, XA, w, z = p.A @ Y, X @ p.A, -gamma * np.eye(nw), -gamma * np.eye(nz)
    control = symmetric_blocks([[AY + AY.T, Y @ p.C1.T, p.B1], [z, p.D11], [w]])
    observe = symmetric_blocks([[XA + XA.T, X @ p.B1, p.C1.T], [w, p.D11.T], [z]])
    constraints = [
        half(-onto_u.T @ control @ onto_u) >> 0,
        half(-onto_y.T @ observe @ onto_y) >> 0,
        symmetric_blocks([[Y, np.eye(n)], [X]]) >> 0,
    ]
    # the little trace picks one of the many X and Y, and keeps them finite
    size = cp.trace(X) + cp.trace(Y)
    _solve(cp.Problem(cp.Minimize(gamma + 1e-9 * size), constraints), settings)
    value = max(float(gamma.value), 1e-12)
    U = onto_u @ constraints[0].dual_value @ onto_u.T
    V = onto_y @ constraints[1].dual_value @ onto_y.T
    lower = dual_bound(p, U, V, X.value, Y.value)
    return Optimum(
        value * scale,
        lower * scale,
        p.scaled(value).balanced(X.value, Y.value).with_unit_channels(),
        scale,
    )


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
    coupling = np.sum(la.svdvals(_factor(of_Y).T @ _factor(of_X)))
    paid = less_Y * np.trace(Y) + less_X * np.trace(X)
    return max(float(2 * fixed + 2 * coupling - paid), 0.0)


def _positive_part(M: FloatArray) -> tuple[FloatArray, float]:
    values, vectors = la.eigh(half(M))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, max(0.0, -float(values[0]))


def moderate_controller(p: Plant, gamma: float, settings: dict[str, float]) -> Matrices:
    """Return a controller for gamma, moderate X, Y and gains (Scherer, Gahinet, Chilali).

    Their LMI holds for some Â exactly when its two diagonal parts do, which are linear in
    (Y, Ĉ, D) and (X, B̂, D): Schur's complement about the columns of w and z.
    """
    cp = _cvxpy()
    n, nw, nz, nu, ny = *p.A.shape[:1], p.B1.shape[1], p.C1.shape[0], p.B2.shape[1], p.C2.shape[0]
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    B, C, D = cp.Variable((n, ny)), cp.Variable((nu, n)), cp.Variable((nu, ny))
    AY, XA = p.A @ Y + p.B2 @ C, X @ p.A + B @ p.C2
    Bw, Cz = p.B1 + p.B2 @ D @ p.D21, p.C1 + p.D12 @ D @ p.C2
    Dzw = p.D11 + p.D12 @ D @ p.D21
    w, z = -gamma * np.eye(nw), -gamma * np.eye(nz)
    apart = (1.0 + APART * (gamma - 1.0)) * np.eye(n)
    constraints = [
        -symmetric_blocks([[AY + AY.T, Bw, (p.C1 @ Y + p.D12 @ C).T], [w, Dzw.T], [z]]) >> 0,
        -symmetric_blocks([[XA + XA.T, X @ p.B1 + B @ p.D21, Cz.T], [w, Dzw.T], [z]]) >> 0,
        symmetric_blocks([[Y, apart], [X]]) >> 0,
    ]
    gains = cp.norm(B, "fro") + cp.norm(C, "fro") + cp.norm(D, "fro")
    _solve(
        cp.Problem(cp.Minimize(cp.trace(X) + cp.trace(Y) + MODERATION * gains), constraints),
        settings,
    )
    return _reconstructed(p, gamma, X.value, Y.value, B.value, C.value, D.value)


def _reconstructed(
    p: Plant,
    gamma: float,
    X: FloatArray,
    Y: FloatArray,
    B: FloatArray,
    C: FloatArray,
    D: FloatArray,
) -> Matrices:
    """Return the controller from the changed variables, with ``N M' = I - X Y`` by SVD."""
    n, nw, nz = p.A.shape[0], p.B1.shape[1], p.C1.shape[0]
    Bw, Cz = p.B1 + p.B2 @ D @ p.D21, p.C1 + p.D12 @ D @ p.C2
    Dzw = p.D11 + p.D12 @ D @ p.D21
    inner = np.block([[gamma * np.eye(nw), -Dzw.T], [-Dzw, gamma * np.eye(nz)]])
    of_Y = np.hstack([Bw, (p.C1 @ Y + p.D12 @ C).T])
    of_X = np.hstack([X @ p.B1 + B @ p.D21, Cz.T])
    A = p.A + p.B2 @ D @ p.C2
    # the off-diagonal block of Schur's complement is made zero
    A_hat = -A.T - of_X @ np.linalg.solve(inner, of_Y.T)
    left, values, right = la.svd(np.eye(n) - X @ Y)
    N, M = left * np.sqrt(values), right.T * np.sqrt(values)
    CK, BK = C - D @ p.C2 @ Y, B - X @ p.B2 @ D
    AK = A_hat - X @ A @ Y - X @ p.B2 @ CK - BK @ p.C2 @ Y
    root = np.sqrt(p.speed)
    AK, BK, CK = la.solve(N, la.solve(M, AK.T).T), la.solve(N, BK), la.solve(M, CK.T).T
    u_size = p.u_size[:, None]
    return p.speed * AK, root * BK / p.y_size, root * CK / u_size, D / p.y_size / u_size


def _solve(problem: Any, settings: dict[str, float]) -> None:
    """Solve a semidefinite program; its LMIs are checked by their eigenvalues afterwards.

    Where Clarabel stops without an answer, the next of `ATTEMPTS` is made; the last resort is a
    point at which progress became insufficient, which often is one that holds.

    Raises
    ------
    InfeasibleError
        When the solver has a proof that there is no solution.
    SolverError
        When it stopped without a solution, or the solution violates an LMI.
    """
    data, chain, inverse = problem.get_problem_data("CLARABEL", solver_opts={})
    reached: Any = None
    for attempt in ATTEMPTS:
        raw = chain.solve_via_data(problem, data, solver_opts={**settings, **attempt})
        status = str(raw.status)
        how = f"Clarabel: {status} after {raw.iterations} iterations"
        if "PrimalInfeasible" in status:
            raise InfeasibleError(
                f"the LMIs have no solution ({how}). Does u reach and y see every unstable mode?"
            )
        if status in ("Solved", "AlmostSolved"):
            reached = raw
            break
        if status == "InsufficientProgress" and reached is None:
            reached = raw
        if "MaxTime" in status:
            break
    if reached is None:
        raise SolverError(
            f"the LMIs were not solved ({how}, residuals {raw.r_prim:.1e} and {raw.r_dual:.1e}, "
            f"{_order(problem)} states, {len(ATTEMPTS)} settings tried). Does u reach and y see "
            "every unstable mode? If so, loosen weights or reduce the order of the plant."
        )
    _unpack(problem, reached, chain, inverse)
    how = f"Clarabel: {reached.status} after {reached.iterations} iterations"
    for constraint in problem.constraints:
        M = constraint.args[0].value
        values = la.eigvalsh(half(M))
        if np.max(np.abs(M - M.T)) > 1e-9 * max(float(values[-1]), 1.0):
            raise SolverError(
                "an LMI was not symmetric, and so not imposed as it was meant. Report it."
            )
        if not values[0] >= -VIOLATION * max(float(values[-1]), 1.0):
            raise SolverError(
                f"an LMI is violated: smallest eigenvalue {values[0]:.1e}, largest "
                f"{values[-1]:.1e} ({how}). Loosen weights or reduce the order of the plant."
            )


def _unpack(problem: Any, raw: Any, chain: Any, inverse: Any) -> None:
    """Write a solver's point into the variables: what is inaccurate is judged by the LMIs."""
    from cvxpy.error import SolverError as Unread

    # cvxpy reads no point whose status is another
    names = ("x", "z", "obj_val", "solve_time", "iterations")
    point = SimpleNamespace(**{name: getattr(raw, name) for name in names}, status=raw.status)
    if str(raw.status) not in ("Solved", "AlmostSolved"):
        point.status = "AlmostSolved"
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            problem.unpack_results(point, chain, inverse)
    except (Unread, ValueError) as error:
        raise SolverError(
            f"the solver's answer could not be read (Clarabel: {raw.status} after "
            f"{raw.iterations} iterations, {_order(problem)} states): {error} Loosen weights or "
            "reduce the order of the plant."
        ) from error


def _order(problem: Any) -> int:
    return int(max(variable.shape[0] for variable in problem.variables() if variable.shape))
