"""The stationary Kalman filter of the POI: a point that no sensor sees, from those elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import AssumptionError, CertificateError, ModelError, ShapeError, SolverError
from ..lti.lyapunov import solve_stein
from ..lti.riccati import solve_dare
from ..lti.statespace import StateSpace, System
from ..plant import StandardPlant
from ..plant.door import TYPE_THIS
from ..values import FloatArray, Value, real_array
from .channels import checked_plant, estimates, poi_channels, row_of, sensors

#: the covariance of the Riccati equation and that of the gain's own Stein equation agree to this
AGREEMENT = 1e-6


@dataclass(frozen=True, eq=False)
class KalmanCertificate(Value):
    """What was checked about a Kalman filter after it was computed.

    Parameters
    ----------
    spectral_radius : float
        Of the estimation error, below 1.
    residual : float
        Of the Riccati equation, relative, in states of unit variance.
    difference : float
        Largest relative difference between the predicted POI variances and those of the gain by a
        Stein equation of its own: at most 1e-6.
    """

    spectral_radius: float
    residual: float
    difference: float


@dataclass(frozen=True, eq=False, repr=False)
class KalmanEstimator(Value):
    """A stationary Kalman filter of the motions at the POIs.

    ::

        x[k|k] = x[k|k-1] + L (y[k] - C2 x[k|k-1] - D22 u[k]),  hat[k] = C1 x[k|k]
        x[k+1|k] = A x[k|k] + B2 u[k]

    Parameters
    ----------
    system : StateSpace
        From the sensors and the applied u to the estimates `die:hat`, `die:rx:hat`, ...; states
        x[k|k-1].
    plant : StandardPlant
        What it was designed on.
    gain : (n, ny) array
        L, per sensor.
    covariance : (n, n) array
        Of the error of x[k|k], after the measurement.
    certificate : KalmanCertificate
        What was checked.
    """

    system: StateSpace
    plant: StandardPlant
    gain: FloatArray
    covariance: FloatArray
    certificate: KalmanCertificate

    def __post_init__(self) -> None:
        self._set(gain=self.gain, covariance=self.covariance)

    def __repr__(self) -> str:
        channels = poi_channels(self.plant)
        rms = ", ".join(f"{name} {self.rms(name):.3g}" for name in channels[:4])
        return (
            f"<KalmanEstimator: {self.system.n_states} states, {len(sensors(self.plant))} sensors, "
            f"spectral radius {self.certificate.spectral_radius:.6f}; rms error {rms}>"
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors, in the order of the columns of `gain`."""
        return sensors(self.plant)

    def rms(self, channel: str) -> float:
        """Return the predicted rms of the estimation error at the sample instants.

        Parameters
        ----------
        channel : str
            A POI's motion under any of its names: `die`, `die:z`, `die:hat`, `die:error`.

        Returns
        -------
        float [m or rad]
            Square root of ``C1 P C1'``, P the covariance after the measurement.

        Raises
        ------
        LabelError
            When it is no motion of a POI.
        """
        channels = poi_channels(self.plant)
        row = self.plant.system.C[self.plant.system.output_index(channels)]
        row = row[row_of(channels, channel)]
        return float(np.sqrt(max(row @ self.covariance @ row, 0.0)))

    def to_filterpy(self) -> Any:
        """Return a `filterpy.kalman.KalmanFilter` of the same model, in its stationary state.

        Call `update(y)` and then `predict(u)`; y without references, u all actuators, as 1-D
        arrays or as columns.
        """
        from .filterpy_twin import twin_class

        g, noise = _model(self.plant), _noises(self.plant)
        if np.any(g.D):
            raise ModelError(
                "filterpy's filter has no feedthrough from u to y, this plant has one. Sample it "
                "with a delay: plant.continuous.discretized(rate, delay=1)."
            )
        n, m = g.B.shape
        twin = twin_class()(dim_x=n, dim_z=g.C.shape[0], dim_u=m)
        twin.F, twin.B, twin.H = g.A.copy(), g.B.copy(), g.C.copy()
        twin.Q, twin.R = noise.process.copy(), noise.sensors.copy()
        twin.P = g.A @ self.covariance @ g.A.T + noise.process
        twin.x = np.zeros((n, 1))
        return twin


