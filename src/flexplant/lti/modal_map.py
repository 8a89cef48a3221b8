"""The modal map of a system: poles, input and output vectors."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray
from ..tolerances import ROOT, SPLIT
from .blocks_of_states import diagonal_blocks, is_block_diagonal, turning_parts
from .equations import even_scale, state_scale
from .statespace import StateSpace

#: largest condition of eigenvectors whose residues are used
POOR = 1e5


class ModalMap(NamedTuple):
    """Poles (n,) of A, its eigenvectors T and T^-1: full, or (b, 2, 2) of uncoupled pairs."""

    poles: ComplexArray
    T: ComplexArray
    inverse: ComplexArray

    @classmethod
    def of_pairs(cls, pairs: FloatArray) -> ModalMap:
        """Return the map of separate blocks (b, 2, 2); T^-1 is not finite for defective blocks.

        The poles are m +- r, m half the trace and ``r^2 I = (A - m I)^2`` (Cayley-Hamilton): their
        damping is as accurate as the block.
        """
        mean, N, q = turning_parts(pairs)
        half, e, c = N[:, 0, 0], N[:, 0, 1], N[:, 1, 0]
        plain = (e == 0) & (c == 0)
        root: ComplexArray = np.where(plain, half, np.sqrt(q.astype(np.complex128)))
        first, second = root + half, root - half  # r + N_11, r - N_11; their product is e c
        T = np.where(
            np.abs(e) >= np.abs(c),
            np.array([[e + 0j, e + 0j], [second, -first]]),
            np.array([[first, -second], [c + 0j, c + 0j]]),
        ).transpose(2, 0, 1)
        T[plain] = np.eye(2)
        adjugate = np.stack([T[:, 1, 1], -T[:, 0, 1], -T[:, 1, 0], T[:, 0, 0]], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = adjugate / (T[:, 0, 0] * T[:, 1, 1] - T[:, 0, 1] * T[:, 1, 0])[:, None]
        poles = np.stack([mean + root, mean - root], axis=1).reshape(-1)
        return cls(poles, T, inverse.reshape(-1, 2, 2))

    def gramian(self, driven: ComplexArray, *, sampled: bool) -> ComplexArray:
        """Return X of ``L X + X L* + d d* = 0``, or ``X = L X L* + d d*``: of modes driven by d."""
        other = self.poles.conj()
        sums = 1.0 - np.outer(self.poles, other) if sampled else -np.add.outer(self.poles, other)
        return np.asarray(driven @ driven.conj().T / sums)

    def seen(self, rows: FloatArray) -> ComplexArray:
        """Return ``rows T``: how outputs (p, n) see the modes."""
        if self.T.ndim == 2:
            return np.asarray(rows @ self.T)
        split = rows.reshape(len(rows), len(self.T), 2)
        return np.asarray(np.einsum("pbi,bij->pbj", split, self.T).reshape(rows.shape))

    def driven(self, columns: FloatArray) -> ComplexArray:
        """Return ``T^-1 columns``: how inputs (n, m) drive the modes."""
        return _times(self.inverse, columns)

    def back(self, columns: ComplexArray) -> ComplexArray:
        """Return ``T columns``: the states (n, m) of modes."""
        return _times(self.T, columns)

    def shapes(self, chosen: IntArray) -> ComplexArray:
        """Return some columns of T."""
        if self.T.ndim == 2:
            return self.T[:, chosen]
        found = np.zeros((len(self.T), 2, chosen.size), dtype=np.complex128)
        found[chosen // 2, :, np.arange(chosen.size)] = self.T[chosen // 2, :, chosen % 2]
        return np.asarray(found.reshape(2 * len(self.T), chosen.size))


def _times(factor: ComplexArray, columns: FloatArray | ComplexArray) -> ComplexArray:
    if factor.ndim == 2:
        return np.asarray(factor @ columns)
    split = columns.reshape(len(factor), 2, columns.shape[1])
    return np.asarray((factor @ split).reshape(columns.shape))


class Diagonal(NamedTuple):
    """``C (s I - A)^-1 B = left (s I - diag(poles))^-1 right``; None for ill-conditioned V."""

    poles: ComplexArray
    left: ComplexArray | None = None
    right: ComplexArray | None = None


def diagonal_form(A: FloatArray, B: FloatArray, C: FloatArray) -> Diagonal:
    """Return a system in the eigenvectors of A; only its poles where these are ill-conditioned."""
    if len(A) == 1:
        return Diagonal(*(part.astype(np.complex128) for part in (A[0], C, B)))
    d = state_scale(A, B, C)
    found: Any = np.linalg.eig(A * d / d[:, None])
    poles, V = (np.asarray(part, dtype=np.complex128) for part in found)
    try:
        inverse = np.linalg.inv(V)
    except np.linalg.LinAlgError:
        return Diagonal(poles)
    with np.errstate(over="ignore"):  # of defective poles
        condition = np.linalg.norm(V) * np.linalg.norm(inverse)
    if not condition < POOR:
        return Diagonal(poles)
    return Diagonal(poles, (C * d) @ V, inverse @ (B / d[:, None]))


def block_form(g: StateSpace) -> Diagonal | None:
    """Return a system in the modes of its blocks, in closed form; None where A has others."""
    if not is_block_diagonal(g):
        return None
    pairs, slots = diagonal_blocks(g.A, g.blocks or ())
    own = ModalMap.of_pairs(pairs)
    if not np.isfinite(own.inverse).all():
        return Diagonal(own.poles)
    real, n = slots >= 0, slots.size
    B, C = g.B[slots] * real[:, :, None], g.C[:, slots] * real
    return Diagonal(own.poles, own.seen(C.reshape(-1, n)), own.driven(B.reshape(n, -1)))


#: number of roundings of A that a pole may contain
ROUNDINGS = 4.0


class Obstacle(NamedTuple):
    """A pole that makes a norm infinite."""

    reason: str
    freq: float  # [Hz]


def obstacle(
    g: StateSpace, *, axis_only: bool = False, known: ComplexArray | None = None
) -> Obstacle | None:
    """Return the worst pole on or beyond the stability limit (or only on it), or None."""
    # rounding moves computed poles: those of a rigid body in dense A have about 1e-4 rad/s with
    # either sign. A pole closer to the limit than its uncertainty (rounding of A times the
    # condition number of the eigenvalue) counts as lying on it. Known eigenvalues are not computed
    # again
    if not g.n_states:
        return None
    poles, error = uncertain_poles(g, known)
    growth = np.abs(poles) - 1.0 if g.dt else poles.real
    on_axis = np.abs(growth) <= error
    beyond = (growth > 0) & ~on_axis & (not axis_only)
    if not (beyond | on_axis).any():
        return None
    worst = int(np.argmax(np.where(beyond if beyond.any() else on_axis, growth, -np.inf)))
    pole, unsure = poles[worst], float(error[worst])
    edge = "the unit circle" if g.dt else "the imaginary axis"
    freq = float(abs(np.angle(pole) / g.dt if g.dt else pole.imag)) / (2 * np.pi)
    if beyond[worst]:
        return Obstacle(
            f"unstable: a pole at {freq:.6g} Hz lies {growth[worst]:.3g}"
            f"{'' if g.dt else ' rad/s'} beyond {edge}",
            freq,
        )
    integrates = abs(pole - 1.0 if g.dt else pole) <= unsure
    kind = "a rigid-body mode or integrator" if integrates else f"an undamped pole at {freq:.6g} Hz"
    rounding = f" (to within its rounding, {unsure:.1g})" if unsure else ""
    return Obstacle(f"marginal: {kind} lies on {edge}{rounding}", 0.0 if integrates else freq)


def uncertain_poles(
    g: StateSpace, known: ComplexArray | None = None
) -> tuple[ComplexArray, FloatArray]:
    """Return the poles and the uncertainty of each by rounding."""
    poles = g.poles() if known is None else known
    if g.blocks is not None and max(g.blocks) <= 2:
        return poles, np.zeros(poles.size)  # closed form: as exact as A
    d = state_scale(g.A, g.B, g.C)
    A = g.A * d / d[:, None]
    gap = np.abs(np.abs(poles) - 1.0 if g.dt else poles.real)
    size = float(np.linalg.norm(A))  # at least the norm, which costs more
    if np.any(gap <= SPLIT * size):
        size = float(np.linalg.norm(A, 2))
    error = np.finfo(float).eps * size * np.ones(poles.size)
    if not np.any(gap <= SPLIT * size):
        return poles, error
    poles, _, error = eigenvalues_with_error(A)
    return poles, error


def eigenvalues_with_error(
    A: FloatArray, largest: float = 1.0 / ROOT
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return eigenvalues, eigenvectors and the uncertainty of each eigenvalue by rounding."""
    # in the units of LAPACK's balancing, in which blocks of different speed do not affect each
    # other
    found: Any = la.eig(A, left=True, right=True)
    values, left, right = found
    d = even_scale(A)[:, None]
    size = np.linalg.norm(left * d, axis=0) * np.linalg.norm(right / d, axis=0)
    condition = size / np.maximum(np.abs(np.sum(left.conj() * right, axis=0)), size / largest)
    rounding = ROUNDINGS * np.finfo(float).eps * float(np.linalg.norm(A * d.T / d, 2))
    return (
        np.asarray(values, dtype=np.complex128),
        right.astype(np.complex128),
        rounding * condition,
    )
