"""The variance of POIs' estimates: where sensors go; the axes of POIs that criteria sum over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, TypeAlias

import numpy as np

from ..arrays import FloatArray, flag, instance, one_of, positive
from ..errors import LabelError, ModelError, only_one, require_known, short
from ..estimation import Filter, FixedLag, KalmanEstimator, Predictor, design_kalman
from ..estimation.filter_models import poi_channels, sensors
from ..lti.sampling import held_exactly, reaches_at_once
from ..lti.statespace import StateSpace
from ..plant import Actuator, StandardPlant
from ..plant.building import direct_effect
from ..plant.machine_plants import interval
from ..plant.partitioned import require_noise
from ..store import checked
from ..tolerances import INTERVAL
from .candidates import Port, with_side
from .convex import WorstRow, quadratic
from .criterion import Criterion, OnBoth, OnPlant, Scorer

#: POIs, or axes of a POI, that count, each once or by a factor
Named: TypeAlias = str | Sequence[str] | Mapping[str, float] | None


def checked_names(given: Any, name: str) -> tuple[str, ...] | Mapping[str, float] | None:
    """Return names as a tuple, or as a mapping to factors; None stays None."""
    if given is None:
        return None
    named: Any = (given,) if isinstance(given, str) else given
    if isinstance(named, Mapping):
        named = {str(a): positive(f, f"factor of {name} {a!r}") for a, f in named.items()}
    elif isinstance(named, Sequence):
        named = tuple(str(a) for a in named)
        if len(set(named)) != len(named):
            raise LabelError(f"{name} {named} twice: name each once, with a factor.")
    else:
        raise ModelError(
            f"{name} is a name, several, or a mapping to factors, got {short(given)}. Type "
            "('die', 'lens'), say."
        )
    if not named:
        raise LabelError(f"a criterion without any {name} has nothing to sum over: name one.")
    found: tuple[str, ...] | Mapping[str, float] = named
    return found


def channels_by_poi(plant: StandardPlant) -> dict[str, dict[str, str]]:
    """Return {POI: {axis: z channel}} by the channels' names."""
    found: dict[str, dict[str, str]] = {}
    for name in plant.z:
        poi, _, axis = name.partition(":")
        if axis.rpartition(":")[2] not in ("effort", "error"):
            found.setdefault(poi, {})[axis] = name
    return found


def factors_of(plant: StandardPlant, poi: Named, axes: Named, *, every: bool) -> dict[str, float]:
    """Return {z channel: factor}, the factor of the POI times that of the axis."""
    known = channels_by_poi(plant)
    poi = _alike(plant, known) if poi is None else poi
    found: dict[str, float] = {}
    for name, weight in _axis_factors(poi).items():
        require_known("POI", [name], known)
        own = known[name]
        usual = tuple(own) if every else tuple(own)[:1]
        for axis, factor in _axis_factors(usual if axes is None else axes).items():
            require_known(f"axis of POI {name!r}", [axis], own)
            found[own[axis]] = weight * factor
    return found


