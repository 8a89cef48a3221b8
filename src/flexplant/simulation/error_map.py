"""The error at many points of a wafer through one run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import LabelError, counted
from ..loop import ClosedLoop, close_loop
from ..plant import Poi
from ..values import FloatArray, Value, instance, real_array
from .exposure import exposure_errors
from .simulate import Signal, simulate


@dataclass(frozen=True, eq=False, repr=False)
class ErrorMap(Value):
    """MA and MSD of the error at points of a structure; `fx.plot.error_map` draws it.

    Parameters
    ----------
    axis, unit : str
        Direction of the error, and its SI unit.
    points : (p, 3) array [m]
        The places.
    ma, msd : (p,) arrays [unit]
        Largest |MA| and MSD at each point.
    window : float [s]
        Of both.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> found = fx.simulation.error_map(loop, [[1.0, 0.0, 0.0]], duration=0.1, axis="x", rng=1)
    >>> found.axis, found.unit
    ('x', 'm')
    """

    axis: str
    unit: str
    points: FloatArray
    ma: FloatArray
    msd: FloatArray
    window: float

    def __repr__(self) -> str:
        window = f"windows of {1e3 * self.window:g} ms"
        lines = [f"<ErrorMap {counted(len(self.points), 'point')} along {self.axis}, {window}>"]
        for name, values in (("MA", self.ma), ("MSD", self.msd)):
            worst = int(np.argmax(values))
            place = ", ".join(f"{c:g}" for c in self.points[worst])
            lines.append(
                f"  {name} {values.min():.4g} to {values[worst]:.4g} {self.unit}, largest at "
                f"({place})"
            )
        return "\n".join(lines)


def error_map(
    loop: ClosedLoop,
    points: npt.ArrayLike,
    *,
    duration: float,
    reference: Signal | None = None,
    axis: str = "z",
    window: float | None = 5e-3,
    start: float = 0.0,
    exposures: npt.ArrayLike | None = None,
    noise: bool = True,
    rng: Any = None,
) -> ErrorMap:
    """Return the error at many points of a structure through one run of a closed loop.

    Each point becomes a POI of its own; the reference of the loop's POI holds for all of them, as
    for a wafer that moves as a whole.

    Parameters
    ----------
    loop : ClosedLoop
        Around a sampled plant that was assembled from a structure.
    points : (p, 3) array [m]
        The places.
    duration : float [s]
        Of the run.
    reference : signal, optional
        As for `simulate`; along `axis`. Rest when not given.
    axis : str
        x, y, z, rx, ry or rz: the direction of the error.
    window, start, exposures
        As for `exposure_errors`.
    noise : bool
        Whether the white noises act.
    rng : int, SeedSequence, Generator or None
        Seed of the noises.

    Returns
    -------
    ErrorMap

    Raises
    ------
    LabelError
        When a point is not on the structure, or a reference is given to a loop without one.
    ModelError
        When the plant was not assembled from a structure, or as for `simulate` and
        `exposure_errors`.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    >>> fx.simulation.error_map(loop, points, duration=0.1, axis="x", rng=1).ma.shape
    (2,)
    """
    given: object = loop
    instance(given, ClosedLoop, "loop", "Use close_loop(plant, ...).")
    places = real_array(points, "points", (None, 3))
    ports = loop.plant.assembled.ports
    names = [f"map|{i}" for i in range(1, len(places) + 1)]
    pois = [Poi(name, at=tuple(p), axes=(axis,)) for name, p in zip(names, places, strict=True)]
    wide = loop.plant.with_ports(ports.replace(z=[*ports.z, *pois]))
    run = simulate(
        close_loop(wide, *loop.blocks, idle=loop.idle),
        duration=duration,
        reference=reference,
        noise=noise,
        rng=rng,
    )
    target: FloatArray = np.zeros(run.time.size)
    if reference is not None:
        refs = [name for name in wide.w if name in wide.y]
        if len(refs) != 1:
            raise LabelError(
                f"the loop has {len(refs)} references {refs}, a map is of one: add "
                "Ports(references=[Reference(poi)]), or leave the reference out."
            )
        target = run[refs[0]]
    shown = [pois[i].channel(axis) for i in range(len(pois))]
    data = target - np.array([run[name] for name in shown])
    errors = run.replace(data=data, names=shown, units={})
    found = exposure_errors(errors, shown, window=window, start=start, exposures=exposures)
    unit = wide.units.get(shown[0], "")
    return ErrorMap(axis, unit, places, found.values[:, 0], found.values[:, 2], found.window)
