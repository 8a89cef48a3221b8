"""Criteria of mode shapes where candidates are, and choices from their rows without trials."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import InfeasibleError, ModelError
from ..plant import SensorPort, StandardPlant
from ..reduction import EffectiveIndependence, ReducedModel
from ..reduction.criteria import SelectionCriterion
from ..store import checked
from ..structure import FEModel
from ..tolerances import divisor
from ..words import flag, instance, one_of
from ..work import Work
from .candidates import Port
from .criterion import Criterion, Scorer, by_size
from .gramian import LogDetOfSum, SummedWorth, noise_sizes
from .problem import Problem, Search, SearchResult


@dataclass(frozen=True, eq=False)
class PlacedShapes:
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


def shapes_of(plant: StandardPlant, ports: Sequence[Any]) -> PlacedShapes:
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
    return PlacedShapes(stacked @ full, omega, zeta, stacked, full, noise_sizes(ports))


class ByShapes(Criterion):
    """A criterion of mode shapes at the sensors: a new one defines `of`."""

    sides: ClassVar[str] = "y"
    scale: ClassVar[float] = 1.0

    @abstractmethod
    def of(self, plant: StandardPlant, shapes: PlacedShapes) -> Scorer:
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

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return it for choices of one size at once."""
        return by_size(sets, self._largest)

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return 0: no shapes are less alike than orthogonal ones."""
        return 0.0

    def _largest(self, rows: IntArray) -> FloatArray:
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
    >>> round(fx.placement.AutoMac()(fx.testbeds.three_masses()), 6)
    0.0
    """

    def of(self, plant: StandardPlant, shapes: PlacedShapes) -> LargestMac:
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
    >>> masses = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> round(fx.placement.KineticEnergy(masses)(fx.testbeds.three_masses()), 6)  # of two modes
    -1.333333
    """

    model: Any = field(
        default=None, metadata=checked(instance, kind=FEModel | ReducedModel, hint="Pass one.")
    )

    def of(self, plant: StandardPlant, shapes: PlacedShapes) -> SummedWorth:
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
        momentum = shapes.rows @ (model.M @ shapes.full[:, shapes.elastic])
        return SummedWorth(np.sum(shapes.phi[:, shapes.elastic] * momentum, axis=1))


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
    >>> round(fx.placement.SensorIndices()(fx.testbeds.three_masses()), 9)
    -3.3333e-05
    """

    norm: str = field(default="h2", metadata=checked(one_of, choices=("h2", "hinf", "hankel")))

    def of(self, plant: StandardPlant, shapes: PlacedShapes) -> SummedWorth:
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
    norm : as for `SensorIndices`

    Examples
    --------
    >>> import flexplant as fx
    >>> round(fx.placement.ActuatorIndices()(fx.testbeds.three_masses()), 3)
    -0.167
    """

    sides: ClassVar[str] = "u"


@dataclass(frozen=True, eq=False)
class ModeRows(LogDetOfSum):
    """Minus log det of the information, and the rows that it is made of."""

    rows: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    driving_point: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class ModeInformation(ByShapes):
    """Minus log det of the Fisher information of mode amplitudes, ``sum_i phi_i phi_i' / asd_i^2``.

    One snapshot of the sensors, no dynamics, no disturbances: choices that distinguish the shapes
    best. `RowSelection` searches for it by effective independence or pivoted QR, and it has a
    bound. With fewer sensors than modes there is no information on all of them. It says next to
    nothing of a POI: rankings of layouts by classical criteria (this one, Gramians, indices,
    energy, MAC) had a Spearman correlation of -0.45 to 0.56 with that by the exact variance, on
    plates. Where the POI matters, use
    `PoiVariance`.

    Parameters
    ----------
    elastic : bool
        Whether rigid-body modes are left out.

    References
    ----------
    [Kammer1991]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(fx.placement.ModeInformation(elastic=True)(fx.testbeds.three_masses()), 3)
    19.519
    """

    sides: ClassVar[str] = "y"
    elastic: bool = field(default=False, metadata=checked(flag))

    def of(self, plant: StandardPlant, shapes: PlacedShapes) -> ModeRows:
        """Return the information of choices."""
        kept = shapes.elastic if self.elastic else slice(None)
        # units in which the best of the sensors has noise 1: constants do not decide
        rows = shapes.phi[:, kept] * (1e-12 / shapes.asd)[:, None]
        bending = shapes.elastic
        point = np.sum((shapes.phi[:, bending] / shapes.omega[bending]) ** 2, axis=1)
        return ModeRows(rows[:, :, None] * rows[:, None, :], rows, point)


@dataclass(frozen=True, eq=False)
class RowSelection(Search):
    """Selection of rows of mode shapes by the methods of `select_dofs`, for `ModeInformation`.

    Parameters
    ----------
    method : SelectionCriterion
        EffectiveIndependence (when not given) leaves out the candidate of least
        ``E_i = phi_i' F^-1 phi_i`` again and again, with the information ``F = sum phi_i phi_i'``:
        without it the determinant of F is ``1 - E_i`` times as large. PivotedQr and Greedy take
        one after the other; when all modes are covered, they begin anew among the rest.
    driving_point : bool
        Whether E_i is weighted by the driving-point residue ``sum_j phi_ij^2 / omega_j^2``, so
        that places that move little are left out first (EfI-DPR).

    References
    ----------
    [Kammer1991]_; [Imamovic1998]_; [Manohar2018]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> goal = fx.placement.ModeInformation(elastic=True)
    >>> fx.place_sensors(plant, ["y1", "y2"], 2, goal, method=fx.placement.RowSelection()).chosen
    ('y1', 'y2')
    """

    method: SelectionCriterion = field(
        default_factory=EffectiveIndependence,
        metadata=checked(instance, kind=SelectionCriterion, hint="Pass EffectiveIndependence()."),
    )
    driving_point: bool = field(default=False, kw_only=True, metadata=checked(flag))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driving_point and not isinstance(self.method, EffectiveIndependence):
            raise ModelError(
                "driving_point weights reduction.EffectiveIndependence(): leave one out."
            )

    def search(self, problem: Problem, work: Work) -> SearchResult:
        """Return the choice, bounded by relaxation; see `Search.search`. Nothing is random."""
        scorer = problem.layouts.scorer
        if not isinstance(scorer, ModeRows):
            raise ModelError(
                f"{self!r} chooses by rows of mode shapes, {problem.layouts.criterion!r} has none. "
                "Pass criterion=placement.ModeInformation(), or search by placement.Exchange()."
            )
        kept, pool = list(problem.required), list(problem.free)
        if self.driving_point:
            kept = _by_driving_point(scorer, kept, pool, problem.count)
        while len(kept) < problem.count:
            more = problem.count - len(kept)
            taken = scorer.rows[kept]
            if not isinstance(self.method, EffectiveIndependence):
                round_size = scorer.rows.shape[1]
                more = min(more, round_size - len(kept) % round_size)
                taken = taken[len(kept) - len(kept) % round_size :]
            picked = self.method.chosen(taken, scorer.rows[pool], more)
            kept += [pool[i] for i in picked]
            pool = [i for i in pool if i not in kept]
        found = tuple(sorted(kept))
        if not problem.rows.hold([found])[0]:
            raise InfeasibleError(
                f"the choice by {self!r} does not satisfy the constraints: it only leaves out "
                "candidates one by one. Use placement.Exchange(), which satisfies all of them."
            )
        value = float(problem.score([found])[0])
        return SearchResult(found, value, min(problem.bound(), value), 1, ((value,),))


def _by_driving_point(
    scorer: ModeRows, required: list[int], pool: list[int], count: int
) -> list[int]:
    """Return what is left when as many as needed have been left out, the least weighted first."""
    left = [*required, *pool]
    while len(left) > count:
        worth = EffectiveIndependence().values(scorer.rows[left]) * scorer.driving_point[left]
        worth[: len(required)] = np.inf
        del left[int(np.argmin(worth))]
    return left
