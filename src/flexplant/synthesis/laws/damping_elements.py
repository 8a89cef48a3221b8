"""Elements that damp modes: velocity feedback, positive position feedback, integral resonance."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Self

import numpy as np

from ...arrays import number, positive
from ...store import checked
from .law import Section, SingleElement

#: where the damping of velocity feedback ends, over the frequency of the mode
_ENDS = (3.0, 10.0, 30.0)
#: frequency of positive position feedback over that of the mode, and its damping ratios
_FILTERS, _DAMPINGS = (0.9, 1.0, 1.1, 1.25, 1.5, 2.0), (0.1, 0.2, 0.35, 0.5, 0.7, 0.9)
#: corner of integral resonant control over the frequency of the mode
_CORNERS = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)


@dataclass(frozen=True, eq=False, repr=False)
class DampingElement(SingleElement):
    """Base class of elements L that damp a mode. Their input is the error: ``u = -L y``.

    A new kind of damping is a subclass. It defines the property `section`, which is the transfer
    function, and the method `candidates`, which gives the elements that `damp_modes` tries.

    Parameters
    ----------
    gain : float
        Gain by which the element is multiplied.
    """

    gain: float = field(metadata=checked(number))

    @classmethod
    @abstractmethod
    def candidates(cls, freq: float) -> Iterator[Self]:
        """Yield elements of gain 1 for a mode at a frequency [Hz]."""


@dataclass(frozen=True, eq=False, repr=False)
class VelocityFeedback(DampingElement):
    """Velocity feedback ``gain s / (1 + s / w)`` for a displacement sensor.

    If actuator and sensor are at the same place, every mode below w is damped, including rigid-body
    modes.

    Parameters
    ----------
    gain : float
        Command per velocity, in the unit of the command over that of y per second.
    pole : float [Hz]
        Corner frequency w. Above it the gain is constant.

    References
    ----------
    [Preumont2018]_, chapter 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.VelocityFeedback(2.0, pole=500.0)
    VelocityFeedback(gain=2, pole=500 Hz)
    """

    pole: float = field(metadata=checked(positive, unit="Hz"))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w = 2.0 * np.pi * self.pole
        return Section((0.0, self.gain * w, 0.0), (0.0, 1.0, 1.0), w)

    @classmethod
    def candidates(cls, freq: float) -> Iterator[Self]:
        """Yield elements of gain 1 for a mode at a frequency [Hz]."""
        yield from (cls(1.0, ratio * freq) for ratio in _ENDS)


@dataclass(frozen=True, eq=False, repr=False)
class PositivePositionFeedback(DampingElement):
    """Positive position feedback ``-gain / (p^2 + 2 damping p + 1)`` with p = s / w.

    The frequency w of the filter lies near that of the mode. The filter is well damped, and
    therefore damps the mode too. Above w the gain of the filter falls. The displacement is fed back
    with positive sign, ``u = +gain F(s) y``, where F(s) is the filter. This acts as a negative
    stiffness. The gain at zero frequency must therefore be below the static stiffness. A body
    without a spring to the ground cannot be damped in this way.

    Parameters
    ----------
    gain : float
        Command per displacement at zero frequency.
    freq : float [Hz]
        Frequency w of the filter.
    damping : float
        Damping ratio of the filter.

    References
    ----------
    [Fanson1990]_; [Preumont2018]_, section 7.6.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.PositivePositionFeedback(100.0, 20.0)
    PositivePositionFeedback(gain=100, freq=20 Hz, damping=0.5)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))
    damping: float = field(default=0.5, metadata=checked(positive))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w = 2.0 * np.pi * self.freq
        return Section((0.0, 0.0, -self.gain), (1.0, 2.0 * self.damping, 1.0), w, w)

    @classmethod
    def candidates(cls, freq: float) -> Iterator[Self]:
        """Yield elements of gain 1 for a mode at a frequency [Hz]."""
        for ratio, damping in product(_FILTERS, _DAMPINGS):
            yield cls(1.0, ratio * freq, damping)


@dataclass(frozen=True, eq=False, repr=False)
class IntegralResonantControl(DampingElement):
    """Integral resonant control ``-gain / (1 + s / w)``, an integrator with a feedthrough.

    The law is an integrator ``k / s`` whose input is ``y - d u``, where d is an artificial
    feedthrough. This equals the formula above with gain = 1 / d and w = k d. If d is larger than
    the static compliance of a collocated actuator and sensor, the plant with feedthrough has a zero
    below each resonance. Integral feedback then damps all these modes.

    Parameters
    ----------
    gain : float
        Command per displacement at zero frequency, which is 1 / d. It must be below the static
        stiffness.
    freq : float [Hz]
        Corner frequency w.

    References
    ----------
    [Aphale2007]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.IntegralResonantControl(100.0, 20.0)
    IntegralResonantControl(gain=100, freq=20 Hz)
    """

    freq: float = field(metadata=checked(positive, unit="Hz"))

    @property
    def section(self) -> Section:
        """Transfer function of the element, from error to command."""
        w = 2.0 * np.pi * self.freq
        return Section((0.0, 0.0, -self.gain), (0.0, 1.0, 1.0), w, w)

    @classmethod
    def candidates(cls, freq: float) -> Iterator[Self]:
        """Yield elements of gain 1 for a mode at a frequency [Hz]."""
        yield from (cls(1.0, ratio * freq) for ratio in _CORNERS)


#: the kinds by the names that the field gives them
KINDS: dict[str, Any] = {
    "velocity": VelocityFeedback,
    "ppf": PositivePositionFeedback,
    "irc": IntegralResonantControl,
}
