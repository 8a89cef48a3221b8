"""The channels of a machine, by name and place: the same Ports serve every model of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

from ..arrays import FloatArray, check_names, instance, members, name_list, several
from ..errors import LabelError, ModelError, require_known, short
from ..labels import DIRECTIONS, Place
from ..lti.filters import pade
from ..lti.frequency import Quantity
from ..lti.interconnection import series
from ..lti.statespace import StateSpace
from ..store import Value
from ..structure.rigid import place_motion
from .forces import Actuator
from .port import ForcePort, MeasuredRow, SensorPort, checked_port, motion_unit, observed
from .realisation import ModalRealisation
from .scheduling import Position, port_at, require_positions


@dataclass(frozen=True, eq=False)
class Sensor(SensorPort):
    """A measured motion, in y.

    Parameters
    ----------
    name : str
        The channel's name; its noise is the channel `name:noise` of w.
    at, direction, moves : as for `Disturbance`
    quantity : {"displacement", "velocity", "acceleration"}
        Measured quantity. An acceleration responds to forces at once (D21, D22). A white
        disturbance that reaches it would give its samples infinite variance. Kalman filters and
        simulation refuse this. Give the disturbance a `shape`, hold it over each sample
        (`Disturbance(held=True)`), or give the sensor `dynamics` that roll off.
    asd : float [m/sqrt(Hz), rad/sqrt(Hz), ... per s or s^2]
        One-sided amplitude spectral density of its white noise; a sample has the variance ``asd^2
        rate / 2``. It is added to the samples, after dynamics and latency; use an OutputDisturbance
        for noise that passes through them.
    asd_deviation : float
        Relative standard deviation of the density among the machines ``plant.machines``, which are
        drawn at random.
    dynamics : StateSpace, optional
        Stable system of sensor and anti-alias filter, from motion to signal. Its states are added
        to those of the plant.
    latency : float [s]
        Delay of the signal, in seconds. A sampled plant contains it exactly, also if it is a
        fraction of a sample. A continuous plant neglects it, and its printed text says so
        (`ports.with_pade(order)` approximates the delay there).
    absolute : bool, optional
        Whether the sensor also measures the motion of the floor (BaseAcceleration): True for
        inertial sensors such as a geophone (absolute velocity), False for sensors that measure
        relative to the floor. By default accelerations are absolute, displacements and velocities
        are relative.

    Raises
    ------
    LabelError, ModelError
        For a bad name, place, direction, quantity, dynamics, a negative asd or latency, or
        a latency of a second or more.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.Sensor("y1", at="41:z", asd=1e-12).unit
    'm'
    >>> fx.Sensor("acc", at="41:z", quantity="acceleration").unit
    'm/s^2'
    """

    name: str
    at: Place
    direction: str = "z"
    quantity: Quantity = "displacement"
    asd: float = 0.0
    dynamics: StateSpace | None = None
    latency: float = 0.0
    absolute: bool | None = None
    moves: Any = None
    asd_deviation: float = field(default=0.0, kw_only=True, repr=False)

    def row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the row (n,) that gives its displacement from the model's DOFs."""
        return realisation.row(self.at, self.direction)

    def carried(self, realisation: ModalRealisation) -> FloatArray:
        """Return the displacement (6,) that it measures per unit of each rigid-body motion.

        The rigid-body motions are x, y, z, rx, ry, rz about the origin.
        """
        return place_motion(realisation.model.full_dofs, self.at, self.direction)


