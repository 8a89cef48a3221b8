"""The controller of one axis of a servo: PID with roll-off and notches, in closed form too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from ..lti.discretisation import held_exactly
from ..lti.grid import highest
from ..lti.responses import responder
from ..lti.statespace import StateSpace
from ..values import ComplexArray, FloatArray
from .controller_elements import LowPass, Notch, Pid
from .law import Law

#: the lead's zero lies this factor below the bandwidth, its pole above: |S| of the rigid body
#: then peaks near 4 dB with the roll-off and integrator below
LEAD = 4.0
#: gain at a notch's centre, and damping ratio of its poles
DEPTH, WIDTH = 0.05, 0.3
#: of a logarithmic grid, refined where |S| of the rigid body is largest
_POINTS = 300


@dataclass(frozen=True)
class Axis:
    """``k (1 + w_i / s) (1 + r s / w_b) / (1 + s / (r w_b)) F(s)``, sampled by Tustin's rule.

    F is a second-order low-pass and the notches; k makes ``1 / s^2`` cross 1 at the bandwidth.
    """

    bandwidth: float
    rolloff: float
    integrator: float
    notches: tuple[float, ...]
    rate: float
    lead: float = LEAD
    prewarped: bool = False

    @cached_property
    def law(self) -> Law:
        """Error to acceleration."""
        pid = Pid.corners(
            1.0,
            integrator=self.integrator,
            zero=self.bandwidth / self.lead,
            pole=self.bandwidth * self.lead,
        )
        notches = tuple(Notch(freq, DEPTH, WIDTH) for freq in self.notches)
        shape = Law(
            (pid, LowPass(self.rolloff), *notches), rate=self.rate, prewarped=self.prewarped
        )
        at = abs(shape.at(np.array([self.bandwidth]))[0])
        return shape * float((2.0 * np.pi * self.bandwidth) ** 2 / at)

    @property
    def system(self) -> StateSpace:
        """Error to acceleration."""
        return self.law.system

    def response(self, freq: FloatArray) -> ComplexArray:
        """Return the response at frequencies [Hz] below half the rate."""
        return self.law.at(freq)

    def with_notch(self, freq: float) -> Axis:
        """Return the axis with one notch more [Hz]."""
        return replace(self, notches=(*self.notches, freq))


@lru_cache(maxsize=64)
def rigid_body(rate: float, delay: float, suspension: float) -> StateSpace:
    """Return one motion of the body, held and delayed: acceleration commanded to error.

    Its frequency is that of a suspension [Hz], 0 when free; negative where magnets make poles
    +-2 pi |f| of it.
    """
    body = StateSpace(
        [[0.0, 1.0], [-((2.0 * np.pi) ** 2) * suspension * abs(suspension), 0.0]],
        [[0.0], [1.0]],
        [[-1.0, 0.0]],
        [[0.0]],
        inputs=["acceleration"],
        outputs=["error"],
        blocks=[2],
    )
    return held_exactly(body, rate, delay=delay)


def rigid_peak(body: StateSpace, axis: Axis) -> float:
    """Return max |S| of one motion of the rigid body, stable or not."""
    respond = responder(body)

    def size(freq: FloatArray) -> FloatArray:
        return np.asarray(1.0 / np.abs(1.0 - respond(freq)[0, 0] * axis.response(freq)))

    freq = np.geomspace(1e-2 * axis.bandwidth, 0.5 * axis.rate * (1.0 - 1e-9), _POINTS)
    return highest(size, freq, 1)[0]
