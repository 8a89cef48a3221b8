"""Spectra of a closed loop's signals under its white noises, and their integrals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..lti.grid import resonance_grid
from ..lti.responses import continuous_poles, responder
from ..lti.statespace import StateSpace
from ..values import FloatArray
from .noise_sources import Source

#: densities (n_source, n_freq) at frequencies [Hz]
Densities = Callable[[FloatArray], FloatArray]
#: intervals are halved until the error of each source's integral is below this part of it
TOLERANCE = 1e-8
ROUNDS = 40
#: edges over all frequencies, beside those at resonances: what a picture of the stairs needs
_STAIRS = 150
#: frequencies at a time
STEP = 2048


class Spectrum(NamedTuple):
    """A one-sided power spectral density.

    Parameters
    ----------
    freq : (n_freq,) array [Hz]
        Frequencies.
    psd : (n_freq,) array [unit^2/Hz]
        Its integral over all frequencies is the mean square.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> flat = fx.loop.Spectrum(freq=np.array([0.0, 1.0]), psd=np.array([2.0, 2.0]))
    >>> float(np.trapezoid(flat.psd, flat.freq))  # the variance
    2.0
    """

    freq: FloatArray
    psd: FloatArray


class Integral(NamedTuple):
    """Integrals (n_source, n_edge) of densities from 0 to the edges [Hz]."""

    edges: FloatArray
    values: FloatArray


def densities(monitored: StateSpace, row: int, noises: Sequence[Source]) -> Densities:
    """Return the function of frequency that gives each source's one-sided density in an output.

    Sampled: ``2 h |C (z I - A)^-1 G + D|^2`` with ``z = exp(2 pi i f h)``; G is the exact
    covariance of a sample, so the density holds all that folds back from above half the rate.
    Continuous: ``2 |C (s I - A)^-1 G + D|^2``.
    """
    n = monitored.n_states
    none = np.zeros((n, 1))
    # from the output back to the states: one column for any number of noises
    dual = StateSpace(monitored.A.T, monitored.C[[row]].T, np.eye(n), none, monitored.dt)
    reach = responder(dual)
    factor = 2.0 * (monitored.dt or 1.0)

    def found(freq: FloatArray) -> FloatArray:
        out = np.empty((len(noises), freq.size))
        for start in range(0, freq.size, STEP):
            part = slice(start, start + STEP)
            # transposed, not conjugated: C (z I - A)^-1 of the same z
            back = reach(freq[part])[:, 0].T
            for i, one in enumerate(noises):
                out[i, part] = np.sum(np.abs(back @ one.G + one.D[row]) ** 2, axis=1)
        return factor * out

    return found


def integrated(find: Densities, monitored: StateSpace, variances: FloatArray) -> Integral:
    """Return the running integrals of densities, by adaptive Gauss-Kronrod quadrature.

    Intervals begin between the resonances and are halved where the rules of 7 and of 15 points
    differ. A continuous loop is integrated to infinity, over ``t = f / (f + f_c)``.
    """
    top = 0.5 / monitored.dt if monitored.dt else np.inf
    grid = _starts(monitored, top)
    centre = float(np.sqrt(grid[1] * grid[-2]))
    edges = grid if monitored.dt else np.append(grid[:-1] / (grid[:-1] + centre), 1.0)
    nodes, gauss, kronrod = _rule()

    def values(left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        t = middle[:, None] + half[:, None] * nodes
        freq, speed = (t, np.ones_like(t))
        if not monitored.dt:
            freq, speed = centre * t / (1.0 - t), centre / (1.0 - t) ** 2
        density = find(freq.ravel()).reshape(-1, *t.shape) * speed * half[:, None]
        fine = density @ kronrod
        return fine, np.abs(fine - density @ gauss)

    left, right = edges[:-1], edges[1:]
    fine, error = values(left, right)
    size = np.where(variances > 0, variances, 1.0)[:, None]
    for _ in range(ROUNDS):
        share = np.max(error / size, axis=0, initial=0.0)
        if share.sum() <= TOLERANCE:
            break
        bad = np.flatnonzero(share > TOLERANCE / share.size)
        middle = 0.5 * (left[bad] + right[bad])
        fresh = np.concatenate([left[bad], middle]), np.concatenate([middle, right[bad]])
        keep = np.setdiff1d(np.arange(left.size), bad)
        more, missed = values(*fresh)
        left, right = np.append(left[keep], fresh[0]), np.append(right[keep], fresh[1])
        fine = np.concatenate([fine[:, keep], more], axis=1)
        error = np.concatenate([error[:, keep], missed], axis=1)
    order = np.argsort(left)
    ends = np.append(left[order], right[order[-1]])
    if not monitored.dt:
        ends = centre * ends[:-1] / (1.0 - ends[:-1])
        ends = np.append(ends, np.inf)
    total = np.cumsum(fine[:, order], axis=1)
    return Integral(ends, np.concatenate([np.zeros((total.shape[0], 1)), total], axis=1))


def _starts(monitored: StateSpace, top: float) -> FloatArray:
    """Return edges from 0 to the top: some over all frequencies, five at each resonance."""
    base = resonance_grid(monitored.poles(), monitored.dt, points=25)
    s = continuous_poles(monitored)
    s = s[(s.imag > 0) & (np.abs(s.real) < 0.1 * s.imag)]
    near = (s.imag[:, None] - s.real[:, None] * np.array([-20, -3, 0, 3, 20])) / (2.0 * np.pi)
    edges = np.concatenate([np.geomspace(base[0], base[-1], _STAIRS), near.ravel()])
    return np.concatenate([[0.0], np.unique(edges[(edges > 0) & (edges < top)]), [top]])


def _rule() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return nodes on (-1, 1) and the weights of Gauss (7 points) and Kronrod (15 points).

    Kronrod's weights integrate polynomials exactly to degree 14 at least: they follow from the
    nodes, which are those of QUADPACK [Piessens1983]_.
    """
    half = [
        0.991455371120812639206854697526329,
        0.949107912342758524526189684047851,
        0.864864423359769072789712788640926,
        0.741531185599394439863864773280788,
        0.586087235467691130294144838258730,
        0.405845151377397166906606412076961,
        0.207784955007898467600689403773245,
    ]
    nodes: FloatArray = np.array([*(-x for x in half), 0.0, *half[::-1]])
    inner, weights = np.polynomial.legendre.leggauss(7)
    gauss: FloatArray = np.zeros(15)
    gauss[1::2] = weights[np.argsort(inner)]
    legendre = np.polynomial.legendre.legvander(nodes, 14).T
    moments = np.zeros(15)
    moments[0] = 2.0
    return nodes, gauss, np.asarray(np.linalg.solve(legendre, moments), dtype=np.float64)


def periodogram(signal: FloatArray, dt: float) -> Spectrum:
    """Return the spectrum of a record whose sum times its spacing is the mean square exactly."""
    n = signal.size
    size: FloatArray = np.asarray(np.abs(np.fft.rfft(signal)) ** 2, dtype=np.float64) * (
        2.0 * dt / n
    )
    size[0] *= 0.5
    if n % 2 == 0:
        size[-1] *= 0.5
    return Spectrum(np.asarray(np.fft.rfftfreq(n, dt), dtype=np.float64), size)
