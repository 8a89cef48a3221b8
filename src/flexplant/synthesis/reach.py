"""Whether any controller can stabilise: u reaches, and y sees, each mode that is not stable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import AssumptionError, ModelError
from ..lti.preparation import Prepared
from ..lti.statespace import System
from ..plant import StandardPlant, standard_plant
from ..plant.uncertainty.uncertain_plant import UncertainPlant
from ..tolerances import TINY

#: relative: poles so small are zero, real parts above this are not stable
_ZERO, _STABLE = 1e-6, -1e-10
#: relative: a singular value of Hautus' matrix that is zero
_MISSED = 1e-12
#: |z| of poles that are delays; e-folds of a mode during them that leave nothing to be gained
_NILPOTENT, _TOO_LONG = 0.5, 15.0


#: what the channels of each side are
_ROLES = {
    "w": "disturbance or noise",
    "z": "output to be kept small",
    "u": "actuator",
    "y": "sensor",
}


def posed(
    given: StandardPlant | UncertainPlant[Any] | System,
    u: Sequence[str] | None,
    y: Sequence[str] | None,
    what: str,
) -> StandardPlant:
    """Return the plant of a synthesis: u and y named where it has no names of its own."""
    if u is None and y is None:
        plant = standard_plant(given)
    elif isinstance(given, StandardPlant):
        raise ModelError("a StandardPlant names its u and y: leave them out.")
    else:
        plant = StandardPlant.from_statespace(given, u=u, y=y)
    for name, role in _ROLES.items():
        if not getattr(plant, name):
            others = ", ".join(f"{len(getattr(plant, one))} {one}" for one in _ROLES if one != name)
            raise AssumptionError(
                f"{what} needs channels w, z, u and y, got a plant without {name} "
                f"({others}). Add a channel {name} ({role})."
            )
    _require_body(plant, what)
    return plant


def _require_body(plant: StandardPlant, what: str) -> None:
    if plant.is_assembled:  # it can name the rigid-body motion that is missed
        plant.check().require(("stabilisable", "detectable"), what)


def require_stabilisable(plant: StandardPlant, problem: Prepared, what: str) -> None:
    """Raise AssumptionError, naming mode and channels, when no controller stabilises a plant."""
    _require_body(plant, what)
    require_reach(problem)


def require_reach(problem: Prepared) -> None:
    """Raise AssumptionError when u does not reach, or y does not see, a pole that is not stable."""
    # weights included; Hautus' rank test in the prepared coordinates, whatever the user's units
    A = problem.A
    poles = np.linalg.eigvals(A)
    size = max(float(np.linalg.norm(A, 2)) if A.size else 0.0, TINY)
    # the poles of a chain of integrators come out of rounding as a ring around zero
    poles = np.where(np.abs(poles) < _ZERO * size, 0.0, poles)
    for pole in poles[poles.real > _STABLE * size]:
        for matrix, gain, text in (
            (A, problem.B2, f"u ({', '.join(problem.u)}) does not reach"),
            (A.T, problem.C2.T, f"y ({', '.join(problem.y)}) does not see"),
        ):
            reach = size * gain / max(float(np.linalg.norm(gain, 2)), TINY)
            pencil = np.hstack([matrix - pole * np.eye(A.shape[0]), reach])
            if np.linalg.svd(pencil, compute_uv=False)[-1] < _MISSED * size:
                raise AssumptionError(
                    _delay_effect(problem, float(pole.real))
                    or f"{text} a mode of the plant or of a weight that is not stable "
                    f"({_pole_in_words(problem, complex(pole))}): no controller can stabilise it. "
                    "Add or move an actuator or a sensor, or give the weight finite gain."
                )


def beyond_rounding(problem: Prepared) -> str:
    """Return why no controller stabilises a problem in rounding, and what to do, in words."""
    poles = np.linalg.eigvals(problem.A)
    unstable = poles[poles.real > _ZERO * float(np.linalg.norm(problem.A, 2))]
    if not unstable.size:
        return (
            "the plant is too badly conditioned. Weight z and w so that their sizes are alike "
            "(metres beside newtons are not; stage_weights), or leave out states that u hardly "
            "reaches or y hardly sees."
        )
    growth = float(np.max(unstable.real))
    return _delay_effect(problem, growth) or (
        f"the plant has {unstable.size} unstable pole(s), growing e-fold in "
        f"{1.0 / (problem.speed * growth):.3g} s, which u ({', '.join(problem.u)}) and y "
        f"({', '.join(problem.y)}) can hold only with gains that 16 digits do not resolve. Add "
        "actuators and sensors that act on these modes one by one, move zeros away from them, or "
        "correct the model where the machine is stable (signs of stiffness and damping)."
    )


def _delay_effect(problem: Prepared, growth: float) -> str:
    """Return what a delay does to a mode of that growth, in words; empty where it does little."""
    if not problem.dt or problem.direct or growth <= _ZERO:
        return ""
    half = 0.5 * problem.dt * problem.speed
    # delays are poles at z = 0; a chain of n of them comes out of rounding on a circle eps^(1/n)
    s = half * np.linalg.eigvals(problem.A)
    delay = problem.dt * int(np.count_nonzero(np.abs(1.0 + s) < _NILPOTENT * np.abs(1.0 - s)))
    rate = 2.0 * np.arctanh(min(half * growth, 0.999)) / problem.dt
    if rate * delay < _TOO_LONG:
        return ""
    return (
        f"the delay of {delay:.3g} s between u ({', '.join(problem.u)}) and y "
        f"({', '.join(problem.y)}) is too long: an unstable mode grows e-fold in "
        f"{1.0 / rate:.3g} s, {np.exp(min(rate * delay, 700.0)):.1e} times meanwhile, and gamma by "
        "as much. Shorten the delay, or make the mode slower."
    )


def _pole_in_words(problem: Prepared, pole: complex) -> str:
    if abs(pole.imag) > _ZERO and abs(pole.imag) > pole.real:
        return f"at {problem.frequency(abs(pole.imag)):.3g} Hz"
    if pole.real > _ZERO:
        return f"it grows e-fold in {1.0 / (problem.speed * pole.real):.3g} s"
    return "at 0 Hz: rigid-body or integrating"
