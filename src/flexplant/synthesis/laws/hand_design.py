"""LoopDesign: loops shaped by hand, with elements or systems, and the script that repeats them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import flag, instance, mapping, number, positive, real_array, whole
from ...errors import (
    AssumptionError,
    LabelError,
    ModelError,
    ShapeError,
    counted,
    require_known,
    short,
)
from ...fingerprints import fingerprint
from ...loop.measured_loop import static_map
from ...lti.conversions import bilinear
from ...lti.frequency import Frf
from ...lti.interconnection import among
from ...lti.statespace import StateSpace, as_statespace, single_channel
from ...plant.port import TERMS
from ...store import Value, checked
from ..controller import Controller
from .law import BlockSection, Law, LawElement, SingleElement
from .loop_design import Axes, DesignedLoops, axes_controller, axes_of, connected, made


@dataclass(frozen=True, eq=False, repr=False)
class FixedBlock(SingleElement):
    """An element of a law that is a given system with one input and one output.

    Parameters
    ----------
    block : StateSpace
        System from error to command, continuous or sampled. A sampled system with states can only
        be used at its own rate.
    label : str
        Description that is shown when the law is printed.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.FixedBlock(fx.lti.tf([1.0], [0.01, 1.0]), "shaping filter")
    FixedBlock shaping filter: 1 state
    """

    block: StateSpace
    label: str = "block"

    def __post_init__(self) -> None:
        block = single_channel(self.block, "a block of a law", ShapeError)
        self._set(block=block, label=str(self.label))

    @classmethod
    def of(cls, given: Any, *, label: str = "") -> FixedBlock:
        """Return the element that is a given system, or a designed controller.

        Parameters
        ----------
        given : StateSpace or Controller
            System of the element. A StateSpace is used unchanged, from error to command. A designed
            Controller K includes the sign of the feedback (``u = K y``). The element is therefore
            ``-K``.
        label : str, optional
            Description of the element; by default the name or the method of `given`.
        """
        if isinstance(given, Controller):
            return cls(-given.system, label or given.method)
        if isinstance(given, Value) and not isinstance(given, StateSpace):
            raise ModelError(
                f"a block of a law is a system, got {short(given)}. Pass a StateSpace."
            )
        return cls(as_statespace(given), label or getattr(given, "name", None) or "block")

    def __repr__(self) -> str:
        rate = f" at {1.0 / self.block.dt:g} Hz" if self.own_rate else ""
        return f"FixedBlock {self.label}: {counted(self.block.n_states, 'state')}{rate}"

    @property
    def own_rate(self) -> float:
        """The only rate [Hz] at which the block can run; 0 if it can run at any rate."""
        return 1.0 / self.block.dt if self.block.dt and self.block.n_states else 0.0

    @cached_property
    def section(self) -> BlockSection:
        """The system. A sampled block is replaced by its continuous equivalent by Tustin's rule."""
        rate, g = self.own_rate, self.block
        return BlockSection(bilinear(g, rate) if rate else g.replace(dt=0.0))


