"""The lowest modes of a large sparse structure: its factors, and a count that all are found."""

from __future__ import annotations

import weakref
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, Rng, divisor
from ..certificates import Certificate, Verified
from ..errors import ModelError, SolverError, attempted, counted
from ..parallel import expect, one_thread
from ..sparse.davidson import BlockDavidson
from ..sparse.factor import (
    DENSE_LIMIT,
    LARGEST_FULL,
    MultifrontalFactor,
    multifrontal_inertia,
    signed_factor,
)
from ..sparse.ordering import Dissection, dissect
from ..sparse.other_factors import Cholmod, CholmodCholesky
from ..sparse.symmetric import (
    EXTRA_VALUES,
    LANCZOS_VECTORS,
    Absolute,
    BlockLanczos,
    by_rows,
    column_groups,
    iterated,
    rayleigh_ritz,
    rounding_of,
    same_pattern,
)
from ..structure.definite import are_rigid, check_stiffness, unstable_stiffness
from ..structure.model import FEModel
from ..tolerances import MOST_STEPS, NULL, PRECISION, ROOT, ROUNDING, TINY

#: shift in units of the rounding of rigid-body energies: far below the first elastic mode of nearly
#: all models, and K - sigma M is still well-conditioned
_SHIFT = -3e3
#: the same in single precision: the lowest elastic modes of a bulky structure lie above it, or not
#: far below, and K - sigma M stays definite in spite of rounding
_SINGLE_SHIFT = -30.0
#: cache of the factors of models that are in use
_held: weakref.WeakKeyDictionary[FEModel, weakref.ref[StiffnessFactor]] = (
    weakref.WeakKeyDictionary()
)
_dissected: weakref.WeakKeyDictionary[FEModel, Dissection] = weakref.WeakKeyDictionary()
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


class StiffnessFactor:
    """``K - sigma M = L L^T`` of a sparse model, with sigma just below zero.

    Made by `stiffness_factor`, which returns the same object as long as it is in use.
    """

    def __init__(
        self, model: FEModel, method: Cholmod | None = None, *, single: bool = False
    ) -> None:
        self.M: Any = sp.csc_array(model.M)
        self.K: Any = sp.csc_array(model.K)
        self.rigid = model.rigid_body
        # use motions, not single DOFs: a DOF may have almost no inertia
        near = self.sigma = _SHIFT * float(np.max(rounding_of(self.K, model.body_motions)))
        self.single = single
        if single:
            self.sigma *= _SINGLE_SHIFT / _SHIFT * (np.finfo(np.float32).eps / np.finfo(float).eps)
        elif model.n_unstable:  # below the lowest eigenvalue
            self.sigma += 2.0 * float(unstable_stiffness(self.K, model.body_motions)[0])
        shifted = _shift_matrix(self.K, self.M, self.sigma)
        self.dissection = dissection_of(model)
        try:
            self._cholesky: MultifrontalFactor | CholmodCholesky = (
                MultifrontalFactor(shifted, self.dissection, single=single)
                if method is None
                else method.factored(shifted)
            )
        except SolverError as error:
            if single:
                raise
            negative = multifrontal_inertia(_shift_matrix(self.K, self.M, near), self.dissection)
            if not negative:
                raise
            raise ModelError(
                f"K has {counted(negative, 'negative eigenvalue')}: the structure is "
                "unstable, and not as a rigid body. Look for a sign in K."
            ) from error

    def __repr__(self) -> str:
        # four or eight bytes each
        size = self._cholesky.n_entries * (4e-9 if self.single else 8e-9)
        return f"<StiffnessFactor: {counted(self.K.shape[0], 'DOF')}, {size:.2g} GB>"

    def solve(self, force: FloatArray) -> FloatArray:
        """Return ``(K - sigma M)^-1 force`` for (n,) or (n, m) forces."""
        return self._cholesky.solve(force)

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the elastic static response (n, m) to loads, M-orthogonal to rigid-body motions.

        ``K u = f - M R R^T f`` (inertia relief) by conjugate gradients, preconditioned with the
        factor: a few steps, since sigma is small.
        """
        R = self.rigid
        inertia = np.asarray(self.M @ R)
        residual = loads - inertia @ (R.T @ loads)
        wanted = np.linalg.norm(residual, axis=0)
        u = np.zeros_like(residual)
        direction, old = np.zeros_like(residual), np.ones(residual.shape[1])
        best = np.full(residual.shape[1], np.inf)
        for _ in range(60):
            moved = self.solve(residual)
            moved -= R @ (inertia.T @ moved)
            new = np.sum(residual * moved, axis=0)
            direction = moved + direction * (new / old)
            force = np.asarray(self.K @ direction)
            stored = np.sum(direction * force, axis=0)
            length = np.divide(new, stored, out=np.zeros_like(new), where=stored > 0)
            step = direction * length
            u += step
            residual -= force * length
            residual -= inertia @ (R.T @ residual)
            # error measured as energy: among forces, the rounding of stiff directions would hide
            # the rest
            part = np.sqrt(new * length / np.maximum(np.sum(u * (self.K @ u), axis=0), TINY))
            if np.all((part <= ROUNDING) | (wanted == 0)) or np.all(part >= best):
                break
            best, old = part, divisor(new)
        # tolerance in energy: shapes built from the response keep at least ten digits
        if not np.all((part <= 1e-7) | (wanted == 0)):
            raise SolverError(
                f"a static response did not converge (relative last step {part.max():.1g}): K is "
                f"singular beyond the {counted(R.shape[1], 'rigid-body motion')} of the "
                "geometry. "
                "Look for a mechanism, a DOF without stiffness, or wrong coordinates."
            )
        return u - R @ (inertia.T @ u)


class CountingFactor:
    """``K - sigma M = L D L^T`` in single precision, sigma above the modes that are wanted.

    One factor counts the modes below sigma and is what their search needs [Grimes1994]_. Get it
    from `counting_factor`.
    """

    single = True

    def __init__(self, signed: MultifrontalFactor, sigma: float) -> None:
        self._signed, self.sigma, self.below = signed, sigma, signed.negative

    def solve(self, force: FloatArray) -> FloatArray:
        """Return ``(K - sigma M)^-1 force`` for (n, m) forces, to single precision."""
        return self._signed.solve(force)


def counting_factor(model: FEModel, square: float) -> CountingFactor | None:
    """Return the factor at omega^2 = `square` of a bulky stable model, else None."""
    order = dissection_of(model)
    if not order.is_costly or model.n_unstable:
        return None
    signed = signed_factor(_shift_matrix(sp.csc_array(model.K), model.M, square), order)
    return None if signed is None else CountingFactor(signed, square)


def stiffness_factor(model: FEModel, method: Cholmod | None = None) -> StiffnessFactor:
    """Return the factor of a sparse model, the same one as long as it is in use."""
    known = _held.get(model)
    factor = known() if known is not None else None
    if factor is None:
        factor = StiffnessFactor(model, method)
        _held[model] = weakref.ref(factor)
    return factor


def is_large(model: Any) -> bool:
    """Return whether a model is sparse, and factored as such."""
    large: bool = model.M.shape[0] > DENSE_LIMIT
    return large and sp.issparse(model.K) and sp.issparse(model.M)


def held_factor(model: FEModel) -> StiffnessFactor | None:
    """Return the factor of a large sparse model, in use as long as it is held; else None."""
    return stiffness_factor(model) if is_large(model) else None


def search_factor(model: FEModel, method: Cholmod | None = None) -> StiffnessFactor:
    """Return a factor to search modes with: the one in use, or one in single precision."""
    known, order = _held.get(model), dissection_of(model)
    unused = known is None or known() is None
    if unused and method is None and not model.n_unstable and order.is_costly:
        with attempted("a factor in single precision", SolverError):
            return StiffnessFactor(model, single=True)
    return stiffness_factor(model, method)


def dissection_of(model: FEModel) -> Dissection:
    """Return the elimination order of a model's matrices, found once."""
    found = _dissected.get(model)
    if found is None:
        M, K = sp.csc_array(model.M), sp.csc_array(model.K)
        # the pattern of both matrices: entries that cancel in one stay in the other
        pattern = K if same_pattern(K, M) else sp.csc_array(abs(K) + abs(M))
        found = dissect(pattern, model.dofs.node_index, model.dofs.xyz)
        _dissected[model] = found
    return found


