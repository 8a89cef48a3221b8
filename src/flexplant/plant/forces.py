"""What pushes a machine: disturbances, with a spectrum too, and actuators."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..arrays import FloatArray, between, positive, real_array
from ..errors import require_known
from ..labels import Place
from ..lti.statespace import StateSpace
from ..store import Value, checked
from ..structure.rigid import turned_about
from .port import ForcePort, force_unit, motion_unit
from .realisation import ModalRealisation
from .rigid_body import inertia_load, rigid_body_of


@dataclass(frozen=True, eq=False)
class Disturbance(ForcePort):
    """A force (or moment) from outside, in w.

    Parameters
    ----------
    name : str
        Name of the disturbance, which is also its channel of w.
    at : str, (3,) array [m] or mapping
        A DOF label, a point, or a sum {label or point: weight}.
    direction : str
        Direction of the force at a point: x, y, z [N] or rx, ry, rz [N m]. Labels contain a
        direction.
    asd : float [N/sqrt(Hz)]
        One-sided amplitude spectral density of white noise; 0 for a force that is not noise.
    asd_deviation : float
        Relative standard deviation of the density among the machines ``plant.machines``, which are
        drawn at random.
    shape : StateSpace, optional
        Stable filter between the channel and the structure. The asd is then that of the white noise
        at the input of the filter, and the states of the filter are added to those of the plant.
    held : bool
        Whether the noise is held over each sample, like that of a force from a digital output. It
        has the variance asd^2 rate / 2 per sample once the plant is sampled. It may act directly on
        an acceleration sensor: process and sensor noise are then correlated.
    moves : mapping {position: (3,) array} or PlaceTable, optional
        Motion of the point `at` with the positions of the machine (see `Ports`). The point is at
        `at` when all positions are zero.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.Disturbance("amp", at="41:z", asd=1e-3)  # white, 1e-3 N/sqrt(Hz) one-sided
    Disturbance(name='amp', at='41:z', direction='z', asd=0.001, shape=None, held=False, moves=None)
    """

    name: str
    at: Place
    direction: str = "z"
    asd: float = 0.0
    shape: StateSpace | None = None
    held: bool = False
    moves: Any = None
    asd_deviation: float = field(default=0.0, kw_only=True, repr=False)


@dataclass(frozen=True, eq=False)
class BaseAcceleration(ForcePort):
    """An acceleration of the floor (or frame) under the whole structure, in w.

    The load on the structure is ``-M r a``. Here a is the acceleration, M the mass matrix, and r
    the rigid-body motion of the structure in the direction of the acceleration. The structure, POIs
    and sensors of displacement and velocity move relative to the base. For POIs and sensors that
    are `absolute` (as accelerometers are), the motion of the base is added: its acceleration r a,
    or the integrals of r a. The integrals are bounded if the `shape`, or the `dynamics` of the
    sensor (those of a geophone), has as many zeros at 0 Hz as there are integrals. A free structure
    stays at rest in space while the ground moves. Springs to ground (`suspend`) and supports
    transmit the motion of the ground and make the structure bend.

    Parameters
    ----------
    name : str
        Name of the acceleration, which is also its channel of w.
    direction : str
        Direction of the acceleration: x, y, z [m/s^2] or rx, ry, rz [rad/s^2].
    asd : float [m/s^2/sqrt(Hz), rad/s^2/sqrt(Hz)]
        One-sided amplitude spectral density of white noise; 0 for none.
    asd_deviation : float
        Relative standard deviation of the density among the machines ``plant.machines``, which are
        drawn at random.
    shape : StateSpace, optional
        A stable filter between the channel and the base: the floor's spectrum.
    about : (3,) array [m]
        Point about which a rotation turns.

    Notes
    -----
    Modes and reduced models contain only the inertia of motions that their mode shapes can
    represent. This is sufficient for free or suspended structures. For a structure that is held at
    some DOFs, pass the FEModel. An FEModel that was held by `fixed` keeps the part of the mass
    matrix that couples its free DOFs to the held ones. Matrices from which another program removed
    the held DOFs have lost these forces.

    Examples
    --------
    >>> import flexplant as fx
    >>> floor = fx.BaseAcceleration("floor", "z", asd=2e-5, shape=fx.lti.low_pass_filter(60.0))
    >>> floor.unit
    'm/s^2'
    """

    name: str
    direction: str = "z"
    asd: float = 0.0
    shape: StateSpace | None = None
    about: tuple[float, ...] | FloatArray = (0.0, 0.0, 0.0)
    asd_deviation: float = field(default=0.0, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        about = real_array(self.about, f"about of {self.name!r}", (3,))
        self._set(about=tuple(about.tolist()))

    @property
    def unit(self) -> str | None:
        """Unit of the channel: m/s^2 or rad/s^2."""
        return motion_unit({}, self.direction, 2)

    @property
    def ground(self) -> FloatArray:
        """Rigid-body motion (6,) of the ground about the origin, per unit of the channel."""
        return turned_about(self.direction, np.asarray(self.about))

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) ``-M r`` over the model's DOFs of a unit acceleration."""
        return inertia_load(realisation, self.direction, np.asarray(self.about))