@dataclass(frozen=True, eq=False, repr=False)
class ShapedAxis(Value):
    """The law of one axis in a `LoopDesign`: a gain, and elements that can be switched off.

    Parameters
    ----------
    elements : sequence of elements
        Elements of the law, multiplied in the given order: `Pid`, `Lead`, `Lag`, `Integrator`,
        `Notch`, `LowPass` or `FixedBlock`.
    gain : float
        Gain by which the product of the elements is multiplied.
    on : sequence of bool, optional
        Whether each element is on; by default all are on.
    feedforward : sequence of up to 5 float
        Feedforward gains. They are the command of the axis per position, velocity, acceleration,
        jerk and snap (the fourth derivative) of its reference.
    closed : bool
        Whether the loop of this axis is closed while others are shaped (sequential loop closing).

    Examples
    --------
    >>> import flexplant as fx
    >>> axis = fx.synthesis.ShapedAxis([fx.Pid(2.0), fx.Notch(130.0)], on=[True, False])
    >>> axis.law
    Pid(p=2, i=0 /s, d=0 s)
    """

    elements: tuple[SingleElement, ...] = ()
    gain: float = field(default=1.0, metadata=checked(number))
    on: tuple[bool, ...] = ()
    feedforward: tuple[float, ...] = ()
    closed: bool = field(default=True, metadata=checked(flag))

    def __post_init__(self) -> None:
        super().__post_init__()
        given: Any = self.elements
        if isinstance(given, LawElement):
            given = (given,)
        if not isinstance(given, Iterable) or isinstance(given, str | Mapping):
            raise ModelError(f"elements are a list of Pid, Lead, Notch ..., got {short(given)}.")
        elements: list[SingleElement] = []
        gain, on = self.gain, [flag(one, "on") for one in self.on]
        for element in given:
            if isinstance(element, Law):  # its factors, one by one
                elements += element.factors
                gain *= element.gain
            else:
                hint = "Pass Pid, Lead, Lag, Integrator, Notch, LowPass or FixedBlock."
                elements.append(instance(element, SingleElement, "an element", hint))
        if on and len(on) != len(elements):
            raise ShapeError(
                f"on says of each element whether it acts: {len(elements)} elements, got {len(on)}."
            )
        forward = tuple(number(one, "feedforward") for one in self.feedforward)
        if len(forward) > len(TERMS):
            raise ShapeError(f"feedforward has up to {len(TERMS)} gains ({', '.join(TERMS)}).")
        while forward and not forward[-1]:
            forward = forward[:-1]
        on = on or [True] * len(elements)
        self._set(elements=tuple(elements), gain=gain, on=tuple(on), feedforward=forward)

    @property
    def active(self) -> tuple[SingleElement, ...]:
        """The elements that are on."""
        return tuple(e for e, on in zip(self.elements, self.on, strict=True) if on)

    @property
    def forward(self) -> dict[str, float]:
        """The feedforward gains that are not zero, as a mapping {term: gain}.

        A term is "position", "velocity", "acceleration", "jerk" or "snap" of the reference.
        """
        return {term: g for term, g in zip(TERMS, self.feedforward, strict=False) if g}

    @property
    def law(self) -> Law:
        """The continuous law of the elements that are on."""
        rate = max((element.own_rate for element in self.active), default=0.0)
        return Law(self.active, self.gain, rate=rate)

    def __repr__(self) -> str:
        each = zip(self.elements, self.on, strict=True)
        shown = [f"{e!r}" if on else f"({e!r}, off)" for e, on in each]
        forward = [f"{term} {gain:.4g}" for term, gain in self.forward.items()]
        more = f"; feedforward {', '.join(forward)}" if forward else ""
        return " * ".join([f"{self.gain:.5g}", *shown]) + more + ("" if self.closed else "; open")


