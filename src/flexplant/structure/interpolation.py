"""Shapes between the nodes of an imported model, whose elements are not known."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from ..arrays import FloatArray, IntArray, instance, positive, real_array
from ..errors import LabelError, ModelError, require_known
from ..labels import DIRECTIONS, DofSet, Interpolation, direction_names
from ..store import Value, checked
from ..tolerances import SAME, TINY
from .model import FEModel

#: number of nodes up to which one smooth interpolant is used; for more, the nearest nodes are used
_GLOBAL = 600
_NEIGHBOURS = 80

Interpolated = TypeVar("Interpolated", bound=Value)


def interpolated(item: Interpolated, *, margin: float = 0.0) -> Interpolated:
    """Return a model (or its modes, or a DofSet) whose shapes are interpolated between its nodes.

    Use this function for imported models, whose elements are not known. A place may then be any
    point between the nodes, in addition to labels. Without this function, only labels are allowed.

    Parameters
    ----------
    item : FEModel, Modes or DofSet
        Model, modes or DOFs to interpolate. The nodes must not all be at one point.
    margin : float [m]
        Largest distance by which a point may lie outside the convex hull of the nodes. For example,
        the surface of a plate lies outside its middle plane.

    Returns
    -------
    FEModel, Modes or DofSet
        The same item with a ScatteredShape as `dofs.interpolation`.

    Raises
    ------
    ModelError
        When the item has another type or is a joined machine, or margin is negative.

    Notes
    -----
    Each displacement is a sum of radial basis functions r^3 and a linear part (RBFInterpolator of
    SciPy). The interpolation is exact at the nodes and for rigid-body motion. If the model has no
    rotational DOFs, rotations are half the curl of the displacements. If only one slope is known,
    such as rx = dz/dy or ry = -dz/dx on a plate, the rotation is this slope. With up to 600 nodes
    the interpolated displacements are smooth. With more nodes, only the 80 nodes nearest to the
    point are used. Where these change from point to point, the displacements may jump by about the
    interpolation error.

    Examples
    --------
    The motion at a point between the nodes of a block:

    >>> import flexplant as fx
    >>> size, mesh = {"size": (1.0, 1.0, 1.0)}, {"elements": (2, 2, 2)}
    >>> block = fx.solid_block(**size, **mesh, density=1.0, youngs_modulus=1.0, poisson_ratio=0.3)
    >>> row = fx.interpolated(block).dofs.row((0.4, 0.5, 0.5), "x")
    >>> round(row.sum(), 9)  # the weights of the nodes around add up to one
    np.float64(1.0)
    """
    dofs: Any = getattr(item, "dofs", item)
    dofs = dofs if getattr(item, "full_dofs", dofs) is dofs else item
    instance(dofs, DofSet, "item", "Pass an FEModel, its modes, or its dofs, before `reduce`.")
    if dofs.components:
        raise ModelError(
            f"the nodes of {', '.join(dofs.components)} move independently: interpolate each "
            "component before they are joined."
        )
    shape = ScatteredShape(dofs.xyz, dofs.directions, positive(margin, "margin", zero=True))
    between = dofs.replace(interpolation=shape)
    if isinstance(item, FEModel):
        return item._with(dofs=between)  # its matrices are not checked again
    return between if item is dofs else item.replace(dofs=between)


@dataclass(frozen=True, eq=False, repr=False)
class ScatteredShape(Interpolation):
    """Interpolation between nodes by radial basis functions, which `interpolated` makes.

    Parameters
    ----------
    xyz : (n, 3) array [m]
        Coordinates of each DOF's node.
    directions : sequence of n str
        Direction of each DOF.
    margin : float [m]
        Largest allowed distance of a point from the convex hull of the nodes. 0: points must lie
        inside it.

    Examples
    --------
    The weights of the five nodes add up to one, so that a translation along x is exact:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> xyz = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 1.0, 1.0]])
    >>> shape = fx.structure.ScatteredShape(xyz, ["x"] * 5)
    >>> round(float(shape.row((0.2, 0.2, 0.2), "x").sum()), 9)
    1.0
    """

    xyz: FloatArray = field(metadata=checked(real_array, shape=("directions", 3)))
    directions: tuple[str, ...] = field(metadata=checked(direction_names))
    margin: float = field(default=0.0, metadata=checked(positive, zero=True, unit="m"))

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion `direction` at the point `xyz` [m].

        Raises
        ------
        LabelError
            When the point is too far outside the convex hull of the nodes, or no node has a DOF
            from which the motion in this direction follows.
        """
        return np.asarray(self.rows(real_array(xyz, "xyz", (3,))[None], direction)[0])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        places = real_array(points, "points", (None, 3))
        require_known("motion", [direction], DIRECTIONS)
        if direction in self.directions:
            return self._field(direction).values(places)
        # the rotation of the material is half the curl: rx of dz/dy and -dy/dz, and so on
        turn = DIRECTIONS.index(direction) % 3
        second, third = (turn + 1) % 3, (turn + 2) % 3
        terms = [
            (sign, self._field(moved), axis)
            for sign, moved, axis in (
                (1.0, DIRECTIONS[third], second),
                (-1.0, DIRECTIONS[second], third),
            )
            if direction[0] == "r" and moved in self.directions and self._field(moved).spans(axis)
        ]
        if not terms:
            raise LabelError(
                f"this model has no motion {direction!r}, and no displacements whose slopes would "
                f"give it: it has {', '.join(sorted(set(self.directions)))}. Choose one of these."
            )
        return np.asarray(
            sum(sign * field.slopes(places, axis) for sign, field, axis in terms) / len(terms)
        )

    def _field(self, direction: str) -> _Field:
        known: dict[str, _Field] = self.__dict__.setdefault("_known_fields", {})
        if direction not in known:
            rows = np.flatnonzero(np.array(self.directions) == direction)
            known[direction] = _Field(self.xyz, rows, direction, self.margin)
        return known[direction]


