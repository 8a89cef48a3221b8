"""The Kalman filter of sensors that are sampled at different integer rates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import lcm
from typing import Any

import numpy as np

from ..arrays import FloatArray, real_array, whole
from ..certificates import Certificate, Verified, stability_check
from ..errors import (
    CertificateError,
    LabelError,
    ModelError,
    ShapeError,
    counted,
    require_known,
    short,
)
from ..lti.riccati import filter_dare
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import AnyPlant
from ..store import Value
from ..tolerances import TINY
from ..words import instance, sizes_of
from .estimator_channels import checked_plant, estimates, poi_channels, recorded, row_of, sensors
from .filter_models import (
    AGREEMENT,
    RICCATI,
    FilterModel,
    check_noises,
    filter_gains,
    filter_model,
    filter_system,
)
from .left_out_modes import LeftOut, beyond_text, left_out

#: longest period [samples], and most measurements in one
_LONGEST, _MOST = 1000, 2000


@dataclass(frozen=True, eq=False, repr=False)
class PeriodicEstimator(Value):
    """A Kalman filter whose gains repeat after a period of samples.

    Parameters
    ----------
    plant : StandardPlant
        What it was designed on; its rate is that of the estimates.
    period : int [samples]
        Least common multiple of the sensors' intervals.
    measured : (period, ny) array of bool
        Which sensors are read in which sample of a period.
    gains : (period, n, ny) array
        L, columns of sensors that are not read are zero.
    predictor_gains : (period, n, ny) array
        K of ``x[k+1|k] = A x[k|k-1] + B2 u + K e``.
    poi_gains : (period, nz, ny) array
        L_z of ``hat = C1 x[k|k-1] + D1 u + L_z e``.
    variances : (period, nz) array [m^2 or rad^2]
        Of the errors at the POIs in each sample of a period.
    certificate : Certificate
    left_out : LeftOut, optional
        The modes of the evaluation model that the plant lacks: white noise on sensors and POIs.
    """

    plant: AnyPlant
    period: int
    measured: FloatArray
    gains: FloatArray
    predictor_gains: FloatArray
    poi_gains: FloatArray
    variances: FloatArray
    certificate: Certificate
    left_out: LeftOut | None = None

    def __repr__(self) -> str:
        judged = self.plant.machine.evaluation is not None
        count = len(self.left_out.modes) if self.left_out else 0 if judged else None
        rms = sizes_of({n: self.rms(n) for n in poi_channels(self.plant)}, self.plant.units)
        return (
            f"<PeriodicEstimator: {counted(self.gains.shape[1], 'state')}, "
            f"{counted(len(self.sensors), 'sensor')}, "
            f"period {self.period} samples;\n  rms error {rms} ({beyond_text(self.plant, count)})>"
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors, in the order of the columns of the gains."""
        return sensors(self.plant)

    @property
    def _model(self) -> FilterModel:
        return filter_model(self.plant, self.left_out)

    def rms(self, channel: str, phase: int | None = None) -> float:
        """Return the rms of the error of a POI's motion (`die`, `die:z`, `die:hat`) over a period.

        Or in one sample of it, `phase` from 0.
        """
        column = self.variances[:, row_of(poi_channels(self.plant), channel)]
        if phase is not None:
            at = whole(phase, "phase", minimum=0, maximum=self.period - 1)
            column = column[at : at + 1]
        return float(np.sqrt(np.mean(np.maximum(column, 0.0))))

    def system(self, phase: int) -> StateSpace:
        """Return the filter of one sample of a period, from sensors and u to the estimates."""
        k = whole(phase, "phase", minimum=0, maximum=self.period - 1)
        model = self._model
        gains = self.predictor_gains[k], self.poi_gains[k]
        return filter_system(self.plant, model, *gains, f"sample {k} of a period")

    def estimate(self, records: Any, *, start: Any = None) -> dict[str, FloatArray]:
        """Return the estimates by name over a record that begins with the first sample of a period.

        All sensors and commands at the plant's rate, as for `KalmanEstimator.estimate`; samples in
        which a sensor is not read may be NaN, or anything. `start` is x (n,) at the first sample;
        rest when not given.
        """
        model = self._model
        record = recorded(records, model)
        due = np.resize(self.measured.astype(bool), record.y.shape)
        if np.any(np.isnan(record.y) & due):
            k, j = (int(i) for i in np.argwhere(np.isnan(record.y) & due)[0])
            raise ModelError(
                f"{self.sensors[j]!r} is read in sample {k}, where the record has NaN. Let the "
                "record start at the first sample of a period, or design the filter without it."
            )
        y = np.where(due, record.y, 0.0)
        n = model.A.shape[0]
        x = np.zeros(n) if start is None else real_array(start, "start", (n,))
        hat = np.empty((len(y), len(model.channels)))
        for k, (measured, u) in enumerate(zip(y, record.u, strict=True)):
            at = k % self.period
            e = np.where(due[k], measured - model.C2 @ x - model.D2 @ u, 0.0)
            hat[k] = model.C1 @ x + self.poi_gains[at] @ e + model.D1 @ u
            x = model.A @ x + model.B @ u + self.predictor_gains[at] @ e
        return dict(zip(estimates(model.channels), hat.T, strict=True))


