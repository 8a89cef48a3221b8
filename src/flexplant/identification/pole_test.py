"""Which poles the data support: poles that noise explains are left out (one in 1000 stays)."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..values import ComplexArray
from .refine import Lines, projected_model, projected_normal

#: probability that noise anywhere in the band passes for a pole
CHANCE = 1e-3


def supported(
    lines: Lines, poles: ComplexArray, part: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Leave out, one by one, poles that noise alone may explain."""
    least = price(lines)
    costs = _Costs(lines, poles, part)
    kept = list(range(poles.size))
    while len(kept) > 1:
        unit = max(1.0, costs.of(kept) / freedom(lines, len(kept)))
        losses = [costs.of([k for k in kept if k != out]) - costs.of(kept) for out in kept]
        if min(losses) > least * unit:
            break
        kept.pop(int(np.argmin(losses)))
    kept = [k for k in kept if len(kept) == 1 or _seen(lines, poles, part, kept, k)]
    return poles[kept], part[:, kept]


def _seen(lines: Lines, poles: ComplexArray, part: ComplexArray, kept: list[int], k: int) -> bool:
    """Return whether a pole narrower than the lines are apart is seen at more than two of them."""
    spacing = 2 * np.pi * float(np.median(np.diff(lines.freq)))
    if -poles[k].real > spacing:
        return True
    rest = [other for other in kept if other != k]
    less, more = (projected_model(lines, poles[some], part[:, some]) for some in (rest, kept))
    return corroborated(lines, less, more)


def corroborated(lines: Lines, less: ComplexArray, more: ComplexArray) -> bool:
    """Return whether other lines than the two that gain most bear a pole out.

    A disturbance of one frequency, or a variance that came out too small at one line, makes an
    outlier. A pole of next to no damping, there or between two lines, explains it and changes
    other lines by chance only: those lower the cost by a chi-square of four degrees, of the pole
    and its size.
    """
    from scipy.special import chdtri

    before, after = (
        np.sum(np.abs((lines.data - model) * lines.weight) ** 2, axis=(0, 1))
        for model in (less, more)
    )
    gain = before - after
    unit = max(1.0, float(np.sum(after)) / (2 * lines.data.size))
    return float(np.sum(np.sort(gain)[:-2])) > unit * lines.inflation * float(chdtri(4, CHANCE))


def price(lines: Lines) -> float:
    """Return by how much a pole must lower the cost.

    Its pole, shape and participation are 2 (n_out + n_in) numbers, so noise lowers the cost by a
    chi-square of that many degrees; it has as many places to do so as there are lines. Where
    errors of neighbouring lines are correlated, noise that changes little over a few lines has
    `inflation` times the power of independent errors. A pole kept in vain costs little; one left
    out biases its neighbours by up to the root of this amount.
    """
    from scipy.special import chdtri

    n_out, n_in, n_freq = lines.data.shape
    return lines.inflation * float(chdtri(2 * (n_out + n_in), CHANCE / n_freq))


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
    """Return the expected cost of a fit with m poles: real data less real parameters.

    Where errors of lines are correlated each parameter fits `inflation` times as much of them.
    """
    n_out, n_in, _ = lines.data.shape
    used = n_out * n_in * (lines.lower + lines.upper) + 2 * m * (n_out + n_in)
    return float(max(1.0, 2 * lines.data.size - lines.inflation * used))
