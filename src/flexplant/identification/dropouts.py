"""Stretches of a record in which a sensor stood still: drop-outs."""

from __future__ import annotations

import warnings

import numpy as np

from ..errors import FlexplantWarning
from ..values import FloatArray
from .records import Records

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
                warnings.warn(
                    f"{name} keeps the value {signal[at]:.4g} for {length} samples from "
                    f"{at / data.rate:.4g} s on ({length / data.rate:.3g} s): a drop-out? The "
                    "estimate counts it as measured. Leave that part of the record out, or the "
                    "period it lies in.",
                    FlexplantWarning,
                    stacklevel=3,
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
