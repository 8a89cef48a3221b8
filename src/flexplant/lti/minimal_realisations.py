"""Minimal realisations: systems without uncontrollable or unobservable states."""

from __future__ import annotations

from contextlib import suppress
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
#: least speed by which poles are moved until they are stable, relative to the slowest mode: even
#: units make a chain of integrators arbitrarily slow where one of its states is hidden
SLOW = 1e-4


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
    even, groups = (g, _block_groups(g)) if is_block_diagonal(g) else _dense_groups(g)
    visible, slowest = _visible(groups, tol), _frequencies(groups)[0]
    kept, hidden = [], []
    for group in groups:
        none = np.zeros((group.part.n_states, 0))
        W, T = _essential(group.part, tol, slowest) if group in visible else (none, none)
        if T.size:
            kept.append(_Group(_projected(group.part, W, T), group.omega))
        if group.bases is not None:
            right, left = group.bases
            hidden.append((right @ _complement(W), left @ _complement(T)))
    n = sum(group.part.n_states for group in kept)
    if n == g.n_states:
        return g
    parts, at = [group.part for group in kept], _frequencies(kept)
    found = g.replace(
        A=block_matrix([part.A for part in parts]),
        B=np.vstack([g.B[:0], *(part.B for part in parts)]),
        C=np.hstack([g.C[:, :0], *(part.C for part in parts)]),
        states=[f"x{i}" for i in range(1, n + 1)],
        blocks=(joined_blocks(parts) or None) if g.blocks is not None else None,
    )
    if not _agree(found, g, at) and hidden:
        # modes cancel each other where the response rolls off, and where they are almost parallel
        with suppress(np.linalg.LinAlgError):
            found = _without(even, hidden)
    return found if _agree(found, g, at) else g


@dataclass(frozen=True, eq=False)
class _Group:
    """Modes of equal poles as a separate system, without feedthrough, and where they act."""

    part: StateSpace
    omega: FloatArray  # [rad/s], 0 for a rigid-body mode or an integrator
    #: bases (n, k) of its right and left invariant subspace in a dense system
    bases: tuple[FloatArray, FloatArray] | None = None


