"""H-infinity synthesis by two Riccati equations, verified by the closed loop's norm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import Value, checked, positive
from ...errors import (
    AssumptionError,
    FlexplantError,
    InfeasibleError,
    ModelError,
    SolverError,
    attempted,
)
from ...lti.equations import OnAxisError
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...lti.preparation import Prepared
from ...lti.responses import responses
from ...lti.statespace import StateSpace
from ...parallel import Progress
from ..controller import SolvedController
from ..synthesis_plants import beyond_rounding
from .central import central, h2_controller, is_indefinite, riccati_solutions
from .lower_bound import parrott
from .singular import LEVELS, Regularised, made_regular, missing_ranks, require_ranks

#: distances from the smallest gamma: 5 % of it cost 3 to 5 % of rms and 0.02 of margin; near it
#: gains stay finite where D12 and D21 have full rank, and grow without bound where they have not
_REGULAR, _SINGULAR = 0.01, 0.05
#: relative width at which the bisection of a step of a search stops
_QUICK = 0.005
#: steps of the bisection, and of going up from its result
_BISECTION, _GROWTH = 60, 12
#: a norm beside that of the least quadratic cost at which nothing is left to gain
_NOTHING = 1e-9
#: sensitivity at infinite frequency that is taken for zero
_ILL_POSED = 1e-6
#: relative: by how much rounding may put a gain above its gamma; what is nothing but rounding
_SLACK, _ROUNDING = 1e-6, 1e-14


@dataclass(frozen=True, eq=False)
class Riccati(Value):
    """Synthesis by the two Riccati equations of Glover and Doyle, gamma by bounded bisection.

    The search begins at the norm of the loop with least quadratic cost, which exists whenever any
    controller does. A gamma counts as reached only by the closed loop that it gives: stable, its
    gains below gamma. The controller is taken back_off above the smallest one (at the optimum it
    is fast and badly conditioned, and gains nothing) when the exact norm of its loop holds. The
    lower bound is the largest gamma that was refuted, not the largest that failed.

    The equations need D12 and D21 of full rank, and z and w that miss no mode on the stability
    boundary. A problem without these, or on which they fail, is solved with a little noise on each
    sensor and a little effort of each actuator added, 1e-3 of what the plant itself does there or
    less; the loop is verified without them. The notes and the certificate say what was added and
    what it costs in gamma.

    Parameters
    ----------
    back_off : float, optional
        Relative distance from the smallest gamma found. Unless given 1 % where D12 and D21 have
        full rank, and 5 % where noise and effort are added.
    tolerance : float
        Relative width at which the bisection stops.
    regularised : bool, optional
        True adds noise and effort to any problem, False to none; None decides as above.
    progress : bool, optional
        True shows a bar of the bisection at once, False never; None after two seconds on a
        terminal.

    Raises
    ------
    ModelError
        When a value is not positive.

    References
    ----------
    [GloverDoyle1988]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lowpass(0.1), KS=0.1)
    >>> fx.design_hinf(sys, fx.Riccati(tolerance=1e-2)).gamma < 1
    True
    """

    back_off: float | None = field(default=None, metadata=checked(positive, zero=True))
    tolerance: float = field(default=1e-3, metadata=checked(positive))
    regularised: bool | None = None
    progress: bool | None = None

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller of a prepared problem.

        Raises
        ------
        AssumptionError
            When z or w misses a mode on the stability boundary, or D12 or D21 has not full rank
            and nothing may be added.
        InfeasibleError
            When gamma has a greatest lower bound that only infinite gain reaches.
        SolverError
            When the plant is too badly conditioned to be stabilised in rounding.
        """
        lacking = missing_ranks(problem)
        if self.regularised is False:
            require_ranks(lacking)
            return self._regular(problem, _REGULAR)
        if not lacking and self.regularised is None:
            try:
                return self._regular(problem, _REGULAR)
            except (AssumptionError, SolverError) as error:
                lacking = (str(error).rstrip("."),)
        return made_regular(problem, lambda regular: self._regular(regular, _SINGULAR), lacking)

    def _regular(self, problem: Prepared, back_off: float) -> SolvedController:
        # the least quadratic cost stabilises: its norm is where the search for less begins
        try:
            least = h2_controller(problem)
            unit = _resonance_gain(problem, least)
        except (la.LinAlgError, SolverError):
            unit = np.inf
        if not np.isfinite(unit):
            raise SolverError(
                "no controller of least quadratic cost stabilises in rounding: "
                + beyond_rounding(problem)
            )
        if unit <= _ROUNDING * _open_size(problem):  # w reaches nothing in z
            return SolvedController(least.A, least.B, least.C, least.D, 0.0, 0.0)
        scaled = problem.measured_in(unit)
        with Progress(_BISECTION, "steps of the bisection", progress=self.progress) as bar:
            # what the equations promise of a step is seen at the end; where it does not hold there
            # they are at their rounding, and each step is seen
            high, low = self._searched(scaled, bar, _stable)
            controller, norm, held = self._accepted(scaled, high, back_off)
            if not held:
                high, low = self._searched(scaled, bar, _below)
                controller, norm, _ = self._accepted(scaled, high, back_off)
        if controller is None:  # nothing below it holds
            controller = least.replace(C=least.C / unit)
            norm = _loop_norm(scaled, controller)
        _require_finite_gain(scaled, controller, unit * norm)
        return SolvedController(
            controller.A,
            controller.B,
            unit * controller.C,
            unit * controller.D,
            unit * norm,
            unit * min(low, norm),
        )

    def _searched(
        self,
        problem: Prepared,
        bar: Progress,
        holds: Callable[[Prepared, StateSpace, float], bool],
    ) -> tuple[float, float]:
        """Return the smallest gamma that bisection reached from 1, and the largest refuted one.

        One is reached where there is a controller, whose loop `holds` for it.
        """
        high = 1.0
        low = tried = min(_direct_bound(problem), high)
        for _ in range(_BISECTION):
            if high <= tried * (1.0 + self.tolerance) or high < _NOTHING:
                break
            middle = float(np.sqrt(max(tried, 1e-2 * high) * high))
            attempt = _attempt(problem, middle)
            bar.advance()
            K = attempt.controller
            if K is not None and holds(problem, K, middle):
                high = middle
                continue
            tried = middle
            if attempt.refuted:
                low = middle
        return high, low

    def _accepted(
        self, problem: Prepared, high: float, back_off: float
    ) -> tuple[StateSpace | None, float, bool]:
        """Return the backed-off controller with the norm of its loop, going up until it holds.

        And whether it held at once.
        """
        step = back_off if self.back_off is None else self.back_off
        for number in range(_GROWTH):
            gamma = high * (1.0 + step)
            controller = _attempt(problem, gamma).controller
            if controller is not None:
                norm = _loop_norm(problem, controller)
                if norm <= gamma * (1.0 + _SLACK):
                    return controller, norm, number == 0
            step = max(2.0 * step, self.tolerance)
        return None, 1.0, False


