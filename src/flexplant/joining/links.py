"""Joints as rows: one for each axis, over the coordinates of all components."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ..errors import ModelError, warn
from ..labels import DIRECTIONS
from ..structure.rigid import rigid_motions
from ..values import FloatArray, IntArray, instance
from .component import Component
from .ends import JointEnd, joint_axes
from .joint import Joint

#: relative: what a joint feels of a motion of the whole machine below this is rounding
BALANCED = 1e-9
#: part of a joint's row that static shapes of a reduced component may miss
_STATIC = 1e-3


class Felt(NamedTuple):
    """What a joint feels of a component: ``values @ q[columns]`` of all its DOFs."""

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
        """Whether forces go through it: a spring of zero stiffness, to be updated say, has none."""
        return self.joint.is_rigid or self.stiffness != 0 or self.rate != 0

    @property
    def owners(self) -> tuple[int, ...]:
        """The components it joins."""
        return tuple(end.component for end in self.ends)


def links_of(joints: Any, parts: Sequence[Component]) -> list[Link]:
    """Return all axes of all joints."""
    listed = (
        [joints]
        if isinstance(joints, Joint)
        else list(instance(joints, Iterable, "joints", "Pass Joint(...) in [...]."))
    )
    size = machine_size(parts)
    motions = [rigid_motions(part.dofs) for part in parts]
    return [link for joint in listed for link in _links(joint, parts, size, motions)]


def machine_size(parts: Sequence[Component]) -> float:
    """Return the largest extent of a machine [m], 1 when it has none."""
    xyz = np.vstack([part.dofs.xyz for part in parts])
    return float(np.ptp(xyz, axis=0).max()) or 1.0


def _links(
    joint: Any, parts: Sequence[Component], size: float, motions: Sequence[FloatArray]
) -> list[Link]:
    instance(joint, Joint, "a joint", "Pass Joint('stage/41:z', 'frame/7:z').")
    first = JointEnd(parts, joint.first, size, motions)
    second = None if joint.second is None else JointEnd(parts, joint.second, size, motions)
    axes = joint_axes(joint, first, second)
    point = first.point if joint.point is None else np.asarray(joint.point, dtype=np.float64)
    if joint.point is None and second is not None and second.is_near(point):
        point = second.point  # the second end follows, by the rotations of the first
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
            raise ModelError(f"both ends of {joint!r} are one place: it would do nothing.")
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


def rows_of(links: Sequence[Link], parts: Sequence[Component]) -> sp.csr_array:
    """Return the stretches of links (m, n) by the coordinates of all components."""
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
        if not felt:
            continue
        names = [f"{link.joint!r} ({link.axis})" for link, _ in felt]
        wanted = np.zeros((len(felt), len(part.dofs)))
        for row, (_, end) in zip(wanted, felt, strict=True):
            row[end.columns] = end.values
        known = part.static_rows
        left = wanted
        if known.size:
            some = np.flatnonzero(np.any(known, axis=0) | np.any(wanted, axis=0))
            known, left, wanted = known[:, some], left[:, some], wanted[:, some]
            left = wanted - (wanted @ np.linalg.pinv(known)) @ known
        part_left = np.linalg.norm(left, axis=1) / np.linalg.norm(wanted, axis=1)
        lost = [name for name, share in zip(names, part_left, strict=True) if share > _STATIC]
        if lost:
            more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
            warn(
                f"component {part.name!r} ({part.model!r}) holds no static shape for the load of "
                f"{lost[0]}{more}: without the compliance of the modes left out, the joint is too "
                "stiff. Solve with compliance_at=[...] there, or reduce by "
                "CraigBampton(boundary=[...]) or Rubin."
            )
