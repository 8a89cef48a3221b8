"""What a method of H-infinity synthesis is, and what it returns."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol

from ..lti.preparation import Prepared
from ..values import FloatArray


class SolvedController(NamedTuple):
    """A controller of the prepared problem, with what its method claims."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    gamma: float
    lower: float
    #: numbers for the certificate, and sentences, on how it was found
    certificate: Mapping[str, float] = MappingProxyType({})
    notes: tuple[str, ...] = ()


class SynthesisMethod(Protocol):
    """A way to solve the prepared problem: `Riccati()` or `Lmi()`."""

    def solve(self, problem: Prepared) -> SolvedController:
        """Return a controller of the prepared problem."""
