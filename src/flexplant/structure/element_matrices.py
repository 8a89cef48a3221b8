"""Element matrices of beams, plates in bending and bricks, and their sums over a regular grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import CACHED, FloatArray, IntArray

# the plate's twelve terms x^p y^q, in coordinates from 0 to 1 over the element: the full cubic, and
# x^3 y, x y^3
_TERMS = [(n - q, q) for n in range(4) for q in range(n + 1)] + [(3, 1), (1, 3)]
_P, _Q = np.transpose(_TERMS)
#: corners of a plate element and of a brick, x fastest
PLATE_CORNERS = np.fliplr(list(np.ndindex(2, 2)))
BRICK_CORNERS = np.fliplr(list(np.ndindex(2, 2, 2)))


def beam_stiffness(length: float) -> FloatArray:
    """Return the bending stiffness (4, 4) of z, dz/dx at both ends, for E I = 1."""
    h = length
    half = np.array(
        [[6, 3 * h, -6, 3 * h], [0, 2 * h**2, -3 * h, h**2], [0, 0, 6, -3 * h], [0, 0, 0, 2 * h**2]]
    )
    return _mirror_upper(2 * half / h**3)


def beam_mass(length: float) -> FloatArray:
    """Return the consistent mass (4, 4) of a beam in bending, for unit mass per length."""
    h = length
    half = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [0, 4 * h**2, 13 * h, -3 * h**2],
            [0, 0, 156, -22 * h],
            [0, 0, 0, 4 * h**2],
        ]
    )
    return _mirror_upper(half * h / 420)


# The shear of an edge is constant and the slope of the section along it quadratic: between ends
# that turn by t1, t2 and move by z1, z2 over a length L,
#     shear = (1 - f) d,  slope = linear + 6 s (1 - s) f d,  d = (z2 - z1) / L - (t1 + t2) / 2,
# with f = 1 / (1 + 12 B / (G L^2)), B the bending and G the shear stiffness, which makes an edge an
# exact Timoshenko beam ([FriedmanKosmatka1993]_). In a plate both carry over linearly to the
# opposite edge: the element of [Katili1993]_ on a rectangle. f = 1 is an edge that does not shear.

#: number of points in each direction, which integrates products of two cubics exactly
POINTS = 4


def edge_share(softness: Any, length: float) -> Any:
    """Return f of an edge whose bending stiffness is `softness` [m^2] of its shear stiffness."""
    return 1.0 / (1.0 + 12.0 * np.asarray(softness) / length**2)


def beam_parts(s: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the parts (2, p, 4) of deflection and slope of the section that f^0 and f^1 weigh."""
    s, one = np.asarray(s, dtype=np.float64)[:, None], np.ones((np.size(s), 1))
    excess = np.array([-1.0 / length, -0.5, 1.0 / length, -0.5])
    bow = -0.5 * length * s * (1.0 - s) * np.array([0.0, -1.0, 0.0, 1.0])
    z = np.hstack([1.0 - s, 0.0 * s, s, 0.0 * s]) + bow
    slope = np.hstack([0.0 * s, 1.0 - s, 0.0 * s, s])
    cubic = length * s * (1.0 - s) * (2.0 * s - 1.0)
    return (np.stack([z, cubic * excess]), np.stack([slope * one, 6.0 * s * (1.0 - s) * excess]))


def beam_terms(length: float) -> tuple[list[FloatArray], list[FloatArray], FloatArray]:
    """Return masses and rotary inertias (4, 4) by powers 0, 1, 2 of f, and what (1 - f) weighs.

    A beam's stiffness is ``B (f K + (1 - f) K1)`` with K of a beam that does not shear.
    """
    points, weights = np.polynomial.legendre.leggauss(POINTS)
    z, slope = beam_parts(0.5 * (points + 1.0), length)
    area = 0.5 * length * weights[:, None]
    turning = np.array([0.0, -1.0, 0.0, 1.0])
    return _powers(z, area), _powers(slope, area), np.outer(turning, turning) / length


def _powers(parts: FloatArray, area: FloatArray) -> list[FloatArray]:
    """Return the integrals of a product of two parts, by the power of f that weighs them."""
    first, second = parts
    both = first.T @ (area * second)
    return [first.T @ (area * first), both + both.T, second.T @ (area * second)]


