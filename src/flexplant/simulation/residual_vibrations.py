"""The vibration that a move leaves: predicted by the modes of the loop, and simulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, instance, positive
from ..errors import ModelError, require_known, with_unit
from ..loop import ClosedLoop
from ..plant.partitioned import NOT_JUDGED
from ..store import Value
from ..tolerances import NEGLIGIBLE, SAME
from .motion import SetPointProfile
from .sampled_runs import known_inputs, named_references, simulate


@dataclass(frozen=True, eq=False, repr=False)
class ResidualVibration(Value):
    """Remaining vibration of a signal after the end of a move: the result of `residual_vibration`.

    Parameters
    ----------
    channel : str
        Name of the channel.
    freq, damping : (k,) arrays [Hz, 1]
        Frequencies and damping ratios of the modes of the closed loop, the largest amplitude first.
    amplitude : (k,) array
        Amplitude of each mode at the end of the move, in the unit of the channel.
    predicted : float
        Largest magnitude after the end of the move, computed from the sum of the modes.
    simulated : float
        Largest magnitude after the end of the move, in a simulation.
    decaying : float
        Largest magnitude, after the end of the move, of the component that decays without
        oscillation.
    rest : float
        Final value of the channel. All magnitudes are deviations from it.
    unit : str
        Unit of the channel.
    judged : bool
        Whether the vibration was computed on the evaluation model.
    """

    channel: str
    freq: FloatArray
    damping: FloatArray
    amplitude: FloatArray
    predicted: float
    simulated: float
    decaying: float
    rest: float
    unit: str
    judged: bool

    def __repr__(self) -> str:
        shown = zip(self.freq[:3], self.amplitude[:3], strict=True)
        modes = ", ".join(f"{with_unit(a, self.unit)} at {f:.4g} Hz" for f, a in shown)
        sizes = [with_unit(size, self.unit) for size in (self.predicted, self.simulated)]
        lines = [
            f"<ResidualVibration of {self.channel}: {sizes[0]} predicted, {sizes[1]} simulated",
            f"  vibrates by {modes}" if modes else "  no mode vibrates",
            f"  decays without vibration: {with_unit(self.decaying, self.unit)}",
        ]
        if not self.judged:
            lines.append(f"  {NOT_JUDGED}")
        return "\n".join(lines) + ">"


def residual_vibration(
    loop: ClosedLoop,
    move: SetPointProfile,
    *,
    reference: str | None = None,
    channel: str | None = None,
    wait: float | None = None,
) -> ResidualVibration:
    """Return the remaining vibration after a set-point, on the evaluation model if there is one.

    The remaining vibration is computed by two independent methods. For ``predicted``, the state at
    the end of the move is split into the modes of the closed loop. The reference is constant from
    then on, and each mode decays freely. ``simulated`` is the largest magnitude in a run without
    noise.

    Parameters
    ----------
    loop : ClosedLoop
        Stable closed loop around a sampled plant.
    move : SetPointProfile
        Move, made by `setpoint`, `quiet_setpoint` or ``shaper.shaped(move)``.
    reference : str, optional
        Reference that follows the move; needed if there are several.
    channel : str, optional
        Channel of z whose vibration is computed; by default the error of the reference.
    wait : float [s], optional
        Length of the time after the end of the move that is evaluated. By default it is ten periods
        of the slowest oscillating mode, but at most the duration of the move and at least a hundred
        samples.

    Returns
    -------
    ResidualVibration

    Raises
    ------
    ModelError
        When the loop is not a stable sampled ClosedLoop, or the move is not a SetPointProfile.
    LabelError
        When the reference or the channel is unknown or must be named.

    References
    ----------
    [Singer1990]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=20.0))
    >>> move = fx.setpoint(1e-3, velocity=0.05, acceleration=2.0, jerk=200.0)
    >>> left = fx.simulation.residual_vibration(loop, move)
    >>> abs(left.predicted / left.simulated - 1.0) < 1e-3
    True
    """
    instance(loop, ClosedLoop, "loop", "Make it by close_loop(plant, ...).")
    instance(move, SetPointProfile, "move", "Make it by setpoint(...).")
    own_plant = loop.machine.evaluation_plant
    own = loop if own_plant is None else loop.around(own_plant)
    if not own.plant.dt or not own.is_stable:
        where = "" if own_plant is None else " with the truncated modes"
        raise ModelError(
            f"need a stable loop around a sampled plant, this one is "
            f"{'continuous' if not own.plant.dt else 'not stable' + where}. Use "
            "plant.discretized(rate), or see loop.left_out."
        )
    machine = own.machine
    given = move if reference is None else {reference: move}
    (name,) = named_references(machine, given)
    seen = f"{name.removesuffix(':ref')}:error" if channel is None else channel
    require_known("channel of z", [seen], machine.z)
    modes = _Modes(own, seen)
    last = int(np.ceil(move.duration / machine.dt - 1e-9))
    seconds = modes.shown(move.duration) if wait is None else positive(wait, "wait")
    after = max(int(seconds / machine.dt), 1)
    time: FloatArray = np.arange(last + 1 + after, dtype=np.float64) * machine.dt
    inputs = known_inputs(machine, named_references(machine, given), None, time, 0)[0]
    amounts, rest = modes.left(inputs[: last + 1], inputs[-1])
    steps = np.exp(np.outer(np.arange(after), modes.logs))
    predicted = np.abs((steps @ amounts).real).max()
    run = simulate(own, reference=given, duration=(time.size + 0.25) * machine.dt, noise=False)
    simulated = np.abs(run[seen][last + 1 : last + 1 + after] - rest).max()
    turning = modes.logs.imag > SAME * np.abs(modes.logs)
    real = np.abs(modes.logs.imag) <= SAME * np.abs(modes.logs)
    decaying = np.abs((steps[:, real] @ amounts[real]).real).max()
    size = 2.0 * np.abs(amounts[turning])
    order = np.argsort(-size)
    poles = modes.logs[turning][order] / machine.dt
    return ResidualVibration(
        seen, np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles), size[order],
        float(predicted), float(simulated), float(decaying), rest, own.units.get(seen, ""),
        own_plant is not None,
    )  # fmt: skip


class _Modes:
    """The modes of a closed loop, w to one channel, that last longer than its delays."""

    def __init__(self, loop: ClosedLoop, channel: str) -> None:
        self.system = loop.system.select([channel], loop.machine.w)
        # delays are chains of states whose poles, zero to some root of rounding, have no basis of
        # eigenvectors: these and poles that a sample takes away are split off as a whole
        lasting: Any = lambda pole: abs(pole) > NEGLIGIBLE  # noqa: E731  # SciPy's stubs want reals
        T, Z, k = la.schur(self.system.A, output="complex", sort=lasting)
        coupled = la.solve_sylvester(T[:k, :k], -T[k:, k:], T[:k, k:])
        self.values, vectors = np.linalg.eig(T[:k, :k])
        self.right = Z[:, :k] @ vectors
        self.rows = np.linalg.solve(vectors, np.hstack([np.eye(k), coupled]) @ Z.conj().T)
        self.logs = np.log(self.values)

    def shown(self, duration: float) -> float:
        """Return the time [s] of ten periods of the slowest vibration, within bounds."""
        dt = self.system.dt
        turning = np.abs(self.logs.imag[np.abs(self.logs.imag) > SAME * np.abs(self.logs)])
        slowest = 20.0 * np.pi / float(turning.min()) if turning.size else 0.0
        return dt * max(min(slowest, duration / dt), 100.0)

    def left(self, inputs: FloatArray, final: FloatArray) -> tuple[Any, float]:
        """Return what each mode adds to the channel in the sample after inputs, and the rest."""
        g = self.system
        powers = np.exp(np.outer(np.arange(len(inputs))[::-1], self.logs))
        state = np.sum(powers * (inputs @ (self.rows @ g.B).T), axis=0)
        constant = self.rows @ g.B @ final / (1.0 - self.values)
        amounts = (g.C @ self.right)[0] * (state - constant)
        rest = g.C @ np.linalg.solve(np.eye(g.n_states) - g.A, g.B @ final) + g.D @ final
        return amounts, float(rest[0])
