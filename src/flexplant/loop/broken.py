"""A loop broken between plant and controller: its gain and distance to the critical point."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray, instance
from ..errors import LabelError, short
from ..lti.frequency_sweep import SOUGHT, climbed_grid, crossings, highest, resonance_grid
from ..lti.measured_lines import FEWEST, HiddenModes, MeasuredPlant
from ..lti.response_solvers import Responder, responder
from ..lti.statespace import StateSpace
from ..plant import AnyPlant
from ..tolerances import CLOSE, KEPT_PLANTS, MOST_STEPS, NULL, RANK, TINY, TYPED
from .blocks import references

Side = Literal["u", "y"]
#: fraction of the largest |S| above which it is computed instead of bounded
_NEAR = 0.8
#: logarithmic step of a grid that is refined at the peaks of |S|
_POINTS = 100


@dataclass(frozen=True)
class BrokenLoop:
    """A loop broken into plant and controller: y = P u, u = K y."""

    u: tuple[str, ...]
    y: tuple[str, ...]
    controller: Responder
    plant: Responder
    poles: Callable[[], ComplexArray]
    dt: float
    measured: MeasuredPlant | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    #: units of actuators whose forces differ much, as multiples of the unit of each
    forces: Callable[[], Mapping[str, str]] = dict

    def respond(self, freq: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return K (n_freq, nu, ny) and P (n_freq, ny, nu)."""
        both = self.controller(freq), self.plant(freq)
        K, P = (np.ascontiguousarray(part.transpose(2, 0, 1)) for part in both)
        return K, P

    def gain(self, freq: FloatArray, at: Side = "u") -> ComplexArray:
        """Return K P (broken at u) or P K (at y), frequency first."""
        if not isinstance(at, str) or at not in ("u", "y"):
            raise LabelError(f"a loop is broken at 'u' or 'y', got {short(at)}. Pass one of them.")
        K, P = self.respond(freq)
        return K @ P if at == "u" else P @ K

    @cached_property
    def grid(self) -> FloatArray:
        """Frequencies [Hz] through the resonances of the closed loop, or the measured lines."""
        if self.measured is not None:
            return self.measured.freq
        return resonance_grid(self.poles(), self.dt)

    @cached_property
    def hidden(self) -> HiddenModes:
        """Modes between the lines of a measured plant, or between the frequencies of the grid."""
        plant = self.measured or MeasuredPlant(self.grid, self.plant(self.grid))
        return plant.hidden(self.controller(self.grid))

    @cached_property
    def followed(self) -> FloatArray:
        """The grid, and frequencies through the modes between the lines of a measured plant."""
        if self.measured is None or self.grid.size < FEWEST:
            return self.grid
        return np.union1d(self.grid, self.hidden.found)

    @property
    def is_unstable(self) -> bool:
        """Whether a pole is not strictly inside the stability region; None for a measured plant."""
        if self.measured is not None:
            return False
        poles = self.poles()
        edge = np.abs(poles) - 1.0 if self.dt else poles.real
        return bool(np.max(edge, initial=-1.0) >= 0)

    def mixed(self, at: Side = "u") -> tuple[str, ...]:
        """Return the units of the channels where it is broken if they have several, else none."""
        # a largest singular value would mix different units, also those of unlike actuators: 1 N at
        # a tool of 0.5 kg asks 130 N of the slide of 60 kg that carries it
        if at == "u":
            return mixed_units(self.u, self.units, self.forces)
        return mixed_units(self.y, self.units)

    @cached_property
    def worst(self) -> Callable[[Side, bool], tuple[float, float]]:
        """Give the largest S of a side, axes scaled (True) or not, and its frequency [Hz]."""
        return cache(self._worst)

    def _worst(self, at: Side, scaled: bool) -> tuple[float, float]:
        def size(freq: FloatArray) -> FloatArray:
            L = self.gain(freq, at)
            return scaled_size(inverted(L)) if scaled else sensitivity_size(L)

        if self.measured is not None:
            return highest(size, self.followed, 0)
        grid = resonance_grid(self.poles(), self.dt, points=_POINTS, around=SOUGHT)
        return highest(size, grid, 6)

    def margin(self, at: Side = "u", scaled: bool | None = None) -> float:
        """Return ``1 / max_f |S|``; 0 when unstable."""
        # with scaled axes where `mixed` says so, unless chosen otherwise
        if self.is_unstable:
            return 0.0
        return 1.0 / self.worst(at, bool(self.mixed(at)) if scaled is None else scaled)[0]


