"""Joints between measured frequency responses: rows over their outputs and their inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, instance
from ..dof_columns import at_nodes
from ..errors import LabelError, ModelError, unknown_label, warn
from ..labels import DIRECTIONS, DofSet
from ..lti import Frf
from ..lti.frequency import ORDERS
from ..structure.rigid import rigid_motions
from ..tolerances import SAME
from .joint import Joint, JointEnd, Patch, joint_axes

#: fraction below which a joint counts as a repetition of other joints
_RANK = SAME
#: fraction of the motion of a patch that differs from its mean, at the median frequency, above
#: which a warning is given
_BENDS = 0.1


class FrfEnd(NamedTuple):
    """Motion that one end of a joint sees, and distribution of its force."""

    owner: str
    outputs: Mapping[str, float]
    inputs: Mapping[str, float]

    def turned(self) -> FrfEnd:
        """Return the end with the opposite sign."""
        rows = ({name: -w for name, w in row.items()} for row in (self.outputs, self.inputs))
        return FrfEnd(self.owner, *rows)


class FrfLink(NamedTuple):
    """One axis of a joint: its ends, stiffness and rate (None: rigid)."""

    name: str
    ends: tuple[FrfEnd, ...]
    stiffness: float | None
    rate: float


def frf_links(joint: Joint, parts: Sequence[Channels]) -> list[FrfLink]:
    """Return all axes of a joint between responses."""
    given = [joint.first] if joint.second is None else [joint.first, joint.second]
    owners = [_component_of(end, parts) for end in given]
    for end, owner in zip(given, owners, strict=True):
        if isinstance(end, tuple):
            raise ModelError(
                f"{joint!r} is between points, but no channel measures their motion. Join "
                "channels, "
                "fx.joining.Joint('stage/41:z', 'frame/7:z'), or a Patch of nodes around the point."
            )
        if (isinstance(end, Patch) or joint.point is not None) and not owner.is_placed:
            raise ModelError(
                f"{joint!r} needs the places of the channels of {owner.name!r} for its lever "
                f"arms: pass dofs={{{owner.name!r}: DofSet(...)}}, or join channels, "
                "fx.joining.Joint('stage/41:z', 'frame/7:z')."
            )
    seen, pushed = ([_end(parts, end, side) for end in given] for side in ("outputs", "inputs"))
    axes = joint_axes(joint, seen[0], seen[-1] if len(seen) > 1 else None)
    point = seen[0].point if joint.point is None else np.asarray(joint.point, dtype=np.float64)
    found = []
    for axis, k, c in zip(axes, *joint.values(axes), strict=True):
        ends = tuple(
            FrfEnd(
                owner.name,
                owner.named(sign * out.row(axis, point), "outputs"),
                owner.named(sign * into.row(axis, point), "inputs"),
            )
            for sign, owner, out, into in zip((1.0, -1.0), owners, seen, pushed, strict=False)
        )
        if len(ends) > 1 and ends[0].owner == ends[1].owner and not _weights_of(ends, "outputs"):
            raise ModelError(
                f"both ends of {joint!r} are the same channel, so that it has no effect. Name "
                "two channels."
            )
        stiffness = None if joint.is_rigid else float(k)
        found.append(FrfLink(f"{joint!r} along {axis}", ends, stiffness, float(c)))
    return found


def _component_of(end: Any, parts: Sequence[Channels]) -> Channels:
    name = end.component if isinstance(end, Patch) else end[0]
    if isinstance(end, str):
        name = end.partition("/")[0]
    for part in parts:
        if part.name == name:
            return part
    raise unknown_label("component", name, [part.name for part in parts])


def _end(parts: Sequence[Channels], end: Any, side: str) -> JointEnd:
    sides = {part.name: part.side(side).dofs for part in parts}
    size = np.ptp(np.vstack([dofs.xyz for dofs in sides.values()]), axis=0).max(initial=0.0)
    motions = [rigid_motions(dofs) for dofs in sides.values()]
    try:
        if isinstance(end, Patch):
            end = _measured_patch(end, _component_of(end, parts), side)
        return JointEnd(sides, end, float(size) or 1.0, motions)
    except LabelError as error:
        raise LabelError(
            f"{error} These are the {side}: a joint needs the response to a force at its own "
            "place, channels that are outputs and inputs, named alike ('41:z', or an input "
            "'u 41:z')."
        ) from None


def _measured_patch(patch: Patch, owner: Channels, side: str) -> Patch:
    """Return the measured part of a patch: sensors and hammers may be at different nodes."""
    if patch.nodes is None:
        return patch
    both = {*owner.outputs.dofs.nodes.tolist(), *owner.inputs.dofs.nodes.tolist()}
    nodes, there = list(patch.nodes), set(owner.side(side).dofs.nodes.tolist())
    if not both.issuperset(nodes):
        raise LabelError(
            f"{patch!r} has nodes {sorted(set(nodes) - both)[:6]} that are not measured. Leave "
            "them out."
        )
    kept = [i for i, node in enumerate(nodes) if node in there]
    weights = None if patch.weights is None else np.asarray(patch.weights)[kept]
    return patch.replace(nodes=[nodes[i] for i in kept], weights=weights)


def _weights_of(ends: Sequence[FrfEnd], side: str) -> dict[str, float]:
    """Return the non-zero weights of the machine's channels in a stretch."""
    total: dict[str, float] = {}
    for end in ends:
        for channel, weight in getattr(end, side).items():
            name = f"{end.owner}/{channel}"
            total[name] = total.get(name, 0.0) + weight
    return {name: weight for name, weight in total.items() if weight}


