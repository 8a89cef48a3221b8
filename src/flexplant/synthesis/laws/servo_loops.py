"""A servo at all frequencies: the law of each axis, and the loop with estimate, modes and delay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...arrays import ComplexArray, FloatArray, IntArray
from ...errors import LabelError, warn
from ...loop import ClosedLoop
from ...loop.blocks import as_block
from ...loop.broken import (
    first_crossing,
    least_scaled,
    mixed_units,
    peaking_size,
    reference_pairs,
    sensitivity,
    sensitivity_size,
)
from ...lti.blocks_of_states import Matrices, cascaded
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import connect
from ...lti.response_solvers import responses
from ...lti.statespace import StateSpace
from ...plant import EvaluationModel, Foreign, StandardPlant
from ...plant.axes import DrivenAxes, complex_gain, force_units, oscillations
from ...tolerances import KEPT_PLANTS
from .law import Integrator, Law, LowPass, Notch, Pid, decoupled, product, tustin_s

#: the lead of a mass line: its zero lies this factor below the bandwidth, its pole above. With 4
#: |S| of a free mass peaks near 4 dB with the roll-off and integrator of `design_servo`. Where a
#: mode lies just above the bandwidth its notch takes phase, which wider leads give back
LEADS = (4.0, 16.0, 64.0)
#: highest corner of a law, as a fraction of the rate
HIGHEST = 0.4
#: lines on which an axis may lie, by the power of 1 / s of its response: a mass that is free (or
#: above its springs), a damper, a spring (or a mass below its springs' frequency)
POWERS = {"mass": 2.0, "damper": 1.0, "spring": 0.0}
#: a line is tried when slope and phase of the response are at most this much further from it than
#: from the nearest line; both distances are counted in powers of s
_ASIDE = 0.8
#: step of frequency for the slope, and how far below the bandwidth a response that vanishes at
#: rest is sought, with how small it is there
_STEP, _BELOW, _VANISHED = 1.05, 1e-3, 1e-2
#: |S| at u that a notch is to bring the loop below: 6 dB
TARGET = 2.0
#: notches that are placed at most, modes that are tried for each, and the least gain of one
_NOTCHES, _TRIED, _GAIN = 6, 4, 0.97
#: damping ratios of a notch's poles that are tried; its zeros have the damping of the mode
_WIDTHS = (0.3, 0.45)
#: fraction of it at which notching ends: the grid misses the top of a resonance by up to 2 %
_BELOW_TARGET = 0.98
#: points where |S| is at least this fraction of its peak are judged first for a further notch
_HIGH = 0.5
#: distance of a growing pole from the mode that it belongs to, relative to its frequency
_DRIVEN = 0.3
#: loop gain at a resonance below which a notch there serves nothing
_QUIET = 0.3


@dataclass(frozen=True, eq=False)
class Axis:
    """The law of an axis, sampled by Tustin's rule, of gain 1 at the bandwidth.

    On a mass line ``(1 + w_i / s) (1 + r s / w_b) / (1 + s / (r w_b)) F(s)`` with the lead r, on
    that of a damper ``(1 + w_i / s) F(s)``, of a spring ``F(s) / s``, of a response that vanishes
    at rest ``F(s)``; F is a second-order low-pass and the notches.
    """

    line: str
    bandwidth: float
    rolloff: float
    rate: float
    lead: float
    integrator: float

    def law(self, notches: Sequence[Notch]) -> Law:
        """Return the law with notches, from error to command."""
        factors = (*self.action, LowPass(self.rolloff), *notches)
        there = product(
            (one.section.at(self.rate) for one in factors), tustin_s(self.bandwidth, self.rate)
        )
        return Law(factors, float(1.0 / abs(there)), self.rate)

    @cached_property
    def shape(self) -> Law:
        """The law without notches."""
        return self.law(())

    @cached_property
    def turn(self) -> complex:
        """The response of the shape at the bandwidth, of size 1."""
        return complex(self.shape.at(np.array(self.bandwidth)))

    @property
    def action(self) -> tuple[Pid | Integrator, ...]:
        """Integral action and lead."""
        if self.line == "mass":
            zero = self.bandwidth / self.lead
            pole = min(self.bandwidth * self.lead, HIGHEST * self.rate)
            return (Pid.corners(1.0, integrator=self.integrator, zero=zero, pole=pole),)
        if self.line == "damper":
            return (Integrator(self.integrator),)
        return (Pid(0.0, i=1.0),) if self.line == "spring" else ()


#: equal laws are one, so that what is known of it is found at once
known_axis = lru_cache(maxsize=_NOTCHES * KEPT_PLANTS)(Axis)


@lru_cache(maxsize=_NOTCHES * KEPT_PLANTS)
def _series(shape: Law, notches: tuple[Notch, ...]) -> Matrices:
    """Return A, B, C and D of a law and notches, sampled."""
    if not notches:
        return shape.matrices
    return cascaded(_series(shape, notches[:-1]), _sampled(notches[-1], shape.rate))


@lru_cache(maxsize=_NOTCHES * KEPT_PLANTS)
def _notch(freq: float, depth: float, width: float) -> Notch:
    return Notch(freq, depth, width)


@lru_cache(maxsize=_NOTCHES * KEPT_PLANTS)
def _sampled(notch: Notch, rate: float) -> Matrices:
    return notch.sampled(rate).matrices


def gains_at(
    plant: StandardPlant, axes: DrivenAxes, freq: FloatArray | ComplexArray | None = None
) -> ComplexArray:
    """Return the responses (r,) of the decoupled axes, at their frequencies [Hz] or at others."""
    at = 2j * np.pi * (axes.freq if freq is None else freq)
    gains = {s: complex_gain(plant.system, s, axes.channels, axes.actuators) for s in set(at)}
    return np.array([gains[s][i] @ axes.T[:, i] for i, s in enumerate(at)])


def lines_of(plant: StandardPlant, axes: DrivenAxes) -> list[tuple[str, ...]]:
    """Return the lines on which each axis may lie, the most likely first."""
    phases = np.angle(gains_at(plant, axes)) + np.pi * axes.freq * plant.dt * (1 + 2 * plant.delay)
    steps = np.array([_BELOW, 1.0 / _STEP, 1.0, _STEP])[:, None]
    real = [gains_at(plant, axes, np.asarray(one)) for one in -1j * steps * axes.freq]
    rest, below, there, above = np.abs(np.real(real))
    slopes = -np.log(above / below) / (2.0 * np.log(_STEP))
    return [
        ("speed",) if rest[i] < _VANISHED * there[i] else _likely(float(slopes[i]), float(phase))
        for i, phase in enumerate(phases)
    ]


def _likely(slope: float, phase: float) -> tuple[str, ...]:
    """Return the lines near a slope of the real axis and a phase [rad] of the imaginary one."""
    # phases in (-3/2 pi, pi/2], so that that of a mass is -pi
    turned = float(np.mod(phase - 0.5 * np.pi, 2.0 * np.pi) - 1.5 * np.pi)
    off = {
        line: abs(slope - power) + abs(turned / (0.5 * np.pi) + power)
        for line, power in POWERS.items()
    }
    nearest = min(off.values())
    order = sorted(off, key=off.__getitem__)
    return tuple(line for line in order if off[line] <= nearest + _ASIDE)


def combinations(lines: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return lines of all axes to try: each axis on its first line, its second, and on a mass.

    Next to its springs' frequency an axis resonates beyond the bandwidth, and crosses 1 once more
    as a mass: the lead of that law holds it there.
    """
    count = max(len(one) for one in lines)
    tried = [tuple(one[min(k, len(one) - 1)] for one in lines) for k in range(count)]
    tried.append(tuple("speed" if one == ("speed",) else "mass" for one in lines))
    return list(dict.fromkeys(tried))


