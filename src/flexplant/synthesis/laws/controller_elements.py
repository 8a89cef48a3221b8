"""What is multiplied by hand: PID, lead, lag, integrator, notch, low-pass, a given block."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import number, positive, whole
from ...errors import ModelError, ShapeError, counted, short
from ...lti.conversions import bilinear
from ...lti.statespace import StateSpace, as_statespace, single_channel
from ...store import Value, checked
from ..controller import Controller
from .law import BlockSection, Section, SingleElement


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


@dataclass(frozen=True, eq=False, repr=False)
class FixedBlock(SingleElement):
    """An element of a law that is a given system with one input and one output.

    Parameters
    ----------
    block : StateSpace
        System from error to command, continuous or sampled. A sampled system with states can only
        be used at its own rate.
    label : str
        Description that is shown when the law is printed.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.FixedBlock(fx.lti.tf([1.0], [0.01, 1.0]), "shaping filter")
    FixedBlock shaping filter: 1 state
    """

    block: StateSpace
    label: str = "block"

    def __post_init__(self) -> None:
        block = single_channel(self.block, "a block of a law", ShapeError)
        self._set(block=block, label=str(self.label))

    @classmethod
    def of(cls, given: Any, *, label: str = "") -> FixedBlock:
        """Return the element that is a given system, or a designed controller.

        Parameters
        ----------
        given : StateSpace or Controller
            System of the element. A StateSpace is used unchanged, from error to command. A designed
            Controller K includes the sign of the feedback (``u = K y``). The element is therefore
            ``-K``.
        label : str, optional
            Description of the element; by default the name or the method of `given`.
        """
        if isinstance(given, Controller):
            return cls(-given.system, label or given.method)
        if isinstance(given, Value) and not isinstance(given, StateSpace):
            raise ModelError(
                f"a block of a law is a system, got {short(given)}. Pass a StateSpace."
            )
        return cls(as_statespace(given), label or getattr(given, "name", None) or "block")

    def __repr__(self) -> str:
        rate = f" at {1.0 / self.block.dt:g} Hz" if self.own_rate else ""
        return f"FixedBlock {self.label}: {counted(self.block.n_states, 'state')}{rate}"

    @property
    def own_rate(self) -> float:
        """The only rate [Hz] at which the block can run; 0 if it can run at any rate."""
        return 1.0 / self.block.dt if self.block.dt and self.block.n_states else 0.0

    @cached_property
    def section(self) -> BlockSection:
        """The system. A sampled block is replaced by its continuous equivalent by Tustin's rule."""
        rate, g = self.own_rate, self.block
        return BlockSection(bilinear(g, rate) if rate else g.replace(dt=0.0))