def channel_rows(links: Sequence[FrfLink], names: Sequence[str], side: str) -> FloatArray:
    """Return the stretches (m, n) of links from named outputs, or their forces at inputs."""
    place = {name: i for i, name in enumerate(names)}
    B = np.zeros((len(links), len(names)))
    for row, link in zip(B, links, strict=True):
        for name, weight in _weights_of(link.ends, side).items():
            row[place[name]] = weight
    return B


def warn_of_bending(
    joints: Sequence[Joint], parts: Sequence[Channels], frfs: Mapping[str, Frf]
) -> None:
    """Warn of patches whose measured motion is not that of a rigid body."""
    for joint in joints:
        for end in (joint.first, joint.second):
            if not isinstance(end, Patch):
                continue
            owner = _component_of(end, parts)
            side, frf = owner.outputs, frfs[owner.name]
            patch = _measured_patch(end, owner, "outputs")
            mean, A, _ = patch.mean(side.dofs, patch.point(side.dofs))
            channels = [side.channels[row] for row in patch.rows(side.dofs)]
            moved = frf.data[[frf.outputs.index(channel) for channel in channels]]
            bending = moved - np.einsum("ij,jkf->ikf", A @ mean, moved)
            part = np.linalg.norm(bending, axis=(0, 1)) / np.linalg.norm(moved, axis=(0, 1))
            if np.median(part) > _BENDS:
                warn(
                    f"{end!r} bends: {100 * np.median(part):.0f} % of its measured motion at the "
                    "median frequency differs from its mean, and only the mean is joined. Use "
                    "nodes closer to each other, or look for a wrong direction of a channel."
                )


def softness(links: Sequence[FrfLink], freq: FloatArray, quantity: str | None) -> ComplexArray:
    """Return the compliance (m, n_freq) of links: ``(2 pi i f)^p / (k + 2 pi i f c)``."""
    # p is 0, 1 or 2 for measured displacements, velocities or accelerations
    s = 2j * np.pi * freq
    found = np.zeros((len(links), freq.size), dtype=np.complex128)
    for row, link in zip(found, links, strict=True):
        if link.stiffness is None:
            continue
        if quantity not in ORDERS:
            raise ModelError(
                "springs and dampers need to know what the responses measure: state it, "
                "frf.replace(quantity='acceleration')."
            )
        force = link.stiffness + s * link.rate
        if not np.all(force):
            raise ModelError(
                f"{link.name} has neither stiffness nor damping at a frequency: leave it out, or "
                "leave out zero frequency."
            )
        row[:] = s ** ORDERS[quantity] / force
    return found