@dataclass(frozen=True, eq=False, repr=False)
class LoopDesign(Value):
    """Loops that are shaped by hand: the elements of each axis, and data of the plant.

    The controller is ``u = before diag(law_i) (r - after y)`` with the references r. The
    feedforward of the axes that have one is added. The design consists of numbers only, so that
    equal designs give exactly equal controllers.

    Parameters
    ----------
    axes : mapping {axis: ShapedAxis}
        Law of each axis, in the order of the outputs of `after`.
    before, after : StateSpace or array, optional
        Static transformations for decoupling. `before` maps the commands of the axes to u, and
        `after` maps y to the motions of the axes. With None the channels of the plant are the axes.
    rate : float [Hz]
        Sampling rate of the controller; 0 if it is continuous.
    delay : float
        Delay in samples of a measured plant that is not contained in the measurement.
    hold : bool
        Whether the zero-order hold must be added to a measured plant. Use False if the plant was
        measured from sampled commands to sampled outputs, because the measurement then contains the
        hold.
    rigid, unstable : int
        Number of rigid-body modes and number of unstable poles of a measured plant. Poles outside
        the stability region are unstable.
    references : mapping {axis: channel}
        Name of the reference that each axis follows. An axis with feedforward always has a
        reference, whose name is ``axis:ref`` by default.
    made_on : str
        Description of the plant on which the design was made.
    fingerprint : str
        Hash of the plant's numbers, which `is_made_on` compares.

    Examples
    --------
    >>> import flexplant as fx
    >>> from flexplant.synthesis import LoopDesign, ShapedAxis
    >>> elements = [fx.Pid(9e4), fx.Lead(50.0), fx.LowPass(500.0)]
    >>> mass = fx.lti.tf([1.0], [1.0, 0.0, 0.0])
    >>> design = LoopDesign.on(mass, {"out": ShapedAxis(elements)})
    >>> design.loops(mass).report.is_stable
    True
    >>> design.controller().inputs, design.controller().outputs
    (('out',), ('in',))
    """

    axes: Mapping[str, ShapedAxis]
    before: Any = None
    after: Any = None
    rate: float = field(default=0.0, metadata=checked(positive, zero=True))
    delay: float = field(default=0.0, metadata=checked(positive, zero=True))
    hold: bool = field(default=True, metadata=checked(flag))
    rigid: int = field(default=0, metadata=checked(whole, minimum=0))
    unstable: int = field(default=0, metadata=checked(whole, minimum=0))
    references: Mapping[str, str] = field(default_factory=dict)
    made_on: str = ""
    fingerprint: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        found = {}
        for name, axis in mapping(self.axes, "axes", "Pass {axis: ShapedAxis}.", least=1).items():
            given: Any = axis
            if isinstance(axis, LawElement | list | tuple):
                given = ShapedAxis(axis)  # type: ignore[arg-type]
            found[str(name)] = instance(given, ShapedAxis, f"axis {name!r}", "Pass a ShapedAxis.")
        names = tuple(found)
        before = static_map(self.before, _at_plant(self.before, "outputs", names, "u"), "before")
        after = static_map(self.after, _at_plant(self.after, "inputs", names, "y"), "after")
        if self.after is None or isinstance(self.after, np.ndarray | list | tuple):
            after = after.replace(outputs=names)
        if tuple(after.outputs) != names or len(before.inputs) != len(names):
            raise LabelError(
                f"the axes are {', '.join(names)}, but after= leads to {', '.join(after.outputs)} "
                f"and before= starts from {len(before.inputs)}. Name the axes like the motions."
            )
        require_known("axis", self.references, names)
        before, after = before.replace(dt=0.0), after.replace(dt=0.0)
        self._set(axes=found, before=before, after=after, references=dict(self.references))

    @classmethod
    def on(
        cls,
        plant: Any,
        axes: Mapping[str, ShapedAxis] | None = None,
        *,
        before: Any = None,
        after: Any = None,
        rate: float | None = None,
        delay: float = 0.0,
        hold: bool = True,
        rigid: int | None = None,
        unstable: int = 0,
        references: Mapping[str, str] | None = None,
    ) -> LoopDesign:
        """Return a design for a plant.

        Parameters
        ----------
        plant : as for `design_loops`
        axes : mapping {axis: ShapedAxis}, optional
            Axes of the design; by default those that the actuators move. An axis that is not given
            has a gain of 1.
        before, after, rate, delay, hold, unstable, references : as for `design_loops`
        rigid : int, optional
            Number of rigid-body modes of a measured plant. By default each axis whose response
            falls with 40 dB per decade at its lowest frequencies counts as one.

        Raises
        ------
        LabelError, ModelError, ShapeError, AssumptionError
            As for `design_loops`.
        """
        parts = axes_of(plant, before, after, rate, delay, hold)
        given = axes or {}
        require_known("axis", given, parts.names)
        if rigid is None:
            rigid = _free_axes(parts.plant) if isinstance(parts.plant, Frf) else 0
        shaped = {name: given.get(name, ShapedAxis()) for name in parts.names}
        first = repr(getattr(plant, "nominal", plant)).splitlines()[0].strip("<>")
        return cls(
            shaped, parts.before, parts.after, parts.rate, delay, hold, rigid, unstable,
            references or {}, first, _digest(plant),
        )  # fmt: skip

    def __repr__(self) -> str:
        rate = f"at {self.rate:g} Hz" if self.rate else "continuous"
        lines = [f"<LoopDesign of {', '.join(self.axes)}, {rate}>"]
        lines += [f"  {name}: {axis!r}" for name, axis in list(self.axes.items())[:4]]
        lines += [f"  and {len(self.axes) - 4} more axes"] if len(self.axes) > 4 else []
        lines += [f"  made on {self.made_on}"] if self.made_on else []
        return "\n".join(lines)

    def is_made_on(self, plant: Any) -> bool:
        """Return whether the design was made on a plant with the same numbers.

        Parameters
        ----------
        plant : StandardPlant, StateSpace or Frf
            Plant to compare with.
        """
        return self.fingerprint == _digest(plant)

    def with_axis(self, name: str, axis: ShapedAxis) -> LoopDesign:
        """Return the design with one axis replaced.

        Parameters
        ----------
        name : str
            Name of the axis that is replaced.
        axis : ShapedAxis
            New axis, with its elements.
        """
        require_known("axis", [name], self.axes)
        return self.replace(axes={**self.axes, name: axis})

    @cached_property
    def laws(self) -> dict[str, Law]:
        """The law of each axis, at the rate of the controller.

        Raises
        ------
        ModelError
            When an element lies above half the rate, or a block has another rate.
        """
        found = {}
        for name, axis in self.axes.items():
            try:
                law = axis.law
                found[name] = law if law.rate == self.rate else law.replace(rate=self.rate)
            except ModelError as error:
                raise ModelError(f"axis {name!r}: {error}") from None
        return found

    def controller(self) -> StateSpace:
        """Return the controller as a system from y and the references to u.

        Its inputs are y, the references of axes that have one, and the derivatives of references
        that a feedforward uses, for example ``z:ref:acceleration``. `close_loop`, `simulate` and
        `write_c` take it. Axes that are open while others are shaped are included.
        """
        axes = Axes(None, self.before, self.after, self.rate)
        feedback = connected(axes, axes_controller(axes, self.laws), self._followed)
        through: dict[tuple[str, str], float] = {}
        for (name, axis), column in zip(self.axes.items(), self.before.D.T, strict=True):
            for term, gain in axis.forward.items():
                reference = self._followed[name]
                channel = reference if term == "position" else f"{reference}:{term}"
                for u, share in zip(self.before.outputs, column, strict=True):
                    through[u, channel] = through.get((u, channel), 0.0) + gain * share
        inputs = dict.fromkeys((*feedback.inputs, *(channel for _, channel in through)))
        found = among(feedback, tuple(inputs), feedback.outputs, through)
        return found.replace(name="loops")

    @property
    def _followed(self) -> dict[str, str]:
        """The reference of each axis that has one."""
        own = {name: f"{name}:ref" for name, axis in self.axes.items() if axis.feedforward}
        found = {**own, **self.references}
        return {name: found[name] for name in self.axes if name in found}

    def loops(self, plant: Any) -> DesignedLoops:
        """Return the loops on a plant with all axes closed, with their report and checks.

        Parameters
        ----------
        plant : StandardPlant, StateSpace or Frf
            Plant with the channels and the rate of the design.

        Raises
        ------
        LabelError, ModelError, ShapeError
            As for `design_loops`.
        """
        return made(self.placed(plant), self.laws, self.rigid, self.unstable, dict(self.references))

    def placed(self, plant: Any) -> Axes:
        """Return a plant transformed to the axes of the design.

        Parameters
        ----------
        plant : StandardPlant, StateSpace or Frf
            Plant with the channels of the design.
        """
        if isinstance(plant, Frf) or hasattr(plant, "frdata"):
            rate = self.rate or None
            return axes_of(plant, self.before, self.after, rate, self.delay, self.hold)
        parts = axes_of(plant, self.before, self.after, None, 0.0, True)
        if abs(parts.rate - self.rate) > 1e-9 * self.rate:
            runs = f"runs at {parts.rate:g} Hz" if parts.rate else "is continuous"
            raise ModelError(
                f"the design runs at {self.rate:g} Hz, the plant {runs}: pass "
                "plant.discretized(rate), or a design of its rate."
            )
        return parts

    def script(self, plant: str = "") -> str:
        """Return a Python script that makes exactly the same design.

        Parameters
        ----------
        plant : str, optional
            Line that makes the plant, for example ``plant = fx.load("stage.npz")``. If it is given,
            the script also reports the loops on this plant.
        """
        return design_script(self, str(plant))


