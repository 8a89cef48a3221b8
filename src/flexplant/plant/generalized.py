"""The generalized plant: a machine between weights and blocks, which synthesis takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import FloatArray, instance, name_list
from ..errors import ModelError, require_known, short
from ..labels import Place
from ..lti.interconnection import append, series
from ..lti.statespace import StateSpace, System, as_statespace, single_channel
from .assumptions import CheckedSystem
from .building import at_rate
from .moving import PositionMap, position_map
from .partitioned import EvaluationModel, PartitionedSystem

_WEIGHTS = "Pass stage_weights(plant, bandwidth), or z={...} and w={...}."
#: fields of the machine, which `replace` changes there
_OF_MACHINE = ("origin", "uncertainty", "evaluation", "measurement")


class Weighable(CheckedSystem):
    """What can be done with a machine, and with weights and blocks around it."""

    def weighted(
        self,
        weights: Any = None,
        *,
        z: Mapping[str, Any] | None = None,
        w: Mapping[str, Any] | None = None,
    ) -> GeneralizedPlant:
        """Return the plant with weights on z and w. Their states are added; channel names stay.

        Parameters
        ----------
        weights : StageWeights, optional
            Result of `stage_weights`, with z and w; the arguments `z` and `w` replace its entries.
        z, w : mapping {name: weight}
            Weights by channel. A weight is a number or a system with one input and one output. A
            continuous weight of a sampled plant is sampled at the plant's rate by Tustin. None
            removes the channel; channels that are not named are unchanged. If the actuator u1 has
            no noise, a weight of `u1:disturbance` in w adds this disturbance. A weight of
            `y1:signal` in z adds the signal of the sensor y1 without its noise.

        Returns
        -------
        GeneralizedPlant
            `W_z P W_w`; its `unweighted` is this plant.

        Raises
        ------
        LabelError, ModelError
            When a name is unknown; when a weight has several inputs or outputs, or another sampling
            time.
        """
        return weighted(self, *both_weights(weights, z, w))

    def through(self, block: System) -> GeneralizedPlant:
        """Return the plant whose measurements are the outputs of a block that reads y.

        The controller may then read errors, decoupled motions or filtered sensors. When you close
        the loop, put the same block before the controller.

        Parameters
        ----------
        block : StateSpace
            Block whose inputs are channels of y. Its outputs become y.

        Raises
        ------
        LabelError, ModelError
            When an input of the block is not in y; when its sampling time differs.
        """
        return measured_through(self, as_statespace(block))

    def map(self, judge: Any = None, *, points: Any = 21) -> PositionMap:
        """Return figures over the positions: decoupling, visibility of modes, and your own ones.

        Parameters
        ----------
        judge : callable or mapping {name: callable}, optional
            Function of the plant at each position that returns a number: ``{"margin": lambda p:
            fx.modulus_margin((p, controller))}``.
        points : int or mapping {name: int or array}
            Number of values of each position over its range, or the values [m or rad].

        Raises
        ------
        LabelError, ModelError
            When the plant has no positions; when it was not assembled from a structure, a value is
            out of range, or a judge gives no number.
        """
        return position_map(self, judge, points)

    def to_control(self) -> Any:
        """Return the whole system as a `control.StateSpace` with the same names."""
        return self.system.to_control()


@dataclass(frozen=True, eq=False, repr=False)
class GeneralizedPlant(Weighable):
    """Plant for a synthesis: a machine P with weights, ``W_z P W_w``, or with blocks at y.

    Made by `StandardPlant.weighted` and `StandardPlant.through`, in any order and number. Once
    weights are applied, w and z are no longer physical channels. Once a block is applied, its
    outputs are the new y. The attribute `unweighted` is the machine without weights and blocks; it
    holds the ports, modes, noise, uncertainty and evaluation model.

    Parameters
    ----------
    system, w, u, z, y, asd : as for `StandardPlant`
    unweighted : StandardPlant
        The machine, before weights and blocks.
    steps : sequence
        Blocks, and weights of z and w, that were applied to the machine, in this order.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> heavy = plant.through(fx.reference_errors(plant)).weighted(fx.stage_weights(plant, 20.0))
    >>> heavy
    <GeneralizedPlant: 9 states, dt 0.0005 s, delay 1, weighted and read through a block>
      w (4) amp  y1:noise  y2:noise  die:ref
      u (1) u1
      z (2) die:error  u1:effort
      y (2) y1:error  y2:error
    >>> heavy.unweighted is plant
    True
    """

    unweighted: Any
    steps: tuple[Any, ...] = ()

    @property
    def machine(self) -> Any:
        """The machine: `unweighted`."""
        return self.unweighted

    @property
    def done(self) -> str:
        """Text of the applied weights and blocks, for the printed plant."""
        return f", {self.alteration}"

    @property
    def scaled(self) -> bool:
        """Whether weights were applied, so that w and z are not physical channels."""
        return not all(isinstance(step, StateSpace) for step in self.steps)

    @property
    def reading(self) -> StateSpace | None:
        """The block from the measurements of the machine to y; None if there is no such block."""
        return self._reading

    @cached_property
    def _reading(self) -> StateSpace | None:
        found: StateSpace | None = None
        for block in self.steps:
            if isinstance(block, StateSpace):
                own = block if block.n_states else block.replace(dt=self.dt)
                before = found and found.select(outputs=own.inputs)
                found = own if before is None else series(before, own)
        return found

    @property
    def alteration(self) -> str:
        """Weights and blocks that were applied to the machine, in words."""
        done = ["weighted"] if self.scaled else []
        done += ["read through a block"] if self.reading is not None else []
        return " and ".join(done)

    @property
    def reading_gain(self) -> FloatArray:
        """The gain (ny, ny of the machine) from the measurements of the machine to y.

        ModelError when the block has dynamics.
        """
        machine, reading = self.unweighted, self.reading
        if reading is None:
            return np.eye(len(machine.y))
        if reading.n_states:
            raise ModelError(
                f"the block that the plant is read through has {reading.n_states} states, so that "
                "noise of its outputs is not white. Give the dynamics to the sensors, "
                "Sensor(dynamics=...), or use plant.unweighted."
            )
        gain = np.zeros((len(self.y), len(machine.y)))
        gain[:, [machine.y.index(name) for name in reading.inputs]] = reading.D
        return gain

    @property
    def noise_factor(self) -> FloatArray:
        """Matrix G (n, r): white disturbances add the covariance G G' to x in one sample.

        It equals that of the machine if only a static block was applied; otherwise ModelError.
        """
        if self.scaled:
            raise ModelError(
                "the plant is weighted: its w are not physical noise, so that the process noise of "
                "each sample is not known. Use plant.unweighted."
            )
        _ = self.reading_gain  # static: the states are those of the machine
        found: FloatArray = self.unweighted.noise_factor
        return found

    @property
    def uncertainty(self) -> Any:
        """The uncertainty of the machine."""
        return self.unweighted.uncertainty

    @property
    def evaluation(self) -> EvaluationModel | None:
        """The evaluation model of the machine."""
        found: EvaluationModel | None = self.unweighted.evaluation
        return found

    @cached_property
    def evaluation_plant(self) -> GeneralizedPlant | None:
        """The evaluation model of the machine with the same weights and blocks, or None."""
        whole = self.unweighted.evaluation_plant
        return None if whole is None else self.around(whole)

    def around(self, machine: Any) -> GeneralizedPlant:
        """Return the same weights and blocks around another machine with the same channels."""
        return _applied(machine, self.steps)  # type: ignore[no-any-return]

    def _all_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return changes of fields; those of the machine are changed there."""
        own = {name: value for name, value in changes.items() if name in _OF_MACHINE}
        rest = {name: value for name, value in changes.items() if name not in _OF_MACHINE}
        return rest | ({"unweighted": self.unweighted.replace(**own)} if own else {})

    def select(
        self,
        *,
        w: Sequence[str] | None = None,
        u: Sequence[str] | None = None,
        z: Sequence[str] | None = None,
        y: Sequence[str] | None = None,
    ) -> GeneralizedPlant:
        """Return the plant with some channels; a side without names keeps all of its channels.

        w, z and y are exactly the channels that are named. If an actuator is left out, its effort
        and its noise are left out too. LabelError when a name is not a channel of that side.
        """
        found = self if u is None else self.around(self.unweighted.select(u=u))
        if w is not None or z is not None:
            found = weighted(found, _dropped(found, "z", z), _dropped(found, "w", w))
        if y is not None:
            names = name_list(y, "y")
            require_known("channel of y", names, found.y)
            gain = StateSpace([], [], [], np.eye(len(names)), found.dt, inputs=names, outputs=names)
            found = measured_through(found, gain)
        return found

    def discretized(self, rate: float, *, delay: float = 0.0) -> GeneralizedPlant:
        """Return the weights and blocks around the machine sampled at a rate (Tustin).

        Parameters are those of `StandardPlant.discretized`. ModelError when a weight or a block is
        sampled already at another rate.
        """
        return self.around(self.unweighted.discretized(rate, delay=delay))

    def at(
        self, poi: Place | Mapping[str, Place] | None = None, **positions: float
    ) -> GeneralizedPlant:
        """Return the weights and blocks around the machine at a place, as `StandardPlant.at`."""
        return self.around(self.unweighted.at(poi, **positions))

    def uncertain(
        self, *given: Any, frequency: Any = None, damping: Any = None
    ) -> GeneralizedPlant:
        """Return the weights and blocks around the machine with its uncertainty.

        Parameters are those of `StandardPlant.uncertain`.
        """
        known = self.unweighted.uncertain(*given, frequency=frequency, damping=damping)
        return self.around(known.nominal)


