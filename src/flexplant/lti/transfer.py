"""Systems from transfer functions: by coefficients, or by zeros, poles and gain."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..checks import between, positive
from ..errors import ModelError
from .sections import tf_fields, zpk_fields
from .statespace import StateSpace, System, as_statespace


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


def matched(sys: System, rate: float, *, at: float = 0.0) -> StateSpace:
    """Return the sampled filter with matched poles and zeros, ``z = e^(s / rate)``.

    Zeros at infinity go to z = -1, so that a roll-off ends in a zero at half the rate. The gain is
    matched at one frequency. Notches keep their frequency and depth exactly, which Tustin only
    does at one.

    Of one input and one output alone, as in MATLAB's c2d: the zeros of several channels are
    properties of all of them together (with their directions), and no state space with mapped
    poles and mapped transmission zeros keeps the gains of the single entries; entry by entry, the
    poles would be there once for each entry. Sampling the residues of a modal form is impulse
    invariance, another method, which aliases. A filter with a section for each channel is sampled
    section by section: ``append(*(matched(f, rate) for f in sections))``.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous, one input, one output: a filter or a controller; for a plant use `discretized`.
    rate : float [Hz]
        Sampling rate.
    at : float [Hz]
        Where the gain is matched; not 0 for a filter that integrates or differentiates.

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
            "channel by itself: append(matched(g['y1', 'u1'], rate), ...)."
        )
    at = between(at, "at", 0.0, 0.5 * rate, "It is in Hz, below half the rate.", ends="[")
    if not g.n_states:
        return g.replace(dt=h)
    wanted = _gain(g, 2j * np.pi * at, at)
    zeros = np.exp(g.zeros() * h)
    poles = np.exp(g.poles() * h)
    zeros = np.concatenate([zeros, -np.ones(poles.size - zeros.size)])
    filtered = StateSpace(**zpk_fields(zeros, poles, 1.0, h), dt=h)
    ratio = wanted / _gain(filtered, np.exp(2j * np.pi * at * h), at)
    gain = abs(ratio) * (-1.0 if ratio.real < 0 else 1.0)
    return filtered.replace(
        C=gain * filtered.C,
        D=gain * filtered.D,
        inputs=g.inputs,
        outputs=g.outputs,
        states=(),
        name=g.name,
    )


def _gain(g: StateSpace, s: complex, at: float) -> complex:
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
