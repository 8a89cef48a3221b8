"""H-infinity synthesis by linear matrix inequalities: programs, checks of solutions, `Lmi`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, divisor, positive, whole
from ...errors import InfeasibleError, ModelError, SolverError, counted
from ...lti.equations import OnAxisError
from ...lti.riccati import control_care, control_dare, filter_care, filter_dare
from ...parallel import interruptible
from ...store import Value, checked
from ...tolerances import FOUR_DIGITS, NEGLIGIBLE, NULL, RANK, RESIDUAL, TINY, TYPED
from ..controller import SolvedController
from ..hinf.hinf_riccati import back_off_controller, h2_controller, resonance_gain
from ..hinf.lower_bound import both_sides, raised_bound
from ..hinf.singular import regularised
from ..preparation import Prepared, beyond_rounding

#: A, B, C, D of a controller
Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

#: settings of the solver's tolerances
TOLERANCES = ("tol_gap_abs", "tol_gap_rel", "tol_feas")


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

    def with_unit_channels(self) -> Plant:
        """Return the plant with u and y in units that make columns [B2; D12], rows [C2, D21] one.

        A channel without visible noise or effort keeps its unit.
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


def lqg_balanced(
    p: Plant, Q: FloatArray, W: FloatArray, R: FloatArray, V: FloatArray, *, sampled: bool = False
) -> Plant:
    """Return a plant in states balanced by its LQG problem, A less one if it is sampled."""
    # in the unit of frequency of the LQG loop; R and V weigh the effort and the noise of sensors
    solve_control, solve_filter = (
        (control_dare, filter_dare) if sampled else (control_care, filter_care)
    )
    control, filtered = solve_control(p.A, p.B2, Q=Q, R=R), solve_filter(p.A, p.C2, Q=W, R=V)
    one = float(sampled)
    sizes = np.abs(np.concatenate([control.poles, filtered.poles]) - one)
    speed = float(np.exp(np.mean(np.log(np.maximum(sizes, TINY)))))
    found = p.balanced(control.P, filtered.P)
    return found._replace(A=found.A - one * np.eye(len(found.A))).timed(speed)


def factor(P: FloatArray) -> FloatArray:
    """Return L with ``L L' = P``, P kept barely positive definite."""
    values, vectors = la.eigh(half(P))
    return np.asarray(vectors * np.sqrt(np.maximum(values, RANK * max(values[-1], TINY))))


def half(M: Any) -> Any:
    """Return the symmetric part."""
    return 0.5 * (M + M.T)


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


def projected(p: Plant, gamma: Any) -> tuple[Any, Any, list[Any]]:
    """Return X, Y and the projected LMIs of a gamma ([GahinetApkarian1994]_, theorem 4.3)."""
    cp = modelling()
    n, nw, nz = p.A.shape[0], p.B1.shape[1], p.C1.shape[0]
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    onto_u = la.block_diag(la.null_space(np.hstack([p.B2.T, p.D12.T]), NULL), np.eye(nw))
    onto_y = la.block_diag(la.null_space(np.hstack([p.C2, p.D21]), NULL), np.eye(nz))
    AY, XA, w, z = p.A @ Y, X @ p.A, -gamma * np.eye(nw), -gamma * np.eye(nz)
    control = symmetric_blocks([[AY + AY.T, Y @ p.C1.T, p.B1], [z, p.D11], [w]])
    observe = symmetric_blocks([[XA + XA.T, X @ p.B1, p.C1.T], [w, p.D11.T], [z]])
    return (
        X,
        Y,
        [
            half(-onto_u.T @ control @ onto_u) >> 0,
            half(-onto_y.T @ observe @ onto_y) >> 0,
            symmetric_blocks([[Y, np.eye(n)], [X]]) >> 0,
        ],
    )


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


def solve_program(problem: Any, settings: dict[str, float], *, violation: float = TYPED) -> None:
    """Solve a semidefinite program; its LMIs are checked by their eigenvalues afterwards."""
    # a point at which the solver stopped early counts too, where it satisfies them
    data, chain, inverse = problem.get_problem_data("CLARABEL", solver_opts={})
    raw = interruptible(partial(chain.solve_via_data, problem, data, solver_opts=settings))
    how = f"Clarabel: {raw.status} after {counted(raw.iterations, 'iteration')}"
    if "PrimalInfeasible" in str(raw.status):
        raise InfeasibleError(
            f"the LMIs have no solution ({how}). Does u reach and y see every unstable mode?"
        )
    if not np.all(np.isfinite(raw.x)):
        raise SolverError(
            f"the LMIs were not solved ({how}). Does u reach and y see every unstable mode? If so, "
            "loosen weights or reduce the order of the plant."
        )
    _unpack(problem, raw, chain, inverse)
    for constraint in problem.constraints:
        M = constraint.args[0].value
        if constraint.__class__.__name__ != "PSD":
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


def _unpack(problem: Any, raw: Any, chain: Any, inverse: Any) -> None:
    """Write a solver's point into the variables, whatever its status."""
    # cvxpy reads no point whose status is another
    names = ("x", "z", "obj_val", "solve_time", "iterations")
    point = SimpleNamespace(**{name: getattr(raw, name) for name in names}, status="AlmostSolved")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solution may be inaccurate")
        problem.unpack_results(point, chain, inverse)


#: largest relative distance of a program's gamma from its lower bound; and how far above the bound
#: the controller's own distance begins at most: with that, 0.5 %, it makes 1 %
_GAP, _NEAR = 2e-2, 5e-3


