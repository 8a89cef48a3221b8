"""Systems from transfer functions: by coefficients, or by zeros, poles and gain."""

from __future__ import annotations

import numpy.typing as npt

from .sections import tf_fields, zpk_fields
from .statespace import StateSpace


def tf(numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt: float = 0.0) -> StateSpace:
    """Return a transfer function of one input and one output as state space.

    ``(b[0] s^m + ... + b[m]) / (a[0] s^n + ... + a[n])``, z in place of s when sampled; kept as
    first- and second-order sections in series, whose poles are exact to rounding.

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
        Complex ones with their conjugates; at most as many zeros as poles.
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
