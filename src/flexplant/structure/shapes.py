"""Motions between the nodes of beams, plates and blocks, by their elements' shape functions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import FloatArray, real_array
from ..errors import LabelError, require_known
from ..labels import Interpolation
from ..tolerances import SAME
from .element_matrices import (
    Grid,
    beam_parts,
    brick_bending,
    brick_shape,
    brick_slopes,
    edge_share,
    plate_coefficients,
    plate_terms,
)


@dataclass(frozen=True, eq=False, repr=False)
class GridShape(Interpolation):
    """Common base of shape functions on regular grids: location of a point."""

    @cached_property
    def _grid(self) -> Grid:
        counts, present, per_node = self._layout()
        there = np.ones(counts[::-1], dtype=bool) if present is None else np.asarray(present)
        return Grid(counts, per_node, there)

    @abstractmethod
    def _layout(self) -> tuple[tuple[int, ...], Any, int]: ...

    def _row(self, element: Sequence[int], weights: FloatArray) -> FloatArray:
        """Return the row (n,) of an element's weights, its corners in the order of the grid."""
        grid, f = self._grid, self._grid.per_node
        strides = np.cumprod([1, *(n + 1 for n in grid.counts[:-1])])
        nodes = grid.rank[(np.asarray(element) + grid.corners) @ strides]
        row = np.zeros(grid.n_dof)
        row[(f * nodes[:, None] + np.arange(f)).ravel()] = weights
        return row

    def _located(
        self, point: FloatArray, lengths: Sequence[float], lost: Callable[[], LabelError]
    ) -> tuple[tuple[int, ...], FloatArray, FloatArray]:
        """Return the element of a point, its coordinates (d,) from 0 to 1 and the sizes (d,)."""
        # on an edge, the element on the side of larger coordinates, unless it is missing
        grid = self._grid
        choices: list[list[tuple[int, float]]] = []
        for value, length, count in zip(point.tolist(), lengths, grid.counts, strict=False):
            place = min(max(value / length, 0.0), 1.0) * count
            nearest = round(place)
            if abs(place - nearest) < 1e-9 * count:  # rounding must not decide the side
                place = float(nearest)
            index = min(int(place), count - 1)
            found = [(index, place - index)]
            if place == index and index:
                found.append((index - 1, 1.0))
            choices.append(found)
        sizes = np.array([n / k for n, k in zip(lengths, grid.counts, strict=True)])
        order = np.ndindex(*(len(found) for found in choices))
        for pick in sorted(order, key=sum):
            chosen = [found[i] for found, i in zip(choices, pick, strict=True)]
            element = tuple(index for index, _ in chosen)
            if grid.present[element[::-1]]:
                return element, np.array([s for _, s in chosen]), sizes
        raise lost()


