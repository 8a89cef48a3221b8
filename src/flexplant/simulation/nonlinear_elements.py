"""What is not linear in a loop: limits and rates of actuators, steps of sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..checks import FloatArray, Value, checked, instance, positive, real_array, short, whole
from ..errors import ModelError, require_known, unknown_label
from ..loop import ClosedLoop
from ..loop.blocks import with_known
from ..plant import StandardPlant
from ..tolerances import divisor


def _limit(value: Any, name: str) -> float:
    """Return a limit, which may be infinite."""
    return np.inf if isinstance(value, float) and value == np.inf else positive(value, name)


@dataclass(frozen=True, eq=False, repr=False)
class Saturation(Value):
    """Limits of a signal: ``|v| <= limit``, and ``|dv/dt| <= rate`` from sample to sample.

    Parameters
    ----------
    limit : float [unit of the channel]
        Largest magnitude; infinite when only the rate is limited.
    rate : float [unit/s], optional
        Largest change per time; the signal starts at 0. Not limited when not given.

    Raises
    ------
    ModelError
        When a limit is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop, weak = fx.close_loop(plant, observer, servo), {"u1": fx.simulation.Saturation(1e-3)}
    >>> run = fx.simulate(loop, reference=1e-6, duration=0.1, elements=weak, rng=1)
    >>> round(float(abs(run["u1:effort"]).max()), 6)
    0.001
    """

    limit: float = field(default=np.inf, metadata=checked(_limit))
    rate: float | None = field(default=None, metadata=checked(positive))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limit == np.inf and self.rate is None:
            raise ModelError("a Saturation without limits does nothing: give limit, rate or both.")

    def __repr__(self) -> str:
        rate = "" if self.rate is None else f", rate {self.rate:g}/s"
        return f"<Saturation: limit {self.limit:g}{rate}>"


@dataclass(frozen=True, eq=False, repr=False)
class Quantiser(Value):
    """A signal in whole steps: ``step round(v / step)``, of a converter or an encoder.

    Parameters
    ----------
    step : float [unit of the channel]
        The least significant bit.

    Raises
    ------
    ModelError
        When it is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop, steps = fx.close_loop(plant, observer, servo), {"y1": fx.simulation.Quantiser(1e-9)}
    >>> counts = fx.simulate(loop, duration=0.1, elements=steps, rng=1)["y1"] / 1e-9
    >>> bool(abs(counts - counts.round()).max() < 1e-6)
    True
    """

    step: float = field(metadata=checked(positive))


#: what may act on a channel: one, or a quantiser and a saturation together
Element: TypeAlias = "Saturation | Quantiser | Sequence[Saturation | Quantiser]"


class Acting:
    """The elements on some channels, sample after sample and in place.

    Values are quantised first, then limited in rate and magnitude: a converter before its
    amplifier.
    """

    def __init__(self, names: Sequence[str], elements: Mapping[str, Element], dt: float) -> None:
        self.limit, self.change = np.full(len(names), np.inf), np.full(len(names), np.inf)
        step = np.zeros(len(names))
        for name, element in elements.items():
            i = names.index(name)
            for one in _listed(name, element):
                if isinstance(one, Quantiser):
                    step[i] = one.step
                else:
                    self.limit[i] = one.limit
                    self.change[i] = np.inf if one.rate is None else one.rate * dt
        self.step, self.coarse = divisor(step), step > 0
        self.below = -self.limit
        self.counts, self.limits = bool(np.any(self.coarse)), bool(np.any(np.isfinite(self.limit)))
        self.is_slow = bool(np.any(np.isfinite(self.change)))
        self.begin(1)

    def begin(self, runs: int) -> None:
        """Start at 0, so many runs side by side."""
        self.last, self.low, self.high = np.zeros((3, runs, self.step.size))

    def apply(self, values: FloatArray) -> None:
        """Let the elements act on the values (runs, n) of a sample, in place."""
        low, high = self.low, self.high
        if self.counts:
            np.divide(values, self.step, out=low)
            np.rint(low, out=low)
            np.multiply(low, self.step, out=low)
            np.copyto(values, low, where=self.coarse)
        if self.is_slow:
            np.subtract(self.last, self.change, out=low)
            np.maximum(values, low, out=values)
            np.add(self.last, self.change, out=high)
            np.minimum(values, high, out=values)
        if self.limits:
            np.maximum(values, self.below, out=values)
            np.minimum(values, self.limit, out=values)
        if self.is_slow:
            np.copyto(self.last, values)


def split_elements(
    elements: Any, sensors: Sequence[str], driven: Sequence[str]
) -> tuple[dict[str, Element], dict[str, Element]]:
    """Return the elements on sensors and on actuators, by channel."""
    if elements is None:
        return {}, {}
    instance(
        elements, Mapping, "elements", "Name the channel: {'u1': simulation.Saturation(10.0)}."
    )
    for name, element in elements.items():
        if name not in sensors and name not in driven:
            raise unknown_label("channel for an element", name, [*sensors, *driven])
        _listed(name, element)
    on_y = {name: element for name, element in elements.items() if name in sensors}
    return on_y, {name: element for name, element in elements.items() if name not in on_y}


def _listed(name: str, element: Any) -> list[Saturation | Quantiser]:
    listed = list(element) if isinstance(element, list | tuple) else [element]
    kinds = [type(one) for one in listed]
    if not listed or not all(isinstance(one, Saturation | Quantiser) for one in listed):
        raise ModelError(
            f"the element on {name!r} must be a Saturation or a Quantiser, got {short(element)}. "
            "Pass one, or a list of both."
        )
    if len(set(kinds)) < len(kinds):
        raise ModelError(f"{name!r} has two elements of one kind: give the tighter one.")
    return listed


class Conditions(NamedTuple):
    """What makes a run differ from that of the linear loop at its own samples.

    `paths` are the places (n_time, 3) of POIs; the controller acts in every `finer`-th sample.
    """

    on_y: Mapping[str, Element] = {}
    on_u: Mapping[str, Element] = {}
    recovery: float | None = None
    finer: int = 1
    paths: Mapping[str, FloatArray] = {}

    @property
    def one_by_one(self) -> bool:
        """Whether there is something that is not linear."""
        return bool(self.on_y or self.on_u)


def conditions(
    loop: ClosedLoop, elements: Any, anti_windup: Any, finer: Any, moving: Any, time: FloatArray
) -> Conditions:
    """Return what was given to `simulate`, checked."""
    on_y, on_u = split_elements(elements, loop.plant.y, loop.driven)
    recovery = None if anti_windup is None else positive(anti_windup, "anti_windup")
    return Conditions(on_y, on_u, recovery, finer, _paths(loop.plant, moving, time))


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
