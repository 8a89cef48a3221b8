"""Mode shapes where candidates are: what the classical criteria are made of."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..checks import FloatArray, checked, instance
from ..errors import AssumptionError, ModelError
from ..plant import SensorPort, StandardPlant
from ..reduction import ReducedModel
from ..structure import FEModel
from ..tolerances import divisor
from .criterion import Criterion, Scorer
from .summed import SummedWorth, by_size


@dataclass(frozen=True, eq=False)
class Shapes:
    """Mass-normalised shapes of a plant's modes, rigid-body modes first."""

    phi: FloatArray
    omega: FloatArray
    zeta: FloatArray
    rows: FloatArray
    full: FloatArray
    asd: FloatArray

    @property
    def elastic(self) -> slice:
        """The modes that are no rigid-body modes."""
        return slice(int(np.count_nonzero(self.omega == 0)), None)


def shapes_of(plant: StandardPlant, ports: Sequence[Any]) -> Shapes:
    """Return the shapes at ports of a plant that was assembled from a structure."""
    real = plant.assembled.realisation
    m = real.n_modes
    pairs = real.pairs[:m]
    omega = np.sqrt(np.abs(np.linalg.det(pairs)))
    omega[: real.n_rigid] = 0.0
    zeta = -np.trace(pairs, axis1=1, axis2=2) / 2.0 / divisor(omega)
    full = real.inputs[:, 1 : 2 * m : 2]
    rows = [p.row(real) if isinstance(p, SensorPort) else p.push(real) for p in ports]
    stacked = np.array(rows).reshape(len(ports), full.shape[0])
    return Shapes(stacked @ full, omega, zeta, stacked, full, noise_sizes(ports))


def noise_sizes(ports: Sequence[Any]) -> FloatArray:
    """Return the densities (N,) of sensors; 1 of actuators, and of sensors if none has noise."""
    sizes = np.array([p.asd if isinstance(p, SensorPort) else 1.0 for p in ports])
    silent = [port.name for port, size in zip(ports, sizes, strict=True) if not size]
    if 0 < len(silent) < sizes.size:
        raise AssumptionError(
            f"sensors {', '.join(silent[:6])} have no noise (asd 0) beside others that have some: "
            "they would count without limit. Give all of them Sensor(..., asd=), or none."
        )
    return divisor(sizes)


class ByShapes(Criterion):
    """A criterion of mode shapes at the sensors: a new one defines `of`."""

    sides: ClassVar[str] = "y"
    scale: ClassVar[float] = 1.0

    @abstractmethod
    def of(self, plant: StandardPlant, shapes: Shapes) -> Scorer:
        """Return the scores of choices among the ports that the shapes belong to."""

    def __call__(self, plant: StandardPlant) -> float:
        """Return the criterion of the plant's own ports."""
        ports = getattr(plant.assembled.ports, self.sides)
        scorer = self.of(plant, shapes_of(plant, ports))
        return float(scorer.score([tuple(range(len(ports)))])[0])

    def scorer(self, plant: StandardPlant, candidates: Sequence[Any]) -> Scorer:
        """Return the criterion of choices among candidates."""
        return self.of(plant, shapes_of(plant, candidates))


@dataclass(frozen=True, eq=False)
class LargestMac(Scorer):
    """The largest off-diagonal MAC of shapes (N, m) at the chosen rows."""

    phi: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice."""
        return float(self.score([tuple(chosen)])[0])

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return it for choices of one size at once."""
        return by_size(sets, self._largest)

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return 0: no shapes are less alike than orthogonal ones."""
        return 0.0

    def _largest(self, rows: FloatArray) -> FloatArray:
        part = self.phi[rows]
        cross = np.einsum("mki,mkj->mij", part, part)
        sizes = np.einsum("mii->mi", cross)
        scale = sizes[:, :, None] * sizes[:, None, :]
        # a mode that none of the sensors sees is like every other
        mac = np.where(scale > 0, cross**2 / divisor(scale), 1.0)
        i = np.arange(mac.shape[1])
        mac[:, i, i] = 0.0
        return np.asarray(mac.max(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class AutoMac(ByShapes):
    """Largest off-diagonal entry of the MAC between the elastic mode shapes at the sensors.

    ``(phi_i' phi_j)^2 / (phi_i' phi_i phi_j' phi_j)``, 0 where all shapes differ, 1 where two look
    alike. It does not count how large the motions are that the sensors see, and of a POI it says
    next to nothing, as `ModeInformation`.

    References
    ----------
    [Allemang2003]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.AutoMac()).chosen
    ('s1', 's3')
    """

    def of(self, plant: StandardPlant, shapes: Shapes) -> LargestMac:
        """Return the largest entry of choices."""
        return LargestMac(shapes.phi[:, shapes.elastic])


@dataclass(frozen=True, eq=False, repr=False)
class KineticEnergy(ByShapes):
    """Minus the part of the elastic modes' kinetic energy at the sensors.

    ``sum_i sum_k (r_i phi_k) (r_i M phi_k)``, 1 for each mode over all DOFs: places that move much,
    and are heavy. Each place counts by itself, so that neighbours that see the same are both
    chosen. Of a POI it says next to nothing, as `ModeInformation`.

    Parameters
    ----------
    model : FEModel, optional
        Of the mass matrix; not needed where the plant was assembled from matrices or a reduced
        model.

    Raises
    ------
    ModelError
        When the model is no structure; when called, where no mass matrix is known or it is of
        another structure.

    References
    ----------
    [Kammer1991]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> masses = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.KineticEnergy(masses)).chosen
    ('s1', 's3')
    """

    model: Any = field(
        default=None, metadata=checked(instance, kind=FEModel | ReducedModel, hint="Pass one.")
    )

    def of(self, plant: StandardPlant, shapes: Shapes) -> SummedWorth:
        """Return the energy of choices."""
        model = plant.assembled.realisation.model if self.model is None else self.model
        if not isinstance(model, FEModel | ReducedModel):
            raise ModelError(
                "the plant was assembled from modes, which have no mass matrix. Pass "
                "KineticEnergy(model), the FEModel that they are of."
            )
        if model.M.shape[0] != shapes.full.shape[0]:
            raise ModelError(
                f"the model has {model.M.shape[0]} DOFs, the plant's {shapes.full.shape[0]}: pass "
                "the one that the plant's modes are of."
            )
        moving = shapes.phi[:, shapes.elastic] * (
            shapes.rows @ (model.M @ shapes.full[:, shapes.elastic])
        )
        return SummedWorth(np.sum(moving, axis=1))
