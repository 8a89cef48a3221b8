"""The static transformations between the channels of a plant and its centre of gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..errors import AssumptionError, counted, require_known
from ..lti.statespace import StateSpace
from ..store import Value
from ..tolerances import TYPED
from ..words import name_list
from .partitioned import Partition
from .rigid_body import RigidBody, refuse_lost, rigid_body_of, rigid_parts

#: units of displacements and rotations at the centre of gravity, by what a channel carries
_UNITS = (
    {"": "m", "acceleration": "m/s^2", "force": "N"},
    {"": "rad", "acceleration": "rad/s^2", "force": "N m"},
)


@dataclass(frozen=True, eq=False, repr=False)
class GravityAxes(Value):
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

    @property
    def T_u(self) -> FloatArray:
        """Matrix (nu, r) from forces at the centre of gravity to actuators."""
        return self.to_actuators.D

    @property
    def T_y(self) -> FloatArray:
        """Matrix (r, ny) from sensors to motions of the centre of gravity."""
        return self.to_motions.D


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
    forces = [f"cog:{axis}:force" for axis in wanted]
    pushes = [f"cog:{axis}:acceleration" for axis in wanted]
    return GravityAxes(
        _gain_system(T_u, forces, plant.u, plant),
        _gain_system(T_y, [s.name for s in sensors], [f"cog:{axis}" for axis in wanted], plant),
        _gain_system(T_u @ mass, pushes, plant.u, plant),
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


def _gain_system(
    gain: FloatArray, inputs: Sequence[str], outputs: Sequence[str], plant: Partition
) -> StateSpace:
    units = plant.units
    for channel in (*inputs, *outputs):
        if channel.startswith("cog:"):
            _, axis, *kind = channel.split(":")
            units[channel] = _UNITS[axis.startswith("r")][kind[0] if kind else ""]
    return StateSpace(
        [], [], [], gain, plant.dt, inputs=inputs, outputs=outputs, name="decoupling", units=units
    )  # fmt: skip
