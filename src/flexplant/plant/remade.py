"""Plants made of plants: with other ports, with some of the channels, or of other modes."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from ..errors import FlexplantWarning, LabelError, ModelError, require_known, some_names
from ..lti.sampling import acting
from ..lti.statespace import StateSpace, as_statespace
from ..store import Value
from ..tolerances import SAME
from ..words import name_list
from .building import (
    P,
    changed_densities,
    continuous_plant,
    loud_like,
    sampled,
    sampled_like,
    warn_of_another_body,
    wired,
    with_modes,
)
from .evaluation_model import EvaluationModel
from .forces import Actuator
from .origins import Assembled, Foreign, PlantChannel
from .partitioned import Partition
from .port import ForcePort, SensorPort
from .ports import Poi, Ports
from .realisation import ModalRealisation, plant_modes

Port: TypeAlias = ForcePort | SensorPort | Poi


@dataclass(frozen=True, eq=False, repr=False)
class MachineParts(Value):
    """Parts of a machine from which its plant is made: modes, ports, delay.

    The Deltas (normalised uncertain numbers) of a plant change these parts.

    Parameters
    ----------
    plant : StandardPlant
        The nominal plant.
    realisation : ModalRealisation
        Modes of the structure; their blocks of A are replaced by `pairs`.
    pairs : (b, 2, 2) array [rad/s]
        Diagonal blocks of A, one for each mode.
    ports : Ports
        Ports of the machine; `with_port` and `with_gain` change one of them.
    model : FEModel or ReducedModel, optional
        A model with other matrices, whose modes are then solved again in place of `realisation`.
    late : float [samples]
        Change of the delay of the actuators, relative to the nominal plant.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> machine = fx.plant.MachineParts.of(plant).with_gain("u1", 1.1)
    >>> machine.assembled().Gyu.D.shape == plant.Gyu.D.shape
    True
    """

    plant: Partition
    realisation: ModalRealisation
    pairs: FloatArray
    ports: Ports
    model: Any = None
    late: float = 0.0

    @classmethod
    def of(cls, plant: Partition) -> MachineParts:
        """Return the parts of a plant, which are those of the nominal machine."""
        own = plant.assembled
        return cls(plant, own.realisation, own.realisation.pairs, own.ports)

    def with_port(self, port: Port) -> MachineParts:
        """Return the machine with another port in place of the one with the same name."""
        side = [port if one.name == port.name else one for one in getattr(self.ports, port.home)]
        return self.replace(ports=self.ports.replace(**{port.home: side}))

    def with_gain(self, name: str, gain: float) -> MachineParts:
        """Return the machine with the gain of an actuator or sensor multiplied by a number."""
        every: tuple[Actuator | SensorPort, ...] = (*self.ports.u, *self.ports.y)
        port = next(one for one in every if one.name == name)
        part = as_statespace([[1.0]]) if port.dynamics is None else port.dynamics
        # states as before: a command is scaled before the filter, a reading behind it
        driven = {"B": gain * part.B} if isinstance(port, ForcePort) else {"C": gain * part.C}
        return self.with_port(port.replace(dynamics=part.replace(D=gain * part.D, **driven)))

    def assembled(self) -> Any:
        """Return the plant of the machine, with the sampling of the nominal plant."""
        plant, realisation = self.plant, self.realisation
        if self.model is not None:
            with warnings.catch_warnings():  # the nominal plant has said in which form it is
                warnings.simplefilter("ignore", FlexplantWarning)
                realisation = plant_modes(self.model)
        elif not np.array_equal(self.pairs, realisation.pairs):
            realisation = realisation.replace(pairs=self.pairs)
        ports = None if self.ports is plant.assembled.ports else self.ports
        if not self.late:
            return rebuilt(plant, ports=ports, realisation=realisation)
        fresh = rebuilt(plant.continuous, ports=ports, realisation=realisation)
        return sampled(fresh, 1.0 / plant.dt, plant.delay + self.late)


def rebuilt(
    plant: P, *, ports: Ports | None = None, realisation: ModalRealisation | None = None
) -> P:
    """Return a plant with other ports or of other modes, sampled like the old one."""
    if isinstance(plant.origin, Foreign) and isinstance(ports, Ports) and realisation is None:
        if not all(isinstance(port, PlantChannel) for port in (*ports.physical, *ports.z)):
            _ = plant.assembled  # other ports need a structure
        kept = {"u": [port.name for port in ports.u], "y": [port.name for port in ports.y]}
        return selected(plant, {"w": None, "z": None, **kept})
    # ports that are among its own are rows and columns of it
    own, judged = plant.assembled, _evaluation_of_rebuilt(plant, ports, realisation)
    if isinstance(ports, Ports) and realisation is None and not changed_densities(plant):
        found = with_ports_of(own, ports)
        if found is not None:
            before = own.continuous
            whole = None if before is None else rebuilt(before, ports=ports)
            return wired(type(plant), found.replace(continuous=whole), judged)
    if ports is None and realisation is not None and _moves_alike(own, realisation):
        fresh = wired(type(plant), with_modes(plant.continuous.assembled, realisation), judged)
    else:
        modes = own.realisation if realisation is None else realisation
        fresh = continuous_plant(type(plant), modes, own.ports if ports is None else ports, judged)
    return sampled_like(plant, loud_like(plant, fresh))


def _evaluation_of_rebuilt(
    plant: Partition, ports: object, realisation: ModalRealisation | None
) -> EvaluationModel | None:
    """Return the evaluation model of a plant that gets other ports or other modes."""
    judged = plant.evaluation
    if judged is None:
        return None
    if isinstance(ports, Ports):
        judged = judged.with_ports(ports)
    if realisation is None:
        return judged
    # other modes are another machine, which the evaluation model does not describe. What a reduced
    # model left out follows a change of that model
    if judged.source is not plant.model:
        return None
    return (
        judged if realisation.model is plant.model else EvaluationModel.known_to(realisation.model)
    )


def selected(plant: P, names: Mapping[str, Iterable[str] | None]) -> P:
    """Return a plant with some of its channels, by side; None keeps all of a side."""
    kept = {}
    for side, given in names.items():
        own = getattr(plant, side)
        kept[side] = own if given is None else name_list(given, side)
        require_known(f"channel of {side}", kept[side], own)
    if isinstance(plant.origin, Foreign):
        return _with_rows(plant, kept)
    own = plant.ports
    axes = {poi.name: _axes_among(poi, kept["z"]) for poi in own.z}
    u = [port for port in own.u if port.name in kept["u"]]
    y = [port for port in own.y if port.name in kept["y"]]
    seen = {port.name for port in y}
    w = [p for p in own.w if p.name in kept["w"] and (p.added_to is None or p.added_to in seen)]
    z = [poi.replace(axes=axes[poi.name]) for poi in own.z if axes[poi.name]]
    references = []
    for one in own.references:
        left = [axis for poi, axis in own.followed if poi.name == one.poi and axis in axes[one.poi]]
        references += [one.replace(axes=left)] if left else []
    return rebuilt(plant, ports=own.replace(w=w, u=u, z=z, y=y, references=references))


def _axes_among(poi: Poi, names: Sequence[str]) -> list[str]:
    """Return the axes of a POI whose motion or error is among some channels."""
    shown = {axis: {poi.channel(axis), poi.derived(axis, "error")} for axis in poi.axes}
    return [axis for axis, own in shown.items() if own & set(names)]


def _with_rows(plant: P, kept: Mapping[str, Sequence[str]]) -> P:
    """Return foreign matrices with some of their rows and columns."""
    gone = {f"{name}:noise" for name in plant.y if name not in kept["y"]}
    gone |= {f"{name}:effort" for name in plant.u if name not in kept["u"]}
    derived = {name for name in (*plant.w, *plant.z) if name.endswith((":noise", ":effort"))}
    derived |= set(plant.w) & set(plant.y)  # references
    w, u, z, y = (
        [n for n in getattr(plant, side) if n not in gone and (n in kept[side] or n in derived)]
        for side in "wuzy"
    )
    asd = {name: size for name, size in plant.asd.items() if name in w}
    judged: Any = plant
    whole = judged.evaluation_plant
    return plant.replace(
        system=plant.system.select([*z, *y], [*w, *u]), w=w, u=u, z=z, y=y, asd=asd,
        evaluation=None if whole is None else selected(whole, kept),
    )  # fmt: skip


def _moves_alike(own: Assembled, realisation: ModalRealisation) -> bool:
    """Return whether modes differ from a plant's in their poles alone, and its ports by them in A.

    What a velocity or an acceleration shows of a mode hangs on its poles.
    """
    before = own.realisation
    same = all(
        getattr(realisation, name) is value or np.array_equal(getattr(realisation, name), value)
        for name, value in before._fields().items()
        if name != "pairs"
    )
    held = set(before.names) <= set(own.physical.states)
    return same and held and not any(sensor.order for sensor in own.ports.y)


def with_ports_of(own: Assembled, ports: Ports) -> Assembled | None:
    """Return a plant's origin with some of its sensors, actuators and POIs in their order."""
    # None for ports that are others or in another order, or whose noise the states hold mixed
    if not _among(ports, own.ports):
        return None
    outputs = ports.motions
    inputs = [*(port.name for port in ports.forces), *ports.input_noises]
    if not inputs or not outputs:
        return None
    modes = np.isin(own.physical.states, own.realisation.names)
    chosen = own.physical.select(outputs, inputs)
    reached = acting(own.physical.A != 0)
    stay = modes | _linked(chosen, reached, modes) | ~_linked(own.physical, reached, modes)
    factor = own.noise_factor
    return own.replace(
        ports=ports,
        physical=_with_states(chosen, stay),
        noise_factor=None if factor is None else factor[stay],
    )


