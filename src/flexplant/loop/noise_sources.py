"""The white noises of a plant, each by itself, and where they enter a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import AssumptionError, LabelError, ModelError
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray, IntArray, instance

#: relative: the noise factors of single disturbances add up to the one that the plant has
_ADDS_UP = 1e-6


class WhiteNoise(NamedTuple):
    """How white samples enter: `factor` (n, r) into x, `deviation` at the `columns` of w."""

    factor: FloatArray
    columns: IntArray
    deviation: FloatArray


class Source(NamedTuple):
    """One white noise of unit intensity (continuous) or unit variance (sampled) in a closed loop.

    ``x+ = A x + G n``, ``output = C x + D n`` with G (n, r) and D (n_output, r).
    """

    name: str
    G: FloatArray
    D: FloatArray


def white_names(plant: StandardPlant) -> tuple[list[str], list[str]]:
    """Return the channels of w that are white noise: disturbances, then noises per sample.

    The latter are those of sensors, and disturbances that are held over each sample.
    """
    loud = [name for name, level in plant.asd.items() if level > 0]
    held = plant.held if plant.dt else ()
    sensors = [name for name in loud if name.removesuffix(":noise") in plant.y or name in held]
    white = [name for name in loud if name not in sensors]
    direct = plant.system.select(inputs=white).D
    if np.any(direct):
        i, j = np.argwhere(direct)[0]
        raise AssumptionError(
            f"white noise {white[j]!r} reaches {plant.system.outputs[i]!r} directly: a sample of "
            "it would have infinite variance. Give the disturbance a coloured spectrum, let it "
            "be held over each sample (held=True), or sense a displacement or velocity."
        )
    return white, sensors


def white_noise(plant: StandardPlant) -> WhiteNoise:
    """Return the noises of a sampled plant, all disturbances together.

    The disturbances' covariance over a sample is exact, so what they excite above half the rate
    is in the samples; a sensor's noise has the variance ``asd^2 rate / 2`` of a sample.
    """
    white, sensors = white_names(plant)
    factor = continuous_factor(plant) if white else np.zeros((plant.system.n_states, 0))
    columns = np.array([plant.w.index(name) for name in sensors], dtype=np.int64)
    asd = np.array([plant.asd[name] for name in sensors])
    return WhiteNoise(factor, columns, asd * np.sqrt(0.5 / plant.dt))


def continuous_factor(plant: StandardPlant) -> FloatArray:
    """Return the noise factor of the disturbances that are not held over each sample."""
    total = plant.noise_factor
    return total[:, : total.shape[1] - len(plant.held)]


def sources(plant: StandardPlant, monitored: StateSpace) -> list[Source]:
    """Return the white noises of a plant as they enter its closed loop, each by itself."""
    white, sensors = white_names(plant)
    found = []
    for name, factor in _factors(plant, white).items() if plant.dt else ():
        G = np.zeros((monitored.n_states, factor.shape[1]))
        G[: factor.shape[0]] = factor
        found.append(Source(name, G, np.zeros((len(monitored.outputs), G.shape[1]))))
    root = np.sqrt(0.5 / (plant.dt or 1.0))
    for name in sensors if plant.dt else (*white, *sensors):
        column = [monitored.inputs.index(name)]
        size = plant.asd[name] * root
        found.append(Source(name, monitored.B[:, column] * size, monitored.D[:, column] * size))
    return found


def _factors(plant: StandardPlant, white: list[str]) -> dict[str, FloatArray]:
    """Return G of each white disturbance; of all together where they cannot be separated."""
    if not white:
        return {}
    total = continuous_factor(plant)
    if len(white) == 1:
        return {white[0]: total}
    if plant.is_assembled:
        found = {}
        for name in white:  # the plant sampled with one of them
            asd = {n: level for n, level in plant.asd.items() if n == name or n in plant.held}
            alone = plant.unweighted.continuous.replace(asd=asd)
            found[name] = continuous_factor(alone.discretized(1.0 / plant.dt, delay=plant.delay))
        # a plant whose noise was changed since it was assembled keeps its own
        if all(factor.shape[0] == total.shape[0] for factor in found.values()):
            own = np.sum(total**2, axis=1)
            added = np.sum([np.sum(factor**2, axis=1) for factor in found.values()], axis=0)
            if np.allclose(added, own, rtol=_ADDS_UP, atol=0.0):
                return found
    return {" + ".join(white): total}


def stationary_row(
    plant: StandardPlant, monitored: StateSpace, problem: object, channel: str
) -> int:
    """Return the row of an output of a closed loop that has a stationary state."""
    if plant.is_weighted:
        raise AssumptionError(
            "the plant is weighted, so its z and w are not physical signals: close the loop "
            "around plant.unweighted with the same blocks."
        )
    given: object = channel
    instance(given, str, "a channel", "Pass its name: 'die:error'.", LabelError)
    row = int(monitored.output_index([channel])[0])
    check_stationary(problem, f"the rms of {channel!r}")
    return row


def check_stationary(problem: object, what: str) -> None:
    """Raise AssumptionError when a closed loop has no stationary state."""
    if problem is not None:
        raise AssumptionError(
            f"{what} needs a stable closed loop, this one is {getattr(problem, 'reason', problem)}:"
            " its noise grows without bound. Stabilise it first: see loop.is_stable."
        )


def check_direct(noises: Sequence[Source], row: int, channel: str) -> None:
    """Raise ModelError where continuous white noise passes to an output without rolling off."""
    for one in noises:
        if np.any(one.D[row]):
            raise ModelError(
                f"white noise {one.name!r} passes straight through to {channel!r}, so its variance "
                "in continuous time is infinite. Close the loop around plant.discretized(rate), or "
                "let the controller roll off."
            )
