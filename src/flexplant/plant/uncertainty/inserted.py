"""Channels of Deltas put into a system, and the check that the Deltas give the changed plant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...errors import ModelError
from ...lti.statespace import StateSpace
from ...values import FloatArray
from ..partition import Partition
from .uncertain_plant import Delta, with_changes

#: values of the Deltas at which the channels are compared with a plant assembled anew
_PROBE = 0.5


def system_matrix(g: StateSpace) -> FloatArray:
    """Return ``[A B; C D]``."""
    return np.block([[g.A, g.B], [g.C, g.D]])


def with_channels(
    g: StateSpace,
    before: int,
    names: Sequence[str],
    left: FloatArray,
    right: FloatArray,
    feed: FloatArray | None = None,
) -> StateSpace:
    """Return a system with channels `name:w` and `name:z` after its first inputs and outputs.

    left (n + p, k): what w adds to states and later outputs; right (k, n + m): what z reads of
    states and all inputs; feed (k, k): from w to z, zero when not given.
    """
    n, k = g.n_states, len(names)
    feed = np.zeros((k, k)) if feed is None else feed
    D = np.block([
        [g.D[:before, :before], np.zeros((before, k)), g.D[:before, before:]],
        [right[:, n : n + before], feed, right[:, n + before :]],
        [g.D[before:, :before], left[n:], g.D[before:, before:]],
    ])  # fmt: skip
    return StateSpace(
        g.A,
        np.hstack([g.B[:, :before], left[:n], g.B[:, before:]]),
        np.vstack([g.C[:before], right[:, :n], g.C[before:]]),
        D,
        g.dt,
        inputs=[*g.inputs[:before], *(f"{name}:w" for name in names), *g.inputs[before:]],
        outputs=[*g.outputs[:before], *(f"{name}:z" for name in names), *g.outputs[before:]],
        states=g.states,
        name=g.name,
        blocks=g.blocks,
    )


def require_exact(
    plant: Partition, system: StateSpace, deltas: Sequence[Delta], what: str, do: str
) -> None:
    """Raise ModelError unless the channels give the plant with all modes changed at once."""
    values = {d.name: _PROBE * (1.0 if j % 2 else -0.5) for j, d in enumerate(deltas)}
    changes = [(delta, values[delta.name] * delta.scale) for delta in deltas]
    wanted = system_matrix(with_changes(plant, changes).system)
    base, whole = system_matrix(plant.system), system_matrix(system)
    n, count = system.n_states, len(system.inputs) - len(plant.system.inputs)
    owner = [name.removesuffix(":w") for name in system.inputs[:count]]
    amounts = np.diag([
        next(v for name, v in values.items() if f"{one}:".startswith(f"{name}:")) for one in owner
    ])  # fmt: skip
    inner = np.arange(n, n + count)
    outer, columns = (np.delete(np.arange(size), inner) for size in whole.shape)
    closed = np.linalg.solve(
        np.eye(count) - whole[np.ix_(inner, inner)] @ amounts, whole[np.ix_(inner, columns)]
    )
    made = whole[np.ix_(outer, columns)] + whole[np.ix_(outer, inner)] @ amounts @ closed
    allowed = 1e-6 * np.abs(wanted - base).max(axis=1) + 1e-12 * np.abs(wanted).max(axis=1)
    bad = np.flatnonzero(np.abs(made - wanted).max(axis=1) > allowed)
    if bad.size:
        name = (*plant.system.states, *plant.system.outputs)[int(bad[0])]
        raise ModelError(
            f"{name!r} does not depend on {what} as displacements, velocities and accelerations "
            f"do, so that no Deltas express it. {do}"
        )
