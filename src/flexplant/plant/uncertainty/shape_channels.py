"""Channels for Deltas on the shapes of modes, and on the gains of actuators and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...checks import FloatArray, real_array
from ...errors import ModelError
from ...lti.statespace import StateSpace
from ...tolerances import TINY
from ..building import rebuilt
from ..partition import Partition
from .delta_channels import require_exact, system_matrix, with_channels
from .uncertain_plant import Delta, modal_realisation, reshaped

#: relative: a dependence below this is rounding
_ROUNDING = 1e-9


class _Channel(NamedTuple):
    """One channel of a Delta: what it moves, what it reads, of which mode's velocity."""

    left: FloatArray
    right: FloatArray
    state: int
    #: whether it reads the rate of that state
    of_rate: bool = False
    name: str = ""
    #: factor of `right` that makes both sides of one size
    even: float = 1.0


def shape_deltas(
    plant: Partition,
    shapes: FloatArray,
    measured: Sequence[int],
    chosen: Sequence[int],
    deviations: float,
) -> list[Delta]:
    """Return a Delta for each direction (n,) of `shapes` (m, n, r) of the chosen modes."""
    realisation = modal_realisation(plant)
    n = realisation.outputs.shape[0]
    given = real_array(shapes, "shapes", (len(measured), n, None))
    found = []
    for number in chosen:
        phi = realisation.inputs[:, 2 * number - 1]
        for j, direction in enumerate(given[list(measured).index(number)].T, 1):
            size = float(np.linalg.norm(direction) / np.linalg.norm(phi))
            if size > 0:
                along = direction / size
                found.append(
                    Delta(f"mode{number}:shape{j}", number, "shape", deviations * size, along)
                )
    return found


def with_shape_channels(
    plant: Partition, system: StateSpace, others: Sequence[Delta], deltas: Sequence[Delta]
) -> StateSpace:
    r"""Return a plant's system with channels for Deltas on shapes beside those it has.

    ``phi + d v`` drives the mode by ``d v^T f`` more and shows ``d v q``, ``d v q'`` or
    ``d v q''`` of its motion more: four channels at most, of which q'' feels what the first one
    drives. Their columns are read off the plant assembled with forces or motions changed alone, so
    that they hold for any port and filter.
    """
    base, g = system_matrix(plant.system), plant.system
    n, m = g.n_states, len(g.inputs)
    before = len(system.inputs) - m
    first: list[_Channel] = []
    further: list[_Channel] = []
    for delta in deltas:
        states = [int(plant.modal_states[2 * delta.mode - i]) for i in (2, 1)]
        own = _channels(plant, delta, base, *states)
        if not own:
            raise ModelError(f"{delta.name} moves no port of the plant: leave that mode out.")
        for i, one in enumerate(own):
            row = np.concatenate([one.right[:n], np.zeros(before), one.right[n:]])
            if one.of_rate:  # with what the other Deltas make of it
                row = np.concatenate([system.A[one.state], system.B[one.state]])
            even = np.sqrt(delta.scale * np.linalg.norm(one.left) / np.linalg.norm(one.right))
            part = one._replace(
                name=f"{delta.name}:{i + 1}" if i else delta.name,
                left=one.left * (delta.scale / even),
                right=row * even,
                even=float(even),
            )
            (further if i else first).append(part)
    parts = [*first, *further]
    names = [one.name for one in parts]
    left = np.array([one.left for one in parts]).T
    right = np.array([one.right for one in parts])
    feed = np.array([one.of_rate * one.even * left[one.state] for one in parts])
    found = with_channels(system, before, names, left, right, feed)
    require_exact(plant, found, [*others, *deltas], "the shapes of modes", "Leave shapes= out.")
    return found


def _channels(plant: Partition, delta: Delta, base: FloatArray, q: int, v: int) -> list[_Channel]:
    """Return columns and rows of what a unit change of a shape does, of states q and v."""
    realisation = modal_realisation(plant)
    driven, seen = (
        system_matrix(rebuilt(plant, realisation=one).system) - base
        for one in (
            reshaped(realisation, delta, 1.0, outputs=False),
            reshaped(realisation, delta, 1.0, inputs=False),
        )
    )
    found = []
    row = driven[v]
    if np.any(row):
        found.append(_Channel(driven @ row / (row @ row), row, v))
    # displacements and velocities read the states, accelerations what else their rate holds
    size, rest, beyond = np.linalg.norm(seen, axis=1), seen.copy(), base[v].copy()
    rest[:, [q, v]], beyond[[q, v]] = 0.0, 0.0
    amount = rest @ beyond / max(float(beyond @ beyond), TINY)
    amount[np.linalg.norm(rest, axis=1) <= _ROUNDING * size] = 0.0
    plain = seen - np.outer(amount, base[v])
    motion, speed = (np.eye(base.shape[1])[i] for i in (q, v))
    for column, right, of_rate in (
        (plain[:, q], motion, False),
        (plain[:, v], speed, False),
        (amount, base[v], True),
    ):
        small = np.abs(column) * np.linalg.norm(right) <= _ROUNDING * size
        left = np.where(small, 0.0, column)
        if np.any(left):
            found.append(_Channel(left, right, v, of_rate))
    return found
