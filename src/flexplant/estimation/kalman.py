"""The stationary Kalman filter for a POI, a point without a sensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..certificates import Certificate, Verified, stability_check
from ..errors import CertificateError, ModelError, SolverError
from ..lti.equations import difference_of, solve_stein
from ..lti.lyapunov import dual_variances
from ..lti.riccati import filter_dare, riccati_root
from ..lti.sampling import reaches_at_once
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import AnyPlant
from ..plant.partitioned import require_noise, require_sampled
from ..tolerances import CLOSE, RESIDUAL, TYPED
from .error import error_variances, estimates
from .estimator import KalmanEstimator
from .filter_models import (
    LEFT_OUT,
    FilterModel,
    LeftOut,
    checked_plant,
    filter_model,
    left_out,
    poi_channels,
    sensors,
    unsure_noise,
    weigh,
)


@one_thread()
def design_kalman(plant: AnyPlant | System, *, machines: Any = None) -> KalmanEstimator:
    """Return the stationary Kalman filter of the POIs on a sampled plant.

    It reads the sensors (not the references) and the applied u, and gives the estimate `die:hat`
    for a POI "die". ``observer.rms("die")`` is the predicted error.
    ``close_loop(plant, observer, servo)`` runs the filter in a loop, and
    ``observer.estimate(records)`` applies it to recorded data. The motion of truncated modes of the
    evaluation model counts as noise, and the predicted error is as accurate as that model (see
    ``help(flexplant.estimation)``; the equations are in `algorithms`). Without an evaluation model
    the predicted error does not include truncation.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant: `assemble_plant(model, ports).discretized(rate, delay=1)`. Its sensors may
        also be read `through` a static block, for example one that decouples the motions; the
        noises of the new signals are then correlated. A labelled system without noise densities is
        refused, and the message tells how to add them.
    machines : PlantMachines, optional
        Random draws of the machine within its known uncertainty, as ``plant.machines`` gives them.
        If they are given, the filter relies less on uncertain modes. The noise of the truncated
        modes is moved towards the mean covariance of the difference between the machines and the
        filter's model: by 0, 1/4, 1/2 or all of this change. The filter whose error intervals have
        the smallest upper ends is returned. Without truncated modes this argument has no effect.

    Returns
    -------
    KalmanEstimator
        Estimator with a certificate. The variances of the error are computed by two independent
        methods, and the certificate contains their difference.

    Raises
    ------
    AssumptionError
        When the plant is continuous or a sensor has no noise. When a disturbance that is not
        constant during each sample reaches a sensor directly. When w does not excite a rigid-body
        mode, or y does not see it. When data are missing that the intervals over `machines` need.
    ModelError
        When the plant is weighted, its noise is not known, or the evaluation model has fewer modes
        than the plant.
    LabelError
        When the labels of a system do not name w, u, z and y.
    SolverError
        When no strictly stable filter exists for another reason.
    CertificateError
        When the two methods for the variances disagree.


    References
    ----------
    [AndersonMoore1979]_, ch. 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> f"{1e9 * observer.rms('die'):.2f} nm"
    '1.88 nm'
    """
    plant = checked_plant(plant)
    require_sampled(plant, "this filter runs at samples")
    _check_noises(plant)
    plant.check().require(("excited", "detectable"), "a stationary Kalman filter")
    whole = plant.machine.evaluation_plant
    found = None if whole is None else left_out(plant, whole)
    if found is None:
        observer = _observer(plant, None)
        checks = () if whole is None else (_left_out_check(0),)
        return observer.replace(certificate=observer.certificate.extended(*checks))
    if machines is None:
        return _judged(plant, found)
    noises = [found, *unsure_noise(found, plant, machines)]
    return min((_judged(plant, noise) for noise in noises), key=_upper_ends)


def _check_noises(plant: AnyPlant) -> None:
    """Raise AssumptionError for a sensor without noise, or with direct white noise."""
    _ = plant.noise_factor  # raises where it is not known
    read, own = sensors(plant), plant.sensor_noise.diagonal()
    require_noise({name: own[plant.y.index(name)] for name in read})
    inner = plant.system
    loud = [
        name
        for name in plant.w
        if plant.asd.get(name, 0.0) > 0 and ":noise" not in name and name not in plant.held
    ]
    direct = inner.D[np.ix_(inner.output_index(read), inner.input_index(loud))]
    if np.any(direct):
        row, column = (int(i) for i in np.argwhere(direct)[0])
        raise reaches_at_once(loud[column], read[row])


def _upper_ends(observer: KalmanEstimator) -> float:
    """Return the mean logarithm of the upper ends of the intervals of a filter's errors."""
    ends = [observer.interval(name).high for name in poi_channels(observer.plant)]
    return float(np.mean([np.inf if end is None else np.log(end) for end in ends]))


