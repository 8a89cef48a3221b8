"""Kinds of uncertainty of a machine: the class from which all of them derive."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...arrays import FloatArray
from ...lti.statespace import StateSpace
from ...store import Value
from ...tolerances import DEVIATIONS
from ..partitioned import Partition
from .delta import Delta
from .delta_blocks import Block


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
