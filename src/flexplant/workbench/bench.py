"""Bench: the plant, its model and its fleet, shared by all tabs; a tab's designs."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ..errors import ModelError, counted
from ..lti.frequency import Frf
from ..plant import AnyPlant
from ..simulation.motion import SetPointProfile
from ..synthesis import LoopDesign, LowPass, Pid, ShapedAxis
from ..synthesis.laws.axis_law import MeasuredAxis
from .consequences import Question
from .evaluation import BenchMachine
from .verdict import LoopLimits

#: designs that are kept
_MOST = 400


class DesignHistory:
    """The successive designs of a tab, for undo and redo."""

    def __init__(self, first: LoopDesign) -> None:
        self._designs = [first]
        self._at = 0
        self._key: Hashable = None

    @property
    def now(self) -> LoopDesign:
        """The present design."""
        return self._designs[self._at]

    def add(self, design: LoopDesign, key: Hashable = None) -> None:
        """Add a design; of changes with the same key (not None) only the last is kept."""
        if key is not None and key == self._key and self._at == len(self._designs) - 1 and self._at:
            self._designs[self._at] = design
            return
        self._designs = [*self._designs[: self._at + 1], design][-_MOST:]
        self._at = len(self._designs) - 1
        self._key = key

    def back(self) -> LoopDesign:
        """Go back to the previous design and return it; the first design stays."""
        self._at, self._key = max(0, self._at - 1), None
        return self.now

    def forward(self) -> LoopDesign:
        """Go forward to the next design and return it; the last design stays."""
        self._at, self._key = min(len(self._designs) - 1, self._at + 1), None
        return self.now


#: first crossover relative to the lowest resonance, and to the first line; its low-pass relative
#: to it; loop gain at resonances that is small; times that the crossover is lowered until it is
_BELOW, _ABOVE, _ROLL, _QUIET, _TRIES = 0.12, 10.0, 8.0, 0.4, 12
#: first crossover of velocities relative to the springs; factor over which a slope is taken; where
#: a loop of the first power is small, relative to its crossover
_OVER, _BESIDE, _BEYOND = 3.0, 1.25, 3.0


class Bench:
    """Machines and design of a page, shared by all tabs; the first machine is the nominal one."""

    def __init__(
        self,
        machines: Mapping[str, Any],
        design: LoopDesign,
        model: Any = None,
        channel: str | None = None,
        move: SetPointProfile | None = None,
        limits: LoopLimits | None = None,
        source: str = "",
    ) -> None:
        self.source = source
        #: design that was shown last in any tab
        self.design = design
        self.start = design
        self.limits = limits or LoopLimits()
        self.machines = [BenchMachine.on(one, design, name) for name, one in machines.items()]
        self.channel, self.move = channel, move
        nominal = self.machines[0]
        if model is not None:
            self.model: BenchMachine | None = BenchMachine.on(model, design, "model")
        else:
            self.model = None if nominal.is_measured else nominal

    @classmethod
    def of(cls, plant: Any, design: LoopDesign | None, options: Mapping[str, Any]) -> Self:
        """Return the machines and the first design of a page, from the arguments of `open_page`."""
        machines = _machines_by_name(plant)
        names = ("before", "after", "rate", "delay", "hold", "rigid", "unstable", "references")
        given = {n: options[n] for n in names if options.get(n) is not None}
        model = options.get("model")
        first = next(iter(machines.values()))
        if design is None and isinstance(first, Frf) and model is not None:  # its axes
            given = _of_model(model, given)
        if design is None:
            design = started(LoopDesign.on(first, **given), first)
        elif given:
            raise ModelError(
                f"{', '.join(given)} are in the design already: leave them out, or the design."
            )
        followed = _references(first if model is None else model, design)
        if not design.references and followed:
            design = design.replace(references=followed)
        kept = {n: options.get(n) for n in ("channel", "move", "limits")}
        return cls(machines, design, model, source=str(options.get("source") or ""), **kept)

    @cached_property
    def question(self) -> Question:
        """Machine, model, channel and move for which errors and truncated modes are computed."""
        return Question(self.machines[0], self.model, self.channel, self.move)

    def question_of(self, index: int) -> Question:
        """Return the same as `question` for the machine with the given index."""
        machine = self.machines[index]
        model = self.model if machine.is_measured or self.model is not self.machines[0] else machine
        return replace(self.question, machine=machine, model=model)

    @property
    def top(self) -> float:
        """Highest frequency [Hz] to which a slider of the page can be set."""
        last = float(self.machines[0].freq[-1])
        return min(last, 0.499 * self.start.rate) if self.start.rate else last

    def __repr__(self) -> str:
        fleet = f", {counted(len(self.machines), 'machine')}" if len(self.machines) > 1 else ""
        model = ", with a model" if self.model and self.machines[0].is_measured else ""
        plant = f"{self.design.made_on or 'a plant'}{model}{fleet}"
        return f"<{type(self).__name__} of {plant}>\n{self.design!r}"


def _machines_by_name(plant: Any) -> dict[str, Any]:
    """Return machines by name, the nominal one first."""
    if isinstance(plant, Mapping) and not isinstance(plant, Frf):
        found = {str(name): one for name, one in plant.items()}
    elif isinstance(plant, Iterable) and not isinstance(plant, Frf | str | bytes):
        found = {f"machine {i}": one for i, one in enumerate(plant, 1)}
    else:
        found = {"machine 1": plant}
    if not found:
        raise ModelError("the workbench needs a plant, got none. Pass an Frf or a StandardPlant.")
    return found


def _of_model(model: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of a measured plant, decoupled and sampled as its model."""
    own = LoopDesign.on(model)
    found: dict[str, Any] = {"rate": own.rate or None}
    if "before" not in given and "after" not in given:
        found |= {"before": own.before, "after": own.after}
    return {**found, **given}


