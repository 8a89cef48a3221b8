"""The largest of several quadratic costs that share one Riccati equation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..values import FloatArray
from .criterion import Scorer
from .quadratic import Quadratic


@dataclass(frozen=True, eq=False)
class WorstRow(Scorer):
    """``max_a (s_a X+ s_a' + constant_a)`` over the rows of a quadratic cost.

    Parameters
    ----------
    costs : Quadratic
        Its rows S are the terms.
    constants : (k,) array
        What no candidate can change of each.
    """

    costs: Quadratic
    constants: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return the largest term with some candidates."""
        return float(np.max(self.costs.terms(chosen) + self.constants))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the largest bound of any one term, or of their mean: the maximum is above both."""
        k = len(self.constants)
        parts = [
            self.costs.replace(S=self.costs.S[[i]], constant=float(self.constants[i]))
            for i in range(k)
        ]
        mean = float(np.mean(self.constants))
        parts.append(self.costs.replace(S=self.costs.S / np.sqrt(k), constant=mean))
        return max(part.bound(count, required) for part in parts)
