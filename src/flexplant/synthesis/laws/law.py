"""Laws as products of elements, and the controller of one law for each axis of a plant."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...arrays import (
    ComplexArray,
    FloatArray,
    below_half_rate,
    flag,
    instance,
    name_list,
    positive,
    real_array,
)
from ...errors import ModelError, require_known, short
from ...lti.blocks_of_states import Matrices, block_matrix, cascaded, trapezoidal
from ...lti.frequency import sampled_freq
from ...lti.interconnection import series, side_by_side
from ...lti.response_solvers import responder
from ...lti.statespace import StateSpace
from ...plant import AnyPlant
from ...store import Value


class Section(NamedTuple):
    """``(b2 p^2 + b1 p + b0) / (a2 p^2 + a1 p + a0)``, p = s / omega, of order 2, 1 or 0."""

    b: tuple[float, float, float]
    a: tuple[float, float, float]
    omega: float
    centre: float = 0.0

    def at(self, rate: float) -> Section:
        """Return the section whose Tustin equivalent at a rate [Hz] keeps the centre."""
        if not rate or not self.centre:
            return self
        stretch = 2.0 * rate * np.tan(0.5 * self.centre / rate) / self.centre
        return self._replace(omega=float(stretch * self.omega))

    def gain(self, s: ComplexArray) -> ComplexArray:
        """Return the response at complex frequencies s [rad/s]."""
        p = s / self.omega
        (b2, b1, b0), (a2, a1, a0) = self.b, self.a
        return np.asarray(((b2 * p + b1) * p + b0) / ((a2 * p + a1) * p + a0))

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A, B, C and D of the continuous section."""
        (b2, b1, b0), (a2, a1, a0), w = self.b, self.a, self.omega
        if not a2 and not a1:  # a gain: a state would be one that nothing sees
            return np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[b0 / a0]])
        if not a2:
            b1, b0, a0 = b1 / a1, b0 / a1, a0 / a1
            one = np.array([[-a0 * w]]), np.array([[w]]), np.array([[b0 - b1 * a0]])
            return *one, np.array([[b1]])
        b2, b1, b0, a1, a0 = b2 / a2, b1 / a2, b0 / a2, a1 / a2, a0 / a2
        return (
            np.array([[0.0, w], [-a0 * w, -a1 * w]]),
            np.array([[0.0], [w]]),
            np.array([[b0 - b2 * a0, b1 - b2 * a1]]),
            np.array([[b2]]),
        )


