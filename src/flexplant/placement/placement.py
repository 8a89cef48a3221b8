"""The answer of a search: the choice, its value, and how good any choice could be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import Value
from ..errors import counted
from ..plant import StandardPlant
from ..tolerances import SETTLED
from .candidates import Port, Side, side_of, with_side
from .criterion import in_words


@dataclass(frozen=True, eq=False, repr=False)
class Placement(Value):
    """The best choice that was found, and how good any choice could be.

    Parameters
    ----------
    chosen : tuple of str
        Names, in the order of the candidates.
    value : float
        Of the criterion.
    bound : float
        No choice of as many candidates is better than this: the value itself when the optimum is
        proven (by every subset, or by branch and bound); else by convex relaxation, for mean
        squares (`PoiVariance` of the plant's own modes, `PoiLqr`, `ClosedLoopH2`, what wraps them)
        where no port has a filter or delay of its own, and for log det; what all candidates reach
        together for other sums; minus infinity for a callable.
    evaluations : int
        Choices that were scored.
    history : tuple of tuples of float
        The value after each improvement, for each start.
    criterion : str
        What was minimised.
    ports : tuple of Sensor or Actuator
        The chosen ones.
    side : {"y", "u", "yu"}
        Whether they are sensors, actuators, or both.
    stopped : str
        Why the search ended before it had proven what it should; empty when it did not.
    unit : str
        Of the square root of the value, where it is a mean square of a motion.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> best = fx.place_sensors(plant, candidates, 2)
    >>> best.on(plant).y
    ('s1', 's3', 'die:ref')
    """

    chosen: tuple[str, ...]
    value: float
    bound: float
    evaluations: int
    history: tuple[tuple[float, ...], ...]
    criterion: str
    ports: tuple[Port, ...]
    side: Side
    stopped: str = ""
    unit: str = ""

    def __repr__(self) -> str:
        ends = [steps[-1] for steps in self.history]
        agree = sum(end <= self.value + SETTLED * abs(self.value) for end in ends)
        if self.proven:
            proof = "the optimum, proven"
        elif not np.isfinite(self.bound) or (self.unit and self.bound <= 0.0):
            proof = "no bound"
        elif self.unit:
            proof = f"no choice below {in_words(self.bound, self.unit)}"
        else:
            proof = f"none is more than {100 * self.gap:.2g} % better"
        return (
            f"<Placement {' '.join(self.chosen):.120}: {in_words(self.value, self.unit)} by "
            f"{self.criterion}, {proof}; {agree} of {len(ends)} starts agree, "
            f"{counted(self.evaluations, 'evaluation')}"
            f"{', ' if self.stopped else ''}{self.stopped}>"
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the chosen sensors."""
        return tuple(port.name for port in self.ports if side_of(port) == "y")

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the chosen actuators."""
        return tuple(port.name for port in self.ports if side_of(port) == "u")

    @property
    def gap(self) -> float:
        """The part of the value by which any choice could be better; infinite without a bound.

        Of a mean square: an rms could be better by about half of it.
        """
        if not np.isfinite(self.bound):
            return np.inf
        return (self.value - self.bound) / abs(self.value) if self.value else 0.0

    @property
    def proven(self) -> bool:
        """Whether no choice is better, apart from rounding."""
        return self.gap <= 1e-8  # ten times what rounding adds to a bound

    def on(self, plant: StandardPlant) -> StandardPlant:
        """Return the plant with the chosen sensors (actuators, or both) instead of its own.

        Parameters
        ----------
        plant : StandardPlant
            Of the same machine; assembled from a structure.
        """
        return with_side(plant, self.side, self.ports)
