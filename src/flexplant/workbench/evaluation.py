"""AxisLoop: the loop of one axis of a design on one of the plants."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray
from ..errors import AssumptionError
from ..loop import LoopMargins
from ..loop.broken import BrokenLoop
from ..loop.measured_loop import NyquistCount, broken_count
from ..loop.report import broken_margins
from ..loop.sensitivity_functions import broken_bandwidth
from ..lti.frequency import Frf
from ..lti.frequency_sweep import resonance_grid
from ..lti.interconnection import loop_poles, side_by_side
from ..lti.measured_lines import MeasuredPlant, low_slope
from ..lti.response_solvers import Responder, remembered, responder
from ..synthesis import LoopDesign
from ..synthesis.laws.axis_law import MeasuredAxis
from ..synthesis.laws.law import Law
from ..synthesis.laws.loop_design import Axes

#: change from a peak to its neighbour, relative to the peak, above which fewer than four lines lie
#: within the half-power width of a mode
_STEP = 0.5


@dataclass(frozen=True, eq=False)
class BenchMachine:
    """One plant in the axes of the design; `given` is the plant before this transformation."""

    name: str
    given: Any
    axes: Axes

    @classmethod
    def on(cls, plant: Any, design: LoopDesign, name: str) -> BenchMachine:
        """Return a plant in the axes of a design."""
        return cls(name, plant, design.placed(plant))

    @property
    def is_measured(self) -> bool:
        """Whether the plant is known by measured lines only."""
        return isinstance(self.axes.plant, Frf)

    @cached_property
    def respond(self) -> Responder:
        """The response (n, n, k) of the axes at frequencies [Hz], between measured lines too."""
        if not self.is_measured:
            return responder(self.axes.plant)
        return MeasuredPlant(self.axes.plant.freq, self.axes.plant.data).at

    @cached_property
    def freq(self) -> FloatArray:
        """Frequencies of the curves [Hz]: measured lines, or a grid through resonances."""
        if self.is_measured:
            return np.asarray(self.axes.plant.freq)
        grid = resonance_grid(self.axes.plant.poles(), self.axes.plant.dt)
        return np.asarray(grid[grid > 1e-5 * grid[-1]])  # names of the curves

    @cached_property
    def G(self) -> ComplexArray:
        """The response (n, n, n_freq) at these frequencies."""
        return self.axes.plant.data if self.is_measured else self.respond(self.freq)

    @cached_property
    def deviation(self) -> FloatArray | None:
        """The standard deviation of each line of a measurement that has one."""
        variance = self.axes.plant.variance if self.is_measured else None
        return None if variance is None else np.sqrt(variance)

    def unresolved(self, axis: int) -> npt.NDArray[np.bool_]:
        """Return the lines of an axis at a peak that is narrower than its lines resolve."""
        marked = np.zeros(self.freq.size, dtype=bool)
        if not self.is_measured or self.freq.size < 5:
            return marked
        variance = None if self.deviation is None else self.deviation[axis, axis] ** 2
        G, rate = self.G[axis, axis], self.axes.rate
        found = MeasuredAxis("", self.freq, G, rate, True, variance).resonances
        peak = np.searchsorted(self.freq, found)
        step = np.abs(np.diff(G))
        jump = np.maximum(step[np.minimum(peak, step.size - 1)], step[peak - 1])
        marked[peak[jump > _STEP * np.abs(G[peak])]] = True
        return marked


#: slope at the lowest lines above which an axis is a free body
_FREE = 1.0
#: without a closed loop nothing is unstable
_NONE = NyquistCount(0)


@dataclass(frozen=True, eq=False)
class OthersClosed:
    """The plant of one axis with the loops of all other axes closed."""

    #: response (n_freq,) at the frequencies of the machine, and (1, 1, k) at any
    G: ComplexArray
    respond: Responder
    count: NyquistCount
    closed: tuple[str, ...]
    measured: MeasuredPlant | None


@dataclass(frozen=True, eq=False)
class AxisLoop:
    """The loop of one axis on one machine: ``L = C G``, closed by negative feedback."""

    name: str
    machine: BenchMachine
    others: OthersClosed
    law: Law
    parts: BrokenLoop
    count: NyquistCount

    @cached_property
    def C(self) -> ComplexArray:
        """The response of the control law."""
        return np.asarray(-self.parts.controller(self.freq)[0, 0])

    @cached_property
    def margins(self) -> LoopMargins:
        """Crossovers and margins, each with its frequency."""
        return broken_margins(self.parts, "y")[0]

    @cached_property
    def modulus_margin(self) -> float:
        """The least distance of the loop gain from -1, over the curve and `margins`."""
        return float(np.abs(1.0 - self.parts.gain(self.parts.followed, "y")).min())

    @cached_property
    def bandwidth(self) -> float:
        """Frequency [Hz] at which |S| first crosses 1; NaN where it never does or S is unstable."""
        with suppress(AssumptionError):
            return float("nan") if self.count.unstable else broken_bandwidth(self.parts)
        return float("nan")

    @property
    def freq(self) -> FloatArray:
        """Frequencies [Hz] of the curves."""
        return self.machine.freq

    @property
    def deviation(self) -> FloatArray | None:
        """The standard deviation of each line of the axis, where it is known."""
        i = self.machine.axes.names.index(self.name)
        known = self.machine.deviation
        return None if known is None else known[i, i]

    @cached_property
    def L(self) -> ComplexArray:
        """The loop gain."""
        return self.C * self.others.G

    @cached_property
    def S(self) -> ComplexArray:
        """The sensitivity."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / (1.0 + self.L))

    @property
    def T(self) -> ComplexArray:
        """The complementary sensitivity."""
        return self.L * self.S

    @property
    def KS(self) -> ComplexArray:
        """Response from sensor noise to the command."""
        return self.C * self.S

    @property
    def PS(self) -> ComplexArray:
        """Response from a force in the axis to its motion."""
        return self.others.G * self.S

    @property
    def is_stable(self) -> bool | None:
        """Whether all closed loops together are stable; None where measured lines leave it open."""
        return None if self.count.unstable is None else not self.count.unstable


