"""BenchMachine: a plant on the bench, in the axes of a design, with what is known of its lines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..checks import ComplexArray, FloatArray
from ..lti.frequency import Frf
from ..lti.frequency_sweep import resonance_grid
from ..lti.measured_lines import on_lines
from ..lti.responses import Responder, responder
from ..synthesis import LoopDesign
from ..synthesis.laws.axis_law import MeasuredAxis
from ..synthesis.laws.loop_design import Axes

#: standard deviations of a line that the band around it shows
DEVIATIONS = 2.0
#: change from a peak to its neighbour, beside the peak, above which fewer than four lines lie
#: within the half-power width of a mode
_STEP = 0.5
#: logarithmic part of the frequencies at which a model is drawn
_POINTS = 600


@dataclass(frozen=True, eq=False)
class BenchMachine:
    """One plant in its axes; `given` is the plant as it came."""

    name: str
    given: Any
    axes: Axes

    @classmethod
    def on(cls, plant: Any, design: LoopDesign, name: str) -> BenchMachine:
        """Return a plant in the axes of a design."""
        return cls(name, plant, design.placed(plant))

    @property
    def is_measured(self) -> bool:
        """Whether it is known by lines alone."""
        return isinstance(self.axes.plant, Frf)

    @cached_property
    def respond(self) -> Responder:
        """The response (n, n, k) of the axes at frequencies [Hz], between lines as they show it."""
        if not self.is_measured:
            return responder(self.axes.plant)
        lines, data = self.axes.plant.freq, self.axes.plant.data
        return lambda freq: on_lines(lines, data, freq)

    @cached_property
    def freq(self) -> FloatArray:
        """Where it is drawn [Hz]: its lines, or through the resonances of a model."""
        if self.is_measured:
            return np.asarray(self.axes.plant.freq)
        grid = resonance_grid(self.axes.plant.poles(), self.axes.plant.dt, points=_POINTS)
        return np.asarray(grid[grid > 1e-5 * grid[-1]])

    @cached_property
    def G(self) -> ComplexArray:
        """The response there (n, n, n_freq)."""
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
