"""Set-points: motions from rest to rest, constant in the highest derivative phase by phase."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, instance, positive, real_array
from ..errors import ModelError, counted
from ..store import Value
from ..tolerances import RANK, TYPED


class Motion(NamedTuple):
    """Position and its derivatives at the same times.

    A set-point has derivatives up to its order. Higher ones are given as zero, although they are
    impulses where the highest derivative jumps.

    Parameters
    ----------
    position, velocity, acceleration, jerk, snap : arrays
        Values in m or rad for the position, per second for the velocity, and so on.

    Examples
    --------
    >>> import flexplant as fx
    >>> move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    >>> bool(move.peaks.velocity <= 5e-3), bool(move.peaks.acceleration <= 0.5)
    (True, True)
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    snap: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class SetPointProfile(Value):
    """A motion from rest to rest along one axis, made by `setpoint`, `scan` or `then`.

    Parameters
    ----------
    edges : (m + 1,) array [ticks]
        Beginning of each phase, from 0, and end of the last phase, in numbers of `tick`.
    lengths : (m,) array [s]
        Lengths of the phases. They are accurate even if the edges are much larger numbers.
    from_end : (m,) bool array
        Whether the entry of `states` for a phase holds at its end, instead of its beginning.
    states : (m, 5) array
        Position, velocity, acceleration, jerk and snap of each phase, at its beginning or at its
        end (see `from_end`).
    start, stop : float [m or rad]
        Positions at rest before and after the motion.
    order : int
        Order of the highest derivative: 2, 3 or 4. This derivative is constant in each phase.
    tick : float [s]
        Grid spacing of the edges. Without a grid it is 1 s.
    gridded : bool
        Whether the edges lie on a grid.
    exposures : (k, 2) array [s]
        Beginning and end of each exposure window.
    """

    edges: FloatArray
    lengths: FloatArray
    from_end: npt.NDArray[np.bool_]
    states: FloatArray
    start: float
    stop: float
    order: int
    tick: float
    gridded: bool
    exposures: FloatArray

    def __repr__(self) -> str:
        peak = self.peaks
        windows = f", {counted(len(self.exposures), 'exposure')}" if len(self.exposures) else ""
        grid = f", on a grid of {self.tick:g} s" if self.gridded else ""
        return (
            f"<SetPointProfile {self.start:g} -> {self.stop:g} m or rad in {self.duration:.6g} s, "
            f"order {self.order}, velocity to {peak.velocity:.4g} /s, acceleration to "
            f"{peak.acceleration:.4g} /s^2{windows}{grid}>"
        )

    @property
    def duration(self) -> float:
        """Total time [s], including rests and exposure windows."""
        return float(self.edges[-1]) * self.tick

    @property
    def rate(self) -> float | None:
        """Rate [Hz] of the grid on which derivatives jump; None without a grid."""
        return 1.0 / self.tick if self.gridded else None

    @property
    def peaks(self) -> Motion:
        """Largest magnitudes. For the position it is the largest distance from the start."""
        found = np.abs(np.concatenate([self._at(self.edges[:-1]), self._before()], axis=1))
        far = max(abs(self.stop - self.start), float(np.ptp(self._at(self.edges[:-1])[0])))
        return Motion(np.asarray(far), *found[1:].max(axis=1))

    def at(self, t: npt.ArrayLike) -> Motion:
        """Return position, velocity, acceleration, jerk and snap, all at the same times t [s].

        Before and after the motion the set-point rests. At a time when a derivative jumps, its
        value after the jump is returned, which holds until the next sample.
        """
        x = real_array(t, "t") / self.tick
        if self.gridded:
            near = np.round(x)
            x = np.where(np.abs(x - near) < TYPED, near, x)
        found = self._at(x)
        found[1:, (x < 0.0) | (x >= self.edges[-1])] = 0.0
        found[0] = np.where(
            x <= 0.0, self.start, np.where(x >= self.edges[-1], self.stop, found[0])
        )
        return Motion(*found)

    def then(self, following: SetPointProfile) -> SetPointProfile:
        """Return this set-point followed by another one, which begins where this one ends.

        Both must have the same order and grid. The result has the exposure windows of both.
        """
        other: SetPointProfile = instance(
            following, SetPointProfile, "following", "Use setpoint(...)."
        )
        if (other.order, other.tick, other.gridded) != (self.order, self.tick, self.gridded):
            raise ModelError(
                f"{other!r} cannot follow {self!r}: a chain has one order and one grid. Give both "
                "the same bounds and the same rate."
            )
        late, by = float(self.edges[-1]), self.stop - other.start
        states = other.states.copy()
        states[:, 0] += by
        return self.replace(
            edges=np.concatenate([self.edges, other.edges[1:] + late]),
            lengths=np.concatenate([self.lengths, other.lengths]),
            from_end=np.concatenate([self.from_end, other.from_end]),
            states=np.vstack([self.states, states]),
            stop=other.stop + by,
            exposures=np.vstack([self.exposures, other.exposures + late * self.tick]),
        )

    def _at(self, x: FloatArray) -> FloatArray:
        last = self.edges.size - 2
        phase = np.clip(np.searchsorted(self.edges, x, side="right") - 1, 0, last)
        inside = np.clip(x, 0.0, self.edges[-1])
        back = self.from_end[phase]
        elapsed = (inside - np.where(back, self.edges[phase + 1], self.edges[phase])) * self.tick
        longest = self.lengths[phase]
        elapsed = np.clip(elapsed, np.where(back, -longest, 0.0), np.where(back, 0.0, longest))
        return constant_snap(np.moveaxis(self.states[phase], -1, 0), elapsed)

    def _before(self) -> FloatArray:
        """Return the states just before the ends of the phases."""
        return constant_snap(self.states.T, np.where(self.from_end, 0.0, self.lengths))


