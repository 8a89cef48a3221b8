"""The variance of a POI's estimate: where sensors go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import AssumptionError, ModelError
from ..estimation import design_kalman
from ..modes import Modes
from ..plant import StandardPlant, larger_plant
from ..plant.ground import followed
from ..reduction import ReducedModel
from ..structure import FEModel
from ..values import flag, short
from .criterion import Criterion, Scorer
from .poi_axes import Axes, bare, checked_axes, factors_of, plain, shown, structure_part
from .quadratic import quadratic


@dataclass(frozen=True, eq=False, repr=False)
class PoiVariance(Criterion):
    """Variance of the stationary Kalman estimate's error at a POI: for sensors, smaller is better.

    ``sum_a (f_a^2 C1_a P C1_a')`` over the axes a, P after the measurement, at sample instants: the
    square of `design_kalman(plant).rms(...)`. Of the plant's own modes more sensors never make it
    larger, a score is one Riccati equation, and searches have a bound. With modes left out it is
    the error on the plant with these modes: each choice is a filter of its own, without a bound.

    Parameters
    ----------
    poi : str, optional
        The POI's name; not needed when the plant has one only.
    axes : str, sequence of str or mapping {axis: factor}, optional
        The POI's axes to sum over; its first when not given. A rotation is turned into a
        displacement by a factor [m], such as half the width of the die.
    larger : Modes, FEModel or ReducedModel, optional
        The structure with the modes left out, as for `design_kalman`: best as Modes, which are
        solved once. None: the modes of the plant's reduced model beyond those it kept, if it has
        any.
    own_modes : bool
        Whether modes left out do not count, whatever the reduced model has kept of them.

    Raises
    ------
    LabelError
        When an axis appears twice; when called, for a POI or an axis that the plant lacks.
    ModelError
        When a factor is not positive, larger is no structure, or is given with own_modes.

    Examples
    --------
    >>> PoiVariance("die", {"z": 1.0, "rx": 0.013})
    PoiVariance('die', axes={'z': 1.0, 'rx': 0.013})
    """

    sides = "y"
    poi: str | None = None
    axes: Axes = field(default=None)
    larger: Any = field(default=None, kw_only=True)
    own_modes: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        self._set(axes=checked_axes(self.axes), own_modes=flag(self.own_modes, "own_modes"))
        if self.larger is not None and self.own_modes:
            raise ModelError("larger= gives modes left out, own_modes=True leaves them: pass one.")
        if not isinstance(self.larger, FEModel | Modes | ReducedModel | None):
            raise ModelError(
                f"larger must be a structure, got {short(self.larger)}: every choice of sensors "
                "gets a plant of its own. Pass Modes, an FEModel or a ReducedModel."
            )

    def __repr__(self) -> str:
        given = [shown(self.poi, self.axes)] if shown(self.poi, self.axes) else []
        given += ["larger=..."] if self.larger is not None else []
        given += ["own_modes=True"] if self.own_modes else []
        return f"PoiVariance({', '.join(given)})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return the variance [m^2] on a sampled plant, by its certified Kalman filter.

        Raises
        ------
        AssumptionError
            When no stationary filter exists: the message names what the sensors miss.
        """
        estimator = design_kalman(plant, larger=plant if self.own_modes else self.larger)
        factors = factors_of(plant, self.poi, self.axes, every=False)
        return float(sum((f * estimator.rms(name)) ** 2 for name, f in factors.items()))

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Raise AssumptionError when w misses a rigid-body mode or a candidate fits no filter."""
        factors_of(plant, self.poi, self.axes, every=False)
        plant.check().require(("excited",), "a stationary Kalman filter")
        ports, realisation = plant.assembled.ports, plant.assembled.realisation
        silent = [sensor.name for sensor in candidates if sensor.asd <= 0]
        if silent:
            raise AssumptionError(
                f"sensors {', '.join(silent[:6])} have no noise (asd 0): the filter would trust "
                "them without limit. Give Sensor(..., asd=) what the data sheet says."
            )
        # noise that is shaped first does not arrive at once
        loud = [port for port in ports.forces if port.asd > 0 and bare(port)]
        push = np.array([port.push(realisation) for port in loud])
        ground = np.array([port.ground for port in loud])
        for sensor in candidates:
            if loud and np.any(followed(sensor.see(realisation), sensor.order, push, ground)):
                raise AssumptionError(
                    f"white noise of a disturbance reaches {sensor.name!r} at once "
                    "(an acceleration, say), so a sample of it would have infinite variance. "
                    "Measure displacement or velocity, or shape the disturbance."
                )

    def scorer(self, plant: StandardPlant, candidates: Sequence[Any]) -> Scorer:
        """Return the variance as a function of the sensors alone; all else is computed once.

        Delay lines of u are left out: their states are known exactly. Where ports have
        filters or delays every choice has states of its own, and with modes left out the noise of
        its sensors is correlated: the plant is made anew.
        """
        counted = not self.own_modes and larger_plant(plant, self.larger) is not None
        if counted or not plain(plant, candidates):
            return super().scorer(plant, candidates)
        A, noise, rows = structure_part(plant, factors_of(plant, self.poi, self.axes, every=False))
        realisation = plant.assembled.realisation
        items = np.zeros((len(candidates), A.shape[0]))
        for i, sensor in enumerate(candidates):
            items[i] = sensor.see(realisation).row / np.sqrt(0.5 * sensor.asd**2 / plant.dt)
        return quadratic(A.T, noise @ noise.T, rows, items)
