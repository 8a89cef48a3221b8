"""A system partitioned into w, u, z and y, the base of all plants, and its evaluation model."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, TypeGuard

import numpy as np

from ..arrays import FloatArray, IntArray, instance, mapping, name_list, positive, real_array
from ..errors import (
    AssumptionError,
    FlexplantError,
    LabelError,
    ModelError,
    counted,
    require_known,
    short,
    some_names,
    unknown_label,
)
from ..lti.statespace import StateSpace, System, as_statespace
from ..modes import Modes
from ..reduction import ReducedModel
from ..store import Value
from ..structure import FEModel
from ..structure.rigid import Structure
from .origins import (
    ELSEWHERE,
    TYPE_THIS,
    Assembled,
    Foreign,
    MeasuredResponse,
    Origin,
    PlantChannel,
    sides_of,
)
from .ports import Ports
from .realisation import MODAL, ModalRealisation, plant_modes


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedSystem(Value):
    """A system ``[w; u] -> [z; y]`` by the names of its channels.

    Parameters
    ----------
    system : StateSpace
    w, u, z, y : sequences of str
    asd : mapping {str: float}
        One-sided amplitude spectral density of the w channels that are white noise.
    """

    system: StateSpace
    w: tuple[str, ...]
    u: tuple[str, ...]
    z: tuple[str, ...]
    y: tuple[str, ...]
    asd: Mapping[str, float]

    def __post_init__(self) -> None:
        for side in "wuzy":
            self._set(**{side: tuple(getattr(self, side))})
        if (*self.w, *self.u) != tuple(self.system.inputs):
            raise LabelError(f"inputs {self.system.inputs} are not [w; u] = {self.w + self.u}.")
        if (*self.z, *self.y) != tuple(self.system.outputs):
            raise LabelError(f"outputs {self.system.outputs} are not [z; y] = {self.z + self.y}.")
        if both := [name for name in self.u if name in self.y]:
            raise LabelError(
                f"{short(both)} are names in u and in y: loops, filters and controllers connect "
                "channels by name, and would take a command for a measurement. Rename the "
                "actuators or the sensors."
            )
        require_known("w channel with an asd", self.asd, self.w)
        asd = {name: positive(a, f"asd of {name!r}", zero=True) for name, a in self.asd.items()}
        self._set(asd=asd)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed; it is checked like a new plant.

        If you change `asd`, the noise of each sample changes with it. Plants that are made from the
        copy have these densities too: at other places, with other modes, or with other ports of the
        same densities.
        """
        return super().replace(**self._all_changes(changes))

    def _all_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return changes of fields with what follows from them."""
        return changes

    @property
    @abstractmethod
    def machine(self) -> Any:
        """The machine: the plant itself, or what it was before weights and blocks."""

    @property
    def has_own_modes(self) -> bool:
        """Whether the states belong to modes that each have one frequency and one damping."""
        return False

    @property
    def reading(self) -> StateSpace | None:
        """The block from the measurements of the machine to y; None when y are the measurements."""
        return None

    @property
    def done(self) -> str:
        """Weights and blocks that were applied to the machine, as text."""
        return ""

    @property
    def noise_factor(self) -> FloatArray:
        """Factor G (n, r) of the covariance G G' that white disturbances add to x in one sample."""
        raise NotImplementedError

    @property
    def reading_gain(self) -> FloatArray:
        """The gain (ny, ny of the machine) from the machine's measurements to y."""
        raise NotImplementedError

    @property
    def delay(self) -> float:
        """Delay of the inputs u [samples]."""
        found: float = self.machine.origin.delay
        return found

    def __repr__(self) -> str:
        time = f"dt {self.dt:g} s, delay {self.delay:g}" if self.dt else "continuous"
        named = f" {self.system.name!r}" if self.system.name else ""
        states = counted(self.system.n_states, "state")
        lines = [f"<{type(self).__name__}{named}: {states}, {time}{self.done}>"]
        for side in "wuzy":
            names = getattr(self, side)
            shown = "  ".join(names[:8]) + ("  ..." if len(names) > 8 else "")
            lines.append(f"  {side} ({len(names)}) {shown}")
        latencies = self.ports.latencies
        if latencies and not self.dt:
            shown = ", ".join(f"{name} {late:g} s" for name, late in latencies.items())
            lines.append(f"  latencies that act once it is sampled: {shown}")
        if self.ports.positions:
            lines.append(f"  at {self.ports.standing}")
        if self.form.startswith("dense"):
            lines.append(f"  {self.form}")
        if self.machine.evaluation is not None:
            lines.append(f"  evaluation model: {self.machine.evaluation.text}")
        if self.unstable_modes:
            lines.append(f"  unstable rigid-body pairs: {self.unstable_text}")
        return "\n".join(lines)

    @property
    def ports(self) -> Ports:
        """The ports of the machine; for other systems, names of actuators and sensors."""
        found: Ports = self.machine.origin.ports
        return found

    @property
    def realisation(self) -> ModalRealisation:
        """The modes of the machine's structure; a plant of other origin has no known modes."""
        found: ModalRealisation = self.machine.origin.realisation
        return found

    @property
    def assembled(self) -> Assembled:
        """Parts of the assembly: ports, realisation, noise, delay, and the plant before sampling.

        ModelError when the plant was not assembled from a structure.
        """
        found = self.machine.origin
        if not isinstance(found, Assembled):
            raise ModelError(
                "this plant was not assembled from a structure: its ports, modes and process noise "
                "are not known. Make it by assemble_plant(model, ports)."
            )
        return found

    @property
    def unjudged(self) -> str:
        """Remark of results on this plant if it has no evaluation model; otherwise empty.

        A plant that was assembled from a full FEModel lacks no modes and has no larger model.
        """
        complete = isinstance(self.model, FEModel)
        return "" if complete or self.machine.evaluation is not None else NOT_JUDGED

    @property
    def dt(self) -> float:
        """Sampling time [s]; 0 when continuous."""
        return self.system.dt

    @property
    def units(self) -> dict[str, str]:
        """The units of the channels, and of derived ones such as estimates."""
        return self.ports.units | dict(self.system.units)

    @property
    def n_rigid(self) -> int:
        """Number of rigid-body modes."""
        return self.realisation.n_rigid

    @property
    def form(self) -> str:
        """Form of A: `modal blocks`, `dense: ` with the reason, or `as given` without a structure.

        Weights and filters of the ports add further blocks.
        """
        return self.realisation.form

    @property
    def model(self) -> Any:
        """The structural model that the plant was assembled from, or None."""
        return self.realisation.model

    @property
    def modal_blocks(self) -> FloatArray:
        """The (b, 2, 2) blocks of the structure's modes [rad/s] before sampling; may be empty."""
        return self.realisation.pairs

    @property
    def unstable_modes(self) -> dict[int, str]:
        """Modes (counted from 1) that negative stiffness makes unstable, with their two poles."""
        found = {}
        for i in np.flatnonzero(np.linalg.det(self.modal_blocks) < 0).tolist():
            low, high = np.sort(np.linalg.eigvals(self.modal_blocks[i]).real)
            found[i + 1] = f"mode {i + 1} ({high:+.4g} and {low:+.4g} 1/s)"
        return found

    @property
    def unstable_text(self) -> str:
        """The first three unstable modes in words, and the number of the others."""
        listed = list(self.unstable_modes.values())
        more = f" and {len(listed) - 3} more" if len(listed) > 3 else ""
        return ", ".join(listed[:3]) + more

    @property
    def modal_states(self) -> IntArray:
        """Indices of the states of the structure's modes; states of sensor filters precede them.

        ModelError when the plant has other states now.
        """
        names = self.realisation.names
        if not names:
            return np.zeros(0, dtype=np.int64)
        if names[0] not in self.system.states:
            raise ModelError(f"the plant has lost the states of its modes ({names[0]!r}, ...).")
        first = self.system.states.index(names[0])
        return np.arange(first, first + len(names), dtype=np.int64)

    @property
    def held(self) -> tuple[str, ...]:
        """Disturbances whose noise is held over each sample, the last columns of `noise_factor`."""
        return tuple(p.name for p in self.ports.w if getattr(p, "held", False) and p.asd > 0)

    @property
    def noise_direct(self) -> FloatArray:
        """Gain H (ny, r) from the noises of `noise_factor` to y in the same sample."""
        found = np.zeros((len(self.y), self.noise_factor.shape[1]))
        if held := self.held:
            sizes = np.array([self.asd.get(name, 0.0) for name in held]) * np.sqrt(0.5 / self.dt)
            columns = [self.w.index(name) for name in held]
            found[:, -len(held) :] = self.D21[:, columns] * sizes
        return found

    @property
    def process_noise(self) -> FloatArray:
        """Covariance (n, n) that white disturbances add to x in one sample."""
        return self.noise_factor @ self.noise_factor.T

    @property
    def sensor_noise(self) -> FloatArray:
        """Covariance (ny, ny) of a sample of y: asd^2 rate / 2 for each sensor.

        If R is this covariance and y is read through a static block T, it is ``T R T'``.
        """
        return self.sensor_noise_factor @ self.sensor_noise_factor.T

    @property
    def sensor_noise_factor(self) -> FloatArray:
        """Factor F (ny, sensors) of the covariance F F' of a sample of y."""
        require_sampled(self, "sensors have a noise of each sample", ModelError)
        asd = [self.asd.get(f"{name}:noise", 0.0) for name in self.machine.y]
        return np.asarray(self.reading_gain * (np.array(asd) * np.sqrt(0.5 / self.dt)))

    def channel(self, name: str, side: str = "z") -> str:
        """Return the channel of `side` that a name means: `die` or `die:hat` mean `die:z`.

        LabelError when the name does not mean a channel.
        """
        names: tuple[str, ...] = getattr(self, side)
        if not isinstance(name, str) or name in names:
            require_known("channel", [name], names)
            return name
        for poi in self.ports.z:
            for axis in poi.axes:
                aliases = (poi.derived(axis, "hat"), poi.derived(axis, "error"))
                if name in aliases or (name == poi.name and axis == poi.axes[0]):
                    return poi.channel(axis)
        raise unknown_label(f"channel of {side}", name, names)

    B1 = property(lambda self: self.system.B[:, : len(self.w)], doc="w to dx/dt.")
    B2 = property(lambda self: self.system.B[:, len(self.w) :], doc="u to dx/dt.")
    C1 = property(lambda self: self.system.C[: len(self.z)], doc="x to z.")
    C2 = property(lambda self: self.system.C[len(self.z) :], doc="x to y.")
    D11 = property(lambda self: self.system.D[: len(self.z), : len(self.w)], doc="w to z.")
    D12 = property(lambda self: self.system.D[: len(self.z), len(self.w) :], doc="u to z.")
    D21 = property(lambda self: self.system.D[len(self.z) :, : len(self.w)], doc="w to y.")
    D22 = property(lambda self: self.system.D[len(self.z) :, len(self.w) :], doc="u to y.")
    Gzw = property(lambda self: self.system.select(self.z, self.w), doc="The system w -> z.")
    Gzu = property(lambda self: self.system.select(self.z, self.u), doc="The system u -> z.")
    Gyw = property(lambda self: self.system.select(self.y, self.w), doc="The system w -> y.")
    Gyu = property(lambda self: self.system.select(self.y, self.u), doc="The system u -> y.")


