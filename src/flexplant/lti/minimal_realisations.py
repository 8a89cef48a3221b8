"""Minimal realisations: systems without uncontrollable or unobservable states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
from scipy.sparse import csgraph

from ..arrays import ComplexArray, FloatArray, between
from ..tolerances import CLOSE, RANK, ROOT, ROUNDING, SAME, SPLIT, TINY, TYPED
from .blocks_of_states import block_matrix, is_block_diagonal, joined_blocks
from .equations import reciprocal, state_scale
from .lyapunov import controllability_factor, observability_factor
from .modal import eigenvalues_with_error, modal_form, part_of, split_stable
from .response_solvers import responses
from .statespace import StateSpace, System, as_statespace

#: distance of a point from the imaginary axis, relative to its frequency: large enough to avoid
#: resonances and zeros
FAR_OFF = 0.1


def minimal(sys: System, *, tol: float = 1e-10) -> StateSpace:
    """Return the system without uncontrollable or unobservable states.

    Each mode is judged at its own frequency: it is removed if its peak is below `tol` times the
    response of the whole system there, independent of larger responses at other frequencies. Modes
    with equal poles are judged together. Their states are balanced, and states with Hankel singular
    values below `tol` times the largest one are removed. Channels are scaled to equal size, so that
    units do not decide. The responses at the frequencies of all kept modes are compared with those
    of `sys`, which is returned unchanged if they do not agree.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system.
    tol : float
        Relative tolerance; it should be above rounding.

    Returns
    -------
    StateSpace
        System with the same channels; `sys` itself if no state can be removed. Blocks are found
        again if it had blocks.

    Raises
    ------
    ModelError
        When `sys` is not a system or tol is not between 0 and 1.
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
    groups = _pole_groups(g)
    kept = [_Group(_less(group.part, tol), group.omega) for group in _visible(groups, tol)]
    kept = [group for group in kept if group.part.n_states]
    n = sum(group.part.n_states for group in kept)
    if n == g.n_states:
        return g
    parts = [group.part for group in kept]
    found = g.replace(
        A=block_matrix([part.A for part in parts]),
        B=np.vstack([g.B[:0], *(part.B for part in parts)]),
        C=np.hstack([g.C[:, :0], *(part.C for part in parts)]),
        states=[f"x{i}" for i in range(1, n + 1)],
        blocks=(joined_blocks(parts) or None) if g.blocks is not None else None,
    )
    return found if _agree(found, g, _frequencies(kept)) else g


@dataclass(frozen=True)
class _Group:
    """Modes of equal poles as a separate system, without feedthrough, and where they act."""

    part: StateSpace
    omega: FloatArray  # [rad/s], 0 for a rigid-body mode or an integrator


def _pole_groups(g: StateSpace) -> list[_Group]:
    """Return the system, but for its feedthrough, as a sum of groups of modes of equal poles."""
    if not is_block_diagonal(g):
        return _dense_groups(g)
    poles = g.poles()
    owner = np.repeat(np.arange(len(g.blocks or ())), g.blocks or ())
    label = _labels(poles, SPLIT * np.abs(poles), owner[:, None] == owner)
    plain = g.replace(D=0 * g.D)
    return [
        _Group(part_of(plain, label == k), _omega(poles[label == k], g.dt))
        for k in range(label.max() + 1)
    ]


