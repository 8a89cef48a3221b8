"""The parts of a standard plant: its systems and matrices between w, u, z and y."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..errors import ModelError
from ..lti.statespace import StateSpace
from ..values import FloatArray


class Partition:
    """What a plant's system is between its four groups of channels."""

    system: StateSpace
    w: tuple[str, ...]
    u: tuple[str, ...]
    z: tuple[str, ...]
    y: tuple[str, ...]
    asd: Mapping[str, float]

    @property
    def dt(self) -> float:
        """Sampling time [s]; 0 when continuous."""
        return self.system.dt

    @property
    def sensor_noise(self) -> FloatArray:
        """Covariance (ny, ny) of a sample of y: asd^2 rate / 2 for each sensor."""
        if not self.dt:
            raise ModelError("sensor noise per sample needs a sampled plant: discretized(rate).")
        variance = [0.5 * self.asd.get(f"{name}:noise", 0.0) ** 2 / self.dt for name in self.y]
        return np.diag(variance)

    B1 = property(lambda self: self.Gzw.B, doc="w to dx/dt.")
    B2 = property(lambda self: self.Gzu.B, doc="u to dx/dt.")
    C1 = property(lambda self: self.Gzw.C, doc="x to z.")
    C2 = property(lambda self: self.Gyw.C, doc="x to y.")
    D11 = property(lambda self: self.Gzw.D, doc="w to z.")
    D12 = property(lambda self: self.Gzu.D, doc="u to z.")
    D21 = property(lambda self: self.Gyw.D, doc="w to y.")
    D22 = property(lambda self: self.Gyu.D, doc="u to y.")

    @property
    def Gzw(self) -> StateSpace:
        """The system w -> z."""
        return self.system.select(self.z, self.w)

    @property
    def Gzu(self) -> StateSpace:
        """The system u -> z."""
        return self.system.select(self.z, self.u)

    @property
    def Gyw(self) -> StateSpace:
        """The system w -> y."""
        return self.system.select(self.y, self.w)

    @property
    def Gyu(self) -> StateSpace:
        """The system u -> y."""
        return self.system.select(self.y, self.u)
