"""Rigid joints eliminated: which coordinates follow, and how, by QR with column pivoting."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..errors import FlexplantWarning
from ..values import FloatArray, IntArray

#: a diagonal entry of R below this part of the first one is none: the joint repeats others
_RANK = 1e-8
#: below this part, it nearly is
_DOUBTFUL = 1e-5
#: how much later components come first among those that follow; far above rounding
_LATER, _WITHIN = 1e-2, 1e-4
#: relative: entries of the expansion below this are rounding
_ROUNDING = 1e-15


class Elimination(NamedTuple):
    """Coordinates (n,) that fulfil constraints, by those that are left (k,): ``q = T q_k``.

    Attributes
    ----------
    T : (n, k) sparse array
        The expansion: unit rows for those that are left.
    kept : (k,) array of int
        Which are left.
    rank : int
        How many constraints are independent.
    """

    T: sp.csc_array
    kept: IntArray
    rank: int


def eliminated(B: sp.csr_array, size: FloatArray, order: IntArray) -> Elimination:
    """Return the motions that fulfil ``B q = 0``.

    Coordinates that no constraint names are left alone, and constraints that share no coordinate
    are solved apart, so that sparse matrices stay sparse.

    Parameters
    ----------
    B : (m, n) sparse array
        The constraints.
    size : (n,) array
        How far each coordinate moves its component at most: makes them comparable.
    order : (n,) array of int
        Of equally good ones, the later follows: the number of the component.
    """
    n = B.shape[1]
    touched = np.unique(B.indices).astype(np.int64)
    entries: list[tuple[IntArray, IntArray, FloatArray]] = []
    rank = 0
    for rows, columns in _blocks(B, touched):
        block = B[rows][:, columns].toarray()
        lead, X = _solved(block, size[columns], order[columns])
        rest = np.setdiff1d(np.arange(columns.size), lead)
        i, j = np.nonzero(X)
        entries.append((columns[lead[i]], columns[rest[j]], X[i, j]))
        rank += lead.size
        entries.append((columns[lead], np.zeros(0, np.int64), np.zeros(0)))
    follow = np.concatenate([np.zeros(0, np.int64), *(e[0] for e in entries[1::2])])
    kept = np.setdiff1d(np.arange(n), follow)
    place = np.zeros(n, dtype=np.int64)
    place[kept] = np.arange(kept.size)
    rows = np.concatenate([kept, *(e[0] for e in entries[::2])])
    columns = np.concatenate([place[kept], *(place[e[1]] for e in entries[::2])])
    values = np.concatenate([np.ones(kept.size), *(e[2] for e in entries[::2])])
    T = sp.csc_array((values, (rows, columns)), shape=(n, kept.size))
    return Elimination(T, kept, rank)


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
        warnings.warn(
            f"joints nearly repeat each other (a pivot is {diagonal[rank - 1] / diagonal[0]:.1g} "
            "of the first): coordinates with few digits make them stiffer than they are. Join "
            "fewer axes.",
            FlexplantWarning,
            4,
        )
    lead = np.asarray(pivots[:rank], dtype=np.int64)
    rest = np.setdiff1d(np.arange(k), lead)
    rows = np.arange(block.shape[0])
    if rank < rows.size:  # those that decide
        rows = la.qr(scaled[:, lead].T, mode="r", pivoting=True)[1][:rank]
    X = np.linalg.solve(scaled[rows][:, lead], -scaled[rows][:, rest])
    X[np.abs(X) < _ROUNDING * np.abs(X).max(initial=0.0)] = 0.0
    return lead, X * size[lead][:, None] ** -1 * size[rest] if rank else X
