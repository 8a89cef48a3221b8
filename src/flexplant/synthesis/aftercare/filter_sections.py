"""second_order_sections: a sampled controller channel by channel, as filters in series."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...errors import CertificateError, ModelError
from ...lti.frequency import frequency_response
from ...lti.grid import resonance_grid
from ...lti.minimal import minimal
from ...lti.statespace import StateSpace, as_statespace
from ...values import FloatArray

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
        When the sections differ from the channel by more than 1e-6 of its largest gain.
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
            "sections are of a sampled controller: discretise_controller(plant, controller) first."
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
    z = np.exp(2j * np.pi * grid * (g.dt or 1.0))
    at = int(np.argmax(np.abs(wanted)))
    shape = np.prod(z[at] - zeros) / np.prod(z[at] - poles)
    gain = float((wanted[at] / shape).real)
    sections = np.asarray(zpk2sos(zeros, poles, gain, pairing="nearest"), dtype=np.float64)
    got = np.ones(z.size, dtype=np.complex128)
    for b0, b1, b2, a0, a1, a2 in sections:
        got *= (b0 + b1 / z + b2 / z**2) / (a0 + a1 / z + a2 / z**2)
    off = float(np.abs(got - wanted).max()) / size
    if not off <= _AGREEMENT:
        raise CertificateError(
            f"the sections of {g.outputs[0]!r} from {g.inputs[0]!r} differ from it by {off:.1e} of "
            "its largest gain: poles and zeros of so many states are lost to rounding. Reduce the "
            "controller first (reduce_controller), or export its states (write_c)."
        )
    return sections
