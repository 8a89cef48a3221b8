"""Uncertain plants: a plant and what is not known of it, opened as Deltas and drawn as machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Self

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, mapping, number
from ...errors import ModelError, counted, require_known, some_names
from ...identification import MeasuredModes
from ...lti.interconnection import append, lft
from ...lti.statespace import StateSpace
from ...store import Value
from ...tolerances import DEVIATIONS
from ...updating import Machines, ModalUncertainty, UpdateResult
from ..building import P
from ..machine_draws import DrawnModes
from ..partitioned import Partition
from ..realisation import ModalRealisation
from .channels import Opened, missed
from .delta import Delta, Known, Uncertainty, with_changes
from .delta_blocks import Block, delta_system, drawn_delta
from .fit import Fit
from .gains import DelayDelta
from .mode_delta import DampingDelta, FrequencyDelta, StatedFamily
from .neglected import Neglected
from .neglected_dynamics import NeglectedModes, with_neglected
from .parameter_amounts import ParameterDelta, require_matrices


@dataclass(frozen=True, eq=False, repr=False)
class UncertainPlant(Value, Generic[P]):
    """A plant and its uncertainty: real Deltas, and weights on the modes that it lacks.

    ::

          z_Delta <---|     |<--- w_Delta = Delta z_Delta
                z <---|  P  |<--- w
                y <---|     |<--- u

    Made by `StandardPlant.uncertain`. Each Delta is one uncertain real number with one channel in
    w_Delta and one in z_Delta. A Delta that acts at several places has further channels, such as
    `mode6:freq:rate:w`, which is needed for accelerations.

    Parameters
    ----------
    plant : StandardPlant
        The nominal plant, continuous or sampled.
    kinds : sequence of Uncertainty
        Kinds of its uncertainty.

    Examples
    --------
    >>> import flexplant as fx
    >>> known = fx.testbeds.three_masses().uncertain(frequency=0.01, damping=0.3)
    >>> len(known.machines.drawn(5))  # machines that it may be
    5
    """

    plant: P
    kinds: tuple[Uncertainty, ...]

    @cached_property
    def _known(self) -> list[Known]:
        """What each kind says of the plant."""
        return [kind.known(self.plant) for kind in self.kinds]

    @cached_property
    def _order(self) -> list[int]:
        """The places of the Deltas in order: by stage, then by mode, whatever order was given."""
        every = [delta for known in self._known for delta in known.deltas]
        named: dict[str, int] = {}
        for delta in every:
            if delta.name in named:
                raise ModelError(
                    f"{delta.name} is uncertain twice. Name the modes or ports of each, such as "
                    "plant.Frequencies({4: 0.01}) and plant.Fit(fit, modes=[5, 6])."
                )
            named[delta.name] = delta.mode
        return sorted(
            range(len(every)),
            key=lambda i: (every[i].stage, every[i].mode, isinstance(every[i], DampingDelta)),
        )

    @cached_property
    def deltas(self) -> tuple[Delta, ...]:
        """The Deltas, with those of modes in the order of their numbers."""
        every = [delta for known in self._known for delta in known.deltas]
        return tuple(every[i] for i in self._order)

    @cached_property
    def delta_blocks(self) -> tuple[Block, ...]:
        """The Deltas that are systems or matrices, such as those of `UnmodelledDynamics`."""
        found = [block for kind in self.kinds for block in kind.delta_blocks(self.plant)]
        names = [delta.name for delta in self.deltas] + [block.name for block in found]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ModelError(f"{some_names(twice)} is uncertain twice. Give each a name, name=....")
        return tuple(found)

    def with_blocks(self, system: StateSpace) -> StateSpace:
        """Return a system of the plant whose first channels are those of `delta_blocks`."""
        for kind in self.kinds:
            system = kind.with_blocks(self.plant, system)
        return system

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (m, m) of the m Deltas, which are random numbers when machines are drawn."""
        whole = la.block_diag(np.zeros((0, 0)), *(known.covariance for known in self._known))
        return np.asarray(whole[np.ix_(self._order, self._order)])

    @property
    def deviations(self) -> float:
        """Number of standard deviations at which a delta is 1; the smallest of all kinds."""
        return float(1.0 / np.sqrt(np.diag(self.covariance).max())) if self.deltas else DEVIATIONS

    @cached_property
    def neglected(self) -> NeglectedModes | None:
        """Bound on the effect of neglected modes, as `NeglectedModes`; None without `Neglected`."""
        found = [one for kind in self.kinds if (one := kind.bound(self.plant)) is not None]
        if len(found) > 1:
            raise ModelError("modes are neglected twice. Pass one plant.Neglected, of all of them.")
        return found[0] if found else None

    @cached_property
    def opened(self) -> Opened:
        """The continuous plant with the channels of its Deltas, except for neglected modes."""
        for delta in self.deltas:
            delta.require_in_range(self.deviations)
        base: Partition = self.plant.continuous
        deltas = [self._acting(delta) for delta in self.deltas]
        found = _opened(base, deltas)
        # parameters solve other modes, whose states are not the plant's: gains are compared alone
        own = [one for one in deltas if not isinstance(one, ParameterDelta | DelayDelta)]
        if own:
            _require_exact(base, found if not self.of_matrices else _opened(base, own), own)
        return found

    @cached_property
    def system(self) -> StateSpace:
        """The continuous system with all channels.

        The inputs are, in this order, those of blocks (`u1:dynamics:w`), of Deltas (`mode6:freq:w`)
        and of neglected modes (`die:z:neglected:w`, `y1:neglected:w`), then w and u. The outputs
        are `u1:dynamics:z`, `mode6:freq:z`, `amp1:neglected:z`, `u1:neglected:z`, then z and y.
        """
        system = self.opened.system
        if self.neglected is not None:
            system = with_neglected(system, self.neglected, self.opened.width)
        return self.with_blocks(system)

    def discretized(self, rate: float, *, delay: float = 0.0) -> Self:
        """Return the plant sampled at a rate with the same uncertainty."""
        plant: Any = self.plant
        return self.replace(plant=plant.discretized(rate, delay=delay))

    def at(self, poi: Any = None, **positions: float) -> Self:
        """Return the plant with ports at other places and the same uncertainty."""
        plant: Any = self.plant
        return self.replace(plant=plant.at(poi, **positions))

    def select(self, *, w: Any = None, u: Any = None, z: Any = None, y: Any = None) -> Self:
        """Return the plant with some of its channels and the same uncertainty."""
        plant: Any = self.plant
        return self.replace(plant=plant.select(w=w, u=u, z=z, y=y))

    def through(self, block: Any) -> Any:
        """Return the nominal plant with its uncertainty, read through a block."""
        nominal: Any = self.nominal
        return nominal.through(block)

    def weighted(self, weights: Any = None, *, z: Any = None, w: Any = None) -> Any:
        """Return the nominal plant with its uncertainty and with weights."""
        nominal: Any = self.nominal
        return nominal.weighted(weights, z=z, w=w)

    @property
    def nominal(self) -> P:
        """The nominal plant. Its `uncertainty` is this value, also after weights and blocks.

        Designs and loops use it when they are given an uncertain plant. For an H-infinity design
        write ``uncertain.nominal.through(errors).weighted(z=..., w=...)``.
        """
        return self.plant.replace(uncertainty=self)

    @property
    def frequencies(self) -> dict[int, float]:
        """Relative error of the frequency of each mode at delta = 1, as {mode: share}."""
        # stiffness is off by twice the relative error of the frequency
        return {d.mode: 0.5 * d.scale for d in self.deltas if isinstance(d, FrequencyDelta)}

    @property
    def is_of_frequencies(self) -> bool:
        """Whether nothing but frequencies of modes is uncertain."""
        others = len(self.frequencies) < len(self.deltas) or self.delta_blocks
        return self.neglected is None and not others

    @cached_property
    def of_matrices(self) -> bool:
        """Whether there are Deltas of `Parameters`. Deltas of modes then change M, D and K too."""
        found = any(isinstance(delta, ParameterDelta) for delta in self.deltas)
        if found:
            require_matrices(self.plant)
        return found

    def _acting(self, delta: Delta) -> Delta:
        """Return a Delta as it acts with all others."""
        return delta.of_matrices(self.plant) if self.of_matrices else delta

    @property
    def channels(self) -> dict[str, str]:
        """Name of the Delta of each channel, in order: {`mode6:freq:rate`: `mode6:freq`, ...}."""
        names = iter(self.opened.system.inputs)
        return {
            next(names).removesuffix(":w"): name
            for name, size in self.opened.sizes
            for _ in range(size)
        }

    def __repr__(self) -> str:
        more = f", {self.neglected!r}" if self.neglected is not None else ""
        count = counted(len(self.deltas), "real Delta")
        lines = [f"<UncertainPlant: {count} at {self.deviations:g} std{more}"]
        lines += [f"  {delta.text}" for delta in self.deltas[:6]]
        if len(self.deltas) > 6:
            lines.append(f"  ... and {len(self.deltas) - 6} more")
        lines += [f"  {one.name}, a block of {one.w} x {one.z}" for one in self.delta_blocks]
        return "\n".join(lines) + ">"

    def lft(self, values: Mapping[str, Any] | None = None) -> P:
        """Return the plant at some values of the Deltas, exactly; sampled like the nominal one.

        Parameters
        ----------
        values : mapping {name: float, array or StateSpace}, optional
            Values of the Deltas, such as {"mode6:freq": 0.5}. Deltas that are not named are 0, and
            values beyond 1 are allowed. A block such as `u1:dynamics` takes a number, a matrix or a
            stable system; a continuous system is sampled like the plant (Tustin).

        Raises
        ------
        LabelError, ModelError
            When a Delta is unknown; when a mode would lose its stiffness or its damping would be
            negative.
        """
        hint = "Such as {'" + self.deltas[0].name + "': 0.5}." if self.deltas else ""
        given = {} if values is None else mapping(values, "values of Deltas", hint)
        known = {delta.name: delta for delta in self.deltas}
        blocks = {block.name: block for block in self.delta_blocks}
        require_known("Delta", given, [*known, *blocks])
        changes = [
            (self._acting(known[name]), known[name].scale * number(x, f"the value of {name!r}"))
            for name, x in given.items()
            if name in known
        ]
        machine = with_changes(self.plant, changes) if changes or not blocks else self.plant
        return self._closed(machine, {n: given[n] for n in blocks if n in given})

    def _closed(self, machine: P, values: Mapping[str, Any]) -> P:
        """Return a machine with systems in the places of some blocks."""
        if not values:
            return machine
        own = (block for block in self.delta_blocks if block.name in values)
        parts = [delta_system(block, values[block.name], machine.dt) for block in own]
        system = self.with_blocks(machine.system.replace(blocks=None))
        delta = append(*parts)
        opened = system.select(
            [*delta.inputs, *machine.z, *machine.y], [*delta.outputs, *machine.w, *machine.u]
        )
        return made_of(machine, lft(opened, delta))

    def with_drawn_blocks(self, machine: P, rng: np.random.Generator) -> P:
        """Return a machine with a random system in the place of each of `delta_blocks`."""
        return self._closed(machine, self.drawn_blocks(rng))

    def drawn_blocks(self, rng: np.random.Generator, size: float | None = None) -> dict[str, Any]:
        """Return a random stable system for each of `delta_blocks`, by name.

        The gain of each system is `size`; by default it is random, at most 1.
        """
        poles = self.plant.continuous.system.poles()
        return {
            one.name: drawn_delta(one, rng, poles, rng.uniform() if size is None else size)
            for one in self.delta_blocks
        }

    @property
    def machines(self) -> Any:
        """The machines that the plant may be, drawn at random (see `plant.PlantMachines`)."""
        nominal: Any = self.nominal
        return nominal.machines

    def values(self, rng: np.random.Generator) -> list[tuple[Delta, float]]:
        """Return random values of the Deltas; each kind is drawn from its covariance.

        For a fit, its parameters are drawn in place of the Deltas of its modes. These parameters
        change all modes and mode shapes.
        """
        found: list[tuple[Delta, float]] = []
        for known in self._known:
            deltas, covariance = known.deltas, known.covariance
            if known.drawn is not None:
                deltas, covariance = known.drawn, np.asarray(known.drawn_covariance)
            found += zip(deltas, _normal(rng, covariance).tolist(), strict=True)
        return found

    def drawn_modes(
        self, whole: ModalRealisation, rng: np.random.Generator, drawn: list[tuple[Delta, float]]
    ) -> DrawnModes:
        """Return the modes of one machine at random values of the Deltas of modes."""
        family = whole.once(self, lambda: StatedFamily(whole, self))
        return family.machine(rng, drawn)

    @cached_property
    def larger(self) -> Any:
        """The plant with its neglected modes, from which machines are drawn; None if not known."""
        given = (kind.larger(self.plant) for kind in self.kinds)
        found = [one for one in given if one is not None]
        plant: Any = self.plant
        return found[0] if found else plant.evaluation_plant

    def on(self, plant: P) -> UncertainPlant[P]:
        """Return the same uncertainty of another plant of the same machine.

        Parameters
        ----------
        plant : StandardPlant
            The other plant: sampled, moved or with other ports, for example.
        """
        return self.replace(plant=plant.replace(uncertainty=None))


