"""Weights absorbed into a plant: W_z P W_w, names kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..checks import instance
from ..errors import ModelError, require_known
from ..lti.discretisation import tustin
from ..lti.interconnection import append, series
from ..lti.statespace import StateSpace, System, as_statespace
from ..tolerances import SAME
from .building import P
from .origin import Weighted
from .partition import Partition


def weighted(plant: P, z: Any, w: Any) -> P:
    """Return ``W_z P W_w``; a weight None drops its channel."""
    z, w = _mapping(z, "z"), _mapping(w, "w")
    for side, weights in (("z", z), ("w", w)):
        require_known(f"channel of {side}", weights, getattr(plant, side))
    keep_z = [name for name in plant.z if name not in z or z[name] is not None]
    keep_w = [name for name in plant.w if name not in w or w[name] is not None]
    if not keep_z or not keep_w:
        raise ModelError("all of z or w was left out: keep at least one channel of each.")
    inner = plant.system.select([*keep_z, *plant.y], [*keep_w, *plant.u])
    before = append(
        *(_weight(plant, w.get(name, 1.0), name) for name in keep_w), _identity(plant, plant.u)
    )
    after = append(
        *(_weight(plant, z.get(name, 1.0), name) for name in keep_z), _identity(plant, plant.y)
    )
    system = series(series(before, inner), after)
    step = tuple(z.items()), tuple(w.items())
    return plant.replace(
        system=system.replace(name=plant.system.name),
        w=tuple(keep_w),
        z=tuple(keep_z),
        asd={},
        origin=Weighted(plant.unweighted, plant.origin.reading, True, (*plant.origin.steps, step)),
    )


def _mapping(weights: Any, side: str) -> dict[str, Any]:
    if weights is None:
        return {}
    instance(
        weights, Mapping, f"weights of {side}", "{'die:error': lti.inverse_sensitivity(30.0)}, say."
    )
    return {
        name: None if weight is None else as_statespace(weight) for name, weight in weights.items()
    }


def measured_through(plant: P, block: System) -> P:
    """Return the plant with y read through a block."""
    g = as_statespace(block)
    inner = plant.system.select([*plant.z, *(plant.y[i] for i in _positions_of(plant, g))])
    block = g if g.n_states else g.replace(dt=plant.dt)
    after = append(_identity(plant, plant.z), block)
    if plant.origin.reading is not None:
        block = series(plant.origin.reading.select(outputs=block.inputs), block)
    return plant.replace(
        system=series(inner, after).replace(name=plant.system.name),
        y=tuple(g.outputs),
        origin=Weighted(plant.unweighted, block, plant.origin.scaled, (*plant.origin.steps, g)),
    )


def altered_like(plant: P, plain: P) -> P:
    """Return a plain plant with the weights and blocks of another one, in their order."""
    for step in plant.origin.steps:
        if isinstance(step, StateSpace):
            plain = measured_through(plain, step)
        else:
            plain = weighted(plain, *map(dict, step))
    return plain


def _positions_of(plant: Partition, g: StateSpace) -> list[int]:
    require_known("channel of y", g.inputs, plant.y)
    return [plant.y.index(name) for name in g.inputs]


def _weight(plant: Partition, weight: Any, name: str) -> StateSpace:
    sys = as_statespace(weight)
    if len(sys.inputs) != 1 or len(sys.outputs) != 1:
        raise ModelError(
            f"the weight of {name!r} must have one input and one output, got {sys!r}. "
            "Weight channels one by one."
        )
    sys = at_rate(sys, name, plant.dt)
    states = [f"{name}|{state}" for state in sys.states]
    return sys.replace(inputs=[name], outputs=[name], states=states)


def at_rate(weight: StateSpace, name: str, dt: float) -> StateSpace:
    """Return a weight of sampling time dt; a continuous one is sampled (Tustin)."""
    if not weight.n_states:
        return weight.replace(dt=dt)
    if dt and not weight.dt:
        return tustin(weight, 1.0 / dt)
    if not np.isclose(weight.dt, dt, rtol=SAME, atol=0.0):
        raise ModelError(
            f"the weight of {name!r} has dt {weight.dt:g} s, the plant {dt:g} s. Give it as a "
            "continuous system, which is sampled at the plant's rate."
        )
    return weight


def _identity(plant: Partition, names: tuple[str, ...]) -> StateSpace:
    gain = as_statespace(np.eye(len(names)))
    return gain.replace(dt=plant.dt, inputs=names, outputs=names)