def quick_answer(problem: Prepared) -> SolvedController:
    """Return a controller near the smallest gamma, not verified: for the steps of a search.

    Where ranks are missing with the most noise and effort that `made_regular` adds; gains are seen
    at resonances alone.
    """
    regular = Regularised(problem, LEVELS[0]) if missing_ranks(problem) else None
    given = problem if regular is None else regular.problem
    least = h2_controller(given)
    unit = _resonance_gain(given, least)
    if not np.isfinite(unit):
        raise SolverError("no controller of least quadratic cost stabilises in rounding.")
    scaled, K = given.measured_in(unit), None
    step = _REGULAR if regular is None else _SINGULAR
    with Progress(_BISECTION, "steps of the bisection", progress=False) as bar:
        high = Riccati(tolerance=_QUICK)._searched(scaled, bar, _below)[0]
    for _ in range(_GROWTH):
        gamma = high * (1.0 + step)
        K = _attempt(scaled, gamma).controller
        if K is not None and _resonance_gain(scaled, K) <= gamma * (1.0 + _SLACK):
            break
        K, step = None, 2.0 * step
    K, gain = (least, 1.0) if K is None else (K, unit)
    found = SolvedController(K.A, K.B, gain * K.C, gain * K.D, unit * high, 0.0)
    if regular is None:
        return found
    return SolvedController(*regular.restored(found), found.gamma, 0.0)