def made_of(plant: P, system: StateSpace) -> P:
    """Return the plant of a system with a plant's channels, whose states come first in it."""
    factor = plant.origin.noise_factor
    if factor is not None:
        extra = system.n_states - len(factor)
        factor = np.vstack([factor, np.zeros((extra, factor.shape[1]))])
    return type(plant).from_statespace(
        system.replace(units=plant.system.units),
        w=plant.w, u=plant.u, z=plant.z, y=plant.y, asd=plant.asd, noise_factor=factor,
    )  # fmt: skip


def _opened(base: Partition, deltas: Sequence[Delta]) -> Opened:
    """Return a continuous plant with the channels of Deltas, kind by kind."""
    groups: dict[Any, list[Delta]] = {}
    for delta in sorted(deltas, key=lambda one: one.stage):
        groups.setdefault(type(delta).opened.__func__, []).append(delta)  # type: ignore[attr-defined]
    found = Opened(base.system)
    for own in groups.values():
        found = type(own[0]).opened(base, found, own)
    return found


def _require_exact(base: Partition, opened: Opened, deltas: Sequence[Delta]) -> None:
    """Raise ModelError unless the channels give the machine with all Deltas changed at once."""
    values = {d.name: 0.5 if j % 2 else -0.25 for j, d in enumerate(deltas)}

    def lost(chosen: Sequence[Delta]) -> str:
        changes = [(one, values[one.name] * one.scale) for one in chosen]
        own = {one.name: values[one.name] for one in chosen}
        return missed(opened, base.system, with_changes(base, changes).system, own)

    where = lost(deltas)
    if not where:
        return
    cause = next((one for one in deltas if lost([one])), None)
    if cause is None:
        raise ModelError(
            f"{where!r} depends on products of Deltas that the channels of "
            f"{some_names(list(values))} lack. Leave one of these uncertainties out."
        )
    read_off = type(cause).opened.__func__ is Delta.opened.__func__  # type: ignore[attr-defined]
    raise ModelError(
        f"no channels express {cause.name!r}: {lost([cause])!r} is not affine in its amount"
        + (
            ", nor a fraction. Let `changed` follow a straight line between its ends, or give "
            f"{type(cause).__name__} its `opened`."
            if read_off
            else " as displacements, velocities and accelerations are. Give the sensor a `row` and "
            "a quantity, or leave that uncertainty out."
        )
    )


