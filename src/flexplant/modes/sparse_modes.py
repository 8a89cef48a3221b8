"""The lowest modes of a large sparse structure, with a count that shows that all are found."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import COLUMNS, FloatArray, IntArray, Matrix, Rng
from ..certificates import Certificate, Verified
from ..errors import ModelError, SolverError, counted
from ..parallel import expect, one_thread, tick
from ..sparse.factor import LARGEST_FULL
from ..sparse.lowest import BLOCK, EXTRA, STEPS, BlockLanczos, along_basis, iterated
from ..sparse.other_factors import Cholmod
from ..sparse.symmetric import SPREAD, Absolute, by_rows, column_groups, rayleigh_ritz, rounding_of
from ..structure.definite import are_rigid, check_stiffness
from ..structure.model import FEModel
from ..tolerances import MOST_STEPS, NULL, PRECISION, ROOT
from .statics import (
    CountingFactor,
    StiffnessFactor,
    counting_factor,
    dissection_of,
    modes_below,
    search_factor,
    stiffness_factor,
)

#: relative distance of omega^2 below which values form one group
_GAP = ROOT
#: cost of a mode in multiplications, per DOF and per entry of the factor: measured on solids and
#: plates of 6 615 to 22 326 DOFs, where memory access limits the speed
_EACH_DOF, _EACH_ENTRY = 5e4, 40.0
#: residual relative to ||K phi|| above which Lanczos continues, unless it is rounding
_RESIDUAL = NULL
#: residuals below this number of roundings of K phi are not reduced by more steps, and values
#: within it form one group
_ROUNDINGS = 10.0
#: error of Ritz vectors, relative to the accepted residuals, at which Lanczos stops. The last of
#: many copies of a mode appear late, since each search begins with the remainder of the previous
#: one
_PARTS = (1.0, *[0.03] * 5)


@one_thread()
def counted_modes(
    model: FEModel, count: int, top: float = np.inf, method: Cholmod | None = None
) -> tuple[FloatArray, FloatArray, Certificate]:
    """Return the lowest elastic modes with omega^2 up to `top`, and what was counted."""
    # Lanczos finds them and a Sturm count in a gap above gives their number; missing modes are
    # searched with the found ones locked
    n, r = model.rigid_body.shape
    new = search_factor
    factor: StiffnessFactor | CountingFactor | None = None
    below = None
    if np.isfinite(top):
        tried = method is None
        factor = counting_factor(model, top) if tried else None
        below = modes_below(model, top, single=not tried) if factor is None else factor.below
        below -= r
        if below <= 0:
            return np.zeros(0), np.zeros((n, 0)), _certificate(top, r, r)
        if count < below:
            factor = None  # its shift is far above the last wanted mode
        count = min(count, below)
        if count > LARGEST_FULL:
            raise ModelError(
                f"below {np.sqrt(top) / (2 * np.pi):.6g} Hz this model of {n} DOFs has {below} "
                f"elastic modes: more than {LARGEST_FULL} are not solved for at once. Choose a "
                "lower frequency, or for the lowest ones with count=."
            )
    order = dissection_of(model)
    expect(2 * order.multiplications + count * (_EACH_DOF * n + _EACH_ENTRY * order.n_factor))
    squares, phi = np.zeros(0), np.zeros((n, 0))
    counted, sure, shift = 0, 0, 0.0
    missing = min(count + EXTRA, n - r)
    for search in range(MOST_STEPS):
        factor = factor or new(model, method)
        locked = np.hstack([model.rigid_body, phi])
        try:
            found = _search(model, factor, locked, missing, search)
        except SolverError:
            if not factor.single:
                raise
            # soft modes next to stiff ones need double precision
            factor, new = None, stiffness_factor
            factor = new(model, method)
            found = _search(model, factor, locked, missing, search)
        squares, phi = _merge_modes(model, phi, *found)
        rounding = rounding_of(model.K, phi)
        # a rigid-body motion that is not free is held by springs, which rounding does not hide
        suspended = are_rigid(model.M, model.body_motions, phi)
        least = np.where(suspended, 0.0, rounding)
        expected = model.body_motions.shape[1]
        check_stiffness(squares, phi, least, model.rigid_body, model.dofs, suspended, expected)
        # the count needs the memory
        factor = None
        if below == count and _is_gap(squares, count, top, rounding):
            counted, sure, shift = count, count, top
        else:
            sure, shift = _widest_gap(squares, count, rounding)
            if not sure and squares.size == n - r:
                sure, shift = squares.size, 2 * float(squares[-1])
            if not sure:
                # more copies of one mode than were found: no other mode may lie below them
                sure, shift = _gap_below(squares, count, rounding)
                if not shift:
                    missing = min(squares.size, n - r - squares.size)
                    continue
            counted = modes_below(model, shift) - r
        if counted == sure:
            return squares[:count], phi[:, :count], _certificate(shift, counted + r, sure + r)
        if counted < sure:
            break
        missing = min(counted - sure + EXTRA, n - r - squares.size)
    raise SolverError(
        (
            f"below {np.sqrt(shift) / (2 * np.pi):.6g} Hz a Sturm count finds {counted + r} modes, "
            f"{sure + r} were found"
            if shift
            else f"above mode {count + r} no gap is found to count modes in"
        )
        + ": closely repeated frequencies. Request some more or fewer modes."
    )


def _certificate(shift: float, counted: int, found: int) -> Certificate:
    """Return how many modes there are below a frequency, by the signs of a factor (Sylvester)."""
    return Certificate(
        (
            Verified("shift", float(np.sqrt(shift) / (2 * np.pi)), "frequency [Hz] of the count"),
            Verified("counted", float(counted), "signs of the factor of K - shift M"),
            Verified("found", float(found), "", float(counted), at_least=True),
        )
    )


def _merge_modes(
    model: FEModel, known: FloatArray, squares: FloatArray, phi: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 and shapes of modes known before and of those found in addition."""
    if not known.shape[1]:
        return squares, phi
    return rayleigh_ritz(model.K, model.M, np.hstack([known, phi]))


