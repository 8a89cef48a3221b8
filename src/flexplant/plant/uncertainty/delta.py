"""One real uncertainty of a plant: how it changes the machine, and the channels that open it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from ...store import Value
from ..building import P
from ..machine_plants import MachineParts
from ..partitioned import Partition
from .channels import EvenUnits, Opened, with_parts


@dataclass(frozen=True, eq=False)
class Delta(Value):
    """One real uncertainty, ``w = delta z`` with ``|delta| <= 1``.

    The number delta says how far the machine differs from the nominal one. To add a new kind of
    Delta, derive a class and define its method `changed`. This method returns the machine that
    differs by a given amount, for example by means of `MachineParts.with_port`. The channels w and
    z of the Delta are computed from the plants at both ends of its range. Therefore the matrix [A
    B; C D] of the plant must be an affine or a linear fractional function of the amount. For a
    sensor that moves from the point p, write its place as a sum that is linear in the amount a:
    ``at={p: 1.0, p + h: a / 2, p - h: -a / 2}``. If the channels of your kind are found in another
    way, override `opened`. A change of M, D or K changes the modes, and the plant is not an affine
    function of it. State such a change by `Parameters`.

    Parameters
    ----------
    name : str
        Prefix of the channel names: `mode6:freq` has the input `mode6:freq:w` and the output
        `mode6:freq:z`.
    scale : float
        Change at delta = 1. It is a relative change, except for a parameter (in the unit of the
        parameter) and for the delay (in samples).
    mode : int
        Number of the mode, from 1, rigid-body modes included; 0 for a Delta that belongs to no
        mode.

    Examples
    --------
    >>> import flexplant as fx
    >>> one = fx.testbeds.three_masses().uncertain(frequency=0.01).deltas[0]
    >>> one.name, one.scale  # of the stiffness
    ('mode2:freq', 0.02)
    """

    name: str
    scale: float
    mode: int = 0

    #: the kind of quantity that changes, for tables
    kind: ClassVar[str] = ""
    #: Deltas of a lower stage are applied first: 0 matrices, 1 poles, 2 shapes and places, 3 gains,
    #: 4 the delay
    stage: ClassVar[int] = 1
    #: whether it changes the matrices or shapes of the plant's own model, not of a larger one
    of_own_model: ClassVar[bool] = False
    #: whether it is of a mode's frequency or damping: these are drawn together
    of_modes: ClassVar[bool] = False
    #: whether its channels act on what those of all others do, exactly: of a sampled plant too
    outermost: ClassVar[bool] = False

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return the machine with a change by `amount`, which has the unit of `scale`."""
        raise NotImplementedError(f"{type(self).__name__} must say by `changed` what it changes.")

    def amount(self, drawn: float) -> float:
        """Return the change that belongs to a value of delta; delta = 1 gives `scale`."""
        return self.scale * drawn

    def of_matrices(self, plant: Partition) -> Delta:
        """Return a Delta that can be combined with `Parameters`; most kinds return it unchanged.

        A Delta of a modal frequency or damping becomes a change of K or D of the plant's model.
        """
        return self

    def require_in_range(self, deviations: float) -> None:
        """Raise ModelError when the range of the Delta contains machines that cannot exist."""

    @property
    def text(self) -> str:
        """Name and amount at delta = 1 in words."""
        return f"{self.name} +- {100 * self.scale:.3g} %"

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Delta]) -> Opened:
        """Return the system of a continuous plant with added channels for Deltas of this kind."""
        base = plant.system
        units = EvenUnits.of(base)
        parts = []
        for delta in deltas:
            ends = [with_changes(plant, [(delta, end * delta.scale)]).system for end in (1, -1)]
            parts.append(units.part(delta.name, units.change(base, *ends)))
        return with_parts(opened, parts)


def with_changes(plant: P, changes: Sequence[tuple[Delta, float]]) -> P:
    """Return the machine that is off by some amounts, sampled like the nominal plant."""
    found: P = MachineParts.of(plant).changed(changes).assembled()
    return found
