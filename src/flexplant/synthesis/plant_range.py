"""Plants by position, whose rows and columns move: between the given ones they are linear."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, mapping, number
from ..errors import CertificateError, ModelError
from ..lti.statespace import StateSpace
from ..plant import StandardPlant, standard_plant
from ..tolerances import SAME

_HINT = "Pass {0.0: plant, 0.1: other}, the same model with its ports at each position."


def sorted_places(given: Any, name: str, least: int = 2) -> tuple[FloatArray, list[Any]]:
    """Return positions in rising order, and what is at each."""
    entries = mapping(given, name, _HINT, least=least)
    pairs = sorted(((number(x, "a position"), one) for x, one in entries.items()), key=_position)
    places = np.array([x for x, _ in pairs])
    if np.any(np.diff(places) <= 0.0):
        raise ModelError(f"positions of {name} must differ, got {places.tolist()}. {_HINT}")
    return places, [one for _, one in pairs]


def _position(pair: tuple[float, Any]) -> float:
    return pair[0]


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
