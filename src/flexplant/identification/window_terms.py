r"""What a Hann window makes of a pole: the response of windowed segments, in closed form.

Averages of windowed segments estimate, for an input that is white over a few lines, the response
whose impulse response is multiplied by the autocorrelation of the window, a lag window:

.. math:: E\,\hat H(s) = \int_0^{T} \rho(\tau) h(\tau) e^{-s \tau} d\tau, \quad
    \rho(\tau) = \left(1 - \frac{\tau}{T}\right)
    \left(\frac{2}{3} + \frac{1}{3} \cos\frac{2 \pi \tau}{T}\right)
    + \frac{1}{2 \pi} \sin\frac{2 \pi \tau}{T}

([BendatPiersol2010]_, sections 11.5 and 11.6, for segments of T seconds; Hann window).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..values import ComplexArray

#: |x| below which the functions are summed as series, and the terms of that
SERIES, TERMS = 1.0, 20


def hann_ratio(gap: ComplexArray, segment: float) -> tuple[ComplexArray, ComplexArray]:
    r"""Return R and dR/dq: a pole's term ``1/q`` is seen as ``R/q``, q = s - lambda.

    ``R = q \int_0^T \rho e^{-q tau} d tau``; 1 far from the pole.

    Parameters
    ----------
    gap : complex array [rad/s]
        q, with a positive real part.
    segment : float [s]
        T.
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
