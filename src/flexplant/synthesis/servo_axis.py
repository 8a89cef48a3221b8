"""The controller of one axis of a servo: PID with roll-off and notches, in closed form too."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..lti.discretisation import discretized, tustin
from ..lti.interconnection import series
from ..lti.responses import responses
from ..lti.statespace import StateSpace
from ..lti.weights import leadlag, lowpass, notch
from ..values import ComplexArray, FloatArray

#: the lead's zero lies this factor below the bandwidth, its pole above: |S| of the rigid body
#: then peaks near 4 dB with the roll-off and integrator below
LEAD = 4.0
#: gain at a notch's centre, and damping ratio of its poles
DEPTH, WIDTH = 0.05, 0.3


@dataclass(frozen=True)
class Axis:
    """``k (1 + w_i / s) (1 + 4 s / w_b) / (1 + s / (4 w_b)) F(s)``, sampled by Tustin's rule.

    F is a second-order low-pass and the notches; k makes ``1 / s^2`` cross 1 at the bandwidth.

    Parameters
    ----------
    bandwidth, rolloff, integrator : float [Hz]
        The corners.
    notches : tuple of float [Hz]
        Centres.
    rate : float [Hz]
        Sampling rate.
    """

    bandwidth: float
    rolloff: float
    integrator: float
    notches: tuple[float, ...]
    rate: float

    @cached_property
    def system(self) -> StateSpace:
        """Error to acceleration."""
        omega_i = 2.0 * np.pi * self.integrator
        parts = [
            StateSpace([[0.0]], [[omega_i]], [[1.0]], [[1.0]]),
            leadlag(self.bandwidth / LEAD, LEAD * self.bandwidth),
            lowpass(self.rolloff, order=2),
            *(notch(freq, depth=DEPTH, width=WIDTH) for freq in self.notches),
        ]
        joined = parts[0]
        for part in parts[1:]:
            joined = series(joined, part)
        joined = tustin(joined, self.rate)
        gain = self._gain
        return joined.replace(
            C=gain * joined.C, D=gain * joined.D, inputs=["error"], outputs=["acceleration"]
        )

    def response(self, freq: FloatArray) -> ComplexArray:
        """Return the response at frequencies [Hz] below half the rate."""
        return np.asarray(self._gain * self._shape(freq))

    @property
    def _gain(self) -> float:
        at = self._shape(np.array([self.bandwidth]))[0]
        return float((2.0 * np.pi * self.bandwidth) ** 2 / abs(at))

    def _shape(self, freq: FloatArray) -> ComplexArray:
        # Tustin's s in units of 1 rad/s: 2 rate (z - 1) / (z + 1)
        s = 2j * self.rate * np.tan(np.pi * freq / self.rate)
        wb, wr, wi = 2.0 * np.pi * np.array([self.bandwidth, self.rolloff, self.integrator])
        value = (1.0 + wi / s) * (1.0 + LEAD * s / wb) / (1.0 + s / (LEAD * wb))
        value = value / ((s / wr) ** 2 + np.sqrt(2.0) * s / wr + 1.0)
        for centre in self.notches:
            p = s / (2.0 * np.pi * centre)
            value *= (p**2 + 2.0 * DEPTH * WIDTH * p + 1.0) / (p**2 + 2.0 * WIDTH * p + 1.0)
        return np.asarray(value)


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
    return discretized(body, rate, delay=delay)


def rigid_peak(body: StateSpace, axis: Axis) -> float:
    """Return max |S| of one motion of the rigid body, stable or not, over a logarithmic grid."""
    freq = np.geomspace(1e-2 * axis.bandwidth, 0.5 * axis.rate * (1.0 - 1e-9), 2000)
    gain = responses(body, freq)[0, 0] * axis.response(freq)
    return float(1.0 / np.min(np.abs(1.0 - gain)))
