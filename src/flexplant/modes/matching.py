"""Matching of modes: similarity of shapes, clusters of close modes, one-to-one pairs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
from scipy.sparse.csgraph import connected_components

from ..arrays import ComplexArray, FloatArray, IntArray, divisor
from ..tolerances import FOUR_DIGITS, NEGLIGIBLE, ROUNDING, SAME, TINY

#: MAC above which two modes count as the same
PARTNER = 0.5
#: relative distance of frequencies within which two modes may be the same one
NEAR = 0.15
#: MAC above which two modes of one model cannot be distinguished by their shapes
ALIKE = 0.9
#: weight of a frequency ratio of e relative to the MAC; frequency decides where shapes are alike
_FREQUENCY = 0.1
#: relative distance below which modes form a cluster: their shapes mix at the smallest change
CLUSTER = 0.02


def mac_matrix(X: Any, Y: Any) -> FloatArray:
    """Return the modal assurance criterion of each column of X with each of Y, from 0 to 1."""
    sizes = np.outer(np.sum(np.abs(X) ** 2, axis=0), np.sum(np.abs(Y) ** 2, axis=0))
    return np.asarray(np.abs(X.conj().T @ Y) ** 2 / divisor(sizes), dtype=np.float64)


def in_span(X: Any, Y: Any) -> FloatArray:
    """Return the fraction (k,) of each column of Y in the span of X; for one column, their MAC."""
    basis, size, _ = np.linalg.svd(X, full_matrices=False)
    inside = basis[:, size > SAME * size[0]].conj().T @ Y
    return np.asarray(np.sum(np.abs(inside) ** 2, axis=0) / np.sum(np.abs(Y) ** 2, axis=0))


def runs(values: Any, gap: float) -> list[IntArray]:
    """Return the places of neighbours in a list whose relative distance is `gap` at most."""
    far = np.abs(np.diff(values)) > gap * np.abs(values[1:])
    return [run for run in np.split(np.arange(len(values)), np.flatnonzero(far) + 1) if run.size]


def clusters(values: Any, gap: float) -> list[IntArray]:
    """Return the places of `runs` with two or more members, by rising size."""
    order = np.argsort(np.abs(values), kind="stable")
    return [np.sort(order[run]) for run in runs(np.abs(values)[order], gap) if run.size > 1]


def assigned(cost: FloatArray, most: float = np.inf) -> IntArray:
    """Return the column of each row, one to one with the least total cost."""
    # -1 for rows without a partner left, or whose cost is above `most`
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(cost)
    found = np.full(len(cost), -1, dtype=np.int64)
    found[rows] = np.where(cost[rows, columns] <= most, columns, -1)
    return found


def pair(old_poles: ComplexArray, old_X: ComplexArray, X: ComplexArray) -> IntArray:
    """Return for each old mode the column of the new mode that continues it, -1 for none."""
    # a one-to-one assignment of largest MAC. Modes of a cluster (a gap under 2 %) are found
    # together, by the projection of each new shape on their subspace. Inside it, independent shapes
    # may cross, and all others keep their order of frequency, since two coupled modes veer instead
    # of crossing
    shapes = mac_matrix(old_X, X)
    score, close = shapes.copy(), clusters(old_poles, CLUSTER)
    for cluster in close:
        score[cluster] = in_span(old_X[:, cluster], X)
    found = assigned(-score)
    for cluster in close:
        members = cluster[found[cluster] >= 0]
        found[members] = _match_cluster(shapes, members, found[members])
    return found


def _match_cluster(shapes: FloatArray, old: IntArray, new: IntArray) -> IntArray:
    """Return the new modes of a cluster in the order of its old ones."""
    s, new = old.size, np.sort(new)
    near = shapes[np.ix_(old, new)] > FOUR_DIGITS
    if near.all() or np.array_equal(near, np.eye(s)):
        return new  # the usual case at every point of a search; a graph costs ten times as much
    linked = np.zeros((2 * s, 2 * s), dtype=bool)
    linked[:s, s:] = near
    # groups of modes that are connected by common shapes
    count, side = connected_components(linked, directed=False)
    found = new.copy()
    for k in range(count):
        a, b = np.flatnonzero(side[:s] == k), np.flatnonzero(side[s:] == k)
        if a.size != b.size:
            return new
        found[a] = new[b]
    return found


class ModePairs(NamedTuple):
    """The pairs of m modes with those of another model."""

    partner: IntArray
    mac: FloatArray
    group: IntArray


def pair_modes(
    freq: FloatArray,
    other_freq: FloatArray,
    gram: Any,
    cross: Any,
    other_gram: Any,
    *,
    n_rigid: int = 0,
) -> ModePairs:
    """Return the one-to-one assignment of largest MAC, decided by frequency where shapes are alike.

    Minimises the sum of ``1 - MAC + 0.1 |ln(f_j / f_i)|`` over the pairs. Modes of a cluster share
    the part of the other mode that lies in their span; a pair with less than half is left out.
    """
    size, other_size = np.real(np.diag(gram)), np.real(np.diag(other_gram))
    alike = np.abs(cross) ** 2 / np.outer(size, other_size)
    first = np.arange(min(n_rigid, freq.size))
    spans = [first] + [n_rigid + run for run in runs(freq[n_rigid:], NEGLIGIBLE)]
    score = alike.copy()
    for members in spans:
        if members.size > 1:
            inside = _orthonormal_map(gram[np.ix_(members, members)]).conj().T @ cross[members]
            score[members] = np.sum(np.abs(inside) ** 2, axis=0) / other_size
    partner = _by_shape(freq, other_freq, score, n_rigid)
    rows = np.arange(freq.size)
    mac = np.where(partner >= 0, alike[rows, partner], 0.0)
    partner[score[rows, partner] < PARTNER] = -1
    for members in spans:
        if members.size > 1:
            found = np.sort(partner[members][partner[members] >= 0])
            # all by rising frequency, else by MAC
            holders = np.arange(members.size)
            if found.size < members.size:
                holders = assigned(-alike[np.ix_(members, found)].T)
            partner[members], mac[members] = -1, 0.0
            partner[members[holders]] = found
            mac[members[holders]] = _cosines(
                gram[np.ix_(members, members)],
                cross[np.ix_(members, found)],
                other_gram[np.ix_(found, found)],
            )
    return ModePairs(partner, mac, groups_alike(np.abs(gram) ** 2 / np.outer(size, size), spans))


def _by_shape(
    freq: FloatArray, other_freq: FloatArray, score: FloatArray, n_rigid: int
) -> IntArray:
    """Return the partner of each mode: rigid-body modes in order, others by shape and frequency."""
    r, k = n_rigid, min(freq.size, other_freq.size)
    partner = np.where(np.arange(freq.size) < k, np.arange(freq.size), -1)
    if k > r:
        ratio = np.maximum(other_freq[None, r:], TINY) / np.maximum(freq[r:, None], TINY)
        found = assigned(_FREQUENCY * np.minimum(np.abs(np.log(ratio)), 1.0) - score[r:, r:])
        partner[r:] = np.where(found >= 0, found + r, -1)
    return partner


def _orthonormal_map(gram: Any) -> Any:
    """Return T with ``T^H G T = I`` on the span of shapes with inner products G, of its rank."""
    values, vectors = la.eigh(gram)
    kept = values > ROUNDING * values[-1]
    return vectors[:, kept] / np.sqrt(values[kept])


def _cosines(gram: Any, cross: Any, other_gram: Any) -> FloatArray:
    """Return the squared cosines of the principal angles between two subspaces, largest first."""
    if not cross.shape[1]:
        return np.zeros(0)
    both = _orthonormal_map(gram).conj().T @ cross @ _orthonormal_map(other_gram)
    cosines = np.zeros(cross.shape[1])
    found = la.svdvals(both)
    cosines[: found.size] = found**2
    return cosines


def likeness(shapes: ComplexArray, freq: FloatArray) -> FloatArray:
    """Return the MAC (m, m) of modes with each other, repeated ones by the span of their shapes."""
    # the similarity of two spans is that of their nearest shapes (cosine squared of the smallest
    # principal angle). Two repeated modes have 1 where their known shapes are nearly dependent,
    # else 0. A mode that has a node at all places is similar to no other mode
    order = np.argsort(freq, kind="stable")
    spans = [order[run] for run in runs(freq[order], NEGLIGIBLE)]
    alike = np.eye(freq.size)
    largest = np.linalg.norm(shapes, axis=0).max(initial=0.0)
    bases = []
    for span in spans:
        basis, sizes, _ = np.linalg.svd(shapes[:, span], full_matrices=False)
        bases.append(basis[:, sizes > NEGLIGIBLE * largest])
        # two unit shapes at the angle a have singular values whose squares are 1 +- cos a
        together = sizes[-1] ** 2 * (1 + ALIKE**0.5) < sizes[0] ** 2 * (1 - ALIKE**0.5)
        if span.size > 1 and (together or sizes.size < span.size):
            alike[np.ix_(span, span)] = 1.0
    for i, j in combinations(range(len(spans)), 2):
        cosine = np.linalg.svd(bases[i].conj().T @ bases[j], compute_uv=False).max(initial=0.0)
        alike[np.ix_(spans[i], spans[j])] = alike[np.ix_(spans[j], spans[i])] = cosine**2
    return alike


def groups_alike(alike: FloatArray, spans: Sequence[IntArray] = ()) -> IntArray:
    """Return for each mode the first one whose shape cannot be distinguished from its own."""
    group = np.arange(len(alike), dtype=np.int64)
    for members in spans:
        group[members] = members[:1]
    for i, j in np.argwhere(np.triu(alike > ALIKE, 1)).tolist():
        group[group == group[j]] = group[i]
    return group


def calibration_of(model: Any, measured: Any) -> Any:
    """Return all measured poles of a model: those of earlier calibrations, and new ones."""
    return measured if model.calibration is None else model.calibration.merged(measured)
