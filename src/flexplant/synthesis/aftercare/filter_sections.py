"""second_order_sections: channels of a sampled controller as chains of filters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...checks import ComplexArray, FloatArray
from ...errors import CertificateError, ModelError
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import resonance_grid
from ...lti.minimal import minimal
from ...lti.statespace import StateSpace, as_statespace

#: largest difference of the responses, relative to the largest gain of a channel
_AGREEMENT = 1e-6


def second_order_sections(controller: Any) -> Mapping[tuple[str, str], FloatArray]:
    """Return each channel of a sampled controller as second-order sections.

    ::

        K_ij(z) = prod_k (b0 + b1 z^-1 + b2 z^-2) / (1 + a1 z^-1 + a2 z^-2)

    Poles and zeros are those of the channel's minimal states; the product is compared with the
    channel over all frequencies.

    Parameters
    ----------
    controller : StateSpace or Controller
        Sampled.

    Returns
    -------
    mapping {(output, input): (k, 6) array}
        Rows [b0, b1, b2, 1, a1, a2], the form of `scipy.signal.sosfilt`; the gain is in the first.

    Raises
    ------
    CertificateError
        When the sections differ from the channel by more than 1e-6 of its largest gain, as where
        the rate is so high above a pole that rounded coefficients move it.
    ModelError
        When the controller is continuous.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> list(fx.synthesis.second_order_sections(servo))
    [('u1', 'die:ref'), ('u1', 'die:hat')]
    """
    K = as_statespace(controller)
    if not K.dt and K.n_states:
        raise ModelError(
            "sections are of a sampled controller: synthesis.discretise_controller(plant, "
            "controller) first."
        )
    return {(output, name): _sections(K[output, name]) for output in K.outputs for name in K.inputs}


def _sections(g: StateSpace) -> FloatArray:
    """Return the sections of one channel."""
    from scipy.signal import zpk2sos

    small = minimal(g) if g.n_states else g
    poles: Any = small.poles()
    zeros: Any = small.zeros()
    grid = resonance_grid(poles, g.dt or 1.0, points=100)
    wanted = frequency_response(g.replace(dt=g.dt or 1.0), grid).data[0, 0]
    size = float(np.abs(wanted).max(initial=0.0))
    if not size:
        return np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    back = np.expm1(-2j * np.pi * grid * (g.dt or 1.0))  # 1/z - 1
    shape = _root_product(poles, zeros, back)
    at = int(np.argmax(np.abs(wanted)))
    gain = float((wanted[at] / shape[at]).real)
    # with a zero at z = 0 for each that is missing: so many samples too early
    sections = np.asarray(zpk2sos(zeros, poles, gain, pairing="nearest"), dtype=np.float64)
    late = len(poles) - len(zeros)
    for row in sections:
        while late and not row[2]:
            row[:3], late = [0.0, *row[:2]], late - 1
    off = float(np.abs(_sections_response(sections, back) - wanted).max()) / size
    if not off <= _AGREEMENT:
        exact = float(np.abs(gain * shape - wanted).max()) / size
        raise CertificateError(
            f"the sections of {g.outputs[0]!r} from {g.inputs[0]!r} differ from it by {off:.1e} of "
            f"its largest gain: {_cause(exact, poles, g.dt)}, or export its states (write_c)."
        )
    return sections


def _root_product(poles: ComplexArray, zeros: ComplexArray, back: ComplexArray) -> ComplexArray:
    """Return ``prod (z - zeros) / prod (z - poles)`` at 1/z - 1 = back."""
    z = 1.0 / (1.0 + back)
    rise = -back * z  # z - 1
    found = np.ones(z.size, dtype=np.complex128)
    for root in zeros:
        found *= rise + (1.0 - root)
    for root in poles:
        found /= rise + (1.0 - root)
    return found


def _sections_response(sections: FloatArray, back: ComplexArray) -> ComplexArray:
    """Return the response of sections: in powers of 1/z - 1, small where coefficients cancel."""
    found = np.ones(back.size, dtype=np.complex128)
    for row in sections:
        above, below = (
            (c0 + c1 + c2) + (c1 + 2.0 * c2) * back + c2 * back**2
            for c0, c1, c2 in (row[:3], row[3:])
        )
        found *= above / below
    return found


def _cause(exact: float, poles: ComplexArray, dt: float) -> str:
    """Return why sections differ, and what helps: the product of their factors differs less."""
    if exact > _AGREEMENT:
        return (
            "poles and zeros of so many states are lost to rounding. Reduce the controller first "
            "(reduce_controller)"
        )
    slow = float(np.abs(poles - 1.0).min()) / (2.0 * np.pi * dt)
    return (
        f"a pole at {slow:.3g} Hz is so near z = 1 at a rate of {1.0 / dt:g} Hz that coefficients "
        "in double precision cannot hold it: 1 + a1 + a2 is (w dt)^2. Lower the rate"
    )
