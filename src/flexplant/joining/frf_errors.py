"""What errors of measured responses do to the responses of a machine that is computed from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..checks import ComplexArray, FloatArray
from ..errors import warn
from ..lti import Frf

#: part of each response that is taken for its error where none is known: of a good measurement
_USUAL = 0.01


class MeasuredParts(NamedTuple):
    """Responses side by side, block-diagonal: with their signs, errors and names of channels."""

    data: ComplexArray
    variance: FloatArray | None
    correlation: ComplexArray | None  # (n_out, n_out, n_freq), None where all are independent
    outputs: list[str]
    inputs: list[str]


def side_by_side(frfs: Mapping[str, Frf], signs: Mapping[str, float]) -> MeasuredParts:
    """Return responses in one matrix, channels behind the prefixes that name them.

    A response without a variance has none: computed ones have no errors.
    """
    outputs = [f"{name}{channel}" for name, frf in frfs.items() for channel in frf.outputs]
    inputs = [f"{name}{channel}" for name, frf in frfs.items() for channel in frf.inputs]
    n_freq = next(iter(frfs.values())).freq.size
    data = np.zeros((len(outputs), len(inputs), n_freq), dtype=np.complex128)
    variance = np.zeros(data.shape)
    correlation = np.zeros((len(outputs), len(outputs), n_freq), dtype=np.complex128)
    correlation[range(len(outputs)), range(len(outputs))] = 1.0
    row = column = 0
    for name, frf in frfs.items():
        rows, columns = slice(row, row + len(frf.outputs)), slice(column, column + len(frf.inputs))
        data[rows, columns] = signs[name] * frf.data
        variance[rows, columns] = 0.0 if frf.variance is None else frf.variance
        if frf.correlation is not None:
            correlation[rows, rows] = frf.correlation
        row, column = rows.stop, columns.stop
    measured = any(frf.variance is not None for frf in frfs.values())
    correlated = measured and any(frf.correlation is not None for frf in frfs.values())
    return MeasuredParts(
        data, variance if measured else None, correlation if correlated else None, outputs, inputs
    )


def variance_of(
    variance: FloatArray, correlation: ComplexArray | None, left: Any, right: Any
) -> FloatArray:
    """Return E|L dY R|^2 (n_out, n_in, n_freq), dY of independent columns.

    L (n_freq, n_out, ...) and R (n_freq, ..., n_in); the errors of different outputs under one
    input are independent, or correlated.
    """
    if correlation is None:
        found = np.abs(left) ** 2 @ np.moveaxis(variance, 2, 0) @ np.abs(right) ** 2
        return np.moveaxis(found, 0, 2)
    between = np.moveaxis(correlation, 2, 0)
    columns = []
    for column in np.moveaxis(variance, 1, 0):
        weighted = left * np.sqrt(column).T[:, None, :]
        columns.append(np.einsum("fia,fab,fib->fi", weighted, between, weighted.conj()).real)
    found = np.stack(columns, axis=2) @ np.abs(right) ** 2
    return np.moveaxis(np.maximum(found, 0.0), 0, 2)


def warn_of_errors(
    data: ComplexArray, error: FloatArray, freq: FloatArray, *, known: bool, done: str
) -> None:
    """Warn of lines at which the error of all answers together exceeds these.

    `error` is the variance, or, where none is `known`, what errors of the size of all responses
    would add up to.
    """
    answer, part = np.sum(np.abs(data) ** 2, axis=(0, 1)), 1.0 if known else _USUAL**2
    hidden = part * np.sum(error, axis=(0, 1)) > answer
    if not hidden.any():
        return
    whose = "by their variances" if known else f"of {100 * _USUAL:.0f} % in each response"
    where = f"{freq[hidden][0]:.5g} to {freq[hidden][-1]:.5g} Hz"
    warn(
        f"errors {whose} exceed the answer at {np.count_nonzero(hidden)} of {freq.size} lines "
        f"({where}): {done}. Leave these lines out, average more, or take channels at which the "
        "responses differ more."
    )
