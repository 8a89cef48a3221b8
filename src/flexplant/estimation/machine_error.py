"""The error of a filter with free gains on another machine: its variance and the gradient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import AssumptionError
from ..lti.lyapunov import accumulated, doubled, scale_of
from ..plant import StandardPlant
from ..values import FloatArray
from .error import moving_parts
from .filter_model import FilterModel, filter_model

#: what a filter may miss of a rigid-body motion that it should follow without error
_MISSED = 1e-7


class Gains(NamedTuple):
    """K (n, ny) and L_z (nz, ny), or the derivatives of a number to them."""

    K: FloatArray
    L_z: FloatArray


class MachineError(NamedTuple):
    """Error of ``x_o+ = A0 x_o + K (y - C0 x_o)``, ``hat = C1 x_o + L_z (y - C0 x_o)``.

    On a machine ``x+ = A x + G xi``, ``y = C x + v``, ``z = C1e x``, without the rigid-body motion
    x_r that both share: x and x_o are what is left beside V_e x_r and V_o x_r.

    Parameters
    ----------
    A, C, C1e, G : arrays
        Of the machine's states that decay.
    A0, C0, C1 : arrays
        Of the filter.
    back, driven : arrays
        ``V_o A_re`` and ``V_o G_r``: what moves the filter's part of the rigid-body motion.
    root : (ny, ny + r) array
        Of the sensor noise: what each sensor has alone, then what disturbances add at once.
    sizes : (nz,) array
        Of the POI motions; their variances count relative to ``sizes^2``, their mean is the value.
    scale : (n + n_o,) array
        Of the states of machine and filter, powers of two.
    """

    A: FloatArray
    C: FloatArray
    C1e: FloatArray
    G: FloatArray
    A0: FloatArray
    C0: FloatArray
    C1: FloatArray
    back: FloatArray
    driven: FloatArray
    root: FloatArray
    sizes: FloatArray
    scale: FloatArray

    def value(self, gains: Gains) -> float:
        """Return the mean relative variance.

        Raises
        ------
        SolverError
            When the filter is not stable.
        """
        F, N, E, direct = self._joint(gains)
        X = doubled(F, N @ N.T)
        return float(np.sum((E @ X) * E) + np.sum(direct**2))

    def value_and_gradient(self, gains: Gains) -> tuple[float, Gains]:
        """Return the mean relative variance and its derivatives to both gains.

        ``J = tr(E X E')``, X = F X F' + N N', Y = F' Y F + E' E: dJ/dF = 2 Y F X,
        dJ/dN = 2 Y N, dJ/dE = 2 E X.

        Raises
        ------
        SolverError
            When the filter is not stable.
        """
        F, N, E, direct = self._joint(gains)
        X, Y = doubled(F, N @ N.T), doubled(F.T, E.T @ E)
        n, d = self.A.shape[0], self.scale
        unit = np.sqrt(self.sizes.size) * self.sizes[:, None]
        to_F, to_N, to_E = 2 * (Y[n:] @ F) @ X, 2 * Y[n:] @ N, 2 * E @ X
        own, other = self.C * d[:n], self.C0 * d[n:]
        K = to_F[:, :n] @ own.T - to_F[:, n:] @ other.T + to_N @ self.root.T
        L_z = -to_E[:, :n] @ own.T + to_E[:, n:] @ other.T + 2 * direct @ self.root.T
        value = float(np.sum((E @ X) * E) + np.sum(direct**2))
        return value, Gains(K / d[n:, None], L_z / unit)

    def sight(self, gains: Gains) -> tuple[FloatArray, FloatArray]:
        """Return the Gramian Y of the filter's states in the value, and their scale."""
        F, _, E, _ = self._joint(gains)
        n = self.A.shape[0]
        return doubled(F[n:, n:].T, E[:, n:].T @ E[:, n:]), self.scale[n:]

    def _joint(self, gains: Gains) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return F, N, E in scaled states, and the part of the noise that enters the estimate."""
        K, L_z, d, n = gains.K, gains.L_z, self.scale, self.A.shape[0]
        F = np.block(
            [
                [self.A, np.zeros((n, self.A0.shape[0]))],
                [K @ self.C - self.back, self.A0 - K @ self.C0],
            ]
        )
        ny, r = len(self.root), self.G.shape[1]
        N = np.zeros((F.shape[0], ny + r))
        N[:n, ny:], N[n:, ny:] = self.G, -self.driven
        N[n:] += K @ self.root
        E = np.hstack([self.C1e - L_z @ self.C, -(self.C1 - L_z @ self.C0)])
        unit = np.sqrt(self.sizes.size) * self.sizes[:, None]
        return F * d / d[:, None], N / d[:, None], E * d / unit, L_z @ self.root / unit


def machine_error(
    plant: StandardPlant,
    model: FilterModel,
    machine: StandardPlant,
    start: Gains,
    sizes: FloatArray,
) -> MachineError:
    """Return the error of filters on a plant's matrices when they run on a machine.

    Undamped motions x_r of the machine have no variance. A filter that holds them follows with
    V_o x_r whatever its gains are: ``A0 V_o = V_o A_rr``, ``C0 V_o = C_r``, ``C1 V_o = C1_r``.

    Parameters
    ----------
    plant : StandardPlant
        Of the filter.
    model : FilterModel
        Its matrices.
    machine : StandardPlant
        Sampled alike.
    start : Gains
        A stable filter.
    sizes : (nz,) array
        Units of the POI motions.

    Raises
    ------
    AssumptionError
        When the filter does not hold a motion of the machine that does not decay.
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
                "filter with other gains would lose it, so no finite worst error can be promised. "
                f"The plant is {plant!r}; assemble both with the same ports, sampled alike."
            )
        back, driven = V @ re, V @ G_all[rigid]
    rows = [machine.y.index(name) for name in own.sensors]
    at_once = machine.noise_direct[rows]
    alone = np.sqrt(machine.sensor_noise[np.ix_(rows, rows)])
    first = MachineError(
        A, C, C1e, G, m.A, m.C2, m.C1, back, driven, np.hstack([alone, at_once]), sizes,
        np.ones(rest.size + m.A.shape[0]),
    )  # fmt: skip
    F, N, *_ = first._joint(start)
    even = scale_of(accumulated(F, N @ N.T))
    F, N = F * even / even[:, None], N / even[:, None]
    return first._replace(scale=even * scale_of(doubled(F, N @ N.T).diagonal()))


def _size(rows: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))
