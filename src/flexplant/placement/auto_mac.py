"""Whether sensors distinguish the mode shapes: the largest cosine between two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..plant import StandardPlant
from ..values import FloatArray
from .candidate_shapes import ByShapes, Shapes
from .criterion import Scorer
from .summed import by_size


@dataclass(frozen=True, eq=False)
class LargestMac(Scorer):
    """The largest off-diagonal MAC of shapes (N, m) at the chosen rows."""

    phi: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice."""
        return float(self.score([tuple(chosen)])[0])

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return it for choices of one size at once."""
        return by_size(sets, self._largest)

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return 0: no shapes are less alike than orthogonal ones."""
        return 0.0

    def _largest(self, rows: FloatArray) -> FloatArray:
        part = self.phi[rows]
        cross = np.einsum("mki,mkj->mij", part, part)
        sizes = np.einsum("mii->mi", cross)
        scale = sizes[:, :, None] * sizes[:, None, :]
        # a mode that none of the sensors sees is like every other
        mac = np.where(scale > 0, cross**2 / np.where(scale > 0, scale, 1.0), 1.0)
        i = np.arange(mac.shape[1])
        mac[:, i, i] = 0.0
        return np.asarray(mac.max(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class AutoMac(ByShapes):
    """Largest off-diagonal entry of the MAC between the elastic mode shapes at the sensors.

    ``(phi_i' phi_j)^2 / (phi_i' phi_i phi_j' phi_j)``, 0 where all shapes differ, 1 where two look
    alike. It does not count how large the motions are that the sensors see, and of a POI it says
    next to nothing, as `ModeInformation`.

    References
    ----------
    [Allemang2003]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.AutoMac()).chosen
    ('s1', 's3')
    """

    def of(self, plant: StandardPlant, shapes: Shapes) -> LargestMac:
        """Return the largest entry of choices."""
        return LargestMac(shapes.phi[:, shapes.elastic])
