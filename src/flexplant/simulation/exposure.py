"""Errors over exposures: MA and MSD by POI and axis, and settling times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, instance, name_list, positive, real_array
from ..errors import LabelError, ModelError, ShapeError, aligned, counted, require_known
from ..loop import ClosedLoop, close_loop
from ..plant import Poi, Ports
from ..store import Value
from .response import (
    Numbers,
    Response,
    as_numbers,
    first_sample,
    moving_moments,
    signal_unit,
    window_samples,
)
from .sampled_runs import Signal, simulate

#: fraction of the windows in the third column of the table: three standard deviations of a Gaussian
SHARE = 0.997
#: axes of a POI
_AXES = ("x", "y", "z", "rx", "ry", "rz")


class ExposureFigures(NamedTuple):
    """Errors of one channel over all exposures and runs, in its unit."""

    ma: float
    ma_most: float
    msd: float
    msd_most: float


@dataclass(frozen=True, eq=False, repr=False)
class ExposureErrors(Value):
    """Moving average (MA) and moving standard deviation (MSD) of errors; prints as a table.

    This is the result of `exposure_errors`.

    Parameters
    ----------
    channels : sequence of str
        Names of the errors.
    units : sequence of str
        SI units of the errors.
    values : (n, 4) array
        Four columns. The first two are the largest |MA| and the |MA| that 99.7 % of the windows do
        not exceed. The last two are the same for the MSD.
    window : float [s]
        Length of the moving window.
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    window: float

    def __getitem__(self, channel: str) -> ExposureFigures:
        require_known("channel", [channel], self.channels)
        return ExposureFigures(*self.values[self.channels.index(channel)].tolist())

    def __repr__(self) -> str:
        head = ("", "MA max", f"MA {SHARE:.1%}", "MSD max", f"MSD {SHARE:.1%}", "")
        rows = []
        for name, unit, row in zip(self.channels, self.units, self.values, strict=True):
            factor, shown = (1e9, f"n{unit}") if unit in ("m", "rad") else (1.0, unit)
            rows.append((name, *(f"{factor * value:.4g}" for value in row), shown))
        table = aligned(head, rows)
        return "\n".join([f"errors over windows of {1e3 * self.window:g} ms", *table])


def exposure_errors(
    run: Response,
    channels: Any = None,
    *,
    window: float | None = 5e-3,
    start: float = 0.0,
    exposures: npt.ArrayLike | None = None,
) -> ExposureErrors:
    """Return MA and MSD of errors over the exposures of a run, by POI and axis.

    The moving average (MA) is the mean of the error over a window; in lithography it is the overlay
    error. The moving standard deviation (MSD) is the standard deviation in the window about this
    mean; it is the fading of the image. Each window lies completely within an exposure. It slides
    over the exposure sample by sample, as the slit slides over a die.

    Parameters
    ----------
    run : Response
        Result of `simulate`; all its runs are evaluated.
    channels : sequence of str, optional
        Names of the errors. By default these are the errors of all POIs (points of interest), and
        the motions of those of their axes that have no reference.
    window : float [s]
        Length of the window, which is the exposure time of one point. With None, each exposure is
        one window.
    start : float [s]
        Beginning of the exposure if `exposures` is not given. It lasts to the end of the run.
    exposures : (k, 2) array [s], optional
        Beginning and end of each exposure, such as `SetPointProfile.exposures`.

    Returns
    -------
    ExposureErrors

    Raises
    ------
    ModelError
        When `run` is not a Response, has no error, or an exposure is not within it or is shorter
        than the window.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> run = fx.Response(np.arange(1000) * 1e-3, np.full((1, 1000), 2e-9), ["die:error"])
    >>> found = fx.simulation.exposure_errors(run, "die:error", window=0.01)
    >>> round(float(found["die:error"].ma) * 1e9, 6)
    2.0
    """
    instance(run, Response, "run", "Pass what simulate returned.")
    names = error_channels(run) if channels is None else name_list(channels, "channels")
    if not names:
        raise ModelError("the run has no error of a POI: name the channels, channels=['y1'].")
    parts = _exposure_slices(run, start, exposures)
    shortest = min(part.stop - part.start for part in parts)
    count = shortest
    if window is not None:
        count = window_samples(window, run.dt, shortest, "the shortest exposure")
    values = np.zeros((len(names), 4))
    for i, name in enumerate(names):
        both = [_window_moments(run[name][..., part], count, window is None) for part in parts]
        for j in (0, 1):
            sizes = np.abs(np.concatenate([pair[j].ravel() for pair in both]))
            values[i, 2 * j : 2 * j + 2] = sizes.max(), np.quantile(sizes, SHARE)
    units = [run.units.get(name, "") for name in names]
    return ExposureErrors(tuple(names), tuple(units), values, count * run.dt)


