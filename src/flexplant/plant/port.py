"""What every port of a machine has: the bases that a new kind of force or sensor derives from."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np

from ..errors import unknown_label
from ..labels import Place
from ..lti.statespace import StateSpace
from ..values import FloatArray, Value
from .port_checks import checked_port
from .realisation import ModalRealisation

Quantity: TypeAlias = Literal["displacement", "velocity", "acceleration"]
#: in the order of their time derivatives
QUANTITIES: tuple[Quantity, ...] = ("displacement", "velocity", "acceleration")


class Seen(NamedTuple):
    """What a channel measures: ``row x + direct f + carried g``.

    Parameters
    ----------
    row : (2 b,) array
        Over the states of the modes.
    direct : (n,) array
        Over loads at the model's DOFs: what follows a force at once.
    carried : (6,) array
        Over the rigid-body motions of the ground about the origin (x, y, z, rx, ry, rz), in the
        derivative that is measured: 0 of what is measured against the ground.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.Seen(row=np.ones((1, 3)), direct=np.zeros((1, 2))).row.shape
    (1, 3)
    """

    row: FloatArray
    direct: FloatArray
    carried: FloatArray = np.zeros(6)


def seen(
    realisation: ModalRealisation,
    row: FloatArray,
    order: int = 0,
    carried: FloatArray | None = None,
) -> Seen:
    """Return how the time derivative of some order of a displacement (a row over DOFs) is seen.

    Against the ground, or with its motion `carried` (6,) along.
    """
    along = np.zeros(6) if carried is None else carried
    if order == 0:
        return Seen(realisation.motion(row, 0), realisation.at_once(row), along)
    direct = np.zeros(row.size)
    if order == 2:  # an acceleration follows a force at once: d2q/dt2 = S A A x + S A N' f
        direct = realisation.inputs @ realisation.motion(row, 1)
    return Seen(realisation.motion(row, order), direct, along)


class ForcePort(Value):
    """A port in w or u. A new kind has a `name`, and says by `push` where it acts.

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

    def __post_init__(self) -> None:
        self._set(**checked_port(self))

    @property
    def filter(self) -> StateSpace | None:
        """The system between the channel and the structure."""
        found: StateSpace | None = getattr(self, "shape", None)
        return found

    @property
    def unit(self) -> str | None:
        """Unit of the channel; None where it has none."""
        return None

    @property
    def added_to(self) -> str | None:
        """The sensor that it is added to, for what does not act on the structure."""
        return None

    @property
    def ground(self) -> FloatArray:
        """The rigid-body motion (6,) of the ground about the origin whose acceleration it is."""
        return np.zeros(6)

    @abstractmethod
    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) over the model's DOFs per unit behind the filter."""

    def static_push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) per unit of the channel at rest: the filter is its static gain."""
        return static_gain(self.filter) * self.push(realisation)


class SensorPort(Value):
    """A port in y. A new kind has the fields below, and says by `row` or `see` what it measures.

    By `row`, a displacement: that of a point beside another, say; with a `quantity` also its
    velocity or acceleration. By `see`, anything that is linear in states and forces; `row` is then
    what it shows at rest.

    Parameters
    ----------
    name : str
        The channel's name.
    at : str, (3,) array [m] or mapping
        Where it is drawn, and what `StandardPlant.at` moves.
    asd : float
        One-sided amplitude spectral density of its white noise.
    dynamics : StateSpace, optional
        Sensor and anti-alias filter.
    latency : float [s]
        Delay of the signal, in seconds.
    quantity : {"displacement", "velocity", "acceleration"}
        What is measured.
    absolute : bool, optional
        Whether the motion of the ground is part of it; that of accelerations when not given.

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
    dynamics: StateSpace | None = None
    latency: float = 0.0
    quantity: Quantity = "displacement"
    absolute: bool | None = None

    def __post_init__(self) -> None:
        self._set(**checked_port(self))
        if self.quantity not in QUANTITIES:
            raise unknown_label(f"quantity of {self.name!r}", self.quantity, QUANTITIES)

    @property
    def filter(self) -> StateSpace | None:
        """The system between the motion and the channel."""
        return self.dynamics

    @property
    def unit(self) -> str | None:
        """Unit of the channel; None where it has none."""
        return None

    @property
    def order(self) -> int:
        """Which time derivative of a displacement it measures: 0, 1 or 2."""
        return QUANTITIES.index(self.quantity)

    @property
    def inertial(self) -> bool:
        """Whether it measures absolute motion: no accelerometer measures against the ground."""
        return self.order == 2 if self.absolute is None else self.absolute

    @abstractmethod
    def row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the row (n,) over the model's DOFs of the displacement that it is about."""

    def carried(self, realisation: ModalRealisation) -> FloatArray:
        """Return its motion (6,) with each rigid-body motion about the origin."""
        return np.asarray(self.row(realisation) @ realisation.model.rigid_motions())

    def static_row(self, realisation: ModalRealisation) -> FloatArray:
        """Return what the channel shows of displacements (n,) at rest: 0 of other quantities."""
        return (static_gain(self.filter) if self.order == 0 else 0.0) * self.row(realisation)

    def see(self, realisation: ModalRealisation) -> Seen:
        """Return what it measures of the states, and of forces at once."""
        along = self.carried(realisation) if self.inertial else None
        return seen(realisation, self.row(realisation), self.order, along)


def static_gain(part: StateSpace | None) -> float:
    """Return the gain of a filter at 0 Hz; 1 without one."""
    return 1.0 if part is None else float(part.evaluated(0.0)[0, 0].real)


def motion_unit(at: Place, direction: str, order: int = 0) -> str | None:
    """Return the unit of a motion; None for a sum of displacements and rotations."""
    turns = turning(at, direction)
    return None if turns is None else ("rad" if turns else "m") + ("", "/s", "/s^2")[order]


def force_unit(at: Place, direction: str) -> str | None:
    """Return the unit of a force; None for a sum of forces and moments."""
    turns = turning(at, direction)
    return None if turns is None else "N m" if turns else "N"


def turning(at: Place, direction: str) -> bool | None:
    """Return whether a place moves by rotation; None for a sum of both kinds."""
    places = list(at) if isinstance(at, Mapping) else [at]
    kinds = {
        (place.rpartition(":")[2] if isinstance(place, str) else direction).startswith("r")
        for place in places
    } or {direction.startswith("r")}
    return kinds.pop() if len(kinds) == 1 else None
