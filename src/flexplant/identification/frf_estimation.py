"""Frequency responses from time records, with a test for bias by feedback."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, members
from ..errors import ModelError, ShapeError, warn
from ..lti.frequency import Frf
from ..tolerances import TINY
from .periodic import Periodic, averages_advised, periodic_frf
from .spectra import H1Estimator, SpectralMethod, dropouts_warned, records, spectral_frf

#: number of samples next to zero lag that delays between channels and the taper affect
GUARD = 8
#: fraction of the lags of a segment that is used: beyond it, longer vibrations fold back
LOOKED = 0.25
#: number of lines over which power is averaged: with a quarter of the lags about ten are
#: independent
STRETCH = 41
#: fraction of the band above which only rounding remains after the taper
HIGHEST = 0.7
#: ratio of the power to that of noise: chi-square with 20 degrees of freedom exceeds 4 with
#: probability 1e-8
SEEN = 16.0
#: fraction of the response below which it is leakage of the window or of channel filters
LEAST = 0.05


def feedback_warned(frf: Frf) -> None:
    r"""Warn of an FRF that responds before its input acts, because feedback biases it.

    With ``u = r - K y`` and noise v on y the direct estimate tends to

    .. math:: S_{yu} S_{uu}^{-1} = \frac{G S_{rr} - K^* S_{vv}}{S_{rr} + |K|^2 S_{vv}}

    where K^* acts before its input: it has an impulse response at negative times
    ([PintelonSchoukens2012]_, section 2.6.4). When set-points are the only excitation,
    ``u = K (r - y)``, noise gives a bias of 1/K, which is causal and not detected. Lines are
    multiplied by s^2 and a taper, so that neither rigid-body modes nor the end of the band spread
    over all lags. The test applies to Hann-windowed segments only: with others, vibrations at the
    end of a segment fold to these times.
    """
    import scipy.ndimage as ndi

    n = frf.freq.size
    if frf.window != "hann" or frf.variance is None or frf.resolution is None or n < 4 * STRETCH:
        return
    lines = np.arange(1, n + 1)
    if not np.allclose(frf.freq, lines * frf.resolution):
        return
    weight = (lines / n) ** (0.0 if frf.quantity == "acceleration" else 2.0) * _taper(lines / n)
    size = 2 * (n + 1)
    lag = np.arange(size)
    early = size - lag  # samples before the input
    end = LOOKED * size
    window = np.where((early > GUARD) & (early < end), np.cos(0.5 * np.pi * early / end) ** 2, 0.0)
    spectrum = np.zeros((*frf.data.shape[:2], n + 2), dtype=np.complex128)
    spectrum[..., 1:-1] = frf.data * weight
    power = np.zeros(spectrum.shape)
    power[..., 1:-1] = frf.variance * weight**2
    seen = np.abs(np.fft.rfft(np.fft.irfft(spectrum, size) * window)) ** 2
    # number of independent lines, from the width of the window's spectrum
    spread = np.abs(np.fft.fft(window) / size) ** 2
    both = np.concatenate([power, power[..., -2:0:-1]], axis=-1)
    noise = np.fft.irfft(np.fft.rfft(both) * np.fft.rfft(spread), size)[..., : n + 2]
    seen, noise, whole = (
        ndi.uniform_filter1d(power, STRETCH, axis=-1, mode="nearest")
        for power in (seen, noise, np.abs(spectrum) ** 2)
    )
    ratio = seen / np.maximum(noise, TINY)
    share = np.sqrt(seen / np.maximum(whole, TINY))
    score: Any = np.where((ratio > SEEN) & (share > LEAST), ratio, 0.0)[..., 1:-1]
    score[..., :STRETCH] = score[..., round(HIGHEST * n) :] = 0.0
    if not score.any():
        return
    o, i, f = np.unravel_index(int(np.argmax(score)), score.shape)
    warn(
        f"the records were made in closed loop: near {frf.freq[f]:.4g} Hz "
        f"{share[o, i, f + 1]:.1%} of the response, {np.sqrt(ratio[o, i, f + 1]):.2g} times its "
        "noise, come before the input acts. Noise that returns through a controller has this "
        "effect. The direct estimate S_yu/S_uu is biased "
        "there towards -1/K, by at least this fraction, and so are poles. Record the excitation or "
        "set-point and pass reference=, or use whole periods, identification.Periodic(...)."
    )


def _taper(x: FloatArray) -> FloatArray:
    """Return 1 at zero and 0 at one, with an impulse response that dies within a few samples."""
    from scipy.signal.windows import kaiser

    both = kaiser(2049, 12.0)
    return np.asarray(np.interp(x, np.linspace(0.0, 1.0, 1025), both[1024:]))


Signals: TypeAlias = npt.ArrayLike | Mapping[str, Any]


def estimate_frf(
    inputs: Signals,
    outputs: Signals,
    rate: float,
    *,
    reference: Signals | None = None,
    method: SpectralMethod | Periodic | None = None,
    quantity: str | None = None,
) -> Frf:
    r"""Return the FRFs from inputs to outputs, with coherence and variance per line.

    | method | estimate |
    |---|---|
    | ``H1Estimator(...)`` | S_yu S_uu^-1: noise on the outputs, open loop |
    | ``H2Estimator(...)`` | S_yy S_uy^-1: noise on the inputs |
    | ``HvEstimator(...)`` | total least squares: noise on both |
    | ``Periodic(...)`` | Y U^-1 of mean periods: no leakage, noise on both |
    | with ``reference=r`` | S_yr S_ur^-1: under feedback (joint input-output) |
    | `impact_frf` | hammer blows, found in the record |

    S_ab is the matrix of cross spectra between the signals a and b: inputs u, outputs y and
    references r. Y and U are the Fourier transforms of the outputs and inputs.

    A levitated machine is measured under feedback. Noise then returns to the inputs through the
    controller K, and H1 is biased towards ``-1/K``. A reference r avoids this bias. It is a
    set-point, or an excitation that is added to the commands. There must be one reference for each
    input, and it must not be correlated with the noise. The references give the process sensitivity
    ``PS = S_yr S_rr^-1`` and the sensitivity ``S = S_ur S_rr^-1``. The plant is the quotient
    ``PS S^-1`` (the three-point method). The inputs are the signals that act on the machine: the
    commands plus the added excitation. Periodic signals need as many experiments as inputs, with
    and without a reference. Averaging over their periods reduces the noise before the division.

    Parameters
    ----------
    inputs : (n_in, n_time) or (n_exp, n_in, n_time) array, or mapping
        Signals that act on the machine. A mapping {name: (n_time,) or (n_exp, n_time) array} also
        gives their names.
    outputs : (n_out, n_time) or (n_exp, n_out, n_time) array, or mapping
        Measured signals, in the same form.
    rate : float [Hz]
        Sampling rate of the records.
    reference : array or mapping, optional
        References r of a measurement under feedback, one signal for each input.
    method : H1Estimator, H2Estimator, HvEstimator or Periodic
        Method of averaging. None: ``H1Estimator()``.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        Quantity of the outputs. `Frf.converted` can convert the result to another quantity.

    Returns
    -------
    Frf
        Responses with their `coherence`, the `variance` E|error|^2 of every entry and the
        `correlation` of the errors of different outputs. The coherence of an output is the multiple
        coherence with all inputs together. These three are None for a single period, which contains
        no information on noise. The Frf also stores the `resolution`, and the `window` and
        `overlap` of segments.

    Warns
    -----
    FlexplantWarning
        When an output keeps one value for longer than quantisation explains (drop-out). When
        segments are averaged although the inputs are periodic (use `Periodic`) or are pulses (use
        `impact_frf`). When `Periodic` is used and the inputs do not repeat after the given period.
        When a transient has not decayed. The warning then gives the number of periods to discard.

        Without a reference, when the machine seems to respond before its inputs act. This shows
        that noise returns through a controller and biases the estimate. The bias is not detected
        when set-points are the only excitation. Always pass a reference in closed loop. With a
        reference, the warning names lines at which the inputs are mostly noise.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When records do not match or are too short, or when the inputs are linearly dependent.

    References
    ----------
    [BendatPiersol2010]_, ch. 6, 7 and 9 (estimators, coherence, variance);
    [PintelonSchoukens2012]_, ch. 2, 3 and 7 (periodic, under feedback).

    Examples
    --------
    A system of gain 2 is measured with a multisine:

    >>> from flexplant.identification import Periodic, estimate_frf, multisine
    >>> u = multisine(1, rate=100.0, period=1.0, periods=3, rng=1)
    >>> y = 2.0 * u
    >>> frf = estimate_frf({"force": u[:, 0]}, y, 100.0, method=Periodic(period=1.0))
    >>> print(frf, f"{abs(frf['y1', 'force'][0]):.3f}")
    <Frf: force -> y1, 49 frequencies 1 .. 49 Hz> 2.000

    In closed loop, u = r - 0.3 y with y = 2 u + noise, the direct estimate is too small:

    >>> import numpy as np
    >>> r, v = np.random.default_rng(1).normal(size=(2, 1, 20_000))
    >>> y = (2.0 * r + v) / 1.6
    >>> frfs = [estimate_frf(r - 0.3 * y, y, 100.0, reference=ref) for ref in (None, r)]
    >>> [f"{np.mean(frf.data.real):.1f}" for frf in frfs]
    ['1.6', '2.0']
    """
    data = records(inputs, outputs, reference, rate, quantity)
    dropouts_warned(data)
    method = H1Estimator() if method is None else method
    if isinstance(method, Periodic):
        return periodic_frf(data, method, quantity)
    if isinstance(method, SpectralMethod):
        averages_advised(data.u if data.r is None else data.r, data.rate, method.window)
        frf = spectral_frf(data, method, quantity)
        if data.r is None:
            feedback_warned(frf)
        return frf
    raise ModelError(
        "method is identification.H1Estimator(...), identification.H2Estimator(...), "
        "identification.HvEstimator(...) or identification.Periodic(...), got "
        f"{type(method).__name__}."
    )


def average_frfs(repeated: Iterable[Frf]) -> Frf:
    r"""Return the mean of repeated FRFs, with variance and correlation from their spread.

    .. math:: \sigma^2_{oi} = \frac{1}{R (R-1)} \sum_r |G^{(r)}_{oi} - \bar G_{oi}|^2

    Here R is the number of repetitions, G^(r) is repetition r, and o and i number the outputs and
    inputs. The noise of an output does not depend on which input is excited, and the FRF is the
    output divided by the input. The true variance is therefore the product of a factor of the
    output (its noise) and a factor of the input (the inverse of its power). The variance from a few
    repetitions is smoothed to such a product, which is ``mean_i(sigma^2_oi) mean_o(sigma^2_oi) /
    mean(sigma^2)``. The correlation of the errors of two outputs is a mean over the inputs. The
    degrees of freedom of the variance (`freedom`) follow from R, the number of inputs, and the
    number of outputs with independent errors.

    Use another `rng` of `multisine` for each run. With the same signal and no dither, the
    quantisation error is equal in every run. It is then not part of the spread, and the variance is
    28 to 300 times too small. If the machine drifts between runs, do not average them, but pass the
    list of runs to `identify_modes`. Their mean would have resonances that are too broad, with
    errors larger than its standard deviations.

    Parameters
    ----------
    repeated : iterable of at least two Frf
        Measurements of the same channels, frequencies and quantity, with independent noise. Take at
        least four, so that the variances are useful as weights of a fit.

    Raises
    ------
    ShapeError, ModelError
        When there are fewer than two measurements, when their channels, frequencies or quantities
        differ, or when all measurements are identical.

    References
    ----------
    [PintelonSchoukens2012]_, chapter 2.

    Examples
    --------
    Two repetitions of a measurement at two frequencies:

    >>> import flexplant as fx
    >>> runs = [fx.Frf([10.0, 20.0], [[[1.0 - e, 2.0 + e]]]) for e in (-0.1, 0.1)]
    >>> mean = fx.identification.average_frfs(runs)
    >>> mean.data.real
    array([[[1., 2.]]])
    >>> mean.variance.round(4)
    array([[[0.01, 0.01]]])
    """
    frfs = repetitions(repeated)
    first = frfs[0]
    data = np.array([frf.data for frf in frfs])
    mean: ComplexArray = data.mean(axis=0)
    error = data - mean
    count = len(frfs)
    spread = np.sum(np.abs(error) ** 2, axis=0) / (count * (count - 1))
    if not np.all(spread > 0):
        raise ModelError("the measurements are identical at some lines: repeat with new noise.")
    over_inputs, over_outputs = spread.mean(axis=1), spread.mean(axis=0)
    variance = over_inputs[:, None] * over_outputs[None] / spread.mean(axis=(0, 1))
    shared = np.einsum("raif,rbif->abf", error, error.conj())
    size = np.sqrt(np.einsum("aaf->af", shared).real)
    correlation = shared / (size[:, None] * size[None])
    rows = np.arange(data.shape[1])
    correlation[rows, rows] = 1.0
    return first.replace(
        data=mean,
        coherence=None,
        variance=variance,
        correlation=correlation,
        freedom=_freedom(correlation, size, count - 1, data.shape[2]),
    )


def _freedom(correlation: ComplexArray, size: FloatArray, spare: int, n_in: int) -> float:
    """Return the complex degrees of freedom of variances of product form."""
    # to first order the relative variances of the three means add up, minus their common part:
    # `1/nu = (1/n_in + 1/n_e - 1/(n_in n_e)) / (R - 1)`, with the number of outputs with
    # independent errors, `n_e = (sum_a s_a)^2 / sum_ab |C_ab|^2 s_a s_b`
    power = np.mean(size**2, axis=1)
    chance = 1.0 / (spare * n_in)  # mean |C|^2 of independent errors
    alike = np.mean(np.abs(correlation) ** 2, axis=2)
    alike = np.clip((alike - chance) / (1.0 - chance), 0.0, 1.0) if chance < 1 else 0.0 * alike
    alike[np.arange(power.size), np.arange(power.size)] = 1.0
    n_e = float(np.sum(power) ** 2 / (power @ alike @ power))
    return float(spare / (1 / n_in + 1 / n_e - 1 / (n_in * n_e)))


def repetitions(repeated: Iterable[Frf]) -> tuple[Frf, ...]:
    """Return measurements of the same channels at the same frequencies, checked."""
    why = "One measurement has no information on its noise: pass two or more."
    frfs = members(repeated, Frf, "repeated measurements", why, least=2)
    first = frfs[0]
    for frf in frfs[1:]:
        same = (frf.inputs, frf.outputs) == (first.inputs, first.outputs)
        if not same or not np.array_equal(frf.freq, first.freq):
            raise ShapeError(
                f"repeated measurements have the same channels and frequencies, got {first!r} and "
                f"{frf!r}."
            )
        if frf.quantity != first.quantity:
            raise ModelError(
                f"quantities differ: {first.quantity!r} and {frf.quantity!r}. Convert first."
            )
        if (frf.window, frf.resolution) != (first.window, first.resolution):
            raise ModelError(
                f"segments differ: window {first.window!r} at a resolution of {first.resolution} "
                f"Hz, and {frf.window!r} at {frf.resolution} Hz. They leak differently, and their "
                "mean has no window: estimate all with the same method."
            )
    return frfs


def stacked_runs(runs: tuple[Frf, ...]) -> Frf:
    """Return the outputs of all runs as outputs of one measurement."""
    first = runs[0]
    variances = [run.variance for run in runs if run.variance is not None]
    blocks = [run.correlation for run in runs if run.correlation is not None]
    correlation, n = None, len(first.outputs)
    if len(blocks) == len(runs):
        correlation = np.zeros((n * len(runs), n * len(runs), first.freq.size), complex)
        for k, block in enumerate(blocks):
            correlation[k * n : (k + 1) * n, k * n : (k + 1) * n] = block
    known = len(variances) == len(runs)
    return first.replace(
        data=np.concatenate([run.data for run in runs]),
        coherence=None,
        variance=np.concatenate(variances) if known else None,
        correlation=correlation,
        freedom=first.freedom if known else None,
        outputs=[f"{name} of run {k + 1}" for k in range(len(runs)) for name in first.outputs],
    )
