"""The Kalman estimator: gain, predicted error and use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import COLUMNS, FloatArray, positive, real_array
from ..certificates import Certificate
from ..errors import ModelError, ShapeError, counted, only_one, require_known
from ..lti.statespace import StateSpace
from ..plant import AnyPlant
from ..tolerances import TYPED
from .error import PoiFilter
from .estimate import Estimate, estimated, in_unit_states
from .filter_models import (
    LEFT_OUT,
    FilterModel,
    LeftOut,
    beyond_text,
    filter_model,
    left_out,
    poi_channels,
)
from .lag_report import LAGS, LagReport, lag_errors
from .steady_filter import Filter, Lag, Sight


@dataclass(frozen=True, eq=False, repr=False)
class KalmanEstimator(PoiFilter):
    """A stationary Kalman filter of the motions at the POIs.

    ::

        x[k|k] = x[k|k-1] + L (y[k] - C2 x[k|k-1] - D22 u[k])
        hat[k] = C1 x[k|k-1] + D12 u[k] + L_z (y[k] - C2 x[k|k-1] - D22 u[k])
        x[k+1|k] = A x[k|k] + B2 u[k]

    x[k|j] is the estimate of the state x[k] from the measurements up to sample j. L is the gain of
    the state and L_z that of the estimates ``hat`` of the POI motions z. L_z is
    ``C1 L`` if no truncated modes are known. A, B2, C1, D12, C2 and D22 are the matrices of the
    plant from u to z and y.

    Parameters
    ----------
    system : StateSpace
        Filter from the sensors and the applied u to the estimates `die:hat`, `die:rx:hat`, ... Its
        state is x[k|k-1].
    plant : StandardPlant
        Plant of the design.
    gain : (n, ny) array
        Gain L, one column for each sensor.
    covariance : (n, n) array
        Covariance of the error of x[k|k], after the measurement, on the filter's model.
    certificate : Certificate
        Checks of the filter, such as the spectral radius of its error dynamics ``A - K C2``, with
        the predictor gain K.
    variances : (nz,) array [m^2 or rad^2]
        Predicted variances of the errors at the POIs, on the plant with truncated modes if these
        are known.
    left_out : LeftOut, optional
        Truncated modes, as noise and static compliance.
    tried : tuple of str
        Methods by which the gain was computed, in the order in which they were tried. The last one
        succeeded. For the others the reason of failure is given. The Riccati equation of the
        covariance is tried first. If its solution is not accurate enough, Newton steps on square
        roots of the covariance follow.

    Examples
    --------
    >>> import flexplant as fx
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> observer.tried
    ('Riccati equation of the covariance',)
    >>> observer.sensors, observer.system.outputs
    (('y1', 'y2'), ('die:hat',))
    >>> hat, state = observer.step(np.zeros(2), np.zeros(1))
    """

    system: StateSpace
    plant: AnyPlant
    gain: FloatArray
    covariance: FloatArray
    certificate: Certificate
    variances: FloatArray
    left_out: LeftOut | None = None
    tried: tuple[str, ...] = ()

    def __repr__(self) -> str:
        count = self.certificate.get(LEFT_OUT)
        beyond = beyond_text(self.plant, None if count is None else int(count))
        if self.certificate["difference"] > TYPED:
            beyond += f";\n  variances hold to {self.certificate['difference']:.0e}"
        return (
            f"<KalmanEstimator: {counted(self.system.n_states, 'state')}, "
            f"{counted(len(self.sensors), 'sensor')}, "
            f"spectral radius {self.certificate['spectral radius']:.6f}\n"
            f"  rms error {self.rms_text} ({beyond})>"
        )

    @cached_property
    def model(self) -> FilterModel:
        """The model of the filter: matrices, and covariances of all noises."""
        return filter_model(self.plant, self.left_out)

    @property
    def predictor_gain(self) -> FloatArray:
        """Gain K (n, ny) in ``x[k+1|k] = A x[k|k-1] + B2 u[k] + K e[k]``; e is the innovation."""
        return self.system.B[:, : len(self.sensors)]

    @cached_property
    def predicted_covariance(self) -> FloatArray:
        """Covariance (n, n) of the error of the prediction x[k|k-1], on the filter's model."""
        model, moved = self.model, self.model.A @ self.gain
        P = model.A @ self.covariance @ model.A.T + model.Q
        if np.any(model.S):
            K = self.predictor_gain
            still = np.eye(len(self.sensors)) - model.C2 @ self.gain
            innovation = np.linalg.solve(still, model.R)
            P = P - K @ innovation @ K.T + moved @ innovation @ moved.T
        return np.asarray(0.5 * (P + P.T))

    def estimate(
        self,
        records: Any,
        lag: Lag | None = None,
        *,
        start: npt.ArrayLike | None = None,
        path: npt.ArrayLike | Mapping[str, npt.ArrayLike] | None = None,
        gate: float | None = None,
    ) -> Estimate:
        """Return the motions at the POIs from recorded measurements and commands.

        The gain varies with time at the start of the record, and during and after gaps. In a gap
        the other sensors are used. The gain counts as stationary when its remaining change affects
        all later estimates and innovations by less than 1e-6 of their variance. Filter and
        Predictor always process the record in blocks of samples, without approximation. FixedLag
        and Smoother do so once the gain is stationary; until then each sample takes about a
        millisecond.

        Parameters
        ----------
        records : Response, mapping {channel: (N,) array} or data frame
            Records of all sensors and of the commands u as the controller gave them, without their
            delay (the filter contains it). NaN and masked entries are missing samples of a sensor.
            Other channels are ignored.
        lag : Predictor, Filter, FixedLag or Smoother, optional
            Type of the estimates; Filter() by default.
        start : (n,) array, optional
            Initial state x[0|-1] of the stationary filter: zeros for a machine at rest, or the
            `state` of the estimate of the preceding record. By default damped modes are in
            stationary motion due to the disturbances, rigid-body motions and undamped modes are
            unknown (diffuse prior), and u was 0 before the record.
        path : (N, 3) array [m] or mapping {name: (N, 3) array}, optional
            Position of a moving POI at each sample; by name for several POIs.
        gate : float, optional
            Number of standard deviations above which an innovation is an outlier. Such a sample of
            a sensor is treated as missing. With 5 or 6, only a fraction of 6e-7 or 2e-9 of correct
            samples is rejected. The result contains the rejected samples (`gated`). By default all
            samples are used.

        Returns
        -------
        Estimate
            ``result["die:hat"]``, its deviation, and the innovations.

        Raises
        ------
        LabelError
            When a sensor or command is not in the records, or a POI on a path is unknown.
        ShapeError
            When channels differ in length, or `start` has a wrong length.
        ModelError
            When `records` hold no channels, infinite values, or times of another rate, `lag` has a
            wrong type, or `gate` is not positive.
        SolverError
            When the sensor noise is so small that covariances cannot be computed accurately. The
            filter itself can still be used, by `system` or `step`.

        Warns
        -----
        FlexplantWarning
            When the gate leaves out more than a tenth of a sensor's samples.

        References
        ----------
        [AndersonMoore1979]_, ch. 7; [deJong1991]_.
        """
        place = None
        if path is not None:
            place = partial(moving_sight, self.plant, self.left_out, self.model, path)
        found = estimated(
            self.model,
            self.predicted_covariance,
            self.predictor_gain,
            records,
            Filter() if lag is None else lag,
            start,
            place,
            self.plant.units,
            np.inf if gate is None else positive(gate, "gate"),
        )
        found.warn_of_gate()
        return found

    def step(
        self, y: FloatArray, u: FloatArray, state: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimates at one sample and the state for the next: for loops in real time.

        ::

            state = None
            for y, u in samples:
                hat, state = observer.step(y, u, state)

        Parameters
        ----------
        y : (ny,) array
            The measurements, in the order of `sensors`.
        u : (nu,) array
            The commands of the same sample, in the order of `plant.u`.
        state : (n,) array, optional
            Result of the previous call; a machine at rest by default.

        Returns
        -------
        tuple of arrays
            The estimates (nz,) in the order of `system.outputs`, and the state x[k+1|k] (n,).

        Raises
        ------
        ShapeError
            When a size is wrong.
        ModelError
            When a value is NaN: a missing sample needs another gain, which `estimate` computes.
        """
        matrix, sizes = self._stepper
        x = np.zeros(sizes[0]) if state is None else state
        parts = [x, y, u]
        for i, name in enumerate(("state", "y", "u")):
            part = parts[i]
            if not (type(part) is np.ndarray and part.dtype == np.float64):
                part = parts[i] = real_array(part, name)
            if part.shape != (sizes[i],):
                raise ShapeError(
                    f"{name} must have shape ({sizes[i]},), got {part.shape}. Pass one sample of "
                    f"all channels: y of {', '.join(self.sensors)}; u of {', '.join(self.plant.u)}."
                )
        out = matrix @ np.concatenate(parts)
        if out[-1] != out[-1]:  # NaN anywhere is NaN everywhere in a product
            raise ModelError(
                "a measurement, a command or the state is NaN: the stationary gain needs all "
                "of them. Pass records with NaN to observer.estimate, which continues without them."
            )
        nz = out.size - sizes[0]
        return out[:nz], out[nz:]

    @cached_property
    def _stepper(self) -> tuple[FloatArray, tuple[int, int, int]]:
        """``[hat; x+] = matrix [x; y; u]``, and the sizes of x, y and u."""
        g, ny = self.system, len(self.sensors)
        return np.block([[g.C, g.D], [g.A, g.B]]), (g.n_states, ny, len(g.inputs) - ny)

    def report(self, lags: npt.ArrayLike = LAGS) -> LagReport:
        """Return the rms errors at the POIs for several lags; prints as a table.

        The rows are the static relation (see `design_static`), the predictor, the filter, fixed
        lags and the smoother, all stationary. They show how much smaller the error is if the
        estimate is allowed a delay.
        `fx.plot.lag_report` draws them.

        Parameters
        ----------
        lags : (k,) array [s]
            Lags, rounded to whole samples. Lags below half a sample are left out.

        Raises
        ------
        ModelError
            When lags are not positive numbers.
        SolverError
            When covariances have too few digits, as in `estimate`.
        """
        steady, sight, _, _ = in_unit_states(
            self.model, self.predicted_covariance, self.predictor_gain
        )
        filtered = steady.variances(sight, steady.P, steady.gains, predict=False)[0]
        whole = self.variances if self.left_out is not None else filtered
        return lag_errors(self.plant, steady, sight, np.sqrt(whole), lags, poi_channels(self.plant))

    def to_control(self) -> Any:
        """Return the filter as a `control.StateSpace`, from sensors and u to the estimates.

        The names of inputs, outputs and states are those of `system`.
        """
        return self.system.to_control()

    def to_filterpy(self) -> Any:
        """Return a `filterpy.kalman.KalmanFilter` of the same model, in its stationary state.

        At each sample, call `update(y)` and then `predict(u)`. y holds the measurements in the
        order of `sensors` (references are not included), and u holds the commands of all actuators.
        Both are 1-D arrays or columns.
        `batch_filter(ys, us, update_first=True)` processes a record. `rts_smoother` has no argument
        u and is therefore correct only for u = 0; use `estimate(records, Smoother())` for other u.
        """
        return filterpy_twin(self.model, self.predicted_covariance)


def moving_sight(
    plant: AnyPlant, found: LeftOut | None, model: FilterModel, path: Any, count: int
) -> Sight:
    """Return the rows of all POIs at each sample, those on a path at its points."""
    # each distinct point is a separate POI of the same plant: its rows of C and D are exact, and so
    # are the covariances of truncated modes there
    pois = {poi.name: poi for poi in plant.assembled.ports.z}
    if not isinstance(path, Mapping):
        path = {only_one("POI", pois, None, "path={name: points}"): path}
    nz = model.C1.shape[0]
    c = np.repeat(np.hstack([model.C1, model.N])[None], count, axis=0)
    D1 = np.repeat(model.D1[None], count, axis=0)
    V = np.repeat(np.diagonal(model.V)[None], count, axis=0)
    for name, points in path.items():
        require_known("POI", [name], pois)
        points = real_array(points, f"the path of {name!r}", (None, 3))
        if len(points) != count:
            raise ShapeError(
                f"the path of {name!r} has {counted(len(points), 'point')}, the record {count} "
                "samples. Pass the point at each sample."
            )
        distinct, which = np.unique(points, axis=0, return_inverse=True)
        which = which.reshape(-1)
        rows = [model.channels.index(pois[name].channel(axis)) for axis in pois[name].axes]
        for first in range(0, len(distinct), COLUMNS):
            some = distinct[first : first + COLUMNS]
            there = _model_at(plant, found, pois[name], some)
            at = np.flatnonzero((which >= first) & (which < first + len(some)))
            place = which[at] - first
            for i, row in enumerate(rows):
                own = nz + place * len(rows) + i
                c[at, row] = np.hstack([there.C1, there.N])[own]
                D1[at, row], V[at, row] = there.D1[own], there.V.diagonal()[own]
    return Sight(c, D1, V)


def _model_at(plant: AnyPlant, found: LeftOut | None, poi: Any, points: FloatArray) -> FilterModel:
    """Return the model with an additional POI at each point, after those of the plant."""
    ports = plant.assembled.ports
    more = [poi.replace(name=f"{poi.name}@{i}", at=p.tolist()) for i, p in enumerate(points)]
    wider = ports.replace(z=[*ports.z, *more])
    moved = plant.around(plant.machine.with_ports(wider))
    if found is None:
        return filter_model(moved)
    whole = found.whole.machine.with_ports(wider)
    return filter_model(moved, left_out(moved, whole))


def filterpy_twin(model: FilterModel, covariance: FloatArray) -> Any:
    """Return filterpy's filter of a model; P is the covariance of x[k|k-1], x is at rest."""
    if np.any(model.D2):
        raise ModelError(
            "filterpy's filter has no feedthrough from u to y, this plant has one. Sample it "
            "with a delay: plant.continuous.discretized(rate, delay=1)."
        )
    if np.any(model.S):
        raise ModelError(
            "filterpy's filter takes the noises of process and sensors as independent, those of "
            "this plant are correlated. Use observer.estimate, which includes the correlation."
        )
    n, m = model.B.shape
    found = twin_class()(dim_x=n, dim_z=model.C2.shape[0], dim_u=m)
    found.F, found.B, found.H = model.A.copy(), model.B.copy(), model.C2.copy()
    found.Q, found.R = model.Q.copy(), model.R.copy()
    found.P = covariance.copy()
    found.x = np.zeros((n, 1))
    return found


@cache
def twin_class() -> Any:
    """Return a subclass of `filterpy.kalman.KalmanFilter` whose y and u are 1-D or columns."""
    # filterpy adds `B u` to the column x as it comes: a 1-D u would make x an (n, n) array. Its
    # smoother, which takes no u, inverts covariances: here in states of unit variance, and without
    # the states of delay lines, which are known exactly
    from filterpy.kalman import KalmanFilter

    class Twin(KalmanFilter):  # type: ignore[misc]
        def update(self, z: Any, *more: Any, **given: Any) -> None:
            super().update(None if z is None else _column(z, self.dim_z, "y"), *more, **given)

        def predict(self, u: Any = None, *more: Any, **given: Any) -> None:
            super().predict(_command(u, self.dim_u), *more, **given)

        def predict_steadystate(self, u: Any = None, *more: Any, **given: Any) -> None:
            super().predict_steadystate(_command(u, self.dim_u), *more, **given)

        def get_prediction(
            self, u: Any = None, *more: Any, **given: Any
        ) -> tuple[FloatArray, FloatArray]:
            x, P = super().get_prediction(_command(u, self.dim_u), *more, **given)
            return x, P

        def rts_smoother(
            self, Xs: Any, Ps: Any, Fs: Any = None, Qs: Any = None, inv: Any = None
        ) -> tuple[Any, ...]:
            found: tuple[Any, ...] = super().rts_smoother(
                Xs, Ps, Fs, Qs, _scaled_inverse if inv is None else inv
            )
            return found

        def __reduce__(self) -> tuple[Any, ...]:
            return _unpickled, (self.__dict__,)

    return Twin


def _scaled_inverse(P: FloatArray) -> FloatArray:
    """Return the inverse of a covariance in states of unit variance; delay lines have none."""
    inverse, size = np.zeros_like(P), np.sqrt(P.diagonal())
    some = np.flatnonzero(size)
    unit = P[np.ix_(some, some)] / size[some] / size[some][:, None]
    inverse[np.ix_(some, some)] = np.linalg.inv(unit) / size[some] / size[some][:, None]
    return inverse


def _command(u: Any, count: int) -> FloatArray:
    # None and 0 are filterpy's own defaults for no command
    return np.zeros((count, 1)) if u is None or np.array_equal(u, 0) else _column(u, count, "u")


def _column(value: Any, count: int, name: str) -> FloatArray:
    found = real_array(value, name)
    if found.shape not in ((count,), (count, 1)) and not (count == 1 and found.size == 1):
        raise ShapeError(
            f"{name} must have {count} entries, as a 1-D array or a column, got shape "
            f"{found.shape}. Pass all of them, in the order of the plant."
        )
    return found.reshape(count, 1)


def _unpickled(fields: dict[str, Any]) -> Any:
    """Return an unpickled filter: pickle finds no class that is made inside a function."""
    kind = twin_class()
    twin = kind.__new__(kind)
    twin.__dict__.update(fields)
    return twin
