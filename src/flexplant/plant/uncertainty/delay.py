"""The delay of a sampled plant, known within some samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from ...arrays import positive
from ...errors import ModelError
from ..machine_plants import MachineParts
from ..partitioned import Partition
from .channels import Opened
from .delta import Delta
from .kind import Uncertainty


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
