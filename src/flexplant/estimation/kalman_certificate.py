"""The check of a Kalman gain: the covariance that follows from it, beside the claimed one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..certificates import Certificate
from ..checks import FloatArray, real_array
from ..errors import CertificateError, SolverError
from ..plant import StandardPlant
from ..tolerances import divisor
from .estimator_channels import sensors
from .filter_model import FilterModel, filter_model, own_variances

#: the covariance of the Riccati equation and that of the gain's own Stein equation agree to this
AGREEMENT = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class KalmanCertificate(Certificate):
    """What was checked about a Kalman filter after it was computed.

    Parameters
    ----------
    spectral_radius : float
        Of the estimation error, below 1.
    residual : float
        Of the Riccati equation, relative, in states of unit variance.
    difference : float
        Largest relative difference between two ways to the POI variances: on the filter's own
        model the Riccati equation and a Stein equation of the gain, at most 1e-6; on the plant with
        the modes left out the joint Stein equation and its dual, at most 1 %, with what rounding of
        hardly damped poles may change.
    left_out : int, optional
        How many modes left out are in the predicted error; None: none are known, truncation is not
        in the number.
    unresolved : float, optional
        Largest share of a predicted variance that is from modes left out with fewer than 4 nodes
        of the larger model's mesh per wavelength; None: its mesh is not known.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.design_kalman(fx.testbeds.three_masses()).certificate
    >>> round(found.spectral_radius, 4), found.difference < 1e-6
    (0.9601, True)
    """

    spectral_radius: float
    residual: float
    difference: float
    left_out: int | None = None
    unresolved: float | None = None


def check_gain(plant: StandardPlant, gain: FloatArray, covariance: FloatArray) -> float:
    """Return how far the POI variances of a gain are from those that a covariance claims.

    The error's covariance follows from the gain alone:
    ``P = F P F' + A L R L' A' + Q``, F = A (I - L C2), a Stein equation.

    Parameters
    ----------
    plant : StandardPlant
        Sampled.
    gain : (n, ny) array
        L.
    covariance : (n, n) array
        Claimed, after the measurement.

    Returns
    -------
    float
        Largest relative difference over the POI channels.

    Raises
    ------
    ShapeError
        When sizes do not match.
    CertificateError
        When the error is not stable or the difference exceeds 1e-6.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> fx.estimation.check_gain(plant, observer.gain, observer.covariance) < 1e-6
    True
    """
    n, p = plant.system.n_states, len(sensors(plant))
    gain = real_array(gain, "gain", (n, p))
    covariance = real_array(covariance, "covariance", (n, n))
    model = filter_model(plant)
    return error_of(model, gain, model.A @ gain, covariance)[1]


def error_of(
    model: FilterModel, gain: FloatArray, predictor: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """Return spectral radius and difference of a gain L and its predictor gain K, if both hold."""
    closed = model.A - predictor @ model.C2
    radius = float(np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0))
    if radius >= 1:
        raise CertificateError(
            f"the estimation error is not stable: spectral radius {radius:.9f}. The gain is not "
            "that of a Kalman filter of this plant."
        )
    try:
        truth = own_variances(model, predictor, model.C1 @ gain)
    except SolverError as error:
        raise CertificateError(f"the estimation error could not be checked: {error}") from error
    claim = np.einsum("ij,jk,ik->i", model.C1, covariance, model.C1)
    size = divisor(truth)
    difference = float(np.max(np.abs(claim - truth) / size))
    if not difference <= AGREEMENT:
        raise CertificateError(
            f"the gain gives POI variances that differ from the predicted ones by {difference:.1e} "
            f"(allowed {AGREEMENT:.0e}). The prediction cannot be trusted."
        )
    return radius, difference
