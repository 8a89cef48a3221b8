"""tune_loops: laws of decoupled axes, of the highest bandwidth that keeps a modulus margin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...checks import FloatArray, between, whole
from ...errors import SolverError, warn
from ...loop import in_axes
from ...lti.frequency import Frf
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import series
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import Progress, one_thread
from ...plant import StandardPlant, larger_plant
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from .axis_law import AxisLaw, FoundLaw, LawSearch, MeasuredAxis
from .joint_search import JointLaws, JointPlant, JointSearch, Worst
from .loop_design import Axes, DesignedLoops, axes_of, made
from .servo_loop import TARGET

#: distance of a pole from zero frequency, beside the farthest, that counts as none
_ZERO = 1e-6


@one_thread()
def tune_loops(
    plant: StandardPlant | UncertainPlant[Any] | System | Frf,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
    peak: float = TARGET,
    rigid: int | None = None,
    notches: int = 3,
    larger: Any = None,
    progress: bool | None = None,
) -> DesignedLoops:
    """Return the laws of highest bandwidth that keep |S| below a peak, all axes together.

    Give a plant or a measured FRF: ``design = fx.tune_loops(frf, rate=10e3)``. `design.laws`
    holds a law of each axis (PID, low-pass and notches), `design.report` its margins,
    `design.system` is what `close_loop` takes and `write_c` exports. With several axes
    ``before=`` and ``after=`` decouple them, as `decouple` finds. Lines that do not resolve a
    resonance, and their variance, are on the safe side: the loop gain is kept small there. The
    best of many starts is returned, without proof that no other law does better, and with a
    warning where the peak is not kept. How: `algorithms`.

    Parameters
    ----------
    plant, before, after, rate, delay, hold
        As for `design_loops`.
    peak : float
        Bound on |S|, at u, at y and of each axis; 2 is a modulus margin of 6 dB.
    rigid : int, optional
        Rigid-body modes that the axes show; unless given as many as axes, of a model those that it
        has. 0 on springs whose modes lie within the lines.
    notches : int
        At most so many for each axis; one has to raise the bandwidth by 2 %.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes left out, as for `larger_plant`, of a StandardPlant: the peak holds
        there too. Unless given, with those that the plant's reduced model still has.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    DesignedLoops
        Verified in all axes together, each broken with the others closed.

    Raises
    ------
    SolverError
        When no bandwidth within the lines holds the peak, with the axis; or when no laws that were
        found are stable together.
    ModelError, ShapeError, LabelError, AssumptionError
        As for `design_loops`; ModelError when peak is not above 1.

    Warns
    -----
    FlexplantWarning
        When the peak was not reached: the largest |S|, where, and at which frequency. The note is
        in `notes` too.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=2)
    >>> design = fx.tune_loops(plant)
    >>> design.report.is_stable
    True
    """
    peak = between(peak, "peak", 1.0, float("inf"), "No loop keeps |S| below 1: try 2.")
    axes = axes_of(plant, before, after, rate, delay, hold)
    measured = isinstance(axes.plant, Frf)
    if rigid is None:
        rigid = len(axes.names) if measured else _free_modes(axes.plant)
    rigid = whole(rigid, "rigid", minimum=0)
    most = whole(notches, "notches", minimum=0)
    plants = _joint_plants(plant, axes, rigid, larger, {"rate": rate, "delay": delay, "hold": hold})
    tuner = _Tuner(axes, _axes_response(plants[-1], axes), float(peak), rigid, most)
    with Progress(len(axes.names), "axes", progress=progress) as bar:
        alone = tuner.each_alone(bar)
    reached = _together(alone, plants, float(peak))
    laws = dict(zip(axes.names, reached.laws([law for law, _ in alone]), strict=True))
    design = made(axes, laws, rigid, 0, None, larger)
    notes = [
        note for (law, _), x in zip(alone, reached.numbers, strict=True) for note in law.notes(x)
    ]
    if reached.worst.size > peak:
        notes.append(_missed(reached.worst, float(peak)))
        warn(notes[-1])
    return design.replace(notes=(*design.notes, *notes))


def _together(
    alone: Sequence[tuple[AxisLaw, FoundLaw]], plants: Sequence[JointPlant], peak: float
) -> JointLaws:
    """Return laws that hold the peak together, or come closest to it."""
    of = [law for law, _ in alone]
    search = JointSearch(of, plants, peak, [one.numbers for _, one in alone])
    found = search.best()
    if found is None:
        raise SolverError(
            f"each axis alone holds |S| below {peak:g}, but all together are unstable at every "
            f"bandwidth down to {', '.join(f'{law.lowest:.3g}' for law in of)} Hz. Decouple the "
            "axes better (before=, after=), or close them one after the other with design_loops."
        )
    return found


def _missed(worst: Worst, peak: float) -> str:
    return (
        f"|S| below {20.0 * np.log10(peak):.3g} dB was not reached: |S| {worst.place} is "
        f"{20.0 * np.log10(worst.size):.3g} dB at {worst.freq:.4g} Hz, which ended the search. "
        "Allow a higher peak, decouple the axes better (before=, after=), or move actuators or "
        "sensors to where they excite or see less of what resonates there"
    )


@dataclass(frozen=True)
class _Tuner:
    """The axes of a plant, each with its response."""

    axes: Axes
    frf: Frf
    peak: float
    rigid: int
    notches: int

    def each_alone(self, bar: Progress) -> list[tuple[AxisLaw, FoundLaw]]:
        """Return the best law of each axis, the others open."""
        found = []
        for i in range(len(self.axes.names)):
            law = AxisLaw(self._axis(i), self.peak)
            found.append((law, LawSearch(law, self.notches).best()))
            bar.advance()
        return found

    def _axis(self, i: int) -> MeasuredAxis:
        variance = None if self.frf.variance is None else self.frf.variance[i, i]
        G, free = self.frf.data[i, i], self.rigid > 0
        return MeasuredAxis(self.axes.names[i], self.frf.freq, G, self.axes.rate, free, variance)


def _joint_plants(
    plant: Any, axes: Axes, rigid: int, larger: Any, measured: Mapping[str, Any]
) -> list[JointPlant]:
    """Return the plant in its own channels, and the one with the modes left out where known."""
    u, y, static = axes.before.outputs, axes.after.inputs, (axes.before.D, axes.after.D)
    if isinstance(axes.plant, Frf):
        given = plant if isinstance(plant, Frf) else Frf.from_control(plant)
        return [JointPlant(in_axes(given.select(y, u), **measured), *static, axes.names, rigid)]
    own = as_statespace(plant if axes.given is None else axes.given.Gyu)
    found = [JointPlant(own.select(y, u), *static, axes.names, rigid)]
    more = None if axes.given is None else larger_plant(axes.given, larger)
    if axes.given is not None and more is not None:
        reading, G = axes.given.origin.reading, more.system.select(more.y, more.u)
        if reading is not None:
            read = [name for name in reading.inputs if name in more.y]
            G = series(G.select(read), reading.select(inputs=read))
        kind = " with the modes left out"
        found.append(JointPlant(G.select(y, u), *static, axes.names, rigid, kind))
    return found


def _free_modes(plant: StateSpace) -> int:
    """Return the number of rigid-body modes: half the poles at zero frequency."""
    distance = np.abs(plant.poles() - (1.0 if plant.dt else 0.0))
    return int(np.count_nonzero(distance <= _ZERO * np.max(distance, initial=0.0))) // 2


def _axes_response(plant: JointPlant, axes: Axes) -> Frf:
    """Return the response in the axes: that measured, or of a model through its resonances."""
    if isinstance(axes.plant, Frf):
        return axes.plant
    assert isinstance(plant.plant, StateSpace)  # noqa: S101 - the axes are of a model
    dt = plant.plant.dt
    grid = resonance_grid(plant.plant.poles(), dt, points=1000)
    freq = grid[grid < 0.4999 / dt] if dt else grid
    data = np.moveaxis(plant.coupling(freq).inner, 0, -1)
    return Frf(freq, data, axes.before.inputs, axes.names, variance=np.zeros(data.shape))
