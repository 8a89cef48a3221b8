"""Weights of lines, from the variance of a measurement or from the residual of a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import BoolArray, ComplexArray, FloatArray, frequency_band
from ..errors import ModelError
from ..lti.frequency import Frf
from ..tolerances import CHANCE, RANK
from ..words import instance
from .frf_estimation import STRETCH

#: frequencies [Hz] of mains
MAINS = (50.0, 60.0)
#: width of a resonance in lines below which it looks like a disturbance with a single frequency
NARROW = 0.5
#: number of lines around a peak, or from zero, within which others belong to it
NEAR = 20
#: number of lines over which windows spread a mains multiple, and of lines for the comparison
SPREAD, COMPARED = 2, 8

#: frequency [Hz], damping ratio and the reason why a pole, or a line, is not reported
Rejected = tuple[float, float, str]


@dataclass(frozen=True, eq=False)
class PreparedLines:
    """Displacement responses of the band, the smaller side as references (second axis)."""

    freq: FloatArray
    data: ComplexArray
    weight: FloatArray
    correlation: ComplexArray | None
    known: bool  # whether the weights come from a variance
    swapped: bool
    line_correlation: sp.csr_array | None = None  # of errors of different lines
    mains: tuple[Rejected, ...] = ()  # mains whose lines are left out

    @cached_property
    def spacing(self) -> float:
        """Usual distance [Hz] of neighbouring lines."""
        return float(np.median(np.diff(self.freq)))

    @property
    def side(self) -> str:
        """Name of the first axis."""
        return "inputs" if self.swapped else "outputs"

    @property
    def turned(self) -> PreparedLines:
        """The same with inputs and outputs exchanged."""
        data, weight = self.data.transpose(1, 0, 2), self.weight.transpose(1, 0, 2)
        return replace(self, data=data, weight=weight, swapped=not self.swapped)

    @property
    def independent(self) -> bool:
        """Whether errors of different entries are independent."""
        return self.line_correlation is None and (
            self.correlation is None or self.data.shape[0] == 1
        )

    @property
    def inflation(self) -> float:
        """Ratio of the variance of a mean over many lines to that of independent lines."""
        if self.line_correlation is None:
            return 1.0
        return float(np.median(self.line_correlation.sum(axis=1)))

    def advanced(self, time: float) -> PreparedLines:
        """Return the lines of responses that come earlier by a time [s]."""
        return replace(self, data=self.data * np.exp(2j * np.pi * self.freq * time))

    def correlated(self, a: int, b: int) -> Any:
        """Return the correlation of the errors of rows a and b at each line, None where it is 0."""
        if self.correlation is None or self.swapped:
            return 1.0 if a == b else None
        return self.correlation[a, b][None, :, None]

    def spread(self, rows: ComplexArray) -> ComplexArray:
        """Return the correlation of the errors within a row times `rows` (n_in, n_freq, k)."""
        C, R = self.correlation, self.line_correlation
        if R is not None:
            flat = np.moveaxis(rows, 1, 0)
            spread: Any = (R @ flat.reshape(flat.shape[0], -1)).reshape(flat.shape)
            rows = np.moveaxis(spread, 0, 1)
        if C is not None and self.swapped:
            return np.asarray(np.einsum("abf,bfq->afq", C, rows))
        return rows

    @property
    def line_weight(self) -> FloatArray:
        """Weights (n_out, n_freq) of whole rows, as a matrix fraction needs them."""
        mean = 1.0 / np.sqrt(np.mean(1.0 / self.weight**2, axis=1))
        return np.asarray(mean / mean.max())

    def over_runs(self, count: int) -> PreparedLines:
        """Return the mean of `count` runs that are stacked along the first axis."""
        data = np.mean(self.data.reshape(count, -1, *self.data.shape[1:]), axis=0)
        power = np.sum(self.weight.reshape(count, *data.shape) ** -2.0, axis=0)
        C, n = self.correlation, len(data)
        if C is not None:
            C = np.mean([C[k : k + n, k : k + n] for k in range(0, len(C), n)], axis=0)
        return replace(self, data=data, weight=count / np.sqrt(power), correlation=C)

    def from_errors(self, power: FloatArray, fitted_share: float) -> PreparedLines:
        """Return the same with weights from the squared errors of a rough fit."""
        # at sharp peaks the residual of such a fit exceeds the noise; the median ignores them
        import scipy.ndimage as ndi

        # all rows as one: SciPy is five times as fast with one axis
        beyond = STRETCH // 2
        rows = np.pad(power, ((0, 0), (0, 0), (beyond, beyond)), mode="edge")
        median = ndi.median_filter(rows.ravel(), STRETCH).reshape(rows.shape)
        return self._weighted(median[..., beyond:-beyond] / np.log(2.0), fitted_share)

    def from_residuals(self, error: ComplexArray, fitted_share: float) -> PreparedLines:
        """Return the same with weights from the residual of a fit, averaged over lines."""
        import scipy.ndimage as ndi

        power = np.maximum(np.abs(error) ** 2, self._rounding())
        # the noise of an acceleration, as a displacement, falls by decades over a stretch near
        # zero: its ratio to the power of frequency that fits it best is averaged
        x = np.log(self.freq) - np.mean(np.log(self.freq))
        trend = np.exp((np.log(power) @ x)[..., None] / (x @ x) * x)
        mean = ndi.uniform_filter1d(power / trend, STRETCH, axis=2, mode="mirror")
        return self._weighted(trend * mean, fitted_share)

    def _rounding(self) -> FloatArray:
        # data without noise only have rounding errors
        return np.asarray(RANK**2 * np.mean(np.abs(self.data) ** 2, axis=2, keepdims=True))

    def _weighted(self, power: FloatArray, fitted_share: float) -> PreparedLines:
        variance = np.maximum(power / (1.0 - fitted_share), self._rounding())
        return replace(self, weight=np.sqrt(2.0 / variance))


def prepared_lines(frf: Any, band: Any) -> PreparedLines:
    """Return the checked data of an FRF for a fit."""
    instance(frf, Frf, "frf", "Pass estimate_frf(...) of records, or Frf(freq, data).")
    low, high = checked_band(band, frf.freq)
    inside = (frf.freq >= low) & (frf.freq <= high) & (frf.freq > 0)
    if np.sum(inside) < 20:
        raise ModelError(
            f"only {int(np.sum(inside))} lines lie in the band {low:g} .. {high:g} Hz: at least 20 "
            "are needed, and several per resonance. Widen the band or measure longer."
        )
    freq, data = frf.freq[inside], frf.data[:, :, inside]
    order = {"velocity": 1, "acceleration": 2}.get(frf.quantity or "", 0)
    factor = (2j * np.pi * freq) ** -float(order)
    known = frf.variance is not None
    if frf.variance is not None:
        variance = frf.variance[:, :, inside]
        if np.any(variance <= 0):
            raise ModelError(
                "the FRF's variance is zero at some lines, which would count infinitely: leave "
                "them out, or drop the variance with frf.replace(variance=None)."
            )
    else:
        power = np.abs(data) ** 2
        if not np.all(np.any(power, axis=2)):
            raise ModelError("a channel of the FRF is zero at all lines: leave it out.")
        # start weights: relative errors above the median response, absolute ones below
        variance = 1e-4 * (power + np.median(power[power > 0]) * 1e-2)
    weight = np.sqrt(2.0 / variance) / np.abs(factor)
    data = data * factor
    correlation = None if frf.correlation is None else frf.correlation[:, :, inside]
    lines = frf.line_correlation()
    if lines is not None:
        lines = lines[inside][:, inside]
    ready = PreparedLines(freq, data, weight, correlation, known, False, lines)
    ready = without_mains(ready, frf.window is not None)
    return ready.turned if data.shape[0] < data.shape[1] else ready


def mains_multiple(freq: float, spacing: float) -> str | None:
    """Return the multiple of mains within half a line of a frequency, or None."""
    for mains in MAINS:
        number = round(freq / mains)
        if number and abs(freq - number * mains) < spacing / 2:
            return f"a mains multiple, {number} x {mains:g} Hz, narrower than half a line"
    return None


def without_mains(ready: PreparedLines, tapered: bool) -> PreparedLines:
    """Return the same without lines at which some responses contain mains, spread by windows."""
    freq, spacing, keep = ready.freq, ready.spacing, np.ones(ready.freq.size, dtype=bool)
    at = {
        int(np.argmin(np.abs(freq - n * f))) for f in MAINS for n in range(1, int(freq[-1] / f) + 2)
    }
    found = []
    for k in sorted(at):
        reason = mains_multiple(float(freq[k]), spacing)
        seen = slice(k - COMPARED, k + COMPARED + 1)
        if reason is None or seen.start < 0 or seen.stop > freq.size:
            continue
        d = (freq[seen] - freq[k]) / spacing
        lines = _disturbed(ready.data[..., seen], d, CHANCE / len(at), tapered)
        if np.any(lines):
            keep[seen] &= ~lines
            found.append((float(freq[k]), 0.0, reason))
    if not found:
        return ready
    C, R = ready.correlation, ready.line_correlation
    return replace(
        ready,
        freq=freq[keep],
        data=ready.data[..., keep],
        weight=ready.weight[..., keep],
        correlation=None if C is None else C[..., keep],
        line_correlation=None if R is None else R[keep][:, keep],
        mains=tuple(found),
    )


def _disturbed(data: ComplexArray, d: FloatArray, chance: float, tapered: bool) -> BoolArray:
    """Return which of some lines hold a disturbance of the frequency in their middle."""
    # the neighbouring lines are fitted by `(1 + g d) H = a + b d + c d^2 + r/d`, d the distance in
    # lines, g of a resonance nearby: one of half-width w in the middle has the height `|r|/w`, a
    # disturbance no r; through a Hann window it has side lobes of `1/(\pi d^3)` of its height
    middle = d.size // 2
    near = np.abs(np.arange(d.size) - middle) <= SPREAD
    aside, rows = d[~near], data.reshape(-1, d.size)
    smooth = d[:, None] ** np.arange(3)
    # all rows share the columns of a, b, c and r; that of g, without its part in them, is their own
    known = np.column_stack([smooth[~near], 1.0 / aside])
    inverse = np.linalg.pinv(known)
    past, y = np.eye(aside.size) - known @ inverse, rows[:, ~near]
    x = -aside * y
    own, due = x @ past, y @ past
    power = np.sum(np.abs(own) ** 2, axis=1)
    seen = power > RANK**2 * np.sum(np.abs(x) ** 2, axis=1)
    power = np.where(seen, 1.0 / np.where(seen, power, 1.0), 0.0)[:, None]
    g = power * np.sum(own.conj() * due, axis=1, keepdims=True)
    c, taken = (y - g * x) @ inverse.T, x @ inverse.T
    free = aside.size - known.shape[1] - 1
    noise = np.linalg.norm(due - g * own, axis=1) / np.sqrt(free)
    deviation = noise[:, None] * np.sqrt(np.sum(inverse**2, axis=1) + power * np.abs(taken) ** 2)
    # with `free` complex degrees of freedom |e|^2 exceeds x with probability (1 + x/free)^-free
    least = np.sqrt(free * np.expm1(-np.log(chance / len(rows)) / free))
    off = np.abs(rows - c[:, :3] @ smooth.T / (1.0 + g * d))
    height = least * np.hypot(noise, deviation[:, 0])
    skirt = np.abs(c[:, 3]) + 2.0 * deviation[:, 3]
    holds = off[:, middle] > np.maximum(height, skirt / (NARROW / 2))
    lines = near & (off > height[:, None])
    if tapered:
        lines |= np.pi * np.abs(d) ** 3 * noise[:, None] < off[:, [middle]]
    return np.asarray(np.any(lines[holds], axis=0))


def checked_band(band: Any, freq: FloatArray) -> tuple[float, float]:
    """Return (low, high) [Hz]; all of the measurement when None."""
    if not freq.size:
        raise ModelError("the Frf has no frequencies.")
    if band is None:
        return float(freq[0]), float(freq[-1])
    return frequency_band(band, "band", float(freq[0]), float(freq[-1]))
