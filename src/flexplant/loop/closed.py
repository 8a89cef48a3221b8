"""The closed loop: a plant with its controller, and results in closed form."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, name_list
from ..errors import ModelError, only_one, require_known, warn
from ..lti.frequency import Frf, sampled_freq
from ..lti.interconnection import lft, loop_poles
from ..lti.modal import Obstacle, obstacle
from ..lti.response_solvers import Responder, remembered, responder
from ..lti.statespace import StateSpace, System
from ..plant import AnyPlant, StandardPlant, plant_of, standard_plant
from ..plant.axes import force_units
from ..plant.machine_plants import FigureInterval, fitted_response
from ..plant.uncertainty.uncertain_plants import UncertainPlant
from ..store import Value
from ..tolerances import INTERVAL
from .blocks import as_block, commands, joined, tapped, with_known
from .broken import BrokenLoop, Path, plant_path
from .budget import (
    ErrorBudget,
    Source,
    Spectrum,
    check_direct,
    densities,
    error_budget,
    source_variances,
    sources,
    stationary_row,
    unverified_variances,
)
from .modal_tolerances import MARGIN, ModeTolerances, mode_tolerances, reported_tolerances
from .on_measurement import NOT_MEASURED, OnMeasurement, judged
from .other_machines import (
    MachineLoops,
    SpillOver,
    growing_modes,
    high,
    interval_line,
    loop_interval,
    warn_of_critical,
)


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoop(Value):
    """A plant with its controller, ``u = K y``, with named signals.

    `close_loop` makes it. A plant has inputs w (noises, disturbances, references) and u (commands),
    and outputs z (motions and errors at points of interest) and y (sensors, references).

    Parameters
    ----------
    plant : StandardPlant
        Plant without its controller.
    blocks : sequence of StateSpace
        Connected blocks; `close_loop(other_plant, *loop.blocks)` closes the same controller around
        another machine.
    controller : StateSpace
        All blocks as one system from the outputs y of the plant to the commands of the driven
        actuators, followed by the monitored outputs, such as estimates of an observer.
    idle : sequence of str
        Actuators that no block drives.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> loop.is_stable, loop.driven
    (True, ('u1',))
    >>> f"{1e9 * loop.rms('die:x'):.0f} nm"
    '247 nm'
    """

    plant: AnyPlant
    blocks: tuple[StateSpace, ...]
    controller: StateSpace
    idle: tuple[str, ...] = ()

    def __repr__(self) -> str:
        kind = f"dt {self.plant.dt:g} s" if self.plant.dt else "continuous"
        plant, controller = self.plant.system.n_states, self.controller.n_states
        lines = [f"<ClosedLoop: plant {plant} states, controller {controller} states, {kind}>"]
        if self.obstacle is None:
            lines.append(f"  stable: {self.decay}, modulus margin {self.modulus_margin:.3g}")
        else:
            lines.append(f"  {self.obstacle.reason}; {self.decay}")
        lines.append(f"  driven: {' '.join(self.driven)}")
        if self.watched:
            shown = " ".join(self.watched[:8]) + (" ..." if len(self.watched) > 8 else "")
            lines.append(f"  monitored: {shown}")
        read = {name for block in self.blocks for name in block.inputs}
        if unread := [name for name in self.plant.y if name in self.plant.w and name not in read]:
            lines.append(f"  references that no block reads: {' '.join(unread)}")
        if self.left_out is not None:
            lines.append(f"  with the truncated modes: {self.left_out.summary}")
        elif self.plant.unjudged:
            lines.append(f"  {self.plant.unjudged}")
        measured = self.on_measurement
        lines.append(f"  {NOT_MEASURED if measured is None else measured.summary}")
        if self.obstacle is None and self.plant.dt and (intervals := interval_line(self)):
            lines.append(f"  {intervals}")
        if self.tolerances is not None:
            lines.append(f"  {self.tolerances.summary}")
        return "\n".join(lines)

    @property
    def machine(self) -> StandardPlant:
        """The plant as a StandardPlant. A loop around a generalized plant raises ModelError."""
        return standard_plant(self.plant)

    @property
    def driven(self) -> tuple[str, ...]:
        """The actuators that the controller drives."""
        return tuple(name for name in self.plant.u if name not in self.idle)

    @property
    def watched(self) -> tuple[str, ...]:
        """The outputs of blocks that are not commands of actuators, such as `die:hat`."""
        return tuple(name for name in self.controller.outputs if name not in self.driven)

    @cached_property
    def units(self) -> dict[str, str]:
        """SI units of the channels, estimates included; unknown units are left out."""
        blocks = {name: unit for block in self.blocks for name, unit in block.units.items()}
        return blocks | self.plant.units

    @property
    def fed_back(self) -> tuple[str, ...]:
        """The channels of y that u can move; references are not among them."""
        return self._path.fed_back

    @cached_property
    def _path(self) -> Path:
        """From the driven u to y."""
        return plant_path(self.plant, self.driven)

    @cached_property
    def _command(self) -> StateSpace:
        """From y to the driven u; a plant alone with its sensors has no references."""
        return self.controller.select(outputs=self.driven, inputs=self.plant.y)

    @cached_property
    def _poles(self) -> ComplexArray:
        return loop_poles(self._path.system, self._command)

    def poles(self) -> ComplexArray:
        """Return the closed loop's poles: in rad/s if it is continuous, else in the z-plane."""
        return self._poles.copy()

    @cached_property
    def monitored(self) -> StateSpace:
        """The closed loop from w to z, y, the driven u and the monitored outputs of blocks."""
        opened = tapped(self.plant, self.driven, self.watched, self.units)
        back = opened.outputs[len(opened.outputs) - len(self.plant.y) :]
        loop = lft(opened, self.controller.replace(inputs=back))
        loop.__dict__["_poles"] = self._poles
        return loop

    @cached_property
    def system(self) -> StateSpace:
        """The closed loop from w to z. The plant's states come before the controller's."""
        return self.monitored.select(outputs=self.plant.z)

    def frequency_response(self, freq: npt.ArrayLike) -> Frf:
        """Return the response from w to z, using the structure of plant and controller.

        The response is ``P11 + P12 K (I - P22 K)^-1 P21`` at each frequency. It is faster than that
        of `system`, because the plant is evaluated mode by mode.

        Frequencies `freq` (n_freq,) [Hz] are at most half the rate. ModelError when a frequency is
        out of range, or the loop is singular at a frequency.
        """
        grid = sampled_freq(freq, self.plant.dt)
        data = self._responses(self.plant.w, self.plant.z)(grid)
        return Frf(grid, data, tuple(self.plant.w), tuple(self.plant.z), units=self.units)

    def gain(self, reference: str, error: str) -> Responder:
        """Return a function that computes the response from one channel of w to one of z.

        The argument of this function is an array of frequencies [Hz], which it does not check. It
        returns an array (1, 1, n_freq) and is fast, because all else is computed in advance.
        """
        return self._responses([reference], [error])

    def _responses(self, w: Sequence[str], z: Sequence[str]) -> Responder:
        g, ports = self.plant.system, self.controller.inputs
        plant = responder(g.select([*z, *ports], [*w, *self.driven]))
        p, m = len(z), len(w)

        def found(freq: FloatArray) -> ComplexArray:
            K = np.moveaxis(self._controller_response(freq), 2, 0)
            P = np.moveaxis(plant(freq), 2, 0)
            back = np.eye(K.shape[1]) - K @ P[:, p:, m:]
            try:
                command = np.linalg.solve(back, K @ P[:, p:, :m])
            except np.linalg.LinAlgError as error:
                raise ModelError(
                    "the loop has a pole at one of the frequencies: choose another frequency."
                ) from error
            return np.moveaxis(P[:, :p, :m] + P[:, :p, m:] @ command, 0, 2)

        return found

    @cached_property
    def _controller_response(self) -> Responder:
        """Response from y to the driven actuators; its first grid, of all poles, is stored."""
        return remembered(commands(self.blocks, self.controller.inputs, self.driven))

    @cached_property
    def broken(self) -> BrokenLoop:
        """The broken loop: plant and controller, between u and those y that u can move."""
        read = self.controller.input_index(self.fed_back)
        return BrokenLoop(
            self.driven,
            self.fed_back,
            lambda freq: self._controller_response(freq)[:, read],
            self._path.respond,
            self.poles,
            self.plant.dt,
            units=self.units,
            forces=lambda: force_units(self.plant.machine),
        )

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of the closed loop's eigenvalues. Below 1 the loop is stable.

        A continuous loop raises ModelError: use its `spectral_abscissa`.
        """
        if not self.plant.dt:
            raise ModelError(
                "the spectral radius belongs to sampled loops; this one is continuous: "
                "use spectral_abscissa, or close the loop around plant.discretized(rate)."
            )
        return float(np.max(np.abs(self._poles), initial=0.0))

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of the closed loop's eigenvalues [rad/s]. Below 0 the loop is stable.

        For a sampled loop it is ``log(spectral_radius) / dt``.
        """
        if self.plant.dt:
            with np.errstate(divide="ignore"):
                return float(np.log(self.spectral_radius) / self.plant.dt)
        return float(np.max(self._poles.real, initial=-np.inf))

    @property
    def decay(self) -> str:
        """Text of the decay: the spectral radius, or the abscissa in rad/s."""
        if self.plant.dt:
            return f"spectral radius {self.spectral_radius:.9g}"
        return f"spectral abscissa {self.spectral_abscissa:.6g} rad/s"

    @property
    def is_stable(self) -> bool:
        """Whether all eigenvalues of the closed loop are strictly inside the stability region."""
        return self.spectral_radius < 1.0 if self.plant.dt else self.spectral_abscissa < 0.0

    @cached_property
    def obstacle(self) -> Obstacle | None:
        """The pole that makes the loop unstable or (within rounding) marginally stable, or None."""
        return obstacle(self.monitored)

    @cached_property
    def completed(self) -> ClosedLoop | None:
        """The loop of this controller and the plant with truncated modes; None if not known."""
        whole = self.plant.evaluation_plant
        return None if whole is None else self.around(whole)

    @cached_property
    def left_out(self) -> SpillOver | None:
        """Stability and margin with the truncated modes; None if they are not known."""
        whole = self.completed
        if whole is None:
            return None
        stability = whole.spectral_radius if self.plant.dt else whole.spectral_abscissa
        margin, without, peak = whole.modulus_margin, self.modulus_margin, None
        if whole.is_stable:
            peak = whole.broken.worst("u", bool(whole.broken.mixed("u")))[1]
        found: tuple[tuple[int, ...], tuple[float, ...]] = (), ()
        states = whole.plant.system.states
        if peak is None or high(margin, without):
            found = growing_modes(whole.monitored, states, near=peak)
        at, sampled = float("nan") if peak is None else peak, bool(self.plant.dt)
        return SpillOver(stability, sampled, margin, without, at, len(states), *found)

    @cached_property
    def modulus_margin(self) -> float:
        """Smallest distance of the loop gain, with the loop opened at u, to the critical point.

        ``1 / max_f sigma_max(S_u)`` with ``S_u = (I - K P)^-1``, over a grid refined at the closed
        loop's resonances; 0 for an unstable loop. If actuators have different units, or forces so
        different that the decoupling of the axes is twice as well conditioned in scaled forces,
        axes are scaled as in `LoopReport.scaled_margin`.
        """
        return self.broken.margin()

    @cached_property
    def on_measurement(self) -> OnMeasurement | None:
        """Stability and margin on the response of ``plant.measured(frf)``; None without one."""
        known = self.plant.machine.measurement or fitted_response(self.plant.machine)
        return None if known is None else judged(self, known)

    @cached_property
    def on_machines(self) -> MachineLoops:
        """Loops of this controller around ``plant.machines``; ModelError if these are not known."""
        known = self.plant.machine.machines
        if known is None:
            raise ModelError(
                "other machines are not known. Make the plant from fit.calibrated(measured) with "
                "evaluation=, or use plant.uncertain(machines)."
            )
        return MachineLoops(self, known)

    def interval(
        self,
        figure: str | Callable[[ClosedLoop], float],
        level: float = INTERVAL,
        *,
        unit: str = "",
    ) -> FigureInterval:
        """Return the interval of a number over the machines that the plant may be (`on_machines`).

        Parameters
        ----------
        figure : str or callable
            The number: "modulus margin", "bandwidth" (in Hz, the smallest of all axes with a
            reference), "spectral radius", or a signal for its `rms`. It may also be a function of a
            loop that returns a positive number, such as the MA of the error after a move: ``lambda
            one: simulate(one, reference=move, duration=0.1, noise=False).exposure("die:error",
            start=0.05)[0]``.
        level : float
            Fraction of the machines, between 0 and 1.
        unit : str
            SI unit of the number that a function `figure` returns.

        Returns
        -------
        FigureInterval
            ``(low, high, sentence)``. If the interval does not exist or a machine's loop is
            unstable, low and high are None and the sentence gives the reason.

        Raises
        ------
        ModelError
            When the figure is unknown, or the level is out of range.
        """
        return loop_interval(self, figure, level, unit)

    @cached_property
    def tolerances(self) -> ModeTolerances | None:
        """Tolerances to errors of single modes; None if modes are coupled or the loop is unstable.

        Known truncated modes are included if frequencies are uncertain. Changes go up to 1 %, or to
        2.5 times their uncertainty. `interval` covers simultaneous changes of all modes.
        """
        return reported_tolerances(self)

    def around(self, plant: AnyPlant) -> ClosedLoop:
        """Return the loop of this controller around another plant with the same u, y and rate."""
        return ClosedLoop(with_known(plant, self.blocks), self.blocks, self.controller, self.idle)

    def mode_tolerances(self, *, margin: float = MARGIN, known: Any = None) -> ModeTolerances:
        """Return the tolerance of the loop to errors of frequency and damping of each mode.

        One mode changes at a time. The results are the exact changes at which a pole crosses the
        stability boundary, and at which the modulus margin falls to `margin` (at least, where axes
        are scaled). A loop with a gain above 1 at a mode of 0.1 % damping may tolerate less than
        0.2 %, while the frequencies of unmeasured modes are seldom that accurate.

        Parameters
        ----------
        margin : float
            Required modulus margin, with the loop opened at u.
        known : UncertainPlant, float, (m,) array or {mode: float}, optional
            Relative uncertainty of the frequency of each elastic mode; by default that of the
            plant.

        Raises
        ------
        AssumptionError, ModelError
            When the loop is unstable, damping couples the plant's modes, the plant was not
            assembled from a structure, a sensor measures accelerations, or a number is out of
            range.

        Warns
        -----
        FlexplantWarning
            When the tolerance of a mode is less than twice its uncertainty.
        """
        known = self.plant.uncertainty if known is None else known
        found = mode_tolerances(self.plant, self.broken, margin=margin, known=known)
        found.warn_of_critical()
        return found

    def rms(self, channel: str) -> float:
        """Return the stationary rms of a signal that all white noises together cause.

        It is computed without simulation. For a sampled loop it holds at the sample instants, and
        includes aliasing from above half the rate. The noise of a sensor has the variance ``asd^2
        rate / 2`` per sample. Truncated modes are not included. If they are known,
        `completed.rms(channel)` is the rms with them.

        Parameters
        ----------
        channel : str
            Name of a channel of z or y, a driven u or a monitored output. The rms has its unit.

        Raises
        ------
        AssumptionError, ModelError
            When the loop is not stable, white noise reaches an output directly, the noise of the
            plant is not known, or the variance is infinite.
        CertificateError
            When two Lyapunov equations give different variances.
        """
        variances, _ = source_variances(self.monitored, *self._noises(channel))
        return float(np.sqrt(variances.sum()))

    def drawn_rms(self, channel: str) -> float:
        """Return `rms` without verification, to be used for variations of a verified loop."""
        variances = unverified_variances(self.monitored, *self._noises(channel))
        return float(np.sqrt(variances.sum()))

    def psd(self, channel: str, freq: npt.ArrayLike | None = None) -> Spectrum:
        """Return the one-sided power spectral density that all white noises together cause.

        For a sampled loop it is that of the samples, up to half the rate. Its integral is the
        variance ``rms(channel)^2``, which includes motion above half the rate by aliasing.

        Parameters
        ----------
        channel : as for `rms`
        freq : (n_freq,) array [Hz], optional
            Frequencies up to half the rate, else ModelError. The default ones resolve resonances.
        """
        row, noises = self._noises(channel)
        grid = self.broken.grid if freq is None else sampled_freq(freq, self.plant.dt)
        return Spectrum(grid, densities(self.monitored, row, noises)(grid).sum(axis=0))

    def budget(
        self, channel: str | None = None, *, residue: Any = None, start: float = 0.0
    ) -> ErrorBudget:
        """Return the error budget of a signal: variance and cumulative spectrum of each source.

        Parameters
        ----------
        channel : as for `rms`; by default the only error, such as `die:error`
        residue : Response, mapping {channel: samples} or (n_time,) array, optional
            A run of this loop without noise, ``simulate(loop, reference=move, noise=False, ...)``.
            The error in it is an additional source, whose variance is the mean square.
        start : float [s]
            Samples of the residue before this time are left out.

        Returns
        -------
        ErrorBudget
            The budget; it prints as a table, and `fx.plot.budget` draws it.

        Raises
        ------
        LabelError, AssumptionError, ModelError, CertificateError
            As for `rms`; when the residue does not match, or two ways to the variance differ.
        """
        errors = [name for name in self.plant.z if name.endswith(":error")]
        channel = channel or only_one("error", errors, None, "channel=")
        row, white = self._noises(channel)
        out, whole = float("nan"), self.completed
        if whole is not None:
            out = whole.rms(channel) if whole.is_stable else float("inf")
        found = error_budget(self.monitored, row, white, residue=residue, start=start, left_out=out)
        known = self.plant.machine.machines is not None
        return found.replace(interval=self.interval(channel).sentence) if known else found

    @cached_property
    def _white(self) -> list[Source]:
        """The separate white noises."""
        return sources(self.plant, self.monitored)

    def _noises(self, channel: str) -> tuple[int, list[Source]]:
        """Return the row of a signal and the white noises of a loop that has a stationary state."""
        row = stationary_row(self.plant, self.monitored, self.obstacle, channel)
        if not self.plant.dt:
            check_direct(self._white, row, channel)
        return row, self._white


