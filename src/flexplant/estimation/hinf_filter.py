"""The H-infinity filter: the smallest gain from noise to the error at the POIs, any spectrum."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..arguments import between
from ..errors import CertificateError, SolverError
from ..lti.norms import hinf_norm
from ..lti.riccati import solve_dare
from ..lti.statespace import System
from ..parallel import one_thread
from ..plant import StandardPlant
from ..values import FloatArray
from .filter_model import FilterModel, weighed
from .filter_system import error_system, filter_system, own_variances
from .kalman import design_kalman
from .robust_filter import HinfFilterCertificate, RobustFilter

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
        found = _at(scaled, level)
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


def _at(m: FilterModel, gamma: float) -> _HinfGains | None:
    """Return the gains of the central filter of a level, None when there is none."""
    rows, nz = np.vstack([m.C2, m.C1]), len(m.C1)
    weight = la.block_diag(m.R, -(gamma**2) * np.eye(nz))
    cross = np.hstack([m.S, np.zeros((len(m.A), nz))])
    try:
        P = solve_dare(m.A, rows, Q=m.Q, R=weight, S=cross).P
    except SolverError:
        return None
    unit = np.sqrt(np.maximum(np.abs(P.diagonal()), 1e-300))
    if np.min(np.linalg.eigvalsh(P / unit / unit[:, None])) < -1e-9:
        return None
    innovation = m.innovation(P)
    gain, shift = (weighed(part, innovation) for part in (P @ m.C2.T, m.S))
    left = m.C1 @ (P - gain @ m.C2 @ P) @ m.C1.T
    if np.max(np.linalg.eigvalsh(0.5 * (left + left.T))) >= gamma**2:
        return None
    return _HinfGains(m.A @ gain + shift, m.C1 @ gain)
