"""Nested dissection: an elimination order with little fill, and the tree of its fronts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..arrays import BoolArray, FloatArray, IntArray

#: number of DOFs below which a part is eliminated as one dense block: with 40, twice as many fronts
#: take 30 % longer; with 96 the factor of a plate has 16 % more entries
LEAF = 64
#: number of neighbours, relative to the mean, above which a node is eliminated last (a constraint)
_HUB = 20
#: ratio of the first separator by coordinates to that by the graph, above which the coordinates do
#: not fit the graph (a rolled-up shell has 2.5, boxes have 1.0 to 1.1)
_USELESS = 1.3
#: multiplications per entry of the factor above which a factorisation counts as costly
_COSTLY = 350.0
#: number of averages over neighbours of a distance in the graph: 10 to 40 give the same fill within
#: 1 %
_AVERAGES = 20
#: fraction of the nodes on either side of the middle among which the smallest separator is searched
_BAND = 0.05
#: least fraction of the DOFs on a side; below it the cut goes through the middle
_LEAST_SIDE = 0.15
#: capacity of edges that must not be cut: above any flow, below the limit of 32-bit integers
_UNCUT = 2**30


@dataclass(frozen=True)
class Front:
    """One dense block of the elimination: DOFs `first` to `last` of the order, and touched DOFs.

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
    def multiplications(self) -> float:
        """Number of multiplications of one factorisation."""
        sizes = ((float(f.last - f.first), float(f.rows.size)) for f in self.fronts)
        return sum(p * (p * p / 6 + q * (p + q) / 2) for p, q in sizes)

    @property
    def is_costly(self) -> bool:
        """Whether single precision is faster: factors cost far more than solutions with them."""
        # this holds for bulky structures, whose modes also stand out from its rounding
        return self.multiplications > _COSTLY * self.n_factor


def dissect(
    matrix: sp.csc_array,
    nodes: IntArray | None = None,
    xyz: FloatArray | None = None,
    *,
    leaf: int = LEAF,
) -> Dissection:
    """Return the nested dissection of a symmetric matrix [George1973]_."""
    # where coordinates fit the graph, parts are cut across their longest side; otherwise along the
    # graph (`_graph_cut`), which takes eight times as long
    if nodes is None:
        nodes = _supervariables(matrix)
    _, first, member = np.unique(nodes, return_index=True, return_inverse=True)
    width = np.bincount(member)
    graph = _node_graph(matrix, member, width.size)
    degree = np.diff(graph.indptr)
    hubs = degree > _HUB * max(8.0, float(degree.mean()))
    cut: _Cut = _graph_cut
    place = np.arange(width.size)
    if xyz is not None:
        where = _unit_box(xyz[first])
        across = _coordinate_cut(where)
        sizes = [
            _bisect(graph, width, hubs, leaf, way, levels=1).separator for way in (across, cut)
        ]
        if sizes[0] <= _USELESS * sizes[1]:
            cut, place = across, _morton(where)
    return _fronts(graph, _bisect(graph, width, hubs, leaf, cut), place, member, width)


def _supervariables(matrix: sp.csc_array) -> IntArray:
    """Return a number for each DOF, equal for DOFs that touch each other and the same others."""
    # the DOFs of a node have this property; sums of a random integer for each touched DOF identify
    # them. Where few are equal (elements whose axes do not couple), groups of unequal sizes cost
    # fill
    n = matrix.shape[0]
    lower: Any = sp.tril(matrix, -1, format="csc")
    lower = sp.csc_array((np.ones(lower.nnz, np.int64), lower.indices, lower.indptr), shape=(n, n))
    key = np.random.default_rng(0).integers(2**62, size=n)
    names, alike = np.unique(key + lower @ key + lower.T @ key, return_inverse=True)
    return np.asarray(alike) if names.size < 0.6 * n else np.arange(n)


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


