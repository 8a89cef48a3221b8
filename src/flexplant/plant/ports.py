"""The channels of a machine, by name and place: the same Ports serve every model of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from ..errors import LabelError, ModelError, unknown_label
from ..labels import DIRECTIONS, Place
from ..lti.interconnection import series
from ..lti.statespace import StateSpace
from ..lti.weights import pade
from ..values import Value, check_names, positive, short
from .forces import Actuator as Actuator
from .forces import BaseAcceleration, OutputDisturbance
from .forces import Disturbance as Disturbance
from .port_checks import checked_direction, checked_filter, checked_name, checked_place

#: what may be in w
Disturbing: TypeAlias = Disturbance | BaseAcceleration | OutputDisturbance

Quantity: TypeAlias = Literal["displacement", "velocity", "acceleration"]
QUANTITIES: tuple[Quantity, ...] = ("displacement", "velocity", "acceleration")


@dataclass(frozen=True, eq=False)
class Sensor(Value):
    """A measured motion, in y.

    Parameters
    ----------
    name : str
        The channel's name; its noise is the channel `name:noise` of w.
    at : str, (3,) array [m] or mapping
        A DOF label, a point, or a sum {label or point: weight}.
    direction : str
        At points: x, y, z or rx, ry, rz.
    quantity : {"displacement", "velocity", "acceleration"}
        What is measured. An acceleration answers forces at once (D21, D22); a white disturbance
        that reaches it would give its samples infinite variance, which Kalman filters and
        simulation refuse: shape the disturbance, or give the sensor `dynamics` that roll off.
    asd : float [m/sqrt(Hz), rad/sqrt(Hz), ... per s or s^2]
        One-sided amplitude spectral density of its white noise; a sample has variance
        asd^2 rate / 2. It is added to the samples, after dynamics and delay; what passes through
        them is an OutputDisturbance.
    dynamics : StateSpace, optional
        Sensor and anti-alias filter, motion to signal: stable; its states join the plant's.
    delay : float [s]
        Of the signal. Exact, also between samples, once the plant is sampled; a continuous plant
        leaves it out and says so (`ports.with_pade(order)` approximates it there).

    Raises
    ------
    LabelError, ModelError
        For a bad name, place, direction, quantity, dynamics, or a negative asd or delay.
    """

    name: str
    at: Place
    direction: str = "z"
    quantity: Quantity = "displacement"
    asd: float = 0.0
    dynamics: StateSpace | None = None
    delay: float = 0.0

    def __post_init__(self) -> None:
        self._set(
            name=checked_name(self.name),
            direction=checked_direction(self.name, self.direction),
            at=checked_place(self.name, self.at),
        )
        if self.quantity not in QUANTITIES:
            raise unknown_label(f"quantity of {self.name!r}", self.quantity, QUANTITIES)
        self._set(
            asd=positive(self.asd, f"asd of {self.name!r}", zero=True),
            dynamics=checked_filter(self.name, "dynamics", self.dynamics),
            delay=positive(self.delay, f"delay of {self.name!r}", zero=True),
        )


@dataclass(frozen=True, eq=False)
class Poi(Value):
    """A Point Of Interest: motions that no sensor sees, in z as `name:axis`.

    Parameters
    ----------
    name : str
        Its name.
    at : str or (3,) array [m]
        A DOF label (whose direction is replaced by the axes) or any point of the structure.
    axes : sequence of str
        Of x, y, z [m], rx, ry, rz [rad]; the first one is the axis that a Reference follows.

    Raises
    ------
    LabelError, ModelError
        For a bad name, place or axis.
    """

    name: str
    at: Place
    axes: tuple[str, ...] = ("z",)

    def __post_init__(self) -> None:
        if not isinstance(self.axes, Iterable):
            raise LabelError(
                f"axes of POI {self.name!r} are names such as ('z', 'rx'), got {short(self.axes)}."
                " Name them."
            )
        axes = (self.axes,) if isinstance(self.axes, str) else tuple(self.axes)
        for axis in axes:
            if axis not in DIRECTIONS:
                raise unknown_label(f"axis of POI {self.name!r}", axis, DIRECTIONS)
        if not axes:
            raise LabelError(f"POI {self.name!r} has no axes: name at least one, such as ('z',).")
        check_names(axes, f"axes of POI {self.name!r}")
        if isinstance(self.at, Mapping) and len(axes) > 1:
            raise LabelError(
                f"POI {self.name!r} is a combination of DOFs, so it has one axis, got {axes}. "
                "Give a point or a DOF label, or one POI per combination."
            )
        self._set(axes=axes, name=checked_name(self.name), at=checked_place(self.name, self.at))

    def channel(self, axis: str) -> str:
        """Return the name of an axis in z, such as `die:z`."""
        return f"{self.name}:{axis}"

    def derived(self, axis: str, kind: str) -> str:
        """Return the name of a reference, error or estimate: `die:hat`, `die:rx:hat`.

        Parameters
        ----------
        axis : str
            One of the POI's axes; the first is left out of the name.
        kind : str
            `ref`, `error` or `hat`.
        """
        return f"{self.name}:{kind}" if axis == self.axes[0] else f"{self.name}:{axis}:{kind}"


@dataclass(frozen=True, eq=False)
class Reference(Value):
    """A set-point for the first axis of a POI.

    It adds `die:ref` to w, the error `die:error` (reference minus POI) to z, and a noise-free
    `die:ref` to y, so that a controller that uses it has two degrees of freedom.

    Parameters
    ----------
    poi : str
        The POI's name.
    """

    poi: str

    def __post_init__(self) -> None:
        poi: object = self.poi
        if not isinstance(poi, str):
            raise LabelError(
                f"a Reference names a POI, got {short(poi)}. Pass its name: Reference('die')."
            )


@dataclass(frozen=True, eq=False, repr=False)
class Ports(Value):
    """All channels of one machine, for every model of it: nominal, updated, truth.

    Parameters
    ----------
    w : sequence of Disturbance, BaseAcceleration and OutputDisturbance
        Disturbances; sensor noises and references are added to them.
    u : sequence of Actuator
        Actuators; each adds an effort `name:effort` to z.
    z : sequence of Poi
        Points of interest.
    y : sequence of Sensor
        Sensors.
    references : sequence of Reference
        Set-points.

    Raises
    ------
    LabelError
        When a name is used twice, a Reference names no POI, or an OutputDisturbance no sensor.
    ModelError
        When an entry has the wrong type.
    """

    w: Sequence[Disturbing] = ()
    u: Sequence[Actuator] = ()
    z: Sequence[Poi] = ()
    y: Sequence[Sensor] = ()
    references: Sequence[Reference] = ()

    def __post_init__(self) -> None:
        kinds: dict[str, Any] = {
            "w": Disturbing,
            "u": Actuator,
            "z": Poi,
            "y": Sensor,
            "references": Reference,
        }
        for side, kind in kinds.items():
            given = getattr(self, side)
            if isinstance(given, str) or not isinstance(given, Value | Iterable):
                raise ModelError(
                    f"Ports.{side} must be a sequence of {_called(kind)}s, got {short(given)}. "
                    f"Put them in a list: {side}=[...]."
                )
            ports = (given,) if isinstance(given, Value) else tuple(given)
            for port in ports:
                if not isinstance(port, kind):
                    raise ModelError(
                        f"Ports.{side} holds {_called(kind)}s, got {type(port).__name__}. "
                        f"{_HOME.get(type(port).__name__, 'Make one of it, or leave it out.')}"
                    )
            self._set(**{side: ports})
        check_names([port.name for port in self.forces], "inputs w and u")
        check_names([port.name for port in self.y], "outputs y")
        check_names([poi.name for poi in self.z], "POIs")
        check_names([reference.poi for reference in self.references], "references")
        for reference in self.references:
            self.poi(reference.poi)
        for port in self.w:
            if isinstance(port, OutputDisturbance):
                self.sensor(port.sensor)

    def __repr__(self) -> str:
        names = {
            "w": [port.name for port in self.w],
            "u": [port.name for port in self.u],
            "z": [poi.name for poi in self.z],
            "y": [port.name for port in self.y],
            "references": [reference.poi for reference in self.references],
        }
        sides = ", ".join(f"{side}: {' '.join(listed)}" for side, listed in names.items() if listed)
        return f"<Ports {sides}>"

    @property
    def forces(self) -> tuple[Disturbing | Actuator, ...]:
        """All ports that bring something in: disturbances, then actuators."""
        return (*self.w, *self.u)

    def poi(self, name: str) -> Poi:
        """Return the POI of a name.

        Raises
        ------
        LabelError
            When there is none.
        """
        for poi in self.z:
            if poi.name == name:
                return poi
        raise unknown_label("POI", name, [poi.name for poi in self.z])

    def sensor(self, name: str) -> Sensor:
        """Return the sensor of a name.

        Raises
        ------
        LabelError
            When there is none.
        """
        for sensor in self.y:
            if sensor.name == name:
                return sensor
        raise unknown_label("sensor", name, [sensor.name for sensor in self.y])

    @property
    def delays(self) -> dict[str, float]:
        """Delays [s] of the actuators and sensors that have one, by name."""
        ports: tuple[Actuator | Sensor, ...] = (*self.u, *self.y)
        return {port.name: port.delay for port in ports if port.delay}

    @property
    def has_dynamics(self) -> bool:
        """Whether some port has a filter or a delay: states beside those of the structure."""
        return bool(self.delays) or any(filter_of(port) for port in (*self.forces, *self.y))

    def with_pade(self, order: int = 2) -> Ports:
        """Return the ports with every delay as an all-pass filter, for continuous designs.

        Parameters
        ----------
        order : int
            States of each; the phase is right up to about ``order / (6 delay)`` Hz.

        Raises
        ------
        ModelError
            When the order is not 1 or more.
        """

        def late(port: Any) -> Any:
            if not port.delay:
                return port
            line, own = pade(port.delay, order=order), filter_of(port)
            both = line if own is None else series(own, line)
            named = both.replace(states=[f"x{i}" for i in range(1, both.n_states + 1)])
            return port.replace(dynamics=named, delay=0.0)

        return self.replace(u=[late(port) for port in self.u], y=[late(port) for port in self.y])


def filter_of(port: Any) -> StateSpace | None:
    """Return the shape or the dynamics of a port, or None."""
    found = port.dynamics if isinstance(port, Actuator | Sensor) else port.shape
    return found if isinstance(found, StateSpace) else None


#: where ports of the wrong side belong
_HOME = {
    "Disturbance": "It belongs in w.",
    "BaseAcceleration": "It belongs in w.",
    "OutputDisturbance": "It belongs in w.",
    "Actuator": "It belongs in u.",
    "Poi": "It belongs in z.",
    "Sensor": "It belongs in y.",
    "Reference": "It belongs in references.",
}


def _called(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) else "disturbance"
