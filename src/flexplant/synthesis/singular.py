"""Singular problems made regular: a little noise on each sensor, effort of each actuator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import AssumptionError, FlexplantError, InfeasibleError, SolverError
from ..lti.interconnection import lft
from ..lti.norms import peak_gain
from ..lti.preparation import Prepared, normalised
from ..lti.statespace import StateSpace
from ..values import FloatArray
from .method import SolvedController

#: a direction of D12 or D21 that is smaller counts as missing (their columns have unit size)
_RANK = 1e-8
#: sizes of what is added, tried in turn: the largest that costs next to nothing in gamma is taken
_LEVELS = (1e-4, 1e-5, 1e-6, 1e-7)
#: where none of these works
_LAST = 1e-3
#: relative: what a level may cost in gamma, compared with a tenth of it
_COST = 2e-3
#: relative: a smaller gamma that is the same
_SAME = 1e-6
#: gamma falls by so much from level to level where its infimum is zero
_FALL = 0.5
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


class Regularised:
    """A problem with noise of size `level` on each y and effort of that size for each u.

    ``[w; v] -> y + level v`` and ``[z; level u]``, in the prepared channels, where the columns of
    [B2; D12] and the rows of [C2, D21] have sizes alike. Any loop has at least the norm that it
    has without them: a gamma that is reached here is reached by the problem itself.

    Parameters
    ----------
    problem : Prepared
        The problem.
    level : float
        Size of noise and effort.
    states : bool
        Also noise on each state and a cost of each: for modes on the stability boundary that w
        does not excite or z does not show.
    """

    def __init__(self, problem: Prepared, level: float, states: bool = False) -> None:
        n, nu, ny = problem.A.shape[0], problem.B2.shape[1], problem.C2.shape[0]
        nx = n if states else 0
        B1 = np.hstack([problem.B1, level * np.eye(n)[:, :nx], np.zeros((n, ny))])
        C1 = np.vstack([problem.C1, level * np.eye(n)[:nx], np.zeros((nu, n))])
        D12 = np.vstack([problem.D12, np.zeros((nx, nu)), level * np.eye(nu)])
        D21 = np.hstack([problem.D21, np.zeros((ny, nx)), level * np.eye(ny)])
        D11 = la.block_diag(problem.D11, np.zeros((nu + nx, ny + nx)))
        z_turn, self._u = normalised(D12, np.ones(nu))
        w_turn, y_scale = normalised(D21.T, np.ones(ny))
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
    claimed: float

    @property
    def speed(self) -> float:
        return float(np.max(np.abs(self.K.poles()), initial=0.0))


def made_regular(
    problem: Prepared,
    solve: Callable[[Prepared], SolvedController],
    lacking: Sequence[str],
) -> SolvedController:
    """Return the controller of a singular problem, found with a little noise and effort added.

    Parameters
    ----------
    problem : Prepared
        The problem; its own loop is what the returned gamma is of.
    solve : callable
        Solves a regular problem.
    lacking : sequence of str
        What makes the problem singular, in words.

    Raises
    ------
    InfeasibleError
        When gamma falls to zero with what is added.
    AssumptionError, SolverError
        When no level gives a controller.
    """
    found: list[_Found] = []
    errors: list[FlexplantError] = []
    for level in (*_LEVELS, _LAST):
        if level == _LAST and found:
            break
        try:
            found.append(_solved(problem, solve, level))
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
    return _with_notes(found[index], found[min(index + 1, len(found) - 1)], lacking, problem)


def _solved(
    problem: Prepared, solve: Callable[[Prepared], SolvedController], level: float
) -> _Found:
    """Return the controller for one level, judged on the problem itself."""
    regular = Regularised(problem, level)
    try:
        answer = solve(regular.problem)
    except AssumptionError:  # a mode on the stability boundary is missed by w or z
        regular = Regularised(problem, level, states=True)
        answer = solve(regular.problem)
    K = StateSpace(*regular.restored(answer), inputs=problem.y, outputs=problem.u)
    loop = lft(problem.system, K)
    if not loop.is_stable:
        raise SolverError(
            f"with noise and effort of {level:.0e} added, the controller does not stabilise in "
            "rounding. Weight the efforts in z and give each sensor noise in w."
        )
    return _Found(level, K, peak_gain(loop)[0], answer.gamma)


def _require_positive_infimum(
    problem: Prepared, found: Sequence[_Found], lacking: Sequence[str]
) -> None:
    gammas = [one.gamma for one in found]
    falls = all(b < _FALL * a for a, b in pairwise(gammas))
    if len(found) < 3 or not falls:
        return
    raise InfeasibleError(
        f"there is no smallest gamma: the infimum is 0. With noise and effort of "
        f"{found[0].level:.0e} to {found[-1].level:.0e} added, {gammas[0]:.3g} to {gammas[-1]:.3g} "
        f"are reached by ever larger gains, with which u ({', '.join(problem.u)}) cancels w in z "
        f"at no cost. {'; '.join(lacking)}. Weight the efforts in z and give the sensors noise "
        "in w."
    )


def _with_notes(
    one: _Found, finer: _Found, lacking: Sequence[str], problem: Prepared
) -> SolvedController:
    K = one.K
    cost = max(one.gamma / finer.gamma - 1.0, 0.0)
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
    if cost > _SAME and finer.speed > _GROWTH * one.speed:
        notes.append(
            "the smallest gamma is approached by infinite gain only: the controller's fastest pole "
            f"lies at {problem.speed * one.speed:.3g} rad/s and moves on as the added noise falls. "
            "Weight the efforts and give the sensors noise to get a slower one."
        )
    certificate = {"added noise": one.level}
    if finer is not one:
        certificate["gamma with a tenth of it"] = finer.gamma
    return SolvedController(K.A, K.B, K.C, K.D, one.gamma, 0.0, certificate, tuple(notes))