def mixed_units(
    names: Sequence[str], units: Mapping[str, str], forces: Callable[[], Mapping[str, str]] = dict
) -> tuple[str, ...]:
    """Return the units of channels if they have several, those of forces included, else none."""
    known = units
    if len(names) > 1 and len({units.get(name) for name in names}) == 1:
        known = {**units, **forces()}
    found = tuple(dict.fromkeys(known.get(name, "unknown") for name in names))
    return found if len(found) > 1 else ()


def inverted(L: ComplexArray) -> ComplexArray:
    """Return (I - L)^-1, frequency first; at the critical point for a slightly different gain."""
    eye = np.eye(L.shape[-1])
    try:
        return np.asarray(np.linalg.inv(eye - L))
    except np.linalg.LinAlgError:  # a marginal loop at the frequency of its pole
        return np.asarray(np.linalg.inv(eye - (1.0 - RANK) * L))


def sensitivity(L: ComplexArray, inner: ComplexArray | None = None) -> ComplexArray:
    """Return ``S = (I - L)^-1 (I - inner)``, frequency first: inner loops stay closed."""
    S = inverted(L)
    return S if inner is None else S - S @ inner


def sensitivity_size(
    L: ComplexArray, inner: ComplexArray | None = None, near: float = _NEAR
) -> FloatArray:
    """Return sigma_max of `sensitivity` at each frequency, a lower bound where it is not high.

    With the mean a of the diagonal of I - L and the Frobenius norms e of I - L - a I and k of the
    inner loop, sigma_max lies between ``(1 - k) / sqrt(|a|^2 + e^2 / n)`` and
    ``(1 + k) / (|a| - e)``. Elsewhere, with m and s^2 the mean and the variance of the n
    eigenvalues of S* S, its square lies between ``m + s / sqrt(n - 1)`` and ``m + s sqrt(n - 1)``
    [WolkowiczStyan1980]_.
    """
    mean, k = np.einsum("fii->f", L) / L.shape[-1], 0.0 if inner is None else _frobenius(inner)
    a = np.abs(1.0 - mean)
    e = np.sqrt(np.maximum(_frobenius(L) ** 2 - L.shape[-1] * np.abs(mean) ** 2, 0.0))
    size = np.maximum(1.0 - k, 0.0) / np.maximum(np.sqrt(a**2 + e**2 / L.shape[-1]), TINY)
    acts = (a - e) * size.max(initial=0.0) < 1.0 + k
    if acts.any():
        size[acts] = norm_or_bound(
            sensitivity(L[acts], None if inner is None else inner[acts]), near
        )
    return np.asarray(size)


def _frobenius(L: ComplexArray) -> FloatArray:
    return np.asarray(np.sqrt(np.sum(L.real**2 + L.imag**2, axis=(1, 2))))


def norm_or_bound(S: ComplexArray, near: float = _NEAR) -> FloatArray:
    """Return sigma_max of S where it may be near its maximum, else its lower bound."""
    n, square = S.shape[-1], S.conj().swapaxes(1, 2) @ S
    mean = np.einsum("fii->f", square).real / n
    spread = np.sum(square.real**2 + square.imag**2, axis=(1, 2)) / n - mean**2
    spread = np.sqrt(np.maximum(spread, 0.0) / max(n - 1, 1))
    low = mean + spread
    high = mean + (n - 1) * spread >= near**2 * low.max(initial=0.0)
    low[high] = np.linalg.eigvalsh(square[high])[:, -1]
    return np.asarray(np.sqrt(low))


