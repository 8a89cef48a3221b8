"""Frequencies of modes that are known within stated shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ..partitioned import Partition
from .delta import Delta
from .kind import Uncertainty
from .mode_delta import FrequencyDelta, stated_by_mode


@dataclass(frozen=True, eq=False, repr=False)
class Frequencies(Uncertainty):
    """Uncertain frequencies of modes: the relative error of each; its Delta changes omega^2.

    Parameters
    ----------
    share : float, (m,) array or {mode: float}
        Relative error of the frequencies at delta = 1: one number for all modes, one for each of
        `modes`, or a mapping by mode. For modes that were not measured, updated models seldom have
        errors below 0.005.
    modes : sequence of int, optional
        Numbers of the modes, counted from 1 with the rigid-body modes included. By default all
        elastic modes are uncertain.

    Raises
    ------
    LabelError, ModelError, ShapeError
        When a plant lacks a mode, its modes are coupled by damping, or a share is negative.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Frequencies({2: 0.005}))
    <UncertainPlant: 1 real Delta at 2 std
      mode2:freq +- 0.5 %>
    """

    share: Any
    modes: Sequence[int] | None = field(default=None, kw_only=True)

    def deltas(self, plant: Partition) -> Sequence[Delta]:
        """Return a Delta for the stiffness of each mode."""
        # stiffness is omega^2
        return stated_by_mode(FrequencyDelta, plant, self.share, self.modes, 2.0)