@dataclass(frozen=True)
class _GraphLevel:
    """Nodes of one level of cuts, the part (0, 1, ...) and width of each, edges inside parts.

    `heads` and `tails` are positions in `nodes`, each edge once.
    """

    nodes: IntArray
    part: IntArray
    width: IntArray
    heads: IntArray
    tails: IntArray

    def dofs(self, chosen: BoolArray) -> FloatArray:
        """Return the number of DOFs of the chosen nodes in each part."""
        count = int(self.part.max()) + 1
        found: Any = np.bincount(self.part[chosen], self.width[chosen], minlength=count)
        return np.asarray(found, dtype=np.float64)


#: function that cuts the parts of a level: masks over its nodes for upper sides and separators
_Cut = Callable[[_GraphLevel], tuple[BoolArray, BoolArray]]


@dataclass(frozen=True)
class _Parts:
    """Each node's part (part p is cut into 2p and 2p + 1), and the nodes of the first separator."""

    part: IntArray
    separator: int


def _bisect(
    graph: sp.csr_array, width: IntArray, hubs: BoolArray, leaf: int, cut: _Cut, levels: int = 62
) -> _Parts:
    """Cut all parts of a level at once, until each is a leaf."""
    n = width.size
    part = np.ones(n, dtype=np.int64)
    live = ~hubs
    heads = np.repeat(np.arange(n), np.diff(graph.indptr))
    tails = graph.indices.astype(np.int64)
    once = heads < tails
    heads, tails = heads[once], tails[once]
    local = np.zeros(n, dtype=np.int64)
    separator = 0
    for depth in range(levels):
        nodes = np.flatnonzero(live)
        _, number = np.unique(part[nodes], return_inverse=True)
        large = np.bincount(number, weights=width[nodes]) > leaf
        large &= np.bincount(number) > 1
        live[nodes[~large[number]]] = False
        nodes = nodes[large[number]]
        if not nodes.size:
            break
        local[nodes] = np.arange(nodes.size)
        inside = live[heads] & live[tails]
        heads, tails = heads[inside], tails[inside]
        _, number = np.unique(part[nodes], return_inverse=True)
        level = _GraphLevel(nodes, number, width[nodes], local[heads], local[tails])
        upper, between = cut(level)
        if depth == 0:
            separator = int(np.count_nonzero(between))
        live[nodes[between]] = False
        part[nodes[~between]] = 2 * part[nodes[~between]] + upper[~between]
    return _Parts(part, separator)


def _smaller_shore(level: _GraphLevel, upper: BoolArray) -> BoolArray:
    """Return the nodes on one side that touch the other, of the side with fewer such DOFs."""
    across = upper[level.heads] != upper[level.tails]
    heads, tails = level.heads[across], level.tails[across]
    shore = np.zeros(upper.size, dtype=bool)
    shore[heads] = shore[tails] = True
    few = level.dofs(shore & upper) < level.dofs(shore & ~upper)
    chosen: BoolArray = shore & (upper == few[level.part])
    return chosen


def _coordinate_cut(where: FloatArray) -> _Cut:
    """Return the cut through the median of the longest side."""

    def cut(level: _GraphLevel) -> tuple[BoolArray, BoolArray]:
        upper = _upper_half(where[level.nodes], level.part)
        return upper, _smaller_shore(level, upper)

    return cut


