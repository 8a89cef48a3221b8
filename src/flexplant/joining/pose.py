"""Where a component stands in the machine: turned, then shifted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..errors import ModelError
from ..labels import DIRECTIONS, DofSet
from ..values import FloatArray, IntArray, Value, real_array

#: entries of a rotation below this are zero: cos(pi/2) is 6e-17
_ZERO = 1e-14
#: how far a rotation matrix may be from orthogonal
_ORTHOGONAL = 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Value):
    """Where a component stands: its point p comes to ``R p + shift``.

    Parameters
    ----------
    shift : (3,) array [m]
        Where its origin comes to.
    rotation : (3,) array [rad] or (3, 3) array
        A turn about this axis by its length, about the origin of the component; or R itself.

    Raises
    ------
    ShapeError, ModelError
        When R is no rotation: not orthogonal, or a mirror image; or a turn is beyond 2 pi.

    Examples
    --------
    >>> pose = Pose(shift=(1.0, 0.0, 0.0), rotation=(0.0, 0.0, np.pi / 2))
    >>> pose.points([[0.5, 0.0, 0.0]])
    array([[1. , 0.5, 0. ]])
    """

    shift: Sequence[float] | FloatArray = (0.0, 0.0, 0.0)
    rotation: Any = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        turn = real_array(self.rotation, "rotation")
        if turn.ndim == 1:
            x, y, z = real_array(turn, "rotation", (3,))
            if la.norm(turn) > 2 * np.pi:
                raise ModelError(
                    f"rotation {turn.tolist()} is more than a whole turn: it is in radians. For "
                    "degrees, pass numpy.radians([0, 0, 90])."
                )
            turn = la.expm(np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))
            turn[np.abs(turn) < _ZERO] = 0.0
        turn = real_array(turn, "rotation", (3, 3))
        if np.abs(turn @ turn.T - np.eye(3)).max() > _ORTHOGONAL or la.det(turn) < 0:
            raise ModelError(
                f"rotation must be a rotation vector [rad] or an orthogonal matrix without a "
                f"mirror image, got {turn.tolist()}: lengths would change. A quarter turn about z "
                "is (0, 0, pi / 2)."
            )
        self._set(shift=real_array(self.shift, "shift", (3,)), rotation=turn)

    def __repr__(self) -> str:
        angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(self.rotation) - 1), -1.0, 1.0)))
        place = ", ".join(f"{float(x):g}" for x in self.shift)
        return f"<Pose at ({place}) m, turned by {angle:.4g} degrees>"

    def points(self, xyz: Any) -> FloatArray:
        """Return where points (n, 3) [m] of the component are in the machine."""
        return np.asarray(real_array(xyz, "xyz", (None, 3)) @ self.rotation.T + self.shift)

    def own_points(self, xyz: FloatArray) -> FloatArray:
        """Return where points (n, 3) [m] of the machine are in the component."""
        return np.asarray((xyz - self.shift) @ self.rotation)

    def own_ground(self) -> FloatArray:
        """Return the (6, 6) map of ground motion about the machine's origin to the component's.

        Translation and rotation in the component: ``R^T (v + w x shift)`` and ``R^T w``.
        """
        x, y, z = self.shift
        back = self.rotation.T
        cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # w x shift = cross w
        return np.block([[back, back @ cross], [np.zeros((3, 3)), back]])


def turned(dofs: DofSet, pose: Pose) -> tuple[DofSet, sp.csc_array]:
    """Return DOFs in the directions and places of the machine, and C with ``q = C q_own``.

    The interpolation is left out. C is orthogonal: it turns each node's displacements, and its
    rotations.
    """
    kinds, n = np.array(dofs.kinds), len(dofs)
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for first in (0, 3):
        there = np.flatnonzero((dofs.kinds >= first) & (dofs.kinds < first + 3))
        # by node, then by direction
        there = there[np.lexsort((dofs.kinds[there], dofs.node_index[there]))]
        for own, group in _groups(dofs, there, first):
            R = pose.rotation[:, own]
            made = np.flatnonzero(np.any(np.abs(R) > _ORTHOGONAL, axis=1))
            if made.size != own.size:
                raise _oblique(dofs, group[0], own + first)
            kinds[group] = first + made
            rows.append(np.repeat(group, own.size, axis=1).ravel())
            columns.append(np.tile(group, (1, own.size)).ravel())
            values.append(np.tile(R[made].ravel(), group.shape[0]))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    names = np.array(DIRECTIONS, dtype=object)
    placed = dofs.replace(
        directions=tuple(names[kinds]), xyz=pose.points(dofs.xyz), interpolation=None
    )
    return placed, sp.csc_array(entries, shape=(n, n))


def _groups(dofs: DofSet, rows: IntArray, first: int) -> list[tuple[IntArray, IntArray]]:
    """Return, for nodes with the same directions, these (k,) and their rows (m, k)."""
    if not rows.size:
        return []
    node = dofs.node_index[rows]
    starts = np.flatnonzero(np.diff(node, prepend=-1))
    bits = np.add.reduceat(1 << (dofs.kinds[rows] - first), starts)
    found = []
    for mask in np.unique(bits):
        own = np.flatnonzero([mask >> k & 1 for k in range(3)])
        begin = starts[bits == mask]
        found.append((own, rows[begin[:, None] + np.arange(own.size)]))
    return found


def _oblique(dofs: DofSet, rows: IntArray, own: IntArray) -> ModelError:
    has = ", ".join(DIRECTIONS[k] for k in own)
    return ModelError(
        f"node {dofs.nodes[rows[0]]} has only the directions {has}, which this rotation turns out "
        "of x, y and z: its motion would be oblique. Turn by quarter turns, or about the axis that "
        "keeps them, or use a component with all directions (place those of a machine before "
        "they are joined)."
    )
