"""tune_loops: laws of decoupled axes, of the highest bandwidth that keeps a modulus margin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from operator import is_
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray, IntArray, between, whole
from ...errors import SolverError, warn
from ...loop import in_axes
from ...lti.frequency import Frf
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import series
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import Progress, one_thread
from ...plant import AnyPlant
from ...plant.axes import real_gain
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...tolerances import SPLIT
from .axis_law import AxisLaw, MeasuredAxis, linear_step, near_lowest
from .joint_plants import Coupling, JointPlant, Worst
from .law import Law, Pid, tustin_s
from .loop_design import Axes, DesignedLoops, axes_of, made
from .pid_tuning import tune_pid
from .servo_loops import TARGET


@one_thread()
def tune_loops(
    plant: AnyPlant | UncertainPlant[Any] | System | Frf,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
    peak: float = TARGET,
    rigid: int | None = None,
    notches: int = 3,
    progress: bool | None = None,
) -> DesignedLoops:
    """Return the laws of largest bandwidth that keep the sensitivity |S| of all axes below a peak.

    Type ``design = fx.tune_loops(frf, rate=10e3)`` for a measured FRF, or pass a plant.
    `design.laws` holds the law of each axis (PID, low-pass and notches), and `design.report` its
    margins. `close_loop` takes `design.system`, and `write_c` exports it. With ``before=`` and
    ``after=`` several axes are decoupled; `decouple` computes both. If the measured frequencies do
    not resolve a resonance, the loop gain is kept small there. The result is the best of many
    starts, without proof that it is optimal. The page `algorithms` describes the method.

    The law of an axis depends on the slope of its response: that of a mass (-40 dB per decade), of
    a damper (-20 dB) or of a spring (0 dB). A single axis gets the law of `tune_pid` if it is
    unstable or has an odd number of integrators, such as a motor.

    Parameters
    ----------
    plant, before, after, rate, delay, hold : as for `design_loops`
    peak : float
        Upper bound on |S| at u and on |S| of each axis. If each axis has one sensor, it is also an
        upper bound on |S| at y. A peak of 2 (6 dB) is a modulus margin of 0.5.
    rigid : int, optional
        Number of rigid-body modes. By default it is that of the model; for a measured FRF it is the
        number of axes. Give 0 if the machine stands on springs and the measured frequencies include
        those of its suspension modes.
    notches : int
        Largest number of notches of each axis. A notch is used only if it raises the bandwidth by
        at least 2 %.
    progress : bool, optional
        Whether to show a progress bar. By default (None) it is shown on a terminal or in a
        notebook, for work of more than two seconds.

    Returns
    -------
    DesignedLoops
        Laws and their margins, verified with all loops closed.

    Raises
    ------
    SolverError
        When no bandwidth within the measured frequencies keeps the peak of an axis (the message
        names the axis), or the laws found are not stable together.
    ModelError, ShapeError, LabelError, AssumptionError
        As for `design_loops`. ModelError is also raised when peak is not above 1.

    Warns
    -----
    FlexplantWarning
        When the peak is exceeded. The warning states the largest |S|, the channel at which it
        occurs, and its frequency. The `notes` of the result contain the same text.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.lti.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=2)
    >>> design = fx.tune_loops(plant)
    >>> design.report.is_stable
    True
    """
    peak = between(peak, "peak", 1.0, float("inf"), "No loop keeps |S| below 1: try 2.")
    axes = axes_of(plant, before, after, rate, delay, hold)
    if rigid is None and isinstance(axes.plant, Frf):
        rigid = len(axes.names)
    elif rigid is None:  # a rigid-body mode has two poles at zero frequency
        distance = np.abs(axes.plant.poles() - (1.0 if axes.rate else 0.0))
        rigid = int(np.count_nonzero(distance <= SPLIT * np.max(distance, initial=0.0))) // 2
    rigid = whole(rigid, "rigid", minimum=0)
    most = whole(notches, "notches", minimum=0)
    if _has_no_line(axes):
        return made(axes, {axes.names[0]: _pid_law(axes, float(peak))}, 0, 0, None)
    plants = _joint_plants(plant, axes, rigid, {"rate": rate, "delay": delay, "hold": hold})
    frf, found = _axes_response(plants[-1], axes), []
    resolved = not isinstance(axes.plant, Frf)
    with Progress(len(axes.names), "axes", progress=progress) as bar:
        for i, (name, (free, powers)) in enumerate(
            zip(axes.names, _lines(axes, rigid), strict=True)
        ):
            variance = None if frf.variance is None else frf.variance[i, i]
            lines = (frf.freq, frf.data[i, i], axes.rate, free, variance)
            laws = [
                AxisLaw(MeasuredAxis(name, *lines, power, resolved), float(peak), most)
                for power in powers
            ]
            found.append(_each_line(laws))
            bar.advance()
    of, best = _together(found, plants, float(peak))
    design = made(axes, dict(zip(axes.names, best.laws, strict=True)), rigid, 0, None)
    notes = [note for law, x in zip(of, best.numbers, strict=True) for note in law.notes(x)]
    if best.worst.size > peak:
        notes.append(
            f"|S| below {20.0 * np.log10(peak):.3g} dB was not reached: |S| {best.worst.place} is "
            f"{20.0 * np.log10(best.worst.size):.3g} dB at {best.worst.freq:.4g} Hz, which ended "
            "the search. Allow a higher peak, decouple the axes better (before=, after=), or move "
            "actuators or sensors to where they excite or see less of what resonates there"
        )
        warn(notes[-1])
    return design.replace(notes=(*design.notes, *notes))


def _has_no_line(axes: Axes) -> bool:
    """Return whether a single axis integrates an odd number of times, or has unstable poles."""
    g = axes.plant
    if isinstance(g, Frf) or len(axes.names) > 1 or not g.n_states:
        return False
    poles = g.poles()
    rest = np.abs(poles - (1.0 if axes.rate else 0.0))
    slow = rest <= SPLIT * np.max(rest)
    grows = np.abs(poles) > 1.0 if axes.rate else poles.real > 0.0
    return bool(np.count_nonzero(slow) % 2 or np.any(grows & ~slow))


def _pid_law(axes: Axes, peak: float) -> Law:
    """Return the law of `tune_pid`, whose loop is judged by its poles."""
    found, rate = tune_pid(axes.plant, margin=1.0 / peak), axes.rate
    # it keeps its response at the crossover when it is sampled: Tustin's rule of shifted corners
    half = np.pi * found.crossover / rate if rate else 0.0
    moved = float(np.tan(half) / half) if half else 1.0
    lead = np.isfinite(found.lead)
    pid = Pid.corners(
        found.gain,
        integrator=moved * found.integral,
        zero=moved * found.lead if lead else None,
        pole=moved * found.roll_off if lead else None,
    )
    return Law((pid,), rate=rate or 0.0)


def _joint_plants(
    plant: Any, axes: Axes, rigid: int, measured: Mapping[str, Any]
) -> list[JointPlant]:
    """Return the plant in its own channels, and the one with the truncated modes where known."""
    u, y, static = axes.before.outputs, axes.after.inputs, (axes.before.D, axes.after.D)
    if isinstance(axes.plant, Frf):
        given = plant if isinstance(plant, Frf) else Frf.from_control(plant)
        return [JointPlant(in_axes(given.select(y, u), **measured), *static, axes.names, rigid)]
    own = as_statespace(plant if axes.given is None else axes.given.Gyu)
    found = [JointPlant(own.select(y, u), *static, axes.names, rigid)]
    more = None if axes.given is None else axes.given.machine.evaluation_plant
    if axes.given is not None and more is not None:
        reading, G = axes.given.reading, more.system.select(more.y, more.u)
        if reading is not None:
            read = [name for name in reading.inputs if name in more.y]
            G = series(G.select(read), reading.select(inputs=read))
        kind = " with the truncated modes"
        found.append(JointPlant(G.select(y, u), *static, axes.names, rigid, kind))
    return found


#: how far next to rest the slope of a response is taken, relative to the rate [Hz], and its step
_RESTING, _STEP_AT_REST = 1e-6, 2.0


def _lines(axes: Axes, rigid: int) -> list[tuple[bool, tuple[int, ...]]]:
    """Return whether each axis is free at rest, and powers of 1 / s of lines of its bandwidth."""
    # always a mass, except for velocities; below the frequency of its springs it is a spring
    if isinstance(axes.plant, Frf):
        return [(rigid > 0, (2,) if rigid else (2, 0))] * len(axes.names)
    found: list[tuple[bool, tuple[int, ...]]] = []
    low = 2.0 * np.pi * _RESTING * (axes.rate or float(np.abs(axes.plant.poles()).max(initial=1.0)))
    g = axes.plant
    for i in range(len(axes.names)):
        near, far = (
            abs(real_gain(g, s, [g.outputs[i]], [g.inputs[i]])[0, 0])
            for s in (low, _STEP_AT_REST * low)
        )
        slope = -np.log(far / near) / np.log(_STEP_AT_REST) if near and far else 2.0
        powers = (2,) if slope > 1.5 else (1,) if abs(slope) > 0.5 else (2, 0)
        found.append((rigid > 0 and slope > 0.5, powers))
    return found


def _each_line(laws: Sequence[AxisLaw]) -> list[tuple[AxisLaw, FloatArray]]:
    """Return the fastest law of each line of an axis that has one, the fastest line first."""
    found, failures = [], []
    for law in laws:
        try:
            found.append((law, law.best()))
        except SolverError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    return sorted(found, key=lambda one: -float(one[1][0]))


def _together(
    found: Sequence[list[tuple[AxisLaw, FloatArray]]], plants: list[JointPlant], peak: float
) -> tuple[list[AxisLaw], JointLaws]:
    """Return the laws of all axes together, on the fastest line of each or on its lowest."""
    # axes that are decoupled on their springs are coupled on the lines of their masses, above
    fastest = [lines[0] for lines in found]
    lowest = [min(lines, key=lambda one: one[0].axis.power) for lines in found]
    tried: list[tuple[list[AxisLaw], JointLaws]] = []
    failures = []
    for chosen in (fastest, lowest):
        of, alone = [law for law, _ in chosen], [numbers for _, numbers in chosen]
        if tried and (all(map(is_, of, tried[0][0])) or tried[0][1].worst.size <= peak):
            break
        try:
            tried.append((of, JointSearch(of, plants, peak, alone).best()))
        except SolverError as error:
            failures.append(error)
    if not tried:
        raise failures[0]
    return min(tried, key=lambda one: one[1].worst.size)


def _axes_response(plant: JointPlant, axes: Axes) -> Frf:
    """Return the response in the axes: that measured, or of a model through its resonances."""
    if isinstance(axes.plant, Frf):
        return axes.plant
    assert isinstance(plant.plant, StateSpace)  # noqa: S101 - the axes are of a model
    dt = plant.plant.dt
    grid = resonance_grid(plant.plant.poles(), dt, points=1000)
    freq = grid[grid < 0.4999 / dt] if dt else grid
    data = np.moveaxis(plant.coupling(freq).inner, 0, -1)
    return Frf(freq, data, axes.before.inputs, axes.names)


#: slower starts, as a factor, until the loops are stable with |S| below so much; starts from which
#: the peak is sought
_SLOWER, _STARTS, _WILD, _TRIED = 0.8, 30, 10.0, 3
#: steps between two checks, and checks at which frequencies are added
_STEPS, _ROUNDS = 50, 6
#: radii [e-folds], penalty on what is violated, step of differences
_RADIUS, _SMALLEST, _PENALTY, _DIFFERENCE = 0.25, 1e-3, 4.0, 1e-6
#: points of one place that count in a step, at most and as far above the bound
_LOWEST, _REACH = 12, 0.3
#: distance kept beyond what is needed, to end with no less
_SPARE = 2e-3
#: steps down, and their factor, where the grid missed the very top of a peak; |S| relative to the
#: bound above which this does not help
_DOWN, _LITTLE, _FAR = 5, 0.99, 1.05
#: fraction of the bound on |S| above which a frequency of the closed loop is added
_NEAR = 0.9


class JointLaws(NamedTuple):
    """Laws of all axes, their numbers, and the largest |S| that they reach."""

    numbers: list[FloatArray]
    laws: list[Law]
    worst: Worst


@dataclass(frozen=True)
class JointSearch:
    """The search for laws of the highest mean bandwidth that hold |S| on some plants."""

    of: Sequence[AxisLaw]
    plants: Sequence[JointPlant]
    peak: float
    given: Sequence[FloatArray]

    def checked(self, numbers: list[FloatArray]) -> JointLaws | None:
        """Return laws with their largest |S| on all plants; None when unstable on one."""
        laws = [law.law(x) for law, x in zip(self.of, numbers, strict=True)]
        if not all(plant.is_stable(laws) for plant in self.plants):
            return None
        return JointLaws(numbers, laws, max(plant.worst(laws) for plant in self.plants))

    def best(self) -> JointLaws:
        """Return laws that hold the peak, or come closest to it."""
        held = self._held(self.given)
        if held is not None:
            return held
        known: JointLaws | None = None
        for start in islice(self._starts(), _TRIED):
            found, spare = start, _SPARE
            known = found if known is None else known
            for _ in range(_ROUNDS):
                again = self.checked(self._raised(found.numbers, 1.0 / self.peak + spare))
                if again is None:  # of lines alone: they count turns, not poles
                    break
                found = again
                if found.worst.size <= self.peak:
                    return found
                known = min(known, found, key=lambda one: one.worst.size)
                spare += 1.0 / self.peak - 1.0 / found.worst.size  # what lies between the points
            held = self._held(known.numbers)
            if held is not None:
                return held
        assert known is not None  # noqa: S101 - there is a start, or none is stable
        return known

    def _held(self, numbers: Sequence[FloatArray]) -> JointLaws | None:
        """Return the laws, or ones a little slower, that hold the peak; None where it is far."""
        for step in range(_DOWN):
            found = self.checked(self._slowed(numbers, _LITTLE**step))
            if found is None or found.worst.size > _FAR * self.peak:
                return None
            if found.worst.size <= self.peak:
                return found
        return None

    def _slowed(self, numbers: Sequence[FloatArray], factor: float) -> list[FloatArray]:
        """Return the numbers with bandwidths times a factor, none below the lowest."""
        least = [np.log(law.lowest) for law in self.of]
        return [
            np.append(max(x[0] + np.log(factor), min(x[0], low)), x[1:])
            for x, low in zip(numbers, least, strict=True)
        ]

    def _starts(self) -> Iterator[JointLaws]:
        """Return ever slower laws that are stable, |S| not wild if possible: each half as fast."""
        wild, last = None, np.inf
        for step in range(_STARTS):
            factor = _SLOWER**step
            if factor > 0.5 * last:
                continue
            found = self.checked(self._slowed(self.given, factor))
            if found is not None and found.worst.size < _WILD:
                last = factor
                yield found
            wild = wild or found
        if last < np.inf:
            return
        if wild is None:
            lowest = ", ".join(f"{law.lowest:.3g}" for law in self.of)
            raise SolverError(
                f"each axis alone holds |S| below {self.peak:g}, but all together are unstable at "
                f"every bandwidth down to {lowest} Hz. Decouple the axes better (before=, "
                "after=), or close them one after the other with design_loops."
            )
        yield wild

    def _raised(self, numbers: list[FloatArray], least: float) -> list[FloatArray]:
        """Return what steps from stable laws lead to."""
        # an exact penalty on what is violated [Fletcher1987]_; each step is stable, and adds the
        # resonances of its closed loop to the frequencies
        x, radius = np.concatenate(numbers), _RADIUS
        grids = self._seen(x, [one.grid for one in self.plants])
        couplings = [one.coupling(grid) for one, grid in zip(self.plants, grids, strict=True)]
        gains, rooms = self._rooms(x, couplings, least)
        lowest = min(float(room.min()) for room in rooms)
        for _ in range(_STEPS):
            program = self._program(x, gains, rooms, couplings)
            step, expected = program.step(program.at(rooms), radius)
            if radius < _SMALLEST or expected < _SMALLEST:
                break
            for last in (False, True):
                there, found = self._rooms(x + step, couplings, least)
                low = min(float(room.min()) for room in found)
                gained = program.mean(step) + _PENALTY * (min(low, 0.0) - min(lowest, 0.0))
                if gained > 0.1 * expected or last:
                    break
                # second-order correction: the bounds are curved, and steps along them short
                bent = program.at(found) - program.slopes @ step
                step = program.step(bent, radius)[0]
            if gained > 0.1 * expected and self._stays_stable(x + step, couplings, gains, there):
                x = x + step
                grids = self._seen(x, grids)
                couplings = [
                    old if grid.size == old.freq.size else one.coupling(grid)
                    for one, grid, old in zip(self.plants, grids, couplings, strict=True)
                ]
                gains, rooms = self._rooms(x, couplings, least)
                lowest = min(float(room.min()) for room in rooms)
                radius *= 2.0 if gained > 0.7 * expected and radius < _RADIUS else 1.0
            else:
                radius *= 0.4
        return self._split(x)

    def _laws(self, x: FloatArray) -> list[Law]:
        return [law.law(own) for law, own in zip(self.of, self._split(x), strict=True)]

    def _seen(self, x: FloatArray, grids: Sequence[FloatArray]) -> list[FloatArray]:
        """Return frequencies with those of the closed loops of some numbers where |S| is large."""
        laws = self._laws(x)
        return [
            np.union1d(grid, one.high(laws, _NEAR * self.peak))
            for one, grid in zip(self.plants, grids, strict=True)
        ]

    def _stays_stable(
        self,
        x: FloatArray,
        couplings: Sequence[Coupling],
        before: Sequence[ComplexArray],
        after: Sequence[ComplexArray],
    ) -> bool:
        """Return whether all loops are stable: by their poles, of lines by turns as before."""
        laws = self._laws(x)
        return all(
            _same_winding(there, old, new) if isinstance(one.plant, Frf) else one.is_stable(laws)
            for one, there, old, new in zip(self.plants, couplings, before, after, strict=True)
        )

    def _rooms(
        self, x: FloatArray, couplings: Sequence[Coupling], least: float
    ) -> tuple[list[ComplexArray], list[FloatArray]]:
        """Return the laws C (n_freq, axes) on each plant, and the distances beyond the least."""
        gains = []
        for one in couplings:
            s = tustin_s(one.freq, self.of[0].axis.rate)
            each = [law.response(own, s) for law, own in zip(self.of, self._split(x), strict=True)]
            gains.append(np.stack(each, axis=-1))
        return gains, [one.distances(C) - least for one, C in zip(couplings, gains, strict=True)]

    def _program(
        self,
        x: FloatArray,
        gains: Sequence[ComplexArray],
        rooms: Sequence[FloatArray],
        couplings: Sequence[Coupling],
    ) -> _Program:
        """Return the problem linearised at some numbers."""
        slopes, places = [np.empty((0, x.size))], []
        for number, (one, C, room) in enumerate(zip(couplings, gains, rooms, strict=True)):
            near = [np.unique(near_lowest(own, _LOWEST, _REACH)) for own in room]
            some = np.unique(np.concatenate(near))
            changes = self._changes(x, one.freq[some])
            for place, rows in enumerate(near):
                if rows.size:
                    by_laws = one.rows(rows).slopes(C[rows], place)
                    by_numbers = by_laws[:, self._owners] * changes[np.searchsorted(some, rows)]
                    slopes.append(by_numbers.real)
                    places.append((number, place, rows))
        limits = [law.limits(own) for law, own in zip(self.of, self._split(x), strict=True)]
        low, high, sides, most = zip(*limits, strict=True)
        bound = la.block_diag(*sides)
        slack = np.maximum(np.concatenate(most) - bound @ x, 0.0)
        bounds = (np.concatenate(low) - x, np.concatenate(high) - x, bound, slack)
        return _Program(np.vstack(slopes), places, bounds, self._places)

    def _changes(self, x: FloatArray, freq: FloatArray) -> ComplexArray:
        """Return the derivatives (n, numbers) of the laws by their numbers, by differences."""
        s = tustin_s(freq, self.of[0].axis.rate)
        found = []
        for law, own in zip(self.of, self._split(x), strict=True):
            here = law.response(own, s)
            moved = own + _DIFFERENCE * np.eye(own.size)
            found.append((law.response(moved, s) - here) / _DIFFERENCE)
        return np.concatenate(found).T

    @property
    def _owners(self) -> IntArray:
        """The axis of each number."""
        return np.repeat(np.arange(len(self.given)), [one.size for one in self.given])

    @property
    def _places(self) -> IntArray:
        """Where the bandwidths are among the numbers of all axes."""
        return np.cumsum([0, *(one.size for one in self.given[:-1])])

    def _split(self, x: FloatArray) -> list[FloatArray]:
        return np.split(x, self._places[1:])


class _Program(NamedTuple):
    """The linearised problem: ``room + slopes step >= 0`` at some points of some places."""

    slopes: FloatArray
    places: list[tuple[int, int, IntArray]]
    bounds: tuple[FloatArray, ...]
    bandwidths: IntArray

    def at(self, rooms: Sequence[FloatArray]) -> FloatArray:
        """Return the room at the points of the program."""
        return np.concatenate([[], *(rooms[i][k, rows] for i, k, rows in self.places)])

    def mean(self, step: FloatArray) -> float:
        """Return the mean growth of the bandwidths."""
        return float(np.mean(step[self.bandwidths]))

    def step(self, room: FloatArray, radius: float) -> tuple[FloatArray, float]:
        """Return the best step within a radius for some room, and the gain that it predicts."""
        step, gain = linear_step(
            self.slopes, room, self.bounds, radius, aim=self.bandwidths, penalty=_PENALTY
        )
        return step, gain - _PENALTY * float(min(room.min(initial=np.inf), 0.0))


def _same_winding(one: Coupling, before: ComplexArray, after: ComplexArray) -> bool:
    """Return whether ``det(I + P C)`` of two laws with the same unstable poles turns as often."""
    ratio = one.turns(after) / one.turns(before)
    return bool(abs(np.sum(np.angle(ratio[1:] / ratio[:-1]))) < 0.5 * np.pi)
