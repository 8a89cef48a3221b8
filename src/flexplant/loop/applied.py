"""The law of a closed loop whose actuators may apply less than it commands."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray
from ..errors import AssumptionError, ModelError
from ..lti.lyapunov import solve_stein
from ..lti.statespace import StateSpace
from ..tolerances import TINY
from .blocks import driving_blocks
from .closed import ClosedLoop

#: smallest part of the largest observability of slow states by the commands that counts
_SEEN = 1e-12


def applied_law(loop: ClosedLoop, recovery: float | None) -> tuple[StateSpace, FloatArray]:
    """Return the law [y; applied u] -> [u; watched], and L (n, nu) of its anti-windup.

    Its states move by ``L (applied - commanded)`` besides: slow ones of blocks that drive actuators
    return within `recovery` [samples]; L is zero without.
    """
    plant, driven = loop.plant, list(loop.driven)
    law = driving_blocks(plant, loop.blocks, driven, list(loop.watched), applied=True)
    ny, nu = len(plant.y), len(driven)
    if np.any(law.D[:nu, ny:]):
        i, j = np.argwhere(law.D[:nu, ny:])[0]
        raise AssumptionError(
            f"the command {driven[i]!r} depends on the applied {driven[j]!r} of the same sample, "
            "which is known after the command only. Let the block read it one sample late, or "
            "design the observer on a plant with a delay: plant.discretized(rate, delay=1)."
        )
    if recovery is None:
        return law, np.zeros((law.n_states, nu))
    return law, _mirror_gain(loop, law.A, law.C[:nu], float(np.exp(-1.0 / recovery)))


def _mirror_gain(loop: ClosedLoop, A: FloatArray, C: FloatArray, radius: float) -> FloatArray:
    """Return L that mirrors the slow poles of the driving blocks at a circle.

    Only poles beyond the circle move: with V a basis of their invariant subspace, ``A V = V S``
    and ``L = V L_s``, where L_s is the filter gain of (S / radius, C V) for no process noise. It
    takes each pole p to radius^2 / p, with the least gain that does.
    """
    owner = np.repeat(np.arange(len(loop.blocks)), [b.n_states for b in loop.blocks])
    drives = [bool(set(b.outputs) & set(loop.driven)) for b in loop.blocks]
    own = np.flatnonzero(np.asarray(drives, dtype=bool)[owner])
    L = np.zeros((A.shape[0], C.shape[0]))
    if not own.size:
        return L

    def beyond(real: float, imaginary: float) -> bool:
        return bool(np.hypot(real, imaginary) > radius)

    T, Z, slow = la.schur(A[np.ix_(own, own)], sort=beyond)
    if not slow:
        return L
    V, S = Z[:, :slow], T[:slow, :slow]
    see = C[:, own] @ V
    see = see / np.abs(see).max(initial=TINY)
    inverse = np.asarray(np.linalg.inv(S / radius), dtype=np.float64)
    X = solve_stein(inverse.T, inverse.T @ see.T @ see @ inverse)
    values = np.linalg.eigvalsh(X)
    if values[0] <= _SEEN * values[-1]:
        raise ModelError(
            f"{slow} slow states of the blocks that drive actuators cannot all be found from the "
            f"{C.shape[0]} commands, so that anti_windup cannot return them. Leave anti_windup out "
            "and give the blocks one of their own, or let fewer integrators drive each actuator."
        )
    M = np.linalg.solve(X, see.T)
    gain = S @ M @ np.linalg.inv(see @ M + np.eye(C.shape[0]))
    L[own] = V @ gain / np.abs(C[:, own] @ V).max()
    return L
