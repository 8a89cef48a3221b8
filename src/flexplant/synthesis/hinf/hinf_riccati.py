"""H-infinity synthesis by two Riccati equations, verified by the closed loop's norm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, positive
from ...errors import FlexplantError, InfeasibleError, SolverError
from ...lti.equations import OnAxisError
from ...lti.frequency_sweep import largest_gains
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...lti.peaks import residues
from ...lti.response_solvers import responses
from ...lti.statespace import StateSpace
from ...parallel import Progress
from ...store import Value, checked
from ...tolerances import FOUR_DIGITS, MOST_STEPS, NEGLIGIBLE, ROUNDING, SETTLED, TYPED
from ..controller import SolvedController
from ..preparation import Prepared, beyond_rounding
from .lower_bound import both_sides, coupling, pointwise_bound
from .singular import lacking, made_regular

#: distances from the smallest gamma: 5 % of it cost 3 to 5 % of rms and 0.02 of margin; near it
#: gains stay finite where D12 and D21 have full rank, so that 1 % is kept with the tolerance, and
#: with what is added for undamped modes or to tiny efforts; they grow without bound where the ranks
#: are missing
_REGULAR, _ADDED, _SINGULAR = 0.005, 0.003, 0.05
#: secants between two bisections of a search, and by how many times a step that rises from a bound
#: is wider than the last
_SECANTS, _WIDER = 3, 8.0

_LEAST = (
    "rounding lets no controller of a smaller gamma be computed than that of least quadratic cost, "
    "which is returned: poles that are too slow or too fast next to the loop's speed cost digits."
)

#: a search in a regular problem, scaled by the norm of its loop of least quadratic cost, and by
#: which: the smallest gamma that is reached, and the largest that is refuted
Search: TypeAlias = Callable[[Prepared, float], tuple[float, float]]
#: what solves a regular problem by a search, with a back-off
Solve: TypeAlias = Callable[[Prepared, Search, float | None], SolvedController]


@dataclass(frozen=True, eq=False)
class Riccati(Value):
    """H-infinity synthesis by the Riccati equations of Glover and Doyle. A bisection finds gamma.

    Gamma is the bound on the H-infinity norm from w to z. A value of gamma counts as reached only
    if the closed loop of its controller is stable and has all gains below gamma. The controller of
    the smallest gamma has very fast poles and is badly conditioned. Therefore the controller is
    computed for a gamma that is larger by `back_off`. The lower bound is the largest gamma for
    which it is proven that no controller reaches it. A failed computation alone does not count as a
    proof.

    The equations make two assumptions. First, the feedthrough D12 from u to z and the feedthrough
    D21 from w to y have full rank. Second, w excites and z observes every mode on the stability
    boundary (undamped mode). If a rank is missing, a small noise on each sensor and a small effort
    of each actuator are added. Their size is measured at the speed of the loop [rad/s]. This is an
    estimate, from the weights and the plant, of the frequency up to which the loop acts. There the
    noise is at most 1e-3 of the signal that w causes at the sensor, and the effort is at most 1e-3
    of the signal that u causes in z. If w does not excite an undamped mode, a small disturbance at
    the actuators is added to w. If z does not observe one, a small multiple of the sensors is added
    to z. A mode counts as undamped if its decay rate is less than 1e-6 of the speed of the loop, or
    less than 1e-2 if several such modes lie close together. The loop is verified without these
    additions. The notes of the controller state what was added and how much gamma increases by it.

    Parameters
    ----------
    back_off : float, optional
        Relative distance from the smallest gamma found. The default is 0.5 % if D12 and D21 have
        full rank and nothing is added to the plant. It is 0.3 % if the ranks are full but something
        is added, because of an undamped mode or because a direct term is tiny. It is 5 % if a rank
        is missing.
    tolerance : float
        Relative width of the interval of gamma at which the bisection stops.
    progress : bool, optional
        Whether to show a progress bar of the bisection. By default (None) it is shown on a terminal
        or in a notebook, for work of more than two seconds.

    References
    ----------
    [GloverDoyle1988]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> fx.design_hinf(sys, fx.Riccati(tolerance=1e-2)).gamma < 1
    True
    """

    back_off: float | None = field(default=None, metadata=checked(positive, zero=True))
    tolerance: float = field(default=1e-3, metadata=checked(positive))
    progress: bool | None = None

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller of the plant that `design_hinf` has scaled and checked.

        Raises
        ------
        InfeasibleError
            When gamma approaches its smallest value only if the gains of the controller become
            infinite.
        SolverError
            When the plant is so badly conditioned that no stabilising controller is found in double
            precision.
        """
        return back_off_controller(problem, self._searched, self.back_off)

    def _searched(self, problem: Prepared, _: float) -> tuple[float, float]:
        """Return the smallest gamma that was reached below 1, and the largest refuted one."""
        # reached: what the equations promise of a step is seen at the resonances of its loop
        bracket = _Bracket(min(1.0, pointwise_bound(problem)), self.tolerance)
        with Progress(MOST_STEPS, "steps of the search", progress=self.progress, even=False) as bar:
            bracket.close(problem, bar, resonance_gain)
        return bracket.high, bracket.low


