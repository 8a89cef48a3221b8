"""Motions at places of components that are placed and joined."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import LabelError
from ..labels import DIRECTIONS, DofSet, Interpolation
from ..values import FloatArray
from .pose import Pose

#: rows of one place on two components that differ by less are one motion
_SAME = 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class PlacedShape(Interpolation):
    """The shapes of a component that was turned and shifted.

    Parameters
    ----------
    own : Interpolation
        Of the component where it was made.
    pose : Pose
        Where it stands.
    C : (n, n) sparse array
        Its DOFs in the directions of the machine by those of its own, ``q = C q_own``.

    Examples
    --------
    >>> import flexplant as fx
    >>> bar = {"length": 0.2, "elements": 2, "area": 1e-4, "inertia": 1e-9}
    >>> beam = fx.beam(**bar, density=7800.0, youngs_modulus=2.1e11)
    >>> joint, shift = fx.Joint("left/3:z", "right/1:z"), fx.Pose(shift=(0.2, 0.0, 0.0))
    >>> machine = fx.joined({"left": beam, "right": beam}, joint, placed={"right": shift})
    >>> machine.dofs.interpolation.parts[1].interpolation
    <PlacedShape of <BeamShape 0.2 m, 2 elements>>
    """

    own: Interpolation
    pose: Pose
    C: sp.csc_array

    def __repr__(self) -> str:
        return f"<PlacedShape of {self.own!r}>"

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of all DOFs in the motion `direction` at a point.

        Raises
        ------
        LabelError
            When the point is off the component, or its shapes do not give the motion.
        """
        return np.asarray(self.rows(np.asarray(xyz, dtype=np.float64)[None], direction)[0])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3), as `row` does one by one."""
        places = self.pose.own_points(points)
        found = sum(share * self.own.rows(places, own) for own, share in self._shares(direction))
        return np.asarray((self.C @ np.asarray(found).T).T)

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the row (n,) and the coordinates (3,) of a DOF that follows others, or None.

        Turned, it is a mixture of the directions of its node, which must all be known.
        """
        node, _, direction = label.rpartition(":")
        if direction not in DIRECTIONS:
            return None
        row, place = np.zeros(self.C.shape[1]), np.zeros(3)
        for own, share in self._shares(direction):
            found = self.own.dependent(f"{node}:{own}")
            if found is None:
                return None
            row, place = row + share * found[0], found[1]
        return np.asarray(self.C @ row), self.pose.points(place[None])[0]

    def _shares(self, direction: str) -> list[tuple[str, float]]:
        """Return the own directions in one of the machine, and their shares."""
        first, axis = divmod(DIRECTIONS.index(direction), 3)
        shares = np.asarray(self.pose.rotation)[axis].tolist()
        own = DIRECTIONS[3 * first : 3 * first + 3]
        return [(name, share) for name, share in zip(own, shares, strict=True) if share]


@dataclass(frozen=True, eq=False, repr=False)
class JoinedShape(Interpolation):
    """The shapes of all components of a joined machine.

    Parameters
    ----------
    names : sequence of str
        Of the components.
    parts : sequence of DofSet
        Their DOFs with their shapes, where they are placed.
    expansion : (n_all, n) sparse array, optional
        All DOFs of all components, one after the other, by those that are left. None: all are.
    motions : (n_all, k) array, optional
        All motions of a reduced machine: by these, places of two components move alike or not.

    Examples
    --------
    >>> import flexplant as fx
    >>> bar = {"length": 0.2, "elements": 2, "area": 1e-4, "inertia": 1e-9}
    >>> beam = fx.beam(**bar, density=7800.0, youngs_modulus=2.1e11)
    >>> joint, shift = fx.Joint("left/3:z", "right/1:z"), fx.Pose(shift=(0.2, 0.0, 0.0))
    >>> machine = fx.joined({"left": beam, "right": beam}, joint, placed={"right": shift})
    >>> machine.dofs.interpolation, machine.dofs.nearest((0.4, 0.0, 0.0), "z")
    (<JoinedShape of left, right>, 'right/3:z')
    """

    names: tuple[str, ...]
    parts: tuple[DofSet, ...]
    expansion: sp.csc_array | None = None
    motions: FloatArray | None = None

    def __post_init__(self) -> None:
        self._set(names=tuple(self.names), parts=tuple(self.parts))
        self._set(expansion=self.expansion, motions=self.motions)

    def __repr__(self) -> str:
        return f"<JoinedShape of {', '.join(self.names)}>"

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the DOFs in the motion `direction` at a point.

        Raises
        ------
        LabelError
            When the point is on no component that has this motion, or on several that move
            independently.
        """
        found: dict[str, FloatArray] = {}
        failed: list[str] = []
        for index, (name, part) in enumerate(zip(self.names, self.parts, strict=True)):
            try:
                found[name] = self._expanded(index, part.row(xyz, direction))
            except LabelError as error:
                failed.append(f"{name}: {error}")
        if not found:
            raise LabelError(
                f"the point {tuple(np.asarray(xyz).tolist())} is on no component with the motion "
                f"{direction!r}. {' '.join(failed)}"
            )
        rows = list(found.values())
        seen = rows if self.motions is None else [row @ self.motions for row in rows]
        if any(np.abs(one - seen[0]).max() > _SAME * np.abs(seen[0]).max() for one in seen[1:]):
            one, other = list(found)[:2]
            raise LabelError(
                f"the point {tuple(np.asarray(xyz).tolist())} is on {one!r} and on {other!r}, "
                "which have a motion of their own there. Name a DOF: "
                f"dofs.nearest(point, {direction!r}, component={one!r})."
            )
        return rows[0]

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the row (n,) and the coordinates (3,) of a DOF that follows others, or None."""
        for index, (name, part) in enumerate(zip(self.names, self.parts, strict=True)):
            rest = label.removeprefix(f"{name}/")
            if rest != label and rest in part:
                return self._expanded(index, part.row(rest)), part.xyz[part.index(rest)]
            if rest != label and part.interpolation is not None:
                inner = part.interpolation.dependent(rest)
                if inner is not None:
                    return self._expanded(index, inner[0]), inner[1]
        return None

    def _expanded(self, index: int, row: FloatArray) -> FloatArray:
        sizes = [len(part) for part in self.parts]
        start = sum(sizes[:index])
        if self.expansion is None:
            found = np.zeros(sum(sizes))
            found[start : start + sizes[index]] = row
            return found
        rows = np.flatnonzero(row)
        return np.asarray(row[rows] @ self._by_rows[start + rows])

    @cached_property
    def _by_rows(self) -> Any:
        expansion: Any = self.expansion
        return sp.csr_array(expansion)