def design_kalman(plant: StandardPlant | System) -> KalmanEstimator:
    """Return the stationary Kalman filter of the POIs on a sampled plant.

    The noise model is that of `simulate`: `plant.process_noise` per sample into x and
    `plant.sensor_noise` on a sample of y. The filter reads the sensors (not the references) and the
    applied u; delays of u are known exactly. The Riccati equation is solved scaled inside, in any
    units (`flexplant.lti.solve_dare`).

    Parameters
    ----------
    plant : StandardPlant
        Sampled: `assemble_plant(model, ports).discretized(rate, delay=1)`. A system with labels
        lacks noise densities: it is told how to give them.

    Returns
    -------
    KalmanEstimator
        With a certificate: the gain's own error by a Stein equation agrees with the prediction.

    Raises
    ------
    AssumptionError
        When the plant is continuous, a sensor has no noise, a disturbance reaches a sensor
        directly, w does not excite a rigid-body mode or y does not see it.
    ModelError
        When the plant is weighted or its noise is not known.
    LabelError
        When the labels of a system do not tell w, u, z and y.
    SolverError
        When no strictly stable filter exists for another reason.
    CertificateError
        When the check by the other route fails.

    References
    ----------
    Anderson, Moore, Optimal Filtering, 1979, ch. 4.
    """
    plant = checked_plant(plant)
    if not plant.dt:
        raise AssumptionError(
            "the plant is continuous, this filter runs at samples: use "
            "plant.discretized(rate, delay=1)."
        )
    if plant.noise_factor is None:
        raise ModelError(
            "labels carry no noise density: a Kalman filter needs the process noise of each sample "
            "and the sensors' asd. Use assemble_plant(model, ports).discretized(rate), or type "
            f"{TYPE_THIS}.replace(noise_factor=G), G G' the covariance that w adds to x in one "
            "sample."
        )
    _check_noises(plant)
    plant.check().require(("excited", "detectable"), "a stationary Kalman filter")
    g, noise = _model(plant), _noises(plant)
    solution = solve_dare(g.A, g.C, Q=noise.process, R=noise.sensors)
    innovation = g.C @ solution.P @ g.C.T + noise.sensors
    scale = np.sqrt(innovation.diagonal())
    unit = innovation / scale / scale[:, None]
    gain = np.linalg.solve(unit, g.C @ solution.P / scale[:, None]).T / scale
    covariance = _updated(solution.P, gain, g.C, noise.sensors)
    radius, difference = _error_of(plant, gain, covariance)
    certificate = KalmanCertificate(radius, solution.residual, difference)
    return KalmanEstimator(_observer(plant, gain), plant, gain, covariance, certificate)


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
    """
    n, p = plant.system.n_states, len(sensors(plant))
    gain = real_array(gain, "gain", (n, p))
    return _error_of(plant, gain, real_array(covariance, "covariance", (n, n)))[1]


def _error_of(
    plant: StandardPlant, gain: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """Return spectral radius and difference, refusing bad ones."""
    g, noise = _model(plant), _noises(plant)
    moved = g.A @ gain
    closed = g.A - moved @ g.C
    radius = float(np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0))
    if radius >= 1:
        raise CertificateError(
            f"the estimation error is not stable: spectral radius {radius:.9f}. The gain is not "
            "that of a Kalman filter of this plant."
        )
    try:
        P = solve_stein(closed, moved @ noise.sensors @ moved.T + noise.process)
    except SolverError as error:
        raise CertificateError(f"the estimation error could not be checked: {error}") from error
    found = _updated(P, gain, g.C, noise.sensors)
    C1 = plant.system.C[plant.system.output_index(poi_channels(plant))]
    truth = np.einsum("ij,jk,ik->i", C1, found, C1)
    claim = np.einsum("ij,jk,ik->i", C1, covariance, C1)
    size = np.where(truth > 0, truth, 1.0)
    difference = float(np.max(np.abs(claim - truth) / size))
    if not difference <= AGREEMENT:
        raise CertificateError(
            f"the gain gives POI variances that differ from the predicted ones by {difference:.1e} "
            f"(allowed {AGREEMENT:.0e}). The prediction cannot be trusted."
        )
    return radius, difference


def _updated(P: FloatArray, gain: FloatArray, C: FloatArray, R: FloatArray) -> FloatArray:
    """Return the covariance after the measurement, in Joseph's form: right for any gain."""
    left = np.eye(P.shape[0]) - gain @ C
    updated = left @ P @ left.T + gain @ R @ gain.T
    return np.asarray(0.5 * (updated + updated.T))


def _observer(plant: StandardPlant, gain: FloatArray) -> StateSpace:
    g, inner = _model(plant), plant.system
    channels = poi_channels(plant)
    rows = inner.output_index(channels)
    C1, D12 = inner.C[rows], inner.D[np.ix_(rows, inner.input_index(plant.u))]
    corrected = np.eye(inner.n_states) - gain @ g.C
    through = -gain @ g.D  # from u to x[k|k]
    return StateSpace(
        g.A @ corrected,
        np.hstack([g.A @ gain, g.B + g.A @ through]),
        C1 @ corrected,
        np.hstack([C1 @ gain, D12 + C1 @ through]),
        plant.dt,
        inputs=[*sensors(plant), *plant.u],
        outputs=estimates(channels),
        states=inner.states,
        name="kalman",
    )


def _model(plant: StandardPlant) -> StateSpace:
    """Return u -> sensors."""
    return plant.system.select(sensors(plant), plant.u)


@dataclass(frozen=True, eq=False)
class _Noises(Value):
    process: FloatArray
    sensors: FloatArray


def _noises(plant: StandardPlant) -> _Noises:
    rows = [plant.y.index(name) for name in sensors(plant)]
    return _Noises(plant.process_noise, plant.sensor_noise[np.ix_(rows, rows)])


def _check_noises(plant: StandardPlant) -> None:
    names, noise = sensors(plant), _noises(plant)
    n = plant.system.n_states
    if noise.process.shape != (n, n):
        raise ShapeError(f"process_noise must be ({n}, {n}), got {noise.process.shape}.")
    silent = [name for name, v in zip(names, noise.sensors.diagonal(), strict=True) if v <= 0]
    if silent:
        raise AssumptionError(
            f"sensors {', '.join(silent)} have no noise (asd 0): the filter would trust them "
            "without limit and differentiate them. Give Sensor(..., asd=) what the data sheet "
            "says, in m/sqrt(Hz)."
        )
    inner = plant.system
    loud = [name for name in plant.w if plant.asd.get(name, 0.0) > 0 and ":noise" not in name]
    direct = inner.D[np.ix_(inner.output_index(names), inner.input_index(loud))]
    if np.any(direct):
        row, column = (int(i) for i in np.argwhere(direct)[0])
        raise AssumptionError(
            f"white noise of {loud[column]!r} reaches {names[row]!r} at once (an acceleration "
            "sensor, say), so a sample of it would have infinite variance. Measure displacement or "
            "velocity, or shape the disturbance."
        )
