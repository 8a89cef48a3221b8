"""Which lines count how much: from the variance of a measurement, or from what a fit left over."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..checks import ComplexArray, FloatArray, instance, real_array
from ..errors import ModelError
from ..lti.frequency import Frf

#: lines over which what a fit leaves is averaged to a variance
WINDOW = 41


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

    @property
    def side(self) -> str:
        """What the first axis is."""
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
        """By how much the variance of a mean over many lines exceeds that of independent ones."""
        if self.line_correlation is None:
            return 1.0
        return float(np.median(self.line_correlation.sum(axis=1)))

    def spread(self, a: int, b: int, rows: ComplexArray) -> ComplexArray | None:
        """Return the correlation of the errors of rows a and b times `rows` (n_in, n_freq, k).

        None where the two are independent.
        """
        C, R = self.correlation, self.line_correlation
        if a != b and (C is None or self.swapped):
            return None
        if R is not None:
            flat = np.moveaxis(rows, 1, 0)
            spread: Any = (R @ flat.reshape(flat.shape[0], -1)).reshape(flat.shape)
            rows = np.moveaxis(spread, 0, 1)
        if C is not None and self.swapped:
            return np.asarray(np.einsum("abf,bfq->afq", C, rows))
        return rows if C is None else np.asarray(C[a, b][None, :, None] * rows)

    @property
    def line_weight(self) -> FloatArray:
        """Weights (n_out, n_freq) of whole rows, as a matrix fraction needs them."""
        mean = 1.0 / np.sqrt(np.mean(self.weight**-2.0, axis=1))
        return np.asarray(mean / mean.max())

    def from_errors(self, power: FloatArray, fitted_share: float) -> PreparedLines:
        """Return the same with weights from the squared errors of a rough fit."""
        # at sharp peaks such a fit leaves more than noise; the median does not see them
        import scipy.ndimage as ndi

        power = ndi.median_filter(power, (1, 1, WINDOW), mode="nearest") / np.log(2.0)
        return self._weighted(power, fitted_share)

    def from_residuals(self, error: ComplexArray, fitted_share: float) -> PreparedLines:
        """Return the same with weights from what a fit left, averaged over lines."""
        import scipy.ndimage as ndi

        power = ndi.uniform_filter1d(np.abs(error) ** 2, WINDOW, axis=2, mode="nearest")
        return self._weighted(power, fitted_share)

    def _weighted(self, power: FloatArray, fitted_share: float) -> PreparedLines:
        # 1e-13 of an amplitude: data without noise have no other error than rounding
        floor = 1e-26 * np.mean(np.abs(self.data) ** 2, axis=2, keepdims=True)
        variance = np.maximum(power / (1.0 - fitted_share), floor)
        return replace(self, weight=np.sqrt(2.0 / variance))


def prepared(frf: Any, band: Any) -> PreparedLines:
    """Return what is fitted of an FRF, checked."""
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
        # relative errors above the median response, absolute ones below: a start, no more
        variance = 1e-4 * (power + np.median(power[power > 0]) * 1e-2)
    weight = np.sqrt(2.0 / variance) / np.abs(factor)
    data = data * factor
    correlation = None if frf.correlation is None else frf.correlation[:, :, inside]
    lines = frf.line_correlation()
    if lines is not None:
        lines = lines[inside][:, inside]
    ready = PreparedLines(freq, data, weight, correlation, known, False, lines)
    return ready.turned if data.shape[0] < data.shape[1] else ready


def checked_band(band: Any, freq: FloatArray) -> tuple[float, float]:
    """Return (low, high) [Hz]; all of the measurement when None."""
    if not freq.size:
        raise ModelError("the Frf has no frequencies.")
    if band is None:
        return float(freq[0]), float(freq[-1])
    low, high = real_array(band, "band", (2,)).tolist()
    if not 0 <= low < high or high < freq[0] or low > freq[-1]:
        raise ModelError(
            f"band must be (low, high) in Hz within {freq[0]:g} .. {freq[-1]:g}, got "
            f"({low:g}, {high:g})."
        )
    return low, high
