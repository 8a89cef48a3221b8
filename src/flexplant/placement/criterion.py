"""What a layout is judged by: any function from plant to float, or one made of another."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ..arrays import FloatArray, IntArray, function
from ..errors import FlexplantError, ModelError, short, with_unit
from ..plant import StandardPlant
from ..store import Value, checked
from .candidates import Port, Side, sides_of, with_side


class Scorer:
    """The scores of choices among fixed candidates.

    A choice is a row of ascending indices of candidates. A subclass defines `value` for one choice,
    or `score` for several choices at once, or both.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> scorer = fx.PoiVariance().scorer(plant, plant.assembled.ports.y)
    >>> bool(scorer.value([0, 1]) < scorer.value([0]))
    True
    """

    def value(self, chosen: Sequence[int]) -> Any:
        """Return the score of one choice (smaller is better); FlexplantError if it has no score."""
        return float(self.score([chosen])[0])

    def outcome(self, chosen: Sequence[int]) -> tuple[float, str]:
        """Return the score of one choice, or infinity and the reason if it has no score."""
        try:
            found = self.value(chosen)
        except FlexplantError as error:
            return np.inf, str(error)
        try:
            number = float(found)
        except (TypeError, ValueError) as error:
            raise ModelError(
                f"the criterion {self!r} must return a float, got {type(found).__name__}."
            ) from error
        if np.isnan(number):
            raise ModelError(f"the criterion {self!r} returned NaN: it cannot be compared.")
        return number, "" if np.isfinite(number) else "the criterion is infinite."

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of several choices. Some criteria compute them all at once."""
        return np.array([self.outcome(chosen)[0] for chosen in sets])

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return a lower bound on the scores of all choices of `count` candidates.

        The bound is minus infinity if none is known.
        """
        return -np.inf


def by_size(sets: Sequence[Sequence[int]], function: Callable[[IntArray], Any]) -> FloatArray:
    """Return numbers of choices: the function gets rows (m, k) of those with k candidates."""
    found = np.empty(len(sets))
    sizes = np.fromiter(map(len, sets), dtype=np.int64, count=len(sets))
    for size in np.unique(sizes).tolist():
        which = np.flatnonzero(sizes == size)
        found[which] = function(np.array([sets[i] for i in which.tolist()], dtype=np.int64))
    return found


@dataclass(frozen=True, eq=False)
class OnPlant(Scorer):
    """The scores of a function from plant to float: choices are rows and columns of one plant."""

    plant: StandardPlant
    side: Side
    candidates: tuple[Port, ...]
    function: Callable[[StandardPlant], Any]

    def __repr__(self) -> str:
        return repr(self.function)

    @cached_property
    def whole(self) -> StandardPlant:
        """The plant with all candidates."""
        return with_side(self.plant, self.side, self.candidates)

    def value(self, chosen: Sequence[int]) -> Any:
        """Return what the function gives on the plant with this choice."""
        return self.function(with_side(self.whole, self.side, [self.candidates[i] for i in chosen]))


@dataclass(frozen=True, eq=False)
class OnBoth(Scorer):
    """The scores of a function of plants with an evaluation plant of the same choice."""

    chosen: OnPlant
    evaluation: StandardPlant

    def __repr__(self) -> str:
        return repr(self.chosen)

    def value(self, chosen: Sequence[int]) -> float:
        """Return what the function gives on the plant with this choice."""
        own = self.chosen
        ports = [own.candidates[i] for i in chosen]
        plant, judge = (with_side(p, own.side, ports) for p in (own.whole, self.evaluation))
        return float(own.function(plant.replace(evaluation=judge)))


class Criterion(Value):
    """The base class of criteria. A criterion is a function from a plant to a number to minimise.

    A new criterion defines `__call__`. It may also define `check`, and a `scorer` that is faster.

    Examples
    --------
    >>> import flexplant as fx
    >>> isinstance(fx.PoiVariance("die"), fx.placement.Criterion)
    True
    """

    #: what it depends on: sensors "y", actuators "u"
    sides: ClassVar[str] = "yu"
    #: values are compared by differences of this size where they pass through zero
    scale: ClassVar[float] = 0.0

    @abstractmethod
    def __call__(self, plant: StandardPlant) -> float:
        """Return the criterion on a plant."""

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Raise AssumptionError if no choice among the candidates satisfies the assumptions."""

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return an object that scores many choices and computes common results only once.

        The plant is sampled and was assembled from a structure. The candidates are sensors,
        actuators or both.
        """
        return OnPlant(plant, sides_of(candidates), tuple(candidates), self)

    def unit(self, plant: StandardPlant) -> str:
        """Return the unit of the root of the value if it is a mean square of a motion, else ""."""
        return ""

    def compared(self, plant: StandardPlant, other: StandardPlant) -> str:
        """Return a text: an interval of the error of a plant divided by that of another plant.

        The interval is computed over the machines that agree with the measurement, as for the
        attribute `interval` of `Placement`. The text is empty if there are none, or if the value of
        the criterion is not a mean square.
        """
        return ""


@dataclass(frozen=True, eq=False, repr=False)
class _Function(Criterion):
    """A callable of the user's."""

    function: Callable[[StandardPlant], Any]

    def __repr__(self) -> str:
        return repr(self.function)

    def __call__(self, plant: StandardPlant) -> Any:
        return self.function(plant)


def as_criterion(given: Any, side: str = "") -> Criterion:
    """Return a criterion of one side, made of any callable from plant to float."""
    if not callable(given) or isinstance(given, type):
        raise ModelError(
            "a criterion is a value such as PoiVariance(...) or placement.PoiLqr(...), or a "
            f"callable from plant to float, got {short(given)}. Pass one, or none for the usual."
        )
    criterion = given if isinstance(given, Criterion) else _Function(given)
    for part in side:
        if part not in criterion.sides:
            raise ModelError(
                f"{criterion!r} does not depend on {'sensors' if part == 'y' else 'actuators'}: "
                "use a criterion that does, or any callable from plant to float."
            )
    return criterion


def in_words(value: float, unit: str) -> str:
    """Return a value as people read it: the root of a mean square as `0.071 nm rms`."""
    if not unit or not np.isfinite(value):
        return f"{value:.4g}"
    return f"{with_unit(float(np.sqrt(max(value, 0.0))), unit)} rms"


@dataclass(frozen=True, eq=False, repr=False)
class Wrapping(Criterion):
    """A criterion of the values of another one, or of a callable; the base of them.

    Parameters
    ----------
    criterion : Criterion or callable
        From plant to float.
    """

    criterion: Any = field(
        metadata=checked(function, name="a criterion", hint="Pass PoiVariance(), say.")
    )

    @property
    def inner(self) -> Criterion:
        """The criterion that is wrapped."""
        return as_criterion(self.criterion)

    def unit(self, plant: StandardPlant) -> str:
        """Return the unit of the criterion that is wrapped."""
        return self.inner.unit(plant)

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Check the criterion that is wrapped."""
        as_criterion(self.criterion, sides_of(candidates)).check(plant, candidates)
