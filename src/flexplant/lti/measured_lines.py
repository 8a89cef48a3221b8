"""A measured response at its lines and between them: correlated errors, modes between lines."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ..arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ..tolerances import NEGLIGIBLE, ROUNDING, SAME, TINY
from .frequency_sweep import around_resonance

#: number of samples of a window that represents all lengths
SAMPLES = 256
#: largest distance of correlated lines
FARTHEST = 40


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
        shares = _window_overlap(values, window, overlap)[places]
        if values.size and values.min() > FARTHEST:
            break
        if np.any(shares > NEGLIGIBLE):
            shares = np.where(shares > NEGLIGIBLE, shares, 0.0)
            diagonals += [shares, shares]
            offsets += [apart, -apart]
    return sp.csr_array(sp.diags_array(diagonals, offsets=offsets, shape=(n, n)))


def _window_overlap(distance: FloatArray, window: Any, overlap: float) -> FloatArray:
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


#: relative third difference that counts as rounding, and distance assigned to the pole of such
#: lines
_ROUNDING, _FAR = 1e-14, 1e6
#: number of neighbouring lines for a fit of a mode plus a straight line
LINES = 4


def between_lines(
    lines: FloatArray, data: ComplexArray, freq: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Return responses between lines, and the difference of two estimates."""
    # the circle through three neighbours is exact for one mode on a constant; each frequency lies
    # in two
    last = lines.size - 3
    i = np.searchsorted(lines, freq, side="right") - 1
    below = _circle_values(lines, data, np.clip(i - 1, 0, last), freq)
    above = _circle_values(lines, data, np.clip(i, 0, last), freq)
    return 0.5 * (below + above), np.asarray(np.abs(below - above))


def on_lines(lines: FloatArray, data: ComplexArray, freq: FloatArray) -> ComplexArray:
    """Return responses (..., k) at frequencies within the lines: as given on them, else between."""
    place = np.minimum(np.searchsorted(lines, freq), lines.size - 1)
    found = np.asarray(data[..., place], dtype=np.complex128)
    off = lines[place] != freq
    if lines.size < LINES:
        straight = [np.interp(freq[off], lines, one) for one in data.reshape(-1, lines.size)]
        found[..., off] = np.reshape(straight, (*data.shape[:-1], -1))
    elif off.any():
        found[..., off] = between_lines(lines, data, freq[off])[0]
    return found


def steps_between(lines: FloatArray, data: ComplexArray, places: IntArray) -> FloatArray:
    """Return frequencies [Hz] in some intervals, dense where the circles through lines turn."""
    low, wide = lines[places], lines[places + 1] - lines[places]
    found = list(np.linspace(low, low + wide, LINES + 1)[1:-1])
    for first in (places - 1, places):
        first = np.clip(first, 0, lines.size - 3)
        c = _circle(lines, data, first)[1]
        pole = lines[first] - 1.0 / np.where(c == 0.0, TINY, c)
        near = pole.real + np.abs(pole.imag) * around_resonance()[:, None]
        found += list(np.clip(near, low + 0.01 * wide, low + 0.99 * wide))
    return np.unique(np.concatenate(found))