@one_thread()
def design_multirate(
    plant: AnyPlant | System, every: Mapping[str, int | tuple[int, int]]
) -> PeriodicEstimator:
    """Return the periodic Kalman filter of sensors that are read at different integer rates.

    The plant is sampled at the rate of the estimates; ``every={"y3": 10}`` is a sensor that is read
    in samples 0, 10, 20, ..., ``(10, 3)`` one that is read in 3, 13, ... Over a period of T
    samples the plant is lifted to one step, measurements stacked::

        x[k+T] = A^T x[k] + sum A^(T-1-j) w[k+j]
        Y[k]   = [C A^j x[k] + sum_i<j C A^(j-1-i) w[k+i] + v[k+j]],  rows that are read

    whose Riccati equation has correlated noises; the recursion then gives the gains of each sample.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, not weighted. A sensor's noise per sample is that of its asd at the plant's rate.
    every : mapping {sensor: interval or (interval, offset)} [samples]
        Sensors that are not named are read in each sample.

    Returns
    -------
    PeriodicEstimator

    Raises
    ------
    AssumptionError
        As `design_kalman`.
    ModelError, ShapeError
        When intervals are not whole numbers, an offset is not below its interval, or the period or
        the number of measurements in it is too large.
    SolverError
        When no stable filter exists: a mode is aliased to rest by the interval of all that see it.
    CertificateError
        When the recursion does not reproduce the lifted solution.

    References
    ----------
    [BittantiColaneri2009]_, ch. 6 and 9.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> slow = fx.estimation.design_multirate(plant, {"y2": 4})  # y2 is read every fourth sample
    >>> slow.period, bool(np.max(slow.rms("die")) > fx.design_kalman(plant).rms("die"))
    (4, True)
    """
    plant = checked_plant(plant)
    judge = plant.machine.evaluation_plant
    found = None if judge is None else left_out(plant, judge)
    model = filter_model(plant, found)
    check_noises(plant)
    plant.check().require(("excited", "detectable"), "a stationary Kalman filter")
    measured = _reading_times(model.sensors, every)
    period = len(measured)
    C, Q, R, S, A = _lifted(model, measured)
    solution = filter_dare(A, C, Q=Q, R=R, S=S)
    P = solution.P
    gains, predictors, shown, variances = [], [], [], []
    moved = np.eye(len(P))
    for read in measured:
        gain, predictor, to_pois, ahead = _joseph_step(model, P, read)
        gains.append(gain)
        predictors.append(predictor)
        shown.append(to_pois)
        left = model.C1 - to_pois @ model.C2
        noise = np.sum((to_pois @ model.R - 2.0 * model.N) * to_pois, axis=1)
        variances.append(np.sum((left @ P) * left, axis=1) + model.V.diagonal() + noise)
        moved = (model.A - predictor @ model.C2) @ moved
        P = ahead
    first = solution.P.diagonal()
    known = first > TINY
    difference = float(np.max(np.abs(P.diagonal() - first)[known] / first[known], initial=0.0))
    radius = float(np.max(np.abs(np.linalg.eigvals(moved)), initial=0.0))
    stable = stability_check(radius, sampled=True, of=" over a period")
    repeated = Verified(
        "difference", difference, "variances after one period of the recursion", AGREEMENT
    )
    solved = Verified("residual", solution.residual, RICCATI)
    certificate = Certificate((stable, solved, repeated))
    if not certificate.holds:
        raise CertificateError(
            f"one period of the recursion changes the variances by {difference:.1e} (allowed "
            f"{AGREEMENT:.0e}), spectral radius {radius:.9f}. The filter cannot be trusted. Choose "
            "a shorter period; sensors that are far better than their data sheet do this too."
        )
    return PeriodicEstimator(
        plant,
        period,
        measured.astype(np.float64),
        np.array(gains),
        np.array(predictors),
        np.array(shown),
        np.array(variances),
        certificate,
        found,
    )


