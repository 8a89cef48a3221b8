"""What a layout of sensors or actuators is judged by: values that map a plant to a number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from ..errors import (
    AssumptionError,
    CertificateError,
    LabelError,
    ModelError,
    SolverError,
    unknown_label,
)
from ..estimation import design_kalman
from ..lti.discretisation import discretized
from ..lti.lyapunov import solve_stein
from ..lti.riccati import control_dare
from ..lti.statespace import StateSpace
from ..plant import Disturbance, Poi, StandardPlant
from ..plant.ports import QUANTITIES
from ..values import FloatArray, Value, positive
from .quadratic import Quadratic, quadratic

#: axes of a POI that count, each once or by a factor
Axes: TypeAlias = "str | Sequence[str] | Mapping[str, float] | None"


@dataclass(frozen=True, eq=False, repr=False)
class PoiVariance(Value):
    """Variance of the stationary Kalman estimate's error at a POI: for sensors, smaller is better.

    ``sum_a (f_a^2 C1_a P C1_a')`` over the axes a, P after the measurement, at sample instants: the
    square of `design_kalman(plant).rms(...)`. More sensors never make it larger.

    Parameters
    ----------
    poi : str, optional
        The POI's name; not needed when the plant has one only.
    axes : str, sequence of str or mapping {axis: factor}, optional
        The POI's axes to sum over; its first when not given. A rotation is turned into a
        displacement by a factor [m], such as half the width of the die.

    Raises
    ------
    LabelError
        When an axis appears twice; when called, for a POI or an axis that the plant lacks.
    ModelError
        When a factor is not positive.

    Examples
    --------
    >>> PoiVariance("die", {"z": 1.0, "rx": 0.013})
    PoiVariance('die', axes={'z': 1.0, 'rx': 0.013})
    """

    poi: str | None = None
    axes: Axes = field(default=None)

    def __post_init__(self) -> None:
        self._set(axes=_axes(self.axes))

    def __repr__(self) -> str:
        return f"PoiVariance({_shown(self.poi, self.axes)})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return the variance [m^2] on a sampled plant, by its certified Kalman filter.

        Raises
        ------
        AssumptionError
            When no stationary filter exists: the message names what the sensors miss.
        """
        estimator = design_kalman(plant)
        factors = _factors(plant, self.poi, self.axes, every=False)
        return float(sum((f * estimator.rms(name)) ** 2 for name, f in factors.items()))

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Raise AssumptionError for what no choice of sensors can repair.

        Parameters
        ----------
        plant : StandardPlant
            Sampled.
        candidates : sequence of Sensor
            Each needs noise of its own and no direct noise of a disturbance.

        Raises
        ------
        AssumptionError
            When w misses a rigid-body mode, or a candidate fits no sampled filter.
        """
        _factors(plant, self.poi, self.axes, every=False)
        plant.check().require(("excited",), "a stationary Kalman filter")
        realisation = plant.realisation
        silent = [sensor.name for sensor in candidates if sensor.asd <= 0]
        if silent:
            raise AssumptionError(
                f"sensors {', '.join(silent[:6])} have no noise (asd 0): the filter would trust "
                "them without limit. Give Sensor(..., asd=) what the data sheet says."
            )
        if realisation is None or plant.ports is None:
            raise ModelError("the plant has no structure.")
        # noise that is shaped first does not arrive at once
        loud = [d for d in plant.ports.w if isinstance(d, Disturbance) and d.asd > 0 and _bare(d)]
        B = [realisation.force(realisation.row(d.at, d.direction)) for d in loud]
        for sensor in candidates:
            row = realisation.row(sensor.at, sensor.direction)
            if sensor.quantity == "acceleration" and np.any(np.dot(B, realisation.motion(row, 1))):
                raise AssumptionError(
                    f"white noise of a disturbance reaches {sensor.name!r} (an acceleration) at "
                    "once, so a sample of it would have infinite variance. Measure displacement "
                    "or velocity, or shape the disturbance."
                )

    def prepared(self, plant: StandardPlant, candidates: Sequence[Any]) -> Quadratic:
        """Return the variance as a function of the sensors alone; all else is computed once.

        Delay lines of u are left out: the filter knows their states exactly.

        Parameters
        ----------
        plant : StandardPlant
            Sampled.
        candidates : sequence of Sensor
            All that may be chosen.
        """
        A, noise, rows = _moving(plant, _factors(plant, self.poi, self.axes, every=False))
        realisation = plant.realisation
        if realisation is None:
            raise ModelError("the plant has no structure.")
        items = np.zeros((len(candidates), A.shape[0]))
        for i, sensor in enumerate(candidates):
            row = realisation.row(sensor.at, sensor.direction)
            seen = realisation.motion(row, QUANTITIES.index(sensor.quantity))
            items[i] = seen / np.sqrt(0.5 * sensor.asd**2 / plant.dt)
        return quadratic(A.T, noise @ noise.T, rows, items)


@dataclass(frozen=True, eq=False, repr=False)
class PoiLqr(Value):
    """Least mean square of a POI's motion and the effort it takes: for actuators.

    ``min E[sum_a (f_a z_a)^2 + effort^2 |u|^2]`` over all stabilising controllers that know the
    state, with the plant's disturbances and its delay of u. More actuators never make it larger.

    Parameters
    ----------
    poi : str, optional
        The POI's name; not needed when the plant has one only.
    axes : str, sequence of str or mapping {axis: factor}, optional
        The POI's axes to sum over; all of them when not given, a rotation with the factor 1 m.
        Together they must see every rigid-body mode.
    effort : float [m/N]
        The motion of the POI that one newton of one actuator is worth. Small: the disturbance is
        rejected as well as the structure and the delay allow.

    Raises
    ------
    LabelError
        When an axis appears twice; when called, for a POI or an axis that the plant lacks.
    ModelError
        When a factor or the effort is not positive.
    """

    poi: str | None = None
    axes: Axes = field(default=None)
    effort: float = field(default=1e-9, kw_only=True)

    def __post_init__(self) -> None:
        self._set(axes=_axes(self.axes), effort=positive(self.effort, "effort"))

    def __repr__(self) -> str:
        shown = _shown(self.poi, self.axes)
        return f"PoiLqr({shown}{', ' if shown else ''}effort={self.effort:g})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return the cost [m^2] on a sampled plant.

        The cost to go by a Riccati equation, checked against the stationary covariance of the
        closed loop of its gain.

        Raises
        ------
        AssumptionError
            When u does not reach, w does not excite or the axes do not see a rigid-body mode.
        CertificateError
            When the two costs differ.
        """
        self.check(plant, ())
        plant.check().require(("stabilisable",), "a stationary controller")
        factors = _factors(plant, self.poi, self.axes, every=True)
        A, B = plant.system.A, plant.B2
        rows = _rows(plant, factors)
        R = self.effort**2 * np.eye(B.shape[1])
        solution = control_dare(A, B, Q=rows.T @ rows, R=R)
        noise = plant.process_noise
        cost = float(np.sum(solution.P * noise))
        P = solve_stein(A - B @ solution.gain, noise)
        seen = np.vstack([rows, self.effort * solution.gain])
        found = float(np.einsum("ij,jk,ik->", seen, P, seen))
        if not abs(found - cost) <= 1e-6 * abs(cost):
            raise CertificateError(
                f"the gain costs {found:.9g}, its Riccati equation says {cost:.9g}: the problem is "
                "too badly conditioned. Give a larger effort."
            )
        return cost

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Raise AssumptionError for what no choice of actuators can repair.

        Parameters
        ----------
        plant : StandardPlant
            Sampled.
        candidates : sequence of Actuator
            Not looked at: any will do.

        Raises
        ------
        AssumptionError
            When w does not excite or the axes do not see a rigid-body mode.
        """
        factors = _factors(plant, self.poi, self.axes, every=True)
        plant.check().require(("excited",), "a stationary controller")
        if plant.ports is None:
            raise ModelError("the plant has no ports.")
        poi = _poi(plant, self.poi)
        axes = tuple(axis for axis in poi.axes if poi.channel(axis) in factors)
        seen = plant.ports.replace(z=[poi.replace(axes=axes)], references=())
        plant.with_ports(seen).check().require(("performance",), f"a controller for {self!r}")

    def prepared(self, plant: StandardPlant, candidates: Sequence[Any]) -> Quadratic:
        """Return the cost as a function of the actuators alone; all else is computed once.

        A delay of d whole samples leaves what happens meanwhile to no controller: it is a constant,
        ``sum_{i<d} |C1 A^i W|^2``, and the rest acts on the state predicted d samples ahead. Only a
        fraction of a sample adds a state per actuator.

        Parameters
        ----------
        plant : StandardPlant
            Sampled.
        candidates : sequence of Actuator
            All that may be chosen.
        """
        A, noise, rows = _moving(plant, _factors(plant, self.poi, self.axes, every=True))
        realisation = plant.realisation
        if realisation is None:
            raise ModelError("the plant has no structure.")
        n, count = A.shape[0], len(candidates)
        whole, fraction = divmod(plant.delay, 1.0)
        constant = 0.0
        for _ in range(int(whole)):
            constant += float(np.sum((rows @ noise) ** 2))
            noise = A @ noise
        constant += float(np.sum((rows @ noise) ** 2))
        B = [realisation.force(realisation.row(c.at, c.direction)) for c in candidates]
        late = discretized(
            StateSpace(
                realisation.A,
                np.array(B).T,
                rows,
                np.zeros((rows.shape[0], count)),
                blocks=[2] * (n // 2),
            ),
            1.0 / plant.dt,
            delay=fraction,
        )
        held = n + np.arange(late.n_states - n).reshape(count, -1)
        S = np.zeros((noise.shape[1], late.n_states))
        S[:, :n] = noise.T
        try:
            return quadratic(
                late.A,
                late.C.T @ late.C,
                S @ late.A.T,
                late.B.T / self.effort,
                constant=constant,
                owned=held,
            )
        except SolverError as error:
            raise SolverError(
                f"{error} The effort of {self.effort:g} m/N may be too small to tell gains apart: "
                "try a larger one."
            ) from error


def plain(plant: StandardPlant, candidates: Sequence[Any]) -> bool:
    """Tell whether candidates change rows of B or C only: no port has a filter or delay of its own.

    Parameters
    ----------
    plant : StandardPlant
        With ports.
    candidates : sequence of Sensor or Actuator
        All that may be chosen.
    """
    ports, realisation = plant.ports, plant.realisation
    if ports is None or realisation is None:
        return False
    forces = all(isinstance(port, Disturbance) for port in ports.w)
    rigidly = getattr(realisation, "static_inputs", None) is None
    return forces and rigidly and all(map(_bare, (*ports.w, *ports.u, *ports.y, *candidates)))


def _bare(port: Any) -> bool:
    """Tell whether a port is without filter and delay."""
    return not any(getattr(port, name, None) for name in ("dynamics", "shape", "delay"))


def _axes(axes: Axes) -> tuple[str, ...] | Mapping[str, float] | None:
    if axes is None:
        return None
    if isinstance(axes, Mapping):
        named = {str(a): positive(f, f"factor of axis {a!r}") for a, f in axes.items()}
    else:
        listed = (axes,) if isinstance(axes, str) else tuple(str(a) for a in axes)
        if len(set(listed)) != len(listed):
            raise LabelError(f"axes {listed} hold one twice: name each once, with a factor.")
        named = dict.fromkeys(listed, 1.0)
    if not named:
        raise LabelError("a criterion without axes has nothing to sum over: name one.")
    return named if isinstance(axes, Mapping) else tuple(named)


def _shown(poi: str | None, axes: Axes) -> str:
    parts = [] if poi is None else [repr(poi)]
    if axes is not None:
        parts.append(f"axes={dict(axes) if isinstance(axes, Mapping) else axes!r}")
    return ", ".join(parts)


def _poi(plant: StandardPlant, name: str | None) -> Poi:
    ports = plant.ports
    if ports is None:
        raise ModelError(
            "the criterion looks its POI up in the plant's ports, this plant has none. Make it by "
            "assemble_plant(model, ports), or pass a callable of your own."
        )
    if name is not None:
        return ports.poi(name)
    if len(ports.z) != 1:
        raise LabelError(
            f"the plant has {len(ports.z)} POIs ({', '.join(p.name for p in ports.z)}): say which "
            f"one counts, such as PoiVariance({ports.z[0].name!r})."
        )
    return ports.z[0]


def _factors(
    plant: StandardPlant, name: str | None, axes: Axes, *, every: bool
) -> dict[str, float]:
    """Return {z channel: factor}."""
    poi = _poi(plant, name)
    if axes is None:
        axes = poi.axes if every else poi.axes[:1]
    named = dict(axes) if isinstance(axes, Mapping) else dict.fromkeys(axes, 1.0)
    for axis in named:
        if axis not in poi.axes:
            raise unknown_label(f"axis of POI {poi.name!r}", axis, poi.axes)
    return {poi.channel(axis): factor for axis, factor in named.items()}


def _rows(plant: StandardPlant, factors: Mapping[str, float]) -> FloatArray:
    g = plant.system
    scale = np.array(list(factors.values()))
    return np.asarray(g.C[g.output_index(list(factors))] * scale[:, None])


def _moving(
    plant: StandardPlant, factors: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, the noise factor and the rows of the POI on the structure's own states."""
    if plant.realisation is None or plant.noise_factor is None:
        raise ModelError("the plant has no structure, or is not sampled.")
    n = plant.realisation.outputs.shape[1]
    return plant.system.A[:n, :n], plant.noise_factor[:n], _rows(plant, factors)[:, :n]
