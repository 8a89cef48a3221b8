"""Which mode is which: of a changed model by shape, of a measurement by shape and frequency."""

from __future__ import annotations

import numpy as np

from ..values import ComplexArray, FloatArray, IntArray
from .family import groups

#: modes closer than this, relatively, are a cluster: their shapes mix at the least change
CLUSTER = 0.02
#: MAC below which two shapes of a cluster have nothing of each other
FOREIGN = 1e-4
#: part of the MAC that a frequency ratio of e counts for: few sensors see many modes alike
NEARNESS = 1.0


def mac(X: ComplexArray, Y: ComplexArray) -> FloatArray:
    """Return the modal assurance criterion of each column of X with each of Y, from 0 to 1."""
    product = np.abs(X.conj().T @ Y) ** 2
    sizes = np.outer(np.sum(np.abs(X) ** 2, axis=0), np.sum(np.abs(Y) ** 2, axis=0))
    return np.asarray(product / sizes, dtype=np.float64)


def pair(old_poles: ComplexArray, old_X: ComplexArray, X: ComplexArray) -> IntArray:
    """Return for each old mode the column of the new mode that continues it, -1 for none.

    A one-to-one assignment of largest MAC. Modes of a cluster (a gap under 2 %) are found
    together, by what of each new shape lies in their subspace; inside it, shapes that have
    nothing of each other keep to themselves and may cross, all others keep their order of
    frequency, since two modes that couple veer instead of crossing.
    """
    from scipy.optimize import linear_sum_assignment

    shapes = mac(old_X, X)
    score = shapes.copy()
    clusters = groups(old_poles, gap=CLUSTER)
    for cluster in clusters:
        basis = np.linalg.qr(old_X[:, cluster])[0]
        inside = np.sum(np.abs(basis.conj().T @ X) ** 2, axis=0) / np.sum(np.abs(X) ** 2, axis=0)
        score[cluster] = inside
    found = np.full(old_poles.size, -1, dtype=np.int64)
    rows, columns = linear_sum_assignment(-score)
    found[rows] = columns
    for cluster in clusters:
        members = np.array([i for i in cluster if found[i] >= 0], dtype=np.int64)
        found[members] = _inside(shapes, members, found[members])
    return found


def measured_pairs(
    psi: ComplexArray, psi_poles: ComplexArray, X: ComplexArray, poles: ComplexArray
) -> IntArray:
    """Return for each measured mode the column of the model's, one to one.

    Minimises the sum of ``1 - MAC + |ln(f_j / f_i)|`` over the pairs.
    """
    from scipy.optimize import linear_sum_assignment

    far = np.abs(np.log(np.abs(poles) / np.abs(psi_poles)[:, None]))
    return np.asarray(linear_sum_assignment(NEARNESS * far - mac(psi, X))[1], dtype=np.int64)


def _inside(shapes: FloatArray, old: IntArray, new: IntArray) -> IntArray:
    """Return the new modes of a cluster in the order of its old ones."""
    s = old.size
    new = np.sort(new)
    linked = shapes[np.ix_(old, new)] > FOREIGN
    if linked.all() or (linked.diagonal().all() and np.count_nonzero(linked) == s):
        return new
    # what a mode reaches through shapes in common: a few rounds of union
    reach = linked @ linked.T | np.eye(s, dtype=bool)
    for _ in range(int(s).bit_length()):
        reach = reach @ reach
    sides, seen = [], np.zeros(s, dtype=bool)
    for i in range(s):
        if not seen[i]:
            seen |= reach[i]
            sides.append((np.flatnonzero(reach[i]), np.flatnonzero(linked[reach[i]].any(axis=0))))
    if sum(b.size for _, b in sides) != s:
        return new
    if any(a.size != b.size for a, b in sides):
        return new
    found = new.copy()
    for a, b in sides:
        found[a] = new[b]
    return found
