"""close_loop: a plant and its controller blocks, connected by name."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import FlexplantWarning, ModelError, unknown_label
from ..lti.frequency import Frf, sampled_freq
from ..lti.interconnection import lft
from ..lti.responses import Responder, remembered, responder
from ..lti.stability import Obstacle, obstacle
from ..lti.statespace import StateSpace, System
from ..plant import StandardPlant, larger_plant, standard_plant
from ..values import ComplexArray, FloatArray, Value, name_list
from .blocks import as_block, check_inputs, drives, joined
from .broken import BrokenLoop, moved
from .spill_over import SpillOver, growing_modes, high


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoop(Value):
    """A plant with its controller: ``u = K y``, everything known by name.

    Made by `close_loop`.

    Parameters
    ----------
    plant : StandardPlant
        The plant, open.
    blocks : sequence of StateSpace
        What was connected; `close_loop(other_plant, *loop.blocks)` closes the same controller
        around another machine.
    controller : StateSpace
        All blocks as one system: plant.y -> the driven actuators, then the other outputs of the
        blocks (an observer's estimates, say), which are monitored.
    idle : sequence of str
        Actuators that nothing drives.
    larger : StandardPlant, optional
        The plant with the modes that it left out, where they are known; `left_out` is how the same
        controller stands there.
    """

    plant: StandardPlant
    blocks: tuple[StateSpace, ...]
    controller: StateSpace
    idle: tuple[str, ...] = ()
    larger: StandardPlant | None = None

    def __repr__(self) -> str:
        kind = f"dt {self.plant.dt:g} s" if self.plant.dt else "continuous"
        plant, controller = self.plant.system.n_states, self.controller.n_states
        lines = [f"<ClosedLoop: plant {plant} states, controller {controller} states, {kind}>"]
        if self.obstacle is None:
            lines.append(f"  stable: {self._decay}, modulus margin {self.modulus_margin:.3g}")
        else:
            lines.append(f"  {self.obstacle.reason}; {self._decay}")
        lines.append(f"  driven: {' '.join(self.driven)}")
        if self.watched:
            shown = " ".join(self.watched[:8]) + (" ..." if len(self.watched) > 8 else "")
            lines.append(f"  monitored: {shown}")
        if self.left_out is not None:
            lines.append(f"  with the modes left out: {self.left_out.summary}")
        return "\n".join(lines)

    @property
    def driven(self) -> tuple[str, ...]:
        """The actuators that the controller drives."""
        return tuple(name for name in self.plant.u if name not in self.idle)

    @property
    def watched(self) -> tuple[str, ...]:
        """The outputs of blocks that drive no actuator, such as `die:hat`."""
        return tuple(name for name in self.controller.outputs if name not in self.driven)

    @cached_property
    def units(self) -> dict[str, str]:
        """The SI units of the channels that have a known one, estimates included."""
        blocks = {name: unit for block in self.blocks for name, unit in block.units.items()}
        return blocks | self.plant.units

    @cached_property
    def fed_back(self) -> tuple[str, ...]:
        """The channels of y that u can move; references are not among them."""
        return moved(self.plant, self.driven)

    @cached_property
    def monitored(self) -> StateSpace:
        """The closed loop from w to z, y, the driven u and the monitored outputs of blocks."""
        g, watched = self.plant.system, self.watched
        shown = [*self.plant.z, *self.plant.y, *self.driven, *watched]
        rows = g.output_index([*self.plant.z, *self.plant.y])
        tapped = [*self.driven, *watched]  # inputs of the tapped plant, and outputs unchanged
        columns = g.input_index([*self.plant.w, *self.driven])
        extra = np.zeros((g.n_states, len(watched)))
        fed = g.output_index(self.plant.y)
        D = np.zeros((len(shown) + fed.size, columns.size + len(watched)))
        D[: rows.size, : columns.size] = g.D[np.ix_(rows, columns)]
        D[rows.size : len(shown), len(self.plant.w) :] = np.eye(len(tapped))
        D[len(shown) :, : columns.size] = g.D[np.ix_(fed, columns)]
        C = np.vstack([g.C[rows], np.zeros((len(tapped), g.n_states)), g.C[fed]])
        ear = [f"{name}|loop" for name in self.plant.y]
        opened = StateSpace(
            g.A,
            np.hstack([g.B[:, columns], extra]),
            C,
            D,
            g.dt,
            inputs=[*self.plant.w, *tapped],
            outputs=[*shown, *ear],
            states=g.states,
            name=g.name,
            units=self.units,
        )
        return lft(opened, self.controller.replace(inputs=ear))

    @cached_property
    def system(self) -> StateSpace:
        """The closed loop from w to z; states of the plant, then of the controller."""
        return self.monitored.select(outputs=self.plant.z)

    def frequency_response(self, freq: npt.ArrayLike) -> Frf:
        """Return the response from w to z, plant and controller each by their own structure.

        ``P11 + P12 K (I - P22 K)^-1 P21`` at each frequency: a plant in modal blocks costs O(n),
        where the closed loop as one system has lost its blocks.

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Not above half the rate.

        Returns
        -------
        Frf
            Of all z and w.

        Raises
        ------
        ModelError
            When a frequency is not allowed, or the loop is singular at one.
        """
        grid = sampled_freq(freq, self.plant.dt)
        data = self._responses(self.plant.w, self.plant.z)(grid)
        return Frf(grid, data, tuple(self.plant.w), tuple(self.plant.z), units=self.units)

    def gain(self, reference: str, error: str) -> Responder:
        """Return the function of frequency [Hz] that gives the response from a w to a z.

        Prepared once for many calls: the frequencies are not checked, (1, 1, n_freq) comes back.

        Parameters
        ----------
        reference : str
            A channel of w.
        error : str
            A channel of z.
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
                    "the loop has a pole at one of the frequencies: move it."
                ) from error
            return np.moveaxis(P[:, :p, :m] + P[:, :p, m:] @ command, 0, 2)

        return found

    @cached_property
    def _controller_response(self) -> Responder:
        """From y to the driven actuators; the first grid, that of all poles, is needed again."""
        return remembered(responder(self.controller.select(outputs=self.driven)))

    @cached_property
    def broken(self) -> BrokenLoop:
        """Plant and controller between u and the y that u moves."""
        read = self.controller.input_index(self.fed_back)
        return BrokenLoop(
            self.driven,
            self.fed_back,
            lambda freq: self._controller_response(freq)[:, read],
            responder(self.plant.system.select(self.fed_back, self.driven)),
            self.monitored.poles,
            self.plant.dt,
        )

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of the closed loop's eigenvalues; stable below 1.

        Raises
        ------
        ModelError
            In continuous time, where the `spectral_abscissa` decides.
        """
        if not self.plant.dt:
            raise ModelError(
                "the spectral radius belongs to sampled loops; this one is continuous: "
                "use spectral_abscissa, or close the loop around plant.discretized(rate)."
            )
        return float(np.max(np.abs(self.monitored.poles()), initial=0.0))

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of the closed loop's eigenvalues [rad/s]; stable below 0.

        For a sampled loop the decay rate ``log(spectral_radius) / dt``.
        """
        if self.plant.dt:
            with np.errstate(divide="ignore"):
                return float(np.log(self.spectral_radius) / self.plant.dt)
        return float(np.max(self.monitored.poles().real, initial=-np.inf))

    @property
    def _decay(self) -> str:
        if self.plant.dt:
            return f"spectral radius {self.spectral_radius:.9g}"
        return f"spectral abscissa {self.spectral_abscissa:.6g} rad/s"

    @property
    def is_stable(self) -> bool:
        """Whether all eigenvalues of the closed loop are strictly inside the stability region."""
        return self.monitored.is_stable

    @cached_property
    def obstacle(self) -> Obstacle | None:
        """The pole that makes the loop unstable or marginal (to within rounding), or None."""
        return obstacle(self.monitored)

    @cached_property
    def left_out(self) -> SpillOver | None:
        """Stability and margin with the modes left out; None: not known."""
        if self.larger is None:
            return None
        whole = ClosedLoop(self.larger, self.blocks, self.controller, self.idle)
        stability = whole.spectral_radius if self.plant.dt else whole.spectral_abscissa
        margin, without, peak = whole.modulus_margin, self.modulus_margin, float("nan")
        modes: tuple[int, ...] = ()
        freq: tuple[float, ...] = ()
        states = self.larger.system.states
        if not whole.is_stable:
            modes, freq = growing_modes(whole.monitored, states)
        else:
            peak = whole.broken.worst[1]
            if high(margin, without):
                modes, freq = growing_modes(whole.monitored, states, near=peak)
        return SpillOver(
            stability, bool(self.plant.dt), margin, without, peak, len(states), modes, freq
        )

    @cached_property
    def modulus_margin(self) -> float:
        """Smallest distance of the loop gain to the critical point, broken at u.

        ``1 / max_f sigma_max(S_u)`` with ``S_u = (I - K P)^-1``, over a grid refined at the closed
        loop's resonances. An unstable loop has none: 0.
        """
        return self.broken.modulus_margin