class BlockSection(NamedTuple):
    """A system of one channel in a law, continuous, where a `Section` has one transfer function."""

    own: StateSpace
    centre: float = 0.0

    def at(self, rate: float) -> BlockSection:
        """Return the same: nothing is prewarped."""
        return self

    def gain(self, s: ComplexArray) -> ComplexArray:
        """Return the response at frequencies s = j omega [rad/s]."""
        return np.asarray(responder(self.own)(s.imag / (2.0 * np.pi))[0, 0])

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A, B, C and D."""
        return self.own.A, self.own.B, self.own.C, self.own.D


class LawElement(Value):
    """A factor of a law: multiply elements, and numbers, to a `Law`."""

    @property
    @abstractmethod
    def law(self) -> Law:
        """The law of this element alone."""

    @property
    def system(self) -> StateSpace:
        """The continuous system from error to command."""
        return self.law.system

    def sampled(self, rate: float) -> Law:
        """Return the law as it runs at a rate [Hz].

        Parameters
        ----------
        rate : float [Hz]
            Sampling rate. It must be above twice the frequency of each notch and low-pass.

        Raises
        ------
        ModelError
            When the rate is not high enough.
        """
        return self.law.replace(rate=positive(rate, "rate"))

    def __mul__(self, other: LawElement | float) -> Law:
        """Return the law of both in series; a number scales it."""
        mine = self.law
        if isinstance(other, LawElement):
            law = other.law
            if mine.rate and law.rate and mine.rate != law.rate:
                raise ModelError(
                    f"the laws run at {mine.rate:g} and {law.rate:g} Hz: multiply them continuous, "
                    "then sample the product."
                )
            factors, gain = (*mine.factors, *law.factors), mine.gain * law.gain
            return mine.replace(factors=factors, gain=gain, rate=mine.rate or law.rate)
        if isinstance(other, int | float | np.number):
            return mine.replace(gain=mine.gain * float(other))
        raise ModelError(
            f"a law is multiplied by elements and numbers, got {short(other)}. Pass one."
        )

    def __rmul__(self, other: float) -> Law:
        """Return the law times a number."""
        return self.law * other

    def __truediv__(self, other: float) -> Law:
        """Return the law over a number."""
        if not isinstance(other, int | float | np.number) or not other:
            raise ModelError(
                f"a law is divided by a number, not zero, got {short(other)}. The inverse of an "
                "element is another element: Notch(freq, depth=20), Lead(freq, 1 / ratio)."
            )
        return self.law * (1.0 / float(other))

    def __neg__(self) -> Law:
        """Return the law with its sign reversed."""
        return self.law * -1.0

    def __add__(self, other: object) -> Law:
        """Refuse a sum: a law is a product."""
        raise ModelError(
            f"a law is a product of elements, {short(self)} + {short(other)} is a sum. Pid has "
            "proportional, integral and derivative action in one; other sums are a StateSpace, "
            "add(first.system, second.system)."
        )

    __radd__ = __sub__ = __rsub__ = __add__


class SingleElement(LawElement):
    """An element with one section."""

    @property
    @abstractmethod
    def section(self) -> Section | BlockSection:
        """Transfer function of the element, from error to command."""

    @property
    def own_rate(self) -> float:
        """The only rate [Hz] at which the element can run; 0 if it can run at any rate."""
        return 0.0

    @property
    def law(self) -> Law:
        """The law of this element alone."""
        return Law((self,), rate=self.own_rate)


@dataclass(frozen=True, eq=False, repr=False)
class Law(LawElement):
    """A product of elements ``gain F1(s) F2(s) ...``, from error to command.

    When the law is sampled, each factor is mapped by Tustin's rule.

    Parameters
    ----------
    factors : sequence of elements
        Elements of the law: `Pid`, `Lead`, `Lag`, `Integrator`, `Notch`, `LowPass` or `FixedBlock`.
    gain : float
        Number by which the factors are multiplied.
    rate : float [Hz]
        Sampling rate; 0 when continuous.
    prewarped : bool
        Whether the frequencies of notches, leads and the corners of low-passes are kept exactly
        when the law is sampled. Tustin's rule alone would shift them.

    Examples
    --------
    >>> from flexplant.synthesis import LowPass, Pid
    >>> law = Pid.corners(2e5, integrator=5.0, zero=15.0, pole=300.0) * LowPass(830.0)
    >>> print(law.replace(factors=law.factors[1:]).sampled(1e4))
    LowPass(freq=830 Hz, order=2, damping=0.707107), at 10000 Hz
    """

    factors: Sequence[SingleElement] = ()
    gain: float = 1.0
    rate: float = 0.0
    prewarped: bool = True

    def __post_init__(self) -> None:
        factors = tuple(self.factors) if isinstance(self.factors, Iterable) else (self.factors,)
        for factor in factors:
            instance(factor, SingleElement, "a factor of a law", "Pass Pid, Lead, Notch, LowPass.")
        rate = positive(self.rate, "rate", zero=True)
        for factor in factors:
            if factor.own_rate not in (0.0, rate):
                runs = f"runs at {rate:g} Hz" if rate else "is continuous"
                raise ModelError(
                    f"{factor} is sampled at {factor.own_rate:g} Hz, the law {runs}: its samples "
                    f"mean nothing there. Sample the law at {factor.own_rate:g} Hz, or take the "
                    "block before it was sampled."
                )
            if rate and (centre := factor.section.centre / (2.0 * np.pi)) >= 0.5 * rate:
                below_half_rate(centre, str(factor), rate)
        gain = float(real_array(self.gain, "gain", ()))
        self._set(
            factors=factors, gain=gain, rate=rate, prewarped=flag(self.prewarped, "prewarped")
        )

    def __repr__(self) -> str:
        gain = [f"{self.gain:.4g}"] if self.gain != 1.0 or not self.factors else []
        rate = f", at {self.rate:g} Hz" if self.rate else ""
        return " * ".join([*gain, *map(repr, self.factors)]) + rate

    @property
    def law(self) -> Law:
        """The law itself."""
        return self

    @cached_property
    def _sections(self) -> tuple[Section | BlockSection, ...]:
        rate = self.rate if self.prewarped else 0.0
        return tuple(factor.section.at(rate) for factor in self.factors)

    @cached_property
    def system(self) -> StateSpace:
        """The system from error to command. It is sampled if the law is."""
        sizes = [len(section.matrices[0]) for section in self._sections]
        blocks = [size for size in sizes if size][::-1]
        dt = 1.0 / self.rate if self.rate else 0.0
        return StateSpace(*self.matrices, dt, inputs=["error"], outputs=["command"], blocks=blocks)

    @cached_property
    def matrices(self) -> Matrices:
        """A, B, C and D of `system`."""
        a = 2.0 * self.rate
        parts = [section.matrices for section in self._sections]
        # sampled each on its own: states of one size
        return chained(self.gain, [trapezoidal(one, a) for one in parts] if a else parts)

    def response(self, freq: npt.ArrayLike) -> ComplexArray:
        """Return the response (n_freq,) at increasing frequencies.

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Frequencies in increasing order. For a sampled law they are below half the rate.
        """
        return self.at(sampled_freq(freq, 1.0 / self.rate if self.rate else 0.0))

    def at(self, freq: FloatArray) -> ComplexArray:
        """Return the response at frequencies [Hz] in any order. The frequencies are not checked."""
        return self.gain * product(self._sections, tustin_s(freq, self.rate))


def chained(gain: float, parts: Iterable[Matrices]) -> Matrices:
    """Return A, B, C and D of matrices one after the other, then a gain."""
    start = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    A, B, C, D = reduce(cascaded, parts, start)
    return A, B, gain * C, gain * D


def decoupled(laws: Iterable[Matrices], before: FloatArray, after: FloatArray) -> Matrices:
    """Return A, B, C and D of ``-before diag(laws) after``, from those of laws."""
    A, B, C, D = (block_matrix(parts) for parts in zip(*laws, strict=True))
    return A, -B @ after, before @ C, -before @ D @ after


def tustin_s(freq: FloatArray | float, rate: float) -> ComplexArray:
    """Return ``2 rate (z - 1) / (z + 1)`` at frequencies [Hz]; j omega of a continuous law."""
    omega = 2.0 * rate * np.tan(np.pi * freq / rate) if rate else 2.0 * np.pi * freq
    return np.asarray(1j * omega, dtype=np.complex128)


def product(sections: Iterable[Section | BlockSection], s: ComplexArray) -> ComplexArray:
    """Return the response of sections one after the other at complex frequencies s [rad/s]."""
    value = np.ones(s.shape, dtype=np.complex128)
    for section in sections:
        value *= section.gain(s)
    return value


@dataclass(frozen=True)
class Axes:
    """A square plant in its axes, and the way there from y and from there to u."""

    plant: Any
    before: StateSpace
    after: StateSpace
    rate: float
    given: AnyPlant | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The axes."""
        return tuple(self.after.outputs)


