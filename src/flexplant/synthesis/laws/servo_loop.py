"""The loop that a servo will run in: estimate, flexible modes and delay, at all frequencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ...checks import ComplexArray, FloatArray, frozen
from ...errors import AssumptionError, LabelError, counted
from ...loop.blocks import as_block
from ...loop.broken import inverted, largest_sensitivity
from ...lti.frequency_sweep import resonance_grid
from ...lti.responses import responses
from ...lti.sampling import held_exactly
from ...lti.statespace import StateSpace
from ...plant import EvaluationModel, Foreign, Poi, StandardPlant
from ...plant.realisation import natural
from ...plant.rigid_motion import rigid_gain
from ...tolerances import divisor
from .controller_elements import LowPass, Notch, Pid
from .law import Law

#: |S| at u that a notch is to bring the loop below: 6 dB
TARGET = 2.0
#: notches that are placed at most, modes that are tried for each, and what one has to gain
_NOTCHES, _TRIED, _GAIN = 6, 4, 0.97
#: loops of so many plants are kept: their designs at other bandwidths begin with them
_KEPT = 8
#: loop gain at a resonance below which a notch there serves nothing
_QUIET = 0.3


@dataclass(frozen=True)
class ServoLoop:
    """The loop of a servo over frequency, broken where `ClosedLoop.broken` breaks it.

    ``u = -c (T_u E_y y + T_u E_u u)``: c of an axis, E of the observer, which may read u too; T_u
    decouples. The plant moves y, so that only the path through y is broken, the other stays closed.
    """

    freq: FloatArray
    moved: ComplexArray
    own: ComplexArray | None
    modes: FloatArray
    plant: StandardPlant

    def gain(self, axis: Axis) -> ComplexArray:
        """Return the loop of an axis (n_freq, nu, nu) on the grid, broken at u."""
        c = axis.law.at(self.freq)[:, None, None]
        act = -c * np.eye(len(self.plant.u)) if self.own is None else -c * inverted(-c * self.own)
        return np.asarray(act @ self.moved)

    def peak(self, axis: Axis) -> tuple[float, float]:
        """Return max_f sigma_max(S_u) over the grid and its frequency [Hz]."""
        # of an unstable loop too, so check that
        mixed = len({self.plant.units.get(name) for name in self.plant.u}) > 1
        size = largest_sensitivity(self.gain(axis), mixed)
        top = int(np.argmax(size))
        return float(size[top]), float(self.freq[top])

    @cached_property
    def _near(self) -> FloatArray:
        """Size of T_u E beside each mode (n_freq, k), elsewhere 0."""
        near = np.abs(self.freq[:, None] - self.modes) <= 0.02 * self.modes
        through = self.moved if self.own is None else self.moved + self.own
        return np.asarray(near * np.linalg.norm(through, axis=(1, 2))[:, None])

    def resonant(self, axis: Axis) -> FloatArray:
        """Return the modes [Hz] whose resonances have loop gain, the largest first."""
        gain = np.abs(axis.law.at(self.freq))
        peaks = np.max(gain[:, None] * self._near, axis=0, initial=0.0)
        order = np.argsort(-peaks, kind="stable")
        return np.asarray(self.modes[order][peaks[order] > _QUIET])

    def notched(self, axis: Axis, stable: Callable[[Axis], bool]) -> Axis:
        """Return the axis with notches at the modes where they bring |S| at u down."""
        # while |S| is above 6 dB or the loop unstable: the one of the largest that lowers it most
        peak = self.peak(axis)[0]
        for _ in range(_NOTCHES):
            if peak <= TARGET and stable(axis):
                break
            left = [f for f in self.resonant(axis).tolist() if f not in axis.notches][:_TRIED]
            tried = [replace(axis, notches=(*axis.notches, freq)) for freq in left]
            if not tried:
                break
            peaks = [self.peak(one)[0] for one in tried]
            best = 0 if peak <= TARGET else int(np.argmin(peaks))
            if TARGET < peak < peaks[best] / _GAIN and stable(axis):
                break
            axis, peak = tried[best], peaks[best]
        return axis


@lru_cache(maxsize=_KEPT)
def decoupling(plant: StandardPlant, poi: Poi) -> FloatArray:
    """Return T_u (m, r): accelerations of the POI's axes to actuator forces, of least norm."""
    axes, r = poi.axes, plant.rigid_motions.modes.size
    plant.continuous.check().require(("stabilisable",), "a servo of the rigid body")
    gain = rigid_gain(plant, plant.rigid_motions, [poi.channel(a) for a in axes], plant.u)
    size = np.linalg.norm(gain, axis=1, keepdims=True)
    if len(axes) != r or np.linalg.matrix_rank(gain / divisor(size)) < r:
        raise AssumptionError(
            f"POI {poi.name!r} has axes {axes}, the plant {counted(r, 'rigid-body mode')}: the "
            "servo needs axes that span them, one each (for a plate z, rx, ry). Give the POI these."
        )
    return np.asarray(frozen(np.linalg.pinv(gain)))


