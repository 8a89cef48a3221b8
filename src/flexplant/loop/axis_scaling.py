"""The size of a sensitivity whatever the units of its axes: scaled by a diagonal, optimally."""

from __future__ import annotations

import numpy as np

from ..checks import ComplexArray, FloatArray
from ..tolerances import TINY

#: sweeps that balance rows against columns; a sweep gains the coupling squared, units at once
_SWEEPS = 30
#: powers of singular values whose sum is made small, one after the other, and steps for each: the
#: largest is within n^(1/p) of the power mean, 2 % for 4 axes at 64
_POWERS, _STEPS = (1, 2, 4, 8, 16, 32, 64), 12
#: largest step of a logarithm, where a loop acts on others and none acts on it
_LARGEST = 1.0
#: frequencies that are optimised at once
_CHUNK = 32


def scaled_size(S: ComplexArray) -> FloatArray:
    """Return ``min_D sigma_max(D S D^-1)``, D diagonal, of S (k, n, n).

    It is the upper bound of the structured singular value of one perturbation for each axis
    [Skogestad2005]_, section 8.8, whatever the units of the axes. Where it cannot be the
    largest it is a bound from above.
    """
    log = _balanced(S)
    size = _largest(S, log)
    if S.shape[-1] < 3:  # the product of both singular values is fixed: balanced is optimal
        return size
    best, order = 0.0, np.argsort(-size, kind="stable")
    for begin in range(0, order.size, _CHUNK):
        some = order[begin : begin + _CHUNK]
        if size[some[0]] <= best:
            break
        size[some] = _optimised(S[some], log[some], size[some])
        best = max(best, float(size[some].max()))
    return size


def _largest(S: ComplexArray, log: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(_scaled(S, log), 2, axis=(1, 2)))


def _scaled(S: ComplexArray, log: FloatArray) -> ComplexArray:
    return np.asarray(S * np.exp(log[:, :, None] - log[:, None, :]))


def _balanced(S: ComplexArray) -> FloatArray:
    """Return log D (k, n) of the least Frobenius norm: each row as large as its column."""
    k, n = S.shape[:2]
    power, log = np.abs(S) ** 2, np.zeros((k, n))
    power[:, range(n), range(n)] = 0.0
    # a coupling of 1e-12 of the whole is rounding; all sums are squares
    least = 1e-24 * np.sum(np.abs(S) ** 2, axis=(1, 2)) + TINY
    for _ in range(_SWEEPS if n > 1 else 0):
        for i in range(n):
            row, column = power[:, i].sum(axis=1), power[:, :, i].sum(axis=1)
            one_way = np.minimum(row, column) <= least * 1e-6
            step = 0.25 * np.log((column + TINY) / (row + TINY))
            step = np.where(one_way, np.clip(step, -_LARGEST, _LARGEST), step)
            step = np.where(np.maximum(row, column) <= 1e-290, 0.0, step)
            log[:, i] += step
            power[:, i] *= np.exp(2.0 * step)[:, None]
            power[:, :, i] *= np.exp(-2.0 * step)[:, None]
    return log


def _optimised(S: ComplexArray, log: FloatArray, size: FloatArray) -> FloatArray:
    """Return the size after log D has gone down the slope of ``sum sigma^(2 p)``, p growing."""
    for power in _POWERS:
        for _ in range(_STEPS):
            left, sigma, right = np.linalg.svd(_scaled(S, log))
            size = np.minimum(size, sigma[:, 0])
            weight = (sigma / sigma[:, :1]) ** (2 * power)
            rows = np.einsum("kis,ks->ki", np.abs(left) ** 2, weight)
            columns = np.einsum("ksi,ks->ki", np.abs(right) ** 2, weight)
            log = log + np.log((columns + 1e-12) / (rows + 1e-12)) / (4.0 * power)
    return size
