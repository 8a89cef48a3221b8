"""The largest gain of any system: a search, then level sets by a Hamiltonian matrix."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..progress import Progress
from ..values import ComplexArray, FloatArray
from .responses import Responder, continuous_poles, responder
from .scaling import balanced_matrix
from .statespace import StateSpace

LEVELS = 30
#: how far above the largest gain of the feedthrough a level set is not lost in rounding
CLEAR = 1e-7
#: points across each resonance at first; parabolas from there on, each on an interval so much
#: narrower: the last one is 1e-3 of a resonance wide, its error in the gain below 1e-10
ACROSS, PARABOLAS, NARROWER = 9, 3, 8.0


def level_set_peak(g: StateSpace, tolerance: float, bar: Progress) -> tuple[float, float]:
    """Return the largest gain and its frequency [Hz] of a system without poles on the axis.

    What a search finds is improved from the middles of the crossings of its level, until none is
    left at (1 + tolerance) times it.
    """
    top = 0.5 / g.dt if g.dt else np.inf
    find = _largest(responder(g))
    gain, freq = _searched(g, find, top)
    if not gain:
        return 0.0, 0.0
    level = _Level(g)
    for _ in range(LEVELS):
        bar.advance()
        # just above the feedthrough the Hamiltonian matrix is nearly singular: a level more
        close = gain <= (1 + CLEAR) * level.through
        levels = (tolerance, CLEAR) if close else (tolerance,)
        found = [level.crossings(gain * (1 + one)) for one in levels]
        middles = np.concatenate([one for c in found for one in (c, 0.5 * (c[1:] + c[:-1]))])
        middles = middles[middles < top]
        gains = find(middles)
        if not gains.size or gains.max() <= gain * (1 + tolerance):
            return gain, freq
        best = int(np.argmax(gains))
        gain, freq = float(gains[best]), float(middles[best])
    raise SolverError(
        f"the level set of the H-infinity norm of {g!r} did not settle in {LEVELS} levels (last "
        f"gain {gain:.9g} at {freq:.6g} Hz). Report this system."
    )


def _searched(
    g: StateSpace, find: Callable[[FloatArray], FloatArray], top: float
) -> tuple[float, float]:
    """Return the largest gain that a zoom around every resonance finds, and its frequency [Hz]."""
    poles = continuous_poles(g)
    size, swing = np.abs(poles) / (2 * np.pi), np.abs(poles.imag) / (2 * np.pi)
    width = np.minimum(np.abs(poles.real) / (2 * np.pi), size)
    upper = poles.imag >= 0
    centre = np.concatenate([[0.0], swing[upper], size[upper]])
    half = np.concatenate([[0.0], 3 * width[upper], 0.7 * size[upper]])
    # the peak of |H| lies at |s| (1 - 2 zeta^2)^(1/2), close to the pole; a few of them matter
    first = find(np.minimum(centre, 0.999999 * top))
    keep = np.argsort(first)[::-1][:12]
    keep = keep[first[keep] >= 0.1 * first[keep[0]]]
    centre, half = centre[keep], half[keep]
    best_gain, best_freq = float(np.linalg.norm(g.D, 2)), np.inf
    if g.dt:
        best_gain, best_freq = float(np.linalg.norm(g.evaluated(-1.0), 2)), top
    pattern, spacing = np.linspace(-1.0, 1.0, ACROSS), 2.0 * half / (ACROSS - 1)
    end = min(top, 1e300)
    reach = half
    for _ in range(1 + PARABOLAS):
        grid = np.clip(centre[:, None] + reach[:, None] * pattern, 0.0, end)
        gains = find(grid.reshape(-1)).reshape(grid.shape)
        peak, each = np.argmax(gains, axis=1), np.arange(grid.shape[0])
        largest = gains[each, peak]
        if largest.max() > best_gain:
            where = int(np.argmax(largest))
            best_gain, best_freq = float(largest[where]), float(grid[where, peak[where]])
        # a resolved peak lies a few percent above its best point; the level set is the judge
        close = largest >= 0.8 * largest.max()
        inner = np.clip(peak, 1, grid.shape[1] - 2)
        centre = np.array([_vertex(grid[i], gains[i], inner[i]) for i in each[close]])
        spacing = spacing[close] / NARROWER
        pattern, reach = np.array([-1.0, 0.0, 1.0]), spacing
    centre = np.clip(centre, 0.0, end)
    gains = find(centre)
    where = int(np.argmax(gains))
    if gains[where] > best_gain:
        best_gain, best_freq = float(gains[where]), float(centre[where])
    return best_gain, best_freq


def _vertex(freq: FloatArray, gains: FloatArray, i: int) -> float:
    """Return where 1 / gain^2, a parabola beside a resonance, is least; near point i.

    The best of the three points where they are not on a parabola with a minimum.
    """
    best = float(freq[int(np.argmax(gains[i - 1 : i + 2])) + i - 1])
    left, right = freq[i] - freq[i - 1], freq[i + 1] - freq[i]
    if not (left > 0.0 and right > 0.0 and gains[i - 1 : i + 2].min() > 0.0):
        return best
    a, b, c = (gains[i] / gains[i - 1 : i + 2]) ** 2
    down, up = (b - a) / left, (c - b) / right
    if not up > down:
        return best
    # the slope of the parabola is (down + up) / 2 or so at point i, and grows to both sides
    slope = (down * right + up * left) / (left + right)
    step = -0.5 * slope * (left + right) / (up - down)
    return float(freq[i] + min(max(step, -left), right))


def _largest(respond: Responder) -> Callable[[FloatArray], FloatArray]:
    """Return the function of frequency [Hz] that gives the largest singular values (n_freq,)."""

    def find(freq: FloatArray) -> FloatArray:
        if not freq.size:
            return np.zeros(0)
        H = np.moveaxis(respond(freq), 2, 0)
        if 1 in H.shape[1:]:
            return np.asarray(np.sqrt(np.sum(np.abs(H) ** 2, axis=(1, 2))))
        return np.asarray(np.linalg.svd(H, compute_uv=False)[:, 0])

    return find


class _Level:
    """The frequencies at which a singular value of a stable system equals a level."""

    def __init__(self, g: StateSpace) -> None:
        self.dt = g.dt
        A, B, C, D = g.A, g.B, g.C, g.D
        if g.dt:  # z = (1 + s) / (1 - s)
            eye = np.eye(A.shape[0])
            factor = la.lu_factor(A + eye)
            inverse_B = la.lu_solve(factor, B)
            A = la.lu_solve(factor, A - eye)
            D = D - C @ inverse_B
            C = np.sqrt(2.0) * la.lu_solve(factor, C.T, trans=1).T
            B = np.sqrt(2.0) * inverse_B
        self.A, self.B, self.C, self.D = A, B, C, D
        self.through = float(np.linalg.norm(D, 2))

    def crossings(self, gamma: float) -> FloatArray:
        """Return the sorted frequencies [Hz] of eigenvalues on, or nearly on, the axis."""
        root = np.sqrt(gamma)
        A, B, C, D = self.A, self.B / root, self.C / root, self.D / gamma
        # (gamma = 1) R = I - D'D, S = I - D D', through the singular values of D
        U, d, Vh = np.linalg.svd(D, full_matrices=True)
        gap_in, gap_out = np.ones(D.shape[1]), np.ones(D.shape[0])
        gap_in[: d.size] = gap_out[: d.size] = (1 - d) * (1 + d)
        BV, CU = B @ Vh.T, U.T @ C
        mixed = np.zeros(D.T.shape)
        mixed[np.arange(d.size), np.arange(d.size)] = d / gap_in[: d.size]
        F = A + BV @ mixed @ CU
        H = np.block([[F, (BV / gap_in) @ BV.T], [-(CU.T / gap_out) @ CU, -F.T]])
        balanced = balanced_matrix(H)
        values: ComplexArray = np.asarray(la.eigvals(balanced), dtype=np.complex128)
        # eigenvalues that only seem to lie on the axis do no harm: the gain is computed there
        near = np.abs(values.real) <= 1e-9 * np.linalg.norm(balanced)
        swing = np.unique(np.abs(values.imag[near]))
        if self.dt:
            return np.asarray(np.arctan(swing) / (np.pi * self.dt))
        return np.asarray(swing / (2 * np.pi))
