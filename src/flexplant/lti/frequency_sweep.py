"""The sweep over frequency: grids dense at resonances, peaks, crossings, largest gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, IntArray, divisor, positive, positive_array, whole
from ..errors import ModelError
from ..tolerances import ROOT, ROUNDING, SETTLED, SPLIT, TINY, TYPED
from .response_solvers import Responder, continuous_poles, responder
from .statespace import StateSpace, System, as_statespace

#: number of log-spaced frequencies of a search for peaks, and of refinements of these
POINTS, ROUNDS = 200, 6
#: [rad] largest change of a phase between neighbours; a dip between them changes it by more
TURN = 0.6
#: largest number of local maxima that are refined, and their least fraction of the highest one
_PEAKS, _HIGH = 6, 0.5
#: inner points of a bracket, and of its halves
_SIXTEENTHS = np.arange(1, 16) / 16.0
_EIGHTHS, _ASIDE = _SIXTEENTHS[1::2], np.array([-1, 0, 1])
#: grid around a resonance in units of its half-power half-width: for a drawn curve, and for a
#: search that finds the maximum between points
DRAWN = tuple(np.sinh(0.5 * np.arange(7)).tolist())
SOUGHT = DRAWN[::2]


def default_freq(sys: System, *, points: int = 10_000, tolerance: float = 0.05) -> FloatArray:
    """Return a grid [Hz] that follows the resonances and antiresonances of every channel.

    The grid extends from a decade below the slowest pole to a decade above the fastest (or half the
    sampling rate), with points through every resonance. Intervals between points are halved, the
    worst first, until straight lines between the points represent the response. In the middle of
    each interval, the logarithm of the magnitude of every channel then differs by at most
    `tolerance` from the straight line between the ends of the interval. No phase changes by more
    than 0.6 rad over an interval. The grid has a gap at an undamped resonance, which has no finite
    response.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        System whose poles determine the frequencies.
    points : int
        Largest number of points. 64 channels of 24 lightly damped modes need about 3500.
    tolerance : float
        Largest difference of the natural logarithm of a magnitude from the straight lines; 0.05 is
        0.4 dB.

    Returns
    -------
    (n_freq,) array [Hz]
        Frequencies, increasing and positive.

    Raises
    ------
    ModelError
        When points or tolerance is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> freq = fx.lti.default_freq(fx.lti.tf([1.0], [1.0, 0.02, 1.0]))
    >>> bool(abs(freq - 0.15915).min() < 1e-4)  # the resonance is on the grid
    True
    """
    g = as_statespace(sys)
    if not g.inputs or not g.outputs:
        raise ModelError("a system without inputs or outputs has no response: give it channels.")
    tolerance = positive(tolerance, "tolerance")
    points = whole(points, "points", minimum=2)
    poles = continuous_poles(g)
    size = np.abs(poles) / (2 * np.pi)
    top = 0.5 / g.dt if g.dt else np.inf
    moving = size[(size > ROUNDING * size.max(initial=0.0)) & (size < top)]
    low, high = (0.1 * moving.min(), 10 * moving.max()) if moving.size else (0.01, 100.0)
    high = min(high, top)
    low = min(low, 1e-3 * high)  # three decades at least
    freq = [np.geomspace(low, high, 200)]
    zeta = np.abs(poles.real) / np.maximum(np.abs(poles), TINY)
    undamped: list[float] = []
    around = np.sinh(np.linspace(-4.0, 4.0, 9)) / np.sinh(1.0)
    for f, z in zip(np.abs(poles.imag) / (2 * np.pi), zeta, strict=True):
        if low < f < high and z < 0.3:
            # narrower ones are lines at any scale of a plot
            near = f * (1 + max(z, 1e-6) * around)
            if z <= ROUNDING:  # infinite there: the grid has a gap
                near, undamped = np.delete(near, around.size // 2), [*undamped, f]
            freq.append(near)
    grid = np.unique(np.concatenate(freq))
    grid = grid[(grid >= low) & (grid <= high)]
    if grid.size > points:
        grid = grid[np.round(np.linspace(0, grid.size - 1, points)).astype(int)]
    return _halve_intervals(g, grid, points, tolerance, np.array(sorted(undamped)))


def _halve_intervals(
    g: StateSpace, grid: FloatArray, points: int, tolerance: float, gaps: FloatArray
) -> FloatArray:
    """Halve intervals, except gaps, until the middle of each agrees with its ends."""
    find = responder(g)
    values = _log_channels(find(grid))
    left = np.arange(grid.size - 1)  # intervals [left, right] that are not settled, by their ends
    right = left + 1
    whole = np.searchsorted(gaps, grid[left]) == np.searchsorted(gaps, grid[right])
    left, right = left[whole], right[whole]
    while left.size and grid.size < points:
        middle = 0.5 * (grid[left] + grid[right])
        open_ = grid[right] - grid[left] > ROOT * middle
        left, right, middle = left[open_], right[open_], middle[open_]
        if not middle.size:
            break
        there = _log_channels(find(middle))
        wrong = _line_error(values[:, left], there, values[:, right])
        worst = np.argsort(wrong)[::-1][: points - grid.size]
        worst = worst[wrong[worst] > tolerance]
        fresh = grid.size + np.arange(worst.size)
        grid = np.concatenate([grid, middle[worst]])
        values = np.concatenate([values, there[:, worst]], axis=1)
        left, right = (np.concatenate([left[worst], fresh]), np.concatenate([fresh, right[worst]]))
    return np.sort(grid)


def _log_channels(data: ComplexArray) -> ComplexArray:
    """Return log H (n_channel, n_freq), entries negligible in row and column flattened."""
    size = np.abs(data)
    scale = np.sqrt(size.max(axis=1, keepdims=True) * size.max(axis=0, keepdims=True))
    floor = np.maximum(TYPED * scale, TINY)
    shown = np.where(size > floor, data, floor)
    return np.asarray(np.log(shown).reshape(-1, data.shape[2]))


def _line_error(left: ComplexArray, middle: ComplexArray, right: ComplexArray) -> FloatArray:
    """Return the error of a line from left to right in the middle, for the worst channel."""
    bent = np.abs(middle.real - 0.5 * (left.real + right.real))
    turned = np.maximum(_phase_step(left, middle), _phase_step(middle, right))
    bent = np.where(turned > TURN, np.maximum(bent, turned), bent)
    return np.asarray(bent.max(axis=0, initial=0.0))


def _phase_step(a: ComplexArray, b: ComplexArray) -> FloatArray:
    step = np.abs(b.imag - a.imag)
    return np.asarray(np.minimum(step, 2 * np.pi - step))


def resonance_grid(
    poles: ComplexArray, dt: float, *, points: int = 600, around: Sequence[float] = DRAWN
) -> FloatArray:
    """Return frequencies [Hz], log-spaced over all poles and dense around each resonance."""
    s: ComplexArray = np.array(poles, dtype=np.complex128)
    if dt:
        # poles at zero are delays: no frequency
        s = np.asarray(np.log(s[np.abs(s) > ROUNDING]) / dt, dtype=np.complex128)
    nyquist = 0.5 / dt if dt else np.inf
    size = np.abs(s) / (2 * np.pi)
    # rigid-body poles at 0 or 1, and their rounding, do not indicate the frequencies of interest
    size_seen = size[size > SPLIT * np.max(size, initial=0.0)]
    if not size_seen.size:
        size_seen = np.array([0.01 * nyquist if dt else 1.0])
    high = nyquist if dt else 100.0 * float(size_seen.max())
    low = min(1e-3 * float(size_seen.min()), 0.01 * high)  # well below the slowest pole
    base = np.geomspace(low, high, points)
    swing = s.imag > 0
    centre, width = s.imag[swing] / (2 * np.pi), np.abs(s.real[swing]) / (2 * np.pi)
    steps = around_resonance(around)
    near = (centre[:, None] + width[:, None] * steps).ravel()
    grid = np.unique(np.concatenate([base, near]))
    return np.asarray(grid[(grid >= low) & (grid <= high)])


def around_resonance(around: Sequence[float] = DRAWN) -> FloatArray:
    """Return a grid on both sides of a resonance, in units of its half-power half-width."""
    return np.concatenate([np.negative(around[:0:-1]), around])


def local_maxima(values: FloatArray) -> IntArray:
    """Return where a function's values are at least their neighbours', ends too, highest first."""
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    tops = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]))
    return np.asarray(tops[np.argsort(-values[tops], kind="stable")])


def _tops(values: FloatArray) -> IntArray:
    """Return where the highest local maxima are, the highest first."""
    tops = local_maxima(values)[:_PEAKS]
    return np.asarray(tops[values[tops] >= _HIGH * values.max(initial=0.0)])


def climbed_grid(
    find: Callable[[FloatArray], FloatArray], grid: FloatArray, rounds: int
) -> tuple[FloatArray, FloatArray]:
    """Return frequencies and values of a function of them, refined where it is highest."""
    values = find(grid)
    for _ in range(rounds):
        left, _, right = np.clip(_tops(values) + _ASIDE[:, None], 0, grid.size - 1)
        inside = grid[left] + (grid[right] - grid[left]) * _SIXTEENTHS[:, None]
        fresh = np.setdiff1d(inside, grid)
        both = np.concatenate([grid, fresh])
        order = np.argsort(both)
        grid, values = both[order], np.concatenate([values, find(fresh)])[order]
    return grid, values


def highest(
    find: Callable[[FloatArray], FloatArray],
    grid: FloatArray,
    rounds: int,
    values: FloatArray | None = None,
) -> tuple[float, float]:
    """Return the largest value of a function of frequency, and its frequency [Hz]."""
    # `values` on the grid where these are known brackets around the highest maxima are divided
    # until a parabola gives no improvement
    values = find(grid) if values is None else values
    ends = np.clip(_tops(values)[:, None] + _ASIDE, 0, grid.size - 1)
    freq, size = grid[ends], values[ends]  # (k, 3): left, top and right of each
    for n in range(1, rounds + 1):
        left, top, right = freq[:, :1], freq[:, 1:2], freq[:, 2:]
        parts = left + (top - left) * _EIGHTHS, top + (right - top) * _EIGHTHS
        fresh = np.hstack([*parts, _vertex(freq, size)[0][:, None]])
        freq = np.hstack([freq, fresh])
        size = np.hstack([size, find(fresh.ravel()).reshape(fresh.shape)])
        order = np.argsort(freq, axis=1)
        freq, size = (np.take_along_axis(both, order, axis=1) for both in (freq, size))
        around = np.clip(np.argmax(size, axis=1)[:, None] + _ASIDE, 0, freq.shape[1] - 1)
        freq, size = (np.take_along_axis(both, around, axis=1) for both in (freq, size))
        # a maximum first seen at half its height is now known to 1 - 0.5 / 8^n of it
        left_in = size[:, 1] >= (1.0 - (1.0 - _HIGH) / 8.0**n) * size[:, 1].max()
        freq, size = freq[left_in], size[left_in]
        if not np.any(_vertex(freq, size)[1] > SETTLED * size[:, 1]):
            break
    best = int(np.argmax(size[:, 1]))
    return float(size[best, 1]), float(freq[best, 1])


def _vertex(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where the vertex of a parabola lies, and how far above its middle point; (k, 3)."""
    width = x[:, 2] - x[:, 0]
    # an end of the grid has only one neighbour
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.diff(y, axis=1) / np.diff(x, axis=1)
        slope = (slopes[:, 0] * (x[:, 2] - x[:, 1]) + slopes[:, 1] * (x[:, 1] - x[:, 0])) / width
        way = 0.5 * slope * width / (slopes[:, 0] - slopes[:, 1])
    inside = np.clip(np.where(np.isfinite(way), x[:, 1] + way, x[:, 1]), x[:, 0], x[:, 2])
    return inside, np.asarray(0.5 * slope * way)