@dataclass(frozen=True, eq=False)
class Poi(Value):
    """A point of interest (POI): motions to be controlled that no sensor measures, in z.

    Parameters
    ----------
    name : str
        Name of the POI; its channels in z are `name:axis`.
    at : str, (3,) array [m] or mapping {place: weight}
        A DOF label, any point of the structure, or a weighted sum of places. If `axes` is
        given, it replaces the direction of a single label. A weighted sum has one axis; an example
        is ``{"1:z": 0.5, (0.3, 0.3, 0.0): 0.5}``.
    axes : sequence of str
        Motions among x, y, z [m], rx, ry, rz [rad]; a Reference uses the first one unless it names
        others. By default the direction of the label, that of the first translation (or else
        rotation) in a weighted sum, and z at a point. Labels in a weighted sum keep their own
        directions.
    absolute : bool
        Whether its motion is absolute, so that it includes the motion of a BaseAcceleration, or
        relative to the floor.
    moves : mapping {position: (3,) array} or PlaceTable, optional
        Motion of the point `at` with the positions of the machine (see `Ports`). The point is at
        `at` when all positions are zero.

    Examples
    --------
    >>> import flexplant as fx
    >>> die = fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"))
    >>> [die.channel(axis) for axis in die.axes]
    ['die:z', 'die:rx', 'die:ry']
    """

    home: ClassVar = "z"
    name: str
    at: Place
    axes: Sequence[str] = ()
    absolute: bool = False
    moves: Any = None

    def __post_init__(self) -> None:
        axes = name_list(self.axes, f"axes of POI {self.name!r}") or _directions_of(self.at)[:1]
        require_known(f"axis of POI {self.name!r}", axes, DIRECTIONS)
        check_names(axes, f"axes of POI {self.name!r}")
        if isinstance(self.at, Mapping) and len(axes) > 1:
            raise LabelError(
                f"POI {self.name!r} is a combination of DOFs, so it has one axis, got {axes}. "
                "Give a point or a DOF label, or one POI per combination."
            )
        found = checked_port(self)
        self._set(**found | {"axes": axes, "absolute": bool(found["absolute"])})

    def channel(self, axis: str) -> str:
        """Return the name of an axis in z, such as `die:z`."""
        return f"{self.name}:{axis}"

    def derived(self, axis: str, kind: str) -> str:
        """Return the name of a reference, error or estimate (`ref`, `error`, `hat`) of an axis.

        `die:hat`, `die:rx:hat`: the first axis is left out of the name.
        """
        return f"{self.name}:{kind}" if axis == self.axes[0] else f"{self.name}:{axis}:{kind}"

    def unit(self, axis: str) -> str | None:
        """Return the unit of an axis: m or rad; None for a sum of both."""
        # a label gives the place alone: its direction is replaced by the axis
        return motion_unit(self.at if isinstance(self.at, Mapping) else {}, axis)

    def row(self, realisation: ModalRealisation, axis: str) -> FloatArray:
        """Return the row (n,) that gives the motion of one axis from the model's DOFs."""
        try:
            return realisation.row(self._at(axis), axis)
        except LabelError as error:
            if not isinstance(self.at, str) or self.at == self._at(axis):
                raise
            raise LabelError(
                f"POI {self.name!r} is at {self.at!r} with the axes {self.axes}, which replace the "
                f"label's direction: {error} Name those that are there, axes=(...)."
            ) from error

    def see(self, realisation: ModalRealisation, axis: str) -> MeasuredRow:
        """Return the coefficients of states, forces and ground motions for one axis."""
        along = None
        if self.absolute:
            along = place_motion(realisation.model.full_dofs, self._at(axis), axis)
        return observed(realisation, self.row(realisation, axis), 0, along)

    def _at(self, axis: str) -> Place:
        """Return the place of an axis: of a label the direction is replaced."""
        return f"{self.at.split(':')[0]}:{axis}" if isinstance(self.at, str) else self.at


def _directions_of(at: Place) -> tuple[str, ...]:
    """Return the directions of a place that has labels, translations first; z for points."""
    labels = [at] if isinstance(at, str) else [*at] if isinstance(at, Mapping) else []
    named = [label.rpartition(":")[2] for label in labels if isinstance(label, str)]
    if isinstance(at, str) and ":" in at and named[0][:1] in {"-", "+"}:
        plain = f"{at.rpartition(':')[0]}:{named[0][1:]}"
        raise LabelError(
            f"a POI at {at!r} has a direction with a sign. Give {plain!r}, or for the opposite "
            f"direction a weighted sum: at={{{plain!r}: -1.0}}."
        )
    known = [direction for direction in named if direction in DIRECTIONS]
    return (*sorted(known, key=lambda direction: direction[:1] == "r"), "z")


#: what each side holds
_KINDS = {"w": "disturbance", "u": "Actuator", "z": "Poi", "y": "Sensor", "references": "Reference"}


@dataclass(frozen=True, eq=False, repr=False)
class Reference(Value):
    """Set-points for the axes of a POI.

    Each set-point adds `die:ref` to w, the error `die:error` (reference minus POI) to z, and a
    noise-free `die:ref` to y, so that a controller that uses it has two degrees of freedom. The
    names for the other axes of the POI are `die:rx:ref` and `die:rx:error`.

    Parameters
    ----------
    poi : str
        Name of the POI.
    axes : sequence of str, optional
        Axes of the POI that get a set-point; by default its first axis.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.Reference("die")  # adds die:ref to w and y, and die:error to z
    Reference(poi='die')
    >>> fx.Reference("wafer", axes=("x", "y", "rz"))
    Reference(poi='wafer', axes=['x', 'y', 'rz'])
    """

    home: ClassVar = "references"
    poi: str
    axes: Sequence[str] | None = None

    def __post_init__(self) -> None:
        poi: object = self.poi
        instance(poi, str, "the POI of a Reference", "Pass its name: Reference('die').", LabelError)
        if self.axes is not None:
            axes = name_list(self.axes, "axes")
            require_known(f"axis of the reference of {poi!r}", axes, DIRECTIONS)
            check_names(axes, f"axes of the reference of {poi!r}")
            self._set(axes=axes)


