"""Costs that are convex in weights of the candidates, and their lower bounds over branches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, product
from math import comb, prod
from typing import TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, IntArray, divisor
from ..errors import SolverError, attempted
from ..estimation.filter_models import weigh
from ..lti.equations import doubled, doubled_riccati, relative, square_root
from ..lti.riccati import riccati_root
from ..store import Value
from ..tolerances import MOST_STEPS, NEGLIGIBLE, RANK, RESIDUAL, SAME, SETTLED, TINY
from .criterion import Scorer

#: tangents of a bound at the root, and the parts of a step between them
_TANGENTS, _HALVES = 20, (1.0, 0.5, 0.25, 0.125, 0.0625)

#: disjoint groups of candidates, and how many of each are chosen
Groups: TypeAlias = tuple[tuple[IntArray, int], ...]


@dataclass(frozen=True, eq=False)
class Branch:
    """All choices with given counts in disjoint groups of candidates, and none elsewhere."""

    groups: Groups

    @classmethod
    def containing(cls, required: Sequence[int], free: Sequence[int], count: int) -> Branch:
        """Return all choices of `count` that hold the required and else any of the free ones."""
        kept, more = np.array(sorted(required), np.int64), np.array(free, np.int64)
        groups = ((kept, kept.size), (more, count - kept.size))
        return cls(tuple((group, count) for group, count in groups if count))

    @property
    def members(self) -> IntArray:
        """Every candidate that appears in a choice."""
        return np.sort(np.concatenate([group for group, _ in self.groups]))

    @property
    def size(self) -> int:
        """How many choices there are."""
        return prod(comb(group.size, count) for group, count in self.groups)

    def choices(self) -> list[tuple[int, ...]]:
        """Return all choices, indices ascending."""
        parts = [combinations(group.tolist(), count) for group, count in self.groups]
        return [tuple(sorted(sum(parts, ()))) for parts in product(*parts)]

    def nearest(self, weights: FloatArray) -> FloatArray:
        """Return the nearest weights (N,) in [0, 1] whose sums over the groups are the counts."""
        found = np.zeros_like(weights)
        for group, count in self.groups:
            found[group] = _capped(weights[group], count)
        return found

    def centre(self, total: int) -> FloatArray:
        """Return equal weights (total,) within each group."""
        found = np.zeros(total)
        for group, count in self.groups:
            found[group] = count / group.size
        return found

    def least(self, slope: FloatArray) -> float:
        """Return the smallest sum of `slope` (N,) over any choice."""
        return float(sum(np.sort(slope[group])[:count].sum() for group, count in self.groups))

    def halves(self, rows: FloatArray, weights: FloatArray) -> Iterator[Branch]:
        """Return the parts that arise when the most diverse group is cut in two."""
        spread = {
            i: _main_variance(rows[group], weights[group])
            for i, (group, count) in enumerate(self.groups)
            if count < group.size
        }
        most = max(spread, key=lambda i: spread[i][0])
        (group, count), along = self.groups[most], spread[most][1]
        order = np.argsort(along, kind="stable")
        heaped = np.cumsum(weights[group][order])
        middle = int(np.searchsorted(heaped, 0.5 * heaped[-1])) + 1
        middle = min(max(middle, 1), group.size - 1)
        low, high = np.sort(group[order[:middle]]), np.sort(group[order[middle:]])
        rest = self.groups[:most] + self.groups[most + 1 :]
        for part in range(max(0, count - high.size), min(count, low.size) + 1):
            counts = ((low, part), (high, count - part))
            yield Branch(rest + tuple((g, c) for g, c in counts if c))


def chosen_rows(sets: Sequence[Sequence[int]], total: int) -> FloatArray:
    """Return a row (m, N) for each choice: 1 for its candidates, 0 for the others."""
    rows = np.zeros((len(sets), total))
    for row, chosen in zip(rows, sets, strict=True):
        row[list(chosen)] = 1.0
    return rows


def _main_variance(rows: FloatArray, weights: FloatArray) -> tuple[float, FloatArray]:
    """Return the weighted variance of rows, and each row's place along its main direction."""
    # those of weight zero are to be cut as well
    weights = weights + 1e-3 * np.max(weights) + TINY
    away = rows - weights @ rows / np.sum(weights)
    _, sizes, directions = np.linalg.svd(np.sqrt(weights)[:, None] * away, full_matrices=False)
    return float(np.sum(sizes**2)), np.asarray(away @ directions[0])


