"""Recorded data: measurements and commands by channel name, missing samples NaN or masked."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..checks import FloatArray, floats, real_array, short
from ..errors import LabelError, ModelError, ShapeError, unknown_label
from .filter_model import FilterModel

#: samples that are copied together
_PIECE = 2048


class Recorded(NamedTuple):
    """A record: time (N,), and measurements y with NaN where missing beside commands u.

    `both` is [y u] (N, ny + nu), `complete` says that no sample is missing.
    """

    time: FloatArray
    both: FloatArray
    ny: int
    complete: bool

    @property
    def y(self) -> FloatArray:
        """Measurements (N, ny)."""
        return self.both[:, : self.ny]

    @property
    def u(self) -> FloatArray:
        """Commands (N, nu)."""
        return self.both[:, self.ny :]


def recorded(records: Any, model: FilterModel) -> Recorded:
    """Return the sensors and commands of a model from what was recorded."""
    if not hasattr(records, "keys") or not hasattr(records, "__getitem__"):
        raise ModelError(
            f"records must give channels by name, got {short(records)}. Pass a Response, a data "
            "frame, or a mapping such as {'y1': array, 'u1': array}."
        )
    known = [str(name) for name in records.keys()]  # noqa: SIM118 - a data frame iterates so too
    for name in (*model.sensors, *model.commands):
        if name not in known:
            missing = unknown_label("channel", name, known, "the records")
            what = (
                "A sensor that was not recorded is an array of NaN"
                if name in model.sensors
                else "A command that was not given is an array of zeros"
            )
            raise LabelError(f"{missing} {what}: the filter needs all of its channels.")
    y = [_channel(records[name], name, missing=True) for name in model.sensors]
    u = [_channel(records[name], name) for name in model.commands]
    sizes = {name: part.size for name, part in zip(model.sensors, y, strict=True)}
    sizes |= {name: part.size for name, part in zip(model.commands, u, strict=True)}
    if len(set(sizes.values())) > 1:
        raise ShapeError(
            f"channels of one record have one length, got {short(sizes)}. Cut them to the same "
            "samples, or fill what is missing of a sensor with NaN."
        )
    count = next(iter(sizes.values()))
    if not count:
        raise ShapeError("the record holds no samples: there is nothing to estimate from.")
    both = np.empty((count, len(sizes)))
    for first in range(0, count, _PIECE):  # a piece of all columns stays in the cache
        piece = slice(first, first + _PIECE)
        for i, part in enumerate((*y, *u)):
            both[piece, i] = part[piece]
    complete = all(bool(np.all(np.isfinite(part))) for part in y)
    return Recorded(_time(records, known, count, model.dt), both, len(y), complete)


def _channel(values: Any, name: str, *, missing: bool = False) -> FloatArray:
    array = floats(values, f"channel {name!r}")
    if array.ndim != 1:
        raise ShapeError(
            f"channel {name!r} must be (N,), one run over time, got {array.shape}. Of several runs "
            "take one: response.replace(data=response.data[0])."
        )
    if missing and not np.any(np.isinf(array)):
        return array
    return real_array(values, f"channel {name!r}")


def _time(records: Any, known: list[str], count: int, dt: float) -> FloatArray:
    """Return the times, which must be in steps of dt."""
    given = records["time"] if "time" in known else getattr(records, "time", None)
    if given is None or callable(given):
        return np.asarray(dt * np.arange(count))
    time = real_array(given, "time", (count,))
    steps = np.diff(time)
    if steps.size and np.max(np.abs(steps - dt)) > 1e-3 * dt:
        k = int(np.argmax(np.abs(steps - dt)))
        raise ModelError(
            f"the record goes from {time[k]:.9g} to {time[k + 1]:.9g} s in one sample, the samples "
            f"of the filter are {dt:.9g} s apart. Design it at the rate of the record, and put NaN "
            "in the place of samples that were lost."
        )
    return time
