"""Where the searches of an update begin, and whether its poles are in rad/s."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError, ShapeError
from ..values import FloatArray, Rng, generator, real_array, whole
from .parameters.added import PointParameter
from .search import Objective, SearchEnd
from .sensitivities import checked_values
from .update_result import Starts

#: relative change of the model's eigenvalues that starts far away make at most, each parameter
#: alone, and how many decades they may be nearer
FAR, DECADES = 0.1, 1.5


def all_starts(objective: Objective, start: Any, starts: Any, rng: Rng) -> list[FloatArray]:
    """Return the start and the others: those given, or a Latin hypercube in bounds or priors."""
    first = objective.default_start
    if start is not None:
        first = checked_values(start, objective.parameters, "start")
        _check_inside(objective, first)
    if starts is None:
        return [first]
    if np.ndim(starts) == 0:
        return [first, *_drawn(objective, whole(starts, "starts") - 1, rng)]
    values = real_array(starts, "starts")
    if values.ndim != 2 or values.shape[1] != first.size or not values.shape[0]:
        raise ShapeError(f"starts must have shape (any, {first.size}), got {values.shape}.")
    for value in values:
        _check_inside(objective, value)
    return list(values)


def summary(begins: list[FloatArray], ends: list[SearchEnd | None]) -> Starts | None:
    """Return what several starts led to, None for one."""
    if len(begins) == 1:
        return None
    nan = np.full(begins[0].size, np.nan)
    return Starts(
        np.array(begins),
        np.array([nan if found is None else found.p for found in ends]),
        np.array([np.inf if found is None else found.cost for found in ends]),
    )


def scattered(objective: Objective, count: int, rng: Rng) -> list[FloatArray]:
    """Return starts around the default one, as far as each parameter moves eigenvalues by 10 %.

    Sizes are drawn evenly over decades; masses, springs and dampers are added, not taken away.
    """
    middle = objective.default_start
    eigen = objective.begin(middle).eigen
    every = list(range(eigen.poles.size))
    moved = np.abs(objective.family.sensitivity(eigen, every)) / np.abs(eigen.poles)[:, None]
    typical = np.median(moved, axis=0)
    scale = np.where(typical > 0, FAR / np.where(typical > 0, typical, 1.0), 0.0)
    scale = np.where(objective.has_prior, objective.prior_std, scale)
    chance = generator(rng)
    added = np.array([isinstance(q, PointParameter) for q in objective.parameters])
    found = []
    for _ in range(count):
        sign = np.where(added & ~objective.has_prior, 1.0, chance.choice([-1.0, 1.0], middle.size))
        step = sign * scale * 10 ** (-DECADES * chance.random(middle.size))
        found.append(np.clip(middle + step, objective.lower, objective.upper))
    return found


def _drawn(objective: Objective, count: int, rng: Rng) -> FloatArray:
    from scipy.stats import qmc

    low = np.where(objective.has_prior, objective.prior_mean - 2 * objective.prior_std, -np.inf)
    high = np.where(objective.has_prior, objective.prior_mean + 2 * objective.prior_std, np.inf)
    low, high = np.maximum(low, objective.lower), np.minimum(high, objective.upper)
    open_ = [
        p.name
        for p, width in zip(objective.parameters, high - low, strict=True)
        if not np.isfinite(width)
    ]
    if open_:
        raise ModelError(
            f"starts of {', '.join(open_)} cannot be drawn: give them bounds= or prior=, or "
            "give starts as values."
        )
    drawn = qmc.LatinHypercube(low.size, rng=generator(rng)).random(count)
    return np.asarray(low + (high - low) * drawn, dtype=np.float64)


def _check_inside(objective: Objective, start: FloatArray) -> None:
    for q, value, low, high in zip(
        objective.parameters, start, objective.lower, objective.upper, strict=True
    ):
        if not low <= value <= high:
            raise ModelError(
                f"start of {q.name} is {value:g}, outside its bounds ({low:g}, {high:g})."
            )


#: how near the ratio of measured poles to those of the model is to 2 pi, all of them
NEAR = 0.15


def check_units(objective: Objective, begin: FloatArray, start: Any = None) -> None:
    """Raise ModelError where all measured poles are 2 pi below or above those of the model."""
    data = objective.poles_measured
    if data is None:
        return
    if start is None:
        try:
            start = objective.poles(objective.begin(begin))
        except ModelError:
            return  # the search raises what is wrong at the start
    known = dict(zip(objective.numbers, np.abs(start), strict=True))
    ratio = np.abs(data.target) / np.array([known[n] for n in data.numbers])
    below = bool(np.all(np.abs(2 * np.pi * ratio - 1) < NEAR))
    above = bool(np.all(np.abs(ratio / (2 * np.pi) - 1) < NEAR))
    if below or above:
        advice = "multiply Hz by 2 pi" if below else "look at the units of the model too"
        raise ModelError(
            f"the measured poles are a factor of 2 pi {'below' if below else 'above'} those of the "
            f"model, all {ratio.size} of them ({np.median(np.abs(data.target)):.4g} against "
            f"{np.median(np.abs(start)):.4g} rad/s). MeasuredModes takes poles in rad/s: {advice}."
        )