def independent(B: FloatArray, links: Sequence[FrfLink]) -> list[int]:
    """Return the rows without rigid joints that repeat others."""
    rigid = [i for i, link in enumerate(links) if link.stiffness is None]
    others = [i for i, link in enumerate(links) if link.stiffness is not None]
    if not rigid:
        return others
    R, pivots = la.qr(B[rigid].T, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > _RANK * diagonal[0]))
    return sorted([rigid[i] for i in pivots[:rank]] + others)


class Side(NamedTuple):
    """Outputs or inputs of a component that are DOFs."""

    dofs: DofSet
    channels: tuple[str, ...]


class Channels(NamedTuple):
    """The channels of a component that joints can name."""

    name: str
    outputs: Side
    inputs: Side
    is_placed: bool

    def side(self, which: str) -> Side:
        """Return the outputs or the inputs."""
        return self.outputs if which == "outputs" else self.inputs

    def named(self, row: FloatArray, which: str) -> dict[str, float]:
        """Return the non-zero weights of a row by the names of the channels."""
        side = self.side(which)
        return {side.channels[i]: float(row[i]) for i in np.flatnonzero(row)}


def channels_as_dofs(name: str, frf: Frf, dofs: DofSet | None, *, inside: bool = False) -> Channels:
    """Return the channels of a component that are DOFs."""
    if dofs is not None:
        instance(dofs, DofSet, f"dofs of {name!r}", "Pass DofSet(nodes, directions, xyz).")
    sides = [_side(name, names, dofs, inside=inside) for names in (frf.outputs, frf.inputs)]
    return Channels(name, sides[0], sides[1], dofs is not None)


def _side(name: str, names: Sequence[str], dofs: DofSet | None, *, inside: bool) -> Side:
    nodes, directions, channels, owners = [], [], [], []
    begin = f"{name}/" if inside else ""
    for channel in (full[len(begin) :] for full in names if full.startswith(begin)):
        component, _, label = channel.removeprefix("u ").rpartition("/")
        node, _, direction = label.partition(":")
        if direction in DIRECTIONS and node.isdigit():
            nodes.append(int(node))
            directions.append(direction)
            owners.append(component)
            channels.append(channel)
    xyz = np.zeros((len(nodes), 3))
    if dofs is not None and nodes:
        first = np.unique(dofs.nodes, return_index=True)[1]
        known, places = dofs.nodes[first], dofs.xyz[first]
        xyz = at_nodes(np.array(nodes), known, places, f"the DofSet of {name!r}")
    listed = sorted(set(owners))
    plain = DofSet(np.array(nodes, dtype=np.int64), tuple(directions), xyz)
    if listed in ([], [""]):
        return Side(plain, tuple(channels))
    if "" in listed:
        raise LabelError(
            f"some channels of {name!r} name a component ({', '.join(filter(None, listed))}), "
            "others do not: name all in the same way."
        )
    numbers = [listed.index(component) for component in owners]
    found = plain.replace(components=tuple(listed), component_of=np.array(numbers, dtype=np.int64))
    return Side(found, tuple(channels))


def known_places(dofs: object, names: Mapping[str, object] | Sequence[str]) -> dict[str, DofSet]:
    """Return the places of components."""
    if dofs is None:
        return {}
    found: Mapping[str, DofSet] = instance(dofs, Mapping, "dofs", "Pass {'stage': DofSet(...)}.")
    for name in found:
        if name not in names:
            raise LabelError(
                f"dofs has places of {name!r}, but the components are {', '.join(names)}. Name one "
                "of them."
            )
    return dict(found)
