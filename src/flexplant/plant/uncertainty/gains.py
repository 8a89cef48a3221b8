"""Gains of actuators and sensors, and the delay, that are known within stated amounts."""

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
from .delta import Delta, Uncertainty


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


@dataclass(frozen=True, eq=False)
class DelayDelta(Delta):
    """The delay of all actuators, plus ``scale delta`` samples."""

    kind: ClassVar[str] = "delay"
    stage: ClassVar[int] = 4

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine with another delay."""
        return machine.replace(late=machine.late + amount)

    @property
    def text(self) -> str:
        """Name and amount at delta = 1."""
        return f"{self.name} +- {self.scale:.3g} samples"

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Delta]) -> Opened:
        """Return the system as it is: a continuous plant has no delay, a sampled one opens it."""
        return opened


@dataclass(frozen=True, eq=False)
class Delay(Uncertainty):
    """Uncertain delay of a sampled plant: longer or shorter by up to a number of samples.

    Parameters
    ----------
    samples : float
        Largest change of the delay, in samples; it is reached at delta = 1 or -1.

    Raises
    ------
    ModelError
        When `samples` is not positive, or a plant is continuous or has a smaller delay than
        `samples`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Delay(0.2))
    <UncertainPlant: 1 real Delta at 2 std
      delay +- 0.2 samples>
    """

    samples: float

    def __post_init__(self) -> None:
        self._set(samples=positive(self.samples, "delay"))

    def deltas(self, plant: Partition) -> list[Delta]:
        """Return the Delta of the delay."""
        if not plant.dt or self.samples > plant.delay:
            raise ModelError(
                f"the delay is uncertain by {self.samples:g} samples, and the plant has "
                f"{plant.delay:g}: it is that of a sampled plant, and cannot become negative. "
                "Pass plant.discretized(rate, delay=...) with the delay in the middle."
            )
        return [DelayDelta("delay", self.samples)]
