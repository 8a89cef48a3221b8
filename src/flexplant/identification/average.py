"""Repeated measurements of the same FRF: their mean, and the variance that they show."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..arguments import members
from ..errors import ModelError, ShapeError
from ..lti.frequency import Frf
from ..values import ComplexArray, FloatArray


def average_frfs(repeated: Iterable[Frf]) -> Frf:
    r"""Return the mean of repeated FRFs, with variance and correlation from their spread.

    .. math:: \sigma^2_{oi} = \frac{1}{R (R-1)} \sum_r |G^{(r)}_{oi} - \bar G_{oi}|^2

    Noise of an output is the same whichever input shakes, so that variances are of product form:
    a few repetitions are averaged to ``mean_i(sigma^2_oi) mean_o(sigma^2_oi) / mean(sigma^2)``.
    The correlation of the errors of two outputs is pooled over the inputs. How well the variance
    is known (`freedom`) follows from R, the inputs and how many outputs err independently.

    Runs with other phases of the excitation make quantisation without dither, and whatever else
    is the same in every run, appear as noise: with the same signal in every run the spread does
    not contain it, and the variance is 28 to 300 times too small. Give `multisine` another `rng`
    for each run.

    Parameters
    ----------
    repeated : iterable of at least two Frf
        Of the same channels, frequencies and quantity, with independent noise; four or more
        for weights that are worth something.

    Returns
    -------
    Frf
        What `identify_modes` weights by.

    Raises
    ------
    ShapeError
        When they have different channels or frequencies.
    ModelError
        When there are fewer than two, they differ in quantity or do not differ at all.

    References
    ----------
    [PintelonSchoukens2012]_, chapter 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> runs = [fx.Frf([10.0, 20.0], [[[1.0 - e, 2.0 + e]]]) for e in (-0.1, 0.1)]
    >>> mean = fx.average_frfs(runs)
    >>> mean.data.real
    array([[[1., 2.]]])
    >>> mean.variance.round(4)
    array([[[0.01, 0.01]]])
    """
    why = "One measurement says nothing about its noise: pass two or more."
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
    return Frf(
        first.freq,
        mean,
        freedom=_freedom(correlation, size, count - 1, data.shape[2]),
        inputs=first.inputs,
        outputs=first.outputs,
        quantity=first.quantity,
        variance=variance,
        correlation=correlation,
        resolution=first.resolution,
        window=first.window,
        overlap=first.overlap,
    )


def _freedom(correlation: ComplexArray, size: FloatArray, spare: int, n_in: int) -> float:
    """Return the complex degrees of freedom of variances of product form.

    To first order the relative variances of the three means add up, those they share taken out:
    ``1/nu = (1/n_in + 1/n_e - 1/(n_in n_e)) / (R - 1)``, with the number of outputs that err
    independently, ``n_e = (sum_a s_a)^2 / sum_ab |C_ab|^2 s_a s_b``.
    """
    power = np.mean(size**2, axis=1)
    chance = 1.0 / (spare * n_in)  # mean |C|^2 of independent errors
    alike = np.mean(np.abs(correlation) ** 2, axis=2)
    alike = np.clip((alike - chance) / (1.0 - chance), 0.0, 1.0) if chance < 1 else 0.0 * alike
    alike[np.arange(power.size), np.arange(power.size)] = 1.0
    n_e = float(np.sum(power) ** 2 / (power @ alike @ power))
    return float(spare / (1 / n_in + 1 / n_e - 1 / (n_in * n_e)))
