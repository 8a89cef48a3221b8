"""Minimal realisations: without the states that no input moves or no output sees."""

from __future__ import annotations

import numpy as np

from ..arguments import between
from ..values import FloatArray
from .factors import controllability_factor, observability_factor
from .interconnection import parallel
from .joining import is_block_diagonal
from .modal import modal_form
from .scaling import reciprocal, state_scale
from .splitting import split_stable
from .statespace import StateSpace, System, as_statespace

#: Hankel singular values below this of the sizes of the two factors are rounding: a part that is
#: not reached where it is seen has no others
NOISE = 1e-13


def minimal(sys: System, *, tol: float = 1e-10) -> StateSpace:
    """Return the system without states that are not both reached and seen.

    The stable part is balanced and loses the states with Hankel singular values below `tol` of
    the largest; channels are scaled to one size first, so that metres beside newtons do not decide
    what is small. Rigid-body and unstable modes are judged in the same way after a shift of the
    axis, which changes neither reachability nor observability.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled.
    tol : float
        Relative; below it rounding decides. A state of this size changes no frequency response by
        more than twice `tol` of the largest.

    Returns
    -------
    StateSpace
        The same channels; `sys` itself when nothing is to be left out, and blocks are found again
        when it had any.

    Raises
    ------
    ModelError
        When `sys` is no system or tol is not between 0 and 1.
    SolverError
        When stable and unstable modes cannot be distinguished.

    References
    ----------
    [TombsPostlethwaite1987]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.minimal(fx.lti.tf([1.0, 2.0], [1.0, 3.0, 2.0])).poles().real.round(9)
    array([-1.])
    """
    g = as_statespace(sys)
    tol = between(tol, "tol", 0.0, 1.0, "Try 1e-9.")
    if not g.n_states:
        return g
    split = split_stable(g)
    stable, rest = split.stable, split.rest
    if not is_block_diagonal(g):  # what a part has of B or C may be what splitting left of zero
        stable, rest = _cleaned(stable, rest), _cleaned(rest, stable)
    stable, rest = _less(stable, tol), _less(rest, tol)
    n = stable.n_states + rest.n_states
    if n == g.n_states:
        return g
    both = parallel(stable, rest)
    blocks = both.blocks if g.blocks is not None else None
    return both.replace(
        states=[f"x{i}" for i in range(1, n + 1)], name=g.name, blocks=blocks or None
    )


def _cleaned(part: StateSpace, other: StateSpace) -> StateSpace:
    """Return a part with B and C set to zero where they are rounding beside those of the other."""
    idle = np.linalg.norm(part.B) <= NOISE * np.linalg.norm(other.B)
    unseen = np.linalg.norm(part.C) <= NOISE * np.linalg.norm(other.C)
    return part.replace(B=0 * part.B, C=0 * part.C) if idle or unseen else part


def _less(g: StateSpace, tol: float) -> StateSpace:
    n = g.n_states
    if not n:
        return g
    judged = _stabilised(g)
    # one size for all channels: what reaches the states from each input, what each output sees
    seen = observability_factor(judged)
    drive = reciprocal(np.linalg.norm(seen.T @ g.B, axis=0))
    judged = judged.replace(B=judged.B * drive)
    reached = controllability_factor(judged)
    sight = reciprocal(np.linalg.norm(g.C @ reached, axis=1))
    judged = judged.replace(C=judged.C * sight[:, None])
    seen = observability_factor(judged)
    left, values, right = np.linalg.svd(seen.T @ reached)
    d = state_scale(judged.A, judged.B, judged.C)[:, None]
    rounding = NOISE * float(np.linalg.norm(seen * d) * np.linalg.norm(reached / d))
    r = int(np.sum(values > max(tol * values[0], rounding)))
    if r == n:
        return g
    root = np.sqrt(values[:r])
    W, T = seen @ left[:, :r] / root, reached @ right[:r].T / root
    less = g.replace(A=W.T @ g.A @ T, B=W.T @ g.B, C=g.C @ T, states=(), blocks=None)
    return modal_form(less).system if g.blocks is not None and r else less


def _stabilised(g: StateSpace) -> StateSpace:
    """Return the system with its poles moved together until it is stable: the same subspaces.

    They move by the speed of the system in even units of the states. Much farther out all of them
    look alike: what zeros near them distinguish in a chain of integrators falls below `tol`.
    """
    poles = g.poles()
    eye = np.eye(g.n_states)
    if g.dt:
        radius = float(np.max(np.abs(poles)))
        if radius < 1 and g.is_stable:
            return g
        speed = min(_speed(g, g.A - radius * eye), 0.2)
        return g.replace(A=g.A / (radius + (speed or 0.2)))
    growth = float(poles.real.max())
    if growth < 0:
        return g
    return g.replace(A=g.A - (growth + (_speed(g, g.A) or 1.0)) * eye)


def _speed(g: StateSpace, A: FloatArray) -> float:
    """Return the size of A of a system in even units of its states, a root mean square."""
    d = state_scale(A, g.B, g.C)
    return float(np.linalg.norm(A * d / d[:, None]) / np.sqrt(g.n_states))
