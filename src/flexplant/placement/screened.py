"""Many choices by a fast criterion, the best of them by the one that counts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..arguments import function
from ..values import whole
from ..work import Work
from .exchange import Exchange
from .layouts import layouts_of
from .problem import Found, Problem, Search

#: up to so many choices are all scored by the fast criterion
_ALL = 20_000


@dataclass(frozen=True, eq=False, repr=False)
class Screened(Search):
    """Choices ranked by a fast criterion, the first few scored by the one that counts.

    All choices are ranked where there are at most 20 000; else that on which exchanges by the fast
    criterion end, and all that differ from it by one candidate. For a plant with many modes:
    ``Screened(OverMachines(PoiVariance(), [plant_with_few_modes]))``, confirmed by
    ``PoiVariance(larger=all_modes)``, where modes left out are noise.

    Parameters
    ----------
    by : Criterion or callable
        The fast criterion.
    keep : int
        How many choices are scored by the criterion that counts.
    starts : int
        Of the exchanges.

    Raises
    ------
    ModelError
        When `by` is not callable, or a number is not at least 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> method = fx.placement.Screened(fx.PoiVariance("die"), starts=1)
    >>> fx.place_sensors(plant, candidates, 1, fx.PoiVariance("die"), method=method, rng=0).chosen
    ('s1',)
    """

    by: Any
    keep: int = field(default=40, kw_only=True)
    starts: int = field(default=6, kw_only=True)

    def __post_init__(self) -> None:
        function(self.by, "by, a criterion,", "Pass PoiVariance(), say.")
        self._set(keep=whole(self.keep, "keep"), starts=whole(self.starts, "starts"))

    def __repr__(self) -> str:
        return f"Screened({self.by!r}, keep={self.keep})"

    def search(self, problem: Problem, work: Work) -> Found:
        """Return the best of the first few, bounded by relaxation; see `Search.search`."""
        own = problem.layouts
        fast = layouts_of(own.plant, own.side, own.candidates, self.by)
        ranked = self._ranked(replace(problem, layouts=fast), work)
        values = own.scores(ranked, work, "the best few")
        best = int(np.argmin(values))
        value = float(values[best])
        bound = min(problem.bound(), value) if np.isfinite(value) else -np.inf
        return Found(ranked[best], value, bound, len(ranked), ((value,),))

    def _ranked(self, problem: Problem, work: Work) -> list[tuple[int, ...]]:
        """Return the first few choices by the fast criterion."""
        if problem.subsets <= _ALL:
            sets = list(problem.choices())
        else:
            chosen = Exchange(self.starts).search(problem, work).chosen
            movable = [u for u in problem.units if set(u) <= set(chosen)]
            near = {chosen}
            for out in movable:
                kept = set(chosen) - set(out)
                others = [u for u in problem.units if len(u) == len(out) and not set(u) & kept]
                near |= {tuple(sorted({*kept, *unit})) for unit in others}
            sets = sorted(near)
            sets = [s for s, holds in zip(sets, problem.rows.hold(sets), strict=True) if holds]
        values = problem.layouts.scores(sets, work, "screened")
        return [sets[i] for i in np.argsort(values, kind="stable")[: self.keep].tolist()]
