"""Forces of a run: requirements of a move compared with ranges, and opposing actuators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..errors import AssumptionError, some_names, warn
from ..loop import ClosedLoop
from ..plant import StandardPlant, driven_axes
from ..plant.axes import complex_gain, idle_forces, opposing_part, resting_frequency
from ..plant.inverse import at_rest, followed_at_rest, solved
from ..tolerances import NEGLIGIBLE
from ..words import several
from .motion import SetPointProfile
from .nonlinear_elements import Saturation
from .response import Response

#: number of derivatives of a move whose forces count: position (springs), velocity, acceleration
_TERMS = 3


def warn_beyond_ranges(
    plant: StandardPlant, signals: Mapping[str, Any], elements: Mapping[str, Any], time: FloatArray
) -> None:
    """Warn of a `Saturation` that moves of references exceed, with the required values.

    Values and rates of forces and readings are those of the plant near rest that follows the moves
    exactly, without the forces that react to disturbances. References without a set-point profile
    count as at rest.
    """
    limits = {name: one for name, given in elements.items() if (one := _limit(given)) is not None}
    moves = {name: move for name, move in signals.items() if isinstance(move, SetPointProfile)}
    if not limits or not moves or not plant.ports.followed:
        return
    for name, needed in _needed(plant, moves, list(limits), time).items():
        limit, unit, driven = limits[name], plant.units.get(name, ""), name in plant.u
        least = -limit.limit if limit.least is None else limit.least
        low, high = float(needed.min(initial=0.0)), float(needed.max(initial=0.0))
        who = f"the move of {', '.join(moves)} needs"
        if low < least * (1.0 + NEGLIGIBLE) or high > limit.limit * (1.0 + NEGLIGIBLE):
            advice = (
                "Lower the acceleration of the move (its stroke, where springs are pushed), or "
                "choose a stronger actuator"
                if driven
                else "Shorten the move, or choose a longer range"
            )
            warn(
                f"{who} {low:.4g} to {high:.4g} {unit} of {name!r}, whose range is {least:.4g} to "
                f"{limit.limit:.4g} {unit}. {advice}."
            )
        fastest = float(np.max(np.abs(np.diff(needed) / np.diff(time)), initial=0.0))
        if limit.rate is not None and fastest > limit.rate * (1.0 + NEGLIGIBLE):
            advice = (
                "Lower the jerk of the move (its velocity, where springs are pushed), or choose a "
                "faster amplifier"
                if driven
                else "Lower the velocity of the move"
            )
            warn(
                f"{who} {name!r} to change by {fastest:.4g} {unit}/s, and its rate is "
                f"{limit.rate:.4g} {unit}/s. {advice}."
            )


def _limit(given: Any) -> Saturation | None:
    """Return the Saturation among the elements of a channel."""
    listed = given if several(given) else [given]
    return next((one for one in listed if isinstance(one, Saturation)), None)


def _needed(
    plant: StandardPlant, moves: Mapping[str, SetPointProfile], names: list[str], time: FloatArray
) -> dict[str, FloatArray]:
    """Return actuator forces and sensor readings over time, by name, during moves."""
    found = {name: moves[name].at(time).position for name in names if name in moves}
    try:
        driven = driven_axes(plant, freq=resting_frequency(plant))
    except AssumptionError:  # the plant has no inverse, which the design reports
        return found
    followed = {
        p.derived(axis, "ref"): p.channel(axis) for p, axis in plant.assembled.ports.followed
    }
    if any(followed.get(name) not in driven.channels for name in moves):
        return found
    signals = np.zeros((len(driven.channels), _TERMS, time.size))
    for name, move in moves.items():
        signals[driven.channels.index(followed[name])] += np.array(move.at(time))[:_TERMS]
    g, T, axes, dt = plant.system, driven.T, driven.channels, plant.dt
    forced = [name for name in names if name in plant.u]
    if forced:

        def inverse(s: complex) -> ComplexArray:
            G = complex_gain(g, s, axes, plant.u) @ T
            return np.asarray(T @ solved(G, np.eye(len(axes), dtype=np.complex128), axes))

        gains = at_rest(inverse, dt, axes, _TERMS)
        forces = np.einsum("uam,amt->ut", gains, signals)
        found |= {name: forces[plant.u.index(name)] for name in forced}
    seen = [name for name in names if name in plant.y and name not in moves]
    if seen:
        places = followed_at_rest(g, T, plant.u, axes, seen, dt)[..., 0]
        found |= dict(zip(seen, places @ signals[:, 0], strict=True))
    return found


#: fraction of a run at its end for the mean of forces, and its least number of samples
_END, _FEWEST = 0.1, 20


#: steady force, relative to the largest force of any actuator in the run, above which a warning is
#: given
_SHARE = 0.05


#: multiple of the standard deviation at the end above which a mean counts as steady
_STEADY = 3.0


def warn_of_opposing_forces(loop: ClosedLoop, run: Response) -> None:
    """Warn of steady forces at the end of a run that move none of the axes of the POIs."""
    # these forces only heat the actuators and bend the structure between them
    count = max(_FEWEST, round(_END * run.time.size))
    if not loop.machine.ports.z or len(loop.driven) < 2 or run.time.size <= count:
        return
    efforts = np.stack([np.atleast_2d(run[name]) for name in loop.driven])  # (m, runs, n_time)
    most = np.abs(efforts).max(axis=(0, 2))
    end = efforts[..., -count:]
    mean = end.mean(axis=2)
    if not np.any(np.abs(mean) > _SHARE * most):
        return
    idle = idle_forces(loop.machine, loop.driven)
    mean = np.stack([opposing_part(idle, one) for one in mean.T], axis=1)
    # the deviation of idle forces alone: those that move the machine may vary more
    about = np.tensordot(idle @ np.linalg.pinv(idle), end, axes=1)
    steady = np.abs(mean) > np.maximum(_SHARE * most, _STEADY * about.std(axis=2))
    opposed = np.sum(steady, axis=0) > 1  # a single actuator cannot oppose itself
    if np.any(opposed):
        worst = int(np.argmax(np.where(opposed, np.abs(mean).max(axis=0), -np.inf)))
        warn(_said(loop, mean[:, worst], steady[:, worst], float(most[worst])))


def _said(loop: ClosedLoop, mean: FloatArray, steady: FloatArray, most: float) -> str:
    """Return the warning of steady forces (m,), with the largest force of the run."""
    units = loop.units
    names = [
        f"{name} with {mean[i]:.3g} {units.get(name, '')}".rstrip()
        for i, name in enumerate(loop.driven)
        if steady[i]
    ]
    return (
        f"at the end of the run actuators steadily push against each other: {some_names(names)}. "
        f"These forces move none of the POIs' axes; the largest force of the run is {most:.3g}. "
        "Command the actuators together (design_servo, fx.plant.driven_axes), correct the offsets "
        "and scales of their sensors, or give the difference of the forces a weight."
    )
