"""Singular problems made regular by a little noise on each sensor and weight on each actuator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray
from ...errors import AssumptionError, FlexplantError, InfeasibleError, SolverError
from ...lti.interconnection import lft
from ...lti.norms import hinf_norm
from ...lti.statespace import StateSpace
from ..controller import SolvedController
from ..preparation import Prepared, normalised

#: a direction of D12 or D21 that is smaller is missing (in a prepared problem the others are 1)
_RANK = 0.5
#: what certificates call the size of what was added
ADDED = "added noise"
#: sizes of what is added, tried in turn: the largest that costs next to nothing in gamma is taken
LEVELS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
#: relative: what a level may cost in gamma, compared with a tenth of it
_COST = 1e-3
#: relative: a smaller gamma that is the same
_SAME = 1e-6
#: gamma falls by so much from level to level where its infimum is zero
_FALL = 0.5
#: and by so much in all
_SMALL = 2e-2
#: a gamma that grows by less from one level to the next has settled, by more it is rounding
_SETTLED = 1.2
#: a fastest pole that grows so much when the level is a tenth has no limit
_GROWTH = 3.0


def missing_ranks(problem: Prepared) -> tuple[str, ...]:
    """Return in words which of D12 and D21 has not full rank, empty for a regular problem."""
    lacking = []
    for name, matrix, names, cause in (
        ("D12", problem.D12, problem.u, "costs nothing in z at high frequencies"),
        ("D21", problem.D21.T, problem.y, "is free of noise in w at high frequencies"),
    ):
        needed = matrix.shape[1]
        rank = int(np.linalg.matrix_rank(matrix, tol=_RANK)) if matrix.size else 0
        if rank < needed:
            lacking.append(
                f"{name} has rank {rank} of {needed}: a combination of {', '.join(names)} {cause}"
            )
    return tuple(lacking)


def require_ranks(lacking: Sequence[str]) -> None:
    """Raise AssumptionError when something is lacking, with the cure of each."""
    if lacking:
        raise AssumptionError(
            f"{'; '.join(lacking)}, and nothing may be added (regularised=False). "
            f"{_remedy(lacking)} Or use Lmi(), which needs no rank."
        )


def _remedy(lacking: Sequence[str]) -> str:
    """Return what to do about what is lacking, that of D21 where only it lacks rank."""
    effort, noise = (any(one.startswith(name) for one in lacking) for name in ("D12", "D21"))
    cures = ["weight the efforts in z"] * (effort or not noise)
    cures += ["give each sensor noise in w"] * (noise or not effort)
    return " and ".join(cures).capitalize() + "."


class Regularised:
    """A problem with noise on each y and effort for each u, `level` of the channel's own size."""

    def __init__(self, problem: Prepared, level: float, states: bool = False) -> None:
        n, nu, ny = problem.A.shape[0], problem.B2.shape[1], problem.C2.shape[0]
        nx = n if states else 0
        B1 = np.hstack([problem.B1, level * np.eye(n)[:, :nx], np.zeros((n, ny))])
        C1 = np.vstack([problem.C1, level * np.eye(n)[:nx], np.zeros((nu, n))])
        effort, noise = (level * np.diag(sizes) for sizes in problem.own_sizes)
        D12 = np.vstack([problem.D12, np.zeros((nx, nu)), effort])
        D21 = np.hstack([problem.D21, np.zeros((ny, nx)), noise])
        D11 = la.block_diag(problem.D11, np.zeros((nu + nx, ny + nx)))
        z_turn, self._u = normalised(D12, np.zeros(nu))
        w_turn, y_scale = normalised(D21.T, np.zeros(ny))
        self._y = y_scale.T
        self.problem = problem.replace(
            B1=B1 @ w_turn,
            B2=problem.B2 @ self._u,
            C1=z_turn.T @ C1,
            C2=self._y @ problem.C2,
            D11=z_turn.T @ D11 @ w_turn,
            D12=z_turn.T @ D12 @ self._u,
            D21=self._y @ D21 @ w_turn,
            D22=self._y @ problem.D22 @ self._u,
            u_scale=problem.u_scale @ self._u,
            y_scale=self._y @ problem.y_scale,
        )

    def restored(
        self, K: SolvedController
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, C, D of a controller of this problem, in the channels of the one given."""
        return K.A, K.B @ self._y, self._u @ K.C, self._u @ K.D @ self._y


class _Found(NamedTuple):
    level: float
    K: StateSpace
    gamma: float

    @property
    def speed(self) -> float:
        return float(np.max(np.abs(self.K.poles()), initial=0.0))


def made_regular(
    problem: Prepared,
    solve: Callable[[Prepared], SolvedController],
    lacking: Sequence[str],
    norm: Callable[[StateSpace], float] = hinf_norm,
) -> SolvedController:
    """Return the controller of a singular problem, found with a little noise and effort added."""
    found: list[_Found] = []
    errors: list[FlexplantError] = []
    for level in LEVELS:
        try:
            found.append(_with_level(problem, solve, norm, level))
        except FlexplantError as error:
            errors.append(error)
            continue
        if len(found) > 1 and found[-2].gamma <= found[-1].gamma * (1.0 + _COST):
            break
    if not found:
        raise next((e for e in errors if isinstance(e, AssumptionError)), errors[0])
    least = min(one.gamma for one in found)
    _require_positive_infimum(problem, found, lacking)
    index = next(i for i, one in enumerate(found) if one.gamma <= least * (1.0 + _COST))
    return _with_notes(found, index, lacking, problem)


def _with_level(
    problem: Prepared,
    solve: Callable[[Prepared], SolvedController],
    norm: Callable[[StateSpace], float],
    level: float,
) -> _Found:
    """Return the controller for one level, judged on the problem itself."""
    regular = Regularised(problem, level)
    try:
        answer = solve(regular.problem)
    except AssumptionError:  # a mode on the stability boundary is missed by w or z
        regular = Regularised(problem, level, states=True)
        answer = solve(regular.problem)
    system = problem.system
    A, B, C, D = regular.restored(answer)
    K = StateSpace(A, B, C, D, inputs=problem.y, outputs=problem.u, dt=system.dt)
    gamma = norm(lft(system, K))
    if not np.isfinite(gamma):
        raise SolverError(
            f"with noise and effort of {level:.0e} added, the controller does not stabilise in "
            "rounding, or a mode that z and w miss stays on the edge of stability. Weight the "
            "efforts and that motion in z, and give each sensor noise in w."
        )
    return _Found(level, K, gamma)


def _require_positive_infimum(
    problem: Prepared, found: Sequence[_Found], lacking: Sequence[str]
) -> None:
    gammas = [one.gamma for one in found]
    least = int(np.argmin(gammas))
    settled = any(later < _SETTLED * gammas[least] for later in gammas[least + 1 :])
    gammas = gammas[: least + 1]
    if len(gammas) < 3 or settled or gammas[-1] > _SMALL * gammas[0]:
        return
    # rounding may hold the last one up
    if gammas[-2] > _FALL * gammas[-3] or gammas[-1] * _SETTLED > gammas[-2]:
        return
    raise InfeasibleError(
        f"there is no smallest gamma: the infimum is 0. With noise and effort of "
        f"{found[0].level:.0e} to {found[least].level:.0e} added, {gammas[0]:.3g} to "
        f"{gammas[-1]:.3g} are reached by ever larger gains, with which u "
        f"({', '.join(problem.u)}) cancels w in z at no cost. {'; '.join(lacking)}. "
        f"{_remedy(lacking)}"
    )


def _with_notes(
    found: Sequence[_Found], index: int, lacking: Sequence[str], problem: Prepared
) -> SolvedController:
    one, finer = found[index], found[min(index + 1, len(found) - 1)]
    K = one.K
    cost = max(one.gamma / finer.gamma - 1.0, 0.0) if finer.gamma else 0.0
    note = (
        f"{'; '.join(lacking)}. Designed with noise of {one.level:.0e} on each sensor and as much "
        "effort of each actuator, relative to the plant's own channels, and verified without them"
    )
    if finer is not one:
        note += (
            f"; a tenth of it gives a gamma {100 * cost:.2g} % smaller"
            if cost > _SAME
            else "; a tenth of it gives no smaller gamma"
        )
    notes = [note + "."]
    if any(
        a.gamma > b.gamma * (1.0 + _SAME) and b.speed > _GROWTH * a.speed
        for a, b in pairwise(found[max(index - 1, 0) : index + 2])
    ):
        notes.append(
            "the smallest gamma is approached by infinite gain only: the controller's fastest pole "
            f"lies at {problem.speed * one.speed:.3g} rad/s and moves on as the added noise falls. "
            f"{_remedy(lacking)[:-1]} to get a slower one."
        )
    certificate = {ADDED: one.level}
    if finer is not one:
        certificate["gamma with a tenth of it"] = finer.gamma
    return SolvedController(K.A, K.B, K.C, K.D, one.gamma, 0.0, certificate, tuple(notes))
