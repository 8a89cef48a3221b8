"""Correlation of the errors of an FRF: of its outputs, and of lines of windowed segments."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from ..checks import ComplexArray, FloatArray, between
from ..errors import ModelError, ShapeError
from ..tolerances import SAME

#: samples of a window that stand for all lengths
SAMPLES = 256
#: correlations below this are left out, and so are lines farther apart than this many
LEAST, FARTHEST = 1e-3, 40


def checked_correlation(value: Any, shape: tuple[int, ...]) -> ComplexArray:
    """Return the correlation (n_out, n_out, n_freq) of the errors of outputs."""
    correlation = np.array(value, dtype=np.complex128)
    if correlation.shape != (shape[0], shape[0], shape[2]):
        raise ShapeError(
            f"correlation must have shape ({shape[0]}, {shape[0]}, {shape[2]}), "
            f"got {correlation.shape}: one row and column for each output."
        )
    unit = np.eye(shape[0])[:, :, None]
    hermitian = np.abs(correlation - correlation.conj().transpose(1, 0, 2))
    wrong = np.maximum(np.abs(correlation * unit - unit), hermitian)
    if not (np.all(np.abs(correlation) <= 1 + SAME) and np.all(wrong <= SAME)):
        raise ModelError(
            "correlation must be Hermitian with ones on the diagonal and none larger than one. "
            "Divide a covariance by the standard deviations of both outputs."
        )
    return correlation


def checked_window(window: Any) -> str | tuple[Any, ...]:
    """Return a window that `scipy.signal.get_window` takes."""
    from scipy.signal import get_window  # costs a third of a second that few need

    window = tuple(window) if isinstance(window, list) else window
    try:
        get_window(window, 16)
    except (ValueError, TypeError) as error:
        raise ModelError(f"window {window!r} is not one of scipy.signal: {error}") from error
    return window  # type: ignore[no-any-return]


def checked_overlap(overlap: Any) -> float:
    """Return an overlap below 0.95."""
    return between(overlap, "overlap", 0.0, 0.95, "More brings nothing new: try 0.5.", ends="[")


def line_correlation(
    freq: FloatArray, *, window: Any, resolution: float, overlap: float
) -> sp.csr_array:
    r"""Return the correlation (n_freq, n_freq) of the errors of an averaged FRF.

    The error at a line is the mean over segments of products ``V U^*`` of noise and input, both
    seen through the window w. For random inputs and noise whose spectra change little over a few
    lines, the correlation of lines a distance x (in units of the resolution) apart is

    .. math:: \rho(x) = \frac{\sum_s |C_s(x)|^2}{\sum_s |C_s(0)|^2}, \quad
        C_s(x) = \sum_t w_t w_{t+s} e^{-2 \pi i x t / L}

    over the shifts s between segments: 4/9 and 1/36 for neighbours under a Hann window without
    overlap ([BendatPiersol2010]_, section 11.5; [Welch1967]_).
    """
    n = freq.size
    diagonals: Any = [np.ones(n)]
    offsets = [0]
    for apart in range(1, min(n, FARTHEST)):
        distance = np.round((freq[apart:] - freq[:-apart]) / resolution, 6)
        values, places = np.unique(distance, return_inverse=True)
        shares = _correlation(values, checked_window(window), overlap)[places]
        if values.size and values.min() > FARTHEST:
            break
        if np.any(shares > LEAST):
            shares = np.where(shares > LEAST, shares, 0.0)
            diagonals += [shares, shares]
            offsets += [apart, -apart]
    return sp.csr_array(sp.diags_array(diagonals, offsets=offsets, shape=(n, n)))


def _correlation(distance: FloatArray, window: Any, overlap: float) -> FloatArray:
    from scipy.signal import get_window

    w = np.asarray(get_window(window, SAMPLES), dtype=np.float64)
    hop = max(1, round(SAMPLES * (1.0 - overlap)))
    turn = np.exp(-2j * np.pi * np.outer(distance, np.arange(SAMPLES)) / SAMPLES)
    power, own = np.zeros(distance.size), 0.0
    for shift in range(0, SAMPLES, hop):
        # shifts to both sides count alike
        product, count = w[: SAMPLES - shift] * w[shift:], 1 if shift == 0 else 2
        power += count * np.abs(turn[:, : product.size] @ product) ** 2
        own += count * float(product.sum()) ** 2
    return np.asarray(power / own)
