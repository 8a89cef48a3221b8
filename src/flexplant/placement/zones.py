"""Zones of a plate in which places are excluded or counted: rectangles and discs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..arrays import FloatArray, floats_of, positive
from ..errors import ModelError
from ..store import Value, checked

_PLACE = checked(floats_of, count=2, unit="m")


@dataclass(frozen=True, eq=False, repr=False)
class Rectangle(Value):
    """A rectangular zone of places on a plate.

    Parameters
    ----------
    lower, upper : (2,) array [m]
        Corner with the smallest x and y, and corner with the largest x and y.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> fx.placement.Rectangle((0.1, 0.1), (0.2, 0.3)).holds(np.array([[0.15, 0.2], [0.5, 0.5]]))
    array([ True, False])
    """

    lower: Sequence[float] = field(metadata=_PLACE)
    upper: Sequence[float] = field(metadata=_PLACE)

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.array(self.upper) <= self.lower):
            raise ModelError(
                f"a rectangle's upper corner must be above its lower one in x and y, got "
                f"{self.lower} and {self.upper}. Swap them, or give it a width."
            )

    def holds(self, points: FloatArray) -> Any:
        """Return which of the points (p, 2) are inside."""
        return np.all((points > self.lower) & (points < self.upper), axis=1)


@dataclass(frozen=True, eq=False, repr=False)
class Disc(Value):
    """A round zone of places on a plate.

    Parameters
    ----------
    centre : (2,) array [m]
        Centre of the disc.
    radius : float [m]
        Radius, above 0.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> fx.placement.Disc((0.3, 0.3), radius=0.1).holds(np.array([[0.3, 0.35], [0.5, 0.5]]))
    array([ True, False])
    """

    centre: Sequence[float] = field(metadata=_PLACE)
    radius: float = field(metadata=checked(positive, unit="m"))

    def holds(self, points: FloatArray) -> Any:
        """Return which of the points (p, 2) are inside."""
        return np.linalg.norm(points - np.array(self.centre), axis=1) < self.radius


Zone = Rectangle | Disc