def settling_time(
    run: Response,
    channel: str,
    *,
    ma: float,
    msd: float | None = None,
    window: float = 5e-3,
    after: float = 0.0,
) -> Numbers:
    """Return the time after which an error stays within its specification.

    Parameters
    ----------
    run : Response
        Result of `simulate`.
    channel : str
        Name of the error.
    ma, msd : float
        Allowed |MA| and MSD (moving average and moving standard deviation, see `exposure_errors`),
        in the unit of the channel.
    window : float [s]
        Length of the window.
    after : float [s]
        Time from which the settling time is counted, such as the end of a move.

    Returns
    -------
    float, or (n_runs,) array [s]
        Time from `after` to the beginning of the first window from which on all windows are within
        the limits. It is infinite if the last window is not.

    Raises
    ------
    ModelError
        When a limit is not positive, no sample remains after `after`, or the window is too long.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> time = np.arange(1000) * 1e-3
    >>> run = fx.Response(time, 1e-6 * np.exp(-time / 0.05)[None], ["die:error"])
    >>> round(float(fx.simulation.settling_time(run, "die:error", ma=1e-8, window=0.01)), 2)
    0.23
    """
    instance(run, Response, "run", "Pass what simulate returned.")
    limit = positive(ma, "ma"), np.inf if msd is None else positive(msd, "msd")
    part = _exposure_slices(run, after, None, "after")[0]
    most = part.stop - part.start
    count = window_samples(window, run.dt, most, f"the run after {after:g} s")
    average, deviation = _window_moments(run[channel][..., part], count, False)
    outside = (np.abs(average) > limit[0]) | (deviation > limit[1])
    late = outside.shape[-1] - np.argmax(outside[..., ::-1], axis=-1)
    steps = np.where(np.any(outside, axis=-1), late, 0).astype(np.float64)
    steps[steps == outside.shape[-1]] = np.inf
    return as_numbers(steps * run.dt)


def error_channels(run: Response) -> tuple[str, ...]:
    """Return the errors of all POIs in a run, and their axes that have no reference."""
    found: list[str] = []
    errors = {name.removesuffix(":error") for name in run if name.endswith(":error")}
    for name in run:
        poi, _, axis = name.rpartition(":")
        if axis == "error":
            found.append(name)
        elif axis in _AXES and poi:
            # `die:error` is of the first axis of a POI, `die:rx:error` of another
            if poi in errors:
                errors.remove(poi)
            elif name not in errors:
                found.append(name)
    return tuple(sorted(found, key=_poi_of))


def _poi_of(channel: str) -> str:
    """Return the POI of a channel: `die` of die:x, die:error and die:rx:error."""
    place, _, axis = channel.removesuffix(":error").rpartition(":")
    return place if axis in _AXES and place else channel.removesuffix(":error")


def _exposure_slices(run: Response, start: Any, exposures: Any, name: str = "start") -> list[slice]:
    """Return the samples of each exposure; messages call the start `name`."""
    if run.time.size < 2:
        raise ModelError(
            "the run has a single sample, which is too short for a window. Run it longer."
        )
    if exposures is None:
        return [slice(first_sample(run, start, name), run.time.size)]
    windows = real_array(exposures, "exposures")
    if windows.ndim != 2 or windows.shape[1] != 2 or not windows.size:
        raise ShapeError(
            f"exposures must have shape (k, 2), begin and end of each, got {windows.shape}. Pass "
            "those of a set-point: move.exposures."
        )
    edges = np.round((windows - run.time[0]) / run.dt).astype(int)
    for (begin, end), given in zip(edges, windows, strict=True):
        if begin < 0 or end > run.time.size or end <= begin:
            raise ModelError(
                f"the exposure from {given[0]:g} to {given[1]:g} s is not within the run of "
                f"{run.time[-1] + run.dt:g} s. Simulate for longer."
            )
    return [slice(int(begin), int(end)) for begin, end in edges]


