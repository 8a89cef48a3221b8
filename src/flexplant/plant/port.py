"""What every port of a machine has: the bases that a new kind of force or sensor derives from."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..arrays import FloatArray, check_names, flag, positive, real_array
from ..errors import LabelError, ModelError, require_known, short
from ..labels import DIRECTIONS, Place
from ..lti.frequency import PER_TIME, QUANTITIES, Quantity
from ..lti.statespace import StateSpace, single_channel
from ..store import Value
from ..tolerances import TYPED
from .realisation import ModalRealisation
from .scheduling import checked_moves

#: what a set-point profile gives of a reference, by the order of the derivative
TERMS = ("position", "velocity", "acceleration", "jerk", "snap")
DERIVATIVES = TERMS[1:]


class MeasuredRow(NamedTuple):
    """Coefficients of a measured channel: ``row x + direct f + carried g``.

    Parameters
    ----------
    row : (2 b,) array
        Coefficients of the states x of the modes.
    direct : (n,) array
        Coefficients of loads f at the model's DOFs, to which the channel responds directly.
    carried : (6,) array
        Coefficients of the rigid-body motions g of the ground about the origin (x, y, z, rx, ry,
        rz). The motions g are displacements, velocities or accelerations, as the sensor measures.
        The coefficients are 0 for a sensor that measures relative to the ground.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.MeasuredRow(row=np.ones((1, 3)), direct=np.zeros((1, 2))).row.shape
    (1, 3)
    """

    row: FloatArray
    direct: FloatArray
    carried: FloatArray = np.zeros(6)


def observed(
    realisation: ModalRealisation,
    row: FloatArray,
    order: int = 0,
    carried: FloatArray | None = None,
) -> MeasuredRow:
    """Return how the time derivative of some order of a displacement (a row over DOFs) is seen."""
    # against the ground, or with its motion `carried` (6,) along
    along = np.zeros(6) if carried is None else carried
    if order == 0:
        return MeasuredRow(realisation.motion(row, 0), realisation.at_once(row), along)
    direct = np.zeros(row.size)
    if order == 2:  # an acceleration follows a force at once: d2q/dt2 = S A A x + S A N' f
        direct = realisation.inputs @ realisation.motion(row, 1)
    return MeasuredRow(realisation.motion(row, order), direct, along)


class ForcePort(Value):
    """A port in w or u. A new kind has a `name` and a method `push`, which says where it acts.

    By default it is a force at the place `at`, along `direction`.

    Examples
    --------
    >>> import flexplant as fx
    >>> force = fx.Disturbance("floor", at="41:z", asd=1e-3)
    >>> isinstance(force, fx.plant.ForcePort), force.home, force.unit
    (True, 'w', 'N')
    """

    #: the side of Ports that holds it
    home: ClassVar = "w"
    name: str
    direction: str
    asd: float = 0.0
    asd_deviation: float = 0.0

    def __post_init__(self) -> None:
        self._set(**checked_port(self))

    @property
    def filter(self) -> StateSpace | None:
        """The system between the channel and the structure: its `shape`, or its `dynamics`."""
        found: StateSpace | None = getattr(self, "shape", getattr(self, "dynamics", None))
        return found

    @property
    def unit(self) -> str | None:
        """Unit of the channel, N or N m at a place; None of a sum of both, or if it has none."""
        given = self._fields()
        known = "at" in given and "direction" in given
        return force_unit(given["at"], self.direction) if known else None

    @property
    def added_to(self) -> str | None:
        """Name of the sensor to which an `OutputDisturbance` is added; None for all other ports."""
        return None

    @property
    def ground(self) -> FloatArray:
        """Rigid-body motion (6,) of the ground, per unit; zero except for a `BaseAcceleration`."""
        return np.zeros(6)

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) over the model's DOFs per unit of the output of the filter."""
        at = self._fields().get("at")
        if at is None:
            raise ModelError(
                f"{type(self).__name__} has no place `at`: define `push`, which returns its load "
                "over the DOFs of the model."
            )
        return realisation.row(at, self.direction)

    def static_push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) per unit of a constant input of the channel.

        It is the load of `push` times the static gain of the filter.
        """
        return static_gain(self.filter) * self.push(realisation)


class SensorPort(Value):
    """A port in y. A new kind has the fields below; its `row` or `see` says what it measures.

    Define `row` for a sensor of a displacement, for example of one point relative to another. With
    a `quantity`, the sensor measures the velocity or the acceleration of this displacement instead.
    Define `see` for any other signal that is linear in states and forces; `row` is then the signal
    of the sensor at rest. Coloured noise of a sensor is an `OutputDisturbance` in w.

    Parameters
    ----------
    name : str
        Name of the sensor, which is also its channel of y.
    at : str, (3,) array [m] or mapping
        Place of the sensor, at which plots show it. `StandardPlant.at` moves it.
    asd : float
        One-sided amplitude spectral density of its white noise.
    dynamics : StateSpace, optional
        Sensor and anti-alias filter.
    latency : float [s]
        Delay of the signal, in seconds.
    quantity : {"displacement", "velocity", "acceleration"}
        Measured quantity.
    absolute : bool, optional
        Whether the motion of the ground is included; by default for accelerations only.

    Examples
    --------
    >>> import flexplant as fx
    >>> gauge = fx.Sensor("y1", at="41:z", asd=1e-12, latency=20e-6)
    >>> isinstance(gauge, fx.plant.SensorPort), gauge.home, gauge.latency
    (True, 'y', 2e-05)
    """

    home: ClassVar = "y"
    name: str
    at: Place
    asd: float = 0.0
    asd_deviation: float = 0.0
    dynamics: StateSpace | None = None
    latency: float = 0.0
    quantity: Quantity = "displacement"
    absolute: bool | None = None

    def __post_init__(self) -> None:
        self._set(**checked_port(self))
        require_known(f"quantity of {self.name!r}", [self.quantity], QUANTITIES)

    @property
    def filter(self) -> StateSpace | None:
        """The system between the motion and the channel."""
        return self.dynamics

    @property
    def unit(self) -> str | None:
        """Unit of the channel: that of the motion at its place; None for a sum of m and rad.

        A kind of sensor that measures another quantity states its unit in a field `unit`. A kind
        that overrides `see` has no unit without this field.
        """
        if type(self).see is not SensorPort.see:
            return None
        return motion_unit(self.at, getattr(self, "direction", "z"), self.order)

    @property
    def order(self) -> int:
        """Order of the time derivative of a displacement that it measures: 0, 1 or 2."""
        return QUANTITIES.index(self.quantity)

    @property
    def inertial(self) -> bool:
        """Whether it measures absolute motion, as every accelerometer does."""
        return self.order == 2 if self.absolute is None else self.absolute

    @abstractmethod
    def row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the row (n,) that gives the measured displacement from the model's DOFs.

        A sensor of a velocity or an acceleration measures a time derivative of this displacement.
        """

    def carried(self, realisation: ModalRealisation) -> FloatArray:
        """Return the displacement (6,) that it measures per unit of each rigid-body motion.

        The rigid-body motions are x, y, z, rx, ry, rz about the origin.
        """
        return np.asarray(self.row(realisation) @ realisation.model.rigid_motions())

    def static_row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the row (n,) that gives the channel for constant displacements of the DOFs.

        It includes the static gain of the filter. It is zero for velocities and accelerations.
        """
        return (static_gain(self.filter) if self.order == 0 else 0.0) * self.row(realisation)

    def see(self, realisation: ModalRealisation) -> MeasuredRow:
        """Return the coefficients of states, forces and ground motions in the signal."""
        along = self.carried(realisation) if self.inertial else None
        return observed(realisation, self.row(realisation), self.order, along)


def static_gain(part: StateSpace | None) -> float:
    """Return the gain of a filter at 0 Hz; 1 without one."""
    return 1.0 if part is None else float(part.evaluated(0.0)[0, 0].real)


def motion_unit(at: Place, direction: str, order: int = 0) -> str | None:
    """Return the unit of a motion; None for a sum of displacements and rotations."""
    turns = turning(at, direction)
    return None if turns is None else ("rad" if turns else "m") + PER_TIME[order]


def force_unit(at: Place, direction: str) -> str | None:
    """Return the unit of a force; None for a sum of forces and moments."""
    turns = turning(at, direction)
    return None if turns is None else "N m" if turns else "N"


def turning(at: Place, direction: str) -> bool | None:
    """Return whether a place moves by rotation; None where a sum of both kinds does not tell.

    A sum of both kinds has the unit of the part with weights of length 1: the weights of the other
    part are then levers, as in the motion ``{"2:y": 1, "2:rz": -0.7}`` [m] of a rail 0.7 m away.
    """
    kinds = {one.startswith("r") for one in place_directions(at, direction)}
    if len(kinds) == 1:
        return kinds.pop()
    squares: dict[tuple[Any, bool], float] = {}
    for one, weight in at.items() if isinstance(at, Mapping) else ():
        node, _, along = one.rpartition(":") if isinstance(one, str) else (one, "", direction)
        part = node, along.startswith("r")
        squares[part] = squares.get(part, 0.0) + float(weight) ** 2
    whole = {turns for (_, turns), square in squares.items() if abs(square - 1.0) < TYPED}
    return whole.pop() if len(whole) == 1 else None


def place_directions(at: Place, direction: str) -> tuple[str, ...]:
    """Return the directions of the motions at a place: a label has its own, a point this one."""
    places = list(at) if isinstance(at, Mapping) else [at]
    found = (one.rpartition(":")[2] if isinstance(one, str) else direction for one in places)
    return tuple(dict.fromkeys(found)) or (direction,)


#: endings of the channels that a plant makes itself: estimates, references, errors, efforts, noises
#: of sensors and disturbances of actuators
DERIVED = ("hat", "ref", "error", "effort", "noise", "disturbance")


def checked_port(port: Any) -> dict[str, Any]:
    """Return the fields that ports have in common, each checked."""
    name = checked_name(port.name)
    checks: dict[str, Any] = {
        "direction": port_direction,
        "at": checked_place,
        "asd": lambda name, asd: positive(asd, f"asd of {name!r}", zero=True),
        "asd_deviation": lambda name, off: positive(off, f"asd_deviation of {name!r}", zero=True),
        "shape": lambda name, shape: checked_filter(name, "shape", shape),
        "dynamics": lambda name, dynamics: checked_filter(name, "dynamics", dynamics),
        "latency": lambda name, late: positive(late, f"latency of {name!r}", zero=True),
        "held": lambda name, held: flag(held, f"held of {name!r}"),
        "absolute": checked_choice,
    }
    given = port._fields()
    found = {"name": name} | {
        key: check(name, given[key]) for key, check in checks.items() if key in given
    }
    label = found.get("at")
    own = label.rpartition(":")[2] if isinstance(label, str) else "z"
    if isinstance(label, str) and found.get("direction", "z") not in ("z", own):
        raise LabelError(
            f"{name!r} is at {label!r} with direction {found['direction']!r}: a label has its own "
            f"direction, {own!r}. Name the other DOF, "
            f"at='{label.rpartition(':')[0]}:{found['direction']}', or give a point (x, y, z)."
        )
    if given.get("moves") is not None:
        found["moves"] = checked_moves(name, found["at"], given["moves"])
    return found


def checked_name(name: Any) -> str:
    """Return the name of a port, or raise LabelError."""
    if not isinstance(name, str):
        raise LabelError(f"a port is named by a string, got {short(name)}. Name it, such as 'u1'.")
    check_names([name], "ports")
    ending = name.rpartition(":")[2]
    if ":" in name and ending in DERIVED:
        raise LabelError(
            f"a port cannot be named {name!r}: names that end in ':{ending}' are those of channels "
            "that a plant and its observer make themselves, and loops connect by name. Name it "
            f"{name.replace(':', '_')!r}, say."
        )
    return name


def checked_choice(name: str, absolute: Any) -> bool | None:
    """Return whether a motion is absolute, or None where that was left open."""
    if absolute is not None and not isinstance(absolute, bool | np.bool_):
        raise ModelError(
            f"absolute of {name!r} is True (with the motion of the ground) or False (against the "
            f"ground), got {short(absolute)}."
        )
    return None if absolute is None else bool(absolute)


def port_direction(name: str, direction: str) -> str:
    """Return one of the six directions, or raise LabelError."""
    require_known(f"direction of {name!r}", [direction], DIRECTIONS)
    return direction


def checked_place(name: str, at: Any) -> Place:
    """Return a copy of a place: a label, a point, or a sum {label or point: weight}."""
    if isinstance(at, Mapping):
        if not at:
            raise LabelError(f"{name!r} is at an empty mapping: name at least one DOF.")
        return {
            _key(name, place): float(real_array(weight, f"weight of {place!r} in {name!r}", ()))
            for place, weight in at.items()
        }
    if isinstance(at, str):
        return at
    if isinstance(at, Sequence) and all(isinstance(place, str) for place in at):
        raise LabelError(
            f"{name!r} is at one place, got {short(at)}. A channel for each is a port for each; "
            "their weighted sum is a mapping, {'1:z': 0.5, '2:z': 0.5}."
        )
    return tuple(real_array(at, f"place of {name!r}", (3,)).tolist())


def _key(name: str, place: Any) -> Any:
    if isinstance(place, tuple):
        return tuple(real_array(place, f"a point of {name!r}", (3,)).tolist())
    return str(place)


def checked_filter(name: str, what: str, given: Any) -> StateSpace | None:
    """Return a stable continuous system of one input and output, named like its port."""
    if given is None:
        return None
    if not isinstance(given, StateSpace) and hasattr(given, "shape") and hasattr(given, "asd"):
        kind = type(given).__name__
        raise ModelError(
            f"the {what} of {name!r} is a filter, got {kind}, which is a spectrum: noise and its "
            f"filter. It makes the port itself: {kind}(...).force(name, at), .rigid or .floor."
        )
    sys = single_channel(given, f"the {what} of {name!r}")
    if sys.n_states and sys.dt:
        raise ModelError(
            f"the {what} of {name!r} is sampled (dt {sys.dt:g} s), but belongs to the machine: "
            "give the continuous system, it is sampled with the plant."
        )
    if not sys.is_stable:
        raise ModelError(
            f"the {what} of {name!r} is not stable (poles {_slowest(sys)} rad/s): nothing would "
            "be stationary. Replace an integrator by a low-pass with a corner far below the band."
        )
    prefix = [f"{name}|{state.rpartition('|')[2]}" for state in sys.states]
    return sys.replace(inputs=["in"], outputs=["out"], dt=0.0, states=prefix)


def _slowest(sys: StateSpace) -> str:
    worst = sorted(sys.poles(), key=lambda pole: -pole.real)[:2]
    return ", ".join(f"{pole:.4g}" for pole in worst)
