"""Criteria made of others: with a penalty, over machines and positions, after losing a device."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, one_of
from ..errors import AssumptionError, FlexplantError, LabelError, ModelError, counted, short
from ..plant import StandardPlant
from ..plant.scheduling import values_over
from ..store import checked
from ..tolerances import NEGLIGIBLE, TINY
from .candidates import SIDES, Port, sampled_plant, side_of, sides_of, with_side
from .convex import Below, Branch, Convex, Tangent, least_sum
from .criterion import Criterion, Scorer, Wrapping
from .mode_shapes import PlacedShapes, shapes_of
from .problem import RigidPart

MEASURES = ("worst", "mean")
#: rounds in which the shares of parts move to the worst one, and how fast
_ROUNDS, _PULL = 8, 4.0


def over(measure: str, values: Any) -> Any:
    """Return the largest or the mean along the first axis."""
    return np.max(values, axis=0) if measure == "worst" else np.mean(values, axis=0)


@dataclass(frozen=True, eq=False)
class Share(Scorer):
    """A sum over the chosen of one worth over that of another."""

    parts: FloatArray
    wholes: FloatArray

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice."""
        kept = list(chosen)
        return float(np.sum(self.parts[kept]) / max(float(np.sum(self.wholes[kept])), TINY))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return 0."""
        return 0.0


@dataclass(frozen=True, eq=False, repr=False)
class LeftOutModes(Criterion):
    """Response of devices to truncated modes, divided by their response to the plant's modes.

    The devices are the chosen sensors or actuators. Each response is the sum of
    ``phi_ik^2 / (4 zeta_k omega_k^3)`` over the devices i and elastic modes k. In the numerator k
    counts the truncated modes, and in the denominator the modes of the plant. phi_ik is the mode
    shape at the device, zeta_k the damping ratio and omega_k the frequency. Each term is the
    squared H2 norm of a mode. The ratio matters because a controller with a high gain at the
    frequencies of truncated modes excites them (spill-over).

    Parameters
    ----------
    of : {"sensors", "actuators"}
        Kind of the devices that count.

    Raises
    ------
    ModelError
        When `of` is neither of these.
    AssumptionError
        When the plant has no evaluation model with more modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.placement.LeftOutModes(of="sensors")
    LeftOutModes()
    """

    scale: ClassVar[float] = 1e-6  # micrometres relative to metres
    of: str = field(default="sensors", kw_only=True, metadata=checked(one_of, choices=SIDES))

    def __call__(self, plant: StandardPlant) -> float:
        """Return the ratio of the plant's own sensors or actuators."""
        own = getattr(plant.assembled.ports, SIDES[self.of])
        return float(self.scorer(plant, own).value(range(len(own))))

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the ratio as a function of the choice; only candidates of the kind `of` count."""
        own = [side_of(port) == SIDES[self.of] for port in candidates]
        counts = np.array(own, dtype=np.float64)
        whole = plant.evaluation_plant
        kept = shapes_of(plant, candidates)
        more = None if whole is None else shapes_of(whole, candidates)
        if more is None or more.omega.size <= kept.omega.size:
            raise AssumptionError(
                "no truncated modes of the plant are known: give it an evaluation model with more "
                "modes, assemble_plant(model, ports, evaluation=)."
            )
        # modes are in order of their frequency: the plant has the first of them
        beyond = more.omega > 1.0001 * np.max(kept.omega)
        return Share(counts * _worth(more, beyond), counts * _worth(kept, kept.omega > 0))


def _worth(shapes: PlacedShapes, which: npt.NDArray[np.bool_]) -> FloatArray:
    omega, zeta = shapes.omega[which], shapes.zeta[which]
    return np.asarray(np.sum(shapes.phi[:, which] ** 2 / (4.0 * zeta * omega**3), axis=1))


@dataclass(frozen=True, eq=False)
class ManyScores(Scorer):
    """The worst or the mean of several scores of the same choice.

    With what each part sees of the rigid-body modes, a choice that misses one has no score.
    """

    parts: tuple[Any, ...]
    measure: str
    rigid: tuple[RigidPart, ...]

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice."""
        missed = [i for i, part in enumerate(self.rigid) if part.missing(chosen)]
        if missed:
            raise AssumptionError(
                f"It misses a rigid-body mode at {len(missed)} of {len(self.rigid)} positions."
            )
        return float(over(self.measure, [part.value(chosen) for part in self.parts]))

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return it for several choices."""
        values = np.full(len(sets), np.inf)
        missed = [part.all_missing(sets) for part in self.rigid]
        kept = np.flatnonzero(~np.any(missed, axis=0)).tolist()
        found = [part.score([sets[i] for i in kept]) for part in self.parts]
        values[kept] = over(self.measure, found)
        return values

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the worst or the mean of the bounds."""
        bounds = [part.bound(count, required) for part in self.parts]
        return float(over(self.measure, bounds))


