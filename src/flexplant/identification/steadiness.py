"""Whether periodic records are periodic: inputs repeat, and outputs have stopped decaying."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import warn
from ..values import ComplexArray, FloatArray

#: power of the inputs' lines over what lies between them below which they are not periodic
PERIODIC = 10.0
#: a period counts as better when the inputs repeat after it with this share of the difference
BETTER = 0.25
#: differences below this share of the inputs are rounding or the last digit of a file
SAME = 1e-6
#: periods and lines (3 and 9) over which a transient is looked for
MOST, STRETCHES = 12, (3, 9)
#: share of the response that a transient from rest has at least
LEAST = 0.5
#: share of the largest one within so many lines that it has at least
PEAK, NEAR = 0.03, 61
#: shares of a transient that may be left after a period; a slower one looks like drift
RADII = (0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.86)
#: standard deviations of the noise of the mean that it biases the mean by, at least
VISIBLE = 2.0
#: probability of a false alarm anywhere
CHANCE = 1e-3


def inputs_checked(x: FloatArray, spectra: ComplexArray, samples: int, rate: float) -> bool:
    r"""Return whether inputs repeat after a period; warn where they do not.

    Judged by the power at lines of a period over that between them (`line_spectra`), and by

    .. math:: D(L) = \sum_t (x_{t+L} - x_t)^2 \Big/ \sum_t (x_{t+L}^2 + x_t^2),

    zero where the signals repeat after L samples and about one where they do not.
    """
    n_time = x.shape[2]
    if n_time < 2 * samples:
        return True
    change = _change(x)
    here = float(change[samples])
    lags = np.arange(samples // 2, 3 * n_time // 4)
    best = int(lags[np.argmin(change[lags])])
    if here > SAME and change[best] < BETTER * here:
        warn(
            f"the inputs repeat after {best} samples, {best / rate:.6g} s, better than after the "
            f"stated period of {samples} samples (they change by {np.sqrt(change[best]):.2g} and "
            f"{np.sqrt(here):.2g} of their size): period= or rate is wrong, and the FRF with it. "
            f"If the period is right the rate is {rate * best / samples:.6g} Hz."
        )
        return False
    if spectra.shape[2] < 2:
        return True
    power = np.sum(np.abs(spectra) ** 2, axis=(0, 1))
    ratio = float(np.median(power[0] / np.maximum(power[1:].mean(axis=0), 1e-300)))
    if ratio < PERIODIC:
        warn(
            f"the inputs are not periodic: at half of the lines or more their power is "
            f"{10 * np.log10(ratio):.1f} dB of what lies between the lines, where periodic "
            "signals have nothing. Check period= and rate; random excitation needs "
            "H1Estimator(...), noise that comes back through a controller reference= or more "
            "periods."
        )
        return False
    return True


def _change(x: FloatArray) -> FloatArray:
    """Return D(L) for all L."""
    n_time = x.shape[2]
    size = 2 * n_time
    power = np.sum(np.abs(np.fft.rfft(x, size, axis=2)) ** 2, axis=(0, 1))
    product = np.fft.irfft(power, size)[:n_time]
    energy = np.concatenate([[0.0], np.cumsum(np.sum(x**2, axis=(0, 1)))])
    lag = np.arange(n_time)
    both = energy[n_time - lag] + energy[-1] - energy[lag]
    return np.asarray(np.maximum(1.0 - 2.0 * product / np.maximum(both, 1e-300), 0.0))


@dataclass(frozen=True)
class Transient:
    """A decay seen in periods: where [Hz], its share left after a period, and what cures it."""

    freq: float
    decay: float
    bias: float  # of the mean period, in standard deviations of its noise
    more: int  # periods to discard beyond those discarded


def transient(
    freq: FloatArray, e: ComplexArray, Y: ComplexArray, *, discard: int
) -> Transient | None:
    r"""Return the slowest decay of what periods leave, where it biases their mean.

    At line k period p is ``S_k + tau_k z^p`` with ``z = exp(lambda T)``, the same for all lines,
    outputs and experiments that a mode reaches. Over a grid of z the energy that this explains
    of the periods' spread is compared with the rest by an F-test.
    """
    import scipy.ndimage as ndi  # both cost a tenth of a second that few need
    from scipy.stats import f as fisher

    first = max(0, min(discard, e.shape[2] - 4))
    kept = e.shape[2] - discard
    e = e[:, :, first : first + MOST]
    count = e.shape[2]
    if count < 3 or (count < 4 and not discard):
        return None
    e = e - e.mean(axis=2, keepdims=True)
    noise = np.median(np.mean(np.abs(e) ** 2, axis=(0, 2)), axis=-1)
    if not np.all(noise > 0):
        return None
    e = e / np.sqrt(noise)[:, None, None]
    seen = np.sum(np.abs(Y[:, :, 0]) ** 2 / noise[:, None], axis=(0, 1))
    shared = np.einsum("eapf,ebpf->ab", e, e.conj())
    outputs = float(np.trace(shared).real ** 2 / np.sum(np.abs(shared) ** 2))
    spread = np.einsum("eopf,eoqf->fpq", e, e.conj(), optimize=True).reshape(freq.size, -1)
    z = (np.array(RADII)[:, None] * np.exp(2j * np.pi * np.arange(48) / 48)).ravel()
    powers = z[:, None] ** np.arange(count)
    mean = np.array(
        [np.mean(one ** np.arange(discard - first, discard - first + kept)) for one in z]
    )
    centred = powers - powers.mean(axis=1, keepdims=True)
    size = np.sum(np.abs(centred) ** 2, axis=1)
    pattern = np.einsum("zp,zq->zpq", centred.conj(), centred).reshape(z.size, -1)
    found: Transient | None = None
    for length in STRETCHES:
        if length > freq.size:
            break
        ones: Any = {"size": length, "axis": 0, "mode": "constant"}
        local: Any = ndi.uniform_filter1d(spread.real, **ones) * length
        local = local + 1j * ndi.uniform_filter1d(spread.imag, **ones) * length
        total = np.trace(local.reshape(-1, count, count), axis1=1, axis2=2).real
        explained = (pattern @ local.T).real / size[:, None]
        best = np.argmax(explained, axis=0)
        mine = explained[best, np.arange(freq.size)]
        rest = np.maximum(total - mine, 1e-12 * total) / (count - 2)
        freedom = 2.0 * length * e.shape[0] * outputs
        limit = fisher.isf(CHANCE / (freq.size * z.size), freedom, freedom * (count - 2))
        # of the whole record's first period: a transient from rest is of the response's size
        tau = mine / size[best]
        start = tau * np.abs(z[best]) ** (-2.0 * first)
        power: Any = ndi.uniform_filter1d(seen, **ones) * length
        # between resonances slow vibration made by noise looks like a decay
        peak = mine > PEAK * ndi.maximum_filter1d(mine, NEAR)
        bias = tau * np.abs(mean[best]) ** 2 / (rest / kept)
        for k in np.flatnonzero(
            (mine > limit * rest) & (bias > VISIBLE**2) & peak & (start > LEAST**2 * power)
        ):
            decay = float(np.abs(z[best[k]]))
            more = int(np.ceil(np.log(10.0 * bias[k]) / (-2.0 * np.log(decay))))
            if found is None or more > found.more:
                found = Transient(float(freq[k]), decay, float(np.sqrt(bias[k])), more)
    return found


def transient_warned(found: Transient | None, discard: int) -> None:
    """Warn of a transient that has not died away in the periods kept."""
    if found is None:
        return
    warn(
        f"a transient has not died away in the periods kept: near {found.freq:.4g} Hz "
        f"{found.decay:.0%} of it is left after a period, and biases the FRF by {found.bias:.2g} "
        "standard deviations of its noise; damping and the number of modes would be wrong. "
        f"Measure {found.more} periods more and discard {discard + found.more}, "
        f"discard={discard + found.more}, or shake so long before recording."
    )
