"""What a model in a few shapes of a structure can say of its places and of rigid-body motion."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy.linalg as la

from ..labels import DofSet, Place
from ..structure.placed import missed
from ..structure.rigid import rigid_motions
from ..values import ComplexArray, FloatArray, real_array


class Spanned:
    """A model whose k coordinates are amounts of shapes of n DOFs: ``q_n = T q_k``.

    The counterpart of `Placed`, whose coordinates are the displacements themselves.
    """

    M: FloatArray
    T: FloatArray
    dofs: DofSet
    full_dofs: DofSet

    @property
    def n_dof(self) -> int:
        """Number of coordinates k."""
        return int(self.M.shape[0])

    @property
    def is_physical(self) -> bool:
        """Whether all coordinates are DOFs of the structure."""
        return len(self.dofs) == self.n_dof

    def expand(self, q: FloatArray | ComplexArray) -> FloatArray | ComplexArray:
        """Return the motion ``T q`` of all n DOFs, of motions (k,) or (k, m) of the coordinates.

        Shapes may be complex.

        Raises
        ------
        ShapeError
            When there are not k rows.
        """
        if np.iscomplexobj(q):
            parts = np.asarray(q)
            return np.asarray(self.expand(parts.real) + 1j * self.expand(parts.imag))
        shape = (self.n_dof,) if np.ndim(q) == 1 else (self.n_dof, None)
        return np.asarray(self.T @ real_array(q, "q", shape))

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (k,) that gives the motion at a place of the full structure.

        Its transpose is the reduced load f* of a unit force there.

        Parameters
        ----------
        at : str, (3,) array [m] or mapping
            A DOF label, a point, or {label: weight}: any of the full structure, not only of the
            desired DOFs.
        direction : str
            The motion at a point.

        Raises
        ------
        LabelError
            When the place is unknown.
        """
        return np.asarray(self.full_dofs.row(at, direction) @ self.T)

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, k) of the motion at many points (p, 3) [m]; see `row`."""
        return np.asarray(self.full_dofs.rows(points, direction) @ self.T)

    def inertia(self, motions: FloatArray) -> FloatArray:
        """Return the loads (k, r) ``M* motions`` of motions (k, r)."""
        return np.asarray(self.M @ motions)

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the relative parts (6,) of the rigid-body motions that T cannot make."""
        wanted = rigid_motions(self.full_dofs, list(about))
        return missed(self.T @ self.rigid_motions(about), wanted)

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the coordinates (k, 6) nearest to the six rigid-body motions of the geometry.

        Parameters
        ----------
        about : (3,) array [m]
            The point that rotations turn about.

        Raises
        ------
        ShapeError
            When `about` is no point.
        """
        centre = real_array(list(about), "about", (3,))
        if self.is_physical:
            return rigid_motions(self.dofs, centre)
        return np.asarray(la.lstsq(self.T, rigid_motions(self.full_dofs, centre))[0])
