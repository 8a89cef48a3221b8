"""The problem that users pose: candidates of one kind or both, counts, and constraints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import InfeasibleError, LabelError, ModelError, require_known
from ..plant import StandardPlant
from ..values import name_list, whole
from .candidate_places import places_of
from .candidates import Port, known_candidates, side_of
from .constraint import Constraint
from .layouts import layouts_of
from .problem import Problem
from .rows import LinearRows
from .separation import Separation
from .zones import rows_of


def problem_of(
    plant: StandardPlant,
    wanted: Mapping[str, tuple[Sequence[Any], int]],
    criterion: Any,
    required: Sequence[str],
    constraints: Sequence[Constraint],
) -> Problem:
    """Return the problem of choosing so many candidates of each side, with everything checked."""
    listed = {side: _listed(plant, side, given) for side, (given, _) in wanted.items()}
    ports = tuple(port for part in listed.values() for port in part)
    names = [port.name for port in ports]
    if len(set(names)) < len(names):
        raise LabelError("a sensor and an actuator have the same name: rename one.")
    kept = _required(names, required)
    counts = {
        side: whole(count, "count", maximum=max(len(listed[side]), 1))
        for side, (_, count) in wanted.items()
    }
    _check_counts(counts, [ports[i] for i in kept])
    side: Any = "".join(wanted)
    layouts = layouts_of(plant, side, ports, criterion)
    layouts.require_any()
    rows = rows_of(constraints, places_of(plant, ports), side)
    if len(wanted) > 1:
        rows = rows.and_(_shares(ports, counts))
        if isinstance(layouts.scorer, Separation):
            numbers = (counts["y"], counts["u"])
            layouts = replace(layouts, scorer=replace(layouts.scorer, counts=numbers))
    problem = Problem(layouts, sum(counts.values()), rows.with_partners(kept), rows)
    _require_start(problem, constraints, [names[i] for i in kept])
    return problem


def _listed(plant: StandardPlant, side: str, given: Sequence[Any]) -> tuple[Port, ...]:
    ports = tuple(known_candidates(plant, side, given).values())
    if not ports:
        raise ModelError("there are no candidates: pass a list of at least one to choose from.")
    if len(ports) != len(tuple(given)):
        raise LabelError("a candidate is listed twice: each may be chosen once.")
    return ports


def _check_counts(counts: Mapping[str, int], kept: Sequence[Port]) -> None:
    for side, count in counts.items():
        needed = sum(side_of(port) == side for port in kept)
        if needed > count:
            raise ModelError(f"count is {count}, and {needed} candidates are required.")


def _shares(ports: Sequence[Port], counts: Mapping[str, int]) -> LinearRows:
    """Return the rows by which so many of each side are chosen."""
    A = np.array([[side_of(port) == side for port in ports] for side in counts], dtype=np.float64)
    exact = np.array(list(counts.values()), dtype=np.float64)
    return LinearRows(A, exact, exact)


def _require_start(
    problem: Problem, constraints: Sequence[Constraint], required: Sequence[str]
) -> None:
    """Raise InfeasibleError when there is no choice to begin with."""
    layouts = problem.layouts
    first = problem.start(None) if len(problem.required) <= problem.count else ()
    what = f"no choice of {problem.count} of the {problem.total} candidates"
    if not first and problem.rows.A.size:
        given = ", ".join(map(repr, constraints)) or "OffPoi()"
        together = f" together with the required {', '.join(required)}" if required else ""
        raise InfeasibleError(
            f"{what} satisfies the constraints {given:.300}{together:.200}. Relax a constraint, "
            "require others, or give more candidates."
        )
    if layouts.missing(first):
        raise InfeasibleError(
            f"{what} will do; of the nearest one: {layouts.reason(first)} Choose more, or require "
            "others."
        )


def _required(names: Sequence[str], required: Sequence[str]) -> tuple[int, ...]:
    listed = name_list(required, "required candidates")
    require_known("required candidate", listed, names)
    return tuple(sorted({names.index(name) for name in listed}))
