"""The Nyquist count: stability of a loop of which only the frequency response is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..lti.responses import Responder
from ..values import ComplexArray, FloatArray

#: phase step of det(I - L) between two lines above which its path is not known, and how far its
#: ends may be from where they have to end
_STEP, _END = 0.6 * np.pi, 0.25 * np.pi
#: what the slope of |det(I - L)| at the lowest lines may differ from the number of integrators
_SLOPE = 0.75
#: how far, beside the lowest line, a measured plant is continued to lower frequencies
_BELOW = 1e-3


class NyquistCount(NamedTuple):
    """Unstable poles of a closed loop by the argument principle; None: the reason says why.

    Parameters
    ----------
    unstable : int or None
        Poles of the closed loop outside the stability region.
    reason : str
        Why they could not be counted.
    """

    unstable: int | None
    reason: str = ""


def nyquist_count(
    freq: FloatArray, L: ComplexArray, *, at_zero: int, unstable: int
) -> NyquistCount:
    """Return the unstable poles of ``u = L u``, counted on the lines that are known.

    From 0+ to the highest frequency the argument of ``F = det(I - L)`` changes by
    ``pi (P + n0 / 2 - Z)``: P unstable and n0 integrating poles of L, Z unstable ones of the loop.
    Below the lines F continues as ``c / (i w)^n0``, c real; above them it ends positive.

    Parameters
    ----------
    freq : (n_freq,) array [Hz]
        Increasing, positive.
    L : (n_freq, m, m) complex array
        The loop gain; the critical point is +1.
    at_zero, unstable : int
        n0 and P: poles of plant and controller at zero frequency, and outside the stability region.
    """
    F = np.linalg.det(np.eye(L.shape[-1]) - L)
    if freq.size < 3 or not np.all(np.abs(F) > 0.0):
        return NyquistCount(None, "fewer than 3 lines, or one on the critical point")
    steps = np.angle(F[1:] / F[:-1])
    worst = int(np.argmax(np.abs(steps)))
    if abs(steps[worst]) > _STEP:
        return NyquistCount(
            None,
            f"the phase turns by {np.degrees(abs(steps[worst])):.0f} deg between the lines at "
            f"{freq[worst]:.4g} and {freq[worst + 1]:.4g} Hz: measure with a finer resolution "
            "there, or give the loop less gain at that resonance",
        )
    slope = -float(np.polyfit(np.log(freq[:3]), np.log(np.abs(F[:3])), 1)[0])
    if abs(slope - at_zero) > _SLOPE:
        return NyquistCount(
            None,
            f"towards zero frequency det(I - L) grows with slope {slope:.2g}, where plant and "
            f"controller were stated to integrate {at_zero} times: state the rigid-body modes that "
            "these channels show",
        )
    first, last = float(np.angle(F[0])), float(np.angle(F[-1]))
    start = first + 0.5 * np.pi * at_zero  # the argument of c: a multiple of pi
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
    return NyquistCount(round(count))


def continued(
    freq: FloatArray, plant: ComplexArray, controller: Responder, slope: int
) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies and K P (n_freq, nu, nu) of a measured plant, also below its lines.

    There the controller is known, and the plant is that of the lowest line: its real part over
    ``f^slope``, its imaginary part (delay) less by a factor of frequency.

    Parameters
    ----------
    freq : (n_freq,) array [Hz]
        The lines.
    plant : (ny, nu, n_freq) complex array
        P there.
    controller : function of frequency
        K (nu, ny, n_freq).
    slope : int
        2 for a free rigid body, 0 for a held structure.
    """
    low = np.geomspace(_BELOW, 1.0, 150)[:-1]
    first = plant[:, :, :1]
    below = (first.real + 1j * low * first.imag) / low**slope
    every = np.concatenate([low * freq[0], freq])
    P = np.concatenate([below, plant], axis=2)
    return every, np.einsum("uyf,yvf->fuv", controller(every), P)
