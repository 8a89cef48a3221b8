"""Laws as products of elements: PID, lead, lag, integrator, notch, low-pass."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...arrays import (
    ComplexArray,
    FloatArray,
    below_half_rate,
    flag,
    instance,
    number,
    positive,
    real_array,
    whole,
)
from ...errors import ModelError, short
from ...lti.blocks_of_states import Matrices, block_matrix, cascaded, trapezoidal
from ...lti.frequency import sampled_freq
from ...lti.response_solvers import responder
from ...lti.statespace import StateSpace
from ...store import Value, checked


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

    def at(self, freq: FloatArray | ComplexArray) -> ComplexArray:
        """Return the response at frequencies [Hz] in any order. The frequencies are not checked."""
        return self.gain * product(self._sections, tustin_s(freq, self.rate))


@dataclass(frozen=True, eq=False, repr=False)
class Pid(SingleElement):
    """PID element ``p + i / s + d s / (1 + s / w)``.

    Parameters
    ----------
    p, i, d : float
        Proportional, integral and derivative gain. Their units are command per error, command per
        error and second, and command per rate of the error.
    pole : float [Hz], optional
        Corner w, above which the gain of the derivative action is constant. It must be given if d
        is not zero.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.Pid(2.0, i=1.0, d=0.1, pole=100.0)
    Pid(p=2, i=1 /s, d=0.1 s, pole=100 Hz)
    """

    p: float = field(metadata=checked(number))
    i: float = field(default=0.0, metadata=checked(number, unit="/s"))
    d: float = field(default=0.0, metadata=checked(number, unit="s"))
    pole: float | None = field(default=None, metadata=checked(positive, unit="Hz"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.d and self.pole is None:
            raise ModelError(
                "a derivative without a pole has unbounded gain, and no system: give pole= [Hz], "
                "some 3 to 10 times the bandwidth."
            )

    @classmethod
    def corners(
        cls,
        gain: float,
        *,
        integrator: float = 0.0,
        zero: float | None = None,
        pole: float | None = None,
    ) -> Pid:
        """Return the PID ``gain (1 + w_i / s) (1 + s / w_z) / (1 + s / w_p)``.

        Parameters
        ----------
        gain : float
            Gain between the corner of the integral action and the zero.
        integrator : float [Hz]
            Corner w_i of the integral action; 0 means no integral action.
        zero, pole : float [Hz], optional
            Zero w_z and pole w_p of the lead. Give both or neither.
        """
        k = number(gain, "gain")
        w_i = 2.0 * np.pi * positive(integrator, "integrator", zero=True)
        if zero is None and pole is None:
            return cls(k, k * w_i)
        if zero is None or pole is None:
            raise ModelError("a lead has a zero and a pole: give both [Hz], or none.")
        w_z = 2.0 * np.pi * positive(zero, "zero")
        w_p = 2.0 * np.pi * positive(pole, "pole")
        p = k * (1.0 + w_i / w_z - w_i / w_p)
        return cls(p, k * w_i, k / w_z - p / w_p, float(pole))

    def as_corners(self) -> dict[str, float | None] | None:
        """Return the arguments of `corners` for this PID, or None if its zeros are complex."""
        if self.pole is None:
            corner = self.i / self.p / (2.0 * np.pi) if self.p else -1.0
            same: dict[str, float | None] = {"gain": self.p, "integrator": corner}
            return None if corner < 0.0 else same | {"zero": None, "pole": None}
        w = 2.0 * np.pi * self.pole
        high, low = self.p / w + self.d, self.p + self.i / w
        root = low * low - 4.0 * high * self.i
        if not high or not low or root < 0.0:
            return None
        fast = -0.5 * (low + np.copysign(np.sqrt(root), low)) / high  # no cancellation
        slow = self.i / (high * fast)
        if fast >= 0.0 or slow > 0.0:
            return None
        found = {"gain": -high * fast, "integrator": -slow / (2.0 * np.pi)}
        return found | {"zero": -float(fast) / (2.0 * np.pi), "pole": self.pole}

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        if self.pole is None and not self.i:
            return Section((0.0, 0.0, self.p), (0.0, 0.0, 1.0), 1.0)
        if self.pole is None:
            return Section((0.0, self.p, self.i), (0.0, 1.0, 0.0), 1.0)
        w = 2.0 * np.pi * self.pole
        b = (self.p + self.d * w, self.p + self.i / w, self.i / w)
        if not self.i:  # no state that integrates nothing
            return Section((0.0, b[0], self.p), (0.0, 1.0, 1.0), w)
        return Section(b, (1.0, 1.0, 0.0), w)


@dataclass(frozen=True, eq=False, repr=False)
class Lead(SingleElement):
    """Lead ``(1 + sqrt(r) p) / (1 + p / sqrt(r)) / sqrt(r)`` with p = s / w.

    Parameters
    ----------
    freq : float [Hz]
        Frequency w at which the phase lead is largest. The lead there is ``asin((r - 1) / (r +
        1))``, and the gain is 1. The zero lies at freq / sqrt(r), and the pole at freq sqrt(r).
    ratio : float
        Ratio r of the pole to the zero. Below 1 the element is a lag.

    References
    ----------
    [Franklin1998]_, section 5.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.Lead(50.0)  # most phase at 50 Hz
    Lead(freq=50 Hz, ratio=9)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))
    ratio: float = field(default=9.0, metadata=checked(positive))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        root, w = float(np.sqrt(self.ratio)), 2.0 * np.pi * self.freq
        return Section((0.0, 1.0, 1.0 / root), (0.0, 1.0 / root, 1.0), w, w)


