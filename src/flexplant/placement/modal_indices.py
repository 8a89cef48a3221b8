"""Gawronski's modal indices: how much of the modes that matter each device sees or moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..plant import StandardPlant
from ..values import FloatArray, one_of
from .candidate_shapes import ByShapes, Shapes, shapes_of
from .summed import SummedWorth


@dataclass(frozen=True, eq=False)
class SensorIndices(ByShapes):
    """Minus the sum of squared placement indices of the sensors, by modal norms.

    ``sum_i sum_k (alpha_k phi_ik / asd_i)^2`` over the elastic modes, which are mass-normalised;
    alpha_k is the norm of mode k from the disturbances to the POIs, ``g = |phi_wk| |phi_zk|``::

        H2:  g / (2 sqrt(zeta) omega^(3/2)),   Hinf:  g / (2 zeta omega^2),   Hankel: half of it

    over that of the largest. Each device counts by itself: two at one place count twice. Of a POI
    it says next to nothing, as `ModeInformation`.

    Parameters
    ----------
    norm : {"h2", "hinf", "hankel"}
        By which modes are weighted.

    Raises
    ------
    ModelError
        When the norm is none of these; when called, for a plant made elsewhere.

    References
    ----------
    [Gawronski2004]_, ch. 5 and 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.SensorIndices()).chosen
    ('s1', 's3')
    """

    norm: str = "h2"

    def __post_init__(self) -> None:
        self._set(norm=one_of(self.norm, "norm", ("h2", "hinf", "hankel")))

    def of(self, plant: StandardPlant, shapes: Shapes) -> SummedWorth:
        """Return the indices of choices."""
        kept = shapes.elastic
        seen = (
            shapes.phi[:, kept] * (1e-12 / shapes.asd if self.sides == "y" else shapes.asd)[:, None]
        )
        return SummedWorth(np.sum((seen * self.weights(plant)) ** 2, axis=1))

    def weights(self, plant: StandardPlant) -> FloatArray:
        """Return alpha (m,) of the elastic modes."""
        ports, real = plant.assembled.ports, plant.assembled.realisation
        pushes = [port for port in ports.forces if port.asd > 0]
        pushed = shapes_of(plant, pushes)
        kept = pushed.elastic
        omega, zeta = pushed.omega[kept], pushed.zeta[kept]
        asd = np.array([port.asd for port in pushes])
        force = np.sqrt(np.sum((pushed.phi[:, kept] * asd[:, None]) ** 2, axis=0))
        rows = [real.row(poi.at, axis) for poi in ports.z for axis in poi.axes]
        motion = np.sqrt(np.sum((np.array(rows) @ pushed.full[:, kept]) ** 2, axis=0))
        damped = {"h2": 2.0 * np.sqrt(zeta) * omega**1.5, "hinf": 2.0 * zeta * omega**2}
        size = force * motion / damped.get(self.norm, damped["hinf"])
        return np.asarray(size / np.max(size))


@dataclass(frozen=True, eq=False)
class ActuatorIndices(SensorIndices):
    """Minus the sum of squared placement indices of the actuators, as `SensorIndices` has them.

    Parameters
    ----------
    norm : {"h2", "hinf", "hankel"}
        By which modes are weighted.

    Raises
    ------
    ModelError
        When the norm is none of these; when called, for a plant made elsewhere.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> fx.place_actuators(plant, candidates, 1, fx.placement.ActuatorIndices()).side
    'u'
    """

    sides: ClassVar[str] = "u"
