"""The model at one set of parameters: its modes and their derivatives, each computed once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ..checks import ComplexArray, FloatArray, IntArray
from ..errors import ModelError
from ..modes.matching import assigned, clusters, in_span, mac_matrix
from .family import Eigen, Family

#: entries of bordered systems that are solved together
TOGETHER = 1_000_000


class Point:
    """The model at the parameters `p`, its modes labelled by their numbers in the start model."""

    def __init__(self, family: Family, p: FloatArray, eigen: Eigen, labels: IntArray) -> None:
        #: with the derivatives at p
        self.family = family.tangent(p)
        self.p = p
        self.eigen = eigen
        self.labels = labels
        self._known: dict[tuple[int, ...], tuple[ComplexArray, ComplexArray]] = {}
        #: derivatives of eigenvalues of repeated modes, by mode number
        self.turned: dict[int, ComplexArray] = {}

    @cached_property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M, D and K in the coordinates of the family."""
        return self.family.matrices(self.p)

    @cached_property
    def _where(self) -> dict[int, int]:
        return {int(n): c for c, n in enumerate(self.labels.tolist()) if n}

    def columns(self, numbers: Sequence[int]) -> list[int]:
        """Return the columns of modes by number."""
        where = self._where
        lost = [n for n in numbers if n not in where]
        if lost:
            raise ModelError(
                f"modes {lost} cease to oscillate: with {self.family.text(self.p)} they have no "
                "pole, or no shape, to compare with the measured one. Keep dampers to what is "
                "possible (bounds=), or begin nearer to the answer (start=)."
            )
        return [where[n] for n in numbers]

    def sensitivity(self, numbers: Sequence[int]) -> ComplexArray:
        """Return d lambda / d p (m, q), the paper's (11)."""
        S = self.family.sensitivity(self.eigen, self.columns(numbers))
        for i, number in enumerate(numbers):
            S[i] = self.turned.get(number, S[i])
        return S

    def subspace(self, numbers: Sequence[int]) -> tuple[ComplexArray, ComplexArray]:
        """Return dX (q, k, s) and dL (q, s, s) of the invariant pair (X, L) of some modes.

        The bordered system, one factor per mode for all parameters::

            [P(lambda_j)  B_j] [dX_j]     [-(lambda_j^2 dM + lambda_j dD + dK) x_j]
            [B_j^T          0] [dL_j]  =  [                  0                    ]

        with ``B_j = [M x_i (lambda_i + lambda_j) + D x_i]_i``: regular for any distance of the
        modes in the group, as long as no other mode comes near. One mode alone gives d lambda and
        the derivative of its vector at fixed ``x^T (2 lambda M + D) dx = 0``.
        """
        return self.subspaces([numbers])[0]

    def subspaces(self, sets: Sequence[Sequence[int]]) -> list[tuple[ComplexArray, ComplexArray]]:
        """Return `subspace` of sets of modes of one size, solved together."""
        keys = [tuple(numbers) for numbers in sets]
        new = [key for key in dict.fromkeys(keys) if key not in self._known]
        if new:
            groups = np.array([self.columns(key) for key in new])
            self._known |= dict(zip(new, _bordered(self, groups), strict=True))
        return [self._known[key] for key in keys]

    def continued(self, p: FloatArray) -> Point:
        """Return the model at other parameters, its modes paired by shape with those here."""
        eigen = self.family.at(p)
        old, new = self.family.weighted(self.eigen.X), self.family.weighted(eigen.X)
        found = pair(self.eigen.poles, old, new)
        labels = np.zeros(eigen.poles.size, dtype=np.int64)
        labels[found[found >= 0]] = self.labels[found >= 0]
        return Point(self.family, p, eigen, labels)


def first_point(family: Family, p: FloatArray) -> Point:
    """Return the model at the start: modes numbered from 1 by rising frequency."""
    eigen = family.at(p)
    labels = np.arange(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1, dtype=np.int64)
    return Point(family, p, eigen, labels)


