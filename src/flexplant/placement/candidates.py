"""Candidates on one plant: their names, their part in the rigid-body modes, their scores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from ..errors import (
    AssumptionError,
    CertificateError,
    FlexplantError,
    LabelError,
    ModelError,
    unknown_label,
)
from ..plant import Actuator, Sensor, StandardPlant, assemble_plant, standard_plant
from ..plant.ports import QUANTITIES
from ..plant.realisation import ModalRealisation
from ..values import FloatArray, Value, short
from .criteria import PoiLqr, PoiVariance, plain
from .quadratic import Quadratic

Port: TypeAlias = "Sensor | Actuator"
Side: TypeAlias = Literal["y", "u"]
Criterion: TypeAlias = "PoiVariance | PoiLqr | Callable[[StandardPlant], float]"

KIND: dict[str, type[Any]] = {"y": Sensor, "u": Actuator}
ASSUMPTION = {"y": "detectable", "u": "stabilisable"}
#: a rigid-body motion weaker than this beside the strongest counts as absent (as in plant.check)
WEAK = 1e-8


@dataclass(frozen=True, eq=False, repr=False)
class Scorer(Value):
    """The score of a choice of candidates; a value, so that it can be sent to other processes.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, assembled from a structure.
    side : {"y", "u"}
        Whether sensors or actuators are chosen.
    candidates : sequence of Sensor or Actuator
        All of them.
    criterion : callable
        Plant to float.
    rigid : (N, r) array
        Part of each candidate in each rigid-body mode, rows of unit size or zero.
    problem : Quadratic, optional
        The criterion in a fast form.
    """

    plant: StandardPlant
    side: Side
    candidates: tuple[Port, ...]
    criterion: Any
    rigid: FloatArray
    problem: Quadratic | None

    def __post_init__(self) -> None:
        self._set(rigid=self.rigid)

    def __call__(self, chosen: Sequence[int]) -> tuple[float, str]:
        """Return the score of some candidates, infinite with the reason when there is none."""
        chosen = sorted(chosen)
        if self.missing(chosen):
            return np.inf, "rigid"
        try:
            if self.problem is not None:
                return self.problem.value(chosen), ""
            value = self.criterion(self.on_plant(chosen))
        except FlexplantError as error:
            return np.inf, str(error)
        return checked(value, self.criterion)

    def missing(self, chosen: Sequence[int]) -> int:
        """Return how many rigid-body modes a choice has no part in: ranks decide."""
        rows = self.rigid[list(chosen)]
        wanted = int(rows.shape[1])
        if not wanted or not np.any(rows):
            return wanted
        sizes = np.linalg.svd(rows, compute_uv=False)
        return wanted - int(np.count_nonzero(sizes > WEAK * sizes[0]))

    def on_plant(self, chosen: Sequence[int]) -> StandardPlant:
        """Return the plant with these sensors or actuators instead of its own."""
        return with_side(self.plant, self.side, [self.candidates[i] for i in chosen])

    def reason(self, chosen: Sequence[int]) -> str:
        """Return which rigid-body motion a choice misses, in words."""
        bare = assemble_plant(self._realisation, self._ports(chosen))
        found = bare.check()[ASSUMPTION[self.side]]
        if found.holds:
            return f"{self.missing(chosen)} rigid-body modes are missed."
        return found.finding

    def refusal(self, chosen: Sequence[int]) -> str:
        """Return the reason and what to change."""
        bare = assemble_plant(self._realisation, self._ports(chosen))
        return f"{self.reason(chosen)} {bare.check()[ASSUMPTION[self.side]].remedy}".strip()

    @property
    def _realisation(self) -> ModalRealisation:
        if self.plant.realisation is None:
            raise ModelError("the plant has no structure.")
        return self.plant.realisation

    def _ports(self, chosen: Sequence[int]) -> Any:
        if self.plant.ports is None:
            raise ModelError("the plant has no ports.")
        return self.plant.ports.replace(**{self.side: [self.candidates[i] for i in chosen]})


class Reasoned:
    """A scorer that also words why a choice is infeasible (for lists that keep the reason)."""

    def __init__(self, scorer: Scorer) -> None:
        self.scorer = scorer

    def __call__(self, chosen: Sequence[int]) -> tuple[float, str]:
        """Return the score and the reason in words."""
        value, reason = self.scorer(chosen)
        return value, self.scorer.reason(chosen) if reason == "rigid" else reason


def scorer_of(
    plant: StandardPlant, side: Side, candidates: Sequence[Port], criterion: Criterion | None
) -> Scorer:
    """Return the scorer of a criterion over candidates, with everything checked at the door.

    Raises
    ------
    ModelError
        When the plant is not a sampled one of a structure, or the criterion is not callable or is
        of the other side.
    AssumptionError
        When the criterion has no meaning on this plant, whatever is chosen.
    LabelError
        When a candidate is off the structure, or a name is used twice.
    """
    checked_plant(plant)
    if criterion is None:
        criterion = PoiVariance() if side == "y" else PoiLqr()
    if not callable(criterion):
        raise ModelError(
            "a criterion is PoiVariance(...), PoiLqr(...) or a callable from plant to float, got "
            f"{short(criterion)}. Pass such a value, or none."
        )
    wanted: type[PoiVariance] | type[PoiLqr] = PoiVariance if side == "y" else PoiLqr
    if isinstance(criterion, PoiVariance | PoiLqr) and not isinstance(criterion, wanted):
        raise ModelError(
            f"{criterion!r} does not depend on {'sensors' if side == 'y' else 'actuators'}: use "
            f"{wanted.__name__}, or any callable from plant to float."
        )
    candidates = tuple(candidates)
    with_side(plant, side, candidates)  # names and places, all at once
    rigid = _rigid(plant, side, candidates)
    scorer = Scorer(plant, side, candidates, criterion, rigid, None)
    everything = range(len(candidates))
    if isinstance(criterion, PoiVariance | PoiLqr):
        criterion.check(plant, candidates)
        # without a single feasible choice there is no fast form to prepare; with filters and delays
        # of single ports every choice has states of its own: the criterion is asked each time
        if not scorer.missing(everything) and plain(plant, candidates):
            return scorer.replace(problem=criterion.prepared(plant, candidates))
    return scorer


def checked_plant(plant: StandardPlant) -> None:
    """Raise ModelError unless the plant is sampled, not weighted, and made of a structure."""
    plant = standard_plant(plant)  # a system with labels is one too, and told what it lacks
    if plant.realisation is None or plant.ports is None:
        raise ModelError(
            "placement asks the structure for rows of candidates, this plant has no structure. "
            "Make it by assemble_plant(model, ports).discretized(rate)."
        )
    if plant.unweighted is not None:
        raise ModelError("placement needs the plant before weights: use plant.unweighted.")
    if not plant.dt:
        raise ModelError(
            "the plant is continuous, scores are of the sampled one: use "
            "plant.discretized(rate, delay=1)."
        )


def with_side(plant: StandardPlant, side: Side, chosen: Sequence[Port]) -> StandardPlant:
    """Return the plant with these sensors or actuators instead of its own."""
    if plant.ports is None:
        raise ModelError("the plant has no ports.")
    return plant.with_ports(plant.ports.replace(**{side: tuple(chosen)}))


def known_candidates(plant: StandardPlant, side: Side, given: Iterable[Any]) -> dict[str, Port]:
    """Return candidates by name; a text stands for the plant's own sensor (actuator).

    Raises
    ------
    LabelError
        When a name is unknown, or two different candidates have the same one.
    ModelError
        When something is no Sensor (Actuator).
    """
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ModelError(
            f"candidates are a list of {KIND[side].__name__}s or names, got {short(given)}. "
            "Put them in a list."
        )
    own: dict[str, Port] = {p.name: p for p in getattr(plant.ports, side)}
    found: dict[str, Port] = {}
    for item in given:
        port = item
        if isinstance(item, str):
            port = found.get(item) or own.get(item)
            if port is None:
                raise unknown_label(KIND[side].__name__.lower(), item, [*own, *found])
        if not isinstance(port, KIND[side]):
            raise ModelError(
                f"candidates are {KIND[side].__name__}s or names of the plant's, got "
                f"{short(port)}. Pass {KIND[side].__name__}(name, at=...)."
            )
        other = found.setdefault(port.name, port)
        if other is not port and other._fields() != port._fields():
            raise LabelError(
                f"two different candidates are called {port.name!r}: scores are kept by name. "
                "Rename one."
            )
    return found


def checked(value: Any, criterion: Any) -> tuple[float, str]:
    """Return what a criterion gave as a float.

    Raises
    ------
    ModelError
        When it is no number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ModelError(
            f"the criterion {criterion!r} must return a float, got {type(value).__name__}."
        ) from error
    if np.isnan(number):
        raise ModelError(f"the criterion {criterion!r} returned NaN: it cannot be compared.")
    return number, "" if np.isfinite(number) else "the criterion is infinite."


