"""The law of one axis by the logarithms of its numbers, and its distance to the critical point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...checks import ComplexArray, FloatArray, IntArray
from ...loop.report import nyquist_count
from ...lti.measured_lines import FEWEST, between_lines, hidden_modes, steps_between
from .controller_elements import LowPass, Notch, Pid
from .law import Law, Section, product, tustin_s

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
        """Return what the distance to the critical point has to spare, at each point."""
        # at the last line also what the gain has below a tenth of 1 - 1 / peak: a mode above may
        # rise tenfold
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


#: standard deviations of a line within which the response is taken to lie
_DEVIATIONS = 2.0
#: change between two lines, beside their size and in standard deviations, that is filled in
_STEP, _CLEAR = 0.15, 3.0
#: lines over which an error is averaged, to either side
_NEAR = 10
#: resonances that may be notched, how far f^2 G rises above its median within a factor of
#: frequency, and the part of a response that its error may be where a resonance is sought
_RESONANCES, _RISE, _WIDE, _KNOWN = 12, 2.0, 1.5, 0.3
#: highest corner of a law beside the rate
_CORNER = 0.45


@dataclass(frozen=True)
class MeasuredAxis:
    """One axis of a plant on lines."""

    name: str
    freq: FloatArray
    G: ComplexArray
    rate: float
    free: bool
    variance: FloatArray | None = None

    @property
    def ceiling(self) -> float:
        """The highest corner [Hz] that a law may have: 0.45 of the rate, or the last line."""
        last = float(self.freq[-1])
        return min(last, _CORNER * self.rate) if self.rate else last

    @property
    def ends_early(self) -> bool:
        """Whether the plant is unknown from the last line to half the rate."""
        return not self.rate or self.freq[-1] < _CORNER * self.rate

    @cached_property
    def deviation(self) -> FloatArray:
        """The standard deviation of each line."""
        if self.variance is not None:
            return np.asarray(np.sqrt(self.variance))
        return _scatter(self.freq, self.G)

    @cached_property
    def points(self) -> tuple[FloatArray, ComplexArray, FloatArray]:
        """Frequencies [Hz], responses and bounds on their errors: the lines, and between them."""
        # where a response changes much, it follows the circles through its neighbours
        f, G, bound = self.freq, self.G, _DEVIATIONS * self.deviation
        if f.size < 4:
            return f, G, bound
        step = np.abs(np.diff(G))
        size = np.minimum(np.abs(G[1:]), np.abs(G[:-1]))
        noise = np.maximum(self.deviation[1:], self.deviation[:-1])
        steep = np.flatnonzero((step > _STEP * size) & (step > _CLEAR * noise))
        added = steps_between(f, G, steep)
        there, apart = between_lines(f, G, added)
        place = np.searchsorted(f, added) - 1
        error = np.maximum(bound[place], bound[place + 1]) + apart
        order = np.argsort(np.concatenate([f, added]), kind="stable")
        return (
            np.concatenate([f, added])[order],
            np.concatenate([G, there])[order],
            np.concatenate([bound, error])[order],
        )

    @cached_property
    def inertia(self) -> float:
        """The inertia, with its sign, of the rigid body: ``G = 1 / (inertia s^2)``."""
        # the median over the lowest decade of lines, above the springs and well below the first
        # mode
        known = self.deviation <= _KNOWN * np.abs(self.G)
        first = float(self.resonances.min(initial=np.inf))
        above = self.freq >= 2.0 * self.suspension
        low = float(self.freq[known & above].min(initial=self.freq[-1]))
        near = known & above & (self.freq <= max(min(10.0 * low, 0.3 * first), 1.2 * low))
        turned = -self.G[near] * (2.0 * np.pi * self.freq[near]) ** 2
        sign = 1.0 if np.median(turned.real) >= 0.0 else -1.0
        return sign / float(np.median(np.abs(turned)))

    @cached_property
    def _peaks(self) -> FloatArray:
        """The frequencies [Hz] of peaks above what lies around them, the highest loop first."""
        size = np.abs(self.G) * self.freq**2
        inner = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])
        known = (self.deviation <= _KNOWN * np.abs(self.G)) & (self.freq < self.ceiling)
        peaks = 1 + np.flatnonzero(inner & known[1:-1])
        ends = [np.searchsorted(self.freq, self.freq[peaks] * way) for way in (1 / _WIDE, _WIDE)]
        around = [np.median(size[a:b]) for a, b in zip(*ends, strict=True)]
        peaks = peaks[size[peaks] > _RISE * np.array(around)]
        order = np.argsort(-size[peaks] / self.freq[peaks], kind="stable")[:_RESONANCES]
        return self.freq[peaks[order]]

    @property
    def suspension(self) -> float:
        """The frequency [Hz] of the springs that hold the body; 0 when free."""
        return 0.0 if self.free else float(self._peaks.min(initial=self.freq[-1]))

    @property
    def resonances(self) -> FloatArray:
        """The frequencies [Hz] of the elastic modes, the highest peak first."""
        return self._peaks[self._peaks > self.suspension]

    def is_stable(self, law: Law) -> bool:
        """Return whether the loop of a law is stable, by the Nyquist count."""

        def respond(freq: FloatArray) -> ComplexArray:
            return -law.response(freq)[None, None]

        if self.freq.size < FEWEST:
            return False
        plant, slope = self.G[None, None], 2 if self.free else 0
        hidden = hidden_modes(self.freq, plant, respond(self.freq))
        count = nyquist_count(
            self.freq, plant, respond, hidden, slope=slope, at_zero=slope + 1, unstable=0
        )
        return count.unstable == 0


def _scatter(freq: FloatArray, G: ComplexArray) -> FloatArray:
    """Return the standard deviation of lines by how they scatter about a smooth curve."""
    # third differences of f^2 G have 20 times the variance of an error, hardly any of a smooth
    # curve
    if freq.size < 2 * _NEAR:
        return np.zeros(freq.size)
    flat = G * freq**2
    third = np.abs(np.diff(flat, 3) / np.abs(flat[1:-2])) ** 2
    near = np.lib.stride_tricks.sliding_window_view(third, min(2 * _NEAR + 1, third.size))
    # |error|^2 is exponential: its median is log 2 times its mean
    median = np.median(near, axis=1) / (20.0 * np.log(2.0))
    places = np.clip(np.arange(freq.size) - _NEAR - 1, 0, median.size - 1)
    return np.asarray(np.sqrt(median[places]) * np.abs(G))