def _complement(basis: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the vectors that are orthogonal to a basis (n, k)."""
    return np.asarray(np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :])


def _without(g: StateSpace, hidden: list[tuple[FloatArray, FloatArray]]) -> StateSpace:
    """Return a system without invariant subspaces, given by bases (n, k) on the right and left."""
    right = _unmixed_complement(np.hstack([left for _, left in hidden]))
    left = _unmixed_complement(np.hstack([right for right, _ in hidden]))
    rows = np.linalg.solve(left.T @ right, left.T)
    A, B, C = rows @ g.A @ right, rows @ g.B, g.C @ right
    return g.replace(A=A, B=B, C=C, states=[f"x{i}" for i in range(1, len(A) + 1)])


def _unmixed_complement(basis: FloatArray) -> FloatArray:
    """Return a basis of the vectors that are orthogonal to a basis (n, k).

    Each vector contains one of n - k states and the k others. An orthonormal basis would mix small
    states with the rounding of large ones.
    """
    n, k = basis.shape
    order = la.qr(basis.T, mode="r", pivoting=True)[1]
    others, states = order[:k], np.sort(order[k:])
    found = np.zeros((n, n - k))
    found[states, np.arange(n - k)] = 1.0
    found[others] = -np.linalg.solve(basis[others].T, basis[states].T)
    return found


def _block_groups(g: StateSpace) -> list[_Group]:
    """Return the system, but for its feedthrough, as a sum of groups of modes of equal poles."""
    poles = g.poles()
    owner = np.repeat(np.arange(len(g.blocks or ())), g.blocks or ())
    label = _labels(poles, SPLIT * np.abs(poles), owner[:, None] == owner)
    plain = g.replace(D=0 * g.D)
    return [
        _Group(part_of(plain, label == k), _omega(poles[label == k], g.dt))
        for k in range(label.max() + 1)
    ]


def _dense_groups(g: StateSpace) -> tuple[StateSpace, list[_Group]]:
    """Return any system in even units, and its groups.

    If its modes are too mixed, the groups are its stable part and the rest, without bases.
    """
    d = state_scale(g.A, g.B, g.C)
    A, B, C = g.A * d / d[:, None], g.B / d[:, None], g.C * d
    # the largest meaningful condition of a pole: of a double one, then of any multiplicity
    for largest in (1.0 / ROOT, 1.0 / ROUNDING):
        poles, vectors, error, duals = eigenvalues_with_error(A, largest)
        same = SPLIT * np.abs(poles)
        conjugate = np.abs(poles[:, None] - poles.conj()) <= same
        label = _labels(poles, np.maximum(same, error), conjugate)
        bases = _bases(A, poles, vectors, error, label)
        V = np.hstack(bases)
        units = np.linalg.norm(V, axis=1)  # units in which the signals of a cascade have equal size
        # left vectors depend on their own group alone. The inverse of V spoils all groups if some
        # modes are almost parallel, such as those of a Pade approximation
        rows = _bases(A.T, poles, duals.conj(), error, label)
        pairs = [
            _biorthogonal(right / units[:, None], left * units[:, None])
            for right, left in zip(bases, rows, strict=True)
        ]
        sizes = [float(np.linalg.norm(right) * np.linalg.norm(left)) for right, left in pairs]
        apart = all(size <= 1.0 / SPLIT for size in sizes)
        if apart:
            break
    centre = 1.0 if g.dt else 0.0
    omega = _omega(np.where(np.abs(poles - centre) <= error, centre, poles), g.dt)
    if not apart:
        split = split_stable(g)
        parts = [split.stable.replace(D=0 * g.D), split.rest]
        return g, [_Group(part, omega) for part in parts if part.n_states]
    even = g.replace(
        A=A * units / units[:, None], B=B / units[:, None], C=C * units, states=(), blocks=None
    )
    groups = []
    for k, (right, left) in enumerate(pairs):
        A, B, C = left.T @ even.A @ right, _sum_of(left.T, even.B), _sum_of(even.C, right)
        part = even.replace(A=A, B=B, C=C, D=0 * g.D, states=())
        groups.append(_Group(part, omega[label == k], (right, left)))
    return even, groups


def _biorthogonal(right: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return bases with ``left.T @ right = 1``; the left one is infinite if there is none."""
    try:
        return right, np.asarray(np.linalg.solve(left.T @ right, left.T).T)
    except np.linalg.LinAlgError:
        return right, np.full_like(left, np.inf)


def _sum_of(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``left @ right``, zero where it is the rounding of its terms."""
    product = left @ right
    return np.where(np.abs(product) > RANK * (np.abs(left) @ np.abs(right)), product, 0.0)


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


def _essential(g: StateSpace, tol: float, slowest: float) -> tuple[FloatArray, FloatArray]:
    """Return bases W, T (n, r) of the balanced states of Hankel singular values above `tol`.

    ``W.T @ T = 1``. `slowest` is the frequency [rad/s] of the slowest mode of the whole system.
    """
    n = g.n_states
    if n == 1 or (n == 2 and np.any(np.linalg.eigvals(g.A).imag)):
        return np.eye(n), np.eye(n)  # a single mode is kept or removed
    judged = _stabilised(g, SLOW * slowest)
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
        return np.eye(n), np.eye(n)
    root = np.sqrt(values[:r])
    return seen @ left[:, :r] / root, reached @ right[:r].T / root


def _projected(g: StateSpace, W: FloatArray, T: FloatArray) -> StateSpace:
    """Return a group with the states ``W.T x``; in blocks if it had blocks."""
    if T.shape[1] == g.n_states:
        return g
    less = g.replace(A=W.T @ g.A @ T, B=W.T @ g.B, C=g.C @ T, states=(), blocks=None)
    return less if g.blocks is None else modal_form(less).system


def _stabilised(g: StateSpace, least: float) -> StateSpace:
    """Return the system with its poles moved together until it is stable: the same subspaces.

    If they are moved, then by at least a speed [rad/s].
    """
    # by the speed of the system: with a much larger shift all poles look equal, and zeros near
    # chains of integrators are lost
    poles = g.poles()
    eye = np.eye(g.n_states)
    if g.dt:
        radius = float(np.max(np.abs(poles)))
        if radius < 1 and g.is_stable:
            return g
        # at most to a decay within five samples
        speed = min(max(_matrix_size(g, g.A - radius * eye), least * g.dt), 0.2)
        return g.replace(A=g.A / (radius + speed))
    growth = float(poles.real.max())
    if growth < 0:
        return g
    return g.replace(A=g.A - (growth + max(_matrix_size(g, g.A), least)) * eye)


def _matrix_size(g: StateSpace, A: FloatArray) -> float:
    """Return the size of A of a system in even units of its states, a root mean square."""
    d = state_scale(A, g.B, g.C)
    return float(np.linalg.norm(A * d / d[:, None]) / np.sqrt(g.n_states))