def _window_moments(signal: FloatArray, count: int, whole: bool) -> tuple[FloatArray, FloatArray]:
    """Return MA and MSD of all windows of `count` samples that lie within a stretch."""
    unit = signal_unit(signal)
    # an offset would reduce the accuracy of the deviation, and is removed first
    offset = np.mean(signal / unit, axis=-1, keepdims=True)
    rest = signal / unit - offset
    if whole:
        deviation = np.sqrt(np.mean(rest**2, axis=-1, keepdims=True))
        return unit * offset, unit * deviation
    average, deviation = moving_moments(rest, count)
    first = count // 2
    inner = slice(first, first + signal.shape[-1] - count + 1)
    return unit * (average[..., inner] + offset), unit * deviation[..., inner]


@dataclass(frozen=True, eq=False, repr=False)
class ErrorMap(Value):
    """Moving average (MA) and standard deviation (MSD) of the error at points of a structure.

    This is the result of the function `error_map`. `fx.plot.error_map` draws it.

    Parameters
    ----------
    axis, unit : str
        Direction of the error, and its SI unit.
    points : (p, 3) array [m]
        Coordinates of the points.
    ma, msd : (p,) arrays [unit]
        Largest magnitude of the MA, and largest MSD, at each point.
    window : float [s]
        Length of the window.
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
    """Return the error at many points of a structure during one run of a closed loop.

    Each point becomes a separate POI (point of interest). The reference of the loop's POI applies
    to all points, as for a wafer that moves as a rigid body.

    Parameters
    ----------
    loop : ClosedLoop
        Loop around a sampled plant that was assembled from a structure.
    points : (p, 3) array [m]
        Coordinates of the points.
    duration, noise, rng : as for `simulate`
    reference : signal, optional
        Reference along `axis`, as for `simulate`; by default the machine stays at rest.
    axis : str
        Direction of the error: x, y, z, rx, ry or rz.
    window, start, exposures : as for `exposure_errors`

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
    instance(loop, ClosedLoop, "loop", "Use close_loop(plant, ...).")
    places = real_array(points, "points", (None, 3))
    ports = loop.machine.assembled.ports
    names = [f"map|{i}" for i in range(1, len(places) + 1)]
    pois = [Poi(name, at=tuple(p), axes=(axis,)) for name, p in zip(names, places, strict=True)]
    wide = loop.machine.with_ports(ports.replace(z=[*ports.z, *pois]))
    given = {} if reference is None else {_map_reference(ports, axis): reference}
    closed = close_loop(wide.replace(evaluation=None), *loop.blocks, idle=loop.idle)
    run = simulate(closed, duration=duration, reference=given, noise=noise, rng=rng)
    target = [run[followed] for followed in given] or [np.zeros(run.time.size)]
    shown = [poi.channel(axis) for poi in pois]
    data = target[0] - np.array([run[name] for name in shown])
    errors = run.replace(data=data, names=shown, units={})
    found = exposure_errors(errors, shown, window=window, start=start, exposures=exposures)
    unit = wide.units.get(shown[0], "")
    return ErrorMap(axis, unit, places, found.values[:, 0], found.values[:, 2], found.window)


def _map_reference(ports: Ports, axis: str) -> str:
    """Return the reference that a map along an axis follows: the only one, or that of the axis."""
    found = ports.followed
    if len(found) > 1:
        found = tuple(pair for pair in found if pair[1] == axis)
    if len(found) != 1:
        refs = [poi.derived(own, "ref") for poi, own in ports.followed]
        raise LabelError(
            f"the loop has {len(refs)} references {refs}, {len(found)} of them along {axis!r}; a "
            "map needs exactly one: add Ports(references=[Reference(poi)]), or leave the "
            "reference out."
        )
    return found[0][0].derived(found[0][1], "ref")
