"""Poles and residual terms at the lines of a measurement, with hold and window; their bases."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray
from ..tolerances import RANK, TINY

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


def halves(plus: ComplexArray, minus: ComplexArray) -> FloatArray:
    """Return the rows (2 m, 2 n_freq) of terms and their conjugates for residues 1, and for j."""
    return real_and_imag(np.concatenate([plus + minus, 1j * (plus - minus)]))


def with_residues(rows: FloatArray, residues: ComplexArray) -> FloatArray:
    """Return the rows (..., 2 m, n) of `halves` for residues (..., m), and for j times these."""
    m = residues.shape[-1]
    first, second = rows[..., :m, :], rows[..., m:, :]
    real, imag = residues.real[..., None], residues.imag[..., None]
    found = np.empty(np.broadcast_shapes(rows.shape, (*residues.shape[:-1], 1, 1)))
    np.multiply(real, first, out=found[..., :m, :])
    np.multiply(real, second, out=found[..., m:, :])
    found[..., :m, :] += imag * second
    found[..., m:, :] -= imag * first
    return found


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