@dataclass(frozen=True, eq=False, repr=False)
class Ports(Value):
    """All channels of one machine, for all of its models: nominal, updated, virtual machine.

    Parameters
    ----------
    w : sequence of Disturbance, BaseAcceleration and OutputDisturbance
        Disturbances; noises of amplifiers and sensors, and references, are added automatically.
    u : sequence of Actuator
        Actuators; each adds an effort `name:effort` to z.
    z : sequence of Poi
        Points of interest.
    y : sequence of Sensor
        Sensors.
    references : sequence of Reference
        Set-points.
    positions : sequence of Position
        Positions of the machine, for ports that move (`moves`).
    values : mapping {name: float} [m or rad]
        Values of the positions, which place the ports; by default the start of each position.

    Raises
    ------
    LabelError
        When a name is used twice, the POI of a Reference or the sensor of an OutputDisturbance does
        not exist, or a port moves with an unknown position.
    ModelError
        When an entry has the wrong type, or a value is out of its range.

    Examples
    --------
    >>> import flexplant as fx
    >>> ports = fx.Ports(
    ...     w=[fx.Disturbance("amp", at="1:x", asd=1e-3)],
    ...     u=[fx.Actuator("u1", at="1:x")],
    ...     z=[fx.Poi("die", at="2:x", axes=("x",))],
    ...     y=[fx.Sensor("y1", at="1:x", asd=1e-10)],
    ... )
    >>> ports
    <Ports w: amp, u: u1, z: die, y: y1>
    """

    w: Sequence[ForcePort] = ()
    u: Sequence[Actuator] = ()
    z: Sequence[Poi] = ()
    y: Sequence[SensorPort] = ()
    references: Sequence[Reference] = ()
    positions: Sequence[Position] = ()
    values: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for side, kind in _KINDS.items():
            given = getattr(self, side)
            if isinstance(given, str) or not (isinstance(given, Value) or several(given)):
                raise ModelError(
                    f"Ports.{side} must be a sequence of {kind}s, got {short(given)}. "
                    f"Put them in a list: {side}=[...]."
                )
            ports = (given,) if isinstance(given, Value) else tuple(given)
            for port in ports:
                own = getattr(port, "home", None)
                if own != side:
                    where = f"It belongs in {own}." if own else "Make one of it, or leave it out."
                    raise ModelError(
                        f"Ports.{side} holds {kind}s, got {type(port).__name__}. {where}"
                    )
            self._set(**{side: ports})
        self._place()
        check_names([port.name for port in self.forces], "inputs w and u")
        # a channel that w and y share is a reference
        names = [*(port.name for port in self.w), *(port.name for port in self.y)]
        check_names(names, "ports w and y")
        check_names([poi.name for poi in self.z], "POIs")
        check_names([reference.poi for reference in self.references], "references")
        for reference in self.references:
            poi = self.poi(reference.poi)
            require_known(f"axis of POI {poi.name!r}", reference.axes or (), poi.axes)
        for port in self.w:
            if port.added_to is not None:
                self.sensor(port.added_to)

    def _place(self) -> None:
        """Place the moving ports at the present values of the positions."""
        positions = members(
            self.positions,
            Position,
            "positions",
            "Pass [Position('x', range=(-0.1, 0.1))].",
            least=0,
        )
        sides = {side: getattr(self, side) for side in "wuzy"}
        every = [port for ports in sides.values() for port in ports]
        if not positions and not any(getattr(port, "moves", None) is not None for port in every):
            require_known("position", self.values, ())
            self._set(positions=(), values={})
            return
        known = {one.name: one for one in positions}
        check_names([one.name for one in positions], "positions")
        require_known("position", self.values, known)
        values = {
            name: float(one.start if name not in self.values else one.within(self.values[name]))
            for name, one in known.items()
        }
        require_positions(every, positions)
        there = {side: tuple(port_at(p, values) for p in ports) for side, ports in sides.items()}
        self._set(positions=positions, values=values, **there)

    def __repr__(self) -> str:
        names = {side: [port.name for port in getattr(self, side)] for side in "wuzy"}
        names["references"] = [reference.poi for reference in self.references]
        sides = ", ".join(f"{side}: {' '.join(listed)}" for side, listed in names.items() if listed)
        return f"<Ports {sides}{', at ' + self.standing if self.values else ''}>"

    @property
    def standing(self) -> str:
        """Text with the values of the positions; empty if the machine has no positions."""
        return ", ".join(
            f"{one.name} = {self.values[one.name]:g} ({one.range[0]:g} to {one.range[1]:g})"
            for one in self.positions
        )

    def at(self, values: Mapping[str, float]) -> Ports:
        """Return the ports at other positions of the machine; positions not named stay.

        LabelError when no position has such a name, ModelError when a value is out of its range.
        """
        return self.replace(values={**self.values, **values})

    @property
    def forces(self) -> tuple[ForcePort, ...]:
        """All input ports: disturbances, then actuators."""
        return (*self.w, *self.u)

    @property
    def physical(self) -> tuple[ForcePort | SensorPort, ...]:
        """All ports of the physical system: forces, then sensors."""
        return (*self.forces, *self.y)

    @property
    def motions(self) -> list[str]:
        """The outputs of the physical system: axes of POIs, then sensors."""
        pois = [poi.channel(axis) for poi in self.z for axis in poi.axes]
        return [*pois, *(sensor.name for sensor in self.y)]

    @cached_property
    def units(self) -> dict[str, str]:
        """The SI units of all channels that have one, and of derived channels.

        Forces have the unit N or N m and motions m or rad (per s, per s^2), according to their
        directions. Noises have the unit of their sensors, unless a coloured noise states a `unit`.
        References, errors and estimates have the unit of their POI, efforts that of their actuator.
        A weighted sum of displacements and rotations has the unit of its displacements if the
        vector of their weights has the length 1, because the weights of the rotations are then
        lever arms [m]. It has the unit of its rotations if the vector of the rotations' weights has
        the length 1. It has no unit if this length is 1 for both groups or for neither. Filters of
        ports do not change units.
        """
        found = {port.name: port.unit for port in self.physical}
        for port in self.w:
            if port.added_to is not None and port.unit is None:
                found[port.name] = found[port.added_to]
        found |= {f"{sensor.name}:noise": sensor.unit for sensor in self.y}
        for kind in ("effort", "disturbance"):
            found |= {f"{actuator.name}:{kind}": actuator.unit for actuator in self.u}
        for poi in self.z:
            for axis in poi.axes:
                found[poi.channel(axis)] = unit = poi.unit(axis)
                found |= {poi.derived(axis, kind): unit for kind in ("ref", "error", "hat")}
        return {name: unit for name, unit in found.items() if unit is not None}

    def poi(self, name: str) -> Poi:
        """Return the POI with this name; LabelError when it does not exist."""
        known = {poi.name: poi for poi in self.z}
        require_known("POI", [name], known)
        return known[name]

    def sensor(self, name: str) -> SensorPort:
        """Return the sensor with this name; LabelError when it does not exist."""
        known = {sensor.name: sensor for sensor in self.y}
        require_known("sensor", [name], known)
        return known[name]

    @property
    def followed(self) -> tuple[tuple[Poi, str], ...]:
        """The axes that have a set-point: pairs of a POI and an axis."""
        pois = ((self.poi(one.poi), one.axes) for one in self.references)
        return tuple((poi, axis) for poi, axes in pois for axis in axes or poi.axes[:1])

    @property
    def latencies(self) -> dict[str, float]:
        """Latencies [s] of the actuators and sensors that have one, by name."""
        ports: tuple[Actuator | SensorPort, ...] = (*self.u, *self.y)
        return {port.name: port.latency for port in ports if port.latency}

    @property
    def input_noises(self) -> dict[str, float]:
        """Densities of the white noise at the amplifiers' inputs, by channel `u1:disturbance`."""
        return {f"{port.name}:disturbance": port.asd for port in self.u if port.asd > 0}

    @property
    def densities(self) -> dict[str, float]:
        """Densities asd of the white noises, by channel of w."""
        noises = {f"{port.name}:noise": port.asd for port in self.y if port.asd > 0}
        return {port.name: port.asd for port in self.w if port.asd > 0} | self.input_noises | noises

    def with_pade(self, order: int = 2) -> Ports:
        """Return the ports with every latency as an all-pass filter, for continuous designs.

        `order` is the number of states of each filter, at least 1. The phase is correct up to
        ``order / (6 latency)`` Hz.
        """

        def late(port: Any) -> Any:
            if not port.latency:
                return port
            line, own = pade(port.latency, order=order), port.filter
            both = line if own is None else series(own, line)
            named = both.replace(states=[f"x{i}" for i in range(1, both.n_states + 1)])
            return port.replace(dynamics=named, latency=0.0)

        return self.replace(u=[late(port) for port in self.u], y=[late(port) for port in self.y])
