"""The plants of a machine that moves, and one H-infinity controller for all its positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ...arrays import FloatArray, mapping, number
from ...certificates import Certificate, Verified
from ...errors import CertificateError, ModelError, SolverError, attempted, counted
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import lft
from ...lti.norms import hinf_norm
from ...lti.statespace import StateSpace
from ...parallel import Progress, tick
from ...plant import AnyPlant, StandardPlant, plant_of
from ...plant.uncertainty.channels import with_channels
from ...tolerances import FOUR_DIGITS, SAME
from ..controller import Controller
from ..pipeline import Design, Solution, solved, verified
from ..preparation import prepared
from .lower_bound import pointwise_bound

#: size of the channels relative to the whole motion: they are for complex deltas, which cover more
#: than a real position
_SIZE = 0.1
#: what the progress bar counts
_DESIGNS = "designs over the positions"


@dataclass(frozen=True)
class PlantRange:
    """Plants of one machine at several positions: same channels, rate and states."""

    places: FloatArray
    plants: list[AnyPlant]

    @classmethod
    def of(cls, given: Mapping[float, Any]) -> PlantRange:
        """Return the plants of a mapping {position: plant}."""
        hint = "Pass {0.0: plant, 0.1: other}, the same model with its ports at each position."
        entries = mapping(given, "plant", hint, least=1)
        known = {number(x, "a position"): plant_of(one) for x, one in entries.items()}
        if len(known) < len(entries):
            raise ModelError(f"positions of plant must differ, got {list(entries)}. {hint}")
        places = np.array(sorted(known))
        found = cls(places, [known[x] for x in places.tolist()])
        first = found.plants[0]
        for x, one in zip(places, found.plants, strict=True):
            same = all(getattr(one, side) == getattr(first, side) for side in "wuzy")
            same &= one.system.n_states == first.system.n_states
            if not same or not np.isclose(one.dt, first.dt, rtol=SAME, atol=0.0):
                raise ModelError(
                    f"the plant at {x:g} has other channels or another rate or number of states "
                    f"({one.system.n_states}) than that at {places[0]:g} "
                    f"({first.system.n_states}): no controller could move from one to the other. "
                    "Assemble all of the same modes, with the same names and rate."
                )
        return found

    @property
    def between(self) -> dict[float, AnyPlant]:
        """The plants half way between neighbours, their matrices linear between those given."""
        middles = 0.5 * (self.places[1:] + self.places[:-1])
        return dict(zip(middles.tolist(), map(_mean, pairwise(self.plants)), strict=True))

    def certified(
        self, norm_of: Callable[[AnyPlant], float], norms: Sequence[float]
    ) -> Certificate:
        """Return the norm at each position, the worst one, and the worst half way between two."""
        found = [(f"norm at {x:.6g}", norm) for x, norm in zip(self.places, norms, strict=True)]
        found.append(("worst position", float(self.places[int(np.argmax(norms))])))
        worst = (0.0, np.nan)
        for x, plant in self.between.items():
            try:
                worst = max(worst, (norm_of(plant), x))
            except CertificateError as error:
                raise CertificateError(
                    f"at {x:.6g}, between the positions designed for: {error} Give plants at more "
                    "positions."
                ) from error
        if np.isfinite(worst[1]):
            found += [("norm between positions", worst[0]), ("worst position between", worst[1])]
        route = "the loop closed at each position"
        return Certificate(tuple(Verified(what, figure, route) for what, figure in found))


def _mean(plants: Sequence[AnyPlant]) -> AnyPlant:
    """Return the plant with the mean matrices of several."""
    first = plants[0]
    mixed = {m: np.mean([getattr(one.system, m) for one in plants], axis=0) for m in "ABCD"}
    sides = {side: getattr(first, side) for side in "wuzy"}
    return StandardPlant.from_statespace(first.system.replace(**mixed, blocks=None), **sides)


@dataclass(frozen=True)
class PositionDesign(Design):
    """The controller whose worst norm over the positions is least of those tried.

    These are for the mean plant, then for the mean plant with a channel for each row and column
    that moves, ``y = (C + delta dC) x`` and ``x+ = ... + (B + delta dB) u``, of several scales.
    """

    design: Design
    progress: bool | None = None

    def prepare(self, plant: PlantRange) -> PlantRange:
        """Return the plants: each design prepares a separate problem."""
        return plant

    def solve(self, problem: PlantRange) -> tuple[Controller, dict[str, float]]:
        """Return the best controller, and the worst norm of each that was tried."""
        motion, tried, found = _MotionChannels(problem), dict[str, float](), list[Controller]()

        def worst_of(name: str, plant: AnyPlant) -> float:
            if name not in tried:
                least, tried[name] = min(tried.values(), default=np.inf), np.inf
                with attempted(f"the design for {name}"):  # another scale may serve
                    one = verified(self.design, solved(self.design, plant))
                    tried[name] = _worst_norm(problem, one.system)
                    if tried[name] < least or not found:
                        found.append(one)
                tick(_DESIGNS)
            return tried[name]

        def worst_of_scale(scale: float) -> float:
            return worst_of(f"scale {scale:g} of the motion", motion.channels(scale))

        with Progress(None, _DESIGNS, progress=self.progress):
            worst_of("the mean plant", motion.mean)
            if motion.scales.size and found:
                motion.even(found[0].system)
                for factor in (0.5, 2.0):  # while that helps
                    scale, value = 1.0, np.inf
                    while (reached := worst_of_scale(scale)) < (1.0 - FOUR_DIGITS) * value:
                        scale, value = scale * factor, reached
                    if scale != factor:
                        break
        if not np.isfinite(min(tried.values())):
            places = problem.places
            raise SolverError(
                "no controller was found that is stable at all "
                f"{counted(len(places), 'position')} from {places[0]:g} to {places[-1]:g} (tried: "
                f"{', '.join(tried)}). Ask for less bandwidth, a shorter range, or schedule the "
                "design (loop.schedule_loops)."
            )
        return found[-1], tried

    def restore(self, plant: PlantRange, problem: PlantRange, found: Any) -> StateSpace:
        """Return the best controller."""
        K: StateSpace = found[0].system
        return K

    def certify(self, solution: Solution) -> Controller:
        """Return the controller with the norms of all positions."""
        moving, _, K, (best, tried) = solution
        norms = [_position_norm(one, K) for one in moving.plants]
        certificate = moving.certified(lambda one: _position_norm(one, K), norms)
        bounds = [pointwise_bound(prepared(one.system, one.u, one.y)) for one in moving.plants]
        worst = certificate["worst position"]
        answer: Controller = best.replace(
            gamma=max(norms),
            lower=max(bounds),
            certificate=certificate,
            reached=Certificate(),
            tried=Certificate(tuple(Verified(name, one) for name, one in tried.items())),
            notes=(f"one controller for {counted(len(norms), 'position')}; worst at {worst:g}",),
        )
        return answer


class _MotionChannels:
    """How rows and columns of the plant change over the range, and channels for it."""

    def __init__(self, moving: PlantRange) -> None:
        systems = [one.system for one in moving.plants]
        #: the plant with the mean matrices
        self.mean = _mean(moving.plants)
        x = moving.places - 0.5 * (moving.places[0] + moving.places[-1])
        x = x / (np.abs(x).max() or 1.0)
        g = self.mean.system
        power = float(x @ x) or 1.0
        dC, dB = (
            np.sum([t * (getattr(one, m) - getattr(g, m))
                    for t, one in zip(x, systems, strict=True)], axis=0) / power
            for m in "CB"
        )  # fmt: skip
        self.rows, self.columns = _changed_rows(dC, g.C), _changed_rows(dB.T, g.B.T)
        self.dC, self.dB = dC[self.rows], dB[:, self.columns]
        self.scales = np.ones(self.rows.size + self.columns.size)

    def channels(self, scale: float = 1.0) -> AnyPlant:
        """Return the mean plant with a disturbance and an output for each row and column."""
        g, r, c, own = self.mean.system, self.rows.size, self.columns.size, self.mean
        D, n, k = scale * self.scales, g.n_states, r + c
        left, right = np.zeros((n + len(g.outputs), k)), np.zeros((k, n + len(g.inputs)))
        left[n + self.rows, np.arange(r)] = D[:r]
        left[:n, r:] = self.dB * D[r:]
        right[:r, :n] = _SIZE * self.dC / D[:r, None]
        right[r + np.arange(c), n + self.columns] = _SIZE / D[r:]
        names = [f"moves{i}" for i in range(1, k + 1)]
        w, z = ([f"{name}:{side}" for name in names] for side in "wz")
        return StandardPlant.from_statespace(
            with_channels(g, 0, names, left, right),
            w=[*w, *own.w], u=own.u, z=[*z, *own.z], y=own.y,
        )  # fmt: skip

    def even(self, K: StateSpace) -> None:
        """Scale each channel so that, in closed loop, w reaches it as it reaches z."""
        k = self.scales.size
        loop = lft(self.channels().system, K)
        freq = resonance_grid(loop.poles(), loop.dt, points=300)
        T = frequency_response(loop, freq).data
        out = np.linalg.norm(T[k:, :k], axis=0).max(axis=1)
        into = np.linalg.norm(T[:k, k:], axis=1).max(axis=1)
        both = (out > 0) & (into > 0)
        self.scales = np.where(both, np.sqrt(into / np.where(both, out, 1.0)), 1.0)


def _changed_rows(change: FloatArray, rows: FloatArray) -> Any:
    """Return which rows change at all, each relative to its own size."""
    size = np.abs(change).max(axis=1, initial=0.0)
    return np.flatnonzero(size > SAME * np.abs(rows).max(axis=1, initial=0.0))


def _worst_norm(moving: PlantRange, K: StateSpace) -> float:
    """Return the largest norm at and between the positions, infinite where a loop is not stable."""
    plants = (*moving.plants, *moving.between.values())
    return max(float(hinf_norm(lft(one.system, K))) for one in plants)


def _position_norm(plant: AnyPlant, K: StateSpace) -> float:
    """Return the norm of the loop of one position."""
    loop = lft(plant.system, K)
    if not loop.is_stable:
        raise CertificateError("the loop is not stable.")
    return float(hinf_norm(loop))