def _capped(values: FloatArray, count: int) -> FloatArray:
    """Return the nearest entries in [0, 1] that sum to count: all shifted alike, then cut off."""
    if count >= values.size:
        return np.ones_like(values)
    kinks = np.sort(np.concatenate([values, values - 1.0]))
    sums = np.clip(values - kinks[:, None], 0.0, 1.0).sum(axis=1)  # falls from the size to 0
    return np.asarray(np.clip(values - np.interp(-count, -sums, kinks), 0.0, 1.0))


def ascended(
    function: Callable[[FloatArray], tuple[float, FloatArray] | None],
    branch: Branch,
    start: FloatArray,
    close: Callable[[float, float], bool],
) -> tuple[float, FloatArray]:
    """Return a number above the function at every choice of a branch, and weights near the largest.

    Projected gradient steps of Barzilai and Borwein [BarzilaiBorwein1988]_. Whatever w is,
    ``h(w) + h'(w) (x - w)`` is above h at every choice x: that is the bound.
    """
    weights, step = branch.nearest(start), 0.0
    most, kept, highest = np.inf, weights, -np.inf
    before: tuple[FloatArray, FloatArray] | None = None
    for _ in range(MOST_STEPS):
        found = function(weights)
        if found is None:
            break
        value, rise = found
        most = min(most, value - branch.least(-rise) - float(rise @ weights))
        if value > highest:
            kept, highest = weights, value
        if close(value, most):
            break
        if before is None:
            # weights move by 0.3 of their range at first
            step = 0.3 / max(float(np.max(np.abs(rise))), TINY)
        else:
            moved, turned = weights - before[0], before[1] - rise
            bend = float(moved @ turned)
            step = float(moved @ moved) / bend if bend > 0 else 2.0 * step
        before = weights, rise
        weights = branch.nearest(weights + step * rise)
        if np.max(np.abs(weights - before[0])) < SETTLED:
            break
    return most, kept


class Below(ABC):
    """A function of weights that is nowhere above a cost of choices."""

    #: effect of each candidate (N, r) on the cost; of like candidates alike
    rows: FloatArray

    @abstractmethod
    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return numbers (m,) below the cost of each choice."""

    @abstractmethod
    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least."""


@dataclass(frozen=True, eq=False)
class Tangent(Below):
    """``tr(F' (I + sum_i (w_i - v_i) Z_i)^-1 F) + constant``: below a cost, equal to it at v.

    The cost is ``tr(S Y(w)^-1 S') + constant``. Its information Y is concave in w, as a matrix, so
    Y is below its tangent at v, and the cost is above the cost of this tangent.
    """

    face: FloatArray
    slopes: FloatArray
    at: FloatArray
    constant: float
    rows: FloatArray

    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return numbers (m,) below the cost of each choice."""
        weights = chosen_rows(sets, self.at.size)
        try:
            solved = np.linalg.solve(self._information(weights), self.face)
        except np.linalg.LinAlgError:
            return np.full(len(sets), -np.inf)
        return safe(np.einsum("ij,mij->m", self.face, solved) + self.constant)

    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least."""
        return least_sum([self], np.ones(1), branch, start)

    def fall(self, weights: FloatArray) -> tuple[float, FloatArray] | None:
        """Return the cost without the constant, and how fast it falls with each weight."""
        try:
            solved = np.linalg.solve(self._information(weights[None])[0], self.face)
        except np.linalg.LinAlgError:
            return None
        cost = float(np.sum(self.face * solved))
        if not cost > 0.0:
            return None
        return cost, np.einsum("ik,nij,jk->n", solved, self.slopes, solved, optimize=True)

    def _information(self, weights: FloatArray) -> FloatArray:
        """Return ``I + sum_i (w_i - v_i) Z_i`` for rows of weights (m, N)."""
        total, n = self.slopes.shape[:2]
        added = (weights - self.at) @ self.slopes.reshape(total, n * n)
        return np.asarray(added.reshape(-1, n, n) + np.eye(n))


