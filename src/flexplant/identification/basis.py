"""Functions of frequency that a measured response is made of: poles and residual terms."""

from __future__ import annotations

import numpy as np

from ..values import ComplexArray, FloatArray
from .window_terms import hann_ratio


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