@dataclass(frozen=True, eq=False)
class Lmi(Value):
    """H-infinity synthesis by linear matrix inequalities (LMIs), solved by Clarabel through cvxpy.

    Gamma is the bound on the H-infinity norm from w to z. One semidefinite program with the matrix
    variables X and Y gives the smallest gamma. For this program, the states are balanced: they are
    transformed so that the solutions of two Riccati equations (least quadratic cost of control and
    of estimation) are equal and diagonal. The eigenvalues of X and Y prove, to the accuracy of the
    solver, that this gamma can be reached. The Riccati equations of H-infinity control prove a
    lower bound for all controllers. If the optimum is more than 2 % above that bound, an error is
    raised.

    The controller is not computed from X and Y, because ``I - X Y`` is nearly singular next to the
    optimum, and digits would be lost. It is computed from the Riccati equations, as by `Riccati()`,
    for a gamma a little larger than the smallest one. The smallest one is taken as at most 0.5 %
    above the lower bound. If the equations need it, small noise, effort and disturbances are added,
    as by `Riccati()`.

    Plants may have up to 20 states, for which the synthesis takes at most 10 s. The time grows with
    the sixth power of the number of states, and larger plants are refused. An error is also raised
    if the solver is not accurate enough for the plant, because its states are both very fast and
    very slow, or its gains very large and very small.

    Parameters
    ----------
    back_off : float, optional
        Relative distance from the smallest gamma. By default it is 0.5 % if D12 and D21 have full
        rank; otherwise it is that of `Riccati()`.
    tolerance : float
        Relative tolerance of the solver on the duality gap and on the residuals.
    max_states : int
        Largest number of states of the plant. An error is raised for a larger one.

    References
    ----------
    [GahinetApkarian1994]_ (the smallest gamma); [GloverDoyle1988]_ (the controller).

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> fx.design_hinf(sys, fx.Lmi()).gamma < 1
    True
    """

    back_off: float | None = field(default=None, metadata=checked(positive))
    tolerance: float = field(default=1e-9, metadata=checked(positive))
    max_states: int = field(default=20, metadata=checked(whole))

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller of the plant that `design_hinf` has scaled and checked.

        Raises
        ------
        ModelError
            When the problem has no states, or more than max_states.
        InfeasibleError
            When gamma approaches its smallest value only if the gains of the controller become
            infinite.
        SolverError
            When the solver stops early, or its optimum is not near the lower bound.
        """
        n = problem.A.shape[0]
        if not n:
            raise ModelError("Lmi needs states, got a static plant. Use Riccati().")
        if n > self.max_states:
            raise ModelError(
                f"Lmi serves plants of 1 to {self.max_states} states, got {n}: time grows as n^6. "
                "Reduce the order first, use Riccati(), or raise Lmi(max_states=...)."
            )
        high, low = self._smallest(problem)
        found = back_off_controller(
            problem, lambda _, unit: (high / unit, low / unit), self.back_off
        )
        return found._replace(lower=low)

    def _smallest(self, given: Prepared) -> tuple[float, float]:
        """Return the smallest gamma of the projected LMIs, and the lower bound that it is near."""
        # in units and states of the controller of least quadratic cost; noise and effort of a size
        # that is not felt keep its solutions away from singular
        try:
            regular = regularised(given, NEGLIGIBLE, modes=True)
            unit = resonance_gain(regular, h2_controller(regular))
            (X, _), (Y, _) = (side.least_squares() for side in both_sides(regular))
        except (la.LinAlgError, OnAxisError, SolverError) as error:
            raise SolverError(
                "no controller of least quadratic cost stabilises. Does u reach and y see every "
                f"unstable mode? {beyond_rounding(given).capitalize()}"
            ) from error
        problem = given.measured_in(unit)
        p, units = problem, (np.ones(len(given.u)), np.ones(len(given.y)))
        plant = Plant(p.A, p.B1, p.B2, p.C1, p.C2, p.D11, p.D12, p.D21, *units)
        high = self._optimum(plant.balanced(X / unit**2, Y).with_unit_channels())
        if high < FOUR_DIGITS:
            raise InfeasibleError(
                "gamma has no minimum: the infimum is 0. u cancels w in z, at no cost. Weight the "
                "efforts in z, or give the sensors noise in w."
            )
        low = raised_bound(problem, high, 0.0, 0.0)
        if not high <= low * (1.0 + _GAP):
            raise SolverError(
                f"the LMIs give a smallest gamma of {unit * high:.4g}, no proof excludes more than "
                f"{unit * low:.4g}. {self._served(len(p.A))}"
            )
        return unit * min(high, low * (1.0 + _NEAR)), unit * low

    def _optimum(self, states: Plant) -> float:
        """Return the smallest gamma of the program, as the solver gives it."""
        cp, gamma = modelling(), modelling().Variable()
        X, Y, constraints = projected(states, gamma)
        # a little of their traces picks one of many X and Y, and keeps them finite
        goal = cp.Minimize(gamma + NULL * (cp.trace(X) + cp.trace(Y)))
        settings = dict.fromkeys(TOLERANCES, self.tolerance)
        # X and Y of smallest gammas are nearly singular: Clarabel's own 1e-8 leaves these gammas up
        # to 4 % too large; 1e-11 fails on one plant in a hundred
        settings["static_regularization_constant"] = RESIDUAL
        try:
            solve_program(cp.Problem(goal, constraints), settings)
        except SolverError as error:
            raise SolverError(f"{error} {self._served(len(states.A))}") from error
        return float(gamma.value)

    def _served(self, n: int) -> str:
        """Return which plants are served, and what to do with one of n states that is refused."""
        return (
            f"Lmi serves plants of up to {self.max_states} states of similar speeds and gains. The "
            f"solver does not resolve those of this plant of {counted(n, 'state')} together. Use "
            "Riccati(), loosen weights, or leave slow or fast states out."
        )
