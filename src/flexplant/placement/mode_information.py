"""The information that sensors have of the modes' amplitudes: what effective independence is of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..plant import StandardPlant
from ..values import FloatArray, flag
from .candidate_shapes import ByShapes, Shapes
from .summed import SummedMatrices


@dataclass(frozen=True, eq=False)
class ModeRows(SummedMatrices):
    """Minus log det of the information, and the rows that it is made of."""

    rows: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    driving_point: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class ModeInformation(ByShapes):
    """Minus log det of the Fisher information of mode amplitudes, ``sum_i phi_i phi_i' / asd_i^2``.

    One snapshot of the sensors, no dynamics, no disturbances: choices that distinguish the shapes
    best. `ByRows` searches for it by effective independence or pivoted QR, and it has a bound.
    Fewer sensors than modes have none. It says next to nothing of a POI: rankings of layouts by
    classical criteria (this one, Gramians, indices, energy, MAC) had a Spearman correlation of
    -0.45 to 0.56 with that by the exact variance, on plates. Where the POI matters, use
    `PoiVariance`.

    Parameters
    ----------
    elastic : bool
        Whether rigid-body modes are left out.

    Raises
    ------
    ModelError
        When elastic is neither True nor False; when called, for a plant made elsewhere.

    References
    ----------
    [Kammer1991]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.ModeInformation(elastic=True)).chosen
    ('s1', 's3')
    """

    sides: ClassVar[str] = "y"
    elastic: bool = False

    def __post_init__(self) -> None:
        self._set(elastic=flag(self.elastic, "elastic"))

    def of(self, plant: StandardPlant, shapes: Shapes) -> ModeRows:
        """Return the information of choices."""
        kept = shapes.elastic if self.elastic else slice(None)
        # units in which the best of the sensors has noise 1: constants do not decide
        rows = shapes.phi[:, kept] * (1e-12 / shapes.asd)[:, None]
        bending = shapes.elastic
        point = np.sum((shapes.phi[:, bending] / shapes.omega[bending]) ** 2, axis=1)
        return ModeRows(rows[:, :, None] * rows[:, None, :], "log det", rows, point)
