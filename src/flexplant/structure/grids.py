"""Regular grids of elements: their input, sums of element matrices, and shapes between nodes."""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Any, ClassVar, TypeAlias

import numpy as np
import scipy.sparse as sp

from ..arrays import (
    CACHED,
    FloatArray,
    IntArray,
    positive,
    real_array,
    several,
    whole,
    why_not_called,
)
from ..errors import LabelError, ModelError, ShapeError, require_known, short
from ..labels import DofSet, Interpolation, node_dofs
from ..tolerances import SAME

#: one number, an array (nx, ny, ...) with one per element, or a function of an element's centre
Field: TypeAlias = float | Sequence[Any] | FloatArray | Callable[..., float]

#: largest number of elements along one axis that a machine model may have
MOST = 10**6


@cache
def corners(ndim: int) -> IntArray:
    """Return the corners (2^d, d) of an element, x fastest."""
    return np.fliplr(list(np.ndindex((2,) * ndim)))


@dataclass(frozen=True, eq=False)
class Grid:
    """A line, rectangle or box of elements; some elements may be missing.

    A node sees up to 3^d nodes through up to 2^d elements; the existing ones determine the entries
    of its rows. Elements and nodes are counted with x fastest; an element's nodes likewise.
    """

    lengths: tuple[float, ...]
    counts: tuple[int, ...]
    per_node: int
    present: Any

    @property
    def _ndim(self) -> int:
        return len(self.counts)

    @cached_property
    def steps(self) -> FloatArray:
        """Sizes (d,) of an element."""
        return np.array(self.lengths) / self.counts

    @property
    def n_grid(self) -> int:
        """Number of nodes of the full grid."""
        return int(np.prod([n + 1 for n in self.counts]))

    @cached_property
    def _strides(self) -> IntArray:
        """Distance (d,) of neighbouring nodes along each axis in the numbers of the full grid."""
        return np.cumprod([1, *(n + 1 for n in self.counts[:-1])])

    @cached_property
    def nodes(self) -> IntArray:
        """The nodes that touch an element, numbered in the full grid from 0, ascending."""
        return np.flatnonzero(self._corner_values(self.present).any(axis=1))

    @cached_property
    def rank(self) -> IntArray:
        """Place of each node of the full grid among `nodes`; -1 in holes."""
        rank = np.full(self.n_grid, -1)
        rank[self.nodes] = np.arange(self.nodes.size)
        return rank

    @property
    def n_dof(self) -> int:
        """Number of DOFs."""
        return self.per_node * self.nodes.size

    def _corner_values(self, values: Any) -> Any:
        """Return (n_grid, 2^d): the value of the element in which a node is corner c; 0 outside."""
        padded = np.pad(np.asarray(values), 1)
        shape = tuple(n + 1 for n in self.counts[::-1])
        found = np.empty((self.n_grid, 2**self._ndim), dtype=padded.dtype)
        for c, corner in enumerate(corners(self._ndim)):
            window = tuple(
                slice(1 - o, 1 - o + n) for o, n in zip(corner[::-1], shape, strict=True)
            )
            found[:, c] = padded[window].ravel()
        return found

    @cached_property
    def _offsets(self) -> IntArray:
        """Which neighbour (2^d, 2^d) corner e of an element is, seen from its corner c."""
        steps = corners(self._ndim)[None, :] - corners(self._ndim)[:, None] + 1
        return np.asarray(steps @ 3 ** np.arange(self._ndim))

    @cached_property
    def _there(self) -> Any:
        """Whether neighbour k of a node (n_nodes, 3^d) shares an element with it."""
        present = self._corner_values(self.present)[self.nodes]
        seen = np.zeros((2**self._ndim, 3**self._ndim), dtype=np.float32)
        for c, offsets in enumerate(self._offsets):
            seen[c, offsets] = 1.0
        return (present.astype(np.float32) @ seen) > 0

    @cached_property
    def _pattern(self) -> tuple[Any, Any]:
        """The row numbers of all columns, and where each begins; the matrix is symmetric."""
        f, d = self.per_node, self._ndim
        steps = np.array([s[::-1] for s in product((-1, 0, 1), repeat=d)]) @ self._strides
        there = self._there
        per_node = there.sum(axis=1)
        entries = int(per_node.sum()) * f * f
        wide = np.int32 if max(entries, self.n_dof) < 2**31 else np.int64
        neighbour = (self.nodes[:, None] + steps)[there]
        first = (f * self.rank[neighbour]).astype(wide)
        # the DOFs of all neighbours of a node, once for each column of the node
        block = (first[:, None] + np.arange(f, dtype=wide)).ravel()
        indices = _repeated_blocks(block, f * per_node, f)
        pointer = np.zeros(self.n_dof + 1, dtype=wide)
        np.cumsum(np.repeat(f * per_node, f), out=pointer[1:])
        for part in (indices, pointer):
            part.flags.writeable = False
        return indices, pointer

    def matrix(self, terms: Sequence[tuple[FloatArray, Any]]) -> sp.csc_array:
        """Return the assembled sum of element matrices, with a weight for each element."""
        f, n_corners, n_seen = self.per_node, 2**self._ndim, 3**self._ndim
        table = np.zeros((len(terms), n_corners, f, n_seen, f))
        weights = []
        for k, (element, weight) in enumerate(terms):
            blocks = element.reshape(n_corners, f, n_corners, f)
            for c, offsets in enumerate(self._offsets):
                table[k, c][:, offsets] = blocks[c]
            whole = np.where(self.present, np.broadcast_to(weight, self.present.shape), 0.0)
            weights.append(self._corner_values(whole)[self.nodes])
        weight_of, flat = np.hstack(weights), table.reshape(len(terms) * n_corners, -1)
        indices, pointer = self._pattern
        data = np.empty(indices.size)
        done, step = 0, max(1, CACHED // flat.shape[1])
        for start in range(0, self.nodes.size, step):
            some = slice(start, start + step)
            values = _symmetric_sum(weight_of[some], flat).reshape(-1, f, n_seen, f)
            there = self._there[some]
            if not there.all():
                keep = np.broadcast_to(there[:, None, :, None], values.shape)
                values = values[keep]
            data[done : done + values.size] = values.ravel()
            done += values.size
        data.flags.writeable = False
        found = sp.csc_array((data, indices, pointer), shape=(self.n_dof, self.n_dof))
        found.has_canonical_format = True
        return found

    def dofs(self, directions: tuple[str, ...], shape: Interpolation) -> DofSet:
        """Return the DOFs of a grid that begins at the origin; nodes keep their numbers."""
        lines = [n * (np.arange(k + 1) / k) for n, k in zip(self.lengths, self.counts, strict=True)]
        xyz = np.zeros((self.nodes.size, 3))
        xyz[:, : self._ndim] = _mesh(lines)[self.nodes]
        return node_dofs(self.nodes + 1, directions, xyz, shape)

    @property
    def _centres(self) -> FloatArray:
        """Centres (elements, d) of all elements."""
        return _mesh(
            [n * (np.arange(k) + 0.5) / k for n, k in zip(self.lengths, self.counts, strict=True)]
        )

    def field(self, value: Field, name: str) -> Any:
        """Return one number, or an array (nz, ny, nx) of positive ones where elements are."""
        if callable(value):
            chosen = self.present.ravel()
            found = np.ones(chosen.size)
            answers = _called(value, name, self._centres[chosen])
            found[chosen] = real_array(answers, f"{name} of the elements", (len(answers),))
            values = found.reshape(self.present.shape)
        else:
            values = real_array(value, name)
            if not values.ndim:
                return positive(value, name)
            if values.shape != self.counts:
                raise ShapeError(
                    f"{name} must be one number, one for each element in an array of shape "
                    f"{self.counts}, or a function of an element's centre, got shape "
                    f"{values.shape}."
                )
            values = values.T
        there = values[self.present]
        if np.any(there <= 0):
            raise ModelError(
                f"{name} must be positive in every element, got {there.min():g}. Say where "
                "elements are missing by holes=."
            )
        return values

    def poisson(self, value: Field) -> Any:
        """Return Poisson's ratio: one number, or an array (nz, ny, nx)."""
        found: Any
        if callable(value) or real_array(value, "poisson_ratio").ndim:
            found = self.field(_one_more(value), "1 + poisson_ratio") - 1.0
        else:
            found = float(real_array(value, "poisson_ratio", ()))
        if np.any(found <= -1) or np.any(found >= 0.5):
            worst = np.min(found) if np.any(found <= -1) else np.max(found)
            raise ModelError(
                f"poisson_ratio must be above -1 and below 0.5, got {worst:g}. Give that of the "
                "material, 0.25 to 0.35 for metals; incompressible materials need other elements."
            )
        return found

    def located(self, points: FloatArray) -> tuple[IntArray, FloatArray, Any]:
        """Return the elements (p, d) of points (p, d), the places there from 0 to 1, and whether.

        On an edge it is the element on the side of larger coordinates, unless it is missing. The
        last result says which points lie in an element that exists.
        """
        counts = np.array(self.counts)
        place = np.minimum(np.maximum(points / self.lengths, 0.0), 1.0) * counts
        nearest = np.round(place)  # rounding must not decide the side
        place = np.where(np.abs(place - nearest) < SAME * counts, nearest, place)
        element = np.minimum(place.astype(np.int64), counts - 1)
        there = self.present[tuple(element.T[::-1])]
        if not np.all(there):
            edge = (place == element) & (element > 0)
            for step in sorted(product((0, 1), repeat=self._ndim), key=sum)[1:]:
                use = ~there & np.all(edge | ~np.array(step, dtype=bool), axis=1)
                other = element - step
                use[use] = self.present[tuple(other[use].T[::-1])]
                element[use], there = other[use], there | use
        return element, place - element, there

    def rows(self, element: IntArray, weights: FloatArray) -> FloatArray:
        """Return the rows (p, n) of the weights of elements (p, d), corners in order."""
        f = self.per_node
        nodes = self.rank[(element[:, None] + corners(self._ndim)) @ self._strides]
        found = np.zeros((len(element), self.n_dof))
        columns = (f * nodes[:, :, None] + np.arange(f)).reshape(weights.shape)
        found[np.arange(len(element))[:, None], columns] = weights
        return found


def grid_of(size: Any, elements: Any, count: int, per_node: int, holes: Any = None) -> Grid:
    """Return a grid along `count` axes of the given lengths and numbers of elements."""
    lengths = tuple(
        positive(value, f"size in {axis}")
        for value, axis in zip(real_array(size, "size", (count,)).tolist(), "xyz", strict=False)
    )
    counts = _counts_of(elements, count)
    grid = Grid(lengths, counts, per_node, np.ones(counts[::-1], dtype=bool))
    return grid if holes is None else replace(grid, present=_present(grid, holes))


def _counts_of(elements: Any, count: int) -> tuple[int, ...]:
    """Return `count` numbers of elements."""
    axes = "xyz"[:count]
    listed = [elements] if count == 1 and not several(elements) else elements
    if not isinstance(listed, Sequence | np.ndarray) or not several(listed) or len(listed) != count:
        raise ShapeError(
            f"elements must be {count} whole numbers (along {', '.join(axes)}), got "
            f"{short(elements)}. Pass for example ({', '.join(['8'] * count)})."
        )
    return tuple(
        whole(value, f"elements along {axis}", maximum=MOST)
        for value, axis in zip(listed, axes, strict=True)
    )


def _called(function: Any, name: str, centres: FloatArray) -> list[Any]:
    """Return the values of a user's function at the centres (elements, d)."""
    if isinstance(function, type):
        raise ModelError(f"{name} is a class, {function.__name__}. Pass a number or a function.")
    names = ", ".join("xyz"[: centres.shape[1]])
    why = why_not_called(function, *centres.tolist()[0]) if len(centres) else ""
    if why:
        raise ModelError(
            f"{name} is evaluated at the centre ({names}) of each element, and this function "
            f"cannot be called so: {why}. Write it as lambda {names}: ..."
        )
    return [function(*centre) for centre in centres.tolist()]


def _one_more(item: Any) -> Any:
    """Return an array, or a function of an element's centre, with values that are larger by one."""
    if not callable(item):
        return 1.0 + real_array(item, "poisson_ratio")
    if isinstance(item, type):
        return item
    return functools.wraps(item)(lambda *at: 1.0 + item(*at))


def _mesh(lines: Sequence[FloatArray]) -> FloatArray:
    """Return the points (n, d) of a mesh with given coordinates along each axis, x fastest."""
    return np.column_stack([a.ravel() for a in np.meshgrid(*lines[::-1], indexing="ij")[::-1]])


def _present(grid: Grid, holes: Any) -> Any:
    """Return which elements exist (nz, ny, nx)."""
    import scipy.ndimage

    if callable(holes):
        answers = _called(holes, "holes", grid._centres)
        present = ~np.array([bool(one) for one in answers]).reshape(grid.present.shape)
    else:
        given = np.asarray(holes)
        if given.dtype != bool:
            raise ModelError(
                f"holes must be a mask of the elements or a function of an element's centre, got "
                f"{short(holes)}. Give True where an element is missing."
            )
        if given.shape != grid.counts:
            raise ShapeError(
                f"holes must be a mask with one entry for each element, of shape {grid.counts}, "
                f"got {given.shape}. Give True where an element is missing."
            )
        present = ~given.T
    pieces = scipy.ndimage.label(present)[1]
    if pieces != 1:
        raise ModelError(
            f"the holes leave {pieces} separate pieces of the structure"
            + (", that is nothing at all" if not pieces else "")
            + ": make them smaller, or model the pieces one by one."
        )
    return present


def _symmetric_sum(weights: FloatArray, table: FloatArray) -> FloatArray:
    """Return weights @ table, summed in one order: the matrix is symmetric to the last bit."""
    # BLAS may fuse a product with a sum, and then (w e)_1 + (w e)_2 depends on which one comes
    # first
    used = np.flatnonzero(weights.any(axis=0))
    found = np.zeros((weights.shape[0], table.shape[1]))
    part = np.empty_like(found)
    for k in used:
        np.multiply(weights[:, k, None], table[k], out=part)
        found += part
    return found


def _repeated_blocks(values: Any, lengths: IntArray, times: int) -> Any:
    """Return blocks of `values`, each of its length written `times` times in a row."""
    if lengths.size and np.all(lengths == lengths[0]):
        return np.repeat(values.reshape(-1, 1, lengths[0]), times, axis=1).ravel()
    starts = np.cumsum(lengths) - lengths
    found = np.empty(times * values.size, dtype=values.dtype)
    # runs of equal blocks are copied together, since a grid has few kinds of nodes
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        step = max(1, 20 * CACHED // (length * times))
        for k in range(0, chosen.size, step):
            some = chosen[k : k + step]
            inside = np.arange(length)
            part = values[starts[some][:, None] + inside]
            for j in range(times):
                found[(times * starts[some] + j * length)[:, None] + inside] = part
    return found


@dataclass(frozen=True, eq=False, repr=False)
class GridShape(Interpolation):
    """Common base of shape functions on regular grids."""

    #: the motions that are known at a point, and the name of such a body
    motions: ClassVar[tuple[str, ...]]
    body: ClassVar[str]

    @property
    @abstractmethod
    def _grid(self) -> Grid: ...

    @abstractmethod
    def _weights(self, direction: str, element: IntArray, place: FloatArray) -> FloatArray:
        """Return the weights (p, w) of the DOFs of elements (p, d) at places (p, d) in them."""

    @abstractmethod
    def _beside(self, points: FloatArray, element: IntArray) -> FloatArray:
        """Return the distance (p,) of points (p, 3) from the body along axes without elements."""

    @abstractmethod
    def _off(self, point: FloatArray, element: IntArray, outside: bool) -> LabelError:
        """Return the error for a point outside of the body, or in a hole."""

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion `direction` at the point `xyz` [m].

        On an edge, it is the motion of the element with the larger coordinates. A LabelError is
        raised if the point does not belong to the body, or the direction is not one of its motions.
        """
        return np.asarray(self.rows(real_array(xyz, "xyz", (3,))[None], direction)[0])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        require_known("motion", [direction], self.motions, self.body)
        points = real_array(points, "points", (None, 3))
        grid = self._grid
        inner = points[:, : len(grid.counts)]
        element, place, there = grid.located(inner)
        slack = SAME * max(grid.lengths)
        outside = np.any((inner < -slack) | (inner > np.array(grid.lengths) + slack), axis=1)
        outside |= self._beside(points, element) > slack
        if np.any(outside | ~there):
            i = int(np.argmax(outside | ~there))
            raise self._off(points[i], element[i], bool(outside[i]))
        return grid.rows(element, self._weights(direction, element, place))
