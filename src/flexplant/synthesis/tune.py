"""tune_loops: for each decoupled axis the law of highest bandwidth that keeps a modulus margin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import ModelError, SolverError
from ..loop import report_loops
from ..loop.nyquist import continued, nyquist_count
from ..lti.frequency import Frf, frequency_response
from ..lti.grid import resonance_grid
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant
from ..progress import Progress
from ..values import ComplexArray, FloatArray, positive, whole
from .law import Law
from .loop_design import LoopDesign, axes_controller, axes_of, made
from .servo_axis import Axis
from .servo_loop import TARGET, ServoLoop, highest

#: shapes that are tried one after the other: factor of the lead, roll-off beside the bandwidth
_SHAPES = ((4.0, 8.0), (3.0, None), (6.0, None), (None, 4.0), (None, 16.0))
#: corner of the integrator beside the bandwidth
_INTEGRATOR = 0.1
#: bandwidths that are tried for each, and steps of 3 % down while the axes disturb each other
_TRIALS, _STEPS = 20, 20
#: resonances that may be notched, and how far they rise above the line of the rigid body
_RESONANCES, _RISE = 12, 2.0
#: distance of a pole from zero frequency, beside the farthest, that counts as none
_ZERO = 1e-6


@one_thread()
def tune_loops(
    plant: StandardPlant | System | Frf,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
    peak: float = TARGET,
    rigid: int | None = None,
    larger: Any = None,
    progress: bool | None = None,
) -> LoopDesign:
    """Return the laws of highest bandwidth that keep |S| of each axis below a peak.

    Each axis gets ``k (1 + w_i / s) (1 + r s / w_b) / (1 + s / (r w_b)) F(s)`` as `design_servo`
    does, with notches at resonances where they serve. For several r and corners of the low-pass
    the bandwidth w_b, near which the loop first crosses 1, is raised until |S| reaches the peak or
    the loop is no longer stable (by the Nyquist count); at most to the first resonance, 0.19 of the
    rate or a quarter of the highest line. No model is needed: the plant may be an Frf.

    Parameters
    ----------
    plant, before, after, rate, delay, hold
        As for `design_loops`.
    peak : float
        Bound on |S|; 2 is a modulus margin of 6 dB.
    rigid : int, optional
        Rigid-body modes that the axes show; unless given as many as axes, of a model those that it
        has. 0 on springs whose modes lie within the lines.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes left out, for the check of a StandardPlant as for `larger_plant`.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    LoopDesign
        Verified in all axes together, each broken with the others closed.

    Raises
    ------
    SolverError
        When no bandwidth within the lines holds the peak, with the axis; or when the axes disturb
        each other too much.
    ModelError, ShapeError, LabelError, AssumptionError
        As for `design_loops`; ModelError when peak is not above 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=2)
    >>> design = fx.tune_loops(plant)
    >>> design.report.is_stable
    True
    """
    if positive(peak, "peak") <= 1.0:
        raise ModelError(f"peak must be above 1, got {peak:g}: no loop keeps |S| below 1. Try 2.")
    axes = axes_of(plant, before, after, rate, delay, hold)
    measured = isinstance(axes.plant, Frf)
    if rigid is None:
        rigid = len(axes.names) if measured else _free_modes(axes.plant)
    rigid = whole(rigid, "rigid", minimum=0)
    frf = axes.plant if measured else _response(axes.plant)
    found = {}
    with Progress(len(axes.names), "axes", progress=progress) as bar:
        for i, name in enumerate(axes.names):
            axis = _Axis(name, frf.freq, frf.data[i, i], axes.rate, peak, rigid > 0)
            found[name] = axis.best()
            bar.advance()
    for step in range(_STEPS):
        laws = {name: one.law(one.bandwidth * 0.97**step) for name, one in found.items()}
        report = report_loops((axes.plant, axes_controller(axes, laws)), at="y", rigid=rigid)
        if report.is_stable and all(one.modulus_margin >= 1.0 / peak for one in report.loops):
            design = made(axes, laws, rigid, 0, None, larger)
            ended = [one.ended for one in found.values() if one.bandwidth >= 0.95 * one.top]
            return design.replace(notes=(*design.notes, *ended))
    slower = 100.0 * (1.0 - 0.97**_STEPS)
    raise SolverError(
        f"each axis alone holds |S| below {peak:g}, all together do not, even {slower:.0f} % "
        f"slower: {report.reason or 'they disturb each other'}. Decouple the axes better "
        "(before=, after=), or close them one after the other with design_loops."
    )


@dataclass(frozen=True)
class _Axis:
    """One axis of the plant; of its law the bandwidth, the lead's factor, roll-off by bandwidth."""

    name: str
    freq: FloatArray
    G: ComplexArray
    rate: float
    peak: float
    free: bool
    lead: float = 4.0
    rolloff: float = 8.0
    bandwidth: float = 0.0

    @cached_property
    def top(self) -> float:
        """The highest bandwidth [Hz]: the line of the rigid body ends at the first resonance."""
        ends = [0.25 * self.freq[-1], *self._resonances, *([0.19 * self.rate] if self.rate else [])]
        return float(min(ends))

    @property
    def ended(self) -> str:
        """A note for a bandwidth that the top ends, not the peak."""
        return (
            f"{self.name}: not |S| but the first resonance, the rate or the last line "
            f"({self.freq[-1]:.4g} Hz) ended the search, at {self.top:.4g} Hz"
        )

    def best(self) -> _Axis:
        """Return the axis with the shape and bandwidth that hold the peak.

        Raises
        ------
        SolverError
            When none does.
        """
        top, low = self.top, max(4.0 * float(self.freq[0]), 3.0 * self._suspension)
        best = replace(self, bandwidth=low)
        for lead, rolloff in _SHAPES:
            one = replace(best, lead=lead or best.lead, rolloff=rolloff or best.rolloff)
            trials = np.geomspace(top, best.bandwidth, _TRIALS) if top > low else np.zeros(0)
            reached = highest(trials[:-1].tolist(), one.holds)
            if reached is not None:
                best = replace(one, bandwidth=reached)
        if best.bandwidth > low:
            return best
        if self.free:
            need = (
                "a rigid body, its motion per force, at the lowest lines. Give rigid=0 when it is"
            )
            need += " on springs"
        else:
            need = f"a mass above its springs' mode, taken to be at {self._suspension:.4g} Hz. Give"
            need += " rigid= when the body is free"
        reach = f"from {low:.3g} to {top:.3g} Hz" if top > low else f"above {low:.3g} Hz"
        raise SolverError(
            f"axis {self.name!r}: no bandwidth {reach} is stable with |S| below "
            f"{20 * np.log10(self.peak):.2g} dB. The axis has to be {need}; raise the rate, lower "
            "the delay, or measure at lower frequencies."
        )

    def holds(self, bandwidth: float) -> bool:
        """Return whether a bandwidth keeps the peak, with the notches that serve it."""
        inertia, late = self._line(bandwidth)
        axis = self._plain(bandwidth)
        if not inertia or _rigid_peak(axis, late) > self.peak:
            return False
        loop = ServoLoop(self.freq, inertia * self.G[:, None, None], self._resonances)
        axis = loop.notched(axis, lambda one: self._is_stable(one, inertia))
        return loop.peak(axis) <= self.peak and self._is_stable(axis, inertia)

    def law(self, bandwidth: float) -> Law:
        """Return the law of a bandwidth [Hz]."""
        inertia, _ = self._line(bandwidth)
        loop = ServoLoop(self.freq, inertia * self.G[:, None, None], self._resonances)
        axis = loop.notched(self._plain(bandwidth), lambda one: self._is_stable(one, inertia))
        return axis.law * inertia

    def _plain(self, bandwidth: float) -> Axis:
        rolloff = self.rolloff * bandwidth
        rolloff = min(rolloff, 0.4 * self.rate) if self.rate else rolloff
        slow = _INTEGRATOR * bandwidth
        return Axis(bandwidth, rolloff, slow, (), self.rate, self.lead, prewarped=True)

    def _line(self, bandwidth: float) -> tuple[float, float]:
        """Return the inertia, with its sign, and the lateness [s] of the lines below a bandwidth.

        ``G = exp(-s late) / (inertia s^2)`` there; 0 without a line.
        """
        near = (self.freq >= 0.25 * bandwidth) & (self.freq <= bandwidth)
        if not np.any(near):
            return 0.0, 0.0
        omega = 2.0 * np.pi * self.freq[near]
        turned = -self.G[near] * omega**2
        sign = 1.0 if np.median(turned.real) >= 0.0 else -1.0
        late = float(np.median(-np.angle(sign * turned) / omega))
        return sign / float(np.median(np.abs(turned))), max(late, 0.0)

    @cached_property
    def _peaks(self) -> FloatArray:
        """The frequencies [Hz] of the highest peaks above the line of the rigid body."""
        size = np.abs(self.G) * self.freq**2
        inner = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])
        peaks = 1 + np.flatnonzero(inner & (size[1:-1] > _RISE * np.median(size)))
        if self.rate:
            peaks = peaks[self.freq[peaks] < 0.45 * self.rate]
        order = np.argsort(-np.abs(self.G[peaks]), kind="stable")[:_RESONANCES]
        return self.freq[peaks[order]]

    @property
    def _suspension(self) -> float:
        """The frequency [Hz] of the springs that hold the body; 0 when free."""
        return 0.0 if self.free else float(self._peaks.min(initial=self.freq[-1]))

    @property
    def _resonances(self) -> FloatArray:
        return self._peaks[self._peaks > self._suspension]

    def _is_stable(self, axis: Axis, inertia: float) -> bool:
        def respond(freq: FloatArray) -> ComplexArray:
            return -inertia * axis.response(freq)[None, None]

        slope = 2 if self.free else 0
        freq, L = continued(self.freq, self.G[None, None], respond, slope)
        return nyquist_count(freq, L, at_zero=slope + 1, unstable=0).unstable == 0


def _rigid_peak(axis: Axis, late: float) -> float:
    """Return max |S| of the rigid body alone, with its lateness."""
    top = 0.49 * axis.rate if axis.rate else 1e2 * axis.bandwidth
    freq = np.geomspace(1e-2 * axis.bandwidth, top, 300)
    s = 2j * np.pi * freq
    return float(np.max(1.0 / np.abs(1.0 + axis.response(freq) * np.exp(-s * late) / s**2)))


def _free_modes(plant: StateSpace) -> int:
    """Return the number of rigid-body modes: half the poles at zero frequency."""
    distance = np.abs(plant.poles() - (1.0 if plant.dt else 0.0))
    return int(np.count_nonzero(distance <= _ZERO * np.max(distance, initial=0.0))) // 2


def _response(plant: StateSpace) -> Frf:
    """Return the response over a grid through the resonances of a model."""
    grid = resonance_grid(plant.poles(), plant.dt, points=1000)
    return frequency_response(plant, grid[grid < 0.4999 / plant.dt] if plant.dt else grid)