def pole_between(
    lines: FloatArray, data: ComplexArray
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return p and rho of ``g = a + b f + rho / (f - p)``, through `LINES` lines each."""
    # third divided differences, in which a + b f is nothing: [g] = -rho / prod(f_j - p), [f g] = p
    # [g]
    apart = lines[:, None] - lines[None]
    apart[range(LINES), range(LINES)] = 1.0
    weighed = data / apart.prod(axis=1)
    third = weighed.sum(axis=0)
    bent = np.abs(third) > _ROUNDING * np.abs(weighed).sum(axis=0)
    third = np.where(bent, third, 0.0)
    pole = (lines * weighed).sum(axis=0) / np.where(bent, third, 1.0)
    pole = np.where(bent, pole, _FAR * np.abs(lines).max(axis=0))
    residue = -third * np.prod(lines - pole, axis=0)
    return pole, residue, np.abs(third * np.prod(lines, axis=0))


def _circle(
    lines: FloatArray, data: ComplexArray, first: IntArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return a and c of ``g1 + a h / (1 + c h)``, h = f - f1, through three lines."""
    g1, g2, g3 = (data[..., first + k] for k in range(3))
    slope, second = ((g - g1) / (lines[first + k] - lines[first]) for k, g in ((1, g2), (2, g3)))
    apart = g3 - g2
    bent = np.abs(apart) > SAME * (np.abs(g1) + np.abs(g2) + np.abs(g3))
    c = np.where(bent, (slope - second) / np.where(bent, apart, 1.0), 0.0)
    return slope + c * (g2 - g1), c


def _circle_values(
    lines: FloatArray, data: ComplexArray, first: IntArray, freq: FloatArray
) -> ComplexArray:
    a, c = _circle(lines, data, first)
    h = freq - lines[first]
    below = 1.0 + c * h
    below = np.where(np.abs(below) > SAME, below, SAME)
    return np.asarray(data[..., first] + a * h / below)


#: smallest damping ratio that a structure may have
_LEAST = 1e-5
#: distance outside of an interval, relative to its length, at which a fitted mode still belongs to
#: it
_ASIDE = 0.25
#: factor from the difference of two fits to their error; fraction of an interval below which a mode
#: counts as found; and fraction of its shift to which the fits must agree
_SAFETY, _FOUND, _ALIKE = 2.0, 0.3, 0.5
#: half-power width relative to the distance of lines above which lines resolve a mode
SHOWN = 4.0
#: phase step of det(I - L) between two lines above which its path is not known
STEP = 0.6 * np.pi
#: number of lines of the three fits of an interval
FEWEST = LINES + 2


class HiddenModes(NamedTuple):
    """The loop on the lines of its plant, and in each interval between two of them."""

    #: det(I - K P) on the lines
    F: ComplexArray
    step: FloatArray
    unknown: npt.NDArray[np.bool_]
    undecided: npt.NDArray[np.bool_]
    width: FloatArray
    found: FloatArray


def low_slope(freq: FloatArray, plant: ComplexArray) -> float:
    """Return the slope of P (ny, nu, n) at low lines: 2 for a free body, 0 for a held one."""
    low = _lowest(freq)
    size = np.maximum(np.linalg.norm(plant[:, :, low], axis=(0, 1)), TINY)
    return -float(np.polyfit(np.log(freq[low]), np.log(size), 1)[0])


def _lowest(freq: FloatArray) -> BoolArray:
    """Return the lines that show how a plant continues to lower frequencies."""
    return np.asarray(freq <= max(1.5 * freq[0], freq[min(3, freq.size - 1)]))


class _Fits(NamedTuple):
    """Three fits of ``g = a + b f + rho / (f - p)``, p from the middle, in each interval."""

    pole: ComplexArray
    #: rho at a line next to it, and the rest of g there
    residue: ComplexArray
    rest: ComplexArray
    #: rho of another mode in the middle, if one fit shows more
    other: FloatArray


class MeasuredPlant:
    """A plant (ny, nu, n_freq) at its lines [Hz], and what follows from it for all its loops."""

    def __init__(self, freq: FloatArray, data: ComplexArray) -> None:
        self.freq, self.data = freq, data

    def at(self, freq: FloatArray) -> ComplexArray:
        """Return the response at frequencies within the lines."""
        return on_lines(self.freq, self.data, freq)

    @cached_property
    def slope(self) -> float:
        """The slope at the lowest lines: 2 for a free body, 0 for a held one."""
        return low_slope(self.freq, self.data)

    @cached_property
    def free_motions(self) -> int:
        """The number of directions with slope 2 at the lowest lines."""
        low = _lowest(self.freq)
        sizes = np.linalg.svd(np.moveaxis(self.data[:, :, low], -1, 0), compute_uv=False)
        slopes = -np.polyfit(np.log(self.freq[low]), np.log(np.maximum(sizes, TINY)), 1)[0]
        free = (slopes > 1.0) & (sizes[0] > ROUNDING * sizes[0, 0])
        return int(np.cumprod(free).sum())

    def hidden(self, controller: ComplexArray) -> HiddenModes:
        """Return what lies between lines in the loop with K (nu, ny, n_freq)."""
        # with S K that of one end, `det(I - L)` changes over an interval as `1 - g`, `g = tr(S K P)
        # = a + b f + rho / (f - p)`: a mode p of the plant becomes `p + d` in the loop, where d is
        # rho over the rest of 1 - g. Three fits through four lines each, with S K of both ends,
        # find p and d. Where they agree there is a mode, which is unstable in the loop when its
        # half-width Im p is below -Im d; where they do not agree, d bounds a hidden mode
        K, P = np.moveaxis(controller, -1, 0), np.moveaxis(self.data, -1, 0)
        difference = np.eye(K.shape[1]) - K @ P
        poles, moves, others = [], [], []
        is_single = P[0].size == 1
        F = difference[:, 0, 0] if is_single else np.linalg.det(difference)
        if not np.all(np.abs(F) > 0.0):  # a line lies on the critical point
            step = np.zeros(F.size - 1)
            return HiddenModes(F, step, step == 0.0, step != 0.0, step, step[:0])
        SK = K / difference if is_single else np.linalg.inv(difference) @ K
        for base in (0, 1):
            part = slice(base, self.freq.size - 1 + base)
            weight = SK[part] / (self.freq[part] ** self._power)[:, None, None]
            if is_single:  # a factor on the plant moves no pole
                factor, fits = np.asarray(weight[:, 0, 0]), self._single[base]
            else:
                g = [np.einsum("fuy,fyu->f", weight, self._level[at]) for at in self._near]
                factor, fits = np.ones(1, complex), self._fits(np.array(g), base)
            scale = 1.0 + factor * fits.rest
            poles.append(fits.pole)
            moves.append(np.asarray(factor * fits.residue / scale))
            others.append(np.abs(factor / scale) * fits.other)
        p, d = np.concatenate(poles), np.concatenate(moves)
        return _hidden_modes(self.freq, F, p, d, np.concatenate(others))

    @cached_property
    def _power(self) -> int:
        """The power of f that makes P level at the lowest lines."""
        return 2 if self.slope > 1.0 else 0

    @cached_property
    def _level(self) -> ComplexArray:
        return np.asarray(np.moveaxis(self.data, -1, 0) * (self.freq**self._power)[:, None, None])

    @cached_property
    def _near(self) -> IntArray:
        """The lines (FEWEST, n - 1) of the fits of each interval."""
        first = np.clip(np.arange(self.freq.size - 1) - 2, 0, self.freq.size - FEWEST)
        return np.asarray(first + np.arange(FEWEST)[:, None])

    @cached_property
    def _single(self) -> tuple[_Fits, _Fits]:
        g = self._level[self._near, 0, 0]
        return self._fits(g, 0), self._fits(g, 1)

    def _fits(self, g: ComplexArray, base: int) -> _Fits:
        """Return the fits to g (FEWEST, n - 1) near each interval, for S K of one of its ends."""
        freq, i = self.freq, np.arange(self.freq.size - 1)
        wide, middle = np.diff(freq), 0.5 * (freq[1:] + freq[:-1])
        h = freq[self._near] - middle
        parts = [slice(j, j + LINES) for j in range(FEWEST - LINES + 1)]
        each = zip(*(pole_between(h[some], g[some]) for some in parts), strict=True)
        p, rho, tail = map(np.array, each)
        ends = [g[i - self._near[0] + k, i] for k in (0, 1)]
        near = np.clip(p.real, -0.5 * wide, 0.5 * wide)
        left, right = (ends[k] - rho / ((k - 0.5) * wide - p) for k in (0, 1))
        moved = (freq[i + base] / (middle + near)) ** self._power
        rest = ends[base] - moved * (left + (right - left) * (near / wide + 0.5))
        other = np.max(np.abs(p[:, None] - p) * tail, axis=1)
        return _Fits(p, moved * rho, rest, other / np.maximum(np.abs(p), 0.5 * wide))


def _hidden_modes(
    freq: FloatArray, F: ComplexArray, p: ComplexArray, d: ComplexArray, others: FloatArray
) -> HiddenModes:
    """Return results of fits (k, n - 1): poles p from the middle of each interval, and shifts d."""
    wide, middle = np.diff(freq), 0.5 * (freq[1:] + freq[:-1])
    step, least, other = np.angle(F[1:] / F[:-1]), _LEAST * middle, others.max(axis=0)
    acts = (np.abs(p.real) <= (0.5 + _ASIDE) * wide) & (np.abs(d) > least)
    far = np.abs(step) > STEP  # also next to a mode of a neighbouring interval
    unknown, undecided = np.zeros((2, step.size), dtype=bool)
    narrow, most = np.where(other > least, other, 0.0), SHOWN * wide
    at = np.flatnonzero(acts.any(axis=0) | far)  # no mode acts in the other intervals
    p, d, acts, far = p[:, at], d[:, at], acts[:, at], far[at]
    wide, middle, least = wide[at], middle[at], least[at]
    size, error = np.abs(d), _SAFETY * _box_size(p)
    width, needed = p.imag, -d.imag
    alike = (error < _FOUND * wide) & (_box_size(d) < _ALIKE * size.max(axis=0))
    found = acts.any(axis=0) & alike & (width.min(axis=0) > -error)
    turn = _phase_change(p + d, wide) - _phase_change(p, wide)
    turns = np.round((turn - step[at]) / (2.0 * np.pi))
    followed = np.abs(turn - step[at] - 2.0 * np.pi * turns).max(axis=0) < STEP
    followed &= turns.max(axis=0) == turns.min(axis=0)
    unknown[at] = np.where(found, ~followed, far & ~(alike & followed))
    critical = np.max(np.where(acts, np.where(found, needed, size), 0.0), axis=0, initial=0.0)
    safe = (critical <= least) | (width.min(axis=0) - error > critical)
    unstable = found & (width.max(axis=0) + error < needed.min(axis=0))
    undecided[at] = found & ~safe & ~unstable & ((p + d).imag.min(axis=0) < 0.0)
    narrow[at] = np.maximum(narrow[at], np.where(safe | unstable, 0.0, critical))
    step[at] += 2.0 * np.pi * np.where(found | (far & alike & followed), turns[0], 0.0)
    near = [middle + pole.mean(axis=0) for pole in (p, p + d)]
    through = np.concatenate(
        [one[found].real + np.abs(one[found].imag) * around_resonance()[:, None] for one in near]
    )
    through = np.unique(through[(through > freq[0]) & (through < freq[-1])])
    return HiddenModes(F, step, unknown, undecided, np.minimum(2.0 * narrow, most), through)


def _box_size(values: ComplexArray) -> FloatArray:
    """Return the size of the box that holds all fits."""
    return np.asarray(np.hypot(np.ptp(values.real, axis=0), np.ptp(values.imag, axis=0)))


def _phase_change(at: ComplexArray, wide: FloatArray) -> FloatArray:
    """Return the change of the argument of ``f - at`` over an interval."""
    return np.asarray(np.angle(0.5 * wide - at) - np.angle(-0.5 * wide - at))
