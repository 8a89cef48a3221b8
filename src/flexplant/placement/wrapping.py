"""Criteria made of another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..arguments import function
from ..plant import StandardPlant
from .candidates import sides_of
from .criterion import Criterion, as_criterion


@dataclass(frozen=True, eq=False)
class Wrapping(Criterion):
    """A criterion of the values of another one, or of a callable; the base of them.

    Parameters
    ----------
    criterion : Criterion or callable
        From plant to float.

    Raises
    ------
    ModelError
        When it is not callable.
    """

    criterion: Any

    def __post_init__(self) -> None:
        function(self.criterion, "a criterion", "Pass PoiVariance(), say.")

    @property
    def inner(self) -> Criterion:
        """The criterion that is wrapped."""
        return as_criterion(self.criterion)

    def unit(self, plant: StandardPlant) -> str:
        """Return the unit of the criterion that is wrapped."""
        return self.inner.unit(plant)

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Check the criterion that is wrapped."""
        as_criterion(self.criterion, sides_of(candidates)).check(plant, candidates)
