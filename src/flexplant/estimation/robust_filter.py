"""Filters for what the noise model does not hold: what they are, and their error on any plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..certificates import Certificate
from ..checks import FloatArray, between, sizes_of
from ..errors import CertificateError, SolverError, counted
from ..lti.norms import hinf_norm
from ..lti.riccati import solve_dare
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant
from ..tolerances import TINY
from .error import PoiFilter
from .estimator_channels import poi_channels
from .filter_model import FilterModel, error_system, filter_system, own_variances, weigh
from .kalman import design_kalman


@dataclass(frozen=True, eq=False, repr=False)
class HinfFilterCertificate(Certificate):
    """What was checked about an H-infinity filter after it was computed.

    Parameters
    ----------
    gamma : float
        Largest gain of the error at any frequency, by the norm of the error's own system. Noises
        have unit density, each POI motion is in units of the Kalman filter's deviation: the
        one-sided density of its error stays below ``gamma (2 dt)^(1/2)`` times that deviation.
    lower : float
        A level at which the Riccati equation has no solution of the right inertia: no filter
        reaches it.
    kalman : float
        The same gain of the Kalman filter.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.estimation.design_hinf_filter(fx.testbeds.three_masses()).certificate
    >>> found.gamma <= 1.01 * found.kalman  # the Kalman filter's gain is no smaller
    True
    """

    gamma: float
    lower: float
    kalman: float


@dataclass(frozen=True, eq=False, repr=False)
class MinimaxCertificate(Certificate):
    """What was checked about a filter for several machines.

    Parameters
    ----------
    worst : float
        Largest mean over the POI motions of ``variance / sizes^2`` among the machines, by
        `error_variances`, which has nothing in common with the search.
    kalman : float
        The same of the Kalman filter of the nominal plant.
    lower : float
        No filter is better: the largest one among the machines, each with the Kalman filter of
        its own.
    difference : float
        Largest relative difference between the search's own values and `error_variances`.
    slope : float
        Norm of the gradient of the smoothed worst value at the end, relative to its value, in
        gains of unit size: 0 at a stationary point.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.estimation.design_minimax_filter(plant, [plant], iterations=20).certificate
    >>> found.worst <= 1.001 * found.kalman
    True
    """

    worst: float
    kalman: float
    lower: float
    difference: float
    slope: float


@dataclass(frozen=True, eq=False, repr=False)
class RobustFilter(PoiFilter):
    """A stationary filter of the motions at the POIs with two gains.

    ::

        e[k]   = y[k] - C2 x[k] - D22 u[k]
        hat[k] = C1 x[k] + D12 u[k] + L_z e[k]
        x[k+1] = A x[k] + B2 u[k] + K e[k]

    Parameters
    ----------
    system : StateSpace
        From the sensors and the applied u to the estimates `die:hat`, ...
    plant : StandardPlant
        Whose matrices it holds.
    gain : (n, ny) array
        K.
    poi_gain : (nz, ny) array
        L_z.
    sizes : (nz,) array [m or rad]
        Deviation of each POI motion's error with the Kalman filter of the plant: the unit in which
        motions of different kinds are compared.
    variances : (nz,) array [m^2 or rad^2]
        Of its errors on its own plant.
    certificate : HinfFilterCertificate or MinimaxCertificate
        What was checked.
    """

    system: StateSpace
    plant: StandardPlant
    gain: FloatArray
    poi_gain: FloatArray
    sizes: FloatArray
    variances: FloatArray
    certificate: HinfFilterCertificate | MinimaxCertificate

    def __repr__(self) -> str:
        rms = sizes_of({n: self.rms(n) for n in poi_channels(self.plant)}, self.plant.units)
        return (
            f"<RobustFilter: {counted(self.system.n_states, 'state')}, "
            f"{counted(len(self.sensors), 'sensor')};\n"
            f"  rms error on its own plant {rms};\n  {self.certificate!r}>"
        )


#: the gain of the error's own system may exceed the level of the Riccati equation by this part
_AGREEMENT = 1e-6


@one_thread()
def design_hinf_filter(plant: StandardPlant | System, *, accuracy: float = 1e-3) -> RobustFilter:
    """Return the filter with the smallest largest gain from the noises to the POI errors.

    The Kalman filter is best for noise that is white with the stated densities; what it pays for
    that is a high peak at a few frequencies, where noise of another spectrum does harm. This
    filter bounds the error of any noise of finite energy::

        sum |z - hat|^2 < gamma^2 (sum |xi|^2 + sum v' R^-1 v)

    with x+ = A x + G xi, y = C2 x + v, and z in units of the Kalman filter's deviations. With the
    stabilising solution of the filter's Riccati equation with an indefinite weight::

        P = A P A' + G G' - A P [C2' C1'] ([C2; C1] P [C2' C1'] + diag(R, -gamma^2 I))^-1 (...)'

    one exists when ``C1 (P - P C2' (C2 P C2' + R)^-1 C2 P) C1' < gamma^2 I``, P >= 0; it is then
    the Kalman filter with this P. The level is found by bisection.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, not weighted, its noises as for `design_kalman`.
    accuracy : float
        The level is at most this part above one that cannot be reached; 1e-6 to 1.

    Returns
    -------
    RobustFilter
        Its certificate holds the gain of the error's system, computed apart.

    Raises
    ------
    AssumptionError, ModelError, LabelError
        As `design_kalman`, whose assumptions are the same.
    SolverError
        When no Kalman filter exists.
    CertificateError
        When the gain of the error's system exceeds the level.

    References
    ----------
    [Hassibi1999]_, ch. 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.estimation.design_hinf_filter(fx.testbeds.three_masses())
    >>> found.certificate.gamma >= found.certificate.lower
    True
    """
    why = "Closer to the optimum the Riccati equation has no digits left. Pass 1e-3, say."
    accuracy = between(accuracy, "accuracy", 1e-6, 1.0, why, ends="[]")
    kalman = design_kalman(plant, larger=plant)  # type: ignore[arg-type]
    plant = kalman.plant
    sizes = np.sqrt(kalman.variances)
    model = kalman.model
    scaled = model.replace(C1=model.C1 / sizes[:, None])
    own = kalman.predictor_gain, scaled.C1 @ kalman.gain
    peak = hinf_norm(error_system(scaled, *own))
    # the mean over frequencies of the density of a motion is at least 1, so is the largest gain
    lower, upper, best = 1.0, peak * (1 + accuracy), None
    while best is None or upper > lower * (1 + accuracy):
        level = upper if best is None else float(np.sqrt(lower * upper))
        found = _central_gains(scaled, level)
        if found is not None:
            upper, best = level, found
        elif best is None:
            raise SolverError(
                f"the H-infinity filter was not found at the gain {level:.6g} of the Kalman "
                "filter, where one exists: the Riccati equation is too badly conditioned. Take "
                "modes that hardly matter out of the plant."
            )
        else:
            lower = level
    K, L_z = best
    gain = hinf_norm(error_system(scaled, K, L_z))
    if not gain <= upper * (1 + _AGREEMENT):
        raise CertificateError(
            f"the error of the H-infinity filter has the gain {gain:.9g}, more than the level "
            f"{upper:.9g} of its Riccati equation. The filter cannot be trusted; a larger "
            "accuracy keeps away from the optimum."
        )
    L_z = L_z * sizes[:, None]
    return RobustFilter(
        filter_system(plant, model, K, L_z, "hinf_filter"),
        plant,
        K,
        L_z,
        sizes,
        own_variances(model, K, L_z),
        HinfFilterCertificate(gain, lower, peak),
    )


class _HinfGains(NamedTuple):
    K: FloatArray
    L_z: FloatArray


def _central_gains(m: FilterModel, gamma: float) -> _HinfGains | None:
    """Return the gains of the central filter of a level, None when there is none."""
    rows, nz = np.vstack([m.C2, m.C1]), len(m.C1)
    weight = la.block_diag(m.R, -(gamma**2) * np.eye(nz))
    cross = np.hstack([m.S, np.zeros((len(m.A), nz))])
    try:
        P = solve_dare(m.A, rows, Q=m.Q, R=weight, S=cross).P
    except SolverError:
        return None
    unit = np.sqrt(np.maximum(np.abs(P.diagonal()), TINY))
    # rounding leaves 1e-12 of a unit diagonal; a solution of the wrong sign some 1
    if np.min(np.linalg.eigvalsh(P / unit / unit[:, None])) < -1e-9:
        return None
    innovation = m.innovation(P)
    gain, shift = (weigh(part, innovation) for part in (P @ m.C2.T, m.S))
    left = m.C1 @ (P - gain @ m.C2 @ P) @ m.C1.T
    if np.max(np.linalg.eigvalsh(0.5 * (left + left.T))) >= gamma**2:
        return None
    return _HinfGains(m.A @ gain + shift, m.C1 @ gain)