def _search(
    model: FEModel,
    factor: StiffnessFactor | CountingFactor,
    locked: FloatArray,
    want: int,
    rng: Rng,
) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 and shapes (n, want) next to the locked ones, residuals down to rounding."""
    # soft modes first: they are locked, and a new search finds those that their rounding hides
    held, block = model.body_motions, BLOCK
    start = None if locked.shape[1] >= held.shape[1] else held
    squares, found = _search_once(model, factor, locked, want, rng, start)
    while 0 < found.shape[1] < want:
        known, missing = np.hstack([locked, found]), want - found.shape[1]
        # a block of vectors finds at most as many copies of a repeated mode as it has vectors
        block = min(2 * block, max(block, missing))
        more = _search_once(model, factor, known, missing, rng, None, block)
        if not more[0].size:
            break
        squares, found = _merge_modes(model, found, *more)
    return squares, found


def _search_once(
    model: FEModel,
    factor: StiffnessFactor | CountingFactor,
    locked: FloatArray,
    want: int,
    rng: Rng,
    start: FloatArray | None,
    block: int = BLOCK,
) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 and shapes, up to `want`, of one search."""
    extra = min(EXTRA, want - 1)
    mass, stiffness = by_rows(model.M), by_rows(model.K)
    if factor.single:
        davidson = BlockDavidson(
            factor.solve, stiffness, mass, factor.sigma, locked, want=want, rng=rng, start=start
        )
        phi = davidson.modes(want, extra, partial(_tolerance, stiffness, 0.5))
        squares, phi = rayleigh_ritz(stiffness, mass, phi)
        if _excess(stiffness, mass, squares[: want - extra], phi, 0.0) > 1:
            raise SolverError("modes found with a factor in single precision are not accurate.")
        return squares, phi
    lanczos = BlockLanczos(
        factor.solve, model.M, locked, want=want, rng=rng, block=block, start=start
    )
    best, squares, found = np.inf, np.zeros(0), np.zeros((locked.shape[0], 0))
    for part in _PARTS:
        steps = lanczos.steps
        needed = partial(_tolerance, stiffness, part)
        _, phi = lanczos.lowest(want, extra=extra, needed=needed)
        if steps == lanczos.steps:
            break
        iterated(factor.solve, mass, locked, phi)
        values, phi = rayleigh_ritz(stiffness, mass, phi)
        kept = values[: values.size - extra] if values.size == want else values
        # accuracy limit from the rounding of the largest 1 / (omega^2 - sigma)
        reached = 2 * PRECISION * (kept - factor.sigma) / (values[0] - factor.sigma)
        left = _excess(stiffness, mass, kept, phi, reached)
        if left < best:
            best, squares, found = left, values, phi
        if left <= 1:
            break
    return squares, found


