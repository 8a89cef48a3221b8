"""Layouts on one plant: their rigid-body modes before any score, and their scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..checks import FloatArray
from ..errors import AssumptionError, CertificateError, counted
from ..plant import Actuator, Assumption, SensorPort, StandardPlant, assemble_plant
from ..tolerances import divisor
from ..work import Work
from .candidates import Port, Side, sampled_plant, side_of, with_side
from .closed_loop_h2 import ClosedLoopH2, PoiLqr
from .criterion import AGREEMENT, Criterion, OnPlant, Scorer, as_criterion
from .poi_variance import PoiVariance

ASSUMPTION = {"y": "detectable", "u": "stabilisable"}
ADVICE = "Fewer candidates, fewer starts or executor=ProcessPoolExecutor() help."
#: choices that are scored at once: always as many, so that rounding does not depend on the executor
_BLOCK = 64


@dataclass(frozen=True, eq=False)
class Layouts:
    """Candidates on a plant, and the scores of choices among them."""

    plant: StandardPlant
    side: Side
    candidates: tuple[Port, ...]
    criterion: Criterion
    rigid: RigidPart
    scorer: Scorer

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, infinite where there is none."""
        ordered = [sorted(chosen) for chosen in sets]
        scored = np.flatnonzero(self.rigid.all_missing(ordered) == 0).tolist() if ordered else []
        values = np.full(len(ordered), np.inf)
        values[scored] = self.scorer.score([ordered[i] for i in scored])
        return values

    def scores(
        self, sets: Sequence[Sequence[int]], work: Work, description: str = "layouts"
    ) -> FloatArray:
        """Return the scores (n,) of many choices, computed on an executor."""
        blocks = [sets[i : i + _BLOCK] for i in range(0, len(sets), _BLOCK)]
        found = work.mapped(
            self.score, blocks, description=description, restored=_floats, advice=ADVICE
        )
        return np.concatenate(found) if found else np.zeros(0)

    def missing(self, chosen: Sequence[int]) -> int:
        """Return how many rigid-body modes a choice has no part in."""
        return self.rigid.missing(chosen)

    def reason(self, chosen: Sequence[int]) -> str:
        """Return in words why a choice has no score; empty when it has one."""
        lost = self.missing(chosen)
        if not lost:
            return self.scorer.outcome(sorted(chosen))[1]
        found = self._finding(chosen)
        return f"It misses {counted(lost, 'rigid-body mode')}." if found.holds else found.finding

    def require_any(self) -> None:
        """Raise AssumptionError when even all candidates together miss a rigid-body mode."""
        everything = range(len(self.candidates))
        if self.missing(everything):
            raise AssumptionError(
                f"no choice of these candidates will do: {self.reason(everything)} "
                f"{self._finding(everything).remedy}".strip()
            )

    def confirm(self, chosen: Sequence[int], value: float) -> None:
        """Raise CertificateError unless the criterion itself, on the plant, gives a fast value."""
        if isinstance(self.scorer, OnPlant) or not np.isfinite(value):
            return
        ports = [self.candidates[i] for i in sorted(chosen)]
        direct = float(self.criterion(with_side(self.plant, self.side, ports)))
        if not abs(direct - value) <= AGREEMENT * max(abs(direct), self.criterion.scale):
            raise CertificateError(
                f"the fast score {value:.9g} of the best choice differs from {self.criterion!r} on "
                f"its plant, {direct:.9g}. No score can be trusted: the problem is too badly "
                "conditioned."
            )

    def _finding(self, chosen: Sequence[int]) -> Assumption:
        own = with_side(self.plant, self.side, [self.candidates[i] for i in chosen]).assembled
        report = assemble_plant(own.realisation, own.ports).check()
        found = [report[ASSUMPTION[part]] for part in self.side]
        return next((item for item in found if not item.holds), found[0])


def _floats(row: Any) -> FloatArray:
    return np.array(row, dtype=np.float64)


def layouts_of(
    plant: StandardPlant, side: Side, candidates: Sequence[Port], criterion: Any
) -> Layouts:
    """Return the layouts of candidates on a plant, with everything checked."""
    plant = sampled_plant(plant)
    if criterion is None:
        criterion = {"y": PoiVariance(), "u": PoiLqr(), "yu": ClosedLoopH2()}[side]
    criterion = as_criterion(criterion, side)
    candidates = tuple(candidates)
    plainly = OnPlant(plant, side, candidates, criterion)
    _ = plainly.whole  # names and places, all at once
    rigid = RigidPart.of(plant, side, candidates)
    layouts = Layouts(plant, side, candidates, criterion, rigid, plainly)
    criterion.check(plant, candidates)
    # without a single feasible choice there is nothing that choices could share
    if layouts.missing(range(len(candidates))):
        return layouts
    return replace(layouts, scorer=criterion.scorer(plainly.whole, candidates))


#: a rigid-body motion weaker than this beside the strongest counts as absent (as in plant.check)
WEAK = 1e-8


@dataclass(frozen=True, eq=False)
class RigidPart:
    """Rows (N, r) of candidates in rigid-body modes, of unit size or zero.

    Sensors see positions and actuators move velocities. Where both are chosen, columns of their
    own keep them apart: as many for the sensors as for the actuators.
    """

    rows: FloatArray

    @classmethod
    def of(cls, plant: StandardPlant, side: str, candidates: Sequence[Port]) -> RigidPart:
        """Return the part of candidates on a plant; of one made elsewhere nothing is known."""
        if not plant.is_assembled:
            return cls(np.zeros((len(candidates), 0)))
        realisation = plant.assembled.realisation
        r = realisation.n_rigid
        parts = np.zeros((len(candidates), len(side), r))
        for part, port in zip(parts, candidates, strict=True):
            own = part[side.index(side_of(port))]
            if isinstance(port, SensorPort):
                own[:] = port.see(realisation).row[0 : 2 * r : 2]
            elif isinstance(port, Actuator):
                own[:] = realisation.force(port.push(realisation))[1 : 2 * r : 2]
        rows = parts.reshape(len(candidates), -1)
        sizes = np.linalg.norm(rows, axis=1, keepdims=True)
        return cls(rows / divisor(sizes))

    def missing(self, chosen: Sequence[int]) -> int:
        """Return how many rigid-body modes a choice has no part in: ranks decide."""
        return int(self.all_missing([chosen])[0])

    def all_missing(self, sets: Sequence[Sequence[int]]) -> npt.NDArray[np.int64]:
        """Return how many rigid-body modes each of some choices (m,) has no part in."""
        wanted = self.rows.shape[1]
        found = np.full(len(sets), wanted)
        if not wanted:
            return found
        sizes = np.fromiter(map(len, sets), dtype=np.int64, count=len(sets))
        for size in np.unique(sizes[sizes > 0]).tolist():
            which = np.flatnonzero(sizes == size)
            parts = self.rows[np.array([list(sets[i]) for i in which.tolist()])]
            values = np.linalg.svd(parts, compute_uv=False)
            strong = (values > WEAK * values[:, :1]) & (values > 0)
            found[which] -= np.count_nonzero(strong, axis=1)
        return found