def both_weights(
    weights: Any, z: Mapping[str, Any] | None, w: Mapping[str, Any] | None
) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
    """Return the weights of z and of w; those that are given replace those of a set."""
    if weights is None:
        return z, w
    if not isinstance(getattr(weights, "z", None), Mapping):
        raise ModelError(f"weights must be StageWeights, got {short(weights)}. {_WEIGHTS}")
    return {**weights.z, **(z or {})}, {**weights.w, **(w or {})}


def weighted(plant: PartitionedSystem, z: Any, w: Any) -> GeneralizedPlant:
    """Return ``W_z P W_w``; a weight None drops its channel, a push at u or a signal is added."""
    z, w = _mapping(z, "z"), _mapping(w, "w")
    added = [name for name in pushes(plant) if w.get(name) is not None]
    require_known("channel of z", z, [*plant.z, *signals(plant)])
    plant = _shown(plant, [name for name in signals(plant) if z.get(name) is not None])
    require_known("channel of w", w, [*plant.w, *pushes(plant)])
    keep_z = [name for name in plant.z if name not in z or z[name] is not None]
    keep_w = [name for name in (*plant.w, *added) if name not in w or w[name] is not None]
    if not keep_z or not keep_w:
        raise ModelError("all of z or w was left out: keep at least one channel of each.")
    inner = _pushed(plant.system, added).select([*keep_z, *plant.y], [*keep_w, *plant.u])
    before, after = (
        append(
            *(_weight(plant, side.get(name, 1.0), name) for name in kept), _identity(plant, rest)
        )
        for side, kept, rest in ((w, keep_w, plant.u), (z, keep_z, plant.y))
    )
    system = series(series(before, inner), after)
    step = tuple(z.items()), tuple(w.items())
    return GeneralizedPlant(
        system.replace(name=plant.system.name), tuple(keep_w), plant.u, tuple(keep_z), plant.y, {},
        plant.machine, (*_steps(plant), step),
    )  # fmt: skip


