"""The part of candidates in the rigid-body modes: what every choice must see or move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..plant import Actuator, SensorPort, StandardPlant
from ..values import FloatArray
from .candidates import Port, side_of

#: a rigid-body motion weaker than this beside the strongest counts as absent (as in plant.check)
WEAK = 1e-8


@dataclass(frozen=True, eq=False)
class RigidPart:
    """Rows (N, r) of candidates in rigid-body modes, of unit size or zero.

    Sensors see positions and actuators move velocities. Where both are chosen, columns of their
    own keep them apart: as many for the sensors as for the actuators.
    """

    rows: FloatArray

    @classmethod
    def of(cls, plant: StandardPlant, side: str, candidates: Sequence[Port]) -> RigidPart:
        """Return the part of candidates on a plant; of one made elsewhere nothing is known."""
        if not plant.is_assembled:
            return cls(np.zeros((len(candidates), 0)))
        realisation = plant.assembled.realisation
        r = realisation.n_rigid
        parts = np.zeros((len(candidates), len(side), r))
        for part, port in zip(parts, candidates, strict=True):
            own = part[side.index(side_of(port))]
            if isinstance(port, SensorPort):
                own[:] = port.see(realisation).row[0 : 2 * r : 2]
            elif isinstance(port, Actuator):
                own[:] = realisation.force(port.push(realisation))[1 : 2 * r : 2]
        rows = parts.reshape(len(candidates), -1)
        sizes = np.linalg.norm(rows, axis=1, keepdims=True)
        return cls(rows / np.where(sizes > 0, sizes, 1.0))

    def missing(self, chosen: Sequence[int]) -> int:
        """Return how many rigid-body modes a choice has no part in: ranks decide."""
        return int(self.all_missing([chosen])[0])

    def all_missing(self, sets: Sequence[Sequence[int]]) -> npt.NDArray[np.int64]:
        """Return how many rigid-body modes each of some choices (m,) has no part in."""
        wanted = self.rows.shape[1]
        found = np.full(len(sets), wanted)
        if not wanted:
            return found
        sizes = np.fromiter(map(len, sets), dtype=np.int64, count=len(sets))
        for size in np.unique(sizes[sizes > 0]).tolist():
            which = np.flatnonzero(sizes == size)
            parts = self.rows[np.array([list(sets[i]) for i in which.tolist()])]
            values = np.linalg.svd(parts, compute_uv=False)
            strong = (values > WEAK * values[:, :1]) & (values > 0)
            found[which] -= np.count_nonzero(strong, axis=1)
        return found