def confirmed(scorer: Scorer, chosen: Sequence[int], value: float) -> None:
    """Raise CertificateError unless the criterion itself, on the plant, gives the fast value."""
    if scorer.problem is None or not np.isfinite(value):
        return
    direct = float(scorer.criterion(scorer.on_plant(sorted(chosen))))
    if not abs(direct - value) <= 1e-6 * abs(direct):
        raise CertificateError(
            f"the fast score {value:.9g} of the best choice differs from {scorer.criterion!r} on "
            f"its plant, {direct:.9g}. No score can be trusted: the problem is too badly "
            "conditioned."
        )


def _rigid(plant: StandardPlant, side: Side, candidates: Sequence[Port]) -> FloatArray:
    """Return unit rows (N, r): a sensor sees positions, an actuator moves velocities."""
    realisation = plant.realisation
    if realisation is None:
        raise ModelError("the plant has no structure.")
    rows = np.zeros((len(candidates), realisation.n_rigid))
    for i, port in enumerate(candidates):
        row = realisation.row(port.at, port.direction)
        if isinstance(port, Sensor):
            motion = realisation.motion(row, QUANTITIES.index(port.quantity))
            rows[i] = motion[0 : 2 * realisation.n_rigid : 2]
        else:
            rows[i] = realisation.force(row)[1 : 2 * realisation.n_rigid : 2]
    sizes = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(sizes > 0, sizes, 1.0))


def require_any(scorer: Scorer) -> None:
    """Raise AssumptionError when even all candidates together miss a rigid-body mode."""
    everything = range(len(scorer.candidates))
    if scorer.missing(everything):
        raise AssumptionError(
            f"no choice of these candidates will do: {scorer.refusal(everything)}"
        )
