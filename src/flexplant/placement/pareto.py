"""What one more device buys: the best value for each count or budget, with its bound."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, Rng, Value, positive, short
from ..errors import InfeasibleError, ModelError
from ..plant import Actuator, StandardPlant
from .candidates import checked_plant
from .criterion import Criterion, in_words
from .groups import Budget, Constraint
from .placement import Placement
from .problem import Search
from .search import place_actuators, place_sensors


@dataclass(frozen=True, eq=False, repr=False)
class ParetoCurve(Value):
    """The best choice for each count, or for each budget; prints as a table.

    Parameters
    ----------
    amounts : (n,) array
        Counts or budgets, ascending.
    placements : sequence of Placement
        The best that was found for each.
    bounds : (n,) array
        No choice of that count (within that budget) is better.
    by_cost : bool
        Whether amounts are budgets.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> curve = fx.placement.pareto_curve(plant, candidates, [1, 2])
    >>> [placement.chosen for placement in curve.placements]
    [('s1',), ('s1', 's3')]
    """

    amounts: FloatArray
    placements: Sequence[Placement]
    bounds: FloatArray
    by_cost: bool = False

    def __repr__(self) -> str:
        what = "cost" if self.by_cost else "count"
        lines = [f"<ParetoCurve by {what}, {self.placements[0].criterion}>"]
        for amount, best, bound in zip(
            self.amounts[:6], self.placements[:6], self.bounds[:6], strict=True
        ):
            low = f", none below {in_words(bound, self.unit)}" if np.isfinite(bound) else ""
            lines.append(
                f"  {amount:<6g} {in_words(best.value, self.unit)}{low}: "
                f"{' '.join(best.chosen):.60}"
            )
        if len(self.placements) > 6:
            lines.append(f"  and {len(self.placements) - 6} more")
        return "\n".join(lines)

    @property
    def values(self) -> FloatArray:
        """The criterion (n,) of each."""
        return np.array([one.value for one in self.placements])

    @property
    def unit(self) -> str:
        """Unit of the root of a value, where it is a mean square of a motion."""
        return self.placements[0].unit


def pareto_curve(
    plant: StandardPlant,
    candidates: Sequence[Any],
    amounts: Sequence[float],
    criterion: Criterion | Callable[[StandardPlant], float] | None = None,
    *,
    costs: Mapping[str, float] | None = None,
    required: Sequence[str] = (),
    constraints: Sequence[Constraint] = (),
    method: Search | None = None,
    executor: Executor | None = None,
    progress: bool | None = None,
    rng: Rng = None,
) -> ParetoCurve:
    """Return the best choice for each of several counts, or of several budgets.

    Parameters
    ----------
    plant : StandardPlant
        Sampled.
    candidates : sequence of Sensor or of Actuator
        As for `place_sensors` or `place_actuators`.
    amounts : sequence of int or float
        Counts; budgets where there are costs. Those without any possible choice are left out.
    criterion : Criterion or callable, optional
        As for `place_sensors` or `place_actuators`.
    costs : mapping {str: float}, optional
        Cost of candidates by name, 1 of others: for each budget every count that fits is tried.
    required, constraints, method, executor, progress, rng : optional
        As for `place_sensors` or `place_actuators`.

    Returns
    -------
    ParetoCurve
        `fx.plot.pareto_curve` draws it.

    Raises
    ------
    ModelError, LabelError, AssumptionError, CertificateError
        As `place_sensors`.
    InfeasibleError
        When there is no choice for any amount.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> curve = fx.placement.pareto_curve(plant, candidates, [1, 2])
    >>> bool(curve.values[1] < curve.values[0])
    True
    """
    plant = checked_plant(plant)
    if not isinstance(amounts, Sequence | np.ndarray | range) or isinstance(amounts, str):
        raise ModelError(f"amounts are counts or budgets, got {short(amounts)}. Type range(3, 8).")
    given = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
    listed = isinstance(candidates, Sequence)
    pushing = listed and any(isinstance(c, Actuator) or c in plant.u for c in candidates)
    place = place_actuators if pushing else place_sensors

    def best(count: int, extra: tuple[Constraint, ...]) -> Placement | None:
        try:
            return place(
                plant, candidates, count, criterion, required=required, executor=executor,
                constraints=(*given, *extra), method=method, progress=progress, rng=rng,
            )  # fmt: skip
        except InfeasibleError:
            return None

    rows: list[tuple[float, Placement, float]] = []
    for amount in sorted(amounts):
        if costs is None:
            number = isinstance(amount, int | np.integer)  # others are refused by the search
            enough = not (number and listed and candidates) or amount <= len(candidates)
            tried = [best(amount, ())] if enough else []  # type: ignore[arg-type]
        else:
            limit = Budget(positive(amount, "a budget"), dict(costs))
            names = [c if isinstance(c, str) else c.name for c in candidates]
            prices = np.cumsum(sorted(limit.costs.get(name, limit.default) for name in names))
            most = int(np.searchsorted(prices, limit.total, side="right"))
            tried = [best(count, (limit,)) for count in range(max(len(required), 1), most + 1)]
        found = [one for one in tried if one is not None]
        if found:
            low = min(one.bound for one in found)
            rows.append((float(amount), min(found, key=lambda one: one.value), low))
    if not rows:
        raise InfeasibleError(
            f"there is no choice for any of the amounts {short(list(amounts))}. Give larger ones, "
            "or relax a constraint."
        )
    return ParetoCurve(
        np.array([row[0] for row in rows]),
        tuple(row[1] for row in rows),
        np.array([row[2] for row in rows]),
        costs is not None,
    )
