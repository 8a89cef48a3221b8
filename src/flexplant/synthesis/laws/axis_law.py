"""The law of one axis by the logarithms of its numbers, and the search for the fastest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product as every

import numpy as np
import numpy.typing as npt

from ...arrays import ComplexArray, FloatArray, IntArray
from ...errors import SolverError
from ...loop.measured_loop import nyquist_count
from ...lti.frequency_sweep import local_maxima
from ...lti.measured_lines import FEWEST, MeasuredPlant, between_lines, steps_between
from ...tolerances import DEVIATIONS, TINY
from .law import Law, LowPass, Notch, Pid, tustin_s

#: power of 1 / s of a mass's response
_MASS = 2
#: corner of the integrator relative to the bandwidth
_INTEGRATOR = 0.1
#: ranges of the lead's zero below the bandwidth (not below the integrator), of its pole and of the
#: low-pass above it, as factors; of a notch's depth and width
_ZERO, _POLE, _ROLLOFF = (1.2, 10.0), (1.5, 60.0), (1.5, 60.0)
_DEPTH, _WIDTH = (0.01, 1.0), (0.02, 1.0)
#: loop gain at the last line, above which the plant is unknown, relative to the gain that keeps |S|
_BEYOND = 0.1
#: how far a notch below the bandwidth may lie from a mode, as a factor
_NEIGHBOUR = 1.3
#: depth and width of a notch from which a better one is sought, gain in bandwidth that it has to
#: bring; closest points, highest modes and multiples of the bandwidth where it is tried
_SLIGHT, _WORTH, _TRIED, _ABOVE = (0.7, 0.3), 1.02, 2, (1.3, 1.8, 2.7)
#: linear steps, of trials and of what is kept; how many are kept
_FEW, _MANY, _KEPT = 10, 60, 3
#: radii [e-folds], penalty on what is violated, step of differences
_RADIUS, _SMALLEST, _PENALTY, _DIFFERENCE = 0.25, 5e-4, 20.0, 1e-6
#: minima of the distance that count in a step, at most and as far above the least
_POINTS, _REACH = 40, 0.4
#: distance to the critical point that steps keep beyond what is needed, to end with no less
_SPARE = 5e-4
#: error of a line that is named when nothing is found
_POOR = 0.2


@dataclass(frozen=True)
class AxisLaw:
    """``k (1 + w_i / s) (1 + a s / w_b) / (1 + s / (b w_b)) F(s)``, w_b as high as |S| allows.

    On the line of a spring ``k F(s) / s``, of a velocity ``k F(s)``: a and b are 1 then. F is a
    low-pass at c w_b and notches, k makes the loop of the line cross 1 at w_b, w_i is a tenth of
    it. The logarithms of w_b, a, b, c and, of each notch, frequency, depth and width
    are its numbers. A notch lies above the bandwidth or at a mode: others would lower the loop gain
    below the bandwidth until nothing is left of it but its crossover.
    """

    axis: MeasuredAxis
    peak: float
    notches: int

    @property
    def lowest(self) -> float:
        """The lowest bandwidth [Hz]: well above the first line and the springs."""
        above = 3.0 * self.axis.suspension if self.axis.power == _MASS else 0.0
        return max(4.0 * float(self.axis.freq[0]), above)

    @property
    def highest(self) -> float:
        """The highest bandwidth [Hz], where the low-pass ends at the highest corner."""
        return self.axis.ceiling / _ROLLOFF[0]

    def law(self, numbers: FloatArray) -> Law:
        """Return the law of the logarithms of its numbers."""
        (w, a, b, c), notches = np.exp(numbers[:4]), np.exp(numbers[4:]).reshape(-1, 3)
        pid = Pid.corners(1.0, integrator=_INTEGRATOR * w, zero=w / a, pole=w * b)
        action = {2: (pid,), 1: (), 0: (Pid(0.0, i=1.0),)}[self.axis.power]
        factors = (*action, LowPass(w * c), *(Notch(*one) for one in notches.tolist()))
        return Law(factors, float(self._scale(numbers)[0]), self.axis.rate)

    def room(self, numbers: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Return what the distance to the critical point has to spare, at some of the points."""
        return self.room_of(self.response(numbers, self.s[rows]), rows)

    def room_of(self, gain: ComplexArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Return `room` by the response of a law (..., n) at some of the points."""
        # at the last line also what the gain has below a tenth of 1 - 1 / peak: a mode above may
        # rise tenfold
        freq, G, bound = (one[rows] for one in self.axis.points)
        room = np.abs(1.0 + gain * G) - np.abs(gain) * bound
        if self.axis.ends_early and freq[-1] == self.axis.freq[-1]:
            last = _BEYOND * (1.0 - 1.0 / self.peak) - np.abs(gain[..., -1]) * (
                np.abs(G[-1]) + bound[-1]
            )
            room[..., -1] = np.minimum(room[..., -1], 1.0 / self.peak + last)
        return np.asarray(room - 1.0 / self.peak)

    def response(self, numbers: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return responses (..., n) of `law`, whose elements are not made, by numbers (..., k).

        s is any of Tustin's rule.
        """
        return np.asarray(self._scale(numbers) * self._shape(numbers, s))

    def is_stable(self, numbers: FloatArray) -> bool:
        """Return whether the loop is stable, by the Nyquist count of what the lines resolve."""
        axis = self.axis
        if axis.resolved:
            loop = self.response(numbers, self.s) * axis.points[1]
            return bool(_turns_stably(loop, axis.integrators))
        return are_stable([self.law(numbers)], axis.lines, rigid=int(axis.free))

    def _scale(self, numbers: FloatArray) -> FloatArray:
        """Return the gains (..., 1) with which the loop of the rigid body crosses 1 at w_b."""
        w = np.exp(numbers[..., :1])
        there = self._shape(numbers, tustin_s(w, self.axis.rate))
        return np.asarray(self.axis.inertia * (2.0 * np.pi * w) ** self.axis.power / np.abs(there))

    def _shape(self, numbers: FloatArray, s: ComplexArray) -> ComplexArray:
        return self.stopped(self.bodies(numbers, s), numbers[..., 4:], s)

    def bodies(self, numbers: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return responses (..., n) of the factors without notches: PID with lead, low-pass."""
        w, a, b, c = (np.exp(numbers[..., i : i + 1]) for i in range(4))
        slow, ab, p = _INTEGRATOR / b, a * b, s / (2.0 * np.pi * b * w)
        lead = {
            2: lambda: ((ab * p + (1.0 + ab * slow)) * p + slow) / ((p + 1.0) * p),
            1: lambda: np.ones_like(p),
            0: lambda: 1.0 / s,
        }[self.axis.power]()
        p = s / self._warped(c * w)
        return np.asarray(lead / ((p + np.sqrt(2.0)) * p + 1.0))

    def stopped(self, gain: ComplexArray, notches: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return responses (..., n) times those of notches by their numbers."""
        for i in range(0, notches.shape[-1], 3):
            f, d, z = (np.exp(notches[..., k : k + 1]) for k in range(i, i + 3))
            p = s / self._warped(f)
            gain = gain * (((p + 2.0 * d * z) * p + 1.0) / ((p + 2.0 * z) * p + 1.0))
        return gain

    def _warped(self, freq: FloatArray) -> FloatArray:
        """Return frequencies [rad/s] of factors that Tustin's rule brings to some [Hz]."""
        return np.asarray(tustin_s(freq, self.axis.rate).imag)

    def notes(self, numbers: FloatArray) -> list[str]:
        """Return what a user has to know of the law: its sign, and lines that ended the search."""
        name, top = self.axis.name, self.axis.ceiling
        notes = []
        if self.axis.inertia < 0.0:
            notes.append(
                f"{name}: the plant moves against its force (sign reversed), so the law has a "
                "negative gain; if that is not so on the machine, correct the sign of y or u"
            )
        if self.axis.ends_early and numbers[0] + numbers[3] >= np.log(0.98 * top):
            notes.append(
                f"{name}: not the plant but the last line ({top:.4g} Hz) ends its roll-off and "
                "with it the bandwidth: measure to higher frequencies for more"
            )
        return notes

    def limits(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the least and largest numbers, and ``rows @ numbers <= most``, near some numbers.

        Pole, low-pass and notches end at the highest corner; a notch lies above the bandwidth, or
        stays close to its mode.
        """
        top = self.axis.ceiling
        leads = [_ZERO, _POLE] if self.axis.power == _MASS else [(1.0, 1.0), (1.0, 1.0)]
        ranges = [(self.lowest, self.highest), *leads, _ROLLOFF]
        rows = np.zeros((2, numbers.size))
        rows[:, 0] = rows[0, 2] = rows[1, 3] = 1.0
        most = [np.log(top), np.log(top)]
        for i in range(4, numbers.size, 3):
            centre = float(np.exp(numbers[i]))
            modes = self.axis.resonances
            near = modes[np.argmin(np.abs(np.log(modes / centre)))] if modes.size else np.inf
            if abs(np.log(near / centre)) <= np.log(_NEIGHBOUR):
                span = (near / _NEIGHBOUR, min(top, near * _NEIGHBOUR))
            else:
                span = (self.lowest, top)
                row = np.zeros((1, numbers.size))
                row[0, [0, i]] = 1.0, -1.0
                rows, most = np.vstack([rows, row]), [*most, 0.0]
            ranges += [span, _DEPTH, _WIDTH]
        low, high = np.log(ranges).T
        return low, high, rows, np.array(most)

    @cached_property
    def s(self) -> ComplexArray:
        """The s of each point, by Tustin's rule where the law is sampled."""
        return tustin_s(self.axis.points[0], self.axis.rate)

    def best(self) -> FloatArray:
        """Return the law of the highest bandwidth."""
        rough: list[FloatArray] = []
        for number, start in enumerate(starts(self)):
            if rough and number >= _STARTS:
                break
            found = self.raised(start, _FEW)
            rough += [] if found is None else [found]
        if not rough:
            raise SolverError(self.failure())
        rough.sort(key=_first, reverse=True)
        best = max((self._finished(one) for one in rough[:_KEPT]), key=_first)
        full = 4 + 3 * self.notches
        while best.size < full and (more := self._with_notch(best)) is not None:
            best = more
        return self._without_idle(best)

    def _finished(self, numbers: FloatArray) -> FloatArray:
        found = self.raised(numbers)
        return numbers if found is None else found

    def raised(self, numbers: FloatArray, steps: int = _MANY) -> FloatArray | None:
        """Return what steps from some numbers lead to; None when that does not hold the peak."""
        # linear programs within a radius, with an exact penalty [Fletcher1987]_, chapter 14
        x, radius, best = numbers, _RADIUS, None
        if not self.is_stable(x):
            return None
        room = self._spare(x)
        for _ in range(steps):
            step, expected = self._step(x, room, radius)
            if radius < _SMALLEST or expected < _SMALLEST:
                break
            trial = self._spare(x + step)
            gained = step[0] + _PENALTY * (min(trial.min(), 0.0) - min(room.min(), 0.0))
            if gained > 0.1 * expected and self.is_stable(x + step):
                x, room = x + step, trial
                radius *= 2.0 if gained > 0.7 * expected and radius < _RADIUS else 1.0
                if room.min() >= -_SPARE and (best is None or x[0] > best[0]):
                    best = x
            else:
                radius *= 0.4
        if best is None or best[0] <= np.log(self.lowest):
            return None
        return best if self.room(best).min() >= 0.0 else None

    def _spare(self, numbers: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Return the room beyond a little that steps may violate."""
        return self.room(numbers, rows) - _SPARE

    def _step(self, x: FloatArray, room: FloatArray, radius: float) -> tuple[FloatArray, float]:
        """Return the step of the linear program, and the gain that it predicts."""
        rows = _critical_points(room)
        slopes, (low, high, limits, most) = self._slopes(x, room, rows), self.limits(x)
        bounds = (low - x, high - x, limits, np.maximum(most - limits @ x, 0.0))
        step, gain = linear_step(slopes, room[rows], bounds, radius, aim=[0], penalty=_PENALTY)
        return step, gain - _PENALTY * float(min(room.min(), 0.0))

    def _slopes(self, x: FloatArray, room: FloatArray, rows: IntArray) -> FloatArray:
        """Return the derivatives of some of the room by the numbers, by differences."""
        moved = x + _DIFFERENCE * np.eye(x.size)
        return np.asarray((self._spare(moved, rows) - room[rows]).T / _DIFFERENCE)

    def _with_notch(self, numbers: FloatArray) -> FloatArray | None:
        """Return the law with the notch that raises the bandwidth most; None when none is worth it.

        At the points closest to the critical point, at modes and above the bandwidth.
        """
        axis = self.axis
        close = axis.points[0][local_maxima(-self.room(numbers))[:_TRIED]]
        above = np.exp(numbers[0]) * np.array(_ABOVE)
        trials = [
            self.raised(np.append(numbers, np.log([f, *_SLIGHT])), _FEW)
            for f in np.concatenate([close, axis.resonances[:_TRIED], above]).tolist()
            if axis.freq[0] < f < axis.ceiling
        ]
        best = max((one for one in trials if one is not None), key=_first, default=numbers)
        return self._finished(best) if best[0] > numbers[0] + np.log(_WORTH) else None

    def _without_idle(self, numbers: FloatArray) -> FloatArray:
        """Return the law without notches that bring little."""
        for i in reversed(range(4, numbers.size, 3)):
            less = self.raised(np.delete(numbers, slice(i, i + 3)), _FEW)
            if less is not None and less[0] + np.log(_WORTH) > numbers[0]:
                numbers = less
        return numbers

    def failure(self) -> str:
        """Return why no law was found, in words."""
        axis = self.axis
        need = (
            "a rigid body, its motion per force, at the lowest lines. Give rigid=0 when it is on "
            "springs"
            if axis.free
            else f"a mass above its springs' mode, taken to be at {axis.suspension:.4g} Hz. Give "
            "rigid= when the body is free"
        )
        low, top = self.lowest, self.highest
        reach = f"from {low:.3g} to {top:.3g} Hz" if top > low else f"above {low:.3g} Hz"
        shares = axis.deviation / np.maximum(np.abs(axis.G), TINY)
        worst, share = int(np.argmax(shares)), float(shares.max())
        poor = (
            f" The line at {axis.freq[worst]:.4g} Hz has an error of {100 * share:.0f} %: measure "
            "longer, or leave out the lines that say little."
            if share > _POOR
            else ""
        )
        decibel = 20.0 * np.log10(self.peak)
        return (
            f"axis {axis.name!r}: no bandwidth {reach} is stable with |S| below {decibel:.2g} dB. "
            f"The axis has to be {need}; raise the rate, lower "
            f"the delay, or measure at lower frequencies.{poor}"
        )


#: change between two lines, relative to their size and in standard deviations, above which lines
#: are added
_STEP, _CLEAR = 0.15, 3.0
#: lines over which an error is averaged, to either side
_NEAR = 10
#: resonances that may be notched, how far f^2 G rises above its median within a factor of
#: frequency, and the largest relative error of a response in which a resonance is sought
_RESONANCES, _RISE, _WIDE, _KNOWN = 12, 2.0, 1.5, 0.3
#: highest corner of a law relative to the rate
_CORNER = 0.45


@dataclass(frozen=True)
class MeasuredAxis:
    """One axis of a plant on lines."""

    name: str
    freq: FloatArray
    G: ComplexArray
    rate: float
    free: bool
    variance: FloatArray | None = None
    #: of 1 / s on the line where its bandwidth is sought: 2 of a mass, 1 of its velocity, 0 of a
    #: spring
    power: int = _MASS
    #: whether the lines resolve all resonances, as those of a model do
    resolved: bool = False

    @cached_property
    def lines(self) -> MeasuredPlant:
        """The plant for which laws are judged on its lines."""
        return MeasuredPlant(self.freq, self.G[None, None])

    @property
    def ceiling(self) -> float:
        """The highest corner [Hz] that a law may have: 0.45 of the rate, or the last line."""
        last = float(self.freq[-1])
        return min(last, _CORNER * self.rate) if self.rate else last

    @property
    def ends_early(self) -> bool:
        """Whether the plant is unknown from the last line to half the rate."""
        return not self.rate or self.freq[-1] < _CORNER * self.rate

    @cached_property
    def deviation(self) -> FloatArray:
        """The standard deviation of each line."""
        if self.resolved:
            return np.zeros(self.freq.size)
        if self.variance is not None:
            return np.asarray(np.sqrt(self.variance))
        return _scatter(self.freq, self.G)

    @cached_property
    def points(self) -> tuple[FloatArray, ComplexArray, FloatArray]:
        """Frequencies [Hz], responses and bounds on their errors: the lines, and between them."""
        # where a response changes much, it follows the circles through its neighbours
        f, G, bound = self.freq, self.G, DEVIATIONS * self.deviation
        if f.size < 4 or self.resolved:
            return f, G, bound
        step = np.abs(np.diff(G))
        size = np.minimum(np.abs(G[1:]), np.abs(G[:-1]))
        noise = np.maximum(self.deviation[1:], self.deviation[:-1])
        steep = np.flatnonzero((step > _STEP * size) & (step > _CLEAR * noise))
        added = steps_between(f, G, steep)
        there, apart = between_lines(f, G, added)
        place = np.searchsorted(f, added) - 1
        error = np.maximum(bound[place], bound[place + 1]) + apart
        order = np.argsort(np.concatenate([f, added]), kind="stable")
        return (
            np.concatenate([f, added])[order],
            np.concatenate([G, there])[order],
            np.concatenate([bound, error])[order],
        )

    @cached_property
    def inertia(self) -> float:
        """The inertia (or stiffness), with its sign: ``G = 1 / (inertia s^power)``."""
        # the median over the lowest decade of lines, above the springs and well below the first
        # mode
        known = self.deviation <= _KNOWN * np.abs(self.G)
        first = float(self.resonances.min(initial=np.inf))
        above = self.freq >= (2.0 * self.suspension if self.power else 0.0)
        low = float(self.freq[known & above].min(initial=self.freq[-1]))
        near = known & above & (self.freq <= max(min(10.0 * low, 0.3 * first), 1.2 * low))
        turned = self.G[near] * (2j * np.pi * self.freq[near]) ** self.power
        sign = 1.0 if np.median(turned.real) >= 0.0 else -1.0
        return sign / float(np.median(np.abs(turned)))

    @cached_property
    def _peaks(self) -> FloatArray:
        """The frequencies [Hz] of peaks above what lies around them, the highest loop first."""
        size = np.abs(self.G) * self.freq**self.power
        inner = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])
        known = (self.deviation <= _KNOWN * np.abs(self.G)) & (self.freq < self.ceiling)
        peaks = 1 + np.flatnonzero(inner & known[1:-1])
        ends = [np.searchsorted(self.freq, self.freq[peaks] * way) for way in (1 / _WIDE, _WIDE)]
        around = [np.median(size[a:b]) for a, b in zip(*ends, strict=True)]
        peaks = peaks[size[peaks] > _RISE * np.array(around)]
        order = np.argsort(-size[peaks] / self.freq[peaks], kind="stable")[:_RESONANCES]
        return self.freq[peaks[order]]

    @property
    def suspension(self) -> float:
        """The frequency [Hz] of the springs that hold the body; 0 when free."""
        return 0.0 if self.free else float(self._peaks.min(initial=self.freq[-1]))

    @property
    def resonances(self) -> FloatArray:
        """The frequencies [Hz] of the elastic modes, the highest peak first."""
        above = self.suspension if self.power == _MASS else 0.0
        return self._peaks[self._peaks > above]

    @property
    def integrators(self) -> int:
        """The number of poles of the axis with its law at zero frequency."""
        return 2 * self.free + (self.power != 1)


def are_stable(laws: Sequence[Law], plant: MeasuredPlant, *, rigid: int) -> bool:
    """Return whether laws stabilise axes (k, k, n_freq) on lines, by the Nyquist count."""

    def respond(freq: FloatArray) -> ComplexArray:
        each = np.array([-law.response(freq) for law in laws])
        return np.asarray(np.eye(len(laws))[:, :, None] * each)

    if plant.freq.size < FEWEST:
        return False
    integrators = sum(any(isinstance(f, Pid) and f.i for f in law.factors) for law in laws)
    count = nyquist_count(
        plant, respond, plant.hidden(respond(plant.freq)),
        rigid=rigid, at_zero=2 * rigid + integrators, unstable=0, poles=np.zeros(0, dtype=complex),
    )  # fmt: skip
    return count.unstable == 0


def _scatter(freq: FloatArray, G: ComplexArray) -> FloatArray:
    """Return the standard deviation of lines by how they scatter about a smooth curve."""
    # third differences of f^2 G have 20 times the variance of an error, hardly any of a smooth
    # curve
    if freq.size < 2 * _NEAR:
        return np.zeros(freq.size)
    flat = G * freq**2
    third = np.abs(np.diff(flat, 3) / np.abs(flat[1:-2])) ** 2
    near = np.lib.stride_tricks.sliding_window_view(third, min(2 * _NEAR + 1, third.size))
    # |error|^2 is exponential: its median is log 2 times its mean
    median = np.median(near, axis=1) / (20.0 * np.log(2.0))
    places = np.clip(np.arange(freq.size) - _NEAR - 1, 0, median.size - 1)
    return np.asarray(np.sqrt(median[places]) * np.abs(G))


def linear_step(
    slopes: FloatArray,
    room: FloatArray,
    bounds: tuple[FloatArray, ...],
    radius: float,
    *,
    aim: Sequence[int] | IntArray,
    penalty: float,
) -> tuple[FloatArray, float]:
    """Return the step that raises the mean of some numbers most, and its gain less a penalty."""
    # on the largest lack of `room + slopes step >= 0`, within a radius and within bounds: least and
    # largest steps, and `rows @ step <= most`
    from scipy.optimize import linprog

    low, high, rows, most = bounds
    cost = np.zeros(low.size + 1)
    cost[aim], cost[-1] = -1.0 / len(aim), penalty
    within = np.clip([low, high], -radius, radius).T
    answer = linprog(
        cost,
        A_ub=np.block([[-slopes, -np.ones((room.size, 1))], [rows, np.zeros((most.size, 1))]]),
        b_ub=np.concatenate([room, most]),
        bounds=np.vstack([within, [0.0, np.inf]]).tolist(),
    )
    if answer.x is None or answer.fun is None:
        return np.zeros(low.size), -np.inf
    return answer.x[:-1], float(-answer.fun)


def _first(numbers: FloatArray) -> float:
    return float(numbers[0])


def near_lowest(room: FloatArray, most: int, level: float) -> IntArray:
    """Return at most `most` of the lowest local minima below a level, and their neighbours."""
    least = local_maxima(-room)[:most]
    near = (least[room[least] < level, None] + np.array([-1, 0, 1])).ravel()
    return np.asarray(near[(near >= 0) & (near < room.size)])


def _critical_points(room: FloatArray) -> IntArray:
    """Return the points that count in a step: local minima, and the valleys about the lowest."""
    near = near_lowest(room, _POINTS, room.min() + _REACH)
    valley = np.flatnonzero(room < room.min() + 0.5 * _REACH)
    even = valley[:: max(1, valley.size // (2 * _POINTS))]
    return np.unique(np.concatenate([near, even, [room.size - 1]]))


#: shapes: zero below and pole above the bandwidth, low-pass above it
_LEADS = tuple((a, b) for a in (2.0, 3.0, 4.2, 6.0, 10.0) for b in (4.0, 8.0, 20.0))
_TAILS = (3.0, 7.0, 20.0)
#: notches at the highest modes: how far above the mode as a factor, depth and width
_NOTCHES = ((1.0, 0.05, 0.3), (1.1, 0.4, 0.4))
_MODES = 3  # with such notches, at most
#: bandwidths; points on which they are tried, and to either side of each mode
_TRIALS, _GRID_POINTS, _AROUND = 50, 300, 10
#: starts that are tried, and more until one serves; those with the same notches, so far apart
_STARTS, _EACH, _APART = 12, 3, 0.25
#: what a start may lack of the distance, and what that costs in its score
_LACK, _LATER = 0.25, 4.0


def starts(of: AxisLaw) -> list[FloatArray]:
    """Return numbers near the highest bandwidths, with and without notches at the modes."""
    if not of.lowest < of.highest:
        return []
    rows = _axis_points(of)
    sets = _sets(of)
    found: list[list[tuple[float, FloatArray]]] = [[] for _ in sets]
    for w in np.geomspace(of.highest, of.lowest, _TRIALS).tolist():
        for own, (score, numbers) in zip(found, _best_starts(of, w, sets, rows), strict=True):
            # far enough from the last of the same notches to end elsewhere
            apart = not own or score < own[-1][0] - _APART
            if np.isfinite(score) and len(own) < _EACH and apart:
                own += [(score, numbers)] if of.is_stable(numbers) else []
    best = sorted((one for own in found for one in own), key=lambda one: -one[0])
    return [numbers for _, numbers in best]


def _sets(of: AxisLaw) -> list[FloatArray]:
    """Return the logarithms of the numbers of the notches that are tried together."""
    modes = of.axis.resonances[: min(_MODES, of.notches)].tolist()
    each = [
        [(), *((f * up, d, z) for up, d, z in _NOTCHES if f * up < of.axis.ceiling)] for f in modes
    ]
    return [np.log([one for one in chosen if one]).reshape(-1) for chosen in every(*each)]


def _best_starts(
    of: AxisLaw, w: float, sets: list[FloatArray], rows: IntArray
) -> list[tuple[float, FloatArray]]:
    """Return for each set of notches the numbers of the best start at one bandwidth [Hz]."""
    # with a score: the logarithm of the bandwidth, less where the peak is not held yet
    top, s = of.axis.ceiling, np.append(of.s[rows], tustin_s(np.array([w]), of.axis.rate))
    leads = _LEADS if of.axis.power == _MASS else ((1.0, 1.0),)
    shapes = sorted({(a, min(b, top / w), min(c, top / w)) for a, b in leads for c in _TAILS})
    numbers = np.log([[w, *shape] for shape in shapes])
    bodies = of.bodies(numbers, s)
    gain = np.array([of.stopped(bodies, one, s) for one in sets])
    level = of.axis.inertia * (2.0 * np.pi * w) ** of.axis.power
    gain = gain[..., :-1] * level / np.abs(gain[..., -1:])
    room = np.min(of.room_of(gain, rows), axis=-1)
    room[room < -_LACK] = -np.inf
    stable = _turns_stably(gain * of.axis.points[1][rows], of.axis.integrators)
    room[~stable] = -np.inf
    best, each = np.argmax(room, axis=1), np.arange(len(sets))
    scores = np.log(w) + _LATER * np.minimum(room[each, best], 0.0)
    return [
        (float(score), np.append(numbers[i], one))
        for score, i, one in zip(scores, best, sets, strict=True)
    ]


def _turns_stably(L: ComplexArray, at_zero: int) -> npt.NDArray[np.bool_]:
    """Return whether loops (..., n) turn as stable ones do, on few points: see `nyquist_count`."""
    F = 1.0 + L
    turned = np.sum(np.angle(F[..., 1:] / F[..., :-1]), axis=-1)
    start = np.angle(F[..., 0]) + 0.5 * np.pi * at_zero
    low, last = start - np.pi * np.round(start / np.pi), np.angle(F[..., -1])
    return np.asarray(np.abs(low + turned - last - 0.5 * np.pi * at_zero) < 0.5 * np.pi)


def _axis_points(of: AxisLaw) -> IntArray:
    """Return points that show the axis: even ones, and those around its modes."""
    freq = of.axis.points[0]
    even = np.searchsorted(freq, np.geomspace(freq[0], freq[-1], _GRID_POINTS))
    near = np.searchsorted(freq, of.axis.resonances)[:, None] + np.arange(-_AROUND, _AROUND + 1)
    return np.unique(np.clip(np.concatenate([even, near.ravel()]), 0, freq.size - 1))
