"""How points of interest see a state, fixed or moving from sample to sample."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..values import FloatArray, IntArray


class Sight(NamedTuple):
    """How the POIs see the state and the noise: ``z = C1 x + n + D1 u``, rows c = [C1 N].

    The first axis has one entry, or one for each sample where POIs move.
    """

    c: FloatArray  # (1 or N, nz, n + ny)
    D1: FloatArray  # (1 or N, nz, nu)
    V: FloatArray  # (1 or N, nz) variances of n

    def part(self, at: slice | IntArray) -> Sight:
        """Return the rows at some samples."""
        return self if self.c.shape[0] == 1 else Sight(*(part[at] for part in self))

    def applied(self, watched: FloatArray) -> FloatArray:
        """Return ``c watched`` (k, nz) for watched [x; b] (k, n + ny)."""
        if self.c.shape[0] == 1:
            return np.asarray(watched @ self.c[0].T)
        return np.asarray(np.einsum("kzi,ki->kz", self.c, watched))

    def commanded(self, u: FloatArray) -> FloatArray:
        """Return ``D1 u`` (k, nz)."""
        if self.c.shape[0] == 1:
            return np.asarray(u @ self.D1[0].T)
        return np.asarray(np.einsum("kzi,ki->kz", self.D1, u))
