"""H-infinity synthesis by linear matrix inequalities: programs, checks of solutions, `Lmi`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import Value, checked, positive, whole
from ...errors import FlexplantError, InfeasibleError, SolverError, counted
from ...lti.preparation import Prepared
from ...parallel import Progress, interruptible
from ..controller import SolvedController
from .lmi_solution import (
    LOOSER,
    Candidate,
    Matrices,
    Plant,
    check_cost,
    check_size,
    dual_bound,
    first_verified,
    half,
    lqg_states,
    reconstructed,
    same_states,
)

#: singular values below this part of the largest are none: channels are prepared to some 1e-12
NULL = 1e-10
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
    onto_u = la.block_diag(la.null_space(np.hstack([p.B2.T, p.D12.T]), NULL), np.eye(nw))
    onto_y = la.block_diag(la.null_space(np.hstack([p.C2, p.D21]), NULL), np.eye(nz))
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


#: gap between value and lower bound at which no other coordinates are tried
_GAP = 5e-4
#: times the tolerance with which a bound that stays loose is computed once more
_COARSER = 10.0
#: programs from one choice of states
_ROUNDS = 4
#: choices of states and tolerance
_STARTS = 3


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
        may be infinite. Doubled up to three times where no controller keeps the target.
    tolerance : float
        Of the solver: gap and residuals, relative.
    max_states : int
        Larger problems are refused.
    progress : bool, optional
        True shows a bar of these programs at once, False never; None after two seconds on a
        terminal.

    Raises
    ------
    ModelError
        When a value is not positive.

    References
    ----------
    [GahinetApkarian1994]_ (the smallest gamma); [Scherer1997]_ (the controller, section IV; its
    Â is eliminated here).

    Examples
    --------
    >>> import flexplant as fx
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lowpass(0.1), KS=0.1)
    >>> fx.design_hinf(sys, fx.Lmi()).gamma < 1
    True
    """

    back_off: float = field(default=0.05, metadata=checked(positive))
    tolerance: float = field(default=1e-9, metadata=checked(positive))
    max_states: int = field(default=30, metadata=checked(whole))
    progress: bool | None = None

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller of a prepared problem.

        `lower` is a bound by weak duality from multipliers repaired to satisfy their equations;
        it holds for all controllers whose Lyapunov matrices are no larger than those found.

        Raises
        ------
        ModelError
            When the problem has no states, or more than max_states.
        InfeasibleError
            When the solver proves that no stabilising controller exists, or no gamma is smallest.
        SolverError
            When the solver stops early, or no controller satisfies what the LMIs claim.
        """
        check_size(self, problem)
        with Progress(_STARTS * _ROUNDS, "programs of the LMIs", progress=self.progress) as bar:
            found = self._smallest(Plant.of(problem), bar.advance)
        settings = self._settings(self.tolerance)
        candidates = [
            Candidate(
                f"{100 * part:.3g} % above it",
                found.value * (1.0 + part),
                partial(moderate_controller, found.plant, 1.0 + part, settings),
            )
            for part in self.back_off * LOOSER
        ]
        return first_verified(problem, found.value, found.lower, candidates)

    def _settings(self, tolerance: float) -> dict[str, float]:
        return {
            "tol_gap_abs": tolerance,
            "tol_gap_rel": tolerance,
            "tol_feas": tolerance,
        }

    def _smallest(self, plant: Plant, count: Callable[[], None]) -> Optimum:
        """Return the smallest gamma, from other states and a coarser tolerance while not sure."""
        found: list[Optimum] = []
        failures: list[FlexplantError] = []
        guess = plant.size()
        # a solver that stops early stops elsewhere with another tolerance: its bounds hold too
        for start, tolerance in (
            (lqg_states, self.tolerance),
            (same_states, self.tolerance),
            (lqg_states, _COARSER * self.tolerance),
        ):
            coarser = tolerance > self.tolerance
            if coarser and not found:
                break
            try:
                scale = found[-1].value if found and not coarser else guess
                # what was found before an error stays
                for one in self._rounds(start(plant), scale, self._settings(tolerance)):
                    found.append(one)
                    count()
            except (SolverError, InfeasibleError) as error:
                failures.append(error)
            if found and _is_close(_tightest(found)):
                break
        if not found:
            # a proof of infeasibility says more than a solver that stopped
            raise next((e for e in failures if isinstance(e, InfeasibleError)), failures[-1])
        best = _tightest(found)
        check_cost(best.value, guess)
        return best._replace(lower=min(max(one.lower for one in found), best.value))

    @staticmethod
    def _rounds(states: Plant, scale: float, settings: dict[str, float]) -> Iterator[Optimum]:
        """Yield smallest gammas, each in the states and the scale that the one before gives."""
        for number in range(_ROUNDS):
            one = smallest_gamma(states.scaled(scale), scale, settings)
            yield one
            if _is_close(one) or (number and one.value > 0.99 * scale):
                return
            states, scale = one.plant.scaled(1.0 / one.value), one.value


def _tightest(found: list[Optimum]) -> Optimum:
    return min(found, key=lambda one: one.value - one.lower)


def _is_close(one: Optimum) -> bool:
    """Whether the bound is close, in a scale that resolves it."""
    return one.value - one.lower <= _GAP * one.value and one.value > 0.03 * one.scale
