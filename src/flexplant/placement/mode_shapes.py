"""Criteria of mode shapes where candidates are, and choices from their rows without trials."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..arrays import FloatArray, divisor, flag, instance
from ..errors import InfeasibleError, ModelError
from ..plant import SensorPort, StandardPlant
from ..reduction import EffectiveIndependence
from ..reduction.methods import SelectionCriterion
from ..store import checked
from ..work import Work
from .candidates import Port
from .criterion import Criterion, Scorer
from .gramian import LogDetOfSum, noise_sizes
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
        """The elastic modes."""
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
class ModeRows(LogDetOfSum):
    """Minus log det of the information, and the rows that it is made of."""

    rows: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    driving_point: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class ModeInformation(ByShapes):
    """Minus log det F, with the Fisher information F of mode amplitudes.

    The Fisher information is ``F = sum_i phi_i phi_i' / asd_i^2``.

    phi_i is the row of mode shapes at sensor i, and asd_i is the noise density of this sensor. The
    criterion finds choices that distinguish the mode shapes best. It assumes that the amplitudes of
    the modes are estimated from one sample of all sensors, and ignores dynamics and disturbances.
    The number of sensors must be at least the number of modes. `RowSelection` is a search for this
    criterion, by effective independence or pivoted QR. Searches have a lower bound of the
    criterion.

    The criterion is a poor measure of the accuracy at a POI (point of interest). In trials on
    plates, layouts were ranked by this criterion, by Gramians and by other classical criteria, and
    also by the exact variance at the POI. The Spearman rank correlation of the two rankings was
    between -0.45 and 0.56. If the motion at the POI matters, use `PoiVariance`.

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
        """Return the object that scores choices by their Fisher information."""
        kept = shapes.elastic if self.elastic else slice(None)
        # units in which the best of the sensors has noise 1: constants do not decide
        rows = shapes.phi[:, kept] * (1e-12 / shapes.asd)[:, None]
        bending = shapes.elastic
        point = np.sum((shapes.phi[:, bending] / shapes.omega[bending]) ** 2, axis=1)
        return ModeRows(rows[:, :, None] * rows[:, None, :], rows, point)


@dataclass(frozen=True, eq=False)
class RowSelection(Search):
    """Selection of rows of mode shapes, as in `select_dofs`, for the criterion `ModeInformation`.

    Parameters
    ----------
    method : SelectionCriterion
        Method of the selection. `EffectiveIndependence` (the default) starts with all candidates
        and repeatedly removes the candidate i with the smallest ``E_i = phi_i' F^-1 phi_i``. Here
        phi_i is the row of candidate i, and ``F = sum phi_i phi_i'`` is the information on the
        modes. Removing a candidate multiplies the determinant of F by ``1 - E_i``. `PivotedQr` and
        `Greedy` add one candidate after the other. After as many candidates as there are modes,
        these two methods begin a new round: they ignore the chosen candidates and select again
        among the others.
    driving_point : bool
        Whether E_i is multiplied by the driving-point residue ``sum_j phi_ij^2 / omega_j^2`` over
        the modes j (EfI-DPR). Places that move little are then removed first.

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
        """Return the choice with a lower bound by relaxation, without random numbers."""
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
