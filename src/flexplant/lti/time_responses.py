"""What a system answers over time: to a step, to an impulse, to any signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, known_units, one_of, positive, real_array
from ..errors import ModelError, ShapeError, counted, require_known, with_unit
from ..store import Value
from ..tolerances import SPLIT, TYPED
from .response_solvers import Recursion, continuous_poles
from .sampling import held_exactly
from .statespace import StateSpace, System, as_statespace

#: the slowest pole has decayed to 1 % when a step response ends, or has turned twenty times
_DECAY, _PERIODS = float(np.log(100.0)), 20.0
#: points for each period of the fastest pole: a peak is found to 0.5 % of its period and 0.01 % of
#: its height; a response has between these numbers of points
_FINE, _FEWEST, _MOST = 200.0, 500, 20_000


@dataclass(frozen=True, eq=False, repr=False)
class TimeResponse(Value):
    """Signals at the outputs of a system over time.

    ``response["y1", "u1"]`` is the response (n_time,) at one output to one input. If the system has
    a single input, or all inputs drove it together, ``response["y1"]`` is this response.

    Parameters
    ----------
    time : (n_time,) array [s]
        Instants of the samples.
    data : (n_out, n_in, n_time) array
        Signals in the units of the outputs. `lsim` drives all inputs together: n_in is then 1.
    outputs, inputs : sequences of str
        Names of the outputs and inputs.
    units : mapping {channel: unit}, optional
        Unit of each channel.

    Examples
    --------
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([1.0], [1.0, 1.0])
    >>> answer = fx.lti.step(lag, time=[0.0, 1.0, 2.0])
    >>> answer["out"].round(4)
    array([0.    , 0.6321, 0.8647])
    """

    time: FloatArray
    data: FloatArray
    outputs: Sequence[str]
    inputs: Sequence[str]
    units: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        drive, seen = ", ".join(self.inputs), ", ".join(self.outputs)
        count = counted(self.time.size, "instant")
        return f"<TimeResponse: {seen} to {drive}, {count} until {self.time[-1]:.4g} s>"

    def __getitem__(self, channel: str | tuple[str, str]) -> FloatArray:
        output, given = channel if isinstance(channel, tuple) else (channel, None)
        require_known("output", [output], self.outputs, "the response")
        if given is None and len(self.inputs) > 1:
            raise ModelError(
                f"several inputs drive the response, {', '.join(self.inputs)}: "
                f"ask for one, response[{output!r}, {self.inputs[0]!r}]."
            )
        require_known("input", [given or self.inputs[0]], self.inputs, "the response")
        column = 0 if given is None else list(self.inputs).index(given)
        return np.asarray(self.data[list(self.outputs).index(output), column])


def step(
    sys: System, time: npt.ArrayLike | None = None, *, duration: float | None = None
) -> TimeResponse:
    """Return the responses to a step of one unit at each input, from rest.

    The result is ``y(t) = C int_0^t e^(A s) ds B + D``, which is exact at the instants returned.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy, or a ClosedLoop
        System whose response is computed.
    time : (n_time,) array [s], optional
        Equidistant instants from 0; for a sampled system its sampling instants.
    duration : float [s], optional
        Length of the response if `time` is not given. By default the response ends when the slowest
        pole has decayed to 1 % or made twenty oscillations.

    Returns
    -------
    TimeResponse
        Response whose `data` has the shape (n_out, n_in, n_time).

    Raises
    ------
    ModelError
        When `time` does not begin at 0 or is not equidistant, or when it does not consist of the
        sampling instants of a sampled system.

    Examples
    --------
    >>> import flexplant as fx
    >>> answer = fx.lti.step(fx.lti.tf([2.0], [1.0, 1.0]))
    >>> bool(abs(answer["out"][-1] - 2.0) < 0.03)
    True
    """
    g = as_statespace(sys)
    instants = _instants(g, time, duration)
    drive = np.ones(instants.size)
    data = np.stack(
        [_driven(g, instants, drive[:, None] * row) for row in np.eye(len(g.inputs))], 1
    )
    return _answer(g, instants, data, g.inputs)


def impulse(
    sys: System, time: npt.ArrayLike | None = None, *, duration: float | None = None
) -> TimeResponse:
    """Return the responses to an impulse of area 1 at each input, from rest.

    The result is ``y(t) = C e^(A t) B``. A direct gain D also passes the impulse itself at t = 0;
    the impulse itself is left out. The input of a sampled system is a pulse of the height ``1 /
    dt`` that lasts one sample. Its response includes the effect of D.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy, or a ClosedLoop
        System whose response is computed.
    time : (n_time,) array [s], optional
        As in `step`.
    duration : float [s], optional
        As in `step`.

    Returns
    -------
    TimeResponse
        Response whose `data` has the shape (n_out, n_in, n_time), in [output unit / (input unit
        s)].

    Raises
    ------
    ModelError
        As `step`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.impulse(fx.lti.tf([1.0], [1.0, 1.0]), time=[0.0, 1.0])["out"].round(4)
    array([1.    , 0.3679])
    """
    g = as_statespace(sys)
    instants = _instants(g, time, duration)
    pulse = np.zeros((instants.size, len(g.inputs)))
    columns = []
    for j in range(len(g.inputs)):
        if g.dt:
            pulse[:] = 0.0
            pulse[0, j] = 1.0 / g.dt
            columns.append(_driven(g, instants, pulse))
        else:
            columns.append(_driven(g, instants, pulse, g.B[:, j]))
    return _answer(g, instants, np.stack(columns, 1), g.inputs)


def lsim(
    sys: System,
    u: npt.ArrayLike,
    time: npt.ArrayLike,
    *,
    start: npt.ArrayLike | None = None,
    between: Literal["held", "linear"] = "held",
) -> TimeResponse:
    """Return the response to given signals at all inputs.

    ``dx/dt = A x + B u, y = C x + D u`` is solved without an integration error. `between` says
    whether u is held constant or is linear between two instants.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy, or a ClosedLoop
        System whose response is computed.
    u : (n_in, n_time) or (n_time,) array
        Inputs in their units; a single row for one input.
    time : (n_time,) array [s]
        Equidistant instants from 0.
    start : (n,) array, optional
        States at the first instant; by default 0.
    between : {"held", "linear"}
        Course of u between two instants; for a sampled system u is "held".

    Returns
    -------
    TimeResponse
        Response to this one input signal: `response["y1"]` is (n_time,).

    Raises
    ------
    ModelError, ShapeError
        As `step`, and when sizes do not match.

    Examples
    --------
    >>> import numpy as np
    >>> import flexplant as fx
    >>> time = np.arange(4.0)
    >>> ramp = fx.lti.lsim(fx.lti.tf([1.0], [1.0, 0.0]), time, time, between="linear")
    >>> ramp["out"]
    array([0. , 0.5, 2. , 4.5])
    """
    g = as_statespace(sys)
    one_of(between, "between", ("held", "linear"))
    instants = _instants(g, time, None)
    signal = np.atleast_2d(real_array(u, "u"))
    if signal.shape != (len(g.inputs), instants.size):
        raise ShapeError(
            f"u of {counted(len(g.inputs), 'input')} at {counted(instants.size, 'instant')} must "
            f"have shape ({len(g.inputs)}, {instants.size}), got {signal.shape}."
        )
    first = np.zeros(g.n_states) if start is None else real_array(start, "start", (g.n_states,))
    if between == "linear" and not g.dt:
        # u is a separate state, whose held derivative is the input
        slope = np.diff(signal, append=signal[:, -1:]) / (instants[1] - instants[0])
        data = _driven(_integrated(g), instants, slope.T, np.concatenate([first, signal[:, 0]]))
    else:
        data = _driven(g, instants, signal.T, first)
    return _answer(g, instants, data[:, None], ["u" if len(g.inputs) > 1 else g.inputs[0]])


@dataclass(frozen=True, eq=False, repr=False)
class StepInfo(Value):
    """Figures of one step response; `print` shows them with their units.

    Parameters
    ----------
    steady : float
        The value at rest, from the static gain.
    rise : float [s]
        Rise time from 10 % to 90 % of the value at rest.
    settling : float [s]
        Time until the response stays within 2 % of the value at rest around this value. The
        argument `band` of `step_info` replaces the 2 %.
    overshoot, undershoot : float [%]
        Overshoot beyond the value at rest, and undershoot on the other side of 0.
    peak : float
        Largest absolute value.
    peak_time : float [s]
        Time of the peak.
    unit : str, optional
        Unit of the output.
    """

    steady: float
    rise: float
    settling: float
    overshoot: float
    undershoot: float
    peak: float
    peak_time: float
    unit: str = ""

    def __repr__(self) -> str:
        rows = (
            ("value at rest", with_unit(self.steady, self.unit)),
            ("rise time, 10 to 90 %", with_unit(self.rise, "s")),
            ("settling time", with_unit(self.settling, "s")),
            ("overshoot", f"{self.overshoot:.3g} %"),
            ("undershoot", f"{self.undershoot:.3g} %"),
            ("peak", f"{with_unit(self.peak, self.unit)} at {with_unit(self.peak_time, 's')}"),
        )
        return "\n".join(f"{name:22s} {value}" for name, value in rows)


def step_info(
    sys: System, *, output: str | None = None, input: str | None = None, band: float = 0.02
) -> StepInfo:
    """Return rise time, settling time and overshoot of one step response.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy, or a ClosedLoop
        System whose response is computed.
    output, input : str, optional
        Names of the output and the input; by default the only ones.
    band : float
        Relative tolerance of the settling time: the response has settled when its distance from the
        value at rest stays below this fraction of that value.

    Returns
    -------
    StepInfo

    Raises
    ------
    ModelError
        When the channel is not given, the system is not stable, or its static gain is zero.

    Examples
    --------
    >>> import flexplant as fx
    >>> print(fx.lti.step_info(fx.lti.tf([1.0], [1.0, 0.4, 1.0])))
    value at rest          1
    rise time, 10 to 90 %  1.2 s
    settling time          19.6 s
    overshoot              52.7 %
    undershoot             0 %
    peak                   1.53 at 3.2 s
    """
    g = as_statespace(sys)
    for name, given, known in (("output", output, g.outputs), ("input", input, g.inputs)):
        if given is None and len(known) > 1:
            raise ModelError(f"step_info describes one channel: say {name}=, {', '.join(known)}.")
    g = g.select(None if output is None else [output], None if input is None else [input])
    if not g.is_stable:
        raise ModelError(
            "the system is not stable: its step response never comes to rest. Close a loop first, "
            "or look at fx.lti.step(sys, duration=...)."
        )
    steady = float(np.squeeze(g.dcgain()))
    found = step(g)
    path = found.data[0, 0]
    if abs(steady) <= SPLIT * float(np.max(np.abs(path), initial=0.0)):
        raise ModelError("the static gain is 0: rise and settling time have no value to refer to.")
    way = path / steady
    top = int(np.argmax(np.abs(path)))
    outside = np.flatnonzero(np.abs(way - 1.0) > positive(band, "band"))
    held = bool(g.dt)
    settled = 0.0
    if outside.size:
        side = 1.0 + band * np.sign(way[outside[-1]] - 1.0)
        settled = _crossing(found.time, way, int(outside[-1]), side, held)
    return StepInfo(
        steady=steady,
        rise=_first(found.time, way, 0.9, held) - _first(found.time, way, 0.1, held),
        settling=settled,
        overshoot=100.0 * max(float(way.max()) - 1.0, 0.0),
        undershoot=100.0 * max(0.0, -float(way.min())),
        peak=float(path[top]),
        peak_time=float(found.time[top]),
        unit=g.units.get(g.outputs[0], ""),
    )


def _first(time: FloatArray, way: FloatArray, level: float, held: bool) -> float:
    """Return when a response first reaches a level [s]."""
    reached = int(np.argmax(way >= level))
    return float(time[0]) if reached == 0 else _crossing(time, way, reached - 1, level, held)


def _crossing(time: FloatArray, way: FloatArray, before: int, level: float, held: bool) -> float:
    """Return when a response passes a level after a sample [s]; a sampled one at the next."""
    after = min(before + 1, time.size - 1)
    rise = way[after] - way[before]
    share = 1.0 if held or rise == 0.0 else (level - way[before]) / rise
    return float(time[before] + share * (time[after] - time[before]))


def _answer(
    g: StateSpace, time: FloatArray, data: FloatArray, inputs: Sequence[str]
) -> TimeResponse:
    units = known_units({k: v for k, v in g.units.items() if k in g.outputs}, g.outputs)
    return TimeResponse(time, data, tuple(g.outputs), tuple(inputs), units)


def _integrated(g: StateSpace) -> StateSpace:
    """Return a system whose inputs are the derivatives of those of the given one."""
    n, m = g.B.shape
    A = np.block([[g.A, g.B], [np.zeros((m, n + m))]])
    B = np.vstack([np.zeros((n, m)), np.eye(m)])
    return StateSpace(A, B, np.hstack([g.C, g.D]), np.zeros((len(g.C), m)))


def _driven(
    g: StateSpace, time: FloatArray, u: FloatArray, start: FloatArray | None = None
) -> FloatArray:
    """Return the outputs (n_out, n_time) for inputs (n_time, n_in) held between instants."""
    held = g if g.dt else held_exactly(g, 1.0 / (time[1] - time[0]))
    first = np.zeros(g.n_states) if start is None else start
    return np.asarray(Recursion(held.A, held.B, held.C, held.D).run(u, first)[0].T)


def _instants(g: StateSpace, time: npt.ArrayLike | None, duration: float | None) -> FloatArray:
    """Return equidistant instants from 0 [s]."""
    if time is None:
        end = decay_time(g) if duration is None else positive(duration, "duration")
        h = g.dt or _fine_step(g, end)
        return np.asarray(h * np.arange(int(np.ceil(end / h)) + 1), dtype=np.float64)
    instants = real_array(time, "time", (None,))
    steps = np.diff(instants)
    if not steps.size or instants[0] != 0 or np.ptp(steps) > TYPED * steps.mean():
        raise ModelError(
            "time must begin at 0 and increase in equal steps, of two instants at least."
        )
    if g.dt and abs(steps.mean() - g.dt) > TYPED * g.dt:
        raise ModelError(
            f"the system is sampled every {g.dt:g} s, time steps by {steps.mean():g} s: "
            "pass its own instants."
        )
    return instants


def decay_time(g: StateSpace) -> float:
    """Return the time [s] in which the slowest pole decays, or turns often where it hardly does."""
    poles = continuous_poles(g)
    size = np.abs(poles)
    moving = poles[size > SPLIT * size.max(initial=0.0)]
    if not moving.size:
        return 100.0 * g.dt if g.dt else 1.0
    # an undamped mode is drawn for its periods alone
    with np.errstate(divide="ignore"):
        decay = _DECAY / np.abs(moving.real)
    return float(np.max(np.minimum(decay, 2.0 * np.pi * _PERIODS / np.abs(moving))))


def _fine_step(g: StateSpace, end: float) -> float:
    """Return a time step [s] that shows the fastest pole, within what can be drawn."""
    fastest = float(np.max(np.abs(g.poles()), initial=0.0))
    fine = 2.0 * np.pi / (_FINE * fastest) if fastest else end
    return float(np.clip(fine, end / _MOST, end / _FEWEST))
