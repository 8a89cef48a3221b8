"""The plants of a synthesis: can any controller stabilise them, and how they move by position."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, mapping, number
from ..errors import AssumptionError, CertificateError, ModelError
from ..lti.preparation import Prepared
from ..lti.statespace import StateSpace, System
from ..plant import StandardPlant, standard_plant
from ..plant.uncertainty.uncertain_plant import UncertainPlant
from ..tolerances import SAME, TINY

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


_HINT = "Pass {0.0: plant, 0.1: other}, the same model with its ports at each position."


def sorted_places(given: Any, name: str, least: int = 2) -> tuple[FloatArray, list[Any]]:
    """Return positions in rising order, and what is at each."""
    entries = mapping(given, name, _HINT, least=least)
    each = ((number(x, "a position"), one) for x, one in entries.items())
    pairs = sorted(each, key=lambda pair: pair[0])
    places = np.array([x for x, _ in pairs])
    if np.any(np.diff(places) <= 0.0):
        raise ModelError(f"positions of {name} must differ, got {places.tolist()}. {_HINT}")
    return places, [one for _, one in pairs]


def system_at(systems: Sequence[StateSpace], places: FloatArray, x: float) -> StateSpace:
    """Return the system at a position, its matrices linear between the nearest two."""
    i = int(np.clip(np.searchsorted(places, x, side="right") - 1, 0, max(len(places) - 2, 0)))
    if x == places[i] or len(places) == 1:
        return systems[i]
    if x == places[i + 1]:
        return systems[i + 1]
    part, a, b = (x - places[i]) / (places[i + 1] - places[i]), systems[i], systems[i + 1]
    mixed = {m: (1.0 - part) * getattr(a, m) + part * getattr(b, m) for m in "ABCD"}
    return a.replace(**mixed, blocks=None)


@dataclass(frozen=True)
class PlantRange:
    """Plants of one machine at several positions: same channels, rate and states."""

    places: FloatArray
    plants: list[StandardPlant]

    @classmethod
    def of(cls, given: Mapping[float, Any], name: str = "plant") -> PlantRange:
        """Return the plants of a mapping {position: plant}."""
        places, plants = sorted_places(given, name, least=1)
        found = cls(places, [standard_plant(one) for one in plants])
        first = found.plants[0]
        for x, one in zip(places, found.plants, strict=True):
            same = all(getattr(one, side) == getattr(first, side) for side in "wuzy")
            if not same or not np.isclose(one.dt, first.dt, rtol=SAME, atol=0.0):
                raise ModelError(
                    f"the plant at {x:g} has other channels or another rate than that at "
                    f"{places[0]:g}: no controller could move from one to the other. Assemble all "
                    "with the same names and rate."
                )
            if one.system.n_states != first.system.n_states:
                raise ModelError(
                    f"the plant at {x:g} has {one.system.n_states} states, that at {places[0]:g} "
                    f"has {first.system.n_states}: where only ports move the model is one. "
                    "Assemble all of the same modes."
                )
        return found

    def at(self, x: float) -> StandardPlant:
        """Return the plant at a position, its matrices linear between those given."""
        known = np.flatnonzero(self.places == x)
        if known.size:
            return self.plants[int(known[0])]
        first = self.plants[0]
        found = system_at([one.system for one in self.plants], self.places, x)
        sides = {side: getattr(first, side) for side in "wuzy"}
        return StandardPlant.from_statespace(found, **sides)

    def certified(
        self, norm_of: Callable[[StandardPlant], float], norms: Sequence[float]
    ) -> dict[str, float]:
        """Return the norm at each position, the worst one, and the worst half way between two."""
        found = {f"norm at {x:.6g}": norm for x, norm in zip(self.places, norms, strict=True)}
        found["worst position"] = float(self.places[int(np.argmax(norms))])
        worst = (0.0, np.nan)
        for x in self.middles.tolist():
            try:
                worst = max(worst, (norm_of(self.at(x)), x))
            except CertificateError as error:
                raise CertificateError(
                    f"at {x:.6g}, between the positions designed for: {error} Give plants at more "
                    "positions."
                ) from error
        if self.middles.size:
            found |= {"norm between positions": worst[0], "worst position between": worst[1]}
        return found

    @property
    def middles(self) -> FloatArray:
        """The positions half way between those given."""
        return np.asarray(0.5 * (self.places[1:] + self.places[:-1]))
