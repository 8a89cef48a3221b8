"""What a choice of places must satisfy: the base of constraints, and limits of counts."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from ..errors import ModelError
from ..values import Value, whole
from .candidate_places import Places, Zone
from .rows import LinearRows


class Constraint(Value):
    """The base of all constraints: a new one defines `rows`.

    Examples
    --------
    >>> import flexplant as fx
    >>> isinstance(fx.placement.MinimumDistance(0.1), fx.placement.Constraint)
    True
    """

    @abstractmethod
    def rows(self, places: Places) -> LinearRows:
        """Return linear rows in x, which is 1 for chosen candidates and 0 for others."""

    def drawn(self, places: Places) -> tuple[Zone, ...]:
        """Return zones without candidates, seen from above, for pictures."""
        return ()


def limits(at_least: Any, at_most: Any) -> tuple[int | None, int | None]:
    """Return two counts, checked; None where there is no limit."""
    low, high = (
        None if n is None else whole(n, name, minimum=0)
        for n, name in ((at_least, "at_least"), (at_most, "at_most"))
    )
    if low is not None and high is not None and low > high:
        raise ModelError(
            f"at_least {low} is above at_most {high}: no choice is both. Exchange them."
        )
    return low, high