def _reading_times(names: tuple[str, ...], every: Any) -> FloatArray:
    """Return which sensors are read in which sample of the common period (T, ny)."""
    instance(every, Mapping, "every", "Pass {sensor: samples}, such as {'y3': 10}.")
    intervals, offsets = dict.fromkeys(names, 1), dict.fromkeys(names, 0)
    for name, given in every.items():
        require_known("sensor", [name], names)
        pair = given if isinstance(given, tuple) else (given, 0)
        if len(pair) != 2:
            raise ShapeError(
                f"{name!r} is read every so many samples, with an offset if any, got "
                f"{short(given)}. Pass 10 or (10, 3)."
            )
        intervals[name] = whole(pair[0], f"interval of {name!r}", maximum=_LONGEST)
        offsets[name] = whole(
            pair[1], f"offset of {name!r}", minimum=0, maximum=intervals[name] - 1
        )
    period = lcm(*intervals.values())
    k = np.arange(period)[:, None]
    found = (k - np.array(list(offsets.values()))) % np.array(list(intervals.values())) == 0
    if period > _LONGEST or found.sum() > _MOST:
        raise ModelError(
            f"the sensors repeat after {period} samples with {int(found.sum())} measurements, at "
            f"most {_LONGEST} and {_MOST} are allowed. Choose intervals with a common multiple."
        )
    if not found.any():
        raise LabelError("no sensor is read. Name one.")
    return np.asarray(found)


def _lifted(
    m: FilterModel, measured: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return C, Q, R, S and A of one period as one step."""
    n = m.A.shape[0]
    A, Q = np.eye(n), np.zeros((n, n))
    C, R, S = np.zeros((0, n)), np.zeros((0, 0)), np.zeros((n, 0))
    for read in measured:
        rows = np.flatnonzero(read)
        C_k = m.C2[rows]
        # the measurement of this sample: its noise, the part of w so far, and that of the others
        cross = C_k @ S
        R = np.block([[R, cross.T], [cross, C_k @ Q @ C_k.T + m.R[np.ix_(rows, rows)]]])
        C = np.vstack([C, C_k @ A])
        S = np.hstack([m.A @ S, m.A @ Q @ C_k.T + m.S[:, rows]])
        Q = m.A @ Q @ m.A.T + m.Q
        A = m.A @ A
    return C, 0.5 * (Q + Q.T), 0.5 * (R + R.T), S, A


def _joseph_step(
    m: FilterModel, P: FloatArray, read: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return L, K, L_z and P[k+1|k] of one sample, in Joseph's form."""
    g = filter_gains(m, P, read)
    closed = m.A - g.K @ m.C2
    ahead = closed @ P @ closed.T + m.driven(g.K)
    to_pois = m.C1 @ g.L + m.N @ g.W.T @ g.W
    return g.L, g.K, to_pois, 0.5 * (ahead + ahead.T)