@dataclass(frozen=True, eq=False, repr=False)
class PlateShape(GridShape):
    """The shape functions of a rectangular grid of plate elements.

    Parameters
    ----------
    size : (float, float) [m]
        Lengths in x and y.
    thickness : float or (ny, nx) array [m]
        Thickness of the plate. Points between the two surfaces belong to the plate.
    elements : (int, int)
        Number of elements in x and y.

    Examples
    --------
    The weights of the deflections add up to one, so that a translation in z is exact:

    >>> import flexplant as fx
    >>> shape = fx.structure.PlateShape((1.0, 1.0), 0.01, (2, 2))
    >>> round(float(shape.row((0.3, 0.2, 0.0), "z")[::3].sum()), 9)
    1.0
    """

    size: tuple[float, float]
    thickness: float | FloatArray
    elements: tuple[int, int]

    def _layout(self) -> tuple[tuple[int, ...], Any, int]:
        return self.elements, None, 3

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion z, rx or ry at the point `xyz` [m].

        Between elements z is continuous. The slope across an edge is not, since the elements are
        non-conforming. On an edge, the slope in the element with the larger coordinates is
        returned.
        """
        require_known("motion", [direction], ("z", "rx", "ry"), "a plate in bending")
        point = real_array(xyz, "xyz", (3,))
        slack = SAME * max(self.size)
        if not _is_inside(point[:2], self.size, slack):
            raise self._off(point, float(np.max(self.thickness)))
        element, (s, t), _ = self._located(point, self.size, lambda: LabelError("no element"))
        thick: Any = self.thickness
        depth = thick if np.ndim(thick) == 0 else float(thick[element[::-1]])
        if abs(point[2]) > 0.5 * depth + slack:
            raise self._off(point, depth)
        return self._row(element, self._weights(direction, element, s, t))

    def _weights(self, direction: str, element: Any, s: Any, t: Any) -> FloatArray:
        """Return the weights (..., 12) of the DOFs of elements (x, y) at s, t between 0 and 1."""
        a, b = (n / k for n, k in zip(self.size, self.elements, strict=True))
        if direction == "z":
            terms = plate_terms(s, t, 0, 0)
        elif direction == "rx":
            terms = plate_terms(s, t, 0, 1) / b
        else:
            terms = -plate_terms(s, t, 1, 0) / a
        return np.asarray(terms @ plate_coefficients(a, b))

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        points = real_array(points, "points", (None, 3))
        grid, size, count = self._grid, np.array(self.size), np.array(self.elements)
        place = np.clip(points[:, :2] / size, 0.0, 1.0) * count
        nearest = np.round(place)
        place = np.where(np.abs(place - nearest) < SAME * count, nearest, place)
        x, y = element = np.minimum(place.astype(np.int64), count - 1).T
        slack = SAME * max(self.size)
        depth = np.broadcast_to(np.asarray(self.thickness), tuple(count[::-1]))[y, x]
        plain = np.all((points[:, :2] >= -slack) & (points[:, :2] <= size + slack), axis=1)
        plain &= np.abs(points[:, 2]) <= 0.5 * depth + slack
        found = np.zeros((len(points), grid.n_dof))
        if plain.any() and direction in ("z", "rx", "ry"):
            s, t = (place.T - element)[:, plain]
            nodes = grid.rank[(element.T[plain, None] + grid.corners) @ np.array([1, count[0] + 1])]
            columns = (3 * nodes[:, :, None] + np.arange(3)).reshape(-1, 12)
            found[np.flatnonzero(plain)[:, None], columns] = self._weights(
                direction, element[:, plain], s, t
            )
        else:
            plain[:] = False
        for i in np.flatnonzero(~plain):  # off the plate
            found[i] = self.row(points[i], direction)
        return found

    def _off(self, point: FloatArray, depth: float) -> LabelError:
        return LabelError(
            f"the point {tuple(point.tolist())} is off the plate, which reaches from "
            f"(0, 0) to ({self.size[0]:g}, {self.size[1]:g}) m at |z| <= "
            f"{0.5 * depth:g} m: its motion is not known. Coordinates are in metres."
        )


@dataclass(frozen=True, eq=False, repr=False)
class BeamShape(GridShape):
    """The shape functions of a beam along x, which are cubic between its nodes.

    Parameters
    ----------
    length : float [m]
        Length of the beam.
    elements : int
        Number of elements.
    softness : float or (elements,) array, optional [m^2]
        Ratio of bending stiffness to shear stiffness. None: the beam has no shear deformation.

    Examples
    --------
    A beam of 2 m with four elements:

    >>> import flexplant as fx
    >>> fx.structure.BeamShape(2.0, 4)
    BeamShape(length=2, elements=4)
    """

    length: float
    elements: int
    softness: float | FloatArray | None = None

    def _layout(self) -> tuple[tuple[int, ...], Any, int]:
        return (self.elements,), None, 2

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion z or ry of the section at `xyz` [m].

        Raises
        ------
        LabelError
            When the point is not on the axis of the beam, or the direction is not z or ry.
        """
        require_known("motion", [direction], ("z", "ry"), "a beam in bending")
        point = real_array(xyz, "xyz", (3,))
        slack = SAME * self.length
        if not _is_inside(point[:1], (self.length,), slack) or np.abs(point[1:]).max() > slack:
            raise LabelError(
                f"the point {tuple(point.tolist())} is off the beam, whose axis reaches from "
                f"(0, 0, 0) to ({self.length:g}, 0, 0) m: its motion is not known. Coordinates are "
                "in metres."
            )
        element, (s,), (h,) = self._located(point, (self.length,), lambda: LabelError("no element"))
        given = np.asarray(0.0 if self.softness is None else self.softness)
        soft = np.broadcast_to(given, (self.elements,))[element[0]]
        z, slope = (
            (one[0] + edge_share(soft, h) * one[1])[0] for one in beam_parts(np.array([s]), h)
        )
        weights = (z if direction == "z" else -slope) * [1, -1, 1, -1]
        return self._row(element, weights)


