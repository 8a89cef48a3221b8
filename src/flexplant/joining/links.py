"""Joints as rows: one for each axis, over the coordinates of all components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..arrays import FloatArray, IntArray, positive
from ..dof_columns import in_box
from ..errors import ModelError, warn
from ..labels import DIRECTIONS, DofSet
from ..sparse.symmetric import DEPENDENT
from ..structure.rigid import rigid_motions
from ..tolerances import CLOSE, FOUR_DIGITS, NEGLIGIBLE, PRECISION, ROOT, SAME, TYPED
from .component import Component, Model, Pose, components_of
from .joint import Joint, JointEnd, joint_axes, joint_list

#: relative stretch of a joint in a motion of the whole machine below which it counts as zero
BALANCED = SAME


class Felt(NamedTuple):
    """Motion of a component seen by a joint: ``values @ q[columns]`` of all its DOFs."""

    component: int
    columns: IntArray
    values: FloatArray


class Link(NamedTuple):
    """One axis of one joint."""

    joint: Joint
    axis: str
    ends: tuple[Felt, ...]
    stiffness: float
    rate: float
    carried: FloatArray

    @property
    def holds(self) -> bool:
        """Whether it transmits forces: a spring of zero stiffness, for an update, does not."""
        return self.joint.is_rigid or self.stiffness != 0 or self.rate != 0

    @property
    def owners(self) -> tuple[int, ...]:
        """Components that it joins."""
        return tuple(end.component for end in self.ends)


def links_of(joints: Any, parts: Sequence[Component]) -> list[Link]:
    """Return all axes of all joints."""
    size, dofs = machine_size(parts), {part.name: part.dofs for part in parts}
    motions = [rigid_motions(part.dofs) for part in parts]
    return [link for one in joint_list(joints) for link in _links(one, dofs, size, motions)]


def machine_size(parts: Sequence[Component]) -> float:
    """Return the largest extent of a machine [m], 1 for a single point."""
    xyz = np.vstack([part.dofs.xyz for part in parts])
    return float(np.ptp(xyz, axis=0).max()) or 1.0


def _links(
    joint: Joint, parts: Mapping[str, DofSet], size: float, motions: Sequence[FloatArray]
) -> list[Link]:
    first = JointEnd(parts, joint.first, size, motions)
    second = None if joint.second is None else JointEnd(parts, joint.second, size, motions)
    axes = joint_axes(joint, first, second)
    point = first.point if joint.point is None else np.asarray(joint.point, dtype=np.float64)
    if joint.point is None and second is not None and second.is_near(point):
        point = second.point  # the second end follows with the rotations of the first
    found = []
    for axis, stiffness, rate in zip(axes, *joint.values(axes), strict=True):
        row = first.row(axis, point)
        ends, carried = [_felt(first.index, row)], np.zeros(6)
        if second is not None:
            other = -second.row(axis, point)
            ends.append(_felt(second.index, other))
            carried = first.carried(row) + second.carried(other)
            if first.index == second.index:
                ends = [_felt(first.index, row + other)]
            _check_balance(joint, axis, carried, size)
        if not any(end.columns.size for end in ends):
            raise ModelError(
                f"both ends of {joint!r} are the same place, so that it has no effect. Name two "
                "places."
            )
        found.append(Link(joint, axis, tuple(ends), float(stiffness), float(rate), carried))
    return found


def _felt(index: int, row: FloatArray) -> Felt:
    columns = np.flatnonzero(row)
    return Felt(index, columns, row[columns])


def _check_balance(joint: Joint, axis: str, carried: FloatArray, size: float) -> None:
    """Refuse or warn of a joint that a motion of the whole machine stretches."""
    felt = np.abs(carried) / np.array([1.0] * 3 + [size] * 3)
    if felt.max() <= BALANCED:
        return
    axes = ", ".join(DIRECTIONS[k] for k in np.flatnonzero(felt > BALANCED))
    arm = f"{np.abs(carried[3:]).max():.3g} m apart" if felt[:3].max() <= BALANCED else "oblique"
    said = (
        f"{joint!r} would hold the machine's motion {axes} against the ground: along {axis}, its "
        f"ends are {arm}, and its forces do not balance. Join nodes or points with axes=[...], "
        "which have lever arms, shift a component by its Pose, or join a Patch."
    )
    if joint.is_rigid:
        raise ModelError(said)
    warn(said)


def stretch_rows(links: Sequence[Link], parts: Sequence[Component]) -> sp.csr_array:
    """Return the stretches of links (m, n) from the coordinates of all components."""
    starts = np.concatenate([[0], np.cumsum([part.n for part in parts])])
    data, rows, columns = [np.zeros(0)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for i, link in enumerate(links):
        for end in link.ends:
            part, some, values = parts[end.component], end.columns, end.values
            if part.is_reduced:
                felt = values @ part.T[some]
                some = np.flatnonzero(felt)
                values = felt[some]
            data.append(values)
            rows.append(np.full(some.size, i))
            columns.append(starts[end.component] + some)
    entries = (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_array(entries, shape=(len(links), int(starts[-1])))


def warn_of_missing_statics(links: Sequence[Link], parts: Sequence[Component]) -> None:
    """Warn of reduced components without static shapes for the loads of their joints."""
    for index, part in enumerate(parts):
        if not part.is_reduced or part.n == len(part.dofs):
            continue
        felt = [(link, end) for link in links for end in link.ends if end.component == index]
        wanted = np.zeros((len(felt), len(part.dofs)))
        for row, (_, end) in zip(wanted, felt, strict=True):
            row[end.columns] = end.values
        some = np.any(part.static_rows, axis=0) | np.any(wanted, axis=0)
        known, wanted = part.static_rows[:, some], wanted[:, some]
        left = wanted - (wanted @ np.linalg.pinv(known)) @ known
        part_left = np.linalg.norm(left, axis=1) / np.linalg.norm(wanted, axis=1)
        lost = [felt[i][0] for i in np.flatnonzero(part_left > NEGLIGIBLE)]
        if lost:
            more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
            warn(
                f"component {part.name!r} ({part.model!r}) holds no static shape for the load of "
                f"{lost[0].joint!r} ({lost[0].axis}){more}: without the compliance of the "
                "truncated modes, the joint is too stiff. Solve with compliance_at=[...] there, "
                "or by "
                "CraigBampton(boundary=[...]) or Rubin."
            )


def coincident_joints(
    components: Mapping[str, Model],
    *,
    placed: Mapping[str, Pose] | None = None,
    box: Sequence[Sequence[float]] | FloatArray | None = None,
    tolerance: float | None = None,
) -> list[Joint]:
    """Return rigid joints of all coincident nodes of different components.

    Use it for components whose meshes match where they touch. Each joint acts along all axes along
    which both nodes have a DOF.

    Parameters
    ----------
    components : mapping {str: FEModel or ReducedModel}
        Components as for `joined`. All nodes of the full structure of a reduced model are compared.
    placed : mapping {str: Pose}, optional
        Poses as for `joined`.
    box : (2, 3) array [m], optional
        Lowest and highest corner of a box in the machine. Only nodes in it are joined.
    tolerance : float [m], optional
        Largest distance of coincident nodes. None: 1e-6 times the size of the machine.

    Raises
    ------
    ModelError
        When no nodes coincide, or a node is close to several others.

    Examples
    --------
    The first nodes of both chains are at the origin and are joined:

    >>> from flexplant.structure import chain
    >>> stage, frame = chain(masses=[1, 2], stiffnesses=[5]), chain(masses=[3, 4], stiffnesses=[6])
    >>> coincident_joints({"stage": stage, "frame": frame}, box=[(0, 0, 0), (0, 0, 0)])
    [<Joint stage/1 - frame/1 along x, rigid>]
    """
    parts = components_of(components, placed)
    reach = TYPED * machine_size(parts) if tolerance is None else positive(tolerance, "tolerance")
    found: list[Joint] = []
    for one, other in combinations(parts, 2):
        found += _joints(one, other, box, reach)
    if not found:
        raise ModelError(
            f"no nodes of {', '.join(part.name for part in parts)} are within {reach:.2g} m of "
            "each other. Check their poses, give tolerance=, or join a Patch."
        )
    return found


def _joints(one: Component, other: Component, box: Any, reach: float) -> list[Joint]:
    from scipy.spatial import KDTree

    first, second = _box_nodes(one.dofs, box), _box_nodes(other.dofs, None)
    if not first.size or not second.size:
        return []
    found_at: Any = KDTree(other.dofs.xyz[second]).query(one.dofs.xyz[first])
    distance, nearest = found_at
    pairs = [(first[i], second[nearest[i]]) for i in np.flatnonzero(distance <= reach)]
    if len({int(row) for _, row in pairs}) < len(pairs):
        raise ModelError(
            f"nodes of {one.name!r} and {other.name!r} are near several of each other within "
            f"{reach:.2g} m: lower tolerance=."
        )
    found = []
    for i, j in pairs:
        both = _axes(one.dofs, i) & _axes(other.dofs, j)
        if both:
            rows = ((one, i), (other, j))
            ends = [f"{p.name}/{p.dofs._label(row).partition(':')[0]}" for p, row in rows]
            found.append(Joint(*ends, axes=[axis for axis in DIRECTIONS if axis in both]))
    return found


def _box_nodes(dofs: DofSet, box: Any) -> Any:
    """Return one row for each node in a box."""
    inside = np.ones(len(dofs), dtype=bool) if box is None else in_box(dofs.xyz, box)
    first = np.unique(dofs.node_index, return_index=True)[1]
    return first[inside[first]]


def _axes(dofs: DofSet, row: int) -> set[str]:
    return {dofs.directions[i] for i in np.flatnonzero(dofs.node_index == dofs.node_index[row])}


#: preference for later components as followers; far above rounding
_LATER, _WITHIN = CLOSE, FOUR_DIGITS
#: size relative to the largest in its constraint above which a coordinate may follow without
#: further search
_HEAVY = 0.3


class Elimination(NamedTuple):
    """Coordinates (n,) that satisfy constraints, from the remaining ones (k,): ``q = T q_k``."""

    T: sp.csc_array
    kept: IntArray
    rank: int


def eliminated(B: sp.csr_array, size: FloatArray, order: IntArray) -> Elimination:
    """Return the motions that satisfy ``B q = 0``."""
    # coordinates without a constraint stay; a coordinate in a single constraint follows from it;
    # the other constraints are solved in separate groups without common coordinates, so that sparse
    # matrices stay sparse
    n = B.shape[1]
    lead = _own_followers(B, size, order)
    plain = lead >= 0
    first = _block_motions(B[~plain], size, order)
    # coordinates in one constraint only follow from it, independent of the others
    leads = lead[plain]
    some = sp.csr_array(B[plain])
    pivot = some[np.arange(leads.size), leads]
    rest = sp.csr_array(sp.diags_array(-1.0 / pivot) @ some) if leads.size else some
    still = np.ones(n)
    still[leads] = 0.0
    every = sp.eye_array(n, format="csc")
    follow = (every + every[:, leads] @ rest) @ sp.diags_array(still)
    left = still[first.kept] > 0
    T = sp.csc_array(follow @ first.T[:, np.flatnonzero(left)])
    return Elimination(T, first.kept[left], first.rank + leads.size)


def _own_followers(B: Any, size: FloatArray, order: IntArray) -> IntArray:
    """Return for each constraint (m,) a coordinate that only it contains, or -1."""
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
    found[rows[chosen]] = columns[chosen]  # the last of several is kept
    return found


def _block_motions(B: Any, size: FloatArray, order: IntArray) -> Elimination:
    """Return the motions that satisfy constraints, solved in groups without common coordinates."""
    n = B.shape[1]
    touched = np.unique(B.indices).astype(np.int64)
    follow, rows, columns, values = [np.zeros(0, np.int64)], [], [], []
    for some, own in _constraint_blocks(B, touched):
        lead, X = _follower_rows(B[some][:, own].toarray(), size[own], order[own])
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


def _constraint_blocks(B: Any, touched: IntArray) -> list[tuple[IntArray, IntArray]]:
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


def _follower_rows(
    block: FloatArray, size: FloatArray, order: IntArray
) -> tuple[IntArray, FloatArray]:
    """Return the columns that follow (r,) and how: ``q_lead = X q_rest``."""
    k = block.shape[1]
    scaled = block / size
    scaled = scaled / np.linalg.norm(scaled, axis=1)[:, None]
    # rounding must not decide between equal pivots
    prefer = 1.0 + _LATER * order / (order.max() + 1) + _WITHIN * np.arange(k) / k
    R, pivots = la.qr(scaled * prefer, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > ROOT * diagonal[0]))
    if rank and diagonal[rank - 1] < DEPENDENT * diagonal[0]:
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
    X[np.abs(X) < PRECISION * np.abs(X).max(initial=0.0)] = 0.0
    return lead, X * size[lead][:, None] ** -1 * size[rest] if rank else X
