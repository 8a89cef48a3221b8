"""Mean and deviation over moving windows, without loss of digits to an offset."""

from __future__ import annotations

import numpy as np

from ..values import FloatArray, IntArray


def moving_moments(signal: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation (..., n) over `count` samples around each sample.

    Cumulative sums restart at every multiple of `count`, and each window spans exactly one such
    edge: it is the tail of one stretch and the head of the next. Both are taken relative to the
    sample at the edge, which the window holds, so that an offset or a far-away motion, however
    large, costs no digits.
    """
    n = signal.shape[-1]
    before = count // 2
    lead = count  # a stretch of no weight before the record, so that every window has its edge
    stretches = -(-(lead + n + count) // count) + 1
    tail = stretches * count - lead - n
    edge = [(0, 0)] * (signal.ndim - 1) + [(lead, tail)]
    shape = (*signal.shape[:-1], stretches, count)
    values = np.pad(signal, edge, mode="edge").reshape(shape)
    inside = np.pad(np.ones(n), (lead, tail)).reshape(stretches, count)
    edges = values[..., :1]
    ahead = (values - edges) * inside
    behind = (values[..., :-1, :] - edges[..., 1:, :]) * inside[:-1]
    first: IntArray = lead + np.arange(n) - before
    stretch, offset = np.divmod(first, count)
    stretch, offset = np.where(offset, stretch, stretch - 1), np.where(offset, offset, count)
    weight = np.minimum(np.arange(n) - before + count, n) - np.maximum(np.arange(n) - before, 0)
    means = []
    for power in (1, 2):
        # heads[..., s, k]: the first k of stretch s + 1; tails[..., s, k]: those of s from k on
        heads = _cumulative(ahead[..., 1:, :] ** power)
        tails = _cumulative(behind[..., ::-1] ** power)[..., ::-1]
        means.append((tails[..., stretch, offset] + heads[..., stretch, offset]) / weight)
    centre = edges[..., 1:, 0][..., stretch] + means[0]
    return centre, np.sqrt(np.maximum(means[1] - means[0] ** 2, 0.0))


def unit_of(signal: FloatArray) -> float:
    """Return the size of a signal as a power of two: its squares neither over- nor underflow."""
    return float(2.0 ** (np.frexp(np.max(np.abs(signal), initial=0.0))[1] - 1))


def _cumulative(parts: FloatArray) -> FloatArray:
    """Return sums of the first 0, 1, ..., count entries along the last axis."""
    out = np.zeros((*parts.shape[:-1], parts.shape[-1] + 1))
    np.cumsum(parts, axis=-1, out=out[..., 1:])
    return out