@dataclass(frozen=True, eq=False, repr=False)
class BlockShape(GridShape):
    """The trilinear shape functions of a box of eight-node bricks.

    Parameters
    ----------
    size : (float, float, float) [m]
        Lengths in x, y and z.
    elements : (int, int, int)
        Number of elements in x, y and z.
    present : (nz, ny, nx) array of bool, optional
        True for each element that exists. None: all elements exist.
    poisson_ratio : float
        Poisson's ratio. The transverse curvature of a bent element is proportional to it.

    Examples
    --------
    The weights add up to one, so that a translation along x is exact:

    >>> import flexplant as fx
    >>> shape = fx.structure.BlockShape((1.0, 1.0, 1.0), (2, 2, 2))
    >>> round(float(shape.row((0.3, 0.2, 0.1), "x").sum()), 9)
    1.0
    """

    size: tuple[float, float, float]
    elements: tuple[int, int, int]
    present: Any = None
    poisson_ratio: float = 0.0

    def _layout(self) -> tuple[tuple[int, ...], Any, int]:
        return self.elements, self.present, 3

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion `direction` at the point `xyz` [m].

        In addition to its trilinear functions, an element has internal bending shapes, whose sizes
        follow from the displacements of its corners. Rotations rx, ry, rz are half the curl of the
        displacements. They jump slightly between two elements. On a boundary, the rotations in the
        element with the larger coordinates are returned.
        """
        require_known("motion", [direction], _BLOCK_MOTIONS, "a solid")
        point = real_array(xyz, "xyz", (3,))

        def off(what: str) -> LabelError:
            return LabelError(
                f"the point {tuple(point.tolist())} is {what} the block, which reaches from "
                f"(0, 0, 0) to {self.size} m: its motion is not known. Coordinates are in metres."
            )

        if not _is_inside(point, self.size, SAME * max(self.size)):
            raise off("outside")
        element, inside, sizes = self._located(point, self.size, lambda: off("in a hole of"))
        kind = _BLOCK_MOTIONS.index(direction)
        weights = np.zeros((11, 3))
        if kind < 3:
            weights[:, kind] = brick_shape(inside)
        else:
            slopes = brick_slopes(inside) / sizes
            after, before = (kind - 2) % 3, (kind - 1) % 3
            weights[:, before] = 0.5 * slopes[:, after]
            weights[:, after] = -0.5 * slopes[:, before]
        return self._row(element, weights[:8].ravel() + weights[8:].ravel() @ self._bending)

    @cached_property
    def _bending(self) -> FloatArray:
        """Bending modes (9, 24) inside an element that follow its corners."""
        sizes = [n / k for n, k in zip(self.size, self.elements, strict=True)]
        return brick_bending(sizes[0], sizes[1], sizes[2], self.poisson_ratio)


_BLOCK_MOTIONS = ("x", "y", "z", "rx", "ry", "rz")


def _is_inside(point: FloatArray, lengths: Sequence[float], slack: float) -> bool:
    return bool(np.all(point >= -slack) and np.all(point <= np.array(lengths) + slack))
