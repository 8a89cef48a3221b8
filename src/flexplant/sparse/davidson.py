"""The lowest modes by Davidson's method, with an approximate inverse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg as la

from ..arrays import COLUMNS, FloatArray, IntArray, Matrix, Rng
from ..errors import SolverError, counted
from ..parallel import tick
from ..tolerances import MOST_STEPS, ROOT
from .symmetric import LANCZOS_STEPS, SPREAD, BlockLanczos, along_basis, by_rows

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
        tick(LANCZOS_STEPS)

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
