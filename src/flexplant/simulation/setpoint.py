"""Point-to-point set-points with bounded velocity, acceleration, jerk and snap, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..errors import ModelError
from ..values import FloatArray, Value, positive, real_array


class Motion(NamedTuple):
    """Position and its derivatives at some times."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class SetPoint(Value):
    """A motion from rest to rest along one axis, made by `setpoint`.

    Parameters
    ----------
    distance : float [m or rad]
        Signed length of the motion.
    velocity, acceleration, jerk : float [m/s, m/s^2, m/s^3]
        Bounds.
    snap : float or None [m/s^4]
        Bound of the fourth derivative; None lets the jerk jump.
    start : float [m]
        Position before the motion.
    rest : float [s]
        Time at rest before the motion begins.
    """

    distance: float
    velocity: float
    acceleration: float
    jerk: float
    snap: float | None = None
    start: float = 0.0
    rest: float = 0.0

    def __post_init__(self) -> None:
        self._set(
            distance=float(real_array(self.distance, "distance", ())),
            velocity=positive(self.velocity, "velocity"),
            acceleration=positive(self.acceleration, "acceleration"),
            jerk=positive(self.jerk, "jerk"),
            snap=None if self.snap is None else positive(self.snap, "snap"),
            start=float(real_array(self.start, "start", ())),
            rest=positive(self.rest, "rest", zero=True),
        )
        if not self.distance:
            raise ModelError("distance must not be 0: a motion of no length needs no set-point.")

    def __repr__(self) -> str:
        end = self.start + self.distance
        return (
            f"<SetPoint {self.start:g} -> {end:g} in {self.duration:.6g} s, order "
            f"{3 if self.snap is None else 4}, v {self.velocity:g}, a {self.acceleration:g}>"
        )

    @property
    def duration(self) -> float:
        """Time until the motion is over, the rest before it included [s]."""
        return self.rest + float(self._times[-1]) * 2.0

    @cached_property
    def _phases(self) -> tuple[float, float, float, float]:
        return _durations(
            abs(self.distance), self.velocity, self.acceleration, self.jerk, self.snap
        )

    @cached_property
    def _times(self) -> FloatArray:
        """Ends of the eight phases of the first half, from the beginning of the motion."""
        ramp, hold, steady, cruise = self._phases
        pulse = (ramp, hold, ramp)
        return np.cumsum([*pulse, steady, *pulse, 0.5 * cruise])

    @cached_property
    def _starts(self) -> FloatArray:
        """Position, velocity, acceleration, jerk and snap (8, 5) at the start of each phase."""
        ramp, hold, steady, _ = self._phases
        peak = self.jerk if self.snap is None else self.snap * ramp
        snap = 0.0 if self.snap is None else self.snap
        snaps = (snap, 0.0, -snap, 0.0, -snap, 0.0, snap, 0.0)
        jerks = (0.0, peak, peak, 0.0, 0.0, -peak, -peak, 0.0)
        rows = np.zeros((8, 5))
        rows[:, 4], rows[:, 3] = snaps, jerks
        for i, length in enumerate((ramp, hold, ramp, steady, ramp, hold, ramp)):
            rows[i + 1, :3] = _moved(rows[i], np.float64(length))[:3]
        rows[7, 2] = 0.0  # its rounding error would grow over a long cruise
        return rows

    def at(self, t: npt.ArrayLike) -> Motion:
        """Return position, velocity, acceleration and jerk at times t.

        Parameters
        ----------
        t : array or float [s]
            Any times; before and after the motion the set-point rests.

        Returns
        -------
        Motion
            Named tuple (position, velocity, acceleration, jerk) of arrays shaped like t.

        Raises
        ------
        ModelError
            When a time is not finite.
        """
        moving = real_array(t, "t") - self.rest
        half = float(self._times[-1])
        # the second half mirrors the first: the end is reached exactly
        late = moving > half
        early = np.clip(np.where(late, 2.0 * half - moving, moving), 0.0, half)
        phase = np.minimum(np.searchsorted(self._times, early, side="right"), 7)
        elapsed = early - np.concatenate([[0.0], self._times])[phase]
        p, v, a, j = _moved(np.moveaxis(self._starts[phase], -1, 0), elapsed)
        resting = (moving <= 0.0) | (moving >= 2.0 * half)
        sign, length = np.sign(self.distance), abs(self.distance)
        position = np.where(late, length - p, p)
        return Motion(
            self.start + sign * np.where(resting, np.where(late, length, 0.0), position),
            sign * np.where(resting, 0.0, v),
            sign * np.where(resting, 0.0, np.where(late, -a, a)),
            sign * np.where(resting, 0.0, j),
        )


def setpoint(
    distance: float,
    *,
    velocity: float,
    acceleration: float,
    jerk: float,
    snap: float | None = None,
    start: float = 0.0,
    rest: float = 0.0,
) -> SetPoint:
    """Return the fastest motion from rest to rest within the bounds, in closed form.

    Third order (bounded jerk, piecewise constant) or, with `snap`, fourth order. Bounds that the
    distance is too short to reach are not reached. The third order is time-optimal; so is the
    fourth where the velocity bound is reached. Where it is not, acceleration and jerk still
    return to zero between speeding up and slowing down, which takes at most 7.5 % longer than
    the optimum.

    Parameters
    ----------
    distance : float [m or rad]
        Signed length of the motion.
    velocity, acceleration, jerk : float [m/s, m/s^2, m/s^3]
        Bounds on the magnitudes.
    snap : float, optional [m/s^4]
        Bound on the fourth derivative.
    start : float [m]
        Position before the motion.
    rest : float [s]
        Time at rest before the motion begins.

    Returns
    -------
    SetPoint
        With `.at(t)` and `.duration`.

    Raises
    ------
    ModelError
        When a bound is not positive, or the distance is 0 or not finite.

    Examples
    --------
    >>> move = setpoint(0.1, velocity=0.5, acceleration=10.0, jerk=1000.0)
    >>> round(move.duration, 9)
    0.26
    >>> float(move.at(1.0).position)
    0.1
    """
    return SetPoint(distance, velocity, acceleration, jerk, snap, start, rest)


def _durations(
    distance: float, velocity: float, acceleration: float, jerk: float, snap: float | None
) -> tuple[float, float, float, float]:
    """Return how long snap, jerk, acceleration and velocity are held in one flank.

    A jerk pulse lasts J = 2 ramp + hold and adds the acceleration a; the acceleration lasts
    2 J + steady and adds the velocity a (J + steady). Each duration is the longest that the bounds
    and the distance allow, from the highest derivative down.
    """
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
    flank = 2.0 * pulse + steady
    cruise = max(0.0, distance / (reached * (pulse + steady)) - flank)
    return float(ramp), float(hold), float(steady), float(cruise)


def _longest_pulse(ramp: float, volume: float) -> float:
    """Return the root p > ramp of p^2 (p - ramp) = volume, by the hyperbolic form of Cardano's."""
    third = ramp / 3.0
    angle = np.arccosh(1.0 + 0.5 * volume / third**3) / 3.0
    return float(third + 2.0 * third * np.cosh(angle))


def _moved(state: FloatArray, t: FloatArray | np.float64) -> tuple[FloatArray, ...]:
    """Return position, velocity, acceleration and jerk after a time of constant snap."""
    p, v, a, j, s = state
    return (
        p + t * (v + t / 2.0 * (a + t / 3.0 * (j + t / 4.0 * s))),
        v + t * (a + t / 2.0 * (j + t / 3.0 * s)),
        a + t * (j + t / 2.0 * s),
        j + t * s,
    )
