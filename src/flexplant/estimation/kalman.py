"""design_kalman: the discrete steady-state filter of the points of interest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..errors import AssumptionError, CertificateError, ModelError
from ..lti.lyapunov import solve_stein
from ..lti.riccati import RiccatiSolution, solve_dare
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray, Value

#: the predicted error and the one from an independent Stein equation agree to this part
AGREEMENT = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class KalmanEstimator(Value):
    """A stationary Kalman filter: y and the applied u to the estimates of the POIs.

    ::

        x[k|k]   = x[k|k-1] + L (y[k] - C2 x[k|k-1] - D22 u[k]),   hat[k] = C_poi x[k|k]
        x[k+1|k] = A x[k|k-1] + B2 u[k] + K (y[k] - C2 x[k|k-1] - D22 u[k])

    Parameters
    ----------
    system : StateSpace
        From the sensors and actuators to `die:hat`, `die:rx:hat`, ...
    plant : StandardPlant
        The sampled plant it was designed on.
    gain : (n, ny) array
        L, of the measurement update.
    covariance : (n, n) array
        Of x - x[k|k], predicted.
    solution : RiccatiSolution
        Of the filter's Riccati equation, for the physical states.
    certificate : mapping {str: float}
        Residual, spectral radius, and how far the prediction is from the error of this gain by an
        independent Stein equation.
    """

    system: StateSpace
    plant: StandardPlant
    gain: FloatArray
    covariance: FloatArray
    solution: RiccatiSolution
    certificate: Mapping[str, float]

    def __post_init__(self) -> None:
        self._set(gain=self.gain, covariance=self.covariance, certificate=self.certificate)

    def __repr__(self) -> str:
        head = f"<KalmanEstimator: {self.system.n_states} states, {1 / self.plant.dt:g} Hz>"
        rms = [f"{name} {self.rms(name):.3g} rms" for name in _estimated(self.plant)]
        return "\n".join([head, f"  predicted error: {', '.join(rms)}"])

    def rms(self, channel: str) -> float:
        """Return the predicted rms error of an estimate at the sampling instants.

        Parameters
        ----------
        channel : str
            `die:z`, `die:rx`, ..., or `die` or `die:hat` for the POI's first axis.

        Raises
        ------
        LabelError
            When there is no such POI channel.
        """
        row = _row(self.plant, channel)
        return float(np.sqrt(row @ self.covariance @ row))

    def to_filterpy(self) -> Any:
        """Return a `filterpy.kalman.KalmanFilter` with this model, at its stationary covariance."""
        from filterpy.kalman import KalmanFilter

        noise = _noise(self.plant)
        rows = self.plant.system.output_index(_sensors(self.plant))
        n = self.plant.system.n_states
        kalman = KalmanFilter(dim_x=n, dim_z=rows.size, dim_u=len(self.plant.u))
        kalman.F, kalman.B = self.plant.system.A.copy(), self.plant.B2.copy()
        kalman.H, kalman.R = self.plant.system.C[rows].copy(), noise.R
        kalman.Q, kalman.P = noise.Q, self.covariance.copy()
        return kalman


def design_kalman(plant: StandardPlant) -> KalmanEstimator:
    """Return the stationary Kalman filter of a sampled plant's POIs.

    The process noise is the exact covariance of the plant's white disturbances over a sample; the
    sensors have the variance asd^2 rate / 2. Its Riccati equation is solved by doubling, with
    states and outputs scaled inside, and the answer is checked by a Stein equation.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, with noisy disturbances and sensors.

    Returns
    -------
    KalmanEstimator
        Its `system` takes the sensors and the applied u and gives `die:hat`, ...

    Raises
    ------
    AssumptionError
        When the plant is continuous or weighted, a sensor has no noise, a white disturbance
        reaches a sensor directly, or a rigid-body mode is not excited by w or not seen by y.
    SolverError
        When the Riccati equation has no stabilising solution.
    CertificateError
        When the prediction fails its check.
    """
    _require(plant)
    noise = _noise(plant)
    sensors = _sensors(plant)
    system = plant.system
    C, D22 = system.C[system.output_index(sensors)], _feedthrough(plant, sensors)
    # delay lines hold commands that are known: the filter's covariance is that of the rest
    n = system.n_states
    physical = slice(0, plant.continuous.system.n_states if plant.continuous is not None else n)
    A, Cp = system.A[physical, physical], C[:, physical]
    Q, S = noise.Q[physical, physical], noise.S[physical]
    solution = solve_dare(A, Cp, Q=Q, R=noise.R, S=S)
    innovation = Cp @ solution.P @ Cp.T + noise.R
    L, K = np.zeros((n, len(sensors))), np.zeros((n, len(sensors)))
    L[physical] = np.linalg.solve(innovation, Cp @ solution.P).T
    K[physical] = solution.gain
    covariance = np.zeros((n, n))
    covariance[physical, physical] = _updated(solution.P, L[physical], Cp, noise.R)
    poi = system.C[system.output_index(_estimated(plant))]
    estimator = StateSpace(
        system.A - K @ C,
        np.hstack([K, plant.B2 - K @ D22]),
        poi - poi @ L @ C,
        np.hstack([poi @ L, -poi @ L @ D22]),
        plant.dt,
        inputs=[*sensors, *plant.u],
        outputs=_hats(plant),
        states=system.states,
        name="kalman",
    )
    spread = _by_stein(A, Cp, K[physical], L[physical], Q, noise.R, S)
    gap = _largest_gap(poi[:, physical], covariance[physical, physical], spread)
    if gap > AGREEMENT:
        raise CertificateError(
            f"the predicted POI error is off by {gap:.1e} from that of an independent Stein "
            f"equation (allowed {AGREEMENT:.0e}): the filter cannot be trusted. Check the noise "
            "densities for extreme ratios."
        )
    certificate = {
        "riccati residual": solution.residual,
        "spectral radius": solution.spectral_radius,
        "prediction gap": gap,
    }
    return KalmanEstimator(estimator, plant, L, covariance, solution, certificate)


class _Noise(NamedTuple):
    Q: FloatArray
    R: FloatArray
    S: FloatArray


def _noise(plant: StandardPlant) -> _Noise:
    """Return covariances per sample of x, of y, and across."""
    rows = plant.system.output_index(_sensors(plant)) - len(plant.z)
    if plant.noise_factor is not None:
        R = plant.sensor_noise[np.ix_(rows, rows)]
        return _Noise(plant.process_noise, R, np.zeros((plant.system.n_states, rows.size)))
    # a plant made elsewhere: its w are sample values of white noise
    variance = np.array([0.5 * plant.asd.get(name, 0.0) ** 2 / plant.dt for name in plant.w])
    B, D = plant.B1 * variance, plant.D21[rows]
    return _Noise(B @ plant.B1.T, (D * variance) @ D.T, B @ D.T)


def _require(plant: StandardPlant) -> None:
    if not plant.dt:
        raise AssumptionError(
            "a Kalman filter runs at a rate: pass plant.discretized(rate, delay=...)."
        )
    if plant.unweighted is not None:
        raise AssumptionError("a Kalman filter reads noise densities, not weights: pass plant.unweighted.")
    if not _hats(plant):
        raise AssumptionError("there is nothing to estimate: add a Poi to the ports.")
    if plant.ports is not None:
        silent = [sensor.name for sensor in plant.ports.y if not sensor.asd]
        if silent or not plant.ports.y:
            raise AssumptionError(
                f"sensors {silent} have no noise: a Kalman filter would trust them without limit. "
                "Give each Sensor an asd."
            )
        direct = plant.system.select(_sensors(plant), [d.name for d in plant.ports.w if d.asd])
        if np.any(direct.D):
            raise AssumptionError(
                "white disturbances reach an acceleration sensor directly: a sample of it would "
                "have infinite variance. Shape the disturbance, or filter the sensor."
            )
    plant.check().require(("excited", "detectable"), "a stationary Kalman filter")


def _sensors(plant: StandardPlant) -> list[str]:
    if plant.ports is not None:
        return [sensor.name for sensor in plant.ports.y]
    return list(plant.y)


def _estimated(plant: StandardPlant) -> list[str]:
    if plant.ports is not None:
        return [poi.channel(axis) for poi in plant.ports.z for axis in poi.axes]
    return list(plant.z)


def _hats(plant: StandardPlant) -> list[str]:
    if plant.ports is not None:
        return [poi.derived(axis, "hat") for poi in plant.ports.z for axis in poi.axes]
    return [f"{name}:hat" for name in plant.z]


def _row(plant: StandardPlant, channel: str) -> FloatArray:
    name = plant.channel(channel)
    if name not in _estimated(plant):
        from ..errors import unknown_label

        raise unknown_label("estimated channel", channel, _estimated(plant))
    return np.asarray(plant.system.C[plant.system.output_index([name])[0]])


def _feedthrough(plant: StandardPlant, sensors: list[str]) -> FloatArray:
    return plant.system.select(sensors, plant.u).D


def _updated(P: FloatArray, L: FloatArray, C: FloatArray, R: FloatArray) -> FloatArray:
    """Return the covariance after the measurement, in Joseph's form (a sum of squares)."""
    rest = np.eye(P.shape[0]) - L @ C
    return np.asarray(rest @ P @ rest.T + L @ R @ L.T)


def _by_stein(
    A: FloatArray,
    C: FloatArray,
    K: FloatArray,
    L: FloatArray,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray,
) -> FloatArray:
    """Return the covariance of x - x[k|k] under given gains, without the Riccati equation."""
    cross = K @ S.T
    predicted = solve_stein(A - K @ C, Q + K @ R @ K.T - cross - cross.T)
    return _updated(predicted, L, C, R)


def _largest_gap(rows: FloatArray, first: FloatArray, second: FloatArray) -> float:
    a, b = (np.sqrt(np.einsum("ij,jk,ik->i", rows, X, rows)) for X in (first, second))
    if not np.all(np.isfinite(a) & np.isfinite(b)):
        raise ModelError("the predicted POI error is not a number: check the noise densities.")
    return float(np.max(np.abs(a - b) / np.where(b > 0, b, 1.0)))
