"""Nested dissection: an elimination order with little fill, and the tree of its fronts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..checks import FloatArray, IntArray

#: a part of fewer DOFs is eliminated as one dense block
LEAF = 96
#: a node with this many times the mean number of neighbours (a spider, a constraint) goes last
_HUB = 20
#: a first separator with more than this part of the nodes: the coordinates do not fit the graph
_USELESS = 0.25
#: multiplications of a factorisation for each entry of the factor from which on it is costly
_COSTLY = 350.0
#: points from which distances through the graph stand in for missing coordinates
_LANDMARKS = 8


@dataclass(frozen=True)
class Front:
    """One dense block of the elimination: DOFs `first` to `last` of the order, and what they touch.

    `rows` are the later DOFs (in the order, ascending) in the same columns, `children` the fronts
    whose remainders are added before this one is eliminated.
    """

    first: int
    last: int
    rows: IntArray
    children: tuple[int, ...]


@dataclass(frozen=True)
class Dissection:
    """An elimination order: DOF `order[i]` comes i-th; the fronts, children before parents."""

    order: IntArray
    fronts: tuple[Front, ...]

    @property
    def n_factor(self) -> int:
        """Entries of the factor, the diagonal blocks counted as squares."""
        return int(sum((f.last - f.first) * (f.last - f.first + f.rows.size) for f in self.fronts))

    @property
    def is_costly(self) -> bool:
        """Whether single precision pays: a factorisation costs far more than solutions with it.

        So it is for bulky structures, whose modes are also not lost in its rounding.
        """
        sizes = ((float(f.last - f.first), float(f.rows.size)) for f in self.fronts)
        work = sum(p * (p * p / 6 + q * (p + q) / 2) for p, q in sizes)
        return work > _COSTLY * self.n_factor


def dissect(
    matrix: sp.csc_array,
    nodes: IntArray | None = None,
    xyz: FloatArray | None = None,
    *,
    leaf: int = LEAF,
) -> Dissection:
    """Return the nested dissection of a symmetric matrix.

    Parts are cut in two across their longest side, through the median; the nodes on one side that
    touch the other come after both [George1973]_.
    """
    n = matrix.shape[0]
    if nodes is None:
        nodes = np.arange(n)
    _, first, member = np.unique(nodes, return_index=True, return_inverse=True)
    width = np.bincount(member)
    graph = _node_graph(matrix, member, width.size)
    degree = np.diff(graph.indptr)
    hubs = degree > _HUB * max(8.0, float(degree.mean()))
    parts = None
    if xyz is not None:
        parts = _bisect(graph, xyz[first], width, hubs, leaf)
    if parts is None or parts.worst > _USELESS * width.size:
        other = _bisect(graph, graph_coordinates(graph), width, hubs, leaf)
        if parts is None or other.worst < parts.worst:
            parts = other
    return _fronts(graph, parts, member, width)


def _node_graph(matrix: sp.csc_array, member: IntArray, count: int) -> sp.csr_array:
    """Return the graph of nodes (without loops) of a matrix of DOFs."""
    member = member.astype(np.int32)
    columns = np.repeat(member, np.diff(matrix.indptr))
    rows = member[matrix.indices]
    off = rows != columns
    rows, columns = rows[off], columns[off]
    edges: Any = sp.csr_array(
        (np.ones(rows.size, dtype=np.int8), (np.maximum(rows, columns), np.minimum(rows, columns))),
        shape=(count, count),
    )
    edges.data = np.ones(edges.indices.size, dtype=np.int8)
    return sp.csr_array(edges + edges.T)


def graph_coordinates(graph: sp.csr_array) -> FloatArray:
    """Return coordinates (n, 3) of a graph's nodes from distances to a few far-apart ones.

    Classical scaling of the distances to landmarks [deSilvaTenenbaum2004]_;
    components that do not touch lie beside each other.
    """
    n = graph.shape[0]
    count, component = csgraph.connected_components(graph, directed=False)
    found = np.zeros((n, 3))
    for c in range(min(count, 64)):  # beyond, many small pieces: any order is good
        inside = np.flatnonzero(component == c)
        part: Any = graph[inside][:, inside] if count > 1 else graph
        found[inside] = _scaled_distances(sp.csr_array(part))
    return found + np.outer(component, [2.0 * n, 0.0, 0.0])


def _scaled_distances(graph: sp.csr_array) -> FloatArray:
    n = graph.shape[0]
    if n < 4:
        return np.column_stack([np.arange(n, dtype=np.float64), np.zeros(n), np.zeros(n)])
    unit = sp.csr_array((np.ones(graph.indices.size), graph.indices, graph.indptr), shape=(n, n))
    distance = np.zeros((n, 0))
    start = int(np.argmax(_distances(unit, 0)))
    for _ in range(min(_LANDMARKS, n)):
        distance = np.column_stack([distance, _distances(unit, start)])
        start = int(np.argmax(distance.min(axis=1)))
    square = distance**2
    centred = square - square.mean(axis=0)
    _, _, right = np.linalg.svd(centred[:: max(1, n // 4000)], full_matrices=False)
    coordinates = centred @ right[:3].T
    return np.pad(coordinates, ((0, 0), (0, 3 - coordinates.shape[1])))


def _distances(graph: sp.csr_array, start: int) -> FloatArray:
    """Return the number of steps from a node to each other, breadth first."""
    order, before = csgraph.breadth_first_order(graph, start, directed=False)
    steps = np.zeros(graph.shape[0])
    # predecessors come first in the order: levels follow by doubling of the jumps
    jump = np.where(before < 0, start, before).astype(np.int64)
    length = np.where(before < 0, 0, 1).astype(np.int64)
    length[start] = 0
    jump[start] = start
    while np.any(jump[order] != start):
        length = length + length[jump]
        jump = jump[jump]
    length = length + length[jump]
    steps[order] = length[order]
    return steps


@dataclass(frozen=True)
class _Parts:
    """Each node's part (heap numbers: part p is cut into 2p and 2p + 1), and its place in it."""

    part: IntArray
    place: IntArray
    worst: int


