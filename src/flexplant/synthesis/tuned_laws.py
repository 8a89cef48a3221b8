"""TunedLaws: PID, lead, notch and low-pass of each decoupled axis, their numbers free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import ModelError, require_known
from ..lti.preparation import Prepared
from ..lti.statespace import System
from ..plant import StandardPlant
from ..values import FloatArray, Value, name_list, rebuild
from .law import Element, Law, Section, SingleElement, chained
from .loop_design import axes_of, checked_laws
from .structured_loop import Matrices
from .structures import DIFFERENCES, ControllerFamily

#: what an element may have free; the depth of a notch is not, unless it is named
_NUMBERS = ("p", "i", "d", "pole", "freq", "ratio", "width", "damping", "depth")
_FREE = _NUMBERS[:-1]
#: logarithm of the farthest that a number moves
_FARTHEST = 8.0
#: highest corner beside half the rate; of a continuous plant beside its fastest pole
_HIGHEST, _FASTER = 0.98, 10.0


@dataclass(frozen=True, eq=False, repr=False)
class TunedLaws(Value):
    """A decoupled controller ``u = -before diag(laws) after y`` whose numbers are free.

    Each number that is not zero moves by a factor and keeps its sign: gains, corners, centres of
    notches. No corner moves above half the rate, or ten times the fastest pole of a continuous
    plant; one that was given higher stays at most where it is. The laws given are where the search
    begins.

    Parameters
    ----------
    laws : Law or mapping {axis: Law}
        As for `design_loops`.
    before, after : StateSpace or array, optional
        As for `design_loops`.
    free : sequence of str
        Which numbers of the elements are free, of p, i, d, pole, freq, ratio, width, damping and
        depth; all but the depth unless given.

    Raises
    ------
    LabelError
        When one of these names is unknown.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.TunedLaws(fx.Pid(1.0) * fx.Lead(50.0), free=("p",)).free
    ('p',)
    """

    laws: Element | Mapping[str, Element]
    before: System | FloatArray | None = None
    after: System | FloatArray | None = None
    free: Sequence[str] = _FREE

    def __post_init__(self) -> None:
        free = name_list(self.free, "free numbers")
        require_known("number of an element", free, _NUMBERS)
        laws = dict(self.laws) if isinstance(self.laws, Mapping) else self.laws
        self._set(free=free, laws=laws)

    def __repr__(self) -> str:
        if not isinstance(self.laws, Mapping):
            return f"TunedLaws({self.laws!r})"
        return "TunedLaws(" + ", ".join(f"{k}: {v!r}" for k, v in self.laws.items()) + ")"

    def family(self, plant: StandardPlant, prepared: Prepared) -> _Laws:
        """Return the structure made ready for a plant.

        Raises
        ------
        LabelError, ModelError, ShapeError, AssumptionError
            When laws, transformations and plant do not go together.
        """
        axes = axes_of(plant, self.before, self.after, None, 0.0, True)
        laws = checked_laws(axes, self.laws)
        before = np.zeros((len(plant.u), len(axes.names)))
        before[[plant.u.index(name) for name in axes.before.outputs]] = axes.before.D
        after = np.zeros((len(axes.names), len(plant.y)))
        after[:, [plant.y.index(name) for name in axes.after.inputs]] = axes.after.D
        fastest = np.abs(plant.system.poles()).max(initial=0.0) / (2.0 * np.pi)
        highest = 0.5 * _HIGHEST * axes.rate if axes.rate else _FASTER * float(fastest)
        return _Laws(self, laws, before, after, axes.rate, highest)


class _Number(NamedTuple):
    """A number of an element: which axis, factor (-1: the gain of the law) and field it is."""

    axis: int
    factor: int
    name: str


class _Laws(ControllerFamily):
    """Laws whose numbers are ``value exp(theta)``."""

    spread = 0.3

    def __init__(
        self,
        given: TunedLaws,
        laws: Mapping[str, Law],
        before: FloatArray,
        after: FloatArray,
        rate: float,
        highest: float,
    ) -> None:
        self._given, self._laws, self.before, self.after = given, dict(laws), before, after
        self.rate = rate
        self._each = list(laws.values())
        factors = [factor for law in self._each for factor in law.factors]
        self._highest = max([highest, *(corner for one in factors for corner in _corners(one))])
        self.numbers = [n for i, law in enumerate(self._each) for n in _free(i, law, given.free)]
        if not self.numbers:
            raise ModelError(f"no number of the laws is free: name some of {_NUMBERS} in free=.")
        self.first = np.zeros(len(self.numbers))
        self._orders = [self._matrices(i, self.first)[0].shape[0] for i in range(len(self._each))]
        self._ends = np.cumsum(self._orders)
        self.order = int(self._ends[-1])

    def matrices(self, theta: FloatArray) -> Matrices:
        """Return the controller y -> u."""
        parts = [self._matrices(i, theta) for i in range(len(self._each))]
        A, B, C, D = (la.block_diag(*(part[j] for part in parts)) for j in range(4))
        return Matrices(A, -B @ self.after, self.before @ C, -self.before @ D @ self.after)

    def slope(self, theta: FloatArray, by: Matrices) -> FloatArray:
        """Return the gradient by the parameters from that by the matrices."""
        found = np.zeros(theta.size)
        known = [self._sections(i, theta) for i in range(len(self._each))]
        for k, (i, factor, name) in enumerate(self.numbers):
            own = slice(self._ends[i] - self._orders[i], self._ends[i])
            left, right = self.before[:, i : i + 1].T, -self.after[i : i + 1].T
            mine = (by.A[own, own], by.B[own] @ right, left @ by.C[:, own], left @ by.D @ right)
            gain, sections = known[i]
            for step, weight in DIFFERENCES:
                size, moved = float(np.exp(step)), list(sections)
                if factor >= 0:
                    element = self._element(i, factor, theta)
                    scaled = {name: size * getattr(element, name)}
                    moved[factor] = _with(element, scaled).section.at(self._rate(i))
                    size = 1.0
                parts = chained(size * gain, [one.matrices for one in moved])
                found[k] += weight * sum(
                    float(np.sum(g * m)) for g, m in zip(mine, parts, strict=True)
                )
        return found

    def structure(self, theta: FloatArray) -> TunedLaws:
        """Return the structure with its laws at these parameters, continuous."""
        laws = {name: self._law(i, theta) for i, name in enumerate(self._laws)}
        return self._given.replace(laws=laws)

    def _element(self, axis: int, factor: int, theta: FloatArray) -> SingleElement:
        element = self._each[axis].factors[factor]
        scaled = {
            name: getattr(element, name) * _factor(value)
            for value, (i, place, name) in zip(theta, self.numbers, strict=True)
            if (i, place) == (axis, factor)
        }
        return _with(element, scaled)

    def _gain(self, axis: int, theta: FloatArray) -> float:
        own = [v for v, n in zip(theta, self.numbers, strict=True) if n[:2] == (axis, -1)]
        return self._each[axis].gain * _factor(sum(own))

    def _law(self, axis: int, theta: FloatArray) -> Law:
        law = self._each[axis]
        factors = tuple(self._element(axis, i, theta) for i in range(len(law.factors)))
        return law.replace(factors=factors, gain=self._gain(axis, theta), rate=0.0)

    def _rate(self, axis: int) -> float:
        return self.rate if self._each[axis].prewarped else 0.0

    def _sections(self, axis: int, theta: FloatArray) -> tuple[float, list[Section]]:
        count = len(self._each[axis].factors)
        sections = [self._element(axis, i, theta).section for i in range(count)]
        return self._gain(axis, theta), [one.at(self._rate(axis)) for one in sections]

    def _matrices(self, axis: int, theta: FloatArray) -> tuple[FloatArray, ...]:
        """Return the matrices of a law in the s of Tustin's rule; NaN for corners too high."""
        gain, sections = self._sections(axis, theta)
        count = len(self._each[axis].factors)
        corners = [f for i in range(count) for f in _corners(self._element(axis, i, theta))]
        far = any(corner > self._highest for corner in corners)
        return chained(np.nan if far else gain, [one.matrices for one in sections])


def _factor(theta: float) -> float:
    return float(np.exp(np.clip(theta, -_FARTHEST, _FARTHEST)))


def _corners(element: SingleElement) -> list[float]:
    """Return the corners [Hz] of an element."""
    given = (getattr(element, name, None) for name in ("pole", "freq"))
    return [float(one) for one in given if one is not None]


def _with(element: SingleElement, numbers: Mapping[str, float]) -> SingleElement:
    """Return an element with other positive numbers, which need no check."""
    made = rebuild(type(element), dict(element._fields()) | dict(numbers))
    assert isinstance(made, SingleElement)  # noqa: S101 - rebuild returns the class it is given
    return made


def _free(axis: int, law: Law, names: Sequence[str]) -> list[_Number]:
    """Return the free numbers of a law; its gain only where no Pid has one."""
    found = []
    for i, factor in enumerate(law.factors):
        own = [f.name for f in fields(factor) if f.name in names]  # type: ignore[arg-type]
        found += [_Number(axis, i, name) for name in own if getattr(factor, name)]
    gains = any(number.name in "pid" for number in found)
    return found if gains or "p" not in names else [_Number(axis, -1, "gain"), *found]