def modes_below(model: FEModel, square: float, *, single: bool = True) -> int:
    """Return how many modes, rigid-body ones included, have an omega^2 below `square` (Sturm)."""
    # without `single`, single precision is skipped, since it failed before
    shifted = _shift_matrix(model.K, model.M, square)
    return multifrontal_inertia(shifted, dissection_of(model), single=single)


def _shift_matrix(K: Any, M: Any, square: float) -> Any:
    """Return ``K - square M``, its indices those of K where both have the same."""
    if not same_pattern(K, M):
        return sp.csc_array(K - square * M)
    return sp.csc_array((K.data - square * M.data, K.indices, K.indptr), shape=K.shape)


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
    missing = min(count + EXTRA_VALUES, n - r)
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
        missing = min(counted - sure + EXTRA_VALUES, n - r - squares.size)
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
    held, block = model.body_motions, LANCZOS_VECTORS
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
    block: int = LANCZOS_VECTORS,
) -> tuple[FloatArray, FloatArray]:
    """Return omega^2 and shapes, up to `want`, of one search."""
    extra = min(EXTRA_VALUES, want - 1)
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
    for at in column_groups(squares.size, LANCZOS_VECTORS):
        force, limit = _let_pass(K, size_of_K, phi[:, at])
        limit = np.maximum(limit, least[at]) * np.linalg.norm(force, axis=0)
        force -= (M @ phi[:, at]) * squares[at]
        left = max(left, float(np.max(np.linalg.norm(force, axis=0) / limit)))
    return left


def _tolerance(K: Any, part: float, phi: FloatArray) -> FloatArray:
    """Return the relative error of each shape at which its residual is `part` of the limit."""
    size_of_K, limit = Absolute(K), np.zeros(phi.shape[1])
    for at in column_groups(limit.size, LANCZOS_VECTORS):
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
