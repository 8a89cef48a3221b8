"""Static transformations between channels and axes: those that u moves, and those of the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, divisor, name_list
from ..errors import AssumptionError, counted, require_known, some_names
from ..lti.statespace import StateSpace
from ..store import Value
from ..tolerances import TYPED
from .axes import DrivenAxes, apart, driven_axes, real_gain
from .inverse import followed_at_rest
from .partitioned import Partition
from .rigid_body import RigidBody, refuse_lost, rigid_body_of, rigid_parts

#: units of displacements and rotations at the centre of gravity, by what a channel carries
_UNITS = (
    {"": "m", ":acceleration": "m/s^2", ":force": "N"},
    {"": "rad", ":acceleration": "rad/s^2", ":force": "N m"},
)


class _StaticAxes(Value):
    """Static systems between the channels of a plant and its axes."""

    to_actuators: StateSpace
    to_motions: StateSpace

    @property
    def T_u(self) -> FloatArray:
        """Matrix (nu, r) from commands of the axes, or forces along them, to actuators."""
        return self.to_actuators.D

    @property
    def T_y(self) -> FloatArray:
        """Matrix (r, ny) from sensors to motions of the axes."""
        return self.to_motions.D


@dataclass(frozen=True, eq=False, repr=False)
class Decoupling(_StaticAxes):
    """Static transformations between the channels of a plant and its axes.

    Let G be the plant from u to y. At the real frequency s = sigma = 2 pi freq,
    ``to_motions G to_actuators`` is then approximately ``I / sigma^2``, apart from hold and delay.
    An axis that moves as a mass at this frequency is therefore a double integrator. At rest
    ``to_motions y`` gives the positions of the axes.

    Parameters
    ----------
    driven : DrivenAxes
        Axes, actuators, and the frequencies at which the axes are decoupled.
    to_actuators : StateSpace
        Static system T from the commands `die:z:command` of the axes [m/s^2, rad/s^2] to the
        actuators.
    to_motions : StateSpace
        Static system T_y from the sensors to the motions of the axes `die:z` [m, rad]. Its outputs
        are a least-squares estimate, weighted by the noise of the sensors. If an axis is a channel
        of y, its motion is the signal of this sensor.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.decouple(fx.testbeds.dual_stage(), bandwidth=20.0)
    <Decoupling die:x, gap:x at 20 Hz: 2 actuators, 2 sensors>
    """

    driven: DrivenAxes
    to_actuators: StateSpace
    to_motions: StateSpace

    def __repr__(self) -> str:
        at = ", ".join(f"{f:.4g}" for f in np.unique(self.driven.freq))
        return (
            f"<Decoupling {', '.join(self.axes)} at {at} Hz: "
            f"{counted(len(self.to_actuators.outputs), 'actuator')}, "
            f"{counted(len(self.to_motions.inputs), 'sensor')}>"
        )

    @property
    def axes(self) -> tuple[str, ...]:
        """The channels of the axes."""
        return self.driven.channels

    @property
    def accelerations(self) -> StateSpace:
        """System from commands (accelerations where the axis is a mass) to actuators."""
        return self.to_actuators


def decouple(
    plant: Partition,
    *,
    axes: Sequence[str] | None = None,
    bandwidth: float | Mapping[str, float] | None = None,
) -> Decoupling:
    """Return static transformations to and from the axes that the actuators can move.

    The axes are decoupled at a real frequency sigma, where no mode resonates (see
    `flexplant.plant.driven_axes`). `flexplant.plant.gravity_axes` gives the mass and the centre of
    gravity of a free body.

    Parameters
    ----------
    plant : StandardPlant
        Plant of a structure, continuous or sampled.
    axes : sequence of str, optional
        Channels of z or y, as for `flexplant.plant.driven_axes`.
    bandwidth : float or mapping {axis: float} [Hz], optional
        Frequency at which the axes are decoupled, about the crossover of their loops. By default it
        is chosen as in `flexplant.plant.driven_axes`.

    Returns
    -------
    Decoupling
        It uses the displacement sensors. If there are none, it uses the velocity sensors, otherwise
        the accelerometers.

    Raises
    ------
    AssumptionError
        When the actuators cannot move the axes independently, or the sensors cannot distinguish the
        axes.
    LabelError, ModelError
        When an axis is unknown; when the plant was not assembled from a structure.

    References
    ----------
    [Skogestad2005]_, section 3.4.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.decouple(fx.testbeds.gantry(), bandwidth=10.0)
    >>> found.axes, found.to_motions.inputs
    (('tool_x:x', 'tool_y:y', 'skew:y'), ('left_encoder', 'right_encoder', 'cross_encoder'))
    """
    plant = Partition.of(plant)
    driven = driven_axes(plant, freq=bandwidth, axes=axes)
    order = min((s.order for s in plant.assembled.ports.y), default=0)
    sensors = [s.name for s in plant.assembled.ports.y if s.order == order]
    T_y = motions_of(plant, driven, sensors)
    commands = [f"{name}:command" for name in driven.channels]
    units = plant.units
    units |= {f"{name}:command": f"{units[name]}/s^2" for name in driven.channels if name in units}
    return Decoupling(
        driven,
        _gain(driven.T, commands, plant.u, plant, units),
        _gain(T_y, sensors, driven.channels, plant, units),
    )


def motions_of(plant: Partition, driven: DrivenAxes, sensors: Sequence[str]) -> FloatArray:
    """Return T_y (r, ny) with ``T_y Y = I``, Y what sensors show of unit axes."""
    # displacements at rest, so that a reference is reached; velocities on the real axis
    Y = _shown(plant, driven, sensors)
    if not apart(Y.T):
        raise AssumptionError(
            f"the sensors ({some_names(list(sensors)) or 'none'}) do not tell the axes "
            f"{some_names(list(driven.channels))} apart. Add or move some, or choose fewer axes, "
            "axes=[...]."
        )
    # each sensor counts by its noise; by what it shows where one has no noise
    noise = np.array([plant.assembled.ports.sensor(name).asd for name in sensors])
    size = 1.0 / (noise if np.all(noise > 0.0) else divisor(np.linalg.norm(Y, axis=1)))
    return np.asarray(np.linalg.pinv(size[:, None] * Y) * size)


def _shown(plant: Partition, driven: DrivenAxes, sensors: Sequence[str]) -> FloatArray:
    """Return what sensors show (p, r) of a unit of each axis."""
    g, u = plant.system, driven.actuators
    if all(plant.assembled.ports.sensor(name).order == 0 for name in sensors):
        return followed_at_rest(g, driven.T, u, driven.channels, sensors, plant.dt)[..., 0]
    shown = []
    for i, f in enumerate(driven.freq):
        sigma = 2.0 * np.pi * f
        late = np.exp(sigma * plant.dt * (plant.delay + 0.5))
        shown.append(real_gain(g, sigma, sensors, u) @ driven.T[:, i] * sigma**2 * late)
    return np.stack(shown, axis=1).reshape(len(sensors), len(driven.channels))


def _gain(
    D: FloatArray,
    inputs: Sequence[str],
    outputs: Sequence[str],
    plant: Partition,
    units: Mapping[str, str],
) -> StateSpace:
    return StateSpace(
        [], [], [], D, plant.dt, inputs=inputs, outputs=outputs, name="decoupling", units=units
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class GravityAxes(_StaticAxes):
    """Static transformations between the channels of a plant and its rigid body.

    Let G be the rigid-body part of the plant from u to y. Then
    ``to_motions G to_actuators = mass^-1 / s^2`` and ``to_motions G accelerations = I / s^2``. On
    ground springs the same transformations are valid above the suspension frequencies, where the
    inertia dominates.

    Parameters
    ----------
    to_actuators : StateSpace
        Static system T_u from forces at the centre of gravity `cog:z:force` [N, N m] to actuator
        forces of least norm.
    to_motions : StateSpace
        Static system T_y from sensors to the least-squares estimate of the motions of the centre of
        gravity `cog:z` [m, rad].
    accelerations : StateSpace
        Static system ``T_u mass`` from accelerations `cog:z:acceleration` to actuators.
    mass : (r, r) array [kg, kg m, kg m^2]
        Inertia about the centre of gravity; a rotational block need not be diagonal.
    centre : (3,) array [m]
        The centre of gravity; 0 in directions that the model's motions do not determine.
    axes : sequence of str
        The r axes, of x, y, z, rx, ry, rz.
    """

    to_actuators: StateSpace
    to_motions: StateSpace
    accelerations: StateSpace
    mass: FloatArray
    centre: FloatArray
    axes: tuple[str, ...]

    def __repr__(self) -> str:
        at = ", ".join(f"{c:.4g}" for c in self.centre)
        return (
            f"<GravityAxes {', '.join(self.axes)} at ({at}) m: {len(self.to_actuators.outputs)} "
            f"actuators, {counted(len(self.to_motions.inputs), 'sensor')}>"
        )


def gravity_axes(plant: Partition, *, axes: Sequence[str] | None = None) -> GravityAxes:
    """Return the static transformations to and from the centre of gravity.

    They follow from the geometry of a free or suspended body. Only rigid-body motions are used and
    no elastic mode shapes, so that a structure on weak springs is decoupled as if it were free. For
    the axes that the actuators of any machine move, use `flexplant.decouple`.

    Parameters
    ----------
    plant : StandardPlant
        Plant of a free or suspended structure, continuous or sampled.
    axes : sequence of str, optional
        Selected rigid-body axes; by default all of the structure.

    Returns
    -------
    GravityAxes
        The static transformations. The filters of the ports enter by their static gains. Only
        displacement sensors are used.

    Raises
    ------
    AssumptionError
        When the actuators cannot move the axes independently, or the sensors cannot distinguish
        them. Also when no axes are given, and actuators or sensors act along an axis that the mode
        shapes of the model do not contain.
    LabelError, ModelError
        When an axis is not one of the structure's; when the plant was not assembled from a
        structure, or it is held.

    References
    ----------
    [Gawronski2004]_, chapter 3 (modes by their shapes at actuators and sensors).

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.gravity_axes(fx.testbeds.three_masses()).mass.round(6)  # all three masses
    array([[3.]])
    """
    plant = Partition.of(plant)
    realisation, ports = plant.assembled.realisation, plant.assembled.ports
    body = rigid_body_of(realisation)
    sensors = [s for s in ports.y if s.order == 0]
    seen = [s.static_row(realisation) for s in sensors]
    pushed = [port.static_push(realisation) for port in ports.u]
    if axes is None:
        do = "; or name the axes that count, axes=[...]"
        refuse_lost(body, realisation, [*seen, *pushed], do)
    wanted = body.axes if axes is None else name_list(axes, "axes")
    require_known("rigid-body axis", wanted, body.axes)
    pick = np.eye(len(body.axes))[[body.axes.index(axis) for axis in wanted]]
    see, push = rigid_parts(seen, body.motions), rigid_parts(pushed, body.motions).T
    # in these units rotations and translations move the structure alike
    length = np.asarray(1.0 / np.linalg.norm(body.motions, axis=0))
    T_y = _left_inverse(see, length, pick)
    T_u = _left_inverse(push.T, 1.0 / length, pick).T
    _check_identity(T_y @ see, pick, wanted, body, length, "sensors", [s.name for s in sensors])
    _check_identity((push @ T_u).T, pick, wanted, body, 1.0 / length, "actuators", list(plant.u))
    mass = pick @ body.mass @ pick.T
    motions, forces, accelerations = (
        [f"cog:{axis}{kind}" for axis in wanted] for kind in ("", ":force", ":acceleration")
    )
    units = plant.units
    for axis in wanted:
        own = _UNITS[axis.startswith("r")]
        units |= {f"cog:{axis}{kind}": unit for kind, unit in own.items()}
    return GravityAxes(
        _gain(T_u, forces, plant.u, plant, units),
        _gain(T_y, [s.name for s in sensors], motions, plant, units),
        _gain(T_u @ mass, accelerations, plant.u, plant, units),
        mass,
        body.centre,
        wanted,
    )


def _left_inverse(matrix: FloatArray, unit: FloatArray, pick: FloatArray) -> FloatArray:
    """Return the rows `pick` of the least-squares left inverse, its columns in these units."""
    return np.asarray(pick @ (unit[:, None] * np.linalg.pinv(matrix * unit, rcond=TYPED)))


def _check_identity(
    product: FloatArray,
    pick: FloatArray,
    wanted: tuple[str, ...],
    body: RigidBody,
    unit: FloatArray,
    side: str,
    names: list[str],
) -> None:
    """Raise AssumptionError unless T (a row per axis) times the geometry is the identity."""
    own = pick @ unit
    wrong = np.abs((product - pick) * unit / own[:, None]) > TYPED
    if np.any(wrong):
        i, j = (int(k) for k in np.argwhere(wrong)[0])
        what = (
            f"do not determine {wanted[i]!r} at all"
            if body.axes[j] == wanted[i]
            else f"mix {wanted[i]!r} with {body.axes[j]!r}"
        )
        raise AssumptionError(
            f"the axis {wanted[i]!r} cannot be decoupled: the {side} "
            f"({', '.join(names) or 'none'}) {what}. Add or move some, or choose fewer "
            f"axes: plant.gravity_axes(plant, axes=...) of {', '.join(body.axes)}."
        )