class _Field:
    """One displacement (or rotation) between the nodes that have it."""

    def __init__(self, xyz: FloatArray, rows: IntArray, direction: str, margin: float) -> None:
        from scipy.spatial import KDTree

        self.n, self.rows, self.direction, self.margin = xyz.shape[0], rows, direction, margin
        self.nodes = xyz[rows]
        self.centre = self.nodes.mean(axis=0)
        _, size, axes = np.linalg.svd(self.nodes - self.centre, full_matrices=False)
        self.extent = float(np.ptp(self.nodes, axis=0).max())
        self.axes = axes[size > SAME * max(size[0], TINY)]  # (d, 3): line, plane or solid
        self.flat = (self.nodes - self.centre) @ self.axes.T
        self.tree = KDTree(self.nodes)
        if not self.extent:
            raise LabelError(
                f"all DOFs {direction!r} are at one node: nothing to interpolate. Use labels."
            )
        # relative to the distance of nodes: a slope
        self.step = 1e-3 * self.extent / max(rows.size ** (1 / self.axes.shape[0]), 2.0)
        self.all = self._interpolant(np.arange(rows.size)) if rows.size <= _GLOBAL else None

    def spans(self, axis: int) -> bool:
        """Return whether the nodes vary along x, y or z, so that slopes along it are known."""
        # 1 where the axis lies in the span of the nodes, lower by the square of the missing part
        return bool(np.linalg.norm(self.axes[:, axis]) > 1.0 - 1e-6)

    def values(self, points: FloatArray) -> FloatArray:
        self._check(points)
        found = self._weights(points, lambda at, here: here(at), axis=None)
        distance, nearest = self.tree.query(points)
        for i in np.flatnonzero(distance <= SAME * self.extent):
            found[i] = 0.0
            found[i, self.rows[np.asarray(nearest)[i]]] = 1.0
        return found

    def slopes(self, points: FloatArray, axis: int) -> FloatArray:
        self._check(points)
        move = self.step * self.axes[:, axis]

        def slope(at: FloatArray, here: Any) -> FloatArray:
            near, far = here(at + move) - here(at - move), here(at + 2 * move) - here(at - 2 * move)
            return np.asarray((8 * near - far) / (12 * self.step))

        return self._weights(points, slope, axis=axis)

    def _weights(self, points: FloatArray, take: Any, *, axis: int | None) -> FloatArray:
        flat = (points - self.centre) @ self.axes.T
        found = np.zeros((points.shape[0], self.n))
        if self.all is not None:
            every = np.arange(self.rows.size)
            found[:, self.rows] = self._exact(take(flat, self.all), every, flat, axis)
            return found
        near = np.atleast_2d(self.tree.query(points, k=min(_NEIGHBOURS, self.rows.size))[1])
        for i, chosen in enumerate(near):
            at = flat[i : i + 1]
            part = take(at, self._interpolant(chosen))
            found[i, self.rows[chosen]] = self._exact(part, chosen, at, axis)[0]
        return found

    def _interpolant(self, chosen: IntArray) -> Any:
        from scipy.interpolate import RBFInterpolator

        try:
            return RBFInterpolator(self.flat[chosen], np.eye(chosen.size), kernel="cubic", degree=1)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise LabelError(
                f"the nodes of {self.direction!r} cannot be interpolated ({error}): are two of "
                "them at one place, or too few? Use DOF labels as places instead."
            ) from error

    def _exact(
        self, weights: FloatArray, chosen: IntArray, at: FloatArray, axis: int | None
    ) -> FloatArray:
        """Remove rounding, so that constant and linear fields (rigid-body motion) are exact."""
        linear = np.column_stack([np.ones(chosen.size), self.flat[chosen] / self.extent])
        if axis is None:
            wanted = np.column_stack([np.ones(at.shape[0]), at / self.extent])
        else:
            slope = np.concatenate([[0.0], self.axes[:, axis] / self.extent])
            wanted = np.broadcast_to(slope, (at.shape[0], slope.size))
        for _ in range(2):
            weights = weights + np.linalg.lstsq(linear.T, (wanted - weights @ linear).T)[0].T
        return np.asarray(weights)

    def _check(self, points: FloatArray) -> None:
        offset = points - self.centre
        flat = offset @ self.axes.T
        aside = np.linalg.norm(offset - flat @ self.axes, axis=1)
        outside = np.max(flat @ self._walls[:, :-1].T + self._walls[:, -1], axis=1)
        miss = np.maximum(aside, outside)
        worst = int(np.argmax(miss))
        if miss[worst] > self.margin + SAME * self.extent:
            low, high = self.nodes.min(axis=0), self.nodes.max(axis=0)
            raise LabelError(
                f"the point {tuple(points[worst].tolist())} is {miss[worst]:.3g} m outside the "
                f"nodes with direction {self.direction!r}, which reach from "
                f"{tuple(low.tolist())} to {tuple(high.tolist())} m: its motion is not known. "
                "Coordinates are in metres; interpolated(model, margin=...) allows for more."
            )

    @cached_property
    def _walls(self) -> FloatArray:
        """Half spaces (walls, d + 1) of the hull: a x + b <= 0 inside."""
        from scipy.spatial import ConvexHull

        if self.flat.shape[1] == 1:
            return np.array([[1.0, -self.flat.max()], [-1.0, self.flat.min()]])
        return np.asarray(ConvexHull(self.flat).equations, dtype=np.float64)