_Kept: TypeAlias = tuple[BenchMachine, LoopDesign, OthersClosed]


class Evaluator:
    """Evaluates axes of designs on machines; results that no slider changes are kept."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, str], _Kept] = {}
        self._law: Law | None = None

    def loop(self, machine: BenchMachine, design: LoopDesign, name: str) -> AxisLoop:
        """Return the loop of one axis, with the loops of the others on or off as in the design."""
        law, others = design.laws[name], self._with_others(machine, design, name)
        parts = self._broken(machine, design, name, others)
        free = others.measured is not None and others.measured.slope > _FREE
        rigid = int(free and design.rigid > 0)
        count = broken_count(parts, rigid, design.unstable + (others.count.unstable or 0))
        if others.count.unstable is None:  # the count of this axis needs that of the others
            count = NyquistCount(None, f"the other axes: {others.count.reason}")
        elif others.count.narrowest > count.narrowest:
            count = count._replace(narrowest=others.count.narrowest, near=others.count.near)
        return AxisLoop(name, machine, others, law, parts, count)

    def _broken(
        self, machine: BenchMachine, design: LoopDesign, name: str, others: OthersClosed
    ) -> BrokenLoop:
        """Return the loop between law and axis, as `report_loops` takes one apart."""
        laws = design.laws
        law = laws[name]

        @cache  # the grid, the count and the bandwidth need them
        def poles() -> ComplexArray:
            if machine.is_measured:
                return law.system.poles()
            chosen = [n for n in design.axes if n == name or n in others.closed]
            inputs = [machine.axes.before.inputs[list(design.axes).index(n)] for n in chosen]
            each = [(-laws[n].system).replace(dt=machine.axes.plant.dt) for n in chosen]
            K = side_by_side(each, chosen).replace(inputs=chosen, outputs=inputs)
            return loop_poles(machine.axes.plant.select(chosen, inputs), K)

        return BrokenLoop(
            (name,), (name,), self._controller(law), others.respond, poles,
            1.0 / law.rate if law.rate else 0.0, others.measured,
        )  # fmt: skip

    def _controller(self, law: Law) -> Responder:
        """Return minus the response of a law, stored on the lines that machines share."""
        if self._law is not law:
            self._law = law
            self._respond = remembered(lambda freq: -law.at(freq)[None, None])
        return self._respond

    def _with_others(self, machine: BenchMachine, design: LoopDesign, name: str) -> OthersClosed:
        """Return the axis with the others closed; kept until one of them changes."""
        key = id(machine), name
        known = self._kept.get(key)
        if known and known[0] is machine and _same_others(known[1], design, name):
            return known[2]
        found = _closed_around(machine, design, name)
        self._kept[key] = machine, design, found
        return found


def _same_others(one: LoopDesign, two: LoopDesign, name: str) -> bool:
    """Return whether the loops of all axes but one are the same in two designs."""
    pairs = [(axis, two.axes.get(n)) for n, axis in one.axes.items() if n != name]
    alike = all(a is b or (b and not (a.closed or b.closed)) for a, b in pairs)
    return alike and (one.rate, one.rigid) == (two.rate, two.rigid)


def _closed_around(machine: BenchMachine, design: LoopDesign, name: str) -> OthersClosed:
    """Return ``G_aa - G_ao C_o (I + G_oo C_o)^-1 G_oa``, o the other axes that are closed."""
    names = list(design.axes)
    a = names.index(name)
    closed = tuple(n for n in names if n != name and design.axes[n].closed)
    o, laws = [names.index(n) for n in closed], [design.laws[n] for n in closed]

    def reduced(freq: FloatArray, G: ComplexArray) -> ComplexArray:
        if not closed:
            return np.asarray(G[a, a])
        C = np.array([law.at(freq) for law in laws])
        back = np.eye(len(o))[:, :, None] + G[np.ix_(o, o)] * C
        fed = np.linalg.solve(np.moveaxis(back, 2, 0), np.moveaxis(G[np.ix_(o, [a])], 2, 0))
        return np.asarray(G[a, a] - np.einsum("of,fo->f", G[a, o] * C, fed[:, :, 0]))

    G = reduced(machine.freq, machine.G)
    if not machine.is_measured:

        def respond(freq: FloatArray) -> ComplexArray:
            return reduced(freq, machine.respond(freq))[None, None]

        return OthersClosed(G, respond, _NONE, closed, None)
    count = _count_others(machine, design, o, laws) if closed else _NONE
    measured = MeasuredPlant(machine.freq, G[None, None])
    return OthersClosed(G, measured.at, count, closed, measured)


def _count_others(
    machine: BenchMachine, design: LoopDesign, o: list[int], laws: list[Law]
) -> NyquistCount:
    """Return the count of the other axes of a measured plant, this one open."""
    names, n = tuple(list(design.axes)[i] for i in o), len(o)
    chosen = np.ix_(o, o)

    def controller(freq: FloatArray) -> ComplexArray:
        K = np.zeros((n, n, freq.size), dtype=np.complex128)
        K[range(n), range(n)] = [-law.at(freq) for law in laws]
        return K

    poles = np.concatenate([law.system.poles() for law in laws])
    each = [low_slope(machine.freq, machine.G[i : i + 1, i : i + 1]) for i in o]
    rigid = sum(slope > _FREE for slope in each) if design.rigid else 0
    measured = MeasuredPlant(machine.freq, machine.G[chosen])
    parts = BrokenLoop(
        names, names, controller, measured.at, lambda: poles,
        1.0 / design.rate if design.rate else 0.0, measured,
    )  # fmt: skip
    return broken_count(parts, rigid, 0)


def coupling(machine: BenchMachine, design: LoopDesign, name: str) -> dict[str, FloatArray]:
    """Return how the command of an axis moves the others, relative to its own motion."""
    names = list(design.axes)
    a = names.index(name)
    own = np.abs(machine.G[a, a])
    others = (i for i in range(len(names)) if i != a)
    return {names[i]: np.abs(machine.G[i, a]) / own for i in others}