def _normal(rng: np.random.Generator, covariance: FloatArray) -> FloatArray:
    """Draw from N(0, covariance), scaled inside: units differ and it may be singular."""
    std = np.sqrt(np.diag(covariance))
    unit = covariance / np.outer(std, std)
    values, vectors = np.linalg.eigh(0.5 * (unit + unit.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(std * (root @ rng.standard_normal(std.size)))


def understood(given: Any) -> Uncertainty:
    """Return a kind of uncertainty; of a fit, a measurement or a bound what it stands for."""
    if isinstance(given, Uncertainty):
        return given
    if isinstance(given, UpdateResult | ModalUncertainty | MeasuredModes | Machines):
        return Fit(given)
    if isinstance(given, NeglectedModes):
        return Neglected(given)
    raise ModelError(
        "what is not known is a value such as plant.Frequencies(0.005), plant.Gains(0.02), an "
        f"UpdateResult or MeasuredModes, got {type(given).__name__}. flexplant.plant has all kinds."
    )


def uncertain_plant(plant: P, kinds: Sequence[Uncertainty]) -> UncertainPlant[P]:
    """Return a plant with what is not known of it, checked: see `StandardPlant.uncertain`."""
    ordered = sorted(map(understood, kinds), key=lambda kind: type(kind).__name__)
    found: UncertainPlant[P] = UncertainPlant(plant, tuple(ordered))
    bounded = any(isinstance(kind, Neglected) for kind in ordered)
    if not found.deltas and not found.delta_blocks and not bounded:
        raise ModelError(
            "there is nothing uncertain: pass what is not known, such as frequency=0.005, "
            "plant.Gains(0.02), plant.UnmodelledDynamics(weight, at='u1') or a fit."
        )
    _ = found.system  # what no channels express is refused here
    return found