def require_sampled(
    plant: PartitionedSystem, why: str, error: type[FlexplantError] = AssumptionError
) -> None:
    """Refuse a continuous plant."""
    if not plant.dt:
        raise error(f"the plant is continuous: {why}. Use plant.discretized(rate, delay=1).")


def require_noise(sizes: Mapping[str, float]) -> None:
    """Refuse sensors whose noise has no size."""
    if silent := [name for name, size in sizes.items() if not size > 0]:
        raise AssumptionError(
            f"sensors {some_names(silent)} have no noise (asd 0): filters would trust them without "
            "limit and differentiate them. Give Sensor(..., asd=) what the data sheet says."
        )


def is_system(given: object) -> TypeGuard[System]:
    """Return whether it is a system with labels: ours, or one of python-control."""
    return isinstance(given, StateSpace) or hasattr(given, "input_labels")


def is_plant(given: object) -> TypeGuard[PartitionedSystem | System]:
    """Return whether it is a plant or a system with labels, not a structure."""
    if isinstance(given, FEModel | Modes | ReducedModel):
        return False  # `hasattr` is slow here: it makes the message with similar names
    return isinstance(given, PartitionedSystem) or is_system(given)


#: what a result of a plant without an evaluation model says
NOT_JUDGED = "not judged on a larger model"
_HINT = "Pass Modes, an FEModel, a ReducedModel or a StandardPlant."


