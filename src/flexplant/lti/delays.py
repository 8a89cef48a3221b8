"""Continuous systems with a delay, exact on the frequency axis; also laws that differentiate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, positive, real_array, whole
from ..errors import ModelError, short
from ..store import Value
from .filters import pade, tf
from .frequency import Frf
from .interconnection import series, side_by_side
from .response_solvers import responder
from .statespace import StateSpace, System, as_statespace


@dataclass(frozen=True, eq=False, repr=False)
class Delayed(Value):
    """``(G(s) + s F) e^(-s delay)``: a continuous system, a derivative and a delay.

    The term s F is the derivative of a PD controller, or of another controller with one more zero
    than poles. Such a controller has no state-space form. Its product with a strictly proper plant
    is an ordinary system again. `flexplant.loop.DelayedLoop` judges loops with it, and `pade` gives
    a system with states for methods that need one.

    Parameters
    ----------
    system : StateSpace, or a system of python-control or SciPy
        G, continuous.
    delay : float [s]
        Delay of all channels.
    slope : (p, m) array, optional
        Gain F of the derivative; zero when not given.

    Raises
    ------
    ModelError, ShapeError
        When the system is sampled, the delay negative, or F of another size.

    Examples
    --------
    >>> import flexplant as fx
    >>> pd = fx.lti.Delayed.tf([2.0, 1.0], [1.0], delay=1.0)  # 1 + 2 s, a second late
    >>> pd(0.0), np.round(abs(pd(1j)), 6)
    ((1+0j), np.float64(2.236068))
    """

    system: Any
    delay: float = 0.0
    slope: Any = None

    def __post_init__(self) -> None:
        g = as_statespace(self.system)
        if g.dt and g.n_states:
            raise ModelError(
                f"{g!r} is sampled: a delay of a sampled system is states. Use "
                "lti.discretized(sys, rate, delay=), or pass a continuous system."
            )
        late = positive(self.delay, "delay", zero=True)
        F = np.zeros(g.D.shape) if self.slope is None else self.slope
        self._set(system=g.replace(dt=0.0), delay=late, slope=real_array(F, "slope", g.D.shape))

    @classmethod
    def tf(cls, num: npt.ArrayLike, den: npt.ArrayLike, *, delay: float = 0.0) -> Delayed:
        """Return ``num(s) / den(s) e^(-s delay)``, with at most one zero more than poles.

        Parameters
        ----------
        num, den : arrays
            Coefficients, the highest power first.
        delay : float [s]
            Time by which the signal is delayed.
        """
        above = np.trim_zeros(np.atleast_1d(real_array(num, "num")), "f")
        below = np.trim_zeros(np.atleast_1d(real_array(den, "den")), "f")
        if above.size <= below.size:
            return cls(tf(num, den), delay)
        if above.size > below.size + 1:
            raise ModelError(
                f"num(s) has degree {above.size - 1} and den(s) {below.size - 1}: a law that "
                "differentiates twice amplifies noise without limit. Add a filter."
            )
        quotient, rest = np.polydiv(above, below)
        proper = tf(np.polyadd(np.polymul(quotient[1:], below), rest), below)
        return cls(proper, delay, [[quotient[0]]])

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        names: tuple[str, ...] = self.system.inputs
        return names

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        names: tuple[str, ...] = self.system.outputs
        return names

    def __repr__(self) -> str:
        more = ", differentiates" if np.any(self.slope) else ""
        return f"<Delayed by {self.delay:g} s{more}: {self.system!r}>"

    def at(self, s: ComplexArray) -> ComplexArray:
        """Return the values (p, m, n) at complex frequencies (n,) [rad/s]."""
        g = self.system
        if np.all(np.real(s) == 0):
            values = responder(g)(np.imag(s) / (2 * np.pi))
        else:
            values = np.stack([g.evaluated(one) for one in s], axis=2)
        return np.asarray((values + self.slope[:, :, None] * s) * np.exp(-s * self.delay))

    def __call__(self, s: complex) -> Any:
        """Return the value at a complex frequency [rad/s]: a number, or (p, m)."""
        value = self.at(np.array([complex(s)]))[:, :, 0]
        return complex(value[0, 0]) if value.size == 1 else value

    def frequency_response(self, freq: npt.ArrayLike) -> Frf:
        """Return the response at frequencies [Hz], exactly."""
        lines = np.atleast_1d(real_array(freq, "freq"))
        s: ComplexArray = np.asarray(2j * np.pi * lines, dtype=np.complex128)
        data = self.at(s)
        return Frf(lines, data, inputs=self.inputs, outputs=self.outputs)

    def __neg__(self) -> Delayed:
        return Delayed(-self.system, self.delay, -self.slope)

    def __mul__(self, other: Any) -> Delayed:
        """Return ``self * other``: first `other`, then this; delays add."""
        first = delayed(other)
        g, h = self.system, first.system
        F, E = self.slope, first.slope
        if np.any(F @ E):
            raise ModelError("both systems differentiate: their product would do so twice.")
        # s C (sI - A)^-1 B = C B + C A (sI - A)^-1 B
        moved = h.replace(C=h.C @ h.A, D=h.C @ h.B, blocks=None) if np.any(F) else None
        found = series(h, g)
        if moved is not None:
            found = found + series(moved, F).replace(inputs=found.inputs, outputs=found.outputs)
        if np.any(E):
            turned = g.replace(B=g.A @ g.B, D=g.C @ g.B, blocks=None)
            found = found + series(E, turned).replace(inputs=found.inputs, outputs=found.outputs)
        return Delayed(found, self.delay + first.delay, F @ h.D + g.D @ E)

    def __rmul__(self, other: Any) -> Delayed:
        return delayed(other) * self

    def pade(self, order: int) -> StateSpace:
        """Return the system with Pade's approximation of the delay, for designs that need states.

        The order is the number of states of the approximation P of each delay. Its relative error
        is ``|1 - P(jw) e^(jw delay)|``; `pade_error` returns it at a frequency.
        """
        if np.any(self.slope):
            raise ModelError(f"{self!r} has no state space: add a filter to its derivative.")
        if not self.delay:
            found: StateSpace = self.system
            return found
        late = pade(self.delay, order=whole(order, "order"))
        return series(side_by_side([late] * len(self.inputs), self.inputs), self.system).replace(
            inputs=self.inputs, outputs=self.outputs
        )

    def pade_error(self, order: int, freq: float) -> float:
        """Return the relative error of `pade` of an order at a frequency [Hz]."""
        s = 2j * np.pi * positive(freq, "freq")
        late = pade(self.delay, order=whole(order, "order")) if self.delay else None
        return 0.0 if late is None else float(abs(1.0 - late(s) * np.exp(s * self.delay)))


def delayed(given: System | Delayed | float) -> Delayed:
    """Return a Delayed as it is, and of a system one without delay."""
    if isinstance(given, Delayed):
        return given
    if given is None or isinstance(given, str):
        raise ModelError(f"need a system or an lti.Delayed, got {short(given)}.")
    return Delayed(as_statespace(given))