def _require_finite_gain(problem: Prepared, controller: StateSpace, gamma: float) -> None:
    """Raise InfeasibleError when putting D22 back takes infinite gain at infinite frequency."""
    loop = np.eye(len(problem.y)) + problem.D22 @ controller.D
    if la.svdvals(loop)[-1] < _ILL_POSED:
        where = "at half the rate" if problem.dt else "at infinite frequency"
        raise InfeasibleError(
            f"there is no smallest gamma: {gamma:.3g} is reached, by infinite gain {where}, where "
            f"u ({', '.join(problem.u)}) acts on y ({', '.join(problem.y)}) directly and cancels w "
            "in z at no cost. Weight the efforts in z, give the sensors noise in w, or give u a "
            "sample of delay or a low-pass."
        )


def _open_size(problem: Prepared) -> float:
    """Return the size of the way from w to z: a norm far below it is rounding."""
    inner = float(np.linalg.norm(problem.A)) or 1.0
    way = float(np.linalg.norm(problem.C1) * np.linalg.norm(problem.B1)) / inner
    return way + float(np.linalg.norm(problem.D11))


def _direct_bound(problem: Prepared) -> float:
    """Return the bound that the feedthrough alone puts on gamma (Glover and Doyle, (i))."""
    D, m2, p2 = problem.D11, problem.B2.shape[1], problem.C2.shape[0]
    rows, columns = D.shape[0] - m2, D.shape[1] - p2
    parts = (D[:rows], D[:, :columns])
    sizes = [float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in parts]
    return max(sizes)


def _bound_at(problem: Prepared, omega: float) -> float:
    """Return a lower bound of gamma at one frequency, 0 at an undamped pole."""
    try:
        P = problem.system.evaluated(1j * omega)
    except ModelError:
        return 0.0
    return float(parrott(P[None], problem.B1.shape[1], problem.C1.shape[0])[0])


def _loop_norm(problem: Prepared, controller: StateSpace) -> float:
    return peak_gain(lft(problem.system, controller))[0]


def _resonance_gain(problem: Prepared, controller: StateSpace) -> float:
    """Return the largest gain of the loop at its resonances: quick, at most its norm."""
    try:
        loop = lft(problem.system, controller)
    except FlexplantError:
        return np.inf
    if not loop.n_states:
        return float(np.linalg.norm(loop.D, 2))
    poles = loop.poles()
    if poles.real.max() >= 0:
        return np.inf
    freq = np.unique(np.concatenate([[0.0], np.abs(poles), np.abs(poles.imag)])) / (2.0 * np.pi)
    gains = np.linalg.norm(responses(loop, freq).transpose(2, 0, 1), 2, axis=(1, 2))
    return max(float(gains.max()), float(np.linalg.norm(loop.D, 2)))


def _below(problem: Prepared, controller: StateSpace, gamma: float) -> bool:
    """Return whether the gains of the loop at its resonances are below gamma."""
    return _resonance_gain(problem, controller) <= gamma * (1.0 + _SLACK)


def _stable(problem: Prepared, controller: StateSpace, _gamma: float) -> bool:
    """Return whether the loop is stable."""
    with attempted("a loop of the bisection"):
        return bool(lft(problem.system, controller).is_stable)
    return False


class _Attempt(NamedTuple):
    """The central controller for a gamma; without one: whether gamma is refuted for good."""

    controller: StateSpace | None
    refuted: bool = False


def _attempt(problem: Prepared, gamma: float) -> _Attempt:
    """Return the central controller for gamma, or why there is none."""
    # refuted means proved, not that the numerics failed: X or Y is indefinite, or rho(X Y) >
    # gamma^2
    try:
        X, F, Y, H = riccati_solutions(problem, gamma)
    except OnAxisError as found:
        # these frequencies are witnesses: the bound there is gamma
        return _Attempt(
            None, any(_bound_at(problem, w) >= gamma * (1 - _SLACK) for w in found.omega)
        )
    except (la.LinAlgError, ValueError, SolverError):
        return _Attempt(None)
    coupling = float(np.max(la.eigvals(X @ Y).real, initial=0.0))
    speed = float(np.linalg.norm(problem.A)) or 1.0
    sizes = (float(np.linalg.norm(part)) ** 2 / speed for part in (problem.C1, problem.B1))
    # as accurate as X and Y are
    if any(map(is_indefinite, (X, Y), sizes)) or coupling > gamma**2 * (1.0 + 1e-5):
        return _Attempt(None, True)
    try:
        return _Attempt(central(problem, gamma, X, F, Y, H))
    except (la.LinAlgError, FlexplantError):
        return _Attempt(None)
