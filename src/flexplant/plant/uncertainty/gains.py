"""Gains of actuators and sensors that are known within stated shares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ...arrays import positive
from ...errors import ModelError, require_known
from ...lti.statespace import StateSpace
from ..machine_plants import MachineParts
from ..partitioned import Partition
from .channels import Opened, with_channels
from .delta import Delta
from .kind import Uncertainty


@dataclass(frozen=True, eq=False)
class GainDelta(Delta):
    """The gain of an actuator or sensor, ``1 + scale delta``."""

    port: str = ""

    kind: ClassVar[str] = "gain"
    stage: ClassVar[int] = 3
    outermost: ClassVar[bool] = True

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine with another gain."""
        return machine.with_gain(self.port, 1.0 + amount)

    def require_in_range(self, deviations: float) -> None:
        """Refuse a gain of unknown sign."""
        if self.scale >= 1:
            raise ModelError(
                f"{self.name} is uncertain by {100 * self.scale:.3g} %: its sign is not known, "
                "and no controller is robust to that. Calibrate it."
            )

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Any]) -> Opened:
        """Return a system with a first channel for each gain: it scales what all others do."""
        for delta in sorted(deltas, key=lambda one: one.port in plant.y):
            system = _with_gain(plant, opened.system, delta)
            opened = Opened(system, ((delta.name, 1), *opened.sizes))
        return opened


def _with_gain(plant: Partition, system: StateSpace, delta: GainDelta) -> StateSpace:
    """Return a system with a first channel for a gain."""
    # `(1 + d) u` acts by d times the command's column more, all but its own effort, and so does
    # noise at the amplifier's input; `(1 + d) y` adds d times what the sensor shows of the motion,
    # with what the actuators' Deltas do
    name, n, (k, m) = delta.port, system.n_states, (len(system.outputs), len(system.inputs))
    left, right = np.zeros((n + k, 1)), np.zeros((1, n + m))
    if name in plant.u:
        column = system.inputs.index(name)
        left[:, 0] = np.concatenate([system.B[:, column], system.D[:, column]])
        left[n + system.outputs.index(f"{name}:effort")] = 0.0
        right[0, n + column] = delta.scale
        if f"{name}:disturbance" in system.inputs:  # at the amplifier's input: scaled as well
            noise = system.inputs.index(f"{name}:disturbance")
            its = np.concatenate([system.B[:, noise], system.D[:, noise]])
            share = float(left[:, 0] @ its) / float(left[:, 0] @ left[:, 0])
            right[0, n + noise] = delta.scale * share
    else:
        row = system.outputs.index(name)
        left[n + row] = 1.0
        right[0] = delta.scale * np.concatenate([system.C[row], system.D[row]])
        if f"{name}:noise" in system.inputs:
            right[0, n + system.inputs.index(f"{name}:noise")] = 0.0
    return with_channels(system, 0, [delta.name], left, right)


@dataclass(frozen=True, eq=False, repr=False)
class Gains(Uncertainty):
    """Uncertain gains of actuators and sensors: the relative error of each gain.

    Parameters
    ----------
    share : float or {name: float}
        Relative error of the gains at delta = 1: one number for all, or a mapping by name.

    Raises
    ------
    LabelError, ModelError
        When a plant lacks an actuator or sensor, or a share is not between 0 and 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Gains({"u1": 0.05}))
    <UncertainPlant: 1 real Delta at 2 std
      u1:gain +- 5 %>
    """

    share: float | Mapping[str, float]

    def deltas(self, plant: Partition) -> list[Delta]:
        """Return a Delta for each gain."""
        ports = plant.assembled.ports
        names = [*(port.name for port in ports.u), *(port.name for port in ports.y)]
        given: Any = self.share
        if isinstance(given, Mapping):
            require_known("actuator or sensor", list(given), names)
        else:
            given = dict.fromkeys(names, given)
        sizes = {name: positive(size, f"gain of {name!r}") for name, size in given.items()}
        return [GainDelta(f"{name}:gain", size, port=name) for name, size in sizes.items()]