def _alike(plant: StandardPlant, known: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return the POIs whose first axis has the unit of the first one's."""
    if not known:
        only_one("POI", known, None, "by name, or all in a list")
    units = {
        name: plant.system.units.get(next(iter(axes.values()))) for name, axes in known.items()
    }
    first = next(iter(units.values()))
    return [name for name, unit in units.items() if unit == first]


def _axis_factors(named: Any) -> dict[str, float]:
    if isinstance(named, Mapping):
        return dict(named)
    return dict.fromkeys((named,) if isinstance(named, str) else named, 1.0)


def unit_of(plant: StandardPlant, factors: Mapping[str, float]) -> str:
    """Return "rad" where only rotations count, each by the factor 1; else "m"."""
    units = {plant.system.units.get(name) for name in factors}
    return "rad" if units == {"rad"} and set(factors.values()) == {1.0} else "m"


def poi_rows(plant: StandardPlant, factors: Mapping[str, float]) -> FloatArray:
    """Return the rows of C of z channels, each times its factor."""
    g = plant.system
    scale = np.array(list(factors.values()))
    return np.asarray(g.C[g.output_index(list(factors))] * scale[:, None])


def structure_part(
    plant: StandardPlant, factors: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, the noise factor and the rows of the POI on all states but delay lines of u."""
    n = _own_states(plant)
    return plant.system.A[:n, :n], plant.noise_factor[:n], poi_rows(plant, factors)[:, :n]


def _own_states(plant: StandardPlant) -> int:
    """Return the number of states that are not delay lines."""
    return plant.continuous.system.n_states


def measured_rows(plant: StandardPlant, candidates: Sequence[Port]) -> FloatArray:
    """Return what sensors see of these states, over the deviation of one sample."""
    whole = with_side(plant, "y", candidates)
    rows = [whole.y.index(port.name) for port in candidates]
    size = np.sqrt(np.diagonal(whole.sensor_noise)[rows])
    return np.asarray(whole.C2[rows, : _own_states(plant)] / size[:, None])


def pushed_columns(plant: StandardPlant, candidates: Sequence[Port]) -> FloatArray:
    """Return what a unit of each actuator, held over one sample, does to these states."""
    if plant.continuous.dt:  # what it was before sampling is not known
        return np.asarray(plant.B2[:, [plant.u.index(port.name) for port in candidates]])
    silent = np.zeros((0, _own_states(plant)))
    return held_exactly(pushed(plant, candidates, silent), 1.0 / plant.dt).B


def pushed(plant: StandardPlant, candidates: Sequence[Port], rows: FloatArray) -> StateSpace:
    """Return the system between actuators and some rows of its states, continuous."""
    g = with_side(plant.continuous, "u", candidates).system
    B = g.B[:, g.input_index([port.name for port in candidates])]
    return StateSpace(g.A, B, rows, np.zeros((len(rows), B.shape[1])), blocks=g.blocks)


def plain(plant: StandardPlant, candidates: Sequence[Port]) -> bool:
    """Return whether candidates change rows of B or C only: they, y and u have no states."""
    # disturbances may have: a shape, the acceleration of the base
    ports, realisation = plant.ports, plant.realisation
    # what is added to a sensor, and noise of an actuator, come and go with it
    apart = all(port.added_to is None for port in ports.w)
    apart = apart and not any(isinstance(c, Actuator) and c.asd > 0 for c in candidates)
    rigidly = not realisation.static_inputs.size
    apart = apart and rigidly and not np.any(plant.D22)
    return apart and all(map(bare, (*ports.u, *ports.y, *candidates)))


def bare(port: Any) -> bool:
    """Return whether a port is without filter and delay."""
    return not any(getattr(port, name, None) for name in ("dynamics", "shape", "latency"))


_LAGS = "The end of a record does not depend on a sample: pass one of these."
Lag: TypeAlias = Predictor | Filter | FixedLag


@dataclass(frozen=True, eq=False, repr=False)
class PoiVariance(Criterion):
    """Variance of the error of the stationary Kalman estimate at POIs, to place sensors.

    A POI is a point of interest, whose motion is estimated. The value is the sum of the terms
    ``f_a^2 C1_a P C1_a'`` over the axes a, or the largest of these terms. f_a is the factor of an
    axis, and C1_a is the row of the output matrix for it. P is the covariance of the error at the
    sample instants, after the measurement was used. For one axis with factor 1, the square root of
    the value is `design_kalman(plant).rms(...)`.

    The value is computed for the plant's own modes, or for the evaluation model with truncated
    modes if the plant has one. With the plant's own modes, additional sensors never increase the
    value, each score takes one Riccati equation, and searches have a lower bound. With truncated
    modes, a filter is computed for each choice, and no lower bound is known.

    Parameters
    ----------
    poi : str, sequence of str or mapping {name: factor}, optional
        Names of the POIs, with factors if they differ. By default it is all POIs whose first axis
        has the same unit as the first axis of the first POI.
    axes : str, sequence of str or mapping {axis: factor}, optional
        Axes of each POI, with factors if they differ; by default its first axis. A factor in m
        turns a rotation into a displacement, for example half the width of the die.
    measure : {"sum", "max"}
        Whether the value is the sum or the largest of the terms.
    lag : Predictor, Filter or FixedLag, optional
        Time at which the estimate is made: before the measurement (Predictor), with the measurement
        (Filter, the default), or some samples later (FixedLag). For Predictor and FixedLag only the
        plant's own modes count.
    own_modes : bool
        Whether to use only the plant's own modes, even if the plant has an evaluation model with
        more modes.

    References
    ----------
    [AndersonMoore1979]_, chapter 4.

    Examples
    --------
    >>> PoiVariance("die", {"z": 1.0, "rx": 0.013})
    PoiVariance(poi=['die'], axes={'z': 1.0, 'rx': 0.013})
    """

    sides = "y"
    poi: Named = field(default=None, metadata=checked(checked_names, name="POI"))
    axes: Named = field(default=None, metadata=checked(checked_names, name="axis"))
    _: KW_ONLY
    measure: str = field(default="sum", metadata=checked(one_of, choices=("sum", "max")))
    lag: Lag | None = field(default=None, metadata=checked(instance, kind=Lag, hint=_LAGS))
    own_modes: bool = field(default=False, metadata=checked(flag))

    def __call__(self, plant: StandardPlant) -> float:
        """Return the variance [m^2] on a sampled plant, by its certified Kalman filter."""
        estimator = design_kalman(plant.replace(evaluation=None) if self._own else plant)
        factors = self._factors(plant)
        if self._lagging:
            terms = _lagged(estimator, poi_rows(plant, factors), self.lag)
        else:
            rms = [estimator.rms(name) for name in factors]
            terms = np.array(list(factors.values())) ** 2 * np.square(rms)
        return float(np.sum(terms) if self.measure == "sum" else np.max(terms))

    def unit(self, plant: StandardPlant) -> str:
        """Return the unit of the square root of the value."""
        return unit_of(plant, self._factors(plant))

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Raise AssumptionError if the plant or a candidate allows no stationary filter."""
        self._factors(plant)
        _ = plant.noise_factor
        plant.check().require(("excited",), "a stationary Kalman filter")
        noise = plant.sensor_noise.diagonal()
        sizes = {name: noise[i] for i, name in enumerate(plant.y)}
        # for matrices from elsewhere, sensors are rows and carry their own noise level
        if plant.model is not None:
            sizes |= {p.name: p.asd for p in candidates if hasattr(p, "asd")}
        require_noise({sensor.name: sizes[sensor.name] for sensor in candidates})
        if plant.model is not None:
            _check_direct(plant, candidates)

    def compared(self, plant: StandardPlant, other: StandardPlant) -> str:
        """Return a text: an interval of the rms error divided by that of another plant.

        The ratio is computed for each machine that agrees with the measurement, as for the
        attribute `interval` of `Placement`.
        """
        machines = plant.machine.machines
        if machines is None or self._own:
            return ""

        def variances(one: StandardPlant) -> FloatArray:
            factors = self._factors(one)
            rows = [poi_channels(one).index(name) for name in factors]
            errors = design_kalman(one).on_machines[:, rows]
            terms = (errors * np.array(list(factors.values()))) ** 2
            return np.asarray(np.sum(terms, axis=1) if self.measure == "sum" else terms.max(axis=1))

        return interval(
            machines, lambda: np.sqrt(variances(plant) / variances(other)), INTERVAL, ""
        ).sentence

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the variance as a function of the chosen sensors.

        All terms that do not depend on the choice are computed once. Delay lines of u are left out,
        because their states are known exactly. A separate filter is computed for each choice in two
        cases: if ports have filters or delays, and with truncated modes, because these make the
        noise of the chosen sensors correlated. The variance of a prediction is ``C1 (A P A' + Q)
        C1'``, with the covariance P after the measurement and that of the process noise, Q. For a
        fixed lag, the motions of the POI some samples ago are additional states.
        """
        chosen = OnPlant(plant, "y", tuple(candidates), self)
        judge = None if self._own else chosen.whole.evaluation_plant
        if judge is not None:
            return OnBoth(chosen, judge)
        read, system = sensors(chosen.whole), chosen.whole.system  # a reference is not a sensor
        at_once = [name for name in chosen.whole.w if name.removesuffix(":noise") not in read]
        if not plain(plant, candidates) or np.any(system.select(read, at_once).D):
            return chosen
        A, noise, rows = structure_part(plant, self._factors(plant))
        items = measured_rows(plant, candidates)
        constants = np.zeros(len(rows))
        if isinstance(self.lag, Predictor):
            constants, rows = np.sum((rows @ noise) ** 2, axis=1), rows @ A
        if isinstance(self.lag, FixedLag):
            A, noise, rows, items = _with_past(A, noise, rows, items, self.lag.samples)
        if self.measure == "sum":
            return quadratic(A.T, noise @ noise.T, rows, items, constant=float(constants.sum()))
        return WorstRow(quadratic(A.T, noise @ noise.T, rows, items), constants)

    @property
    def _lagging(self) -> bool:
        return not isinstance(self.lag, Filter | None)

    @property
    def _own(self) -> bool:
        return self.own_modes or self._lagging

    def _factors(self, plant: StandardPlant) -> Mapping[str, float]:
        return factors_of(plant, self.poi, self.axes, every=False)


def _with_past(
    A: FloatArray, noise: FloatArray, rows: FloatArray, items: FloatArray, lag: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a plant whose last states are its motions ``rows x`` some samples ago."""
    n, q = A.shape[0], rows.shape[0]
    past = np.eye(n + q * lag, k=-q)
    past[: n + q] = 0.0
    past[: n + q, :n] = np.vstack([A, rows])
    last = np.eye(q, n + q * lag, k=n + q * (lag - 1))
    more = ((0, 0), (0, q * lag))
    return past, np.pad(noise, more[::-1]), last, np.pad(items, more)


def _lagged(estimator: KalmanEstimator, rows: FloatArray, lag: Any) -> FloatArray:
    """Return the variances of ``rows x`` before the measurement, or some samples after it."""
    # `P_k|k+L = P - sum_{i=0..L} W_i' S^-1 W_i` with `W_i = C M^i P` and M of the predictor
    # ([AndersonMoore1979]_, chapter 7)
    model, P = estimator.model, estimator.predicted_covariance
    found = np.einsum("ij,jk,ik->i", rows, P, rows)
    M = model.A - estimator.predictor_gain @ model.C2
    S, ahead = model.innovation(P), P @ rows.T
    for _ in range(lag.samples + 1 if isinstance(lag, FixedLag) else 0):
        W = model.C2 @ ahead
        found = found - np.einsum("ij,ij->j", W, np.linalg.solve(S, W))
        ahead = M @ ahead
    return np.asarray(found)


def _check_direct(plant: StandardPlant, candidates: Sequence[Any]) -> None:
    """Raise AssumptionError when white noise of a disturbance reaches a sensor at once."""
    ports, realisation = plant.ports, plant.realisation
    # noise that is shaped first does not arrive at once, and samples of held noise are finite
    white = (port for port in ports.forces if port.asd > 0 and port.name not in plant.held)
    loud = [port for port in white if bare(port)]
    push = np.array([port.push(realisation) for port in loud])
    ground = np.array([port.ground for port in loud])
    for sensor in candidates:
        seen = sensor.see(realisation)
        if loud and np.any(direct_effect(realisation.model, seen, sensor.order, push, ground)):
            raise reaches_at_once("a disturbance", sensor.name)
