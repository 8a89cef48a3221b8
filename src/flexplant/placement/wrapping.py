"""Criteria made of others: with a penalty, over several machines, after the loss of a device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..checks import FloatArray, checked, function, one_of, positive, short
from ..errors import AssumptionError, FlexplantError, ModelError
from ..plant import StandardPlant, larger_plant
from ..tolerances import TINY
from .candidates import SIDES, Port, sampled_plant, side_of, sides_of, with_side
from .criterion import Criterion, Scorer, Wrapping, as_criterion
from .gramian import Shapes, shapes_of
from .layouts import RigidPart
from .many import MEASURES, many_scores, over


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
    """Share of the modes left out of the plant in what devices measure or excite.

    ``sum_i sum_k phi_ik^2 / (4 zeta_k omega_k^3)`` over the elastic modes left out, over the same
    sum for those of the plant: squared H2 norms of the modes. A controller that is fast there
    excites the former by spill-over.

    Parameters
    ----------
    larger : Modes, FEModel or ReducedModel, optional
        The structure with more modes; None: those of the plant's reduced model beyond those kept.
    of : {"sensors", "actuators"}
        Of which devices, when it is called on a plant.

    Raises
    ------
    ModelError
        When `of` is none of these; when called, when larger is no structure.
    AssumptionError
        When called, where no modes left out are known.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.placement.LeftOutModes(of="sensors")
    LeftOutModes(of='sensors')
    """

    scale: ClassVar[float] = 1e-6
    larger: Any = None
    of: str = field(default="sensors", kw_only=True, metadata=checked(one_of, choices=SIDES))

    def __call__(self, plant: StandardPlant) -> float:
        """Return the share of the plant's own sensors or actuators."""
        own = getattr(plant.assembled.ports, SIDES[self.of])
        return float(self.scorer(plant, own).value(range(len(own))))

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the share of choices among candidates of this kind; others do not count."""
        own = [side_of(port) == SIDES[self.of] for port in candidates]
        counted = np.array(own, dtype=np.float64)
        whole = larger_plant(plant, self.larger)
        kept = shapes_of(plant, candidates)
        more = None if whole is None else shapes_of(whole, candidates)
        if more is None or more.omega.size <= kept.omega.size:
            raise AssumptionError(
                "no modes left out of the plant are known: pass "
                "placement.LeftOutModes(larger), the "
                "structure with more modes."
            )
        # modes are in order of their frequency: the plant has the first of them
        beyond = more.omega > 1.0001 * np.max(kept.omega)
        return Share(counted * _worth(more, beyond), counted * _worth(kept, kept.omega > 0))


@dataclass(frozen=True, eq=False)
class PenalisedScores(Scorer):
    """``J + weight |J| penalty`` of the same choices."""

    base: Scorer
    penalty: Scorer
    weight: float

    def value(self, chosen: Sequence[int]) -> float:
        """Return it for one choice."""
        return float(
            _penalised_sum(self.base.value(chosen), self.penalty.value(chosen), self.weight)
        )

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return it for several choices."""
        values = self.base.score(sets)
        finite = np.flatnonzero(np.isfinite(values)).tolist()
        more = self.penalty.score([sets[i] for i in finite])
        values[finite] = _penalised_sum(values[finite], more, self.weight)
        return values

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the bound without a penalty, or with the least one."""
        base = self.base.bound(count, required)
        least = max(self.penalty.bound(count, required), 0.0)
        return float(_penalised_sum(base, least, self.weight)) if base >= 0 else base


@dataclass(frozen=True, eq=False)
class Penalised(Wrapping):
    """``J + weight |J| penalty``: a criterion that grows by a part of itself.

    Parameters
    ----------
    criterion : Criterion or callable
        J, from plant to float.
    penalty : Criterion or callable
        From plant to float, 0 or more, such as `LeftOutModes`.
    weight : float
        Of the penalty.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> sensors = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> cautious = fx.placement.Penalised(fx.PoiVariance(), penalty=lambda plant: 0.1)
    >>> fx.place_sensors(plant, sensors, 1, cautious).chosen
    ('s1',)
    """

    penalty: Any = None
    weight: float = field(default=1.0, metadata=checked(positive))

    def __post_init__(self) -> None:
        super().__post_init__()
        function(self.penalty, "a penalty", "Name one.")

    def __call__(self, plant: StandardPlant) -> float:
        """Return it on a plant."""
        return float(_penalised_sum(self.criterion(plant), self.penalty(plant), self.weight))

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Check both."""
        super().check(plant, candidates)
        as_criterion(self.penalty, sides_of(candidates)).check(plant, candidates)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the scores of choices by those of both."""
        base, more = self.inner, as_criterion(self.penalty)
        return PenalisedScores(
            base.scorer(plant, candidates), more.scorer(plant, candidates), self.weight
        )


def _penalised_sum(value: Any, penalty: Any, weight: float) -> Any:
    return value + weight * np.abs(value) * penalty


def _worth(shapes: Shapes, which: npt.NDArray[np.bool_]) -> FloatArray:
    omega, zeta = shapes.omega[which], shapes.zeta[which]
    return np.asarray(np.sum(shapes.phi[:, which] ** 2 / (4.0 * zeta * omega**3), axis=1))


def _checked_machines(machines: Any, name: str) -> tuple[StandardPlant, ...]:
    """Return the machines of a criterion, one at least."""
    if isinstance(machines, str) or not isinstance(machines, Sequence) or not machines:
        raise ModelError(
            f"{name} are a list of at least one plant, got {short(machines)}. Pass "
            "plant.uncertain(fit).sample(rng, 20), say."
        )
    return tuple(sampled_plant(machine) for machine in machines)


@dataclass(frozen=True, eq=False, repr=False)
class OverMachines(Wrapping):
    """The worst or the mean of a criterion over several machines with the same devices.

    Parameters
    ----------
    criterion : Criterion or callable
        From plant to float.
    machines : sequence of StandardPlant
        Such as `plant.uncertain(fit).sample(rng, 20)`, or one plant for each machine of a fleet;
        sampled, each gets the devices of the plant that is scored.
    measure : {"worst", "mean"}
        Over the machines.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> worst = fx.placement.OverMachines(fx.PoiVariance("die"), [plant, plant])
    >>> fx.place_sensors(plant, candidates, 1, worst).chosen
    ('s1',)
    """

    machines: Sequence[StandardPlant] = field(metadata=checked(_checked_machines))
    measure: str = field(default="worst", kw_only=True, metadata=checked(one_of, choices=MEASURES))

    def __repr__(self) -> str:
        return f"OverMachines({self.criterion!r}, {len(self.machines)} machines, {self.measure!r})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return it with the devices of a plant."""
        ports = plant.assembled.ports
        values = [self.criterion(machine.with_ports(ports)) for machine in self.machines]
        return float(over(self.measure, values))

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Check the criterion on every machine."""
        for machine in self._with(plant):
            super().check(machine, candidates)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the scores by those on each machine."""
        inner = self.inner
        parts = tuple(inner.scorer(machine, candidates) for machine in self._with(plant))
        return many_scores(parts, self.measure)

    def _with(self, plant: StandardPlant) -> list[StandardPlant]:
        return [machine.with_ports(plant.assembled.ports) for machine in self.machines]


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
class AfterLoss(Wrapping):
    """The worst or the mean of a criterion after the loss of any one device.

    Infinite where the others do not suffice: choose one more than the least number.

    Parameters
    ----------
    criterion : Criterion or callable
        From plant to float.
    of : {"sensors", "actuators"}
        Which devices may be lost.
    measure : {"worst", "mean"}
        Over the devices.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 3)]
    >>> one_may_fail = fx.placement.AfterLoss(fx.PoiVariance("die"))
    >>> found = fx.place_sensors(plant, candidates, 2, one_may_fail)
    >>> found.value > fx.place_sensors(plant, candidates, 2).value
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
        """Return the scores by those of choices of one less."""
        inner = self.inner.scorer(plant, candidates)
        losable = tuple(side_of(port) == SIDES[self.of] for port in candidates)
        rigid = RigidPart.of(plant, sides_of(candidates), candidates)
        return LossScores(inner, rigid, losable, self.measure)
