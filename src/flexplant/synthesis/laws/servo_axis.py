"""The law of one axis of a servo, by the line on which its plant lies at the bandwidth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...checks import FloatArray
from ...plant import StandardPlant
from ...plant.axes import DrivenAxes, complex_gain, real_gain
from .controller_elements import Integrator, LowPass, Notch, Pid
from .law import Law

#: the lead's zero lies this factor below the bandwidth, its pole above: |S| of a free mass then
#: peaks near 4 dB with the roll-off and integrator of `design_servo`
_LEAD = 4.0
#: gain at a notch's centre, and damping ratio of its poles
_DEPTH, _WIDTH = 0.05, 0.3
#: lines on which an axis may lie, by the power of 1 / s of its response: a mass that is free (or
#: above its springs), a damper, a spring (or a mass below its springs' frequency)
POWERS = {"mass": 2.0, "damper": 1.0, "spring": 0.0}
#: a line is tried when slope and phase of the response are no further from it than this beyond the
#: nearest line; both distances are counted in powers of s
_TRIED = 0.8
#: step of frequency for the slope, and how far below the bandwidth a response that vanishes at
#: rest is sought, with how small it is there
_STEP, _BELOW, _VANISHED = 1.05, 1e-3, 1e-2


@dataclass(frozen=True)
class Axis:
    """The law of an axis, sampled by Tustin's rule, with which its loop crosses 1 at the bandwidth.

    On a mass line ``(1 + w_i / s) (1 + r s / w_b) / (1 + s / (r w_b)) F(s)``, on that of a damper
    ``(1 + w_i / s) F(s)``, of a spring ``F(s) / s``, of a response that vanishes at rest ``F(s)``;
    F is a second-order low-pass and the notches.
    """

    line: str
    bandwidth: float
    rolloff: float
    integrator: float
    #: of the plant at the bandwidth, decoupled: exact
    gain: float
    rate: float
    notches: tuple[float, ...] = ()

    @cached_property
    def law(self) -> Law:
        """Error to command."""
        notches = (Notch(freq, _DEPTH, _WIDTH) for freq in self.notches)
        factors = (*self._action, LowPass(self.rolloff), *notches)
        shape = Law(factors, rate=self.rate, prewarped=False)
        at = abs(shape.at(np.array([self.bandwidth]))[0]) * self.gain
        return shape * float(1.0 / at)

    @property
    def _action(self) -> tuple[Pid | Integrator, ...]:
        if self.line == "mass":
            zero, pole = self.bandwidth / _LEAD, self.bandwidth * _LEAD
            return (Pid.corners(1.0, integrator=self.integrator, zero=zero, pole=pole),)
        if self.line == "damper":
            return (Integrator(self.integrator),)
        return (Pid(0.0, i=1.0),) if self.line == "spring" else ()


def gains_at(plant: StandardPlant, axes: DrivenAxes) -> FloatArray:
    """Return the responses (r,) of the decoupled axes to their commands at j 2 pi freq, complex."""
    found = [
        (complex_gain(plant.system, 2j * np.pi * f, [name], axes.actuators) @ axes.T[:, i])[0]
        for i, (name, f) in enumerate(zip(axes.channels, axes.freq, strict=True))
    ]
    return np.array(found)


def lines_of(plant: StandardPlant, axes: DrivenAxes) -> list[tuple[str, ...]]:
    """Return the lines on which each axis may lie, the most likely first."""
    phases = np.angle(gains_at(plant, axes)) + np.pi * axes.freq * plant.dt * (1 + 2 * plant.delay)
    found: list[tuple[str, ...]] = []
    for i, (name, f) in enumerate(zip(axes.channels, axes.freq, strict=True)):
        sigmas = 2.0 * np.pi * f * np.array([_BELOW, 1.0 / _STEP, 1.0, _STEP])
        sizes = [
            abs(float((real_gain(plant.system, s, [name], axes.actuators) @ axes.T[:, i])[0]))
            for s in sigmas
        ]
        if sizes[0] < _VANISHED * sizes[2]:
            found.append(("speed",))
            continue
        slope = -np.log(sizes[3] / sizes[1]) / (2.0 * np.log(_STEP))
        found.append(_likely(float(slope), float(phases[i])))
    return found


def _likely(slope: float, phase: float) -> tuple[str, ...]:
    """Return the lines near a slope of the real axis and a phase [rad] of the imaginary one."""
    # phases in (-3/2 pi, pi/2], so that that of a mass is -pi
    turned = float(np.mod(phase - 0.5 * np.pi, 2.0 * np.pi) - 1.5 * np.pi)
    off = {
        line: abs(slope - power) + abs(turned / (0.5 * np.pi) + power)
        for line, power in POWERS.items()
    }
    nearest = min(off.values())
    order = sorted(off, key=off.__getitem__)
    return tuple(line for line in order if off[line] <= nearest + _TRIED)


def combinations(lines: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return lines of all axes to try: each axis on its first line, its second, and on a mass.

    Next to its springs' frequency an axis resonates beyond the bandwidth, and crosses 1 once more
    as a mass: the lead of that law holds it there.
    """
    count = max(len(one) for one in lines)
    tried = [tuple(one[min(k, len(one) - 1)] for one in lines) for k in range(count)]
    tried.append(tuple("speed" if one == ("speed",) else "mass" for one in lines))
    return list(dict.fromkeys(tried))