@dataclass(frozen=True, eq=False)
class ConvexScores(ManyScores, Convex):
    """The worst or the mean of convex costs: it is one itself."""

    bound = Convex.bound

    def cost(self, weights: FloatArray) -> float:
        """Return it at weights (N,)."""
        return float(over(self.measure, [part.cost(weights) for part in self.parts]))

    def tangent(self, weights: FloatArray) -> Below:
        """Return the worst or the mean of the tangents."""
        return BelowAll(tuple(part.tangent(weights) for part in self.parts), self.measure)

    def everything(self) -> float:
        """Return a number below the cost of all candidates together."""
        return float(over(self.measure, [part.everything() for part in self.parts]))

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.parts[0].total)


@dataclass(frozen=True, eq=False)
class BelowAll(Below):
    """The worst or the mean of functions below costs: it lies below the worst or the mean."""

    parts: tuple[Below, ...]
    measure: str

    @cached_property
    def rows(self) -> FloatArray:  # type: ignore[override]
        """Effects of each candidate on all parts."""
        return np.hstack([part.rows for part in self.parts])

    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return numbers (m,) below the cost of each choice."""
        return np.asarray(over(self.measure, [part.values(sets) for part in self.parts]))

    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least."""
        # for any shares that add up to one `min_w sum_p share_p f_p(w) <= min_w max_p f_p(w)`; they
        # are moved to the worst parts as far as that lifts the bound
        tangents = [part for part in self.parts if isinstance(part, Tangent)]
        if len(tangents) < len(self.parts):
            found = [part.least(branch, start) for part in self.parts]
            bound = float(over(self.measure, [one for one, _ in found]))
            return bound, np.mean([weights for _, weights in found], axis=0)
        shares = np.full(len(tangents), 1.0 / len(tangents))
        best, kept = least_sum(tangents, shares, branch, start)
        if self.measure == "mean":
            return best, kept
        weights = kept
        for _ in range(_ROUNDS):
            falls = [one.fall(weights) for one in tangents]
            if any(fall is None for fall in falls):
                break
            costs = np.array(
                [f[0] + t.constant for f, t in zip(falls, tangents, strict=True) if f is not None]
            )
            size = float(np.abs(costs).max())
            if float(costs.max()) - best <= NEGLIGIBLE * size:
                break
            shares = shares * np.exp(_PULL * (costs - costs.max()) / size)
            shares = shares / shares.sum()
            bound, weights = least_sum(tangents, shares, branch, weights)
            if bound > best:
                best, kept = bound, weights
        return best, kept