@dataclass(frozen=True, eq=False)
class EvaluationModel(Value):
    """A model of the machine with the modes that the design model of a plant lacks.

    Made by ``assemble_plant(model, ports, evaluation=source)``. Every plant that is made from that
    plant has it too; `StandardPlant.evaluation_plant` is this model with the plant's channels.

    Parameters
    ----------
    source : Modes, FEModel, ReducedModel or StandardPlant
        The larger model. If it is a structure, the ports of the plant are applied to it. If it is a
        reduced model, the modes that it left out are included. If it is a plant, it must have the
        same channels as the plant that is judged on it.
    ports : Ports, optional
        Ports that replaced those of the plant after its assembly. A source that is a plant gets
        these ports too.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3), count=4)
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1]), ports, evaluation=modes)
    >>> plant.evaluation.source.n_modes
    4
    """

    source: Any
    ports: Ports | None = None

    @classmethod
    def of(cls, given: Any) -> EvaluationModel | None:
        """Return the argument `evaluation` of `assemble_plant` as an EvaluationModel, or None."""
        if given is None or isinstance(given, cls):
            return given
        given = getattr(given, "nominal", given)
        if not is_plant(given):
            instance(given, FEModel | Modes | ReducedModel, "evaluation", _HINT)
        return cls(given)

    @classmethod
    def known_to(cls, model: Structure) -> EvaluationModel | None:
        """Return a ReducedModel that kept its truncated modes as an evaluation model, else None."""
        known = isinstance(model, ReducedModel) and model.truncated is not None
        return cls(model) if known else None

    @property
    def is_structure(self) -> bool:
        """Whether the source is a structure, to which the ports of the plant are applied."""
        return isinstance(self.source, FEModel | Modes | ReducedModel)

    def with_ports(self, ports: Ports) -> EvaluationModel:
        """Return the same evaluation model with other ports."""
        return self if self.is_structure else self.replace(ports=ports)

    @cached_property
    def realisation(self) -> ModalRealisation:
        """The modes of a structure, solved once for all plants that are judged on it."""
        given = self.source
        return plant_modes(given.completed() if isinstance(given, ReducedModel) else given)

    @property
    def text(self) -> str:
        """The model in a few words."""
        kind = type(self.source).__name__
        count = getattr(self.source, "n_modes", None)
        return kind if count is None else f"{kind}, {count} modes"


