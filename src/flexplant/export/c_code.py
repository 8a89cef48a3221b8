"""write_c: a sampled controller as one C99 file with its header, without allocation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, flag, number, positive
from ..errors import AssumptionError, LabelError, ModelError, require_known, short
from ..loop import ClosedLoop, ScheduledLoop
from ..loop.blocks import applied_law
from ..lti.statespace import StateSpace, as_statespace
from ..store import named_file, written
from ..synthesis.aftercare.forms import back_gain, scheduled_form, two_state_form
from ..tolerances import SAME
from .c_text import CText

#: keywords of C, and names of its library that end in _t
_RESERVED = frozenset(
    """auto break case char const continue default do double else enum extern float for goto if
    inline int long register restrict return short signed sizeof static struct switch typedef
    union unsigned void volatile while main size ptrdiff int8 int16 int32 int64 uint8 uint16 uint32
    uint64 time clock""".split()  # noqa: SIM905 - words, not data
)


def write_c(
    controller: Any,
    path: Any,
    *,
    name: str | None = None,
    limits: Any = None,
    anti_windup: float | None = None,
    schedule: str | None = None,
    single: bool = False,
) -> tuple[Path, Path]:
    """Write a sampled controller as C99: one source file and its header, no allocation.

    The states are transformed to blocks of two, so that a compiler can compute several blocks at a
    time. As a check, the response of the blocks is compared with that of the controller. Numbers
    have 17 digits (9 in single precision), which is exact. The names of the functions end in
    `_reset`, `_start`, `_output`, `_update` and `_step`. `_start` is used in place of `_reset` if
    commands act already: it computes states with which these commands stay constant (if such states
    exist), so that they do not jump. In each sample call `_output` and then `_update`, or only
    `_step`. If a value is not finite, the last outputs are held and a flag is raised.

    Parameters
    ----------
    controller : StateSpace, Controller, ClosedLoop, ScheduledLoop, or {place: one of these}
        Sampled controller. All blocks of a ClosedLoop go to one file. Its inputs are the channels
        of `plant.y`, and its outputs the driven actuators, followed by the monitored outputs. If a
        single controller has an input with the same name as one of its outputs (as in a controller
        that contains an observer, or in an `anti_windup_form`), the generated code feeds the
        applied command to this input, and it is not an input of the C functions. The keys of a
        mapping are places, values of the input `schedule`. Its controllers may differ only in their
        output matrices C and D (for example feedforward or decoupling), which are interpolated
        linearly between places. For a ScheduledLoop all matrices are interpolated, and its position
        is the last input.
    path : path
        Path of the source file. The header is written to the same folder.
    name : str, optional
        Prefix of the functions; by default the name of the file.
    limits : float, (low, high) or mapping {actuator: one of these}, optional
        Limits of the commands of the actuators, in the units of u.
    anti_windup : float [s], optional
        Recovery time of a ClosedLoop, as for `simulate`. For a single controller that does not read
        the applied commands it is the `recovery` of `anti_windup_form`. If it is not given, limits
        are possible only for a controller that has Hanus' form (see `anti_windup_form`).
    schedule : str, optional
        Name of the input whose value is the place, for controllers in a mapping.
    single : bool
        Whether to compute in float instead of double.

    Returns
    -------
    (Path, Path)
        The source and the header.

    Raises
    ------
    AssumptionError
        When a command depends on an applied command of the same sample, or limits need a recovery
        time.
    CertificateError
        When the blocks differ from the controller, for example by rounding to single precision.
    LabelError
        When the name is not a C identifier, or an actuator or the input of a schedule is unknown.
    ModelError
        When the controller is continuous, the path does not end in `.c`, or controllers of a
        mapping differ in more than C and D.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     loop = fx.close_loop(plant, observer, servo)
    ...     _ = fx.export.write_c(loop, os.path.join(folder, "servo.c"), limits=20.0)
    ...     sorted(os.listdir(folder))
    ['servo.c', 'servo.h']
    """
    source = named_file(path)
    if source.suffix != ".c":
        raise ModelError(
            f"path must end in .c, got {short(str(path))}. Pass a name such as 'stage.c'."
        )
    prefix = c_name(source.stem if name is None else name)
    if source.stem != prefix:
        source = source.with_name(f"{prefix}.c")
    program = c_program(
        controller, prefix,
        limits=limits, anti_windup=anti_windup, schedule=schedule, single=single,
    )  # fmt: skip
    header = source.with_suffix(".h")
    for file, text in ((header, program.header), (source, program.source)):
        with written(file) as stream:
            stream.write(text.encode("ascii"))
    return source, header


def c_name(name: Any) -> str:
    """Return a name that C allows for functions, and with the ending _t for a type."""
    valid = isinstance(name, str) and re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name)
    if not valid or name in _RESERVED:
        raise LabelError(
            f"{short(name)} is not allowed as a function name in C. Pass name= with letters, "
            "digits and underscores."
        )
    return str(name)


class _Law(NamedTuple):
    """A controller [in] -> [driven; watched], and how ``applied - commanded`` moves its states."""

    system: StateSpace
    driven: int
    back: FloatArray | None


def c_program(
    controller: Any,
    name: str,
    *,
    limits: Any = None,
    anti_windup: float | None = None,
    schedule: str | None = None,
    single: bool = False,
    driven: bool = True,
) -> CText:
    """Return the C text of a sampled controller, or of a system without commands (a plant)."""
    recovery = None if anti_windup is None else positive(anti_windup, "anti_windup")
    if isinstance(controller, ScheduledLoop):
        if schedule is not None or limits is not None or recovery is not None:
            raise ModelError(
                "a ScheduledLoop brings its position as its last input, and its states under "
                "limits would belong to no design: leave out schedule=, limits= and "
                "anti_windup=, and saturate outside of the function."
            )
        return _following(controller, name, flag(single, "single"))
    places, laws = _scheduled(controller, schedule, recovery, limits is not None, driven)
    law = laws[0]
    K, p, m = law.system, len(law.system.outputs), len(law.system.inputs)
    ends = _limits(limits, K.outputs[: law.driven])
    whole = K
    if len(laws) > 1:
        whole = K.replace(
            C=np.vstack([one.system.C for one in laws]),
            D=np.vstack([one.system.D for one in laws]),
            outputs=[f"{name}|{q}" for q in range(len(laws)) for name in K.outputs],
            units={},
        )
    back = law.back if law.back is not None and np.any(law.back) else None
    if back is not None:
        D = np.hstack([whole.D, np.zeros((len(whole.outputs), law.driven))])
        names = [*K.inputs, *(f"{one}|missed" for one in K.outputs[: law.driven])]
        whole = whole.replace(B=np.hstack([whole.B, back]), D=D, inputs=names, units={})
    groups = [slice(q * p, q * p + law.driven) for q in range(len(laws) if law.driven else 0)]
    form = two_state_form(whole, driven=groups, inputs=m, single=flag(single, "single"))
    at = K.inputs.index(str(schedule)) if len(laws) > 1 else 0
    return CText(name, K, form, law.driven, ends, places, at, single)


def _following(loop: ScheduledLoop, name: str, single: bool) -> CText:
    """Return the C text of a loop whose controller follows a position, its last input."""
    laws = []
    for one in loop.loops:
        K = one.controller
        B, D = (np.hstack([part, np.zeros((len(part), 1))]) for part in (K.B, K.D))
        laws.append(K.replace(B=B, D=D, inputs=[*K.inputs, loop.position], units={}))
    K, driven = laws[0], len(loop.loops[0].driven)
    _check_rate(K.dt, K.n_states)
    form = scheduled_form(laws, driven=driven, single=single)
    return CText(name, K, form, driven, None, loop.places, len(K.inputs) - 1, single)


def _scheduled(
    given: Any, schedule: Any, recovery: float | None, limited: bool, driven: bool
) -> tuple[FloatArray, list[_Law]]:
    """Return the places in rising order, and the law of each."""
    if not isinstance(given, Mapping):
        if schedule is not None:
            raise ModelError(
                f"schedule={short(schedule)} needs controllers by place: pass a mapping such as "
                "{0.0: controller, 0.1: other}."
            )
        return np.zeros(0), [_law(given, recovery, limited, driven)]
    places = sorted(number(place, "a place") for place in given)
    if len(places) < 2 or len(set(places)) < len(places):
        raise ModelError(f"a schedule needs two places or more, all different, got {places}.")
    by_place = {number(place, "a place"): one for place, one in given.items()}
    laws = [_law(by_place[place], recovery, limited, driven) for place in places]
    first = laws[0]
    require_known("input of the schedule", [schedule], first.system.inputs, "the controller")
    for place, one in zip(places, laws, strict=True):
        a, b = first.system, one.system
        if (a.inputs, a.outputs, a.dt, a.n_states) != (b.inputs, b.outputs, b.dt, b.n_states):
            raise ModelError(
                f"the controller at {place:g} has other channels, rate or states than the first. "
                "Design all with the same structure."
            )
        moved = [
            part
            for part, u, v in (("A", a.A, b.A), ("B", a.B, b.B), ("back", first.back, one.back))
            if u is not None
            and v is not None
            and not np.allclose(u, v, rtol=SAME, atol=SAME * np.abs(u).max(initial=0.0))
        ]
        if moved == ["back"]:
            raise ModelError(
                "limits and a schedule: the feedback of the applied command to the states "
                f"follows from the gains, and differs between {place:g} and {places[0]:g}; "
                "between places the states under saturation would belong to no design. Leave "
                "limits out and saturate outside of the function, or schedule only rows of "
                "feedforward (D)."
            )
        if moved:
            raise ModelError(
                f"the controller at {place:g} differs from the first in more than its outputs "
                f"({', '.join(moved)}): poles between places would belong to no design. Schedule "
                "only the outputs (feedforward, decoupling, gains)."
            )
    return np.array(places), laws


def _law(given: Any, recovery: float | None, limited: bool, driven: bool) -> _Law:
    """Return a controller with fed back applied commands, and the effect of their error."""
    if isinstance(given, ClosedLoop):
        dt = given.plant.dt
        _check_rate(dt, given.controller.n_states)
        law, L = applied_law(given, None if recovery is None else recovery / dt)
        return _applied_law(law, len(given.driven), [*given.plant.y], L)
    K = as_statespace(given)
    _check_rate(K.dt, K.n_states)
    if not driven:
        return _Law(K, 0, None)
    fed = [name for name in K.inputs if name in K.outputs]
    if fed:
        rows = [*fed, *(name for name in K.outputs if name not in fed)]
        outer = [name for name in K.inputs if name not in fed]
        law = K.select(rows, [*outer, *fed])
        found = _applied_law(law, len(fed), outer, np.zeros((K.n_states, len(fed))))
        if len(fed) < len(K.outputs) and limited:
            raise ModelError(
                "limits need all applied commands as inputs, but the controller reads only "
                f"{fed} of {K.outputs}: pass the ClosedLoop, which has the actuators."
            )
        return found
    if not limited or not K.n_states:
        return _Law(K, len(K.outputs), None)
    return _Law(K, len(K.outputs), back_gain(K, recovery))


def _check_rate(dt: float, states: int) -> None:
    if not dt and states:
        raise ModelError(
            "a computer runs a sampled controller: synthesis.discretise_controller(plant, "
            "controller) first."
        )


def _applied_law(law: StateSpace, nu: int, outer: Sequence[str], L: FloatArray) -> _Law:
    """Return ``[outer; applied] -> [u; watched]`` with commands applied without limits."""
    ny = len(outer)
    if np.any(law.D[:, ny:]):
        i, j = np.argwhere(law.D[:, ny:])[0]
        raise AssumptionError(
            f"{law.outputs[i]!r} depends on the applied {law.outputs[j]!r} of the same sample, "
            "which is only known after the command. Let the block read it one sample later."
        )
    Ba, known = law.B[:, ny:], (*outer, *law.outputs)
    system = law.replace(
        A=law.A + Ba @ law.C[:nu],
        B=law.B[:, :ny] + Ba @ law.D[:nu, :ny],
        D=law.D[:, :ny],
        inputs=outer,
        units={key: unit for key, unit in law.units.items() if key in known},
        blocks=None,
    )
    return _Law(system, nu, Ba + L)


def _limits(given: Any, names: Sequence[str]) -> FloatArray | None:
    """Return the lowest and the highest command (2, n) of each actuator."""
    if given is None:
        return None
    each = dict(given) if isinstance(given, Mapping) else dict.fromkeys(names, given)
    require_known("actuator with a limit", list(each), names, "the outputs")
    found = np.tile([[-np.inf], [np.inf]], (1, len(names)))
    for name, ends in each.items():
        pair = ends if isinstance(ends, list | tuple) else (-number(ends, "a limit"), ends)
        if len(pair) != 2:
            raise ModelError(f"limits of {name!r} must be one number or (low, high), got {ends}.")
        low, high = (number(end, f"a limit of {name!r}") for end in pair)
        if not low < high:
            raise ModelError(f"limits of {name!r} must be low < high, got ({low:g}, {high:g}).")
        found[:, names.index(name)] = low, high
    return found