class ServoLaw(NamedTuple):
    """Laws of axes, and how their commands reach the actuators."""

    driven: DrivenAxes
    axes: tuple[Axis, ...]
    #: gains (r,) of the plant at the bandwidths, decoupled: exact
    level: tuple[float, ...]
    #: which all axes have in common
    notches: tuple[Notch, ...] = ()

    def notched(self, notch: Notch) -> ServoLaw:
        """Return the laws with a further notch."""
        return self._replace(notches=(*self.notches, notch))

    def of(self, axes: Iterable[Axis]) -> ServoLaw:
        """Return the same with other axes."""
        return self._replace(axes=tuple(axes))

    def faster(self, part: float) -> ServoLaw:
        """Return the same with integral action up to a part of the bandwidth, or faster."""
        corners = (max(one.integrator, part * one.bandwidth) for one in self.axes)
        each = zip(self.axes, corners, strict=True)
        return self.of(known_axis(*astuple(one)[:-1], corner) for one, corner in each)

    def there(self, notch: Notch) -> ComplexArray:
        """Return the responses (r,) of a notch at the bandwidths, whose gains the laws make up."""
        rate = self.axes[0].rate
        s = tustin_s(np.array([axis.bandwidth for axis in self.axes]), rate)
        return notch.section.at(rate).gain(s)

    def at(self, freq: FloatArray) -> ComplexArray:
        """Return the responses (n_freq, r) of the laws."""
        found, rate = {one: one.shape.at(freq) for one in set(self.axes)}, self.axes[0].rate
        at = np.stack([found[one] for one in self.axes], axis=-1) / self.level
        for notch in self.notches:
            at *= notch.section.at(rate).gain(tustin_s(freq, rate))[:, None] / np.abs(
                self.there(notch)
            )
        return at

    @property
    def matrices(self) -> Matrices:
        """A, B, C and D from what the servo reads to the actuators."""
        notched = np.abs(np.prod([self.there(notch) for notch in self.notches], axis=0))
        parts = []
        for axis, gain in zip(self.axes, notched * np.array(self.level), strict=True):
            A, B, C, D = _series(axis.shape, self.notches)
            parts.append((A, B, C / gain, D / gain))
        return decoupled(parts, self.driven.T, np.eye(len(self.axes)))


