"""Damping of modes that is known within stated shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ..partitioned import Partition
from .delta import Delta
from .kind import Uncertainty
from .mode_delta import DampingDelta, stated_by_mode


@dataclass(frozen=True, eq=False)
class Dampings(Uncertainty):
    """Uncertain damping of modes: the relative error of 2 zeta omega of each mode.

    Parameters
    ----------
    share : float, (m,) array or {mode: float}
        Relative error of the damping at delta = 1: one number for all modes, one for each of
        `modes`, or a mapping by mode.
    modes : sequence of int, optional
        Numbers of the modes, counted from 1 with the rigid-body modes included. By default all
        elastic modes are uncertain.

    Raises
    ------
    LabelError, ModelError, ShapeError
        When a plant lacks a mode, its modes are coupled by damping, or a share is not between 0
        and 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Dampings({2: 0.3}))
    <UncertainPlant: 1 real Delta at 2 std
      mode2:damping +- 30 %>
    """

    share: Any
    modes: Sequence[int] | None = field(default=None, kw_only=True)

    def deltas(self, plant: Partition) -> Sequence[Delta]:
        """Return a Delta for the damping of each mode."""
        return stated_by_mode(DampingDelta, plant, self.share, self.modes)
