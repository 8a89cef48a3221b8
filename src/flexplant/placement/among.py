"""So many of some named candidates: device types, alternatives at one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import unknown_label
from ..values import name_list
from .constraints import Constraint, limits
from .places import Places
from .rows import LinearRows


@dataclass(frozen=True, eq=False)
class Among(Constraint):
    """So many of the chosen among these names: at most two accelerometers, one kind at a place.

    Parameters
    ----------
    names : sequence of str
        Candidates.
    at_least, at_most : int, optional
        How many of them.

    Raises
    ------
    ModelError
        When a count is no whole number, or at_least is above at_most.
    LabelError
        When these are no names; when used, for an unknown name.
    """

    names: Sequence[str]
    at_least: int | None = field(default=None, kw_only=True)
    at_most: int | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        low, high = limits(self.at_least, self.at_most)
        self._set(names=name_list(self.names, "names"), at_least=low, at_most=high)

    def rows(self, places: Places) -> LinearRows:
        """Return the count of them between its limits."""
        for name in self.names:
            if name not in places.names:
                raise unknown_label("candidate among others", name, places.names)
        row = np.array([[name in self.names for name in places.names]], dtype=np.float64)
        high = np.inf if self.at_most is None else float(self.at_most)
        return LinearRows(row, np.array([float(self.at_least or 0)]), np.array([high]))