def swept_gains(respond: Responder, freq: FloatArray) -> FloatArray:
    """Return the largest gains at frequencies [Hz], not all of whose responses are held at once."""
    found, most = [], 0.0
    for first in range(0, freq.size, POINTS):
        found.append(largest_gains(respond(freq[first : first + POINTS]), most))
        most = max(most, float(found[-1].max()))
    return np.concatenate([*found, np.zeros(0)])


def largest_gains(H: ComplexArray, most: float = 0.0) -> FloatArray:
    """Return the largest singular values of responses (p, m, n): lower bounds off the peak.

    `most`: a gain that is known, below which bounds are enough.
    """
    # between the Frobenius norm over the root of the rank and the Frobenius norm: few need an SVD
    squares = [np.einsum("pmn,pmn->n", part, part) for part in (H.real, H.imag)]
    size, root = np.sqrt(squares[0] + squares[1]), np.sqrt(min(H.shape[:2]))
    if root == 1.0:
        return np.asarray(size)
    near = size * root >= size.max(initial=most) * (1.0 - ROUNDING)
    size[~near] /= root
    # of the size 1, since squares of the smallest and largest sizes are out of range
    part = np.ascontiguousarray(np.moveaxis(H[:, :, near] / divisor(size[near]), 2, 0))
    if H.shape[0] > H.shape[1]:
        part = part.swapaxes(1, 2)
    square = part @ part.conj().swapaxes(1, 2)
    size[near] *= np.sqrt(np.maximum(np.linalg.eigvalsh(square)[:, -1], 0.0))
    return np.asarray(size)


