"""One sample of the controller as one step: the plant's samples in it stacked (lifting)."""

from __future__ import annotations

import numpy as np

from ..loop import ClosedLoop
from ..lti.recursion import Recursion
from ..values import FloatArray, IntArray


def lifted(
    loop: ClosedLoop, factor: FloatArray, columns: IntArray, hold: int, states: bool
) -> Recursion:
    """Return a sampled loop whose controller acts in the first of every `hold` samples.

    Parameters
    ----------
    loop : ClosedLoop
        Its plant in the finer samples, without feedthrough from u to y.
    factor : (n, r) array
        How white samples enter the plant's states.
    columns : (k,) int array
        Of w that are inputs.
    hold : int
        Samples of the plant in one of the controller.
    states : bool
        Whether the plant's states are outputs too.

    Returns
    -------
    Recursion
        From `hold` stacked inputs [w[columns]; white] to as many outputs [z; y; driven; monitored;
        states]; states of the plant, then of the controller.
    """
    plant, law, g = loop.plant, loop.controller, loop.plant.system
    used = [plant.u.index(name) for name in loop.driven]
    enter = np.hstack([plant.B1[:, columns], factor])
    n, nc, m, k = g.n_states, law.n_states, enter.shape[1], columns.size
    both = n + nc
    # every signal as a matrix over [x; c; inputs of the first sample; of the second; ...]
    unit = np.eye(both + hold * m)
    x, c = unit[:n], unit[n:both]
    seen = []
    for j in range(hold):
        v = unit[both + j * m : both + (j + 1) * m]
        y = plant.C2 @ x + plant.D21[:, columns] @ v[:k]
        if not j:
            c, out = law.A @ c + law.B @ y, law.C @ c + law.D @ y
            u = out[: len(used)]
        z = plant.C1 @ x + plant.D12[:, used] @ u + plant.D11[:, columns] @ v[:k]
        seen += [z, y, out, *([x] if states else [])]
        x = g.A @ x + plant.B2[:, used] @ u + enter @ v
    step, shown = np.vstack([x, c]), np.vstack(seen)
    parts = (step[:, :both], step[:, both:], shown[:, :both], shown[:, both:])
    return Recursion(*map(np.ascontiguousarray, parts))
