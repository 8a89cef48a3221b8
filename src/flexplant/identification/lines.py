"""Lines of a measurement: their weights, and the terms that a fit of them has."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import BoolArray, ComplexArray, FloatArray, IntArray, frequency_band, instance
from ..errors import ModelError
from ..lti.frequency import Frf
from ..parallel import so_far
from ..tolerances import CHANCE, RANK, TINY
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
    data: ComplexArray  # (n_out, n_in, n_freq)
    weight: FloatArray  # the same shape: sqrt(2)/standard deviation
    correlation: ComplexArray | None = None
    known: bool = True  # whether the weights come from a variance
    side: str = "outputs"  # name of the first axis
    line_correlation: sp.csr_array | None = None  # of errors of different lines
    mains: tuple[Rejected, ...] = ()  # mains whose lines are left out

    @cached_property
    def spacing(self) -> float:
        """Usual distance [Hz] of neighbouring lines."""
        return float(np.median(np.diff(self.freq)))

    @property
    def swapped(self) -> bool:
        """Whether the first axis is that of the inputs."""
        return self.side == "inputs"

    @property
    def turned(self) -> PreparedLines:
        """The same with inputs and outputs exchanged."""
        data, weight = self.data.transpose(1, 0, 2), self.weight.transpose(1, 0, 2)
        side = "outputs" if self.swapped else "inputs"
        return replace(self, data=data, weight=weight, side=side)

    @property
    def independent(self) -> bool:
        """Whether errors of different entries are independent."""
        return self.line_correlation is None and (
            self.correlation is None or self.data.shape[0] == 1
        )

    @cached_property
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
    ready = PreparedLines(freq, data, weight, correlation, known, line_correlation=lines)
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


#: |(s - lambda) T| below which the integral for a windowed pole is a sum over Gauss points, because
#: the closed form loses digits there; and number of points, which is exact to rounding
CLOSE, GAUSS_POINTS = 8.0, 24


def hann_ratio(gap: ComplexArray, segment: float) -> tuple[ComplexArray, ComplexArray]:
    r"""Return R and dR/dq: a window changes the term ``1/q`` to ``R/q``, q = s - lambda.

    For an input that is white over a few lines, averages of windowed segments estimate a response
    whose impulse response is multiplied by the autocorrelation of the window (a lag window):

    .. math:: R = q \int_0^T \rho(\tau) e^{-q \tau} d\tau, \quad
        \rho(\tau) = \left(1 - \frac{\tau}{T}\right)
        \left(\frac{2}{3} + \frac{1}{3} \cos\frac{2 \pi \tau}{T}\right)
        + \frac{1}{2 \pi} \sin\frac{2 \pi \tau}{T}

    ([BendatPiersol2010]_, sections 11.5 and 11.6, for Hann windows); 1 far from the pole, where,
    with x = q T and P = x^2 + 4 pi^2, it is

    .. math:: R = 1 - \frac{4 \pi^2}{3 P} - \frac{32 \pi^4}{3}\,\frac{1 - e^{-x}}{x P^2}
    """
    x, near = gap * segment, np.abs(gap) * segment < CLOSE
    x[near] = CLOSE
    square, fourth = 4.0 * np.pi**2 / 3.0, 32.0 * np.pi**4 / 3.0
    a, b, decay = 1.0 / x, 1.0 / (x**2 + 4.0 * np.pi**2), np.exp(-x)
    bend = fourth * a * b**2
    lost = bend * (1.0 - decay)
    ratio = 1.0 - square * b - lost
    slope = 2.0 * square * x * b**2 + lost * (a + 4.0 * x * b) - bend * decay
    if np.any(near):
        x = gap[near] * segment
        points, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
        t, turn = (1.0 + points) / 2.0, np.pi * (1.0 + points)
        window = (1.0 - t) * (2.0 + np.cos(turn)) / 3.0 + np.sin(turn) / (2.0 * np.pi)
        seen = np.exp(-x[:, None] * t) * (weights / 2.0 * window)
        value = np.sum(seen, axis=1)
        ratio[near], slope[near] = x * value, value - x * (seen @ t)
    return ratio, segment * slope


def pole_terms(
    poles: ComplexArray,
    s: ComplexArray,
    hold: float | None,
    segment: float | None = None,
    *,
    late: float = 0.0,
) -> tuple[ComplexArray, ComplexArray]:
    r"""Return ``1/(s - lambda)`` (n_poles, n_freq) and its derivative with respect to lambda.

    After a zero-order hold of period T, a sampled mode has the response

    .. math:: \frac{e^{\lambda T} - 1}{\lambda}\,\frac{1}{z - e^{\lambda T}}, \quad z = e^{sT},

    which has the same pole in s and tends to 1/(s - lambda) for small T ([PintelonSchoukens2012]_,
    section 6.2). `segment`: with the effect of Hann-windowed segments [s]. `late`: the hold's input
    acts a fraction a of a period late, and the response is taken as much earlier; the gain before
    ``1/(z - e^{\lambda T})`` is then

    .. math:: \frac{e^{sTa}}{\lambda}
        \left(e^{\lambda T b} - 1 + z^{-1} (e^{\lambda T} - e^{\lambda T b})\right),
        \quad b = 1 - a.
    """
    gap = s[None, :] - poles[:, None]
    value = 1.0 / gap
    slope = value**2
    if hold is not None:
        T = 1.0 / hold
        turn = np.exp(poles * T)[:, None]
        # 1 - exp(-gap T) loses digits near the pole unless computed by expm1
        distance = turn * np.expm1(gap * T)
        before = np.exp(poles * T * (1.0 - late))[:, None]
        newer = (np.expm1(poles * T * (1.0 - late)) / poles)[:, None]
        older = before * (np.expm1(poles * T * late) / poles)[:, None]
        ahead, behind = np.exp(s * T * late), np.exp(s * T * (late - 1.0))
        gain = newer * ahead + older * behind
        bent = before * T * (1.0 - late)
        change = (bent - newer) * ahead + (turn * T - bent - older) * behind
        change = change / poles[:, None]
        value, slope = gain / distance, change / distance + gain * T * turn / distance**2
    if segment is not None:
        ratio, change = hann_ratio(gap, segment)
        value, slope = value * ratio, slope * ratio - value * change
    return value, slope


def residual_terms(
    s: ComplexArray, *, lower: int, upper: int, hold: float | None, top: float, late: float = 0.0
) -> ComplexArray:
    """Return ``1/s, ..., 1/s^lower`` and ``1, s, ..., s^(upper-1)`` (lower + upper, n_freq)."""
    # 1/s^2 is the motion of a rigid body; with a hold 1/s and 1/s^2 are T/(z-1) and T^2 (z+1)/(2
    # (z-1)^2), and the limits of `pole_terms` where the input is late. Powers are of s/top, top in
    # rad/s
    rows = []
    for power in range(1, lower + 1):
        term = s ** (-float(power))
        if hold is not None:
            T = 1.0 / hold
            back: Any = np.expm1(s * T)
            held = back / (np.exp(s * T) * s * T)
            turn, fresh = np.exp(s * T * late), (1.0 - late) ** 2
            first = T * ((1.0 - late) * turn + late * turn * np.exp(-s * T)) / back
            moved = T**2 / 2.0 * (fresh + (1.0 - fresh) * np.exp(-s * T)) * turn
            known = {1: first, 2: (T * first + moved) / back}
            term = known.get(power, term * held)
        rows.append(term * top**power)
    rows += [(s / top) ** power for power in range(upper)]
    return np.array(rows, dtype=np.complex128).reshape(lower + upper, s.size)


#: numbers of residual terms of modes above the band: the first, or more if the residual exceeds
#: noise
UPPER, MORE = (3, 5, 7, 9), (25, 17, 13)


def afforded_terms(n_freq: int, lower: int) -> list[int]:
    """Return the larger numbers of residual terms that a number of lines allows."""
    return [upper for upper in MORE if n_freq >= 8 * (upper + lower)]


def axis(freq: FloatArray) -> ComplexArray:
    """Return s = 2 pi i f."""
    return np.asarray(2j * np.pi * freq)


def real_and_imag(values: Any) -> FloatArray:
    """Return the real parts, followed by the imaginary parts."""
    return np.concatenate([values.real, values.imag], axis=-1)


def qr(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q and R of a matrix, also of one without columns."""
    if not matrix.shape[1]:
        return np.zeros((matrix.shape[0], 0)), np.zeros((0, 0))
    Q, R = la.qr(matrix, mode="economic")
    return np.asarray(Q), np.asarray(R)


