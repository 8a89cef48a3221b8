"""Whether an FRF that was estimated directly, without a reference, was measured under feedback."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray
from ..errors import warn
from ..lti.frequency import Frf
from ..tolerances import TINY

#: samples next to zero lag where delays between channels and the taper act
GUARD = 8
#: share of the segment's lags that is used: beyond, what rings longer than it folds back
LOOKED = 0.25
#: lines over which power is averaged: at a quarter of the lags some ten are independent
STRETCH = 41
#: share of the band above which the taper leaves rounding
HIGHEST = 0.7
#: power over that of noise there: chi-square of 20 degrees of freedom passes 4 once in 10^8
SEEN = 16.0
#: share of the response below which it is leakage of the window or the channels' filters
LEAST = 0.05


@dataclass(frozen=True)
class Feedback:
    """Where [Hz] an FRF responds before its input acts, and by which share of the response."""

    freq: float
    share: float
    deviations: float


def feedback_bias(frf: Frf) -> Feedback | None:
    r"""Return where an FRF is most biased by feedback, None where nothing shows it.

    With ``u = r - K y`` and noise v on y the direct estimate tends to

    .. math:: S_{yu} S_{uu}^{-1} = \frac{G S_{rr} - K^* S_{vv}}{S_{rr} + |K|^2 S_{vv}}

    whose K^* acts before its input: an impulse response at negative times, which no machine has
    ([PintelonSchoukens2012]_, section 2.6.4).
    Noise that returns through a set-point's controller alone, ``u = K (r - y)``, biases by 1/K,
    which is causal: no record of u and y shows that. The response is taken from lines with s^2
    and a taper, so that neither rigid-body modes nor the end of the band spread over all lags,
    and compared with what the variance makes there. Hann-windowed segments only: others fold
    what rings on at the end of a segment to these times.
    """
    n = frf.freq.size
    if frf.window != "hann" or frf.variance is None or frf.resolution is None or n < 4 * STRETCH:
        return None
    lines = np.arange(1, n + 1)
    if not np.allclose(frf.freq, lines * frf.resolution):
        return None
    weight = (lines / n) ** (0.0 if frf.quantity == "acceleration" else 2.0) * _taper(lines / n)
    size = 2 * (n + 1)
    lag = np.arange(size)
    early = size - lag  # samples before the input
    end = LOOKED * size
    window = np.where((early > GUARD) & (early < end), np.cos(0.5 * np.pi * early / end) ** 2, 0.0)
    spectrum = np.zeros((*frf.data.shape[:2], n + 2), dtype=np.complex128)
    spectrum[..., 1:-1] = frf.data * weight
    power = np.zeros(spectrum.shape)
    power[..., 1:-1] = frf.variance * weight**2
    seen = np.abs(np.fft.rfft(np.fft.irfft(spectrum, size) * window)) ** 2
    # independent lines: their power is spread by that of the window's spectrum
    spread = np.abs(np.fft.fft(window) / size) ** 2
    both = np.concatenate([power, power[..., -2:0:-1]], axis=-1)
    noise = np.fft.irfft(np.fft.rfft(both) * np.fft.rfft(spread), size)[..., : n + 2]
    seen, noise, whole = (_moving_mean(x) for x in (seen, noise, np.abs(spectrum) ** 2))
    ratio = seen / np.maximum(noise, TINY)
    share = np.sqrt(seen / np.maximum(whole, TINY))
    score: Any = np.where((ratio > SEEN) & (share > LEAST), ratio, 0.0)[..., 1:-1]
    score[..., :STRETCH] = score[..., round(HIGHEST * n) :] = 0.0
    if not score.any():
        return None
    o, i, f = np.unravel_index(int(np.argmax(score)), score.shape)
    return Feedback(
        float(frf.freq[f]), float(share[o, i, f + 1]), float(np.sqrt(ratio[o, i, f + 1]))
    )


def _taper(x: FloatArray) -> FloatArray:
    """Return 1 at zero and 0 at one, with an impulse response that dies within a few samples."""
    from scipy.signal.windows import kaiser

    both = kaiser(2049, 12.0)
    return np.asarray(np.interp(x, np.linspace(0.0, 1.0, 1025), both[1024:]))


def _moving_mean(power: FloatArray) -> FloatArray:
    import scipy.ndimage as ndi

    return np.asarray(ndi.uniform_filter1d(power, STRETCH, axis=-1, mode="nearest"))


def feedback_warned(found: Feedback | None) -> None:
    """Warn of an estimate that feedback biases."""
    if found is None:
        return
    warn(
        f"the records were made in closed loop: near {found.freq:.4g} Hz {found.share:.1%} of the "
        f"response, {found.deviations:.2g} times its noise, come before the input acts, which "
        "noise that returns through a controller does. The direct estimate S_yu/S_uu is biased "
        "there towards -1/K, by at least this share, and poles with it. Record the excitation or "
        "set-point and pass reference=, or use whole periods, identification.Periodic(...)."
    )
