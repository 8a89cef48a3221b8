"""Conditions of a run: nonlinear elements, paths of POIs, samples finer than the controller's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..checks import FloatArray, instance, positive, real_array, whole
from ..errors import ModelError, require_known
from ..loop import ClosedLoop
from ..loop.blocks import with_known
from ..plant import StandardPlant
from .nonlinear_elements import split_elements


class Conditions(NamedTuple):
    """What makes a run differ from that of the linear loop at its own samples.

    `paths` are the places (n_time, 3) of POIs; the controller acts in every `finer`-th sample.
    """

    on_y: Mapping[str, Any] = {}
    on_u: Mapping[str, Any] = {}
    on_w: Mapping[str, Any] = {}
    recovery: float | None = None
    finer: int = 1
    paths: Mapping[str, FloatArray] = {}

    @property
    def one_by_one(self) -> bool:
        """Whether there is something that is not linear."""
        return bool(self.on_y or self.on_u or self.on_w)


def conditions(
    loop: ClosedLoop, elements: Any, anti_windup: Any, finer: Any, moving: Any, time: FloatArray
) -> Conditions:
    """Return what was given to `simulate`, checked."""
    on_y, on_u, on_w = split_elements(elements, loop.plant, loop.driven)
    recovery = None if anti_windup is None else positive(anti_windup, "anti_windup")
    return Conditions(on_y, on_u, on_w, recovery, finer, _paths(loop.plant, moving, time))


def finer_loop(loop: ClosedLoop, finer: int) -> ClosedLoop:
    """Return a loop whose plant is sampled so many times in a sample of its controller.

    The same plant before sampling, with the same delay in seconds.
    """
    if whole(finer, "finer", maximum=10_000) == 1:
        return loop
    plant = loop.plant
    if plant.continuous.dt:
        raise ModelError(
            "finer= needs the plant before it was sampled, which is not known of a plant made "
            "elsewhere. Make it by assemble_plant(model, ports).discretized(rate), or simulate at "
            "its own samples."
        )
    fine = plant.continuous.discretized(finer / plant.dt, delay=finer * plant.delay)
    fine = with_known(fine, loop.blocks)
    if (fine.w, fine.u, fine.z, fine.y) != (plant.w, plant.u, plant.z, plant.y):
        raise ModelError(
            "the channels of the plant were changed after it was sampled, so that its motion "
            "between samples is not known. Change the ports before plant.discretized(rate)."
        )
    fine = fine.replace(asd={name: level for name, level in plant.asd.items() if name in fine.w})
    return ClosedLoop(fine, loop.blocks, loop.controller, loop.idle)


def _paths(plant: StandardPlant, moving: Any, time: FloatArray) -> dict[str, FloatArray]:
    if moving is None:
        return {}
    instance(moving, Mapping, "moving", "Name the POI: {'die': (n_time, 3) points}.")
    pois = [poi.name for poi in plant.assembled.ports.z]
    found = {}
    for name, path in moving.items():
        require_known("POI to move", [name], pois)
        points: Callable[[FloatArray], Any] | Any = path(time) if callable(path) else path
        found[name] = real_array(points, f"the path of {name!r}", (time.size, 3))
        ends = [*found[name].argmin(axis=0), *found[name].argmax(axis=0)]
        plant.along(name, found[name][ends])  # refuses places off the structure
    return found


class Rows(NamedTuple):
    """Channels of z whose rows C (k, c, n) and D (k, c, m) over x and [w; u] differ by sample."""

    shown: list[int]
    C: FloatArray
    D: FloatArray

    def show(self, z: FloatArray, x: FloatArray, inputs: FloatArray) -> None:
        """Put these channels into z (k, nz), for states x (k, n) and [w; u] (k, m)."""
        z[:, self.shown] = np.einsum("kcn,kn->kc", self.C, x)
        z[:, self.shown] += np.einsum("kcm,km->kc", self.D, inputs)


class Moving:
    """The rows of z that change with the places of POIs."""

    def __init__(self, plant: StandardPlant, paths: Mapping[str, FloatArray]) -> None:
        self.plant, self.paths = plant, paths

    def rows(self, first: int, count: int) -> list[Rows]:
        """Return the rows of the samples from `first`; a place that comes again is found once."""
        found = []
        for name, points in self.paths.items():
            places, at = np.unique(points[first : first + count], axis=0, return_inverse=True)
            along, again = self.plant.along(name, places), at.ravel()
            shown = [self.plant.z.index(channel) for channel in along.channels]
            found.append(Rows(shown, along.C[again], along.D[again]))
        return found
