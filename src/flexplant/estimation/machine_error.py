"""The error of a filter with free gains on another machine: its variance and the gradient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import AssumptionError, SolverError
from ..lti.lyapunov import DOUBLINGS, scale_of, solve_stein
from ..plant import StandardPlant
from ..values import FloatArray
from .error import moving_parts
from .filter_model import FilterModel, filter_model

#: what a filter may miss of a rigid-body motion that it should follow without error
_MISSED = 1e-7
#: norm of a power of the filter, states of unit size, that adds nothing any more
_VANISHED = 1e-17


class Gains(NamedTuple):
    """K (n, ny) and L_z (nz, ny), or the derivatives of a number to them."""

    K: FloatArray
    L_z: FloatArray


class FilterPart(NamedTuple):
    """What the errors on all machines share: the filter with some gains, states of unit size."""

    K: FloatArray
    L: FloatArray
    powers: list[FloatArray]
    C0: FloatArray
    E: FloatArray
    sight: FloatArray


@np.errstate(over="ignore", invalid="ignore")
def filter_part(m: FilterModel, gains: Gains, scale: FloatArray, unit: FloatArray) -> FilterPart:
    """Return the part of the errors that does not depend on the machine."""
    K, L, C0 = gains.K / scale[:, None], gains.L_z / unit, m.C2 * scale
    power = m.A * scale / scale[:, None] - K @ C0
    powers, E = [power], m.C1 * scale / unit - L @ C0
    while not (size := np.linalg.norm(power)) < _VANISHED:
        if len(powers) > DOUBLINGS or not np.isfinite(size):
            raise SolverError("the filter is not stable: its error has no variance.")
        power = power @ power
        powers.append(power)
    return FilterPart(K, L, powers, C0, E, _summed(powers, powers, E.T @ E, turned=True))


class MachineError(NamedTuple):
    """Error of ``x_o+ = A0 x_o + K (y - C0 x_o)``, ``hat = C1 x_o + L_z (y - C0 x_o)``.

    On a machine ``x+ = A x + G xi``, ``y = C x + v``, ``z = C1e x``, without the rigid-body motion
    x_r that both share: x and x_o are what is left beside V_e x_r and V_o x_r. All in states of
    unit size.
    """

    powers: list[FloatArray]
    C: FloatArray
    C1e: FloatArray
    G: FloatArray
    X: FloatArray
    back: FloatArray
    driven: FloatArray
    root: FloatArray

    def value(self, part: FilterPart) -> float:
        """Return the mean relative variance."""
        return self.value_and_slopes(part)[0]

    def value_and_slopes(self, part: FilterPart) -> tuple[float, Gains]:
        """Return the mean relative variance and its derivatives to K and L of the part.

        ``J = tr(E X E')``, X = F X F' + N N', Y = F' Y F + E' E: dJ/dF = 2 Y F X,
        dJ/dN = 2 Y N, dJ/dE = 2 E X with ``F = [A, 0; B, A_o]``, B = K C - back; of Y the rows of
        the filter are enough.
        """
        A, A_o, Y = self.powers[0], part.powers[0], part.sight
        powers = self._until(len(part.powers))
        B, own = part.K @ self.C - self.back, self.root.shape[1] - self.G.shape[1]
        N = part.K @ self.root
        N[:, own:] -= self.driven
        E = self.C1e - part.L @ self.C
        entering = B @ self.X
        X_oe = _summed(part.powers, powers, entering @ A.T + N[:, own:] @ self.G.T)
        half = A_o @ X_oe @ B.T
        X_oo = _summed(part.powers, part.powers, entering @ B.T + half + half.T + N @ N.T)
        Y_oe = _summed(part.powers, powers, A_o.T @ Y @ B - part.E.T @ E, turned=True)
        direct = part.L @ self.root
        to_e, to_o = E @ self.X - part.E @ X_oe, E @ X_oe.T - part.E @ X_oo
        value = float(np.sum(to_e * E) - np.sum(to_o * part.E) + np.sum(direct**2))
        left, right = Y_oe @ A + Y @ B, Y @ A_o
        to_Fe, to_Fo = left @ self.X + right @ X_oe, left @ X_oe.T + right @ X_oo
        to_N = Y @ N
        to_N[:, own:] += Y_oe @ self.G
        K = to_Fe @ self.C.T - to_Fo @ part.C0.T + to_N @ self.root.T
        L = -to_e @ self.C.T + to_o @ part.C0.T + direct @ self.root.T
        return value, Gains(2 * K, 2 * L)

    def _until(self, count: int) -> list[FloatArray]:
        while len(self.powers) < count:
            self.powers.append(self.powers[-1] @ self.powers[-1])
        return self.powers


def _summed(
    left: list[FloatArray], right: list[FloatArray], first: FloatArray, *, turned: bool = False
) -> FloatArray:
    """Return the sum of ``A^j first B'^j`` (``A'^j first B^j`` when turned) by doubling."""
    X = first
    for P, Q in zip(left, right, strict=False):
        X = X + (P.T @ X @ Q if turned else P @ X @ Q.T)
    return X


def machine_error(
    plant: StandardPlant,
    model: FilterModel,
    machine: StandardPlant,
    start: Gains,
    scale: FloatArray,
    unit: FloatArray,
) -> MachineError:
    """Return the error of filters on a plant's matrices when they run on a machine.

    Undamped motions x_r of the machine have no variance. A filter that holds them follows with
    V_o x_r whatever its gains are: ``A0 V_o = V_o A_rr``, ``C0 V_o = C_r``, ``C1 V_o = C1_r``.
    """
    m, own = model, filter_model(machine)
    G_all = machine.noise_factor
    rigid, rest = moving_parts(machine)
    rr, re, er = (own.A[np.ix_(*pair)] for pair in ((rigid, rigid), (rigid, rest), (rest, rigid)))
    A, C, C1e, G = own.A[np.ix_(rest, rest)], own.C2[:, rest], own.C1[:, rest], G_all[rest]
    C_r, C1_r = own.C2[:, rigid], own.C1[:, rigid]
    back, driven = np.zeros((m.A.shape[0], rest.size)), np.zeros((m.A.shape[0], G.shape[1]))
    if rigid.size:
        if np.any(er):  # filters of sensors follow the motion too
            V_e = la.solve_sylvester(A, -rr, -er)
            C_r, C1_r, G, A = C_r + C @ V_e, C1_r + C1e @ V_e, G - V_e @ G_all[rigid], A - V_e @ re
        V = la.solve_sylvester(m.A - start.K @ m.C2, -rr, -start.K @ C_r)
        missed = [(m.C2 @ V - C_r) / _size(C_r), (m.C1 @ V - C1_r) / _size(C1_r)]
        if max(float(np.max(np.abs(part))) for part in missed) > _MISSED:
            raise AssumptionError(
                "a rigid-body motion (or undamped mode) of a machine is not one of the plant: a "
                "filter with other gains would lose it, so that no worst error is finite. "
                f"The plant is {plant!r}; assemble both with the same ports, sampled alike."
            )
        back, driven = V @ re, V @ G_all[rigid]
    rows = [machine.y.index(name) for name in own.sensors]
    at_once = machine.noise_direct[rows]
    alone = machine.sensor_noise_factor[rows]
    X = solve_stein(A, G @ G.T)
    d = scale_of(X.diagonal())
    return MachineError(
        [A * d / d[:, None]],
        C * d,
        C1e * d / unit,
        G / d[:, None],
        X / d / d[:, None],
        back * d / scale[:, None],
        driven / scale[:, None],
        np.hstack([alone, at_once]),
    )


def _size(rows: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))
