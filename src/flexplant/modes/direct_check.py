"""Responses in a basis, checked by direct solutions with all of the matrices at a few points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ..checks import ComplexArray, FloatArray
from ..tolerances import TINY
from .dynamic_basis import DynamicBasis
from .shifted import held_factor

#: channels this far below the others of their row and column are zero by symmetry
_FLOOR = 1e-6
#: relative: next to a resonance, still within its peak
_BESIDE = 1e-6
#: error let pass relative to the response at a frequency, at antiresonances too
_THERE = 1e-2
#: of the peak: what an antiresonance has at least, undamped ones too
_DEEPEST = 1e-7
#: how often direct solutions join the basis, where it is not good enough
_ROUNDS = 3
#: frequencies on which antiresonances are bracketed, over the band and between two resonances
_GRID, _BETWEEN = 300, 5


@dataclass(frozen=True)
class DirectCheck:
    """What direct solutions said of responses."""

    freq: FloatArray
    of_peak: FloatArray
    there: FloatArray

    @property
    def worst(self) -> float:
        """The largest error, of the peaks."""
        return float(self.of_peak.max(initial=0.0))

    def holds(self, tolerance: float) -> bool:
        """Return whether errors are within `tolerance` of the peak, and 1 % of the response."""
        return self.worst <= tolerance and bool(np.all(self.there <= _THERE))

    def __str__(self) -> str:
        if not self.freq.size:
            return "not checked"
        points = "frequencies" if self.freq.size > 1 else "frequency"
        return (
            f"direct solutions at {self.freq.size} {points} differ by {self.worst:.1g} of the "
            f"peak, {self.there.max():.1g} of the response there"
        )


def checked_response(
    basis: DynamicBasis,
    freq: FloatArray,
    rows: FloatArray,
    loads: FloatArray,
    *,
    checks: int,
    tolerance: float,
    seen: Callable[[FloatArray, ComplexArray], ComplexArray] | None = None,
) -> tuple[DynamicBasis, ComplexArray, DirectCheck]:
    """Return a basis that is good to a tolerance, its responses, and the check of them."""
    # where the error is larger, direct solutions join the basis, checked again elsewhere
    view = seen or (lambda _, response: response)

    def find(at: FloatArray) -> ComplexArray:
        return view(at, basis.response(at, rows, loads))

    found = find(freq)
    none = np.zeros(0)
    if not checks or not found.size:
        return basis, found, DirectCheck(none, none, none)
    points = _points(basis, find, float(freq[0]), float(freq[-1]))
    for last in range(_ROUNDS - 1, -1, -1):
        at = np.array(sorted({next(points) for _ in range(checks)}))
        wanted, better = _direct(basis, at, rows, loads)
        check = _compared(at, find(at), view(at, wanted), found)
        if check.holds(tolerance) or not last:
            return basis, found, check
        basis = better()
        found = find(freq)
    raise AssertionError


def _direct(
    basis: DynamicBasis, at: FloatArray, rows: FloatArray, loads: FloatArray
) -> tuple[ComplexArray, Callable[[], DynamicBasis]]:
    """Return responses by all of the matrices, and the basis that has the motions too."""
    # by corrections with the static factor; a dynamic stiffness is factored where they do not
    # settle
    factor = held_factor(basis.model)
    corrected = None if factor is None else basis.corrected(at, loads, factor)
    if corrected is not None:
        found = corrected
        return found.response(at, rows, loads), lambda: found
    motions = [basis.solved(f, loads) for f in at.tolist()]
    fresh = [part for motion in motions for part in (motion.real, motion.imag)]
    return np.array([rows @ motion for motion in motions]), lambda: basis.enriched(np.hstack(fresh))


def _compared(
    at: FloatArray, found: ComplexArray, wanted: ComplexArray, whole: ComplexArray
) -> DirectCheck:
    peak = np.maximum(np.abs(whole).max(axis=0), np.abs(wanted).max(axis=0))
    floor = _FLOOR * np.sqrt(np.outer(peak.max(axis=1), peak.max(axis=0)))
    absent, peak = peak <= floor, np.maximum(peak, floor)
    peak[peak == 0] = 1.0
    gap = np.abs(found - wanted)
    own = np.where(absent, peak, np.maximum(np.abs(wanted), _DEEPEST * peak))
    return DirectCheck(at, (gap / peak).max(axis=(1, 2)), (gap / own).max(axis=(1, 2)))


def _points(
    basis: DynamicBasis, find: Callable[[FloatArray], ComplexArray], low: float, high: float
) -> Iterator[float]:
    """Yield frequencies: highest resonances, deepest antiresonances, edges of the band, random."""
    chance = np.random.default_rng(0)
    inside = basis.damped_freq[(basis.damped_freq > low) & (basis.damped_freq < high)]
    peaks = []
    if inside.size:
        size = np.abs(find(inside))
        share = (size / np.maximum(size.max(axis=0), TINY)).max(axis=(1, 2))
        # beside them: repeated modes may hold one that is not damped
        peaks = (inside * (1 + _BESIDE))[np.argsort(-share, kind="stable")].tolist()
    deep = antiresonances(find, basis.freq, low, high).tolist() if high > low else []
    edges = [high, low] if high > low else [high]
    while True:
        for few in (peaks, deep, edges):
            if few:
                yield few.pop(0)
        # of three in a row one: they are independent of what the basis was made of
        yield low * (high / low) ** chance.random() if low > 0 else high * chance.random()


def antiresonances(
    find: Callable[[FloatArray], ComplexArray], resonances: FloatArray, low: float, high: float
) -> FloatArray:
    """Return the antiresonances [Hz] of responses in a band, the deepest first."""
    start = low if low > 0 else high / 1000
    inside = resonances[(resonances > start) & (resonances < high)] * (1 + _BESIDE)
    ends = np.concatenate([[start], inside, [high]])
    share = np.linspace(0.0, 1.0, _BETWEEN + 2)
    between = (ends[:-1, None] + np.diff(ends)[:, None] * share).ravel()
    return dips(find, np.unique(np.concatenate([np.geomspace(start, high, _GRID), between])))


#: how deep a dip is at least, as a share of the lower one of the two maxima that it lies between
_DEPTH = 0.5
#: how many are refined, the deepest on the grid first
_MOST = 40


def dips(
    find: Callable[[FloatArray], ComplexArray],
    grid: FloatArray,
) -> FloatArray:
    """Return the antiresonances [Hz] of responses: deep local minima of the size of a channel."""
    size = np.abs(find(grid)).reshape(grid.size, -1)
    place, channel = np.nonzero((size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:]))
    lowest = size[place + 1, channel]
    ends = zip(place.tolist(), channel, strict=True)
    sides = np.array([_lower_side(size[:, own], at + 1) for at, own in ends])
    first = np.argsort(lowest / np.maximum(sides, TINY), kind="stable")[:_MOST]
    place, channel, lowest, sides = place[first], channel[first], lowest[first], sides[first]
    left, centre, right = grid[place], grid[place + 1], grid[place + 2]
    part = np.linspace(0.0, 1.0, 9)[1:-1]
    for _ in range(15 if place.size else 0):
        inside = left[:, None] + (right - left)[:, None] * part
        found = np.abs(find(inside.ravel())).reshape(*inside.shape, -1)
        found = np.take_along_axis(found, channel[:, None, None], axis=2)[:, :, 0]
        best = np.argmin(found, axis=1)
        rows = np.arange(place.size)
        centre, lowest = inside[rows, best], found[rows, best]
        edges = np.column_stack([left, inside, right])
        left, right = edges[rows, best], edges[rows, best + 2]
    share = lowest / np.maximum(sides, TINY)
    order = np.argsort(share, kind="stable")
    return np.asarray(centre[order][share[order] < _DEPTH])


def _lower_side(size: FloatArray, at: int) -> float:
    """Return the lower one of the maxima left and right of a minimum, up to where it is as low."""
    sides = (size[:at][::-1], size[at + 1 :])
    ends = [np.flatnonzero(side < size[at]) for side in sides]
    return min(
        float(side[: end[0] if end.size else None].max(initial=0.0))
        for side, end in zip(sides, ends, strict=True)
    )
