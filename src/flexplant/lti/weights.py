"""Filters for weights and controllers, one input and one output, as state space.

All are continuous; `flexplant.lti.tustin(weight, rate)` samples them for a sampled plant.
"""

from __future__ import annotations

import numpy as np

from ..checks import positive, real_array
from ..errors import ModelError
from ..tolerances import SAME
from .interconnection import series
from .statespace import StateSpace


def first_order(b1: float, b0: float, omega: float) -> StateSpace:
    """Return ``(b1 s / w + b0) / (s / w + 1)``."""
    return StateSpace([[-omega]], [[omega]], [[b0 - b1]], [[b1]], inputs=["in"], outputs=["out"])


def second_order(b2: float, b1: float, b0: float, omega: float, zeta: float) -> StateSpace:
    """Return ``(b2 p^2 + b1 p + b0) / (p^2 + 2 zeta p + 1)`` with p = s / omega."""
    return StateSpace(
        [[0.0, omega], [-omega, -2.0 * zeta * omega]],
        [[0.0], [omega]],
        [[b0 - b2, b1 - 2.0 * zeta * b2]],
        [[b2]],
        inputs=["in"],
        outputs=["out"],
        blocks=[2],
    )


def _number(gain: float) -> float:
    return float(real_array(gain, "gain", ()))


def lowpass(freq: float, *, order: int = 1, gain: float = 1.0) -> StateSpace:
    """Return a low-pass filter, Butterworth for order 2.

    Parameters
    ----------
    freq : float [Hz]
        Corner frequency.
    order : {1, 2}
        Slope at high frequencies.
    gain : float
        At low frequencies.

    Returns
    -------
    StateSpace
        ``gain / (s/w + 1)`` or ``gain / (p^2 + sqrt(2) p + 1)``, p = s / w.

    Raises
    ------
    ModelError
        When freq is not positive, gain not a number, or the order neither 1 nor 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(abs(fx.lowpass(100.0)(2j * 3.141592653589793 * 100.0)), 4)
    0.7071
    """
    return _butterworth(freq, order, 0.0, _number(gain))


def highpass(freq: float, *, order: int = 1, gain: float = 1.0) -> StateSpace:
    """Return a high-pass filter, Butterworth for order 2.

    Parameters
    ----------
    freq : float [Hz]
        Corner frequency.
    order : {1, 2}
        Slope at low frequencies.
    gain : float
        At high frequencies.

    Returns
    -------
    StateSpace
        ``gain (s/w) / (s/w + 1)`` or ``gain p^2 / (p^2 + sqrt(2) p + 1)``, p = s / w.

    Raises
    ------
    ModelError
        When freq is not positive, gain not a number, or the order neither 1 nor 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> high = fx.lti.highpass(10.0)
    >>> round(abs(high(2j * np.pi * 10.0)), 4), round(abs(high(0.0)), 4)
    (0.7071, 0.0)
    """
    return _butterworth(freq, order, _number(gain), 0.0)


def _butterworth(freq: float, order: int, high: float, low: float) -> StateSpace:
    omega = 2.0 * np.pi * positive(freq, "freq")
    if order == 1:
        return first_order(high, low, omega)
    if order == 2:
        return second_order(high, 0.0, low, omega, np.sqrt(0.5))
    raise ModelError(f"order must be 1 or 2, got {order!r}. Put filters in series for more.")


def notch(freq: float, *, depth: float = 0.05, width: float = 0.5) -> StateSpace:
    """Return a notch filter.

    Parameters
    ----------
    freq : float [Hz]
        Centre.
    depth : float
        Gain at the centre, below 1 (above 1 it is a resonance).
    width : float
        Damping ratio of the poles: half the relative width.

    Returns
    -------
    StateSpace
        ``(p^2 + 2 depth width p + 1) / (p^2 + 2 width p + 1)``, p = s / w.

    Raises
    ------
    ModelError
        When an argument is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(abs(fx.lti.notch(100.0, depth=0.1)(2j * np.pi * 100.0)), 4)
    0.1
    """
    omega = 2.0 * np.pi * positive(freq, "freq")
    zeta = positive(width, "width")
    return second_order(1.0, 2.0 * positive(depth, "depth", zero=True) * zeta, 1.0, omega, zeta)


