"""Modes that lie between the lines of a measured plant, and what they mean for a loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..checks import ComplexArray, FloatArray
from ..lti.between_lines import AROUND, LINES, pole_between
from ..tolerances import TINY

#: damping ratio below which a mode is not considered: no structure has less
_LEAST = 1e-5
#: how far outside its interval, beside its length, a fit may find a mode of it
_ASIDE = 0.25
#: what fits are taken to be wrong by, beside what they differ by; the part of an interval up to
#: which that is a mode found; and the part of its shift within which they have to agree on that
_SAFETY, _FOUND, _ALIKE = 2.0, 0.3, 0.5
#: half-power width, beside the distance of two lines, of a mode that the lines themselves show:
#: some of them lie on its circle, so that the steps from line to line follow it
_SHOWN = 4.0
#: phase step of det(I - L) between two lines above which its path is not known
_STEP = 0.6 * np.pi
#: lines that the three fits of an interval use
FEWEST = LINES + 2


class HiddenModes(NamedTuple):
    """What is known of a loop in each interval between two lines of its plant."""

    step: FloatArray
    unknown: npt.NDArray[np.bool_]
    undecided: npt.NDArray[np.bool_]
    width: FloatArray
    found: FloatArray


def low_slope(freq: FloatArray, plant: ComplexArray) -> float:
    """Return how P (ny, nu, n) falls at the lowest lines: 2 for a free body, 0 for a held one."""
    low = freq <= max(1.5 * freq[0], freq[min(3, freq.size - 1)])
    size = np.maximum(np.linalg.norm(plant[:, :, low], axis=(0, 1)), TINY)
    return -float(np.polyfit(np.log(freq[low]), np.log(size), 1)[0])


def hidden_modes(freq: FloatArray, plant: ComplexArray, controller: ComplexArray) -> HiddenModes:
    """Return what lies between lines.

    With S K that of one end, ``det(I - L)`` changes over an interval as ``1 - g``,
    ``g = tr(S K P) = a + b f + rho / (f - p)``: a mode p of the plant is ``p + d`` in the loop,
    d rho over what 1 - g is beside it. Three fits through four lines each, by S K of both ends,
    find p and d. Where they agree a mode is there, unstable in the loop when its half-width Im p
    is below -Im d; where they do not, d bounds what may be there unseen.
    """
    slope = 2 if low_slope(freq, plant) > 1.0 else 0  # f^slope P is level at the lowest lines
    plant, controller = (np.moveaxis(part, -1, 0) for part in (plant, controller))
    n, L = freq.size, controller @ plant
    eye = np.eye(L.shape[-1])
    F, SK = np.linalg.det(eye - L), np.linalg.inv(eye - L) @ controller
    i, wide, middle = np.arange(n - 1), np.diff(freq), 0.5 * (freq[1:] + freq[:-1])
    level = plant * (freq**slope)[:, None, None]
    first = np.clip(i - 2, 0, n - FEWEST)
    h = np.array([freq[first + j] - middle for j in range(FEWEST)])
    poles, moves, others = [], [], []
    for base in (0, 1):
        at = freq[i + base]
        weight = SK[i + base] / (at**slope)[:, None, None]
        g = np.array([np.einsum("fuy,fyu->f", weight, level[first + j]) for j in range(FEWEST)])
        ends = [np.einsum("fuy,fyu->f", weight, level[i + end]) for end in (0, 1)]
        fits = [pole_between(h[j : j + LINES], g[j : j + LINES]) for j in range(FEWEST - LINES + 1)]
        for p, rho, _ in fits:
            near = np.clip(p.real, -0.5 * wide, 0.5 * wide)
            left, right = (ends[k] - rho / ((k - 0.5) * wide - p) for k in (0, 1))
            moved = (at / (middle + near)) ** slope
            beside = 1.0 + ends[base] - moved * (left + (right - left) * (near / wide + 0.5))
            poles.append(p)
            moves.append(moved * rho / beside)
            # what another mode in the middle would have for rho, of which one fit shows more
            others += [
                np.abs(p - q) * tail / (np.maximum(np.abs(p), 0.5 * wide) * np.abs(beside))
                for q, _, tail in fits
            ]
    return _judged(freq, F, np.array(poles), np.array(moves), np.max(others, axis=0))


def _judged(
    freq: FloatArray, F: ComplexArray, p: ComplexArray, d: ComplexArray, other: FloatArray
) -> HiddenModes:
    """Return what fits (k, n - 1) say: poles p from the middle of each interval, moved by d."""
    wide, middle = np.diff(freq), 0.5 * (freq[1:] + freq[:-1])
    step, least = np.angle(F[1:] / F[:-1]), _LEAST * middle
    acts = (np.abs(p.real) <= (0.5 + _ASIDE) * wide) & (np.abs(d) > least)
    there, size = acts.any(axis=0), np.abs(d)
    error = _SAFETY * _spread(p)
    width, needed = p.imag, -d.imag
    alike = (error < _FOUND * wide) & (_spread(d) < _ALIKE * size.max(axis=0))
    found = there & alike & (width.min(axis=0) > -error)
    turn = _turn(p + d, wide) - _turn(p, wide)
    turns = np.round((turn - step) / (2.0 * np.pi))
    followed = np.abs(turn - step - 2.0 * np.pi * turns).max(axis=0) < _STEP
    followed &= turns.max(axis=0) == turns.min(axis=0)
    far = np.abs(step) > _STEP  # also beside a mode of a neighbouring interval
    turns = np.where(found | (far & alike & followed), turns[0], 0.0)
    unknown = np.where(found, ~followed, far & ~(alike & followed))
    critical = np.max(np.where(acts, np.where(found, needed, size), 0.0), axis=0, initial=0.0)
    safe = (critical <= least) | (width.min(axis=0) - error > critical)
    unstable = found & (width.max(axis=0) + error < needed.min(axis=0))
    undecided = found & ~safe & ~unstable & ((p + d).imag.min(axis=0) < 0.0)
    narrow = np.maximum(
        np.where(safe | unstable, 0.0, critical), np.where(other > least, other, 0.0)
    )
    near = [middle + at.mean(axis=0) for at in (p, p + d)]
    through = np.concatenate(
        [at[found].real + np.abs(at[found].imag) * AROUND[:, None] for at in near]
    )
    through = through[(through > freq[0]) & (through < freq[-1])]
    return HiddenModes(
        step + 2.0 * np.pi * turns,
        unknown,
        undecided,
        np.minimum(2.0 * narrow, _SHOWN * wide),
        np.unique(through),
    )


def _spread(values: ComplexArray) -> FloatArray:
    """Return the size of the box that holds all fits."""
    return np.asarray(np.hypot(np.ptp(values.real, axis=0), np.ptp(values.imag, axis=0)))


def _turn(at: ComplexArray, wide: FloatArray) -> FloatArray:
    """Return the change of the argument of ``f - at`` over an interval."""
    return np.asarray(np.angle(0.5 * wide - at) - np.angle(-0.5 * wide - at))
