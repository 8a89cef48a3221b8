"""Which poles the data support: by the Bayesian information criterion."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..values import ComplexArray
from .refine import Lines, projected_normal


def supported(
    lines: Lines, poles: ComplexArray, part: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Leave out, one by one, poles without which the Bayesian information is higher."""
    n_out, n_in, n_freq = lines.data.shape
    price = 2 * (n_out + n_in) * np.log(2 * n_out * n_in * n_freq)
    costs = _Costs(lines, poles, part)
    kept = list(range(poles.size))
    while len(kept) > 1:
        unit = max(1.0, costs.of(kept) / freedom(lines, len(kept)))
        losses = [costs.of([k for k in kept if k != out]) - costs.of(kept) for out in kept]
        if min(losses) > price * unit:
            break
        kept.pop(int(np.argmin(losses)))
    return poles[kept], part[:, kept]


class _Costs:
    """Cost of the fit with some of the poles, from one set of normal equations per output."""

    def __init__(self, lines: Lines, poles: ComplexArray, part: ComplexArray) -> None:
        self.m = poles.size
        self.parts = projected_normal(lines, poles, part)
        self.known: dict[tuple[int, ...], float] = {}

    def of(self, kept: list[int]) -> float:
        """Return the cost with the poles at these places only."""
        key = tuple(kept)
        if key not in self.known:
            both = np.array([*kept, *(k + self.m for k in kept)])
            total = 0.0
            for N, g, square in self.parts:
                x = la.lstsq(N[np.ix_(both, both)], g[both], cond=1e-13)[0]
                total += square - float(g[both] @ x)
            self.known[key] = total
        return self.known[key]


def freedom(lines: Lines, m: int) -> float:
    """Return real data less real parameters of a fit with m poles."""
    n_out, n_in, _ = lines.data.shape
    used = n_out * n_in * (lines.lower + lines.upper) + 2 * m * (n_out + n_in)
    return float(max(1, 2 * lines.data.size - used))
