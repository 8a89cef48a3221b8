"""H-infinity synthesis by linear matrix inequalities: no assumption on the ranks of D12 and D21."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from ...checks import Value, checked, positive, whole
from ...errors import FlexplantError, InfeasibleError, SolverError
from ...lti.preparation import Prepared
from ...parallel import Progress
from ..controller import SolvedController
from .lmi_programs import Optimum, moderate_controller, smallest_gamma
from .lmi_solution import (
    LOOSER,
    Candidate,
    Plant,
    check_cost,
    check_size,
    first_verified,
    lqg_states,
    same_states,
)

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
            if found and _settled(_tightest(found)):
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
            if _settled(one) or (number and one.value > 0.99 * scale):
                return
            states, scale = one.plant.scaled(1.0 / one.value), one.value


def _tightest(found: list[Optimum]) -> Optimum:
    return min(found, key=lambda one: one.value - one.lower)


def _settled(one: Optimum) -> bool:
    """Whether the bound is close, in a scale that resolves it."""
    return one.value - one.lower <= _GAP * one.value and one.value > 0.03 * one.scale
