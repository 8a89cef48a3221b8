"""Filters as state space: by coefficients, by zeros, poles and gain, weights and elements."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..arrays import between, number, positive, whole
from ..errors import ModelError
from ..tolerances import SAME
from .foreign_systems import tf_fields, zpk_fields
from .interconnection import series
from .statespace import StateSpace, System, as_statespace


def tf(numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt: float = 0.0) -> StateSpace:
    """Return a transfer function of one input and one output as state space.

    The transfer function is ``(b[0] s^m + ... + b[m]) / (a[0] s^n + ... + a[n])``, with z in place
    of s if it is sampled. It is stored as first- and second-order sections in series, whose poles
    are exact to rounding.

    Parameters
    ----------
    numerator, denominator : sequences of float
        Coefficients, highest power first; the numerator's degree is at most the denominator's.
    dt : float [s]
        Sampling time; 0 for continuous time.

    Raises
    ------
    ModelError
        When the denominator is zero or of a lower degree than the numerator.

    Examples
    --------
    >>> integrator = tf([1.0], [1.0, 0.0])
    >>> print(integrator(2j))
    -0.5j
    """
    return StateSpace(
        **tf_fields(numerator, denominator, dt), dt=dt, inputs=["in"], outputs=["out"]
    )


def zpk(zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float, dt: float = 0.0) -> StateSpace:
    """Return ``gain prod(s - zeros) / prod(s - poles)`` as state space.

    Parameters
    ----------
    zeros, poles : sequences of complex [rad/s, or of z]
        Zeros and poles, for a sampled system in the z-plane. Each complex number must be listed
        together with its conjugate. There are at most as many zeros as poles.
    gain : float
        Factor of the products.
    dt : float [s]
        Sampling time; 0 for continuous time.

    Raises
    ------
    ModelError
        When a complex number lacks its conjugate, or there are more zeros than poles.

    Examples
    --------
    >>> resonance = zpk([], [-1 + 100j, -1 - 100j], 10001.0)
    >>> round(resonance.dcgain(), 12)
    1.0
    """
    return StateSpace(**zpk_fields(zeros, poles, gain, dt), dt=dt, inputs=["in"], outputs=["out"])


def matched(sys: System, rate: float, *, at: float = 0.0) -> StateSpace:
    """Return the sampled filter with matched poles and zeros, ``z = e^(s / rate)``.

    Zeros at infinity go to z = -1, so that a roll-off ends in a zero at half the rate. The gain is
    matched at one frequency. Notches keep their frequency and depth exactly; with Tustin this is
    possible at one frequency only.

    As in MATLAB's c2d, the method needs systems with one input and one output, because the zeros of
    a system with several channels do not belong to single channels. A filter with a section for
    each channel is sampled section by section: ``append(*(matched(f, rate) for f in sections))``.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous filter or controller with one input and one output. For a plant use
        `discretized`.
    rate : float [Hz]
        Sampling rate.
    at : float [Hz]
        Frequency at which the gain is matched; not 0 for a filter that integrates or
        differentiates.

    Returns
    -------
    StateSpace
        A cascade of sections of second order, with the same names.

    Raises
    ------
    ModelError
        When `sys` is sampled already or has several channels, or the gain at `at` is zero or
        infinite.

    References
    ----------
    [Franklin1998]_, sec. 6.2.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.matched(fx.lti.tf([1.0], [1.0, 1.0]), 10.0).poles().real.round(6)  # exp(-0.1)
    array([0.904837])
    """
    g = as_statespace(sys)
    h = 1.0 / positive(rate, "rate")
    if g.dt and g.n_states:
        raise ModelError(f"{g!r} is sampled already. Pass the continuous system.")
    if g.D.shape != (1, 1):
        raise ModelError(
            f"matched needs one input and one output, got {len(g.inputs)} and {len(g.outputs)}: "
            "zeros of several channels cannot be mapped one by one. Use tustin, or sample each "
            "channel separately: append(matched(g['y1', 'u1'], rate), ...)."
        )
    at = between(at, "at", 0.0, 0.5 * rate, "It is in Hz, below half the rate.", ends="[")
    if not g.n_states:
        return g.replace(dt=h)
    wanted = _finite_gain(g, 2j * np.pi * at, at)
    zeros = np.exp(g.zeros() * h)
    poles = np.exp(g.poles() * h)
    zeros = np.concatenate([zeros, -np.ones(poles.size - zeros.size)])
    filtered = StateSpace(**zpk_fields(zeros, poles, 1.0, h), dt=h)
    ratio = wanted / _finite_gain(filtered, np.exp(2j * np.pi * at * h), at)
    gain = abs(ratio) * (-1.0 if ratio.real < 0 else 1.0)
    return filtered.replace(
        C=gain * filtered.C,
        D=gain * filtered.D,
        inputs=g.inputs,
        outputs=g.outputs,
        states=(),
        name=g.name,
    )


def _finite_gain(g: StateSpace, s: complex, at: float) -> complex:
    try:
        value = complex(g.evaluated(s)[0, 0])
    except ModelError:  # a pole
        value = complex(np.inf)
    if not np.isfinite(value) or value == 0:
        raise ModelError(
            f"the gain of {g!r} at {at:g} Hz is {abs(value):g} and cannot be matched there. Give "
            "another frequency: matched(..., at=)."
        )
    return value


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


def low_pass_filter(freq: float, *, order: int = 1, gain: float = 1.0) -> StateSpace:
    """Return a low-pass filter, Butterworth for order 2.

    Parameters
    ----------
    freq : float [Hz]
        Corner frequency.
    order : {1, 2}
        Slope at high frequencies, in decades per decade.
    gain : float
        Gain at low frequencies.

    Returns
    -------
    StateSpace
        ``gain / (p + 1)`` or ``gain / (p^2 + sqrt(2) p + 1)``, with p = s / w and w = 2 pi freq.

    Raises
    ------
    ModelError
        When freq is not positive, gain not a number, or the order neither 1 nor 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(abs(fx.lti.low_pass_filter(100.0)(2j * 3.141592653589793 * 100.0)), 4)
    0.7071
    """
    return _butterworth(freq, order, 0.0, number(gain, "gain"))


def high_pass_filter(freq: float, *, order: int = 1, gain: float = 1.0) -> StateSpace:
    """Return a high-pass filter, Butterworth for order 2.

    It is ``gain p / (p + 1)`` or ``gain p^2 / (p^2 + sqrt(2) p + 1)``, with p = s / w and w = 2 pi
    freq.

    Parameters
    ----------
    freq, order, gain
        Parameters as for `low_pass_filter`, but `order` is the slope at low frequencies and `gain`
        the gain at high frequencies.

    Raises
    ------
    ModelError
        As for `low_pass_filter`.

    Examples
    --------
    >>> import flexplant as fx
    >>> high = fx.lti.high_pass_filter(10.0)
    >>> round(abs(high(2j * np.pi * 10.0)), 4), round(abs(high(0.0)), 4)
    (0.7071, 0.0)
    """
    return _butterworth(freq, order, number(gain, "gain"), 0.0)


def _butterworth(freq: float, order: int, high: float, low: float) -> StateSpace:
    omega = 2.0 * np.pi * positive(freq, "freq")
    if not isinstance(order, int | float | np.number):
        whole(order, "order", maximum=2)
    if order == 1:
        return first_order(high, low, omega)
    if order == 2:
        return second_order(high, 0.0, low, omega, np.sqrt(0.5))
    raise ModelError(f"order must be 1 or 2, got {order!r}. Put filters in series for more.")


def notch_filter(freq: float, *, depth: float = 0.05, width: float = 0.5) -> StateSpace:
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
        ``(p^2 + 2 depth width p + 1) / (p^2 + 2 width p + 1)`` with p = s / w and w = 2 pi freq.

    Raises
    ------
    ModelError
        When an argument is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(abs(fx.lti.notch_filter(100.0, depth=0.1)(2j * np.pi * 100.0)), 4)
    0.1
    """
    omega = 2.0 * np.pi * positive(freq, "freq")
    zeta = positive(width, "width")
    return second_order(1.0, 2.0 * positive(depth, "depth", zero=True) * zeta, 1.0, omega, zeta)


