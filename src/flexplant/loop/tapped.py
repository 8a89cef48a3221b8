"""The plant as its closed loop is read: what is monitored passes through it to the outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import inner_names


def tapped(
    plant: StandardPlant, driven: Sequence[str], watched: Sequence[str], units: Mapping[str, str]
) -> StateSpace:
    """Return [w; driven; watched] -> [z; y; driven; watched; y of the loop], named `y1|loop`."""
    g = plant.system
    shown = [*plant.z, *plant.y, *driven, *watched]
    rows = g.output_index([*plant.z, *plant.y])
    taps = [*driven, *watched]  # inputs, and outputs unchanged
    columns = g.input_index([*plant.w, *driven])
    extra = np.zeros((g.n_states, len(watched)))
    fed = g.output_index(plant.y)
    D = np.zeros((len(shown) + fed.size, columns.size + len(watched)))
    D[: rows.size, : columns.size] = g.D[np.ix_(rows, columns)]
    D[rows.size : len(shown), len(plant.w) :] = np.eye(len(taps))
    D[len(shown) :, : columns.size] = g.D[np.ix_(fed, columns)]
    C = np.vstack([g.C[rows], np.zeros((len(taps), g.n_states)), g.C[fed]])
    return StateSpace(
        g.A,
        np.hstack([g.B[:, columns], extra]),
        C,
        D,
        g.dt,
        inputs=[*plant.w, *taps],
        outputs=[*shown, *inner_names((f"{name}|loop" for name in plant.y), shown)],
        states=g.states,
        name=g.name,
        units=units,
    )
