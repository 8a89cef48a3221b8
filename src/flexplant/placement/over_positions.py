"""A criterion over the positions of a machine whose ports move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from ..checks import checked, one_of
from ..errors import AssumptionError, LabelError, counted
from ..plant import StandardPlant
from ..plant.scheduling import values_over
from .candidates import Port, side_of, sides_of, with_side
from .criterion import Scorer, Wrapping
from .layouts import RigidPart
from .many import MEASURES, many_scores, over


@dataclass(frozen=True, eq=False, repr=False)
class OverPositions(Wrapping):
    """The worst or the mean of a criterion over the positions of a machine whose ports move.

    Candidates may move as other ports do (`moves`): a head on the frame sees another point of the
    stage at each position. Scores share the modes of the plant and cost one equation for each
    position; a bound is the worst (or the mean) of those at the positions. A choice that misses a
    rigid-body mode at any of them has no score. Constraints on places hold where the plant stands.

    Parameters
    ----------
    criterion : Criterion or callable
        From plant to float.
    points : int or mapping {name: int or array}
        How many values of each position are taken over its range, or which [m or rad]. Between
        them nothing is known: compare with more of them.
    measure : {"worst", "mean"}
        Over the positions.

    Raises
    ------
    AssumptionError
        In a search, when at a position even all candidates miss a rigid-body mode.
    LabelError
        When it is called on a plant without positions, or a name is none of them.
    ModelError
        When the measure is neither; when called, where a value is out of its range.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.placement.OverPositions(fx.PoiVariance("die"), {"x": [-0.1, 0.0, 0.1]})
    OverPositions(PoiVariance('die'), {'x': [-0.1, 0.0, 0.1]}, 'worst')
    """

    points: Any = 5
    measure: str = field(default="worst", kw_only=True, metadata=checked(one_of, choices=MEASURES))

    def __repr__(self) -> str:
        given = dict(self.points) if isinstance(self.points, Mapping) else self.points
        return f"OverPositions({self.criterion!r}, {given!r:.60}, {self.measure!r})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return it on a plant, wherever that stands."""
        values = [self.criterion(there) for there in self._plants(plant)]
        return float(over(self.measure, values))

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Check the criterion at every position, and that the candidates suffice there."""
        for there, ports in self._there(plant, candidates):
            rigid = RigidPart.of(there, sides_of(ports), ports)
            missed = rigid.missing(range(len(ports)))
            if missed:
                raise AssumptionError(
                    f"no choice of these candidates will do: at {there.assembled.ports.standing} "
                    f"even all of them miss {counted(missed, 'rigid-body mode')}. Add others, or "
                    "narrow the positions."
                )
            super().check(there, ports)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the scores by those at each position."""
        inner, side = self.inner, sides_of(candidates)
        parts, rigid = [], []
        for there, ports in self._there(plant, candidates):
            rigid.append(RigidPart.of(there, side, ports))
            parts.append(inner.scorer(there, ports))
        return many_scores(parts, self.measure, rigid)

    def _plants(self, plant: StandardPlant) -> Iterator[StandardPlant]:
        """Yield the plant at each position."""
        positions = plant.assembled.ports.positions
        if not positions:
            raise LabelError(
                "the plant has no positions, over which OverPositions could go: nothing of it "
                "moves. Give ports moves={'x': (-1, 0, 0)} and "
                "Ports(..., positions=[fx.plant.Position('x', range=(-0.1, 0.1))])."
            )
        grid = values_over(positions, self.points)
        for values in product(*grid.values()):
            yield plant.at(**dict(zip(grid, values, strict=True)))

    def _there(
        self, plant: StandardPlant, candidates: Sequence[Port]
    ) -> Iterator[tuple[StandardPlant, list[Port]]]:
        """Yield the plant with all candidates at each position, and where these are there."""
        keys = [(side_of(port), port.name) for port in candidates]
        for there in self._plants(with_side(plant, sides_of(candidates), candidates)):
            ports = there.assembled.ports
            own = {(s, port.name): port for s in "yu" for port in getattr(ports, s)}
            yield there, [own[key] for key in keys]