@dataclass(frozen=True, eq=False)
class Reading:
    """What a servo reads for each axis: the estimate of a POI's, or the sensor itself."""

    channels: tuple[str, ...]
    #: of the channel: its estimate or sensor, and its reference where there is one
    reads: Mapping[str, str]
    references: Mapping[str, str]

    @property
    def estimates(self) -> list[str]:
        """What an observer has to give."""
        return [one for channel, one in self.reads.items() if one != channel]

    def warn_of_held(self, axes: Sequence[str] | None) -> None:
        """Warn of sensors that stand for a motion that no POI shows, where axes are not given."""
        held = [channel for channel, one in self.reads.items() if one == channel]
        if axes is None and held and self.references:
            warn(
                "no axis of a POI shows a free motion that the actuators move, so that the servo "
                f"holds {', '.join(held)} at zero, also while references move the POIs. Add a Poi "
                "that shows this motion to move otherwise, or name the axes, axes=[...]."
            )


@dataclass(frozen=True)
class ServoLoop:
    """The loop of a servo over frequency, broken where `ClosedLoop.broken` breaks it.

    ``u = -T C (E_y y + E_u u)``: C of the axes, E of the observer, which may read u too; T
    decouples. The plant moves y, so that only the path through y is broken, the other stays closed.
    """

    freq: FloatArray
    plant: StandardPlant
    observer: StateSpace | None
    reading: Reading
    #: of the modes: frequencies [Hz] and damping ratios
    modes: FloatArray
    damping: FloatArray

    @cached_property
    def motion(self) -> ComplexArray:
        """From u to the axes with a reference (n_freq, k, nu): their true motion."""
        return _stack(self.plant.system, self.reading.references, self.plant.u, self.freq)

    @cached_property
    def _paths(self) -> tuple[ComplexArray, ComplexArray | None]:
        """E_y G + E_u and E_u (n_freq, r, nu)."""
        plant, observer, reading, grid = self.plant, self.observer, self.reading, self.freq
        direct = [one for one in reading.channels if observer is None or reading.reads[one] == one]
        rows = {name: i for i, name in enumerate(reading.channels)}
        through = np.zeros((grid.size, len(rows), len(plant.u)), dtype=np.complex128)
        if direct:
            known = _stack(plant.system, direct, plant.u, grid)
            through[:, [rows[name] for name in direct]] = known
        guessed = [name for name in reading.channels if name not in direct]
        if not guessed or observer is None:
            return through, None
        read, given = (
            [name for name in observer.inputs if name in side] for side in (plant.y, plant.u)
        )
        at, hats = [rows[name] for name in guessed], [reading.reads[name] for name in guessed]
        E = _stack(observer, hats, [*read, *given], grid)
        through[:, at] = E[..., : len(read)] @ _stack(plant.system, read, plant.u, grid)
        if not given:
            return through, None
        own = np.zeros_like(through)
        columns = [plant.u.index(name) for name in given]
        own[np.ix_(range(grid.size), at, columns)] = E[..., len(read) :]
        return through + own, own

    @cached_property
    def mixed(self) -> bool:
        """Whether the actuators have several units, as for `BrokenLoop.mixed`."""
        plant = self.plant
        return bool(mixed_units(plant.u, plant.units, lambda: force_units(plant)))

    def broken(
        self, law: ServoLaw, some: IntArray | slice = slice(None)
    ) -> tuple[ComplexArray, ComplexArray | None]:
        """Return L (k, nu, nu) with all paths, and the inner loop of the observer's u."""
        act, (through, own) = -law.driven.T * self.at(law)[some, None, :], self._paths
        return act @ through[some], None if own is None else act @ own[some]

    def _sizes(self, law: ServoLaw, some: IntArray | slice = slice(None)) -> FloatArray:
        loop = self.broken(law, some)
        return peaking_size(sensitivity(*loop)) if self.mixed else sensitivity_size(*loop, 1.0)

    @cached_property
    def at(self) -> Callable[[ServoLaw], ComplexArray]:
        """The function of a law that gives its responses over the grid."""
        rate = 1.0 / self.plant.dt
        s = tustin_s(self.freq, rate)
        notched = lru_cache(lambda notch: notch.section.at(rate).gain(s)[:, None])

        @lru_cache
        def found(law: ServoLaw) -> ComplexArray:
            if not law.notches:
                return law.at(self.freq)
            *first, last = law.notches
            before = found(law._replace(notches=tuple(first)))
            return np.asarray(before * (notched(last) / np.abs(law.there(last))))

        return found

    @cached_property
    def size(self) -> Callable[[ServoLaw], FloatArray]:
        """The function of a law that gives sigma_max(S_u) over the grid.

        It is a lower bound where it is not the largest. It says nothing of stability: check that.
        """
        return lru_cache(self._sizes)

    def peak(self, law: ServoLaw) -> tuple[float, float]:
        """Return max_f sigma_max(S_u) over the grid and its frequency [Hz]."""
        size = self.size(law)
        top = int(np.argmax(size))
        return float(size[top]), float(self.freq[top])

    def suppressed_up_to(self, law: ServoLaw) -> float:
        """Return the least frequency [Hz] at which |S| of a reference first crosses 1."""
        T, L = law.driven.T, self.broken(law)[0]
        moved = np.linalg.solve(np.eye(len(T)) - L, T * self.at(law)[:, None, :])
        referred = [self.reading.channels.index(name) for name in self.reading.references]
        error = 1.0 - np.einsum("fij,fji->if", self.motion, moved[:, :, referred])
        return _first_crossing(self.freq, np.abs(error))

    def _at_least(self, law: ServoLaw, like: ServoLaw) -> float:
        """Return a lower bound of max_f sigma_max(S_u): that where the loop of a like law peaks."""
        size = self.size(like)
        some = np.flatnonzero(size >= _HIGH * size.max())
        if self.mixed:
            return float(least_scaled(sensitivity(*self.broken(law, some))).max())
        return float(self._sizes(law, some).max())

    def lowest(self, laws: Sequence[ServoLaw]) -> ServoLaw:
        """Return the law with the lowest peak of |S|, the first of equals."""
        best, *others = laws
        for law in others:
            least = self.peak(best)[0]
            # else too high already where the loop of the best peaks
            if self._at_least(law, best) < least and self.peak(law)[0] < least:
                best = law
        return best

    def _with_notch(self, law: ServoLaw, modes: Sequence[int]) -> ServoLaw:
        """Return the law with the further notch that gives the lowest peak of |S|.

        It is a narrow one where that brings |S| below 6 dB: wide ones take more phase.
        """
        narrow, *wider = _WIDTHS
        tried = [law.notched(self._inverse(mode, narrow)) for mode in modes]
        best = self.lowest(sorted(tried, key=lambda one: self._at_least(one, law)))
        freq, depth = best.notches[-1].freq, max(best.notches[-1].depth, Notch(1.0).depth)
        best = self.lowest([best, law.notched(_notch(freq, depth, narrow))])  # less phase
        for width in wider:
            if self.peak(best)[0] <= _BELOW_TARGET * TARGET:
                break
            depth = best.notches[-1].depth * best.notches[-1].width / width
            best = self.lowest([best, law.notched(_notch(freq, depth, width))])
        return best

    @cached_property
    def _near(self) -> list[slice]:
        """The points of the grid near each mode."""
        ends = np.searchsorted(self.freq, [0.98 * self.modes, 1.02 * self.modes])
        return [slice(*pair) for pair in ends.T.tolist()]

    @cached_property
    def _reach(self) -> Callable[[DrivenAxes], FloatArray]:
        """The function of axes that gives the size of T times what u moves."""
        return lru_cache(lambda axes: np.linalg.norm(axes.T @ self._paths[0], axis=(1, 2)))

    def resonant(self, law: ServoLaw) -> list[int]:
        """Return the modes above the bandwidth with loop gain and no notch, the largest first."""
        size = np.abs(self.at(law)).max(axis=1) * self._reach(law.driven)
        peaks = np.array([size[near].max(initial=0.0) for near in self._near])
        # below the bandwidths a notch would take the gain that suppresses the error
        peaks[self.modes < law.driven.freq.min()] = 0.0
        done = np.isin(self.places, [notch.freq for notch in law.notches])
        peaks[done | (self.damping > _WIDTHS[0])] = 0.0
        order = np.argsort(-peaks, kind="stable")
        return [int(i) for i in order[peaks[order] > _QUIET]]

    @cached_property
    def places(self) -> FloatArray:
        """Frequencies [Hz] of notches: next to slow modes, up to a third below fast ones."""
        # the bilinear transform would move them there. At the resonance such a notch leads the
        # phase, so that the loop tolerates a machine whose mode is elsewhere: of 40 machines of the
        # wafer stage with 0.1 % damping 20 were unstable with notches at the modes, and none so
        rate = 1.0 / self.plant.dt
        return np.asarray(rate / np.pi * np.arctan(np.pi * self.modes / rate))

    def _inverse(self, mode: int, width: float) -> Notch:
        """Return the notch of a mode, whose zeros have the damping of the mode."""
        return _notch(float(self.places[mode]), float(self.damping[mode]) / width, width)

    def notched(self, law: ServoLaw, poles: Callable[[ServoLaw], ComplexArray]) -> ServoLaw:
        """Return the law with notches at the modes where they bring |S| at u down."""
        inside = poles(law)
        for _ in range(_NOTCHES):
            stable = np.abs(inside).max() < 1.0
            if stable and self.size(law).max() <= _BELOW_TARGET * TARGET:
                break
            left = self.resonant(law)
            left = left[:_TRIED] if stable else self._driven(left, inside)
            if not left:
                break
            further = self._with_notch(law, left)
            outside = poles(further)
            # of an unstable loop |S| says little: a notch is to slow the growth
            if np.abs(outside).max() >= max(1.0, np.abs(inside).max()):
                break
            if stable and self.peak(further)[0] > _GAIN * self.peak(law)[0]:
                break
            law, inside = further, outside
        return law

    def _driven(self, modes: list[int], poles: ComplexArray) -> list[int]:
        """Return the mode next to the pole that grows most, if each growing pole has one."""
        growing = poles[np.abs(poles) >= 1.0]
        growing = growing[np.argsort(-np.abs(growing), kind="stable")]
        grows = np.abs(np.angle(growing)) / (2.0 * np.pi * self.plant.dt)
        off = np.abs(self.modes[modes] - grows[:, None])
        if not modes or np.any(off.min(axis=1) >= _DRIVEN * grows):
            return []
        return [modes[int(np.argmin(off[0]))]]


