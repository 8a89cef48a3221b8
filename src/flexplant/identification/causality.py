"""The sign of time in an FRF: responses follow their forces, and modes decay."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..errors import warn
from ..lti.frequency import Frf
from .diagram import affordable, line_windows, moments_in
from .line_weights import PreparedLines, prepared_lines

#: number of times of the impulse response examined on either side of zero
TIMES = 96
#: the main lobe of the spectrum of a Hann window over a band B ends at 2/B
LOBE = 2.0
#: ratio of the residual of stable modes for the conjugate to that for the data, below which the
#: conjugate is used; with noise as large as the responses both are equal
BETTER = 0.8
#: largest damping ratio of a mode; powers of frequency for modes outside of the band
DAMPED, POWERS = 0.2, np.arange(-2, 3)


def forward_in_time(frf: Frf, band: Any) -> Frf:
    r"""Return an FRF in the convention exp(i omega t), conjugated if it was in exp(-i omega t).

    The impulse response of a stable machine is zero before the force, that of the conjugate after
    it. Where more energy ``\int |h(t)|^2 dt`` lies before than after the force, the conjugate is
    used if stable modes fit it better than the given FRF.
    """
    ready = prepared_lines(frf, band)
    rows = ready.data.reshape(-1, ready.freq.size)
    if not _earlier(ready.freq, rows):
        return frf
    mean = frf.correlation
    turned = frf.replace(data=frf.data.conj(), correlation=None if mean is None else np.conj(mean))
    if _stable_misfit(prepared_lines(turned, band)) > BETTER * _stable_misfit(ready):
        return frf
    warn(
        "the FRF responds before its forces act: it uses the convention exp(-i omega t), which "
        "has the opposite sign of all imaginary parts. Its conjugate is used. Pass "
        "frf.replace(data=frf.data.conj())."
    )
    return turned


def _earlier(freq: FloatArray, data: ComplexArray) -> bool:
    """Return whether responses (n, n_freq) on average have more energy before zero than after."""
    # by the trapezoidal rule over lines of any spacing; a Hann window confines the effect of the
    # band ends to times near zero
    step, band = np.gradient(freq), freq[-1] - freq[0]
    rows = data * np.sin(np.pi * (freq - freq[0]) / band) ** 2
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows * step / np.where(size > 0, size, 1.0)
    # lines a step apart repeat the response after 1/step: half of that belongs to either side
    time = np.geomspace(LOBE / band, 0.5 / float(np.median(step)), TIMES)
    turn = np.exp(2j * np.pi * np.outer(freq, time))
    after, before = (np.sum(np.abs(rows @ one) ** 2, axis=0) @ time for one in (turn, turn.conj()))
    return bool(before > after)


def _stable_misfit(ready: PreparedLines) -> float:
    """Return the weighted squared error that the stable poles of a matrix fraction leave."""
    order, left = affordable(None, ready)[-1], 0.0
    for _, seen in line_windows(ready):
        freq = ready.freq[seen]

        def stable(poles: ComplexArray, freq: FloatArray = freq) -> Any:
            inside = (poles.imag > 2 * np.pi * freq[0]) & (poles.imag < 2 * np.pi * freq[-1])
            return inside & (poles.real < 0) & (poles.real > -DAMPED * np.abs(poles))

        poles = moments_in(ready, seen, order).solve(order, stable).poles
        terms = [1 / (2j * np.pi * freq[:, None] - poles), (freq[:, None] / freq[-1]) ** POWERS]
        for weight, data in zip(ready.line_weight[:, seen], ready.data[:, :, seen], strict=True):
            columns = np.hstack(terms) * weight[:, None]
            columns = columns / np.linalg.norm(columns, axis=0)
            due = (weight * data).T
            fitted = columns @ np.linalg.lstsq(columns, due, rcond=None)[0]
            left += float(np.sum(np.abs(due - fitted) ** 2))
    return left
