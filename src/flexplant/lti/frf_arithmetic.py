"""Sums, products and multiples of frequency responses; their magnitude and phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import LabelError, ModelError, ShapeError, counted
from ..values import ComplexArray, FloatArray, short
from .joining import short_list
from .responses import responses
from .statespace import as_statespace

_NUMBERS = (int, float, complex, np.number)


class Operand(NamedTuple):
    """A response on the lines of another one, with what is known of its channels and errors."""

    data: ComplexArray
    variance: FloatArray | None
    inputs: Sequence[str]
    outputs: Sequence[str]
    units: dict[str, str]
    quantity: str | None


class Arithmetic:
    """What `Frf` calculates with: numbers, responses on the same lines, systems.

    Errors of two responses are taken to be independent, so that variances add; those of a product
    follow to first order, ``|G2|^2 var G1 + |G1|^2 var G2``. A system adds none. What belongs to
    one measurement (coherence, correlation of outputs, segments) is left out of sums and products.
    """

    #: arrays leave `2.0 * frf` with a numpy number to this class
    __array_ufunc__ = None

    @property
    def mag(self: Any) -> FloatArray:
        """Magnitude (n_out, n_in, n_freq)."""
        return np.asarray(np.abs(self.data))

    @property
    def phase(self: Any) -> FloatArray:
        """Phase (n_out, n_in, n_freq) [rad], between -pi and pi."""
        return np.asarray(np.angle(self.data))

    def __neg__(self) -> Any:
        """Return the responses negated."""
        return self * -1.0

    def __add__(self: Any, other: Any) -> Any:
        """Return the sum of two responses between the same channels."""
        one, two = _operand(self, self), _operand(other, self)
        if (tuple(one.inputs), tuple(one.outputs)) != (tuple(two.inputs), tuple(two.outputs)):
            raise LabelError(
                f"a sum needs the same channels, got {_sides(one)} and {_sides(two)}. Select or "
                "rename them first."
            )
        variance = _sum(one.variance, two.variance)
        quantity = one.quantity if two.quantity in (None, one.quantity) else None
        return _computed(self, one.data + two.data, variance, quantity=quantity)

    __radd__ = __add__

    def __rsub__(self, other: Any) -> Any:
        """Return a system minus these responses."""
        return -self + other

    def __sub__(self, other: Any) -> Any:
        """Return the difference of two responses between the same channels."""
        return self + (-other if isinstance(other, Arithmetic) else -as_statespace(other))

    def __mul__(self: Any, other: Any) -> Any:
        """Return ``G1 G2``, the second one's outputs driving this one's inputs; or a multiple."""
        if isinstance(other, _NUMBERS):
            return _multiple(self, complex(other))
        return _product(self, _operand(self, self), _operand(other, self))

    def __rmul__(self: Any, other: Any) -> Any:
        """Return a multiple, or the product of a system before this one."""
        if isinstance(other, _NUMBERS):
            return _multiple(self, complex(other))
        return _product(self, _operand(other, self), _operand(self, self))

    def __truediv__(self: Any, other: Any) -> Any:
        """Return the responses divided by a number, or by a response of one channel."""
        if isinstance(other, Arithmetic):
            return self * _reciprocal(other)
        if not isinstance(other, _NUMBERS) or other == 0:
            raise ModelError(
                f"responses are divided by a number other than 0 or by a response of one input "
                f"and one output, got {short(other)}. Pass one of these."
            )
        return self * (1.0 / complex(other))

    def __rtruediv__(self: Any, other: Any) -> Any:
        """Return a number divided by a response of one channel."""
        return _reciprocal(self) * other


def _reciprocal(frf: Any) -> Any:
    """Return 1/G, from the output to the input of G; its variance is ``var G / |G|^4``."""
    if frf.data.shape[:2] != (1, 1):
        raise ShapeError(
            f"the quotient needs a response of one input and one output, got {_sides(frf)}. Select "
            "one pair, or solve line by line: numpy.linalg.solve over data."
        )
    if not np.all(frf.data):
        zero = float(frf.freq[~frf.data[0, 0].astype(bool)][0])
        raise ModelError(
            f"the response is 0 at {zero:g} Hz: its inverse is infinite there. Leave the line out."
        )
    inverse = 1.0 / frf.data
    variance = None if frf.variance is None else frf.variance * np.abs(inverse) ** 4
    return _computed(frf, inverse, variance, inputs=frf.outputs, outputs=frf.inputs, quantity=None)


def _operand(given: Any, frf: Any) -> Operand:
    """Return a response, or that of a system, on the lines of an Frf."""
    if not isinstance(given, Arithmetic):
        g = as_statespace(given)
        return Operand(responses(g, frf.freq), None, g.inputs, g.outputs, dict(g.units), None)
    own: Any = given
    if own.freq.shape != frf.freq.shape or not np.allclose(own.freq, frf.freq, rtol=1e-9, atol=0.0):
        raise ShapeError(
            f"responses are combined line by line, but one has {_lines(frf)} and the other "
            f"{_lines(own)}. Compute or measure both at the same frequencies."
        )
    parts = (own.data, own.variance, own.inputs, own.outputs, own.channel_units, own.quantity)
    return Operand(*parts)


def _multiple(frf: Any, factor: complex) -> Any:
    if not np.isfinite(factor):
        raise ModelError(f"responses are multiplied by a finite number, got {factor:g}.")
    variance = None if frf.variance is None else abs(factor) ** 2 * frf.variance
    return frf.replace(data=factor * frf.data, variance=variance)


def _product(frf: Any, one: Operand, two: Operand) -> Any:
    """Return the product of two matrices of responses, line by line."""
    if len(one.inputs) != len(two.outputs):
        raise ShapeError(
            "a product G1 * G2 needs as many outputs of G2 as inputs of G1, got "
            f"{len(two.outputs)} ({short_list(two.outputs)}) and {len(one.inputs)} "
            f"({short_list(one.inputs)})."
        )

    def product(a: Any, b: Any) -> Any:
        return None if a is None or b is None else np.einsum("ijf,jkf->ikf", a, b)

    variance = _sum(
        product(one.variance, np.abs(two.data) ** 2), product(np.abs(one.data) ** 2, two.variance)
    )
    units = {name: two.units[name] for name in two.inputs if name in two.units}
    units |= {name: one.units[name] for name in one.outputs if name in one.units}
    return _computed(
        frf, product(one.data, two.data), variance,
        inputs=two.inputs, outputs=one.outputs, units=units, quantity=None,
    )  # fmt: skip


def _computed(frf: Any, data: ComplexArray, variance: FloatArray | None, **fields: Any) -> Any:
    """Return an Frf on the same lines that no single measurement gave."""
    lost = ("coherence", "correlation", "resolution", "window", "freedom")
    return frf.replace(data=data, variance=variance, overlap=0.0, **dict.fromkeys(lost), **fields)


def _sum(a: FloatArray | None, b: FloatArray | None) -> FloatArray | None:
    return b if a is None else a if b is None else a + b


def _sides(one: Operand) -> str:
    return f"{short_list(one.inputs)} -> {short_list(one.outputs)}"


def _lines(frf: Any) -> str:
    span = f" from {frf.freq[0]:.4g} to {frf.freq[-1]:.4g} Hz" if frf.freq.size else ""
    return f"{counted(frf.freq.size, 'line')}{span}"
