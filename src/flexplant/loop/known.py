"""Signals that are known in advance: derivatives of references, and forces of a feedforward."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..lti.statespace import StateSpace
from ..plant import StandardPlant

#: what a block may read of a set-point beside its position, by the order of the derivative
DERIVATIVES = ("velocity", "acceleration", "jerk", "snap")
_FORCE = "feedforward"


def force_name(actuator: str) -> str:
    """Return the channel of a force known in advance: `u1:feedforward`."""
    return f"{actuator}:{_FORCE}"


def references(plant: StandardPlant) -> list[str]:
    """Return the channels that are both in w and in y, what is derived from them left out."""
    both = [name for name in plant.w if name in plant.y]
    return [name for name in both if not is_known(name, both, plant.u)]


def is_known(name: str, refs: Sequence[str], actuators: Sequence[str]) -> bool:
    """Return whether a name is a derivative of a reference, or a force on an actuator."""
    owner, _, kind = name.rpartition(":")
    return (kind in DERIVATIVES and owner in refs) or (kind == _FORCE and owner in actuators)


def with_known(plant: StandardPlant, systems: Sequence[StateSpace]) -> StandardPlant:
    """Return the plant with the known signals that blocks read as references, in w and y."""
    read = [name for sys in systems for name in sys.inputs]
    refs = references(plant)
    fresh = [n for n in dict.fromkeys(read) if n not in plant.y and is_known(n, refs, plant.u)]
    if not fresh:
        return plant
    g, nw, nf = plant.system, len(plant.w), len(fresh)
    B = np.hstack([g.B[:, :nw], np.zeros((g.n_states, nf)), g.B[:, nw:]])
    C = np.vstack([g.C, np.zeros((nf, g.n_states))])
    D = np.zeros((C.shape[0], B.shape[1]))
    old = [*range(nw), *range(nw + nf, B.shape[1])]
    D[np.ix_(np.arange(g.C.shape[0]), old)] = g.D
    D[g.C.shape[0] :, nw : nw + nf] = np.eye(nf)
    w, y = (*plant.w, *fresh), (*plant.y, *fresh)
    system = g.replace(B=B, C=C, D=D, inputs=[*w, *plant.u], outputs=[*plant.z, *y])
    return plant.replace(system=system, w=w, y=y)
