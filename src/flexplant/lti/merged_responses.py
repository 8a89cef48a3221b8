"""Frequency responses that were measured one after the other: sensors or forces that moved."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, members
from ..errors import LabelError, ModelError, some_names
from ..tolerances import SAME
from .frequency import Frf

#: what measurements that are merged have in common
_COMMON = ("quantity", "resolution", "window", "overlap")


def merged_frf(frfs: Sequence[Frf]) -> Frf:
    """Return the responses of several measurements of one machine as one.

    The measurements have other sensors or other forces, for example because one accelerometer or
    one hammer moved from place to place. Together they contain each pair of an output and an input
    once.

    Parameters
    ----------
    frfs : sequence of Frf
        The measurements, at the same frequencies and with the same quantity and window. Inputs and
        outputs of the result are in the order in which they occur first.

    Returns
    -------
    Frf
        It has a coherence or a variance if all measurements have one. Errors of different
        measurements are assumed independent. The correlation of the errors of outputs is kept if
        all measurements have one, and the same inputs. `freedom` is the smallest that is known.

    Raises
    ------
    LabelError
        When a pair of an output and an input was measured twice, or not at all.
    ModelError
        When the measurements have different frequencies, quantities or windows, or a channel has
        different units in them.

    Examples
    --------
    >>> near = Frf([1.0, 2.0], [[[1.0, 0.5j]]], inputs=["hammer"], outputs=["1:z"])
    >>> far = Frf([1.0, 2.0], [[[0.2, 0.1j]]], inputs=["hammer"], outputs=["9:z"])
    >>> merged_frf([near, far])
    <Frf: hammer -> 1:z, 9:z, 2 frequencies 1 .. 2 Hz>
    """
    parts: tuple[Frf, ...] = members(frfs, Frf, "frfs", "Pass the measurements, [frf1, frf2].")
    _check_alike(parts)
    inputs = tuple(dict.fromkeys(name for part in parts for name in part.inputs))
    outputs = tuple(dict.fromkeys(name for part in parts for name in part.outputs))
    _check_pairs(parts, inputs, outputs)

    def spread(name: str) -> Any:
        given = [getattr(part, name) for part in parts]
        if any(one is None for one in given):
            return None
        whole = np.zeros((len(outputs), len(inputs), parts[0].freq.size), given[0].dtype)
        for part, one in zip(parts, given, strict=True):
            rows = [outputs.index(output) for output in part.outputs]
            whole[np.ix_(rows, [inputs.index(name) for name in part.inputs])] = one
        return whole

    freedoms = [part.freedom for part in parts if part.freedom is not None]
    return parts[0].replace(
        data=spread("data"),
        inputs=inputs,
        outputs=outputs,
        coherence=spread("coherence"),
        variance=spread("variance"),
        correlation=_correlation(parts),
        freedom=min(freedoms, default=None),
        units={name: unit for part in parts for name, unit in part.units.items()},
    )


def _check_alike(parts: Sequence[Frf]) -> None:
    first = parts[0]
    for number, part in enumerate(parts[1:], 2):
        same = part.freq.shape == first.freq.shape
        if not same or not np.allclose(part.freq, first.freq, rtol=SAME, atol=0.0):
            raise ModelError(
                f"measurement {number} has other frequencies than the first: estimate all with "
                "the same rate and the same length of segments or periods."
            )
        for name in _COMMON:
            own, wanted = getattr(part, name), getattr(first, name)
            numbers = isinstance(own, float) and isinstance(wanted, float)
            if own != wanted and not (numbers and math.isclose(own, wanted, rel_tol=SAME)):
                raise ModelError(
                    f"measurement {number} has the {name} {own!r}, the first {wanted!r}: "
                    "estimate all in the same way."
                )
        for name, unit in part.units.items():
            known = next((one.units[name] for one in parts if name in one.units), unit)
            if unit != known:
                raise ModelError(
                    f"measurement {number} has {name!r} in {unit}, another one in {known}: convert "
                    "one of them."
                )


def _check_pairs(parts: Sequence[Frf], inputs: Sequence[str], outputs: Sequence[str]) -> None:
    measured = Counter(pair for part in parts for pair in part)
    twice = [pair for pair, count in measured.items() if count > 1]
    if twice:
        raise LabelError(
            f"{_text(twice)} was measured more than once. Select one: frf.select(outputs, inputs)."
        )
    missing = [(out, name) for out in outputs for name in inputs if (out, name) not in measured]
    if missing:
        raise LabelError(
            f"{_text(missing)} was not measured. Leave out what was not measured for all: "
            "frf.select(outputs, inputs), or identify the measurements one by one and merge the "
            "modes: measured.merged(other)."
        )


def _text(pairs: Sequence[tuple[str, str]]) -> str:
    return some_names([f"{name} -> {output}" for output, name in pairs])


def _correlation(parts: Sequence[Frf]) -> ComplexArray | None:
    """Return the correlation of outputs, of which those measured apart are independent."""
    given = [part.correlation for part in parts if part.correlation is not None]
    if len(given) < len(parts) or len({part.inputs for part in parts}) > 1:
        return None
    lines = [la.block_diag(*(one[:, :, k] for one in given)) for k in range(parts[0].freq.size)]
    return np.stack(lines, axis=-1)