def lead_lag_filter(zero: float, pole: float, *, gain: float = 1.0) -> StateSpace:
    """Return a lead (zero below pole) or lag filter.

    Parameters
    ----------
    zero, pole : float [Hz]
        Corner frequencies.
    gain : float
        Gain at low frequencies.

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
    >>> lead = fx.lti.lead_lag_filter(10.0, 90.0)
    >>> round(float(np.angle(lead(2j * np.pi * 30.0), deg=True)), 1)
    53.1
    """
    ratio, gain = positive(pole, "pole") / positive(zero, "zero"), number(gain, "gain")
    return first_order(gain * ratio, gain, 2.0 * np.pi * pole)


def inverse_sensitivity(
    bandwidth: float, *, peak: float = 2.0, floor: float = 1e-3, slope: int = 1
) -> StateSpace:
    """Return a weight W of the sensitivity S: ``|W S| <= 1`` means that S is below 1 / |W|.

    Parameters
    ----------
    bandwidth : float [Hz]
        Frequency at which the bound 1 / |W| on the sensitivity |S| crosses 1.
    peak : float
        Bound on |S| at high frequencies.
    floor : float
        Bound on |S| at frequency zero; above 0, so that the weight is stable.
    slope : {1, 2}
        Slope of the bound below the bandwidth, in decades per decade.

    Returns
    -------
    StateSpace
        ``((s / peak^(1/k) + w) / (s + w floor^(1/k)))^k``, where k is the slope. The frequency w is
        such that |W| is exactly 1 at the bandwidth.

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
    slope = whole(slope, "slope", maximum=2)
    floor, peak = positive(floor, "floor"), positive(peak, "peak")
    if not floor < 1.0 < peak:
        raise ModelError(
            f"need 0 < floor < 1 < peak, got floor {floor:g} and peak {peak:g}. They are the "
            "sizes of S at low and at high frequency, for example 1e-3 and 2."
        )
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
        Time by which the signal is delayed.
    order : int
        Number of states, 1 to 12; the phase is accurate up to about ``order / (6 delay)`` Hz.

    Returns
    -------
    StateSpace
        ``Q(-s) / Q(s)`` with ``Q = sum_k c_k (s delay)^k`` and
        ``c_k = (2n-k)! n! / ((2n)! k! (n-k)!)``, where n is the order. It consists of real modal
        sections in series.

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
    n = whole(order, "order", maximum=12)
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
