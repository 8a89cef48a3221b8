"""A loop on machines drawn from an uncertain plant: how many are stable and keep a margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import FloatArray, Value


@dataclass(frozen=True, eq=False, repr=False)
class MachineDraws(Value):
    """The modulus margins of one controller on machines drawn from an uncertainty.

    Everything that is uncertain is off at once: at delta = 1 two standard deviations unless the
    uncertain plant says otherwise.

    Parameters
    ----------
    margins : (n,) array
        Modulus margin at u on each machine, 0 where the loop is unstable there.
    margin : float
        The one that shall be kept.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.loop.MachineDraws([0.5, 0.4, 0.3, 0.0], margin=0.35)
    <MachineDraws: 3 of 4 stable, 2 keep a modulus margin of 0.35, the least is 0>
    """

    margins: FloatArray
    margin: float

    def __post_init__(self) -> None:
        self._set(margins=np.asarray(self.margins, dtype=np.float64))

    @property
    def stable(self) -> float:
        """The share of machines on which the loop is stable."""
        return float(np.mean(self.margins > 0))

    @property
    def kept(self) -> float:
        """The share of machines on which it keeps the margin."""
        return float(np.mean(self.margins >= self.margin))

    @property
    def summary(self) -> str:
        """The counts in words."""
        n = self.margins.size
        stable, kept = (np.count_nonzero(self.margins > 0), round(n * self.kept))
        return (
            f"{stable} of {n} stable, {kept} keep a modulus margin of {self.margin:.3g}, the least "
            f"is {self.margins.min():.3g}"
        )

    def __repr__(self) -> str:
        return f"<MachineDraws: {self.summary}>"
