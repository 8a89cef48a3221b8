"""Figures of a loop on the machines that its plant may be, and their intervals."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..lti.frequency_sweep import crossings
from ..plant.machine_plants import FigureInterval, PlantMachines, interval, interval_text
from ..tolerances import INTERVAL
from ..words import one_of
from .broken import axis_sensitivities, moved_poles

#: figures that have an interval in the repr of a loop
MARGIN, BANDWIDTH, RADIUS = FIGURES = ("modulus margin", "bandwidth", "spectral radius")


class MachineLoops:
    """One controller around each of the machines ``plant.machines``; figures are cached."""

    def __init__(self, loop: Any, machines: PlantMachines) -> None:
        self.machines = machines
        near = loop.completed or loop
        self.loops = [loop_beside(near, loop.plant.around(plant)) for plant in machines.plants]
        self._found: dict[Any, FloatArray] = {}

    @property
    def unstable(self) -> int:
        """Number of machines on which the loop is not stable."""
        return sum(not loop.is_stable for loop in self.loops)

    def values(self, figure: str | Callable[[Any], float]) -> FloatArray:
        """Return a figure, the rms of a channel, or a function of the loop on each machine."""
        if figure not in self._found:
            self._found[figure] = np.array([_figure(loop, figure) for loop in self.loops])
        return self._found[figure]


def loop_beside(known: Any, plant: Any) -> Any:
    """Return the loop of a controller around a machine, its poles from a like one's if proven."""
    loop = known.around(plant)
    poles = moved_poles(known, loop)
    if poles is not None:
        loop.__dict__["_poles"] = poles
    return loop


def first_crossing(
    freq: FloatArray, size: FloatArray, find: Callable[[FloatArray], FloatArray] | None
) -> float:
    """Return the frequency [Hz] at which a size first rises to 1, infinite if it stays below."""
    # by interpolation between two points where possible
    beyond = np.flatnonzero((size >= 1.0) & np.logical_or.accumulate(size < 1.0))
    if not beyond.size:
        return float("inf")
    pair, found = slice(beyond[0] - 1, beyond[0] + 1), freq[beyond[:1]]
    if find is not None:
        between = crossings(lambda f: find(f) - 1.0, freq[pair], size[pair] - 1.0)
        found = np.append(between, found)
    return float(found[0])


def crossing(loop: Any, reference: str, error: str, curve: tuple[FloatArray, FloatArray]) -> float:
    """Return the frequency [Hz] at which |S| first crosses 1 from below; 0 if never below."""
    gain = loop.gain(reference, error)
    below = np.any(curve[1] < 1.0)
    return first_crossing(*curve, lambda freq: np.abs(gain(freq)[0, 0])) if below else 0.0


def axis_bandwidths(loop: Any) -> dict[str, float]:
    """Return where |S| of each reference first crosses 1 from below [Hz], 0 if never below."""
    return {
        f"{axis}:ref": crossing(loop, f"{axis}:ref", f"{axis}:error", curve)
        for axis, curve in axis_sensitivities(loop).items()
    }


def _figure(loop: Any, figure: str | Callable[[Any], float]) -> float:
    if not isinstance(figure, str):
        return float(figure(loop))
    if figure == BANDWIDTH:
        return min(axis_bandwidths(loop).values())
    if figure == RADIUS:  # the distance to the circle is log-normal, not the radius
        return 1.0 - float(loop.spectral_radius)
    return float(loop.modulus_margin if figure == MARGIN else loop.drawn_rms(figure))


def loop_interval(
    loop: Any, figure: str | Callable[[Any], float], level: float, unit: str = ""
) -> FigureInterval:
    """Return the interval of a figure or a channel's rms; see `ClosedLoop.interval`."""
    known = loop.plant.machine.machines
    if isinstance(figure, str):
        figure = one_of(figure, "figure", (*FIGURES, *loop.monitored.outputs))
    if known is None or known.missing:
        return interval(known, lambda: np.zeros(0), level, "")
    loops = loop.on_machines
    if loops.unstable:
        return FigureInterval(
            None, None, f"unstable on {loops.unstable} of {len(loops.loops)} such machines"
        )
    if figure == BANDWIDTH and not axis_sensitivities(loop):
        return FigureInterval(None, None, "no interval: the loop has no reference")
    if isinstance(figure, str):
        unit = "Hz" if figure == BANDWIDTH else loop.units.get(figure, "")
    given = "" if callable(figure) or figure in FIGURES else known.densities
    own = None
    if isinstance(figure, str) and loop.is_stable:  # a figure of the loop is verified
        own = _figure(loop, figure) if figure in FIGURES else loop.rms(figure)
    found = interval(known, partial(loops.values, figure), level, unit, given, own)
    if figure != RADIUS or found.low is None or found.high is None:
        return found
    low, high = 1.0 - found.high, 1.0 - found.low
    return FigureInterval(
        low, high, f"{low:.6f} to {high:.6f} on {100 * level:.3g} % of such machines"
    )


def interval_line(loop: Any) -> str:
    """Return the line of a loop's repr: intervals of all figures, or the reason without them."""
    known = loop.plant.machine.machines
    if known is None:
        return ""
    found = {figure: loop_interval(loop, figure, INTERVAL) for figure in FIGURES}
    if found[MARGIN].low is None:
        return found[MARGIN].sentence
    parts = []
    for figure, one in found.items():
        if one.low is not None and one.high is not None:
            ends = (
                f"{one.low:.6f} to {one.high:.6f}"
                if figure == RADIUS
                else interval_text(one.low, one.high, "Hz" if figure == BANDWIDTH else "")
            )
            parts.append(f"{figure} {ends}")
    return f"on {100 * INTERVAL:.3g} % of such machines:\n    " + ", ".join(parts)
