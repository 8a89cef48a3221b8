"""The largest value of a concave function of weights over a branch, with a bound from above."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..values import FloatArray
from .branch import Branch


def ascended(
    function: Callable[[FloatArray], tuple[float, FloatArray] | None],
    branch: Branch,
    start: FloatArray,
    *,
    steps: int,
    close: Callable[[float, float], bool],
) -> tuple[float, FloatArray]:
    """Return a number above the function at every choice of a branch, and weights near the largest.

    Projected gradient steps of Barzilai and Borwein [BarzilaiBorwein1988]_. Whatever w is,
    ``h(w) + h'(w) (x - w)`` is above h at every choice x: that is the bound.

    Parameters
    ----------
    function : callable
        Returns h and its gradient (N,) at weights (N,); None where it has no value.
    branch : Branch
        The choices.
    start : (N,) array
        First weights.
    steps : int
        At most so many.
    close : callable
        Of the value and the bound: whether they are close enough.
    """
    weights, step = branch.nearest(start), 0.0
    most, kept, highest = np.inf, weights, -np.inf
    before: tuple[FloatArray, FloatArray] | None = None
    for _ in range(steps):
        found = function(weights)
        if found is None:
            break
        value, rise = found
        most = min(most, value - branch.least(-rise) - float(rise @ weights))
        if value > highest:
            kept, highest = weights, value
        if close(value, most):
            break
        if before is None:
            step = 0.3 / max(float(np.max(np.abs(rise))), 1e-300)
        else:
            moved, turned = weights - before[0], before[1] - rise
            bend = float(moved @ turned)
            step = float(moved @ moved) / bend if bend > 0 else 2.0 * step
        before = weights, rise
        weights = branch.nearest(weights + step * rise)
        if np.max(np.abs(weights - before[0])) < 1e-9:
            break
    return most, kept
