"""What every model of a structure can say of places and of rigid-body motion."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from ..checks import FloatArray, real_array
from ..labels import DofSet, Place
from ..tolerances import divisor
from .rigid import rigid_motions

#: relative: a rigid-body motion that the shapes of a model make up to this is one of theirs. Those
#: of the lowest modes on springs lack the springs' stiffness over that of the modes left out, 1e-5
#: for a suspension at 10 Hz below elastic modes at 1 kHz; held structures lack a tenth and more
SPANNED = 1e-3


class Structure(Protocol):
    """A model with k coordinates, as a plant needs it: FEModel, Modes and ReducedModel are such."""

    @property
    def full_dofs(self) -> DofSet:
        """The n DOFs of the structure, with their coordinates."""

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (k,) that gives the motion at a place."""

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, k) of the motion at many points."""

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the coordinates (k, 6) of the six rigid-body motions."""

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the relative parts (6,) of these motions that the coordinates cannot make."""

    def inertia(self, motions: FloatArray) -> FloatArray:
        """Return the loads (k, r) ``M motions``."""


class Placed:
    """A model whose coordinates are the displacements of its DOFs."""

    dofs: DofSet

    @property
    def full_dofs(self) -> DofSet:
        """The DOFs, with their coordinates."""
        return self.dofs

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (n,) that gives the motion at a place; see `DofSet.row`."""
        return self.dofs.row(at, direction)

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, n) of the motion at many points; see `DofSet.rows`."""
        return self.dofs.rows(points, direction)

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the six rigid-body motions (n, 6), rotations about a point [m]."""
        centre = real_array(about, "about", (3,))
        return rigid_motions(self.dofs, centre)


def relative_miss(made: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return how far motions (n, r) that a model makes are from those wanted, relative to these."""
    size = np.linalg.norm(wanted, axis=0)
    return np.asarray(np.linalg.norm(made - wanted, axis=0) / divisor(size))
