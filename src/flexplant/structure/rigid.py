"""Rigid-body motions from the geometry, their mass, soft springs on them; places of models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..arrays import FloatArray, IntArray, Matrix, divisor, real_array
from ..errors import SolverError
from ..labels import DIRECTIONS, DofSet, Place
from ..sparse.factor import DENSE_LIMIT
from ..sparse.lowest import definite_solver
from ..sparse.symmetric import (
    ZERO,
    Absolute,
    by_rows,
    dense,
    diagonal,
    orthonormalised,
    projected,
    unit_diagonal,
)
from ..tolerances import CLOSE, NEGLIGIBLE, NULL, PRECISION, RESIDUAL, ROUNDING, TYPED

#: multiple of the usual rounding of a row above which a force belongs to a spring
_OUTLIER = 30.0
#: fraction of all DOFs: forces at fewer DOFs belong to springs, not to rounding
_FEW, _FEW_ROWS = 0.02, 6
#: energy, in relative roundings of the entries, above which springs may be present
ENERGY = 90.0
#: multiple of the root of summed squares of the work at the DOFs: work of distributed springs adds
#: up, rounding of either sign does not
_COHERENT = 4.0


def unheld(
    K: Matrix, motions: FloatArray, rounding: float = PRECISION, far: float = 1.0
) -> FloatArray:
    """Return the combinations (r, m) of almost force-free motions (n, r) that no spring holds."""
    # rounding of K leaves forces at all DOFs, of about the same size relative to the terms that
    # cancel. A few springs, however soft, leave larger forces at a few DOFs. Distributed springs do
    # work of one sign, whose sum is an energy above that of rounding
    mix = np.eye(motions.shape[1])
    if not motions.size:
        return mix
    size_of_K = Absolute(K)
    mix = mix @ _without_few_springs(K, size_of_K, motions, max(rounding, PRECISION * far))
    if mix.shape[1]:
        # errors of coordinates have a second-order effect on the energy
        mix = mix @ _without_many_springs(K, size_of_K, motions @ mix, rounding)
    return mix


def _without_few_springs(
    K: Any, size_of_K: Absolute, motions: FloatArray, rounding: float
) -> FloatArray:
    """Return the combinations (r, m) without outliers among the forces."""
    n, r = motions.shape
    force, most = np.abs(np.asarray(K @ motions)), _uncancelled_forces(size_of_K, motions)
    part = np.divide(force, most, out=np.zeros_like(force), where=most > 0)
    usual = np.maximum(np.median(part, axis=0), rounding)
    rows = np.flatnonzero(np.any(part > _OUTLIER * usual, axis=1))
    if not rows.size or rows.size > max(_FEW * n, min(_FEW_ROWS, n // 4)):
        return np.eye(r)
    # each row in units of its rounding, so that springs of any stiffness compare
    held = np.asarray(K[rows] @ motions) / most[rows].max(axis=1, keepdims=True)
    values = np.zeros(r)
    _, found, right = la.svd(held)
    values[: found.size] = found
    null = right[values < _OUTLIER * usual.max() * np.sqrt(rows.size)].T
    return _in_their_order(null, np.all(part[rows] <= _OUTLIER * usual, axis=0))


def _without_many_springs(
    K: Any, size_of_K: Absolute, motions: FloatArray, rounding: float
) -> FloatArray:
    """Return the combinations (r, m) whose energy is within rounding."""
    moved = np.abs(motions)
    most = np.sqrt(np.einsum("ij,ij->j", moved, size_of_K @ moved))
    most = divisor(most)
    energy, mix = la.eigh(motions.T @ np.asarray(K @ motions) / most / most[:, None])
    mix = mix / most[:, None]
    held = _held_everywhere(K, motions @ mix, energy, rounding)
    alone = np.einsum("ij,ij->j", motions, np.asarray(K @ motions)) / most**2
    return _in_their_order(mix[:, ~held], ~_held_everywhere(K, motions, alone, rounding))


def _held_everywhere(K: Any, motions: FloatArray, energy: FloatArray, rounding: float) -> Any:
    """Return which motions (r,) have a relative `energy` to which all DOFs contribute."""
    work = motions * np.asarray(K @ motions)
    coherent = work.sum(axis=0) > _COHERENT * np.linalg.norm(work, axis=0)
    return (energy > ENERGY * rounding) & coherent


def _in_their_order(null: FloatArray, untouched: Any) -> FloatArray:
    """Return combinations (r, m): single motions where enough of them are unaffected."""
    if np.count_nonzero(untouched) == null.shape[1]:
        return np.eye(untouched.size)[:, untouched]
    return null


def _uncancelled_forces(size_of_K: Absolute, motions: FloatArray) -> FloatArray:
    """Return the forces (n, r) that do not cancel, each DOF moving as far as the farthest."""
    # so that rounding stays in proportion where a motion passes through zero
    most = np.abs(motions).max(axis=0, initial=0.0)
    return np.asarray((size_of_K @ np.ones((motions.shape[0], 1))) * most)


def pieces(K: Any, M: Any, dofs: DofSet | None) -> IntArray:
    """Return the number (n,) of the piece each DOF belongs to, 0 being the largest."""
    # pieces are joined by no entry of K or M, the DOFs of one node counting as joined in steps,
    # each within the parts found before; most structures are one piece after the first
    label: Any = csgraph.connected_components(sp.csr_array(by_rows(K)), directed=False)[1]
    if M is not None and label.max(initial=0) > 0:
        entries = sp.coo_array(M)
        label = _join_parts(label, *entries.coords)
    if dofs is not None and label.max(initial=0) > 0:
        node = dofs.node_index
        first = np.unique(node, return_index=True)[1]
        label = _join_parts(label, np.arange(label.size), first[node])
    sizes = np.bincount(label)
    place = np.empty(sizes.size, dtype=np.int64)
    place[np.argsort(-sizes, kind="stable")] = np.arange(sizes.size)
    return np.asarray(place[label], dtype=np.int64)


def bodies(K: Any, M: Any, dofs: DofSet) -> list[IntArray]:
    """Return the DOFs of each body: of the pieces that nothing joins, the largest first."""
    # a mass without any stiffness is a body; a single DOF held only by the ground is not a body.
    # DOFs with neither mass nor stiffness belong to the first body. Where the bodies may have more
    # than 2000 motions, all DOFs form one body
    piece = pieces(K, M, dofs)
    stiffness = diagonal(K)
    there = np.abs(stiffness) > 0
    if M is not None:
        there = there | (diagonal(M) > 0)
    sizes = np.bincount(piece)
    held = (sizes[piece] == 1) & (stiffness > 0)
    own = np.bincount(piece, weights=there & ~held) > 0
    if np.count_nonzero(own) < 1 or np.minimum(sizes[own], 6).sum() > DENSE_LIMIT:
        return [np.arange(piece.size)]
    kept = np.flatnonzero(~held)
    owner = np.where(own[piece[kept]], piece[kept], np.argmax(own))
    order = np.argsort(owner, kind="stable")
    ends = np.cumsum(np.bincount(owner)[own[: int(owner.max()) + 1]])
    return np.split(kept[order], ends[:-1])


def _join_parts(label: IntArray, one: Any, other: Any) -> IntArray:
    """Return the number (n,) of the part each DOF belongs to, with some pairs of DOFs joined."""
    size = int(label.max()) + 1
    graph = sp.coo_array((np.ones(one.size, bool), (label[one], label[other])), shape=(size, size))
    return np.asarray(csgraph.connected_components(graph.tocsr(), directed=False)[1][label])


#: largest force of such a motion at any DOF, relative to the largest force of its terms
_EVERYWHERE = 3e-4
#: number of steps of inverse iteration from geometric motions to the null vectors of K
_STEPS = 4


def rigid_motions(dofs: DofSet, about: Any = (0.0, 0.0, 0.0)) -> FloatArray:
    """Return the six rigid-body motions (n, 6) of the DOFs: x, y, z, rx, ry, rz."""
    # rotations are small ones about a point [m], the origin unless given: rx moves a point by
    # `y rx` in z and `-z rx` in y, hence a plate's rx = dz/dy and ry = -dz/dx
    n = len(dofs)
    kind, xyz = dofs.kinds, dofs.xyz - np.asarray(about)
    motions = np.zeros((n, 6))
    motions[np.arange(n), kind] = 1.0
    for axis in range(3):
        # a turn about axis moves the next one by minus the coordinate after it, and so on round
        after, before = (axis + 1) % 3, (axis + 2) % 3
        for moved, along, sign in ((after, before, -1.0), (before, after, 1.0)):
            rows = kind == moved
            motions[rows, 3 + axis] = sign * xyz[rows, along]
    return motions


def turned_about(direction: str, about: FloatArray) -> FloatArray:
    """Return the motions (6,) about the origin that are a motion about another point."""
    axis, own = DIRECTIONS.index(direction), np.zeros(6)
    own[axis] = 1.0
    if axis >= 3:  # e x (p - about) = e x p + about x e
        own[:3] = np.cross(about, own[3:])
    return own


def place_motion(dofs: DofSet, at: Place, direction: str) -> FloatArray:
    """Return the displacement (6,) of a place in the six rigid-body motions about the origin.

    It follows from the coordinates, not from shapes: a place next to a held DOF moves with the
    ground too.
    """
    if isinstance(at, Mapping):
        parts = [weight * place_motion(dofs, place, direction) for place, weight in at.items()]
        return np.asarray(np.sum(parts, axis=0))
    if isinstance(at, str):
        direction, at = at.rpartition(":")[2], dofs.location(at)
    axis, own = DIRECTIONS.index(direction), np.zeros(6)
    own[axis] = 1.0
    if axis < 3:  # (e_r x p) . e = (p x e) . e_r
        own[3:] = np.cross(np.asarray(at, dtype=np.float64), own[:3])
    return own


def farness(xyz: FloatArray) -> float:
    """Return the largest coordinate of a body relative to its size; at least 1."""
    size = float(np.ptp(xyz, axis=0).max()) if xyz.size else 0.0
    return max(1.0, float(np.abs(xyz).max()) / size) if size else 1.0


def body_motions(M: Matrix, K: Matrix, dofs: DofSet) -> FloatArray:
    """Return the M-orthonormal rigid-body motions (n, r) of every piece of a structure."""
    # each piece that nothing joins to the others has its own six, as far as its DOFs can make them:
    # those of the largest piece come first. Translations precede rotations about the centre of
    # gravity
    motions, part = rigid_motions(dofs), cast(Any, M)
    found = []
    for rows in bodies(K, M, dofs):
        whole = rows.size == len(dofs)
        own = part if whole else part[rows][:, rows]
        # only independent ones: some are missing, and with few DOFs some of the six coincide
        moved = orthonormalised(own, motions[rows], dependent="drop")
        found.append(moved if whole else np.zeros((len(dofs), moved.shape[1])))
        found[-1][rows] = moved
    return np.hstack(found)


def nearest_free(K: Matrix, motions: FloatArray) -> FloatArray:
    """Return motions (n, r) without the small stretching caused by coordinates of few digits."""
    # ``m - K^+ K m`` is the null vector of K next to m; of a large K inverse iteration finds it
    if not motions.size:
        return motions
    scaled, scale = unit_diagonal(K)
    if K.shape[0] <= DENSE_LIMIT:
        force = scale[:, None] * np.asarray(K @ motions)
        change = scale[:, None] * (la.pinvh(dense(scaled), rtol=NULL) @ force)
    else:
        try:
            solve = definite_solver(scaled, sp.eye_array(K.shape[0], format="csc"), NULL)
        except SolverError:  # magnets make a motion unstable
            return motions
        given = motions / scale[:, None]
        found = given
        for _ in range(_STEPS):
            found = solve(NULL * found)
        # held motions have shrunk; rounding moves null vectors only within their space
        kept = found[:, np.linalg.norm(found, axis=0) > 0.5 * np.linalg.norm(given, axis=0)]
        change = scale[:, None] * (given - kept @ np.linalg.lstsq(kept, given)[0])
    size = divisor(np.linalg.norm(motions, axis=0))
    small = np.linalg.norm(change, axis=0) <= TYPED * size
    return np.asarray(motions - np.where(small, change, 0.0))


def rigid_body_basis(M: Matrix, K: Matrix, motions: FloatArray, xyz: FloatArray) -> FloatArray:
    """Return the M-orthonormal rigid-body vectors (n, r) of a structure, ``K R = 0``."""
    # they are those of the `motions` of its pieces, from `body_motions`, that cost no energy. They
    # come from the coordinates, not from an eigenvalue solver, so that they are exact. Partly held
    # structures (a hinge, say) keep the combinations that cost none. Where coordinates have few
    # digits, rotations are the null vectors of K next to theirs. Each body is judged separately,
    # with the rounding that its coordinates `xyz` (n, 3) have
    parts = _bodies_of(motions)
    if len(parts) < 2:
        return free_motions(M, K, motions, farness(xyz))
    found, mass, stiffness = [], cast(Any, M), cast(Any, K)
    for rows, columns in parts:
        own = mass[rows][:, rows], stiffness[rows][:, rows], motions[np.ix_(rows, columns)]
        free = free_motions(*own, farness(xyz[rows]))
        found.append(np.zeros((motions.shape[0], free.shape[1])))
        found[-1][rows] = free
    return np.hstack(found)


def _bodies_of(motions: FloatArray) -> list[tuple[IntArray, IntArray]]:
    """Return the rows and the columns of each body: motions of two bodies share no row."""
    moved = (motions != 0).astype(np.float32)
    count, label = csgraph.connected_components(sp.csr_array(moved.T @ moved), directed=False)
    columns = [np.flatnonzero(label == number) for number in range(count)]
    return [(np.flatnonzero(moved[:, one].any(axis=1)), one) for one in columns]


def free_motions(
    M: Matrix, K: Matrix, motions: FloatArray, far: float, rounding: float = PRECISION
) -> FloatArray:
    """Return the M-orthonormal motions of one body whose energy is at most `rounding`."""
    # the relative rounding of the entries of K; energy due to coordinates of few digits is removed
    # K r and |K| |r|, row by row: forces of rounding size say that no energy is stored
    K = by_rows(K)
    size_of_K = Absolute(K)
    scale = np.linalg.norm(size_of_K @ np.abs(motions), axis=0)
    scale = divisor(scale)
    force = np.asarray(K @ motions) / scale
    tolerance = max(RESIDUAL, ENERGY * rounding)
    free = np.linalg.norm(force, axis=0) < tolerance
    if np.all(free):
        return _not_held(M, K, motions, far, rounding)
    # decompose the small triangle: the left factor of all DOFs would be a full square matrix
    _, found, right = la.svd(la.qr(force, mode="economic")[1])
    values = np.zeros(scale.size)
    values[: found.size] = found
    null = right[values < tolerance].T
    basis = motions[:, free]
    if null.shape[1] > basis.shape[1]:
        basis = orthonormalised(M, motions @ (null / scale[:, None]))
    basis = _not_held(M, K, basis, far, rounding)
    near = right[(values >= tolerance) & (values < CLOSE)].T
    if not near.shape[1]:
        return basis
    nearly = motions @ (near / scale[:, None])
    # motions without a large force at any DOF are not grounded
    nearly = nearly[:, force_parts(K, nearly) < _EVERYWHERE]
    if not nearly.shape[1]:
        return basis
    return _null_vectors(M, K, size_of_K, motions, basis, nearly, rounding * ZERO / PRECISION)


def _not_held(M: Matrix, K: Matrix, motions: FloatArray, far: float, rounding: float) -> FloatArray:
    """Return the almost force-free motions, or combinations, that no soft spring holds."""
    mix = unheld(K, motions, rounding, far)
    if np.array_equal(mix, np.eye(*mix.shape)[:, : mix.shape[1]]):
        return motions[:, : mix.shape[1]]
    if np.count_nonzero(mix) == mix.shape[1]:
        return motions @ mix
    return orthonormalised(M, motions @ mix)


def force_free(M: Matrix, K: Matrix, motions: FloatArray) -> bool:
    """Return whether M-orthonormal motions pass for modes at 0 of (K, M), to rounding."""
    root = np.sqrt(M.diagonal())[:, None]
    force = np.linalg.norm(np.asarray(K @ motions) / root, axis=0)
    return bool(np.all(force <= ROUNDING * float(np.max(K.diagonal() / M.diagonal()))))


def force_parts(K: Matrix, motions: FloatArray) -> FloatArray:
    """Return the largest force of each motion (r,) relative to the largest of its terms."""
    rows = by_rows(K)
    weight = 1 / np.sqrt(divisor(diagonal(K)))[:, None]
    force = np.abs(weight * np.asarray(rows @ motions)).max(axis=0)
    most = (weight * (Absolute(rows) @ np.abs(motions))).max(axis=0)
    return np.asarray(force / divisor(most))


def _null_vectors(
    M: Matrix,
    K: Matrix,
    size_of_K: Absolute,
    motions: FloatArray,
    basis: FloatArray,
    nearly: FloatArray,
    rounding: float,
) -> FloatArray:
    """Return a basis, and null vectors of K close to nearly free motions, if there are any."""
    # by inverse iteration, `(K + s M) x' = s M x`: what the last digits of coordinates add are
    # elastic modes, which shrink by s / (lambda + s) each time, and motions without energy stay. A
    # motion that something holds, however softly, keeps its energy and is not rigid
    start = orthonormalised(M, np.hstack([basis, nearly]), dependent="drop")
    spread = float(np.einsum("ij,ij->j", np.abs(start), size_of_K @ np.abs(start)).max())
    shift = 30 * rounding * spread
    try:
        solve = definite_solver(K, M, shift)
        found = start
        for _ in range(_STEPS):
            found = orthonormalised(M, np.asarray(solve(np.asarray(M @ found))))
    except SolverError:
        return basis  # K is indefinite, which the mode solver reports
    values, mix = la.eigh(projected(K, found))
    null = found @ mix[:, np.abs(values) < rounding * spread]
    # the geometry's own motions, seen in the null space: what turns stays a turn about its axis
    for candidates in (motions, nearly):
        seen = null.T @ np.asarray(M @ candidates)
        size = np.sqrt(np.einsum("ij,ij->j", candidates, np.asarray(M @ candidates)))
        kept = np.linalg.norm(seen, axis=0) > (1 - NEGLIGIBLE) * size
        several = np.hstack([*([basis] if candidates is nearly else []), null @ seen[:, kept]])
        whole = orthonormalised(M, several, dependent="drop")
        if whole.shape[1] >= null.shape[1]:
            break
    return whole


@dataclass(frozen=True)
class RigidMass:
    """Mass properties of the whole body; NaN where the DOFs do not determine them."""

    mass: FloatArray
    center: FloatArray
    inertia: FloatArray


def rigid_mass(M: Any, dofs: DofSet) -> RigidMass:
    """Return mass, centre of gravity and inertia: ``R^T M R`` of the six rigid-body motions R."""
    # with all six directions it is `[[m I, -m [c]x], [m [c]x, J]]`; a flat model that moves in z
    # only determines m, two coordinates of c, and the inertia about two axes
    motions = rigid_motions(dofs)
    whole = motions.T @ np.asarray(M @ motions)
    there = np.array([np.any(dofs.kinds == kind) for kind in range(3)])
    mass = np.where(there, np.diag(whole)[:3], np.nan)
    center = np.full(3, np.nan)
    # e_d . (e_k x c) m_d is the coupling of translation d with rotation k: linear in c
    rows, sides = [], []
    for d in np.flatnonzero(there):
        for k in range(3):
            rows.append(mass[d] * np.cross(np.eye(3)[d], np.eye(3)[k]))
            sides.append(whole[d, 3 + k])
    inertia = np.full((3, 3), np.nan)
    if rows:
        system = np.array(rows)
        known = np.abs(system).max(axis=0) > 0
        found = np.linalg.lstsq(system[:, known], np.array(sides), rcond=None)[0]
        center[known] = found
        about = np.where(known, center, 0.0)
        # shifted to the centre of gravity, motion by motion: exact for any mass matrix
        shift = np.eye(6)
        for k in range(3):
            shift[:3, 3 + k] = -np.cross(np.eye(3)[k], about)
        turned = motions @ shift
        inertia = (turned.T @ np.asarray(M @ turned))[3:, 3:]
        moves = np.array([np.any(turned[:, 3 + k] != 0) for k in range(3)])
        inertia[~moves] = np.nan
        inertia[:, ~moves] = np.nan
    return RigidMass(mass, center, inertia)


class Structure(Protocol):
    """Protocol of a model with k coordinates for plants: FEModel, Modes and ReducedModel."""

    @property
    def dofs(self) -> DofSet:
        """The DOFs among the coordinates, which come first."""

    @property
    def full_dofs(self) -> DofSet:
        """The n DOFs of the structure, with their coordinates."""

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (k,) that gives the motion at a place."""

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, k) of the motion at many points."""

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the coordinates (k, 6) of the six rigid-body motions."""

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the relative parts (6,) of these motions that the coordinates cannot make."""

    def inertia(self, motions: FloatArray) -> FloatArray:
        """Return the loads (k, r) ``M motions``."""


class Placed:
    """A model whose coordinates are the displacements of its DOFs."""

    dofs: DofSet

    @property
    def full_dofs(self) -> DofSet:
        """The DOFs of the full structure, which are `dofs` of this model."""
        return self.dofs

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (n,) whose product with all n displacements is the motion at a place.

        See `DofSet.row` for the arguments.
        """
        return self.dofs.row(at, direction)

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, n) of the motion at many points; see `DofSet.rows`."""
        return self.dofs.rows(points, direction)

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the six rigid-body motions (n, 6) x, y, z, rx, ry, rz.

        Rotations turn about the point `about` [m].
        """
        centre = real_array(about, "about", (3,))
        return rigid_motions(self.dofs, centre)


def relative_miss(made: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the relative error of motions (n, r) of a model from the wanted ones."""
    size = np.linalg.norm(wanted, axis=0)
    return np.asarray(np.linalg.norm(made - wanted, axis=0) / divisor(size))
