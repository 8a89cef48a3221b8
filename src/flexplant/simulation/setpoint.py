"""Moves and scans with bounded velocity, acceleration, jerk and snap."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import positive, real_array
from ..errors import ModelError
from .motion import ON_GRID, Phase, SetPoint, flank, mirrored, on_grid, shortest, spans


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
) -> SetPoint:
    """Return the fastest motion from rest to rest within the bounds, in closed form.

    Second order (acceleration jumps), third with `jerk` (jerk jumps) or fourth with `snap`. Bounds
    that the distance is too short to reach are not reached. The second and third order are
    time-optimal; so is the fourth where the velocity bound is reached. Where it is not,
    acceleration and jerk still return to zero between speeding up and slowing down, which takes at
    most 7.5 % longer than the optimum.

    With `rate` all switching times are samples of a grid: the motion is a few samples longer, the
    levels a little lower, so that all bounds hold and the end is exact; the samples of all
    derivatives then belong together without any interpolation.

    Parameters
    ----------
    distance : float [m or rad]
        Signed length of the motion.
    velocity, acceleration : float [m/s, m/s^2]
        Bounds on the magnitudes.
    jerk, snap : float, optional [m/s^3, m/s^4]
        Bounds on the third and fourth derivative; a bound on snap needs one on jerk.
    start : float [m]
        Position before the motion.
    rest : float [s]
        Time at rest before the motion begins.
    settle, exposure : float [s]
        Time to settle after the motion, and length of the exposure window after that.
    rate : float, optional [Hz]
        Of the controller, to switch on its samples; rests are rounded up to whole samples.

    Returns
    -------
    SetPoint
        With `.at(t)`, `.duration`, `.exposures`, and `.then(other)` for chains.

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
    t = tuple(grid.tick * n for n in on_grid(length, bounds, 1.0 / grid.tick)) if grid else ()
    t = t or shortest(length, bounds)
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
) -> SetPoint:
    """Return a scan: to constant velocity, settle, expose a length, and back to rest.

    Parameters
    ----------
    length : float [m or rad]
        Signed length that is exposed at constant velocity.
    velocity : float [m/s]
        During the exposure; with a grid lowered so that the exposure takes whole samples.
    acceleration, jerk, snap : float [m/s^2, m/s^3, m/s^4]
        Bounds, as for `setpoint`.
    settle : float [s]
        At constant velocity before the exposure.
    start : float [m]
        Position before the scan. The exposure begins later: see ``at(exposures)``.
    rest : float [s]
        Time at rest before the scan begins.
    rate : float, optional [Hz]
        As for `setpoint`.

    Returns
    -------
    SetPoint
        With one exposure window.

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
    exposed = max(exposed, grid.tick) if grid else exposed  # a sample at least
    speed = abs(signed) / exposed
    if grid:
        t = tuple(grid.tick * n for n in on_grid(speed, bounds[1:], 1.0 / grid.tick))
    else:
        t = shortest(speed, bounds[1:])
    up = flank(t, speed)
    total = speed * (spans(t)[0][-1] + wait[1]) + abs(signed)
    waits = [wait[0], wait[1], exposed]
    return _assembled(up, wait[1] + exposed, signed, total, grid, waits, start, len(bounds), True)


class _Grid:
    """The samples that a motion switches on; false without any."""

    def __init__(self, rate: float | None) -> None:
        self.tick = 1.0 if rate is None else 1.0 / positive(rate, "rate")
        self.given = rate is not None

    def __bool__(self) -> bool:
        return self.given

    def whole(self, time: Any, name: str) -> float:
        """Return a time [s], rounded up to whole samples."""
        length = positive(time, name, zero=True)
        return float(np.ceil(length / self.tick - ON_GRID)) * self.tick if self else length


def _bounds(velocity: Any, acceleration: Any, jerk: Any, snap: Any) -> tuple[float, ...]:
    """Return the bounds that are given, from velocity upwards."""
    found = [positive(velocity, "velocity"), positive(acceleration, "acceleration")]
    if snap is not None and jerk is None:
        raise ModelError(
            "a bound on snap needs one on jerk, or the jerk would grow without bound: pass jerk=."
        )
    if jerk is not None:
        found.append(positive(jerk, "jerk"))
    if snap is not None:
        found.append(positive(snap, "snap"))
    return tuple(found)


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
) -> SetPoint:
    """Return rest, rise, cruise and fall as one value.

    `waits` are rest, settle and exposure; the last two at constant velocity when `moving`.
    """
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
    return SetPoint(
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
