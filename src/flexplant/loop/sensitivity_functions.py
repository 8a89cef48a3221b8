"""Sensitivities S, T, KS of a loop, for a model or a measured frequency response as plant."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray
from ..errors import (
    AssumptionError,
    ModelError,
    ShapeError,
    counted,
    require_known,
    short,
    unknown_label,
    warn,
)
from ..lti.frequency import Frf, sampled_freq
from ..lti.interconnection import loop_poles
from ..lti.response_solvers import remembered, responder
from ..lti.statespace import StateSpace, as_statespace
from ..plant import AnyPlant, SensorPort
from ..tolerances import SAME
from .broken import BrokenLoop, first_crossing, inverted, movable_outputs
from .closed import ClosedLoop
from .measured_loop import broken_count, measured_between

#: types of loops: a closed loop; a plant (StandardPlant, StateSpace or measured Frf) and a
#: controller; a loop gain
Loop: TypeAlias = "ClosedLoop | tuple[Any, Any] | StateSpace | Frf"


def loop_gain(loop: Loop, *, freq: npt.ArrayLike | None = None, at: Literal["u", "y"] = "u") -> Frf:
    """Return the loop gain L = K P (broken at u) or P K (broken at y).

    The feedback is ``u = K y``, so that the critical point is +1.

    Parameters
    ----------
    loop : ClosedLoop, (plant, controller), or StateSpace or Frf
        In ``(plant, controller)``, the plant is a StandardPlant, a StateSpace (also of
        python-control) or a measured Frf that includes the delay of the loop. The controller is a
        system from y to u that contains the sign of the feedback, or a ClosedLoop, whose controller
        is used. A single system or Frf G is a loop gain for negative feedback; the result is then
        ``L = -G``, and ``S = (I + G)^-1``.
    freq : (n_freq,) array, optional [Hz]
        Frequencies. By default, a grid refined at resonances; for a measured plant, its frequencies
        above 0 Hz. Frequency 0 is left out because free bodies and integrators respond infinitely
        there.
    at : {"u", "y"}
        Where the loop is broken.

    Returns
    -------
    Frf
        Loop gain from the channels of u (or y, see `at`) back to the same channels.

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop, freq = fx.close_loop(plant, observer, servo), [10.0]
    >>> L, S = fx.loop.loop_gain(loop, freq=freq), fx.loop.sensitivity(loop, freq=freq)
    >>> bool(abs(S.data - 1 / (1 - L.data)).max() < 1e-9)
    True
    """
    parts, grid = _loop_and_grid(loop, freq)
    return _loop_frf(grid, parts.gain(grid, at), parts, at, at)


def sensitivity(
    loop: Loop, *, freq: npt.ArrayLike | None = None, at: Literal["u", "y"] = "u"
) -> Frf:
    """Return the sensitivity S = (I - L)^-1 to a disturbance at u or y.

    L has the critical point +1, as in `loop_gain`. If a single loop gain G for negative feedback is
    given, as in the example, then L = -G and S = (I + G)^-1.

    Parameters
    ----------
    loop, freq, at : as for `loop_gain`

    Raises
    ------
    LabelError, ModelError, ShapeError
        As `loop_gain`.

    References
    ----------
    [Skogestad2005]_, section 3.2.

    Examples
    --------
    >>> import flexplant as fx
    >>> L = fx.lti.tf([60.0], [1.0, 0.0])  # an integrator that crosses 1 at 60 rad/s
    >>> S = fx.loop.sensitivity(L, freq=[0.01, 900.0])
    >>> abs(S.data[0, 0]).round(3)  # small at low frequency, one at high
    array([0.001, 1.   ])
    """
    parts, grid = _loop_and_grid(loop, freq)
    return _loop_frf(grid, inverted(parts.gain(grid, at)), parts, at, at)


def complementary_sensitivity(
    loop: Loop, *, freq: npt.ArrayLike | None = None, at: Literal["u", "y"] = "u"
) -> Frf:
    """Return the complementary sensitivity T = I - S = -L (I - L)^-1.

    The loop gain L has the sign of `loop_gain`, with the critical point +1.

    Parameters
    ----------
    loop, freq, at : as for `loop_gain`

    Raises
    ------
    LabelError, ModelError, ShapeError
        As `loop_gain`.

    References
    ----------
    [Skogestad2005]_, section 3.2.

    Examples
    --------
    >>> import flexplant as fx
    >>> L = fx.lti.tf([60.0], [1.0, 0.0])  # an integrator that crosses 1 at 60 rad/s
    >>> abs(fx.loop.complementary_sensitivity(L, freq=[0.01]).data[0, 0]).round(3)
    array([1.])
    """
    parts, grid = _loop_and_grid(loop, freq)
    L = parts.gain(grid, at)
    return _loop_frf(grid, -L @ inverted(L), parts, at, at)


def control_sensitivity(loop: Loop, *, freq: npt.ArrayLike | None = None) -> Frf:
    """Return the control sensitivity K S, the response from noise on y to the commands u.

    Parameters
    ----------
    loop, freq : as for `loop_gain`

    Returns
    -------
    Frf
        Response from y to u: ``(I - K P)^-1 K``, with plant P and controller K.

    Raises
    ------
    LabelError, ModelError, ShapeError
        As `loop_gain`.

    References
    ----------
    [Skogestad2005]_, section 3.2.

    Examples
    --------
    >>> import flexplant as fx
    >>> mass = fx.StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u1"], outputs=["y1"])
    >>> law = fx.StateSpace([], [], [], [[-9.0]], inputs=["y1"], outputs=["u1"])
    >>> KS = fx.loop.control_sensitivity((mass, law), freq=[10.0])
    >>> KS.outputs, KS.inputs
    (('u1',), ('y1',))
    """
    parts, grid = _loop_and_grid(loop, freq)
    K, P = parts.respond(grid)
    return _loop_frf(grid, inverted(K @ P) @ K, parts, "u", "y")


def taken_apart(loop: Loop) -> BrokenLoop:
    """Return plant and controller between u and y."""
    if isinstance(loop, ClosedLoop):
        return loop.broken
    if not isinstance(loop, tuple):
        loop = _fed_back(loop)
    if len(loop) != 2:
        raise ModelError(f"need a tuple (plant, controller), got {short(loop)}.")
    plant: Any = loop[0]
    controller = _law_system(loop[1])
    if hasattr(plant, "frdata"):  # python-control's
        plant = Frf.from_control(plant)
    if isinstance(plant, Frf):
        return measured_between(plant, controller, _quantities(loop[1]))
    if isinstance(plant, AnyPlant):
        require_known("y for the controller", controller.inputs, plant.y, "the plant")
        driven = [name for name in controller.outputs if name in plant.u]
        fed = movable_outputs(plant.system.select(plant.y, driven))
        read = [name for name in controller.inputs if name in fed]
        plant, controller = plant.system.select(read, driven), controller.select(driven, read)
    elif not isinstance(plant, StateSpace):
        plant = StateSpace.from_control(plant)
    driven = [name for name in controller.outputs if name in plant.inputs]
    if not driven:
        raise unknown_label("actuator", controller.outputs[0], plant.inputs, "the plant")
    controller = controller.select(driven)
    plant = plant.select(controller.inputs, driven)
    # the peaks of S lie at the poles of the closed loop, not at those of its parts
    return _modelled(plant, controller, cache(lambda: loop_poles(plant, controller)))


def _fed_back(gain: Any) -> tuple[Any, StateSpace]:
    """Return a loop gain as a plant, and the negative unity feedback that closes it."""
    if hasattr(gain, "frdata"):  # python-control's
        gain = Frf.from_control(gain)
    elif hasattr(gain, "system") or not (isinstance(gain, Frf) or hasattr(gain, "dt")):
        raise ModelError(
            "need a ClosedLoop, (plant, controller) or a loop gain L of negative feedback, got "
            f"{short(gain)}. Type close_loop(plant, controller) or (plant, controller)."
        )
    gain = gain if isinstance(gain, Frf) else as_statespace(gain)
    outputs, inputs = tuple(gain.outputs), tuple(gain.inputs)
    if len(outputs) != len(inputs):
        raise ModelError(
            f"a loop gain has as many outputs as inputs, got {len(outputs)} and {len(inputs)}: "
            "pass (plant, controller), the controller with the sign of the feedback in it."
        )
    n = len(inputs)
    return gain, StateSpace([], [], [], -np.eye(n), inputs=outputs, outputs=inputs)


def _modelled(
    plant: StateSpace, controller: StateSpace, poles: Callable[[], ComplexArray]
) -> BrokenLoop:
    dt, both = plant.dt or controller.dt, plant.n_states and controller.n_states
    if both and not np.isclose(plant.dt, controller.dt, rtol=SAME):
        raise ModelError(
            f"plant and controller have dt {plant.dt:g} and {controller.dt:g} s: discretise one."
        )
    plant, controller = plant.replace(dt=dt), controller.replace(dt=dt)
    return BrokenLoop(
        tuple(plant.inputs), tuple(plant.outputs), remembered(responder(controller)),
        responder(plant), poles, dt,
        units={**controller.units, **plant.units},
    )  # fmt: skip


def _law_system(law: Any) -> StateSpace:
    """Return the system y -> u of a controller; of a closed loop, its own."""
    if isinstance(law, ClosedLoop):
        return law.controller.select(law.driven, law.fed_back)
    if isinstance(law, Frf) or hasattr(law, "frdata"):
        raise ModelError(
            "the controller is a frequency response, whose stability and poles are not known. "
            "Pass its StateSpace; a measured plant may be an Frf."
        )
    law = getattr(law, "system", law)
    return law if isinstance(law, StateSpace) else StateSpace.from_control(law)


def _quantities(law: Any) -> dict[str, str]:
    """Return the quantities of the sensors of a controller, if these are known."""
    plant = getattr(law, "plant", None)
    ports = plant.ports.y if isinstance(plant, AnyPlant) else ()
    return {port.name: port.quantity for port in ports if isinstance(port, SensorPort)}


def _loop_and_grid(loop: Loop, freq: npt.ArrayLike | None) -> tuple[BrokenLoop, FloatArray]:
    parts = taken_apart(loop)
    return parts, parts.grid if freq is None else _checked_freq(parts, freq)


def _checked_freq(parts: BrokenLoop, freq: npt.ArrayLike) -> FloatArray:
    """Return frequencies that were given."""
    grid = sampled_freq(freq, parts.dt)
    if not grid.size:
        raise ShapeError("freq must hold at least one frequency [Hz], got none. Pass one.")
    if grid[0] <= 0:
        raise ModelError("freq must be positive: integrators and free bodies are infinite at 0.")
    if parts.measured is not None and not np.all(np.isin(grid, parts.grid)):
        raise ModelError(
            "the plant is a measured Frf, known only at its own frequencies: leave freq out."
        )
    return grid


def _loop_frf(freq: FloatArray, data: ComplexArray, parts: BrokenLoop, to: str, fro: str) -> Frf:
    names = {"u": parts.u, "y": parts.y}
    return Frf(
        freq, np.moveaxis(data, 0, -1), inputs=names[fro], outputs=names[to], units=parts.units
    )


def modulus_margin(loop: Loop) -> float:
    """Return the modulus margin ``1 / max_f sigma_max(S_u)``, with the loop opened at u.

    It is the smallest distance of the loop gain to the critical point.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`. Stability is judged first: for a model by its poles, and for a measured
        plant by a Nyquist count as in `report_loops`. The count assumes that the plant has no
        unstable poles. If a response is proportional to 1/f^2 at the lowest frequencies, the motion
        counts as a free rigid-body motion. For a measured plant, S is evaluated at its frequencies,
        and between them at the modes that are visible in the data. If the actuators have several
        units (N and N m), or those of a ClosedLoop have forces that are not comparable (as in
        `ClosedLoop.modulus_margin`), it is the margin with scaled axes, `LoopReport.scaled_margin`.

    Returns
    -------
    float
        Modulus margin. A margin above 0.5 means that |S| stays below 6 dB. For sampled loops it is
        at most 1. For an unstable loop it is 0, and a FlexplantWarning is given.

    Raises
    ------
    AssumptionError
        When the measured frequencies do not show whether the loop is stable. The distance to the
        critical point is then not a margin. Use `report_loops`, which takes the numbers of
        rigid-body modes and of unstable poles.
    LabelError, ModelError
        When channels do not match, or `loop` is of another type.

    References
    ----------
    [Skogestad2005]_, section 2.4, describes the peak of S, which is the inverse of the margin.

    Examples
    --------
    >>> import flexplant as fx
    >>> L = fx.lti.tf([60.0], [1.0, 0.0])  # an integrator that crosses 1 at 60 rad/s
    >>> round(fx.modulus_margin(L), 2)
    1.0
    """
    parts = taken_apart(loop)
    count = broken_count(parts, None, 0)
    if count.unstable is None:
        raise AssumptionError(
            f"it is not known whether the closed loop is stable: {count.reason}. Only a stable "
            "loop has a modulus margin. Pass further knowledge of the plant to fx.loop.report_loops"
            "(loop, rigid=, unstable=), which also reports the limits of its judgement."
        )
    if count.unstable:
        warn(
            f"the closed loop is unstable ({counted(count.unstable, 'pole')} outside the stability "
            "region): it has no modulus margin, which is returned as 0."
        )
        return 0.0
    return parts.margin()


def bandwidth(loop: Loop) -> float:
    """Return the frequency [Hz] at which |S| first crosses 0 dB from below.

    S is the sensitivity with the loop opened at u, and |S| its largest singular value. With more
    actuators than controlled motions, some combinations of actuators are never used, and S = 1 for
    these. Therefore only the combinations that the loop uses at low frequency are counted.

    Parameters
    ----------
    loop : as for `loop_gain`

    Returns
    -------
    float [Hz]
        Bandwidth. It is infinite when |S| stays below 0 dB at all higher frequencies.

    Raises
    ------
    AssumptionError
        When the closed loop is not stable, or |S| is nowhere below 0 dB.
    LabelError, ModelError
        When channels do not match, or `loop` is of another type.

    Examples
    --------
    >>> import flexplant as fx
    >>> L = fx.lti.tf([40.0, 900.0], [1.0, 0.0, 0.0])
    >>> round(fx.loop.bandwidth(L), 1)
    10.1
    """
    return broken_bandwidth(taken_apart(loop))


def broken_bandwidth(parts: BrokenLoop) -> float:
    """Return the bandwidth of a broken loop."""
    if parts.is_unstable:
        raise AssumptionError(
            "the closed loop is not stable, so that |S| has no meaning and no bandwidth. "
            "Stabilise it first: see loop.spectral_radius and loop.modulus_margin."
        )
    grid = parts.grid
    vectors, gains, _ = np.linalg.svd(parts.gain(grid[:1])[0])
    # axes without an actuator have a gain of rounding size
    acting = np.asarray(vectors[:, gains >= 1e-6 * gains[0]], dtype=np.complex128)
    values = _sensitivity_along(acting, parts, grid)
    if not np.any(values < 1.0):
        raise AssumptionError(
            f"|S| is nowhere below 0 dB (least {values.min():.4g}): this feedback does not "
            "suppress errors, so that it has no bandwidth. Check the sign of the controller, u "
            "= K y."
        )
    find = None if parts.measured is not None else partial(_sensitivity_along, acting, parts)
    return first_crossing(grid, values, find)


def _sensitivity_along(acting: ComplexArray, parts: BrokenLoop, grid: FloatArray) -> FloatArray:
    """Return sigma_max of S_u in the space of some orthonormal directions of u (columns)."""
    S = inverted(acting.conj().T @ parts.gain(grid) @ acting)
    return np.asarray(np.linalg.norm(S, 2, axis=(1, 2)))
