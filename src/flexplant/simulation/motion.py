"""A set-point: a motion from rest to rest, constant in its highest derivative phase by phase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..errors import ModelError, counted
from ..values import FloatArray, Value, instance, real_array
from .profile import moved

#: [samples] a time this close to the grid is on it
ON_GRID = 1e-6


class Motion(NamedTuple):
    """Position and its derivatives at the same times.

    What is above the order of a set-point is given as zero: it is an impulse where the highest
    derivative jumps.

    Parameters
    ----------
    position, velocity, acceleration, jerk, snap : arrays
        In m or rad, and per second to the order of each.

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
class SetPoint(Value):
    """A motion from rest to rest along one axis; made by `setpoint`, `scan` and `then`.

    Parameters
    ----------
    edges : (m + 1,) array [ticks]
        Where the phases begin, from 0, and the end of the last one.
    lengths : (m,) array [s]
        Of the phases, also where the edges are large numbers beside them.
    from_end : (m,) bool array
        Whether a phase's state is given at its end, not at its beginning.
    states : (m, 5) array
        Position, velocity, acceleration, jerk and snap of each phase there.
    start, stop : float [m or rad]
        Where it rests before and after.
    order : int
        Of the highest derivative, constant in each phase: 2, 3 or 4.
    tick : float [s]
        The grid that all edges are whole numbers on; 1 s when there is none.
    gridded : bool
        Whether there is a grid.
    exposures : (k, 2) array [s]
        Beginning and end of each exposure window.

    Examples
    --------
    >>> import flexplant as fx
    >>> move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    >>> float(move.at(move.duration).position.round(9))
    0.0001
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
            f"<SetPoint {self.start:g} -> {self.stop:g} m or rad in {self.duration:.6g} s, order "
            f"{self.order}, velocity to {peak.velocity:.4g} /s, acceleration to "
            f"{peak.acceleration:.4g} /s^2{windows}{grid}>"
        )

    @property
    def duration(self) -> float:
        """Time until all is over, rests and windows included [s]."""
        return float(self.edges[-1]) * self.tick

    @property
    def rate(self) -> float | None:
        """Rate [Hz] of the grid on which it switches; None without a grid."""
        return 1.0 / self.tick if self.gridded else None

    @property
    def peaks(self) -> Motion:
        """Largest magnitudes that are reached, the position's as the distance from the start."""
        found = np.abs(np.concatenate([self._at(self.edges[:-1]), self._before()], axis=1))
        far = max(abs(self.stop - self.start), float(np.ptp(self._at(self.edges[:-1])[0])))
        return Motion(np.asarray(far), *found[1:].max(axis=1))

    def at(self, t: npt.ArrayLike) -> Motion:
        """Return position, velocity, acceleration, jerk and snap at times t, all in phase.

        Parameters
        ----------
        t : array or float [s]
            Any times; before and after the motion the set-point rests. Where a derivative jumps
            it is the one after the jump, which holds until the next sample.

        Returns
        -------
        Motion
            Named tuple (position, velocity, acceleration, jerk, snap) of arrays shaped like t.

        Raises
        ------
        ModelError
            When a time is not finite.
        """
        x = real_array(t, "t") / self.tick
        if self.gridded:
            near = np.round(x)
            x = np.where(np.abs(x - near) < ON_GRID, near, x)
        found = self._at(x)
        found[1:, (x < 0.0) | (x >= self.edges[-1])] = 0.0
        found[0] = np.where(
            x <= 0.0, self.start, np.where(x >= self.edges[-1], self.stop, found[0])
        )
        return Motion(*found)

    def then(self, following: SetPoint) -> SetPoint:
        """Return this set-point with another one after it, which begins where this one ends.

        Parameters
        ----------
        following : SetPoint
            Of the same order, on the same grid.

        Returns
        -------
        SetPoint
            With the exposure windows of both.

        Raises
        ------
        ModelError
            When it is no SetPoint, or order or grid differ.
        """
        other: SetPoint = instance(following, SetPoint, "following", "Use setpoint(...).")
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
        return moved(np.moveaxis(self.states[phase], -1, 0), elapsed)

    def _before(self) -> FloatArray:
        """Return the states just before the ends of the phases."""
        return moved(self.states.T, np.where(self.from_end, 0.0, self.lengths))