def close_loop(
    plant: AnyPlant | UncertainPlant[Any] | System, *blocks: Any, idle: Iterable[str] = ()
) -> ClosedLoop:
    """Return the closed loop of a plant with controller blocks, connected by name.

    An input of a block is a measurement (plant.y: sensors, references such as `die:ref`), the
    applied command of an actuator (plant.u), or an output of another block. A block output with the
    name of an actuator drives that actuator. Several outputs with the same name are added. All
    other outputs are monitored. A block may also read the derivatives of a reference
    (`die:ref:velocity`, `die:ref:acceleration`, `die:ref:jerk`, `die:ref:snap`), which `simulate`
    computes from the SetPoint. It may also read forces (`u1:feedforward`), which are given as
    references.

    Parameters
    ----------
    plant : StandardPlant, UncertainPlant, StateSpace or control.StateSpace
        Plant of the loop. The loop is also checked on the plant's evaluation model, see
        `ClosedLoop.left_out`. For an uncertain plant the nominal one is used, and the repr shows
        `ClosedLoop.tolerances`. The channels of a StateSpace have the names of those of an
        assembled plant, see `StandardPlant.from_statespace`.
    *blocks : StateSpace, or values with a `system` such as KalmanEstimator and Controller
        Parts of the controller. Each is sampled at the plant's rate, or is a static gain.
    idle : iterable of str
        Actuators that no block drives. Naming them here prevents an error.

    Returns
    -------
    ClosedLoop
        Closed loop; its repr states stability, spectral radius and modulus margin.

    Warns
    -----
    FlexplantWarning
        When the closed loop is unstable, also if only the truncated modes make it so, or a mode of
        an uncertain plant tolerates less than twice its uncertainty. The loop is returned anyway.
        Marginal poles (a free rigid-body mode) are only named in its repr.

    Raises
    ------
    LabelError
        When the names of a system do not show which channels are w, u, z and y, an input is
        connected to nothing, an actuator is driven by nothing (and not idle), or a name other than
        an actuator's is driven twice.
    ModelError
        When no block is given, a block is not a system or appears twice, sampling times differ, or
        the algebraic loop is ill-posed.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.lti import StateSpace
    >>> from flexplant.plant import StandardPlant
    >>> mass = StateSpace([[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0], [1, 0], [0, 1]],
    ...     np.zeros((3, 2)), inputs=["f", "u"], outputs=["z", "y", "v"])
    >>> plant = StandardPlant.from_statespace(mass, u=["u"], y=["y", "v"])
    >>> pd = StateSpace([], [], [], [[-100.0, -20.0]], inputs=["y", "v"], outputs=["u"])
    >>> loop = close_loop(plant, pd)
    >>> loop.is_stable, round(loop.spectral_abscissa, 6)
    (True, -10.0)
    """
    plant = plant_of(plant)
    systems = tuple(as_block(block, f"block {i}", plant.dt) for i, block in enumerate(blocks, 1))
    if not systems:
        raise ModelError(
            "close_loop needs at least one block that drives an actuator: pass a StateSpace, "
            "a Controller, or an observer and a servo."
        )
    resting = name_list(idle, "idle actuators")
    require_known("actuator to leave idle", resting, plant.u)
    plant, controller = joined(plant, systems, resting)
    loop = ClosedLoop(plant, systems, controller, resting)
    found = loop.left_out
    if not loop.is_stable and loop.obstacle and loop.obstacle.reason.startswith("unstable"):
        warn(
            f"the closed loop is {loop.obstacle.reason} ({loop.decay}): its signals grow, so "
            "that margin, bandwidth and norms do not exist. Check the sign (u = K y), lower the "
            "bandwidth, or notch the mode at that frequency."
        )
    elif loop.is_stable and found is not None and not found.is_stable:
        warn(
            "the loop is stable on its plant, but with the truncated modes it is "
            f"{found.summary}. The machine has these modes: lower the bandwidth, keep them in "
            "the plant, or let the controller roll off (or notch) below them."
        )
    measured = loop.on_measurement
    if loop.is_stable and measured is not None and measured.is_unstable:
        warn(
            "the loop is stable on its plant but unstable on the measured response of the machine: "
            "the model's shapes, gains or delay are wrong there. Compare both: "
            "plant.frequency_response(frf.freq) with the measured one."
        )
    warn_of_critical(loop)
    return loop