def moved_poles(known: Any, loop: Any) -> ComplexArray | None:
    """Return the poles of a loop from those of a like one; None where they are not proven.

    Both have one controller and plants of the same states in one order. With
    ``F = det(I - K P) / det(I - D_K D_P)``, which is 1 at infinity, and the n poles p of K and P,
    the differences x of two neighbours are improved by ``x_j - w_j`` with
    ``w_j = F(x_j) prod_i (x_j - p_i) / prod_(k != j) (x_j - x_k)``. The discs of radius n |w_j| at
    x_j contain all poles, a group of m that overlap contains m [Smith1970]_. They are proven where
    no disc is larger than 1 % of the distance of its centre to the stability boundary.
    """
    own, dt = known._command.poles(), loop.plant.dt
    before, now = (np.append(one._path.system.poles(), own) for one in (known, loop))
    x = known.poles()
    if x.size != now.size:
        return None
    one = np.eye(len(loop.driven))
    direct = np.linalg.det(one - loop._command.D @ loop._path.system.D)
    x = x[x.imag >= 0.0]
    swings = x.imag > 0.0
    moved = (now - before)[np.argmin(np.abs(x[:, None] - before), axis=1)]
    x = np.where(swings, x + moved, x.real + moved.real)
    F, every = np.zeros_like(x), np.arange(x.size)
    rows = every
    for _ in range(_STEPS):
        # beside a pole that the loop does not move
        x[rows] += NULL * np.where(x[rows] == 0.0, 1.0, x[rows])
        turn = np.log(x[rows]) / dt if dt else x[rows]
        K, P = loop.broken.respond(turn / (2j * np.pi))
        F[rows] = np.linalg.det(one - K @ P) / direct
        for some in (rows, every):
            gaps = x[some, None] - np.append(x, x[swings].conj())
            gaps[np.arange(some.size), some] = 1.0
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                w = F[some] * np.prod((x[some, None] - now) / gaps, axis=1)
            edge = np.abs(x[some]) - 1.0 if dt else x[some].real
            wide = ~(now.size * np.abs(w) <= CLOSE * np.abs(edge))
            if wide.any():
                break
        else:
            x = x - w
            return np.append(x, x[swings].conj())
        rows = some[wide]
        x[rows] -= w[wide]
        if not np.all(np.isfinite(x)):  # a double pole
            break
    return None


class Path(NamedTuple):
    """A plant between the driven u and y, prepared for all its loops."""

    #: response to all of y, the y that u can move, and the response to these
    system: StateSpace
    fed_back: tuple[str, ...]
    respond: Responder


@lru_cache(maxsize=KEPT_PLANTS)
def plant_path(plant: AnyPlant, driven: tuple[str, ...]) -> Path:
    """Return the path between some actuators and y."""
    system = plant.system.select(plant.y, driven)
    fed_back = movable_outputs(system)
    return Path(system, fed_back, responder(system.select(fed_back)))


def movable_outputs(g: StateSpace) -> tuple[str, ...]:
    """Return the outputs that can move: their rows see a state or an input."""
    moves = np.any(g.C != 0, axis=1) | np.any(g.D != 0, axis=1)
    return tuple(name for name, one in zip(g.outputs, moves, strict=True) if one)


#: powers of singular values whose sum is minimised in turn, and steps for each: the largest value
#: is within n^(1/p) of the power mean, 2 % for 4 axes at 64
_POWERS, _STEPS = (1, 2, 4, 8, 16, 32, 64), 12
#: points that are optimised at once, in falling order of their bounds; and the ratio of the upper
#: to the lower bound at which a point needs no further steps
_AT_ONCE, _SETTLED = 4, 1.001
#: largest step of a logarithm, where a loop acts on others but no loop acts on it
_LARGEST = 1.0


def scaled_size(S: ComplexArray) -> FloatArray:
    """Return ``min_D sigma_max(D S D^-1)``, D diagonal, of S (k, n, n)."""
    # it is the upper bound of the structured singular value of one perturbation for each axis
    # [Skogestad2005]_, section 8.8, independent of the units of the axes. Where it cannot be the
    # maximum, an upper bound is returned
    log = log_scaling(S)
    size = np.asarray(np.linalg.norm(_d_scaled(S, log), 2, axis=(1, 2)))
    if S.shape[-1] < 3:  # the product of both singular values is fixed: balanced is optimal
        return size
    best, order = 0.0, np.argsort(-size, kind="stable")
    while order.size and size[order[0]] > best:
        some, order = order[:_AT_ONCE], order[_AT_ONCE:]
        size[some] = _optimised(S[some], log[some], size[some])
        best = max(best, float(size[some].max()))
    return size