def leadlag(zero: float, pole: float, *, gain: float = 1.0) -> StateSpace:
    """Return a lead (zero below pole) or lag filter.

    Parameters
    ----------
    zero, pole : float [Hz]
        Corner frequencies.
    gain : float
        At low frequencies.

    Returns
    -------
    StateSpace
        ``gain (s / w_zero + 1) / (s / w_pole + 1)``.

    Raises
    ------
    ModelError
        When a frequency is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> lead = fx.lti.leadlag(10.0, 90.0)
    >>> round(float(np.angle(lead(2j * np.pi * 30.0), deg=True)), 1)
    53.1
    """
    ratio, gain = positive(pole, "pole") / positive(zero, "zero"), _number(gain)
    return first_order(gain * ratio, gain, 2.0 * np.pi * pole)


def inverse_sensitivity(
    bandwidth: float, *, peak: float = 2.0, floor: float = 1e-3, slope: int = 1
) -> StateSpace:
    """Return a weight W with ``|W S| <= 1`` where S is as wanted: 1 / |W| bounds S.

    Parameters
    ----------
    bandwidth : float [Hz]
        Where the bound on |S| crosses 1.
    peak : float
        Bound on |S| at high frequencies.
    floor : float
        Bound on |S| at frequency zero; above 0, so that the weight is stable.
    slope : {1, 2}
        Of the bound below the bandwidth, in decades per decade.

    Returns
    -------
    StateSpace
        ``((s / peak^(1/k) + w) / (s + w floor^(1/k)))^k``, k the slope, with the crossing at the
        bandwidth exactly.

    Raises
    ------
    ModelError
        Unless floor < 1 < peak, bandwidth > 0 and slope is 1 or 2.

    References
    ----------
    [Skogestad2005]_, section 2.8.

    Examples
    --------
    >>> import flexplant as fx
    >>> W = fx.lti.inverse_sensitivity(50.0, peak=2.0)
    >>> round(1 / abs(W(2j * np.pi * 1e5)), 3)  # |S| may be 2 at high frequency
    2.0
    """
    if slope not in (1, 2):
        raise ModelError(f"slope must be 1 or 2, got {slope!r}.")
    if not 0.0 < floor < 1.0 < peak:
        raise ModelError(f"need 0 < floor < 1 < peak, got floor {floor:g} and peak {peak:g}.")
    high, low = peak ** (-1.0 / slope), floor ** (1.0 / slope)
    # |W| = 1 at the bandwidth w_b: (w_b high)^2 + w^2 = w_b^2 + (w low)^2
    omega = 2.0 * np.pi * positive(bandwidth, "bandwidth") * np.sqrt((1 - high**2) / (1 - low**2))
    section = first_order(high, 1.0 / low, omega * low)
    if slope == 1:
        return section
    return series(section, section.replace(inputs=["mid"], outputs=["out"], states=["x2"]))


def pade(delay: float, *, order: int = 2) -> StateSpace:
    """Return the all-pass approximation of a delay.

    Parameters
    ----------
    delay : float [s]
        The delay.
    order : int
        Number of states, 1 to 12; the phase is right up to about ``order / (6 delay)`` Hz.

    Returns
    -------
    StateSpace
        ``Q(-s) / Q(s)``, ``Q = sum_k c_k (s delay)^k`` with
        ``c_k = (2n-k)! n! / ((2n)! k! (n-k)!)``, n the order; real modal sections in series.

    Raises
    ------
    ModelError
        When delay is not positive or the order not a whole number from 1 to 12.

    Examples
    --------
    >>> import flexplant as fx
    >>> delay = fx.lti.pade(1e-3)
    >>> round(abs(delay(200j)), 6), round(float(np.angle(delay(200j))), 4)  # one, and -0.2 rad
    (1.0, -0.2)
    """
    time = positive(delay, "delay")
    if order not in range(1, 13):
        raise ModelError(f"order must be a whole number from 1 to 12, got {order!r}.")
    n = int(order)
    powers = np.cumprod([1.0, *((n - k) / ((2 * n - k) * (k + 1)) for k in range(n))])
    poles = np.roots(powers[::-1])
    upper = poles[poles.imag > SAME * np.abs(poles)]
    line = StateSpace([], [], [], [[1.0]], inputs=["in"], outputs=["out"])
    for pole in poles[np.abs(poles.imag) <= SAME * np.abs(poles)].real:
        line = series(line, first_order(-1.0, 1.0, -pole / time).replace(states=["real"]))
    for i, pole in enumerate(upper, 1):
        size = abs(pole)
        zeta = -pole.real / size
        section = second_order(1.0, -2.0 * zeta, 1.0, size / time, zeta)
        line = series(line, section.replace(states=[f"pair{i}", f"rate{i}"]))
    return line
