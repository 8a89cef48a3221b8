"""The lowest modes of a large sparse structure, counted: none is missing."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError, SolverError
from ..parallel import one_thread
from ..sparse.factor import by_rows
from ..sparse.pardiso import Pardiso
from ..sparse.rayleigh_ritz import absolute, rayleigh_ritz, rounding_of
from ..structure.eigen import check_stiffness
from ..structure.model import FEModel
from ..structure.negative_stiffness import are_rigid
from ..values import FloatArray, Rng
from .lanczos import FOUND, BlockLanczos
from .shifted import StiffnessFactor, modes_below, stiffness_factor

#: modes beyond the last wanted one among which a gap is searched
_EXTRA = 4
#: omega^2 closer than this (relative), or than so many of their roundings, belong together
_GAP, _GAP_ROUNDINGS = 1e-8, 4.0
#: more modes than this are not looked for: their shapes and the basis fill the memory
_MOST = 2000
#: searches with what is found locked, before giving up
_SEARCHES = 8
#: residuals, relative to ||K phi||, beyond which Lanczos goes on, unless they are rounding
_RESIDUAL = 1e-11
#: residuals below this many roundings of K phi are not reduced by more steps
_ROUNDINGS = 10.0


def counted_modes(
    model: FEModel, count: int, top: float = np.inf, method: Pardiso | None = None
) -> tuple[FloatArray, FloatArray, dict[str, float]]:
    """Return the lowest elastic modes with omega^2 up to `top`, and what was counted.

    Block Lanczos finds them, a Sturm count in a gap above the last one says how many there are;
    what is missing is looked for beside those found until the count agrees.

    Parameters
    ----------
    model : FEModel
        The structure, sparse.
    count : int
        How many elastic modes at most.
    top : float [rad^2/s^2]
        Largest omega^2.
    method : Pardiso, optional
        In place of the multifrontal factor; the count does without.

    Returns
    -------
    squares : (k,) array
        omega^2 of the elastic modes.
    phi : (n, k) array
        M-orthonormal shapes.
    certificate : dict
        `shift` [Hz], modes `counted` and `found` below it.

    Raises
    ------
    ModelError
        When K is indefinite or an elastic mode has no stiffness.
    SolverError
        When the count does not agree, or is not sure.
    """
    with one_thread():
        return _counted(model, count, top, method)


def _counted(
    model: FEModel, count: int, top: float, method: Pardiso | None
) -> tuple[FloatArray, FloatArray, dict[str, float]]:
    n, r = model.rigid_body.shape
    factor: StiffnessFactor | None = stiffness_factor(model, method)
    below = None
    if np.isfinite(top):
        below = modes_below(model, top) - r
        if not below:
            return np.zeros(0), np.zeros((n, 0)), _certificate(top, r, r)
        count = min(count, below)
        if count > _MOST:
            raise ModelError(
                f"below {np.sqrt(top) / (2 * np.pi):.6g} Hz this model of {n} DOFs has {below} "
                f"elastic modes: more than {_MOST} are not solved for at once. Choose a lower "
                "frequency, or for the lowest ones with count=."
            )
    squares, phi = np.zeros(0), np.zeros((n, 0))
    missing = min(count + _EXTRA, n - r)
    for search in range(_SEARCHES):
        factor = factor or stiffness_factor(model, method)
        locked = np.hstack([model.rigid_body, phi])
        more = _search(model, factor, locked, missing, search)
        squares, phi = rayleigh_ritz(model.K, model.M, np.hstack([phi, more]))
        rounding = rounding_of(model.K, phi)
        # a motion of the geometry that is not free has springs, which rounding does not hide
        suspended = are_rigid(model.M, model.body_motions, phi)
        least = np.where(suspended, 0.0, rounding)
        check_stiffness(squares, phi, least, model.rigid_body, model.dofs, suspended)
        # the count needs the memory
        factor, more = None, np.zeros((n, 0))
        if below == count and _apart(squares, count, top, rounding):
            counted, sure, shift = count, count, top
        else:
            sure, shift = _gap(squares, count, rounding)
            if not sure and squares.size < n - r:
                missing = min(2 * _EXTRA, n - r - squares.size)
                continue
            if not sure:
                sure, shift = squares.size, 2 * float(squares[-1])
            counted = modes_below(model, shift) - r
        if counted == sure:
            return squares[:count], phi[:, :count], _certificate(shift, counted + r, sure + r)
        if counted < sure:
            break
        missing = min(counted - sure + _EXTRA, n - r - squares.size)
    raise SolverError(
        f"below {np.sqrt(shift) / (2 * np.pi):.6g} Hz a Sturm count finds {counted + r} modes, "
        f"{sure + r} were found: closely repeated frequencies. Request some more or fewer modes."
    )


def _certificate(shift: float, counted: int, found: int) -> dict[str, float]:
    return {
        "shift": float(np.sqrt(shift) / (2 * np.pi)),
        "counted": float(counted),
        "found": float(found),
    }


def _search(
    model: FEModel, factor: StiffnessFactor, locked: FloatArray, want: int, rng: Rng
) -> FloatArray:
    """Return shapes (n, want) beside the locked ones, residuals down to rounding.

    Soft modes first: they are locked, and a new search finds those that their rounding hides.
    """
    held = model.body_motions
    start = None if locked.shape[1] >= held.shape[1] else held
    found = _searched(model, factor, locked, want, rng, start)
    while 0 < found.shape[1] < want:
        beside = np.hstack([locked, found])
        more = _searched(model, factor, beside, want - found.shape[1], rng, None)
        if not more.shape[1]:
            break
        found = np.hstack([found, more])
    return found


def _searched(
    model: FEModel,
    factor: StiffnessFactor,
    locked: FloatArray,
    want: int,
    rng: Rng,
    start: FloatArray | None,
) -> FloatArray:
    """Return up to `want` shapes of one search."""
    lanczos = BlockLanczos(factor.solve, model.M, locked, want=want, rng=rng, start=start)
    extra = min(_EXTRA, want - 1)
    mass, stiffness = by_rows(model.M), by_rows(model.K)
    deflated = np.asarray(mass @ locked)
    best, found = np.inf, np.zeros((locked.shape[0], 0))
    for tolerance in FOUND * np.array([1, 2e-3, 1e-5]):
        _, phi = lanczos.lowest(want, tolerance, extra=extra)
        # one inverse iteration: what is left in phi of high modes, most of its residual, is gone
        force = mass @ phi
        force -= deflated @ (locked.T @ force)
        phi = factor.solve(force)
        phi -= locked @ (deflated.T @ phi)
        squares, phi = rayleigh_ritz(stiffness, mass, phi)
        kept = squares.size - extra if squares.size == want else squares.size
        left = _residual(stiffness, mass, squares[:kept], phi[:, :kept])
        if left < best:
            best, found = left, phi
        if left <= 1:
            break
    return found


def _residual(K: Any, M: Any, squares: FloatArray, phi: FloatArray) -> float:
    """Return the worst residual of some modes, ``||K phi - omega^2 M phi|| / ||K phi||``.

    In units of what is let pass.
    """
    force, mass = K @ phi, M @ phi
    size = np.linalg.norm(force, axis=0)
    mass *= squares
    force -= mass
    left = np.linalg.norm(force, axis=0)
    del force, mass
    rounding = np.finfo(np.float64).eps * np.linalg.norm(absolute(K) @ np.abs(phi), axis=0)
    return float(np.max(left / np.maximum(_RESIDUAL * size, _ROUNDINGS * rounding)))


def _apart(squares: FloatArray, count: int, top: float, rounding: FloatArray) -> bool:
    """Return whether `top` is well between the last mode below it and the next."""
    near = squares[count - 1 : count + 1]
    closest = np.maximum(_GAP * top, _GAP_ROUNDINGS * rounding[count - 1 : count + 1])
    return bool(np.all(np.abs(near - top) > closest) and near[0] < top < near[-1])


def _gap(squares: FloatArray, count: int, rounding: FloatArray) -> tuple[int, float]:
    """Return how many modes lie below the widest gap after the last wanted one, and its middle.

    Gaps narrower than some roundings of the modes beside them, or than 1e-8, are none.
    """
    above, least = squares[count - 1 :], _GAP_ROUNDINGS * rounding[count - 1 :]
    wide = np.diff(above)
    real = (wide > _GAP * above[1:]) & (wide > least[1:]) & (wide > least[:-1])
    if not np.any(real):
        return 0, 0.0
    i = int(np.argmax(np.where(real, wide / above[1:], 0.0)))
    return count + i, 0.5 * float(above[i] + above[i + 1])