def _dense_groups(g: StateSpace) -> list[_Group]:
    """Return the groups of any A; its stable part and the rest where its modes are too mixed."""
    d = state_scale(g.A, g.B, g.C)
    A, B, C = g.A * d / d[:, None], g.B / d[:, None], g.C * d
    # the largest meaningful condition of a pole: of a double one, then of any multiplicity
    for largest in (1.0 / ROOT, 1.0 / ROUNDING):
        poles, vectors, error = eigenvalues_with_error(A, largest)
        same = SPLIT * np.abs(poles)
        conjugate = np.abs(poles[:, None] - poles.conj()) <= same
        label = _labels(poles, np.maximum(same, error), conjugate)
        bases = _bases(A, poles, vectors, error, label)
        V = np.hstack(bases)
        units = np.linalg.norm(V, axis=1)  # units in which the signals of a cascade have equal size
        V = V / units[:, None]
        whole = V.shape == A.shape and bool(np.all(np.isfinite(V)))
        apart = whole and float(np.linalg.cond(V)) <= 1.0 / SPLIT
        if apart:
            break
    centre = 1.0 if g.dt else 0.0
    omega = _omega(np.where(np.abs(poles - centre) <= error, centre, poles), g.dt)
    if not apart:
        split = split_stable(g)
        parts = [split.stable.replace(D=0 * g.D), split.rest]
        return [_Group(part, omega) for part in parts if part.n_states]
    V_inverse = np.linalg.inv(V)
    A, B = V_inverse @ (A * units / units[:, None]) @ V, V_inverse @ (B / units[:, None])
    C = (C * units) @ V
    groups, start = [], 0
    for k, basis in enumerate(bases):
        at = slice(start, start + basis.shape[1])
        start = at.stop
        part = g.replace(A=A[at, at], B=B[at], C=C[:, at], D=0 * g.D, states=(), blocks=None)
        groups.append(_Group(part, omega[label == k]))
    return groups


def _labels(poles: ComplexArray, radius: FloatArray, together: Any) -> Any:
    """Return the number of the group of each pole: overlapping discs, and required pairs."""
    reach = radius[:, None] + radius
    gap = np.minimum(abs(poles[:, None] - poles), abs(poles[:, None] - poles.conj()))
    return csgraph.connected_components((gap <= reach) | together, directed=False)[1]


def _bases(
    A: FloatArray, poles: ComplexArray, vectors: ComplexArray, error: FloatArray, label: Any
) -> list[FloatArray]:
    """Return a real basis of unit columns of the invariant subspace of each group of poles."""
    bases: list[FloatArray] = []
    schur: tuple[FloatArray, FloatArray, Any] | None = None
    for k in range(label.max() + 1):
        group = np.flatnonzero(label == k)
        v: ComplexArray = vectors[:, group[0]]
        if group.size == 1:
            bases.append(v.real[:, None])
        elif group.size == 2 and abs(poles[group[0]].imag) > error[group[0]]:
            # the phase that makes real and imaginary part orthogonal: the best conditioned pair
            v = v * np.exp(-0.5j * np.angle(np.sum(v**2)))
            bases.append(np.sqrt(2.0) * np.stack([v.real, v.imag], axis=1))
        else:  # eigenvectors of equal poles are parallel: their subspace by an ordered Schur form
            if schur is None:
                T, Z = la.schur(A)
                real, imag = la.lapack.dtrsen(np.zeros(len(T)), T, Z, job="N")[2:4]
                found = (real + 1j * imag)[:, None]
                schur = T, Z, label[np.argmin(abs(found - poles), axis=1)]
            T, Z, owner = schur
            bases.append(la.lapack.dtrsen(owner == k, T, Z, job="N")[1][:, : group.size])
    return bases


def _omega(poles: ComplexArray, dt: float) -> FloatArray:
    """Return the frequencies [rad/s] at which modes act: the sizes of their continuous poles."""
    if not dt:
        return np.asarray(np.abs(poles))
    logs = np.log(np.where(poles == 0, TINY, poles))
    return np.asarray(np.minimum(np.abs(logs), np.pi) / dt)


def _frequencies(groups: list[_Group]) -> FloatArray:
    """Return all frequencies [rad/s] of groups; a rigid body gets that of the slowest mode."""
    omega = np.unique(np.concatenate([np.zeros(0), *(group.omega for group in groups)]))
    moving = omega[omega > 0]
    return moving if moving.size else np.ones(1)


def _visible(groups: list[_Group], tol: float) -> list[_Group]:
    """Return the groups whose contribution around their frequency exceeds rounding."""
    slowest = _frequencies(groups)[0]
    omega = [np.maximum(np.unique(group.omega), slowest) for group in groups]
    whole = sum(_gains(group.part, np.concatenate(omega), FAR_OFF) for group in groups)
    size = _equalisers(np.abs(np.asarray(whole)))
    last = np.cumsum([len(w) for w in omega])
    kept = []
    for group, w, end in zip(groups, omega, last, strict=True):
        unit = size[end - len(w) : end]
        far, near = (np.abs(_gains(group.part, w, off)) * unit for off in (FAR_OFF, SAME))
        if np.max(far) > RANK and np.max(near) > tol:
            kept.append(group)
    return kept


