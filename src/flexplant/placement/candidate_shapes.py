"""Mode shapes where candidates are: what the classical criteria are made of."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..errors import AssumptionError
from ..plant import SensorPort, StandardPlant
from ..values import FloatArray
from .criterion import Criterion, Scorer


@dataclass(frozen=True, eq=False)
class Shapes:
    """Mass-normalised shapes of a plant's modes, rigid-body modes first."""

    phi: FloatArray
    omega: FloatArray
    zeta: FloatArray
    rows: FloatArray
    full: FloatArray
    asd: FloatArray

    @property
    def elastic(self) -> slice:
        """The modes that are no rigid-body modes."""
        return slice(int(np.count_nonzero(self.omega == 0)), None)


def shapes_of(plant: StandardPlant, ports: Sequence[Any]) -> Shapes:
    """Return the shapes at ports of a plant that was assembled from a structure."""
    real = plant.assembled.realisation
    m = real.n_modes
    pairs = real.pairs[:m]
    omega = np.sqrt(np.abs(np.linalg.det(pairs)))
    omega[: real.n_rigid] = 0.0
    zeta = -np.trace(pairs, axis1=1, axis2=2) / 2.0 / np.where(omega > 0, omega, 1.0)
    full = real.inputs[:, 1 : 2 * m : 2]
    rows = [p.row(real) if isinstance(p, SensorPort) else p.push(real) for p in ports]
    stacked = np.array(rows).reshape(len(ports), full.shape[0])
    return Shapes(stacked @ full, omega, zeta, stacked, full, noise_sizes(ports))


def noise_sizes(ports: Sequence[Any]) -> FloatArray:
    """Return the densities (N,) of sensors; 1 of actuators, and of sensors if none has noise."""
    sizes = np.array([p.asd if isinstance(p, SensorPort) else 1.0 for p in ports])
    silent = [port.name for port, size in zip(ports, sizes, strict=True) if not size]
    if 0 < len(silent) < sizes.size:
        raise AssumptionError(
            f"sensors {', '.join(silent[:6])} have no noise (asd 0) beside others that have some: "
            "they would count without limit. Give all of them Sensor(..., asd=), or none."
        )
    return np.where(sizes > 0, sizes, 1.0)


class ByShapes(Criterion):
    """A criterion of mode shapes at the sensors: a new one defines `of`."""

    sides: ClassVar[str] = "y"
    scale: ClassVar[float] = 1.0

    @abstractmethod
    def of(self, plant: StandardPlant, shapes: Shapes) -> Scorer:
        """Return the scores of choices among the ports that the shapes belong to."""

    def __call__(self, plant: StandardPlant) -> float:
        """Return the criterion of the plant's own ports."""
        ports = getattr(plant.assembled.ports, self.sides)
        scorer = self.of(plant, shapes_of(plant, ports))
        return float(scorer.score([tuple(range(len(ports)))])[0])

    def scorer(self, plant: StandardPlant, candidates: Sequence[Any]) -> Scorer:
        """Return the criterion of choices among candidates."""
        return self.of(plant, shapes_of(plant, candidates))