def crossings(
    find: Callable[[FloatArray], FloatArray], freq: FloatArray, values: FloatArray
) -> FloatArray:
    """Return the zeros of a function of frequency between the points where its sign changes."""
    # all together: a response at many frequencies costs little more than at one
    from scipy.optimize.elementwise import find_root

    first = np.flatnonzero((values[1:] > 0) != (values[:-1] > 0))
    if not first.size:
        return np.zeros(0)
    low, high = freq[first], freq[first + 1]
    ends = find(low), find(high)
    found = np.where(np.abs(ends[0]) < np.abs(ends[1]), low, high)
    real = ends[0] * ends[1] < 0  # else rounding at a point
    if real.any():
        found[real] = find_root(
            find,
            (low[real], high[real]),
            tolerances={"xatol": 0.0, "xrtol": ROUNDING, "fatol": 0.0, "frtol": 0.0},
        ).x
    return np.asarray(found)


def checked_freq(freq: npt.ArrayLike) -> FloatArray:
    """Return frequencies as a finite array (n,) that is not negative."""
    return positive_array(freq, "freq", (None,), zero=True)


def sampled_freq(freq: npt.ArrayLike, dt: float) -> FloatArray:
    """Return frequencies [Hz] at which a system of sampling time dt has a response."""
    grid = checked_freq(freq)
    if dt and grid.size and grid.max() > 0.5 / dt * (1 + ROUNDING):
        raise ModelError(
            f"frequency {grid.max():g} Hz lies above half the sampling rate ({0.5 / dt:g} Hz), "
            "where the response of a sampled system only repeats. Stay below."
        )
    if np.any(np.diff(grid) <= 0):
        raise ModelError("freq must increase strictly: sort the frequencies and merge doubles.")
    return grid