def plate_terms(s: Any, t: Any, dp: int, dq: int) -> FloatArray:
    """Return the d^dp/ds^dp d^dq/dt^dq derivatives (..., 12) of the terms s^p t^q."""
    return _monomials(_P, s, dp) * _monomials(_Q, t, dq)


def _monomials(power: IntArray, x: Any, order: int) -> FloatArray:
    factor = np.ones(power.size)
    for k in range(order):
        factor *= power - k
    return np.asarray(
        factor * np.power(np.asarray(x, float)[..., None], np.maximum(power - order, 0)),
        dtype=np.float64,
    )


@cache
def _unit_coefficients() -> FloatArray:
    """Return the polynomial coefficients (12, 12) of unit DOFs z, dz/dt, -dz/ds at the corners."""
    rows = []
    for s, t in PLATE_CORNERS.astype(float):
        rows += [plate_terms(s, t, 0, 0), plate_terms(s, t, 0, 1), -plate_terms(s, t, 1, 0)]
    return np.round(np.linalg.inv(np.array(rows)), 6)  # small integers


def plate_coefficients(a: float, b: float) -> FloatArray:
    """Return the coefficients (12, 12) of unit DOFs z, rx, ry of an element a x b."""
    return np.asarray(_unit_coefficients() * np.tile([1.0, b, a], 4), dtype=np.float64)


def _derivative_products(first: tuple[int, int], second: tuple[int, int]) -> FloatArray:
    """Return the exact integrals (12, 12) of products of derivatives over the unit square."""

    def factor(power: IntArray, order: int) -> IntArray:
        return power * (power - 1) if order == 2 else power if order == 1 else np.ones_like(power)

    p = np.add.outer(_P - first[0], _P - second[0])
    q = np.add.outer(_Q - first[1], _Q - second[1])
    scale = np.outer(
        factor(_P, first[0]) * factor(_Q, first[1]), factor(_P, second[0]) * factor(_Q, second[1])
    )
    # where a derivative vanishes its power may be negative
    return np.asarray(scale / (np.maximum(p, 0) + 1) / (np.maximum(q, 0) + 1), dtype=np.float64)


def plate_mass(a: float, b: float) -> FloatArray:
    """Return the consistent mass (12, 12) of a plate element for unit mass per area."""
    shape = plate_coefficients(a, b)
    return _symmetrised(a * b * shape.T @ _derivative_products((0, 0), (0, 0)) @ shape)