def _references(plant: Any, design: LoopDesign) -> dict[str, str]:
    """Return the reference of a plant that each axis follows."""
    plant = getattr(plant, "nominal", plant)
    if not isinstance(plant, AnyPlant):
        return {}
    plant = plant.machine
    found = {poi.channel(axis): poi.derived(axis, "ref") for poi, axis in plant.ports.followed}
    return {n: ref for n, ref in found.items() if n in design.axes and ref in plant.y}


def started(design: LoopDesign, plant: Any) -> LoopDesign:
    """Return a design with a first law in each axis."""
    machine = BenchMachine.on(plant, design, "")
    axes = {name: first_axis(machine, i, design) for i, name in enumerate(design.axes)}
    return design.replace(axes=axes)


def first_axis(machine: BenchMachine, index: int, design: LoopDesign) -> ShapedAxis:
    """Return a first law of an axis: its loop gain is small at the resonances."""
    G = machine.G[index, index]
    measured = MeasuredAxis("", machine.freq, G, design.rate, True)
    if machine.freq.size < 5:
        return ShapedAxis()
    first, low = float(measured.resonances.min(initial=measured.ceiling)), float(machine.freq[0])
    cross = max(_BELOW * first, min(_ABOVE * low, 0.3 * first))
    least = 4.0 * low
    if _line(machine, index, cross) < 0:  # velocities of a body on springs: that of a mass is above
        cross, least = min(_OVER * first, measured.ceiling / _ROLL), 0.5 * _OVER * first
    for _ in range(_TRIES):
        axis = crossing_axis(machine, index, design, cross)
        beyond = machine.freq > _BEYOND * cross
        L = axis.law.replace(rate=design.rate).at(machine.freq) * G
        if np.abs(L[beyond]).max(initial=0.0) < _QUIET or cross < least:
            break
        cross *= 0.8
    return axis


def crossing_axis(
    machine: BenchMachine, index: int, design: LoopDesign, cross: float
) -> ShapedAxis:
    """Return the law and low-pass for a crossover [Hz], by the line and sign of the plant there."""
    cross = float(f"{cross:.3g}")
    top = 0.95 * (min(machine.freq[-1], 0.45 * design.rate) if design.rate else machine.freq[-1])
    line = _line(machine, index, cross)
    pid = Pid.corners(1.0, integrator=cross / 6.0, zero=cross / 3.0, pole=min(3.0 * cross, top))
    # velocities say nothing of rest, which an integrator would look for
    action = {2: (pid,), 0: (Pid(0.0, i=1.0),)}
    axis = ShapedAxis((*action.get(line, ()), LowPass(min(_ROLL * cross, top))))
    there = np.array([cross])
    G = complex(machine.respond(there)[index, index][0])
    gain = 1.0 / abs(complex(axis.law.replace(rate=design.rate).at(there)[0]) * G)
    right = (G * 1j**line).real > 0.0  # each power of 1 / s turns back a quarter
    return axis.replace(gain=float(f"{gain if right else -gain:.6g}"))


def _line(machine: BenchMachine, index: int, freq: float) -> int:
    """Return the power of 1 / s of an axis at a frequency [Hz]: 2 of a mass, 0 of a spring."""
    near = np.clip([freq / _BESIDE, freq * _BESIDE], machine.freq[0], machine.freq[-1])
    size = np.abs(machine.respond(near)[index, index])
    slope = -np.diff(np.log(size))[0] / np.diff(np.log(near))[0]
    return int(np.clip(np.round(slope), -1, 2))