def _among(ports: Ports, own: Ports) -> bool:
    """Return whether the ports are some of a plant's own, in their order, without lost noise."""
    some = _is_subsequence(ports.u, own.u) and _is_subsequence(ports.y, own.y)
    same = len(ports.w) == len(own.w) and _is_subsequence(ports.w, own.w)
    noisy = own.input_noises.keys() == ports.input_noises.keys()
    known = {poi.name: poi for poi in own.z}
    return some and same and noisy and all(_is_part(poi, known.get(poi.name)) for poi in ports.z)


def _is_subsequence(ports: Sequence[Value], own: Sequence[Value]) -> bool:
    """Return whether all of some ports are among others, in their order."""
    left = iter(own)
    return all(any(port is other for other in left) for port in ports)


def _is_part(poi: Poi, own: Poi | None) -> bool:
    """Return whether a POI is one of the plant's, or has some of its axes."""
    if own is None or not set(poi.axes) <= set(own.axes):
        return False
    return poi is own or own.replace(axes=poi.axes)._fields() == poi._fields()


def _linked(
    g: StateSpace, reached: npt.NDArray[np.bool_], modes: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Return which states an input or a mode acts on and an output or a mode sees."""
    driven = reached @ (np.any(g.B, axis=1) | modes)
    return np.asarray(driven & ((np.any(g.C, axis=0) | modes) @ reached))


def _with_states(g: StateSpace, stay: npt.NDArray[np.bool_]) -> StateSpace:
    """Return a system without some of its states, which nothing reaches or nothing shows."""
    if np.all(stay):
        return g
    blocks = None
    if g.blocks is not None:
        owner = np.repeat(np.arange(len(g.blocks)), g.blocks)
        sizes = np.bincount(owner[stay], minlength=len(g.blocks))
        blocks = sizes[sizes > 0].tolist()
    return g.replace(
        A=g.A[np.ix_(stay, stay)],
        B=g.B[stay],
        C=g.C[:, stay],
        states=[name for name, kept in zip(g.states, stay.tolist(), strict=True) if kept],
        blocks=blocks,
    )


def check_channels(plant: Partition, other: Partition) -> None:
    """Raise LabelError unless an evaluation model that is a plant has the plant's channels."""
    for side in "wuzy":
        own, others = getattr(plant, side), getattr(other, side)
        if own != others:
            raise LabelError(
                f"the evaluation model has other channels in {side}: {some_names(others)}, the "
                f"plant has {some_names(own)}. Assemble both with the same ports."
            )


def own_plant(kind: type[P], model: EvaluationModel) -> P:
    """Return the plant that is an evaluation model, with the ports that it got since."""
    found = kind.of(model.source)
    return found if model.ports is None else rebuilt(found, ports=model.ports)


def matched(plant: P, model: EvaluationModel) -> P:
    """Return the evaluation plant of a plant whose evaluation model is a plant."""
    other = own_plant(type(plant), model)
    check_channels(plant, other)
    other = other.replace(evaluation=None)
    if plant.dt and not other.dt:
        other = sampled_like(plant, other)
    same = bool(np.isclose(other.dt, plant.dt, rtol=SAME, atol=0.0))
    if not same or other.delay != plant.delay:
        raise ModelError(
            f"the evaluation model has dt {other.dt:g} s and delay {other.delay:g}, the plant "
            f"{plant.dt:g} s and {plant.delay:g}: their responses could not be compared. Pass it "
            "continuous, or sampled like the plant."
        )
    warn_of_another_body(plant, other)
    return other
