"""All constraints of a choice together: those given, and no sensor on a POI."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import ModelError
from ..values import short
from .candidate_places import Places
from .constraint import Constraint
from .rows import LinearRows
from .zones import OffPoi


def rows_of(constraints: Any, places: Places, side: str) -> LinearRows:
    """Return the rows of all constraints, OffPoi() among them for sensors unless one is given.

    Raises
    ------
    ModelError
        When something is no constraint.
    """
    return LinearRows.stacked([c.rows(places) for c in all_of(constraints, side)], places.total)


def all_of(constraints: Any, side: str) -> tuple[Constraint, ...]:
    """Return constraints as a tuple, OffPoi() among them for sensors unless one is given."""
    given = (constraints,) if isinstance(constraints, Constraint) else constraints
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise ModelError(
            f"constraints are a list of Excluded(...), MinimumDistance(...) and others, got "
            f"{short(given)}. Put them in a list."
        )
    for item in given:
        if not isinstance(item, Constraint):
            raise ModelError(
                f"a constraint is Excluded(...), MinimumDistance(...) or another such value, got "
                f"{short(item)}. Write Excluded(Disc((0.3, 0.3), radius=0.05)), say."
            )
    usual = "y" in side and not any(isinstance(item, OffPoi) for item in given)
    return (*given, OffPoi()) if usual else tuple(given)
