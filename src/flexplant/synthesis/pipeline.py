"""The way of every design: pose, prepare, solve, restore, certify, judge on evaluation models."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

from ..errors import AssumptionError, CertificateError, ModelError, SolverError
from ..lti.statespace import StateSpace, System
from ..plant import AnyPlant, GeneralizedPlant, StandardPlant, plant_of
from ..plant.uncertainty.uncertain_plants import UncertainPlant
from .controller import Controller, with_left_out
from .preparation import Prepared, badly_scaled, prepared, require_reach

#: what the channels of each side are
_ROLES = {
    "w": "disturbance or noise",
    "z": "output to be kept small",
    "u": "actuator",
    "y": "sensor",
}


def posed(
    given: AnyPlant | UncertainPlant[Any] | System,
    u: Sequence[str] | None,
    y: Sequence[str] | None,
    what: str,
) -> AnyPlant:
    """Return the plant of a synthesis, with u and y given where it does not name them."""
    if u is None and y is None:
        plant: AnyPlant = plant_of(given)
    elif isinstance(given, StandardPlant | GeneralizedPlant):
        raise ModelError("a plant names its u and y: leave them out.")
    else:
        plant = StandardPlant.from_statespace(given, u=u, y=y)
    for name, role in _ROLES.items():
        if not getattr(plant, name):
            others = ", ".join(f"{len(getattr(plant, one))} {one}" for one in _ROLES if one != name)
            raise AssumptionError(
                f"{what} needs channels w, z, u and y, got a plant without {name} "
                f"({others}). Add a channel {name} ({role})."
            )
    if plant.modal_blocks.size:  # it can name the rigid-body motion that is missed
        plant.check().require(("stabilisable", "detectable"), what)
    return plant


class Solution(NamedTuple):
    """A controller that is not verified yet, with its plant, its problem and what was found."""

    plant: Any
    problem: Any
    K: StateSpace
    found: Any


class Design(ABC):
    """A method, with the steps in which it differs from the others: all else is `designed`.

    The steps that are written here are those of one plant ``[w; u] -> [z; y]``, as `posed`.
    """

    #: name of the controller, and what of its kind may hide a mode from u or y
    name: ClassVar[str] = "controller"
    hidden: ClassVar[str] = ""

    def prepare(self, plant: Any) -> Any:
        """Return the scaled problem."""
        return prepared(plant.system, plant.u, plant.y)

    @abstractmethod
    def solve(self, problem: Any) -> Any:
        """Return what the method finds for the problem, or raise."""

    def restore(self, plant: Any, problem: Any, found: Any) -> StateSpace:
        """Return the controller of the plant as given."""
        K: StateSpace = problem.restored(found.A, found.B, found.C, found.D)
        return K.replace(name=self.name, units=plant.units)

    @abstractmethod
    def certify(self, solution: Solution) -> Controller:
        """Return the answer, verified on the plant as given by another route."""


def designed(design: Design, plant: Any, judged: AnyPlant | None) -> Controller:
    """Return the verified controller of a posed plant, judged on the evaluation model of one."""
    answer = verified(design, solved(design, plant))
    return answer if judged is None else with_left_out(answer, judged)


def solved(design: Design, plant: Any) -> Solution:
    """Return the controller of a posed plant, not verified yet."""
    problem = design.prepare(plant)
    with _blaming(problem):
        if isinstance(problem, Prepared) and not problem.direct:
            require_reach(problem, design.hidden)
        found = design.solve(problem)
        return Solution(plant, problem, design.restore(plant, problem, found), found)


def verified(design: Design, solution: Solution) -> Controller:
    """Return the answer with what was verified of a solution."""
    with _blaming(solution.problem):
        return design.certify(solution)


@contextmanager
def _blaming(problem: Any) -> Iterator[None]:
    """Name badly scaled states as the cause of an error, where they are."""
    try:
        yield
    except (AssumptionError, SolverError, CertificateError) as error:
        cause = badly_scaled(problem) if isinstance(problem, Prepared) else ""
        if not cause:
            raise
        raise SolverError(f"{cause} (What was found in these: {error})") from error