def _judged(plant: AnyPlant, found: LeftOut) -> KalmanEstimator:
    """Return the filter of a plant and of truncated modes, with its errors on the larger plant."""
    observer = _observer(plant, found)
    complete = error_variances(plant.around(found.whole.machine), observer.system)
    certificate = observer.certificate.extended(_left_out_check(found.modes.size))
    if complete.difference > certificate["difference"]:
        certificate = certificate.extended(_difference_check(complete.difference, CLOSE))
    return observer.replace(certificate=certificate, variances=complete.values)


def _left_out_check(count: int) -> Verified:
    """Return the number of truncated modes whose noise the filter includes."""
    return Verified(LEFT_OUT, float(count), "the evaluation model")


def redesigned(
    observer: KalmanEstimator, change: Callable[[AnyPlant], AnyPlant]
) -> KalmanEstimator:
    """Return the observer of a changed plant, with the same truncated modes and their noise."""
    # its predicted errors hold on its own model
    found = observer.left_out
    if found is not None:
        found = found.replace(plant=change(found.plant))
    return _observer(change(observer.plant), found)


def _observer(plant: AnyPlant, found: LeftOut | None) -> KalmanEstimator:
    """Return the filter of a plant and truncated modes, with its errors on its own model."""
    model = filter_model(plant, found)
    design = auto_filter_design(model)
    own = plant if found is None else found.plant
    system = _filter_system(own, model, design.K, design.L_z)
    return KalmanEstimator(
        system, plant, design.gain, design.covariance, design.certificate, design.variances, found,
        design.tried,
    )  # fmt: skip


def _filter_system(
    plant: AnyPlant, model: FilterModel, K: FloatArray, L_z: FloatArray
) -> StateSpace:
    """Return the filter, from sensors and u to the estimates of POIs."""
    # `x+ = A x + B u + K e`, `hat = C1 x + D1 u + L_z e` with the innovation `e = y - C2 x - D2 u`
    m = model
    return StateSpace(
        m.A - K @ m.C2,
        np.hstack([K, m.B - K @ m.D2]),
        m.C1 - L_z @ m.C2,
        np.hstack([L_z, m.D1 - L_z @ m.D2]),
        plant.dt,
        inputs=[*m.sensors, *m.commands],
        outputs=estimates(m.channels),
        states=plant.system.states,
        name="kalman",
        units=plant.units,
    )


#: the two methods, in words
_BY_COVARIANCE, _IN_ROOTS = "Riccati equation of the covariance", "Newton's steps in square roots"


class FilterDesign(NamedTuple):
    """Gains L, K and L_z, covariance after the measurement, POI variances, and checks."""

    gain: FloatArray
    K: FloatArray
    L_z: FloatArray
    covariance: FloatArray
    variances: FloatArray
    radius: float
    residual: float
    difference: float
    #: the methods in the order in which they were tried, each with the reason why it failed
    tried: tuple[str, ...]
    allowed: float = TYPED

    @property
    def certificate(self) -> Certificate:
        """Checks of the filter."""
        checks = (
            stability_check(self.radius, sampled=True),
            Verified("residual", self.residual, "the Riccati equation, in states of unit variance"),
        )
        return Certificate((*checks, _difference_check(self.difference, self.allowed)))


def _difference_check(difference: float, limit: float = TYPED) -> Verified:
    """Return the check of two routes to the variances at the POIs."""
    return Verified("difference", difference, "variances by a Stein equation of the gain", limit)