def _at_plant(given: Any, side: str, names: tuple[str, ...], prefix: str) -> tuple[str, ...]:
    """Return the channels at the plant of a transformation that may be a matrix or none."""
    if isinstance(given, StateSpace):
        return tuple(getattr(given, side))
    if given is None:
        return names if prefix == "y" else tuple(f"u{i}" for i in range(1, len(names) + 1))
    shape = real_array(given, "a transformation").shape
    count = shape[0 if prefix == "u" else -1]
    return tuple(f"{prefix}{i}" for i in range(1, count + 1))


def _free_axes(frf: Frf) -> int:
    """Return how many axes of a measured plant fall with slope 2 at their lowest lines."""
    from ...lti.measured_lines import low_slope

    axes = range(len(frf.outputs) if frf.freq.size >= 5 else 0)
    return sum(low_slope(frf.freq, frf.data[i : i + 1, i : i + 1]) > 1.0 for i in axes)


def _digest(plant: Any) -> str:
    """Return a digest of the numbers of a plant; none of what has no numbers."""
    try:
        return fingerprint([getattr(plant, "nominal", plant)])[:16]
    except (AssumptionError, ModelError):
        return ""


def design_script(design: Any, plant: str = "") -> str:
    """Return the script; `plant` is the line that makes the plant."""
    axes = list(design.axes.items())
    used = {type(e).__name__ for _, axis in axes for e in axis.elements}
    names = sorted({"LoopDesign", "ShapedAxis", *used})
    rows = [f"    {name!r}: {_call(axis, 1)}," for name, axis in axes]
    given = {f.name: getattr(design, f.name) for f in fields(design)}
    others = [
        f"    {key}={literal(value)},"
        for key, value in given.items()
        if key != "axes" and value not in ({}, "")
    ]
    array = any("np." in row for row in (*rows, *others))
    lines = ['"""Loops shaped by hand: made again by this script, to the last digit."""', ""]
    lines += ["import numpy as np", ""] if array else []
    lines += ["import flexplant as fx", f"from flexplant.synthesis import {', '.join(names)}", ""]
    lines += ["axes = {", *rows, "}"]
    lines += ["design = LoopDesign(", "    axes,", *others, ")"]
    lines += ["controller = design.controller()  # y (and references) -> u", ""]
    if plant:
        lines += [plant, "print(design.loops(plant))"]
    else:
        lines += ["# plant = fx.load(...)  # what it was made on", "# print(design.loops(plant))"]
    return "\n".join(lines) + "\n"


