"""Filters for what the noise model does not hold: what they are, and their error on any plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..certificates import Certificate
from ..errors import counted
from ..lti.statespace import StateSpace, System
from ..plant import StandardPlant
from ..values import FloatArray, Value, sizes_of
from .error import error_variances
from .estimator_channels import poi_channels, row_of, same_pois, sensors


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
class RobustFilter(Value):
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

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.estimation.design_hinf_filter(fx.testbeds.three_masses())
    >>> found.sensors, found.rms("die") >= fx.design_kalman(fx.testbeds.three_masses()).rms("die")
    (('y1', 'y2'), True)
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
            f"{counted(len(sensors(self.plant)), 'sensor')};\n"
            f"  rms error on its own plant {rms};\n  {self.certificate!r}>"
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors, in the order of the columns of the gains."""
        return sensors(self.plant)

    def rms(self, channel: str, *, on: StandardPlant | System | None = None) -> float:
        """Return the rms of the estimation error at the sample instants, u at rest.

        Parameters
        ----------
        channel : str
            A POI's motion: `die`, `die:z`, `die:hat` or `die:error`.
        on : StandardPlant, optional
            A sampled plant that the filter runs on; None: that of its design.

        Returns
        -------
        float [m or rad]

        Raises
        ------
        LabelError
            When it is no motion of a POI, or the other plant lacks a channel.
        ModelError
            When the other plant is not sampled alike, or its noise is not known.
        AssumptionError
            When the error would contain a rigid-body motion of the other plant.
        """
        row = row_of(poi_channels(self.plant), channel)
        variances = self.variances
        if on is not None:
            variances = error_variances(same_pois(self.plant, on), self.system).values
        return float(np.sqrt(max(variances[row], 0.0)))
