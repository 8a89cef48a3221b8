"""H-infinity synthesis by the projected LMIs, their structure used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import FlexplantError, SolverError, counted
from ..lti.preparation import Prepared
from ..parallel import Progress
from ..values import FloatArray, Value
from .interior_point import STEPS, Iterate, smallest
from .lmi_method import (
    LOOSER,
    NOTHING,
    Candidate,
    check_cost,
    check_size,
    checked_settings,
    first_verified,
)
from .lmi_plant import Plant, half, lqg_states, same_states
from .lmi_solution import Matrices, dual_bound, reconstructed
from .method import SolvedController
from .projected_lmis import ProjectedLmis
from .singular import made_regular

#: R, S, gamma and the blocks of the LMIs at the start, in a plant scaled to gamma near 1
_START = 10.0
#: the lower bound holds for controllers whose R and S are larger than those found by this factor
LARGER = 10.0
#: gamma, beside the scale it is sought in, that is sought again in its own scale, unless the
#: relative gap to the lower bound is settled
_ROUGH, _SETTLED = (0.1, 10.0), 1e-3
#: points tried for each back-off
_POINTS = 3
#: steps of the search for a weight of an eliminated variable, each by this factor
_WEIGHTS, _FACTOR = 60, 4.0


@dataclass(frozen=True, eq=False)
class StructuredLmi(Value):
    """Synthesis by linear matrix inequalities (LMIs), with an interior-point method of their own.

    The projected LMIs in R, S and gamma (Gahinet and Apkarian), whose n (n + 1) + 1 unknowns
    meet in one Cholesky factor of that size in each step. Needs a stabilising controller to exist
    and nothing else: efforts without weight, sensors without noise and modes on the stability
    boundary are allowed. About 1 s at 24 states and 15 s at 48.

    The controller is that of a point on the central path, where R and S are moderate, with gamma
    within back_off of the smallest. Where rounding hides it (D12 and D21 lack rank, and its gains
    are close to infinite), that of the problem with a little noise and effort, as for `Riccati`.

    Parameters
    ----------
    back_off : float
        Relative distance of gamma from the smallest one, at which gains may be infinite. Doubled
        up to three times where no controller keeps the target.
    tolerance : float
        Relative gap between gamma and its lower bound at which the search stops.
    max_states : int
        Larger problems are refused.
    progress : bool, optional
        True shows a bar of the steps at once, False never; None after two seconds on a terminal.

    Raises
    ------
    ModelError
        When a value is not positive.

    References
    ----------
    [GahinetApkarian1994]_; [Helmberg1996]_; [IwasakiSkelton1994]_ (the eliminated variables).

    Examples
    --------
    >>> import flexplant as fx
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lowpass(0.1), KS=0.1)
    >>> fx.design_hinf(sys, fx.StructuredLmi()).gamma < 1
    True
    """

    back_off: float = 0.05
    tolerance: float = 1e-6
    max_states: int = 80
    progress: bool | None = None

    def __post_init__(self) -> None:
        self._set(**checked_settings(self))

    def solve(self, problem: Prepared) -> SolvedController:
        """Return the controller of a prepared problem.

        `lower` is a bound by weak duality from multipliers repaired to satisfy their equations;
        it holds for all controllers whose Lyapunov matrices are no more than ten times as large
        as those found.

        Raises
        ------
        ModelError
            When the problem has no states, or more than max_states.
        InfeasibleError
            When no gamma is smallest.
        SolverError
            When the method stops early, or no controller satisfies what the LMIs claim.
        """
        found = self.smallest(problem)
        try:
            return self.controller(problem, found)
        except SolverError as error:
            hidden = f"the LMIs give gamma = {found.value:.6g}, whose controller rounding hides"
            try:
                K = made_regular(problem, self._plain, (hidden,))
            except SolverError:
                raise error from None
            return K._replace(lower=min(found.lower, K.gamma))

    def _plain(self, problem: Prepared) -> SolvedController:
        return self.controller(problem, self.smallest(problem))

    def controller(self, problem: Prepared, found: SmallestGamma) -> SolvedController:
        """Return the controller for the smallest gamma that was found.

        Raises
        ------
        SolverError
            When no controller satisfies what the LMIs claim.
        """
        candidates = [
            Candidate(f"{target:.6g}", target, partial(_controller_at, found, point))
            for part in self.back_off * LOOSER
            for point in found.points_below(1.0 + part)[:_POINTS]
            for target in [found.scale * float(point.y[-1])]
        ]
        return first_verified(problem, found.value, found.lower, candidates)

    def smallest(self, problem: Prepared) -> SmallestGamma:
        """Return the smallest gamma of the LMIs with its lower bound, without a controller.

        Raises
        ------
        ModelError, InfeasibleError, SolverError
            As for `solve`.
        """
        check_size(self, problem)
        plant = Plant.of(problem)
        guess = scale = plant.size()
        failures: list[FlexplantError] = []
        for states in (lqg_states, same_states):
            try:
                start = states(plant.scaled(guess).with_unit_channels())  # whatever the unit of z
                for _ in range(3):
                    found = self._solved(start.scaled(scale / guess), scale)
                    low, high = _ROUGH
                    settled = found.value - found.lower <= _SETTLED * found.value
                    if settled or low < found.value / scale < high:
                        break
                    if found.value < NOTHING * guess:
                        break
                    scale = found.value
                break
            except (SolverError, la.LinAlgError) as error:
                failures.append(SolverError(str(error)))
        else:
            raise failures[0]
        check_cost(found.value, guess)
        return found

    def _solved(self, plant: Plant, scale: float) -> SmallestGamma:
        program = ProjectedLmis(plant)
        with Progress(STEPS, "steps of the LMIs", progress=self.progress) as bar:
            points = smallest(program, program.start(_START), _START, self.tolerance, bar.advance)
        feasible = [one for one in points if _holds(program, one.y)]
        if not feasible:
            raise SolverError(
                "the LMIs were not solved: no point satisfies them after "
                f"{counted(len(points), 'step')} (missed by {points[-1].primal_residual:.1e}, "
                f"{counted(program.n, 'state')}). Does u reach and y see every unstable mode? If "
                "so, loosen weights or reduce the order."
            )
        best = min(feasible, key=lambda one: float(one.y[-1]))
        R, S, value = program.matrices(best.y)
        lower = max(_bound(program, plant, one.X, R, S) for one in points)
        return SmallestGamma(
            scale * value,
            scale * min(lower, value),
            scale,
            plant,
            program,
            feasible,
        )


class SmallestGamma(NamedTuple):
    """The smallest gamma, its lower bound, and the points on the way that satisfy the LMIs."""

    value: float
    lower: float
    scale: float
    plant: Plant
    program: ProjectedLmis
    points: Sequence[Iterate]

    def points_below(self, factor: float) -> list[Iterate]:
        """Return the points with gamma at most factor times the smallest, the first one first."""
        limit = factor * self.value / self.scale
        return [one for one in self.points if one.y[-1] <= limit]


def _holds(program: ProjectedLmis, y: FloatArray) -> bool:
    """Return whether each block is positive definite at y."""
    try:
        for const, moved in zip(program.const, program.linear(y), strict=True):
            la.cholesky(const + moved)
    except la.LinAlgError:
        return False
    return True


def _bound(
    program: ProjectedLmis, plant: Plant, X: Sequence[FloatArray], R: FloatArray, S: FloatArray
) -> float:
    """Return the lower bound on gamma that multipliers give."""
    U, V = (side.onto @ part @ side.onto.T for side, part in zip(program.sides, X, strict=False))
    return dual_bound(plant, U, V, LARGER * S, LARGER * R)


def _controller_at(found: SmallestGamma, point: Iterate) -> Matrices:
    return _controller(found.plant, *found.program.matrices(point.y))


def _controller(plant: Plant, R: FloatArray, S: FloatArray, gamma: float) -> Matrices:
    """Return a controller for R, S and gamma: D, then the columns of C, then the rows of B.

    Each is eliminated from an LMI that the projected ones guarantee a solution of.
    """
    p, n = plant, plant.A.shape[0]
    nw, nz = p.B1.shape[1], p.C1.shape[0]
    inner = np.block([[-gamma * np.eye(nw), p.D11.T], [p.D11, -gamma * np.eye(nz)]])
    D = _eliminated(
        inner,
        np.vstack([np.zeros((nw, p.D12.shape[1])), p.D12]),
        np.hstack([p.D21, np.zeros((p.D21.shape[0], nz))]),
    )
    D11 = p.D11 + p.D12 @ D @ p.D21
    B1, C1 = p.B1 + p.B2 @ D @ p.D21, p.C1 + p.D12 @ D @ p.C2
    state = np.hstack([np.eye(n), np.zeros((n, nw + nz))])
    C = _eliminated(
        _bordered(p.A @ R + R @ p.A.T, B1, R @ p.C1.T, D11, gamma),
        np.vstack([p.B2, np.zeros((nw, p.B2.shape[1])), p.D12]),
        state,
    )
    B = _eliminated(
        _bordered(S @ p.A + p.A.T @ S, S @ p.B1, C1.T, D11, gamma),
        np.hstack([p.C2, p.D21, np.zeros((p.C2.shape[0], nz))]).T,
        state,
    ).T
    return reconstructed(p, gamma, S, R, B, C, D)


def _bordered(
    corner: FloatArray, w: FloatArray, z: FloatArray, D: FloatArray, gamma: float
) -> FloatArray:
    nw, nz = w.shape[1], z.shape[1]
    return np.block(
        [
            [half(corner), w, z],
            [w.T, -gamma * np.eye(nw), D.T],
            [z.T, D, -gamma * np.eye(nz)],
        ]
    )


def _eliminated(Q: FloatArray, P: FloatArray, C: FloatArray) -> FloatArray:
    """Return K with ``Q + P K C + (P K C)' < 0`` ([Skelton1998]_, theorem 2.3.12).

    ``K = -r P' F C' (C F C')^-1`` with ``F = (r P P' - Q)^-1`` positive definite.
    """
    size = float(np.linalg.norm(P, 2)) ** 2
    if size == 0.0 or not np.any(C):
        return np.zeros((P.shape[1], C.shape[0]))
    weight = 1e-2 * float(np.linalg.norm(Q, 2)) / size
    for _ in range(_WEIGHTS):
        try:
            factor = la.cho_factor(weight * P @ P.T - Q, lower=True)
        except la.LinAlgError:
            weight *= _FACTOR
            continue
        weight *= _FACTOR  # away from the boundary
        factor = la.cho_factor(weight * P @ P.T - Q, lower=True)
        moved = la.cho_solve(factor, C.T)
        return np.asarray(-weight * np.linalg.lstsq(C @ moved, moved.T @ P, rcond=1e-13)[0].T)
    raise SolverError("rounding hides the controller of the LMIs.")