def _bisect(graph: sp.csr_array, xyz: FloatArray, width: IntArray, hubs: Any, leaf: int) -> _Parts:
    """Cut all parts of a level at once, until each is a leaf."""
    n = width.size
    where = _unit_box(xyz)
    part = np.ones(n, dtype=np.int64)
    live = ~hubs
    place = _morton(where)
    heads = np.repeat(np.arange(n), np.diff(graph.indptr))
    tails = graph.indices.astype(np.int64)
    once = (heads < tails) & live[heads] & live[tails]
    heads, tails = heads[once], tails[once]
    worst = int(np.count_nonzero(hubs))
    while True:
        inside = np.flatnonzero(live)
        if not inside.size:
            break
        # parts left, numbered 0, 1, ...
        names, number = np.unique(part[inside], return_inverse=True)
        size = np.bincount(number, weights=width[inside])
        cut = (size > leaf) & (np.bincount(number) > 1)
        live[inside[~cut[number]]] = False
        inside, number = inside[cut[number]], number[cut[number]]
        if not inside.size:
            break
        upper = np.zeros(n, dtype=bool)
        upper[inside[_upper_half(where[inside], number, names.size)]] = True
        keep = live[heads] & live[tails]
        heads, tails = heads[keep], tails[keep]
        across = upper[heads] != upper[tails]
        a, b = heads[across], tails[across]
        low, high = np.where(upper[a], b, a), np.where(upper[a], a, b)
        slot = np.zeros(n, dtype=np.int64)
        slot[inside] = number
        low, high = np.unique(low), np.unique(high)
        # of the two shores of the cut the one with fewer DOFs
        few = np.bincount(slot[high], weights=width[high], minlength=names.size) < np.bincount(
            slot[low], weights=width[low], minlength=names.size
        )
        between = np.concatenate([low[~few[slot[low]]], high[few[slot[high]]]])
        if part[inside[0]] == 1 and between.size:
            worst = max(worst, between.size)
        live[between] = False
        rest = inside[live[inside]]
        part[rest] = 2 * part[rest] + upper[rest]
        keep = live[heads] & live[tails] & ~across
        heads, tails = heads[keep], tails[keep]
    return _Parts(part, place, worst)


def _unit_box(xyz: FloatArray) -> FloatArray:
    spread = np.ptp(xyz, axis=0)
    box = (xyz - xyz.min(axis=0)) / (spread.max() or 1.0)
    # what rounding separates belongs to one row of nodes
    return np.asarray(np.round(box, 9), dtype=np.float64)