class Phase(NamedTuple):
    """A stretch of time in which the highest derivative is constant.

    `state` is position, velocity, acceleration, jerk and snap at its beginning or, with `from_end`,
    at its end: expanded from there, motions begin and end exactly at rest.
    """

    length: float
    from_end: bool
    state: FloatArray


def spans(t: tuple[float, ...]) -> tuple[list[float], list[float]]:
    """Return the lengths b_k of the pulse of each level, and their effective widths w_k."""
    # level 1 holds the highest derivative for t_1. Level k puts two pulses of level k - 1, the
    # second with the opposite sign, a time t_k apart: `b_k = 2 b_(k-1) + t_k`. Its integral is
    # `w_k = b_(k-1) + t_k` times the peak of level k - 1, so that the last one covers the distance
    # `w_1 w_2 ... w_n` times the highest derivative
    b, w = [0.0], []
    for length in t:
        w.append(b[-1] + length)
        b.append(2.0 * b[-1] + length)
    return b, w


def shortest(distance: float, bounds: tuple[float, ...]) -> tuple[float, ...]:
    """Return the durations t_1, ..., t_n of each level, bounds those of velocity and upwards."""
    # each duration is the longest that the bounds and the distance allow, from the highest
    # derivative downwards
    if len(bounds) == 1:
        return (distance / bounds[0],)
    if len(bounds) == 2:
        velocity, acceleration = bounds
        steady = min(velocity / acceleration, float(np.sqrt(distance / acceleration)))
        return steady, max(0.0, distance / (acceleration * steady) - steady)
    found = _durations(distance, *bounds)
    return found if len(bounds) == 4 else found[1:]


def on_grid(distance: float, bounds: tuple[float, ...], rate: float) -> tuple[float, ...]:
    """Return the durations in whole samples: the shortest motion near the optimum off the grid."""
    # with any durations, one level of the highest derivative gives the distance exactly. For given
    # durations of the levels 1 to n - 1, the last duration (constant velocity) is the shortest that
    # all bounds allow: `w_n >= distance / (bound_m w_(n-1) ... w_(n-m+1))`. So every bound holds
    # for every choice
    off = shortest(distance, bounds)
    choices = []
    for level, length in enumerate(off[:-1]):
        below = int(np.floor(length * rate))
        least = 1 if level == 0 else 0
        choices.append(sorted({max(below + step, least) for step in (-1, 0, 1, 2)}))
    best: tuple[float, float] | None = None
    chosen: tuple[float, ...] = ()
    for first in product(*choices):
        b, w = spans(tuple(float(n) for n in first))
        widths = np.cumprod([1.0, *w[::-1]])
        ticks = [bound / rate**m for m, bound in enumerate(bounds, start=1)]
        needed = max(distance / (bound * v) for bound, v in zip(ticks, widths, strict=True))
        last = max(np.ceil(needed * (1.0 - RANK) - b[-1]), 0.0 if first else 1.0)
        total, volume = 2.0 * b[-1] + last, float(widths[-1]) * (b[-1] + last)
        if best is None or (total, -volume) < best:
            best, chosen = (total, -volume), (*(float(n) for n in first), float(last))
    return chosen


