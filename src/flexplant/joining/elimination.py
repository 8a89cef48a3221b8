"""Rigid joints eliminated: which coordinates follow, and how, by QR with column pivoting."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..errors import warn
from ..values import FloatArray, IntArray

#: a diagonal entry of R below this part of the first one is none: the joint repeats others
_RANK = 1e-8
#: below this part, it nearly is
_DOUBTFUL = 1e-5
#: how much later components come first among those that follow; far above rounding
_LATER, _WITHIN = 1e-2, 1e-4
#: of the heaviest in its constraint: a coordinate that may follow without looking for a better one
_HEAVY = 0.3
#: relative: entries of the expansion below this are rounding
_ROUNDING = 1e-15


class Elimination(NamedTuple):
    """Coordinates (n,) that fulfil constraints, by those that are left (k,): ``q = T q_k``."""

    T: sp.csc_array
    kept: IntArray
    rank: int


def eliminated(B: sp.csr_array, size: FloatArray, order: IntArray) -> Elimination:
    """Return the motions that fulfil ``B q = 0``.

    Coordinates that no constraint names are left alone, one that a single constraint names follows
    it, and of the others, constraints that share no coordinate are solved apart: sparse matrices
    stay sparse.
    """
    n = B.shape[1]
    lead = _own_followers(B, size, order)
    plain = lead >= 0
    first = _by_blocks(B[~plain], size, order)
    # those that one constraint alone names follow it, whatever the others say
    leads = lead[plain]
    some = sp.csr_array(B[plain])
    pivot = some[np.arange(leads.size), leads]
    rest = sp.csr_array(sp.diags_array(-1.0 / pivot) @ some) if leads.size else some
    still = np.ones(n)
    still[leads] = 0.0
    place = sp.csr_array((np.ones(leads.size), (leads, np.arange(leads.size))), (n, leads.size))
    follow = sp.diags_array(still) + place @ rest @ sp.diags_array(still)
    left = still[first.kept] > 0
    T = sp.csc_array(follow @ first.T[:, np.flatnonzero(left)])
    return Elimination(T, first.kept[left], first.rank + leads.size)


def _own_followers(B: Any, size: FloatArray, order: IntArray) -> IntArray:
    """Return for each constraint (m,) the coordinate that it alone names, or -1."""
    part = sp.coo_array(B)
    rows, columns = part.coords
    weight = np.abs(part.data) / size[columns]
    most = np.zeros(B.shape[0])
    np.maximum.at(most, rows, weight)
    alone = np.bincount(columns, minlength=B.shape[1])[columns] == 1
    alone &= weight >= _HEAVY * most[rows]
    found = np.full(B.shape[0], -1, dtype=np.int64)
    chosen = np.flatnonzero(alone)
    chosen = chosen[np.lexsort((columns[chosen], order[columns[chosen]]))]
    found[rows[chosen]] = columns[chosen]  # of several, the last one stays
    return found


def _by_blocks(B: Any, size: FloatArray, order: IntArray) -> Elimination:
    """Return the motions that fulfil constraints, solved apart where they share no coordinate."""
    n = B.shape[1]
    touched = np.unique(B.indices).astype(np.int64)
    follow, rows, columns, values = [np.zeros(0, np.int64)], [], [], []
    for some, own in _blocks(B, touched):
        lead, X = _solved(B[some][:, own].toarray(), size[own], order[own])
        rest = np.setdiff1d(np.arange(own.size), lead)
        i, j = np.nonzero(X)
        follow.append(own[lead])
        rows.append(own[lead[i]])
        columns.append(own[rest[j]])
        values.append(X[i, j])
    gone = np.concatenate(follow)
    kept = np.setdiff1d(np.arange(n), gone)
    place = np.zeros(n, dtype=np.int64)
    place[kept] = np.arange(kept.size)
    entries = np.concatenate([np.ones(kept.size), *values])
    where = (np.concatenate([kept, *rows]), place[np.concatenate([kept, *columns])])
    return Elimination(sp.csc_array((entries, where), shape=(n, kept.size)), kept, gone.size)


def _blocks(B: Any, touched: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Return the rows and columns of constraints that share coordinates."""
    m = B.shape[0]
    if not m:
        return []
    part = B[:, touched]
    graph = sp.block_array([[None, part], [part.T, None]], format="csr")
    count, label = csgraph.connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    ends = np.cumsum(np.bincount(label, minlength=count))[:-1]
    groups = np.split(order, ends)
    return [(group[group < m], touched[group[group >= m] - m]) for group in groups]


def _solved(block: FloatArray, size: FloatArray, order: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the columns that follow (r,) and how: ``q_lead = X q_rest``."""
    k = block.shape[1]
    scaled = block / size
    scaled = scaled / np.linalg.norm(scaled, axis=1)[:, None]
    # equally good pivots must not hang on rounding
    prefer = 1.0 + _LATER * order / (order.max() + 1) + _WITHIN * np.arange(k) / k
    R, pivots = la.qr(scaled * prefer, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > _RANK * diagonal[0]))
    if rank and diagonal[rank - 1] < _DOUBTFUL * diagonal[0]:
        warn(
            f"joints nearly repeat each other (a pivot is {diagonal[rank - 1] / diagonal[0]:.1g} "
            "of the first): coordinates with few digits make them stiffer than they are. Join "
            "fewer axes."
        )
    lead = np.asarray(pivots[:rank], dtype=np.int64)
    rest = np.setdiff1d(np.arange(k), lead)
    rows = np.arange(block.shape[0])
    if rank < rows.size:  # those that decide
        rows = la.qr(scaled[:, lead].T, mode="r", pivoting=True)[1][:rank]
    X = np.linalg.solve(scaled[rows][:, lead], -scaled[rows][:, rest])
    X[np.abs(X) < _ROUNDING * np.abs(X).max(initial=0.0)] = 0.0
    return lead, X * size[lead][:, None] ** -1 * size[rest] if rank else X