def _upper_half(where: FloatArray, number: IntArray, count: int) -> Any:
    """Return a mask of the nodes beyond the median of their part, along its longest side."""
    by_part = np.argsort(number, kind="stable")
    begin = np.searchsorted(number[by_part], np.arange(count + 1))
    filled = np.flatnonzero(np.diff(begin) > 0)
    starts = begin[filled]
    ordered = where[by_part]
    side = np.maximum.reduceat(ordered, starts) - np.minimum.reduceat(ordered, starts)
    axis = np.zeros(count, dtype=np.int64)
    axis[filled] = np.argmax(side, axis=1)
    along = where[np.arange(number.size), axis[number]]
    rank = np.lexsort((along, number))
    middle = (begin[:-1] + begin[1:]) // 2
    level = np.zeros(count)
    level[filled] = along[rank[middle[filled]]]
    lowest = np.zeros(count)
    lowest[filled] = along[rank[starts]]
    # a whole row of equal coordinates goes to one side, unless one side would be empty
    upper = np.where(level[number] > lowest[number], along >= level[number], along > level[number])
    flat = np.zeros(count, dtype=bool)
    flat[filled] = side.max(axis=1) <= 0
    if np.any(flat):
        position = np.empty(number.size, dtype=np.int64)
        position[rank] = np.arange(number.size)
        upper = np.where(flat[number], position >= middle[number], upper)
    return upper


def _morton(where: FloatArray) -> IntArray:
    """Return the rank of points along a space-filling curve: neighbours come close together."""
    cells = np.minimum((where * 1024).astype(np.int64), 1023)
    code = np.zeros(cells.shape[0], dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    rank = np.empty(code.size, dtype=np.int64)
    rank[np.argsort(code, kind="stable")] = np.arange(code.size)
    return rank


def _fronts(graph: sp.csr_array, parts: _Parts, member: IntArray, width: IntArray) -> Dissection:
    """Order the nodes part by part, children first, and find what each part touches."""
    names = np.unique(parts.part)
    names = names[np.argsort(_postorder_key(names), kind="stable")]
    rank = np.empty(names.size, dtype=np.int64)
    by_name = np.argsort(names)
    number = by_name[np.searchsorted(names[by_name], parts.part)]
    sequence = np.lexsort((parts.place, number))
    position = np.empty(width.size, dtype=np.int64)
    position[sequence] = np.arange(width.size)
    starts = np.searchsorted(number[sequence], np.arange(names.size + 1))
    rank[:] = np.arange(names.size)
    where = {int(name): k for k, name in enumerate(names)}
    parent = np.full(names.size, -1)
    for k, name in enumerate(names.tolist()):
        above = name >> 1
        while above and above not in where:
            above >>= 1
        parent[k] = where.get(above, -1)
    structure = _structures(graph, sequence, position, starts, parent)
    children: list[list[int]] = [[] for _ in range(names.size)]
    for k, above in enumerate(parent.tolist()):
        if above >= 0:
            children[above].append(k)
    # from nodes to DOFs
    offset = np.concatenate([[0], np.cumsum(width[sequence])])
    order = np.argsort(position[member], kind="stable")
    fronts = []
    for k in range(names.size):
        rows = structure[k]
        fronts.append(
            Front(
                int(offset[starts[k]]),
                int(offset[starts[k + 1]]),
                spread(offset[rows], offset[rows + 1]),
                tuple(children[k]),
            )
        )
    return Dissection(order, tuple(fronts))


def spread(begin: IntArray, end: IntArray) -> IntArray:
    """Return the numbers of all intervals [begin, end), one after the other."""
    length = end - begin
    total = int(length.sum())
    if not total:
        return np.zeros(0, dtype=np.int64)
    jump = np.concatenate([[0], np.cumsum(length)[:-1]])
    return np.repeat(begin - jump, length) + np.arange(total)


def _postorder_key(names: IntArray) -> FloatArray:
    """Return keys that put the parts below a part before it: ends of intervals of [0, 1]."""
    depth = np.floor(np.log2(names)).astype(np.int64)
    deepest = int(depth.max())
    end = (names + 1) << (deepest - depth)
    # of parts that end together the deeper one comes first
    return np.asarray(end * (deepest + 2.0) + (deepest - depth), dtype=np.float64)


def _structures(
    graph: sp.csr_array,
    sequence: IntArray,
    position: IntArray,
    starts: IntArray,
    parent: IntArray,
) -> Sequence[IntArray]:
    """Return for each part the positions of the later nodes that it and its children touch."""
    ordered: Any = graph[sequence]
    touched = position[ordered.indices]
    pointer = ordered.indptr
    passed: list[list[IntArray]] = [[] for _ in range(parent.size)]
    found: list[IntArray] = []
    for k in range(parent.size):
        begin, end = starts[k], starts[k + 1]
        own = touched[pointer[begin] : pointer[end]]
        rows = np.unique(np.concatenate([own[own >= end], *passed[k]]))
        passed[k] = []
        rows = rows[rows >= end]
        found.append(rows)
        if parent[k] >= 0:
            passed[parent[k]].append(rows)
    return found