def _excess(
    K: Any, M: Any, squares: FloatArray, phi: FloatArray, least: FloatArray | float
) -> float:
    """Return the largest residual of the first shapes, relative to its limit or `least`."""
    left, least, size_of_K = 0.0, np.broadcast_to(least, squares.shape), Absolute(K)
    for at in column_groups(squares.size, BLOCK):
        force, limit = _let_pass(K, size_of_K, phi[:, at])
        limit = np.maximum(limit, least[at]) * np.linalg.norm(force, axis=0)
        force -= (M @ phi[:, at]) * squares[at]
        left = max(left, float(np.max(np.linalg.norm(force, axis=0) / limit)))
    return left


def _tolerance(K: Any, part: float, phi: FloatArray) -> FloatArray:
    """Return the relative error of each shape at which its residual is `part` of the limit."""
    size_of_K, limit = Absolute(K), np.zeros(phi.shape[1])
    for at in column_groups(limit.size, BLOCK):
        limit[at] = part * _let_pass(K, size_of_K, phi[:, at])[1]
    return limit


def _let_pass(K: Any, size_of_K: Absolute, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return forces ``K phi`` and the residual limit relative to each."""
    force = np.asarray(K @ phi)
    rounding = np.finfo(np.float64).eps * np.linalg.norm(size_of_K @ np.abs(phi), axis=0)
    return force, np.maximum(_RESIDUAL, _ROUNDINGS * rounding / np.linalg.norm(force, axis=0))


def _is_gap(squares: FloatArray, count: int, top: float, rounding: FloatArray) -> bool:
    """Return whether `top` is well between the last mode below it and the next."""
    near = squares[count - 1 : count + 1]
    closest = np.maximum(_GAP * top, _ROUNDINGS * rounding[count - 1 : count + 1])
    return bool(np.all(np.abs(near - top) > closest) and near[0] < top < near[-1])


def _widest_gap(squares: FloatArray, count: int, rounding: FloatArray) -> tuple[int, float]:
    """Return the number of modes below the widest gap above the last wanted one, and its middle."""
    # gaps narrower than 1e-8 or than some roundings of the neighbouring modes do not count
    above, least = squares[count - 1 :], _ROUNDINGS * rounding[count - 1 :]
    wide = np.diff(above)
    real = (wide > _GAP * above[1:]) & (wide > least[1:]) & (wide > least[:-1])
    if not np.any(real):
        return 0, 0.0
    i = int(np.argmax(np.where(real, wide / above[1:], 0.0)))
    return count + i, 0.5 * float(above[i] + above[i + 1])


def _gap_below(squares: FloatArray, count: int, rounding: FloatArray) -> tuple[int, float]:
    """Return how many modes lie below all copies of the last wanted one, and the middle of the gap.

    Copies agree to 1e-8 or to some roundings, the first with the last as well. The shift is 0 when
    the modes are not copies.
    """
    closest = np.maximum(_GAP * squares[-1], _ROUNDINGS * float(rounding[-1]))
    first = int(np.searchsorted(squares, squares[-1] - closest))
    before = max(float(squares[first - 1]), 0.0) if first else 0.0
    apart = squares[first] - before > closest and first < count
    return first, 0.5 * (before + float(squares[first])) if apart else 0.0


#: number of steps that use M times the last block in place of residuals
_FIRST = 10
#: residual relative to ||K phi|| at which an eigenvalue is accepted: its error is of second order
_VALUE = 1e-5
#: number of steps after which, for fast convergence, modes must lie above this fraction of -sigma
#: (where sigma is below zero)
_EARLY, _FAR = 12, 0.1


class BlockDavidson(BlockLanczos):
    """The lowest modes by corrections with ``P`` near ``(K - sigma M)^-1`` [MorganScott1986]_."""

    def __init__(
        self,
        solve: Callable[[FloatArray], FloatArray],
        K: Matrix,
        M: Matrix,
        sigma: float,
        locked: FloatArray,
        *,
        want: int,
        rng: Rng = 0,
        start: FloatArray | None = None,
    ) -> None:
        super().__init__(solve, M, locked, want=want, rng=rng, start=start)
        self._K, self._sigma = by_rows(K), sigma
        # as long as the errors of P do not matter, Lanczos steps converge as fast and cost less
        for _ in range(_FIRST):
            if self._loaded.shape[1]:
                self._extend(self._loaded)

    def modes(
        self, count: int, extra: int, needed: Callable[[FloatArray], FloatArray]
    ) -> FloatArray:
        """Return the lowest shapes (n, count), the last `extra` of them for their values only."""
        # only the values of the last `extra` are needed; `needed` gives the residual limits of
        # shapes
        found = np.zeros(count, dtype=bool)
        self._limit, self._left = np.zeros(count), np.full(count, np.inf)
        for _ in range(MOST_STEPS + count):
            squares, mix = la.eigh(self._T)
            if self.steps > _EARLY and squares[:count][-1] < -_FAR * self._sigma:
                break
            at = np.flatnonzero(~found[: self._m])[:COLUMNS]
            residual, found[at] = self._residuals(squares, mix, at, needed)
            # shapes of equal values have the same accuracy, since they may be mixed
            last = squares[:count][-extra - 1] * (1 + SPREAD)
            shapes = int(np.searchsorted(squares[:count], last, side="right"))
            if np.all(found[:shapes]) and np.all(self._left <= _VALUE):
                # check all again: a mode found late changes those above it
                at = np.arange(count)
                self._limit[:], self._left[:] = 0.0, np.inf
                residual, found = self._residuals(squares, mix, at, needed)
                if np.all(found[:shapes]) and np.all(self._left <= _VALUE):
                    return self._shapes(mix[:, :count])
            unfinished = residual[:, ~found[at]][:, :COLUMNS]
            if not unfinished.shape[1]:
                continue
            if self._r + self._m + COLUMNS > self._capacity:
                self._restart(squares, mix, max(count + self._block, 2 * self._m // 3))
            self._extend(unfinished)
        raise SolverError(
            f"{counted(count, 'mode')} did not converge in {self.steps} steps of a Davidson "
            "iteration: its preconditioner is too far from the inverse of K - sigma M."
        )

    def _extend(self, forces: FloatArray) -> None:
        """Add ``P forces`` to the basis."""
        moved = self._solve(forces)
        block, self._loaded, _ = self._orthonormal(moved / np.linalg.norm(moved, axis=0))
        width = block.shape[1]
        if not width:
            raise SolverError("the corrections of a Davidson iteration add no new direction.")
        self._append(block)
        along = along_basis(self._V[self._r : self._r + self._m], np.asarray(self._K @ block))
        grown = np.zeros((self._m, self._m))
        grown[:-width, :-width] = self._T
        grown[:, -width:] = along
        grown[-width:, :] = along.T
        self._T = grown
        self.steps += 1
        tick(STEPS)

    def _residuals(
        self,
        squares: FloatArray,
        mix: FloatArray,
        at: IntArray,
        needed: Callable[[FloatArray], FloatArray],
    ) -> tuple[FloatArray, FloatArray]:
        """Return ``K phi - omega^2 M phi`` of some shapes, and which of them are found."""
        phi = self._shapes(mix[:, at])
        force = np.asarray(self._K @ phi)
        size = np.linalg.norm(force, axis=0)
        force -= np.asarray(self._M @ phi) * squares[at]
        left = np.linalg.norm(force, axis=0) / size
        near = left < ROOT
        new = np.flatnonzero(near & (self._limit[at] == 0))
        if new.size:
            self._limit[at[new]] = needed(phi[:, new])
        self._left[at] = left
        return force, near & (left <= self._limit[at])
