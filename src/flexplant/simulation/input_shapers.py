"""Moves that leave modes at rest: input shapers, and set-points whose ramps last whole periods."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, between, one_of, positive, positive_array, real_array
from ..errors import ModelError, counted
from ..store import Value
from .motion import SetPointProfile, constant_snap, setpoint

#: largest number of factors of a shaper; more would take too long
_MOST = 6
#: number of frequencies at which the residual of a band is evaluated: a hundred on each lobe
_LINES = 100


@dataclass(frozen=True, eq=False, repr=False)
class InputShaper(Value):
    """Sequence of impulses that leaves no vibration of the modes for which it is designed.

    A command is replaced by ``sum_i a_i command(t - t_i)``, with ``sum_i a_i = 1``. `input_shaper`
    makes this object.

    Parameters
    ----------
    times : (n,) array [s]
        Times t_i of the impulses. The first one is 0.
    amplitudes : (n,) array
        Amplitudes a_i. They are positive, so that no actuator force exceeds that of the command.
    """

    times: FloatArray
    amplitudes: FloatArray

    def __repr__(self) -> str:
        count = counted(self.times.size, "impulse")
        return f"<InputShaper: {count} in {1e3 * self.duration:.4g} ms>"

    @property
    def duration(self) -> float:
        """Time [s] by which the shaper makes a move longer."""
        return float(self.times[-1])

    def residual(self, freq: npt.ArrayLike, damping: npt.ArrayLike) -> FloatArray:
        """Return the remaining vibration of modes relative to that without the shaper.

        For a command that is an impulse, the ratio is ``V = e^(-zeta omega t_n) |sum_i a_i e^(zeta
        omega t_i) e^(j omega_d t_i)|`` [Singer1990]_.

        Parameters
        ----------
        freq : float or (k,) array [Hz]
            Undamped frequencies.
        damping : float or (k,) array
            Damping ratios.

        Returns
        -------
        (k,) array
            Amplitude ratios. 0 means no remaining vibration, and 1 the same as without the shaper.
        """
        omega = 2.0 * np.pi * np.atleast_1d(positive_array(freq, "freq"))
        zeta = np.broadcast_to(real_array(damping, "damping"), omega.shape)
        # e^(s* t) with the conjugate pole, backwards in time from the last impulse
        pole = zeta * omega + 1j * omega * np.sqrt(1.0 - zeta**2)
        turns = np.exp(pole[:, None] * (self.times - self.times[-1]))
        return np.asarray(np.abs(turns @ self.amplitudes))

    def shaped(self, move: SetPointProfile) -> SetPointProfile:
        """Return the shaped move. Its distance is the same, and it takes longer by `duration`.

        The shaped move is the sum of copies of the move. Each copy starts at the time of an impulse
        and is multiplied by its amplitude. The sum is exact and not sampled.
        """
        delays = self.times / move.tick
        edges = np.unique(np.concatenate([move.edges + late for late in delays]))
        # edges that only rounding separates are merged
        edges = edges[np.concatenate([[True], np.diff(edges) > 1e-12 * edges[-1]])]
        middle = 0.5 * (edges[1:] + edges[:-1])
        states = np.zeros((edges.size - 1, 5))
        for late, share in zip(self.times, self.amplitudes, strict=True):
            at = np.stack(move.at(middle * move.tick - late), axis=1)
            states += share * at
        half = 0.5 * np.diff(edges) * move.tick
        return move.replace(
            edges=edges,
            lengths=2.0 * half,
            from_end=np.zeros(middle.size, dtype=bool),
            states=constant_snap(states.T, -half).T,
            gridded=False,
            exposures=move.exposures + self.duration,
        )

    def then(self, other: InputShaper) -> InputShaper:
        """Return the shaper that applies this shaper and then `other` to a command."""
        times = (self.times[:, None] + other.times).ravel()
        order = np.argsort(times, kind="stable")
        sizes = (self.amplitudes[:, None] * other.amplitudes).ravel()
        return InputShaper(times[order], sizes[order])


def input_shaper(
    freq: npt.ArrayLike,
    *,
    damping: npt.ArrayLike = 0.0,
    kind: Literal["ZV", "ZVD", "EI"] = "ZV",
    change: float = 0.0,
    left: float = 0.05,
) -> InputShaper:
    """Return the shaper that leaves one or several modes at rest after a move.

    The residual is the remaining vibration divided by that without a shaper. ZV (zero vibration)
    has two impulses half a period apart. ZVD (zero vibration and derivative) has three impulses,
    and the slope of its residual over frequency is zero at the mode. EI (extra-insensitive) has
    three impulses; its residual is `left` at the mode and zero at a frequency on each side of it.
    With `change`, several ZV shapers for frequencies in the uncertain band are applied one after
    the other, until less than `left` remains everywhere in the band. If several modes are given,
    their shapers are applied one after the other.

    Parameters
    ----------
    freq : float or (k,) array [Hz]
        Undamped frequencies of the modes.
    damping : float or (k,) array
        Damping ratios below 1.
    kind : {"ZV", "ZVD", "EI"}
        Kind of the shaper if `change` is 0.
    change : float
        Relative uncertainty of each frequency, to both sides.
    left : float
        Largest fraction of the vibration that may remain, for EI and with `change`.

    Returns
    -------
    InputShaper

    Raises
    ------
    ModelError
        When a frequency is not positive, a damping ratio is not below 1, or the band is so wide
        that more than `left` remains with six shapers.

    References
    ----------
    [Singer1990]_; [Singhose1994]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> zv = fx.simulation.input_shaper(10.0)
    >>> zv.times.round(3), zv.amplitudes, zv.residual([10.0, 11.0], 0.0).round(3)
    (array([0.  , 0.05]), array([0.5, 0.5]), array([0.   , 0.156]))
    >>> robust = fx.simulation.input_shaper(10.0, change=0.2)
    >>> bool(robust.residual([8.0, 12.0], 0.0).max() < 0.05)
    True
    """
    modes = np.atleast_1d(positive_array(freq, "freq"))
    ratios = np.broadcast_to(real_array(damping, "damping"), modes.shape)
    one_of(kind, "kind", ("ZV", "ZVD", "EI"))
    between(left, "left", 0.0, 1.0, "It is a fraction of the vibration.")
    if np.any((ratios < 0) | (ratios >= 1.0)):
        raise ModelError(
            "damping ratios lie between 0 and 1, since only oscillating modes are shaped."
        )
    if change:
        between(change, "change", 0.0, 0.5, "It is a fraction of the frequency.")
        found = [_over_band(f, zeta, change, left) for f, zeta in zip(modes, ratios, strict=True)]
    else:
        weights = {"ZV": (1, 1), "ZVD": (1, 2, 1), "EI": (1 + left, 2 - 2 * left, 1 + left)}[kind]
        found = [_half_periods(f, zeta, weights) for f, zeta in zip(modes, ratios, strict=True)]
    return reduce(InputShaper.then, found)


def _half_periods(freq: float, zeta: float, weights: tuple[float, ...]) -> InputShaper:
    """Return impulses half a damped period apart, with amplitudes that cancel at the end."""
    root = np.sqrt(1.0 - zeta**2)
    decay = np.exp(-np.pi * zeta / root)  # in half a period
    sizes = np.array(weights) * decay ** np.arange(len(weights))
    return InputShaper(np.arange(len(weights)) / (2.0 * freq * root), sizes / sizes.sum())


def _over_band(freq: float, zeta: float, change: float, left: float) -> InputShaper:
    """Return enough ZV shapers at Chebyshev points of a band."""
    for count in range(1, _MOST + 1):
        points = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        one = reduce(
            InputShaper.then,
            (_half_periods(freq * (1.0 + change * x), zeta, (1, 1)) for x in points),
        )
        band = freq * (1.0 + change * np.linspace(-1.0, 1.0, count * _LINES + 1))
        if one.residual(band, zeta).max() <= left:
            return one
    raise ModelError(
        f"{_MOST} shapers leave more than {left:.0%} of a mode with a frequency error of "
        f"{change:.0%}: allow more with left=, or measure the frequency better."
    )


def quiet_setpoint(
    distance: float,
    *,
    velocity: float,
    acceleration: float,
    freq: npt.ArrayLike,
    start: float = 0.0,
    settle: float = 0.0,
    exposure: float = 0.0,
) -> SetPointProfile:
    """Return a set-point of third order that leaves one or two modes at rest.

    The velocity is ``distance`` times the convolution of three rectangular pulses of unit area.
    Their lengths are T_1 >= T_2 >= T_3. The Fourier transform of a pulse is zero at each frequency
    f for which ``f T_i`` is a whole number. A mode of this frequency therefore remains at rest
    after the move. T_3 is one period of the first mode, and T_2 is a whole number of periods of the
    second mode. The bounds on velocity and acceleration are kept. The jerk is not bounded; it
    follows from T_3.

    Parameters
    ----------
    distance : float [m or rad]
        Distance of the move.
    velocity, acceleration : float [m/s, m/s^2]
        Bounds on the magnitudes.
    freq : float or (2,) array [Hz]
        Frequency of the mode, or of two modes.
    start, settle, exposure : float
        As in `setpoint`.

    Returns
    -------
    SetPointProfile

    Raises
    ------
    ModelError
        When a bound or frequency is not positive, or there are more than two modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> move = fx.simulation.quiet_setpoint(0.1, velocity=0.5, acceleration=10.0, freq=40.0)
    >>> round(move.duration, 4), round(float(move.peaks.acceleration), 3)
    (0.275, 10.0)
    """
    modes = np.atleast_1d(positive_array(freq, "freq"))
    if modes.size > 2:
        raise ModelError(
            f"ramps of a set-point serve two modes, got {modes.size}: use input_shaper for more."
        )
    v, a = positive(velocity, "velocity"), positive(acceleration, "acceleration")
    length = abs(float(distance))
    third = 1.0 / float(modes[0])
    second = max(v / a, third)
    if modes.size > 1:  # as many whole periods as the bound on acceleration requires
        second = float(np.ceil(second * modes[1] - 1e-9)) / float(modes[1])
    first = max(length / v, second + third, length / (a * second))
    speed = length / first
    return setpoint(
        distance,
        velocity=speed,
        acceleration=speed / second,
        jerk=speed / second / third,
        start=start,
        settle=settle,
        exposure=exposure,
    )