@dataclass(frozen=True, eq=False)
class OutputDisturbance(ForcePort):
    """A disturbance in w that is added to the motion of one sensor, before the sensor's dynamics.

    White noise needs a sensor with `dynamics` that roll off (an anti-alias filter, for example), or
    a shape that rolls off; otherwise the samples of the sensor would have infinite variance. For
    white noise of the samples use `Sensor.asd`.

    Parameters
    ----------
    name, sensor : str
        Names of the channel and of the sensor.
    asd : float [unit of the channel/sqrt(Hz)]
        One-sided amplitude spectral density of white noise; 0 for none.
    asd_deviation : float
        Relative standard deviation of the density among the machines ``plant.machines``, which are
        drawn at random.
    shape : StateSpace, optional
        A stable filter between the channel and the sensor: drift, mains hum.
    unit : str, optional
        Unit of the channel if the shape changes the unit, for example rad/s for rate noise whose
        integral a gyro shows; by default the unit of the sensor.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.OutputDisturbance("cable", sensor="y1", asd=1e-12)
    OutputDisturbance(name='cable', sensor='y1', asd=1e-12, shape=None, unit=None)
    """

    name: str
    sensor: str
    asd: float = 0.0
    shape: StateSpace | None = None
    asd_deviation: float = field(default=0.0, kw_only=True, repr=False)
    unit: str | None = field(default=None, kw_only=True)

    @property
    def added_to(self) -> str:
        """The sensor that it is added to."""
        return self.sensor

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return no load (n,): it does not act on the structure."""
        return np.zeros(realisation.outputs.shape[0])


@dataclass(frozen=True, eq=False)
class Actuator(ForcePort):
    """A force (or moment) that the controller commands, in u.

    Parameters
    ----------
    name, at, direction, moves
        Name, place, direction and motion as for `Disturbance`. If the place is a weighted sum, the
        actuator drives several forces at once, for example a pair of opposite forces.
    dynamics : StateSpace, optional
        Stable system of amplifier and motor, from command to force. Its states are added to those
        of the plant.
    latency : float [s]
        Delay of the command by cable or bus, in seconds, in addition to the `delay` in samples of
        `discretized`. A sampled plant contains it exactly, also if it is a fraction of a sample. A
        continuous plant neglects it, and its printed text says so (`ports.with_pade(order)`
        approximates the delay there).
    asd : float [N/sqrt(Hz), N m/sqrt(Hz)]
        One-sided amplitude spectral density of white noise at the amplifier's input, the channel
        `name:disturbance` of w. It passes through the `dynamics` like the command, but not through
        the latency.
    asd_deviation : float
        Relative standard deviation of the density among the machines ``plant.machines``, which are
        drawn at random.

    Raises
    ------
    LabelError, ModelError
        For a bad name, place, direction, dynamics, a negative asd, or a latency that is
        negative or a second or more.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(4e3)
    >>> motor = fx.Actuator("u1", at=(0.1, 0.2, 0.0), dynamics=slow, asd=1e-4)
    >>> motor.unit, motor.direction
    ('N', 'z')
    """

    home: ClassVar = "u"
    name: str
    at: Place
    direction: str = "z"
    dynamics: StateSpace | None = None
    latency: float = 0.0
    asd: float = 0.0
    moves: Any = None
    asd_deviation: float = field(default=0.0, kw_only=True, repr=False)


class _Spectrum(Value):
    """White noise of one-sided density `asd` through a stable filter, `shape`."""

    @property
    @abstractmethod
    def asd(self) -> float: ...

    @property
    @abstractmethod
    def shape(self) -> StateSpace: ...

    def force(self, name: str, at: Place, direction: str = "z") -> Disturbance:
        """Return the force [N, N m] of this spectrum at a place; see `Disturbance`."""
        return Disturbance(name, at, direction, self.asd, self.shape)

    def rigid(self, name: str, direction: str = "z") -> RigidForce:
        """Return the force [N, N m] of this spectrum on a rigid-body axis; see `RigidForce`."""
        return RigidForce(name, direction, self.asd, self.shape)

    def floor(self, name: str, direction: str = "z") -> BaseAcceleration:
        """Return this spectrum as a `BaseAcceleration` [m/s^2, rad/s^2]."""
        return BaseAcceleration(name, direction, self.asd, self.shape)


@dataclass(frozen=True, eq=False)
class FirstOrder(_Spectrum):
    """First-order noise: flat up to a corner, then falling with 20 dB per decade.

    ``shape = omega / (s + omega)``. At its output, white noise of density asd has the variance
    ``asd^2 omega / 4``.

    Parameters
    ----------
    rms : float [N]
        Root mean square of the force.
    corner : float [Hz]
        Corner frequency, omega / (2 pi).

    Examples
    --------
    >>> import flexplant as fx
    >>> hum = fx.plant.FirstOrder(rms=0.01, corner=20.0)
    >>> hum.asd, hum.shape
    (0.001784124116152771, <StateSpace: 1 state, continuous, u1 -> y1>)
    """

    rms: float = field(metadata=checked(positive))
    corner: float = field(metadata=checked(positive))

    @property
    def asd(self) -> float:
        """Density [N/sqrt(Hz)] far below the corner."""
        return float(2.0 * self.rms / np.sqrt(2 * np.pi * self.corner))

    @property
    def shape(self) -> StateSpace:
        """The low-pass filter."""
        omega = 2 * np.pi * self.corner
        return StateSpace([[-omega]], [[omega]], [[1.0]], [[0.0]], states=["force"])


@dataclass(frozen=True, eq=False)
class NarrowBand(_Spectrum):
    """Narrow-band noise: hum, an imbalance, a pump.

    ``shape = 2 zeta omega s / (s^2 + 2 zeta omega s + omega^2)`` has the gain 1 at its frequency.
    At its output, white noise of density asd has the variance ``asd^2 zeta omega / 2``. The force
    is an oscillation whose amplitude and phase drift; its correlation decays by the factor e in
    ``1 / (2 pi zeta)`` periods.

    Parameters
    ----------
    rms : float [N]
        Root mean square of the force.
    freq : float [Hz]
        Centre frequency, omega / (2 pi).
    zeta : float
        Half the relative bandwidth, below 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> pump = fx.plant.NarrowBand(rms=0.01, freq=48.0)
    >>> round(fx.h2_norm(pump.shape) * pump.asd / 2**0.5, 6)  # the rms again
    0.01
    """

    rms: float = field(metadata=checked(positive))
    freq: float = field(metadata=checked(positive))
    zeta: float = field(
        default=0.01,
        metadata=checked(between, low=0.0, high=1.0, hint="No band is that wide: use FirstOrder."),
    )

    @property
    def asd(self) -> float:
        """Density [N/sqrt(Hz)] at the frequency."""
        return float(self.rms * np.sqrt(2.0 / (self.zeta * 2 * np.pi * self.freq)))

    @property
    def shape(self) -> StateSpace:
        """The band-pass filter."""
        omega = 2 * np.pi * self.freq
        width = 2 * self.zeta * omega
        return StateSpace(
            [[0.0, omega], [-omega, -width]], [[0.0], [width]], [[0.0, 1.0]], [[0.0]],
            states=["integral", "force"],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RandomWalk(_Spectrum):
    """A slowly drifting force (bias). Its change over a time t has the rms ``drift t^(1/2)``.

    It is first-order noise with a corner far below all other frequencies, so that it is stationary
    and all variances are finite. Above the corner it cannot be distinguished from a random walk.

    Parameters
    ----------
    drift : float [N/sqrt(s)]
        Standard deviation of its change in one second.
    corner : float [Hz]
        Corner frequency, below the inverse of the longest record.

    Examples
    --------
    >>> import flexplant as fx
    >>> drift = fx.plant.RandomWalk(drift=1e-3)
    >>> drift.shape
    <StateSpace: 1 state, continuous, u1 -> y1>
    """

    drift: float = field(metadata=checked(positive))
    corner: float = field(default=1e-4, metadata=checked(positive))

    @property
    def rms(self) -> float:
        """Root mean square [N] that the corner leaves: drift / (4 pi corner)^(1/2)."""
        return float(self.drift / np.sqrt(4 * np.pi * self.corner))

    asd, shape = FirstOrder.asd, FirstOrder.shape


@dataclass(frozen=True, eq=False)
class RigidForce(ForcePort):
    """A force (or moment) spread over the mass so that a free machine moves and does not bend.

    The load is ``M r / (r' M r)``. Here M is the mass matrix and r the rigid-body motion along the
    direction; rotations are about the centre of mass. It does the work of a unit force along r, and
    no work on elastic modes of a free structure.

    Parameters
    ----------
    name, asd, shape, asd_deviation : as for `Disturbance`
    direction : str
        Direction of the force: x, y, z [N] or rx, ry, rz [N m].

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.RigidForce("cable", "x", asd=1e-3).unit
    'N'
    """

    name: str
    direction: str = "z"
    asd: float = 0.0
    shape: StateSpace | None = None
    asd_deviation: float = field(default=0.0, kw_only=True, repr=False)

    @property
    def unit(self) -> str | None:
        """Unit of the channel: N or N m."""
        return force_unit({}, self.direction)

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) over the model's DOFs of a unit force."""
        body = rigid_body_of(realisation)
        require_known("rigid-body axis of the machine", [self.direction], body.axes)
        row = body.axes.index(self.direction)
        load = inertia_load(realisation, self.direction, body.centre)
        return np.asarray(-load / body.mass[row, row])
