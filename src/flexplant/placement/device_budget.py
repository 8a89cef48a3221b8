"""A budget for the devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..errors import ModelError
from ..values import positive, short
from .candidate_places import Places
from .constraint import Constraint
from .rows import LinearRows


@dataclass(frozen=True, eq=False)
class Budget(Constraint):
    """An upper limit on the total cost of the chosen candidates.

    Parameters
    ----------
    total : float
        What they may cost.
    costs : mapping {str: float}, optional
        Cost of candidates by name.
    default : float
        Cost of the others.

    Raises
    ------
    ModelError
        When a number is negative.
    LabelError
        When used, for an unknown name.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> cheap = fx.placement.Budget(2.0, {"s1": 5.0})  # s1 costs 5, the others 1
    >>> fx.place_sensors(plant, candidates, 1, constraints=[cheap]).chosen
    ('s3',)
    """

    total: float
    costs: Mapping[str, float] = field(default_factory=dict)
    default: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.costs, Mapping):
            raise ModelError(f"costs are a mapping from name to cost, got {short(self.costs)}.")
        self._set(
            total=positive(self.total, "total", zero=True),
            costs={
                str(name): positive(cost, f"cost of {name!r}", zero=True)
                for name, cost in self.costs.items()
            },
            default=positive(self.default, "default", zero=True),
        )

    def rows(self, places: Places) -> LinearRows:
        """Return the sum of costs, at most the total."""
        places.index(list(self.costs), "candidate with a cost")
        costs = np.array([self.costs.get(name, self.default) for name in places.names])
        return LinearRows(costs[None], np.array([0.0]), np.array([self.total]))
