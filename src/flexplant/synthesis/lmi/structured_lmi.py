"""H-infinity synthesis by the projected LMIs, their structure used.

Over symmetric R, S (n, n) and gamma, with N_R = null [B2' D12'], N_S = null [C2 D21]
([GahinetApkarian1994]_, theorem 4.3)::

    min gamma,   -N_R' [A R + R A'  R C1'      B1      ] N_R >= 0,   [R I] >= 0,
                       [C1 R        -gamma I   D11     ]             [I S]
                       [B1'         D11'       -gamma I]

and the same with A', C1', B1', D11', S for N_S. Each side is ``const + U R V' + V R U' + gamma J``
with n columns in U and V, which is what makes the Schur complement of an interior-point step cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray, Value
from ...errors import FlexplantError, SolverError, counted
from ...lti.preparation import Prepared
from ...parallel import Progress
from ...tolerances import RANK
from ..controller import SolvedController
from ..hinf.singular import made_regular
from .interior_point import STEPS, Iterate, smallest
from .lmi_solution import (
    LOOSER,
    NOTHING,
    Candidate,
    Matrices,
    Plant,
    check_cost,
    check_size,
    checked_settings,
    dual_bound,
    first_verified,
    half,
    lqg_states,
    null_space,
    reconstructed,
    same_states,
)

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
        return np.asarray(-weight * np.linalg.lstsq(C @ moved, moved.T @ P, rcond=RANK)[0].T)
    raise SolverError("rounding hides the controller of the LMIs.")


#: rows of the transformed basis matrices that are held at once
_ROWS = 512


class _Side:
    """One projected LMI, ``const + U X V' + V X U' + gamma J >= 0`` in its symmetric X."""

    def __init__(
        self,
        A: FloatArray,
        B1: FloatArray,
        C1: FloatArray,
        D11: FloatArray,
        free: FloatArray,
    ) -> None:
        n, nw, nz = A.shape[0], B1.shape[1], C1.shape[0]
        self.onto = la.block_diag(null_space(free), np.eye(nw))
        self.U = -self.onto.T @ np.vstack([A, C1, np.zeros((nw, n))])
        self.V = self.onto[:n].T.copy()
        fixed = np.zeros((n + nz + nw, n + nz + nw))
        fixed[: n + nz, n + nz :] = np.vstack([B1, D11])
        self.const = half(-2.0 * self.onto.T @ fixed @ self.onto)
        self.J = half(self.onto[n:].T @ self.onto[n:])

    def value(self, X: FloatArray, gamma: float) -> FloatArray:
        moved = self.U @ X @ self.V.T
        return np.asarray(moved + moved.T + gamma * self.J)

    def adjoint(self, W: FloatArray) -> tuple[FloatArray, float]:
        moved = self.V.T @ W @ self.U
        return moved + moved.T, float(np.sum(W * self.J))


class ProjectedLmis:
    """The program ``min gamma`` over y = (R, S, gamma): blocks ``const + linear(y) >= 0``.

    R and S enter by their upper triangles. The multipliers X of the blocks satisfy
    ``adjoint(X) = cost`` at the optimum.
    """

    def __init__(self, plant: Plant) -> None:
        p, n = plant, plant.A.shape[0]
        self.n = n
        self.sides = (
            _Side(p.A, p.B1, p.C1, p.D11, np.hstack([p.B2.T, p.D12.T])),
            _Side(p.A.T, p.C1.T, p.B1.T, p.D11.T, np.hstack([p.C2, p.D21])),
        )
        self._I, self._J = np.triu_indices(n)
        #: a diagonal entry is counted once where an entry beside the diagonal stands twice
        self._once = np.where(self._I == self._J, 0.5, 1.0)
        coupling = np.kron(np.array([[0.0, 1.0], [1.0, 0.0]]), np.eye(n))
        self.const = [self.sides[0].const, self.sides[1].const, coupling]
        self.count = 2 * self._I.size + 1
        self.cost = np.zeros(self.count)
        self.cost[-1] = 1.0

    def start(self, size: float) -> FloatArray:
        """Return y of R = S = size I, gamma = size."""
        y = np.zeros(self.count)
        y[:-1] = size * np.tile(self._I == self._J, 2)
        y[-1] = size
        return y

    def matrices(self, y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return R, S and gamma of y."""
        R, S = np.zeros((2, self.n, self.n))
        for X, part in ((R, y[: self._I.size]), (S, y[self._I.size : -1])):
            X[self._I, self._J] = X[self._J, self._I] = part
        return R, S, float(y[-1])

    def linear(self, y: FloatArray) -> list[FloatArray]:
        """Return the part of each block that is linear in y."""
        R, S, gamma = self.matrices(y)
        first, second = self.sides
        return [first.value(R, gamma), second.value(S, gamma), la.block_diag(R, S)]

    def adjoint(self, W: Sequence[FloatArray]) -> FloatArray:
        """Return the products of symmetric W, one for each block, with the basis of y."""
        n = self.n
        (of_R, gamma_R), (of_S, gamma_S) = (
            side.adjoint(part) for side, part in zip(self.sides, W, strict=False)
        )
        parts = (of_R + W[2][:n, :n], of_S + W[2][n:, n:])
        folded = [(G[self._I, self._J] + G[self._J, self._I]) * self._once for G in parts]
        return np.concatenate([*folded, [gamma_R + gamma_S]])

    def schur(
        self,
        X_roots: Sequence[FloatArray],
        Z_roots: Sequence[FloatArray],
        X: FloatArray,
        Z_inverse: FloatArray,
    ) -> FloatArray:
        """Return ``M_ij = tr(A_i X A_j Z^-1)`` over the basis of y, summed over the blocks."""
        n, N = self.n, self._I.size
        M = np.zeros((self.count, self.count))
        for i, side in enumerate(self.sides):
            own = slice(i * N, (i + 1) * N)
            gamma = (Z_roots[i].T @ side.J @ X_roots[i]).ravel()
            rows = self._transformed(side, X_roots[i], Z_roots[i])
            M[own, own] = rows @ rows.T
            M[own, -1] = M[-1, own] = rows @ gamma
            M[-1, -1] += gamma @ gamma
        x, z = X, Z_inverse
        M[:N, :N] += self._pairs(x[:n, :n], z[:n, :n])
        M[N:-1, N:-1] += self._pairs(x[n:, n:], z[n:, n:])
        M[:N, N:-1] = self._pairs(x[:n, n:], z[n:, :n])
        M[N:-1, :N] = M[:N, N:-1].T
        return M

    def _transformed(self, side: _Side, X_root: FloatArray, Z_root: FloatArray) -> FloatArray:
        """Return ``L_z' (U E V' + V E U') L_x`` for each basis matrix E, one row each.

        The product of two rows is ``tr(A_i X A_j Z^-1)``.
        """
        left = (Z_root.T @ side.U).T, (Z_root.T @ side.V).T
        right = side.V.T @ X_root, side.U.T @ X_root
        size = X_root.shape[0]
        rows = np.empty((self._I.size, size * size))
        for begin in range(0, self._I.size, _ROWS):
            own = slice(begin, begin + _ROWS)
            I, J = self._I[own], self._J[own]  # noqa: E741 - indices of rows and columns
            part = np.zeros((I.size, size, size))
            for a, b in zip(left, right, strict=True):
                part += a[I][:, :, None] * b[J][:, None, :]
                part += a[J][:, :, None] * b[I][:, None, :]
            part *= self._once[own, None, None]
            rows[own] = part.reshape(I.size, -1)
        return rows

    def _pairs(self, P: FloatArray, Q: FloatArray) -> FloatArray:
        """Return ``tr(E_i P E_j Q)`` over the basis of one symmetric matrix (and of another)."""
        I, J = self._I, self._J  # noqa: E741 - indices of rows and columns
        found = np.zeros((I.size, I.size))
        for a, b in ((I, J), (J, I)):
            P_rows, Q_rows = P[b], Q.T[a]
            found += P_rows[:, I] * Q_rows[:, J]
            found += P_rows[:, J] * Q_rows[:, I]
        return found * self._once[:, None] * self._once