def _gains(g: StateSpace, omega: FloatArray, offset: float) -> ComplexArray:
    """Return the gains (n, p, m) at points ``(offset + j) omega`` in the unstable half plane."""
    s = (offset + 1j) * omega
    s = np.exp(s * g.dt) if g.dt else s
    shifted = s[:, None, None] * np.eye(g.n_states) - g.A
    return np.asarray(g.C @ np.linalg.solve(shifted, np.broadcast_to(g.B, (s.size, *g.B.shape))))


def _equalisers(gains: FloatArray) -> FloatArray:
    """Return factors (n, p, m) that scale the largest gain of each input, then output, to 1."""
    columns = reciprocal(np.max(gains, axis=1, keepdims=True, initial=0.0))
    rows = reciprocal(np.max(gains * columns, axis=2, keepdims=True, initial=0.0))
    return np.asarray(rows * columns)


def _agree(found: StateSpace, g: StateSpace, omega: FloatArray) -> bool:
    """Return whether two systems have the same responses next to the frequencies of modes."""
    omega = (1.0 - CLOSE) * omega
    ours, wanted = (responses(s, omega / (2.0 * np.pi)).transpose(2, 0, 1) for s in (found, g))
    unit = _equalisers(np.abs(wanted))
    return bool(np.max(np.abs(ours - wanted) * unit, initial=0.0) <= TYPED)


def _less(g: StateSpace, tol: float) -> StateSpace:
    """Return a system without the balanced states of Hankel singular values below `tol`."""
    n = g.n_states
    if n == 1 or (n == 2 and np.any(np.linalg.eigvals(g.A).imag)):
        return g  # a single mode is kept or removed
    judged = _stabilised(g)
    # equal size of all channels: effect of each input on the states, and of the states on each
    # output
    seen = observability_factor(judged)
    drive = reciprocal(np.linalg.norm(seen.T @ g.B, axis=0))
    judged = judged.replace(B=judged.B * drive)
    reached = controllability_factor(judged)
    sight = reciprocal(np.linalg.norm(g.C @ reached, axis=1))
    judged = judged.replace(C=judged.C * sight[:, None])
    seen = observability_factor(judged)
    left, values, right = np.linalg.svd(seen.T @ reached)
    d = state_scale(judged.A, judged.B, judged.C)[:, None]
    rounding = RANK * float(np.linalg.norm(seen * d) * np.linalg.norm(reached / d))
    r = int(np.sum(values > max(tol * values[0], rounding)))
    if r == n:
        return g
    root = np.sqrt(values[:r])
    W, T = seen @ left[:, :r] / root, reached @ right[:r].T / root
    less = g.replace(A=W.T @ g.A @ T, B=W.T @ g.B, C=g.C @ T, states=(), blocks=None)
    return modal_form(less).system if g.blocks is not None and r else less


def _stabilised(g: StateSpace) -> StateSpace:
    """Return the system with its poles moved together until it is stable: the same subspaces."""
    # by the speed of the system: with a much larger shift all poles look equal, and zeros near
    # chains of integrators are lost
    poles = g.poles()
    eye = np.eye(g.n_states)
    if g.dt:
        radius = float(np.max(np.abs(poles)))
        if radius < 1 and g.is_stable:
            return g
        # at most to a decay within five samples
        speed = min(_matrix_size(g, g.A - radius * eye), 0.2)
        return g.replace(A=g.A / (radius + (speed or 0.2)))
    growth = float(poles.real.max())
    if growth < 0:
        return g
    return g.replace(A=g.A - (growth + (_matrix_size(g, g.A) or 1.0)) * eye)


def _matrix_size(g: StateSpace, A: FloatArray) -> float:
    """Return the size of A of a system in even units of its states, a root mean square."""
    d = state_scale(A, g.B, g.C)
    return float(np.linalg.norm(A * d / d[:, None]) / np.sqrt(g.n_states))
