"""Records of a run, their servo metrics (RMS, MA, MSD), and forces at their end that oppose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from ..arrays import FloatArray, IntArray, check_names, known_units, name_list, positive, real_array
from ..errors import ChannelError, ModelError, ShapeError, counted, some_names, unknown_label, warn
from ..loop import ClosedLoop, Spectrum
from ..plant.axes import idle_forces, opposing_part
from ..store import Value
from ..tolerances import TYPED

#: one number, or one per run
Numbers: TypeAlias = "float | FloatArray"


@dataclass(frozen=True, eq=False, repr=False)
class Response(Value, Mapping[str, FloatArray]):
    """Sampled signals of one run or of several, by name.

    `response["die:error"]` is an array over time. Its shape is (n_time,), or (n_runs, n_time) if
    the number of runs was given, even if that number is 1. A Response is a mapping, so that
    ``pandas.DataFrame(dict(response))`` makes a table of one run.

    Parameters
    ----------
    time : (n_time,) array [s]
        Equidistant sampling instants.
    data : (n_channel, n_time) or (n_runs, n_channel, n_time) array
        Samples of the channels, for one or several runs.
    names : sequence of str
        Names of the channels.
    units : mapping {channel: unit}, optional
        SI units of those channels whose unit is known.
    seed : int or tuple of int, optional
        Seed of the noise. If it is given to `simulate` as `rng`, the same run is repeated.

    Raises
    ------
    ModelError
        When time is not equidistant or entries are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> run = Response(np.arange(4) * 0.5, [[1.0, -1.0, 1.0, -1.0]], ["e"])
    >>> run.rms("e"), run.peak("e"), run["e"].shape
    (1.0, 1.0, (4,))
    """

    time: FloatArray
    data: FloatArray
    names: Sequence[str]
    units: Mapping[str, str] = field(default_factory=dict)
    seed: int | tuple[int, ...] | None = None

    # compared by identity; Mapping's == would compare arrays
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __post_init__(self) -> None:
        names = name_list(self.names, "channels")
        check_names(names, "channels")
        time = real_array(self.time, "time", (None,), copy=False)
        steps = np.diff(time)
        if steps.size and (steps.min() <= 0 or np.ptp(steps) > TYPED * steps.mean()):
            raise ModelError("time must increase in equal steps: moving windows count samples.")
        data = real_array(self.data, "data", limit=np.inf, copy=False)
        if data.ndim not in (2, 3) or data.shape[-2:] != (len(names), time.size):
            raise ShapeError(
                f"data of {len(names)} channels at {time.size} times must have shape "
                f"({len(names)}, {time.size}), runs before that, got {data.shape}."
            )
        self._set(time=time, data=data, names=names, units=known_units(self.units, names))

    def __repr__(self) -> str:
        runs = "" if self.data.ndim == 2 else f"{counted(self.data.shape[0], 'run')}, "
        shown = ", ".join(self.names[:6]) + (", ..." if len(self.names) > 6 else "")
        span = self.time.size * self.dt
        drawn = "" if self.seed is None else f", seed {self.seed}"
        return (
            f"<Response {runs}{counted(self.time.size, 'sample')} over {span:.6g} s, "
            f"{counted(len(self.names), 'channel')}: {shown}{drawn}>"
        )

    def __getitem__(self, channel: str) -> FloatArray:
        if not isinstance(channel, str) or channel not in self.names:
            raise ChannelError(str(unknown_label("channel", channel, self.names)))
        signal: FloatArray = self.data[..., self.names.index(channel), :]
        return signal

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        if self.time.size < 2:
            return 0.0
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]; 0 for a single sample."""
        return 1.0 / self.dt if self.dt else 0.0

    def rms(self, channel: str, *, start: float = 0.0) -> Numbers:
        """Return the root mean square of a channel: one number, or one for each run.

        The mean is not removed. Samples before `start` [s] are left out (transients). In this and
        the other methods, an unknown channel raises LabelError, and a start after the end of the
        record raises ModelError.
        """
        signal = self._from(channel, start)
        unit = signal_unit(signal)
        return as_numbers(unit * np.sqrt(np.mean((signal / unit) ** 2, axis=-1)))

    def rms_interval(
        self, channel: str, *, start: float = 0.0, level: float = 0.95
    ) -> tuple[float, float, float]:
        """Return the root mean square over all runs, and the ends of its confidence interval.

        The mean squares of two or more independent runs are assumed to be normally distributed. The
        interval of their mean is that of Student's distribution, with a lower end of at least zero.
        """
        if self.data.ndim != 3 or self.data.shape[0] < 2:
            raise ModelError(
                "an interval needs the scatter between runs: simulate(..., runs=5) or more."
            )
        if not 0.0 < positive(level, "level") < 1.0:
            raise ModelError(f"level is a probability between 0 and 1, got {level:g}. Try 0.95.")
        rms = np.asarray(self.rms(channel, start=start))
        unit = float(rms.max()) or 1.0
        power = (rms / unit) ** 2
        from scipy.special import stdtrit

        quantile = float(stdtrit(power.size - 1, 0.5 + 0.5 * level))
        half = quantile * float(power.std(ddof=1)) / np.sqrt(power.size)
        ends = np.sqrt(np.maximum(power.mean() + np.array([0.0, -half, half]), 0.0))
        value, low, high = (unit * ends).tolist()
        return value, low, high

    def peak(self, channel: str, *, start: float = 0.0) -> Numbers:
        """Return the largest magnitude of a channel from `start` [s] on, for each run."""
        return as_numbers(np.max(np.abs(self._from(channel, start)), axis=-1))

    def psd(self, channel: str, *, start: float = 0.0, segment: float | None = None) -> Spectrum:
        """Return the one-sided power spectral density of a channel, over all runs.

        It is estimated by Welch's method. Hann windows of the length `segment` [s] (an eighth of
        the record by default) overlap by half. The mean is not removed, so that the integral is the
        mean square.
        """
        from scipy.signal import welch

        signal = self._from(channel, start)
        length = signal.shape[-1] * self.dt
        count = round(positive(length / 8.0 if segment is None else segment, "segment") / self.dt)
        if not 2 <= count <= signal.shape[-1]:
            raise ModelError(
                f"a segment of {count * self.dt:g} s is {count} samples, the record has "
                f"{signal.shape[-1]} from {start:g} s on: choose one of 2 to that many samples."
            )
        unit = signal_unit(signal)
        freq, density = welch(
            signal / unit, fs=1.0 / self.dt, window="hann", nperseg=count, detrend=False
        )
        return Spectrum(freq, unit**2 * density.reshape(-1, freq.size).mean(axis=0))

    def moving_average(self, channel: str, *, window: float = 5e-3) -> FloatArray:
        """Return the mean of a channel over a window [s] centred at each time (MA).

        In lithography the window is the exposure time of a point, and the MA of the error is the
        overlay error. The window is rounded to whole samples. If their number is even, the window
        reaches one sample further back than ahead. At both ends of the record the window is
        shortened to the samples that exist.
        """
        return self._moments(channel, window)[0]

    def moving_std(self, channel: str, *, window: float = 5e-3) -> FloatArray:
        """Return the standard deviation of a channel in a window [s] centred at each time (MSD).

        The deviation is that from the mean of the window. In lithography the MSD of the error is
        called fading, the blur of the image.
        """
        return self._moments(channel, window)[1]

    def exposure(
        self, channel: str, *, window: float = 5e-3, start: float = 0.0
    ) -> tuple[float, float]:
        """Return the largest |MA| and the largest MSD of a channel after a time, over all runs.

        MA is the moving average, and MSD the moving standard deviation, over a window in seconds.

        Windows are centred at each sample. Those centred before `start` [s] are left out, because
        they cover the move and its settling. At the end of the record, windows are shortened.
        """
        first = first_sample(self, start)
        average, deviation = self._moments(channel, window)
        return float(np.abs(average[..., first:]).max()), float(deviation[..., first:].max())

    def _from(self, channel: str, start: float) -> FloatArray:
        return self[channel][..., first_sample(self, start) :]

    def _moments(self, channel: str, window: float) -> tuple[FloatArray, FloatArray]:
        signal = self[channel]
        unit = signal_unit(signal)
        count = window_samples(window, self.dt, self.time.size, "the response")
        mean, deviation = moving_moments(signal / unit, count)
        return unit * mean, unit * deviation