def plate_stiffness(a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Return K0, K1 (12, 12): the stiffness is ``E t^3 / 12 (1 - nu^2) (K0 + nu K1)``."""
    xx, yy, xy = (2, 0), (0, 2), (1, 1)
    cross = _derivative_products(xx, yy) / (a * b) ** 2
    twist = 2 * _derivative_products(xy, xy) / (a * b) ** 2
    shape = plate_coefficients(a, b)
    plain = _derivative_products(xx, xx) / a**4 + _derivative_products(yy, yy) / b**4 + twist
    return (
        _symmetrised(a * b * shape.T @ plain @ shape),
        _symmetrised(a * b * shape.T @ (cross + cross.T - twist) @ shape),
    )


def brick_shape(point: FloatArray) -> FloatArray:
    """Return the weights (11,) of corners and parabolas at a point (3,) of the unit cube."""
    corners = np.prod(np.where(BRICK_CORNERS, point, 1 - point), axis=1)
    return np.concatenate([corners, 4 * point * (1 - point)])


def brick_slopes(point: FloatArray) -> FloatArray:
    """Return the derivatives (11, 3) of these weights along the three unit coordinates."""
    parts = np.where(BRICK_CORNERS, point, 1 - point)
    signs = np.where(BRICK_CORNERS, 1.0, -1.0)
    found = [signs[:, k] * np.delete(parts, k, 1).prod(axis=1) for k in range(3)]
    return np.vstack([np.column_stack(found), np.diag(4 - 8 * point)])


def brick_mass(a: float, b: float, c: float) -> FloatArray:
    """Return the consistent mass (24, 24) of a brick, x y z at its corners, for unit density."""
    line = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
    return np.asarray(a * b * c * np.kron(np.kron(line, np.kron(line, line)), np.eye(3)))


def brick_stiffness(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the stiffness (24, 24) of a brick for E = 1, three bending modes inside condensed."""
    K = _brick_with_bending(a, b, c, nu)
    return _symmetrised(K[:24, :24] + K[:24, 24:] @ brick_bending(a, b, c, nu))


def brick_bending(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the bending modes (9, 24) inside a brick that follow the motions of its corners."""
    K = _brick_with_bending(a, b, c, nu)
    return np.asarray(-np.linalg.solve(K[24:, 24:], K[24:, :24]))


def _brick_with_bending(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the stiffness (33, 33) of corners and bending modes of a brick for E = 1."""
    # trilinear displacements and, for each of x, y, z, the incompatible parabolas 1 - xi^2: without
    # them a brick in bending is far too stiff (Wilson and Taylor; rectangular elements pass the
    # patch test without changes)
    law = np.diag([0.5 * (1 - 2 * nu)] * 6)
    law[:3, :3] += nu + 0.5 * (1 - 2 * nu) * np.eye(3)  # lambda + 2 mu on the diagonal
    law /= (1 + nu) * (1 - 2 * nu)
    sizes = np.array([a, b, c])
    points, weights = np.polynomial.legendre.leggauss(3)
    K = np.zeros((33, 33))
    for index in product(range(3), repeat=3):
        slopes = brick_slopes((points[list(index)] + 1) / 2) / sizes
        strain = _strain(slopes)
        K += np.prod(weights[list(index)]) / 8 * a * b * c * strain.T @ law @ strain
    return K


def _strain(slopes: FloatArray) -> FloatArray:
    """Return the strains xx, yy, zz, xy, yz, zx (6, 3 m) of m shape functions with these slopes."""
    strain = np.zeros((6, 3 * slopes.shape[0]))
    for k in range(3):
        strain[k, k::3] = slopes[:, k]
    for row, (i, j) in enumerate(((0, 1), (1, 2), (2, 0)), 3):
        strain[row, i::3], strain[row, j::3] = slopes[:, j], slopes[:, i]
    return strain


def _symmetrised(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)


def _mirror_upper(upper: FloatArray) -> FloatArray:
    return np.asarray(upper + np.triu(upper, 1).T, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Grid:
    """A line, rectangle or box of elements; some elements may be missing.

    A node sees up to 3^d nodes through up to 2^d elements; the existing ones determine the entries
    of its rows. Elements and nodes are counted with x fastest; an element's nodes likewise.
    """

    counts: tuple[int, ...]
    per_node: int
    present: Any

    @property
    def _ndim(self) -> int:
        return len(self.counts)

    @property
    def n_grid(self) -> int:
        """Number of nodes of the full grid."""
        return int(np.prod([n + 1 for n in self.counts]))

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

    def coordinates(self, lengths: Sequence[float]) -> FloatArray:
        """Return the coordinates (n_nodes, d) of `nodes` when the grid has the given lengths."""
        steps = [n * (np.arange(k + 1) / k) for n, k in zip(lengths, self.counts, strict=True)]
        axes = np.meshgrid(*steps[::-1], indexing="ij")[::-1]
        return np.column_stack([axis.ravel()[self.nodes] for axis in axes])

    @property
    def corners(self) -> IntArray:
        """The corners (2^d, d) of an element, x fastest."""
        return np.array([c[::-1] for c in product((0, 1), repeat=self._ndim)])

    def _corner_values(self, values: Any) -> Any:
        """Return (n_grid, 2^d): the value of the element in which a node is corner c; 0 outside."""
        padded = np.pad(np.asarray(values), 1)
        shape = tuple(n + 1 for n in self.counts[::-1])
        found = np.empty((self.n_grid, 2**self._ndim), dtype=padded.dtype)
        for c, corner in enumerate(self.corners):
            window = tuple(
                slice(1 - o, 1 - o + n) for o, n in zip(corner[::-1], shape, strict=True)
            )
            found[:, c] = padded[window].ravel()
        return found

    @cached_property
    def _offsets(self) -> IntArray:
        """Which neighbour (2^d, 2^d) corner e of an element is, seen from its corner c."""
        steps = self.corners[None, :] - self.corners[:, None] + 1
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
        strides = np.cumprod([1, *(n + 1 for n in self.counts[:-1])])
        steps = np.array([s[::-1] for s in product((-1, 0, 1), repeat=d)]) @ strides
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
