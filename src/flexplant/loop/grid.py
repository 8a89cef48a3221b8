"""Frequencies at which a system with given poles has to be looked at."""

from __future__ import annotations

import numpy as np

from ..values import ComplexArray, FloatArray

#: around a resonance, in units of its half-power half-width
_AROUND = np.array([0.0, 0.3, 0.7, 1.2, 2.0, 3.5, 6.0, 12.0])


def resonance_grid(poles: ComplexArray, dt: float, *, points: int = 600) -> FloatArray:
    """Return frequencies [Hz], log-spaced over all poles and dense around each resonance.

    Parameters
    ----------
    poles : (n,) complex array
        In rad/s, or of a sampled system.
    dt : float [s]
        Sampling time, 0 when continuous; sampled systems are covered up to half the rate.
    points : int
        Of the logarithmic part.
    """
    s: ComplexArray = np.array(poles, dtype=np.complex128)
    if dt:
        s = np.asarray(np.log(s[np.abs(s) > 1e-12]) / dt, dtype=np.complex128)
    nyquist = 0.5 / dt if dt else np.inf
    size = np.abs(s) / (2 * np.pi)
    # rigid-body poles and rounding of them at 0 or 1 tell nothing about where to look
    size_seen = size[size > 1e-6 * np.max(size, initial=0.0)]
    if not size_seen.size:
        size_seen = np.array([0.01 * nyquist if dt else 1.0])
    high = nyquist if dt else 100.0 * float(size_seen.max())
    low = min(1e-3 * float(size_seen.min()), 0.01 * high)
    base = np.geomspace(low, high, points)
    swing = s.imag > 0
    centre, width = s.imag[swing] / (2 * np.pi), np.abs(s.real[swing]) / (2 * np.pi)
    steps = np.concatenate([-_AROUND[:0:-1], _AROUND])
    near = (centre[:, None] + width[:, None] * steps).ravel()
    grid = np.unique(np.concatenate([base, near]))
    return np.asarray(grid[(grid >= low) & (grid <= high)])


def refined(grid: FloatArray, values: FloatArray, *, peaks: int = 6, parts: int = 8) -> FloatArray:
    """Return new frequencies between the neighbours of the highest local maxima."""
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    tops = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]))
    tops = tops[np.argsort(values[tops])[::-1][:peaks]]
    left, right = grid[np.maximum(tops - 1, 0)], grid[np.minimum(tops + 1, grid.size - 1)]
    share = np.arange(1, 2 * parts) / (2 * parts)
    return np.setdiff1d((left[:, None] + (right - left)[:, None] * share).ravel(), grid)