#: least independent fraction of a column for which products are accurate, and for which one pass is
#: exact to 1e-14
OWN_PART, FAR_APART = 1e-4, 0.1


def orthonormal(rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return R of columns, given as rows, its inverse, their lengths, and T: Q^T = T rows.

    Where columns are close the rows are replaced by Q^T.
    """
    # by the triangle of their products, twice where columns are close: many times faster than `qr`,
    # and equally accurate where no column is nearly a combination of the others
    whole = inverse = kept = np.eye(len(rows))
    if not len(rows):
        return whole, inverse, np.zeros(0), kept
    products = rows @ rows.T
    size = np.maximum(np.sqrt(products.diagonal()), TINY)
    now, scale, products = rows, size, products / size / size[:, None]
    for _ in range(2):
        triangle, fails = la.lapack.dpotrf(products, lower=1)
        own = np.min(triangle.diagonal())
        if fails or own < OWN_PART:
            break
        back = la.lapack.dtrtri(triangle, lower=1)[0]
        whole, inverse, turn = whole @ triangle, back @ inverse, back / scale
        if own > FAR_APART:
            if now is rows:
                return whole.T, inverse.T, size, turn
            np.matmul(turn, now, out=rows)
            return whole.T, inverse.T, size, kept
        now, scale = turn @ now, np.ones(len(rows))
        products = now @ now.T
    Q, R = qr((rows / size[:, None]).T)
    rows[:] = Q.T
    return R, np.asarray(la.pinv(R, rtol=RANK), dtype=np.float64), size, kept


def take_off(Q: FloatArray, rows: FloatArray) -> FloatArray:
    """Take the projection on Q (n_in, N, n_terms) from rows (n_in, count, N), and return them."""
    for own, basis in zip(rows, Q, strict=True):
        own -= (own @ basis) @ basis.T
    return rows


class Exhausted(Exception):  # noqa: N818 - not an error: the first result is kept
    """A refinement exceeds its allowed number of operations."""


@dataclass
class Products:
    """Number of operations of fits so far, the allowed number, and the expected one."""

    most: float = np.inf
    done: float = 0.0
    expected: float = 1.0

    def add(self, count: float) -> None:
        """Count more operations and tell the bar; raise Exhausted above the limit."""
        self.done += count
        if self.done > self.most:
            raise Exhausted
        so_far(self.done, min(self.expected, self.most))


@dataclass(frozen=True, eq=False, kw_only=True)
class Lines(PreparedLines):
    """Lines with what a fit of them assumes: residual terms, hold, delay, window, set-ups."""

    lower: int
    upper: int
    hold: float | None = None
    #: fraction of a period of the hold by which its input acts late; the data are advanced by it
    late: float = 0.0
    #: complex degrees of freedom of an estimated variance, None where it is exact or the fit's own
    variance_freedom: float | None = None
    #: length [s] of the Hann-windowed segments that the fit takes account of
    segment: float | None = None
    #: poles that a fit may have
    most: int = 1000
    work: Products = field(default_factory=Products)
    #: which rows of the data were measured together
    setups: tuple[IntArray, ...] = ()

    @property
    def parts(self) -> tuple[IntArray, ...]:
        """Groups of rows that may have separate poles: the rows of a set-up, otherwise each row."""
        return self.setups or tuple(np.arange(len(self.data))[:, None])

    def freedom(self, m: int) -> float:
        """Return the expected cost of a fit with m poles: number of data minus parameters."""
        # where errors of lines are correlated each parameter fits `inflation` times as much of them
        n_out, n_in, _ = self.data.shape
        used = n_out * n_in * (self.lower + self.upper) + 2 * m * (n_out + n_in)
        return float(max(1.0, 2 * self.data.size - self.inflation * used))

    def of_rows(self, rows: IntArray) -> Lines:
        """Return the lines of some outputs."""
        data, weight = self.data[rows], self.weight[rows]
        some = replace(self, data=data, weight=weight, correlation=None, setups=())
        # the part of the residual terms is known
        some.__dict__["inflation"] = self.inflation
        some.__dict__["smooth_bases"] = [self.smooth_bases[o] for o in rows]
        some.__dict__["goals"] = [self.goals[o] for o in rows]
        some.__dict__["twice"] = self.twice[rows]
        return some

    def with_upper(self, upper: int) -> Lines:
        """Return the lines with another number of residual terms of modes above the band."""
        other, count = replace(self, upper=upper), self.lower + upper
        other.__dict__.update(twice=self.twice, inflation=self.inflation)
        if upper <= self.upper:
            # bases of fewer terms are the leading columns
            other.__dict__["smooth_bases"] = [
                (Q[:, :, :count], R[:, :count, :count]) for Q, R in self.smooth_bases
            ]
        return other

    def pole_terms(self, poles: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the terms (m, n_freq) of poles and their derivatives."""
        return pole_terms(poles, axis(self.freq), self.hold, self.segment, late=self.late)

    @cached_property
    def smooth(self) -> ComplexArray:
        """The residual terms (n_terms, n_freq)."""
        top = 2 * np.pi * float(self.freq[-1])
        return residual_terms(
            axis(self.freq),
            lower=self.lower,
            upper=self.upper,
            hold=self.hold,
            top=top,
            late=self.late,
        )

    @cached_property
    def twice(self) -> FloatArray:
        """The weights (n_out, n_in, 2 n_freq) of real and imaginary parts."""
        return np.concatenate([self.weight, self.weight], axis=-1)

    @cached_property
    def smooth_bases(self) -> list[tuple[FloatArray, FloatArray]]:
        """Per output Q (n_in, 2 n_freq, n_terms) and R of the weighted residual terms."""
        # the terms are made orthonormal with mean weights first: with others little is left to do
        mean = np.sqrt(np.mean(self.twice**2, axis=(0, 1)))
        shared, R = qr((real_and_imag(self.smooth) * mean).T)
        terms, found = shared.T / mean, []
        bases = np.empty((*self.twice.shape[:2], *terms.shape))
        for weights, Q in zip(self.twice, bases, strict=True):
            triangles = []
            for w, own in zip(weights, Q, strict=True):
                np.multiply(terms, w, out=own)
                mine, _, size, turn = orthonormal(own)
                own[:] = turn @ own
                triangles.append((mine * size) @ R)
            found.append((Q.swapaxes(1, 2), np.array(triangles)))
        return found

    @cached_property
    def goals(self) -> list[FloatArray]:
        """Per output the weighted data (n_in 2 n_freq,) without the residual terms."""
        found = []
        for (Q, _), data, w in zip(self.smooth_bases, self.data, self.weight, strict=True):
            goal = real_and_imag(data * w)[:, None, :]
            found.append(take_off(Q, goal).ravel())
        return found
