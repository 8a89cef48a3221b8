"""The H-infinity level of the best controller: for a short list of layouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import ModelError
from ..plant import StandardPlant
from ..synthesis import design_hinf
from ..values import positive, short
from .criterion import Criterion


@dataclass(frozen=True, eq=False, repr=False)
class HinfLevel(Criterion):
    """Least H-infinity norm of the weighted plant over all controllers, for sensors and actuators.

    A synthesis per layout, by bisection: seconds, not milliseconds. Score the best few by another
    criterion with `score_sensors(plant, layouts, HinfLevel(...))`.

    Parameters
    ----------
    z, w : mapping {channel: weight}
        Weights of motions and disturbances, numbers or systems, as for `plant.weighted`.
    effort : float
        Weight of the effort of each actuator, whichever is chosen.
    noise : float
        Weight of the noise of each sensor.

    Raises
    ------
    ModelError
        When weights are no mappings, effort or noise not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> level = fx.placement.HinfLevel(z={"die:x": 1e6}, w={"amp": 1.0}, effort=0.1, noise=1e-9)
    >>> level.effort, level.noise
    (0.1, 1e-09)
    """

    z: Mapping[str, Any] = field(default_factory=dict)
    w: Mapping[str, Any] = field(default_factory=dict)
    effort: float = field(default=1.0, kw_only=True)
    noise: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        for weights in (self.z, self.w):
            if not isinstance(weights, Mapping):
                raise ModelError(
                    f"weights are a mapping from channel to weight, got {short(weights)}. Type "
                    "HinfLevel(z={'die:z': 1e9}, w={'amp1': 1e-3})."
                )
        self._set(
            z=dict(self.z),
            w=dict(self.w),
            effort=positive(self.effort, "effort"),
            noise=positive(self.noise, "noise"),
        )

    def __repr__(self) -> str:
        channels = ", ".join([*self.z, *self.w])
        return f"HinfLevel({channels}, effort={self.effort:g}, noise={self.noise:g})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return the level that was reached and verified on a plant.

        Channels of w and z that are not weighted, nor noise or effort, do not count.
        """
        z = {name: self.z.get(name) for name in plant.z}
        w = {name: self.w.get(name) for name in plant.w}
        z |= {f"{name}:effort": self.effort for name in plant.u}
        w |= {f"{name}:noise": self.noise for name in plant.y}
        level = design_hinf(plant.weighted(z=z, w=w)).gamma
        return np.inf if level is None else level