def least_scaled(S: ComplexArray) -> FloatArray:
    """Return a lower bound of `scaled_size` of S (k, n, n): no scaling changes the diagonal."""
    return np.asarray(np.abs(np.einsum("fii->fi", S)).max(axis=1))


def peaking_size(S: ComplexArray) -> FloatArray:
    """Return `scaled_size` of S (k, n, n), n > 1, where it may be the largest, else a lower bound.

    With the two largest entries a and d of the diagonal and the Frobenius norm e of the rest, which
    each step of the scaling lowers, it is at most the norm of [[a, e], [e, d + e]].
    """
    n, size = S.shape[-1], least_scaled(S)
    rest = _d_scaled(S, log_scaling(S, 2))
    second = np.sort(np.abs(np.einsum("fii->fi", S)), axis=1)[:, -2]
    rest[:, range(n), range(n)] = 0.0
    e = np.linalg.norm(rest, axis=(1, 2))
    high = 0.5 * (size + second + e) + np.hypot(0.5 * (size - second - e), e)
    may = high > (1.0 + RANK) * size.max(initial=0.0)
    if may.any():
        size[may] = scaled_size(S[may])
    return size


def _d_scaled(S: ComplexArray, log: FloatArray) -> ComplexArray:
    return np.asarray(S * np.exp(log[:, :, None] - log[:, None, :]))


def log_scaling(S: ComplexArray, steps: int = MOST_STEPS) -> FloatArray:
    """Return log D (k, n) of the least Frobenius norm: rows and columns have equal size."""
    k, n = S.shape[:2]
    power, log = np.abs(S) ** 2, np.zeros((k, n))
    power[:, range(n), range(n)] = 0.0
    # a coupling of 1e-12 of the whole is rounding; all sums are squares
    least = 1e-24 * np.sum(np.abs(S) ** 2, axis=(1, 2)) + TINY
    for _ in range(steps if n > 1 else 0):
        before = log.copy()
        for i in range(n):
            row, column = power[:, i].sum(axis=1), power[:, :, i].sum(axis=1)
            # it acts on others, and no loop acts on it
            one_way = np.minimum(row, column) <= least * 1e-6
            step = 0.25 * (np.log(column + TINY) - np.log(row + TINY))
            step = np.where(one_way, np.clip(step, -_LARGEST, _LARGEST), step)
            # no loop at all: sums of squares
            step = np.where(np.maximum(row, column) <= 1e-290, 0.0, step)
            log[:, i] += step
            power[:, i] *= np.exp(2.0 * step)[:, None]
            power[:, :, i] *= np.exp(-2.0 * step)[:, None]
        if np.abs(log - before).max() < TYPED:
            break
    return log


def _optimised(S: ComplexArray, log: FloatArray, size: FloatArray) -> FloatArray:
    """Return the size after log D has gone down the slope of ``sum sigma^(2 p)``, p growing."""
    for power in _POWERS:
        if np.all(size <= _SETTLED * _unscalable(_d_scaled(S, log))):
            break
        for _ in range(_STEPS):
            left, sigma, right = np.linalg.svd(_d_scaled(S, log))
            size = np.minimum(size, sigma[:, 0])
            weight = (sigma / sigma[:, :1]) ** (2 * power)
            rows = np.einsum("kis,ks->ki", np.abs(left) ** 2, weight)
            columns = np.einsum("ksi,ks->ki", np.abs(right) ** 2, weight)
            # of singular vectors, of length one
            log = log + np.log((columns + 1e-12) / (rows + 1e-12)) / (4.0 * power)
    return size