@dataclass(frozen=True, eq=False, repr=False)
class Partition(PartitionedSystem):
    """The data of a standard plant, in the fields of `StandardPlant`, and derived quantities."""

    origin: Origin = ELSEWHERE
    uncertainty: Any = None
    evaluation: EvaluationModel | None = None
    measurement: MeasuredResponse | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(evaluation=EvaluationModel.of(self.evaluation))
        if isinstance(self.origin, Foreign):  # its ports are the names that it has
            u: Any = [PlantChannel(name, "u") for name in self.u]
            y: Any = [PlantChannel(name, "y") for name in self.y if name not in self.w]
            self._set(origin=self.origin.replace(ports=Ports(u=u, y=y)))

    @property
    def machine(self) -> Self:
        """The machine: the plant itself."""
        return self

    def around(self, machine: Self) -> Self:
        """Return another machine unchanged, because this plant has neither weights nor blocks."""
        return machine

    def _all_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return changes of fields with the noise of each sample and the plant before sampling."""
        asd = changes.get("asd")
        of_sample = self.origin.continuous is not None and self.origin.noise_factor is not None
        if isinstance(asd, Mapping) and "origin" not in changes and of_sample:
            quiet = {f"{name}:noise" for name in self.y}
            new, old = (
                {n: a for n, a in d.items() if a and n not in quiet} for d in (asd, self.asd)
            )
            if new != old:
                factor = np.zeros((len(self.noise_factor), len(self.held)))
                if new:
                    loud = {n: a for n, a in new.items() if n in self.continuous.w}
                    before: Any = self.continuous.replace(asd=loud)
                    factor = before.discretized(1.0 / self.dt, delay=self.delay).noise_factor
                changes["origin"] = self.assembled.replace(noise_factor=factor)
        if "evaluation" in changes:  # the plant before sampling has the same one
            judged = EvaluationModel.of(changes["evaluation"])
            origin = changes.get("origin", self.origin)
            if origin.continuous is not None and origin.continuous.evaluation is not judged:
                origin = origin.replace(continuous=origin.continuous.replace(evaluation=judged))
            changes |= {"evaluation": judged, "origin": origin}
        return changes

    @classmethod
    def of(cls, given: Any) -> Self:
        """Return a plant, or the plant of a system whose labels name w, u, z and y.

        For an `UncertainPlant` it is the nominal plant with its `uncertainty`. LabelError when the
        labels do not name these channels, ModelError for any other value.
        """
        given = given if isinstance(given, cls) else getattr(given, "nominal", given)
        if isinstance(given, cls):
            return given
        if is_system(given):
            return cls.from_statespace(given)
        if hasattr(given, "alteration"):
            raise ModelError(
                f"need the plant of a machine, but the plant is {given.alteration}: its "
                "channels are not those of the machine. Use plant.unweighted."
            )
        raise ModelError(
            f"need a StandardPlant, got {short(given)}. Make it by assemble_plant(model, ports), "
            f"or by {TYPE_THIS}."
        )

    @classmethod
    def from_statespace(
        cls,
        sys: System,
        *,
        u: Sequence[str] | None = None,
        y: Sequence[str] | None = None,
        w: Sequence[str] | None = None,
        z: Sequence[str] | None = None,
        asd: Mapping[str, float] | None = None,
        noise_factor: FloatArray | None = None,
        evaluation: Any = None,
    ) -> Self:
        """Return the standard plant of a system that was not assembled from a structure.

        Parameters
        ----------
        sys : StateSpace or control.StateSpace
            System with named channels.
        u, y : sequences of str, optional
            Inputs that the controller drives, and outputs that it reads. Both may be
            left out when the channels are named like those of an assembled plant
            (`u1:effort`, `y1:noise`, `die:z`, `die:ref`), as in `plant.to_control()`.
        w, z : sequences of str, optional
            Disturbances and performance; by default the remaining channels.
        asd : mapping, optional
            One-sided amplitude spectral densities of white w channels; the noise of a sensor y1
            is the w channel `y1:noise`.
        noise_factor : (n, r) array, optional
            Factor G of the covariance G G' that disturbances add to x in one sample.
        evaluation : StandardPlant, optional
            Larger plant of the same machine with the same channels, on which results are checked.

        Returns
        -------
        StandardPlant
            Plant with inputs [w; u] and outputs [z; y].

        Raises
        ------
        LabelError
            When a name is unknown or on two sides. Also when no names are given and the names of
            the channels do not show their sides.
        """
        g = as_statespace(sys)
        if u is None and y is None and w is None and z is None:
            w, u, z, y = sides_of(g)
        if u is None or y is None:
            raise LabelError(
                f"name both u and y, got u = {u} and y = {y}. Type {TYPE_THIS}, or leave all four "
                "out when the channels are named like those of an assembled plant."
            )
        u, y = name_list(u, "u"), name_list(y, "y")
        w = [n for n in g.inputs if n not in u] if w is None else list(name_list(w, "w"))
        z = [n for n in g.outputs if n not in y] if z is None else list(name_list(z, "z"))
        if noise_factor is not None:
            noise_factor = real_array(noise_factor, "noise_factor", (g.n_states, None))
        return cls(
            g.select([*z, *y], [*w, *u]),
            tuple(w), tuple(u), tuple(z), tuple(y),
            {} if asd is None else mapping(asd, "asd", "Pass {channel: density}."),
            Foreign(noise_factor), evaluation=evaluation,
        )  # fmt: skip

    @property
    def continuous(self) -> Self:
        """The plant before sampling; the plant itself if it is continuous or this is not known."""
        found: Self | None = self.origin.continuous
        return self if found is None else found

    @property
    def has_own_modes(self) -> bool:
        """Whether it has modes that each have one frequency and one damping."""
        return self.form == MODAL

    @property
    def noise_factor(self) -> FloatArray:
        """Factor G (n, r) of the covariance G G' that white disturbances add to x in one sample.

        ModelError when it is not known.
        """
        found = self.origin.noise_factor
        if found is None:
            raise ModelError(
                "labels carry no noise density, so that the process noise of each sample is not "
                "known. Use assemble_plant(model, ports).discretized(rate), or type "
                f"{TYPE_THIS[:-1]}, noise_factor=G), G G' the covariance that w adds to x in one "
                "sample."
            )
        return found

    @property
    def reading_gain(self) -> FloatArray:
        """The identity matrix, because y are the measurements of the machine."""
        return np.eye(len(self.y))
