"""Sums, products and multiples of systems."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from ..errors import ModelError
from ..values import FloatArray, Value, real_array
from .joining import in_parallel, in_series


class SystemArithmetic(Value):
    """What `StateSpace` calculates with: systems of any kind and numbers."""

    C: FloatArray
    D: FloatArray
    #: arrays leave `2.0 * g` with a numpy number to this class
    __array_ufunc__ = None

    @abstractmethod
    def _like(self, other: Any) -> Self:
        """Return another system, of python-control say, as one of this class."""

    def __neg__(self) -> Self:
        """Return the system with its outputs negated."""
        return self.replace(C=-self.C, D=-self.D)

    def __add__(self, other: Any) -> Self:
        """Return `parallel(self, other)`: same channels, outputs added."""
        if isinstance(other, Mapping):  # an Frf, which is computed line by line
            return NotImplemented
        return type(self)(**in_parallel(self, self._like(other)))

    def __sub__(self, other: Any) -> Self:
        """Return self + (-other): same channels, outputs subtracted."""
        return NotImplemented if isinstance(other, Mapping) else self + -self._like(other)

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

    def __truediv__(self, other: float) -> Self:
        """Return the system with its outputs divided by a number."""
        divisor = float(real_array(other, "the divisor", ()))
        if not divisor:
            raise ModelError("a system is divided by a number other than 0: pass one.")
        return self * (1.0 / divisor)
