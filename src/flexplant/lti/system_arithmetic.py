"""Sums, products and multiples of systems."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from ..errors import ModelError
from ..values import FloatArray, Value, real_array, short
from .joining import in_parallel, in_series


class SystemArithmetic(Value):
    """What `StateSpace` calculates with: systems of any kind and numbers."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    inputs: Sequence[str]
    outputs: Sequence[str]
    #: arrays leave `2.0 * g` with a numpy number to this class
    __array_ufunc__ = None

    @abstractmethod
    def _like(self, other: Any) -> Self:
        """Return another system, of python-control say, as one of this class."""

    def _direct(self, value: Any) -> FloatArray:
        """Return a number or a matrix that is added to D; of several channels it is a matrix."""
        found = real_array(value, "what is added to a system")
        if found.shape != self.D.shape and (found.ndim or self.D.shape != (1, 1)):
            raise ModelError(
                f"what is added to a system of shape {self.D.shape} is a system or a matrix of "
                f"that shape, got {short(value)}. For I + L add np.eye({self.D.shape[0]})."
            )
        return found

    def __neg__(self) -> Self:
        """Return the system with its outputs negated."""
        return self.replace(C=-self.C, D=-self.D)

    def __add__(self, other: Any) -> Self:
        """Return `parallel(self, other)`: same channels, outputs added; a number adds to D."""
        if isinstance(other, Mapping):  # an Frf, which is computed line by line
            return NotImplemented
        if isinstance(other, int | float | np.number | np.ndarray):
            return self.replace(D=self.D + self._direct(other))
        return type(self)(**in_parallel(self, self._like(other)))

    def __radd__(self, other: Any) -> Self:
        """Return `self + other`: ``1 + L``."""
        found: Self = self + other
        return found

    def __rsub__(self, other: Any) -> Self:
        """Return `-self + other`: ``1 - S``."""
        found: Self = -self + other
        return found

    def __sub__(self, other: Any) -> Self:
        """Return self + (-other): same channels, outputs subtracted."""
        if isinstance(other, Mapping):
            return NotImplemented
        numeric = isinstance(other, int | float | np.number | np.ndarray)
        return self + (-other if numeric else -self._like(other))

    def __mul__(self, other: Any) -> Self:
        """Return `series(other, self)`, as transfer functions multiply; a number scales outputs."""
        if isinstance(other, int | float | np.number):
            factor = float(real_array(other, "the factor", ()))
            return self.replace(C=factor * self.C, D=factor * self.D)
        if isinstance(other, Mapping):
            return NotImplemented
        return type(self)(**in_series(self._like(other), self))

    def __rmul__(self, other: float) -> Self:
        """Return the system with its outputs times a number."""
        return self * other if isinstance(other, int | float | np.number) else NotImplemented

    def __rtruediv__(self, other: float) -> Self:
        """Return a number times the inverse of the system: ``1 / (1 + L)``.

        From ``y = C x + D u``: ``u = D^-1 (y - C x)``.
        """
        D = self.D
        if D.shape[0] != D.shape[1] or np.linalg.matrix_rank(D) < D.shape[0]:
            raise ModelError(
                "the inverse of this system differentiates: its D is not invertible, as of all "
                "plants. For 1 / (1 + L) write the brackets; for S and T see lti.feedback."
            )
        inverse = np.linalg.inv(D)
        B, C = self.B @ inverse, -inverse @ self.C
        found = self.replace(
            A=self.A - B @ self.C, B=B, C=C, D=inverse, inputs=self.outputs, outputs=self.inputs
        )
        return found * other

    def __truediv__(self, other: float) -> Self:
        """Return the system with its outputs divided by a number."""
        divisor = float(real_array(other, "the divisor", ()))
        if not divisor:
            raise ModelError("a system is divided by a number other than 0: pass one.")
        return self * (1.0 / divisor)
