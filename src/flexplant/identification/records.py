"""Time records of experiments: checked arrays with names, and drop-outs in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ShapeError, warn
from ..values import FloatArray, real_array, signal_names


@dataclass(frozen=True, eq=False)
class Records:
    """Inputs, outputs and references (n_exp, n_channel, n_time) of the same experiments."""

    u: FloatArray
    y: FloatArray
    r: FloatArray | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    rate: float


def records(inputs: Any, outputs: Any, reference: Any, rate: float) -> Records:
    """Return records of arrays or mappings by name."""
    u, in_names = signals(inputs, "inputs", "u")
    y, out_names = signals(outputs, "outputs", "y")
    sides = {"outputs": y}
    r = None
    if reference is not None:
        r, _ = signals(reference, "reference", "r")
        sides["reference"] = r
        if r.shape[1] != u.shape[1]:
            raise ShapeError(
                f"joint input-output needs one reference per input, got {r.shape[1]} for "
                f"{u.shape[1]}: the inputs' response to the references must be invertible."
            )
    for name, side in sides.items():
        if (side.shape[0], side.shape[2]) != (u.shape[0], u.shape[2]):
            raise ShapeError(
                f"inputs have {u.shape[0]} experiments of {u.shape[2]} samples, {name} "
                f"{side.shape[0]} of {side.shape[2]}: they must be the same experiments."
            )
    return Records(u, y, r, in_names, out_names, rate)


def signals(value: Any, side: str, prefix: str) -> tuple[FloatArray, tuple[str, ...]]:
    """Return records (n_exp, n_channel, n_time) and the names of their channels."""
    names: tuple[str, ...] = ()
    if isinstance(value, Mapping):
        names = tuple(str(name) for name in value)
        parts = [real_array(part, f"{side}[{name!r}]") for name, part in value.items()]
        if len({part.shape for part in parts}) != 1:
            raise ShapeError(f"all {side} must have the same shape.")
        array = np.stack(parts, axis=-2)
    else:
        array = real_array(value, side)
    if array.ndim == 1:
        array = array[None, :]
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or 0 in array.shape:
        raise ShapeError(
            f"{side} must have shape (n_channel, n_time) or (n_exp, n_channel, n_time), or be a "
            f"mapping from names to (n_time,) or (n_exp, n_time), got {array.shape}."
        )
    if not names:
        cure = f"{side}.T" if np.ndim(value) == 2 else f"np.swapaxes({side}, 1, 2)"
        _require_time_last(array, side, cure)
    return array, signal_names(names, array.shape[1], prefix, side)


def _require_time_last(array: FloatArray, side: str, cure: str) -> None:
    """Refuse records of more channels than samples: their axes are swapped."""
    channels, samples = array.shape[1:]
    if channels > samples:
        raise ShapeError(
            f"{side} have {channels} channels of {samples} samples each: their axes are swapped, "
            f"time is the last one here. Pass {cure}; in a mapping, each name has its own record."
        )


#: samples of one value, beyond what quantisation makes, that are no measurement
LONGEST = 20
#: times the logarithm of the number of runs that the longest of quantised noise is at most
CHANCE = 3.0


def dropouts_warned(data: Records) -> None:
    """Warn of outputs that repeat one value for longer than quantisation would make them.

    A cable, a buffer or an interferometer that lost its fringe leaves the last value, or zero,
    for a while; in an FRF that is a disturbance at all lines, which coherence shows but does not
    name. Values before the first change are the machine at rest.
    """
    for name, record in zip(data.outputs, np.moveaxis(data.y, 1, 0), strict=True):
        for signal in record:
            at, length = _longest(signal)
            if length:
                warn(
                    f"{name} keeps the value {signal[at]:.4g} for {length} samples from "
                    f"{at / data.rate:.4g} s on ({length / data.rate:.3g} s): a drop-out? The "
                    "estimate counts it as measured. Leave that part of the record out, or the "
                    "period it lies in."
                )
                break


def _longest(signal: FloatArray) -> tuple[int, int]:
    """Return where the longest run of one value begins and its length, 0 where it is ordinary."""
    ends = np.flatnonzero(np.diff(signal) != 0) + 1
    if ends.size < 3:
        return 0, 0
    # the first run is the machine at rest
    starts, lengths = ends[:-1], np.diff(ends)
    last = signal.size - int(ends[-1])
    starts, lengths = np.append(starts, ends[-1]), np.append(lengths, last)
    usual = float(np.mean(np.delete(lengths, np.argmax(lengths))))
    i = int(np.argmax(lengths))
    ordinary = LONGEST + CHANCE * usual * np.log(lengths.size)
    return (int(starts[i]), int(lengths[i])) if lengths[i] > ordinary else (0, 0)
