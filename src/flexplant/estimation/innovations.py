"""The spectrum of whitened innovations, and tests of whether they are white noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..lti.frequency import frequency_response
from ..lti.statespace import StateSpace
from ..parallel import PIECE
from ..plant import AnyPlant
from .estimator import KalmanEstimator
from .filter_models import innovation_root

#: bands of lines, relative to the narrowest one, over which the spectrum is averaged to find an
#: excess
_WIDTHS = (1, 8, 64)
#: lines of the spectrum at its finest
_LINES = 2000
#: number of lines times channels for an average within 12 % of its mean
_STEADY = 64


class Statistic(NamedTuple):
    """A statistic and its p-value."""

    statistic: float
    p_value: float


class PooledSpectrum(NamedTuple):
    """Mean density of the channels over frequency, 1 for white noise of unit variance."""

    freq: FloatArray
    density: FloatArray
    channels: int


def level_test(squares: float, count: int) -> Statistic:
    """Return the mean square of `count` numbers of unit variance, and its p-value."""
    # the sum is chi-square; the probability is of both tails
    from scipy.stats import chi2

    p = 2 * min(chi2.cdf(squares, count), chi2.sf(squares, count))
    return Statistic(squares / count, float(min(p, 1.0)))


def ljung_box(white: FloatArray, lags: int) -> Statistic:
    """Return the portmanteau statistic of vectors (N, p) over some lags."""
    # `N^2 sum_l tr(G_l' G_0^-1 G_l G_0^-1) / (N - l)`, chi-square with p^2 lags degrees of freedom;
    # [LjungBox1978]_ for one channel, [Hosking1980]_ for several. Missing rows (NaN) count as zero,
    # N is the number of pairs
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


def cumulative_periodogram(found: PooledSpectrum) -> Statistic:
    """Return the largest distance of the cumulative periodogram from a straight line."""
    # Bartlett's test; the distance times (m p)^(1/2), m lines of p channels, has Kolmogorov's
    # distribution for white noise of any level
    from scipy.stats import kstwobign

    total = np.cumsum(found.density)
    line = np.arange(1, total.size + 1) / total.size
    distance = float(np.max(np.abs(total / total[-1] - line)))
    statistic = distance * np.sqrt(found.density.size * found.channels)
    return Statistic(distance, float(kstwobign.sf(statistic)))


class ExcessPeak(NamedTuple):
    """A peak of a spectrum above its mean."""

    freq: float
    height: float
    p_value: float


def excess_peaks(found: PooledSpectrum, alpha: float) -> list[ExcessPeak]:
    """Return the peaks of the spectrum above its mean, the most significant first."""
    # Averages over b lines of p channels are chi-square with 2 b p degrees of freedom; each of the
    # bands of three widths is tested at alpha over their number (Bonferroni). Bands that touch are
    # one peak
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
    # wide enough for a significant height
    lines = max(2 * first + 1, -(-_STEADY // found.channels))
    smooth = np.convolve(density, np.ones(lines) / lines, "same")
    listed = []
    for start, end in edges.reshape(-1, 2):
        at = start + int(np.argmax(smooth[start:end]))
        listed.append(
            ExcessPeak(float(found.freq[at]), float(smooth[at]), float(chance[start:end].min()))
        )
    return sorted(listed, key=lambda one: (one.p_value, -one.height))


class InnovationLines(NamedTuple):
    """Fourier transform X (m, p) of whitened innovations at lines [cycles per sample]."""

    freq: FloatArray
    X: ComplexArray
    samples: int

    @property
    def pooled(self) -> PooledSpectrum:
        """The periodogram, mean over the channels."""
        return PooledSpectrum(self.freq, np.mean(np.abs(self.X) ** 2, axis=1), self.X.shape[1])

    def relative_to(self, S: ComplexArray) -> PooledSpectrum:
        """Return ``X* S^-1 X / p``: 1 on average if the innovations have the density S."""
        solved = np.linalg.solve(S, self.X[:, :, None])[:, :, 0]
        density = np.sum(self.X.conj() * solved, axis=1).real / self.X.shape[1]
        return PooledSpectrum(self.freq, density, self.X.shape[1])


class InnovationParts(NamedTuple):
    """Density (m, p, p) of whitened innovations: by disturbances, and by the sensors' noise."""

    process: ComplexArray
    sensors: ComplexArray

    @property
    def both(self) -> ComplexArray:
        """Their sum."""
        return self.process + self.sensors

    @property
    def pooled(self) -> FloatArray:
        """Mean over the channels, (2, m)."""
        means = [np.mean(np.diagonal(part, axis1=1, axis2=2).real, axis=1) for part in self]
        return np.asarray(np.stack(means))