@dataclass(frozen=True, eq=False, repr=False)
class Several(Wrapping):
    """The worst or the mean of a criterion over several plants; a new one defines `plants`."""

    measure: str = field(default="worst", kw_only=True, metadata=checked(one_of, choices=MEASURES))

    @abstractmethod
    def plants(
        self, plant: StandardPlant, candidates: Sequence[Port]
    ) -> Iterator[tuple[StandardPlant, Sequence[Port]]]:
        """Yield the plants that take the place of one, and where its candidates are there."""

    def __call__(self, plant: StandardPlant) -> float:
        """Return it with the devices of a plant."""
        return float(over(self.measure, [self.criterion(one) for one, _ in self.plants(plant, ())]))

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Check the criterion on every plant."""
        for one, ports in self.plants(plant, candidates):
            super().check(one, ports)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the scores by those on each plant, with bounds of their relaxation if all have."""
        every, side = list(self.plants(plant, candidates)), sides_of(candidates)
        parts = tuple(self.inner.scorer(one, ports) for one, ports in every)
        rigid = tuple(RigidPart.of(one, side, ports) for one, ports in every)
        kind = ConvexScores if all(isinstance(part, Convex) for part in parts) else ManyScores
        return kind(parts, self.measure, rigid)


def _checked_machines(machines: Any, name: str) -> tuple[StandardPlant, ...]:
    """Return the machines of a criterion, one at least."""
    if isinstance(machines, str) or not isinstance(machines, Sequence) or not machines:
        raise ModelError(
            f"{name} are a list of at least one plant, got {short(machines)}. Pass "
            "plant.uncertain(fit).machines.plants, say."
        )
    return tuple(sampled_plant(machine) for machine in machines)


@dataclass(frozen=True, eq=False, repr=False)
class OverMachines(Several):
    """The worst or the mean of a criterion over several machines with the same devices.

    Parameters
    ----------
    criterion : Criterion or callable
        Criterion, or function of a plant that returns a float; smaller is better.
    machines : sequence of StandardPlant
        Sampled plants, for example one plant for each machine of a fleet, or the possible machines
        of one plant: `plant.uncertain(fit).machines.plants`, where `fit` is the result of `update`.
        Each of them gets the sensors and actuators of the plant that is scored.
    measure : {"worst", "mean"}
        Whether the value is the largest over the machines, or their mean.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> worst = fx.placement.OverMachines(fx.PoiVariance("die"), [plant, plant])
    >>> fx.place_sensors(plant, ["y1", "y2"], 1, worst).chosen
    ('y1',)
    """

    machines: Sequence[StandardPlant] = field(metadata=checked(_checked_machines))

    def plants(
        self, plant: StandardPlant, candidates: Sequence[Port]
    ) -> Iterator[tuple[StandardPlant, Sequence[Port]]]:
        """Yield every machine with the devices of the plant."""
        for machine in self.machines:
            yield machine.with_ports(plant.assembled.ports), candidates


