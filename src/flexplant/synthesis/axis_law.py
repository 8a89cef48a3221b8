"""The law of one axis by the logarithms of its numbers, and its distance to the critical point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..values import ComplexArray, FloatArray, IntArray
from .controller_elements import LowPass, Notch, Pid
from .law import Law, Section, product, tustin_s
from .measured_axis import MeasuredAxis

#: corner of the integrator beside the bandwidth
_INTEGRATOR = 0.1
#: ranges of the lead's zero below the bandwidth (not below the integrator), of its pole and of the
#: low-pass above it, as factors; of a notch's depth and width
_ZERO, _POLE, _ROLLOFF = (1.2, 10.0), (1.5, 60.0), (1.5, 60.0)
_DEPTH, _WIDTH = (0.01, 1.0), (0.02, 1.0)
#: loop gain at the last line, where the plant above it is unknown, beside that which holds |S|
_BEYOND = 0.1
#: how far a notch below the bandwidth may lie from a mode, as a factor
_BESIDE = 1.3


@dataclass(frozen=True)
class AxisLaw:
    """``k (1 + w_i / s) (1 + a s / w_b) / (1 + s / (b w_b)) F(s)``, w_b as high as |S| allows.

    F is a low-pass at c w_b and notches, k makes the loop of the rigid body cross 1 at w_b, w_i is
    a tenth of it. The logarithms of w_b, a, b, c and, of each notch, frequency, depth and width
    are its numbers. A notch lies above the bandwidth or at a mode: others would lower the loop gain
    below the bandwidth until nothing is left of it but its crossover.
    """

    axis: MeasuredAxis
    peak: float

    @property
    def lowest(self) -> float:
        """The lowest bandwidth [Hz]: well above the first line and the springs."""
        return max(4.0 * float(self.axis.freq[0]), 3.0 * self.axis.suspension)

    @property
    def highest(self) -> float:
        """The highest bandwidth [Hz], where the low-pass ends at the highest corner."""
        return self.axis.ceiling / _ROLLOFF[0]

    def law(self, numbers: FloatArray) -> Law:
        """Return the law of the logarithms of its numbers."""
        (w, a, b, c), notches = np.exp(numbers[:4]), np.exp(numbers[4:]).reshape(-1, 3)
        pid = Pid.corners(1.0, integrator=_INTEGRATOR * w, zero=w / a, pole=w * b)
        factors = (pid, LowPass(w * c), *(Notch(*one) for one in notches.tolist()))
        return Law(factors, self._scale(numbers), self.axis.rate)

    def room(self, law: Law) -> FloatArray:
        """Return what the distance to the critical point has to spare, at each point.

        Where the plant is unknown above its lines, at the last one also what the loop gain has to
        spare below a tenth of ``1 - 1 / peak``: a mode above it may rise tenfold then.
        """
        return self.room_of(law.response(self.axis.points[0]))

    def room_of(self, gain: ComplexArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Return `room` by the response of a law (..., n) at some of the points."""
        freq, G, bound = (one[rows] for one in self.axis.points)
        room = np.abs(1.0 + gain * G) - np.abs(gain) * bound
        if self.axis.ends_early and freq[-1] == self.axis.freq[-1]:
            last = _BEYOND * (1.0 - 1.0 / self.peak) - np.abs(gain[..., -1]) * (
                np.abs(G[-1]) + bound[-1]
            )
            room[..., -1] = np.minimum(room[..., -1], 1.0 / self.peak + last)
        return np.asarray(room - 1.0 / self.peak)

    def gain(self, numbers: FloatArray, rows: IntArray | slice = slice(None)) -> ComplexArray:
        """Return the response of `law` at some of the points, without making its elements."""
        return self.response(numbers, self.s[rows])

    def response(self, numbers: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return the response of `law` at any s, by Tustin's rule where it is sampled."""
        return self._scale(numbers) * product(self.sections(numbers), s)

    def _scale(self, numbers: FloatArray) -> float:
        """Return the gain with which the loop of the rigid body crosses 1 at the bandwidth."""
        w = float(np.exp(numbers[0]))
        there = product(self.sections(numbers), tustin_s(np.array([w]), self.axis.rate))
        return float(self.axis.inertia * (2.0 * np.pi * w) ** 2 / abs(there[0]))

    def sections(self, numbers: FloatArray) -> list[Section]:
        """Return the factors of the law: PID with lead, low-pass, notches."""
        (w, a, b, c), notches = np.exp(numbers[:4]).tolist(), np.exp(numbers[4:]).reshape(-1, 3)
        slow, ab = _INTEGRATOR / b, a * b
        lead = Section((ab, 1.0 + ab * slow, slow), (1.0, 1.0, 0.0), 2.0 * np.pi * b * w)
        others = [((0.0, 0.0, 1.0), np.sqrt(2.0), c * w)]
        others += [((1.0, 2 * d * z, 1.0), 2.0 * z, f) for f, d, z in notches.tolist()]
        centred = [
            Section(above, (1.0, damped, 1.0), 2.0 * np.pi * f, 2.0 * np.pi * f).at(self.axis.rate)
            for above, damped, f in others
        ]
        return [lead, *centred]

    def slower(self, numbers: FloatArray, factor: float) -> Law:
        """Return the law with its bandwidth times a factor below 1, its notches where they are."""
        return self.law(np.append(numbers[0] + np.log(factor), numbers[1:]))

    def notes(self, numbers: FloatArray) -> list[str]:
        """Return what a user has to know of the law: its sign, and lines that ended the search."""
        name, top = self.axis.name, self.axis.ceiling
        notes = []
        if self.axis.inertia < 0.0:
            notes.append(
                f"{name}: the plant moves against its force (sign reversed), so the law has a "
                "negative gain; if that is not so on the machine, correct the sign of y or u"
            )
        if self.axis.ends_early and numbers[0] + numbers[3] >= np.log(0.98 * top):
            notes.append(
                f"{name}: not the plant but the last line ({top:.4g} Hz) ends its roll-off and "
                "with it the bandwidth: measure to higher frequencies for more"
            )
        return notes

    def limits(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the least and largest numbers, and ``rows @ numbers <= most``, near some numbers.

        Pole, low-pass and notches end at the highest corner; a notch lies above the bandwidth, or
        stays beside the mode that it is at.
        """
        top = self.axis.ceiling
        ranges = [(self.lowest, self.highest), _ZERO, _POLE, _ROLLOFF]
        rows = np.zeros((2, numbers.size))
        rows[:, 0] = rows[0, 2] = rows[1, 3] = 1.0
        most = [np.log(top), np.log(top)]
        for i in range(4, numbers.size, 3):
            centre = float(np.exp(numbers[i]))
            modes = self.axis.resonances
            near = modes[np.argmin(np.abs(np.log(modes / centre)))] if modes.size else np.inf
            if abs(np.log(near / centre)) <= np.log(_BESIDE):
                span = (near / _BESIDE, min(top, near * _BESIDE))
            else:
                span = (self.lowest, top)
                row = np.zeros((1, numbers.size))
                row[0, [0, i]] = 1.0, -1.0
                rows, most = np.vstack([rows, row]), [*most, 0.0]
            ranges += [span, _DEPTH, _WIDTH]
        low, high = np.log(ranges).T
        return low, high, rows, np.array(most)

    @cached_property
    def s(self) -> ComplexArray:
        """The s of each point, by Tustin's rule where the law is sampled."""
        return tustin_s(self.axis.points[0], self.axis.rate)