def _bordered(point: Point, groups: IntArray) -> list[tuple[ComplexArray, ComplexArray]]:
    """Return dX (q, k, s) and dL (q, s, s) of groups of modes, columns (g, s)."""
    M, D, K = point.matrices
    count, s = groups.shape
    X, poles = point.eigen.X[:, groups.ravel()], point.eigen.poles[groups.ravel()]
    k, q = X.shape[0], point.p.size
    changes = point.family.moved(X, (poles**2, poles, np.ones_like(poles))).transpose(2, 1, 0)
    MX, DX = M @ X, D @ X
    # undamped: all is real but the border, imaginary, and its unknown
    real = not (np.any(DX) or np.any(X.imag) or np.any(poles.real) or np.any(changes.imag))
    turn = -1j if real else 1.0
    kind = np.float64 if real else np.complex128
    dX, dL = np.zeros((count, s, k, q), complex), np.zeros((count, s, s, q), complex)
    together = max(1, TOGETHER // (k + s) ** 2)
    for first in range(0, count * s, together):
        own = np.arange(first, min(first + together, count * s))
        lam, members = poles[own], (own // s * s)[:, None] + np.arange(s)
        border = MX.T[members] * (poles[members] + lam[:, None])[:, :, None] + DX.T[members]
        size = np.sqrt(np.linalg.norm(K, 1) / np.abs(border).max(axis=(1, 2)))[:, None, None]
        edge = border * size * turn
        whole = lam[:, None, None] ** 2 * M + lam[:, None, None] * D + K
        system = np.zeros((own.size, k + s, k + s), kind)
        system[:, :k, :k] = whole.real if real else whole
        system[:, k:, :k] = edge.real if real else edge
        system[:, :k, k:] = system[:, k:, :k].transpose(0, 2, 1)
        right = np.zeros((own.size, k + s, q), kind)
        right[:, :k] = -changes[own].real if real else -changes[own]
        solved = np.linalg.solve(system, right)
        dX[own // s, own % s], dL[own // s, own % s] = solved[:, :k], solved[:, k:] * size * turn
    return list(zip(dX.transpose(0, 3, 2, 1), dL.transpose(0, 3, 2, 1), strict=True))


#: modes closer than this, relatively, are a cluster: their shapes mix at the least change
CLUSTER = 0.02
#: MAC below which two shapes of a cluster have nothing of each other
FOREIGN = 1e-4
#: part of the MAC that a frequency ratio of e counts for: few sensors see many modes alike
NEARNESS = 1.0


def pair(old_poles: ComplexArray, old_X: ComplexArray, X: ComplexArray) -> IntArray:
    """Return for each old mode the column of the new mode that continues it, -1 for none.

    A one-to-one assignment of largest MAC. Modes of a cluster (a gap under 2 %) are found
    together, by what of each new shape lies in their subspace; inside it, shapes that have
    nothing of each other keep to themselves and may cross, all others keep their order of
    frequency, since two modes that couple veer instead of crossing.
    """
    shapes = mac_matrix(old_X, X)
    score, close = shapes.copy(), clusters(old_poles, CLUSTER)
    for cluster in close:
        score[cluster] = in_span(old_X[:, cluster], X)
    found = assigned(-score)
    for cluster in close:
        members = cluster[found[cluster] >= 0]
        found[members] = _match_cluster(shapes, members, found[members])
    return found


def measured_pairs(
    psi: ComplexArray, psi_poles: ComplexArray, X: ComplexArray, poles: ComplexArray
) -> IntArray:
    """Return for each measured mode the column of the model's, one to one.

    Minimises the sum of ``1 - MAC + |ln(f_j / f_i)|`` over the pairs.
    """
    far = np.abs(np.log(np.abs(poles) / np.abs(psi_poles)[:, None]))
    return assigned(NEARNESS * far - mac_matrix(psi, X))


def _match_cluster(shapes: FloatArray, old: IntArray, new: IntArray) -> IntArray:
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
