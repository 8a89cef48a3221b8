"""Outputs of a machine: sensors, and points of interest that no sensor measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from ..checks import FloatArray, Value, check_names, name_list
from ..errors import LabelError, require_known
from ..labels import DIRECTIONS, Place
from ..lti.statespace import StateSpace
from ..structure.rigid import place_motion
from .port import (
    Quantity,
    Seen,
    SensorPort,
    checked_choice,
    checked_name,
    checked_place,
    motion_unit,
    observed,
)
from .realisation import ModalRealisation
from .scheduling import checked_moves


@dataclass(frozen=True, eq=False)
class Sensor(SensorPort):
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
        simulation refuse: shape the disturbance, let it be held over each sample
        (`Disturbance(held=True)`), or give the sensor `dynamics` that roll off.
    asd : float [m/sqrt(Hz), rad/sqrt(Hz), ... per s or s^2]
        One-sided amplitude spectral density of its white noise; a sample has variance
        asd^2 rate / 2. It is added to the samples, after dynamics and latency; what passes through
        them is an OutputDisturbance.
    dynamics : StateSpace, optional
        Sensor and anti-alias filter, motion to signal: stable; its states join the plant's.
    latency : float [s]
        Delay of the signal, in seconds. Exact, also between samples, once the plant is sampled; a
        continuous plant leaves it out and says so (`ports.with_pade(order)` approximates it there).
    absolute : bool, optional
        Whether a BaseAcceleration moves it too: True of inertial sensors, as of a geophone
        (absolute velocity), False of what measures against the floor. When not given,
        accelerations are absolute, displacements and velocities are relative to the floor.
    moves : mapping {position: (3,) array} or PlaceTable, optional
        How its point follows the positions of `Ports`; `at` is where all of them are zero.

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

    @property
    def unit(self) -> str | None:
        """Unit of the motion, m or rad, per s, per s^2; None for a sum of both."""
        return motion_unit(self.at, self.direction, self.order)

    def row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the row (n,) over the model's DOFs of its displacement."""
        return realisation.row(self.at, self.direction)

    def carried(self, realisation: ModalRealisation) -> FloatArray:
        """Return its motion (6,) with each rigid-body motion about the origin."""
        return place_motion(realisation.model.full_dofs, self.at, self.direction)


@dataclass(frozen=True, eq=False)
class Poi(Value):
    """A Point Of Interest: motions to be controlled that no sensor measures, in z as `name:axis`.

    Parameters
    ----------
    name : str
        Its name.
    at : str or (3,) array [m]
        A DOF label (whose direction is replaced by the axes) or any point of the structure.
    axes : sequence of str
        Of x, y, z [m], rx, ry, rz [rad]; a Reference follows the first one unless it names others.
    absolute : bool
        Whether a BaseAcceleration moves it too; its motion relative to the floor otherwise.
    moves : mapping {position: (3,) array} or PlaceTable, optional
        How its point follows the positions of `Ports`; `at` is where all of them are zero.

    Raises
    ------
    LabelError, ModelError
        For a bad name, place or axis.

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
    axes: Sequence[str] = ("z",)
    absolute: bool = False
    moves: Any = None

    def __post_init__(self) -> None:
        axes = name_list(self.axes, f"axes of POI {self.name!r}")
        require_known(f"axis of POI {self.name!r}", axes, DIRECTIONS)
        if not axes:
            raise LabelError(f"POI {self.name!r} has no axes: name at least one, such as ('z',).")
        check_names(axes, f"axes of POI {self.name!r}")
        if isinstance(self.at, Mapping) and len(axes) > 1:
            raise LabelError(
                f"POI {self.name!r} is a combination of DOFs, so it has one axis, got {axes}. "
                "Give a point or a DOF label, or one POI per combination."
            )
        name, absolute = checked_name(self.name), checked_choice(self.name, self.absolute)
        at = checked_place(name, self.at)
        moves = checked_moves(name, at, self.moves)
        self._set(axes=axes, name=name, at=at, absolute=bool(absolute), moves=moves)

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

    def unit(self, axis: str) -> str | None:
        """Return the unit of an axis: m or rad; None for a sum of both."""
        # a label gives the place alone: its direction is replaced by the axis
        return motion_unit(self.at if isinstance(self.at, Mapping) else {}, axis)

    def row(self, realisation: ModalRealisation, axis: str) -> FloatArray:
        """Return the row (n,) over the model's DOFs of one axis."""
        try:
            return realisation.row(self._at(axis), axis)
        except LabelError as error:
            if not isinstance(self.at, str) or self.at == self._at(axis):
                raise
            raise LabelError(
                f"POI {self.name!r} is at {self.at!r} with the axes {self.axes}, which replace the "
                f"label's direction: {error} Name those that are there, axes=(...)."
            ) from error

    def see(self, realisation: ModalRealisation, axis: str) -> Seen:
        """Return what an axis shows of the states, and of forces at once."""
        along = None
        if self.absolute:
            along = place_motion(realisation.model.full_dofs, self._at(axis), axis)
        return observed(realisation, self.row(realisation, axis), 0, along)

    def _at(self, axis: str) -> Place:
        """Return the place of an axis: of a label the direction is replaced."""
        return f"{self.at.split(':')[0]}:{axis}" if isinstance(self.at, str) else self.at