def _graph_cut(level: _GraphLevel) -> tuple[BoolArray, BoolArray]:
    """Return the smallest separator near the middle of the longest way through each part."""
    # its nodes are the minimum cut of the flow through a band of nodes, each with a capacity equal
    # to its number of DOFs (Menger's theorem), for all parts in one network
    piece, along = _long_axis(level)
    order = np.lexsort((along, piece, level.part))
    begin = np.searchsorted(level.part[order], np.arange(int(level.part.max()) + 2))
    rank = np.empty(order.size)
    rank[order] = np.arange(order.size)
    rank = (rank + 0.5 - begin[level.part]) / np.diff(begin)[level.part]
    half = rank >= 0.5
    low, high = rank < 0.5 - _BAND, rank > 0.5 + _BAND
    touching = (low[level.heads] & high[level.tails]) | (high[level.heads] & low[level.tails])
    band = ~(low | high)
    band[level.heads[touching]] = band[level.tails[touching]] = True
    upper, between = _minimum_cut(level, low & ~band, high & ~band, band)
    whole = level.dofs(np.ones_like(upper))
    sides = np.minimum(level.dofs(upper), level.dofs(~upper & ~between))
    lopsided = (sides < _LEAST_SIDE * whole)[level.part]
    upper = np.where(lopsided, half, upper)
    return upper, np.where(lopsided, _smaller_shore(level, half), between)


def _long_axis(level: _GraphLevel) -> tuple[IntArray, FloatArray]:
    """Return each node's connected piece, and a coordinate along the longest way through it."""
    # the difference of the distances to two far ends, averaged over neighbours: steps towards the
    # vector of Fiedler [Fiedler1973]_, whose level sets are smaller than those of distances
    n = level.nodes.size
    ends = (np.r_[level.heads, level.tails], np.r_[level.tails, level.heads])
    graph = sp.csr_array((np.ones(ends[0].size), ends), shape=(n, n))
    count, piece = csgraph.connected_components(graph, directed=False)

    def farthest(distance: FloatArray) -> IntArray:
        order = np.lexsort((distance, piece))
        return order[np.searchsorted(piece[order], np.arange(count), side="right") - 1]

    def distance(starts: IntArray) -> FloatArray:
        return _steps(graph, starts)

    one = farthest(distance(farthest(np.zeros(n))))
    from_one = distance(one)
    along = from_one - distance(farthest(from_one))
    neighbours = graph.sum(axis=1) + 1.0
    for _ in range(_AVERAGES):
        along = (graph @ along + along) / neighbours
    return piece.astype(np.int64), along


def _steps(graph: sp.csr_array, starts: IntArray) -> FloatArray:
    """Return the number of steps from each node to the nearest of some, breadth first."""
    n = graph.shape[0]
    pointer = np.r_[graph.indptr, graph.indptr[-1] + starts.size]
    indices = np.r_[graph.indices, starts].astype(graph.indices.dtype)
    source = sp.csr_array((np.ones(indices.size), indices, pointer), shape=(n + 1, n + 1))
    order, jump = csgraph.breadth_first_order(source, n)
    jump[n] = n
    steps = np.ones(n + 1)
    steps[n] = 0.0
    while np.any(jump[order] != n):  # each jump passes twice as many steps as the one before
        steps, jump = steps + steps[jump], jump[jump]
    return steps[:n] - 1.0