def pushes(plant: PartitionedSystem) -> dict[str, str]:
    """Return the actuators of the disturbances `u1:disturbance` that are not channels of w."""
    own = {f"{name}:disturbance": name for name in plant.u}
    return {channel: name for channel, name in own.items() if channel not in plant.w}


def _pushed(system: StateSpace, added: Sequence[str]) -> StateSpace:
    """Return a system with disturbances that add to the commands of actuators."""
    if not added:
        return system
    own = system.input_index([name.removesuffix(":disturbance") for name in added])
    direct = system.D[:, own]
    direct[[name.endswith(":effort") for name in system.outputs]] = 0.0  # an effort is a command
    return system.replace(
        B=np.hstack([system.B, system.B[:, own]]),
        D=np.hstack([system.D, direct]),
        inputs=[*system.inputs, *added],
    )


def signals(plant: PartitionedSystem) -> dict[str, str]:
    """Return the sensors of the signals without noise, `y1:signal`, that are not channels of z."""
    own = {f"{sensor.name}:signal": sensor.name for sensor in plant.ports.y}
    return {channel: name for channel, name in own.items() if channel not in plant.z}


def _shown(plant: PartitionedSystem, added: Sequence[str]) -> PartitionedSystem:
    """Return a plant with signals of sensors in z, behind the same weights and blocks."""
    if not added:
        return plant
    machine = plant.machine
    g, count = machine.system, len(machine.z)
    names = [name for name in plant.z if name in signals(machine)] + list(added)
    sensors = [signals(machine)[name] for name in names]
    rows = g.output_index(sensors)
    direct = g.D[rows]
    direct[:, [name.endswith(":noise") for name in g.inputs]] = 0.0
    z, shown = (*machine.z, *names), zip(names, sensors, strict=True)
    system = g.replace(
        C=np.insert(g.C, count, g.C[rows], axis=0),
        D=np.insert(g.D, count, direct, axis=0),
        outputs=[*z, *machine.y],
        units=g.units | {name: g.units[own] for name, own in shown if own in g.units},
    )
    whole = GeneralizedPlant(system, machine.w, machine.u, z, machine.y, machine.asd, machine)
    return _applied(whole, _steps(plant))  # type: ignore[no-any-return]


