"""Disturbances with a spectrum: first-order, narrow-band and almost constant forces as ports."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np

from ..checks import FloatArray, Value, between, checked, positive
from ..errors import unknown_label
from ..labels import Place
from ..lti.statespace import StateSpace
from .forces import BaseAcceleration, Disturbance
from .port import ForcePort, force_unit
from .realisation import ModalRealisation
from .rigid.rigid_body import inertia_load, rigid_body_of


class _Spectrum(Value):
    """White noise through a stable filter: `asd` of the noise, and the filter as `shape`."""

    @property
    @abstractmethod
    def asd(self) -> float:
        """One-sided amplitude spectral density of the white noise before the filter."""

    @property
    @abstractmethod
    def shape(self) -> StateSpace:
        """The filter."""

    def force(self, name: str, at: Place, direction: str = "z") -> Disturbance:
        """Return the force of this spectrum at a place: a channel of w.

        Parameters
        ----------
        name : str
            The channel's name.
        at : str, (3,) array [m] or mapping
            A DOF label, a point, or a sum {label or point: weight}.
        direction : str
            At points: x, y, z or rx, ry, rz.

        Raises
        ------
        LabelError, ModelError
            For a bad name, place or direction.
        """
        return Disturbance(name, at, direction, self.asd, self.shape)

    def rigid(self, name: str, direction: str = "z") -> RigidForce:
        """Return the force of this spectrum on a rigid-body axis, which bends nothing.

        Parameters
        ----------
        name : str
            The channel's name.
        direction : str
            x, y, z [N] or rx, ry, rz [N m].

        Raises
        ------
        LabelError, ModelError
            For a bad name or direction.
        """
        return RigidForce(name, direction, self.asd, self.shape)

    def floor(self, name: str, direction: str = "z") -> BaseAcceleration:
        """Return the base acceleration of this spectrum [m/s^2 or rad/s^2].

        Parameters
        ----------
        name : str
            The channel's name.
        direction : str
            x, y, z or rx, ry, rz.

        Raises
        ------
        LabelError, ModelError
            For a bad name or direction.
        """
        return BaseAcceleration(name, direction, self.asd, self.shape)


@dataclass(frozen=True, eq=False)
class FirstOrder(_Spectrum):
    """First-order noise: flat up to a corner, then falling with 20 dB per decade.

    ``shape = omega / (s + omega)``; white noise of density asd has the variance
    ``asd^2 omega / 4`` behind it.

    Parameters
    ----------
    rms : float [N]
        Its root mean square.
    corner : float [Hz]
        omega / (2 pi).

    Raises
    ------
    ModelError
        When one is not positive.

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
        """The low-pass."""
        omega = 2 * np.pi * self.corner
        return StateSpace([[-omega]], [[omega]], [[1.0]], [[0.0]], states=["force"])


@dataclass(frozen=True, eq=False)
class NarrowBand(_Spectrum):
    """Narrow-band noise: hum, an imbalance, a pump.

    ``shape = 2 zeta omega s / (s^2 + 2 zeta omega s + omega^2)``, 1 at its frequency; white noise
    of density asd has the variance ``asd^2 zeta omega / 2`` behind it. The force loses its phase
    within 1 / (2 pi zeta) periods.

    Parameters
    ----------
    rms : float [N]
        Its root mean square.
    freq : float [Hz]
        omega / (2 pi).
    zeta : float
        Half the relative bandwidth, below 1.

    Raises
    ------
    ModelError
        When one is not positive, or zeta not below 1.

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
        """The band-pass."""
        omega = 2 * np.pi * self.freq
        width = 2 * self.zeta * omega
        return StateSpace(
            [[0.0, omega], [-omega, -width]], [[0.0], [width]], [[0.0, 1.0]], [[0.0]],
            states=["integral", "force"],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RandomWalk(_Spectrum):
    """A force that drifts: a bias. Its rms after a time t is ``drift t^(1/2)``.

    First-order noise with a corner far below everything else, so that it is stationary and no
    variance of anything is infinite: above the corner nothing distinguishes it from a random walk.

    Parameters
    ----------
    drift : float [N/sqrt(s)]
        Deviation of its change in one second.
    corner : float [Hz]
        Below the inverse of the longest record.

    Raises
    ------
    ModelError
        When one is not positive.

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

    @property
    def asd(self) -> float:
        """Density [N/sqrt(Hz)] far below the corner."""
        return FirstOrder(self.rms, self.corner).asd

    @property
    def shape(self) -> StateSpace:
        """The low-pass."""
        return FirstOrder(self.rms, self.corner).shape


@dataclass(frozen=True, eq=False)
class RigidForce(ForcePort):
    """A force (or moment) spread over the mass so that a free machine moves and does not bend.

    The load ``M r / (r' M r)``, r the rigid-body motion of its axis, rotations about the centre of
    mass: it does the work of a unit force along r, and none on elastic modes of a free structure.

    Parameters
    ----------
    name : str
        The channel's name.
    direction : str
        x, y, z [N] or rx, ry, rz [N m].
    asd : float [N/sqrt(Hz), N m/sqrt(Hz)]
        One-sided amplitude spectral density of white noise; 0 for none.
    shape : StateSpace, optional
        A stable filter between the channel and the machine.

    Raises
    ------
    LabelError, ModelError
        For a bad name, direction, shape or a negative asd.

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

    @property
    def unit(self) -> str | None:
        """N or N m."""
        return force_unit({}, self.direction)

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) over the model's DOFs of a unit force."""
        body = rigid_body_of(realisation)
        if self.direction not in body.axes:
            raise unknown_label("rigid-body axis of the machine", self.direction, body.axes)
        row = body.axes.index(self.direction)
        load = inertia_load(realisation, self.direction, body.centre)
        return np.asarray(-load / body.mass[row, row])