def lines_of(white: FloatArray) -> InnovationLines:
    """Return the lines of vectors (N, p) without 0 and the Nyquist frequency; missing are zero."""
    there = np.all(np.isfinite(white), axis=1)
    x = np.where(there[:, None], white, 0.0)
    at = slice(1, (len(x) - 1) // 2 + 1)
    X = np.fft.rfft(x, axis=0)[at] / np.sqrt(max(int(there.sum()), 1))
    return InnovationLines(np.fft.rfftfreq(len(x))[at].astype(np.float64), X, len(x))


def seen_from_states(
    A: FloatArray, C: FloatArray, freq: FloatArray, blocks: Sequence[int] | None = None
) -> ComplexArray:
    """Return ``C (z I - A)^-1`` (m, p, n) at frequencies [cycles per sample]."""
    # of the transposed system, which has the fewer inputs, from its last state to its first: upper
    # triangular in the same blocks
    n, p = C.shape[1], C.shape[0]
    back = None if blocks is None else tuple(blocks)[::-1]
    parts = A.T[::-1, ::-1], C.T[::-1], np.eye(n)[::-1], np.zeros((n, p))
    turned = StateSpace(*parts, 1.0, blocks=back)
    return np.asarray(frequency_response(turned, freq).data.transpose(2, 1, 0))


def whitening(observer: KalmanEstimator, freq: FloatArray) -> ComplexArray:
    """Return ``W (I - C (z I - A + K C)^-1 K)`` (m, p, p): from y to the whitened innovations."""
    m, K = observer.model, observer.predictor_gain
    back = np.eye(K.shape[1]) - seen_from_states(m.A - K @ m.C2, m.C2, freq) @ K
    return np.asarray(np.linalg.solve(_cholesky(observer), back))


def steady_gain(observer: KalmanEstimator) -> FloatArray:
    """Return the whitened innovations (p, p) due to constant offsets of the sensors."""
    m, K = observer.model, observer.predictor_gain
    moved = np.linalg.solve(np.eye(len(m.A)) - m.A + K @ m.C2, K)
    return np.asarray(np.linalg.solve(_cholesky(observer), np.eye(K.shape[1]) - m.C2 @ moved))


def impulse(observer: KalmanEstimator, count: int) -> FloatArray:
    """Return the whitened innovations (count, p, p) after a unit error of one sample."""
    m, K = observer.model, observer.predictor_gain
    closed, x = m.A - K @ m.C2, K
    found = np.empty((count, K.shape[1], K.shape[1]))
    found[0] = np.eye(K.shape[1])
    for k in range(1, count):
        found[k], x = -m.C2 @ x, closed @ x
    return np.asarray(np.linalg.solve(_cholesky(observer), found))


def density_of(
    observer: KalmanEstimator,
    plant: AnyPlant | None,
    freq: FloatArray,
    white: ComplexArray | None = None,
) -> InnovationParts:
    """Return the density of the whitened innovations of a filter that runs on a plant."""
    # `V (Y Y* + R) V*` with V that of `whitening`, `Y = C (z I - A)^-1 G + H` from the noises of
    # the plant to its sensors and R the sensors' own. None: on the filter's model, where truncated
    # modes are white noise of the sensors and the sum of both parts is I. `white`: V, if known
    p = len(observer.sensors)
    process = np.empty((freq.size, p, p), dtype=np.complex128)
    sensors = np.empty_like(process)
    for start in range(0, freq.size, PIECE):
        at = slice(start, start + PIECE)
        V = whitening(observer, freq[at]) if white is None else white[at]
        if plant is None:
            sensors[at] = squared(V @ np.linalg.cholesky(observer.model.R))
            process[at] = np.eye(p) - sensors[at]
            continue
        rows = [plant.y.index(name) for name in observer.sensors]
        g = plant.system
        C = g.C[g.output_index(observer.sensors)]
        Y = seen_from_states(g.A, C, freq[at], g.blocks) @ plant.noise_factor
        process[at] = squared(V @ (Y + plant.noise_direct[rows]))
        sensors[at] = squared(V @ plant.sensor_noise_factor[rows])
    return InnovationParts(process, sensors)


def expected(observer: KalmanEstimator, plant: AnyPlant, samples: int) -> InnovationParts:
    """Return the mean of the periodogram of a number of samples, at the lines of `lines_of`."""
    # the density seen through the record's length (Fejer's kernel): its covariance c_l counts
    # `1 - |l| / N`. A line narrower than 1 / N leaks into its neighbours in just this way
    freq = np.arange(1, samples + 1) / (2.0 * samples)
    lag = np.minimum(np.arange(2 * samples), 2 * samples - np.arange(2 * samples))
    weight = (1.0 - lag / samples)[:, None, None]
    at = slice(2, 2 * ((samples - 1) // 2) + 1, 2)

    def seen(density: ComplexArray) -> ComplexArray:
        whole = np.concatenate([density[:1].real, density])
        covariance = np.fft.irfft(whole, 2 * samples, axis=0)
        return np.asarray(np.fft.rfft(covariance * weight, axis=0)[at])

    found = density_of(observer, plant, freq)
    return InnovationParts(seen(found.process), seen(found.sensors))


def _cholesky(observer: KalmanEstimator) -> FloatArray:
    return innovation_root(observer.model.innovation(observer.predicted_covariance))


def squared(part: ComplexArray) -> ComplexArray:
    """Return ``T T*`` of matrices T (m, p, r)."""
    return np.asarray(part @ np.conj(np.swapaxes(part, 1, 2)))
