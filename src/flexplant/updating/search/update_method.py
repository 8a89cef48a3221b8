"""What every search has in common: the interface of a method, the way it went and its end."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ...checks import FloatArray, Value, checked, positive
from ...parallel import tick
from ...tolerances import divisor
from .objective import Objective

#: what a bar calls the steps of all searches
ITERATIONS = "update, iterations"


@dataclass
class Trail:
    """The points a search has moved to."""

    p: list[FloatArray] = field(default_factory=list)
    poles: list[Any] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    fraction: list[float] = field(default_factory=list)

    def add(self, objective: Objective, p: FloatArray, fraction: float) -> None:
        """Add the point at `p`, where the objective is."""
        tick(ITERATIONS)
        point = objective.at(p)
        self.p.append(np.array(p))
        self.poles.append(objective.poles(point))
        self.error.append(float(np.sum(objective.values(point, prior=False) ** 2)))
        self.fraction.append(fraction)

    def joined(self, later: Trail) -> Trail:
        """Return this way and the one that goes on where it ends."""
        parts = zip(vars(self).values(), vars(later).values(), strict=True)
        return Trail(*(own + more[1:] for own, more in parts))


@dataclass
class SearchEnd:
    """What a search ended with."""

    p: FloatArray
    cost: float
    trail: Trail
    converged: bool
    reason: str
    #: methods that were tried and how each of them ended, where there were several
    tried: tuple[str, ...] = ()


class UpdateMethod(Value):
    """The base class of methods that minimise the residuals.

    A new method is a subclass with a `search`, in a module of its own.

    Examples
    --------
    >>> import flexplant as fx
    >>> isinstance(fx.updating.GaussNewton(), fx.updating.UpdateMethod)
    True
    """

    #: most steps when nothing else is said
    steps: ClassVar[int] = 200
    #: whether it keeps to the bounds of parameters
    keeps_bounds: ClassVar[bool] = True
    #: whether eigenvalues alone are weighted by W of the paper's (12), not by their covariance
    weighs_poles: ClassVar[bool] = False

    @property
    def least_squares(self) -> bool:
        """Whether the answer is that of least squares: no penalty, no robust loss, all data."""
        return True

    @property
    def penalised(self) -> bool:
        """Whether the answer is drawn towards the start, so that its covariance is not known."""
        return False

    @abstractmethod
    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where the search from `start` ends.

        Parameters
        ----------
        objective : Objective
            What to minimise.
        start : (q,) array
            Parameters to begin with.
        most : int, optional
            Most steps; `steps` when not given.
        tolerance : float
            Relative change of what is fitted that counts as none.

        Raises
        ------
        ModelError, SolverError
            When no step from the start helps.
        """


def unit_changes(objective: Objective, J: FloatArray) -> FloatArray:
    """Return what counts as one change of each parameter."""
    width = (objective.upper - objective.lower) / 2
    length = np.linalg.norm(J, axis=0)
    felt = 1 / divisor(length)
    unit = np.where(np.isfinite(width), width, felt)
    return np.asarray(np.where(objective.has_prior, objective.prior_std, unit), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class PenalisedMethod(UpdateMethod):
    """A method with a penalty of some weight; None: the weight is chosen from the data."""

    weight: float | None = field(default=None, kw_only=True, metadata=checked(positive))

    @property
    def penalised(self) -> bool:
        """Whether the answer is drawn towards the start."""
        return True