def _unscalable(S: ComplexArray) -> FloatArray:
    """Return a lower bound of sigma_max(D S D^-1) for all diagonal D."""
    # the largest eigenvalue of S Q, Q diagonal and unitary, does not depend on D. With these phases
    # it is sigma_max where the entries of both singular vectors have equal sizes [Skogestad2005]_
    left, _, right = np.linalg.svd(S)
    phase = np.exp(-1j * np.angle(left[:, :, 0] * right[:, 0, :]))
    return np.asarray(np.abs(np.linalg.eigvals(S * phase[:, None, :])).max(axis=1))


def reference_pair(loop: Any, reference: str | None, error: str | None) -> tuple[str, ...]:
    """Return reference and error, or nothing when the loop has no reference."""
    for name, given in (("reference", reference), ("error", error)):
        instance(given, str | None, name, "Pass the name of a channel.", LabelError)
    if reference is None:
        known = [name for name in loop.plant.w if name.endswith(":ref")]
        if len(known) > 1:
            raise LabelError(
                f"the loop has {len(known)} references {known}, each with its own S: choose one, "
                f"reference={known[0]!r}; fx.plot.sensitivity(loop) draws all."
            )
        if not known:
            return ()
        reference = known[0]
    return reference, error if error is not None else f"{reference.removesuffix(':ref')}:error"


def error_sensitivity(
    loop: Any, reference: str | None = None, error: str | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and |S| from reference to error, refined where it is largest."""
    if reference is None or error is None:
        pair = reference_pair(loop, reference, error)
        if not pair:
            raise LabelError(
                "the loop has no reference, so no sensitivity from it to an error: add "
                "Reference(...) to the ports, or name the channels."
            )
        reference, error = pair
    gain = loop.gain(reference, error)
    return climbed_grid(lambda freq: np.abs(gain(freq)[0, 0]), loop.broken.grid, 4)


def axis_sensitivities(loop: Any) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return |S| of each axis that has a reference, by its name: frequencies [Hz] and sizes."""
    return {
        error.removesuffix(":error"): error_sensitivity(loop, ref, error)
        for ref, error in reference_pairs(loop.plant).items()
    }


def reference_pairs(plant: AnyPlant) -> dict[str, str]:
    """Return the error of each reference that has one in z."""
    pairs = {name: f"{name.removesuffix(':ref')}:error" for name in references(plant)}
    return {name: error for name, error in pairs.items() if error in plant.z}


def first_crossing(
    freq: FloatArray, size: FloatArray, find: Callable[[FloatArray], FloatArray] | None
) -> float:
    """Return the frequency [Hz] at which a size first rises to 1, infinite if it stays below."""
    # by interpolation between two points where possible
    beyond = np.flatnonzero((size >= 1.0) & np.logical_or.accumulate(size < 1.0))
    if not beyond.size:
        return float("inf")
    pair, found = slice(beyond[0] - 1, beyond[0] + 1), freq[beyond[:1]]
    if find is not None:
        between = crossings(lambda f: find(f) - 1.0, freq[pair], size[pair] - 1.0)
        found = np.append(between, found)
    return float(found[0])


def lowest_crossing(freq: FloatArray, sizes: Iterable[FloatArray]) -> float:
    """Return the least frequency [Hz] at which one of some sizes of |S| first crosses 1."""
    first, last = float(freq[0]), float(freq[-1])
    crossings = (first_crossing(freq, one, None) if one.min() < 1.0 else first for one in sizes)
    return min((min(one, last) for one in crossings), default=0.0)


def crossing(loop: Any, reference: str, error: str, curve: tuple[FloatArray, FloatArray]) -> float:
    """Return the frequency [Hz] at which |S| first crosses 1 from below; 0 if never below."""
    gain = loop.gain(reference, error)
    below = np.any(curve[1] < 1.0)
    return first_crossing(*curve, lambda freq: np.abs(gain(freq)[0, 0])) if below else 0.0


def axis_bandwidths(loop: Any) -> dict[str, float]:
    """Return where |S| of each reference first crosses 1 from below [Hz], 0 if never below."""
    return {
        f"{axis}:ref": crossing(loop, f"{axis}:ref", f"{axis}:error", curve)
        for axis, curve in axis_sensitivities(loop).items()
    }
