"""Iterative learning: feedforward gains from the errors of repeated moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import MOST_DRAWS, FloatArray, function, instance, positive, whole
from ..errors import ModelError, counted, short, with_unit
from ..loop import ClosedLoop, close_loop
from ..loop.blocks import force_name
from ..store import Value
from ..tolerances import SAME
from .feedforward import Feedforward, known_forces, term_numbers, tracked
from .motion import SetPointProfile
from .response import Response
from .sampled_runs import simulate


@dataclass(frozen=True, eq=False, repr=False)
class LearnedFeedforward(Value):
    """A feedforward with learned gains, and the error of each move; prints as a table.

    Parameters
    ----------
    feedforward : Feedforward
        Feedforward with the gains of that move which had the smallest error.
    errors : (trials,) array [m]
        Rms of the error in each move.
    gains : (trials, r, 5) array
        The gains of each move.
    """

    feedforward: Feedforward
    errors: FloatArray
    gains: FloatArray

    def __repr__(self) -> str:
        lines = [f"<LearnedFeedforward {counted(self.errors.size, 'move')}>"]
        lines += [f"  move {i}: rms {with_unit(e, 'm')}" for i, e in enumerate(self.errors[:5], 1)]
        return "\n".join(lines)


def learn_feedforward(
    start: Feedforward,
    trial: Callable[[Feedforward], Response],
    loop: ClosedLoop,
    move: SetPointProfile,
    *,
    duration: float,
    terms: Sequence[str] = ("acceleration", "jerk", "snap"),
    trials: int = 4,
    step: float = 1.0,
) -> LearnedFeedforward:
    """Return feedforward gains that are tuned on repeated moves of the machine, by least squares.

    The forces are a sum of basis functions: the set-point's derivatives for each axis, multiplied
    by gains. In a linear loop the error depends linearly on these gains, ``e = e_0 + Phi gains``.
    Phi is the effect of a unit of each gain on the error in closed loop. It is computed from a
    model and may be approximate: each move measures the remaining error, and the least-squares
    gains for this error are added to the gains. The error e_0, which remains without these forces,
    needs no model, because it is a part of the measured error. Every error that repeats (due to a
    wrong mass, a compliance or a delay) is therefore compensated as far as the basis functions
    allow.

    Parameters
    ----------
    start : Feedforward
        Feedforward of the first move.
    trial : function
        Function that takes a Feedforward, makes the move on the machine with it, and returns the
        record.
    loop : ClosedLoop
        Loop of the same controller, without feedforward, around a model of the machine. Phi is
        computed from it.
    move : SetPointProfile
        Move that each trial repeats.
    duration : float [s]
        Duration of each run.
    terms : sequence of str
        Names of the derivatives whose gains are tuned.
    trials : int
        Number of moves.
    step : float
        Fraction of each correction that is applied. Use 1, or less if the noise is larger than the
        repeating error.

    Returns
    -------
    LearnedFeedforward

    Raises
    ------
    ModelError
        When `trial` does not return a Response with the error of the POI, the gains depend on the
        place, or a number is out of range.

    References
    ----------
    [VandeWijdevenBosgra2010]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> move = fx.setpoint(1e-3, velocity=0.1, acceleration=5.0, jerk=500.0)
    >>> def trial(forward):  # on the machine, here the model
    ...     closed = fx.close_loop(plant, observer, servo, forward)
    ...     return fx.simulate(closed, reference=move, duration=0.3, noise=False)
    >>> start = fx.design_feedforward(plant).up_to("acceleration")
    >>> found = fx.simulation.learn_feedforward(start, trial, loop, move, duration=0.3, trials=2)
    >>> bool(found.errors[1] < 0.2 * found.errors[0])
    True
    """
    if not isinstance(start, Feedforward) or len(start.gains) != 1:
        raise ModelError(
            f"need a Feedforward with one set of gains, got {short(start)}. Use "
            "design_feedforward(plant)."
        )
    instance(loop, ClosedLoop, "loop", "Use close_loop(plant, ...).")
    instance(move, SetPointProfile, "move", "Use setpoint(...) or scan(...).")
    orders = term_numbers(terms)
    part = positive(step, "step")
    if part > 1.0:
        raise ModelError(f"step is a fraction of a correction, at most 1, got {part:g}. Pass 1.0.")
    _, poi, own, _ = tracked(loop.machine, start.reference)
    others = [one for one in start.axes if one != poi.channel(own)]
    channels = [poi.derived(own, "error"), *others]
    effects = _gain_effects(start, loop, move, duration, orders, channels)
    unit = np.linalg.norm(effects, axis=1)
    used = unit > 0
    pseudo = np.linalg.pinv((effects[used] / unit[used, None]).T, rcond=SAME)
    function(trial, "trial", "It takes a Feedforward and returns a Response.")
    current, errors, gains = start, [], []
    for _ in range(whole(trials, "trials", maximum=MOST_DRAWS)):
        error = _run_errors(trial(current), channels)
        if error.size != effects.shape[1]:
            raise ModelError(
                f"the trial recorded {error.size // len(channels)} samples, the model's run has "
                f"{effects.shape[1] // len(channels)}: simulate both for duration={duration:g}."
            )
        errors.append(float(np.sqrt(np.mean(error[: error.size // len(channels)] ** 2))))
        gains.append(current.gains[0])
        change = np.zeros(unit.size)
        change[used] = -part * (pseudo @ error) / unit[used]
        new = current.gains.copy()
        new[0][:, orders] += change.reshape(len(start.axes), len(orders))
        current = current.replace(gains=new)
    best = int(np.argmin(errors))
    chosen = start.replace(gains=gains[best][None])
    return LearnedFeedforward(chosen, np.array(errors), np.array(gains))


def _gain_effects(
    start: Feedforward,
    loop: ClosedLoop,
    move: SetPointProfile,
    duration: float,
    orders: list[int],
    channels: list[str],
) -> FloatArray:
    """Return the effect of a unit of each gain on the errors (n_gain, n_channel * n_time)."""
    plant = loop.machine.replace(evaluation=None)
    forced = close_loop(plant, *loop.blocks, known_forces(plant), idle=loop.idle)
    time = np.arange(round(positive(duration, "duration") / loop.machine.dt)) * loop.machine.dt
    signals = move.at(time)
    rows = []
    for axis in range(len(start.axes)):
        for order in orders:
            # scaled to size one: a unit gain may cause forces that are far too large
            size = float(np.max(np.abs(signals[order]))) or 1.0
            force = np.outer(start.T[:, axis], signals[order] / size)
            given = {force_name(u): force[i] for i, u in enumerate(start.actuators)}
            run = simulate(forced, reference=given, duration=duration, noise=False)
            rows.append(size * _run_errors(run, channels))
    return np.array(rows)


def _run_errors(run: object, channels: list[str]) -> FloatArray:
    """Return the errors one after the other; the mean over runs where there are several."""
    if not isinstance(run, Response) or any(name not in run for name in channels):
        raise ModelError(
            f"a trial must return a Response with {', '.join(channels)}, got {short(run)}. Return "
            "simulate(loop, reference=move, duration=...)."
        )
    signals = [run[name] for name in channels]
    return np.concatenate([s.mean(axis=0) if s.ndim == 2 else s for s in signals])