@dataclass(frozen=True, eq=False, repr=False)
class OverPositions(Several):
    """The worst or the mean of a criterion over the positions of a machine whose ports move.

    Ports are the sensors and actuators of a plant. Candidates may move with the position of the
    machine, as other ports do (argument ``moves``). For example, a sensor head on the frame
    measures another point of the stage at each position. The modes of the plant are computed only
    once. A score takes one Riccati equation for each position. The lower bound is the worst (or the
    mean) of the bounds at the positions. A choice that does not observe every rigid-body mode at
    each position has no score. Constraints on places are checked only at the position of the given
    plant.

    Parameters
    ----------
    criterion, measure
        Criterion and measure, as for `OverMachines`, with positions in place of the machines.
    points : int or mapping {name: int or array}
        Number of values of each position over its range, or the values [m or rad]. The criterion is
        computed only at these values. To see whether they suffice, repeat the calculation with more
        values and compare.

    Raises
    ------
    AssumptionError
        In a search, when all candidates together do not observe every rigid-body mode at a
        position.
    LabelError
        When the plant has no positions, or a name is not one of them.
    ModelError
        When the measure is neither of the two, or a value is out of its range.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.placement.OverPositions(fx.PoiVariance("die"), {"x": [-0.1, 0.0, 0.1]})
    OverPositions(criterion=PoiVariance(poi=['die']), points={'x': [-0.1, 0.0, 0.1]})
    """

    points: Any = 5

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Check, at each position, the criterion and whether the candidates suffice."""
        for there, ports in self.plants(plant, candidates):
            missed = RigidPart.of(there, sides_of(ports), ports).missing(range(len(ports)))
            if missed:
                raise AssumptionError(
                    f"no choice of these candidates will do: at {there.assembled.ports.standing} "
                    f"even all of them miss {counted(missed, 'rigid-body mode')}. Add others, or "
                    "narrow the positions."
                )
            Wrapping.check(self, there, ports)

    def plants(
        self, plant: StandardPlant, candidates: Sequence[Port]
    ) -> Iterator[tuple[StandardPlant, Sequence[Port]]]:
        """Yield the plant with all candidates at each position, and the candidates there."""
        keys = [(side_of(port), port.name) for port in candidates]
        whole = with_side(plant, sides_of(candidates), candidates) if keys else plant
        positions = whole.assembled.ports.positions
        if not positions:
            raise LabelError(
                "the plant has no positions, over which OverPositions could go: nothing of it "
                "moves. Give ports moves={'x': (-1, 0, 0)} and "
                "Ports(..., positions=[fx.plant.Position('x', range=(-0.1, 0.1))])."
            )
        grid = values_over(positions, self.points)
        for values in product(*grid.values()):
            there = whole.at(**dict(zip(grid, values, strict=True)))
            ports = there.assembled.ports
            own = {(s, port.name): port for s in "yu" for port in getattr(ports, s)}
            yield there, [own[key] for key in keys]


@dataclass(frozen=True, eq=False)
class LossScores(Scorer):
    """The worst or the mean score of a choice without any one of its devices."""

    inner: Scorer
    rigid: RigidPart
    losable: tuple[bool, ...]
    measure: str

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice: infinite where a loss leaves a rigid-body mode unseen."""
        lists = [[j for j in chosen if j != i] for i in chosen if self.losable[i]]
        if not lists or np.any(self.rigid.all_missing(lists)):
            return np.inf
        return float(over(self.measure, self.inner.score(lists)))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the bound of choices of one less: what is left is one of them."""
        return self.inner.bound(count - 1, ()) if count > 1 else -np.inf


@dataclass(frozen=True, eq=False)
class DeviceLoss(Wrapping):
    """The worst or the mean of a criterion after the loss of any one device.

    The devices are the sensors or the actuators. The value is infinite if, after the loss of one
    device, the others do not observe (or move) every rigid-body mode. Therefore choose at least one
    device more than the rigid-body modes need.

    Parameters
    ----------
    criterion, measure
        As for `OverMachines`, with the losses of single devices in place of the machines.
    of : {"sensors", "actuators"}
        Kind of the devices that may be lost.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> one_may_fail = fx.placement.DeviceLoss(fx.PoiVariance("die"))
    >>> one_may_fail(plant) > fx.PoiVariance("die")(plant)
    True
    """

    of: str = field(default="sensors", kw_only=True, metadata=checked(one_of, choices=SIDES))
    measure: str = field(default="worst", kw_only=True, metadata=checked(one_of, choices=MEASURES))

    def __call__(self, plant: StandardPlant) -> float:
        """Return it for the devices of a plant: infinite where the others do not suffice."""
        side = SIDES[self.of]
        own: tuple[Port, ...] = getattr(plant.assembled.ports, side)
        values = []
        for lost in own:
            try:
                left = with_side(plant, side, [port for port in own if port is not lost])
                values.append(self.criterion(left))
            except FlexplantError:
                return np.inf
        return float(over(self.measure, values))

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the scores, which follow from those of choices with one device less."""
        inner = self.inner.scorer(plant, candidates)
        losable = tuple(side_of(port) == SIDES[self.of] for port in candidates)
        rigid = RigidPart.of(plant, sides_of(candidates), candidates)
        return LossScores(inner, rigid, losable, self.measure)
