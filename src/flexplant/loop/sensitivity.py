"""Sensitivities S, T, KS of a loop, for a model or a measured frequency response as plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import LabelError, ModelError, ShapeError, unknown_label
from ..lti.frequency import Frf, frequency_response
from ..lti.grid import resonance_grid
from ..lti.interconnection import lft
from ..lti.responses import responder
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import ComplexArray, FloatArray, real_array, short
from .closed import ClosedLoop

Responder: TypeAlias = Callable[[FloatArray], ComplexArray]
#: a closed loop, or a plant (StandardPlant, StateSpace or measured Frf) and a controller
Loop: TypeAlias = "ClosedLoop | tuple[Any, Any]"


class Pieces(NamedTuple):
    """A loop taken apart: y = P u, u = K y; `respond` gives K (f, nu, ny) and P (f, ny, nu).

    `poles` gives those of the closed loop, or of the controller when the plant was measured.
    """

    u: tuple[str, ...]
    y: tuple[str, ...]
    respond: Callable[[FloatArray], tuple[ComplexArray, ComplexArray]]
    poles: Callable[[], ComplexArray]
    dt: float
    measured: FloatArray | None  # the frequencies of a measured plant


def loop_gain(loop: Loop, *, freq: npt.ArrayLike | None = None, at: Literal["u", "y"] = "u") -> Frf:
    """Return the loop gain L = K P (broken at u) or P K (broken at y); the critical point is +1.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        The plant a StandardPlant, a StateSpace or a measured Frf (with the delay that the loop
        will have), those of python-control too; the controller y -> u with the sign of the
        feedback in it, or a ClosedLoop, whose controller is then closed on this plant.
    freq : (n_freq,) array, optional [Hz]
        A grid refined at resonances when not given; those of the Frf for a measured plant.
    at : {"u", "y"}
        Where the loop is broken.

    Returns
    -------
    Frf
        From the channels of `at` to themselves.

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.
    ModelError, ShapeError
        When `freq` is not an array of positive frequencies.
    """
    parts, grid = _prepared(loop, freq)
    return _frf(grid, open_gain(parts, grid, at), parts, at, at)


def sensitivity(
    loop: Loop, *, freq: npt.ArrayLike | None = None, at: Literal["u", "y"] = "u"
) -> Frf:
    """Return the sensitivity S = (I - L)^-1: what feedback leaves of a disturbance at u or y.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`.
    freq : (n_freq,) array, optional [Hz]
        As for `loop_gain`.
    at : {"u", "y"}
        Where the loop is broken.

    Returns
    -------
    Frf
        From the channels of `at` to themselves.

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.
    ModelError, ShapeError
        When `freq` is not an array of positive frequencies.
    """
    parts, grid = _prepared(loop, freq)
    return _frf(grid, inverted(open_gain(parts, grid, at)), parts, at, at)


def complementary_sensitivity(
    loop: Loop, *, freq: npt.ArrayLike | None = None, at: Literal["u", "y"] = "u"
) -> Frf:
    """Return the complementary sensitivity T = I - S = -L (I - L)^-1.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`.
    freq : (n_freq,) array, optional [Hz]
        As for `loop_gain`.
    at : {"u", "y"}
        Where the loop is broken.

    Returns
    -------
    Frf
        From the channels of `at` to themselves.

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.
    ModelError, ShapeError
        When `freq` is not an array of positive frequencies.
    """
    parts, grid = _prepared(loop, freq)
    L = open_gain(parts, grid, at)
    return _frf(grid, -L @ inverted(L), parts, at, at)


def control_sensitivity(loop: Loop, *, freq: npt.ArrayLike | None = None) -> Frf:
    """Return K S: from noise on the measurements y to the commands u.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`.
    freq : (n_freq,) array, optional [Hz]
        As for `loop_gain`.

    Returns
    -------
    Frf
        From y to u: ``(I - K P)^-1 K``.

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.
    ModelError, ShapeError
        When `freq` is not an array of positive frequencies.
    """
    parts, grid = _prepared(loop, freq)
    K, P = parts.respond(grid)
    return _frf(grid, inverted(K @ P) @ K, parts, "u", "y")


def taken_apart(loop: Loop) -> Pieces:
    """Return plant and controller between u and y.

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.
    ModelError
        When `loop` is of another type.
    """
    if isinstance(loop, ClosedLoop):
        plant: Any = loop.plant.system.select(loop.fed_back, loop.driven)
        controller = loop.controller.select(loop.driven, loop.fed_back)
        return _modelled(plant, controller, loop.monitored.poles)
    if not isinstance(loop, tuple) or len(loop) != 2:
        raise ModelError(
            f"need a ClosedLoop or a tuple (plant, controller), got {short(loop)}. Type "
            "close_loop(plant, controller) or (plant, controller)."
        )
    plant, controller = loop[0], _controller(loop[1])
    if hasattr(plant, "frdata"):  # python-control's
        plant = Frf.from_control(plant)
    if isinstance(plant, Frf):
        return _measured(plant, controller, _quantities(loop[1]))
    if isinstance(plant, StandardPlant):
        unread = [name for name in controller.inputs if name not in plant.y]
        if unread:
            raise unknown_label("y for the controller", unread[0], plant.y, "the plant")
        driven = [name for name in controller.outputs if name in plant.u]
        fed = ClosedLoop(plant, (controller,), controller, _idle(plant, driven)).fed_back
        read = [name for name in controller.inputs if name in fed]
        plant, controller = plant.system.select(read, driven), controller.select(driven, read)
    elif not isinstance(plant, StateSpace):
        plant = StateSpace.from_control(plant)
    driven = [name for name in controller.outputs if name in plant.inputs]
    if not driven:
        raise unknown_label("actuator", controller.outputs[0], plant.inputs, "the plant")
    controller = controller.select(driven)
    plant = plant.select(controller.inputs, driven)
    # the peaks of S are at the poles of the closed loop, not at those of its parts
    return _modelled(plant, controller, lambda: lft(plant, controller).poles())


def open_gain(parts: Pieces, grid: FloatArray, at: str) -> ComplexArray:
    """Return K P or P K on a grid, frequency first."""
    if at not in ("u", "y"):
        raise LabelError(f"a loop is broken at 'u' or 'y', got {short(at)}. Pass one of them.")
    K, P = parts.respond(grid)
    return K @ P if at == "u" else P @ K


def inverted(L: ComplexArray) -> ComplexArray:
    """Return (I - L)^-1, frequency first."""
    return np.asarray(np.linalg.inv(np.eye(L.shape[-1]) - L))


def _idle(plant: StandardPlant, driven: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in plant.u if name not in driven)


def _modelled(
    plant: StateSpace, controller: StateSpace, poles: Callable[[], ComplexArray]
) -> Pieces:
    dt = plant.dt or controller.dt
    if (
        plant.n_states
        and controller.n_states
        and not np.isclose(plant.dt, controller.dt, rtol=1e-9)
    ):
        raise ModelError(
            f"plant and controller have dt {plant.dt:g} and {controller.dt:g} s: discretise one."
        )
    plant, controller = plant.replace(dt=dt), controller.replace(dt=dt)

    @cache
    def prepared() -> tuple[Responder, Responder]:  # a dense A is brought to Schur form once
        return responder(controller), responder(plant)

    def respond(freq: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        K, P = (one(freq) for one in prepared())
        return np.ascontiguousarray(K.transpose(2, 0, 1)), np.ascontiguousarray(
            P.transpose(2, 0, 1)
        )

    return Pieces(tuple(plant.inputs), tuple(plant.outputs), respond, poles, dt, None)


def _controller(law: Any) -> StateSpace:
    """Return the system y -> u of a controller; of a closed loop, its own."""
    if isinstance(law, ClosedLoop):
        return law.controller.select(law.driven, law.fed_back)
    if isinstance(law, Frf) or hasattr(law, "frdata"):
        raise ModelError(
            "the controller is a frequency response, whose stability and own poles are not known. "
            "Pass its StateSpace; a measured plant may be an Frf."
        )
    law = getattr(law, "system", law)
    return law if isinstance(law, StateSpace) else StateSpace.from_control(law)


def _quantities(law: Any) -> dict[str, str]:
    """Return what the sensors measure that a controller was designed for, as far as it knows."""
    ports = getattr(getattr(law, "plant", None), "ports", None)
    return {} if ports is None else {sensor.name: sensor.quantity for sensor in ports.y}


def _measured(plant: Frf, controller: StateSpace, quantities: dict[str, str]) -> Pieces:
    for name in controller.inputs:
        if name not in plant.outputs:
            error = unknown_label("measured output", name, plant.outputs, "the Frf")
            raise LabelError(
                f"{error} Select what was measured: controller.select(inputs=[...]); references "
                "are no part of the loop."
            )
        wanted = quantities.get(name, plant.quantity)
        if plant.quantity is not None and wanted != plant.quantity:
            raise ModelError(
                f"the Frf was measured as {plant.quantity}, the controller reads {name!r} as "
                f"{wanted}: convert it, frf.converted({wanted!r})."
            )
    driven = [name for name in controller.outputs if name in plant.inputs]
    if not driven:
        raise unknown_label("measured input", controller.outputs[0], plant.inputs, "the Frf")
    controller = controller.select(driven)
    P = _stack(plant.select(controller.inputs, driven))

    def respond(freq: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        place = np.searchsorted(plant.freq, freq)
        return _stack(frequency_response(controller, freq)), P[place]

    return Pieces(
        tuple(driven), tuple(controller.inputs), respond, controller.poles, controller.dt,
        np.array(plant.freq),
    )  # fmt: skip


def _prepared(loop: Loop, freq: npt.ArrayLike | None) -> tuple[Pieces, FloatArray]:
    parts = taken_apart(loop)
    return parts, checked_grid(parts, freq)


def checked_grid(parts: Pieces, freq: npt.ArrayLike | None) -> FloatArray:
    """Return the asked frequencies, or a grid of our own.

    Raises
    ------
    ModelError, ShapeError
        When they are no array of positive frequencies, or were not measured.
    """
    if freq is None:
        if parts.measured is not None:
            return parts.measured
        return resonance_grid(parts.poles(), parts.dt)
    grid = real_array(freq, "freq")
    if grid.ndim != 1 or not grid.size:
        raise ShapeError(f"freq must be a one-dimensional array [Hz], got {short(freq)}. Pass one.")
    if np.any(grid <= 0):
        raise ModelError("freq must be positive: integrators and free bodies are infinite at 0.")
    if parts.dt and grid.max() > 0.5 / parts.dt * (1 + 1e-12):
        raise ModelError(
            f"frequency {grid.max():g} Hz lies above half the sampling rate ({0.5 / parts.dt:g} "
            "Hz), where a sampled system has no response of its own. Stay below."
        )
    if np.any(np.diff(grid) <= 0):
        raise ModelError("freq must increase strictly: sort the frequencies and merge doubles.")
    if parts.measured is not None and not np.all(np.isin(grid, parts.measured)):
        raise ModelError(
            "the plant is a measured Frf, known only at its own frequencies: leave freq out."
        )
    return grid


def _stack(frf: Frf) -> ComplexArray:
    """Return the data with frequency first, for stacked matrix products."""
    return np.ascontiguousarray(np.moveaxis(np.asarray(frf.data, dtype=np.complex128), -1, 0))


def _frf(freq: FloatArray, data: ComplexArray, parts: Pieces, to: str, fro: str) -> Frf:
    names = {"u": parts.u, "y": parts.y}
    return Frf(freq, np.moveaxis(data, 0, -1), inputs=names[fro], outputs=names[to])
