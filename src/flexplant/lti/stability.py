"""Whether a system has norms at all, and the pole that makes them infinite."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..values import ComplexArray, FloatArray
from .scaling import even_scale, state_scale
from .statespace import StateSpace

#: poles this close to the axis, relative to the size of A, are examined with their condition
NEAR = 1e-6
#: roundings of A that a pole is allowed to have suffered
ROUNDINGS = 4.0
#: largest condition of a pole: two in one are moved by the root of rounding
DOUBLE = 1.0 / float(np.sqrt(np.finfo(float).eps))


class Obstacle(NamedTuple):
    """A pole that makes a norm infinite."""

    reason: str
    freq: float  # [Hz]


def obstacle(
    g: StateSpace, *, axis_only: bool = False, known: ComplexArray | None = None
) -> Obstacle | None:
    """Return the worst pole on or beyond the edge of stability (or on it alone), or None.

    Computed poles are moved by rounding: those of a rigid body in dense A come out at some 1e-4
    rad/s, on either side. A pole nearer to the edge than its own uncertainty (rounding of A times
    the condition of the eigenvalue) counts as lying on it. Eigenvalues that are known are not
    computed again.
    """
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
    """Return the poles and how far rounding may have moved each."""
    poles = g.poles() if known is None else known
    if g.blocks is not None and max(g.blocks) <= 2:
        return poles, np.zeros(poles.size)  # closed form: as exact as A
    d = state_scale(g.A, g.B, g.C)
    A = g.A * d / d[:, None]
    gap = np.abs(np.abs(poles) - 1.0 if g.dt else poles.real)
    size = float(np.linalg.norm(A))  # at least the norm, which costs more
    if np.any(gap <= NEAR * size):
        size = float(np.linalg.norm(A, 2))
    error = np.finfo(float).eps * size * np.ones(poles.size)
    if not np.any(gap <= NEAR * size):
        return poles, error
    poles, _, error = eigenvalues_with_error(A)
    return poles, error


def eigenvalues_with_error(
    A: FloatArray, largest: float = DOUBLE
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return eigenvalues, eigenvectors and how far rounding may have moved each eigenvalue.

    In the units that LAPACK takes for A itself, in which the blocks of unlike speed that do not act
    on each other do not spoil each other. Conditions count up to `largest`.
    """
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
