"""The semidefinite programs of H-infinity synthesis, and what their solutions are checked by."""

from __future__ import annotations

import warnings
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...errors import InfeasibleError, SolverError, counted
from ...parallel import interruptible
from .lmi_solution import Matrices, Plant, dual_bound, half, null_space, reconstructed

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


class Optimum(NamedTuple):
    """The smallest gamma and its lower bound, and the plant of that size."""

    value: float
    lower: float
    #: scaled by value and balanced
    plant: Plant
    #: in which it was sought
    scale: float


def modelling() -> Any:
    """Return cvxpy, which takes more than a second to import."""
    import cvxpy

    return cvxpy


def symmetric_blocks(rows: list[list[Any]]) -> Any:
    """Return the symmetric block matrix (cvxpy) whose upper triangle of blocks is given."""
    # cvxpy's ``M >> 0`` constrains only the symmetric part: every LMI is made here, mirrored
    cp = modelling()
    count = len(rows)
    full = [
        [
            rows[i][j - i] if j > i else half(rows[i][0]) if j == i else rows[j][i - j].T
            for j in range(count)
        ]
        for i in range(count)
    ]
    return cp.bmat(full)


def smallest_gamma(p: Plant, scale: float, settings: dict[str, float]) -> Optimum:
    """Return the smallest gamma of the projected LMIs ([GahinetApkarian1994]_, theorem 4.3)."""
    cp = modelling()
    n, nw, nz = p.A.shape[0], p.B1.shape[1], p.C1.shape[0]
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    gamma = cp.Variable()
    onto_u = la.block_diag(null_space(np.hstack([p.B2.T, p.D12.T])), np.eye(nw))
    onto_y = la.block_diag(null_space(np.hstack([p.C2, p.D21])), np.eye(nz))
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
    solve_program(cp.Problem(cp.Minimize(gamma + 1e-9 * size), constraints), settings)
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


def moderate_controller(p: Plant, gamma: float, settings: dict[str, float]) -> Matrices:
    """Return a controller for gamma, moderate X, Y and gains (Scherer, Gahinet, Chilali)."""
    # holds for some A^ exactly when its two diagonal parts do, linear in (Y, C^, D), (X, B^, D)
    cp = modelling()
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
    solve_program(
        cp.Problem(cp.Minimize(cp.trace(X) + cp.trace(Y) + MODERATION * gains), constraints),
        settings,
    )
    return reconstructed(p, gamma, X.value, Y.value, B.value, C.value, D.value)


def solve_program(
    problem: Any, settings: dict[str, float], *, violation: float = VIOLATION
) -> None:
    """Solve a semidefinite program; its LMIs are checked by their eigenvalues afterwards.

    Where Clarabel stops without an answer, the next of `ATTEMPTS` is made; the last resort is a
    point at which progress became insufficient, which often is one that holds; with a larger
    `violation` also one at which numbers failed, its residuals below that.
    """
    data, chain, inverse = problem.get_problem_data("CLARABEL", solver_opts={})
    reached: Any = None
    for attempt in ATTEMPTS:
        options = {**settings, **attempt}
        raw = interruptible(partial(chain.solve_via_data, problem, data, solver_opts=options))
        status = str(raw.status)
        how = f"Clarabel: {status} after {counted(raw.iterations, 'iteration')}"
        if "PrimalInfeasible" in status:
            raise InfeasibleError(
                f"the LMIs have no solution ({how}). Does u reach and y see every unstable mode?"
            )
        if status in ("Solved", "AlmostSolved"):
            reached = raw
            break
        failed = status == "NumericalError" and max(raw.r_prim, raw.r_dual) < violation
        if reached is None and (
            status == "InsufficientProgress" or (failed and violation > VIOLATION)
        ):
            reached = raw
    if reached is None:
        raise SolverError(
            f"the LMIs were not solved ({how}, residuals {raw.r_prim:.1e} and {raw.r_dual:.1e}, "
            f"{counted(_order(problem), 'state')}, {len(ATTEMPTS)} settings tried). Does u reach "
            "and y see every unstable mode? If so, loosen weights or reduce the order of the plant."
        )
    _unpack(problem, reached, chain, inverse)
    how = f"Clarabel: {reached.status} after {counted(reached.iterations, 'iteration')}"
    for constraint in problem.constraints:
        M = constraint.args[0].value
        if not _is_lmi(constraint):
            continue
        values = la.eigvalsh(half(M))
        # solvers return them symmetric: else the constraint is not the one meant
        if np.max(np.abs(M - M.T)) > 1e-9 * max(float(values[-1]), 1.0):
            raise SolverError(
                "an LMI was not symmetric, and so not imposed as it was meant. Report it."
            )
        if not values[0] >= -violation * max(float(values[-1]), 1.0):
            raise SolverError(
                f"an LMI is violated: smallest eigenvalue {values[0]:.1e}, largest "
                f"{values[-1]:.1e} ({how}). Loosen weights or reduce the order of the plant."
            )


def _is_lmi(constraint: Any) -> bool:
    return bool(constraint.__class__.__name__ == "PSD")


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
            f"{counted(raw.iterations, 'iteration')}, {counted(_order(problem), 'state')}): "
            f"{error} Loosen weights or reduce the order of the plant."
        ) from error


def _order(problem: Any) -> int:
    return int(max(variable.shape[0] for variable in problem.variables() if variable.shape))
