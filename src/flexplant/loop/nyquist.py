"""The Nyquist count: stability of a loop of which only the frequency response is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..lti.responses import Responder
from ..values import ComplexArray, FloatArray
from .hidden_modes import HiddenModes

#: how far the phase of det(I - L) may be from where its ends have to be
_END = 0.25 * np.pi
#: what the slope of |det(I - L)| at the lowest lines may differ from the number of integrators
_SLOPE = 0.75
#: how far, beside the lowest line, a measured plant is continued to lower frequencies
_BELOW = 1e-3


class NyquistCount(NamedTuple):
    """Unstable poles of a closed loop by the argument principle; None: the reason says why."""

    unstable: int | None
    reason: str = ""
    narrowest: float = 0.0
    near: float = 0.0


def nyquist_count(
    lines: FloatArray,
    plant: ComplexArray,
    controller: Responder,
    hidden: HiddenModes,
    *,
    slope: int,
    at_zero: int,
    unstable: int,
) -> NyquistCount:
    """Return the unstable poles of ``u = K P u``, counted on the lines and what lies between them.

    From 0+ to the highest frequency the argument of ``F = det(I - K P)`` changes by
    ``pi (p + n0 / 2 - z)``: p unstable and n0 integrating poles of K P, z unstable ones of the
    loop. Below the lines F continues as ``c / (i w)^n0``, c real; above them it ends positive.
    """
    freq, L = _continued(lines, plant, controller, slope)
    F = np.linalg.det(np.eye(L.shape[-1]) - L)
    if not np.all(np.abs(F) > 0.0):
        return NyquistCount(None, "a line lies on the critical point")
    below_lines = freq.size - lines.size
    below = np.angle(F[1 : below_lines + 1] / F[:below_lines])
    steps = np.concatenate([below, hidden.step])
    for open_, what in (
        (hidden.unknown, "the phase turns too far for its path to be known"),
        (hidden.undecided, "lies a mode that is unstable in the loop if it is a little narrower"),
    ):
        if open_.any():
            worst = int(np.argmax(open_))
            return NyquistCount(
                None,
                f"between the lines at {lines[worst]:.4g} and {lines[worst + 1]:.4g} Hz {what}: "
                "measure with a finer resolution there, or give the loop less gain at that "
                "resonance",
            )
    grows = -float(np.polyfit(np.log(freq[:3]), np.log(np.abs(F[:3])), 1)[0])
    if abs(grows - at_zero) > _SLOPE:
        return NyquistCount(
            None,
            f"towards zero frequency det(I - L) grows with slope {grows:.2g}, where plant and "
            f"controller were stated to integrate {at_zero} times: state the rigid-body modes that "
            "these channels show",
        )
    last = float(np.angle(F[-1]))
    start = float(np.angle(F[0])) + 0.5 * np.pi * at_zero  # the argument of c: a multiple of pi
    low = start - np.pi * np.round(start / np.pi)
    for miss, place, where in ((low, freq[0], "lower"), (last, freq[-1], "higher")):
        if abs(miss) > _END:
            return NyquistCount(
                None,
                f"at {place:.4g} Hz the loop gain has not reached its limit (the phase is "
                f"{np.degrees(abs(miss)):.0f} deg off): measure at {where} frequencies",
            )
    change = low + float(np.sum(steps)) - last
    count = unstable + 0.5 * at_zero - change / np.pi
    if abs(count - round(count)) > 0.05 or round(count) < 0:
        return NyquistCount(
            None,
            f"the phase turns so that {count:.3g} poles would be unstable: state the rigid-body "
            "and the unstable poles that the plant has",
        )
    widest = int(np.argmax(hidden.width))
    return NyquistCount(
        round(count),
        "",
        float(hidden.width[widest]),
        float(0.5 * np.sum(lines[widest : widest + 2])),
    )


def _continued(
    freq: FloatArray, plant: ComplexArray, controller: Responder, slope: int
) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies and K P (n_freq, nu, nu) of a measured plant, also below its lines.

    There the controller is known, and the plant is that of the lowest line: its real part over
    ``f^slope``, its imaginary part (delay) less by a factor of frequency.
    """
    low = np.geomspace(_BELOW, 1.0, 150)[:-1]
    first = plant[:, :, :1]
    below = (first.real + 1j * low * first.imag) / low**slope
    every = np.concatenate([low * freq[0], freq])
    P = np.concatenate([below, plant], axis=2)
    return every, np.einsum("uyf,yvf->fuv", controller(every), P)
