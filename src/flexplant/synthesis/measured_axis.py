"""One axis as it was measured: its lines, what lies between them, and how well they are known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..loop.hidden_modes import FEWEST, hidden_modes
from ..loop.nyquist import nyquist_count
from ..lti.between_lines import between_lines, steps_between
from ..values import ComplexArray, FloatArray
from .law import Law

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
        """Frequencies [Hz], responses and bounds on their errors: the lines, and between them.

        Where a response changes much between two lines, more than their errors, it follows the
        circle through its neighbours; what two such circles differ by adds to the bound.
        """
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
        """The inertia, with its sign, of the rigid body: ``G = 1 / (inertia s^2)``.

        The median over the lowest decade of lines, above the springs and well below the first mode.
        """
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
    """Return the standard deviation of lines by how they scatter about a smooth curve.

    Third differences of ``f^2 G`` have 20 times the variance of an error that differs from line to
    line, and hardly anything of a smooth response; their median over neighbours leaves resonances
    out.
    """
    if freq.size < 2 * _NEAR:
        return np.zeros(freq.size)
    flat = G * freq**2
    third = np.abs(np.diff(flat, 3) / np.abs(flat[1:-2])) ** 2
    near = np.lib.stride_tricks.sliding_window_view(third, min(2 * _NEAR + 1, third.size))
    # |error|^2 is exponential: its median is log 2 times its mean
    median = np.median(near, axis=1) / (20.0 * np.log(2.0))
    places = np.clip(np.arange(freq.size) - _NEAR - 1, 0, median.size - 1)
    return np.asarray(np.sqrt(median[places]) * np.abs(G))
