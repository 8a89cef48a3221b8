"""Periodic excitation: no leakage, and noise from the changes between periods."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, frequency_band, generator, positive, whole
from ..errors import ModelError, counted, warn
from ..lti.frequency import Frf, error_statistics
from ..store import Value, checked
from ..tolerances import CHANCE, DEVIATIONS, NEGLIGIBLE, RANK, TINY, TYPED
from .spectra import Records


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Periodic(Value):
    """Estimation of FRFs by averages over the periods of a multisine (or any periodic signal).

    Parameters
    ----------
    period : float [s]
        Period of the signal, which is a whole number of samples. Its inverse is the resolution.
    discard : int
        Number of periods at the start that are not used, because transients still decay in them.
    band : (low, high) [Hz], optional
        Band of the frequencies (lines) that are used. None: all excited lines.

    References
    ----------
    [PintelonSchoukens2012]_, chapter 2.

    Examples
    --------
    A system of gain 2 is measured with a multisine:

    >>> import flexplant as fx
    >>> u = fx.identification.multisine(1, rate=1e3, period=0.1, periods=4, rng=1)[0]
    >>> frf = fx.estimate_frf(u, 2 * u, rate=1e3, method=fx.identification.Periodic(period=0.1))
    >>> abs(frf.data[0, 0, :3]).round(6)
    array([2., 2., 2.])
    """

    period: float = field(metadata=checked(positive, unit="s"))
    discard: int = field(default=1, metadata=checked(whole, minimum=0))
    band: tuple[float, float] | None = field(default=None, metadata=checked(frequency_band))


def periodic_frf(data: Records, method: Periodic, quantity: str | None) -> Frf:
    r"""Return ``G = Y X^H (U X^H)^-1`` from the mean periods; X is U, or R of a reference.

    With one experiment per input this is Y U^-1. Noise e = y - G u is the part that changes between
    periods. It is found at the lines of all P periods together that lie between those of one
    period, where periodic signals have no power; the mean C_e of the P - 1 nearest gives the
    variance

    .. math:: \sigma^2_{oi} = [C_e]_{oo}\,\bigl[(U U^H)^{-1}\bigr]_{ii}

    ([PintelonSchoukens2012]_, section 2.7). A drift leaks equally into these lines and into the
    mean; into the spectrum of each period it leaks up to P times more power.
    """
    n_exp, n_in, n_time = data.u.shape
    samples = round(method.period * data.rate)
    if abs(samples - method.period * data.rate) > TYPED * samples or samples < 4:
        raise ModelError(
            f"a period of {method.period:g} s is {method.period * data.rate:g} samples at "
            f"{data.rate:g} Hz: it must be a whole number from 4, or the spectrum leaks."
        )
    periods = n_time // samples - int(method.discard)
    if periods < 1:
        raise ModelError(
            f"the record holds {n_time / samples:.3g} periods, {method.discard} are discarded: "
            "measure longer, or discard less."
        )
    if n_exp < n_in:
        raise ModelError(
            f"{counted(n_exp, 'experiment')} cannot separate {counted(n_in, 'periodic input')}: "
            "make one per input, with the phases of `multisine`."
        )
    Y, U = (line_spectra(side, samples, periods) for side in (data.y, data.u))
    lines = np.arange(1, (samples + 1) // 2)
    freq = lines / method.period
    X = U if data.r is None else line_spectra(data.r, samples, periods)
    singular = np.linalg.svd(_mean_spectra(X), compute_uv=False)[:, -1]
    keep = singular > NEGLIGIBLE * singular.max(initial=0.0)
    if method.band is not None:
        keep &= (freq >= method.band[0]) & (freq <= method.band[1])
    if not np.any(keep):
        raise ModelError("no line is excited in all directions of the inputs: check the records.")
    sides = data.u if data.r is None else data.r
    periodic = inputs_checked(sides, X[..., keep], samples, data.rate)
    frf = frf_of_periods(
        freq[keep],
        Y[..., keep],
        U[..., keep],
        X[..., keep],
        periods,
        inputs=data.inputs,
        outputs=data.outputs,
        quantity=quantity,
        resolution=1.0 / method.period,
    )
    if periodic:
        y, u = (_each_period(side, samples)[..., keep] for side in (data.y, data.u))
        left = y - np.einsum("oif,eipf->eopf", frf.data, u)
        transient_warned(frf.freq, left, y, method.discard)
    return frf


def frf_of_periods(
    freq: FloatArray,
    Y: ComplexArray,
    U: ComplexArray,
    X: ComplexArray,
    periods: int,
    *,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    quantity: str | None,
    resolution: float,
) -> Frf:
    """Return ``Y X^H (U X^H)^-1`` of `line_spectra` with its variance, correlation, coherence."""
    n_in = U.shape[1]
    y, u, x = _mean_spectra(Y), _mean_spectra(U), _mean_spectra(X)
    xh = x.conj().transpose(0, 2, 1)
    back = u @ xh
    G: Any = np.linalg.solve(back.transpose(0, 2, 1), (y @ xh).transpose(0, 2, 1))
    G = G.transpose(0, 2, 1)
    variance: FloatArray | None = None
    correlation: ComplexArray | None = None
    coherence: FloatArray | None = None
    left, freedom = _noise_spectrum(Y, U, G, periods)
    if freedom > 0:
        # part of the inputs due to the excitation: U X^H (X X^H)^-1 X U^H
        inverse: Any = np.linalg.inv(back @ np.linalg.solve(x @ xh, back.conj().transpose(0, 2, 1)))
        variance, correlation = error_statistics(left, inverse)
        power = np.mean(np.abs(Y[:, :, 0]) ** 2, axis=(0, 2))
        if not np.all(np.einsum("foo->fo", left).real > RANK**2 * power):
            variance = correlation = None  # no noise at all: nothing to weight by
        else:
            # the fraction of the outputs' power in a period that is not noise
            noise = np.einsum("foo->of", left).real
            whole = np.mean(np.abs(y) ** 2, axis=2).T + (periods - 1) * noise
            share = np.clip(1.0 - periods * noise / np.maximum(whole, TINY), 0.0, 1.0)
            coherence = np.repeat(share[:, None, :], n_in, axis=1)
    return Frf(
        freq,
        G.transpose(1, 2, 0),
        inputs=inputs,
        outputs=outputs,
        quantity=quantity,
        coherence=coherence,
        variance=variance,
        correlation=correlation,
        freedom=None if variance is None else float(freedom),
        resolution=resolution,
    )


def offsets(periods: int) -> tuple[Any, FloatArray]:
    """Return offsets j of lines kP + j, zero first, and their weights for the noise at k."""
    near = np.arange(1, periods // 2 + 1)
    # half way to the next line of a period: each line has half the weight
    weight = np.where(2 * near == periods, 0.5, 1.0)
    both = np.concatenate([[0], near, -near])
    return both, np.concatenate([[0.0], weight, weight])


def line_spectra(signals: FloatArray, samples: int, periods: int) -> ComplexArray:
    """Return spectra (..., n_offset, lines) of the last periods at and around lines of one."""
    tail = signals[..., signals.shape[-1] - periods * samples :]
    lines = np.arange(1, (samples + 1) // 2)
    full = np.fft.rfft(tail, axis=-1) / periods
    return np.asarray(full[..., periods * lines + offsets(periods)[0][:, None]])


def _each_period(signals: FloatArray, samples: int) -> ComplexArray:
    """Return spectra (n_exp, n_channel, n_period, lines) of all periods, the last at the end."""
    periods = signals.shape[-1] // samples
    tail = signals[..., signals.shape[-1] - periods * samples :]
    spectra = np.fft.rfft(tail.reshape(*signals.shape[:-1], periods, samples), axis=-1)
    return np.asarray(spectra[..., 1 : (samples + 1) // 2])


def _mean_spectra(spectra: ComplexArray) -> ComplexArray:
    """Return spectra of the mean period (lines, n_channel, n_exp)."""
    return np.asarray(spectra[:, :, 0].transpose(2, 1, 0))


def _noise_spectrum(
    Y: ComplexArray, U: ComplexArray, G: ComplexArray, periods: int
) -> tuple[ComplexArray, int]:
    """Return the noise spectrum of a mean period (lines, n_out, n_out) and its freedom."""
    n_exp, n_in = Y.shape[0], U.shape[1]
    e = Y - np.einsum("foi,eipf->eopf", G, U)
    weight, freedom = offsets(periods)[1], n_exp * (periods - 1)
    if periods == 1:
        weight, freedom = np.ones(1), n_exp - n_in
    left = np.einsum("p,eapf,ebpf->fab", weight, e, e.conj(), optimize=True)
    return np.asarray(left / max(freedom, 1)), freedom


def multisine(
    count: int,
    *,
    rate: float,
    period: float,
    periods: int = 1,
    band: tuple[float, float] | None = None,
    rms: float = 1.0,
    rng: int | np.random.Generator | None = None,
) -> FloatArray:
    r"""Return random-phase multisines for `count` inputs, in `count` orthogonal experiments.

    Input k in experiment e has the spectrum ``U(f) exp(2 pi j e k / count)``, with j the imaginary
    unit. U(f) has a random phase at each excited frequency (line), common to all inputs and
    experiments. The matrix of all inputs in all experiments is therefore orthogonal at every line,
    so that the inputs can be separated with the least error [Dobrowiecki2006]_.

    Parameters
    ----------
    count : int
        Number of inputs, which is also the number of experiments.
    rate : float [Hz]
        Sampling rate of the signals.
    period : float [s]
        Duration of one period, which is a whole number of samples. Its inverse is the distance
        between the lines.
    periods : int
        Number of repetitions of the period in each experiment.
    band : (low, high) [Hz], optional
        Band of the excited lines. None: all lines below half the rate.
    rms : float
        RMS value of each signal.
    rng : int or Generator, optional
        Random generator of the phases, or its seed.

    Returns
    -------
    (count, count, n_time) array
        Signals by experiment, input and time.

    Raises
    ------
    ModelError
        When a number is out of range or no line lies in the band.

    Examples
    --------
    Two experiments with two inputs, each with one period of 500 samples:

    >>> import flexplant as fx
    >>> signals = fx.identification.multisine(2, rate=1e3, period=0.5, rng=1)
    >>> signals.shape  # experiments, inputs, samples
    (2, 2, 500)
    """
    count = whole(count, "count", maximum=1000)
    periods = whole(periods, "periods", maximum=MOST_SAMPLES)
    random = generator(rng)
    if band is not None:
        frequency_band(band)
    exact = positive(period, "period") * positive(rate, "rate")
    samples = round(exact)
    if abs(samples - exact) > TYPED * exact or samples < 4:
        raise ModelError(f"a period must be a whole number of samples from 4, got {exact:g}.")
    if samples * periods * count**2 > MOST_SAMPLES:
        raise ModelError(
            f"{samples} samples a period, {periods} times, from {count} inputs are more than "
            f"memory holds. Shorten the period or lower the rate."
        )
    lines = np.arange(1, (samples + 1) // 2)
    if band is not None:
        lines = lines[(lines >= band[0] * period) & (lines <= band[1] * period)]
    if not lines.size:
        raise ModelError(f"no line of a period of {period:g} s lies in the band {band!r} Hz.")
    phases = np.exp(2j * np.pi * random.random(lines.size))
    turns = np.exp(2j * np.pi * np.outer(np.arange(count), np.arange(count)) / count)
    full = np.zeros((count, count, samples // 2 + 1), dtype=np.complex128)
    full[:, :, lines] = turns[:, :, None] * phases
    waves = np.fft.irfft(full, samples, axis=2)
    waves *= positive(rms, "rms") / np.sqrt(np.mean(waves**2, axis=2, keepdims=True))
    return np.asarray(np.tile(waves, (1, 1, int(periods))))


#: largest number of samples of a signal, limited by memory
MOST_SAMPLES = 10**9


#: ratio of the power of the inputs' lines to that between lines below which they are not periodic
PERIODIC = 10.0
#: ratio of the difference of the inputs after another period below which that period counts as
#: better
BETTER = 0.25
#: number of periods and of lines (3 and 9) over which a transient is searched
MOST, STRETCHES = 12, (3, 9)
#: least fraction of the response in a transient from rest
LEAST = 0.5
#: least fraction of the largest transient within this number of lines
PEAK, NEAR = 0.03, 61
#: fractions of a transient that may remain after a period; a slower transient looks like drift
RADII = np.linspace(0.03, 0.87, 13)


def inputs_checked(x: FloatArray, spectra: ComplexArray, samples: int, rate: float) -> bool:
    r"""Return whether inputs repeat after a period; warn where they do not.

    Judged by the power at lines of a period over that between them (`line_spectra`), and by

    .. math:: D(L) = \sum_t (x_{t+L} - x_t)^2 \Big/ \sum_t (x_{t+L}^2 + x_t^2),

    zero where the signals repeat after L samples and about one where they do not.
    """
    n_time = x.shape[2]
    if n_time < 2 * samples:
        return True
    change = _differences(x)
    here = float(change[samples])
    lags = np.arange(samples // 2, 3 * n_time // 4)
    best = int(lags[np.argmin(change[lags])])
    if here > TYPED and change[best] < BETTER * here:
        warn(
            f"the inputs repeat after {best} samples, {best / rate:.6g} s, more exactly than "
            f"after the stated period of {samples} samples (they change by "
            f"{np.sqrt(change[best]):.2g} and "
            f"{np.sqrt(here):.2g} of their size): period= or rate is wrong, and so is the FRF. "
            f"If the period is right the rate is {rate * best / samples:.6g} Hz."
        )
        return False
    if spectra.shape[2] < 2:
        return True
    power = np.sum(np.abs(spectra) ** 2, axis=(0, 1))
    ratio = float(np.median(power[0] / np.maximum(power[1:].mean(axis=0), TINY)))
    if ratio < PERIODIC:
        warn(
            f"the inputs are not periodic: at half of the lines or more their power is "
            f"{10 * np.log10(ratio):.1f} dB relative to that between the lines, where periodic "
            "signals have no power. Check period= and rate; random excitation needs "
            "identification.H1Estimator(...), blows of a hammer "
            "identification.impact_frf(...), noise that comes back through a "
            "controller reference= or more periods."
        )
        return False
    return True


#: mean fourth power over squared power of pulses that fill 1/60 of a record; noise has 3
PULSES = 60.0


def averages_advised(x: FloatArray, rate: float, window: Any) -> None:
    """Warn where another method suits the inputs better than averages of segments."""
    power = np.mean(x**2, axis=2)
    peaked = np.mean(x**4, axis=2)[power > 0] / power[power > 0] ** 2
    if peaked.size and peaked.min() > PULSES:
        warn(
            "the inputs are pulses: segments of a fixed length cut the responses to blows "
            "anywhere, which adds to their damping. Use identification.impact_frf(force, "
            "response, rate, segment=...), which finds the blows."
        )
        return
    period = _period(x)
    if period and window != "boxcar":
        warn(
            f"the inputs repeat after {period / rate:.6g} s: windowed segments leak and smear "
            "resonances where whole periods do not. Use "
            f"identification.Periodic(period={period / rate:.6g})."
        )


def _period(x: FloatArray) -> int:
    """Return the shortest period of at most half the record [samples], 0 if not periodic."""
    change = _differences(x)[: x.shape[2] // 2 + 1]
    # neighbouring samples of slow signals are similar too
    apart = np.flatnonzero(change > 0.5)
    if not apart.size:
        return 0
    alike = np.flatnonzero(change[apart[0] :] < NEGLIGIBLE) + apart[0]
    if not alike.size:
        return 0
    run = alike[: int(np.argmax(np.diff(alike, append=alike[-1] + 2) > 1)) + 1]
    return int(run[np.argmin(change[run])])


def _differences(x: FloatArray) -> FloatArray:
    """Return D(L) for all L."""
    n_time = x.shape[2]
    size = 2 * n_time
    power = np.sum(np.abs(np.fft.rfft(x, size, axis=2)) ** 2, axis=(0, 1))
    product = np.fft.irfft(power, size)[:n_time]
    energy = np.concatenate([[0.0], np.cumsum(np.sum(x**2, axis=(0, 1)))])
    lag = np.arange(n_time)
    both = energy[n_time - lag] + energy[-1] - energy[lag]
    return np.asarray(np.maximum(1.0 - 2.0 * product / np.maximum(both, TINY), 0.0))


def transient_warned(freq: FloatArray, e: ComplexArray, Y: ComplexArray, discard: int) -> None:
    """Warn of a slowly decaying transient that biases the mean of the periods."""
    # at line k period p is `S_k + tau_k z^p` with `z = exp(lambda T)`, the same for all lines,
    # outputs and experiments that a mode reaches. Over a grid of z the energy that this explains of
    # the periods' spread is compared with the rest by an F-test
    import scipy.ndimage as ndi  # slow imports that few users need
    from scipy.stats import f as fisher

    first = max(0, min(discard, e.shape[2] - 4))
    kept = e.shape[2] - discard
    e = e[:, :, first : first + MOST]
    count = e.shape[2]
    if count < 3 or (count < 4 and not discard):
        return
    e = e - e.mean(axis=2, keepdims=True)
    noise = np.median(np.mean(np.abs(e) ** 2, axis=(0, 2)), axis=-1)
    if not np.all(noise > 0):
        return
    e = e / np.sqrt(noise)[:, None, None]
    seen = np.sum(np.abs(Y[:, :, 0]) ** 2 / noise[:, None], axis=(0, 1))
    shared = np.einsum("eapf,ebpf->ab", e, e.conj())
    outputs = float(np.trace(shared).real ** 2 / np.sum(np.abs(shared) ** 2))
    spread = np.einsum("eopf,eoqf->fpq", e, e.conj(), optimize=True).reshape(freq.size, -1)
    z = (RADII[:, None] * np.exp(2j * np.pi * np.arange(48) / 48)).ravel()
    powers = z[:, None] ** np.arange(count)
    mean = np.array(
        [np.mean(one ** np.arange(discard - first, discard - first + kept)) for one in z]
    )
    centred = powers - powers.mean(axis=1, keepdims=True)
    size = np.sum(np.abs(centred) ** 2, axis=1)
    pattern = np.einsum("zp,zq->zpq", centred.conj(), centred).reshape(z.size, -1)
    # more periods to discard, the line, the fraction that remains after one period, the bias
    worst = (0, 0, 0.0, 0.0)
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
        # a line that explains everything leaves rounding
        rest = np.maximum(total - mine, 1e-12 * total) / (count - 2)
        freedom = 2.0 * length * e.shape[0] * outputs
        limit = fisher.isf(CHANCE / (freq.size * z.size), freedom, freedom * (count - 2))
        # relative to the first period of the whole record: a transient from rest is as large as the
        # response
        tau = mine / size[best]
        start = tau * np.abs(z[best]) ** (-2.0 * first)
        power: Any = ndi.uniform_filter1d(seen, **ones) * length
        # between resonances slow vibration caused by noise looks like a decay
        peak = mine > PEAK * ndi.maximum_filter1d(mine, NEAR)
        bias = tau * np.abs(mean[best]) ** 2 / (rest / kept)
        for k in np.flatnonzero(
            (mine > limit * rest) & (bias > DEVIATIONS**2) & peak & (start > LEAST**2 * power)
        ):
            decay = float(np.abs(z[best[k]]))
            more = int(np.ceil(np.log(10.0 * bias[k]) / (-2.0 * np.log(decay))))
            if more > worst[0]:
                worst = (more, int(k), decay, float(np.sqrt(bias[k])))
    more, line, decay, off = worst
    if more:
        warn(
            f"a transient has not decayed in the kept periods: near {freq[line]:.4g} Hz "
            f"{decay:.0%} of it remains after a period and biases the FRF by {off:.2g} "
            "standard deviations of its noise; damping and the number of modes would be wrong. "
            f"Measure {more} periods more and discard {discard + more}, "
            f"discard={discard + more}, or excite the machine for this time before recording."
        )