def least_sum(
    parts: Sequence[Tangent], shares: FloatArray, branch: Branch, start: FloatArray
) -> tuple[float, FloatArray]:
    """Return a number below ``sum_p share_p cost_p`` in a branch, and weights near the least."""
    # `h = 1 / sum_p share_p (cost_p - constant_p)` is concave in w: a harmonic sum of information
    # that is concave, block by block
    constant = float(shares @ [part.constant for part in parts])

    def inverse(weights: FloatArray) -> tuple[float, FloatArray] | None:
        found = [part.fall(weights) for part in parts]
        if any(one is None for one in found):
            return None
        costs, falls = zip(*(one for one in found if one is not None), strict=True)
        cost = float(shares @ costs)
        return 1.0 / cost, shares @ np.array(falls) / cost**2

    size = abs(constant)
    most, weights = ascended(
        inverse,
        branch,
        start,
        close=lambda h, most: 1.0 / h - 1.0 / most <= NEGLIGIBLE * (1.0 / h + size),
    )
    if not np.isfinite(most):
        return -np.inf, weights
    return float(safe(np.array(1.0 / most + constant))), weights


class Convex(Scorer, ABC):
    """Scores that are a convex cost of weights of the candidates, in [0, 1]: they have bounds."""

    @abstractmethod
    def tangent(self, weights: FloatArray) -> Below:
        """Return the tangent of the cost's information at weights (N,)."""

    @abstractmethod
    def cost(self, weights: FloatArray) -> float:
        """Return the cost at weights (N,); infinite where it has none."""

    def inner_tangent(self, branch: Branch, weights: FloatArray) -> Below | None:
        """Return the tangent at weights of a branch moved slightly inwards; None if none exists.

        A candidate of zero weight does not count in the cost: a rigid-body mode might be missed.
        """
        with attempted("a tangent within the branch", SolverError):
            return self.tangent(0.98 * weights + 0.02 * branch.centre(weights.size))
        return None

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return a lower bound over all choices of `count` candidates: tangent after tangent."""
        free = [i for i in range(self.total) if i not in required]
        return self.relaxation(Branch.containing(required, free, count))[0]

    def relaxation(self, branch: Branch) -> tuple[float, FloatArray]:
        """Return a lower bound over a branch, and weights near the least relaxed cost."""
        # the least weights of a tangent are in a direction in which the cost falls: it is convex,
        # above the tangent and equal to it where they touch. The step is halved until it does fall,
        # for whole steps may jump to and fro
        centre = branch.centre(self.total)
        weights, best, cost = centre, self.everything(), np.inf
        for _ in range(_TANGENTS):
            tangent = self.inner_tangent(branch, weights)
            if tangent is None:
                break
            found, least = tangent.least(branch, weights)
            best = max(best, found)
            for step in _HALVES:
                moved = weights + step * (least - weights)
                lower = self.cost(0.999 * moved + 0.001 * centre)  # inside, where it has a slope
                if lower < cost:
                    break
            if not lower < cost - NEGLIGIBLE * abs(cost) and np.isfinite(cost):
                break
            weights, cost = moved, lower
            if cost - best <= NEGLIGIBLE * abs(cost):
                break
        return best, weights

    def everything(self) -> float:
        """Return a number below the cost of all candidates together."""
        return float(safe(np.array(self.value(range(self.total)))))

    @property
    @abstractmethod
    def total(self) -> int:
        """How many candidates there are."""


def safe(bound: FloatArray) -> FloatArray:
    """Return bounds less what rounding may have added."""
    return np.asarray(bound - SAME * np.abs(bound))


@dataclass(frozen=True, eq=False, repr=False)
class Quadratic(Value, Convex):
    """``J(w) = tr(S X+ S') + constant`` with weights w of the candidates.

    ::

        X = A' X+ A + H,    X+ = (X^-1 + G)^-1,    G = sum_i w_i g_i g_i'

    For a filter X is the covariance of the state before and X+ after the measurement (A is the
    transpose of the plant's), g_i = c_i / (standard deviation of sensor i). For a controller X is
    the cost to go and g_i = b_i / (weight of effort i). More candidates never cost more.
    """

    A: FloatArray
    H: FloatArray
    S: FloatArray
    items: FloatArray
    owned: IntArray
    constant: float

    def value(self, chosen: Sequence[int]) -> float:
        """Return J with some candidates."""
        return float(np.sum(self.terms(chosen))) + self.constant

    def terms(self, chosen: Sequence[int]) -> FloatArray:
        """Return the parts (k,) of J that the rows of S see, without the constant."""
        g, X, S = self.solution(chosen)
        return _quotients(S, X, g)

    def solution(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return g, X and S of some candidates, in the states that are there with them."""
        rows = np.sort(np.asarray(chosen, dtype=np.int64))
        keep = np.ones(self.A.shape[0], dtype=bool)
        if self.owned.size:
            keep[self.owned.ravel()] = False
            keep[self.owned[rows].ravel()] = True
        inner = np.ix_(keep, keep)
        g = _square_root(self.items[rows][:, keep])
        return g, solved(self.A[inner], self.H[inner], g), self.S[:, keep]

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.items.shape[0])

    def cost(self, weights: FloatArray) -> float:
        """Return J at weights (N,); infinite where it has none."""
        g = self._weighted(weights)
        try:
            return float(np.sum(_quotients(self.S, solved(self.A, self.H, g), g))) + self.constant
        except SolverError:
            return np.inf

    def tangent(self, weights: FloatArray) -> Tangent:
        """Return the tangent of the information ``(X+)^-1`` at weights (N,)."""
        # the information is the limit of iterates that are concave in w (a parallel sum is). Its
        # derivative by w_i is `(X+)^-1 D_i (X+)^-1` with the Stein equation
        # `D_i = M D_i M' + X+ g_i g_i' X+`, solved for all i by the eigenvectors of M, or one by
        # one where it lacks some; the adjoint equation `Y = M' Y M + S' S`, by which J falls with
        # w_i by `g_i' X+ Y X+ g_i`, confirms the slopes. Directions of no variance are left out: a
        # compression of an inverse has an inverse that is concave as well
        cost, after, closed, adjoint, seen = self._stationary(weights)
        sizes, axes = np.linalg.eigh(0.5 * (after + after.T))
        kept = sizes > RANK * sizes[-1]
        lost = (self.S @ axes[:, ~kept]) ** 2 @ np.abs(sizes[~kept])
        root = axes[:, kept] * np.sqrt(sizes[kept])
        face, into = root.T @ self.S.T, (root / sizes[kept]).T
        gradient = np.sum((seen @ adjoint) * seen, axis=1)
        most = float(np.max(gradient))
        for slopes in _increments(closed, seen, into):
            found = np.einsum("ik,nij,jk->n", face, slopes, face, optimize=True)
            if np.max(np.abs(found - gradient)) <= RESIDUAL * most:
                break
        else:
            raise SolverError("the derivatives of the Riccati equation are not certain.")
        if float(np.sum(lost)) > RESIDUAL * (cost - self.constant):
            raise SolverError("directions of no variance have a part in the cost.")
        value, vectors = np.linalg.eigh(adjoint)
        rows = seen @ (vectors * np.sqrt(np.maximum(value, 0.0)))
        return Tangent(face, slopes, np.array(weights), self.constant, rows)

    def _stationary(
        self, weights: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return J, X+, M, the adjoint Y and the rows ``g_i' X+`` at weights."""
        g = self._weighted(weights)
        X = solved(self.A, self.H, g)
        left, after = measured(X, g)
        closed = left @ self.A.T
        adjoint = doubled(closed.T, self.S.T @ self.S)
        cost = float(np.sum(_quotients(self.S, X, g))) + self.constant
        return cost, after, closed, adjoint, self.items @ after

    def _weighted(self, weights: FloatArray) -> FloatArray:
        """Return g of the candidates with weights above zero, each times the root of its weight."""
        used = weights > 0
        return _square_root(np.sqrt(weights[used])[:, None] * self.items[used])


def quadratic(
    A: FloatArray,
    H: FloatArray,
    S: FloatArray,
    items: FloatArray,
    *,
    constant: float = 0.0,
    owned: IntArray | None = None,
) -> Quadratic:
    """Return the problem in states in which X, with all candidates, has a unit diagonal."""
    X = _certain(A, H, items)
    s = np.sqrt(divisor(X.diagonal()))
    own = np.zeros((items.shape[0], 0), dtype=np.int64) if owned is None else owned
    return Quadratic(A * s[:, None] / s, H / s / s[:, None], S * s, items * s, own, constant)


def solved(A: FloatArray, H: FloatArray, g: FloatArray) -> FloatArray:
    """Return X of ``X = A' (X^-1 + g' g)^-1 A + H``: doubling, its residual checked."""
    with suppress(SolverError):
        X = doubled_riccati(A, g.T @ g, H, quick=True)[0]
        residual = A.T @ measured(X, g)[1] @ A + H - X
        # closed loops that are barely stable look converged: `riccati_root` distinguishes them
        if relative(residual, float(np.linalg.norm(X))) <= RESIDUAL:
            return X
    return _certain(A, H, g)


def _certain(A: FloatArray, H: FloatArray, g: FloatArray) -> FloatArray:
    """Return X by Newton's steps in square roots, which keep the digits of a soft machine."""
    noise = la.block_diag(square_root(H), np.eye(g.shape[0]))
    L = riccati_root(A.T, g, noise[: len(A)], noise[len(A) :]).L
    return np.asarray(L @ L.T)


def _square_root(g: FloatArray) -> FloatArray:
    """Return as few rows as there are states with the same ``g' g``."""
    return g if g.shape[0] <= g.shape[1] else np.asarray(np.linalg.qr(g, mode="r"))


def _increments(closed: FloatArray, seen: FloatArray, into: FloatArray) -> Iterator[FloatArray]:
    """Yield ``into D_i into'`` (N, m, m) for all i with ``D_i = M D_i M' + s_i s_i'``, two ways."""
    poles, modes = np.linalg.eig(closed)
    try:
        part = np.linalg.solve(modes, seen.T.astype(complex)).T
    except np.linalg.LinAlgError:  # delay lines of a lag lack eigenvectors
        part = np.zeros((0, len(poles)), dtype=complex)
    if len(part):
        sums = part[:, :, None] * (part[:, None, :].conj() / (1.0 - poles[:, None] * poles.conj()))
        turned = into @ modes
        yield (turned @ sums @ turned.conj().T).real
    yield np.array([into @ doubled(closed, np.outer(row, row)) @ into.T for row in seen])


def measured(X: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return I - K g, and X+ as a sum of squares: ``(I - K g) X (I - K g)' + K K'``."""
    gain = _update_gain(X, g)
    left = np.eye(X.shape[0]) - gain @ g
    return left, left @ X @ left.T + gain @ gain.T


def _update_gain(X: FloatArray, g: FloatArray) -> FloatArray:
    """Return K with ``X+ = (I - K g) X``."""
    seen = X @ g.T
    return weigh(seen, g @ seen + np.eye(len(g)))


def _quotients(S: FloatArray, X: FloatArray, g: FloatArray) -> FloatArray:
    """Return the diagonal of ``S X+ S'`` as sums of squares: nothing cancels with good sensors."""
    gain = S @ _update_gain(X, g)
    left = S - gain @ g
    return np.asarray(np.einsum("ij,jk,ik->i", left, X, left) + np.sum(gain**2, axis=1))


@dataclass(frozen=True, eq=False)
class WorstRow(Scorer):
    """``max_a (s_a X+ s_a' + constant_a)`` over the rows of a quadratic cost."""

    costs: Quadratic
    constants: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return the largest term with some candidates."""
        return float(np.max(self.costs.terms(chosen) + self.constants))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the largest bound of any one term, or of their mean: the maximum is above both."""
        S, constants = self.costs.S, self.constants
        parts = [(S[[i]], constant) for i, constant in enumerate(constants.tolist())]
        parts.append((S / np.sqrt(constants.size), float(np.mean(constants))))
        costs = (self.costs.replace(S=rows, constant=constant) for rows, constant in parts)
        return max(cost.bound(count, required) for cost in costs)
