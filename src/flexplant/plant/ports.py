"""The channels of a machine, by name and place: the same Ports serve every model of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from ..errors import LabelError, ModelError, unknown_label
from ..labels import DIRECTIONS, Place
from ..values import Value, check_names, positive, real_array

Quantity: TypeAlias = Literal["displacement", "velocity", "acceleration"]
QUANTITIES: tuple[Quantity, ...] = ("displacement", "velocity", "acceleration")


@dataclass(frozen=True, eq=False)
class Disturbance(Value):
    """A force (or moment) from outside, in w.

    Parameters
    ----------
    name : str
        The channel's name.
    at : str, (3,) array [m] or mapping
        A DOF label, a point, or {label: weight}.
    direction : str
        At a point: x, y, z [N] or rx, ry, rz [N m].
    asd : float [N/sqrt(Hz)]
        One-sided amplitude spectral density of white noise; 0 for a force that is no noise.

    Raises
    ------
    LabelError, ModelError
        For a bad name, place, direction or a negative asd.
    """

    name: str
    at: Place
    direction: str = "z"
    asd: float = 0.0

    def __post_init__(self) -> None:
        _check_place(self)
        self._set(asd=positive(self.asd, f"asd of {self.name!r}", zero=True))


@dataclass(frozen=True, eq=False)
class Actuator(Value):
    """A force (or moment) that the controller commands, in u.

    Parameters
    ----------
    name : str
        The channel's name.
    at : str, (3,) array [m] or mapping
        A DOF label, a point, or {label: weight}: pairs and other combinations.
    direction : str
        At a point: x, y, z [N] or rx, ry, rz [N m].

    Raises
    ------
    LabelError, ModelError
        For a bad name, place or direction.
    """

    name: str
    at: Place
    direction: str = "z"

    def __post_init__(self) -> None:
        _check_place(self)


@dataclass(frozen=True, eq=False)
class Sensor(Value):
    """A measured motion, in y.

    Parameters
    ----------
    name : str
        The channel's name; its noise is the channel `name:noise` of w.
    at : str, (3,) array [m] or mapping
        A DOF label, a point, or {label: weight}.
    direction : str
        At a point: x, y, z or rx, ry, rz.
    quantity : {"displacement", "velocity", "acceleration"}
        What is measured.
    asd : float [m/sqrt(Hz), rad/sqrt(Hz), ... per s or s^2]
        One-sided amplitude spectral density of its white noise; a sample has variance
        asd^2 rate / 2.

    Raises
    ------
    LabelError, ModelError
        For a bad name, place, direction, quantity or a negative asd.
    """

    name: str
    at: Place
    direction: str = "z"
    quantity: Quantity = "displacement"
    asd: float = 0.0

    def __post_init__(self) -> None:
        _check_place(self)
        if self.quantity not in QUANTITIES:
            raise unknown_label(f"quantity of {self.name!r}", self.quantity, QUANTITIES)
        self._set(asd=positive(self.asd, f"asd of {self.name!r}", zero=True))


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
        self._set(axes=axes)
        _check_place(self)

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


@dataclass(frozen=True, eq=False, repr=False)
class Ports(Value):
    """All channels of one machine, for every model of it: nominal, updated, truth.

    Parameters
    ----------
    w : sequence of Disturbance
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
        When a name is used twice, or a Reference names no POI.
    ModelError
        When an entry has the wrong type.
    """

    w: Sequence[Disturbance] = ()
    u: Sequence[Actuator] = ()
    z: Sequence[Poi] = ()
    y: Sequence[Sensor] = ()
    references: Sequence[Reference] = ()

    def __post_init__(self) -> None:
        kinds = {"w": Disturbance, "u": Actuator, "z": Poi, "y": Sensor, "references": Reference}
        for side, kind in kinds.items():
            given = getattr(self, side)
            ports = (given,) if isinstance(given, Value) else tuple(given)
            for port in ports:
                if not isinstance(port, kind):
                    raise ModelError(
                        f"Ports.{side} holds {kind.__name__}s, got {type(port).__name__}."
                    )
            self._set(**{side: ports})
        check_names([port.name for port in self.forces], "inputs w and u")
        check_names([port.name for port in self.y], "outputs y")
        check_names([poi.name for poi in self.z], "POIs")
        check_names([reference.poi for reference in self.references], "references")
        for reference in self.references:
            self.poi(reference.poi)

    def __repr__(self) -> str:
        names = {
            "w": [port.name for port in self.w],
            "u": [port.name for port in self.u],
            "z": [poi.name for poi in self.z],
            "y": [port.name for port in self.y],
        }
        sides = ", ".join(f"{side}: {' '.join(listed)}" for side, listed in names.items() if listed)
        return f"<Ports {sides}>"

    @property
    def forces(self) -> tuple[Disturbance | Actuator, ...]:
        """All ports that push: disturbances, then actuators."""
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


def _check_place(port: Disturbance | Actuator | Sensor | Poi) -> None:
    """Check name and place of a port, and copy the place."""
    check_names([str(port.name)], "ports")
    direction = getattr(port, "direction", "z")
    if direction not in DIRECTIONS:
        raise unknown_label(f"direction of {port.name!r}", direction, DIRECTIONS)
    at = port.at
    if isinstance(at, Mapping):
        if not at:
            raise LabelError(f"{port.name!r} is at an empty mapping: name at least one DOF.")
        place: Place = {
            str(label): float(real_array(weight, f"weight of {label!r} in {port.name!r}", ()))
            for label, weight in at.items()
        }
    elif isinstance(at, str):
        place = at
    else:
        place = tuple(real_array(at, f"place of {port.name!r}", (3,)).tolist())
    port._set(at=place)