def first_sample(run: Response, start: float, name: str = "start") -> int:
    """Return the number of the first sample from a time [s] on, which messages call `name`."""
    first = float(real_array(start, name, ()))
    # half a sample of slack: start=0.1 means the sample at 0.1 s, however that was rounded
    found = int(np.searchsorted(run.time, first - 0.5 * run.dt))
    if found == run.time.size:
        raise ModelError(
            f"{name}={first:g} s is too late: the response ends at {run.time[-1]:g} s. "
            "Choose an earlier time, or simulate for longer."
        )
    return found


def window_samples(window: float, dt: float, most: int, where: str) -> int:
    """Return the number of samples of a window [s] in a part of a run that has `most` samples."""
    length = positive(window, "window")
    count = round(length / dt) if dt else 0
    if not 1 <= count <= most:
        raise ModelError(
            f"a window of {length:g} s is {count} samples of {dt:g} s, but {where} has {most}: "
            f"choose a window of 1 to {most} samples, or a longer run."
        )
    return count


def as_numbers(values: FloatArray) -> Numbers:
    """Return a number, or an array of one for each run."""
    return float(values) if np.ndim(values) == 0 else values


def moving_moments(signal: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation (..., n) over `count` samples around each sample."""
    # cumulative sums restart at every multiple of `count`, and each window spans exactly one such
    # edge: it is the tail of one stretch and the head of the next. Both are relative to the sample
    # at the edge, which lies in the window, so that a large offset does not reduce the accuracy
    n = signal.shape[-1]
    before = count // 2
    lead = count  # samples of zero weight before the record, so that every window has its edge
    stretches = -(-(lead + n + count) // count) + 1
    tail = stretches * count - lead - n
    edge = [(0, 0)] * (signal.ndim - 1) + [(lead, tail)]
    shape = (*signal.shape[:-1], stretches, count)
    values = np.pad(signal, edge, mode="edge").reshape(shape)
    inside = np.pad(np.ones(n), (lead, tail)).reshape(stretches, count)
    edges = values[..., :1]
    ahead = (values - edges) * inside
    behind = (values[..., :-1, :] - edges[..., 1:, :]) * inside[:-1]
    first: IntArray = lead + np.arange(n) - before
    stretch, offset = np.divmod(first, count)
    stretch, offset = np.where(offset, stretch, stretch - 1), np.where(offset, offset, count)
    weight = np.minimum(np.arange(n) - before + count, n) - np.maximum(np.arange(n) - before, 0)
    means = []
    for power in (1, 2):
        # heads[..., s, k]: the first k of stretch s + 1; tails[..., s, k]: those of s from k on
        heads = _cumulative(ahead[..., 1:, :] ** power)
        tails = _cumulative(behind[..., ::-1] ** power)[..., ::-1]
        means.append((tails[..., stretch, offset] + heads[..., stretch, offset]) / weight)
    centre = edges[..., 1:, 0][..., stretch] + means[0]
    return centre, np.sqrt(np.maximum(means[1] - means[0] ** 2, 0.0))


def signal_unit(signal: FloatArray) -> float:
    """Return the size of a signal as a power of two: its squares neither over- nor underflow."""
    return float(2.0 ** (np.frexp(np.max(np.abs(signal), initial=0.0))[1] - 1))


def _cumulative(parts: FloatArray) -> FloatArray:
    """Return sums of the first 0, 1, ..., count entries along the last axis."""
    out = np.zeros((*parts.shape[:-1], parts.shape[-1] + 1))
    np.cumsum(parts, axis=-1, out=out[..., 1:])
    return out


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
    efforts = [np.atleast_2d(run[name]) for name in loop.driven]  # (runs, n_time) of each
    most = np.max([np.maximum(one.max(axis=1), -one.min(axis=1)) for one in efforts], axis=0)
    end = np.stack([one[:, -count:] for one in efforts])
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
