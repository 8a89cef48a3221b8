"""Functions of frequency that a measured response is made of: poles and residual terms."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..values import ComplexArray, FloatArray

#: |x| below which the functions are summed as series, and the terms of that
SERIES, TERMS = 1.0, 20


def hann_ratio(gap: ComplexArray, segment: float) -> tuple[ComplexArray, ComplexArray]:
    r"""Return R and dR/dq: a pole's term ``1/q`` is seen as ``R/q``, q = s - lambda.

    Averages of windowed segments estimate, for an input that is white over a few lines, the
    response whose impulse response is multiplied by the autocorrelation of the window, a lag
    window:

    .. math:: R = q \int_0^T \rho(\tau) e^{-q \tau} d\tau, \quad
        \rho(\tau) = \left(1 - \frac{\tau}{T}\right)
        \left(\frac{2}{3} + \frac{1}{3} \cos\frac{2 \pi \tau}{T}\right)
        + \frac{1}{2 \pi} \sin\frac{2 \pi \tau}{T}

    ([BendatPiersol2010]_, sections 11.5 and 11.6, for Hann windows); 1 far from the pole.
    """
    T, turn = segment, 2j * np.pi
    x = gap * T
    middle, (low, d_low), (high, d_high) = _ramp(x), *(_step(x + side) for side in (-turn, turn))
    left, right = _ramp(x - turn), _ramp(x + turn)
    g = (4.0 * middle[0] + left[0] + right[0]) / 6.0 + (low - high) / (2.0 * turn)
    slope = (4.0 * middle[1] + left[1] + right[1]) / 6.0 + (d_low - d_high) / (2.0 * turn)
    return np.asarray(x * g), np.asarray(T * (g + x * slope))


def _step(x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return ``mu = (1 - exp(-x)) / x`` and its derivative."""
    near = np.abs(x) < SERIES
    far: ComplexArray = np.where(near, 1.0 + 0j, x)
    decay = np.exp(-far)
    value = (1.0 - decay) / far
    slope = (decay * (1.0 + far) - 1.0) / far**2
    return _joined(x, near, value, slope, 1)


def _ramp(x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return ``kappa = (x - 1 + exp(-x)) / x^2`` and its derivative."""
    near = np.abs(x) < SERIES
    far: ComplexArray = np.where(near, 1.0 + 0j, x)
    decay = np.exp(-far)
    value = (far - 1.0 + decay) / far**2
    slope = ((1.0 - decay) / far - 2.0 * value) / far
    return _joined(x, near, value, slope, 2)


def _joined(
    x: ComplexArray,
    near: npt.NDArray[np.bool_],
    value: ComplexArray,
    slope: ComplexArray,
    first: int,
) -> tuple[ComplexArray, ComplexArray]:
    """Return value and slope, near zero by the series ``sum (-x)^n / (n + first)!``."""
    if np.any(near):
        z = x[near]
        factorial, power, total, change = 1.0, np.ones_like(z), 0.0 * z, 0.0 * z
        for k in range(2, first + 1):
            factorial *= k
        for n in range(TERMS):
            total = total + power / factorial
            factorial *= n + 1 + first
            change = change - (n + 1) * power / factorial
            power = -power * z
        value, slope = value.copy(), slope.copy()
        value[near], slope[near] = total, change
    return value, slope


def seen_terms(
    poles: ComplexArray, s: ComplexArray, hold: float | None, segment: float | None
) -> tuple[ComplexArray, ComplexArray]:
    """Return `pole_terms` as lines of Hann-windowed segments [s] show them; None: as they are."""
    value, slope = pole_terms(poles, s, hold)
    if segment is None:
        return value, slope
    ratio, change = hann_ratio(s[None, :] - poles[:, None], segment)
    return value * ratio, slope * ratio - value * change


def pole_terms(
    poles: ComplexArray, s: ComplexArray, hold: float | None
) -> tuple[ComplexArray, ComplexArray]:
    r"""Return ``1/(s - lambda)`` (n_poles, n_freq) and its derivative with respect to lambda.

    Behind a zero-order hold of period T, a sampled mode answers

    .. math:: \frac{e^{\lambda T} - 1}{\lambda}\,\frac{1}{z - e^{\lambda T}}, \quad z = e^{sT},

    which has the same pole on the axis of s and tends to 1/(s - lambda) with T
    ([PintelonSchoukens2012]_, section 6.2).
    """
    gap = s[None, :] - poles[:, None]
    if hold is None:
        return 1.0 / gap, 1.0 / gap**2
    T = 1.0 / hold
    turn = np.exp(poles * T)[:, None]
    # 1 - exp(-gap T) loses digits near the pole unless computed by expm1
    distance = turn * _expm1(gap * T)
    gain = (_expm1(poles * T) / poles)[:, None]
    slope = (turn * T - gain) / poles[:, None]
    return gain / distance, slope / distance + gain * T * turn / distance**2


def residual_terms(
    s: ComplexArray, *, lower: int, upper: int, hold: float | None, top: float
) -> ComplexArray:
    """Return ``1/s, ..., 1/s^lower`` and ``1, s, ..., s^(upper-1)`` (lower + upper, n_freq).

    1/s^2 is the motion of a rigid body; with a hold 1/s and 1/s^2 are T/(z-1) and
    T^2 (z+1)/(2 (z-1)^2). Powers are of s/top, top in rad/s.
    """
    rows = []
    for power in range(1, lower + 1):
        term = s ** (-float(power))
        if hold is not None:
            T = 1.0 / hold
            back = _expm1(s * T)
            held = back / (np.exp(s * T) * s * T)
            known = {1: T / back, 2: T**2 * (back + 2.0) / (2.0 * back**2)}
            term = known.get(power, term * held)
        rows.append(term * top**power)
    rows += [(s / top) ** power for power in range(upper)]
    return np.array(rows, dtype=np.complex128).reshape(lower + upper, s.size)


def axis(freq: FloatArray) -> ComplexArray:
    """Return s = 2 pi i f."""
    return np.asarray(2j * np.pi * freq)


def _expm1(x: ComplexArray) -> ComplexArray:
    return np.asarray(np.expm1(x.real) * np.cos(x.imag) - 2.0 * np.sin(x.imag / 2) ** 2) + 1j * (
        np.exp(x.real) * np.sin(x.imag)
    )
