"""Channels of measured responses as DOFs: which are outputs and inputs, and where they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..dof_columns import at_nodes
from ..errors import LabelError
from ..labels import DIRECTIONS, DofSet
from ..lti import Frf
from ..values import FloatArray, instance


class Side(NamedTuple):
    """The outputs, or the inputs, of a component that are DOFs."""

    name: str
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
        found: Side = getattr(self, which)
        return found

    def named(self, row: FloatArray, which: str) -> dict[str, float]:
        """Return the weights of a row by the names of the channels, zeros left out."""
        side = self.side(which)
        return {side.channels[i]: float(row[i]) for i in np.flatnonzero(row)}


def channels_of(name: str, frf: Frf, dofs: DofSet | None, *, inside: bool = False) -> Channels:
    """Return the channels of a component that are DOFs."""
    if dofs is not None:
        instance(dofs, DofSet, f"dofs of {name!r}", "Pass DofSet(nodes, directions, xyz).")
    sides = [_side(name, names, dofs, inside=inside) for names in (frf.outputs, frf.inputs)]
    return Channels(name, sides[0], sides[1], dofs is not None)


def _side(name: str, names: Sequence[str], dofs: DofSet | None, *, inside: bool) -> Side:
    nodes, directions, channels, owners = [], [], [], []
    for channel in names:
        label = channel
        if inside:
            owner, _, label = channel.partition("/")
            if owner != name:
                continue
        component, _, label = label.removeprefix("u ").rpartition("/")
        node, _, direction = label.partition(":")
        if direction in DIRECTIONS and node.isdigit():
            nodes.append(int(node))
            directions.append(direction)
            owners.append(component)
            channels.append(channel.partition("/")[2] if inside else channel)
    xyz = np.zeros((len(nodes), 3))
    if dofs is not None and nodes:
        first = np.unique(dofs.nodes, return_index=True)[1]
        known, places = dofs.nodes[first], dofs.xyz[first]
        xyz = at_nodes(np.array(nodes), known, places, f"the DofSet of {name!r}")
    listed = sorted(set(owners))
    plain = DofSet(np.array(nodes, dtype=np.int64), tuple(directions), xyz)
    if listed in ([], [""]):
        return Side(name, plain, tuple(channels))
    if "" in listed:
        raise LabelError(
            f"some channels of {name!r} are of components ({', '.join(filter(None, listed))}), "
            "others are not: name all alike."
        )
    numbers = [listed.index(component) for component in owners]
    found = plain.replace(components=tuple(listed), component_of=np.array(numbers, dtype=np.int64))
    return Side(name, found, tuple(channels))


def parts_of(frfs: Mapping[str, Frf], dofs: Mapping[str, DofSet] | None) -> list[Channels]:
    """Return the channels of all components."""
    places = known_places(dofs, frfs)
    return [channels_of(name, frf, places.get(name)) for name, frf in frfs.items()]


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
