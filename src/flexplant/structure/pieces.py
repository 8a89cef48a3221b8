"""Which parts of a structure hang together."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..labels import DofSet
from ..values import IntArray


def pieces(K: Any, M: Any, dofs: DofSet | None) -> IntArray:
    """Return the number (n,) of the piece each DOF belongs to, 0 being the largest.

    Pieces are joined by no entry of K or M, the DOFs of one node counting as joined.
    """
    n = K.shape[0]
    joined: Any = sp.csr_array(abs(K)) if M is None else sp.csr_array(abs(K) + abs(M))
    if dofs is not None:
        _, node = np.unique(dofs.nodes, return_inverse=True)
        of_node: Any = sp.csr_array((np.ones(n), (np.arange(n), node)))
        count, label = csgraph.connected_components(of_node.T @ joined @ of_node, directed=False)
        label = label[node]
    else:
        count, label = csgraph.connected_components(joined, directed=False)
    sizes = np.bincount(label, minlength=count)
    place = np.empty(count, dtype=np.int64)
    place[np.argsort(-sizes, kind="stable")] = np.arange(count)
    return np.asarray(place[label], dtype=np.int64)