@lru_cache(maxsize=_KEPT)
def servo_loop(
    plant: StandardPlant, observer: StateSpace | None, poi: Poi, known: StandardPlant
) -> ServoLoop:
    """Return the loop of a plant with an observer, or with the POI itself as its estimate."""
    # decoupled, and with notches, by what is known to the design: a plant of fewer modes
    hats = tuple(poi.derived(axis, "hat") for axis in poi.axes)
    systems = (plant.system,) if observer is None else (plant.system, observer)
    poles = np.concatenate([one.poles() for one in systems])
    grid = resonance_grid(poles, plant.dt, points=300)
    # half the rate itself, where a hold has no answer, is left out
    grid = grid[grid < 0.5 / plant.dt * (1.0 - 1e-6)]
    T_u = decoupling(known, poi)
    read, given = [poi.channel(axis) for axis in poi.axes], []
    E: Any = T_u
    if observer is not None:
        read, given = (
            [name for name in observer.inputs if name in side] for side in (plant.y, plant.u)
        )
        E = T_u @ _response_stack(observer.select(hats, [*read, *given]), grid)
    moved = E[..., : len(read)] @ _response_stack(plant.system.select(read, plant.u), grid)
    own = np.zeros_like(moved)
    own[:, :, [plant.u.index(name) for name in given]] = E[..., len(read) :]
    return ServoLoop(grid, moved, own if given else None, elastic(known), plant)


def _response_stack(system: StateSpace, grid: FloatArray) -> ComplexArray:
    return np.ascontiguousarray(np.moveaxis(responses(system, grid), -1, 0))


def elastic(plant: StandardPlant) -> FloatArray:
    """Return the frequencies [Hz] of the elastic modes below 0.45 of the rate."""
    if not plant.is_assembled:
        return np.zeros(0)
    pairs = plant.modal_blocks[plant.n_rigid : plant.assembled.realisation.n_modes]
    freq = natural(pairs)[0] / (2.0 * np.pi)
    freq = freq[freq > 0]  # unstable pairs do not resonate
    return np.asarray(freq[freq * plant.dt < 0.45])


@lru_cache(maxsize=_KEPT)
def seeing(plant: StandardPlant, poi: Poi) -> StandardPlant:
    """Return the plant whose y are the references and the POI itself, named as estimates."""
    g, nz = plant.system, len(plant.z)
    own = [plant.z.index(poi.channel(axis)) for axis in poi.axes]
    kept = [i for i, name in enumerate(plant.y) if name.endswith(":ref")]
    rows = [*range(nz), *own, *(nz + i for i in kept)]
    y = (*(poi.derived(axis, "hat") for axis in poi.axes), *(plant.y[i] for i in kept))
    system = g.replace(C=g.C[rows], D=g.D[rows], outputs=[*plant.z, *y])
    whole = plant.evaluation_plant
    return StandardPlant(
        system, plant.w, plant.u, plant.z, y, {}, Foreign(delay=plant.delay),
        evaluation=EvaluationModel.of(whole and seeing(whole, poi)),
    )  # fmt: skip


def observer_system(observer: Any, plant: StandardPlant, poi: Poi) -> StateSpace | None:
    """Return the observer as a block of the plant, checked to give the POI's estimates."""
    if observer is None:
        return None
    inner = as_block(observer, "the observer", plant.dt)
    missing = [h for h in (poi.derived(a, "hat") for a in poi.axes) if h not in inner.outputs]
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


#: the lead's zero lies this factor below the bandwidth, its pole above: |S| of the rigid body
#: then peaks near 4 dB with the roll-off and integrator below
_LEAD = 4.0
#: gain at a notch's centre, and damping ratio of its poles
_DEPTH, _WIDTH = 0.05, 0.3


@dataclass(frozen=True)
class Axis:
    """``k (1 + w_i / s) (1 + r s / w_b) / (1 + s / (r w_b)) F(s)``, sampled by Tustin's rule.

    F is a second-order low-pass and the notches; k makes ``1 / s^2`` cross 1 at the bandwidth.
    """

    bandwidth: float
    rolloff: float
    integrator: float
    notches: tuple[float, ...]
    rate: float

    @cached_property
    def law(self) -> Law:
        """Error to acceleration."""
        zero, pole = self.bandwidth / _LEAD, self.bandwidth * _LEAD
        pid = Pid.corners(1.0, integrator=self.integrator, zero=zero, pole=pole)
        notches = (Notch(freq, _DEPTH, _WIDTH) for freq in self.notches)
        shape = Law((pid, LowPass(self.rolloff), *notches), rate=self.rate, prewarped=False)
        at = abs(shape.at(np.array([self.bandwidth]))[0])
        return shape * float((2.0 * np.pi * self.bandwidth) ** 2 / at)


@lru_cache(maxsize=64)
def rigid_body(rate: float, delay: float, suspension: float) -> StateSpace:
    """Return one motion of the body, held and delayed: acceleration commanded to error."""
    # its suspension's frequency [Hz], 0 when free, negative where magnets make poles +-2 pi |f|
    body = StateSpace(
        [[0.0, 1.0], [-((2.0 * np.pi) ** 2) * suspension * abs(suspension), 0.0]],
        [[0.0], [1.0]],
        [[-1.0, 0.0]],
        [[0.0]],
        inputs=["acceleration"],
        outputs=["error"],
        blocks=[2],
    )
    return held_exactly(body, rate, delay=delay)
