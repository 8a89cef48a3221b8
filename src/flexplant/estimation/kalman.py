"""The stationary Kalman filter of the POI: a point that no sensor sees, from those elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..errors import (
    AssumptionError,
    CertificateError,
    ModelError,
    ShapeError,
    SolverError,
)
from ..lti.lyapunov import solve_stein
from ..lti.riccati import solve_dare
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant, larger_plant
from ..plant.realisation import Structure
from ..values import FloatArray, Value, real_array
from .channels import checked_plant, estimates, poi_channels, row_of, same_pois, sensors
from .error import error_variances
from .left_out import LeftOut, left_out

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
        Largest relative difference between two ways to the POI variances, at most 1e-6: on the
        filter's own model the Riccati equation and a Stein equation of the gain; on the plant with
        the modes left out the joint Stein equation and its dual.
    left_out : int, optional
        How many modes left out are in the predicted error; None: none are known, truncation is not
        in the number.
    """

    spectral_radius: float
    residual: float
    difference: float
    left_out: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class KalmanEstimator(Value):
    """A stationary Kalman filter of the motions at the POIs.

    ::

        x[k|k] = x[k|k-1] + L (y[k] - C2 x[k|k-1] - D22 u[k])
        hat[k] = C1 x[k|k-1] + D12 u[k] + L_z (y[k] - C2 x[k|k-1] - D22 u[k])
        x[k+1|k] = A x[k|k] + B2 u[k]

    L_z is C1 L where no modes left out are known.

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
        Of the error of x[k|k], after the measurement, on the filter's own model.
    certificate : KalmanCertificate
        What was checked.
    variances : (nz,) array [m^2 or rad^2]
        Predicted, of the errors at the POIs: on the plant with the modes left out where these are
        known.
    left_out : LeftOut, optional
        The modes left out, as noise and static compliance.
    """

    system: StateSpace
    plant: StandardPlant
    gain: FloatArray
    covariance: FloatArray
    certificate: KalmanCertificate
    variances: FloatArray
    left_out: LeftOut | None = None

    def __post_init__(self) -> None:
        self._set(gain=self.gain, covariance=self.covariance, variances=self.variances)

    def __repr__(self) -> str:
        channels = poi_channels(self.plant)
        rms = ", ".join(f"{name} {self.rms(name):.3g}" for name in channels[:4])
        count = self.certificate.left_out
        counted = (
            "modes left out are not known: truncation is not in these numbers"
            if count is None
            else f"with {count} modes left out"
            if count
            else "as if no modes were left out"
        )
        return (
            f"<KalmanEstimator: {self.system.n_states} states, {len(sensors(self.plant))} sensors, "
            f"spectral radius {self.certificate.spectral_radius:.6f};\n"
            f"  rms error {rms} ({counted})>"
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors, in the order of the columns of `gain`."""
        return sensors(self.plant)

    def rms(self, channel: str, *, on: StandardPlant | System | None = None) -> float:
        """Return the rms of the estimation error at the sample instants.

        Parameters
        ----------
        channel : str
            A POI's motion under any of its names: `die`, `die:z`, `die:hat`, `die:error`.
        on : StandardPlant, optional
            A plant that the filter runs on, sampled, with other modes or noises; the error there is
            exact (`error_variances`), u at rest. None: the predicted error.

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

    def to_filterpy(self) -> Any:
        """Return a `filterpy.kalman.KalmanFilter` of the same model, in its stationary state.

        Call `update(y)` and then `predict(u)`; y without references, u all actuators, as 1-D
        arrays or as columns.
        """
        from .filterpy_twin import twin_class

        own = self.plant if self.left_out is None else self.left_out.plant
        g, noise = _model(own), _noises(own)
        if self.left_out is not None:
            noise = noise.replace(sensors=noise.sensors + self.left_out.sensors)
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


@one_thread()
def design_kalman(
    plant: StandardPlant | System, larger: StandardPlant | Structure | None = None
) -> KalmanEstimator:
    """Return the stationary Kalman filter of the POIs on a sampled plant.

    The noise model is that of `simulate`: `plant.process_noise` per sample into x and
    `plant.sensor_noise` on a sample of y. The filter reads the sensors (not the references) and the
    applied u; delays of u are known exactly. The Riccati equation is solved scaled inside, in any
    units (`flexplant.lti.solve_dare`).

    Modes left out of the plant add no states. Their motion under the disturbances is noise with
    covariances R_t at the sensors, V_t at the POIs and N_t between them (see `left_out`), and they
    follow u by their static compliance::

        S = C2 P C2' + R + R_t,   L = P C2' S^-1,   L_z = (C1 P C2' + N_t) S^-1

    with P of the Riccati equation of (A, C2, Q, R + R_t). The predicted error is that of this
    filter on the plant with the modes left out. It knows what `larger` knows, mesh errors of
    those modes included: on a plate of 0.6 m x 0.6 m a model of 8 x 8 elements predicts the error
    of z on finer ones within 6 %, that of rotations within 23 %; on one of 0.5 m x 0.3 m it
    predicts z 65 % too large, since other shapes mix in modes of almost one frequency above
    10 kHz. 12 x 12 elements are within 5 % for z there, beside 24 x 24. Refine the mesh of
    `larger` until the prediction stays. Without any delay of u the static compliance is left out:
    it would close an algebraic loop from y to u to y.

    Parameters
    ----------
    plant : StandardPlant
        Sampled: `assemble_plant(model, ports).discretized(rate, delay=1)`. A system with labels
        lacks noise densities: the error names what gives them.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        The structure with more modes, such as `solve_modes(fit.applied_to(model), count=100)`.
        None: the modes that the plant's reduced model knows beyond those it kept; where it knows
        none, truncation is not in the predicted error. The plant itself: no modes are left out.

    Returns
    -------
    KalmanEstimator
        With a certificate: the error by two routes.

    Raises
    ------
    AssumptionError
        When the plant is continuous, a sensor has no noise, a disturbance reaches a sensor
        directly, w does not excite a rigid-body mode or y does not see it.
    ModelError
        When the plant is weighted or its noise is not known, or the larger model is not larger.
    LabelError
        When the labels of a system do not tell w, u, z and y, or the larger plant has others.
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
    _check_noises(plant)
    plant.check().require(("excited", "detectable"), "a stationary Kalman filter")
    whole = None if larger is plant else larger_plant(plant, larger)
    found = None if whole is None else left_out(plant, whole)
    own = plant if found is None else found.plant
    design = _designed(own, found)
    system = _observer(own, design.gain, design.poi_gain)
    if whole is None or found is None:
        certificate = design.certificate
        if larger is not None:
            certificate = certificate.replace(left_out=0)
        return KalmanEstimator(
            system, plant, design.gain, design.covariance, certificate, design.variances
        )
    honest = error_variances(whole, system)
    if not honest.difference <= AGREEMENT:
        raise CertificateError(
            f"the error on the plant with the modes left out and its dual differ by "
            f"{honest.difference:.1e} (allowed {AGREEMENT:.0e}). The prediction cannot be trusted."
        )
    certificate = design.certificate.replace(
        difference=max(design.certificate.difference, honest.difference),
        left_out=int(found.modes.size),
    )
    return KalmanEstimator(
        system, plant, design.gain, design.covariance, certificate, honest.values, found
    )


class _Design(NamedTuple):
    gain: FloatArray
    poi_gain: FloatArray
    covariance: FloatArray
    variances: FloatArray
    certificate: KalmanCertificate


def _designed(plant: StandardPlant, found: LeftOut | None) -> _Design:
    """Return the gains of a plant whose sensors have noise of modes left out as well."""
    g, noise, C1 = _model(plant), _noises(plant), _poi_rows(plant)
    cross = np.zeros((C1.shape[0], g.C.shape[0]))
    if found is not None:
        noise = noise.replace(sensors=noise.sensors + found.sensors)
        cross = found.cross
    solution = solve_dare(g.A, g.C, Q=noise.process, R=noise.sensors)
    innovation = g.C @ solution.P @ g.C.T + noise.sensors
    scale = np.sqrt(innovation.diagonal())
    unit = innovation / scale / scale[:, None]

    def weighed(covariance: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(unit, covariance.T / scale[:, None]).T / scale)

    gain = weighed(solution.P @ g.C.T)
    poi_gain = weighed(C1 @ solution.P @ g.C.T + cross)
    covariance = _updated(solution.P, gain, g.C, noise.sensors)
    variances = np.einsum("ij,jk,ik->i", C1, covariance, C1)
    radius, difference = _error_of(g, C1, noise, gain, covariance)
    certificate = KalmanCertificate(radius, solution.residual, difference)
    return _Design(gain, poi_gain, covariance, variances, certificate)


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
    covariance = real_array(covariance, "covariance", (n, n))
    return _error_of(_model(plant), _poi_rows(plant), _noises(plant), gain, covariance)[1]


def _error_of(
    g: StateSpace, C1: FloatArray, noise: _Noises, gain: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """Return spectral radius and difference, refusing bad ones."""
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


def _observer(plant: StandardPlant, gain: FloatArray, poi_gain: FloatArray) -> StateSpace:
    g, inner = _model(plant), plant.system
    channels = poi_channels(plant)
    C1 = _poi_rows(plant)
    D12 = inner.D[np.ix_(inner.output_index(channels), inner.input_index(plant.u))]
    moved = g.A @ gain
    return StateSpace(
        g.A - moved @ g.C,
        np.hstack([moved, g.B - moved @ g.D]),
        C1 - poi_gain @ g.C,
        np.hstack([poi_gain, D12 - poi_gain @ g.D]),
        plant.dt,
        inputs=[*sensors(plant), *plant.u],
        outputs=estimates(channels),
        states=inner.states,
        name="kalman",
        units=plant.units,
    )


def _poi_rows(plant: StandardPlant) -> FloatArray:
    return plant.system.C[plant.system.output_index(poi_channels(plant))]


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
