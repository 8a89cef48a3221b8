"""decouple: static transformations between the channels of a plant and the axes that u moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, divisor
from ..errors import AssumptionError, counted, some_names
from ..lti.statespace import StateSpace
from ..store import Value
from .axes import DrivenAxes, apart, driven_axes, real_gain
from .partitioned import Partition
from .rest_expansion import followed_at_rest


@dataclass(frozen=True, eq=False, repr=False)
class Decoupling(Value):
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

    @property
    def T_u(self) -> FloatArray:
        """Matrix (nu, r) from commands of the axes to actuators."""
        return self.to_actuators.D

    @property
    def T_y(self) -> FloatArray:
        """Matrix (r, ny) from sensors to motions of the axes."""
        return self.to_motions.D


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
