"""How a lag reduces the predicted error at the POIs, and the error of the static relation.

The static relation computes the POI from the sensors for a machine at rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, positive_array
from ..errors import AssumptionError, FlexplantError, aligned, require_known
from ..lti.equations import solve_stein
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import AnyPlant, Disturbance, standard_plant
from ..plant.inverse import moved_at_rest
from ..plant.partitioned import require_sampled
from ..store import Value
from ..tolerances import SAME
from .error import PoiEstimator, error_variances, estimates, row_of
from .filter_models import checked_plant, poi_channels, same_pois, sensors
from .steady_filter import Sight, Steady

#: lags of the table [s]
LAGS = (1e-4, 1e-3, 1e-2)
#: points of the curve over the lag
_POINTS = 60
#: names of the rows without a lag in seconds
PREDICTOR, FILTER, SMOOTHER, STATIC = "predictor", "filter", "smoother", "static relation"


@dataclass(frozen=True, eq=False, repr=False)
class LagReport(Value):
    """The stationary rms errors of one filter for several lags; prints as a table.

    The errors hold on the filter's model, where truncated modes are white noise. `on_whole` is the
    error of the filter on the plant with these modes. The static relation is the estimate of
    `design_static`, a constant gain for the sensors.

    Parameters
    ----------
    channels : sequence of str
        Names of the POI motions.
    names : sequence of str
        Names of the rows: static relation, predictor, filter, lags such as "1 ms", smoother.
    rms : (n_row, nz) array [m or rad]
        RMS errors; NaN without a static relation.
    lag : (n,) array [s]
        Lags of the curve; 0 is the filter.
    curve : (n, nz) array [m or rad]
        RMS errors at these lags.
    on_whole : (nz,) array
        RMS errors of the filter on the plant with truncated modes; equal to the filter's row in
        `rms` if no truncated modes are known.
    note : str
        Reason why no static relation exists, or "".
    units : mapping {channel: unit}
        Unit of each channel.

    Examples
    --------
    >>> import flexplant as fx
    >>> report = fx.design_kalman(fx.testbeds.three_masses()).report()
    >>> report.channels
    ('die:x',)
    """

    channels: Sequence[str]
    names: Sequence[str]
    rms: FloatArray
    lag: FloatArray
    curve: FloatArray
    on_whole: FloatArray
    note: str = ""
    units: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, row: str) -> FloatArray:
        """Return the rms errors (nz,) of one row, such as "smoother" or "1 ms"."""
        require_known("row", [row], self.names)
        return np.asarray(self.rms[list(self.names).index(row)])

    def recovered(self, row: str, channel: str) -> float:
        """Return the improvement of a row (such as "1 ms") relative to that of the smoother.

        The result is the decrease of the error variance from the filter to this row, divided by
        the decrease from the filter to the smoother: 0 for the filter, and 1 for the smoother.
        """
        i = row_of(self.channels, channel)
        filtered, smooth = self[FILTER][i] ** 2, self[SMOOTHER][i] ** 2
        return float((filtered - self[row][i] ** 2) / (filtered - smooth))

    def __repr__(self) -> str:
        units = [self.units.get(name, "?") for name in self.channels]
        scaled = [unit in ("m", "rad") for unit in units]
        nano = ["n" if small else "" for small in scaled]
        heads = [f"{name} [{n}{u}]" for name, n, u in zip(self.channels, nano, units, strict=True)]
        rows = dict(zip(self.names, self.rms * np.where(scaled, 1e9, 1.0), strict=True))
        beyond = not np.allclose(self.on_whole, self[FILTER], rtol=1e-6, atol=0.0)
        rows |= {"filter *": self.on_whole * np.where(scaled, 1e9, 1.0)} if beyond else {}
        cells = [(n, *("-" if np.isnan(v) else f"{v:.4g}" for v in r)) for n, r in rows.items()]
        lines = ["rms error at the POIs by lag", *aligned(("", *heads), cells)]
        if beyond:
            lines.append("* on the plant with the truncated modes, which are white noise above")
        if self.note:
            lines.append(f"no static relation: {self.note}")
        return "\n".join(lines)


@one_thread()
def lag_errors(
    plant: AnyPlant,
    steady: Steady,
    sight: Sight,
    on_whole: FloatArray,
    lags: npt.ArrayLike,
    channels: Sequence[str],
) -> LagReport:
    """Return the report of a stationary filter."""
    # `var(l) = var(filter) - T M_l T'`, M_l the information of l further samples on the state, up
    # to `M = F' M F + C2' S^-1 C2` of the smoother
    wanted = positive_array(lags, "lags", (None,), hint="They are times [s]: try 1e-3.")
    counts = {f"{1e3 * s:.4g} ms": round(s / plant.dt) for s in sorted(wanted.tolist())}
    counts = {name: count for name, count in counts.items() if count}
    g, F = steady.gains, steady.F
    base = steady.variances(sight, steady.P, g, predict=False)[0]
    predicted = steady.variances(sight, steady.P, g, predict=True)[0]
    rows = sight.c[0] @ steady.onward(steady.P, g)
    seen = g.W @ steady.model.C2
    total = solve_stein(F.T, seen.T @ seen)
    smooth = base - np.einsum("zi,ij,zj->z", rows, total, rows)
    longest = max([*counts.values(), 10])
    curve = np.empty((longest + 1, base.size))
    curve[0] = base
    w = rows
    for k in range(1, longest + 1):
        curve[k] = curve[k - 1] - np.sum((w @ seen.T) ** 2, axis=1)
        w = w @ F.T
    try:
        alone = design_static(plant.replace(evaluation=None))  # like the other rows
        static, note = np.array([alone.rms(name) for name in channels]), ""
    except FlexplantError as error:
        static, note = np.full(len(channels), np.nan), str(error)
    table = [static**2, predicted, base, *(curve[k] for k in counts.values()), smooth]
    shown = np.unique(np.geomspace(1, longest + 1, _POINTS).astype(np.int64)) - 1
    return LagReport(
        channels,
        (STATIC, PREDICTOR, FILTER, *counts, SMOOTHER),
        np.sqrt(np.maximum(table, 0.0)),
        np.asarray(plant.dt * shown, dtype=np.float64),
        np.sqrt(np.maximum(curve[shown], 0.0)),
        on_whole,
        note,
        {name: plant.units[name] for name in channels if name in plant.units},
    )


@dataclass(frozen=True, eq=False, repr=False)
class StaticEstimator(PoiEstimator):
    """Least-squares estimate of the POI motions at low frequencies by a constant gain matrix.

    Parameters
    ----------
    system : StateSpace
        Static system from the displacement sensors to the estimates `die:hat`, ...
    plant : StandardPlant
        Plant whose static motions it uses.
    """

    system: StateSpace
    plant: AnyPlant

    def __repr__(self) -> str:
        g = self.system
        return f"<StaticEstimator: {', '.join(g.inputs)} -> {', '.join(g.outputs)}>"

    @property
    def gain(self) -> FloatArray:
        """Gain matrix (n_poi, n_sensors) from the displacement sensors to the estimates."""
        return self.system.D

    def rms(self, channel: str, *, on: AnyPlant | System | None = None) -> float:
        """Return the predicted rms of the error at sample instants, with u = 0.

        The error includes the deformation by disturbances (also of known truncated modes) and the
        sensor noise. Rigid-body motions cause no error. `channel` and the plant `on` are as for
        `KalmanEstimator.rms`; without `on`, the evaluation plant is used if there is one.
        AssumptionError is raised for a continuous plant, since continuous white sensor noise has an
        infinite variance. SolverError is raised when an elastic mode is not damped.
        """
        row = row_of(poi_channels(self.plant), channel)
        require_sampled(self.plant, "an rms is of samples")
        plant = self.plant.evaluation_plant or self.plant
        if on is not None:
            plant = same_pois(self.plant, on)
        found = error_variances(plant, self.system)
        return float(np.sqrt(found.values[row]))


def design_static(plant: AnyPlant) -> StaticEstimator:
    """Return the static relation between the displacement sensors and the POIs.

    The estimate is ``hat = Z Y^+ y`` with the pseudo-inverse ``Y^+``. The columns of Z and Y are
    the static motions of the POIs and of the sensors under the forces of the actuators. If the
    actuators do not cause every motion of the POIs, the forces of the disturbances are used too.
    For a free body the static motions are its rigid-body motions, and the relation follows from the
    geometry only. For a machine whose bodies are connected by drives and springs, they are the
    motions that the drives cause. The static relation is usual practice, and estimators with a
    flexible model are compared with it.

    Parameters
    ----------
    plant : StandardPlant
        Plant, continuous or sampled.

    Returns
    -------
    StaticEstimator
        Estimator that is exact for static motions. A motion that no force of the plant causes is
        estimated as zero.

    Raises
    ------
    AssumptionError
        When the displacement sensors do not determine a motion of a POI.
    ModelError
        When the plant is weighted.

    References
    ----------
    [paper]_, section 5: "the static geometric relation".

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.design_static(fx.testbeds.three_masses()).gain.round(6)  # the mean of both ends
    array([[0.5, 0.5]])
    >>> fx.design_static(fx.testbeds.hexapod()).gain.shape  # from six legs to six axes
    (6, 6)
    """
    plant = standard_plant(checked_plant(plant))
    ports = plant.assembled.ports
    orders = {s.name: s.order for s in ports.y}
    used = [name for name in sensors(plant) if orders.get(name) == 0]
    channels = poi_channels(plant)
    names = [*channels, *used]
    motions = moved_at_rest(plant, names, plant.u)
    if not np.all(np.any(motions[: len(channels)], axis=1)):
        pushes = [one.name for one in ports.w if isinstance(one, Disturbance)]
        motions = moved_at_rest(plant, names, [*plant.u, *pushes])
    Z, Y = np.split(motions, [len(channels)])
    gain = Z @ np.linalg.pinv(Y, rcond=SAME)
    missed = np.linalg.norm(Z - gain @ Y, axis=1)
    # displacements of a static solution have nine digits
    bad = missed > 1e-6 * np.linalg.norm(Z, axis=1)
    if np.any(bad):
        raise AssumptionError(
            f"the displacement sensors ({', '.join(used) or 'none'}) do not determine the "
            f"motion of {channels[int(np.argmax(bad))]!r} at rest. Add or move sensors: of a free "
            "plate, three that are not on one line see z, rx and ry."
        )
    ends: Any = {"inputs": used, "outputs": estimates(channels), "units": plant.units}
    system = StateSpace([], [], [], gain, plant.dt, name="static", **ends)
    return StaticEstimator(system, plant)
