"""Matrices of equal elements on a regular grid, written row by row: no triplets to sort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp

from ...checks import FloatArray, IntArray

#: so many numbers at once: more of them no longer fit the cache
_CHUNK = 100_000


@dataclass(frozen=True, eq=False)
class Grid:
    """A line, rectangle or box of elements, of which some may be missing.

    A node sees up to 3^d nodes through up to 2^d elements; which of these exist decides what its
    rows hold. Elements and nodes are counted with x fastest; an element's nodes likewise.
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
        # the DOFs of all neighbours of a node, once for each of its own columns
        block = (first[:, None] + np.arange(f, dtype=wide)).ravel()
        indices = _repeated_blocks(block, f * per_node, f)
        pointer = np.zeros(self.n_dof + 1, dtype=wide)
        np.cumsum(np.repeat(f * per_node, f), out=pointer[1:])
        for part in (indices, pointer):
            part.flags.writeable = False
        return indices, pointer

    def matrix(self, terms: Sequence[tuple[FloatArray, Any]]) -> sp.csc_array:
        """Return the sum of element matrices, each term weighted element by element."""
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
        done, step = 0, max(1, _CHUNK // flat.shape[1])
        for start in range(0, self.nodes.size, step):
            some = slice(start, start + step)
            values = _weighted(weight_of[some], flat).reshape(-1, f, n_seen, f)
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


def _weighted(weights: FloatArray, table: FloatArray) -> FloatArray:
    """Return weights @ table, summed in one order: the matrix is symmetric to the last bit.

    BLAS may fuse a product with a sum, and then (w e)_1 + (w e)_2 depends on which one comes first.
    """
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
    # runs of equal blocks are copied at once: on a grid there are few kinds of nodes
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        step = max(1, 20 * _CHUNK // (length * times))
        for k in range(0, chosen.size, step):
            some = chosen[k : k + step]
            inside = np.arange(length)
            part = values[starts[some][:, None] + inside]
            for j in range(times):
                found[(times * starts[some] + j * length)[:, None] + inside] = part
    return found