@dataclass(frozen=True, eq=False, repr=False)
class Lag(SingleElement):
    """Lag ``(p + 1) / (p + 1 / ratio)`` with p = s / w.

    The gain is 1 far above the frequency w, and `ratio` far below it.

    Parameters
    ----------
    freq : float [Hz]
        Frequency w of the zero. The pole lies at freq / ratio.
    ratio : float
        Gain at low frequency.

    References
    ----------
    [Franklin1998]_, section 5.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.Lag(5.0)
    Lag(freq=5 Hz, ratio=10)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))
    ratio: float = field(default=10.0, metadata=checked(positive))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w = 2.0 * np.pi * self.freq
        return Section((0.0, 1.0, 1.0), (0.0, 1.0, 1.0 / self.ratio), w, w)


@dataclass(frozen=True, eq=False, repr=False)
class Integrator(SingleElement):
    """Integral action ``1 + w / s`` below a corner w. Above the corner the gain is 1.

    Parameters
    ----------
    freq : float [Hz]
        Corner frequency w, which is the zero of the element.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.Integrator(5.0)
    Integrator(freq=5 Hz)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w = 2.0 * np.pi * self.freq
        return Section((0.0, 1.0, 1.0), (0.0, 1.0, 0.0), w, w)


@dataclass(frozen=True, eq=False, repr=False)
class Notch(SingleElement):
    """Notch ``(p^2 + 2 depth width p + 1) / (q^2 + 2 width q + 1)``, p = s / w, q = p / skew.

    Parameters
    ----------
    freq : float [Hz]
        Frequency w of the zeros, the centre of the notch.
    depth : float
        Gain at the centre if skew is 1. Below 1 the element is a notch, and above 1 a resonance.
        The damping ratio of the zeros is depth times width.
    width : float
        Damping ratio of the poles. It is half the relative width of the notch.
    skew : float
        Ratio of the frequency of the poles to that of the zeros. The gain at high frequency is the
        square of this ratio.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.Notch(130.0, depth=0.1, width=0.2)
    Notch(freq=130 Hz, depth=0.1, width=0.2, skew=1)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))
    depth: float = field(default=0.05, metadata=checked(positive, zero=True))
    width: float = field(default=0.3, metadata=checked(positive))
    skew: float = field(default=1.0, metadata=checked(positive))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w, two, k = 2.0 * np.pi * self.freq, 2.0 * self.width, self.skew
        return Section((1.0, self.depth * two, 1.0), (1.0 / k**2, two / k, 1.0), w, w)


@dataclass(frozen=True, eq=False, repr=False)
class LowPass(SingleElement):
    """Low-pass ``1 / (p^2 + 2 damping p + 1)``, or ``1 / (p + 1)`` of order 1, with p = s / w.

    Parameters
    ----------
    freq : float [Hz]
        Corner frequency w.
    order : {1, 2}
        Order of the filter. The gain falls with 20 dB per decade above the corner for order 1, and
        with 40 dB per decade for order 2.
    damping : float
        Damping ratio of the poles for order 2; by default that of a Butterworth filter.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.LowPass(400.0)
    LowPass(freq=400 Hz, order=2, damping=0.707107)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))
    order: int = field(default=2, metadata=checked(whole, maximum=2))
    damping: float = field(default=float(np.sqrt(0.5)), metadata=checked(positive))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w = 2.0 * np.pi * self.freq
        if self.order == 1:
            return Section((0.0, 0.0, 1.0), (0.0, 1.0, 1.0), w, w)
        return Section((0.0, 0.0, 1.0), (1.0, 2.0 * self.damping, 1.0), w, w)


def chained(gain: float, parts: Iterable[Matrices]) -> Matrices:
    """Return A, B, C and D of matrices one after the other, then a gain."""
    start = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    A, B, C, D = reduce(cascaded, parts, start)
    return A, B, gain * C, gain * D


def decoupled(laws: Iterable[Matrices], before: FloatArray, after: FloatArray) -> Matrices:
    """Return A, B, C and D of ``-before diag(laws) after``, from those of laws."""
    A, B, C, D = (block_matrix(parts) for parts in zip(*laws, strict=True))
    return A, -B @ after, before @ C, -before @ D @ after


def tustin_s(freq: FloatArray | ComplexArray | float, rate: float) -> ComplexArray:
    """Return ``2 rate (z - 1) / (z + 1)`` at frequencies [Hz]; j omega of a continuous law."""
    omega = 2.0 * rate * np.tan(np.pi * freq / rate) if rate else 2.0 * np.pi * freq
    return np.asarray(1j * omega, dtype=np.complex128)


def product(sections: Iterable[Section | BlockSection], s: ComplexArray) -> ComplexArray:
    """Return the response of sections one after the other at complex frequencies s [rad/s]."""
    value = np.ones(s.shape, dtype=np.complex128)
    for section in sections:
        value *= section.gain(s)
    return value
