"""Predicted errors of a machine on the move: the variance of every channel along a trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, Value, flag, instance, positive, real_array, sizes_of
from ..errors import AssumptionError, ModelError, require_known
from ..loop import ClosedLoop, ScheduledLoop
from ..lti.lyapunov import solve_stein
from ..parallel import one_thread
from .moving_machine import MovingMachine, Sample, trajectory


@dataclass(frozen=True, eq=False, repr=False)
class RmsAlong(Value):
    """Standard deviations of a closed loop's channels along a trajectory; made by `rms_along`.

    Parameters
    ----------
    time : (n_time,) array [s]
        The samples.
    rms : (n_channels, n_time) array
        Of each channel, in its unit.
    names : sequence of str
        The channels: z, y, driven u and what blocks show.
    units : mapping {str: str}
        Of the channels.
    """

    time: FloatArray
    rms: FloatArray
    names: tuple[str, ...]
    units: Mapping[str, str]

    def __post_init__(self) -> None:
        names = tuple(self.names)
        time = real_array(self.time, "time", (None,))
        rms = real_array(self.rms, "rms", (len(names), time.size))
        self._set(time=time, rms=rms, names=names, units=dict(self.units))

    def __repr__(self) -> str:
        largest = {
            name: float(self.rms[i].max())
            for i, name in enumerate(self.names)
            if name.endswith(":error")
        }
        shown = sizes_of(largest or {self.names[0]: float(self.rms[0].max())}, self.units)
        return f"<RmsAlong: {self.time.size} samples; largest {shown}>"

    def __getitem__(self, name: str) -> FloatArray:
        """Return the standard deviation (n_time,) of a channel."""
        require_known("channel", [name], self.names)
        return np.asarray(self.rms[self.names.index(name)])


@one_thread()
def rms_along(
    loop: ClosedLoop | ScheduledLoop,
    *,
    moving: Mapping[str, Any],
    duration: float,
    repeats: bool = False,
) -> RmsAlong:
    """Return the standard deviation of every channel of a loop whose machine moves.

    ``P[k + 1] = A[k] P[k] A[k]' + G[k] G[k]'`` of plant and controller together, with the matrices
    of each sample of the moving machine: what the white noises of the plant cause, exactly. The
    controller stays as it was designed, observer included, or follows its schedule.

    Parameters
    ----------
    loop : ClosedLoop or ScheduledLoop
        Around a sampled plant with positions.
    moving : mapping {position: path}
        As for `simulate`: SetPoints, functions of time, or a value for each sample.
    duration : float [s]
        Of the trajectory.
    repeats : bool
        Whether the trajectory repeats for ever: the variance is then the periodic one,
        ``P[0] = P[duration]``. Else the machine has stood at the beginning for a long time.

    Returns
    -------
    RmsAlong

    Raises
    ------
    AssumptionError
        When the loop is not stable: at the beginning, or over the trajectory that repeats.
    LabelError
        When a position is unknown.
    ModelError
        When nothing moves, or a port that moves has dynamics of its own.

    References
    ----------
    [BittantiColaneri2009]_ (periodic Lyapunov equations).

    Examples
    --------
    >>> import flexplant as fx
    >>> machine = fx.testbeds.wafer_stage(damping=0.01)
    >>> plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8),
    ...     density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> places = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    >>> ports = fx.Ports(
    ...     w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(places)],
    ...     u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(places)],
    ...     z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves={"x": (-1, 0, 0)})],
    ...     y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves={"x": (-1, 0, 0)})
    ...        for i, p in enumerate(places)],
    ...     references=[fx.Reference("die")],
    ...     positions=[fx.plant.Position("x", range=(-0.1, 0.1))],
    ... )
    >>> modes = fx.solve_modes(plate, count=12, damping=fx.ModalDamping(0.01))
    >>> plant = fx.assemble_plant(modes, ports).discretized(1e4, delay=1)
    >>> observer = fx.design_kalman(plant)
    >>> loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=40.0,
    ...     observer=observer))
    >>> move = fx.setpoint(0.02, velocity=0.5, acceleration=10.0, jerk=1e3)
    >>> found = fx.simulation.rms_along(loop, moving={"x": move}, duration=0.05)
    >>> found["die:error"].shape
    (500,)
    """
    schedule = loop if isinstance(loop, ScheduledLoop) else None
    loop = loop.standing if isinstance(loop, ScheduledLoop) else loop
    plant = instance(loop, ClosedLoop, "loop", "Pass close_loop(plant, *blocks).").plant
    if not plant.dt or not plant.is_assembled or not plant.assembled.ports.positions:
        raise ModelError(
            "errors along a trajectory need a sampled plant whose ports move: Ports(..., "
            "positions=[fx.plant.Position('x', range=...)]) and plant.discretized(rate)."
        )
    steps = round(positive(duration, "duration") / plant.dt)
    time = np.arange(steps) * float(plant.dt)
    path = trajectory(plant, moving, time)
    machine = MovingMachine(loop, path, noise=True, schedule=schedule)
    P = _periodic(machine, steps) if flag(repeats, "repeats") else _standing(machine)
    rms = np.zeros((len(plant.z) + len(plant.y) + len(loop.controller.outputs), steps))
    closed = ClosedAlong(machine)
    for k, sample in enumerate(machine.each(steps)):
        A, G, C, D = closed(k, sample)
        rms[:, k] = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", C, P, C) + np.sum(D**2, axis=1), 0))
        P = A @ P @ A.T + G @ G.T
    names = (*plant.z, *plant.y, *loop.driven, *loop.watched)
    return RmsAlong(time, rms, names, {n: u for n, u in loop.units.items() if n in names})


class ClosedAlong:
    """The closed loop of one sample: ``X+ = A X + G n``, what is shown ``C X + D n``."""

    def __init__(self, machine: MovingMachine) -> None:
        self.machine = machine
        plant = machine.plant
        self.nw, self.nz = len(plant.w), len(plant.z)

    def __call__(self, k: int, sample: Sample) -> tuple[FloatArray, ...]:
        """Return A, G, C and D of sample k."""
        m, nz = self.machine, self.nz
        law_A, law_B, law_C, law_D = m.law_at(k)
        nu = len(m.loop.driven)
        u, columns = m.u, m.noise.columns
        sized = np.zeros((self.nw, columns.size))
        sized[columns, np.arange(columns.size)] = m.noise.deviation
        W = np.vstack([sized, np.zeros((sample.B.shape[1] - self.nw, columns.size))])
        C2, D2 = sample.C[nz:], m.D[nz:] @ W
        # commands and what is watched, over x, c and the noises of sensors
        seen = law_D @ C2, law_C, law_D @ D2
        B_u, D_u = sample.B[:, u], m.D[:nz][:, u]
        command = [part[:nu] for part in seen]
        A = np.block(
            [
                [sample.A + B_u @ command[0], B_u @ command[1]],
                [law_B @ C2, law_A],
            ]
        )
        r = sample.G.shape[1]
        G = np.block(
            [
                [sample.G, sample.B @ W + B_u @ command[2]],
                [np.zeros((len(law_A), r)), law_B @ D2],
            ]
        )
        C = np.block(
            [
                [sample.C[:nz] + D_u @ command[0], D_u @ command[1]],
                [C2, np.zeros((len(C2), len(law_A)))],
                [seen[0], seen[1]],
            ]
        )
        D = np.vstack([m.D[:nz] @ W + D_u @ command[2], D2, seen[2]])
        return A, G, C, D


def _standing(machine: MovingMachine) -> FloatArray:
    """Return the covariance of the loop that has stood where it is for a long time."""
    A, G, _, _ = ClosedAlong(machine)(0, next(machine.each(1)))
    if np.abs(np.linalg.eigvals(A)).max(initial=0.0) >= 1.0:
        raise AssumptionError(
            "the loop is not stable where the trajectory begins: it has no variance there. Design "
            "it for that position, or pass repeats=True where it only passes by."
        )
    return solve_stein(A, G @ G.T)


def _periodic(machine: MovingMachine, steps: int) -> FloatArray:
    """Return the covariance at the beginning of a trajectory that repeats for ever."""
    Phi = np.eye(machine.plant.system.n_states + machine.loop.controller.n_states)
    P = np.zeros_like(Phi)
    closed = ClosedAlong(machine)
    for k, sample in enumerate(machine.each(steps)):
        A, G, _, _ = closed(k, sample)
        Phi, P = A @ Phi, A @ P @ A.T + G @ G.T
    radius = float(np.abs(np.linalg.eigvals(Phi)).max(initial=0.0))
    if radius >= 1.0:
        raise AssumptionError(
            f"the loop grows {radius:.3g} times in each repetition of the trajectory: it is not "
            "stable along it. Lower its gain, or schedule it."
        )
    return solve_stein(Phi, P)