def flank(t: tuple[float, ...], change: float) -> list[Phase]:
    """Return the phases in which the velocity rises from 0 by a change, durations t in seconds."""
    # the first half is expanded from rest, the second from its end by the symmetry of the flank,
    # `v(T - t) = change - v(t)` and `p(T - t) = change (T / 2 - t) + p(t)`
    b, w = spans(t)
    level = change / float(np.prod(w))
    pulse = [(t[0], level)]
    for length in t[1:-1]:
        pulse = [*pulse, (length, 0.0), *((s, -one) for s, one in pulse)]
    half = [] if len(t) == 1 else pulse
    rows, x, now, starts = [], np.zeros(5), 0.0, []
    for length, value in half:
        x[len(t) + 1] = value
        rows.append(Phase(length, False, x.copy()))
        starts.append(now)
        x, now = constant_snap(x, length), now + length
    middle = np.zeros(5)
    middle[0], middle[1], middle[2] = x[0], 0.5 * change * b[-2] / w[-1], change / w[-1]
    rows.append(Phase(t[-1], False, middle))
    for start, row in zip(starts[::-1], rows[-2::-1], strict=True):
        p, v, a, j, s = row.state
        end = np.array([change * (0.5 * b[-1] - start) + p, change - v, a, -j, s])
        rows.append(Phase(row.length, True, end))
    return rows


def mirrored(rows: list[Phase], total: float) -> list[Phase]:
    """Return phases in reversed time: a rise from rest becomes a stop at the position total."""
    return [
        Phase(length, not from_end, np.array([total - p, v, -a, j, -s]))
        for length, from_end, (p, v, a, j, s) in reversed(rows)
    ]


def constant_snap(state: FloatArray, t: float | FloatArray) -> FloatArray:
    """Return position, velocity, acceleration, jerk and snap (5, ...) after constant snap."""
    p, v, a, j, s = state
    return np.array(
        [
            p + t * (v + t / 2.0 * (a + t / 3.0 * (j + t / 4.0 * s))),
            v + t * (a + t / 2.0 * (j + t / 3.0 * s)),
            a + t * (j + t / 2.0 * s),
            j + t * s,
            s + 0.0 * t,
        ]
    )


def _durations(
    distance: float, velocity: float, acceleration: float, jerk: float, snap: float | None = None
) -> tuple[float, float, float, float]:
    """Return the durations of constant snap, jerk, acceleration and velocity in one flank."""
    # a jerk pulse lasts J = 2 ramp + hold and adds the acceleration a; the acceleration lasts 2 J +
    # steady and adds the velocity a (J + steady)
    if snap is None:
        ramp, peak = 0.0, jerk
        hold = min(acceleration / jerk, np.sqrt(velocity / jerk), np.cbrt(distance / (2.0 * jerk)))
    else:
        ramp = min(
            jerk / snap,
            np.sqrt(acceleration / snap),
            np.cbrt(velocity / (2.0 * snap)),
            (distance / (8.0 * snap)) ** 0.25,
        )
        peak = snap * ramp
        hold = max(
            0.0,
            min(
                acceleration / peak - ramp,
                # peak (ramp + hold) (2 ramp + hold) = velocity
                0.5 * (np.sqrt(ramp**2 + 4.0 * velocity / peak) - 3.0 * ramp),
                _longest_pulse(ramp, distance / (2.0 * peak)) - 2.0 * ramp,
            ),
        )
    pulse, reached = 2.0 * ramp + hold, peak * (ramp + hold)
    steady = max(
        0.0,
        min(
            velocity / reached - pulse,
            # reached (pulse + steady) (2 pulse + steady) = distance
            0.5 * (np.sqrt(pulse**2 + 4.0 * distance / reached) - 3.0 * pulse),
        ),
    )
    both = 2.0 * pulse + steady
    cruise = max(0.0, distance / (reached * (pulse + steady)) - both)
    return float(ramp), float(hold), float(steady), float(cruise)