def _applied(plant: Any, steps: Sequence[Any]) -> Any:
    """Return a plant with weights and blocks, in their order."""
    for step in steps:
        if isinstance(step, StateSpace):
            plant = measured_through(plant, at_rate(step, "y", plant.dt))
        else:
            z, w = map(dict, step)  # a selection may have taken channels away
            shown, pushed = {*plant.z, *signals(plant)}, {*plant.w, *pushes(plant)}
            kept = {name: weight for name, weight in z.items() if name in shown}
            plant = weighted(plant, kept, {n: own for n, own in w.items() if n in pushed})
    return plant


def _dropped(plant: PartitionedSystem, side: str, names: Sequence[str] | None) -> dict[str, None]:
    """Return the weight None of every channel of a side that is not among some names."""
    own = getattr(plant, side)
    if names is None:
        return {}
    require_known(f"channel of {side}", name_list(names, side), own)
    return {name: None for name in own if name not in names}


def _steps(plant: PartitionedSystem) -> tuple[Any, ...]:
    """Return what was applied to the machine of a plant."""
    return plant.steps if isinstance(plant, GeneralizedPlant) else ()


def _mapping(weights: Any, side: str) -> dict[str, Any]:
    if weights is None:
        return {}
    instance(
        weights, Mapping, f"weights of {side}", "{'die:error': lti.inverse_sensitivity(30.0)}, say."
    )
    return {
        name: None if weight is None else as_statespace(weight) for name, weight in weights.items()
    }


def measured_through(plant: PartitionedSystem, block: StateSpace) -> GeneralizedPlant:
    """Return the plant with y read through a block."""
    require_known("channel of y", block.inputs, plant.y)
    inner = plant.system.select([*plant.z, *block.inputs])
    after = append(
        _identity(plant, plant.z), block if block.n_states else block.replace(dt=plant.dt)
    )
    return GeneralizedPlant(
        series(inner, after).replace(name=plant.system.name), plant.w, plant.u, plant.z,
        tuple(block.outputs), plant.asd, plant.machine, (*_steps(plant), block),
    )  # fmt: skip


def _weight(plant: PartitionedSystem, weight: Any, name: str) -> StateSpace:
    sys = at_rate(single_channel(weight, f"the weight of {name!r}"), name, plant.dt)
    states = [f"{name}|{state}" for state in sys.states]
    return sys.replace(inputs=[name], outputs=[name], states=states)


def _identity(plant: PartitionedSystem, names: tuple[str, ...]) -> StateSpace:
    gain = as_statespace(np.eye(len(names)))
    return gain.replace(dt=plant.dt, inputs=names, outputs=names)