def axes_controller(axes: Axes, laws: Mapping[str, Law]) -> StateSpace:
    """Return motions to commands of the axes, ``-diag(laws)``."""
    dt = 1.0 / axes.rate if axes.rate else 0.0
    each = [(-laws[name].system).replace(dt=dt) for name in axes.names]
    return side_by_side(each, axes.names).replace(outputs=axes.before.inputs)


def connected(axes: Axes, inner: StateSpace, references: Mapping[str, str]) -> StateSpace:
    """Return [y, references] -> u of a controller in the axes."""
    require_known("axis", references, axes.names)
    names = name_list(references.values(), "references")
    chosen = np.zeros((len(axes.names), len(names)))
    for column, name in enumerate(references):
        chosen[axes.names.index(name), column] = 1.0
    none = np.zeros((len(axes.names), len(axes.after.inputs)))
    if len(inner.inputs) > len(axes.names):
        read = np.block([[none, chosen], [axes.after.D, np.zeros(chosen.shape)]])
    else:
        read = np.hstack([axes.after.D, -chosen])
    inputs = [*axes.after.inputs, *names]
    first = StateSpace([], [], [], read, inner.dt, inputs=inputs)
    system = series(series(first, inner), axes.before.replace(dt=inner.dt))
    return system.replace(inputs=inputs, outputs=axes.before.outputs)