def literal(value: Any) -> str:
    """Return an expression for a value of a design."""
    if isinstance(value, Value):
        return _call(value, 0)
    if isinstance(value, np.ndarray):
        if not value.size:
            return f"np.zeros({value.shape})"
        return f"np.array({value.tolist()!r})"
    if isinstance(value, np.generic):
        return repr(value.item())
    if isinstance(value, tuple | list):
        return f"[{', '.join(literal(one) for one in value)}]"
    if hasattr(value, "items"):
        return f"{{{', '.join(f'{k!r}: {literal(v)}' for k, v in value.items())}}}"
    return repr(value)


def _call(value: Value, depth: int) -> str:
    """Return the constructor's call of a value, with what is not its default."""
    kind = type(value).__name__
    name = f"fx.{kind}" if isinstance(value, StateSpace) else kind
    parts = [f"{key}={literal(one)}" for key, one in _fields_given(value)]
    if not depth:
        return f"{name}({', '.join(parts)})"
    elements = getattr(value, "elements", ())
    inner = "".join(f"\n            {_call(one, 0)}," for one in elements)
    listed = f"[{inner}\n        ]" if elements else "[]"
    rest = [part for part in parts if not part.startswith("elements=")]
    return f"{name}(\n        {', '.join([listed, *rest])},\n    )"


def _fields_given(value: Value) -> Iterable[tuple[str, Any]]:
    for one in fields(value):  # type: ignore[arg-type]
        item = getattr(value, one.name)
        if one.name == "on" and all(item):
            continue
        empty = item is None or (not isinstance(item, np.ndarray) and item in ((), {}, ""))
        if not empty and not (isinstance(item, float | int | bool) and item == one.default):
            yield one.name, item
