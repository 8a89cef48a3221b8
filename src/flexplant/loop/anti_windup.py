"""Anti-windup: the gain with which slow states of a controller follow the applied command."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, divisor
from ..errors import ModelError, counted
from ..lti.equations import solve_lyapunov, solve_stein
from ..tolerances import NEGLIGIBLE, ROUNDING, TINY

#: reached fraction of the wanted decay where several poles coincide, which rounding splits
_REACHED = 0.5


def recovery_gain(A: FloatArray, C: FloatArray, recovery: float, dt: float) -> FloatArray:
    """Return L (n, nu): every pole of ``A - L C`` decays with the recovery time [s] or faster.

    Slower poles move to that decay and keep their frequency; the others do not change.
    """
    wanted = -1.0 / recovery
    limit = wanted * (1.0 - NEGLIGIBLE)
    unit = divisor(np.linalg.norm(C, axis=1))
    C = C / unit[:, None]
    L = np.zeros(C.T.shape)
    V, S = _slower_than(limit, A, dt)
    slow, rest = len(S), A
    for _ in range(slow if _is_seen(S, C @ V, wanted, dt) else 0):
        top = _slowest(rest, dt)
        if top <= limit:
            break
        # from the slowest on, poles of equal decay together
        equal = ROUNDING * (1.0 / dt if dt else la.norm(rest) + 1.0 / recovery)
        V, S = _slower_than(top - equal, rest, dt)
        L += V @ _mirroring(S, C @ V, 0.5 * (top + wanted), dt)
        rest = A - L @ C
    if not _slowest(rest, dt) <= _REACHED * wanted:
        raise ModelError(
            f"{counted(slow, 'slow state')} of the blocks that drive actuators cannot all be "
            f"determined from the {counted(len(C), 'command')}, so that anti-windup cannot "
            "correct them. Use fewer integrators for each actuator, or leave the recovery time "
            "out and use blocks with separate anti-windup."
        )
    return np.asarray(L / unit)


def _growth(pole: complex, dt: float) -> float:
    """Return the rate of growth [1/s] of a pole, which is negative where it decays."""
    return float(np.log(max(abs(pole), TINY)) / dt) if dt else pole.real


def _slowest(A: FloatArray, dt: float) -> float:
    """Return the largest rate of growth [1/s] of the poles."""
    return max((_growth(pole, dt) for pole in la.eigvals(A)), default=-np.inf)


def _slower_than(limit: float, A: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return V and S, ``A V = V S``, of the poles whose rate of growth is above the limit."""
    if not A.size:
        return A, A

    def slow(real: float, imaginary: float) -> bool:
        return _growth(complex(real, imaginary), dt) > limit

    T, Z, count = la.schur(A, sort=slow)
    return np.asarray(Z[:, :count]), np.asarray(T[:count, :count])


def _gramian(S: FloatArray, see: FloatArray, level: float, dt: float) -> FloatArray:
    """Return the observability Gramian, backwards in time, of poles that grow beyond a level."""
    if dt:
        back = np.asarray(np.linalg.inv(S * np.exp(-level * dt)), dtype=np.float64)
        return solve_stein(back.T, back.T @ see.T @ see @ back)
    return solve_lyapunov(level * np.eye(len(S)) - S.T, see.T @ see)


def _is_seen(S: FloatArray, see: FloatArray, level: float, dt: float) -> bool:
    """Return whether the commands show each combination of the slow states."""
    X = _gramian(S, see / np.abs(see).max(initial=TINY), level, dt)
    size = np.sqrt(divisor(X.diagonal()))
    values = np.linalg.eigvalsh(X / size / size[:, None])
    return bool(values.min(initial=1.0) > ROUNDING * values.max(initial=1.0))


def _mirroring(S: FloatArray, see: FloatArray, level: float, dt: float) -> FloatArray:
    """Return the least gain that mirrors the poles of S at a circle or a vertical line."""
    # the stationary filter of S with its poles moved by the level, for no process noise
    size = np.abs(see).max(initial=TINY)
    see = see / size
    M = np.linalg.solve(_gramian(S, see, level, dt), see.T)
    gain = S @ M @ np.linalg.inv(see @ M + np.eye(len(see))) if dt else M
    return np.asarray(gain / size)
