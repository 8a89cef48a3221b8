"""Every subset is scored: the optimum, proven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import ModelError, counted
from ..values import whole
from ..work import Work
from .problem import Found, Problem, Search


@dataclass(frozen=True, eq=False)
class Exhaustive(Search):
    """Every subset: the optimum, proven.

    Parameters
    ----------
    limit : int
        More subsets than this are refused.

    Raises
    ------
    ModelError
        When limit is no whole number of at least 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 1, method=fx.placement.Exhaustive()).proven
    True
    """

    limit: int = 200_000

    def __post_init__(self) -> None:
        self._set(limit=whole(self.limit, "limit"))

    def search(self, problem: Problem, work: Work) -> Found:
        """Return the best of all subsets; see `Search.search`. Nothing is random.

        Raises
        ------
        ModelError
            When there are more subsets than `limit`.
        """
        if problem.subsets > self.limit:
            raise ModelError(
                f"there are {counted(problem.subsets, 'subset')}, more than "
                f"Exhaustive(limit={self.limit}) allows. Use Exchange(), whose bound shows how far "
                "from the optimum it can be, or a higher limit."
            )
        sets = list(problem.choices())
        values = problem.layouts.scores(sets, work, "every subset")
        best = int(np.argmin(values))
        value = float(values[best])
        return Found(sets[best], value, value, len(sets), ((value,),))
