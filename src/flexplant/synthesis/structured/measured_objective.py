"""Objectives of your own: a number of the closed loop, minimised by its differences."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real

import numpy as np

from ...arrays import FloatArray, name_list, positive
from ...errors import ModelError, require_known, short
from ...lti.conversions import tustin
from ...lti.interconnection import lft
from ...lti.statespace import StateSpace
from ...plant import AnyPlant
from ...store import Value, checked
from ...tolerances import TINY
from .judges import STEP, Closed, Judge, Matrices, SmoothJudge, problem_on


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredObjective(Value):
    """Base class for your own objectives. An objective is a positive number of a closed loop.

    A new objective defines the method `measured`. It is a smooth function of the closed loop from w
    to z, in seconds and in the units of the channels. It returns infinity for a stable loop that is
    not acceptable. Its value must not depend on the choice of states. The search computes
    derivatives with respect to the n parameters of the controller by differences. Each gradient
    therefore needs 2 n more closed loops, which `evaluations` does not count.

    Parameters
    ----------
    w, z : sequences of str, optional
        Channels of the closed loop that `measured` receives; by default all.
    below : float, optional
        Upper bound on the number. If it is given, the search uses the number divided by this bound.

    Examples
    --------
    >>> import flexplant as fx
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, eq=False)
    ... class SlowestPole(fx.synthesis.MeasuredObjective):
    ...     def measured(self, closed):
    ...         return 1.0 / -closed.poles().real.max()
    >>> plant = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=0.1, KS=0.1)
    >>> law = fx.synthesis.FixedOrder(0)
    >>> found = fx.synthesis.design_structured(
    ...     plant, law, objective=SlowestPole(), starts=1, evaluations=50
    ... )
    >>> bool(found.gamma < 0.1)  # the largest time constant [s]
    True
    """

    w: tuple[str, ...] | None = field(default=None, metadata=checked(name_list))
    z: tuple[str, ...] | None = field(default=None, metadata=checked(name_list))
    below: float | None = field(default=None, metadata=checked(positive))

    def chosen(self, plant: AnyPlant) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of the channels w and z; by default all channels of the plant."""
        for side in "wz":
            require_known(f"channel of {side}", getattr(self, side) or (), getattr(plant, side))
        return self.w or plant.w, self.z or plant.z

    @abstractmethod
    def measured(self, closed: StateSpace) -> float:
        """Return the objective of a closed loop from w to z."""

    def judges(self, plant: AnyPlant, order: int) -> Sequence[Judge]:
        """Return the objects that compute the objective for controllers of `order` states.

        `design_structured` calls this method. See `Judge`.
        """
        return [MeasuredJudge(plant, self, order)]


class MeasuredJudge(SmoothJudge):
    """A number of the loop in the user's units, its gradient by differences of the controller."""

    def __init__(self, plant: AnyPlant, objective: MeasuredObjective, order: int) -> None:
        w, z = objective.chosen(plant)
        super().__init__(problem_on(plant, w, z), order)
        self.objective, self.dt = objective, plant.dt
        self.sides = (plant.y, plant.u)
        self.system = plant.system.select([*z, *plant.y], [*w, *plant.u])

    def value(self, K: Matrices) -> tuple[float, None]:
        """Return the number."""
        if self.stable(K) is None:
            return np.inf, None
        law = StateSpace(*K, inputs=self.sides[0], outputs=self.sides[1])
        closed = lft(self.system, tustin(law, 1.0 / self.dt) if self.dt else law)
        found: object = self.objective.measured(closed)
        if not (isinstance(found, Real) and float(found) > 0.0):
            raise ModelError(
                f"`measured` of {self.objective!r} must return one positive number of a stable "
                f"loop, got {short(found)}. Return a number that falls as loops get better."
            )
        return float(found), None

    def _logarithm(self, K: Matrices, by: FloatArray) -> tuple[float, FloatArray]:
        value = self.value(K)[0]
        ends = [[self.value(K.moved(s * STEP * move))[0] for s in (1.0, -1.0)] for move in by]
        up, down = np.log(np.maximum(np.array(ends).reshape(-1, 2), TINY)).T
        slopes = (up - down) / (2.0 * STEP)
        return float(np.log(max(value, TINY))), np.where(np.isfinite(slopes), slopes, 0.0)

    def found(self, loop: Closed) -> tuple[float, FloatArray]:
        """Return nothing: `value` and `_logarithm` close the loop in the user's units."""
        raise NotImplementedError
