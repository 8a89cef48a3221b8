"""The mixed-sensitivity plant: weights on S, K S and T of a loop around any system."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import ModelError
from ..lti.interconnection import connect, side_by_side
from ..lti.statespace import StateSpace, System, as_statespace
from .standard import StandardPlant
from .weighting import at_rate


def mixed_sensitivity(
    system: System,
    *,
    S: System | float | None = None,
    KS: System | float | None = None,
    T: System | float | None = None,
) -> StandardPlant:
    """Return the plant whose H-infinity norm is that of ``[W_S S; W_KS K S; W_T T]``.

    ``e = r - G u, u = K e``: S = (I + G K)^-1 from r to e, T = G K S. What `augw` and `mixsyn` of
    other tools build; `design_hinf` of the result designs K. A rigid-body mode or integrator in
    G is an invariant zero on the limit of [G; weights] from r: add a disturbance at u instead, as
    `stage_weights` does.

    Parameters
    ----------
    system : StateSpace
        G, (p, m): from u to the measured outputs; continuous or sampled.
    S, T : float or StateSpace, optional
        Weights of every output: one by one for all alike, or (p, p).
    KS : float or StateSpace, optional
        Weight of every input: one by one for all alike, or (m, m). Continuous weights are sampled
        at the rate of a sampled system (Tustin).

    Returns
    -------
    StandardPlant
        w are the references `y:ref`, z the weighted signals `S:y`, `KS:u` and `T:y`, y the errors
        `y:error`, for each output y and input u of the system by name.

    Raises
    ------
    ModelError
        When there is no weight, or a weight fits neither one channel nor all.

    References
    ----------
    [Kwakernaak1993]_.

    Examples
    --------
    >>> from flexplant.lti import inverse_sensitivity, tf
    >>> P = mixed_sensitivity(tf([1.0], [1.0, 1.0]), S=inverse_sensitivity(1.0), KS=0.1)
    >>> P.z, P.y
    (('S:out', 'KS:in'), ('out:error',))
    """
    g = as_statespace(system)
    given = {"S": (S, g.outputs), "KS": (KS, g.inputs), "T": (T, g.outputs)}
    weights = {
        key: _weights(weight, key, names, g.dt)
        for key, (weight, names) in given.items()
        if weight is not None
    }
    if not weights:
        raise ModelError("there is no weight: give at least one of S=, KS= and T=.")
    # what each weight reads is an output of the loop of its own name
    p = len(g.outputs)
    refs, errors = ([f"{name}:{side}" for name in g.outputs] for side in ("ref", "error"))
    minus = StateSpace(
        [], [], [], np.hstack([np.eye(p), -np.eye(p)]), inputs=[*refs, *g.outputs], outputs=errors
    )
    reads = {"S": errors, "KS": list(g.inputs), "T": list(g.outputs)}
    named = [
        weight.replace(inputs=reads[key], outputs=[f"{key}:{name}" for name in given[key][1]])
        for key, weight in weights.items()
    ]
    z = [name for weight in named for name in weight.outputs]
    whole = connect([g, minus, *named], [*refs, *g.inputs], [*z, *errors])
    return StandardPlant.from_statespace(whole, u=list(g.inputs), y=errors)


def _weights(weight: System | float, key: str, names: Sequence[str], dt: float) -> StateSpace:
    """Return a weight of all channels."""
    system = as_statespace(weight)
    count = len(names)
    if (len(system.inputs), len(system.outputs)) == (1, 1):
        return side_by_side([at_rate(system, key, dt)] * count, names)
    if (len(system.inputs), len(system.outputs)) != (count, count):
        raise ModelError(
            f"the weight {key} must be one by one or {count} by {count} (channels "
            f"{', '.join(names)}), got {system!r}."
        )
    return at_rate(system, key, dt)
