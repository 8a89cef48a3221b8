"""H-infinity synthesis by linear matrix inequalities: programs, checks of solutions, `Lmi`."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, positive, whole
from ...errors import FlexplantError, InfeasibleError, ModelError, SolverError, counted
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...lti.riccati import control_care, control_dare, filter_care, filter_dare
from ...lti.statespace import StateSpace
from ...parallel import Progress, interruptible
from ...store import Value, checked
from ...tolerances import RANK, TINY, divisor
from ..controller import AGREEMENT, SolvedController
from ..hinf.lower_bound import pointwise_bound, raised_bound
from ..preparation import Prepared

#: A, B, C, D of a controller
Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

#: singular values below this fraction of the largest count as zero: channels are prepared to about
#: 1e-12
NULL = 1e-10
#: fraction of the back-off that goes into X Y >= (1 + ...)^2, away from the singular I - X Y
APART = 0.6
#: weight of the size of the controller's matrices relative to the traces of X and Y
MODERATION = 0.1
#: settings of the solver's tolerances
TOLERANCES = ("tol_gap_abs", "tol_gap_rel", "tol_feas")
#: largest violation of an LMI, relative to its largest eigenvalue
VIOLATION = 1e-6
#: the same of LMIs that only choose states
STATES = 1e-5
#: part of the back-off at which states are chosen for the controller's LMIs
NEARER = 0.4
#: multiples of the back-off that are tried in turn, while they are at most so large
LOOSER, LOOSEST = np.array([2.0, 4.0, 8.0]), 0.05
#: relative distance from the smallest gamma at which states are chosen for the next program; of the
#: smallest gamma from its lower bound, above which neither is trusted
AWAY = 0.02
#: gamma, relative to the plant's size, that is taken for zero
_NOTHING = 1e-7
#: settings of Clarabel, tried in turn: its own; without its scaling of the data; regularised more
ATTEMPTS: tuple[dict[str, Any], ...] = (
    {},
    {"equilibrate_enable": False},
    {"static_regularization_constant": 1e-7},
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
        """Return a gamma typical for the plant: its open gain near its unit of frequency."""
        shifted = (1.3 + 0.7j) * np.eye(self.A.shape[0]) - self.A
        gain = float(np.linalg.norm(self.C1 @ np.linalg.solve(shifted, self.B1) + self.D11, 2))
        bound = float(np.linalg.norm(self.C1) * np.linalg.norm(self.B1))
        return max(gain, 1e-3 * bound) or 1.0  # the largest it can be, and no zero


def lqg_states(p: Plant) -> Plant:
    """Return the plant in LQG-balanced states, in the unit of frequency of the LQG loop."""
    # the Riccati solutions stand in for X and Y
    n, nu, ny = p.A.shape[0], p.B2.shape[1], p.C2.shape[0]
    # a little of everything: no rank of D12, D21 or observability of z is assumed
    Q, W = p.C1.T @ p.C1, p.B1 @ p.B1.T
    Q = Q + 1e-8 * np.linalg.norm(Q) * np.eye(n)
    W = W + 1e-8 * np.linalg.norm(W) * np.eye(n)
    R, V = p.D12.T @ p.D12 + 0.1 * np.eye(nu), p.D21 @ p.D21.T + 0.1 * np.eye(ny)
    try:
        return lqg_balanced(p, Q, W, R, V)
    except (SolverError, la.LinAlgError) as error:
        raise SolverError("rounding hides every stabilising controller.") from error


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


class Optimum(NamedTuple):
    """The smallest gamma, and the plant scaled by it and balanced."""

    value: float
    plant: Plant


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


def smallest_gamma(p: Plant, scale: float, settings: dict[str, float]) -> Optimum:
    """Return the smallest gamma of the projected LMIs."""
    cp = modelling()
    gamma = cp.Variable()
    X, Y, constraints = projected(p, gamma)
    # the little trace picks one of the many X and Y, and keeps them finite
    size = cp.trace(X) + cp.trace(Y)
    solve_program(cp.Problem(cp.Minimize(gamma + 1e-9 * size), constraints), settings)
    value = max(float(gamma.value), 1e-12)  # it may end below zero
    states = p.scaled(value).balanced(X.value, Y.value).with_unit_channels()
    return Optimum(value * scale, states)


def moderate_states(p: Plant, gamma: float, settings: dict[str, float]) -> Plant:
    """Return the plant in states balanced by the smallest X and Y of a gamma."""
    # those of the smallest gamma are nearly singular, and no states for another program
    cp = modelling()
    X, Y, constraints = projected(p, gamma)
    size = cp.Minimize(cp.trace(X) + cp.trace(Y))
    solve_program(cp.Problem(size, constraints), settings, violation=STATES)
    return p.balanced(X.value, Y.value).with_unit_channels()


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
    if not norm <= target * (1.0 + AGREEMENT):
        raise SolverError(f"its closed loop has the norm {norm:.6g}, not {target:.6g}.")
    return norm


def solve_program(
    problem: Any, settings: dict[str, float], *, violation: float = VIOLATION
) -> None:
    """Solve a semidefinite program; its LMIs are checked by their eigenvalues afterwards."""
    # where Clarabel stops without an answer, the next of `ATTEMPTS` is made; the last resort is a
    # point at which progress became insufficient, which often is one that holds; with a larger
    # `violation` also one at which numbers failed, its residuals below that
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


#: relative gap between a value and its lower bound, known to 1e-3, at which the search ends
_GAP = 5e-3
#: programs from one choice of states, and choices of states
_ROUNDS, _STARTS = 4, 2


@dataclass(frozen=True, eq=False)
class Lmi(Value):
    """Synthesis by linear matrix inequalities (LMIs), solved by Clarabel through cvxpy.

    Needs a stabilising controller to exist and nothing else: efforts without weight, sensors
    without noise and modes on the stability boundary are allowed. Suits small plants: the time
    grows with the sixth power of the number of states, about 10 s at 24.

    Parameters
    ----------
    back_off : float
        Relative distance of the target from the smallest gamma, at which the controller's gains
        may be infinite. Doubled up to three times, to at most 5 %, where no controller keeps it.
    tolerance : float
        Tolerance of the solver: gap and residuals, relative.
    max_states : int
        Largest number of states; larger problems are refused.
    progress : bool, optional
        Whether to show a progress bar of these programs. None: on a terminal or in a
        notebook, for work of more than two seconds.

    References
    ----------
    [GahinetApkarian1994]_ (the smallest gamma); [Scherer1997]_ (the controller, section IV; its
    Â is eliminated here).

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> fx.design_hinf(sys, fx.Lmi()).gamma < 1
    True
    """

    back_off: float = field(default=0.05, metadata=checked(positive))
    tolerance: float = field(default=1e-9, metadata=checked(positive))
    max_states: int = field(default=30, metadata=checked(whole))
    progress: bool | None = None

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller of a prepared problem.

        Raises
        ------
        ModelError
            When the problem has no states, or more than max_states.
        InfeasibleError
            When the solver proves that no stabilising controller exists, or no gamma is smallest.
        SolverError
            When the solver stops early, or no controller satisfies what the LMIs claim.
        """
        n = problem.A.shape[0]
        if not n:
            raise ModelError("Lmi needs states, got a static plant. Use Riccati().")
        if n > self.max_states:
            raise ModelError(
                f"Lmi takes plants of 1 to {self.max_states} states, got {n}: time grows as n^6. "
                "Reduce the order first, use Riccati(), or raise Lmi(max_states=...)."
            )
        with Progress(
            _STARTS * _ROUNDS, "programs of the LMIs", progress=self.progress, even=False
        ) as bar:
            found, lower = self._smallest(problem, bar.advance)
        if found.value > lower * (1.0 + AWAY):
            raise SolverError(
                f"the LMIs give gamma = {found.value:.6g} as smallest, but no proof excludes more "
                f"than {lower:.6g}: {counted(n, 'state')} of such unlike speeds are beyond the "
                "solver. Use Riccati(), loosen weights, or leave slow or fast states out."
            )
        failures = []
        steps = [self.back_off, *(one for one in self.back_off * LOOSER if one <= LOOSEST)]
        for step, choose in itertools.product(steps, (lambda same, *_: same, moderate_states)):
            try:
                states = choose(found.plant, 1.0 + NEARER * step, self._settings)
                K = moderate_controller(states, 1.0 + step, self._settings)
                norm = verified(problem, K, found.value * (1.0 + step))
            except (FlexplantError, la.LinAlgError) as error:
                failures.append(f"{100 * step:.3g} % above it: {error}")
                continue
            return SolvedController(*K, norm, min(lower, norm))
        raise SolverError(
            f"the LMIs of {counted(n, 'state')} give gamma = {found.value:.6g} as smallest, but no "
            f"controller. {' '.join(failures)} Loosen weights, raise back_off, or use Riccati(), "
            "which adds a little noise and effort where sensors and actuators have none."
        )

    @property
    def _settings(self) -> dict[str, float]:
        return dict.fromkeys(TOLERANCES, self.tolerance)

    def _smallest(self, problem: Prepared, count: Callable[[], None]) -> tuple[Optimum, float]:
        """Return the smallest gamma, from other states while it is not near its bound, and that."""
        plant, lower = Plant.of(problem), 0.0
        found: list[Optimum] = []
        failures: list[FlexplantError] = []
        guess = plant.size()
        for start in (lqg_states, lambda same: same):
            try:  # what was found before an error stays
                states, scale = start(plant), found[-1].value if found else guess
                for number in range(_ROUNDS):
                    one = smallest_gamma(states.scaled(scale), scale, self._settings)
                    found.append(one)
                    count()
                    lower = lower or raised_bound(problem, one.value, pointwise_bound(problem), 0.0)
                    # close, in a scale that resolves it
                    if one.value - lower <= _GAP * one.value and one.value > 0.03 * scale:
                        return one, lower
                    if number and one.value > 0.99 * scale:
                        break
                    nearer = moderate_states(one.plant, 1.0 + AWAY, self._settings)
                    states, scale = nearer.scaled(1.0 / one.value), one.value
            except (SolverError, InfeasibleError) as error:
                failures.append(error)
        if not found:
            # a proof of infeasibility says more than a solver that stopped
            raise next((e for e in failures if isinstance(e, InfeasibleError)), failures[-1])
        best = min(found, key=lambda one: abs(one.value - lower))
        if best.value < _NOTHING * guess:
            raise InfeasibleError(
                f"gamma has no minimum: the infimum is 0. {best.value:.3g} is reached; typical "
                f"for this plant is {guess:.3g}. u cancels w in z, at no cost. Weight the "
                "efforts in z, or give the sensors noise in w."
            )
        return best, lower
