"""Which parts of a structure are connected."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..labels import DofSet
from ..sparse.factor import by_rows, diagonal
from ..values import IntArray

#: more pieces than this are no structure of several bodies
_MOST_BODIES = 50


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

    Loose DOFs without stiffness are no body of their own, they go with the first. More than 50
    pieces are no structure of several bodies: all DOFs are then taken together.
    """
    piece = pieces(K, M, dofs)
    stiff = np.unique(piece[np.abs(diagonal(K)) > 0])
    if not 1 < stiff.size <= _MOST_BODIES:
        return [np.arange(piece.size)]
    loose = ~np.isin(piece, stiff)
    return [np.flatnonzero((piece == number) | (loose & (number == stiff[0]))) for number in stiff]


def _joined(label: IntArray, one: Any, other: Any) -> IntArray:
    """Return the number (n,) of the part each DOF belongs to, with some pairs of DOFs joined."""
    size = int(label.max()) + 1
    graph = sp.coo_array((np.ones(one.size, bool), (label[one], label[other])), shape=(size, size))
    return np.asarray(csgraph.connected_components(graph.tocsr(), directed=False)[1][label])