@dataclass(frozen=True, eq=False)
class UncheckedRiccati(Riccati):
    """The same by what the equations promise: for designs of which only the crossing is needed."""

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller, without a norm of its loop."""
        return back_off_controller(problem, self._searched, self.back_off, self._promised)

    def _promised(
        self, problem: Prepared, search: Search, back_off: float | None
    ) -> SolvedController:
        """Return the controller at a distance from the smallest gamma that has one."""
        bound = pointwise_bound(problem, coarse=True)
        bracket = _Bracket(bound, self.tolerance, np.inf)
        bracket.close(problem, Progress(0, "", progress=False), lambda *_: 0.0)
        gamma = bracket.high * (1.0 + (_REGULAR if back_off is None else back_off))
        K = _attempt(problem, gamma).controller if gamma < np.inf else None
        if K is None:
            return regular_controller(problem, search, back_off)
        at_bound = bracket.failed == bound
        return SolvedController(K.A, K.B, K.C, K.D, gamma, bracket.low, at_bound=at_bound)

    def proven(self, problem: Prepared, found: SolvedController) -> SolvedController | None:
        """Return what was found, with the norm of its loop, if `Riccati` finds the same; else None.

        It does where the first gamma above the lower bound is reached: it tries no other then.
        """
        if not found.at_bound:
            return None
        gamma = found.gamma / (1.0 + _REGULAR)
        first = _attempt(problem, gamma).controller
        if first is None or resonance_gain(problem, first) > gamma:
            return None
        K = StateSpace(*found[:4], inputs=problem.y, outputs=problem.u)
        norm = _loop_norm(problem, K)
        if not norm <= found.gamma * (1.0 + FOUR_DIGITS):
            return None
        _require_finite_gain(problem, K, norm)
        return found._replace(gamma=norm)


class _Bracket:
    """The smallest gamma reached below 1, the largest one that failed, and what is between them."""

    def __init__(self, low: float, tolerance: float, high: float = 1.0) -> None:
        #: the largest gamma refuted, the largest one that failed, and the smallest one reached
        self.low, self.failed, self.high = low, low, high
        self.tolerance, self.step = tolerance, 0.5 * tolerance
        #: the last two gammas, with their rooms where these are known
        self.known: list[tuple[float, FloatArray]] = []
        #: number of secants since the bracket was last halved, and its width then
        self.secants, self.width = 0, np.inf
        #: whether no attempt has had rooms yet
        self.blind = True

    @property
    def is_closed(self) -> bool:
        """Whether the bracket is narrow enough, gamma as good as zero, or nothing is reached."""
        if self.high == np.inf and self.step > 1.0 / NEGLIGIBLE:
            return True
        return self.high <= self.failed * (1.0 + self.tolerance) or self.high < SETTLED

    def close(
        self, problem: Prepared, bar: Progress, gain: Callable[[Prepared, StateSpace], float]
    ) -> None:
        """Try gammas until the bracket is closed, by the gain of the loop of each controller."""
        for _ in range(MOST_STEPS):
            if self.is_closed:
                break
            gamma = self.next_gamma()
            attempt = _attempt(problem, gamma)
            bar.advance()
            K = attempt.controller
            self.narrow(gamma, attempt, np.inf if K is None else gain(problem, K))

    def next_gamma(self) -> float:
        """Return the gamma to try next."""
        if self.high == np.inf:
            return max(self.failed, SETTLED) * (1.0 + self.step)
        low = max(self.failed, 1e-2 * self.high)
        middle = float(np.sqrt(low * self.high))
        if self.blind:  # the limit is often next to the bound: steps that become wider
            return min(middle, low * (1.0 + self.step))
        width = float(np.log(self.high / low))
        if width < 0.5 * self.width:
            self.secants, self.width = 0, width
        if len(self.known) < 2 or self.secants == _SECANTS or width < 2.0 * self.tolerance:
            self.secants = 0
            return middle
        self.secants += 1
        # rooms are nearly linear in t = gamma^-2
        (g1, one), (g2, two) = self.known
        t1, t2 = g1**-2, g2**-2
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (two - one) / (t2 - t1)
            roots = t2 - two / slope
        t = float(np.min(roots[slope < 0.0], initial=low**-2))
        root = t**-0.5 if t > 0.0 else self.high
        # beyond it on the side of the farther end
        aside = 1.0 + 0.25 * self.tolerance
        aim = root * aside if root < middle else root / aside
        inner = 1.0 + 0.5 * self.tolerance
        return float(np.clip(aim, low * inner, self.high / inner))

    def narrow(self, gamma: float, attempt: _Attempt, gain: float) -> None:
        """Take in what an attempt found, and the gain of its loop."""
        self.step *= _WIDER
        self.blind = self.blind and attempt.rooms is None
        self.known = [*self.known[-1:], (gamma, attempt.rooms)] if attempt.rooms is not None else []
        # rounding costs some of what is promised
        if gain < np.inf and gain <= max(gamma * (1.0 + TYPED), np.sqrt(gamma * self.high)):
            self.high = max(gamma, gain)
            return
        self.high, self.failed = min(self.high, gain), gamma
        if attempt.refuted:
            self.low = gamma
        else:  # by rounding, which secants do not see
            self.known = []


def back_off_controller(
    problem: Prepared, search: Search, back_off: float | None, solve: Solve | None = None
) -> SolvedController:
    """Return the controller at a distance from the smallest gamma, regularised where needed."""
    lack, solve = lacking(problem), solve or regular_controller
    if not lack.words:
        return solve(problem, search, back_off)
    step = (_ADDED if lack.is_full else _SINGULAR) if back_off is None else back_off
    return made_regular(problem, lambda regular: solve(regular, search, step), lack)


def regular_controller(
    problem: Prepared, search: Search, back_off: float | None
) -> SolvedController:
    """Return the controller of a regular problem, accepted by the norm of its loop."""
    # the least quadratic cost stabilises: its norm is the unit in which a search looks for less
    try:
        least = h2_controller(problem)
        unit = resonance_gain(problem, least)
    except (la.LinAlgError, OnAxisError, SolverError):
        unit = np.inf
    if not np.isfinite(unit):
        raise SolverError(
            "no controller of least quadratic cost stabilises in rounding: "
            + beyond_rounding(problem)
        )
    if not unit:  # w reaches nothing in z
        return SolvedController(least.A, least.B, least.C, least.D, 0.0, 0.0)
    scaled = problem.measured_in(unit)
    high, low = search(scaled, unit)
    K, norm = _accepted(scaled, high, _REGULAR if back_off is None else back_off)
    notes: tuple[str, ...] = ()
    if K is None:  # a gamma of the problem itself is below what is reached with much added to it
        K, notes = least.replace(C=least.C / unit), (_LEAST,)
        norm = _loop_norm(scaled, K)
    _require_finite_gain(scaled, K, unit * norm)
    return SolvedController(
        K.A, K.B, unit * K.C, unit * K.D, unit * norm, unit * min(low, norm), notes=notes
    )


def _accepted(problem: Prepared, high: float, step: float) -> tuple[StateSpace | None, float]:
    """Return the backed-off controller with the norm of its loop."""
    # next to the optimum rounding puts norms above their gammas, and a controller that misses by
    # much of its distance hangs on rounding: the distance grows until the norm holds
    while step < 1.0:
        controller = _attempt(problem, high * (1.0 + step)).controller
        if controller is not None:
            norm = _loop_norm(problem, controller)
            if norm <= high * (1.0 + step) * (1.0 + FOUR_DIGITS):
                return controller, norm
        step = max(2.0 * step, NEGLIGIBLE)
    return None, 1.0


def _require_finite_gain(problem: Prepared, controller: StateSpace, gamma: float) -> None:
    """Raise InfeasibleError when putting D22 back takes infinite gain at infinite frequency."""
    loop = np.eye(len(problem.y)) + problem.D22 @ controller.D
    if la.svdvals(loop)[-1] < TYPED:
        where = "at half the rate" if problem.dt else "at infinite frequency"
        raise InfeasibleError(
            f"gamma has no minimum: {gamma:.3g} is reached, by infinite gain {where}, where "
            f"u ({', '.join(problem.u)}) acts on y ({', '.join(problem.y)}) directly and cancels w "
            "in z at no cost. Weight the efforts in z, give the sensors noise in w, or give u a "
            "sample of delay or a low-pass."
        )


def _loop_norm(problem: Prepared, controller: StateSpace) -> float:
    return peak_gain(lft(problem.system, controller))[0]


def resonance_gain(problem: Prepared, controller: StateSpace) -> float:
    """Return the largest gain of the loop at its resonances: quick, at most its norm."""
    loop = lft(problem.system, controller)
    through = float(np.linalg.norm(loop.D, 2))
    if not loop.n_states:
        return through
    model, poles = residues(loop)
    poles = loop.poles() if poles is None else poles
    if poles.real.max() >= 0:
        return np.inf
    freq = np.unique(np.concatenate([[0.0], np.abs(poles), np.abs(poles.imag)])) / (2.0 * np.pi)
    gains = responses(loop, freq) if model is None else model.responses(freq)
    return max(float(largest_gains(gains).max()), through)


class _Attempt(NamedTuple):
    """The central controller for a gamma; without one: whether gamma is refuted for good."""

    controller: StateSpace | None
    refuted: bool = False
    #: what X, Y and both together leave until their limit, 0 there; infinite where unknown
    rooms: FloatArray | None = None


def _attempt(problem: Prepared, gamma: float) -> _Attempt:
    """Return the central controller for gamma, or why it does not exist."""
    # refuted means proved, not that the numerics failed: X or Y is indefinite, or rho(X Y) >
    # gamma^2
    known, dual = both_sides(problem)
    rooms, solutions = np.full(3, np.inf), []
    try:
        for i, side in enumerate((known, dual)):
            X, F = side.solution(gamma)
            values, vectors = la.eigh(X)
            rooms[i] = _room(values)
            if side.refutes(X, F, values, vectors):
                return _Attempt(None, True, rooms)
            solutions.append((X, F))
        (X, F), (Y, Ht) = solutions
        values = coupling(X, Y)
        rooms[2] = _room(values) - gamma**-2
        if values.max(initial=0.0) > gamma**2 * (1.0 + FOUR_DIGITS):
            return _Attempt(None, True, rooms)
        return _Attempt(central(problem, gamma, X, F, Y, Ht.T), rooms=rooms)
    except (la.LinAlgError, OnAxisError, FlexplantError):  # near the least gamma one of them fails
        return _Attempt(None)


def _room(values: FloatArray) -> float:
    """Return one over the eigenvalue that ends a solution: smooth in gamma, 0 at the limit."""
    # the largest one becomes infinite at the limit and returns from the negative side beyond
    least, most = np.min(values, initial=0.0), np.max(values, initial=0.0)
    one = float(least if least < -FOUR_DIGITS * most else most)
    return 1.0 / one if abs(one) > ROUNDING else np.inf


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
    small = sizes < NEGLIGIBLE  # of the sensitivity at infinite frequency: taken for zero
    pull = left.T @ U[:, small] @ Vt[small] @ right.T
    W, gains, Xt = la.svd(pull, full_matrices=False)
    reached = gains > ROUNDING * np.max(gains, initial=0.0)
    return np.asarray(0.5 * W[:, reached] @ Xt[reached])


def h2_controller(p: Prepared) -> StateSpace:
    """Return the controller of least H2 norm, feedthrough apart (gamma without bound)."""
    (_, F), (_, Ht) = (side.least_squares() for side in both_sides(p))
    A, D = p.A + p.B2 @ F + Ht.T @ p.C2, np.zeros((len(F), len(Ht)))
    return StateSpace(A, -Ht.T, F, D, inputs=p.y, outputs=p.u)