@lru_cache(maxsize=KEPT_PLANTS)
def reading_of(plant: StandardPlant, channels: tuple[str, ...]) -> Reading:
    """Return what a servo on some channels reads."""
    ports = {poi.channel(axis): (poi, axis) for poi in plant.assembled.ports.z for axis in poi.axes}
    hats = {
        name: ports[name][0].derived(ports[name][1], "hat") for name in channels if name in ports
    }
    refs = {name: ports[name][0].derived(ports[name][1], "ref") for name in hats}
    return Reading(
        channels,
        {name: hats.get(name, name) for name in channels},
        {name: ref for name, ref in refs.items() if ref in plant.y},
    )


@lru_cache(maxsize=KEPT_PLANTS)
def servo_loop(
    plant: StandardPlant, observer: StateSpace | None, reading: Reading, known: StandardPlant
) -> ServoLoop:
    """Return the loop of a plant with an observer, or with the axes themselves as estimates."""
    # with notches by what is known to the design: a plant of fewer modes
    systems = (plant.system,) if observer is None else (plant.system, observer)
    poles = np.concatenate([one.poles() for one in systems])
    grid = resonance_grid(poles, plant.dt, points=300)
    # half the rate itself, where a hold has no answer, is left out
    grid = grid[grid < 0.5 / plant.dt * (1.0 - 1e-6)]
    return ServoLoop(grid, plant, observer, reading, *oscillations(known))