def close_loop(
    plant: StandardPlant | System, *blocks: Any, idle: Iterable[str] = (), larger: Any = None
) -> ClosedLoop:
    """Return the closed loop of a plant with controller blocks, connected by name.

    An input of a block is a measurement (plant.y: sensors, references such as `die:ref`), the
    applied command of an actuator (plant.u), or an output of another block. An output of a block
    that has an actuator's name drives it, and several such outputs add; every other output is
    monitored.

    Parameters
    ----------
    plant : StandardPlant, StateSpace or control.StateSpace
        The plant; a system whose channels are named like those of an assembled plant (see
        `StandardPlant.from_statespace`) is one.
    *blocks : StateSpace, or values with a `system` such as KalmanEstimator and Controller
        The controller in any number of parts. Sampled at the plant's rate, or static gains.
    idle : iterable of str
        Actuators that stay without a drive on purpose.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`. The loop is then
        checked there too (`ClosedLoop.left_out`); unless given, with those that the plant's reduced
        model still has.

    Returns
    -------
    ClosedLoop
        Its repr says whether it is stable, with spectral radius and modulus margin.

    Warns
    -----
    FlexplantWarning
        When the closed loop is unstable, or is with the modes that the plant left out; it is
        returned all the same, for inspection. Marginal poles (a rigid-body mode that nothing
        holds) are named by its repr alone.

    Raises
    ------
    LabelError
        When the names of a system do not show which channels are w, u, z and y, an input is
        connected to nothing, an actuator is driven by nothing (and not idle), or
        a name other than an actuator's is driven twice.
    ModelError
        When there is no block, a block is no system, sampling times differ, or the algebraic loop
        is ill-posed, or `larger` does not go with the plant.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.plant import StandardPlant
    >>> mass = StateSpace([[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0], [1, 0], [0, 1]],
    ...     np.zeros((3, 2)), inputs=["f", "u"], outputs=["z", "y", "v"])
    >>> plant = StandardPlant.from_statespace(mass, u=["u"], y=["y", "v"])
    >>> pd = StateSpace([], [], [], [[-100.0, -20.0]], inputs=["y", "v"], outputs=["u"])
    >>> loop = close_loop(plant, pd)
    >>> loop.is_stable, round(loop.spectral_abscissa, 6)
    (True, -10.0)
    """
    plant = standard_plant(plant)
    systems = tuple(as_block(block, i, plant.dt) for i, block in enumerate(blocks, 1))
    if not systems:
        raise ModelError(
            "close_loop needs at least one block that drives an actuator: pass a StateSpace, "
            "a Controller, or an observer and a servo."
        )
    resting = name_list(idle, "idle actuators")
    for name in resting:
        if name not in plant.u:
            raise unknown_label("actuator to leave idle", name, plant.u)
    driven, watched = drives(plant, systems, resting)
    check_inputs(plant, systems)
    controller = joined(plant, systems, driven, watched)
    loop = ClosedLoop(plant, systems, controller, resting, _completed(plant, larger))
    found = loop.left_out
    if not loop.is_stable:
        if loop.obstacle and loop.obstacle.reason.startswith("unstable"):
            warnings.warn(
                f"the closed loop is {loop.obstacle.reason} ({loop._decay}): its signals grow, and "
                "it has no margin, bandwidth or norm. Check the sign (u = K y), lower the "
                "bandwidth, or notch the mode at that frequency.",
                FlexplantWarning,
                stacklevel=2,
            )
    elif found is not None and not found.is_stable:
        warnings.warn(
            f"the loop is stable on its plant, but with the modes left out it is {found.summary}. "
            "The machine has these modes: lower the bandwidth, keep them in the plant, or let the "
            "controller roll off (or notch) before them.",
            FlexplantWarning,
            stacklevel=2,
        )
    return loop


def _completed(plant: StandardPlant, larger: Any) -> StandardPlant | None:
    """Return the plant with the modes left out, None where they are not known.

    Raises
    ------
    ModelError
        When the plant is seen through a block, which the larger one is not.
    """
    if not plant.is_weighted:
        return larger_plant(plant, larger)
    if larger is not None:
        raise ModelError(
            "the plant is weighted, or seen through a block, and the larger one is not: close the "
            "loop on plant.unweighted (with that block first) to check it with the modes left out."
        )
    return None