def auto_filter_design(model: FilterModel) -> FilterDesign:
    """Return the gains by the covariance or, if it fails, in square roots; `tried` says which."""
    own = np.sum(model.H[:, ~np.any(model.G, axis=0)] ** 2, axis=1)
    # R is nearly all noise that moves the states too, the sensors' own part lost in it
    if np.any(own < RESIDUAL * np.sum(model.H**2, axis=1)):
        return _design_in_roots(model)
    try:
        return _design_by_covariance(model)
    except (SolverError, CertificateError, ModelError) as error:  # R singular by rounding, say
        try:
            found = _design_in_roots(model)
            return found._replace(tried=(f"{_BY_COVARIANCE}: {error}", *found.tried))
        except SolverError:
            raise error from None


def _design_by_covariance(model: FilterModel) -> FilterDesign:
    """Return the gains by the Riccati equation of P."""
    solution = filter_dare(model.A, model.C2, Q=model.Q, R=model.R, S=model.S)
    P = solution.P
    innovation = model.innovation(P)
    gain = weigh(P @ model.C2.T, innovation)
    K = model.A @ gain + weigh(model.S, innovation)
    L_z = weigh(model.C1 @ P @ model.C2.T + model.N, innovation)
    covariance = model.updated(P, gain)
    variances = np.einsum("ij,jk,ik->i", model.C1, covariance, model.C1)
    radius, difference = checked_error(model, gain, K, covariance)
    return FilterDesign(
        gain, K, L_z, covariance, variances, radius, solution.residual, difference,
        (_BY_COVARIANCE,),
    )  # fmt: skip


def _design_in_roots(model: FilterModel) -> FilterDesign:
    """Return the gains where P has too few digits."""
    G, H = model.G, model.H
    found = riccati_root(model.A, model.C2, G, H)
    gain = found.weighed(found.L @ (model.C2 @ found.L).T)
    rest = np.hstack([found.L - gain @ (model.C2 @ found.L), gain @ H])
    covariance = rest @ rest.T
    variances = np.sum((model.C1 @ rest) ** 2, axis=1)
    radius = _stable_radius(model, found.K)
    poi_rows, entering = model.C1 @ gain, G - found.K @ H
    truth = dual_variances(
        model.A - found.K @ model.C2,
        entering,
        model.C1 - poi_rows @ model.C2,
        np.linalg.norm(found.L, axis=1),
    ) + np.sum((poi_rows @ H) ** 2, axis=1)
    difference = _agreement(variances, truth, CLOSE)
    L_z = poi_rows + found.weighed(model.N)
    return FilterDesign(
        gain, found.K, L_z, covariance, variances, radius, found.change, difference,
        (_IN_ROOTS,), CLOSE,
    )  # fmt: skip


def checked_error(
    model: FilterModel, L: FloatArray, K: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """Return spectral radius and difference of the gains of a filter, if the covariance is theirs.

    The error's covariance follows from the gains alone, by a Stein equation:
    ``P = F P F' + (G - K H)(G - K H)'``, F = A - K C2.
    """
    radius, rows = _stable_radius(model, K), model.C1 @ L
    left = model.C1 - rows @ model.C2
    try:
        P = solve_stein(model.A - K @ model.C2, model.driven(K))
    except SolverError as error:
        raise CertificateError(f"the estimation error could not be checked: {error}") from error
    truth = np.sum((left @ P) * left, axis=1) + np.sum((rows @ model.H) ** 2, axis=1)
    claim = np.einsum("ij,jk,ik->i", model.C1, covariance, model.C1)
    return radius, _agreement(claim, truth)


def _stable_radius(model: FilterModel, predictor: FloatArray) -> float:
    """Return the spectral radius of the error of a predictor gain, which is below 1."""
    closed = model.A - predictor @ model.C2
    radius = float(np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0))
    if radius >= 1:
        raise CertificateError(
            f"the estimation error is not stable: spectral radius {radius:.9f}. The gain is not "
            "that of a Kalman filter of this plant."
        )
    return radius


def _agreement(claim: FloatArray, truth: FloatArray, allowed: float = TYPED) -> float:
    """Return the largest relative difference of POI variances from those of a gain."""
    difference = difference_of(claim, truth)
    if not difference <= allowed:
        raise CertificateError(
            f"the gain gives POI variances that differ from the predicted ones by {difference:.1e} "
            f"(allowed {allowed:.0e}). The prediction cannot be trusted."
        )
    return difference