def _stack(
    system: StateSpace, outputs: Iterable[str], inputs: Iterable[str], grid: FloatArray
) -> ComplexArray:
    found = responses(_part(system, tuple(outputs), tuple(inputs)), grid)
    return np.ascontiguousarray(np.moveaxis(found, -1, 0))


@lru_cache(maxsize=2 * KEPT_PLANTS)
def _part(system: StateSpace, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> StateSpace:
    return system.select(outputs, inputs)


def path_of(plant: StandardPlant, observer: StateSpace | None, reading: Reading) -> StateSpace:
    """Return the system from u to what a servo reads."""
    if observer is None:
        return plant.system.select(reading.channels, plant.u)
    reads = list(reading.reads.values())
    read = [one for one in plant.y if one in (*observer.inputs, *reads)]
    return connect([plant.system.select(read, plant.u), observer], plant.u, reads)


@lru_cache(maxsize=KEPT_PLANTS)
def seeing(plant: StandardPlant, reading: Reading) -> StandardPlant:
    """Return the plant whose y are the references and the axes themselves, named as read."""
    g, nz = plant.system, len(plant.z)
    names = (*plant.z, *plant.y)
    own = [names.index(channel) for channel in reading.channels]
    kept = [i for i, name in enumerate(plant.y) if name.endswith(":ref")]
    rows = [*range(nz), *own, *(nz + i for i in kept)]
    y = (*reading.reads.values(), *(plant.y[i] for i in kept))
    system = g.replace(C=g.C[rows], D=g.D[rows], outputs=[*plant.z, *y])
    whole = plant.evaluation_plant
    return StandardPlant(
        system, plant.w, plant.u, plant.z, y, {}, Foreign(delay=plant.delay),
        evaluation=EvaluationModel.of(whole and seeing(whole, reading)),
    )  # fmt: skip


def observer_system(
    observer: Any, plant: StandardPlant, estimates: Sequence[str]
) -> StateSpace | None:
    """Return the observer as a block of the plant, checked to give the estimates."""
    if observer is None:
        return None
    inner = as_block(observer, "the observer", plant.dt)
    missing = [name for name in estimates if name not in inner.outputs]
    if missing:
        raise LabelError(
            f"the observer gives {', '.join(inner.outputs[:6])}, but the servo acts on "
            f"{', '.join(missing)} too. Design it on this plant, or rename its outputs."
        )
    unknown = [name for name in inner.inputs if name not in (*plant.y, *plant.u)]
    if unknown:
        raise LabelError(
            f"the observer reads {', '.join(unknown)}, which the plant has neither in y nor in u."
        )
    return inner


def highest_bandwidth(freq: Sequence[float], holds: Callable[[float], bool]) -> float | None:
    """Return the largest frequency that holds: of a descending grid, then by bisection above."""
    i = next((i for i, one in enumerate(freq) if holds(one)), None)
    if not i:  # none, or the first
        return None if i is None else freq[0]
    low, high = freq[i], freq[i - 1]
    for _ in range(6):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def verified_suppression(closed: ClosedLoop) -> float:
    """Return the frequency [Hz] of `ServoLoop.suppressed_up_to`, from the closed loop instead."""
    plant = closed.plant
    response = closed.frequency_response(closed.broken.grid)
    sizes = (
        np.abs(response.data[plant.z.index(error), plant.w.index(reference)])
        for reference, error in reference_pairs(plant).items()
    )
    return _first_crossing(response.freq, sizes)


def _first_crossing(freq: FloatArray, sizes: Iterable[FloatArray]) -> float:
    """Return the least frequency [Hz] at which one of some sizes of |S| first crosses 1."""
    first, last = float(freq[0]), float(freq[-1])
    crossings = (first_crossing(freq, one, None) if one.min() < 1.0 else first for one in sizes)
    return min((min(one, last) for one in crossings), default=0.0)
