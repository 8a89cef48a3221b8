"""Joints between measured frequency responses: rows over their channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import LabelError, ModelError, unknown_label
from ..labels import DIRECTIONS
from ..values import ComplexArray, FloatArray, instance
from .joint import Joint

#: time derivatives in the outputs of a measurement
ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
#: a joint that adds less than this part to the others repeats them
_RANK = 1e-9


class FrfLink(NamedTuple):
    """One axis of a joint: the channels of its ends, stiffness and rate (None: rigid)."""

    first: str
    second: str | None
    stiffness: float | None
    rate: float


def frf_links(joints: Sequence[Any], channels: Mapping[str, tuple[str, ...]]) -> list[FrfLink]:
    """Return all axes of joints between responses.

    Parameters
    ----------
    joints : sequence of Joint
        Between DOFs, "stage/41:z", or nodes, "stage/41": their channels are "41:z".
    channels : mapping {str: tuple of str}
        The channels of each component that are both outputs and inputs.

    Raises
    ------
    LabelError
        When a channel is not both an output and an input of its component.
    ModelError
        When an end is no DOF and no node, or lever arms would be needed.
    """
    found = []
    for joint in joints:
        instance(joint, Joint, "a joint", "Pass Joint('stage/41:z', 'frame/7:z').")
        ends = [joint.first] if joint.second is None else [joint.first, joint.second]
        if joint.point is not None or not all(isinstance(end, str) for end in ends):
            raise ModelError(
                f"{joint!r} needs places or lever arms, which measured responses do not have. Join "
                "channels: Joint('stage/41:z', 'frame/7:z')."
            )
        axes, named = _axes(joint, [str(end) for end in ends], channels)
        for axis, k, c in zip(axes, *joint.values(axes), strict=True):
            sides = [_channel(end, axis, channels) for end in named]
            if len(set(sides)) < len(sides):
                raise ModelError(f"both ends of {joint!r} are one channel: it would do nothing.")
            second = sides[1] if len(sides) > 1 else None
            stiffness = None if joint.is_rigid else float(k)
            found.append(FrfLink(sides[0], second, stiffness, float(c)))
    return found


def _axes(
    joint: Joint, ends: list[str], channels: Mapping[str, tuple[str, ...]]
) -> tuple[tuple[str, ...], list[str]]:
    if joint.axes is not None:
        return tuple(joint.axes), ends
    labelled = [end for end in ends if ":" in end]
    if labelled:
        return (labelled[0].rpartition(":")[2],), ends
    known = []
    for end in ends:
        name, _, node = end.partition("/")
        there = channels.get(name, ())
        known.append(tuple(axis for axis in DIRECTIONS if f"{node}:{axis}" in there))
    if not known[0] or known[-1] != known[0]:
        raise LabelError(
            f"the ends of {joint!r} have channels along {known[0]} and {known[-1]}: it is not "
            "clear what is joined. Name axes=[...], measured at both ends as output and input."
        )
    return known[0], ends


def _channel(end: str, axis: str, channels: Mapping[str, tuple[str, ...]]) -> str:
    name, _, rest = end.partition("/")
    if name not in channels:
        raise unknown_label("component", name, channels)
    if ":" in rest and rest.rpartition(":")[2] != axis:
        raise LabelError(
            f"the joint at {end!r} has no axis {axis!r}: it is along {rest.rpartition(':')[2]}. "
            "Join channels of one direction; of a node, 'stage/41', name axes=[...]."
        )
    channel = rest if ":" in rest else f"{rest}:{axis}"
    if channel not in channels[name]:
        raise LabelError(
            f"{unknown_label('channel', channel, channels[name], name)} A joint needs the response "
            "to a force at its own place: a channel that is an output and an input, named alike."
        )
    return f"{name}/{channel}"


def channel_rows(links: Sequence[FrfLink], names: Sequence[str]) -> FloatArray:
    """Return the stretches (m, n) of links by named channels."""
    place = {name: i for i, name in enumerate(names)}
    B = np.zeros((len(links), len(names)))
    for row, link in zip(B, links, strict=True):
        row[place[link.first]] += 1.0
        if link.second is not None:
            row[place[link.second]] -= 1.0
    return B


def softness(links: Sequence[FrfLink], freq: FloatArray, quantity: str | None) -> ComplexArray:
    """Return what links give way (m, n_freq) per force: ``(2 pi i f)^p / (k + 2 pi i f c)``.

    p is 0, 1 or 2 where displacements, velocities or accelerations are measured.

    Raises
    ------
    ModelError
        When there are springs and the quantity is not known, or one of them has neither stiffness
        nor rate at a frequency.
    """
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
                f"the joint at {link.first!r} has neither stiffness nor damping at a frequency: "
                "leave it out, or leave out zero frequency."
            )
        row[:] = s ** ORDERS[quantity] / force
    return found


def independent(B: FloatArray, links: Sequence[FrfLink]) -> list[int]:
    """Return the rows that are left when rigid joints that repeat others are taken out."""
    rigid = [i for i, link in enumerate(links) if link.stiffness is None]
    others = [i for i, link in enumerate(links) if link.stiffness is not None]
    if not rigid:
        return others
    R, pivots = la.qr(B[rigid].T, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > _RANK * diagonal[0]))
    return sorted([rigid[i] for i in pivots[:rank]] + others)
