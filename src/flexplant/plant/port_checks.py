"""What the ports of a machine have in common: a place, and the filters of amplifier and sensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import LabelError, ModelError, unknown_label
from ..labels import DIRECTIONS, Place
from ..lti.statespace import StateSpace, as_statespace
from ..values import check_names, flag, positive, real_array, short

#: [s] a latency from here on is taken for a number of samples
_SAMPLES = 1.0
#: endings of the channels that a plant makes itself: estimates, references, errors, efforts, noises
#: of sensors and disturbances of actuators
DERIVED = ("hat", "ref", "error", "effort", "noise", "disturbance")


def checked_port(port: Any) -> dict[str, Any]:
    """Return the fields that ports have in common, each checked."""
    name = checked_name(port.name)
    checks: dict[str, Any] = {
        "direction": checked_direction,
        "at": checked_place,
        "asd": lambda name, asd: positive(asd, f"asd of {name!r}", zero=True),
        "shape": lambda name, shape: checked_filter(name, "shape", shape),
        "dynamics": lambda name, dynamics: checked_filter(name, "dynamics", dynamics),
        "latency": checked_latency,
        "held": lambda name, held: flag(held, f"held of {name!r}"),
        "absolute": checked_choice,
    }
    given = port._fields()
    return {"name": name} | {
        key: check(name, given[key]) for key, check in checks.items() if key in given
    }


def checked_name(name: Any) -> str:
    """Return the name of a port, or raise LabelError."""
    if not isinstance(name, str):
        raise LabelError(f"a port is named by a string, got {short(name)}. Name it, such as 'u1'.")
    check_names([name], "ports")
    ending = name.rpartition(":")[2]
    if ":" in name and ending in DERIVED:
        raise LabelError(
            f"a port cannot be named {name!r}: names that end in ':{ending}' are those of channels "
            "that a plant and its observer make themselves, and loops connect by name. Name it "
            f"{name.replace(':', '_')!r}, say."
        )
    return name


def checked_latency(name: str, latency: Any) -> float:
    """Return the latency [s] of a port, or raise ModelError: a second is a number of samples."""
    late = positive(latency, f"latency of {name!r}", zero=True)
    if late >= _SAMPLES:
        raise ModelError(
            f"the latency of {name!r} is {late:g} s, in seconds: no loop runs that late. If "
            f"samples are meant, divide by the rate, latency={late:g} / rate, or pass them to "
            f"plant.discretized(rate, delay={late:g})."
        )
    return late


def checked_choice(name: str, absolute: Any) -> bool | None:
    """Return whether a motion is absolute, or None where that was left open."""
    if absolute is not None and not isinstance(absolute, bool | np.bool_):
        raise ModelError(
            f"absolute of {name!r} is True (with the motion of the ground) or False (against the "
            f"ground), got {short(absolute)}."
        )
    return None if absolute is None else bool(absolute)


def checked_direction(name: str, direction: str) -> str:
    """Return one of the six directions, or raise LabelError."""
    if not isinstance(direction, str) or direction not in DIRECTIONS:
        raise unknown_label(f"direction of {name!r}", direction, DIRECTIONS)
    return direction


def checked_place(name: str, at: Any) -> Place:
    """Return a copy of a place: a label, a point, or a sum {label or point: weight}."""
    if isinstance(at, Mapping):
        if not at:
            raise LabelError(f"{name!r} is at an empty mapping: name at least one DOF.")
        return {
            _term(name, place): float(real_array(weight, f"weight of {place!r} in {name!r}", ()))
            for place, weight in at.items()
        }
    if isinstance(at, str):
        return at
    return tuple(real_array(at, f"place of {name!r}", (3,)).tolist())


def _term(name: str, place: Any) -> Any:
    if isinstance(place, tuple):
        return tuple(real_array(place, f"a point of {name!r}", (3,)).tolist())
    return str(place)


def checked_filter(name: str, what: str, given: Any) -> StateSpace | None:
    """Return a stable continuous system of one input and output, named like its port."""
    if given is None:
        return None
    if hasattr(given, "shape") and hasattr(given, "asd"):
        kind = type(given).__name__
        raise ModelError(
            f"the {what} of {name!r} is a filter, got {kind}, which is a spectrum: noise and its "
            f"filter. It makes the port itself: {kind}(...).force(name, at), .rigid or .floor."
        )
    sys = as_statespace(given)
    if len(sys.inputs) != 1 or len(sys.outputs) != 1:
        raise ModelError(
            f"the {what} of {name!r} needs one input and one output, got {sys!r}. "
            "Select a channel of it: sys['output', 'input']."
        )
    if sys.n_states and sys.dt:
        raise ModelError(
            f"the {what} of {name!r} is sampled (dt {sys.dt:g} s), but belongs to the machine: "
            "give the continuous system, it is sampled with the plant."
        )
    if not sys.is_stable:
        raise ModelError(
            f"the {what} of {name!r} is not stable (poles {_slowest(sys)} rad/s): nothing would "
            "be stationary. Replace an integrator by a low-pass with a corner far below the band."
        )
    prefix = [f"{name}|{state.rpartition('|')[2]}" for state in sys.states]
    return sys.replace(inputs=["in"], outputs=["out"], dt=0.0, states=prefix)


def _slowest(sys: StateSpace) -> str:
    worst = sorted(sys.poles(), key=lambda pole: -pole.real)[:2]
    return ", ".join(f"{pole:.4g}" for pole in worst)