def _longest_pulse(ramp: float, volume: float) -> float:
    """Return the root p > ramp of p^2 (p - ramp) = volume, by the hyperbolic form of Cardano's."""
    third = ramp / 3.0
    angle = np.arccosh(1.0 + 0.5 * volume / third**3) / 3.0
    return float(third + 2.0 * third * np.cosh(angle))


def setpoint(
    distance: float,
    *,
    velocity: float,
    acceleration: float,
    jerk: float | None = None,
    snap: float | None = None,
    start: float = 0.0,
    rest: float = 0.0,
    settle: float = 0.0,
    exposure: float = 0.0,
    rate: float | None = None,
) -> SetPointProfile:
    """Return the fastest motion from rest to rest within the bounds, without optimisation.

    The order of the motion is that of the derivative that jumps. It is two (acceleration), three if
    `jerk` is given, or four if `snap` is given too. For a short distance some bounds are not
    reached. Motions of second and third order are time-optimal. A motion of fourth order is
    time-optimal if it reaches the velocity bound. If it does not, acceleration and jerk still
    return to zero between speeding up and slowing down. The motion is then at most 7.5 % longer
    than the optimum.

    With `rate` all derivatives jump at samples of a grid. The motion is then a few samples longer,
    and its largest derivatives are slightly smaller, so that all bounds are kept and the final
    position is exact. The samples of all derivatives are then consistent without interpolation.

    Parameters
    ----------
    distance : float [m or rad]
        Signed length of the motion.
    velocity, acceleration : float [m/s, m/s^2]
        Bounds on the magnitudes.
    jerk, snap : float, optional [m/s^3, m/s^4]
        Bounds on the third and fourth derivative. A bound on snap needs one on jerk.
    start : float [m]
        Position before the motion.
    rest : float [s]
        Time at rest before the motion begins.
    settle, exposure : float [s]
        Time to settle after the motion, and length of the exposure window that follows.
    rate : float, optional [Hz]
        Rate of the controller. If it is given, derivatives jump only at its samples, and rests are
        rounded up to whole samples.

    Returns
    -------
    SetPointProfile
        Motion, with `.at(t)`, `.duration`, `.exposures`, and `.then(other)` to append another one.

    Raises
    ------
    ModelError
        When a bound is not positive, snap is given without jerk, or the distance is 0 or not
        finite.

    References
    ----------
    [Lambrechts2005]_.

    Examples
    --------
    >>> move = setpoint(0.1, velocity=0.5, acceleration=10.0, jerk=1000.0)
    >>> round(move.duration, 9)
    0.26
    >>> float(move.at(1.0).position)
    0.1
    """
    signed = float(real_array(distance, "distance", ()))
    bounds = _bounds(velocity, acceleration, jerk, snap)
    if not signed:
        raise ModelError("distance must not be 0: a motion of no length needs no set-point.")
    grid = _Grid(rate)
    length = abs(signed)
    t = grid.durations(length, bounds)
    _, w = spans(t)
    up = flank(t[:-1], length / w[-1])
    waits = [grid.whole(one, name) for one, name in ((rest, "rest"), (settle, "settle"),
             (exposure, "exposure"))]  # fmt: skip
    return _assembled(up, t[-1], signed, length, grid, waits, start, len(bounds), False)


