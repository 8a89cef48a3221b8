"""The lowest modes of a large sparse structure, counted: none is missing."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..errors import ModelError, SolverError
from ..parallel import one_thread
from ..values import FloatArray
from .eigen import check_stiffness
from .factor import by_rows
from .lanczos import FOUND, BlockLanczos
from .model import FEModel
from .pardiso import Pardiso
from .shifted import StiffnessFactor, modes_below, stiffness_factor

#: modes beyond the last wanted one among which a gap is looked for
_EXTRA = 4
#: frequencies closer than this (relative, squared), or than so many roundings, belong together
_GAP, _GAP_ROUNDINGS = 1e-8, 4.0
#: more modes than this are not looked for: their shapes and the basis fill the memory
_MOST = 2000
#: roundings in the strain energy of an elastic mode below which omega^2 is none
_ROUNDING = 30 * float(np.finfo(np.float64).eps)
#: rows that are mixed at a time
_ROWS = 65536
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
    largest = factor.largest if factor else 0.0
    below = None
    if np.isfinite(top):
        below = modes_below(model, top) - r
        if not below:
            return np.zeros(0), np.zeros((n, 0)), _certificate(top, r, r)
        count = min(count, below)
        if count > _MOST:
            raise ModelError(
                f"below {np.sqrt(top) / (2 * np.pi):.6g} Hz this model of {n} DOFs has {below} "
                f"elastic modes: more than {_MOST} are not solved for at once. Ask for a lower "
                "frequency, or for the lowest ones with count=."
            )
    squares, phi = np.zeros(0), np.zeros((n, 0))
    missing = min(count + _EXTRA, n - r)
    for search in range(_SEARCHES):
        factor = factor or stiffness_factor(model, method)
        locked = np.hstack([model.rigid_body, phi])
        more = _search(model, factor, locked, missing, search)
        squares, phi = _rayleigh_ritz(model, np.hstack([phi, more]))
        check_stiffness(squares, _rounding(model, phi[:, 0]), r)
        # the count needs the memory
        factor, more = None, np.zeros((n, 0))
        if below == count and _apart(squares, count, top, largest):
            counted, sure, shift = count, count, top
        else:
            sure, shift = _gap(squares, count, largest)
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
        f"below {np.sqrt(shift) / (2 * np.pi):.6g} Hz a Sturm count tells {counted + r} modes, "
        f"{sure + r} were found: closely repeated frequencies. Ask for some more or fewer modes."
    )


def _rounding(model: FEModel, phi: FloatArray) -> float:
    """Return the rounding in ``phi' K phi``: of the sum of what cancels in it."""
    return _ROUNDING * float(np.abs(phi) @ (_absolute(by_rows(model.K)) @ np.abs(phi)))


def _certificate(shift: float, counted: int, found: int) -> dict[str, float]:
    return {
        "shift": float(np.sqrt(shift) / (2 * np.pi)),
        "counted": float(counted),
        "found": float(found),
    }


def _search(
    model: FEModel, factor: StiffnessFactor, locked: FloatArray, want: int, seed: int
) -> FloatArray:
    """Return shapes (n, want) beside the locked ones, residuals down to rounding."""
    lanczos = BlockLanczos(factor.solve, model.M, locked, want=want, seed=seed)
    extra = min(_EXTRA, want - 1)
    asked = want - extra
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
        phi, left = _ritz_residual(mass, stiffness, phi, asked)
        if left < best:
            best, found = left, phi
        if left <= 1:
            break
    return found


def _ritz_residual(M: Any, K: Any, phi: FloatArray, asked: int) -> tuple[FloatArray, float]:
    """Return the Rayleigh-Ritz shapes in the span of phi, and the worst residual of `asked` ones.

    ``||K phi - omega^2 M phi|| / ||K phi||`` in units of what is let pass.
    """
    force, mass = K @ phi, M @ phi
    squares, mix = la.eigh(_even(phi.T @ force), _even(phi.T @ mass))
    force, mass = _mixed(force, mix[:, :asked]), _mixed(mass, mix[:, :asked])
    phi = _mixed(phi, mix)
    size = np.linalg.norm(force, axis=0)
    mass *= squares[:asked]
    force -= mass
    left = np.linalg.norm(force, axis=0)
    del force, mass
    rounding = np.finfo(np.float64).eps * np.linalg.norm(
        _absolute(K) @ np.abs(phi[:, :asked]), axis=0
    )
    return phi, float(np.max(left / np.maximum(_RESIDUAL * size, _ROUNDINGS * rounding)))


def _mixed(X: FloatArray, mix: FloatArray) -> FloatArray:
    """Return ``X mix`` in the place of X: a second array of this size is memory at its peak."""
    for begin in range(0, X.shape[0], _ROWS):
        rows = slice(begin, begin + _ROWS)
        X[rows, : mix.shape[1]] = X[rows] @ mix
    return X[:, : mix.shape[1]]


def _absolute(K: Any) -> Any:
    return sp.csr_array((np.abs(K.data), K.indices, K.indptr), shape=K.shape)


def _even(A: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (A + A.T))


def _rayleigh_ritz(model: FEModel, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
    stiffness = phi.T @ (by_rows(model.K) @ phi)
    mass = phi.T @ (by_rows(model.M) @ phi)
    squares, mix = la.eigh(_even(stiffness), _even(mass))
    return squares, np.asarray(phi @ mix)


def _apart(squares: FloatArray, count: int, top: float, largest: float) -> bool:
    """Return whether `top` is well between the last mode below it and the next."""
    near = squares[count - 1 : count + 1]
    return bool(
        np.all(np.abs(near - top) > _closest(top, largest) * top) and near[0] < top < near[-1]
    )


def _closest(square: float, largest: float) -> float:
    """Return the relative distance of two omega^2 that rounding of K and M lets tell apart."""
    return max(_GAP, _GAP_ROUNDINGS * float(np.finfo(np.float64).eps) * largest / square)


def _gap(squares: FloatArray, count: int, largest: float) -> tuple[int, float]:
    """Return how many modes lie below the widest gap after the last wanted one, and its middle."""
    above = squares[count - 1 :]
    wide = np.diff(above) / above[1:]
    if not wide.size or wide.max() <= _closest(float(above[-1]), largest):
        return 0, 0.0
    i = int(np.argmax(wide))
    return count + i, 0.5 * float(above[i] + above[i + 1])
