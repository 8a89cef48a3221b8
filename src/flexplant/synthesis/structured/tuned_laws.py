"""TunedLaws: PID, lead, notch and low-pass of each decoupled axis, their numbers free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray, Value, checked, name_list, rebuild
from ...errors import ModelError, require_known
from ...lti.preparation import Prepared
from ...lti.statespace import System
from ...plant import StandardPlant
from ..laws.law import Law, LawElement, SingleElement, chained
from ..laws.loop_design import axes_of, checked_laws
from .scaled_loop import Matrices
from .structures import ControllerFamily, differenced

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

    laws: LawElement | Mapping[str, LawElement]
    before: System | FloatArray | None = None
    after: System | FloatArray | None = None
    free: Sequence[str] = field(default=_FREE, metadata=checked(name_list, name="free numbers"))

    def __post_init__(self) -> None:
        super().__post_init__()
        require_known("number of an element", self.free, _NUMBERS)

    def family(self, plant: StandardPlant, prepared: Prepared) -> _Laws:
        """Return the structure made ready for a plant."""
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
        self.order = sum(self._matrices(i, self.first)[0].shape[0] for i in range(len(self._each)))

    def matrices(self, theta: FloatArray) -> Matrices:
        """Return the controller y -> u; NaN for corners too high."""
        corners = [
            corner
            for i, law in enumerate(self._each)
            for j in range(len(law.factors))
            for corner in _corners(self._element(i, j, theta))
        ]
        K = self._joined([self._matrices(i, theta) for i in range(len(self._each))])
        return K if max(corners, default=0.0) <= self._highest else K._replace(D=np.nan * K.D)

    def _joined(self, parts: Sequence[tuple[FloatArray, ...]]) -> Matrices:
        A, B, C, D = (la.block_diag(*(part[j] for part in parts)) for j in range(4))
        return Matrices(A, -B @ self.after, self.before @ C, -self.before @ D @ self.after)

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives (n, rows, columns) of [A, B; C, D] by the parameters."""
        parts = [self._matrices(i, theta) for i in range(len(self._each))]

        def moved(axis: int, to: FloatArray) -> Matrices:
            return self._joined([*parts[:axis], self._matrices(axis, to), *parts[axis + 1 :]])

        return np.array(
            [
                differenced(partial(moved, number.axis), theta, i)
                for i, number in enumerate(self.numbers)
            ]
        )

    def structure(self, theta: FloatArray) -> TunedLaws:
        """Return the structure with its laws at these parameters, continuous."""
        laws = {name: self._law(i, theta) for i, name in enumerate(self._laws)}
        return self._given.replace(laws=laws)

    def _element(self, axis: int, factor: int, theta: FloatArray) -> SingleElement:
        element = self._each[axis].factors[factor]
        scaled = {
            name: getattr(element, name) * _clipped_exp(value)
            for value, (i, place, name) in zip(theta, self.numbers, strict=True)
            if (i, place) == (axis, factor)
        }
        return _with(element, scaled)

    def _gain(self, axis: int, theta: FloatArray) -> float:
        own = [v for v, n in zip(theta, self.numbers, strict=True) if n[:2] == (axis, -1)]
        return self._each[axis].gain * _clipped_exp(sum(own))

    def _law(self, axis: int, theta: FloatArray) -> Law:
        law = self._each[axis]
        factors = tuple(self._element(axis, i, theta) for i in range(len(law.factors)))
        return law.replace(factors=factors, gain=self._gain(axis, theta), rate=0.0)

    def _rate(self, axis: int) -> float:
        return self.rate if self._each[axis].prewarped else 0.0

    def _matrices(self, axis: int, theta: FloatArray) -> tuple[FloatArray, ...]:
        """Return the matrices of a law in the s of Tustin's rule."""
        sections = [
            self._element(axis, i, theta).section.at(self._rate(axis)).matrices
            for i in range(len(self._each[axis].factors))
        ]
        return chained(self._gain(axis, theta), sections)


def _clipped_exp(theta: float) -> float:
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
