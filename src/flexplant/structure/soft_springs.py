"""Which almost force-free motions soft springs hold: forces that rounding of K does not explain."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..checks import FloatArray, IntArray, Matrix
from ..labels import DofSet
from ..sparse.factor import by_rows, diagonal
from ..sparse.lowest import PRECISION
from ..sparse.rayleigh_ritz import Absolute
from ..tolerances import divisor

#: times the usual rounding of a row: a force larger than this is of a spring
_OUTLIER = 30.0
#: part of all DOFs: forces at fewer are of springs, not of rounding
_FEW, _FEW_ROWS = 0.02, 6
#: in relative roundings of the entries: an energy larger than this may be of springs
ENERGY = 90.0
#: times the root of the summed squares of the work at each DOF: springs everywhere add up, rounding
#: of either sign does not
_COHERENT = 4.0


def unheld(
    K: Matrix, motions: FloatArray, rounding: float = PRECISION, far: float = 1.0
) -> FloatArray:
    """Return the combinations (r, m) of almost force-free motions (n, r) that no spring holds.

    Rounding of K leaves forces at all DOFs, of about the same size relative to what cancels there.
    A few springs leave larger ones at a few DOFs, however soft they are; springs everywhere, a
    bed, leave work of one sign, which sums to an energy above that of rounding.
    """
    mix = np.eye(motions.shape[1])
    if not motions.size:
        return mix
    size_of_K = Absolute(K)
    mix = mix @ _beside_few_springs(K, size_of_K, motions, max(rounding, PRECISION * far))
    if mix.shape[1]:
        # errors of coordinates are of second order in the energy
        mix = mix @ _beside_many_springs(K, size_of_K, motions @ mix, rounding)
    return mix


def _beside_few_springs(
    K: Any, size_of_K: Absolute, motions: FloatArray, rounding: float
) -> FloatArray:
    """Return the combinations (r, m) without outliers among the forces."""
    n, r = motions.shape
    force, most = np.abs(np.asarray(K @ motions)), _sizes(size_of_K, motions)
    part = np.divide(force, most, out=np.zeros_like(force), where=most > 0)
    usual = np.maximum(np.median(part, axis=0), rounding)
    rows = np.flatnonzero(np.any(part > _OUTLIER * usual, axis=1))
    if not rows.size or rows.size > max(_FEW * n, min(_FEW_ROWS, n // 4)):
        return np.eye(r)
    # each row in terms of its rounding, so that springs of any two stiffnesses compare
    held = np.asarray(K[rows] @ motions) / most[rows].max(axis=1, keepdims=True)
    values = np.zeros(r)
    _, found, right = la.svd(held)
    values[: found.size] = found
    null = right[values < _OUTLIER * usual.max() * np.sqrt(rows.size)].T
    return _in_their_order(null, np.all(part[rows] <= _OUTLIER * usual, axis=0))


def _beside_many_springs(
    K: Any, size_of_K: Absolute, motions: FloatArray, rounding: float
) -> FloatArray:
    """Return the combinations (r, m) without an energy that is more than rounding."""
    moved = np.abs(motions)
    most = np.sqrt(np.einsum("ij,ij->j", moved, size_of_K @ moved))
    most = divisor(most)
    energy, mix = la.eigh(motions.T @ np.asarray(K @ motions) / most / most[:, None])
    mix = mix / most[:, None]
    held = _held_everywhere(K, motions @ mix, energy, rounding)
    alone = np.einsum("ij,ij->j", motions, np.asarray(K @ motions)) / most**2
    return _in_their_order(mix[:, ~held], ~_held_everywhere(K, motions, alone, rounding))


def _held_everywhere(K: Any, motions: FloatArray, energy: FloatArray, rounding: float) -> Any:
    """Return which motions (r,) cost a relative `energy` to which all DOFs add."""
    work = motions * np.asarray(K @ motions)
    coherent = work.sum(axis=0) > _COHERENT * np.linalg.norm(work, axis=0)
    return (energy > ENERGY * rounding) & coherent


def _in_their_order(null: FloatArray, untouched: Any) -> FloatArray:
    """Return combinations (r, m): the motions themselves where as many of them are untouched."""
    if np.count_nonzero(untouched) == null.shape[1]:
        return np.eye(untouched.size)[:, untouched]
    return null


def _sizes(size_of_K: Absolute, motions: FloatArray) -> FloatArray:
    """Return the forces (n, r) that do not cancel, each DOF moving as far as the farthest.

    So that rounding is seen in proportion also where a motion passes through zero.
    """
    most = np.abs(motions).max(axis=0, initial=0.0)
    return np.asarray((size_of_K @ np.ones((motions.shape[0], 1))) * most)


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
