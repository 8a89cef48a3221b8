"""Criteria of mode shapes where candidates are: Gramians of the elastic modes, indices."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..checks import FloatArray, checked, instance, one_of
from ..errors import AssumptionError, ModelError
from ..plant import SensorPort, StandardPlant
from ..plant.realisation import ModalRealisation
from ..reduction import ReducedModel
from ..structure import FEModel
from ..tolerances import divisor
from .candidates import Port
from .convex import MEASURES, SummedWorth, by_size, sum_scorer
from .criterion import Criterion, Scorer


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

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
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
                "placement.KineticEnergy(model), the FEModel that they are of."
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


@dataclass(frozen=True, eq=False)
class ModalGramian(Criterion):
    """Minus a measure of a Gramian of the elastic modes; the base of one for each side.

    In continuous time, in states whose square is twice the energy of a mode, every entry of
    ``W_ij = -conj(c_i) c_j / (conj(lambda_i) + lambda_j)`` for the eigenvectors: modes of one
    frequency that are alike count as one, which the diagonal alone takes for two. Rigid-body modes,
    whose Gramian is infinite, are left out; filters and delays do not count. It is the sum of the
    Gramians of single devices. Of a POI it says next to nothing, as `ModeInformation`.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Sum of the eigenvalues, sum of their logarithms, or the least one.
    """

    scale: ClassVar[float] = 1.0
    measure: str = field(default="log det", metadata=checked(one_of, choices=MEASURES))

    def __call__(self, plant: StandardPlant) -> float:
        """Return minus the measure: infinite where a mode is missed, for log det."""
        return float(sum_scorer(self.matrix(plant)[None], self.measure).score([(0,)])[0])

    def matrix(self, plant: StandardPlant) -> FloatArray:
        """Return the Gramian (2 m, 2 m) of the m elastic modes."""
        ports = getattr(plant.assembled.ports, self.sides)
        return np.asarray(self._each(plant.assembled.realisation, ports).sum(axis=0))

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the measure of sums of the candidates' Gramians."""
        return sum_scorer(self._each(plant.assembled.realisation, candidates), self.measure)

    def _each(self, real: ModalRealisation, ports: Sequence[Any]) -> FloatArray:
        """Return the Gramians (N, 2 m, 2 m) of single ports."""
        start = 2 * real.n_rigid
        A = real.A[start:, start:]
        rows = np.array([self._row(real, port) for port in ports])[:, start:]
        rows = rows / noise_sizes(ports)[:, None]
        if not A.size:
            raise ModelError("the plant has no elastic mode, so no Gramian. Keep some modes.")
        poles, modes = np.linalg.eig(A.T if self.sides == "u" else A)
        part = rows @ modes
        sums = poles.conj()[:, None] + poles
        W = -(part.conj()[:, :, None] * part[:, None, :]) / sums
        back = np.linalg.inv(modes)
        found = (back.conj().T @ W @ back).real
        return np.asarray(0.5 * (found + found.transpose(0, 2, 1)))

    @abstractmethod
    def _row(self, real: ModalRealisation, port: Any) -> FloatArray: ...


@dataclass(frozen=True, eq=False)
class ModalObservability(ModalGramian):
    """Minus a measure of the observability Gramian of the elastic modes, which sensors see.

    See `ModalGramian`. One row per sensor, in units of its noise where it has any.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Sum of the eigenvalues, sum of their logarithms, or the least one.

    References
    ----------
    [Gawronski2004]_, chapter 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.ModalObservability()).chosen
    ('s1', 's3')
    """

    sides: ClassVar[str] = "y"

    def _row(self, real: ModalRealisation, port: Any) -> FloatArray:
        return np.asarray(port.see(real).row)


@dataclass(frozen=True, eq=False)
class ModalControllability(ModalGramian):
    """Minus a measure of the controllability Gramian of the elastic modes, which actuators move.

    See `ModalGramian`. One row per actuator: what a newton (newton metre) of it does.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Sum of the eigenvalues, sum of their logarithms, or the least one.

    References
    ----------
    [Gawronski2004]_, chapter 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> fx.place_actuators(plant, candidates, 1, fx.placement.ModalControllability()).side
    'u'
    """

    sides: ClassVar[str] = "u"

    def _row(self, real: ModalRealisation, port: Any) -> FloatArray:
        return real.force(port.push(real))


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

    norm: str = field(default="h2", metadata=checked(one_of, choices=("h2", "hinf", "hankel")))

    def of(self, plant: StandardPlant, shapes: Shapes) -> SummedWorth:
        """Return the indices of choices."""
        kept = shapes.elastic
        # in sqrt(Hz) / pm, so that the indices are numbers of usual size
        unit = 1e-12 / shapes.asd if self.sides == "y" else shapes.asd
        seen = shapes.phi[:, kept] * unit[:, None]
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

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> fx.place_actuators(plant, candidates, 1, fx.placement.ActuatorIndices()).side
    'u'
    """

    sides: ClassVar[str] = "u"
