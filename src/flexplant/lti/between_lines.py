"""A measured response between its lines, by the resonance that neighbouring lines make."""

from __future__ import annotations

import numpy as np

from ..checks import ComplexArray, FloatArray, IntArray
from ..tolerances import TINY

#: change of a response between two lines, beside its size, below which it is a straight line
_STRAIGHT = 1e-9
#: third difference, beside the terms of its sum, that is rounding, and how far away the pole of
#: such lines is put
_ROUNDING, _FAR = 1e-14, 1e6
#: neighbouring lines through which a mode on a straight line is fitted
LINES = 4
#: where an interval is filled: by its length, and about a resonance by its half-width
_SHARES = (0.25, 0.5, 0.75)
AROUND = np.array([-6.0, -3.0, -1.5, -0.8, -0.4, 0.0, 0.4, 0.8, 1.5, 3.0, 6.0])


def between_lines(
    lines: FloatArray, data: ComplexArray, freq: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Return responses between lines, and what two estimates of them differ by."""
    # the circle through three neighbours is exact for one mode on a constant; each frequency lies
    # in two
    last = lines.size - 3
    i = np.searchsorted(lines, freq, side="right") - 1
    below = _through(lines, data, np.clip(i - 1, 0, last), freq)
    above = _through(lines, data, np.clip(i, 0, last), freq)
    return 0.5 * (below + above), np.asarray(np.abs(below - above))


def followed(lines: FloatArray, data: ComplexArray, freq: FloatArray) -> ComplexArray:
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
    found = [low + share * wide for share in _SHARES]
    for first in (places - 1, places):
        first = np.clip(first, 0, lines.size - 3)
        c = _circle(lines, data, first)[1]
        pole = lines[first] - 1.0 / np.where(c == 0.0, TINY, c)
        near = pole.real + np.abs(pole.imag) * AROUND[:, None]
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
    bent = np.abs(apart) > _STRAIGHT * (np.abs(g1) + np.abs(g2) + np.abs(g3))
    c = np.where(bent, (slope - second) / np.where(bent, apart, 1.0), 0.0)
    return slope + c * (g2 - g1), c


def _through(
    lines: FloatArray, data: ComplexArray, first: IntArray, freq: FloatArray
) -> ComplexArray:
    a, c = _circle(lines, data, first)
    h = freq - lines[first]
    below = 1.0 + c * h
    below = np.where(np.abs(below) > _STRAIGHT, below, _STRAIGHT)
    return np.asarray(data[..., first] + a * h / below)
