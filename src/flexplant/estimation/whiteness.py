"""Tests of whether a record of vectors is white noise of unit variance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..checks import FloatArray

#: bands of lines over which the spectrum is averaged to find an excess, beside the narrowest one
_WIDTHS = (1, 8, 64)
#: lines of the spectrum at its finest
_LINES = 2000
#: lines times channels that an average needs to be within 12 % of its mean
_STEADY = 64


class Statistic(NamedTuple):
    """A statistic and the probability of a larger one (or one further off) by chance."""

    statistic: float
    p_value: float


class PooledSpectrum(NamedTuple):
    """Mean density of the channels over frequency, 1 for white noise of unit variance."""

    freq: FloatArray
    density: FloatArray
    channels: int


def level_test(squares: float, count: int) -> Statistic:
    """Return the mean square of `count` numbers of unit variance, and how unlikely it is.

    The sum is chi-square; the probability is of both tails.
    """
    from scipy.stats import chi2

    p = 2 * min(chi2.cdf(squares, count), chi2.sf(squares, count))
    return Statistic(squares / count, float(min(p, 1.0)))


def ljung_box(white: FloatArray, lags: int) -> Statistic:
    """Return the portmanteau statistic of vectors (N, p) over some lags.

    ``N^2 sum_l tr(G_l' G_0^-1 G_l G_0^-1) / (N - l)``, chi-square with p^2 lags degrees of freedom;
    [LjungBox1978]_ for one channel, [Hosking1980]_ for several. Missing rows (NaN) count as zero, N
    is the number of pairs.
    """
    from scipy.stats import chi2

    there = np.all(np.isfinite(white), axis=1)
    x = np.where(there[:, None], white, 0.0)
    count, p = int(there.sum()), x.shape[1]
    size = 2 * len(x)
    spectrum = np.fft.rfft(x, size, axis=0)
    mask = np.fft.irfft(np.abs(np.fft.rfft(there.astype(float), size)) ** 2)[: lags + 1]
    # covariances of all lags by one transform: G[l, i, j] = mean of x_i[k + l] x_j[k]
    cross = np.fft.irfft(spectrum[:, :, None] * spectrum.conj()[:, None, :], size, axis=0)
    covariance = cross[: lags + 1] / count
    root = np.linalg.inv(np.linalg.cholesky(covariance[0]))
    standard = root @ covariance[1:] @ root.T
    pairs = np.maximum(np.round(mask[1:]), 1.0)
    statistic = float(np.sum(count**2 / pairs * np.sum(standard**2, axis=(1, 2))))
    return Statistic(statistic, float(chi2.sf(statistic, p * p * lags)))


def spectrum_of(white: FloatArray) -> PooledSpectrum:
    """Return the periodogram of vectors (N, p), mean over the channels."""
    there = np.all(np.isfinite(white), axis=1)
    x = np.where(there[:, None], white, 0.0)
    power = np.abs(np.fft.rfft(x, axis=0)) ** 2 / max(int(there.sum()), 1)
    lines = slice(1, (len(x) - 1) // 2 + 1)
    return PooledSpectrum(
        np.fft.rfftfreq(len(x))[lines].astype(np.float64), power[lines].mean(axis=1), x.shape[1]
    )


def cumulative_periodogram(found: PooledSpectrum) -> Statistic:
    """Return the largest distance of the cumulative periodogram from a straight line.

    Bartlett's test; the distance times (m p)^(1/2), m lines of p channels, has Kolmogorov's
    distribution for white noise of any level.
    """
    from scipy.stats import kstwobign

    total = np.cumsum(found.density)
    line = np.arange(1, total.size + 1) / total.size
    distance = float(np.max(np.abs(total / total[-1] - line)))
    statistic = distance * np.sqrt(found.density.size * found.channels)
    return Statistic(distance, float(kstwobign.sf(statistic)))


class ExcessPeak(NamedTuple):
    """Where a spectrum is above its mean."""

    freq: float
    height: float
    p_value: float


def peaks(found: PooledSpectrum, alpha: float) -> list[ExcessPeak]:
    """Return where the spectrum exceeds its mean, the most significant ones first.

    Averages over b lines of p channels are chi-square with 2 b p degrees of freedom; each of the
    bands of three widths is tested at alpha over their number (Bonferroni). Bands that touch are
    one peak.
    """
    from scipy.stats import chi2

    density = found.density / found.density.mean()
    first = max(1, density.size // _LINES)
    widths = [w * first for w in _WIDTHS if w * first <= density.size // 4] or [1]
    total = sum(density.size // w for w in widths)
    marked = np.zeros(density.size, dtype=bool)
    chance = np.ones(density.size)
    for width in widths:
        count = density.size // width
        means = density[: count * width].reshape(count, width).mean(axis=1)
        freedom = 2 * width * found.channels
        p = np.minimum(chi2.sf(means * freedom, freedom) * total, 1.0)
        for band in np.flatnonzero(p < alpha):
            part = slice(band * width, (band + 1) * width)
            marked[part] = True
            chance[part] = np.minimum(chance[part], p[band])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(int)))
    # wide enough that the height is not chance
    lines = max(2 * first + 1, -(-_STEADY // found.channels))
    smooth = np.convolve(density, np.ones(lines) / lines, "same")
    listed = []
    for start, end in edges.reshape(-1, 2):
        at = start + int(np.argmax(smooth[start:end]))
        listed.append(
            ExcessPeak(float(found.freq[at]), float(smooth[at]), float(chance[start:end].min()))
        )
    return sorted(listed, key=lambda one: (one.p_value, -one.height))