def scan(
    length: float,
    *,
    velocity: float,
    acceleration: float,
    jerk: float | None = None,
    snap: float | None = None,
    settle: float = 0.0,
    start: float = 0.0,
    rest: float = 0.0,
    rate: float | None = None,
) -> SetPointProfile:
    """Return a scan: speed up, settle, expose a length at constant velocity, slow down and rest.

    Parameters
    ----------
    length : float [m or rad]
        Signed length that is exposed at constant velocity.
    velocity : float [m/s]
        Velocity during the exposure. With a grid it is lowered so that the exposure lasts a whole
        number of samples.
    acceleration, jerk, snap : float [m/s^2, m/s^3, m/s^4]
        Bounds, as for `setpoint`.
    settle : float [s]
        Settling time at constant velocity before the exposure.
    start : float [m]
        Position before the scan. The exposure begins farther along, at ``at(exposures).position``.
    rest, rate : as for `setpoint`

    Returns
    -------
    SetPointProfile
        Scan with one exposure window.

    Raises
    ------
    ModelError
        As for `setpoint`.

    Examples
    --------
    >>> one = scan(0.02, velocity=0.2, acceleration=5.0, jerk=500.0, settle=0.01, rate=1e4)
    >>> begin, end = one.at(one.exposures[0]).position
    >>> round(float(end - begin), 12)
    0.02
    """
    signed = float(real_array(length, "length", ()))
    bounds = _bounds(velocity, acceleration, jerk, snap)
    if not signed:
        raise ModelError("length must not be 0: a scan of no length exposes nothing.")
    grid = _Grid(rate)
    wait = [grid.whole(rest, "rest"), grid.whole(settle, "settle")]
    exposed = grid.whole(abs(signed) / bounds[0], "length / velocity")
    exposed = max(exposed, grid.tick) if grid else exposed  # at least one sample
    speed = abs(signed) / exposed
    t = grid.durations(speed, bounds[1:])
    up = flank(t, speed)
    total = speed * (spans(t)[0][-1] + wait[1]) + abs(signed)
    waits = [wait[0], wait[1], exposed]
    return _assembled(up, wait[1] + exposed, signed, total, grid, waits, start, len(bounds), True)


class _Grid:
    """The sample grid on which a motion switches; false without a grid."""

    def __init__(self, rate: float | None) -> None:
        self.tick = 1.0 if rate is None else 1.0 / positive(rate, "rate")
        self.given = rate is not None

    def __bool__(self) -> bool:
        return self.given

    def whole(self, time: Any, name: str) -> float:
        """Return a time [s], rounded up to whole samples."""
        length = positive(time, name, zero=True)
        return float(np.ceil(length / self.tick - TYPED)) * self.tick if self else length

    def durations(self, distance: float, bounds: tuple[float, ...]) -> tuple[float, ...]:
        """Return the durations [s] of each level of a motion."""
        if not self:
            return shortest(distance, bounds)
        return tuple(self.tick * n for n in on_grid(distance, bounds, 1.0 / self.tick))


def _bounds(velocity: Any, acceleration: Any, jerk: Any, snap: Any) -> tuple[float, ...]:
    """Return the bounds that are given, from velocity upwards."""
    if snap is not None and jerk is None:
        raise ModelError(
            "a bound on snap needs one on jerk, or the jerk would grow without bound: pass jerk=."
        )
    both = {"velocity": velocity, "acceleration": acceleration}
    more = {name: one for name, one in {"jerk": jerk, "snap": snap}.items() if one is not None}
    return tuple(positive(one, name) for name, one in {**both, **more}.items())


def _assembled(
    up: list[Phase],
    cruise: float,
    signed: float,
    total: float,
    grid: _Grid,
    waits: list[float],
    start: Any,
    order: int,
    moving: bool,
) -> SetPointProfile:
    """Return rest, rise, cruise and fall as one value."""
    # `waits` are rest, settle and exposure; the last two at constant velocity when `moving`
    rest, settle, exposure = waits
    rise = sum(row.length for row in up)
    speed = total / (rise + cruise)
    still, steady = np.zeros(5), np.zeros(5)
    steady[0], steady[1] = 0.5 * speed * rise, speed
    rows = [Phase(rest, False, still), *up, Phase(cruise, False, steady), *mirrored(up, total)]
    after = rest + rise + settle if moving else rest + 2.0 * rise + cruise + settle
    if not moving:
        rows.append(Phase(settle + exposure, False, np.array([total, 0.0, 0.0, 0.0, 0.0])))
    rows = [row for row in rows if row.length > 0]
    ticks = np.array([row.length for row in rows]) / grid.tick
    if grid:
        ticks = np.round(ticks)
    edges = np.concatenate([[0.0], np.cumsum(ticks)])
    sign, begin = float(np.sign(signed)), float(real_array(start, "start", ()))
    states = sign * np.array([row.state for row in rows])
    states[:, 0] += begin
    windows = [[after, after + exposure]] if exposure > 0 else np.zeros((0, 2))
    return SetPointProfile(
        edges,
        np.array([row.length for row in rows]),
        np.array([row.from_end for row in rows]),
        states,
        begin,
        begin + sign * total,
        order,
        grid.tick,
        bool(grid),
        np.array(windows),
    )
