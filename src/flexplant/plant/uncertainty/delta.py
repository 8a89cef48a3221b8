"""Kinds of uncertainty and their Deltas: how these change a machine, and what opens them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...arrays import FloatArray
from ...lti.statespace import StateSpace
from ...store import Value
from ...tolerances import DEVIATIONS
from ..building import P
from ..machine_plants import MachineParts
from ..partitioned import Partition
from .channels import EvenUnits, Opened, with_parts
from .delta_blocks import Block


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


class Known(NamedTuple):
    """Deltas of one kind of uncertainty for a plant, and their distribution in random draws.

    Parameters
    ----------
    deltas : sequence of Delta
        Deltas of this kind, m in number.
    covariance : (m, m) array
        Covariance matrix of the deltas, which are random numbers when machines are drawn.
    drawn : sequence of Delta, optional
        Deltas that are drawn in place of `deltas` when a machine is drawn. They are the parameters
        of a fit, which change all modes and mode shapes.
    drawn_covariance : (q, q) array, optional
        Covariance of the Deltas in `drawn`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.Known.independent([fx.plant.Delta("off", 0.1)]).covariance
    array([[0.25]])
    """

    deltas: tuple[Delta, ...]
    covariance: FloatArray
    drawn: tuple[Delta, ...] | None = None
    drawn_covariance: FloatArray | None = None

    @classmethod
    def independent(cls, deltas: Sequence[Delta], *, deviations: float = DEVIATIONS) -> Known:
        """Return independent Deltas; each is 1 at the given number of standard deviations."""
        return cls(tuple(deltas), np.eye(len(deltas)) / deviations**2)


class Uncertainty(Value):
    """A kind of uncertainty of a machine, for ``plant.uncertain(...)``.

    To add a new kind, derive a class and define its method `deltas`, which returns the Deltas of a
    plant. Define `known` instead if the Deltas are correlated, or if the machines
    ``plant.machines`` are drawn by means of other random numbers than the Deltas. For uncertain
    dynamics define `delta_blocks` and `with_blocks`.

    Examples
    --------
    >>> import flexplant as fx
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, eq=False)
    ... class Warmth(fx.plant.Delta):
    ...     def changed(self, machine, amount):
    ...         return machine.with_gain("u1", 1.0 + amount).with_gain("y1", 1.0 + amount)
    >>> @dataclass(frozen=True, eq=False)
    ... class Warm(fx.plant.Uncertainty):
    ...     def deltas(self, plant):
    ...         return [Warmth("warmth", 0.02)]
    >>> fx.testbeds.three_masses().uncertain(Warm())
    <UncertainPlant: 1 real Delta at 2 std
      warmth +- 2 %>
    """

    def deltas(self, plant: Partition) -> Sequence[Delta]:
        """Return the Deltas of this kind of uncertainty for a plant."""
        return ()

    def known(self, plant: Partition) -> Known:
        """Return the Deltas of this kind for a plant, and their distribution in random draws."""
        return Known.independent(self.deltas(plant))

    def bound(self, plant: Partition) -> Any:
        """Return the bound on modes that a plant neglects; None except for the kind `Neglected`."""
        return None

    def delta_blocks(self, plant: Partition) -> Sequence[Block]:
        """Return the Deltas that are systems or matrices; empty if all Deltas are real numbers.

        An example is the Delta of `UnmodelledDynamics`.
        """
        return ()

    def with_blocks(self, plant: Partition, system: StateSpace) -> StateSpace:
        """Return a system whose first channels are those of `delta_blocks`.

        A kind without such blocks returns the system unchanged. `system` is the system of the
        plant, or one made from it, for example a continuous system that the bilinear map gives for
        a sampled plant.
        """
        return system

    def larger(self, plant: Partition) -> Any:
        """Return the plant with its neglected modes; None except for the kind `Neglected`.

        The machines ``plant.machines``, which are drawn at random, are made from this plant.
        """
        return None
