"""Which parts of a structure are connected."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..labels import DofSet
from ..sparse.factor import by_rows, diagonal
from ..values import IntArray

#: more motions of all bodies together than this are not listed: full columns would fill the memory
_MOST_MOTIONS = 2000


def pieces(K: Any, M: Any, dofs: DofSet | None) -> IntArray:
    """Return the number (n,) of the piece each DOF belongs to, 0 being the largest.

    Pieces are joined by no entry of K or M, the DOFs of one node counting as joined.
    """
    # step by step, each among the parts found before: most structures are whole after the first
    label: Any = csgraph.connected_components(sp.csr_array(by_rows(K)), directed=False)[1]
    if M is not None and label.max(initial=0) > 0:
        entries = sp.coo_array(M)
        label = _joined(label, *entries.coords)
    if dofs is not None and label.max(initial=0) > 0:
        node = dofs.node_index
        first = np.unique(node, return_index=True)[1]
        label = _joined(label, np.arange(label.size), first[node])
    sizes = np.bincount(label)
    place = np.empty(sizes.size, dtype=np.int64)
    place[np.argsort(-sizes, kind="stable")] = np.arange(sizes.size)
    return np.asarray(place[label], dtype=np.int64)


def bodies(K: Any, M: Any, dofs: DofSet) -> list[IntArray]:
    """Return the DOFs of each body: of the pieces that nothing joins, the largest first.

    A mass that no stiffness joins to anything is a body, a single DOF that only ground holds is
    none. DOFs with neither mass nor stiffness go with the first. Where the bodies may have more
    than 2000 motions, all DOFs are taken together.
    """
    piece = pieces(K, M, dofs)
    stiffness = diagonal(K)
    there = np.abs(stiffness) > 0
    if M is not None:
        there = there | (diagonal(M) > 0)
    sizes = np.bincount(piece)
    held = (sizes[piece] == 1) & (stiffness > 0)
    own = np.bincount(piece, weights=there & ~held) > 0
    if np.count_nonzero(own) < 1 or np.minimum(sizes[own], 6).sum() > _MOST_MOTIONS:
        return [np.arange(piece.size)]
    kept = np.flatnonzero(~held)
    owner = np.where(own[piece[kept]], piece[kept], np.argmax(own))
    order = np.argsort(owner, kind="stable")
    ends = np.cumsum(np.bincount(owner)[own[: int(owner.max()) + 1]])
    return np.split(kept[order], ends[:-1])


def _joined(label: IntArray, one: Any, other: Any) -> IntArray:
    """Return the number (n,) of the part each DOF belongs to, with some pairs of DOFs joined."""
    size = int(label.max()) + 1
    graph = sp.coo_array((np.ones(one.size, bool), (label[one], label[other])), shape=(size, size))
    return np.asarray(csgraph.connected_components(graph.tocsr(), directed=False)[1][label])