def _minimum_cut(
    level: _GraphLevel, low: BoolArray, high: BoolArray, band: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Return the upper sides and the smallest separator in the band between `low` and `high`."""
    # node k of the band is an edge from k to m + k; of the two cuts nearest to `low` and to `high`,
    # the one with more equal sides is taken for each part
    nodes = np.flatnonzero(band)
    m = nodes.size
    local = np.zeros(band.size, dtype=np.int64)
    local[nodes] = np.arange(m)
    heads, tails = np.r_[level.heads, level.tails], np.r_[level.tails, level.heads]
    within = band[heads] & band[tails]
    first = local[np.unique(tails[low[heads] & band[tails]])]
    last = local[np.unique(heads[high[tails] & band[heads]])]
    source, sink = 2 * m, 2 * m + 1
    begin = np.r_[local[heads[within]] + m, np.arange(m), np.full(first.size, source), last + m]
    end = np.r_[local[tails[within]], np.arange(m) + m, first, np.full(last.size, sink)]
    capacity = np.full(begin.size, _UNCUT, dtype=np.int32)
    capacity[np.count_nonzero(within) :][:m] = level.width[nodes]
    network = sp.csr_array((capacity, (begin, end)), shape=(2 * m + 2, 2 * m + 2))
    left: Any = network - csgraph.maximum_flow(network, source, sink).flow
    left.data = (left.data > 0).astype(np.int8)
    left.eliminate_zeros()
    found = []
    for graph, start in ((left, source), (sp.csr_array(left.T), sink)):
        reached = np.zeros(2 * m + 2, dtype=bool)
        reached[csgraph.breadth_first_order(graph, start, return_predecessors=False)] = True
        below = reached if start == source else ~reached
        upper, between = high.copy(), np.zeros_like(high)
        between[nodes] = below[:m] & ~below[m : 2 * m]
        upper[nodes] = ~below[:m]
        found.append((upper, between))
    unequal = [abs(level.dofs(up) - level.dofs(~up & ~cut)) for up, cut in found]
    later = (unequal[1] < unequal[0])[level.part]
    return np.where(later, found[1][0], found[0][0]), np.where(later, found[1][1], found[0][1])


def _unit_box(xyz: FloatArray) -> FloatArray:
    spread = np.ptp(xyz, axis=0)
    box = (xyz - xyz.min(axis=0)) / (spread.max() or 1.0)
    # nodes that only rounding separates belong to one row
    return np.asarray(np.round(box, 9), dtype=np.float64)


def _upper_half(where: FloatArray, number: IntArray) -> BoolArray:
    """Return a mask of the nodes beyond the median of each part, along its longest side."""
    count = int(number.max()) + 1
    by_part = np.argsort(number, kind="stable")
    begin = np.searchsorted(number[by_part], np.arange(count + 1))
    starts = begin[:-1]
    ordered = where[by_part]
    side = np.maximum.reduceat(ordered, starts) - np.minimum.reduceat(ordered, starts)
    axis = np.argmax(side, axis=1)
    along = where[np.arange(number.size), axis[number]]
    rank = np.lexsort((along, number))
    middle = (begin[:-1] + begin[1:]) // 2
    level, lowest = along[rank[middle]], along[rank[starts]]
    # a whole row of equal coordinates goes to one side, unless one side would be empty
    upper: BoolArray = np.where(
        level[number] > lowest[number], along >= level[number], along > level[number]
    )
    flat = side.max(axis=1) <= 0
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


def _fronts(
    graph: sp.csr_array, parts: _Parts, place: IntArray, member: IntArray, width: IntArray
) -> Dissection:
    """Order the nodes part by part, children first, and find the nodes that each part touches."""
    names = np.unique(parts.part)
    names = names[np.argsort(_postorder_key(names), kind="stable")]
    rank = np.empty(names.size, dtype=np.int64)
    by_name = np.argsort(names)
    number = by_name[np.searchsorted(names[by_name], parts.part)]
    sequence = np.lexsort((place, number))
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
                interval_numbers(offset[rows], offset[rows + 1]),
                tuple(children[k]),
            )
        )
    return Dissection(order, tuple(fronts))


def interval_numbers(begin: IntArray, end: IntArray) -> IntArray:
    """Return the numbers of all intervals [begin, end), one after the other."""
    length = end - begin
    total = int(length.sum())
    if not total:
        return np.zeros(0, dtype=np.int64)
    jump = np.concatenate([[0], np.cumsum(length)[:-1]])
    return np.repeat(begin - jump, length) + np.arange(total)


def _postorder_key(names: IntArray) -> FloatArray:
    """Return keys that sort subparts before their part: ends of intervals of [0, 1]."""
    depth = np.floor(np.log2(names)).astype(np.int64)
    deepest = int(depth.max())
    end = (names + 1) << (deepest - depth)
    # among parts that end together the deeper one comes first
    return np.asarray(end * (deepest + 2.0) + (deepest - depth), dtype=np.float64)


def _structures(
    graph: sp.csr_array, sequence: IntArray, position: IntArray, starts: IntArray, parent: IntArray
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
