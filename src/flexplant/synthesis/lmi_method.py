"""What both methods by linear matrix inequalities share: settings, and the way to a controller."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import FlexplantError, InfeasibleError, ModelError, SolverError
from ..lti.preparation import Prepared
from ..values import positive, whole
from .lmi_solution import Matrices, verified
from .method import SolvedController

#: multiples of the back-off that are tried in turn
LOOSER = np.array([1.0, 2.0, 4.0, 8.0])
#: gamma, relative to the plant's size, that is taken for zero
NOTHING = 1e-7
#: failures that a message lists
_LISTED = 4


class Candidate(NamedTuple):
    """A controller that may keep a target: its name in messages, and how it is computed."""

    name: str
    target: float
    compute: Callable[[], Matrices]


def checked_settings(method: Any) -> dict[str, Any]:
    """Return the settings of a method, each checked."""
    return {
        "back_off": positive(method.back_off, "back_off"),
        "tolerance": positive(method.tolerance, "tolerance"),
        "max_states": whole(method.max_states, "max_states"),
    }


def check_size(method: Any, problem: Prepared) -> None:
    """Raise ModelError when a problem has no states, or more than a method's max_states."""
    n, name = problem.A.shape[0], type(method).__name__
    if not n:
        raise ModelError(f"{name} needs states, got a static plant. Use Riccati().")
    if n > method.max_states:
        raise ModelError(
            f"{name} takes plants of 1 to {method.max_states} states, got {n}: time grows as n^6. "
            f"Reduce the order first, use Riccati(), or raise {name}(max_states=...)."
        )


def check_cost(gamma: float, size: float) -> None:
    """Raise InfeasibleError when gamma is nothing beside the size of the plant."""
    if gamma < NOTHING * size:
        raise InfeasibleError(
            f"there is no smallest gamma: the infimum is 0. {gamma:.3g} is reached, where the "
            f"plant's own size is {size:.3g}. u cancels w in z, at no cost. Weight the efforts in "
            "z, or give the sensors noise in w."
        )


def first_verified(
    problem: Prepared,
    gamma: float,
    lower: float,
    candidates: Iterable[Candidate],
) -> SolvedController:
    """Return the first candidate whose closed loop keeps its target."""
    failures = []
    for name, target, compute in candidates:
        try:
            K = compute()
            norm = verified(problem, K, target)
        except (FlexplantError, la.LinAlgError) as error:
            failures.append(f"{name}: {error}")
            continue
        return SolvedController(*K, norm, min(lower, norm), {})
    raise SolverError(
        f"the LMIs give gamma = {gamma:.6g} as smallest, but no controller. "
        + " ".join(failures[-_LISTED:])
        + " Loosen weights, raise back_off, or use Riccati(), which adds a little noise and effort "
        "where sensors and actuators have none."
    )
