"""A structure in its modes and the static shapes of some loads; its responses, checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import CACHED, ComplexArray, FloatArray, divisor
from ..errors import ModelError, SolverError
from ..sparse.factor import DENSE_LIMIT, ComplexSymmetricFactor
from ..sparse.symmetric import beyond, dense, projected
from ..structure import Damping, FEModel, ModalDamping, Rayleigh
from ..structure.definite import signed_root, unstable_stiffness
from ..tolerances import CLOSE, MISSED, MOST_STEPS, NULL, SAME, SETTLED, SPLIT, TINY, TYPED
from .complex_modes import damper_forces
from .modes import Modes
from .solve import static_response
from .sparse_modes import StiffnessFactor, dissection_of, held_factor

#: number of loads above which the second static response of each load is left out
_MANY = 30
#: fraction of the remaining loads (root of their energy) that may remain after a correction; the
#: error of a Galerkin response is its square
_LEFT = 0.2


@dataclass(frozen=True)
class DampingTerms:
    """``K (1 + i eta) + i omega (a M + b K + D + M V R V^T M)``, R diagonal, of shapes V."""

    own: FloatArray
    eta: float = 0.0
    a: float = 0.0
    b: float = 0.0
    D: Any = None


class DynamicBasis:
    """``M q'' + D q' + K q = B f`` in q = V p: modes, and static responses to the loads.

    V holds the modes, the static responses ``u = G f`` to the loads (inertia relief), ``G M u``,
    and the static responses to the forces of dampers, M-orthonormal and diagonal in K. Responses
    between loads then have an error of order ``(f / f_cut)^8`` of what the truncated modes give,
    f_cut being the last frequency of the modes.
    """

    def __init__(
        self,
        model: FEModel,
        modes: Modes,
        loads: FloatArray,
        damping: Damping | None = None,
        *,
        loss: float | None = None,
    ) -> None:
        self.model = model
        self.n_modes, self.n_rigid = modes.n_modes, modes.n_rigid
        phi = np.real(modes.phi)
        dampers = damper_forces(model) if damping is None and loss is None else None
        static = static_shapes(model, loads, dampers)
        shapes, squares = _diagonalise_shapes(model, beyond(model.M, phi, static))
        self.V = np.hstack([phi, shapes])
        self.squares = np.concatenate([modes.basis_squares[: modes.n_modes], squares])
        #: shapes of the modes for which a damping law holds
        self._inertia = np.asarray(model.M @ self.V)
        self.losses = self._losses(damping, loss)
        self._damped()

    @property
    def n_shapes(self) -> int:
        """Number of shapes in addition to the modes."""
        return int(self.V.shape[1]) - self.n_modes

    @property
    def freq(self) -> FloatArray:
        """Frequencies [Hz] of the elastic modes."""
        return np.asarray(np.sqrt(np.abs(self.squares[self.n_rigid : self.n_modes])) / (2 * np.pi))

    @property
    def damped_freq(self) -> FloatArray:
        """Frequencies [Hz] of the elastic modes whose response at resonance is finite."""
        size = np.sqrt(np.abs(self.squares))
        rates = self._rates + self._loss / divisor(size)
        own = rates[self.n_rigid : self.n_modes]
        return np.asarray(self.freq[own > SAME * 2 * np.pi * self.freq])

    def enriched(self, shapes: FloatArray) -> DynamicBasis:
        """Return the basis with more shapes (n, m), damped as it is."""
        found = object.__new__(DynamicBasis)
        found.__dict__.update(self.__dict__)
        model, phi = self.model, self.V[:, : self.n_modes]
        more = np.hstack([self.V[:, self.n_modes :], beyond(model.M, self.V, shapes)])
        more, squares = _diagonalise_shapes(model, more)
        found.V = np.hstack([phi, more])
        found.squares = np.concatenate([self.squares[: self.n_modes], squares])
        found._damped()
        return found

    def response(self, freq: FloatArray, rows: FloatArray, loads: FloatArray) -> ComplexArray:
        """Return the responses (n_freq, p, q) of motions (p, n) to loads (n, q)."""
        return self._answered(freq, rows @ self.V, self.V.T @ loads)

    def drive_points(self, freq: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the sizes (n_freq, p) of motions (p, n), each to a unit force on itself."""
        own = [self._answered(freq, row[None], row[:, None])[:, 0, 0] for row in rows @ self.V]
        return np.abs(np.array(own)).T.reshape(freq.size, len(rows))

    def _answered(self, freq: FloatArray, left: FloatArray, right: FloatArray) -> ComplexArray:
        """Return responses (n_freq, p, q) of rows (p, k) to forces (k, q), all in coordinates."""
        found = np.zeros((freq.size, left.shape[0], right.shape[1]), dtype=np.complex128)
        k = self.squares.size
        chunk = max(1, CACHED // (k**2 if self._coupled else k))
        for begin in range(0, freq.size, chunk):
            part = slice(begin, begin + chunk)
            omega = 2 * np.pi * freq[part, None]
            main = self.squares + 1j * self._loss - omega**2 + 1j * omega * self._rates
            if np.any(main == 0):
                i = int(np.flatnonzero(np.any(main == 0, axis=1))[0])
                raise ModelError(
                    f"the response at {omega[i, 0] / (2 * np.pi):.6g} Hz is infinite: an undamped "
                    "(or rigid-body) motion is there. Leave that frequency out, or pass "
                    "damping=ModalDamping(0.01)."
                )
            if not self._coupled:
                found[part] = (left * (1 / main)[:, None]) @ right
                continue
            whole = 1j * (omega[:, :, None] * self._C + np.diag(self._loss))
            at = np.arange(k)
            whole[:, at, at] = main
            found[part] = left @ np.linalg.solve(whole, right[None].astype(np.complex128))
        return found

    def compliance(self, rows: FloatArray, loads: FloatArray) -> FloatArray:
        """Return the static elastic response (p, q), which is exact for the loads of the basis."""
        elastic = self.V[:, self.n_rigid :]
        return np.asarray(((rows @ elastic) / self.squares[self.n_rigid :]) @ (elastic.T @ loads))

    def corrected(
        self, freq: FloatArray, loads: FloatArray, factor: StiffnessFactor
    ) -> DynamicBasis | None:
        """Return the basis, extended by the responses of the full matrices at some frequencies."""
        # solutions with a factor of the stiffness extend it until almost no energy is left
        n, count = self.n_modes, freq.size
        inner, basis, first = self._inertia[:, :n], self, np.zeros(0)
        forces = self.V[:, self.n_rigid :].T @ loads
        energy = np.sum(forces**2 / np.abs(self.squares[self.n_rigid :, None]), axis=0)
        for _ in range(MOST_STEPS):
            left = basis._left(freq, loads)
            parts = np.hstack([left.real, left.imag])
            moved = factor.solve(parts)
            moved -= basis.V[:, :n] @ (inner.T @ moved)
            stored = np.abs(np.sum(parts * moved, axis=0)).reshape(2, -1).sum(axis=0)
            first = first if first.size else stored
            if np.all(stored <= np.maximum(_LEFT**2 * first, SAME**2 * np.tile(energy, count))):
                return basis
            basis = basis.enriched(moved)
        return None

    def _left(self, freq: FloatArray, loads: FloatArray) -> ComplexArray:
        """Return the part of the loads (n, f q) that the motions do not balance."""
        at = self._answered(freq, np.eye(self.V.shape[1]), self.V.T @ loads)
        motion = self.V @ np.hstack(list(at))
        omega = np.repeat(2 * np.pi * freq, loads.shape[1])
        law = self.losses

        def pushed(matrix: Any) -> ComplexArray:
            return np.asarray(matrix @ motion.real + 1j * (matrix @ motion.imag))

        force = pushed(self.model.K) * (1 + 1j * (law.eta + omega * law.b))
        force -= pushed(self.model.M) * (omega**2 - 1j * omega * law.a)
        if law.D is not None:
            force += 1j * omega * pushed(law.D)
        chosen = np.flatnonzero(law.own)
        U = self._inertia[:, chosen]
        force += 1j * omega * (U @ (law.own[chosen, None] * (U.T @ motion)))
        return np.asarray(np.tile(loads, freq.size) - force)

    def solved(self, freq: float, loads: FloatArray) -> ComplexArray:
        """Return the motion (n, q) of all DOFs under loads, from the matrices alone."""
        model, law, omega = self.model, self.losses, 2 * np.pi * freq
        M, K = model.M, model.K
        stiff = 1 + 1j * (law.eta + omega * law.b)
        matrix: Any = K * stiff - (omega**2 - 1j * omega * law.a) * M
        if law.D is not None:
            like = sp.issparse(matrix) == sp.issparse(law.D)
            matrix = matrix + 1j * omega * (law.D if like else dense(law.D))
        chosen = np.flatnonzero(law.own)
        U = self._inertia[:, chosen]
        size: ComplexArray = np.asarray(1j * omega * law.own[chosen], dtype=np.complex128)
        if sp.issparse(matrix) and model.n_dof > DENSE_LIMIT:
            # a D may join DOFs that K and M do not
            order = dissection_of(model) if law.D is None else None
            solve = _with_rank(ComplexSymmetricFactor(matrix, order).solve, U, size)
        else:
            matrix = matrix.toarray() if hasattr(matrix, "toarray") else matrix
            full = np.asarray(matrix + (U * size) @ U.T, dtype=np.complex128)
            scale = 1.0 / np.sqrt(np.abs(np.diag(full)))[:, None]
            lu = la.lu_factor(full * scale * scale.T)
            matrix, U, size = full, U[:, :0], size[:0]

            def solve(right: Any) -> Any:
                return la.lu_solve(lu, right * scale) * scale

        found = solve(loads.astype(np.complex128))
        for _ in range(4):
            left = loads - matrix @ found - (U * size) @ (U.T @ found)
            step = solve(left)
            found = found + step
            size_of = np.linalg.norm(found, axis=0)
            change = np.linalg.norm(step, axis=0) / divisor(size_of)
            if np.all(change <= SETTLED):
                break
        if not np.all(change <= TYPED):
            raise SolverError(
                f"a direct solution at {freq:.6g} Hz changes by {change.max():.2g} when refined: "
                "the frequency is at a resonance of an undamped motion. Move it a little, or give "
                "the structure damping."
            )
        return np.asarray(found, dtype=np.complex128)

    def _losses(self, damping: Damping | None, loss: float | None) -> DampingTerms:
        r, none = self.n_rigid, np.zeros(self.squares.size)
        if loss is not None:
            return DampingTerms(none, eta=loss)
        if damping is None:
            return DampingTerms(none, D=self.model.D)
        if isinstance(damping, Rayleigh):
            own = none.copy()
            own[:r] = 0.0 if damping.rigid else -damping.alpha
            return DampingTerms(own, a=damping.alpha, b=damping.beta)
        omega = signed_root(self.squares)
        rates = 2 * damping.zeta(omega) * np.abs(omega)
        if isinstance(damping, ModalDamping):
            rates[:r] = damping.rigid
        a = float(rates[: self.n_modes].max(initial=0.0))
        return DampingTerms(rates - a, a=a)

    def _damped(self) -> None:
        """Set the losses in the coordinates: decay rates, and the coupling between coordinates."""
        law = self.losses
        C = np.diag(law.a + law.b * self.squares)
        if law.D is not None:
            C = C + self.V.T @ np.asarray(law.D @ self.V)
        if np.any(law.own):
            turned = self.V.T @ self._inertia
            C = C + (turned * law.own) @ turned.T
        self._C, self._rates = C, np.diag(C).copy()
        self._loss = law.eta * self.squares
        self._coupled = _couples(C)


def _couples(C: FloatArray) -> bool:
    """Return whether a matrix of losses couples coordinates."""
    own = np.diag(C)
    # diagonal entries may be zero
    size = np.sqrt(np.abs(np.outer(own, own))) + 1e-3 * np.abs(C).max(initial=0)
    return bool(np.any(np.abs(C - np.diag(own)) > NULL * size))


def static_shapes(
    model: FEModel, loads: FloatArray, dampers: FloatArray | None = None
) -> FloatArray:
    """Return static responses ``u = G f`` to loads (n, m) and, when loads are few, ``G M u``."""
    # for the forces of dampers (n, d) only the first of these
    if not loads.shape[1]:
        return loads
    factor = held_factor(model)

    def static(forces: FloatArray) -> FloatArray:
        if model.n_unstable:
            # no static response exists here; the response to forces that grow faster than the
            # motion takes its place
            balanced = forces - np.asarray(
                model.M @ (model.rigid_body @ (model.rigid_body.T @ forces))
            )
            if factor is not None:
                return factor.solve(balanced)
            square = 2 * float(unstable_stiffness(model.K, model.body_motions)[0])
            return np.asarray(la.solve(dense(model.K) - square * dense(model.M), balanced))
        return static_response(model, forces)

    found = static(loads)
    shapes = [found] if loads.shape[1] > _MANY else [found, static(np.asarray(model.M @ found))]
    if dampers is not None and dampers.shape[1]:
        shapes.append(static(dampers))
    return np.hstack(shapes)


def _diagonalise_shapes(model: FEModel, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return M-orthonormal shapes that are orthogonal in K too, and their omega^2."""
    if not shapes.shape[1]:
        return shapes, np.zeros(0)
    squares, mix = la.eigh(projected(model.K, shapes))
    return shapes @ mix, squares


def _with_rank(solve: Any, U: FloatArray, size: ComplexArray) -> Any:
    """Return a solver of ``(A + U diag(size) U^T) x = b`` that uses solutions with A (Woodbury)."""
    if not size.size:
        return solve
    moved = solve(U.astype(np.complex128))
    small = la.lu_factor(np.diag(1 / size) + U.T @ moved)

    def both(right: Any) -> Any:
        found = solve(right)
        return found - moved @ la.lu_solve(small, U.T @ found)

    return both


#: fraction of the responses of its places to their own forces below which the peak of a channel
#: counts as silent: it then consists of rounding of modes in other directions (up to 1e-11 for
#: beams of 360 DOFs)
SILENT = SAME
#: relative distance from a resonance that is still within its peak
_WITHIN_PEAK = SPLIT
#: number of rounds in which direct solutions extend a basis that is not accurate enough
_ROUNDS = 3
#: number of grid frequencies that bracket antiresonances, over the band and between two resonances
_GRID, _BETWEEN = 300, 5


@dataclass(frozen=True)
class DirectCheck:
    """Errors of responses found by direct solutions."""

    freq: FloatArray
    of_peak: FloatArray
    there: FloatArray

    @property
    def worst(self) -> float:
        """The largest error relative to the peaks."""
        return float(self.of_peak.max(initial=0.0))

    def holds(self, tolerance: float) -> bool:
        """Return whether errors are within `tolerance` of the peak, and 1 % of the response."""
        return self.worst <= tolerance and bool(np.all(self.there <= CLOSE))

    def __str__(self) -> str:
        if not self.freq.size:
            return "not checked"
        points = "frequencies" if self.freq.size > 1 else "frequency"
        return (
            f"direct solutions at {self.freq.size} {points} differ by {self.worst:.1g} of the "
            f"peak, {self.there.max():.1g} of the response there"
        )


def checked_response(
    basis: DynamicBasis,
    freq: FloatArray,
    rows: FloatArray,
    loads: FloatArray,
    *,
    checks: int,
    tolerance: float,
    seen: Callable[[FloatArray, ComplexArray], ComplexArray] | None = None,
) -> tuple[DynamicBasis, ComplexArray, DirectCheck]:
    """Return a basis that meets a tolerance, its responses, and their check."""
    # where the error is larger, direct solutions extend the basis, which is checked again elsewhere
    view = seen or (lambda _, response: response)

    def find(at: FloatArray) -> ComplexArray:
        return view(at, basis.response(at, rows, loads))

    found = find(freq)
    none = np.zeros(0)
    if not checks or not found.size:
        return basis, found, DirectCheck(none, none, none)
    points = _points(basis, find, float(freq[0]), float(freq[-1]))
    for last in range(_ROUNDS - 1, -1, -1):
        at = np.array(sorted({next(points) for _ in range(checks)}))
        wanted, better = _direct_responses(basis, at, rows, loads)
        own = np.sqrt(
            basis.drive_points(at, rows)[:, :, None] * basis.drive_points(at, loads.T)[:, None]
        )
        check = _direct_check(at, find(at), view(at, wanted), found, np.abs(view(at, own + 0j)))
        if check.holds(tolerance) or not last:
            return basis, found, check
        basis = better()
        found = find(freq)
    raise AssertionError


def _direct_responses(
    basis: DynamicBasis, at: FloatArray, rows: FloatArray, loads: FloatArray
) -> tuple[ComplexArray, Callable[[], DynamicBasis]]:
    """Return responses from the full matrices, and the basis extended by these motions."""
    # by corrections with the static factor; a dynamic stiffness is factored where these do not
    # converge
    factor = held_factor(basis.model)
    corrected = None if factor is None else basis.corrected(at, loads, factor)
    if corrected is not None:
        found = corrected
        return found.response(at, rows, loads), lambda: found
    motions = [basis.solved(f, loads) for f in at.tolist()]
    fresh = [part for motion in motions for part in (motion.real, motion.imag)]
    return np.array([rows @ motion for motion in motions]), lambda: basis.enriched(np.hstack(fresh))


def _direct_check(
    at: FloatArray, found: ComplexArray, wanted: ComplexArray, whole: ComplexArray, own: FloatArray
) -> DirectCheck:
    # `own`: geometric means of the responses of both places to their own forces, to which a
    # channel that is rounding of other directions is compared
    peak, own = np.maximum(np.abs(whole).max(axis=0), np.abs(wanted).max(axis=0)), own.max(axis=0)
    floor = TYPED * np.sqrt(np.outer(peak.max(axis=1), peak.max(axis=0)))
    floor = np.where(peak <= SILENT * own, own, floor)
    absent, peak = peak <= floor, np.maximum(peak, floor)
    peak[peak == 0] = 1.0
    gap = np.abs(found - wanted)
    there = np.where(absent, peak, np.maximum(np.abs(wanted), MISSED * peak))
    return DirectCheck(at, (gap / peak).max(axis=(1, 2)), (gap / there).max(axis=(1, 2)))


def _points(
    basis: DynamicBasis, find: Callable[[FloatArray], ComplexArray], low: float, high: float
) -> Iterator[float]:
    """Yield frequencies: highest resonances, deepest antiresonances, edges of the band, random."""
    chance = np.random.default_rng(0)
    inside = basis.damped_freq[(basis.damped_freq > low) & (basis.damped_freq < high)]
    peaks = []
    if inside.size:
        size = np.abs(find(inside))
        share = (size / np.maximum(size.max(axis=0), TINY)).max(axis=(1, 2))
        # next to them, since one of two repeated modes may be undamped
        peaks = (inside * (1 + _WITHIN_PEAK))[np.argsort(-share, kind="stable")].tolist()
    deep = antiresonances(find, basis.freq, low, high).tolist() if high > low else []
    edges = [high, low] if high > low else [high]
    while True:
        for few in (peaks, deep, edges):
            if few:
                yield few.pop(0)
        # one of three consecutive ones, which are independent of those the basis was made from
        yield low * (high / low) ** chance.random() if low > 0 else high * chance.random()


def antiresonances(
    find: Callable[[FloatArray], ComplexArray], resonances: FloatArray, low: float, high: float
) -> FloatArray:
    """Return the antiresonances [Hz] of responses in a band, the deepest first."""
    start = low if low > 0 else high / 1000
    inside = resonances[(resonances > start) & (resonances < high)] * (1 + _WITHIN_PEAK)
    ends = np.concatenate([[start], inside, [high]])
    share = np.linspace(0.0, 1.0, _BETWEEN + 2)
    between = (ends[:-1, None] + np.diff(ends)[:, None] * share).ravel()
    return dips(find, np.unique(np.concatenate([np.geomspace(start, high, _GRID), between])))


#: least depth of a dip as a fraction of the lower of the two neighbouring maxima
_DEPTH = 0.5
#: number of dips that are refined, the deepest on the grid first
_MOST = 40


def dips(find: Callable[[FloatArray], ComplexArray], grid: FloatArray) -> FloatArray:
    """Return the antiresonances [Hz] of responses: deep local minima of the size of a channel."""
    size = np.abs(find(grid)).reshape(grid.size, -1)
    place, channel = np.nonzero((size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:]))
    lowest = size[place + 1, channel]
    ends = zip(place.tolist(), channel, strict=True)
    sides = np.array([_lower_side(size[:, own], at + 1) for at, own in ends])
    first = np.argsort(lowest / np.maximum(sides, TINY), kind="stable")[:_MOST]
    place, channel, lowest, sides = place[first], channel[first], lowest[first], sides[first]
    left, centre, right = grid[place], grid[place + 1], grid[place + 2]
    part = np.linspace(0.0, 1.0, 9)[1:-1]
    for _ in range(15 if place.size else 0):
        inside = left[:, None] + (right - left)[:, None] * part
        found = np.abs(find(inside.ravel())).reshape(*inside.shape, -1)
        found = np.take_along_axis(found, channel[:, None, None], axis=2)[:, :, 0]
        best = np.argmin(found, axis=1)
        rows = np.arange(place.size)
        centre, lowest = inside[rows, best], found[rows, best]
        edges = np.column_stack([left, inside, right])
        left, right = edges[rows, best], edges[rows, best + 2]
    share = lowest / np.maximum(sides, TINY)
    order = np.argsort(share, kind="stable")
    return np.asarray(centre[order][share[order] < _DEPTH])


def _lower_side(size: FloatArray, at: int) -> float:
    """Return the lower one of the maxima left and right of a minimum, up to where it is as low."""
    sides = (size[:at][::-1], size[at + 1 :])
    ends = [np.flatnonzero(side < size[at]) for side in sides]
    return min(
        float(side[: end[0] if end.size else None].max(initial=0.0))
        for side, end in zip(sides, ends, strict=True)
    )
